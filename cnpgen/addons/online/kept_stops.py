"""Stops of the motion in execution that are computed before they are needed."""

from __future__ import annotations

import threading
from collections.abc import Iterator
from contextlib import contextmanager

import numpy as np

from cnpgen.addons.online.motion_check import MotionChecker
from cnpgen.addons.online.set_points import SampledMotion
from cnpgen.addons.online.stops import earliest_stop

KEPT_STOP_STEP_S = 0.1  # between the times at which kept stops begin


class KeptStops:
    """Stops of one motion at a time, computed by a thread that ends with its work.

    A kept stop follows the motion until the stop begins, so it can be used at all times
    before.
    """

    def __init__(self, checker: MotionChecker, *, measured: bool) -> None:
        self._checker = checker
        self._measured = measured
        self._lock = threading.Lock()
        self._motion: SampledMotion | None = None
        self._stops: list[tuple[float, SampledMotion]] = []
        self._may_compute = threading.Event()
        self._may_compute.set()

    @contextmanager
    def paused(self) -> Iterator[None]:
        """Leave the processor to the block."""
        self._may_compute.clear()
        try:
            yield
        finally:
            self._may_compute.set()

    def follow(self, motion: SampledMotion | None) -> None:
        """Compute the stops of another motion from its start on, and drop those of the last one; None ends it."""
        with self._lock:
            self._motion = motion
            self._stops = []
        if motion is not None:
            threading.Thread(
                target=self._keep, args=(motion,), name="cnpgen-stops", daemon=True
            ).start()

    def after(
        self, motion: SampledMotion, time: float
    ) -> tuple[float, SampledMotion] | None:
        """Return the kept stop of a motion that begins first after a time [s], and its begin; None without one."""
        with self._lock:
            stops = self._stops if motion is self._motion else []
            # A stop may be used at all times before it begins.
            return next((kept for kept in stops if kept[0] >= time), None)

    def _keep(self, motion: SampledMotion) -> None:
        """Compute stops in the order of their times until another motion is followed."""
        for begin in np.arange(
            motion.start, motion.end_time, KEPT_STOP_STEP_S
        ).tolist():
            # A stop that is needed now has priority (``paused``).
            self._may_compute.wait()
            stop = earliest_stop(self._checker, motion, begin, measured=self._measured)
            with self._lock:
                # Another motion was followed meanwhile: its own thread computes now.
                if self._motion is not motion:
                    return
                self._stops.append((begin, stop))
