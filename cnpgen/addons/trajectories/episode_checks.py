"""Checks of recorded episodes: what is proven from facts excludes an episode, everything else is for review.

A finding excludes only if it follows from the file alone, or if a limit of the vendor
for positions or velocities is exceeded by a lower bound of all curves, with the noise of
the arm's registry or a stated one. Rounding is a lower bound of a sensor's noise,
nominal times hide the clock, and contacts, payloads and hand guiding are unknown:
accelerations are for review at most. Actions are targets, and only checked for numbers.
"""

from collections.abc import Iterator
from dataclasses import dataclass, field, replace
from enum import StrEnum
from itertools import islice

import numpy as np

from cnpgen.addons.trajectories.arm_registry import (
    QUANTITIES,
    VENDOR,
    ArmLimit,
    RecordedArm,
)
from cnpgen.addons.trajectories.episode_files import Episode
from cnpgen.addons.trajectories.lower_bounds import (
    LAGS,
    MeanDerivatives,
    first_derivatives,
    second_derivatives,
    swing_velocities,
    value_intervals,
)
from cnpgen.addons.trajectories.sample_errors import rounding, time_rounding
from cnpgen.addons.trajectories.velocity_by_position import span_limits
from cnpgen.arrays import Array
from cnpgen.documents import JsonObject
from cnpgen.errors import counted

NOMINAL_LAGS = (
    2  # distances in frames: a recorder that falls behind distorts longer ones
)
NOMINAL_JITTER = 0.5  # of a period, of times without a clock
MAX_STALL_S = 0.25  # by which a frame of such a recorder may be late: findings that it explains are for review
STILL_S = 1.0  # time of equal states while the actions change, that is reviewed
MIN_EXCESS = 1e-6  # relative to a limit


class Level(StrEnum):
    """Outcome of the checks of an episode."""

    PASS = "PASS"  # noqa: S105 - no password
    REVIEW = "REVIEW"
    EXCLUDE = "EXCLUDE"

    __repr__ = str.__repr__


@dataclass(frozen=True)
class EpisodeFinding:
    """Finding about one episode.

    Attributes:
        level: Its consequence.
        check: Name of the check.
        joint: Name of the value; empty for all.
        time: Time [s], or None.
        statement: What is proven.
        basis: Facts that it rests on.
    """

    level: Level
    check: str
    joint: str
    time: float | None
    statement: str
    basis: str = ""

    def __str__(self) -> str:
        place = f"{self.joint}: " if self.joint else ""
        basis = f" ({self.basis})" if self.basis else ""
        return f"{place}{self.statement}{basis}"


@dataclass(frozen=True)
class EpisodeReport:
    """Findings about one episode, the most serious first, and checks that could not run with their reasons."""

    name: str
    findings: tuple[EpisodeFinding, ...]
    not_run: dict[str, str] = field(default_factory=dict)

    @property
    def level(self) -> Level:
        """The most serious level; PASS without findings."""
        return self.findings[0].level if self.findings else Level.PASS

    def to_dict(self) -> JsonObject:
        """Return the report for JSON."""
        return {
            "episode": self.name,
            "result": str(self.level),
            "findings": [
                {**vars(finding), "level": str(finding.level)}
                for finding in self.findings
            ],
            "not_run": self.not_run,
        }


@dataclass(frozen=True, eq=False)
class Scale:
    """Conversion of the recorded values of an arm's joints to radians.

    Attributes:
        columns: Column of each joint, shape (n,).
        factor: Radians per unit, shape (n,).
        has_zero: Whether 0 is the zero of the joint, so that position limits apply.
    """

    columns: tuple[int, ...]
    factor: Array
    has_zero: bool = True


def check_episode(
    episode: Episode,
    arm: RecordedArm | None,
    scale: Scale | None,
    *,
    noise: float | None = None,
    jitter: float | None = None,
) -> EpisodeReport:
    """Check one episode.

    Args:
        episode: The episode.
        arm: Its arm, or None.
        scale: Conversion of its joints to radians; None if it is unknown.
        noise: Largest error of the positions [rad]; by default that of the registry.
        jitter: Largest error of the times [s].
    """
    not_run: dict[str, str] = {}
    findings = [*_file_findings(episode)]
    if episode.is_nominal:
        not_run["clock"] = "not recorded: the times are frame index / rate"
    if arm is None:
        not_run["limits"] = "the arm is not known"
    elif scale is None:
        not_run["limits"] = "the unit of the joints is not known"
    elif not any(f.level == Level.EXCLUDE for f in findings) and len(episode.t) > 2:
        findings += _limit_findings(episode, arm, scale, (noise, jitter), not_run)
    order = (Level.EXCLUDE, Level.REVIEW)
    return EpisodeReport(
        episode.name,
        tuple(sorted(findings, key=lambda finding: order.index(finding.level))),
        not_run,
    )


