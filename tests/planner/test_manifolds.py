"""Every manifold of the tip behind the network: its landing brings paths that are near a manifold onto it."""

from pathlib import Path

import numpy as np
import pytest

from cnpgen.kernels.library import problem_kernels
from cnpgen.planner.landing import make_landing
from cnpgen.problems.problem import Problem
from cnpgen.trajectory.motion import Motion
from cnpgen.world.state import World
from tests.examples.manifolds import ROBOT, ends_on, problem_on


def off(problem: Problem, path: np.ndarray) -> np.ndarray:
    """How far paths are off the manifold, at worst, in the middle half of their phases, shape (N,)."""
    world, found = World(ROBOT, (), None), []
    states = Motion(path, np.ones((len(path), 20))).at(np.linspace(0.25, 0.75, 40))
    for motion in states.q:
        worst = 0.0
        for q in motion:
            world.set_state(q, 0 * q, 0 * q, np.zeros(0))
            conditions = [each for constraint in problem.constraint for each in constraint.measured(world)]
            worst = max(worst, *(each.violation() for each in conditions if each.is_equality))
        found.append(worst)
    return np.array(found)


DEAR = pytest.mark.extended  # building kernels of two and more equalities takes long, and the claim is the same


@pytest.mark.slow
@pytest.mark.parametrize("name", ["plane", *(pytest.param(name, marks=DEAR) for name in ("line", "axis", "pose"))])
def test_paths_near_a_manifold_are_on_it_behind_the_landing(name: str, tmp_path: Path) -> None:
    problem, (start, goal) = problem_on(name), ends_on(name)
    landing = make_landing(problem, problem_kernels(problem, ROBOT, "numpy", tmp_path), steps=1)
    along = np.r_[0, 0, 0, np.linspace(0, 1, 10), 1, 1][:, None]
    path = np.repeat((start + along * (goal - start))[None], 4, axis=0)
    path[:, 3:13] += np.random.default_rng(0).uniform(-0.03, 0.03, path[:, 3:13].shape)
    landed = landing.land(path, np.zeros((4, 0)))
    before, after = off(problem, path), off(problem, landed)
    assert np.median(before) > 0.005
    assert (after < 0.1 * before).all()
    np.testing.assert_array_equal(landed[:, [0, 1, 2, 13, 14]], path[:, [0, 1, 2, 13, 14]])
