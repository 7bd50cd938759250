"""Motions along joint-space paths around obstacles: free of collisions by meshes, and needed by some tasks."""

import numpy as np
import pytest

from cnpgen.problems.load_robot import load_robot
from cnpgen.problems.problem import Problem
from cnpgen.refine import attempts
from cnpgen.refine.initial_guesses import fit_to_path
from cnpgen.refine.strategy import PlanChecker, refine_task
from cnpgen.refine.task import Outcome
from cnpgen.trajectory.boundary import assemble
from cnpgen.trajectory.spline_motion import Motion
from tests.conftest import needs_compiled_code
from tests.examples.meshes import Meshes
from tests.examples.narrow import BESIDE_WALL, WALL, between, narrow, refiner

pytestmark = needs_compiled_code


@pytest.fixture(scope="module")
def wall(tmp_path_factory: pytest.TempPathFactory) -> Problem:
    return narrow(tmp_path_factory.mktemp("wall"), WALL)


def test_a_motion_along_a_path_meets_the_boundary_conditions(wall):
    robot, task, spec = load_robot(wall), between(wall, BESIDE_WALL), wall.trajectory
    path = np.array([BESIDE_WALL[0], [0.0, -1.0, 0.8, 0.2], BESIDE_WALL[1]])
    interior, rate = fit_to_path(path, task.boundary, robot.velocity_limit, spec)
    motion = Motion(
        assemble(task.boundary, interior[None], rate[None], spec),
        rate[None],
        spec.degree,
    )
    states = motion.at(np.linspace(0, 1, 50))
    assert np.abs(states.q[0, [0, -1]] - BESIDE_WALL).max() < 1e-12
    assert np.abs(states.dq[0, [0, -1]]).max() < 1e-12
    assert np.abs(states.q[0] - path[1]).max(axis=1).min() < 0.1
    assert (np.abs(states.dq) < 1.5 * robot.velocity_limit).all()


@pytest.mark.slow
def test_an_arm_moves_over_a_wall_that_no_other_guess_avoids(wall, monkeypatch):
    robot, tool, task = load_robot(wall), refiner(wall), between(wall, BESIDE_WALL)
    checker = PlanChecker(wall, robot, degree=tool.spec.degree)
    found = refine_task(tool, checker, task)
    assert found.valid
    assert found.outcome in {
        Outcome.TIME_SCALED,
        Outcome.RESTARTED,
        Outcome.SOLVED_FINE,
    }
    meshes = Meshes(wall, robot, wall.path.parent)
    states = (
        Motion(found.path[None], found.rate[None], tool.spec.degree)
        .at(np.linspace(0, 1, 300))
        .q[0]
    )
    assert (
        min(min(meshes.distances(q)) for q in states) > -1e-4
    )  # what the problem allows
    monkeypatch.setattr(
        attempts, "along_tree_paths", lambda refiner, task, best: iter(())
    )
    assert not refine_task(tool, checker, task).valid
