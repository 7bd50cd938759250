"""Joint limits over a whole motion, between any two moments: proven, since there the motion is a polynomial."""

from typing import TYPE_CHECKING, cast

import numpy as np
from numpy.typing import NDArray

from cnpgen.judges.plans.between import Peak, Pieces, largest
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
_QUANTITIES = {JointPosition: "q", JointVelocity: "dq", JointAcceleration: "ddq", JointJerk: "jerk"}


def is_proven(constraint: Constraint) -> bool:
    """Whether a constraint is a limit that can be proven to hold at every moment."""
    return type(constraint) in _QUANTITIES


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
        brief: Whether, where the limit is proven to hold, it is enough to know how close samples come to it.
    """
    (condition,) = constraint.measured(cast("World", world))
    allowed = constraint.allowed(condition)
    scale = np.maximum(allowed, LEAST * np.maximum(np.abs(condition.lower), np.abs(condition.upper)))
    brief &= bool((allowed > 0).all())  # where nothing is allowed, rounding decides
    values, coefficients = (getattr(each, _QUANTITIES[type(constraint)]) for each in (world, pieces))
    share, row, phase = _at_samples(values, s, condition, scale)
    hull = _beyond(coefficients.min(axis=0).min(axis=0), coefficients.max(axis=0).max(axis=0), condition, scale)
    if not (brief and hull.max() <= 1):
        rows, least = _beyond(coefficients, coefficients, condition, scale), 1.0 if brief else -np.inf
        share, row, phase = largest(rows, pieces.edges, (share, row, phase), least=least)
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
        time=float(times(phase, table)),
        phase=phase,
    )


def _at_samples(values: Array, s: Array, condition: Condition, scale: Array) -> Peak:
    """Return the largest share at phases s, of values of shape (n, K)."""
    shares = _beyond(values.min(axis=1), values.max(axis=1), condition, scale)
    row = int(shares.argmax())
    its = values[row % len(values)]
    return float(shares[row]), row, float(s[its.argmin() if row < len(values) else its.argmax()])


def _beyond(least: Array, most: Array, condition: Condition, scale: Array) -> Array:
    """Return how far ``least`` is below lower bounds, then ``most`` above upper ones, in multiples of ``scale``.

    Joints are along the last axis, n of them that become 2 n; ``scale`` has shape (n,).
    """
    return np.concatenate([(condition.lower - least) / scale, (most - condition.upper) / scale], axis=-1)
