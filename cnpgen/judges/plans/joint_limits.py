"""Joint limits over a whole motion, including all times between samples: proven, because the motion is a polynomial."""

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import cast

import numpy as np

from cnpgen.arrays import Array, Indices
from cnpgen.judges.plans.bernstein import Maximum, PiecewisePolynomials, find_maximum
from cnpgen.judges.plans.sampling import times
from cnpgen.judges.plans.verdict import Margin
from cnpgen.problems.constraints.constraint import Conditions, Constraint
from cnpgen.problems.constraints.joint import (
    JointAcceleration,
    JointJerk,
    JointPosition,
    JointVelocity,
)
from cnpgen.problems.problem import Problem
from cnpgen.store.joint_units import unit_of
from cnpgen.world.path import PathWorld
from cnpgen.world.world import World

MIN_RELATIVE_SCALE = 1e-9  # of a bound: resolution of violations if the tolerance is 0
EARLY_EXIT_PARTS = 8  # of a span per subdivision with early exit
_QUANTITIES = {
    JointPosition: "q",
    JointVelocity: "dq",
    JointAcceleration: "ddq",
    JointJerk: "jerk",
}


def is_proven(constraint: Constraint) -> bool:
    """Return whether a constraint is a joint limit that can be proven for the whole motion."""
    return type(constraint) in _QUANTITIES


def quantity_of(constraint: Constraint) -> str:
    """Return the quantity that a proven constraint limits: "q", "dq", "ddq" or "jerk"."""
    return _QUANTITIES[type(constraint)]


def _factor_of(constraint: Constraint, parameters: Mapping[str, float]) -> float:
    """Return the factor by which a sample scales the limit of a proven constraint."""
    return parameters.get(getattr(constraint, "factor_name", ""), 1.0)


def _per_factor(values: Array, factor: float) -> Array:
    return values if factor == 1 else values / factor


