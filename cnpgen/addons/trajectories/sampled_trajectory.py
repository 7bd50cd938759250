"""Trajectories sampled in time, as most planners return them, and their interpolation."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np

from cnpgen.addons.trajectories.samples import checked_samples
from cnpgen.arrays import Array
from cnpgen.errors import UsageError
from cnpgen.schema.arguments import numbers


@dataclass(frozen=True, eq=False)
class Trajectory:
    """Motion given by samples and interpolated as ROS's joint trajectory controllers do.

    The interpolation is linear for positions alone, cubic with velocities, and quintic
    with accelerations.

    Attributes:
        t: Times [s], shape (K,), increasing from 0.
        q: Joint positions [rad], shape (K, n).
        dq: Joint velocities [rad/s], shape (K, n), or None.
        ddq: Joint accelerations [rad/s^2], shape (K, n), or None.
        parameters: Values of the problem's parameters in SI units, shape (p,); None
            without parameters.
        phase: Phases at the samples, increasing from 0 to 1, for bounds that depend on
            the phase, shape (K,), or None.
        obstacle_poses: Poses and sizes of the problem's obstacles
            (``cnpgen.robots.solid``), shape (width,), in place of its own; None for
            these.

    Raises:
        UsageError: A shape is wrong, the times do not increase from 0, or a value is
            not finite.
    """

    t: Array
    q: Array
    dq: Array | None = None
    ddq: Array | None = None
    parameters: Array | None = None
    phase: Array | None = None
    obstacle_poses: Array | None = None

    def __post_init__(self) -> None:
        t, q, dq = checked_samples(self.t, self.q, self.dq)
        ddq = None
        if self.ddq is not None:
            if dq is None:
                raise UsageError(
                    "a trajectory with accelerations needs velocities, too",
                    concerns="ddq",
                )
            ddq = checked_samples(t, q, self.ddq)[2]
        phase = None if self.phase is None else numbers("phase", self.phase)
        if phase is not None:
            _check_phase(phase, len(t))
        arrays = {
            "t": t,
            "q": q,
            "dq": dq,
            "ddq": ddq,
            "parameters": _vector("parameters", self.parameters, "p"),
            "phase": phase,
            "obstacle_poses": _vector("obstacle_poses", self.obstacle_poses, "width"),
        }
        for name, values in arrays.items():
            object.__setattr__(self, name, values)  # lists become arrays
        if self.t[0] != 0:
            raise UsageError(
                f"a trajectory begins at t = 0, got {self.t[0]} s", concerns="t"
            )

    @property
    def duration(self) -> float:
        """Motion time [s]."""
        return float(self.t[-1])

    def phase_of(self) -> Callable[[Array], Array] | None:
        """Return the function from shares of the duration, shape (M,), to phases.

        None without phases.
        """
        if self.phase is None:
            return None
        # Pchip keeps phases monotonic between samples, which cubic splines do not.
        from scipy.interpolate import PchipInterpolator

        interpolator = PchipInterpolator(self.t / self.duration, self.phase)
        return lambda share: np.asarray(interpolator(share))

    def states(self, t: Array) -> tuple[Array, Array, Array]:
        """Evaluate the trajectory.

        Args:
            t: Times [s], shape (K,).

        Returns:
            Positions [rad], velocities [rad/s] and accelerations [rad/s^2], shape (K,
            n) each. Accelerations of linear spans are 0; they do not include jumps of
            the velocity.
        """
        t = self._clipped(t)
        q, dq, ddq = (np.asarray(self._piecewise(t, order)) for order in range(3))
        return q, dq, ddq

    def jerks(self, t: Array) -> Array:
        """Evaluate the jerks within spans [rad/s^3] at times [s] of shape (K,), shape (K, n)."""
        times = self._clipped(t)
        if self.dq is None:
            # Linear spans, of which SciPy has no third derivative.
            return np.zeros((len(times), self.q.shape[1]))
        return np.asarray(self._piecewise(times, 3))

    def _clipped(self, t: Array) -> Array:
        """Return times as an array, clipped to the motion."""
        times = numbers("t", t)
        increasing = times.ndim == 1 and len(times) > 0 and not np.isnan(times).any()
        if not increasing:
            raise UsageError(
                f"must be times, shape (K,), got {times!s:.100}", argument="t"
            )
        return np.clip(times, 0, self.duration)

    @cached_property
    def _piecewise(self) -> Any:
        """The piecewise polynomial, a function of (t, order of the derivative)."""
        from scipy.interpolate import BPoly

        parts = [part for part in (self.q, self.dq, self.ddq) if part is not None]
        return BPoly.from_derivatives(self.t, np.stack(parts, axis=1))


def _vector(name: str, values: Array | None, size: str) -> Array | None:
    """Return numbers of one axis, whose size has a name in errors."""
    if values is None:
        return None
    checked = numbers(name, values)
    if checked.ndim != 1:
        raise UsageError(
            f"must have shape ({size},), got {checked.shape}", argument=name
        )
    return checked


def _check_phase(phase: Array, count: int) -> None:
    """Check that phases increase from 0 to 1."""
    if phase.shape != (count,):
        raise UsageError(
            f"must have shape ({count},), one for each sample, got {phase.shape}",
            argument="phase",
        )
    if not (np.diff(phase) >= 0).all() or phase[0] != 0 or phase[-1] != 1:
        raise UsageError(
            f"must increase from 0 to 1, got {phase[0]:g} to {phase[-1]:g}",
            argument="phase",
        )
