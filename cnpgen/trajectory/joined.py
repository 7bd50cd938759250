"""Sequences of motions: each part is cut at a time, and the next one continues from that state without a jump."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from cnpgen.arrays import Array
from cnpgen.errors import UsageError
from cnpgen.trajectory.spline import end_derivatives
from cnpgen.trajectory.spline_motion import Motion, States, states_at_times

# Rad, rad/s and rad/s^2: rounding error between a state and a motion that starts from
# it.
MAX_JOINT_GAP = 1e-9
# Relative; dominates in accelerations of motions of milliseconds.
CONTROL_POINT_ROUNDING = 4 * np.finfo(float).eps


@dataclass(frozen=True)
class JoinedMotion:
    """N motions, each a sequence of P parts.

    Attributes:
        parts: Parts, N motions each, of the same joints.
        start_times: Start time of each part [s], shape (P, N), ascending from 0.

    Raises:
        UsageError: A part does not start in the state at which the previous part is
            cut.
    """

    parts: tuple[Motion, ...]
    start_times: Array

    def __post_init__(self) -> None:
        for index in range(1, len(self.parts)):
            _check_joint(
                self.parts[index - 1],
                self.parts[index],
                *self.start_times[index - 1 : index + 1],
            )

    def __repr__(self) -> str:
        return f"<JoinedMotion: {len(self)} of {len(self.parts)} parts>"

    def __len__(self) -> int:
        return len(self.parts[0])

    def __getitem__(self, index: list[int]) -> JoinedMotion:
        return JoinedMotion(
            tuple(part[index] for part in self.parts), self.start_times[:, index]
        )

    def duration(self) -> Array:
        """Compute the duration from the start of the first part to the end of the last [s], shape (N,)."""
        last: Array = self.start_times[-1] + self.parts[-1].duration()
        return last

    def at_times(self, t: Array) -> States:
        """Evaluate the motions at times t [s], shape (N, K).

        At a start time, return the state of the later part.
        """
        # Each part runs on its own clock; times before its start are clipped and
        # replaced below.
        parts = [
            part.at_times(t - start[:, None])
            for part, start in zip(self.parts, self.start_times, strict=True)
        ]
        joined = {name: values.copy() for name, values in vars(parts[0]).items()}
        for states, start in zip(parts[1:], self.start_times[1:], strict=True):
            later = t >= start[:, None]
            for name, values in vars(states).items():
                joined[name][later] = values[later]
        return States(**joined)


def _check_joint(before: Motion, after: Motion, start: Array, cut_time: Array) -> None:
    """Raise an error for cuts outside the part before, and for parts that do not start in its state at the cut."""
    duration = before.duration()
    cut = cut_time - start
    # Relative rounding of the duration may put a cut at the end slightly behind it.
    outside = ~((cut >= 0) & (cut <= duration * (1 + 1e-12)))
    if outside.any():
        row = int(outside.argmax())
        interval = f"from {start[row]:.6g} to {start[row] + duration[row]:.6g} s"
        raise UsageError(
            f"plan {row} cannot be cut at {cut_time[row]:.6g} s: its last part lasts {interval}",
            concerns="at",
        )
    left = states_at_times(before, cut)
    right = states_at_times(after, np.zeros_like(cut))
    # Control points have rounding errors, which derivatives multiply by eta r and beta
    # r^2.
    tolerance = MAX_JOINT_GAP + _rounding(before) + _rounding(after)
    for name, unit, end, begin, max_gap in zip(
        ("q", "dq", "ddq"),
        ("rad", "rad/s", "rad/s^2"),
        left,
        right,
        tolerance,
        strict=True,
    ):
        gap = np.abs(begin - end).max(axis=1)
        if not (gap <= max_gap).all():
            row = int(np.argmax(np.nan_to_num(gap - max_gap, nan=np.inf)))
            text = f"{name} jumps by {gap[row]:.3g} {unit} at {cut_time[row]:.6g} s, expected at most {max_gap[row]:.3g}"
            raise UsageError(
                f"plan {row} cannot be joined: {text}", concerns="following"
            )


def _rounding(motion: Motion) -> Array:
    """Estimate the errors of positions, velocities and accelerations by rounding of control points, shape (3, N)."""
    ends = end_derivatives(motion.path.shape[1], motion.degree)
    largest = motion.rate.max(axis=1)
    orders = np.array(
        [np.ones_like(largest), ends.eta * largest, ends.beta * largest**2]
    )
    return np.asarray(
        CONTROL_POINT_ROUNDING * np.abs(motion.path).max(axis=(1, 2)) * orders
    )
