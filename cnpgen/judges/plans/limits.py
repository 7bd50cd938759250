"""Joint limits over a whole motion, between any two moments: proven, since there the motion is a polynomial."""

from typing import TYPE_CHECKING, cast

import numpy as np
from numpy.typing import NDArray

from cnpgen.judges.plans.between import Pieces, largest
from cnpgen.judges.plans.sampling import times
from cnpgen.judges.plans.verdict import Margin
from cnpgen.problems.constraints.constraint import Condition, Constraint
from cnpgen.problems.constraints.joint import JointAcceleration, JointJerk, JointPosition, JointVelocity
from cnpgen.store.joint_units import unit_of
from cnpgen.world.path import PathWorld

if TYPE_CHECKING:
    from cnpgen.world.state import World

Array = NDArray[np.float64]

LEAST = 1e-9  # of a bound: how exactly the largest excess is found where none is allowed
_COEFFICIENTS = {JointPosition: "q", JointVelocity: "dq", JointAcceleration: "ddq", JointJerk: "jerk"}


def is_proven(constraint: Constraint) -> bool:
    """Whether a constraint is a limit that can be proven to hold at every moment."""
    return type(constraint) in _COEFFICIENTS


def limit_margin(
    constraint: Constraint, world: PathWorld, pieces: Pieces, s: Array, table: Array, *, brief: bool
) -> Margin:
    """Find where a motion comes closest to breaking a joint limit, or breaks it most.

    Args:
        constraint: One that ``is_proven``.
        world: The robot at the samples.
        pieces: The motion as polynomials.
        s: Phases of the samples, shape (K,).
        table: Its times, as ``time_table`` returns them.
        brief: Whether, where the limit is proven to hold, it is enough to know how close knots come to it.
    """
    (condition,) = constraint.measured(cast("World", world))
    allowed = constraint.allowed(condition)
    brief &= bool(np.all(allowed > 0))  # where nothing is allowed, rounding decides
    scale = np.maximum(allowed, LEAST * np.maximum(np.abs(condition.lower), np.abs(condition.upper)))
    coefficients: Array = getattr(pieces, _COEFFICIENTS[type(constraint)])
    shares = _beyond(coefficients, condition, scale)
    sampled, at = shares[..., 0], pieces.edges
    if not brief:
        sampled, at = _beyond(np.array(condition.g)[:, None], condition, scale)[:, 0], s
    row, k = divmod(int(np.argmax(sampled)), sampled.shape[1])
    known = float(sampled[row, k]), row, float(at[k])
    share, row, phase = largest(shares, pieces.edges, known, least=1.0 if brief else -np.inf)
    low, part = row < len(scale), row % len(scale)
    excess, bound = share * scale[part], (condition.lower if low else condition.upper)[part]
    return Margin(
        condition.name,
        constraint.reason,
        unit_of(condition.unit, part),
        world.robot.joint_names[part],
        value=float(bound - excess if low else bound + excess),
        bound=float(bound),
        excess=float(excess),
        allowed=float(allowed[part]),
        time=float(times(np.array([phase]), table)[0]),
        phase=phase,
    )


def _beyond(coefficients: Array, condition: Condition, scale: Array) -> Array:
    """Return how far joints are below their lower bounds, then above their upper ones, in multiples of ``scale``."""
    lower, upper, unit = (values[:, None, None] for values in (condition.lower, condition.upper, scale))
    return np.concatenate([(lower - coefficients) / unit, (coefficients - upper) / unit])
