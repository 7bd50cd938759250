"""Sampled motions that are evaluated in microseconds: quintic Hermite interpolation on a grid of one millisecond."""

from __future__ import annotations

from dataclasses import dataclass
from math import ceil
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from cnpgen.arrays import Array
from cnpgen.plans.join import JoinedPlans
from cnpgen.plans.plans import Plans

PlanOrSequence = Plans | JoinedPlans
"""One plan, or one sequence of plans, whose path a motion follows."""

MAX_GRID_STEP_S = 1e-3
GRID_STEPS_S = 1e-4, 4e-3  # that a caller may choose
_QUINTIC = (
    np.array(  # coefficients of 1, x, ..., x^5 from q, dq, ddq at 0 and q, dq, ddq at 1
        [
            [1.0, 0.0, 0.0, 0.0, 0.0, 0.0],
            [0.0, 1.0, 0.0, 0.0, 0.0, 0.0],
            [0.0, 0.0, 0.5, 0.0, 0.0, 0.0],
            [-10.0, -6.0, -1.5, 10.0, -4.0, 0.5],
            [15.0, 8.0, 1.5, -15.0, 7.0, -1.0],
            [-6.0, -3.0, -0.5, 6.0, -3.0, 0.5],
        ]
    )
)


class SetPoint(NamedTuple):
    """Positions [rad], velocities [rad/s] and accelerations [rad/s^2], shape (n,) or (K, n) each."""

    q: Array
    dq: Array
    ddq: Array


class ChunkSetPoint(NamedTuple):
    """Positions [rad], velocities [rad/s] and accelerations [rad/s^2], shape (n,), and the other columns, (D - n,)."""

    q: Array
    dq: Array
    ddq: Array
    others: Array


@dataclass(frozen=True, eq=False)
class SampledMotion:
    """A motion from a start time on, then rest at its end.

    The interpolation is twice continuously differentiable. Its error is below 1e-9 rad,
    1e-6 rad/s and 1e-3 rad/s^2 for motions within the limits of the shipped problems.

    Attributes:
        edges: Edges of the cells [s], ascending, shape (cells + 1,).
        coefficients: Polynomials of the cells, in units of the cell width, shape
            (cells, 6, n).
        end: Positions at the end [rad], shape (n,).
        plan: Plan or sequence whose path the motion follows; None for an arm at rest.
        plan_times: Time since the start of the plan at which it passes the state at
            each edge [s], shape (cells + 1,).
    """

    edges: Array
    coefficients: Array
    end: Array
    plan: PlanOrSequence | None
    plan_times: Array

    @property
    def start(self) -> float:
        """Time at which the motion starts [s]."""
        return float(self.edges[0])

    @property
    def end_time(self) -> float:
        """Time at which the motion ends [s]."""
        return float(self.edges[-1])

    def at(self, times: Array) -> SetPoint:
        """Evaluate the motion at times [s], shape (K,), not before its start."""
        cell = np.clip(
            np.searchsorted(self.edges, times, side="right") - 1,
            0,
            len(self.coefficients) - 1,
        )
        low = self.edges[cell]
        width = (self.edges[cell + 1] - low)[:, None]
        x = (times - low)[:, None] / width
        c = self.coefficients[cell].transpose(1, 0, 2)
        # Horner's scheme; derivatives by x are divided by powers of the width.
        q = ((((c[5] * x + c[4]) * x + c[3]) * x + c[2]) * x + c[1]) * x + c[0]
        dq = (
            (((5 * c[5] * x + 4 * c[4]) * x + 3 * c[3]) * x + 2 * c[2]) * x + c[1]
        ) / width
        ddq = (((20 * c[5] * x + 12 * c[4]) * x + 6 * c[3]) * x + 2 * c[2]) / width**2
        # After its end, the arm rests exactly, in spite of rounding of the polynomial.
        over = (times >= self.end_time)[:, None]
        return SetPoint(
            np.where(over, self.end, q),
            np.where(over, 0.0, dq),
            np.where(over, 0.0, ddq),
        )


