"""Checks of recorded episodes: healthy ones that are excluded, planted faults that are found, and CPU time.

    python benchmarks/episodes.py [--episodes 1000] [--programs 2000] [--json]

Episodes of an SO-101 have 10 s at 30 Hz with nominal times, smooth motions of at most
1.5 rad/s, 4,096 steps a turn and backlash of half a degree on either side. Every third
one has a fault. Faults of random sizes in further episodes count if a linear program
proves that a limit is exceeded by 1 % (``episode_programs``).
"""

import argparse
import time
from collections import Counter
from typing import Any

import numpy as np
from common import arguments, progress, report, table
from episode_programs import CLOCK_NOISE_RAD, found_faults

from cnpgen.addons.trajectories.arm_registry import find_arm
from cnpgen.addons.trajectories.episode_checks import Level, Scale, check_episode
from cnpgen.addons.trajectories.episode_files import Episode

Array = np.ndarray[Any, np.dtype[np.float64]]

FPS, SECONDS = 30, 10.0
STEP_RAD, BACKLASH_RAD = 2 * np.pi / 4096, np.radians(0.5)
MARGIN = 1.01  # of limits, for programs: their tolerance, and parts of spans
FAULTS = ("outlier", "jump", "degrees", "joints swapped", "no number")


def motion(
    random: np.random.Generator,
    joints: int,
    t: Array | None = None,
    is_smooth: bool = False,
) -> Array:
    """Return measured positions at the frames [rad], shape (K, n), smooth ones with noise in place of steps."""
    t = np.arange(int(SECONDS * FPS)) / FPS if t is None else t
    rates = random.uniform(0.5, 2.0, joints)
    q = 1.05 / rates * np.sin(rates * t[:, None] + random.uniform(0, 6, joints))
    if is_smooth:
        return np.asarray(q + CLOCK_NOISE_RAD * random.uniform(-1, 1, q.shape))
    play = q + random.uniform(-BACKLASH_RAD, BACKLASH_RAD, q.shape)
    return np.asarray(np.round(play / STEP_RAD) * STEP_RAD)


def spoil(q: Array, fault: str, random: np.random.Generator) -> Array:
    """Return positions with a fault."""
    bad, k, joint = q.copy(), int(random.integers(20, len(q) - 20)), 1
    if fault == "outlier":
        bad[k, joint] += 2.0
    elif fault == "jump":
        bad[k:, joint] += 2.0
    elif fault == "degrees":
        bad[k:] = np.degrees(bad[k:])
    elif fault == "joints swapped":
        bad[:, 0] += 2.0  # joints with different positions
        bad[k:, :2] = bad[k:, 1::-1]
    else:
        bad[k, joint] = np.nan
    return bad


def measure(count: int) -> dict[str, Any]:
    """Check episodes, and count the results of each kind."""
    arm, random = find_arm("so101"), np.random.default_rng(11)
    n = len(arm.joints)
    scale = Scale(tuple(range(n)), np.ones(n))
    results: dict[str, Counter[str]] = {}
    seconds = 0.0
    for index in range(count):
        fault = FAULTS[index // 3 % len(FAULTS)] if index % 3 == 0 else "none"
        q = motion(random, n)
        q = q if fault == "none" else spoil(q, fault, random)
        frame = np.arange(len(q))
        episode = Episode(str(index), frame / FPS, q, None, arm.joints, frame, len(q))
        start = time.process_time()
        level = check_episode(episode, arm, scale).level
        seconds += time.process_time() - start
        results.setdefault(fault, Counter())[str(level)] += 1
        if index % 1000 == 0:
            progress(f"episode {index:,}")
    return {"results": results, "CPU of 1,000 episodes [s]": seconds / count * 1e3}


def _add(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--episodes", type=int, default=1000, help="number of episodes")
    text = "number of episodes that linear programs compare"
    parser.add_argument("--programs", type=int, default=2000, help=text)


def main() -> None:
    """Measure and print a table or JSON."""
    options = arguments(__doc__, _add)
    found = measure(options.episodes)
    rows = [
        (fault, *(f"{counts[str(level)]:,}" for level in Level))
        for fault, counts in found["results"].items()
    ]
    cpu = found["CPU of 1,000 episodes [s]"]
    faults = found_faults(options.programs, MARGIN, motion)
    found["faults by programs"] = faults
    missed = sum(counts["missed"] for counts in faults.values())
    total = sum(counts.total() for counts in faults.values())
    columns = ("missed", *list(map(str, Level))[1:])
    proven = [
        (name, *(f"{counts[column]:,}" for column in columns))
        for name, counts in faults.items()
    ]
    share = f"found: {total - missed:,} of {total:,} ({(total - missed) / total:.2%})"
    text = f"CPU of 1,000 episodes of {SECONDS:g} s at {FPS} Hz: {cpu:.1f} s"
    report(
        found,
        [
            table("episodes", ("fault", *map(str, Level)), rows),
            text,
            table("faults by linear programs", ("", *columns), proven),
            share,
        ],
        as_json=options.json,
    )


if __name__ == "__main__":
    main()
