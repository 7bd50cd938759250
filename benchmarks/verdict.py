"""CPU time of the verdict per plan, beside the same check with one state of Pinocchio and Coal at a time.

Both look at the same moments; the second measures every constraint at every one of them. The verdict's time is the
median over repetitions of the mean over all plans; both ways take turns on the plans that they share.

    cnpgen solve airhockey-hit --n 100 -o hits.h5
    python benchmarks/verdict.py hits.h5
"""

import argparse
import time
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from common import arguments, median, report, table, verdict

from cnpgen.judges.plans import Verdict, judge
from cnpgen.judges.plans.course import course
from cnpgen.judges.plans.sampling import sample, time_table
from cnpgen.plans import Plans, load_plans, open_problem
from cnpgen.problems.obstacles import obstacle_tops
from cnpgen.world.state import World

STEP = 1e-3  # s
TARGETS = {"airhockey": 3.0, "heavy-object": 8.0}  # ms per plan


@dataclass(frozen=True)
class Timing:
    """What was measured of one file.

    Attributes:
        problem: Name of the problem.
        plans: Number of plans.
        moments: Moments per plan that were looked at, on average.
        ms: CPU time of the verdict per plan [ms].
        times_faster: CPU time of the check state by state, in times the verdict's.
        difference: Largest difference between both of how far a condition is exceeded, in what it allows; without
            contacts, of which the verdict takes a closer look.
    """

    problem: str
    plans: int
    moments: float
    ms: float
    times_faster: float
    difference: float


def judged(plans: Plans) -> tuple[list[Verdict], float]:
    """Judge plans; return the verdicts and the CPU time [s]."""
    problem, robot = open_problem(plans.problem)
    ends = plans.columns["start_xyz"], plans.columns["goal_xyz"]
    start = time.process_time()
    found = judge(problem, robot, plans.motion, plans.boundary, *ends, step=STEP)
    return found, time.process_time() - start


def state_by_state(plans: Plans) -> tuple[list[dict[str, float]], float]:
    """Measure every constraint at every moment; return condition -> severity of each plan, and the CPU time [s]."""
    problem, robot = open_problem(plans.problem)
    world = World(robot, problem.obstacle, problem.object_size)
    tops = obstacle_tops(problem, plans.columns["start_xyz"], plans.columns["goal_xyz"])
    start, found = time.process_time(), []
    for index, motion in enumerate(plans.motion[[i]] for i in range(len(plans))):
        moments = sample(time_table(motion.rate[0], motion.degree), STEP, 13)
        assert moments is not None
        states = course(motion, moments.s)
        severity: dict[str, float] = {}
        for k, phase in enumerate(moments.s):
            world.set_state(*(values[:, k].copy() for values in (states.q, states.dq, states.ddq)), tops[index])
            for constraint in problem.constraint:
                for condition in constraint.measured(world):
                    wider = constraint.funnel(condition, np.array([phase]), plans.columns["start_xyz"][index])
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
    ratios, difference = [], 0.0
    for _ in range(repeat):
        fast, slowly = judged(few)[1], state_by_state(few)
        ratios.append(slowly[1] / fast)
        for found, expected in zip(verdicts, slowly[0], strict=False):
            for name in expected.keys() - {"object contact"}:
                difference = max(difference, abs(found.margins[name].severity - expected[name]))
    moments = float(np.mean([found.samples for found in verdicts]))
    return Timing(plans.problem.name, len(plans), moments, 1e3 * median(times), median(ratios), difference)


def add(parser: argparse.ArgumentParser) -> None:
    """Add the arguments."""
    parser.add_argument("file", nargs="+", type=Path, help="files of plans")
    parser.add_argument("--repeat", type=int, default=3, help="repetitions")
    parser.add_argument("--slow", type=int, default=4, help="plans of each file that are also checked state by state")


def main() -> None:
    """Run the benchmark."""
    options = arguments(__doc__, add)
    found = [measure(load_plans(file), repeat=options.repeat, slow=options.slow) for file in options.file]
    head = ("problem", "plans", "moments", "ms per plan", "target", "", "times faster", "difference")
    rows = [
        (
            item.problem,
            str(item.plans),
            f"{item.moments:.0f}",
            f"{item.ms:.2f}",
            *verdict(item.ms, TARGETS.get(item.problem), at_most=True),
            f"{item.times_faster:.1f}",
            f"{item.difference:.1e}",
        )
        for item in found
    ]
    tables = [table("the verdict of a plan, CPU time on one core", head, rows)]
    report({"verdict": [vars(item) for item in found]}, tables, as_json=options.json)


if __name__ == "__main__":
    main()
