"""Who states the limits of a problem: derived from the origin of the numbers, or stated in the file."""

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from cnpgen.addons.trajectories.evaluate_trajectories import evaluate_trajectories
from cnpgen.addons.trajectories.sampled_trajectory import Trajectory
from cnpgen.addons.trajectories.trajectory_options import summary_text
from cnpgen.cli import verdict_text
from cnpgen.cli.main import main
from cnpgen.errors import RecipeError
from cnpgen.make.any_recipe import load_any
from cnpgen.make.recipe import recipe_digest
from cnpgen.plans.evaluate import evaluate_plans
from cnpgen.problems.limit_sources import judged_sources, limit_sources, sources_line
from cnpgen.problems.load_robot import load_robot
from cnpgen.problems.problem import Problem
from cnpgen.problems.problem_file import load_problem
from cnpgen.problems.problem_record import open_problem, record_problem
from cnpgen.robots.robot_spec import LimitSources
from cnpgen.schema.catalogue import list_recipes
from tests.examples.plan_files import plans_of
from tests.examples.plans import load
from tests.problems.test_drive import arm, changed
from tests.refusals import is_refused

SOURCES = LimitSources(velocity="vendor: data sheet: page 3", jerk="guess: 100/s")


def found(problem: Problem) -> dict[str, tuple[str, str]]:
    sources = limit_sources(problem, load_robot(problem))
    return {name: (each.basis, each.source) for name, each in sources.items()}


def test_the_origin_of_numbers_says_who_states_them() -> None:
    assert found(load_problem("heavy-object")) == {
        "position": ("urdf", ""),
        "velocity": ("urdf", "times 0.8"),
        "acceleration": (
            "guess",
            "10/s times the velocity limits, at most 20 rad/s^2",
        ),
        "jerk": ("guess", "5/s times the acceleration limits"),
        "torque": ("urdf", "times 0.8"),
    }


def test_numbers_without_a_source_are_not_stated(tmp_path: Path) -> None:
    numbers = "position = [[-1, 1], [-1, 1], [-1, 1], [-1, 1]]\nvelocity = 1\n"
    numbers += "acceleration = 2\njerk = 3\ntorque = 4\nvelocity_scale = 0.5"
    motors = "[drive]\ntorque = 5"
    sources = found(arm(tmp_path, motors, "soft-limits", numbers))
    assert set(sources) >= {"position", "jerk", "motor"}
    assert {basis for basis, _ in sources.values()} == {"not stated"}
    text = '\n[limits.sources]\nvelocity = "vendor: data sheet: page 3"'
    stated = found(arm(tmp_path, "", "soft-limits", numbers + text))
    assert stated["velocity"] == ("vendor", "data sheet: page 3, times 0.5")
    assert stated["jerk"] == ("not stated", "")


def test_limits_of_derivatives_are_those_of_a_urdf_that_has_all(tmp_path: Path) -> None:
    one = 'velocity="2" acceleration="4" jerk="9"'
    problem = arm(tmp_path, urdf=changed(tmp_path, 'velocity="2"', one))
    # The other joints have none: a rule bounds them.
    for name in ("acceleration", "jerk"):
        basis, source = found(problem)[name]
        assert basis == "guess"
        joint = load_robot(problem).joint_names[0]
        assert source.startswith(f"the URDF for {joint}; ")
        assert source.endswith(" for the others")
    text = problem.urdf_path.read_text(encoding="utf-8")
    tagged = text.replace("<limit ", '<limit acceleration="4" jerk="9" ')
    (tmp_path / "all.urdf").write_text(tagged.replace(one, 'velocity="2"'))
    problem = arm(tmp_path, urdf=str(tmp_path / "all"))
    assert found(problem)["acceleration"] == found(problem)["jerk"] == ("urdf", "")


@pytest.mark.parametrize("text", ["data sheet", "vendor:", "maker: data sheet"])
def test_a_source_without_a_known_basis_is_refused(tmp_path: Path, text: str) -> None:
    with is_refused(RecipeError):
        arm(tmp_path, limits=f'[limits.sources]\nvelocity = "{text}"')


def test_sources_change_no_digest_and_are_kept_in_records() -> None:
    dataset = load_any("heavy-object", "dataset")
    problem = dataset.pipeline.problem
    stated = replace(problem, limits=replace(problem.limits, sources=SOURCES))
    pipeline = replace(dataset.pipeline, problem=stated)
    assert stated.identity == problem.identity
    assert stated.structure == problem.structure
    assert recipe_digest(pipeline) == recipe_digest(dataset)
    record, plain = record_problem(stated), record_problem(problem)
    assert record.comparable_sha256 == plain.comparable_sha256
    assert not record.differences(plain)
    again, robot = open_problem(record)
    assert limit_sources(again, robot)["velocity"].source == (
        "data sheet: page 3, times 0.8"
    )
    assert "sources" not in plain.content["limits"]


def test_numbers_of_shipped_problems_have_sources() -> None:
    for name in list_recipes("problem"):
        limits = load_problem(name).limits
        for quantity in ("position", "velocity", "acceleration", "jerk", "torque"):
            if getattr(limits, quantity):
                assert limits.sources is not None, name
                assert getattr(limits.sources, quantity), (name, quantity)


def test_verdicts_and_show_state_the_sources(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    line = "limits: the URDF's: position, velocity, torque; guessed: acceleration"
    plans = plans_of(load("transport"))
    judged = evaluate_plans(plans)
    assert line in verdict_text.summary_text(tmp_path, judged).splitlines()
    assert judged.summary()["limit_sources"]["torque"] == {
        "basis": "urdf",
        "source": "times 0.8",
    }
    still = Trajectory(np.arange(5) / 30, np.zeros((5, 7)))
    samples = evaluate_trajectories("heavy-object", [still])
    assert line in summary_text(tmp_path, samples).splitlines()
    assert samples.summary()["limit_sources"] == judged.summary()["limit_sources"]
    assert main(["show", "heavy-object", "--kind", "problem"]) == 0
    shown = [" ".join(row.split()) for row in capsys.readouterr().out.splitlines()]
    assert "torque the URDF's times 0.8" in shown
    assert not any(row.startswith("jerk") for row in shown)
    assert main(["show", "heavy-object", "--kind", "problem", "--json"]) == 0
    content = json.loads(capsys.readouterr().out)
    assert content["limit_sources"]["jerk"]["basis"] == "guess"


def test_sources_of_limits_that_no_constraint_applies_are_left_out() -> None:
    problem = replace(load_problem("heavy-object"), constraint=())
    sources = judged_sources(problem, load_robot(problem))
    assert not sources
    assert not sources_line(sources)
