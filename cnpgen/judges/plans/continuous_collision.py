"""Continuous collision checking by interval subdivision and motion bounds (Schwarzer, Saha and Latombe 2005).

Where edges pass each other, the penetration depth has a maximum that may fall between
two samples. Between samples a body stays within the convex hull of its two poses,
except for the deviation of its points from their chords. Intervals in which this does
not prove a sufficient distance are subdivided until none is unresolved.

A function whose second derivative is at most C deviates by at most C h^2 / 8 from the
chord between two values at a distance of h. The path p(s) is a polynomial between
knots, so its derivatives lie between their smallest and their largest Bernstein
coefficients. The second derivative of a point by s is the sum over joints of its
partial derivatives times p'', and over pairs of joints of its second partial
derivatives times p' p'. For a revolute joint, and for a pair whose distal joint it is,
these are at most as long as the chain from the joint to the point.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np

from cnpgen.arrays import Array, Mask
from cnpgen.judges.plans.evaluated_trajectory import Curve
from cnpgen.judges.plans.measure import EvaluationContext, MeasuredCondition
from cnpgen.judges.plans.verdict import Margin
from cnpgen.problems.constraints.clearance import DistanceConstraint
from cnpgen.problems.constraints.constraint import Constraint
from cnpgen.world.pair_distances import PairDistances
from cnpgen.world.path import PathWorld

INTERVAL_PARTS = 8  # per subdivision
MAX_INTERVALS = 256  # that are subdivided at a time
MAX_LEVELS = 8  # of subdivision: 1 ms becomes 0.06 ns
# Of subdivision around the smallest margin, even if it cannot change the verdict.
MINIMUM_LEVELS = 2


def is_contact(constraint: Constraint) -> bool:
    """Return whether a constraint is about distances of bodies, which have kinks where the closest features change."""
    return isinstance(constraint, DistanceConstraint)


@dataclass(frozen=True)
class Intervals:
    """I intervals between samples."""

    s: Array  # phases of both ends, shape (I, 2)
    # Smallest distance minus the smallest valid one, at both ends [m], shape (I, 2).
    margin: Array
    # Proven lower bound of the margin over the interval [m], shape (I,).
    lower_bound: Array

    def around_minimum(self) -> Mask:
        """Return a mask of the intervals on both sides of the smallest margin, shape (I,)."""
        return np.asarray((self.margin <= self.margin.min()).any(axis=1))

    def unresolved(self) -> Mask:
        """Return a mask of intervals that may contain a violation, none if there is one at a sample, shape (I,)."""
        chosen = np.zeros(len(self.s), bool)
        # A violation at a sample decides the verdict; only the smallest lower bounds
        # need work.
        if self.margin.min() >= 0:
            chosen[np.argsort(self.lower_bound, kind="stable")[:MAX_INTERVALS]] = True
        return np.asarray(chosen & (self.lower_bound < 0))


def check_continuous_collision(
    context: EvaluationContext, *, early_exit: bool
) -> Iterator[tuple[MeasuredCondition, Margin]]:
    """Yield contact conditions and their margins between samples: around the smallest, and in unresolved intervals.

    The world of the context is at its samples, and is moved. With early exit, intervals
    are subdivided only if it can change the verdict or the size of a violation.
    """
    contacts = [
        condition for condition in context.measured if is_contact(condition.constraint)
    ]
    if not contacts:
        return
    motion_bounds = context.world.motion_bounds(context.curve.max_positions())
    # Before the world is moved.
    initial = _intervals(context, context.samples.s[None], contacts, motion_bounds)
    for contact, intervals in zip(contacts, initial, strict=True):
        for s, measured in _subdivisions(
            context, intervals, contact.constraint, motion_bounds, early_exit=early_exit
        ):
            yield contact, context.margin(measured, s)


def _subdivisions(
    context: EvaluationContext,
    intervals: Intervals,
    constraint: Constraint,
    motion_bounds: Array,
    *,
    early_exit: bool,
) -> Iterator[tuple[Array, MeasuredCondition]]:
    """Yield phases in subdivided intervals, and the contact condition there."""
    for level in range(MAX_LEVELS):
        # Intervals that may hide a violation, the most doubtful first, and those around
        # the smallest margin, so that the printed value is that of the motion.
        chosen = intervals.unresolved()
        if level < MINIMUM_LEVELS and not (early_exit and intervals.margin.min() >= 0):
            chosen |= intervals.around_minimum()
        if not chosen.any():
            return
        low, high = intervals.s[chosen].T
        grid = np.linspace(low, high, INTERVAL_PARTS + 1, axis=1)
        context.move(grid.ravel())
        (measured,) = context.measure(constraint, grid.ravel())
        yield grid.ravel(), measured
        (intervals,) = _intervals(context, grid, [measured], motion_bounds)


def _intervals(
    context: EvaluationContext,
    s: Array,
    contacts: Sequence[MeasuredCondition],
    motion_bounds: Array,
) -> list[Intervals]:
    """Return the intervals of each contact between neighbors in rows of phases, shape (rows, K), where the world is."""
    world = context.world
    last = s.shape[1] - 1
    # |x(q2) - x(q1)| <= sum over joints of (reach of the joint) |q2_j - q1_j|
    displacements = motion_bounds @ np.abs(world.q[:, 1:] - world.q[:, :-1])
    # Between rows there is no interval.
    displacements[last :: last + 1] = -np.inf
    # The chord deviation h^2 / 8 max |x''| bounds how far a point leaves the segment
    # between its positions at both ends of an interval.
    deviations = chord_deviation_bounds(context.curve, s.ravel(), motion_bounds)
    results = []
    for contact in contacts:
        # One, or of each.
        min_distances = (
            contact.condition.lower - contact.tolerance + np.ravel(contact.uncertainty)
        )
        margin = (contact.g - min_distances[:, None]).min(axis=0).reshape(s.shape)
        proven = np.full(s.size, np.nan)
        # With a violation at a sample the verdict is decided, and no bound is needed.
        if margin.min() >= 0:
            pairs = pairs_of(world, contact.constraint)
            proven[:-1] = pairs.interval_bounds(
                min_distances, displacements, deviations
            )
        phases, margins = (
            np.stack([values[:, :-1], values[:, 1:]], axis=-1).reshape(-1, 2)
            for values in (s, margin)
        )
        results.append(
            Intervals(phases, margins, proven.reshape(s.shape)[:, :-1].ravel())
        )
    return results


def pairs_of(world: PathWorld, constraint: Constraint) -> PairDistances:
    """Return the distances of a contact constraint, one pair for each of its values."""
    assert isinstance(constraint, DistanceConstraint)
    return world.pairs(constraint.bodies)


def chord_deviation_bounds(curve: Curve, s: Array, motion_bounds: Array) -> Array:
    """Bound the deviation of the robot's points from the chords between neighboring phases [m], shape (K - 1,).

    Phases ascend at distances of at most a part of a span; the bound is 0 where a phase
    is below its predecessor. Motion bounds of the joints [m] have shape (n,).
    """
    edges, first, second = curve.derivative_bounds()
    # With P_j = sum over i < j of |p'_i| and joints ordered from the base,
    #   |x''| <= sum_j reach_j (|p''_j| + |p'_j|^2 + 2 |p'_j| P_j),
    # since each pair of joints occurs twice and the distal one's reach bounds it.
    proximal = np.cumsum(first, axis=1) - first
    curvature = (second + first * (first + 2 * proximal)) @ motion_bounds
    # The spans of both neighbors: an interval is at most a part of a span, so it meets
    # no third one.
    low = np.searchsorted(edges[1:-1], s[:-1], "right")
    high = np.searchsorted(edges[1:-1], s[1:], "left")
    step = np.maximum(s[1:] - s[:-1], 0.0)
    return np.asarray(step**2 / 8 * np.maximum(curvature[low], curvature[high]))
