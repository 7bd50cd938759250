"""CPU time of the verdict per plan, compared with a check of one state at a time by Pinocchio and Coal.

The second check measures every constraint at all times of the time grid and not between them. The time of the verdict
is the median over repetitions of the mean over all plans. Both checks run in turn on the same plans.

With ``--always N``, N plans of each file lie at a tolerance, with a relative distance of 1e-5 on either side. They are
judged at finer and finer steps and with early exit, as by the refiner. Their validity must not depend on the step.

    cnpgen solve airhockey-hit --n 100 -o hits.h5
    python benchmarks/verdict.py hits.h5 --always 100
"""

import argparse
import time
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from common import arguments, median, report, table, verdict

from cnpgen.judges.plans import Margin, Reason, Verdict, judge
from cnpgen.judges.plans.evaluated_trajectory import evaluate_trajectory
from cnpgen.judges.plans.judge import Judge
from cnpgen.judges.plans.sampling import sample, time_table
from cnpgen.plans import Plans, load_plans, open_problem
from cnpgen.problems.problem import Problem
from cnpgen.trajectory.spline_motion import Motion
from cnpgen.world.world import World

STEP_S = 1e-3
STEPS_S = (1e-3, 1e-4, 1e-5)
TOLERANCE_DISTANCE = 1e-5  # of plans from a tolerance, relative to it
MIN_VIOLATION = 1e-6  # of the condition whose tolerance is changed, in its unit
TARGETS_MS = {"airhockey": 3.0, "heavy-object": 8.0}  # per plan


@dataclass(frozen=True)
class Timing:
    """Measurements of one file.

    Attributes:
        problem: Name of the problem.
        plans: Number of plans.
        times: Mean number of evaluated times per plan.
        ms: CPU time of the verdict per plan [ms].
        times_faster: CPU time of the check state by state over that of the verdict.
        missed: Maximum severity that only the check state by state measures, in tolerances.
        between: Maximum severity that only the verdict measures, between times.
    """

    problem: str
    plans: int
    times: float
    ms: float
    times_faster: float
    missed: float
    between: float


def judge_plans(plans: Plans) -> tuple[list[Verdict], float]:
    """Judge plans; return the verdicts and the CPU time [s]."""
    problem, robot = open_problem(plans.problem)
    ends = plans.scene, plans.columns["goal_xyz"]
    start = time.process_time()
    verdicts = judge(problem, robot, plans.motion, plans.boundary, *ends, step=STEP_S)
    return verdicts, time.process_time() - start


def state_by_state(plans: Plans) -> tuple[list[dict[str, float]], float]:
    """Measure every constraint at all times; return condition -> severity of each plan, and the CPU time [s]."""
    problem, robot = open_problem(plans.problem)
    world = World(robot, problem.obstacle, problem.object_size)
    obstacle_poses = plans.scene.poses
    start, severities = time.process_time(), []
    for index, motion in enumerate(plans.motion[[i]] for i in range(len(plans))):
        times = sample(time_table(motion.rate[0], motion.degree), STEP_S, 13)
        assert times is not None
        states = evaluate_trajectory(motion, times.s)
        severity: dict[str, float] = {}
        for k, phase in enumerate(times.s):
            q, dq, ddq = (
                values[:, k].copy() for values in (states.q, states.dq, states.ddq)
            )
            world.set_state(q, dq, ddq, obstacle_poses[index])
            for constraint in problem.constraint:
                for condition in constraint.measured(world):
                    relaxation = constraint.bound_relaxation(
                        condition, np.array([phase]), plans.columns["start_xyz"][index]
                    )
                    g = np.array(condition.g, float)
                    excess = (
                        np.maximum(condition.lower - g, g - condition.upper)
                        - relaxation
                    )
                    worst = float(np.max(excess / constraint.allowed(condition)))
                    severity[condition.name] = max(
                        severity.get(condition.name, -np.inf), worst
                    )
        severities.append(severity)
    return severities, time.process_time() - start


def measure(plans: Plans, *, repeat: int, slow: int) -> Timing:
    """Measure one file."""
    shared = plans[:slow]
    verdicts, _ = judge_plans(plans)  # also the warm-up
    times = [judge_plans(plans)[1] / len(plans) for _ in range(repeat)]
    ratios, missed, between = [], 0.0, 0.0
    for _ in range(repeat):
        verdict_time, reference = judge_plans(shared)[1], state_by_state(shared)
        ratios.append(reference[1] / verdict_time)
        for result, expected in zip(verdicts, reference[0], strict=False):
            for name, severity in expected.items():
                missed = max(missed, severity - result.margins[name].severity)
                between = max(between, result.margins[name].severity - severity)
    samples = float(np.mean([result.samples for result in verdicts]))
    return Timing(
        plans.problem.name,
        len(plans),
        samples,
        1e3 * median(times),
        median(ratios),
        missed,
        between,
    )


