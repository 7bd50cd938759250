"""Joint limits over a whole motion, between any two moments: proven, since there the motion is a polynomial."""

from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING, cast

import numpy as np
from numpy.typing import NDArray

from cnpgen.judges.plans.between import Peak, Pieces, largest
from cnpgen.judges.plans.sampling import times
from cnpgen.judges.plans.verdict import Margin
from cnpgen.problems.constraints.constraint import Condition, Constraint
from cnpgen.problems.constraints.joint import JointAcceleration, JointJerk, JointPosition, JointVelocity
from cnpgen.problems.problem import Problem
from cnpgen.store.joint_units import unit_of
from cnpgen.world.path import PathWorld

if TYPE_CHECKING:
    from cnpgen.world.state import World

Array = NDArray[np.float64]

LEAST = 1e-9  # of a bound: how exactly the largest excess is found where none is allowed
AT_ONCE = 8  # parts that a brief look divides pieces into at a time
_QUANTITIES = {JointPosition: "q", JointVelocity: "dq", JointAcceleration: "ddq", JointJerk: "jerk"}


def is_proven(constraint: Constraint) -> bool:
    """Whether a constraint is a limit that can be proven to hold at every moment."""
    return type(constraint) in _QUANTITIES


@dataclass(frozen=True)
class Limit:
    """A limit of n joints that is proven to hold, or broken; arrays have shape (n,).

    Attributes:
        constraint: It.
        condition: What it states, at whatever state.
        allowed: How far beyond its bounds a motion may be and still be called valid.
        scale: What is counted in how far a motion is beyond them: ``allowed``, or a little where that is 0.
    """

    constraint: Constraint
    condition: Condition
    allowed: Array
    scale: Array

    @cached_property
    def is_tolerant(self) -> bool:
        """Whether anything is allowed at every joint; where nothing is, rounding decides."""
        return bool((self.allowed > 0).all())

    def margin(self, world: PathWorld, pieces: Pieces, s: Array, table: Array, *, brief: bool) -> Margin:
        """Find where a motion comes closest to breaking the limit, or breaks it most.

        Args:
            world: The robot at the samples.
            pieces: The motion as polynomials.
            s: Phases of the samples, shape (K,).
            table: Its times, as ``time_table`` returns them.
            brief: Whether, where the limit is proven to hold, it is enough to know how close samples come to it.
        """
        share, row, phase = self._worst(world, pieces, s, brief=brief and self.is_tolerant)
        low, part = row < len(self.scale), row % len(self.scale)
        excess, bound = share * self.scale[part], (self.condition.lower if low else self.condition.upper)[part]
        return Margin(
            self.condition.name,
            self.constraint.reason,
            unit_of(self.condition.unit, part),
            world.robot.joint_names[part],
            value=float(bound - excess if low else bound + excess),
            bound=float(bound),
            excess=float(excess),
            allowed=float(self.allowed[part]),
            time=float(times(phase, table)),
            phase=phase,
        )

    def _worst(self, world: PathWorld, pieces: Pieces, s: Array, *, brief: bool) -> Peak:
        """Return the largest share of ``scale`` that a motion is beyond the limit by."""
        values, coefficients = (getattr(each, _QUANTITIES[type(self.constraint)]) for each in (world, pieces))
        sampled = self._beyond(values.min(axis=1), values.max(axis=1))
        row = int(sampled.argmax())
        its = values[row % len(values)]
        known = float(sampled[row]), row, float(s[its.argmin() if row < len(values) else its.argmax()])
        hull = self._beyond(coefficients.min(axis=0).min(axis=0), coefficients.max(axis=0).max(axis=0))
        if brief and hull.max() <= 1:
            return known
        rows = self._beyond(coefficients, coefficients)
        if brief:
            return largest(rows, pieces.edges, known, least=1.0, parts=AT_ONCE)
        return largest(rows, pieces.edges, known)

    def _beyond(self, least: Array, most: Array) -> Array:
        """Return how far ``least`` is below lower bounds, then ``most`` above upper ones, shape (..., 2 n)."""
        below, above = self.condition.lower - least, most - self.condition.upper
        return np.concatenate([below / self.scale, above / self.scale], axis=-1)


def limits_of(problem: Problem, world: PathWorld) -> tuple[Limit, ...]:
    """Return the limits of a problem that are proven.

    Args:
        problem: The problem.
        world: Its robot at some state with a jerk: the bounds are the same at all of them.
    """
    return tuple(_limit(each, world) for each in problem.constraint if is_proven(each))


def _limit(constraint: Constraint, world: PathWorld) -> Limit:
    (condition,) = constraint.measured(cast("World", world))
    allowed = constraint.allowed(condition)
    least = LEAST * np.maximum(np.abs(condition.lower), np.abs(condition.upper))
    return Limit(constraint, condition, allowed, np.maximum(allowed, least))
