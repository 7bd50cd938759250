"""Tasks and network outputs for the tests of the bridges, and the boundary conditions that control points meet."""

from typing import Any

import numpy as np
import scipy

from cnpgen.planner.boundary_layer import BoundaryLayer
from cnpgen.problems.problem_file import load_problem
from cnpgen.trajectory.boundary import Boundary
from cnpgen.trajectory.spline import clamped_knots
from tests.examples.models import accelerated


def boundary(problem: str, count: int, seed: int = 0) -> Boundary:
    """Draw boundary conditions near the base configuration, with moving starts and goals."""
    base, random = (
        np.array(load_problem(problem).robot.base),
        np.random.default_rng(seed),
    )
    draw = lambda scale: scale * random.standard_normal((count, len(base)))  # noqa: E731
    return Boundary(base + draw(0.2), draw(0.3), draw(1.0), base + draw(0.2), draw(0.3))


def boundary_for_layer(layer: BoundaryLayer, count: int) -> Boundary:
    """Draw boundary conditions for a block, with accelerations at the goal if they are given."""
    conditions = boundary(layer.problem.name, count)
    return conditions if layer.goal_acceleration == "free" else accelerated(conditions)


def outputs(
    layer: BoundaryLayer, count: int, seed: int = 1
) -> tuple[np.ndarray, np.ndarray]:
    """Draw network outputs."""
    random = np.random.default_rng(seed)
    return (
        random.uniform(-0.3, 0.3, (count, layer.path_outputs)),
        random.normal(-0.5, 0.3, (count, layer.rate_outputs)),
    )


def at_ends(path: Any, rate: Any) -> list[np.ndarray]:
    """Return q, dq and ddq at start and goal of motions by SciPy, on purpose independent of cnpgen's splines."""
    path, rate, states = np.asarray(path, float), np.asarray(rate, float), []
    p = scipy.interpolate.BSpline(
        clamped_knots(path.shape[1], 7), path.swapaxes(0, 1), 7
    )
    r = scipy.interpolate.BSpline(clamped_knots(rate.shape[1], 7), rate.T[..., None], 7)
    for s in (0.0, 1.0):
        states += [p(s), p(s, 1) * r(s), p(s, 2) * r(s) ** 2 + p(s, 1) * r(s, 1) * r(s)]
    return states