@dataclass(frozen=True)
class ToleranceTest:
    """Results of plans at a tolerance.

    Attributes:
        problem: Name of the problem.
        plans: Number of plans.
        differ: Number of plans whose validity depends on the step or on the early exit.
    """

    problem: str
    plans: int
    differ: int


def at_the_tolerance(problem: Problem, margin: Margin, by: float) -> Problem:
    """Return the problem with one constraint only, whose tolerance is the violation times ``1 + by``."""
    factor = margin.violation / margin.tolerance * (1 + by)
    constraints = [
        constraint
        for constraint in problem.constraint
        if constraint.reason == margin.reason
    ]
    changed = [
        replace(constraint, tolerance=constraint.tolerance * factor)
        for constraint in constraints
    ]
    return replace(problem, constraint=tuple(changed))


def check_steps(plans: Plans, count: int, seed: int) -> ToleranceTest:
    """Perturb plans, set the tolerance of one condition to its violation, and judge them at every step."""
    problem, robot = open_problem(plans.problem)
    random = np.random.default_rng(seed)
    differ = 0
    for k in range(count):
        plan = plans[[k % len(plans)]]
        path = plan.path_control_points.copy()
        path[:, 3:-3] += random.uniform(-0.02, 0.02, path[:, 3:-3].shape)
        motion = Motion(path, plan.rate_control_points)
        arguments = motion, plan.boundary, plan.scene, plan.columns["goal_xyz"]
        margins = judge(problem, robot, *arguments, step=STEP_S)[0].margins
        exceeded = [
            name
            for name, margin in margins.items()
            if margin.reason != Reason.BOUNDARY and margin.violation > MIN_VIOLATION
        ]
        name, changed = exceeded[random.integers(len(exceeded))], problem
        for _ in range(4):  # the violation depends on the tolerance
            changed = at_the_tolerance(
                changed,
                judge(changed, robot, *arguments, step=STEP_S)[0].margins[name],
                0.0,
            )
        by = TOLERANCE_DISTANCE if k % 2 else -TOLERANCE_DISTANCE
        final = at_the_tolerance(
            changed, judge(changed, robot, *arguments, step=STEP_S)[0].margins[name], by
        )
        validity = {
            judge(final, robot, *arguments, step=step)[0].valid for step in STEPS_S
        }
        differ += (
            len(validity | {Judge(final, robot)(*arguments, early_exit=True)[0].valid})
            > 1
        )
    return ToleranceTest(plans.problem.name, count, differ)


def add(parser: argparse.ArgumentParser) -> None:
    """Add the options of this benchmark."""
    parser.add_argument("file", nargs="+", type=Path, help="plan files")
    parser.add_argument("--repeat", type=int, default=3, help="repetitions")
    parser.add_argument(
        "--always",
        type=int,
        default=0,
        metavar="N",
        help="plans of each file at a tolerance",
    )
    parser.add_argument(
        "--seed", type=int, default=20265, help="seed of the plans at a tolerance"
    )
    parser.add_argument(
        "--slow",
        type=int,
        default=4,
        help="plans of each file that are checked state by state",
    )


def main() -> None:
    """Run the benchmark."""
    options = arguments(__doc__, add)
    timings = [
        measure(load_plans(file), repeat=options.repeat, slow=options.slow)
        for file in options.file
    ]
    head = (
        "problem",
        "plans",
        "times",
        "ms per plan",
        "target",
        "",
        "times faster",
        "missed",
        "between",
    )
    rows = [
        (
            item.problem,
            str(item.plans),
            f"{item.times:.0f}",
            f"{item.ms:.2f}",
            *verdict(item.ms, TARGETS_MS.get(item.problem), at_most=True),
            f"{item.times_faster:.1f}",
            f"{item.missed:.1e}",
            f"{item.between:.1e}",
        )
        for item in timings
    ]
    tables = [table("CPU time of the verdict on one core", head, rows)]
    content = {"verdict": [vars(item) for item in timings]}
    if options.always:
        tests = [
            check_steps(load_plans(file), options.always, options.seed)
            for file in options.file
        ]
        differ = [(item.problem, str(item.plans), str(item.differ)) for item in tests]
        title = f"plans at a tolerance, judged every {', '.join(f'{1e6 * step:g}' for step in STEPS_S)} us"
        tables.append(table(title, ("problem", "plans", "validity differs"), differ))
        content["always"] = [vars(item) for item in tests]
    report(content, tables, as_json=options.json)


if __name__ == "__main__":
    main()
