"""Observations of scenes, on one core, in CPU time.

Scenes are those of a family with their own numbers of bodies; each is observed by every kind of observation.
"""

import argparse
from functools import partial
from typing import Any

import numpy as np
from common import arguments, cpu_of, median, progress, report, table

from cnpgen.addons.families.scene_generator import load_family, shipped_families
from cnpgen.machine.threads import one_thread
from cnpgen.scenes import (
    BasisPoints,
    CameraCloud,
    DistanceGrid,
    ObjectTokens,
    SurfaceCloud,
    observe,
    scene_bodies,
)

TARGETS = {"cloud": 10_000.0, "camera": 1_000.0}  # scenes/s
REPETITIONS = 5
KINDS = (
    SurfaceCloud(),
    CameraCloud(),
    DistanceGrid(),
    BasisPoints(),
    ObjectTokens(capacity=40),
)


def measure(family: str, count: int, seed: int) -> list[dict[str, Any]]:
    """Return the rates of all observations of scenes of a family."""
    random, drawer = np.random.default_rng(seed), load_family(family)
    bodies = scene_bodies([drawer.draw(random).obstacles for _ in range(count)])
    results = []
    for kind in KINDS:
        observe(bodies, kind)  # loads the compiled code
        times = [cpu_of(partial(observe, bodies, kind)) for _ in range(REPETITIONS)]
        rate = count / median(times)
        results.append(
            {
                "family": family,
                "kind": kind.name,
                "bodies": float((bodies.kinds >= 0).sum(axis=1).mean()),
                "scenes/s": rate,
            }
        )
    return results


def options(parser: argparse.ArgumentParser) -> None:
    """Add the options of this benchmark."""
    known = list(shipped_families())
    parser.add_argument(
        "--families",
        nargs="*",
        default=["tabletop", "cubby"],
        choices=known,
        help="families",
    )
    parser.add_argument("--count", type=int, default=500, help="scenes")
    parser.add_argument("--seed", type=int, default=1, help="seed of the scenes")


def main() -> None:
    """Run the benchmark."""
    chosen = arguments(__doc__, options)
    results = []
    with one_thread():
        for family in chosen.families:
            progress(family)
            results += measure(family, chosen.count, chosen.seed)
    head = (
        "family",
        "observation",
        "bodies",
        "scenes/s",
        "target",
    )
    rows = [
        (
            each["family"],
            each["kind"],
            f"{each['bodies']:.1f}",
            f"{each['scenes/s']:,.0f}",
            f"{TARGETS[each['kind']]:,.0f}" if each["kind"] in TARGETS else "",
        )
        for each in results
    ]
    report(
        {"observations": results},
        [table("observations of scenes", head, rows, left=2)],
        as_json=chosen.json,
    )


if __name__ == "__main__":
    main()
