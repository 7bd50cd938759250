"""cnpgen against the implementation that one would write first: Pinocchio, SciPy and Coal, sample by sample in Python.

Both solve the same draws: the reference starts from the positions, guesses, angles and (for the goal) start
configurations of rows that cnpgen accepted. So it pays for no rejected draw; cnpgen's time includes them. Prints the
documentation's figures of speed-up and of optimality: CPU seconds per sample of both, and for every hit the objective
of the hitting configuration against SLSQP's and the speed of the linear program against HiGHS's.

    python benchmarks/reference.py
    python benchmarks/reference.py --samples 1000 --starts 4    SLSQP also from 3 random starts; the best one counts
"""

import argparse
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from common import arguments, median, progress, report, table
from pinocchio_scipy import (
    Arm,
    Array,
    Boxes,
    Hit,
    hitting_speed,
    solve_ik,
    solve_upright_ik,
    table_acceleration,
    table_velocity,
)

from cnpgen.kernels.library import choose_backend
from cnpgen.pipelines.pipeline_file import load_pipeline
from cnpgen.pipelines.prepared import PreparedPipeline, random_generator
from cnpgen.pipelines.stages.stage import BLOCK_ROWS, CandidateBatch

LOSS = 1e-6  # an objective this much below the reference's is a defeat


@dataclass
class Watch:
    """CPU time of the reference, by step [s]."""

    seconds: dict[str, float] = field(default_factory=dict)

    @contextmanager
    def step(self, name: str) -> Iterator[None]:
        """Add the time of a block."""
        start = time.process_time()
        yield
        self.seconds[name] = self.seconds.get(name, 0.0) + time.process_time() - start


@dataclass
class Comparison:
    """The outcome for one pipeline.

    Attributes:
        pipeline: Its name.
        samples: Number of samples.
        ours: Our CPU time per accepted row [s].
        reference: CPU time of the reference per sample [s].
        steps: The same, by step.
        failed: Samples that the reference did not solve, by step.
        margins: What is optimised -> our objective minus the reference's, per sample that both solved.
        lost: The cases that we lose by more than ``LOSS``, with everything needed to repeat them.
    """

    pipeline: str
    samples: int
    ours: float
    reference: float = 0.0
    steps: dict[str, float] = field(default_factory=dict)
    failed: dict[str, int] = field(default_factory=dict)
    margins: dict[str, list[float]] = field(default_factory=dict)
    lost: list[dict[str, Any]] = field(default_factory=list)

    def fail(self, step: str) -> None:
        """Count a sample that the reference did not solve."""
        self.failed[step] = self.failed.get(step, 0) + 1

    def compare(self, what: str, ours: float, theirs: float, **case: Any) -> None:
        """Note the objectives of one sample."""
        self.margins.setdefault(what, []).append(ours - theirs)
        if ours < theirs - LOSS:
            plain = {name: value.tolist() if isinstance(value, np.ndarray) else value for name, value in case.items()}
            self.lost.append({"what": what, "ours": ours, "theirs": theirs, **plain})


def our_rows(prepared: PreparedPipeline, samples: int, seed: int) -> CandidateBatch:
    """Run rounds of draws until one has enough rows; it also holds the columns that are not stored, such as guesses."""
    size = max(256, 3 * samples)
    while True:
        draws = prepared._sample_batch(random_generator(seed, "reference", 0), size)
        if len(draws.alive) >= samples:
            return draws
        size *= 2


def our_seconds(prepared: PreparedPipeline, repeat: int = 9) -> float:
    """CPU time per accepted row [s], median over blocks."""
    prepared.block(0, "reference", 0)
    seconds = []
    for index in range(repeat):
        start = time.process_time()
        prepared.block(0, "reference", index)
        seconds.append((time.process_time() - start) / BLOCK_ROWS)
    return median(seconds)


