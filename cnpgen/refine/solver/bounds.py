"""Bounds of the residuals on a grid, tightened against overshoot between grid points.

Between two grid points a residual may exceed what it has at both. Bounds are therefore
tightened in advance, by a share of their half width for limits or a length for
clearances, fading in from both ends over the phase ``edge``:

    u(s) = c + h (1 - fraction min(s, 1 - s, edge) / edge),    c, h: center, half width.

After convergence midpoints are interpolated by cubic polynomials through four grid
points, and bounds whose residuals still overshoot there are tightened by the overshoot.
"""

from dataclasses import dataclass
from itertools import accumulate

import numpy as np

from cnpgen.arrays import Array, Mask
from cnpgen.problems.conditions import condition_orders
from cnpgen.problems.constraints.clearance import RobotClearance
from cnpgen.problems.constraints.constraint import Condition, Constraint
from cnpgen.problems.constraints.joint import JointPosition
from cnpgen.problems.constraints.link_clearance import ObjectClearance, SelfClearance
from cnpgen.problems.problem import Problem
from cnpgen.refine.solver.residuals import DISTANCE_SCALE_M, residual_scale
from cnpgen.world.world import World

# From either end, whose accelerations depend on the last rate control points.
END_POINTS = 0, 1, 2, 4, 7, 11
# Phases between which the relaxation of violated end bounds fades out.
END_RELAXATION = 0.1, 0.3
MIN_END_RELAXATION = 1e-5  # of scaled residuals: iterations end with larger violations
# In scaled units, of conditions that only the verdict can check.
UNKNOWN_TOLERANCE = 1e9
# Time-varying bounds close earlier by this factor: motions overshoot where they level
# out.
PHASE_FACTOR = 1.03
# Of the tolerance of an equality: the largest error of a precise plan.
PRECISE_FRACTION = 0.1
# Of the distance from a path, on the grid: motions overshoot between its points.
NEAR_FRACTION = 0.97
PROJECTED_FRACTION = 0.1  # of the smallest tolerance: the error of projected states
# Of the tolerance between grid points: the interpolation has an error.
INTERVAL_FRACTION = 0.9


_TEMPLATES: dict[tuple[str, bytes, "Tightening"], "BoundsTemplate"] = {}
MAX_TEMPLATES = 64


@dataclass(frozen=True)
class Tightening:
    """Tightening of the problem's bounds against overshoot between grid points."""

    limit: float  # fraction of acceleration, torque and jerk limits
    # Fraction of position and velocity limits, on which boundary states lie.
    gentle: float
    clearance: float  # distance added to clearances [m]
    band: float  # half width of equalities, as a fraction of their tolerance
    # Phase over which the tightening fades in from either end, since boundary states
    # may lie on a limit.
    edge: float


NO_TIGHTENING = Tightening(limit=0.0, gentle=0.0, clearance=0.0, band=0.0, edge=1.0)


