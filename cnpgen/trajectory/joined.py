"""Motions that follow one another: each is cut at a moment, and the next goes on from there without a jump."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from cnpgen.errors import UsageError
from cnpgen.trajectory.moment import states_at_times
from cnpgen.trajectory.motion import Motion, States
from cnpgen.trajectory.spline import end_derivatives

Array = NDArray[np.float64]

GAP = 1e-9  # rad, rad/s and rad/s^2: what rounding leaves where one motion begins in the state of another
ROUNDING = 4 * np.finfo(float).eps  # of control points: in accelerations of motions of milliseconds that is more


@dataclass(frozen=True)
class JoinedMotion:
    """N motions, each of P parts, one after the other.

    Attributes:
        parts: The parts, N motions each, of the same joints.
        begins: When each part takes over [s], shape (P, N), ascending from 0.

    Raises:
        UsageError: A part does not begin in the state in which the one before it is cut.
    """

    parts: tuple[Motion, ...]
    begins: Array

    def __post_init__(self) -> None:
        for index in range(1, len(self.parts)):
            _check_joint(self.parts[index - 1], self.parts[index], *self.begins[index - 1 : index + 1])

    def __repr__(self) -> str:
        return f"<JoinedMotion: {len(self)} of {len(self.parts)} parts>"

    def __len__(self) -> int:
        return len(self.parts[0])

    def __getitem__(self, index: list[int]) -> "JoinedMotion":
        return JoinedMotion(tuple(part[index] for part in self.parts), self.begins[:, index])

    def duration(self) -> Array:
        """Duration from the start of the first part to the end of the last [s], shape (N,)."""
        last: Array = self.begins[-1] + self.parts[-1].duration()
        return last

    def at_times(self, t: Array) -> States:
        """Evaluate the motions at times t [s], shape (N, K); where a part takes over it is that part's state."""
        every = [part.at_times(t - begin[:, None]) for part, begin in zip(self.parts, self.begins, strict=True)]
        found = {name: values.copy() for name, values in vars(every[0]).items()}
        for states, begin in zip(every[1:], self.begins[1:], strict=True):
            later = t >= begin[:, None]
            for name, values in vars(states).items():
                found[name][later] = values[later]
        return States(**found)


def _check_joint(before: Motion, after: Motion, begun: Array, begins: Array) -> None:
    """Refuse parts that do not go on where the part before is cut, and cuts that are outside of it."""
    duration, cut = before.duration(), begins - begun
    outside = ~((cut >= 0) & (cut <= duration * (1 + 1e-12)))
    if outside.any():
        row = int(outside.argmax())
        whole = f"from {begun[row]:.6g} to {begun[row] + duration[row]:.6g} s"
        raise UsageError(f"plan {row} cannot be cut at {begins[row]:.6g} s: what is cut lasts {whole}")
    left, right = states_at_times(before, cut), states_at_times(after, np.zeros_like(cut))
    allowed = GAP + _rounding(before) + _rounding(after)
    for name, unit, one, other, most in zip(
        ("q", "dq", "ddq"), ("rad", "rad/s", "rad/s^2"), left, right, allowed, strict=True
    ):
        gap = np.abs(other - one).max(axis=1)
        if not (gap <= most).all():
            row = int(np.argmax(np.nan_to_num(gap - most, nan=np.inf)))
            text = f"{name} jumps by {gap[row]:.3g} {unit} at {begins[row]:.6g} s, expected at most {most[row]:.3g}"
            raise UsageError(f"plan {row} cannot be joined: {text}")


def _rounding(motion: Motion) -> Array:
    """Estimate what rounding of control points makes of positions, velocities and accelerations, shape (3, N)."""
    ends, largest = end_derivatives(motion.path.shape[1], motion.degree), motion.rate.max(axis=1)
    orders = np.array([np.ones_like(largest), ends.eta * largest, ends.beta * largest**2])
    return np.asarray(ROUNDING * np.abs(motion.path).max(axis=(1, 2)) * orders)
