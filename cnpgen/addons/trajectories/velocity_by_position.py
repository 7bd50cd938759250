"""Velocity limits that fall towards the ends of a joint's range, as those of the Franka Research 3.

The largest velocity towards the upper end u of a joint at q is

    L(q) = max(0, sqrt(max(0, s (u - q))) - o) = sqrt(max(s (u - q), o^2)) - o,

and a constant limit V holds, too. Towards the lower end the limit is that of -q. A joint
that starts at a or below and obeys dq <= min(V, L(q)) needs at least the time

    T(a, b) = integral of dq / min(V, L(q)) from a to b

to reach b: samples that are closer in time prove that a limit is exceeded.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from cnpgen.addons.trajectories.lower_bounds import LAGS, first_derivatives
from cnpgen.addons.trajectories.refuted_limits import RefutedLimit
from cnpgen.addons.trajectories.sample_errors import SampleErrors
from cnpgen.addons.trajectories.sampled_trajectory import Trajectory
from cnpgen.arrays import Array
from cnpgen.documents import Names
from cnpgen.errors import RecipeError
from cnpgen.judges.plans.verdict import Margin
from cnpgen.problems.constraints.constraint import Condition, Constraint
from cnpgen.schema.keys import PerJoint, Range, field

if TYPE_CHECKING:
    from cnpgen.kernels.symbolic.symbolic_state import SymbolicState
    from cnpgen.robots.robot import Robot
    from cnpgen.world.world import World

NAME = "joint velocity by position"
MIN_PROVEN = 1e-9  # rad/s, of a bound beyond a limit: rounding proves nothing
# Of the constant limit, that lower bounds grant everywhere. A larger limit proves less,
# and makes finite numbers where the limit is zero.
MIN_SHARE = 0.05


def span_limits(
    q: Array, lag: int, error: float, by_position: Array, largest: Array
) -> tuple[Array, Array]:
    """Return the limits of mean velocities between samples at a distance, lower and upper, shape (K - lag, n).

    Both samples count as near to each other as their errors allow: a curve that begins
    before them and ends behind them passes this way, too.

    Args:
        q: Samples [rad], shape (K, n).
        lag: Their distance.
        error: Largest error of a sample [rad].
        by_position: s, o, lower and upper ends of all joints, shape (4, n).
        largest: Constant limits V [rad/s], shape (n,).
    """
    slope, offset, low, high = by_position
    a = q[:-lag]
    b = q[lag:]
    e = error
    upper = _largest_mean(high - a - e, high - b + e, slope, offset, largest)
    return -_largest_mean(a - e - low, b + e - low, slope, offset, largest), upper


def _largest_mean(
    begin: Array, end: Array, slope: Array, offset: Array, largest: Array
) -> Array:
    """Return the largest mean velocity between two distances from the end, the constant limit if it does not come nearer."""
    times = [_time_to_end(x, slope, offset, largest) for x in (begin, end)]
    with np.errstate(divide="ignore", invalid="ignore"):
        mean = (begin - end) / (times[0] - times[1])
    # Rounding must not make the limit of a very short way larger or undefined.
    return np.where(begin > end, np.fmin(mean, largest), largest)


def _time_to_end(x: Array, slope: Array, offset: Array, largest: Array) -> Array:
    """Return the least time from a distance x to the end, with at least ``MIN_SHARE`` of the constant limit.

    With w = sqrt(s x), dx / L = (2 / s) w dw / (w - o): its integral is (2 / s) (w + o
    log(w - o)). It applies where L is between both constant limits.
    """
    least = MIN_SHARE * largest
    # Values of w at which L equals the least and the largest limit, and their distances.
    slow = least + offset
    fast = largest + offset
    near = slow**2 / slope
    far = fast**2 / slope
    w = np.sqrt(slope * np.clip(x, near, far))
    between = 2 / slope * (w - slow + offset * np.log((w - offset) / least))
    return np.minimum(x, near) / least + between + np.maximum(x - far, 0) / largest


@dataclass(frozen=True, kw_only=True)
class VelocityByPosition(Constraint):
    """Constraint: joint velocities towards an end of the range are at most ``sqrt(slope * distance) - offset``.

    The limit is at least zero. A ``joint-velocity`` constraint adds constant limits. Each
    key has one number for all joints, or one per joint.
    """

    reason = "joint velocity limit at a position"
    reads = ()
    slope: PerJoint = field(
        "square of velocities per distance", unit="rad/s^2", low=1e-6
    )
    offset: PerJoint = field("velocity below the root", unit="rad/s", low=1e-3)
    ends: tuple[Range, ...] = field("ends from which distances count", unit="rad")
    tolerance: float = field(
        "violation that a valid motion may have", unit="rad/s", low=0.0
    )

    def symbolic(self, state: SymbolicState) -> tuple[Condition, ...]:
        """State the differences of velocities from their limits [rad/s]."""
        import casadi as ca

        return self._below(state.robot, state.q, state.dq, ca.fmax)

    def measured(self, world: World) -> tuple[Condition, ...]:
        """Compare velocities [rad/s] with their limits."""
        return self._below(world.robot, world.q, world.dq, np.maximum)

    def _below(
        self, robot: Robot, q: Any, dq: Any, maximum: Any
    ) -> tuple[Condition, ...]:
        n = robot.n
        g = []
        s, o, *ends = self.by_position(n).tolist()
        for end, sign in zip(ends, (-1, 1), strict=True):
            for j in range(n):
                # The maximum keeps the root, and its derivative, away from zero.
                square = maximum(s[j] * sign * (end[j] - q[j]), o[j] ** 2)
                g.append(sign * dq[j] - square**0.5 + o[j])
        unit = robot.units("rad/s")
        parts = robot.joint_names
        none = np.full(2 * n, -np.inf)
        zero = np.zeros(2 * n)
        return (Condition(NAME, unit, g, none, zero, "velocity", (*parts, *parts)),)

    def by_position(self, n: int) -> Array:
        """Return slopes, offsets, lower and upper ends of n joints, shape (4, n)."""
        slope = self.slope.values
        offset = self.offset.values
        if len(self.ends) != n or not {len(slope), len(offset)} <= {1, n}:
            text = f"{n} joints need {n} ends, and one or {n} slopes and offsets"
            raise RecipeError([f"velocity-by-position: {text}"])
        low, high = zip(*((each.low, each.high) for each in self.ends), strict=True)
        rows = (np.broadcast_to(row, n) for row in (slope, offset, low, high))
        return np.stack([*rows])

    def refuted(
        self,
        trajectory: Trajectory,
        errors: SampleErrors,
        largest: Array,
        joints: Names,
    ) -> RefutedLimit | None:
        """Return the limit that no curve through samples within their errors meets, or None.

        Args:
            trajectory: Samples; their positions count.
            errors: Their errors.
            largest: Constant limits of velocities with tolerances [rad/s], shape (n,).
            joints: Names of the joints.
        """
        if not np.isfinite(largest).all():
            return None
        best = MIN_PROVEN
        found = None
        t = trajectory.t
        q = trajectory.q
        e = errors.q
        # An offset that is smaller by the tolerance raises the limit by as much.
        rows = self.by_position(len(joints)) - np.array([[0, self.tolerance, 0, 0]]).T
        means = first_derivatives(t, q, e, errors.t)
        for lag, mean in zip(LAGS, means, strict=False):
            for limit, value in zip(
                span_limits(q, lag, e, rows, largest),
                (mean.high, mean.low),
                strict=True,
            ):
                excess = (value - limit) * np.sign(limit)
                k, joint = np.unravel_index(int(excess.argmax()), excess.shape)
                if excess[k, joint] > best:
                    best = float(excess[k, joint])
                    margin = Margin(
                        *(NAME, self.reason, "rad/s", joints[joint]),
                        value=float(value[k, joint]),
                        bound=float(limit[k, joint]),
                        violation=best,
                        tolerance=0.0,  # is part of the bound
                        time=float(mean.t[k]),
                        phase=float(mean.t[k] / t[-1]),
                    )
                    found = RefutedLimit(margin, "positions")
        return found
