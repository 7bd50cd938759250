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
class Limits:
    """L limits of n joints that are proven to hold, or broken; arrays have shape (L, n).

    Attributes:
        constraints: Those of a problem that are proven.
        conditions: What each of them states, at whatever state.
        joints: Names of the joints.
        lower: Lower bounds.
        upper: Upper bounds.
        allowed: How far beyond them a motion may be and still be called valid.
    """

    constraints: tuple[Constraint, ...]
    conditions: tuple[Condition, ...]
    joints: tuple[str, ...]
    lower: Array
    upper: Array
    allowed: Array

    @cached_property
    def scale(self) -> Array:
        """What is counted in how far a motion is beyond them: what is allowed, or a little where that is nothing."""
        return np.maximum(self.allowed, LEAST * np.maximum(np.abs(self.lower), np.abs(self.upper)))

    @cached_property
    def tolerant(self) -> NDArray[np.bool_]:
        """Which of them allow something at every joint, shape (L,); in others rounding decides."""
        return np.asarray((self.allowed > 0).all(axis=1))

    def margins(self, world: PathWorld, pieces: Pieces, s: Array, table: Array, *, brief: bool) -> list[Margin]:
        """Find where a motion comes closest to breaking each limit, or breaks it most.

        Args:
            world: The robot at the samples.
            pieces: The motion as polynomials.
            s: Phases of the samples, shape (K,).
            table: Its times, as ``time_table`` returns them.
            brief: Whether, where a limit is proven to hold, it is enough to know how close samples come to it.
        """
        if not self.constraints:
            return []
        names = [_QUANTITIES[type(each)] for each in self.constraints]
        functions = [getattr(pieces, name) for name in names]
        peaks = self._at_samples(np.array([getattr(world, name) for name in names]), s)
        briefly = self.tolerant & brief
        for limit in np.flatnonzero(~(briefly & self._hold(functions))).tolist():
            rows, known = self._beyond(functions[limit], functions[limit], limit), peaks[limit]
            least, parts = (1.0, AT_ONCE) if briefly[limit] else (-np.inf, 2)
            peaks[limit] = largest(rows, pieces.edges, known, least=least, parts=parts)
        when = times(np.array([phase for *_, phase in peaks]), table).tolist()
        return [self._margin(limit, peak, when[limit]) for limit, peak in enumerate(peaks)]

    def _at_samples(self, values: Array, s: Array) -> list[Peak]:
        """Return by how many ``scale`` values of shape (L, n, K) at phases s are beyond each limit, and where."""
        shares, peaks = self._beyond(values.min(axis=2), values.max(axis=2)), []
        for limit, row in enumerate(shares.argmax(axis=1).tolist()):
            below, joint = row < len(self.joints), row % len(self.joints)
            its = values[limit, joint]
            peaks.append((float(shares[limit, row]), row, float(s[its.argmin() if below else its.argmax()])))
        return peaks

    def _hold(self, functions: list[Array]) -> NDArray[np.bool_]:
        """Say which limits functions hold with certainty, by their coefficients of shape (d + 1, S, n); shape (L,)."""
        least = np.array([each.min(axis=0).min(axis=0) for each in functions])
        most = np.array([each.max(axis=0).max(axis=0) for each in functions])
        return np.asarray(self._beyond(least, most).max(axis=1) <= 1)

    def _beyond(self, least: Array, most: Array, limit: "int | slice" = slice(None)) -> Array:
        """Return how far ``least`` is below lower bounds, then ``most`` above upper ones, shape (..., 2 n)."""
        scale, below, above = self.scale[limit], self.lower[limit] - least, most - self.upper[limit]
        return np.concatenate([below / scale, above / scale], axis=-1)

    def _margin(self, limit: int, peak: Peak, time: float) -> Margin:
        share, row, phase = peak
        low, part = row < len(self.joints), row % len(self.joints)
        excess, bound = share * self.scale[limit, part], (self.lower if low else self.upper)[limit, part]
        return Margin(
            self.conditions[limit].name,
            self.constraints[limit].reason,
            unit_of(self.conditions[limit].unit, part),
            self.joints[part],
            value=float(bound - excess if low else bound + excess),
            bound=float(bound),
            excess=float(excess),
            allowed=float(self.allowed[limit, part]),
            time=time,
            phase=phase,
        )


def limits_of(problem: Problem, world: PathWorld) -> Limits:
    """Return the limits of a problem that are proven.

    Args:
        problem: The problem.
        world: Its robot at some state with a jerk: the bounds are the same at all of them.
    """
    constraints = tuple(each for each in problem.constraint if is_proven(each))
    conditions = tuple(each.measured(cast("World", world))[0] for each in constraints)
    stated = [
        (found.lower, found.upper, each.allowed(found)) for each, found in zip(constraints, conditions, strict=True)
    ]
    bounds = np.array(stated).reshape(-1, 3, world.robot.n).swapaxes(0, 1)
    return Limits(constraints, conditions, world.robot.joint_names, *bounds)
