"""Splines and end conditions of motions in torch: any device, differentiable any number of times."""

import math
from functools import lru_cache
from typing import Any

import torch

from cnpgen.trajectory.spline import end_derivatives, taylor_coefficients
from cnpgen.trajectory.trajectory_spec import TrajectorySpec


def spline_derivatives(
    control: torch.Tensor, s: torch.Tensor, degree: int, orders: int = 3
) -> tuple[torch.Tensor, ...]:
    """Evaluate clamped uniform B-splines and their derivatives; differentiable in control points and phases.

    Args:
        control: Control points, shape (N, C, ...).
        s: Phases in [0, 1], shape (N, K) or (K,).
        degree: Degree D.
        orders: Number of results: the value, the first derivative with respect to s,
            and so on.

    Returns:
        Tensors of shape (N, K, ...).
    """
    points = control.shape[1]
    s = s.expand(len(control), s.shape[-1])
    spans = points - degree
    # The span itself is constant: derivatives by s are those of its polynomial.
    span = (s.detach() * spans).long().clamp(0, spans - 1)
    table = _taylor_table(points, degree, control.dtype, control.device)
    coefficients = torch.einsum("nkdc,nc...->dnk...", table[span], control)
    offset = (
        (s - span.to(s.dtype) / spans)
        .to(control.dtype)
        .reshape(*s.shape, *(1,) * (control.ndim - 2))
    )
    results = []
    for order in range(orders):
        value = torch.zeros_like(coefficients[0])
        # Horner's scheme: the derivative of c x^k has the factor k (k - 1) ... of
        # perm(k, order).
        for power in range(degree, order - 1, -1):
            value = value * offset + math.perm(power, order) * coefficients[power]
        results.append(value)
    return tuple(results)


def joint_states(
    path: torch.Tensor, rate: torch.Tensor, s: torch.Tensor, spec: TrajectorySpec
) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
    """Compute the states of N motions at phases.

    Args:
        path: Path control points [rad], shape (N, C, n).
        rate: Rate control points [1/s], shape (N, R).
        s: Phases in [0, 1], shape (N, K) or (K,).
        spec: Degree of the splines: ``problem.trajectory``.

    Returns:
        ``(q, dq, ddq)`` in rad, rad/s and rad/s^2, shape (N, K, n) each.
    """
    p, p1, p2 = spline_derivatives(path, s, spec.degree)
    r, r1 = (x[..., None] for x in spline_derivatives(rate, s, spec.degree, 2))
    # Chain rule: dq = p' r and ddq = p'' r^2 + p' r r', with r = ds/dt.
    return p, p1 * r, p2 * r**2 + p1 * r * r1


def start_points(
    q: torch.Tensor,
    dq: torch.Tensor,
    ddq: torch.Tensor,
    rate: torch.Tensor,
    spec: TrajectorySpec,
) -> torch.Tensor:
    """Compute the first three path control points from the state at the start (paper, Appendix A).

    The last three, in reverse, are those of a start at the goal with the velocity
    ``-goal_dq`` and ``rate.flip(1)``.

    Args:
        q: Positions [rad], shape (N, n).
        dq: Velocities [rad/s], shape (N, n).
        ddq: Accelerations [rad/s^2], shape (N, n).
        rate: Rate control points [1/s], shape (N, R), positive.
        spec: Degree and numbers of control points.

    Returns:
        Control points [rad], shape (N, 3, n).
    """
    path, speed = (
        end_derivatives(n, spec.degree)
        for n in (spec.path_control_points, spec.rate_control_points)
    )
    # r and r' at the start.
    first_rate = rate[:, :1]
    change = speed.eta * (rate[:, 1:2] - rate[:, :1])
    first = dq / first_rate
    # From ddq = p'' r^2 + p' r r', solved for p''.
    second = (ddq - first * change * first_rate) / first_rate**2
    c1 = q + first / path.eta
    return torch.stack([q, c1, second / path.beta - 2 * q + 3 * c1], dim=1)


@lru_cache(maxsize=16)
def _taylor_table(points: int, degree: int, dtype: Any, device: Any) -> torch.Tensor:
    """Return the Taylor coefficients of the basis functions in every span, shape (spans, D + 1, C)."""
    return torch.tensor(
        taylor_coefficients(points, degree).swapaxes(0, 1), dtype=dtype, device=device
    )
