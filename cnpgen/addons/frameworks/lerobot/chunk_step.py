"""The step that executes chunks in the processors of LeRobot.

LeRobot's real-time chunking calls ``postprocessor(actions)`` on a whole chunk, and its
queue then drops the samples that are due before the result. So the step returns
commands at the times of all samples: first those of the running motion up to the join,
then those of the joined motion, which rests at the last one.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from cnpgen.addons.online.chunk_checks import (
    MAX_DURATION,
    MIN_CHUNK_SAMPLES,
    ChunkOptions,
)
from cnpgen.addons.online.chunk_executor import ChunkExecutor
from cnpgen.addons.online.set_points import ChunkSetPoint
from cnpgen.addons.online.switches import ChunkJoin, SwitchOutcome
from cnpgen.arrays import Array
from cnpgen.errors import UsageError, either, requires_extra
from cnpgen.problems.problem_record import as_record
from cnpgen.schema.arguments import number, numbers

with requires_extra("lerobot", "lerobot"):
    from lerobot.processor import ProcessorStep, ProcessorStepRegistry, TransitionKey

STATE = "observation.state"
RADIANS = {"rad": 1.0, "deg": float(np.pi / 180)}
CLOCK_STEP_S = 1e-6
PLACE = (
    "policies without real-time chunking (select_action) and the asynchronous server"
    " (PolicyServer._predict_action_chunk, its loop over steps) postprocess single"
    " actions. Chunks exist where predict_action_chunk returns them: call"
    " postprocessor(policy.predict_action_chunk(observation)), as real-time chunking does"
)


class ChunkStep(ProcessorStep):  # type: ignore[misc] # LeRobot has no types
    """A step for both processors of a policy: it notes observations, and executes chunks.

    Put the same object first into the preprocessor, before normalization, and last into
    the postprocessor. Returned chunks keep their shape (1, T, D) and rate. A refused
    chunk is replaced by the running motion, and a stop by the motion to rest; see
    ``last_join``. ``reset`` of the pipelines states that the arm rests; the next
    observation is then the first.

    Only positions at the rate of the chunk are claimed. Speeds above the chunk's own
    need ``ChunkExecutor``: real-time chunking guides the next inference by the policy's
    own timing.

    Args:
        problem: Name or path of a problem: it has all limits.
        unit: Unit of the joints in observations and actions, "rad" or "deg".
        zero: Positions of the joints of the problem at the value 0 [rad], shape (n,).
        clock: Monotonic clock [s].
        options: ``rate``, ``length``, ``join``, ``max_distance``, ``tracking_error`` and
            ``stale_after`` of ``ChunkExecutor``. The first is the rate of the robot's
            commands. Tracking is compared at the observation.

    Attributes:
        last_join: Result of the last chunk; None before the first.

    Raises:
        UsageError: An option is wrong, or a chunk is too short to rest at its end after
            ``stale_after`` and ``join``.
    """

    def __init__(
        self,
        problem: str,
        *,
        unit: str = "rad",
        zero: ArrayLike | None = None,
        clock: Callable[[], float] = time.monotonic,
        **options: Any,
    ) -> None:
        if unit not in RADIANS:
            raise UsageError(
                f"must be {either(tuple(RADIANS))}, got {unit!r}", argument="unit"
            )
        if "speed" in options:
            raise UsageError(
                "chunks keep their own timing here; ChunkExecutor has other speeds",
                argument="speed",
            )
        self._config = {"problem": str(problem), "unit": unit, **options}
        rest = ChunkOptions(stop_after=_time_to_rest(**options))
        self._executor = ChunkExecutor(problem, **options, options=rest)
        n = len(as_record(problem).joint_names)
        self._zero = np.zeros(n) if zero is None else numbers("zero", zero)
        if self._zero.shape != (n,) or not np.isfinite(self._zero).all():
            raise UsageError(
                f"must be finite and have shape ({n},), got {zero!r:.100}",
                argument="zero",
            )
        self._factor = RADIANS[unit]
        self._clock = clock
        self._times = np.arange(options["length"]) / options["rate"]
        self._stale_after = float(options["stale_after"])
        self._is_new = True  # until the first observation of an episode
        self._read: float | None = None  # last time of the executor [s]
        self._observation: _Observation | None = None
        self.last_join: ChunkJoin | None = None

    @property
    def stopped(self) -> SwitchOutcome | None:
        """The reason why the arm was stopped and chunks are refused until ``reset``; None otherwise."""
        return None if self._is_new else self._executor.stopped

    def reset(self) -> None:
        """Begin an episode: the arm rests, and its next observation is the first."""
        self._is_new = True

    def get_config(self) -> dict[str, Any]:
        """Return the arguments without the clock, for JSON."""
        return self._config | {"zero": self._zero.tolist()}

    def transform_features(self, features: Any) -> Any:
        """Return the features, which do not change."""
        return features

    def __call__(self, transition: Any) -> Any:
        """Note an observation, or replace a chunk of shape (1, T, D) by the commands of a valid motion.

        Raises:
            UsageError: A shape is wrong, no observation precedes the chunk, or the arm
                moves at the first observation of an episode.
        """
        observation = transition.get(TransitionKey.OBSERVATION)
        action = transition.get(TransitionKey.ACTION)
        if observation is not None:
            self._observe(observation)
        if action is None:
            return transition
        return {**transition, TransitionKey.ACTION: self._commands(action)}

    def _observe(self, observation: dict[str, Any]) -> None:
        """Note the state of an observation, and its difference to the set point."""
        if STATE not in observation:
            raise UsageError(f"an observation has no {STATE!r}")
        values = _numpy(observation[STATE])
        n = len(self._zero)
        now = self._clock()
        if values.size != values.shape[-1] or values.size < n:
            text = f"must have shape (1, D) with at least {n} joints"
            raise UsageError(f"{STATE} {text}, got {values.shape}")
        values = values.reshape(-1)
        q = self._radians(values[:n])
        dq = np.zeros(n)
        last = self._observation
        if self._is_new:
            self._begin(q, now)
        elif last is not None and now > last.time:
            # The mean velocity is a lower bound of the largest one.
            dq = (q - last.q) / (now - last.time)
        error = q - self._advance(now).q
        self._observation = _Observation(now, q, dq, error, values[n:])

    def _begin(self, q: Array, now: float) -> None:
        """Reset the executor to an arm at rest; a motion that still runs is an error."""
        if self._read is not None:
            # The observation is the first one after the reset, and not as old as it.
            self._advance(max(now - CLOCK_STEP_S, self._read))
            if self._executor.stopped is None:
                self._executor.stop()
        self._executor.reset((q, np.zeros_like(q)))
        self._is_new = False

    def _advance(self, now: float) -> ChunkSetPoint:
        """Return the set point at a time [s].

        Between chunks the robot's queue is served and not the executor, so times
        between are read here: the executor stops if its clock steps.
        """
        before = now if self._read is None else self._read
        self._read = now
        for between in np.arange(before, now, self._stale_after / 2)[1:].tolist():
            self._executor.set_point(between)
        return self._executor.set_point(now)

    def _commands(self, action: Any) -> Any:
        """Execute a chunk, and return the commands at the times of its samples, in its unit and type."""
        if action.ndim != 3 or len(action) != 1:
            text = f"expected a chunk of shape (1, T, D), got {tuple(action.shape)}"
            raise UsageError(f"{text}: {PLACE}")
        seen = self._observation
        if seen is None or self._is_new:
            raise UsageError(
                "no observation precedes the chunk: put the same step into the preprocessor"
            )
        chunk = _numpy(action[0])
        n = len(self._zero)
        if not n <= chunk.shape[1] <= n + len(seen.others):
            text = f"{n} joints and at most the {len(seen.others)} other columns"
            raise UsageError(
                f"a chunk must have {text} of {STATE}, got {chunk.shape[1]}"
            )
        chunk[:, :n] = self._radians(chunk[:, :n])
        now = self._clock()
        # The difference at the observation is added to the present set point: no later
        # state is measured.
        measured = self._advance(now).q + seen.error, seen.dq
        self.last_join = self._executor.step(now, chunk, seen.time, measured)
        # Earlier states of a stale chunk are forgotten, and its commands dropped.
        times = np.maximum(seen.time + self._times, now - self._stale_after)
        for row, at in zip(chunk, times.tolist(), strict=True):
            point = self._executor.state_at(at)
            others = point.others if point.others.size else seen.others
            # Inverse of the conversion to radians.
            row[:n] = (point.q - self._zero) / self._factor
            row[n:] = others[: len(row) - n]
        return action.new_tensor(chunk[None])

    def _radians(self, values: Array) -> Array:
        return np.asarray(self._zero + self._factor * values)


# Registered after its definition: as a decorator, a stand-in for LeRobot would replace
# the class on the documentation site.
ProcessorStepRegistry.register("cnpgen_chunks")(ChunkStep)


@dataclass(frozen=True, eq=False)
class _Observation:
    """State of an observation [s, rad, rad/s], its difference to the set point [rad], and other columns."""

    time: float
    q: Array
    dq: Array
    error: Array
    others: Array


def _numpy(values: Any) -> Array:
    return np.array(values.detach().cpu().double().numpy())


def _time_to_rest(
    *, rate: float, length: int, join: float, stale_after: float, **_: Any
) -> float | None:
    """Return the time after the latest join in which a motion rests at the last sample [s].

    The join is at the next sample. Wrong values are left to the executor.
    """
    values = [
        number(name, value)
        for name, value in (
            ("rate", rate),
            ("length", length),
            ("join", join),
            ("stale_after", stale_after),
        )
    ]
    if min(values) <= 0:
        return None
    # Two samples less: the join is at the next sample, and K samples have K - 1 spans.
    left = (values[1] - 2) / values[0] - values[2] - values[3]
    least = MAX_DURATION * (MIN_CHUNK_SAMPLES - 1) / values[0]
    if left < least:
        raise UsageError(
            f"{length} samples leave {left:.3g} s to rest after stale_after and join,"
            f" expected at least {least:.3g} s",
            argument="length",
        )
    return left
