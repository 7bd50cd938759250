"""Ways of an arm that holds 12 kg upright, between configurations that no other start leads between."""

import json
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest

import cnpgen
from cnpgen.plans.plans import Plans
from cnpgen.problems.record import open_problem
from cnpgen.refine.engine import prepare, tasks_of
from cnpgen.refine.options import DEFAULT
from cnpgen.refine.refiner import Refiner
from cnpgen.refine.seeds import APART, LEAP, Space, find_ways, go
from cnpgen.refine.task import Outcome
from cnpgen.world.state import World
from tests.conftest import needs_compiler

pytestmark = needs_compiler

ENDS = json.loads((Path(__file__).parents[1] / "data" / "transports.json").read_text())
UNSOLVED = ["goals of others", pytest.param("joint on its limit", marks=pytest.mark.slow)]  # from other starts
BETWEEN = 1.5  # times the tolerance is what states between those that were looked at may be outside


def transport(label: str) -> Plans:
    return cnpgen.complete("heavy-object", **ENDS[label]).plans


def space_of(problems: Plans) -> Space:
    tool, (task,) = prepare(problems, DEFAULT), tasks_of(problems)
    return Space(tool.stage, tool.robot, tool.check.bounds_at_rest(task), task.tops)


def excess(problems: Plans, states: np.ndarray) -> Iterator[float]:
    """How far states at rest are outside what the problem asks for, in tolerances, as Pinocchio and Coal have it."""
    problem, robot = open_problem(problems.problem)
    (task,), world = tasks_of(problems), World(robot, problem.obstacle, problem.object_size)
    for q in states:
        world.set_state(q, 0 * q, 0 * q, task.tops)
        for constraint in problem.constraint:
            for condition in constraint.measured(world):
                outside = np.maximum(condition.lower - condition.g, condition.g - condition.upper)
                yield float((outside / constraint.allowed(condition)).max())


def test_a_way_holds_the_object_upright_and_within_all_limits() -> None:
    problems = transport("tilted on the way")
    space, ends = space_of(problems), (problems.boundary.start_q[0], problems.boundary.goal_q[0])
    assert not go(*ends, space.follow)[1]
    way = next(find_ways(*ends, space.robot, space.follow))
    np.testing.assert_allclose(way[[0, -1]], ends, atol=1e-6)
    assert np.abs(np.diff(way, axis=0)).max() <= LEAP
    assert max(excess(problems, way)) <= 1
    assert max(excess(problems, (way[1:] + way[:-1]) / 2)) <= BETWEEN


def test_states_off_the_equalities_are_put_on_them_within_the_joint_limits() -> None:
    problems = transport("joint on its limit")
    space, start = space_of(problems), problems.boundary.goal_q
    robot, random = space.robot, np.random.default_rng(0)
    away = start.T + random.uniform(-APART, APART, (robot.n, 20))
    found = space.projected(away)
    assert (found >= robot.position_lower[:, None]).all()
    assert (found <= robot.position_upper[:, None]).all()
    assert np.abs(found - away).max() < 10 * APART
    problem, _ = open_problem(problems.problem)
    world = World(robot, problem.obstacle, problem.object_size)
    (vertical,) = (each for each in problem.constraint if each.reason == "not vertical")
    for q in found.T:
        world.set_state(q, 0 * q, 0 * q, space.tops)
        assert all(condition.violation() < 0.1 * vertical.tolerance for condition in vertical.measured(world))


@pytest.mark.parametrize("label", UNSOLVED)
def test_a_transport_that_no_other_start_solves_is_solved_along_a_way(
    label: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    (found,) = cnpgen.solve_plans(transport(label), workers=1).refined
    assert found.valid
    assert found.outcome is Outcome.RESTARTED
    monkeypatch.setattr(Refiner, "_ways", lambda self, task, hulls=None: iter(()))
    (before,) = cnpgen.solve_plans(transport(label), workers=1).refined
    assert not before.valid