def compare_replan(prepared: PreparedPipeline, samples: int, seed: int, starts: int) -> Comparison:
    """Solve rows of airhockey-replan again."""
    arm, draws, watch = Arm(prepared.context.robot), our_rows(prepared, samples, seed), Watch()
    found = Comparison("airhockey-replan", samples, our_seconds(prepared))
    random = np.random.default_rng(seed)
    for row in range(samples):
        sample = {name: np.ascontiguousarray(values[:, row]) for name, values in draws.columns.items()}
        angle = float(sample["hit_angle"][0])
        direction = np.array([np.cos(angle), np.sin(angle), 0.0])
        _reference_start(arm, sample, found, watch=watch, random=random)
        _reference_goal(arm, sample, found, watch=watch, direction=direction, random=random, starts=starts)
    return _finish(found, watch)


def _reference_start(
    arm: Arm, sample: dict[str, Array], found: Comparison, *, watch: Watch, random: np.random.Generator
) -> None:
    with watch.step("start: IK (Gauss-Newton)"):
        q = solve_ik(arm, sample["start_xyz"], sample["guess_q"])
    if q is None:
        found.fail("start IK")
        return
    with watch.step("start: velocity and acceleration"):
        dq = table_velocity(arm, q, random)
        ddq = table_acceleration(arm, q, dq, random)
    if ddq is None:
        found.fail("start acceleration")


def _reference_goal(
    arm: Arm,
    sample: dict[str, Array],
    found: Comparison,
    *,
    watch: Watch,
    direction: Array,
    random: np.random.Generator,
    starts: int,
) -> None:
    hit = Hit(arm, sample["goal_xyz"], direction, home=sample["start_q"])
    with watch.step("goal: IK (Gauss-Newton)"):
        first = solve_ik(arm, hit.target, hit.home)
    with watch.step("goal: configuration (SLSQP)"):
        q = hit.solve(first) if first is not None else None
    if q is None:
        found.fail("hitting configuration")
    else:
        with watch.step("goal: velocity (HiGHS)"):
            hitting_speed(arm, q, direction)
    rivals = {"hitting configuration": [q]}
    if starts > 1:
        others = [hit.solve(_nearby(arm, hit, random)) for _ in range(starts - 1)]
        rivals[f"... against the best of {starts} starts"] = [q, *others]
    for what, found_qs in rivals.items():
        solved = [x for x in found_qs if x is not None]
        if solved:
            best, ours = max(solved, key=hit.objective), sample["goal_q"]
            case = {"start_q": hit.home, "p": hit.target, "d": direction, "our_q": ours, "their_q": best}
            found.compare(what, hit.objective(ours), hit.objective(best), **case)
    program = hitting_speed(arm, sample["goal_q"], direction)
    if program is not None:
        speed = float(sample["hit_speed_max"][0])
        found.compare("hitting velocity", speed, program[1], goal_q=sample["goal_q"], d=direction)


def _nearby(arm: Arm, hit: Hit, random: np.random.Generator) -> Array:
    """Draw a configuration around the start and move it to the goal as far as that goes."""
    guess = hit.home + 0.5 * random.standard_normal(arm.robot.n)
    found = solve_ik(arm, hit.target, guess)
    return np.clip(guess, arm.bounds.lb, arm.bounds.ub) if found is None else found


def compare_heavy(prepared: PreparedPipeline, samples: int, seed: int) -> Comparison:
    """Solve rows of heavy-object again."""
    arm, draws, watch = Arm(prepared.context.robot), our_rows(prepared, samples, seed), Watch()
    problem = prepared.context.problem
    boxes, zero = Boxes(problem, arm), np.zeros(arm.robot.n)
    half = problem.object.size[2] / 2 if problem.object else 0.0
    found = Comparison("heavy-object", samples, our_seconds(prepared))
    for row in range(samples):
        sample = {name: np.ascontiguousarray(values[:, row]) for name, values in draws.columns.items()}
        obstacle_poses = np.array([sample[f"{box.below}_xyz"][2] - half for box in problem.obstacle])
        guess = sample["guess_q"]
        for end in ("start", "goal"):
            with watch.step(f"{end}: IK (SLSQP)"):
                q = solve_upright_ik(arm, sample[f"{end}_xyz"], guess)
            if q is None:
                found.fail(f"{end} IK")
                break
            with watch.step(f"{end}: torque and collision (Coal)"):
                fits = bool(np.all(np.abs(arm.torque(q, zero, zero)) <= arm.robot.torque_limit))
                collides = boxes.collide(q, obstacle_poses)
            if collides or not fits:
                found.fail(f"{end} in collision or too heavy")
                break
            guess = q
        _agree(found, boxes, sample, obstacle_poses)
    return _finish(found, watch)