@dataclass(frozen=True)
class Bounds:
    """Bounds of the residuals on the grid, in scaled units."""

    lower: Array  # lower bounds, shape (K, m), -inf where there are none
    upper: Array  # upper bounds, shape (K, m)
    # Mask of residuals that change abruptly with the last rate control points, shape
    # (K, m): those of accelerations and jerks at the ends.
    nonsmooth: Mask
    # Accepted violation between grid points, shape (K, m): that of the verdict, or of a
    # precise plan for equalities; inf where it is unknown.
    interval_tolerance: Array

    @property
    def accelerated(self) -> Mask:
        """Mask of residuals that depend on accelerations or jerks, shape (m,)."""
        return np.asarray(self.nonsmooth.any(axis=0))

    def violations(self, g: Array) -> Array:
        """Return the violations by residuals g, shape (K, m).

        Negative inside the bounds.
        """
        return np.maximum(g - self.upper, self.lower - g)

    def end_violations(self, ends: Array) -> Array:
        """Return the violations by residuals ``ends`` of the boundary states, shape (2, m); nan where they are nan."""
        return np.maximum(ends - self.upper[[0, -2]], self.lower[[0, -2]] - ends)

    def max_violation(self, g: Array) -> float:
        """Return the largest violation by residuals g, shape (K, m).

        Inf where g is not finite.
        """
        worst = float(self.violations(g).max())
        return max(worst, 0.0) if np.isfinite(worst) else np.inf

    def tightened(self, g: Array, midpoint_weights: Array) -> "Bounds | None":
        """Return bounds tightened where residuals g (K, m) violate them between grid points, or None if none do.

        Midpoints are interpolated with ``Grid.midpoint_weights``.
        """
        # value at the midpoint of points k + 1 and k + 2 from those at k, ..., k + 3
        centers = sum(
            weights[:, None] * g[k : k + len(midpoint_weights)]
            for k, weights in enumerate(midpoint_weights.T)
        )
        # Of the intervals between the second and the last but one.
        left = slice(1, -2)
        right = slice(2, -1)
        tolerance = INTERVAL_FRACTION * np.minimum(
            self.interval_tolerance[left], self.interval_tolerance[right]
        )
        above = centers - np.maximum(self.upper[left], self.upper[right]) - tolerance
        below = np.minimum(self.lower[left], self.lower[right]) - centers - tolerance
        if not (above.max() > 0 or below.max() > 0):
            return None
        lower = self.lower.copy("F")
        upper = self.upper.copy("F")
        # Both neighbors of a midpoint move inwards by the overshoot there.
        for side in (left, right):
            upper[side] -= np.maximum(above, 0.0)
            lower[side] += np.maximum(below, 0.0)
        return Bounds(lower, upper, self.nonsmooth, self.interval_tolerance)


def bounds_template(
    problem: Problem, world: World, s: Array, tightening: Tightening
) -> "BoundsTemplate":
    """Return the bounds of the motions of a problem on one grid.

    Equal problems share them (``BoundsTemplate``).
    """
    key = problem.identity, s.tobytes(), tightening
    template = _TEMPLATES.get(key)
    if template is None:
        if len(_TEMPLATES) >= MAX_TEMPLATES:
            _TEMPLATES.clear()
        template = _TEMPLATES[key] = BoundsTemplate(problem, world, s, tightening)
    return template


