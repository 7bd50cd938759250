"""Sampled motions that are evaluated in microseconds: quintic Hermite interpolation on a grid of one millisecond."""

from __future__ import annotations

from dataclasses import dataclass
from math import ceil
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from cnpgen.plans.join import JoinedPlans
from cnpgen.plans.plans import Plans

Array = NDArray[np.float64]

MAX_GRID_STEP_S = 1e-3
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
    """

    edges: Array
    coefficients: Array
    end: Array

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
        q = ((((c[5] * x + c[4]) * x + c[3]) * x + c[2]) * x + c[1]) * x + c[0]
        dq = (
            (((5 * c[5] * x + 4 * c[4]) * x + 3 * c[3]) * x + 2 * c[2]) * x + c[1]
        ) / width
        ddq = (((20 * c[5] * x + 12 * c[4]) * x + 6 * c[3]) * x + 2 * c[2]) / width**2
        over = (times >= self.end_time)[:, None]
        return SetPoint(
            np.where(over, self.end, q),
            np.where(over, 0.0, dq),
            np.where(over, 0.0, ddq),
        )


def sample_motion(plan: Plans | JoinedPlans, start: float) -> SampledMotion:
    """Sample one plan, or one sequence of plans, that starts at a time [s]."""
    parts = plan.parts if isinstance(plan, JoinedPlans) else (plan,)
    begins = plan.begins[:, 0].tolist() if isinstance(plan, JoinedPlans) else [0.0]
    ends = [*begins[1:], float(plan.duration[0])]
    edges, coefficients, last = [], [], np.zeros(0)
    for part, begin, end in zip(parts, begins, ends, strict=True):
        if end <= begin:
            continue  # the next part replaces it at once
        cells = ceil((end - begin) / MAX_GRID_STEP_S)
        times, width = np.linspace(0.0, end - begin, cells + 1), (end - begin) / cells
        states = part.motion.at_times(times[None])
        nodes = np.stack(
            [states.q[0], states.dq[0] * width, states.ddq[0] * width**2], axis=1
        )
        coefficients.append(
            np.einsum(
                "ij,cjn->cin", _QUINTIC, np.concatenate([nodes[:-1], nodes[1:]], axis=1)
            )
        )
        edges.append(start + begin + times[:-1])
        last = states.q[0, -1]
    return SampledMotion(
        np.append(np.concatenate(edges), start + ends[-1]),
        np.concatenate(coefficients),
        last,
    )


def at_rest(q: ArrayLike, start: float) -> SampledMotion:
    """Return an arm at rest at joint positions [rad], shape (n,), from a time on [s]."""
    end = np.array(q, np.float64)
    coefficients = np.zeros((1, 6, len(end)))
    coefficients[0, 0] = end
    return SampledMotion(start + np.array([0.0, MAX_GRID_STEP_S]), coefficients, end)
