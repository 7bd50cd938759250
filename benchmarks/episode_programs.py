"""Faults that linear programs prove to exceed a limit, for benchmarks/episodes.py.

A program decides whether a curve leads through all samples near a fault, within their
errors, below a limit. Nothing of it is shared with the bounds of the package. Faults
have random sizes: those that no curve below the limit explains must be found.
"""

from collections import Counter
from dataclasses import dataclass
from typing import Any

import numpy as np
from scipy.optimize import linprog
from scipy.sparse import csr_array, eye_array, hstack, vstack

from cnpgen.addons.trajectories.arm_registry import RecordedArm, find_arm
from cnpgen.addons.trajectories.episode_checks import Scale, check_episode
from cnpgen.addons.trajectories.episode_files import Episode

Array = np.ndarray[Any, np.dtype[np.float64]]

FPS, FRAMES = 30, 300
CLOCK_NOISE_RAD = 1e-3  # stated, of recordings with a clock
BEFORE, AFTER = 20, 30  # frames around a fault that a program has
SIZES_RAD = 0.02, 2.5
PARTS = 4  # of a span between samples, with constant accelerations
FAULTS = ("outlier", "jump", "ramp", "bump")


@dataclass(frozen=True, eq=False)
class Samples:
    """Positions of a joint y [rad] at times t [s], shape (K,), with the errors of both."""

    t: Array
    y: Array
    error: float
    jitter: float


def exceeds_velocity(samples: Samples, limit: float) -> bool:
    """Return whether no curve below a velocity [rad/s] leads through samples.

    Unknowns are the positions p and the times tau of all samples within their errors:
    |p_k+1 - p_k| <= limit (tau_k+1 - tau_k).
    """
    count = len(samples.t)
    step = eye_array(count - 1, count, k=1) - eye_array(count - 1, count)
    rows = [
        hstack([step, -limit * step]),
        hstack([-step, -limit * step]),
        hstack([0 * step, -step]),
    ]
    values = ((samples.y, samples.error), (samples.t, samples.jitter))
    bounds = [
        pair
        for middle, e in values
        for pair in zip(middle - e, middle + e, strict=True)
    ]
    found = linprog(
        np.zeros(2 * count),
        A_ub=vstack(rows).tocsr(),
        b_ub=np.zeros(3 * (count - 1)),
        bounds=bounds,
    )
    assert found.status in {0, 2}, found.message
    return bool(found.status == 2)


def exceeds_acceleration(samples: Samples, limit: float) -> bool:
    """Return whether no curve with accelerations below a limit [rad/s^2] leads through samples at exact times.

    Accelerations are constant in parts of every span, which excludes more curves than
    the limit does: the parts and a margin of the limit keep this small.
    """
    t, shares = samples.t - samples.t[0], np.arange(PARTS) / PARTS
    grid = np.append((t[:-1, None] + np.diff(t)[:, None] * shares).ravel(), t[-1])
    rest = np.maximum(t[:, None] - grid, 0.0) ** 2 / 2
    # Position at a sample: p_0 + v_0 t + the integral of the accelerations before it,
    # in units of the limit; positions are in units of their error.
    parts = limit * (rest[:, :-1] - rest[:, 1:])
    rows = csr_array(np.column_stack([np.ones_like(t), t, parts]) / samples.error)
    y = samples.y / samples.error
    found = linprog(
        np.zeros(rows.shape[1]),
        A_ub=vstack([rows, -rows]).tocsr(),
        b_ub=np.concatenate([y + 1, 1 - y]),
        bounds=[(None, None)] * 2 + [(-1, 1)] * (len(grid) - 1),
    )
    # A program that ends without a result proves nothing.
    return bool(found.status == 2)


def with_fault(q: Array, kind: str, place: tuple[int, int], random: Any) -> Array:
    """Return positions with a fault of random size at a frame of a joint."""
    bad, (k, joint), frames = q.copy(), place, np.arange(len(q))
    size = np.exp(random.uniform(*np.log(SIZES_RAD))) * random.choice([-1, 1])
    share = np.clip((frames - k) / random.integers(2, 16), 0, 1)
    shapes = {
        "outlier": frames == k,
        "jump": frames >= k,
        "ramp": share,
        "bump": np.sin(np.pi * share) ** 2,
    }
    bad[:, joint] += size * shapes[kind]
    return bad


def found_faults(count: int, margin: float, motion: Any) -> dict[str, Counter[str]]:
    """Count the faults that exceed a limit by a margin by a program, and the findings about them."""
    results: dict[str, Counter[str]] = {}
    random = np.random.default_rng(12)
    for index in range(count):
        has_clock = bool(index % 2)
        arm = find_arm("panda" if has_clock else "so101")
        n, t = len(arm.joints), np.arange(FRAMES) / FPS
        if has_clock:
            t = t + random.uniform(-2e-3, 2e-3, FRAMES)
        place = int(random.integers(BEFORE, FRAMES - AFTER)), int(random.integers(n))
        kind = FAULTS[index // 2 % len(FAULTS)]
        bad = with_fault(motion(random, n, t, has_clock), kind, place, random)
        for quantity, finding in _compared(arm, t, bad, place, margin):
            clock = "clock" if has_clock else "nominal times"
            name = f"{quantity}, {clock}, {kind}"
            results.setdefault(name, Counter())[finding] += 1
    return dict(sorted(results.items()))


def _compared(
    arm: RecordedArm, t: Array, q: Array, place: tuple[int, int], margin: float
) -> list[tuple[str, str]]:
    """Return the quantities that a program proves to exceed their limits, each with the finding about it."""
    has_clock, (k, joint) = arm.name == "panda", place
    noise = CLOCK_NOISE_RAD if has_clock else None
    error = noise or float(arm.noise or 0)
    n, near = len(arm.joints), slice(k - BEFORE, k + AFTER)
    jitter = 0.0 if has_clock else 0.5 / FPS
    samples = Samples(t[near], q[near, joint], error, jitter)
    frame = np.arange(len(t))
    episode = Episode("", t, q, None, arm.joints, frame, len(t))
    report = check_episode(
        episode,
        arm,
        Scale(tuple(range(n)), np.ones(n), has_zero=False),
        noise=noise,
        jitter=0.0 if has_clock else None,
    )
    findings = {each.check: str(each.level) for each in report.findings}
    programs = {"velocity": exceeds_velocity}
    if has_clock:
        programs["acceleration"] = exceeds_acceleration
    return [
        (quantity, findings.get(quantity, "missed"))
        for quantity, exceeds in programs.items()
        if exceeds(samples, margin * float(arm.limits[quantity].upper[joint]))
    ]
