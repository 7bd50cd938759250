"""Boundary control points: exact in time, compared with SciPy's derivatives and an explicit chain rule."""

from collections.abc import Iterator
from dataclasses import replace

import numpy as np
import pytest
import scipy

from cnpgen.errors import UsageError
from cnpgen.trajectory.boundary import (
    Boundary,
    anchor_line,
    assemble,
    boundary_of,
    goal_points,
    start_points,
)
from cnpgen.trajectory.trajectory_spec import TrajectorySpec
from tests.refusals import is_refused

N, JOINTS = 5, 6


def draw_boundary(
    random: np.random.Generator, *, goal_ddq: bool, n: int = JOINTS, rows: int = N
) -> Boundary:
    q, dq, ddq = (
        random.uniform(-2, 2, (2, rows, n)),
        random.uniform(-2, 2, (2, rows, n)),
        None,
    )
    ddq = random.uniform(-20, 20, (2, rows, n))
    return Boundary(q[0], dq[0], ddq[0], q[1], dq[1], ddq[1] if goal_ddq else None)


def draw_spec(random: np.random.Generator) -> TrajectorySpec:
    degree = int(random.choice([5, 7]))
    return TrajectorySpec(
        degree=degree,
        path_control_points=int(random.integers(max(10, degree + 2), 31)),
        rate_control_points=int(random.integers(10, 31)),
    )


def end_states(
    path: np.ndarray, rate: np.ndarray, degree: int
) -> Iterator[tuple[np.ndarray, np.ndarray, np.ndarray]]:
    """Yield q, dq, ddq in time at s = 0 and s = 1 of one motion."""

    def spline(control: np.ndarray) -> scipy.interpolate.BSpline:
        inner = np.arange(1, len(control) - degree) / (len(control) - degree)
        return scipy.interpolate.BSpline(
            np.r_[[0.0] * (degree + 1), inner, [1.0] * (degree + 1)], control, degree
        )

    p, r = spline(path), spline(rate)
    for s in (0.0, 1.0):
        dq = p.derivative(1)(s) * r(s)
        yield (
            p(s),
            dq,
            p.derivative(2)(s) * r(s) ** 2
            + p.derivative(1)(s) * r.derivative(1)(s) * r(s),
        )


@pytest.mark.parametrize("goal_ddq", [False, True])
@pytest.mark.parametrize("seed", range(12))
def test_boundary_conditions_hold_in_time(seed: int, goal_ddq: bool) -> None:
    random = np.random.default_rng(seed)
    spec, boundary = draw_spec(random), draw_boundary(random, goal_ddq=goal_ddq)
    rate = np.exp(random.normal(0, 0.5, (N, spec.rate_control_points)))
    interior = random.normal(
        size=(N, spec.path_control_points - 3 - boundary.fixed_at_goal, JOINTS)
    )
    path = assemble(boundary, interior, rate, spec)
    assert path.shape == (N, spec.path_control_points, JOINTS)
    for i in range(N):
        start, goal = end_states(path[i], rate[i], spec.degree)
        expected = [
            *zip(
                start,
                (boundary.start_q[i], boundary.start_dq[i], boundary.start_ddq[i]),
                strict=True,
            )
        ]
        expected += [
            *zip(goal, (boundary.goal_q[i], boundary.goal_dq[i]), strict=False)
        ]
        if boundary.goal_ddq is not None:
            expected.append((goal[2], boundary.goal_ddq[i]))
        for found, wanted in expected:
            assert np.abs(found - wanted).max() < 1e-10


def test_the_printed_eta_makes_the_boundary_velocity_too_small_by_c_minus_d() -> None:
    spec = TrajectorySpec()
    points, degree = spec.path_control_points, spec.degree
    boundary = draw_boundary(np.random.default_rng(0), goal_ddq=False, rows=1)
    rate = np.full((1, spec.rate_control_points), 2.0)
    path = assemble(boundary, anchor_line(boundary, rate, spec), rate, spec)
    path[:, 1] = boundary.start_q + boundary.start_dq / (
        rate[:, :1] * degree * (points - degree) ** 2
    )  # Appendix A
    (_, found, _), _ = end_states(path[0], rate[0], degree)
    assert np.allclose(found * (points - degree), boundary.start_dq[0], rtol=1e-10)
    assert not np.allclose(found, boundary.start_dq[0], rtol=0.5)


