"""Execution of action chunks in closed loop: joins, validity, jumps, CPU time, faults, a lagging arm, and baselines.

    python benchmarks/chunks.py [--chunks 200] [--arms panda-3kg so101] [--json]

A policy observes the arm every 0.5 s and returns 50 samples at 30 Hz of a reference
motion, from the point nearest to the arm on, with noise of 5e-4 rad and an offset of up
to 0.02 rad of its own. References are valid plans between random states, slowed. Every
accepted motion is judged again by the full verdict. Times are CPU times of one thread.
"""

import argparse
import tempfile
import time
from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from chunk_baselines import compare
from chunk_loop import (
    NOISE_RAD,
    RATE,
    TICK_S,
    Loop,
    Plant,
    Policy,
    executor_of,
    problem_of,
    references,
    spoil,
)
from common import arguments, median, progress, report, table, verdict

import cnpgen
from cnpgen.addons.online.chunk_executor import ChunkExecutor
from cnpgen.addons.online.set_points import SetPoint
from cnpgen.addons.online.switches import ChunkJoin
from cnpgen.plans.evaluate import evaluate_plans
from cnpgen.plans.plans import Plans
from cnpgen.problems.problem_record import open_problem
from cnpgen.trajectories import Trajectory, import_trajectories

Array = np.ndarray[Any, np.dtype[np.float64]]

PERIOD_S = 0.5  # of chunks
LAG_S = 0.03  # of the servos of the plant
SETTINGS = {  # name -> slowed by, speed, share of faults
    "own timing": (2.0, 1.0, 0.0),
    "speed 1 to 2": (3.0, 2.0, 0.0),
    "30 % faulty": (3.0, 1.0, 0.3),
}
TARGETS = {"own timing": 0.99, "speed 1 to 2": 0.92, "30 % faulty": 0.9}


@dataclass
class Figures:
    """What is counted in a closed loop."""

    good: Counter[str] = field(default_factory=Counter)  # outcomes of chunks
    faulty: Counter[str] = field(default_factory=Counter)
    seconds: list[float] = field(default_factory=list)  # of all steps
    jumps: Array = field(default_factory=lambda: np.zeros(3))
    distances: list[float] = field(default_factory=list)
    plans: list[Plans] = field(default_factory=list)
    cases: list[tuple[SetPoint, Array]] = field(default_factory=list)


def closed_loop(plans: Plans, name: str, count: int) -> Figures:
    """Execute chunks with exact tracking and without delay."""
    slow, speed, faults = SETTINGS[name]
    random, found = np.random.default_rng(7), Figures()
    loop = Loop(executor_of(plans.problem, speed, 0.01), Plant(0.0))
    executor = loop.executor
    while True:
        for plan in plans:
            policy, refused = Policy(plan, slow, random), 0
            loop.restart(policy.start)
            while (chunk := policy.chunk(loop.points[-1].q)) is not None:
                if sum((found.good + found.faulty).values()) >= count:
                    return found
                is_faulty = random.uniform() < faults
                chunk = spoil(chunk, random) if is_faulty else chunk
                start = time.thread_time()
                join = executor.step(loop.time, chunk, loop.time, loop.measured[-1])
                found.seconds.append(time.thread_time() - start)
                counts = found.faulty if is_faulty else found.good
                counts[join.outcome.name] += 1
                refused = 0 if join.accepted else refused + 1
                if join.accepted:
                    note(found, executor, join, chunk)
                if refused > 3 or executor.stopped is not None:
                    break  # the arm rests where no chunk can be joined
                loop.run(PERIOD_S)


def note(
    found: Figures, executor: ChunkExecutor, join: ChunkJoin, chunk: Array
) -> None:
    """Note the plan of an accepted chunk, its distance, and its jumps from the motion before."""
    timeline = executor._runtime._timeline  # type: ignore[union-attr]
    parts, at = timeline._parts, np.array([timeline._parts[-1].start])
    before, after = (part.at(at) for part in parts[-2:])
    state = SetPoint(*(values[0] for values in before))
    jumps = [np.abs(x - y).max() for x, y in zip(before, after, strict=True)]
    found.jumps = np.maximum(found.jumps, jumps)
    found.distances.append(join.distance)
    found.plans.append(parts[-1].plan)  # type: ignore[arg-type]
    found.cases.append((state, chunk[join.skipped :]))


def with_plant(plans: Plans, count: int) -> dict[str, Any]:
    """Execute chunks with lag and delays; late, reordered and repeated chunks, and an arm that freezes, stop it."""
    random, stops = np.random.default_rng(8), Counter[str]()
    outcomes, good, accepted = Counter[str](), 0, 0
    loop = Loop(executor_of(plans.problem, 1.0, 0.08), Plant(LAG_S))
    while sum(outcomes.values()) < count:
        for plan in plans:
            policy = Policy(plan, 3.0, random)
            loop.restart(policy.start)
            last: tuple[float, Array] | None = None
            while (chunk := policy.chunk(loop.plant.q)) is not None:
                observed, event = loop.time, random.uniform()
                loop.plant.frozen |= event > 0.97
                loop.run(random.uniform(0.05, 0.3) if event > 0.03 else 0.7)
                if 0.03 < event < 0.06 and last is not None:  # an older one arrives
                    observed, chunk = last
                last = observed, chunk
                measured = loop.measured[-1]
                join = loop.executor.step(loop.time, chunk, observed, measured)
                outcomes[join.outcome.name] += 1
                ordinary = 0.06 <= event <= 0.97
                good, accepted = good + ordinary, accepted + (ordinary & join.accepted)
                if (cause := loop.executor.stopped) is not None:
                    stops[cause.name] += 1
                    break
                loop.run(0.2)
    commanded = [(x.q, x.dq) for x in loop.points]
    robot = open_problem(plans.problem)[1]
    return {
        "joined": accepted / good,
        "outcomes": dict(outcomes),
        "stops": dict(stops),
        **dict(_uses("commanded", commanded, loop.resets, robot)),
        **dict(_uses("measured", loop.measured, loop.resets, robot)),
    }


