"""Shipped models as planners: the plan of the network, and the refined plan."""

from dataclasses import dataclass

from cnpgen.benchmark.benchmark_planner import Answer, BenchmarkPlanner, Plan, Setting
from cnpgen.benchmark.planners.solve import near_base
from cnpgen.errors import UsageError
from cnpgen.planner.planner import Planner
from cnpgen.plans.plans import Plans
from cnpgen.refine.refine_plans import refine_plans


@dataclass(frozen=True)
class CNPB(BenchmarkPlanner):
    """Plan of the shipped model without refining."""

    def prepare(self, setting: Setting) -> Plan:
        """Load the model."""
        if not setting.model:
            raise UsageError(f"cnpgen ships no model for these problems of {setting.problem.name!r}")
        planner = Planner(setting.model)

        def plan(problem: Plans) -> Plans:
            return planner.plan_batch(problem.boundary, sample_id=problem.sample_id, columns=problem.columns)

        base = planner.robot.base
        planner.plan(base, base)  # load kernels before planning is timed
        return plan


@dataclass(frozen=True)
class RefinedCNPB(BenchmarkPlanner):
    """Refined plan of the shipped model."""

    def prepare(self, setting: Setting) -> Plan:
        """Load the model and the refiner."""
        network = CNPB().prepare(setting)
        refine_plans(near_base(setting.problem), workers=1)

        def plan(problem: Plans) -> Answer:
            drafts = network(problem)
            assert isinstance(drafts, Plans)
            return refine_plans(drafts, workers=1).plans

        return plan
