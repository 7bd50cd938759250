"""Planners of cnpgen: optimization from a straight line, trained models without and with refining."""

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from cnpgen.addons.benchmark.benchmark_planner import (
    Answer,
    BenchmarkPlanner,
    Plan,
    Setting,
)
from cnpgen.errors import UsageError
from cnpgen.planner.planner import Planner
from cnpgen.plans.boundary_problems import plans_of_rows
from cnpgen.plans.plans import Plans
from cnpgen.problems.problem_record import ProblemRecord, open_problem
from cnpgen.refine.refine_plans import refine_plans, solve_plans
from cnpgen.schema.keys import field


@dataclass(frozen=True)
class Solve(BenchmarkPlanner):
    """Sequential quadratic programming from a straight line, as ``cnpgen solve``."""

    def prepare(self, setting: Setting) -> Plan:
        """Load the kernels."""
        solve_plans(near_base(setting.problem), workers=1)
        return lambda problem: solve_plans(problem, workers=1).plans


def near_base(record: ProblemRecord) -> Plans:
    """Return a boundary problem for warming up: a small rotation of the first joint from the base configuration."""
    base = open_problem(record)[1].home
    goal = base.copy()
    still = np.zeros((1, len(base)))
    goal[0] += 0.1
    ends = {"start_q": base[None], "goal_q": goal[None]}
    return plans_of_rows(
        record, {**ends, "start_dq": still, "start_ddq": still, "goal_dq": still}
    )


@dataclass(frozen=True)
class ShippedNetwork(BenchmarkPlanner):
    """Plan of the shipped model without refining."""

    def prepare(self, setting: Setting) -> Plan:
        """Load the model."""
        if not setting.model:
            raise UsageError(
                f"cnpgen ships no model for these problems of {setting.problem.name!r}"
            )
        return _batch_of_one(Planner(setting.model))


@dataclass(frozen=True)
class RefinedNetwork(BenchmarkPlanner):
    """Refined plan of the shipped model."""

    def prepare(self, setting: Setting) -> Plan:
        """Load the model and the refiner."""
        network = ShippedNetwork().prepare(setting)
        refine_plans(near_base(setting.problem), workers=1)

        def plan(problem: Plans) -> Answer:
            drafts = network(problem)
            assert isinstance(drafts, Plans)
            return refine_plans(drafts, workers=1).plans

        return plan


@dataclass(frozen=True)
class PaperNetwork(BenchmarkPlanner):
    """Plan of a model trained as published (train --preset paper), from a model file."""

    model: str = field("path of the model file, or name of a shipped model", default="")

    def prepare(self, setting: Setting) -> Plan:
        """Load the model, which must be for the problem of the suite."""
        if not self.model:
            raise UsageError(
                "cnp-b-paper needs a model file: pass --set cnp-b-paper.model=FILE;"
                " 'cnpgen train --preset paper' makes one"
            )
        planner = Planner(
            Path(self.model) if Path(self.model).suffix else self.model,
            scale_time=False,
        )
        theirs = planner.model.problem
        if theirs.comparable_sha256 != setting.problem.comparable_sha256:
            differs = ", ".join(setting.problem.differences(theirs)[:4])
            raise UsageError(
                f"the model {self.model} is for another problem, they differ in {differs}: train one for"
                f" {setting.problem.name!r} ('cnpgen train --preset paper')"
            )
        return _batch_of_one(planner)


def _batch_of_one(planner: Planner) -> Callable[[Plans], Plans]:
    """Return the function that plans one boundary problem.

    Load its kernels before planning is timed.
    """

    def plan(problem: Plans) -> Plans:
        return planner.plan_batch(
            problem.boundary, sample_id=problem.sample_id, columns=problem.columns
        )

    base = planner.robot.home
    nominal = planner.robot.nominal_parameters
    planner.plan(base, base, parameters=nominal if len(nominal) else None)
    return plan
