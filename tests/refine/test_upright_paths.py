"""Joint-space paths of an arm that holds 12 kg upright, between configurations that need them."""

import json
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest

import cnpgen
from cnpgen.plans.plans import Plans
from cnpgen.problems.problem_record import open_problem
from cnpgen.refine import attempts, rrt_connect
from cnpgen.refine.options import DEFAULT_OPTIONS
from cnpgen.refine.refine_engine import prepare, tasks_of
from cnpgen.refine.rrt_connect import MANIFOLD_SPACING_RAD, TreeSearch
from cnpgen.refine.task import Outcome
from cnpgen.world.world import World
from tests.conftest import needs_compiled_code

pytestmark = needs_compiled_code

ENDS = json.loads((Path(__file__).parents[1] / "data" / "transports.json").read_text())
UNSOLVED = [
    "goals of others",
    pytest.param("joint on its limit", marks=pytest.mark.slow),
]  # from other initial guesses
MAX_MIDPOINT_VIOLATION = 1.5  # tolerances, of states between the checked ones


def transport(label: str) -> Plans:
    return cnpgen.complete("heavy-object", **ENDS[label]).plans


def search_of(problems: Plans) -> TreeSearch:
    tool, (task,) = prepare(problems, DEFAULT_OPTIONS), tasks_of(problems)
    return tool.tree_search(task)


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
    search = search_of(problems)
    ends = problems.boundary.start_q[0], problems.boundary.goal_q[0]
    assert search.line() is None
    path, *others = search.paths()
    assert 0 < len(others) < rrt_connect.MAX_CHECKED_PATHS
    np.testing.assert_array_equal(path[[0, -1]], ends)
    assert np.abs(np.diff(path, axis=0)).max() <= 3 * MANIFOLD_SPACING_RAD
    assert max(violations(problems, path)) <= 1
    assert (
        max(violations(problems, (path[1:] + path[:-1]) / 2)) <= MAX_MIDPOINT_VIOLATION
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