def _agree(found: Comparison, boxes: Boxes, sample: dict[str, Array], obstacle_poses: Array) -> None:
    """Ask the reference about our configurations; an accepted row that it calls a collision is a defeat."""
    for end in ("start", "goal"):
        ours = -1.0 if boxes.collide(sample[f"{end}_q"], obstacle_poses) else 0.0
        found.compare("free of collision", ours, 0.0, q=sample[f"{end}_q"], obstacle_poses=obstacle_poses)


def _finish(found: Comparison, watch: Watch) -> Comparison:
    found.steps = {name: seconds / found.samples for name, seconds in watch.seconds.items()}
    found.reference = sum(found.steps.values())
    return found


def speed_table(comparisons: list[Comparison]) -> str:
    rows = [
        (
            *(found.pipeline, str(found.samples), f"{1e6 * found.ours:.2f}", f"{1e6 * found.reference:,.0f}"),
            f"{found.reference / found.ours:,.0f}",
            ", ".join(f"{count} x {step}" for step, count in found.failed.items()) or "none",
        )
        for found in comparisons
    ]
    head = ("pipeline", "samples", "ours [us/row]", "reference [us/sample]", "times slower", "reference failed")
    return table("CPU time per sample", head, rows)


def step_table(found: Comparison) -> str:
    rows = [(name, f"{1e6 * seconds:,.0f}") for name, seconds in found.steps.items()]
    return table(f"{found.pipeline}: the reference's steps", ("step", "us/sample"), rows)


def margin_table(comparisons: list[Comparison]) -> str:
    rows = []
    for found in comparisons:
        for what, margins in found.margins.items():
            values = np.array(margins)
            equal, better = int(np.sum(np.abs(values) <= LOSS)), int(np.sum(values > LOSS))
            worst = f"{max(0.0, -float(values.min())):.1e}"
            rows.append((what, str(len(values)), str(equal), str(better), str(len(values) - equal - better), worst))
    head = ("objective", "compared", "equal", "ours better", "ours worse", "worst shortfall")
    return table(f"Objectives, equal within {LOSS:g}", head, rows)


def lost_table(comparisons: list[Comparison]) -> str:
    lost = [case for found in comparisons for case in found.lost]
    return "\n".join(f"LOST {case}" for case in lost)


def prepare(pipeline: str, backend: str | None) -> PreparedPipeline:
    chosen, cache_folder = choose_backend(backend)
    return PreparedPipeline(load_pipeline(pipeline), backend=chosen, cache_folder=cache_folder)


def add_options(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--samples", type=int, default=100, help="samples of each pipeline")
    parser.add_argument("--seed", type=int, default=1, help="of the draws")
    parser.add_argument("--starts", type=int, default=1, help="starts of the reference's hitting configuration")
    parser.add_argument("--backend", help="of ours")


def main() -> None:
    options = arguments(__doc__, add_options)
    progress("airhockey-replan")
    replan = compare_replan(prepare("airhockey-replan", options.backend), options.samples, options.seed, options.starts)
    progress("heavy-object")
    heavy = compare_heavy(prepare("heavy-object", options.backend), options.samples, options.seed)
    both = [replan, heavy]
    tables: list[str] = [speed_table(both), *map(step_table, both), margin_table(both), lost_table(both)]
    report({"comparisons": [vars(found) for found in both]}, filter(None, tables), as_json=options.json)


if __name__ == "__main__":
    main()
