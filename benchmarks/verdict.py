"""CPU time of the verdict per plan, beside the same check with one state of Pinocchio and Coal at a time.

The second measures every constraint at all times of the time grid, and looks at nothing between them. The verdict's
time is the median over repetitions of the mean over all plans; both ways take turns on the plans that they share.

With ``--always N``, N plans of each file are made to lie at a tolerance, a hundred-thousandth of it on either side, and
judged at ever finer steps, and as with early exit as the refiner does: whether they are valid must not depend on that.

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
from cnpgen.problems.obstacles import obstacle_poses_of
from cnpgen.problems.problem import Problem
from cnpgen.trajectory.spline_motion import Motion
from cnpgen.world.world import World

STEP = 1e-3  # s
STEPS = (1e-3, 1e-4, 1e-5)  # s
NEAR = 1e-5  # of what is allowed: so near to a tolerance do plans lie
EXCEEDED = 1e-6  # in its unit: so much must a condition be exceeded by for a plan to lie at its tolerance
TARGETS = {"airhockey": 3.0, "heavy-object": 8.0}  # ms per plan


@dataclass(frozen=True)
class Timing:
    """Measurements of one file.

    Attributes:
        problem: Name of the problem.
        plans: Number of plans.
        times: Mean number of evaluated times per plan.
        ms: CPU time of the verdict per plan [ms].
        times_faster: CPU time of the check state by state, in times the verdict's.
        missed: How much more than the verdict the check state by state saw at most, in what is allowed.
        between: How much more the verdict saw between times.
    """

    problem: str
    plans: int
    times: float
    ms: float
    times_faster: float
    missed: float
    between: float


def judged(plans: Plans) -> tuple[list[Verdict], float]:
    """Judge plans; return the verdicts and the CPU time [s]."""
    problem, robot = open_problem(plans.problem)
    ends = plans.columns["start_xyz"], plans.columns["goal_xyz"]
    start = time.process_time()
    found = judge(problem, robot, plans.motion, plans.boundary, *ends, step=STEP)
    return found, time.process_time() - start


def state_by_state(plans: Plans) -> tuple[list[dict[str, float]], float]:
    """Measure every constraint at all times; return condition -> severity of each plan, and the CPU time [s]."""
    problem, robot = open_problem(plans.problem)
    world = World(robot, problem.obstacle, problem.object_size)
    obstacle_poses = obstacle_poses_of(problem, plans.columns["start_xyz"], plans.columns["goal_xyz"])
    start, found = time.process_time(), []
    for index, motion in enumerate(plans.motion[[i]] for i in range(len(plans))):
        times = sample(time_table(motion.rate[0], motion.degree), STEP, 13)
        assert times is not None
        states = evaluate_trajectory(motion, times.s)
        severity: dict[str, float] = {}
        for k, phase in enumerate(times.s):
            q, dq, ddq = (values[:, k].copy() for values in (states.q, states.dq, states.ddq))
            world.set_state(q, dq, ddq, obstacle_poses[index])
            for constraint in problem.constraint:
                for condition in constraint.measured(world):
                    wider = constraint.bound_relaxation(condition, np.array([phase]), plans.columns["start_xyz"][index])
                    g = np.array(condition.g, float)
                    excess = np.maximum(condition.lower - g, g - condition.upper) - wider
                    worst = float(np.max(excess / constraint.allowed(condition)))
                    severity[condition.name] = max(severity.get(condition.name, -np.inf), worst)
        found.append(severity)
    return found, time.process_time() - start


def measure(plans: Plans, *, repeat: int, slow: int) -> Timing:
    """Measure one file."""
    few = plans[:slow]
    verdicts, _ = judged(plans)  # warms up, too
    times = [judged(plans)[1] / len(plans) for _ in range(repeat)]
    ratios, missed, between = [], 0.0, 0.0
    for _ in range(repeat):
        fast, slowly = judged(few)[1], state_by_state(few)
        ratios.append(slowly[1] / fast)
        for found, expected in zip(verdicts, slowly[0], strict=False):
            for name, severity in expected.items():
                missed = max(missed, severity - found.margins[name].severity)
                between = max(between, found.margins[name].severity - severity)
    samples = float(np.mean([found.samples for found in verdicts]))
    return Timing(plans.problem.name, len(plans), samples, 1e3 * median(times), median(ratios), missed, between)


@dataclass(frozen=True)
class Always:
    """Results of plans at a tolerance.

    Attributes:
        problem: Name of the problem.
        plans: Number of plans.
        differ: How many of them are valid at one step, or as with early exit as the refiner looks, and not at another.
    """

    problem: str
    plans: int
    differ: int


def at_the_tolerance(problem: Problem, margin: Margin, by: float) -> Problem:
    """Return the problem with one of its constraints alone, which allows the share ``by`` more than is exceeded."""
    share = margin.violation / margin.tolerance * (1 + by)
    found = [each for each in problem.constraint if each.reason == margin.reason]
    only = [replace(each, tolerance=each.tolerance * share) for each in found]
    return replace(problem, constraint=tuple(only))


def always(plans: Plans, count: int, seed: int) -> Always:
    """Bend plans a little, make a tolerance of what one condition is exceeded by, and judge them at every step."""
    problem, robot = open_problem(plans.problem)
    random = np.random.default_rng(seed)
    differ = 0
    for k in range(count):
        given = plans[[k % len(plans)]]
        path = given.path_control_points.copy()
        path[:, 3:-3] += random.uniform(-0.02, 0.02, path[:, 3:-3].shape)
        motion = Motion(path, given.rate_control_points)
        rest = motion, given.boundary, given.columns["start_xyz"], given.columns["goal_xyz"]
        margins = judge(problem, robot, *rest, step=STEP)[0].margins
        exceeded = [
            name for name, each in margins.items() if each.reason != Reason.BOUNDARY and each.violation > EXCEEDED
        ]
        name, near = exceeded[random.integers(len(exceeded))], problem
        for _ in range(4):  # each time more exactly, since it decides
            near = at_the_tolerance(near, judge(near, robot, *rest, step=STEP)[0].margins[name], 0.0)
        by = NEAR if k % 2 else -NEAR
        last = at_the_tolerance(near, judge(near, robot, *rest, step=STEP)[0].margins[name], by)
        said = {judge(last, robot, *rest, step=step)[0].valid for step in STEPS}
        differ += len(said | {Judge(last, robot)(*rest, early_exit=True)[0].valid}) > 1
    return Always(plans.problem.name, count, differ)


def add(parser: argparse.ArgumentParser) -> None:
    """Add the arguments."""
    parser.add_argument("file", nargs="+", type=Path, help="files of plans")
    parser.add_argument("--repeat", type=int, default=3, help="repetitions")
    parser.add_argument("--always", type=int, default=0, metavar="N", help="plans of each file at a tolerance")
    parser.add_argument("--seed", type=int, default=20265, help="of the plans at a tolerance")
    parser.add_argument("--slow", type=int, default=4, help="plans of each file that are also checked state by state")


def main() -> None:
    """Run the benchmark."""
    options = arguments(__doc__, add)
    found = [measure(load_plans(file), repeat=options.repeat, slow=options.slow) for file in options.file]
    head = ("problem", "plans", "times", "ms per plan", "target", "", "times faster", "missed", "between")
    rows = [
        (
            item.problem,
            str(item.plans),
            f"{item.times:.0f}",
            f"{item.ms:.2f}",
            *verdict(item.ms, TARGETS.get(item.problem), at_most=True),
            f"{item.times_faster:.1f}",
            f"{item.missed:.1e}",
            f"{item.between:.1e}",
        )
        for item in found
    ]
    tables = [table("the verdict of a plan, CPU time on one core", head, rows)]
    content = {"verdict": [vars(item) for item in found]}
    if options.always:
        steps = [always(load_plans(file), options.always, options.seed) for file in options.file]
        differ = [(item.problem, str(item.plans), str(item.differ)) for item in steps]
        title = f"plans at a tolerance, judged every {', '.join(f'{1e6 * step:g}' for step in STEPS)} us"
        tables.append(table(title, ("problem", "plans", "differ from step to step"), differ))
        content["always"] = [vars(item) for item in steps]
    report(content, tables, as_json=options.json)


if __name__ == "__main__":
    main()