class BoundsTemplate:
    """Bounds of the motions of a problem on one grid with phases s, shape (K,); the state of its world is changed.

    Per residual, shape (m,), it has tolerances of the verdict in scaled units
    (``UNKNOWN_TOLERANCE`` for conservative conditions), the highest derivative of q,
    and masks of equalities, capsules and clearances of the held object.
    """

    def __init__(
        self, problem: Problem, world: World, s: Array, tightening: Tightening
    ) -> None:
        orders = condition_orders(problem, world, "solved", jerk=problem.uses_jerk)
        pairs = [
            (constraint, condition)
            for constraint in problem.constraint
            for condition in constraint.solved(world)
        ]
        tables, untightened = (
            np.concatenate(
                [
                    _bounds(*pair, s, amount, order)
                    for pair, order in zip(pairs, orders, strict=True)
                ],
                axis=-1,
            )
            for amount in (tightening, NO_TIGHTENING)
        )
        self._tightening = tightening
        self._s, self._bound_phases = s, s * (PHASE_FACTOR if tightening.band else 1.0)
        # The layout of residuals.
        self._lower, self._upper = map(np.asfortranarray, tables)
        self._set_rows(pairs, orders)
        with np.errstate(invalid="ignore"):
            # Equalities are solved to a fraction of the tolerance; the bounds of the
            # others were moved inwards, by which a violation within the interval may be
            # larger.
            interval_tolerance = np.where(
                self.equal, PRECISE_FRACTION, 1.0
            ) * self.tolerances + np.fmax(
                untightened[1] - self._upper, self._lower - untightened[0]
            )
        self._interval_tolerance = np.asfortranarray(
            np.where(np.isnan(interval_tolerance), np.inf, interval_tolerance)
        )
        self._nonsmooth = np.zeros(self._lower.shape, bool, order="F")
        self._nonsmooth[[*END_POINTS, *(-1 - point for point in END_POINTS)]] = (
            self.orders >= 2
        )

    def _set_rows(
        self, pairs: list[tuple[Constraint, Condition]], orders: list[int]
    ) -> None:
        """Set what is known of each residual, from the constraints with their conditions."""
        self.conditions = [condition for _, condition in pairs]
        self.tolerances = np.concatenate([_tolerances(*pair) for pair in pairs])
        widths = [len(condition.g) for condition in self.conditions]
        # Bounds that depend on the motion are computed for each of them.
        self._time_varying = [
            (*pair, slice(behind - width, behind))
            for pair, width, behind in zip(
                pairs, widths, accumulate(widths), strict=True
            )
            if type(pair[0]).bound_relaxation is not Constraint.bound_relaxation
        ]
        self.orders = np.repeat(orders, widths)
        self.capsules = np.repeat(
            [isinstance(item, RobotClearance | SelfClearance) for item, _ in pairs],
            widths,
        )
        self.held_clearances = np.repeat(
            [isinstance(item, ObjectClearance) for item, _ in pairs], widths
        )
        scales = [
            _scale(*pair) if isinstance(pair[0], JointPosition) else np.nan
            for pair in pairs
        ]
        self._position_scale = np.concatenate(
            [
                np.broadcast_to(scale, width)
                for scale, width in zip(scales, widths, strict=True)
            ]
        )
        self.projection_accuracy = _projection_accuracy(pairs)
        self.equal = np.repeat(
            [condition.is_equality for condition in self.conditions], widths
        )

    def bounds_for(self, start_tip: Array, *, ends: Array | None = None) -> Bounds:
        """Return the bounds of one motion with the tip at ``start_tip`` [m], shape (3,), at the start.

        Residuals of the boundary states ``ends`` have shape (2, m), nan where they are
        free. Bounds near an end that violates them within the tolerance are relaxed by
        the violation: no motion meets narrower ones.
        """
        lower = self._lower
        upper = self._upper
        for constraint, condition, columns in self._time_varying:
            relaxation = constraint.bound_relaxation(
                condition, self._bound_phases, start_tip
            )
            if np.any(relaxation > 0):
                scale = _scale(constraint, condition)
                lower = lower.copy("F")
                upper = upper.copy("F")
                lower[:, columns] -= relaxation[:, None] / scale
                upper[:, columns] += relaxation[:, None] / scale
        bounds = Bounds(lower, upper, self._nonsmooth, self._interval_tolerance)
        return bounds if ends is None else self._relaxed_at_ends(bounds, ends)

    def near(self, bounds: Bounds, positions: Array, distance: float) -> Bounds:
        """Return bounds that also keep every joint within a distance [rad] of a path on the grid, shape (K, n)."""
        columns = np.isfinite(self._position_scale)
        if columns.sum() != positions.shape[1]:
            return bounds
        scale = self._position_scale[columns]
        band = NEAR_FRACTION * distance
        inner = self._s < 1
        # |q - q_path| <= distance, in scaled units: the tighter of both bounds holds
        rows = np.ix_(inner, columns)
        lower = bounds.lower.copy("F")
        upper = bounds.upper.copy("F")
        lower[rows] = np.maximum(lower[rows], (positions[inner] - band) / scale)
        upper[rows] = np.minimum(upper[rows], (positions[inner] + band) / scale)
        return Bounds(lower, upper, bounds.nonsmooth, bounds.interval_tolerance)

    def with_hull_distances(
        self, bounds: Bounds, min_distances: Array, extra: Array | float = 0.0
    ) -> Bounds:
        """Return bounds without those of capsules and with further columns for the distances of hulls.

        Required distances [m] have shape (columns,), additional ones shape (K,
        columns).
        """
        # d >= required + tightening + what collisions between grid points have added; the
        # last grid point is the goal itself, which no variable moves
        added = _added_clearance(self._s, self._tightening)[:, None]
        lower = (min_distances + added + extra) / DISTANCE_SCALE_M
        lower[self._s == 1] = -np.inf
        free = np.where(self.capsules, np.inf, 0.0)
        return Bounds(
            np.asfortranarray(np.hstack([bounds.lower - free, lower])),
            np.asfortranarray(
                np.hstack([bounds.upper + free, np.full_like(lower, np.inf)])
            ),
            np.asfortranarray(
                np.hstack([bounds.nonsmooth, np.zeros(lower.shape, bool)])
            ),
            np.asfortranarray(
                np.hstack([bounds.interval_tolerance, np.full_like(lower, np.inf)])
            ),
        )

    def _relaxed_at_ends(self, bounds: Bounds, ends: Array) -> Bounds:
        lower = bounds.lower
        upper = bounds.upper
        if (
            not np.fmax.reduce(bounds.end_violations(ends), axis=None)
            > MIN_END_RELAXATION
        ):
            return bounds
        fades = near_ends(self._s)
        # Most of the last row is unbounded.
        for g, row, fade in (
            (ends[0], 0, fades[0]),
            (ends[1], -2, fades[1]),
        ):
            above = np.fmax(g - upper[row], 0.0)
            below = np.fmax(lower[row] - g, 0.0)
            if np.any(above > 0):
                upper = np.asfortranarray(
                    upper + np.minimum(above, self.tolerances) * fade
                )
            if np.any(below > 0):
                lower = np.asfortranarray(
                    lower - np.minimum(below, self.tolerances) * fade
                )
        with np.errstate(invalid="ignore"):
            relaxation = np.nan_to_num(
                np.fmax(upper - bounds.upper, bounds.lower - lower)
            )
        interval_tolerance = bounds.interval_tolerance - np.where(
            self.equal, 0.0, relaxation
        )
        return Bounds(lower, upper, bounds.nonsmooth, interval_tolerance)


