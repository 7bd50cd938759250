"""Derivatives of the boundary control points with respect to the rate, against finite differences."""

import numpy as np
import pytest

from cnpgen.trajectory.boundary import (
    Boundary,
    boundary_derivatives,
    goal_points,
    start_points,
)
from cnpgen.trajectory.trajectory_spec import TrajectorySpec

STEP = 1e-6


def random_boundary(rows: int, n: int, *, goal_ddq: bool, seed: int = 0) -> Boundary:
    random = np.random.default_rng(seed)
    parts = [random.normal(size=(rows, n)) for _ in range(6)]
    return Boundary(*parts[:5], parts[5] if goal_ddq else None)


@pytest.mark.parametrize("goal_ddq", [False, True])
@pytest.mark.parametrize(
    "spec", [TrajectorySpec(), TrajectorySpec(degree=5, path_control_points=9)]
)
def test_derivatives_agree_with_finite_differences_and_others_are_zero(spec, goal_ddq):
    boundary, random = (
        random_boundary(4, 3, goal_ddq=goal_ddq),
        np.random.default_rng(1),
    )
    rate = random.uniform(0.5, 2.0, (4, spec.rate_control_points))
    listed = {
        (each.point, each.variable): each.derivative
        for each in boundary_derivatives(boundary, rate, spec)
    }

    def points(rate: np.ndarray) -> np.ndarray:
        path = np.zeros((4, spec.path_control_points, 3))
        path[:, :3], path[:, -boundary.fixed_at_goal :] = (
            start_points(boundary, rate, spec),
            goal_points(boundary, rate, spec),
        )
        return path

    for variable in range(spec.rate_control_points):
        change = np.zeros_like(rate)
        change[:, variable] = STEP
        found = (points(rate + change) - points(rate - change)) / (2 * STEP)
        for point in range(spec.path_control_points):
            expected = listed.get((point, variable), np.zeros((4, 3)))
            np.testing.assert_allclose(found[:, point], expected, rtol=1e-6, atol=1e-8)
    assert len(listed) == (6 if goal_ddq else 4)