@dataclass(frozen=True)
class ProvenJointLimits:
    """L limits of n joints that are proven to hold or to be violated."""

    constraints: tuple[Constraint, ...]  # constraints of a problem that are proven
    # Condition of each constraint, the same at all states.
    conditions: Conditions
    joints: tuple[str, ...]  # names of the joints
    tolerance: Array  # accepted violations, shape (L, n)
    bounds: Array  # lower bounds of all joints, then upper ones, shape (L, 2 n)
    # Units of relative violations: tolerances, or small values, negative for lower
    # bounds, shape (L, 2 n).
    scale: Array

    def scaled(self, parameters: Mapping[str, float]) -> "ProvenJointLimits":
        """Return the limits of a sample with these parameters, by name."""
        # Bounds, tolerances and units scale alike, so relative violations stay
        # comparable.
        factors = np.array(
            [_factor_of(constraint, parameters) for constraint in self.constraints]
        )[:, None]
        if (factors == 1).all():
            return self
        tolerance, bounds, scale = (
            factors * values for values in (self.tolerance, self.bounds, self.scale)
        )
        return replace(self, tolerance=tolerance, bounds=bounds, scale=scale)

    def margins(
        self,
        world: PathWorld,
        polynomials: PiecewisePolynomials,
        s: Array,
        table: Array,
        *,
        early_exit: bool,
    ) -> list[Margin]:
        """Find where a motion, as polynomials, comes closest to violating each limit, or violates it most.

        The world is at its samples, phases of shape (K,); the table is that of
        ``time_table``. With early exit, the margin at the samples is enough if a limit
        is proven to hold.
        """
        if not self.constraints:
            return []
        # The polynomials are divided by the factor instead of multiplying the bounds, so
        # that one set of bounds serves all samples.
        scaled = [
            (quantity_of(each), _factor_of(each, world.parameters.values))
            for each in self.constraints
        ]
        functions = [
            _per_factor(getattr(polynomials, name), factor) for name, factor in scaled
        ]
        values = [_per_factor(getattr(world, name), factor) for name, factor in scaled]
        maxima = self._at_samples(np.array(values), s)
        self._search(functions, polynomials.edges, maxima, early_exit=early_exit)
        t = times(np.array([phase for *_, phase in maxima]), table).tolist()
        return [
            self.margin_at(limit, maximum, t[limit])
            for limit, maximum in enumerate(maxima)
        ]

    def _search(
        self,
        functions: list[Array],
        edges: Array,
        maxima: list[Maximum],
        *,
        early_exit: bool,
    ) -> None:
        """Replace the maxima at samples by those of the functions where their coefficients prove no smaller ones."""
        # The coefficients bound the function: limits that they meet need no search.
        low = np.array(
            [coefficients.min(axis=0).min(axis=0) for coefficients in functions]
        )
        high = np.array(
            [coefficients.max(axis=0).max(axis=0) for coefficients in functions]
        )
        upper_bounds = self._relative_violations(low, high)
        # Without a tolerance, rounding decides.
        skippable = np.asarray((self.tolerance > 0).all(axis=1) & early_exit)
        searched = ~skippable | ~(upper_bounds.max(axis=1) <= 1)
        for limit in np.flatnonzero(searched).tolist():
            threshold = 1.0 if skippable[limit] else -np.inf
            # Only bounds that the coefficients do not prove are searched.
            (rows,) = (~(upper_bounds[limit] <= threshold)).nonzero()
            maxima[limit] = self._maximum(
                limit, rows, functions[limit], edges, maxima[limit], threshold
            )

    def _at_samples(self, values: Array, s: Array) -> list[Maximum]:
        """Return the maximum relative violation of each limit by values of shape (L, n, K) at phases s."""
        violations = self._relative_violations(values.min(axis=2), values.max(axis=2))
        maxima = []
        for limit, row in enumerate(violations.argmax(axis=1).tolist()):
            below = row < len(self.joints)
            joint = row % len(self.joints)
            series = values[limit, joint]
            maxima.append(
                (
                    float(violations[limit, row]),
                    row,
                    float(s[series.argmin() if below else series.argmax()]),
                )
            )
        return maxima

    def _relative_violations(self, low: Array, high: Array) -> Array:
        """Return the violations by minima and maxima, shape (L, n), in multiples of ``scale``, shape (L, 2 n)."""
        # The scale is negative for lower bounds: the quotient is positive outside on
        # both sides.
        return np.asarray(
            (np.concatenate([low, high], axis=1) - self.bounds) / self.scale
        )

    def _maximum(  # noqa: PLR0917 - the function, the bounds, and the known maximum
        self,
        limit: int,
        rows: Indices,
        function: Array,
        edges: Array,
        known: Maximum,
        threshold: float,
    ) -> Maximum:
        """Search for a larger violation than the known one at some of the bounds of a limit."""
        # Row r is the lower bound of joint r, or for r >= n the upper bound of joint r
        # - n.
        values = function[..., rows % len(self.joints)]
        violations = (values - self.bounds[limit, rows]) / self.scale[limit, rows]
        parts = EARLY_EXIT_PARTS if threshold == 1 else 2
        value, row, phase = find_maximum(
            violations,
            edges,
            (known[0], -1, known[2]),
            threshold=threshold,
            parts=parts,
        )
        return value, known[1] if row < 0 else int(rows[row]), phase

    def margin_at(self, limit: int, maximum: Maximum, time: float) -> Margin:
        """Return the margin of a limit at its maximum relative violation and the time of it [s]."""
        (relative, row, phase), condition = maximum, self.conditions[limit]
        bound = self.bounds[limit, row]
        offset = relative * self.scale[limit, row]
        part = row % len(self.joints)
        return Margin(
            condition.name,
            self.constraints[limit].reason,
            unit_of(condition.unit, part),
            self.joints[part],
            value=float(bound + offset),
            bound=float(bound),
            violation=float(-offset if row < len(self.joints) else offset),
            tolerance=float(self.tolerance[limit, part]),
            time=time,
            phase=phase,
        )


def joint_limits(problem: Problem, world: PathWorld) -> ProvenJointLimits:
    """Return the joint limits of a problem that are proven.

    Its robot may be at any state with a jerk.
    """
    constraints = tuple(
        constraint for constraint in problem.constraint if is_proven(constraint)
    )
    conditions = tuple(
        constraint.measured(cast(World, world))[0] for constraint in constraints
    )
    shape = len(constraints), world.robot.n
    lower, upper = (
        np.array([getattr(condition, end) for condition in conditions]).reshape(shape)
        for end in ("lower", "upper")
    )
    pairs = zip(constraints, conditions, strict=True)
    tolerance = np.array(
        [constraint.allowed(condition) for constraint, condition in pairs]
    ).reshape(shape)
    # The resolution of violations where the tolerance is zero: a billionth of the
    # bound.
    scale = np.maximum(
        tolerance, MIN_RELATIVE_SCALE * np.maximum(np.abs(lower), np.abs(upper))
    )
    both = (
        np.concatenate([lower, upper], axis=1),
        np.concatenate([-scale, scale], axis=1),
    )
    return ProvenJointLimits(
        constraints, conditions, world.robot.joint_names, tolerance, *both
    )