def _file_findings(episode: Episode) -> Iterator[EpisodeFinding]:
    """Yield what the file alone proves, without units."""
    tables = {"state": episode.state, "time": episode.t[:, None]}
    if episode.action is not None:
        tables["action"] = episode.action
    # Numbers come first: later checks compare and subtract them.
    for name, values in tables.items():
        bad = np.argwhere(~np.isfinite(values))
        if len(bad):
            frame, column = bad[0].tolist()
            joint = episode.names[column] if name == "state" else name
            text = (
                f"{counted(len(bad), 'value')} not finite, the first in frame {frame}"
            )
            yield EpisodeFinding(Level.EXCLUDE, "numbers", joint, None, text)
            return
    steps = np.diff(episode.t)
    if len(steps) and steps.min() <= 0:
        k = int(steps.argmin())
        text = f"the time does not increase after frame {k}"
        yield EpisodeFinding(Level.EXCLUDE, "times", "", float(episode.t[k]), text)
    gaps = np.flatnonzero(np.diff(episode.frame) != 1)
    if len(gaps):
        first, after = episode.frame[gaps[0] : gaps[0] + 2].tolist()
        text = f"frames are missing: {after} follows {first}"
        yield EpisodeFinding(
            Level.REVIEW, "frames", "", float(episode.t[gaps[0]]), text
        )
    if episode.length is not None and episode.length != len(episode.t):
        text = f"{len(episode.t)} frames, the description states {episode.length}"
        yield EpisodeFinding(Level.REVIEW, "frames", "", None, text)
    yield from _still_findings(episode)


def _still_findings(episode: Episode) -> Iterator[EpisodeFinding]:
    """Yield a time in which all states are equal while the actions change."""
    if episode.action is None or len(episode.t) < 3:
        return
    # Edges of runs: pairs of begins and ends of equal states.
    equal = (np.diff(episode.state, axis=0) == 0).all(axis=1)
    edges = np.flatnonzero(np.diff(np.concatenate([[0], equal.astype(int), [0]])))
    for start, end in edges.reshape(-1, 2).tolist():
        moved = np.ptp(episode.action[start : end + 1], axis=0) > 0
        length = float(episode.t[end] - episode.t[start])
        if length >= STILL_S and moved.any():
            text = f"all states are equal for {length:.2g} s while the actions change"
            yield EpisodeFinding(
                Level.REVIEW, "frozen", "", float(episode.t[start]), text
            )
            return


def _limit_findings(
    episode: Episode,
    arm: RecordedArm,
    scale: Scale,
    errors: tuple[float | None, float | None],
    not_run: dict[str, str],
) -> Iterator[EpisodeFinding]:
    """Yield the limits that no curve through the states meets."""
    q = episode.state[:, scale.columns] * scale.factor
    error, known, text = _noise(q, arm, errors[0])
    jitter, largest = _jitters(episode, errors[1])
    lags = NOMINAL_LAGS if episode.is_nominal else None
    samples = _Samples(episode.t, q, error, lags)
    for quantity, unit in QUANTITIES.items():
        limit = arm.limits.get(quantity)
        if limit is None:
            not_run[quantity] = f"no source states a limit of {arm.name}"
            continue
        if quantity == "position" and not scale.has_zero:
            not_run[quantity] = "the zero of the joints is not known"
            continue
        # Only limits of the vendor exclude, with a known noise, and not of
        # accelerations.
        proven = known and limit.basis == VENDOR and quantity != "acceleration"
        worst, proven = _excess(
            samples, limit, quantity, (jitter, largest), proven=proven
        )
        if worst is None:
            continue
        joint, time, value, bound = worst
        word = "at least" if value >= bound else "at most"
        where = " at these positions" if limit.by_position is not None else ""
        yield EpisodeFinding(
            Level.EXCLUDE if proven else Level.REVIEW,
            quantity,
            arm.joints[joint],
            time,
            f"{word} {value:.3g} {unit} at {time:.2f} s, limit {bound:.3g}{where}",
            f"limit: {limit.basis}, {limit.source}; {text}; jitter {jitter:.2g} s",
        )


