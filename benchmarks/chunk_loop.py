"""A policy, an executor and an arm in closed loop, for benchmarks/chunks.py."""

import subprocess
import sys
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from your_arm import ARMS, robots

import cnpgen
from cnpgen.addons.online.chunk_executor import ChunkExecutor
from cnpgen.addons.online.set_points import SetPoint
from cnpgen.plans.plans import Plans

Array = np.ndarray[Any, np.dtype[np.float64]]

RATE, LENGTH, TICK_S = 30.0, 50, 0.01
NOISE_RAD, OFFSET_RAD, MAX_DISTANCE_RAD = 5e-4, 0.02, 0.15
FAULTS = ("outlier", "offset", "limit", "nan", "jump")


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
        found += self._random.uniform(-OFFSET_RAD, OFFSET_RAD, found.shape[1])
        return found


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
