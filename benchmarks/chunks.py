"""Execution of action chunks in closed loop: joins, validity, jumps, CPU time, faults, a lagging arm, and baselines.

    python benchmarks/chunks.py [--chunks 200] [--arms panda-3kg so101] [--json]

A policy observes the arm every 0.5 s and returns 50 samples at 30 Hz of a reference
motion, from the point nearest to the arm on, with noise of 5e-4 rad and an offset of up
to 0.02 rad of its own. References are valid plans between random states, slowed. Every
accepted motion is judged again by the full verdict. Times are CPU times of one thread.
"""

import argparse
import subprocess
import sys
import tempfile
import time
from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from chunk_baselines import compare
from common import arguments, median, progress, report, table, verdict
from your_arm import ARMS, robots

import cnpgen
from cnpgen.addons.online.chunk_executor import ChunkExecutor
from cnpgen.addons.online.set_points import SetPoint
from cnpgen.addons.online.switches import ChunkJoin
from cnpgen.plans.evaluate import evaluate_plans
from cnpgen.plans.plans import Plans
from cnpgen.problems.problem_record import open_problem
from cnpgen.trajectories import Trajectory, import_trajectories

Array = np.ndarray[Any, np.dtype[np.float64]]

RATE, LENGTH, PERIOD_S, TICK_S = 30.0, 50, 0.5, 0.01
NOISE_RAD, OFFSET_RAD, MAX_DISTANCE_RAD = 5e-4, 0.02, 0.15
LAG_S = 0.03  # of the servos of the plant
FAULTS = ("outlier", "offset", "limit", "nan", "jump")
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


class Policy:
    """A policy that follows a reference motion from the point nearest to an arm on."""

    def __init__(self, plan: Plans, slow: float, random: np.random.Generator) -> None:
        self._motion, self._slow, self._random = plan.motion, slow, random
        self.duration = float(plan.duration[0]) * slow
        self._times = np.linspace(0, self.duration, 600)
        self._path, self._first = self.at(self._times), 0
        self.start = self._path[0]

    def at(self, times: Array) -> Array:
        """Return positions of the reference, shape (K, n)."""
        inside = np.clip(times, 0, self.duration)
        return np.asarray(self._motion.at_times(inside[None] / self._slow).q[0])

    def chunk(self, q: Array) -> Array | None:
        """Return a chunk from the point nearest to q [rad], shape (n,), on; None at the end."""
        distance = np.abs(self._path[self._first :] - q).max(axis=1)
        self._first += int(distance.argmin())
        now = self._times[self._first]
        if now > self.duration - 0.05:
            return None
        found = self.at(now + np.arange(LENGTH) / RATE)
        found += self._random.uniform(-NOISE_RAD, NOISE_RAD, found.shape)
        return found + self._random.uniform(-OFFSET_RAD, OFFSET_RAD, found.shape[1])


class Plant:
    """An arm that follows set points with the lag of its servos, or not at all."""

    def __init__(self, lag: float) -> None:
        self.lag, self.frozen = lag, False
        self.q = self.dq = np.zeros(0)

    def follow(self, point: SetPoint) -> None:
        """Move for a tick towards a set point."""
        before = self.q if self.q.size else point.q
        share = 1.0 if self.lag == 0 else 1 - np.exp(-TICK_S / self.lag)
        moved = np.zeros_like(point.q) if self.frozen else share * (point.q - before)
        self.q, self.dq = before + moved, moved / TICK_S


@dataclass
class Loop:
    """A clock, an executor, and the arm that follows its set points."""

    executor: ChunkExecutor
    plant: Plant
    time: float = 0.0
    points: list[Any] = field(default_factory=list)
    measured: list[tuple[Array, Array]] = field(default_factory=list)
    resets: list[int] = field(default_factory=list)  # numbers of points before them

    def run(self, duration: float) -> None:
        """Serve set points for a time [s]."""
        for _ in range(round(duration / TICK_S)):
            self.time += TICK_S
            self.points.append(self.executor.set_point(self.time))
            self.plant.follow(self.points[-1])
            self.measured.append((self.plant.q, self.plant.dq))

    def restart(self, q: Array) -> None:
        """Stop, wait for rest, and place the arm elsewhere."""
        if self.points and self.executor.stopped is None:
            self.executor.stop()
        while self.points and self.points[-1].dq.any():
            self.run(0.1)
        self.run(0.1 if self.points else 0.0)
        self.executor.reset((q, np.zeros_like(q)))
        self.plant.q, self.plant.frozen = q, False
        self.resets.append(len(self.points))
        self.run(TICK_S)


def executor_of(problem: Any, speed: float, tracking_error: float) -> ChunkExecutor:
    """Return an executor with the options of the benchmark."""
    return ChunkExecutor(
        problem,
        rate=RATE,
        length=LENGTH,
        join=0.05,
        max_distance=MAX_DISTANCE_RAD,
        tracking_error=tracking_error,
        stale_after=0.5,
        speed=speed,
    )


def spoil(chunk: Array, random: np.random.Generator) -> Array:
    """Return a chunk with a fault of a random kind."""
    bad, n = chunk.copy(), chunk.shape[1]
    k, j = int(random.integers(5, 40)), int(random.integers(n))
    kind = FAULTS[int(random.integers(len(FAULTS)))]
    if kind == "outlier":
        bad[k, j] += 0.3
    elif kind == "offset":
        bad += 0.3 * random.choice([-1, 1], n)
    elif kind == "limit":
        bad[:, j] = np.linspace(bad[0, j], 5.0, LENGTH)
    elif kind == "nan":
        bad[k] = np.nan
    else:
        bad[k:, j] += 0.5
    return bad


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
    found.plans.append(parts[-1].plan)
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


def references(problem: Any, count: int) -> Plans:
    """Return valid plans from rest to rest between random states."""
    robot, spec = cnpgen.RobotModel(problem), cnpgen.load_problem(problem).trajectory
    low, high = np.asarray(robot.position_lower), np.asarray(robot.position_upper)
    random, n = np.random.default_rng(5), len(low)
    ends = [
        (low + high) / 2 + 0.3 * (high - low) * random.uniform(-1, 1, (count, n))
        for _ in range(2)
    ]
    still = np.zeros((count, n))
    unplanned = cnpgen.make_plans(
        problem,
        cnpgen.Boundary(ends[0], still, still, ends[1], still),
        path_control_points=np.full((count, spec.path_control_points, n), np.nan),
        rate_control_points=np.full((count, spec.rate_control_points), np.nan),
    )
    refinement = cnpgen.solve_plans(unplanned, workers=1)
    return refinement.plans[np.flatnonzero(refinement.valid)]


def problem_of(arm: str, folder: Path) -> Any:
    """Return a shipped problem, or write that of an arm of example-robot-data, with jerk limits."""
    if arm not in ARMS:
        return arm
    urdf, tip = ARMS[arm]
    command = [sys.executable, "-m", "cnpgen", "init", arm, "--tip", tip]
    command += ["--urdf", str(robots() / urdf)]
    subprocess.run(command, cwd=folder, check=True, capture_output=True)
    return str(folder / arm / "problem.toml")


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