@dataclass(frozen=True, eq=False)
class _Samples:
    """Positions of joints [rad], shape (K, n), at times [s], their error, and the number of lags that are used."""

    t: Array
    q: Array
    error: float
    lags: int | None

    def compared(
        self, quantity: str, limit: ArmLimit, jitter: float
    ) -> Iterator[tuple[MeanDerivatives, Array, Array]]:
        """Yield bounds of a quantity of every curve, with the lower and upper limits that hold for each."""
        t = self.t
        q = self.q
        e = self.error
        if quantity == "position":
            found = value_intervals(t, q, e)
        elif quantity == "velocity":
            found = first_derivatives(t, q, e, jitter)
        else:
            found = second_derivatives(t, q, e, jitter)
        for lag, bounds in zip(LAGS, islice(found, self.lags), strict=False):
            lower = limit.lower
            upper = limit.upper
            if limit.by_position is not None:
                lower, upper = span_limits(q, lag, e, limit.by_position, upper)
            yield bounds, lower, upper
        if quantity == "velocity" and jitter:
            # Two spans of one frame are within two frames.
            swings = swing_velocities(t, q, e, jitter)
            for bounds in islice(swings, self.lags and self.lags // 2):
                yield bounds, limit.lower, limit.upper


def _noise(q: Array, arm: RecordedArm, noise: float | None) -> tuple[float, bool, str]:
    """Return the error of positions [rad], whether it is known, and its text."""
    # The visible rounding is a lower bound of the noise.
    half = rounding(q)[1]
    if noise is not None:
        return max(noise, half), True, f"noise {max(noise, half):.2g} rad, stated"
    if arm.noise is not None:
        error = max(arm.noise, half)
        return error, True, f"noise {error:.2g} rad: {arm.noise_source}"
    return half, False, f"noise {half:.2g} rad by rounding alone"


def _jitters(episode: Episode, stated: float | None) -> tuple[float, float]:
    """Return the error of the times [s], and that with stalls of the recorder."""
    if stated is not None:
        return stated, stated
    if not episode.is_nominal:
        jitter = time_rounding(episode.t)[1]
        return jitter, jitter
    # Without a clock, half a period is assumed as error of the times.
    jitter = NOMINAL_JITTER * float(np.median(np.diff(episode.t)))
    # Half of a stall on either side of two frames.
    return jitter, max(jitter, MAX_STALL_S / 2)


def _excess(
    samples: _Samples,
    limit: ArmLimit,
    quantity: str,
    jitters: tuple[float, float],
    *,
    proven: bool,
) -> tuple[tuple[int, float, float, float] | None, bool]:
    """Return the largest excess, as ``_worst``, and whether it stays proven; ``jitters`` are without and with stalls [s]."""
    jitter, largest = jitters
    worst = _worst(limit, samples.compared(quantity, limit, jitter))
    if quantity != "velocity":
        return worst, proven
    if worst is None:
        # Over many frames, a recorder that falls behind explains the excess, too.
        far = replace(samples, lags=None)
        return _worst(limit, far.compared(quantity, limit, jitter)), False
    # A velocity that a stall of the recorder explains is for review.
    if proven and largest > jitter:
        of_stall = _worst(limit, samples.compared(quantity, limit, largest))
        return of_stall or worst, of_stall is not None
    return worst, proven


def _worst(
    limit: ArmLimit, found: Iterator[tuple[MeanDerivatives, Array, Array]]
) -> tuple[int, float, float, float] | None:
    """Return joint, time, bound and limit of the largest relative excess, or None."""
    best: tuple[float, int, float, float, float] | None = None
    # Excess relative to the range makes joints of different ranges comparable.
    scale = np.maximum(limit.upper - limit.lower, 1e-9)
    for bounds, lower, upper in found:
        for values, ends, sign in ((bounds.low, upper, 1), (bounds.high, lower, -1)):
            excess = sign * (values - ends) / scale
            # Bounds that say nothing are infinite.
            excess = np.where(np.isfinite(excess), excess, -np.inf)
            k, joint = np.unravel_index(int(excess.argmax()), excess.shape)
            size = float(excess[k, joint])
            if size > (best[0] if best else MIN_EXCESS):
                time = float(bounds.t[k])
                value = float(values[k, joint])
                end = float(np.broadcast_to(ends, excess.shape)[k, joint])
                best = size, int(joint), time, value, end
    return None if best is None else best[1:]