def sample_motion(
    plan: PlanOrSequence, start: float, *, step: float = MAX_GRID_STEP_S
) -> SampledMotion:
    """Sample one plan, or one sequence of plans, that starts at a time [s], at most a step [s] apart."""
    edges = []
    coefficients = []
    last = np.zeros(0)
    for part, begin, end in parts_of(plan):
        if end <= begin:
            # The next part replaces it at once.
            continue
        times = grid(end - begin, step)
        states = part.motion.at_times(times[None])
        coefficients.append(
            _cells(times, SetPoint(states.q[0], states.dq[0], states.ddq[0]))
        )
        # The last edge of a part is the first of the next one.
        edges.append(begin + times[:-1])
        last = states.q[0, -1]
    plan_times = np.append(np.concatenate(edges), float(plan.duration[0]))
    return SampledMotion(
        start + plan_times, np.concatenate(coefficients), last, plan, plan_times
    )


def parts_of(plan: PlanOrSequence) -> list[tuple[Plans, float, float]]:
    """Return the parts of one plan or sequence, with their begins and ends since its start [s]."""
    if isinstance(plan, Plans):
        return [(plan, 0.0, float(plan.duration[0]))]
    begins = plan.begins[:, 0].tolist()
    ends = [*begins[1:], float(plan.duration[0])]
    return list(zip(plan.parts, begins, ends, strict=True))


def grid(duration: float, step: float = MAX_GRID_STEP_S) -> Array:
    """Return the edges of equal cells of at most a step [s] from 0 to a duration [s], shape (cells + 1,)."""
    return np.linspace(0.0, duration, ceil(duration / step) + 1)


def sample_states(
    times: Array, states: SetPoint, plan: PlanOrSequence, plan_times: Array
) -> SampledMotion:
    """Return the motion through states at times [s], shape (K,), which follows the path of a plan."""
    return SampledMotion(times, _cells(times, states), states.q[-1], plan, plan_times)


def joined_motions(first: SampledMotion, second: SampledMotion) -> SampledMotion:
    """Return a motion up to the start of a second one, which follows the path of the same plan, and then that one."""
    (kept,) = np.nonzero(first.edges < second.start)
    # The last cell of the first motion ends at the start of the second: its polynomial
    # is evaluated in its own unit of time, so it is sampled again.
    times = np.append(first.edges[kept], second.start)
    plan_times = np.interp(times, first.edges, first.plan_times)
    return SampledMotion(
        np.append(times[:-1], second.edges),
        np.concatenate([_cells(times, first.at(times)), second.coefficients]),
        second.end,
        second.plan,
        np.append(plan_times[:-1], second.plan_times),
    )


def _cells(times: Array, states: SetPoint) -> Array:
    """Return the quintic Hermite polynomials between states at times, shape (K - 1, 6, n)."""
    width = np.diff(times)[:, None]
    # With x = (t - t_k) / w, derivatives by x are w dq and w^2 ddq.
    ends = [
        np.stack([q, dq * width, ddq * width**2], axis=1)
        for q, dq, ddq in (
            (part[:-1] for part in states),
            (part[1:] for part in states),
        )
    ]
    return np.asarray(np.einsum("ij,cjn->cin", _QUINTIC, np.concatenate(ends, axis=1)))


def at_rest(q: ArrayLike, start: float) -> SampledMotion:
    """Return an arm at rest at joint positions [rad], shape (n,), from a time on [s]."""
    end = np.array(q, np.float64)
    # A constant polynomial in one cell; times after it are at rest.
    coefficients = np.zeros((1, 6, len(end)))
    coefficients[0, 0] = end
    edges = start + np.array([0.0, MAX_GRID_STEP_S])
    return SampledMotion(edges, coefficients, end, None, np.zeros(2))
