"""Joint limits that no curve through samples meets: lower bounds of derivatives outside the limits of a problem.

The limits are those of the problem's constraints. A limit is refuted if the mean of its
quantity (``lower_bounds``) exceeds it by more than the tolerance. The bound itself is
the number that is reported: no curve has less.
"""

from collections.abc import Iterator
from dataclasses import dataclass
from itertools import product

import numpy as np

from cnpgen.addons.trajectories.curve_family import ORDERS
from cnpgen.addons.trajectories.lower_bounds import (
    MeanDerivatives,
    first_derivatives,
    second_derivatives,
    second_derivatives_with_velocities,
    third_derivatives,
    value_intervals,
)
from cnpgen.addons.trajectories.sample_errors import SampleErrors
from cnpgen.addons.trajectories.sampled_trajectory import Trajectory
from cnpgen.arrays import Array
from cnpgen.judges.plans.joint_limits import ProvenJointLimits, quantity_of
from cnpgen.judges.plans.verdict import Margin

MIN_VIOLATION = 1.001  # in tolerances: rounding of the bounds proves nothing
POSITIONS = "positions"
VELOCITIES = "velocities"
BOTH = "positions and velocities"


@dataclass(frozen=True)
class RefutedLimit:
    """A joint limit that no curve through the samples meets.

    Attributes:
        margin: The bound as value of the limit, with joint and time.
        samples: Columns that prove it.
        condition: Condition under which it holds, such as that another limit is met;
            empty without one.
    """

    margin: Margin
    samples: str
    condition: str = ""

    @property
    def detail(self) -> str:
        """The bound with its place, for the output."""
        return bound_text(self.margin, self.condition)


def bound_text(margin: Margin, condition: str = "") -> str:
    """Format a lower bound: ``at least 360 rad/s^2 at 0.50 s, joint 1 (limit 12)``."""
    word = "at least" if margin.value >= margin.bound else "at most"
    value = f"{word} {margin.value:.4g} {margin.unit} at {margin.time:.2f} s"
    text = f"{value}, {margin.part} (limit {margin.bound:.4g})"
    return f"{text}, unless {condition}" if condition else text


def refuted_limits(
    limits: ProvenJointLimits, trajectory: Trajectory, errors: SampleErrors
) -> list[RefutedLimit]:
    """Return the joint limits that no curve through samples within their errors meets, worst first."""
    found: dict[int, tuple[float, RefutedLimit]] = {}
    largest = largest_values(limits)
    # Bounds of quantities without a limit need not be computed.
    bounded = [quantity_of(constraint) for constraint in limits.constraints]
    for order, samples, condition, all_bounds in _bounds(trajectory, errors, largest):
        name = ORDERS[order]
        # Bounds are computed one distance after the other, and only those of a limit.
        for bounds, limit in product(
            all_bounds if name in bounded else (),
            [limit for limit, own in enumerate(bounded) if own == name],
        ):
            excess, margin = _worst(limits, limit, bounds, trajectory.duration)
            if excess > found.get(limit, (MIN_VIOLATION,))[0]:
                found[limit] = excess, RefutedLimit(margin, samples, condition)
    ordered = sorted(found.values(), key=lambda item: -item[0])
    return [refuted for _, refuted in ordered]


def largest_values(limits: ProvenJointLimits) -> dict[str, Array]:
    """Return the largest absolute values within the limits and tolerances, by quantity, shape (n,) each; inf without."""
    # The larger side counts: the values bound how far a motion within limits can move.
    return absolute_limits(limits, np.maximum, 1.0)


def absolute_limits(
    limits: ProvenJointLimits, of_both: np.ufunc, tolerance_share: float
) -> dict[str, Array]:
    """Return one limit of absolute values for both signs, with a share of its tolerance, by quantity, shape (n,) each.

    ``of_both`` chooses between the limits of both signs. Quantities without a limit
    have inf.
    """
    n = len(limits.joints)
    smallest = {order: np.full(n, np.inf) for order in ORDERS}
    for constraint, bounds, tolerance in zip(
        limits.constraints, limits.bounds, limits.tolerance, strict=True
    ):
        name = quantity_of(constraint)
        allowed = of_both(-bounds[:n], bounds[n:]) + tolerance_share * tolerance
        smallest[name] = np.minimum(smallest[name], allowed)
    return smallest


def _worst(
    limits: ProvenJointLimits, limit: int, bounds: MeanDerivatives, duration: float
) -> tuple[float, Margin]:
    """Return the largest relative violation of a limit by bounds, and its margin."""
    # A supremum above ``low`` violates upper limits, an infimum below ``high`` lower ones.
    values = np.concatenate([bounds.high, bounds.low], axis=1)
    with np.errstate(invalid="ignore", over="ignore"):
        relative = (values - limits.bounds[limit]) / limits.scale[limit]
    # Joints without a limit and bounds that say nothing give inf or nan.
    relative = np.where(np.isfinite(relative), relative, -np.inf)
    k, row = np.unravel_index(int(relative.argmax()), relative.shape)
    time = float(bounds.t[k])
    maximum = float(relative[k, row]), int(row), time / duration
    return maximum[0], limits.margin_at(limit, maximum, time)


def _bounds(
    trajectory: Trajectory, errors: SampleErrors, largest: dict[str, Array]
) -> Iterator[tuple[int, str, str, Iterator[MeanDerivatives]]]:
    """Yield all bounds: order of the derivative, columns, condition, and the bounds of all distances."""
    t = trajectory.t
    q = trajectory.q
    dq = trajectory.dq
    ddq = trajectory.ddq
    # Under a limit V, a time within d moves a position by at most V d.
    moved = [
        float((largest[name] * errors.t).max()) if errors.t else 0.0
        for name in ("dq", "ddq")
    ]
    conditions = [
        f"a {name} limit is exceeded" if errors.t else ""
        for name in ("velocity", "velocity or acceleration")
    ]
    # A position is reached at some time, whatever the jitter.
    yield (0, POSITIONS, "", value_intervals(t, q, errors.q))
    if np.isfinite(moved[0]):
        jerks = third_derivatives(t, q, errors.q + moved[0])
        yield (3, POSITIONS, conditions[0], jerks)
    yield (1, POSITIONS, "", first_derivatives(t, q, errors.q, errors.t))
    yield (2, POSITIONS, "", second_derivatives(t, q, errors.q, errors.t))
    if dq is None:
        return
    yield (1, VELOCITIES, "", value_intervals(t, dq, errors.dq))
    yield (2, VELOCITIES, "", first_derivatives(t, dq, errors.dq, errors.t))
    yield (3, VELOCITIES, "", second_derivatives(t, dq, errors.dq, errors.t))
    if np.isfinite(moved).all():
        of_both = errors.q + moved[0], errors.dq + moved[1]
        both = second_derivatives_with_velocities(t, q, dq, of_both)
        yield (2, BOTH, conditions[1], both)
    if ddq is not None:
        yield (2, "accelerations", "", value_intervals(t, ddq, errors.ddq))
        rates = first_derivatives(t, ddq, errors.ddq, errors.t)
        yield (3, "accelerations", "", rates)
