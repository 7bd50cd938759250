"""Projection onto every manifold of the tip: paths near a manifold are moved onto it."""

from pathlib import Path

import numpy as np
import pytest

from cnpgen.kernels.library import problem_kernels
from cnpgen.planner.control_points import make_projection
from cnpgen.problems.problem import Problem
from cnpgen.trajectory.spline_motion import Motion
from cnpgen.world.world import World
from tests.examples.manifolds import ends_on, problem_on
from tests.examples.shipped import ROBOTS


def manifold_distances(problem: Problem, path: np.ndarray) -> np.ndarray:
    """Return the largest violations of equalities by paths in the central half of their phases, shape (N,)."""
    world, found = World(ROBOTS["heavy-object"], (), None), []
    states = Motion(path, np.ones((len(path), 20))).at(np.linspace(0.25, 0.75, 40))
    for motion in states.q:
        worst = 0.0
        for q in motion:
            world.set_state(q, 0 * q, 0 * q, np.zeros(0))
            conditions = [
                each
                for constraint in problem.constraint
                for each in constraint.measured(world)
            ]
            worst = max(
                worst, *(each.violation() for each in conditions if each.is_equality)
            )
        found.append(worst)
    return np.array(found)


EXPENSIVE = (
    pytest.mark.extended
)  # kernels of two and more equalities take long to build; the claim is the same


@pytest.mark.slow
@pytest.mark.parametrize(
    "name",
    [
        "plane",
        *(pytest.param(name, marks=EXPENSIVE) for name in ("line", "axis", "pose")),
    ],
)
def test_projection_moves_paths_near_a_manifold_onto_it(
    name: str, tmp_path: Path
) -> None:
    problem, (start, goal) = problem_on(name), ends_on(name)
    projection = make_projection(
        problem,
        problem_kernels(problem, ROBOTS["heavy-object"], "numpy", tmp_path),
        steps=1,
    )
    along = np.r_[0, 0, 0, np.linspace(0, 1, 10), 1, 1][:, None]
    path = np.repeat((start + along * (goal - start))[None], 4, axis=0)
    path[:, 3:13] += np.random.default_rng(0).uniform(-0.03, 0.03, path[:, 3:13].shape)
    projected = projection.project(path, np.zeros((4, 0)))
    before, after = (
        manifold_distances(problem, path),
        manifold_distances(problem, projected),
    )
    assert np.median(before) > 0.005
    assert (after < 0.1 * before).all()
    np.testing.assert_array_equal(
        projected[:, [0, 1, 2, 13, 14]], path[:, [0, 1, 2, 13, 14]]
    )
