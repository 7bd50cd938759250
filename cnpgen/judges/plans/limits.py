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
Indices = NDArray[np.intp]

LEAST = 1e-9  # of a bound: how exactly the largest excess is found where none is allowed
AT_ONCE = 8  # parts that a brief look divides pieces into at a time
_QUANTITIES = {JointPosition: "q", JointVelocity: "dq", JointAcceleration: "ddq", JointJerk: "jerk"}


def is_proven(constraint: Constraint) -> bool:
    """Whether a constraint is a limit that can be proven to hold at every moment."""
    return type(constraint) in _QUANTITIES


@dataclass(frozen=True)
class Limits:
    """L limits of n joints that are proven to hold, or broken.

    Attributes:
        constraints: Those of a problem that are proven.
        conditions: What each of them states, at whatever state.
        joints: Names of the joints.
        allowed: How far beyond its bounds a motion may be and still be called valid, shape (L, n).
        bounds: Lower bounds of all joints, then upper ones, shape (L, 2 n).
        scale: What is counted in how far a motion is beyond them: what is allowed, or a little where that is nothing;
            negative of lower bounds, since what is less is beyond them. Shape (L, 2 n).
    """

    constraints: tuple[Constraint, ...]
    conditions: tuple[Condition, ...]
    joints: tuple[str, ...]
    allowed: Array
    bounds: Array
    scale: Array

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
        peaks, hulls = self._at_samples(np.array([getattr(world, name) for name in names]), s), self._hulls(functions)
        briefly = self.tolerant & brief
        for limit in np.flatnonzero(~briefly | ~(hulls.max(axis=1) <= 1)).tolist():
            least = 1.0 if briefly[limit] else -np.inf
            (rows,) = (~(hulls[limit] <= least)).nonzero()
            peaks[limit] = self._largest(limit, rows, functions[limit], pieces.edges, peaks[limit], least)
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

    def _hulls(self, functions: list[Array]) -> Array:
        """Bound by how many ``scale`` functions are beyond each bound; they are coefficients, shape (d + 1, S, n)."""
        least = np.array([each.min(axis=0).min(axis=0) for each in functions])
        most = np.array([each.max(axis=0).max(axis=0) for each in functions])
        return self._beyond(least, most)

    def _beyond(self, least: Array, most: Array) -> Array:
        """Return by how many ``scale`` least and largest values, shape (L, n), are beyond bounds, shape (L, 2 n)."""
        return np.asarray((np.concatenate([least, most], axis=1) - self.bounds) / self.scale)

    def _largest(  # noqa: PLR0917 - what is looked for, where, and what is known
        self, limit: int, rows: Indices, function: Array, edges: Array, known: Peak, least: float
    ) -> Peak:
        """Look for more than is known at some of the bounds of a limit."""
        values = function[..., rows % len(self.joints)]
        beyond, parts = (values - self.bounds[limit, rows]) / self.scale[limit, rows], AT_ONCE if least == 1 else 2
        share, found, phase = largest(beyond, edges, (known[0], -1, known[2]), least=least, parts=parts)
        return share, known[1] if found < 0 else int(rows[found]), phase

    def _margin(self, limit: int, peak: Peak, time: float) -> Margin:
        (share, row, phase), condition = peak, self.conditions[limit]
        bound, beyond, part = self.bounds[limit, row], share * self.scale[limit, row], row % len(self.joints)
        return Margin(
            condition.name,
            self.constraints[limit].reason,
            unit_of(condition.unit, part),
            self.joints[part],
            value=float(bound + beyond),
            bound=float(bound),
            excess=float(-beyond if row < len(self.joints) else beyond),
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
    shape = len(constraints), world.robot.n
    lower, upper = (np.array([getattr(each, end) for each in conditions]).reshape(shape) for end in ("lower", "upper"))
    pairs = zip(constraints, conditions, strict=True)
    allowed = np.array([each.allowed(condition) for each, condition in pairs]).reshape(shape)
    scale = np.maximum(allowed, LEAST * np.maximum(np.abs(lower), np.abs(upper)))
    both = np.concatenate([lower, upper], axis=1), np.concatenate([-scale, scale], axis=1)
    return Limits(constraints, conditions, world.robot.joint_names, allowed, *both)