def test_motions_at_rest_have_equal_boundary_control_points_for_any_rate() -> None:
    random = np.random.default_rng(1)
    q, zero = random.normal(size=(2, N, JOINTS)), np.zeros((N, JOINTS))
    boundary, spec = Boundary(q[0], zero, zero, q[1], zero, zero), TrajectorySpec()
    rate = np.exp(random.normal(size=(N, 20)))
    assert np.abs(start_points(boundary, rate, spec) - q[0][:, None]).max() < 1e-14
    assert np.abs(goal_points(boundary, rate, spec) - q[1][:, None]).max() < 1e-14


def test_the_anchor_line_agrees_with_the_paper() -> None:
    """Indices 3 to 12, from C_2 to C_13: i + N_i for 0 <= i <= C - B, B = N_i + N_d + 1 (eq. of the control points)."""
    random = np.random.default_rng(2)
    spec, boundary = TrajectorySpec(), draw_boundary(random, goal_ddq=False)
    rate = np.exp(random.normal(size=(N, 20)))
    line = anchor_line(boundary, rate, spec)
    path = assemble(boundary, line, rate, spec)
    points, n_start, n_goal = 15, 3, 2
    b = n_start + n_goal + 1
    assert line.shape == (N, points - b + 1, JOINTS)
    for i in range(points - b + 1):
        expected = path[:, 2] * (1 - i / (points - b)) + path[
            :, points - n_goal
        ] * i / (points - b)
        assert np.abs(path[:, i + n_start] - expected).max() < 1e-14
    assert np.array_equal(path[:, 3], path[:, 2])
    assert np.array_equal(path[:, 12], path[:, 13])


def test_a_prescribed_goal_acceleration_fixes_one_more_control_point() -> None:
    random = np.random.default_rng(3)
    spec, boundary = TrajectorySpec(), draw_boundary(random, goal_ddq=True)
    rate = np.exp(random.normal(size=(N, 20)))
    assert boundary.fixed_at_goal == 3
    assert goal_points(boundary, rate, spec).shape == (N, 3, JOINTS)
    line = anchor_line(boundary, rate, spec)
    assert line.shape == (N, 9, JOINTS)
    assert np.array_equal(line[:, -1], assemble(boundary, line, rate, spec)[:, 12])


def test_a_batch_agrees_with_its_single_motions() -> None:
    random = np.random.default_rng(4)
    spec, boundary = TrajectorySpec(), draw_boundary(random, goal_ddq=True)
    rate = np.exp(random.normal(size=(N, 20)))
    whole = start_points(boundary, rate, spec), goal_points(boundary, rate, spec)
    for i in range(N):
        one = boundary[i : i + 1]
        assert len(one) == 1
        assert np.array_equal(start_points(one, rate[[i]], spec)[0], whole[0][i])
        assert np.array_equal(goal_points(one, rate[[i]], spec)[0], whole[1][i])
    chosen = boundary[np.array([False, True, False, True, True])]
    assert len(chosen) == 3
    assert np.array_equal(chosen.goal_ddq, boundary.goal_ddq[[1, 3, 4]])
    assert boundary[np.array([2, 0])].goal_ddq.shape == (2, JOINTS)


def test_a_path_of_a_single_span_raises_an_error() -> None:
    boundary = draw_boundary(np.random.default_rng(5), goal_ddq=False)
    spec = TrajectorySpec(degree=7, path_control_points=8, rate_control_points=8)
    with is_refused(UsageError):
        start_points(boundary, np.ones((N, 8)), spec)
    assert assemble(boundary, np.zeros((N, 4, JOINTS)), np.ones((N, 8)), TrajectorySpec(
        degree=7, path_control_points=9, rate_control_points=8)).shape == (N, 9, JOINTS)  # fmt: skip


def test_conditions_of_different_joints_raise_an_error_with_their_names() -> None:
    random = np.random.default_rng(2)
    spec = draw_spec(random)
    rate = np.ones((N, spec.rate_control_points))
    mixed = replace(
        draw_boundary(random, goal_ddq=False), goal_q=np.zeros((N, JOINTS + 1))
    )
    for points in (start_points, goal_points):
        with is_refused(UsageError):
            points(mixed, rate, spec)


@pytest.mark.parametrize("name", ["start_q", "goal_q"])
def test_missing_positions_are_refused_and_not_taken_as_zero(name: str) -> None:
    positions = {"start_q": np.zeros(6), "goal_q": np.zeros(6), name: None}
    with pytest.raises(UsageError) as caught:
        boundary_of(
            6, positions["start_q"], None, None, positions["goal_q"], None, None
        )
    assert caught.value.argument == name
