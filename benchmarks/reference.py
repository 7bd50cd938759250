"""cnpgen compared with a direct implementation in Python: Pinocchio, SciPy and Coal, sample by sample.

Both solve the same samples: the reference starts from the positions, guesses, angles and (for the goal) start
configurations of rows that cnpgen accepted. The time of cnpgen includes rejected candidates, that of the reference does
not. The tables have the CPU time per sample of both. For every hit, they compare the objective of the hitting
configuration with SLSQP and the speed of the linear program with HiGHS.

    python benchmarks/reference.py
    python benchmarks/reference.py --samples 1000 --starts 4    SLSQP also from 3 random starts; the best result counts
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
from cnpgen.pipelines.pipeline import load_pipeline
from cnpgen.pipelines.prepared import PreparedPipeline, random_generator
from cnpgen.pipelines.stages.stage import BLOCK_ROWS, CandidateBatch

OBJECTIVE_TOLERANCE = (
    1e-6  # a lower objective than that of the reference counts as worse
)


@dataclass
class StepTimer:
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
    """Results of one pipeline.

    Attributes:
        pipeline: Its name.
        samples: Number of samples.
        ours: Our CPU time per accepted row [s].
        reference: CPU time of the reference per sample [s].
        steps: The same, by step.
        failed: Samples that the reference did not solve, by step.
        margins: Name of the objective -> our value minus that of the reference, of samples that both solved.
        worse: Samples whose objective is worse by more than ``OBJECTIVE_TOLERANCE``, with their inputs.
    """

    pipeline: str
    samples: int
    ours: float
    reference: float = 0.0
    steps: dict[str, float] = field(default_factory=dict)
    failed: dict[str, int] = field(default_factory=dict)
    margins: dict[str, list[float]] = field(default_factory=dict)
    worse: list[dict[str, Any]] = field(default_factory=list)

    def fail(self, step: str) -> None:
        """Count a sample that the reference did not solve."""
        self.failed[step] = self.failed.get(step, 0) + 1

    def compare(self, objective: str, ours: float, theirs: float, **case: Any) -> None:
        """Add the objectives of one sample."""
        self.margins.setdefault(objective, []).append(ours - theirs)
        if ours < theirs - OBJECTIVE_TOLERANCE:
            plain = {
                name: value.tolist() if isinstance(value, np.ndarray) else value
                for name, value in case.items()
            }
            self.worse.append(
                {"objective": objective, "ours": ours, "theirs": theirs, **plain}
            )


def our_rows(prepared: PreparedPipeline, samples: int, seed: int) -> CandidateBatch:
    """Sample a batch with enough accepted rows; it also has the columns that are not stored, such as guesses."""
    size = max(256, 3 * samples)
    while True:
        batch = prepared._sample_batch(random_generator(seed, "reference", 0), size)
        if len(batch.alive) >= samples:
            return batch
        size *= 2


def our_seconds(prepared: PreparedPipeline, repeat: int = 9) -> float:
    """Return the CPU time per accepted row [s], median over blocks."""
    prepared.block(0, "reference", 0)
    seconds = []
    for index in range(repeat):
        start = time.process_time()
        prepared.block(0, "reference", index)
        seconds.append((time.process_time() - start) / BLOCK_ROWS)
    return median(seconds)


def compare_replan(
    prepared: PreparedPipeline, samples: int, seed: int, starts: int
) -> Comparison:
    """Solve rows of airhockey-replan by the reference."""
    arm, batch, timer = (
        Arm(prepared.context.robot),
        our_rows(prepared, samples, seed),
        StepTimer(),
    )
    comparison = Comparison("airhockey-replan", samples, our_seconds(prepared))
    random = np.random.default_rng(seed)
    for row in range(samples):
        sample = {
            name: np.ascontiguousarray(values[:, row])
            for name, values in batch.columns.items()
        }
        angle = float(sample["hit_angle"][0])
        direction = np.array([np.cos(angle), np.sin(angle), 0.0])
        _reference_start(arm, sample, comparison, timer=timer, random=random)
        _reference_goal(
            arm,
            sample,
            comparison,
            timer=timer,
            direction=direction,
            random=random,
            starts=starts,
        )
    return _finish(comparison, timer)


def _reference_start(
    arm: Arm,
    sample: dict[str, Array],
    comparison: Comparison,
    *,
    timer: StepTimer,
    random: np.random.Generator,
) -> None:
    with timer.step("start: IK (Gauss-Newton)"):
        q = solve_ik(arm, sample["start_xyz"], sample["guess_q"])
    if q is None:
        comparison.fail("start IK")
        return
    with timer.step("start: velocity and acceleration"):
        dq = table_velocity(arm, q, random)
        ddq = table_acceleration(arm, q, dq, random)
    if ddq is None:
        comparison.fail("start acceleration")


def _reference_goal(
    arm: Arm,
    sample: dict[str, Array],
    comparison: Comparison,
    *,
    timer: StepTimer,
    direction: Array,
    random: np.random.Generator,
    starts: int,
) -> None:
    hit = Hit(arm, sample["goal_xyz"], direction, home=sample["start_q"])
    with timer.step("goal: IK (Gauss-Newton)"):
        first = solve_ik(arm, hit.target, hit.home)
    with timer.step("goal: configuration (SLSQP)"):
        q = hit.solve(first) if first is not None else None
    if q is None:
        comparison.fail("hitting configuration")
    else:
        with timer.step("goal: velocity (HiGHS)"):
            hitting_speed(arm, q, direction)
    candidates = {"hitting configuration": [q]}
    if starts > 1:
        others = [hit.solve(_nearby(arm, hit, random)) for _ in range(starts - 1)]
        candidates[f"... against the best of {starts} starts"] = [q, *others]
    for name, configurations in candidates.items():
        solved = [x for x in configurations if x is not None]
        if solved:
            best, ours = max(solved, key=hit.objective), sample["goal_q"]
            case = {
                "start_q": hit.home,
                "p": hit.target,
                "d": direction,
                "our_q": ours,
                "their_q": best,
            }
            comparison.compare(name, hit.objective(ours), hit.objective(best), **case)
    program = hitting_speed(arm, sample["goal_q"], direction)
    if program is not None:
        speed = float(sample["hit_speed_max"][0])
        comparison.compare(
            "hitting velocity", speed, program[1], goal_q=sample["goal_q"], d=direction
        )


def _nearby(arm: Arm, hit: Hit, random: np.random.Generator) -> Array:
    """Sample a configuration near the start; move it to the goal if inverse kinematics converge."""
    guess = hit.home + 0.5 * random.standard_normal(arm.robot.n)
    solution = solve_ik(arm, hit.target, guess)
    return (
        np.clip(guess, arm.bounds.lb, arm.bounds.ub) if solution is None else solution
    )


def compare_heavy(prepared: PreparedPipeline, samples: int, seed: int) -> Comparison:
    """Solve rows of heavy-object by the reference."""
    arm, batch, timer = (
        Arm(prepared.context.robot),
        our_rows(prepared, samples, seed),
        StepTimer(),
    )
    problem = prepared.context.problem
    boxes, zero = Boxes(problem, arm), np.zeros(arm.robot.n)
    half = problem.object.size[2] / 2 if problem.object else 0.0
    comparison = Comparison("heavy-object", samples, our_seconds(prepared))
    for row in range(samples):
        sample = {
            name: np.ascontiguousarray(values[:, row])
            for name, values in batch.columns.items()
        }
        obstacle_poses = np.array(
            [sample[f"{box.below}_xyz"][2] - half for box in problem.obstacle]
        )
        guess = sample["guess_q"]
        for end in ("start", "goal"):
            with timer.step(f"{end}: IK (SLSQP)"):
                q = solve_upright_ik(arm, sample[f"{end}_xyz"], guess)
            if q is None:
                comparison.fail(f"{end} IK")
                break
            with timer.step(f"{end}: torque and collision (Coal)"):
                fits = bool(
                    np.all(np.abs(arm.torque(q, zero, zero)) <= arm.robot.torque_limit)
                )
                collides = boxes.collide(q, obstacle_poses)
            if collides or not fits:
                comparison.fail(f"{end} in collision or too heavy")
                break
            guess = q
        _check_collisions(comparison, boxes, sample, obstacle_poses)
    return _finish(comparison, timer)


def _check_collisions(
    comparison: Comparison,
    boxes: Boxes,
    sample: dict[str, Array],
    obstacle_poses: Array,
) -> None:
    """Check our configurations by the reference; an accepted row that it finds in collision counts as worse."""
    for end in ("start", "goal"):
        ours = -1.0 if boxes.collide(sample[f"{end}_q"], obstacle_poses) else 0.0
        comparison.compare(
            "free of collision",
            ours,
            0.0,
            q=sample[f"{end}_q"],
            obstacle_poses=obstacle_poses,
        )


def _finish(comparison: Comparison, timer: StepTimer) -> Comparison:
    comparison.steps = {
        name: seconds / comparison.samples for name, seconds in timer.seconds.items()
    }
    comparison.reference = sum(comparison.steps.values())
    return comparison


def speed_table(comparisons: list[Comparison]) -> str:
    rows = [
        (
            *(
                comparison.pipeline,
                str(comparison.samples),
                f"{1e6 * comparison.ours:.2f}",
                f"{1e6 * comparison.reference:,.0f}",
            ),
            f"{comparison.reference / comparison.ours:,.0f}",
            ", ".join(f"{count} x {step}" for step, count in comparison.failed.items())
            or "none",
        )
        for comparison in comparisons
    ]
    head = (
        "pipeline", "samples", "ours [us/row]", "reference [us/sample]", "times slower", "failures of the reference",
    )  # fmt: skip
    return table("CPU time per sample", head, rows)


def step_table(comparison: Comparison) -> str:
    rows = [
        (name, f"{1e6 * seconds:,.0f}") for name, seconds in comparison.steps.items()
    ]
    return table(
        f"{comparison.pipeline}: the reference's steps", ("step", "us/sample"), rows
    )


def margin_table(comparisons: list[Comparison]) -> str:
    rows = []
    for comparison in comparisons:
        for objective, margins in comparison.margins.items():
            values = np.array(margins)
            equal, better = (
                int(np.sum(np.abs(values) <= OBJECTIVE_TOLERANCE)),
                int(np.sum(values > OBJECTIVE_TOLERANCE)),
            )
            worst = f"{max(0.0, -float(values.min())):.1e}"
            rows.append(
                (
                    objective,
                    str(len(values)),
                    str(equal),
                    str(better),
                    str(len(values) - equal - better),
                    worst,
                )
            )
    head = (
        "objective",
        "compared",
        "equal",
        "ours better",
        "ours worse",
        "worst shortfall",
    )
    return table(f"Objectives, equal within {OBJECTIVE_TOLERANCE:g}", head, rows)


def worse_table(comparisons: list[Comparison]) -> str:
    worse = [case for comparison in comparisons for case in comparison.worse]
    return "\n".join(f"WORSE {case}" for case in worse)


def prepare(pipeline: str, backend: str | None) -> PreparedPipeline:
    chosen, cache_folder = choose_backend(backend)
    return PreparedPipeline(
        load_pipeline(pipeline), backend=chosen, cache_folder=cache_folder
    )


def add_options(parser: argparse.ArgumentParser) -> None:
    parser.add_argument(
        "--samples", type=int, default=100, help="samples of each pipeline"
    )
    parser.add_argument("--seed", type=int, default=1, help="seed of the candidates")
    parser.add_argument(
        "--starts",
        type=int,
        default=1,
        help="starts of the reference for the hitting configuration",
    )
    parser.add_argument("--backend", help="backend of cnpgen")


def main() -> None:
    options = arguments(__doc__, add_options)
    progress("airhockey-replan")
    replan = compare_replan(
        prepare("airhockey-replan", options.backend),
        options.samples,
        options.seed,
        options.starts,
    )
    progress("heavy-object")
    heavy = compare_heavy(
        prepare("heavy-object", options.backend), options.samples, options.seed
    )
    both = [replan, heavy]
    tables: list[str] = [
        speed_table(both),
        *map(step_table, both),
        margin_table(both),
        worse_table(both),
    ]
    report(
        {"comparisons": [vars(comparison) for comparison in both]},
        filter(None, tables),
        as_json=options.json,
    )


if __name__ == "__main__":
    main()