def _uses(
    name: str, states: list[tuple[Array, Array]], resets: list[int], robot: Any
) -> Iterator[tuple[str, float]]:
    """Yield the largest velocities and accelerations between resets as shares of their limits."""
    parts = [
        np.array([dq for _, dq in states[begin:end]])
        for begin, end in zip(resets, [*resets[1:], len(states)], strict=True)
    ]
    shares = [np.abs(dq) / robot.velocity_limit for dq in parts]
    changes = [np.abs(np.diff(dq, axis=0)) / TICK_S for dq in parts]
    yield f"{name} velocity", max(float(x.max()) for x in shares)
    shares = [change / robot.acceleration_limit for change in changes]
    yield f"{name} acceleration", max(float(x.max(initial=0)) for x in shares)


def todays_times(found: Figures, count: int = 24) -> list[float]:
    """Return the CPU times of an import and a refinement of the same chunks [s]."""
    seconds = []
    for plan, (_, chunk) in list(zip(found.plans, found.cases, strict=True))[:count]:
        samples = Trajectory(np.arange(len(chunk)) / RATE, chunk)
        start = time.process_time()
        imported = import_trajectories(plan.problem, [samples], noise=NOISE_RAD)
        cnpgen.refine_plans(imported.plans, workers=1)
        seconds.append(time.process_time() - start)
    return seconds[2:]  # the first ones load kernels


def figures_of(found: Figures, target: float) -> dict[str, Any]:
    """Return the figures of a closed loop."""
    good, faulty = found.good.total(), found.faulty.total()
    valid = [bool(evaluate_plans(plan).valid[0]) for plan in found.plans]
    ms = 1e3 * np.sort(found.seconds)
    return {
        "chunks": good + faulty,
        "joined": found.good["ACCEPTED"] / good,
        "target": target,
        "outcomes": dict(found.good),
        "faulty": dict(found.faulty),
        "accepted": len(valid),
        "invalid": len(valid) - sum(valid),
        "jumps": found.jumps.tolist(),
        "distance p95": float(np.quantile(found.distances, 0.95)),
        "ms": median(ms.tolist()),
        "ms p99": float(np.quantile(ms, 0.99)),
    }


def measure(arm: str, count: int) -> dict[str, Any]:
    """Return all figures of an arm."""
    with tempfile.TemporaryDirectory() as folder:
        plans = references(problem_of(arm, Path(folder)), 40)
        figures: dict[str, Any] = {}
        for name, target in TARGETS.items():
            progress(f"{arm}: {name}")
            found = closed_loop(plans, name, count)
            figures[name] = figures_of(found, target)
            if name == "own timing":
                figures["import and refine ms"] = 1e3 * median(todays_times(found))
                robot = open_problem(plans.problem)[1]
                figures["baselines"] = compare(robot, found.cases[:100], RATE)
        progress(f"{arm}: plant")
        return figures | {"plant": with_plant(plans, count)}


def tables(arm: str, figures: dict[str, Any]) -> Iterator[str]:
    """Yield the tables of an arm."""
    today, rows = figures["import and refine ms"], []
    for name, target in TARGETS.items():
        x = figures[name]
        rows.append(
            (
                name,
                f"{x['chunks']:,}",
                f"{x['joined']:.3f}",
                *verdict(x["joined"], target),
                f"{x['invalid']} of {x['accepted']}",
                " ".join(f"{jump:.0e}" for jump in x["jumps"]),
                f"{x['distance p95']:.3f}",
                f"{x['ms']:.1f}",
                f"{x['ms p99']:.1f}",
                f"1 / {today / x['ms']:.1f}",
            )
        )
    head = ("", "chunks", "joined", "goal", "", "invalid", "jumps q dq ddq")
    last = ("distance p95", "ms", "ms p99", f"of {today:.0f} ms today")
    yield table(arm, (*head, *last), rows)
    for name in TARGETS:
        yield f"{name}: {figures[name]['outcomes']}, faulty {figures[name]['faulty']}"
    names = list(next(iter(figures["baselines"].values())))
    rows = [
        (name, *(f"{values[key]:.3g}" for key in names))
        for name, values in figures["baselines"].items()
    ]
    yield table("the same chunks by other executions", ("", *names), rows)
    yield f"with {LAG_S * 1e3:.0f} ms of lag: " + ", ".join(
        f"{key} {value:.3g}" if isinstance(value, float) else f"{key} {value}"
        for key, value in figures["plant"].items()
    )


def _add(parser: argparse.ArgumentParser) -> None:
    text = "chunks of every setting"
    parser.add_argument("--chunks", type=int, default=200, help=text)
    text = "problems, or arms of example-robot-data"
    parser.add_argument("--arms", nargs="+", default=["panda-3kg", "so101"], help=text)


def main() -> None:
    """Measure all arms and print tables or JSON."""
    options = arguments(__doc__, _add)
    results = {arm: measure(arm, options.chunks) for arm in options.arms}
    texts = [text for arm in results for text in tables(arm, results[arm])]
    report(results, texts, as_json=options.json)


if __name__ == "__main__":
    main()