def near_ends(s: Array) -> Array:
    """Return the share of the violation of the start and of the goal that bounds accept at phases, shape (2, K, 1)."""
    until = END_RELAXATION[1]
    from_full = END_RELAXATION[1] - END_RELAXATION[0]
    return np.clip((until - np.stack([s, 1 - s])) / from_full, 0.0, 1.0)[..., None]


def accepted_along(shares: Array, accepted: Array) -> Array:
    """Return the violations that are accepted at K phases, shape (K, m), from ``near_ends`` and those of both ends."""
    return np.asarray((shares * accepted[:, None]).max(axis=0))


def _scale(constraint: Constraint, condition: Condition) -> Array:
    return residual_scale(
        condition.lower, condition.upper, constraint.tolerance, condition.tolerance_kind
    )


def _tolerances(constraint: Constraint, condition: Condition) -> Array:
    if condition.sufficient:
        return np.full(len(condition.g), UNKNOWN_TOLERANCE)
    return constraint.allowed(condition) / _scale(constraint, condition)


def _projection_accuracy(pairs: list[tuple[Constraint, Condition]]) -> float:
    """Return the largest error of projected states in equalities, in their units."""
    allowed = [
        constraint.allowed(condition).min(initial=np.inf)
        for constraint, condition in pairs
        if condition.is_equality
    ]
    return PROJECTED_FRACTION * float(min(allowed, default=np.inf))


def _bounds(
    constraint: Constraint,
    condition: Condition,
    s: Array,
    tightening: Tightening,
    order: int,
) -> Array:
    """Return scaled bounds, shape (2, K, m), of one condition that depends on derivatives up to ``order``."""
    scale = _scale(constraint, condition)
    lower = np.repeat((condition.lower / scale)[None], len(s), axis=0)
    upper = np.repeat((condition.upper / scale)[None], len(s), axis=0)
    if condition.tolerance_kind == "limit":
        # Boundary states may lie on limits of positions and velocities: these shrink by
        # the smaller share ``gentle``.
        fraction = tightening.limit if order >= 2 else tightening.gentle
        shrink = (
            1
            - fraction * np.clip(np.minimum(s, 1 - s) / tightening.edge, 0, 1)[:, None]
        )
        center = (lower + upper) / 2
        half = (upper - lower) / 2
        lower = center - shrink * half
        upper = center + shrink * half
    elif condition.is_equality:
        # An equality gets a band within its tolerance, so that the program has an interior.
        band = tightening.band * constraint.tolerance / scale
        lower = lower - band
        upper = upper + band
    elif not constraint.has_solver_margin:
        inside = _added_clearance(s, tightening)[:, None] / scale
        lower = lower + inside
        upper = upper - inside
    if order < 2:
        # Fixed by the boundary conditions.
        lower[s == 1] = -np.inf
        upper[s == 1] = np.inf
    return np.stack([lower, upper])


def _added_clearance(s: Array, tightening: Tightening) -> Array:
    """Return the tightening of clearances along the motion [m], shape (K,)."""
    return np.asarray(
        tightening.clearance * np.clip(np.minimum(s, 1 - s) / tightening.edge, 0, 1)
    )
