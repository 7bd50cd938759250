"""Optimization from a straight line, without input plan."""

from dataclasses import dataclass

import numpy as np

from cnpgen.benchmark.benchmark_planner import BenchmarkPlanner, Plan, Setting
from cnpgen.plans.boundary_problems import plans_of_rows
from cnpgen.plans.plans import Plans
from cnpgen.problems.problem_record import ProblemRecord, open_problem
from cnpgen.refine.refine_plans import solve_plans


@dataclass(frozen=True)
class Solve(BenchmarkPlanner):
    """Sequential quadratic programming from a straight line, as ``cnpgen solve``."""

    def prepare(self, setting: Setting) -> Plan:
        """Load the kernels."""
        solve_plans(near_base(setting.problem), workers=1)
        return lambda problem: solve_plans(problem, workers=1).plans


def near_base(record: ProblemRecord) -> Plans:
    """Return a boundary problem for warming up: a small rotation of the first joint from the base configuration."""
    base = open_problem(record)[1].base
    goal, still = base.copy(), np.zeros((1, len(base)))
    goal[0] += 0.1
    ends = {"start_q": base[None], "goal_q": goal[None]}
    return plans_of_rows(record, {**ends, "start_dq": still, "start_ddq": still, "goal_dq": still})
