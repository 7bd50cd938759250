"""Joint-space paths of an arm that holds 12 kg upright, between configurations that need them."""

import json
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest

import cnpgen
from cnpgen.plans.plans import Plans
from cnpgen.problems.problem_record import open_problem
from cnpgen.refine import attempts
from cnpgen.refine.options import DEFAULT_OPTIONS
from cnpgen.refine.refine_engine import prepare, tasks_of
from cnpgen.refine.rrt_connect import (
    MAX_STATE_SPACING,
    STATE_SPACING,
    RestSpace,
    find_paths,
    follow_line,
)
from cnpgen.refine.task import Outcome
from cnpgen.world.world import World
from tests.conftest import needs_compiler

pytestmark = needs_compiler

ENDS = json.loads((Path(__file__).parents[1] / "data" / "transports.json").read_text())
UNSOLVED = [
    "goals of others",
    pytest.param("joint on its limit", marks=pytest.mark.slow),
]  # from other initial guesses
MAX_MIDPOINT_VIOLATION = 1.5  # tolerances, of states between the checked ones


def transport(label: str) -> Plans:
    return cnpgen.complete("heavy-object", **ENDS[label]).plans


def space_of(problems: Plans) -> RestSpace:
    tool, (task,) = prepare(problems, DEFAULT_OPTIONS), tasks_of(problems)
    return tool.rest_space(task)


def violations(problems: Plans, states: np.ndarray) -> Iterator[float]:
    """Yield the violations of the problem's constraints at rest in tolerances, by Pinocchio and Coal."""
    problem, robot = open_problem(problems.problem)
    (task,), world = (
        tasks_of(problems),
        World(robot, problem.obstacle, problem.object_size),
    )
    for q in states:
        world.set_state(q, 0 * q, 0 * q, task.scene.poses[0])
        for constraint in problem.constraint:
            for condition in constraint.measured(world):
                violation = np.maximum(
                    condition.lower - condition.g, condition.g - condition.upper
                )
                yield float((violation / constraint.allowed(condition)).max())


def test_a_path_holds_the_object_upright_and_within_all_limits() -> None:
    problems = transport("tilted on the way")
    space, ends = (
        space_of(problems),
        (problems.boundary.start_q[0], problems.boundary.goal_q[0]),
    )
    assert not follow_line(*ends, space.follow)[1]
    path = next(find_paths(*ends, space.robot, space.follow))
    np.testing.assert_allclose(path[[0, -1]], ends, atol=1e-6)
    assert np.abs(np.diff(path, axis=0)).max() <= MAX_STATE_SPACING
    assert max(violations(problems, path)) <= 1
    assert (
        max(violations(problems, (path[1:] + path[:-1]) / 2)) <= MAX_MIDPOINT_VIOLATION
    )


def test_states_off_the_equalities_are_projected_within_the_joint_limits() -> None:
    problems = transport("joint on its limit")
    space, start = space_of(problems), problems.boundary.goal_q
    robot, random = space.robot, np.random.default_rng(0)
    away = start.T + random.uniform(-STATE_SPACING, STATE_SPACING, (robot.n, 20))
    projected = space.projected(away)
    assert (projected >= robot.position_lower[:, None]).all()
    assert (projected <= robot.position_upper[:, None]).all()
    assert np.abs(projected - away).max() < 10 * STATE_SPACING
    problem, _ = open_problem(problems.problem)
    world = World(robot, problem.obstacle, problem.object_size)
    (vertical,) = (item for item in problem.constraint if item.reason == "not vertical")
    for q in projected.T:
        world.set_state(q, 0 * q, 0 * q, space.scene_poses)
        assert all(
            condition.violation() < 0.1 * vertical.tolerance
            for condition in vertical.measured(world)
        )


@pytest.mark.parametrize("label", UNSOLVED)
def test_a_transport_that_no_other_guess_solves_is_solved_along_a_path(
    label: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    (found,) = cnpgen.solve_plans(transport(label), workers=1).results
    assert found.valid
    assert found.outcome is Outcome.RESTARTED
    monkeypatch.setattr(attempts, "path_guesses", lambda refiner, task: iter(()))
    (before,) = cnpgen.solve_plans(transport(label), workers=1).results
    assert not before.valid
