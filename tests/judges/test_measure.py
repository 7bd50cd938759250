"""Names of the values of conditions."""

import numpy as np
import pytest

from cnpgen.judges.plans.measure import name_part
from cnpgen.problems.constraints.constraint import Condition
from cnpgen.world.world import World
from tests.examples.plans import PROBLEMS, ROBOTS, load


def names(problem_name: str) -> dict[str, list[str]]:
    """Return condition -> names of its values."""
    problem, world = (
        PROBLEMS[problem_name],
        World(
            ROBOTS[problem_name],
            PROBLEMS[problem_name].obstacle,
            PROBLEMS[problem_name].object_size,
        ),
    )
    return {
        condition.name: [
            name_part(problem, constraint, condition, part)
            for part in range(len(condition.g))
        ]
        for constraint in problem.constraint
        for condition in constraint.measured(world)
    }


def test_joints_and_axes_have_names_and_a_single_value_has_an_empty_one() -> None:
    named = names("airhockey")
    joints = list(PROBLEMS["airhockey"].robot.joints)
    for quantity in ("position", "velocity", "acceleration", "torque"):
        assert named[f"joint {quantity}"] == joints
    assert named["table rectangle"] == ["x", "y"]
    assert named["table height"] == [""]


def test_obstacles_are_named_in_the_order_of_measurement() -> None:
    named = names("heavy-object")
    assert named["object contact"] == ["pedestal-1", "pedestal-2"]
    assert named["robot clearance"] == [
        f"segment {segment}, pedestal-{number}"
        for segment in (1, 2, 3)
        for number in (1, 2)
    ]
    assert named["tilt"] == ["x", "y"]


@pytest.mark.parametrize(
    ("label", "name", "obstacle"),
    [("transport", "start", "pedestal-1"), ("dragging", "goal", "pedestal-2")],
)
def test_the_closest_obstacle_is_named(label: str, name: str, obstacle: str) -> None:
    """The object is lowered by 2 cm into the pedestal on which it stands."""
    plan = load(label)
    low = plan.start_xyz.copy(), plan.goal_xyz.copy()
    low[name == "goal"][0, 2] += 0.02
    (margin,) = [
        margin
        for key, margin in type(plan)(
            plan.problem, plan.robot, plan.motion, plan.boundary, *low
        )
        .judged()
        .margins.items()
        if key == "object contact"
    ]
    assert margin.part == obstacle
    assert margin.violation == pytest.approx(0.019, abs=2e-3)


def test_values_of_a_plug_in_are_numbered() -> None:
    condition = Condition("mine", "1", [0.0, 0.0], -np.ones(2), np.ones(2), "limit")
    assert name_part(PROBLEMS["airhockey"], object(), condition, 1) == "[1]"  # type: ignore[arg-type]
