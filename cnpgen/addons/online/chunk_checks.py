"""Checks of raw action chunks: a chunk that no motion within the limits can follow is refused, not smoothed."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import ArrayLike

from cnpgen.addons.online.plan_runtime import positive
from cnpgen.addons.trajectories.refuted_limits import refuted_limits
from cnpgen.addons.trajectories.sample_errors import SampleErrors
from cnpgen.addons.trajectories.sampled_trajectory import Trajectory
from cnpgen.arrays import Array
from cnpgen.errors import UsageError
from cnpgen.judges.plans.joint_limits import joint_limits
from cnpgen.plans.plausible import check_units_of_states
from cnpgen.problems.constraints.joint import JointPosition
from cnpgen.problems.problem import Problem
from cnpgen.robots.robot import Robot
from cnpgen.schema.argument_types import check_fields
from cnpgen.schema.arguments import check_range, concerning, number, numbers
from cnpgen.world.path import PathWorld

MIN_CHUNK_SAMPLES = 8  # of a chunk after the join: fewer have no reliable velocity
MAX_DURATION = 1.2  # of a motion, in chunk lengths
SAMPLE_ROUNDING = 1e-6  # samples
TIMES_S = 1e-3, 60.0  # range of options
NOISE_RAD = 1e-3
MAX_RESTING_SPEED = 0.05  # fraction of the velocity limits, of an arm that is at rest


@dataclass(frozen=True)
class ChunkOptions:
    """Further options of ``ChunkExecutor``.

    Attributes:
        noise: Largest random error of a chunk's positions [rad]. A chunk is refused if
            no motion within it meets the limits of velocities, accelerations and jerks.
        stop_after: Time after a join at which the arm rests at the latest without
            another chunk [s]; by default 1.2 chunk lengths. Later samples are not used.

    Raises:
        UsageError: A value has another type, or is outside of its range.
    """

    noise: float = NOISE_RAD
    stop_after: float | None = None

    def __post_init__(self) -> None:
        check_fields(self)
        positive("noise", self.noise)
        if self.stop_after is not None:
            bounded("stop_after", self.stop_after, *TIMES_S, "s")


class ChunkChecks:
    """Checks of the chunks of one problem.

    Args:
        problem: The problem; its limits of velocities, accelerations and jerks apply.
        robot: Its robot.
        length: Number of samples of a chunk.
        rate: Samples per second [Hz].
        noise: Largest random error of the positions [rad].
    """

    def __init__(
        self, problem: Problem, robot: Robot, *, length: int, rate: float, noise: float
    ) -> None:
        # Positions beyond the limits are clipped later, so they refuse no chunk.
        speeds = tuple(c for c in problem.constraint if type(c) is not JointPosition)
        limited = replace(problem, constraint=speeds)
        world = PathWorld(robot, problem.obstacle, problem.object_size)
        self._limits = joint_limits(limited, world)
        # Times of a chunk are nominal, without jitter.
        self._errors = SampleErrors(noise, 0.0, 0.0, 0.0, "")
        self._times = np.arange(length) / rate
        self._n = robot.n
        self._columns = 0

    def read(self, chunk: ArrayLike) -> tuple[Array, Array]:
        """Return positions, shape (K, n), and the other columns, shape (K, D - n).

        Raises:
            UsageError: The shape is wrong, or differs from that of earlier chunks.
        """
        values = numbers("chunk", chunk)
        length = len(self._times)
        n = self._n
        if values.ndim != 2 or len(values) != length or values.shape[1] < n:
            raise UsageError(
                f"must have shape ({length}, D) with at least {n} columns, the joints,"
                f" got {values.shape}",
                argument="chunk",
            )
        if self._columns not in {0, values.shape[1]}:
            raise UsageError(
                f"has {values.shape[1]} columns, earlier ones have {self._columns}",
                argument="chunk",
            )
        # The other columns are kept, and the caller may reuse the array.
        return values[:, :n], values[:, n:].copy()

    def keep_columns(self, columns: int) -> None:
        """Demand a number of columns of all later chunks."""
        self._columns = columns

    def refuted(self, q: Array) -> str:
        """Return a limit that no motion within the noise of samples, shape (K, n), meets; empty if none is proven."""
        found = refuted_limits(self._limits, Trajectory(self._times, q), self._errors)
        return f"{found[0].margin.name}: {found[0].detail}" if found else ""


def bounded(name: str, value: float, low: float, high: float, unit: str) -> float:
    """Return an argument as a number from a least to a largest value in a unit."""
    found = number(name, value)
    check_range(name, found, low, high, unit)
    return found


def checked_state(measured: tuple[ArrayLike, ArrayLike], n: int) -> tuple[Array, Array]:
    """Return measured positions and velocities, shape (n,) each; they may be nan."""
    state = [numbers("measured", values) for values in measured]
    shapes = [values.shape for values in state]
    if shapes != [(n,), (n,)]:
        raise UsageError(
            f"must be positions and velocities of shape ({n},), got shapes {shapes}",
            argument="measured",
        )
    return state[0], state[1]


def check_rest(
    robot: Robot, names: Sequence[str], state: tuple[Array, Array], error: Array
) -> None:
    """Refuse a measured state, shape (n,) each, that is outside the position limits by more than an error, or moves."""
    q, dq = state
    if not np.isfinite(q).all():
        raise UsageError(f"must be finite, got {q}", argument="measured")
    with concerning("measured"):
        check_units_of_states(
            robot, {"start_q": q[None], "start_dq": dq[None]}, noun="state"
        )
    outside = np.maximum(robot.position_lower - q, q - robot.position_upper)
    if (outside > error).any():
        joint = int(np.argmax(outside))
        text = f"{names[joint]} is {outside[joint]:.3g} rad outside its position limits"
        raise UsageError(text, concerns="measured")
    # Measured velocities of an arm at rest are noise, not zero.
    resting = np.abs(dq) <= MAX_RESTING_SPEED * robot.velocity_limit
    if not resting.all():
        # Nan does not rest.
        joint = int(resting.argmin())
        text = f"the arm must be at rest, but {names[joint]} moves at {dq[joint]:.3g} rad/s"
        raise UsageError(text, concerns="measured")


def checked_errors(tracking_error: ArrayLike, n: int) -> Array:
    """Return positive tracking errors, shape (n,)."""
    errors = numbers("tracking_error", tracking_error)
    fits = errors.shape in {(), (n,)} and np.asarray(tracking_error).dtype != bool
    if not fits or not (np.isfinite(errors) & (errors > 0)).all():
        raise UsageError(
            f"must be one positive number or {n} of them, got {tracking_error!r:.100}",
            argument="tracking_error",
        )
    return np.broadcast_to(errors, (n,))


def horizon(stop_after: float | None, length: int, rate: float) -> int:
    """Return the number of samples that a motion follows, so that it rests after a time [s]."""
    if stop_after is None:
        return length
    # The motion takes at most MAX_DURATION times the samples that it follows.
    samples = int(stop_after / MAX_DURATION * rate + SAMPLE_ROUNDING) + 1
    if samples < MIN_CHUNK_SAMPLES:
        least = MAX_DURATION * (MIN_CHUNK_SAMPLES - 1) / rate
        raise UsageError(
            f"must be at least {least:.3g} s, the time of {MIN_CHUNK_SAMPLES} samples,"
            f" got {stop_after:g}",
            argument="stop_after",
        )
    return min(samples, length)
