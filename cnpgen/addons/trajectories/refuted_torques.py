"""Torques that no curve through samples meets together with the limits of velocities and accelerations.

With a hat of half width h around a sample as weight, the mean of the torques of joint j
is M(q_c) a + n(q_c, v_c), up to a remainder R_j. Here q_c is the sample, v_c the mean
velocity over both spans, and a the second divided difference, the mean of ddq. Let |dq|
<= V and |ddq| <= A. On the mean over the hat,

    |q - q_c| <= e + v h / 3 with v = min(V, |v_c| + A h),
    |dq - v_c| <= 7 A h / 12 + e / h, and |mean of ddq - a| <= 4 e / h^2.

R_j adds these times the changes of M and n. The changes are differences of torques,
times a factor for curvature: an estimate, not a proof. If |mean| - R_j exceeds a torque
limit, no curve meets all three limits.
"""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from cnpgen.addons.trajectories.refuted_limits import RefutedLimit
from cnpgen.arrays import Array, Indices
from cnpgen.documents import Names
from cnpgen.judges.plans.verdict import Margin

Torques = Callable[[Array, Array, Array], Array]  # of states, shape (K, n) each

LAGS = (1, 2, 4, 8)
MAX_CANDIDATES = 12  # per distance: the largest torques
MAX_UNEQUAL = 0.05  # relative difference of both spans of a hat
MEAN_VELOCITY_ERROR = 7 / 12  # of A h: integral of (t^2 + h^2) / (2 h) against the hat
CURVATURE_FACTOR = 1.5  # on changes of M and n
UNLESS = "a velocity or acceleration limit is exceeded; constants estimated"


@dataclass(frozen=True, eq=False)
class TorqueLimit:
    """Torque limits [N m] with their tolerances, shape (n,) each, and the texts of their margins."""

    name: str
    reason: str
    limit: Array
    tolerance: Array


def refuted_torques(
    torques: Torques,
    allowed: TorqueLimit,
    t: Array,
    q: Array,
    *,
    error: float,
    largest: tuple[Array, Array],
    joint_names: Names,
) -> RefutedLimit | None:
    """Return the torque limit that samples exceed most, or None.

    Args:
        torques: Inverse dynamics.
        allowed: The limits.
        t: Times [s], shape (K,).
        q: Positions [rad], shape (K, n).
        error: Largest error of the positions [rad].
        largest: Limits of velocities and accelerations with tolerances, shape (n,) each.
        joint_names: Names of the joints.
    """
    best, found = 1.0, None
    if not np.isfinite(largest[1]).all():
        return None
    for lag in LAGS:
        centres = _centres(t, lag)
        if not len(centres):
            continue
        states = _mean_states(t, q, centres, lag)
        # Torques of the mean state: M(q_c) a + n(q_c, v_c).
        mean = torques(*states)
        share = (np.abs(mean) - allowed.tolerance) / allowed.limit
        worst = share.max(axis=1)
        # Each remainder needs many evaluations of the dynamics, so only large torques
        # get one.
        rows = np.argsort(-worst)[:MAX_CANDIDATES]
        rows = rows[worst[rows] > best]
        for row in rows.tolist():
            h = float(t[centres[row] + lag] - t[centres[row] - lag]) / 2
            state = [values[row] for values in states]
            rest = _remainder(torques, state, h, error, largest)
            least = np.abs(mean[row]) - rest
            relative = (least - allowed.tolerance) / allowed.limit
            joint = int(relative.argmax())
            if relative[joint] > best:
                best, time = float(relative[joint]), float(t[centres[row]])
                value = float(np.copysign(least[joint], mean[row, joint]))
                found = _refuted(allowed, joint_names, joint, value, time, float(t[-1]))
    return found


def _refuted(  # noqa: PLR0917 - the parts of a margin
    allowed: TorqueLimit,
    joint_names: Names,
    joint: int,
    value: float,
    time: float,
    duration: float,
) -> RefutedLimit:
    """Return the refuted limit of a joint by the torque that every curve reaches [N m]."""
    limit = float(allowed.limit[joint])
    margin = Margin(
        allowed.name,
        allowed.reason,
        "N m",
        joint_names[joint],
        value=value,
        bound=float(np.copysign(limit, value)),
        violation=abs(value) - limit,
        tolerance=float(allowed.tolerance[joint]),
        time=time,
        phase=time / duration,
    )
    return RefutedLimit(margin, "positions", UNLESS)


def _centres(t: Array, lag: int) -> Indices:
    """Return the samples at the center of two spans of about equal lengths."""
    # The remainder holds for a hat with equal halves.
    centres = np.arange(lag, len(t) - lag)
    before = t[centres] - t[centres - lag]
    after = t[centres + lag] - t[centres]
    equal = np.abs(after - before) <= MAX_UNEQUAL * np.minimum(before, after)
    return centres[equal]


def _mean_states(
    t: Array, q: Array, centres: Indices, lag: int
) -> tuple[Array, Array, Array]:
    """Return positions at the center, mean velocities and mean accelerations over hats, shape (M, n) each."""
    # Divided differences: v_c = (q_2 - q_0) / (2 h), a = 2 (v_after - v_before) / (2
    # h).
    first = centres - lag
    last = centres + lag
    before, after = (
        (q[end] - q[start]) / (t[end] - t[start])[:, None]
        for start, end in ((first, centres), (centres, last))
    )
    width = (t[last] - t[first])[:, None]
    return q[centres], (q[last] - q[first]) / width, 2 * (after - before) / width


def _remainder(
    torques: Torques,
    state: list[Array],
    h: float,
    error: float,
    largest: tuple[Array, Array],
) -> Array:
    """Bound the difference of mean torques from those of the mean state, shape (n,)."""
    (q, v, _), (max_dq, max_ddq), n = state, largest, len(state[0])
    # Bounds of |q - q_c| and |dq - v_c| on the mean over the hat, as in the module.
    fastest = np.minimum(max_dq, np.abs(v) + max_ddq * h)
    moved = error + fastest * h / 3
    faster = MEAN_VELOCITY_ERROR * max_ddq * h + error / h
    # Rows: the state, then every joint moved up and down, then every velocity.
    offsets = np.concatenate([np.zeros((1, n)), np.diag(moved), -np.diag(moved)])
    still, units = np.zeros_like(offsets), np.eye(n)
    # With ddq = 0, inverse dynamics are n(q, v).
    fixed = torques(q + offsets, v + still, still)
    # Column k of M at every row, shape (n, rows, n).
    masses = np.stack(
        [torques(q + offsets, still + v, still + unit) - fixed for unit in units]
    )
    # Positions stay while every velocity moves up and down.
    speeds = np.concatenate([np.diag(faster), -np.diag(faster)])
    by_speed = torques(q + 0 * speeds, v + speeds, 0 * speeds) - fixed[0]

    def change(values: Array) -> Array:
        """Sum over joints the larger of both changes, shape (..., 2 n, n) -> (..., n)."""
        size = np.abs(values)
        both = np.maximum(size[..., :n, :], size[..., n:, :])
        return np.asarray(both.sum(axis=-2))

    # Changes of M are multiplied by the largest ddq.
    of_mass = np.einsum("kj,k->j", change(masses[:, 1:] - masses[:, :1]), max_ddq)
    estimated = of_mass + change(fixed[1:] - fixed[0]) + change(by_speed)
    # The error 4 e / h^2 of the mean of ddq acts through |M|.
    return np.asarray(
        CURVATURE_FACTOR * estimated
        + np.abs(masses[:, 0]).sum(axis=0) * 4 * error / h**2
    )
