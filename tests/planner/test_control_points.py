"""Control points from the network's outputs: boundary conditions by construction, gradients by finite differences."""

import numpy as np
import pytest
import scipy

from cnpgen.planner.control_points import control_points, vjp
from cnpgen.planner.tasks import MIN_EXPECTED_TIME_S, Tasks, expected_time
from cnpgen.robots.scene import Scene
from cnpgen.trajectory.boundary import Boundary, anchor_line
from cnpgen.trajectory.spline import clamped_knots
from cnpgen.trajectory.trajectory_spec import TrajectorySpec
from tests.trajectory.test_boundary_derivatives import random_boundary

SPEC, N, JOINTS = TrajectorySpec(), 5, 3


def tasks(*, goal_ddq: bool = False, corrected: bool = True, seed: int = 0) -> Tasks:
    boundary, random = (
        random_boundary(N, JOINTS, goal_ddq=goal_ddq, seed=seed),
        np.random.default_rng(seed),
    )
    interior = SPEC.path_control_points - 3 - boundary.fixed_at_goal
    correction = random.normal(0, 0.1, (N, interior, JOINTS)) if corrected else None
    tips = random.normal(size=(2, N, 3))
    return Tasks(
        boundary,
        *tips,
        expected_time(boundary, np.ones(JOINTS)),
        Scene((), np.empty((N, 0))),
        correction,
    )


def outputs(given: Tasks, seed: int = 1) -> tuple[np.ndarray, np.ndarray]:
    random = np.random.default_rng(seed)
    interior = SPEC.path_control_points - 3 - given.boundary.fixed_at_goal
    phi = random.uniform(-1, 1, (N, interior * JOINTS))
    return phi, random.normal(0, 0.3, (N, SPEC.rate_control_points))


@pytest.mark.parametrize("goal_ddq", [False, True])
def test_boundary_conditions_hold_for_any_output(goal_ddq):
    given = tasks(goal_ddq=goal_ddq)
    points = control_points(given, *outputs(given), scale=0.3, spec=SPEC)
    for i in range(N):
        p = scipy.interpolate.BSpline(clamped_knots(15, 7), points.path[i], 7)
        r = scipy.interpolate.BSpline(clamped_knots(20, 7), points.rate[i], 7)
        for end, s in (("start", 0.0), ("goal", 1.0)):
            dq = p(s, 1) * r(s)
            ddq = p(s, 2) * r(s) ** 2 + p(s, 1) * r(s, 1) * r(s)
            wanted = [
                getattr(given.boundary, f"{end}_{what}") for what in ("q", "dq", "ddq")
            ]
            for found, want, exact in zip(
                (p(s), dq, ddq), wanted, (1e-12, 1e-10, 1e-8), strict=True
            ):
                if want is not None:
                    np.testing.assert_allclose(found, want[i], atol=exact)


def test_without_outputs_the_path_is_the_papers_line_at_the_expected_time():
    given = tasks(corrected=False)
    phi, log_rate = outputs(given)
    points = control_points(given, 0 * phi, 0 * log_rate, scale=np.pi, spec=SPEC)
    np.testing.assert_allclose(
        points.rate, 1 / given.expected_time[:, None] * np.ones(20)
    )
    np.testing.assert_allclose(
        points.path[:, 3:13], anchor_line(given.boundary, points.rate, SPEC), atol=1e-12
    )


def test_phi_times_scale_is_added_to_the_interior_control_points():
    given = tasks()
    phi, log_rate = outputs(given)
    zero = control_points(given, 0 * phi, log_rate, scale=0.3, spec=SPEC)
    points = control_points(given, phi, log_rate, scale=0.3, spec=SPEC)
    np.testing.assert_allclose(
        points.path[:, 3:13] - zero.path[:, 3:13], 0.3 * phi.reshape(N, 10, JOINTS)
    )


@pytest.mark.parametrize("goal_ddq", [False, True])
@pytest.mark.parametrize("corrected", [False, True])
def test_gradients_reach_the_outputs_through_interior_boundary_and_line(
    goal_ddq, corrected
):
    given = tasks(goal_ddq=goal_ddq, corrected=corrected)
    phi, log_rate = outputs(given)
    random = np.random.default_rng(2)
    a, b = random.normal(size=(N, 15, JOINTS)), random.normal(size=(N, 20))

    def scalar(phi: np.ndarray, log_rate: np.ndarray) -> np.ndarray:
        points = control_points(given, phi, log_rate, scale=0.3, spec=SPEC)
        return (points.path * a).sum(axis=(1, 2)) + (points.rate * b).sum(axis=1)

    points = control_points(given, phi, log_rate, scale=0.3, spec=SPEC)
    by_phi, by_rate = vjp(
        given, points, path_gradient=a, rate_gradient=b, scale=0.3, spec=SPEC
    )
    for i in range(phi.shape[1]):
        step = np.zeros_like(phi)
        step[:, i] = 1e-6
        found = (scalar(phi + step, log_rate) - scalar(phi - step, log_rate)) / 2e-6
        np.testing.assert_allclose(by_phi[:, i], found, rtol=1e-6, atol=1e-7)
    for i in range(20):
        step = np.zeros_like(log_rate)
        step[:, i] = 1e-6
        found = (scalar(phi, log_rate + step) - scalar(phi, log_rate - step)) / 2e-6
        np.testing.assert_allclose(by_rate[:, i], found, rtol=1e-5, atol=1e-6)


def test_the_expected_time_is_the_largest_of_the_joints_with_a_lower_bound():
    q = np.zeros((2, 2))
    goal = np.array([[1.0, 3.0], [1e-3, 0.0]])
    boundary = Boundary(q, q, q, goal, q)
    np.testing.assert_allclose(
        expected_time(boundary, np.array([2.0, 1.5])), [2.0, MIN_EXPECTED_TIME_S]
    )
