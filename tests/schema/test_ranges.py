"""Arguments out of their range, larger than the memory, or names of no recipe name the argument and a remedy."""

import json
from unittest.mock import ANY

import numpy as np
import pytest

import cnpgen
from cnpgen.addons.online.plan_hits import plan_hits
from cnpgen.errors import MachineError, RecipeError, UsageError
from cnpgen.problems.problem_record import ProblemRecord, open_problem, record_problem
from cnpgen.refine.options import RefineOptions
from cnpgen.robots.observation.camera import Camera
from cnpgen.robots.scene import Scene
from cnpgen.schema import arguments
from cnpgen.schema.argument_types import checked_arguments
from cnpgen.schema.arguments import check_range, numbers
from cnpgen.schema.catalogue import find_recipe
from tests.refusals import is_refused


@pytest.fixture(scope="module")
def planner():
    return cnpgen.Planner("airhockey-replan")


def test_a_value_in_another_unit_has_a_suggestion():
    check_range("error", [0.0, 0.5], 0.0, 0.5, "rad")
    with is_refused(UsageError, argument="error"):
        check_range("error", [0.1, 2.0], 0.0, 0.5, "rad")
    with is_refused(UsageError, argument="time"):
        check_range("time", 500.0, 0.0, 60.0, "s")
    with is_refused(UsageError, argument="time"):
        check_range("time", np.nan, 0.0, 60.0, "s")


def test_public_functions_check_their_ranges(planner):
    state = (planner.robot.home, *np.zeros((2, planner.robot.n)))
    plans = planner.plan(planner.robot.home, planner.robot.home + 0.1)
    calls = {
        "meeting_time": lambda: plan_hits(
            planner, state, [1.0, 0.1], [2.49, 0.0], meeting_time=500
        ),
        "puck_velocity": lambda: plan_hits(
            planner, state, [1.0, 0.1], [2.49, 0.0], puck_velocity=[900.0, 0.0]
        ),
        "tracking_error": lambda: cnpgen.evaluate_plans(plans, tracking_error=2.0),
        "stay_within": lambda: RefineOptions(stay_within=2.0),
        "radius": lambda: cnpgen.scenes.obstacles_of_points(
            np.zeros((1, 3)), radius=5.0
        ),
        "field_of_view": lambda: Camera(field_of_view=60.0),
    }
    for argument, call in calls.items():
        with is_refused(UsageError, argument=ANY) as caught:
            call()
        assert caught.value.argument == argument


@pytest.mark.parametrize(
    ("call", "argument"),
    [
        (cnpgen.load_problem, "name_or_path"),
        (cnpgen.recipes.load_pipeline, "name_or_path"),
        (cnpgen.recipes.load_dataset_recipe, "name_or_path"),
        (cnpgen.make_dataset, "recipe"),
        (cnpgen.RobotModel, "problem"),
    ],
)
def test_names_of_no_recipe_carry_the_argument(call, argument):
    with is_refused(RecipeError, argument=ANY) as caught:
        call("nope")
    assert caught.value.argument == argument


def test_views_that_repeat_values_are_compared_with_the_memory(planner):
    q = np.broadcast_to(planner.robot.home, (10**13, planner.robot.n))
    with pytest.raises(
        UsageError,
        match=r"start_q must be smaller: 10,000,000,000,000 needs at least .* GB",
    ):
        planner.plan(q, q)
    with pytest.raises(UsageError, match="goal_xyz must be smaller"):
        cnpgen.complete(
            "airhockey-hit", goal_xyz=np.broadcast_to([1.0, 0.1], (10**13, 2))
        )


def test_many_plans_are_compared_with_the_memory(planner, monkeypatch):
    q = np.repeat(planner.robot.home[None], 1000, axis=0)
    monkeypatch.setattr(arguments, "MIN_CHECKED_SIZE", 100)
    monkeypatch.setattr(arguments, "available_bytes", lambda: 100_000)
    with is_refused(UsageError, argument="start_q"):
        planner.plan(q, q)
    with is_refused(UsageError, argument="boundary"):
        planner.plan_batch(
            cnpgen.Boundary(q, *np.zeros((2, *q.shape)), q, np.zeros(q.shape))
        )
    assert len(numbers("q", q)) == 1000


def test_a_failed_allocation_is_an_error_of_the_machine():
    @checked_arguments
    def allocate(n: int) -> None:
        raise MemoryError(f"Unable to allocate {n} GiB")

    with is_refused(MachineError):
        allocate(4)


def test_stored_recipes_may_have_implausible_values(tmp_path):
    text = find_recipe(("problem",), "heavy-object").read_text(encoding="utf-8")
    source = find_recipe(("problem",), "heavy-object").parent / "iiwa14_object.urdf"
    file = tmp_path / "problem.toml"
    file.write_text(
        text.replace('"iiwa14_object.urdf"', f'"{source}"'), encoding="utf-8"
    )
    record = record_problem(cnpgen.load_problem(file))
    content = json.loads(record.recipe)
    content["limits"]["acceleration_cap"] = 1e6
    stored = ProblemRecord(
        json.dumps(content),
        record.urdf.replace('upper="2.9670597283903604"', 'upper="30"', 1),
    )
    assert stored != record
    problem, robot = open_problem(stored)
    assert problem.limits.acceleration_cap == 1e6
    assert robot.position_upper.max() == 30
    file.write_text(
        file.read_text().replace(
            'acceleration_cap = "20 rad/s^2"', "acceleration_cap = 1e6"
        )
    )
    with is_refused(RecipeError):
        cnpgen.load_problem(file)


def test_hints_follow_only_values_without_a_unit(tmp_path):
    file = tmp_path / "problem.toml"
    text = find_recipe(("problem",), "heavy-object").read_text(encoding="utf-8")
    for value, hint in (('"103 deg"', False), ("1.8", True)):
        file.write_text(
            text.replace('tolerance = "1.8 deg"', f"tolerance = {value}"),
            encoding="utf-8",
        )
        with is_refused(RecipeError) as caught:
            cnpgen.load_problem(file)
        assert ("did you mean" in str(caught.value)) == hint


def test_scenes_have_obstacles_and_poses():
    with is_refused(UsageError, argument="obstacles"):
        Scene(3, np.zeros((1, 3)))
    with is_refused(UsageError, argument="poses"):
        Scene((), 3)
