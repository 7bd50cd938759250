"""The paper's planner as cnpgen ships it: a network's plan, and the same plan refined."""

from dataclasses import dataclass

from cnpgen.benchmark.benchmark_planner import Answer, BenchmarkPlanner, Plan, Setting
from cnpgen.benchmark.planners.solve import near_base
from cnpgen.errors import UsageError
from cnpgen.planner.planner import Planner
from cnpgen.plans.plans import Plans
from cnpgen.refine.refine_plans import refine_plans


@dataclass(frozen=True)
class CNPB(BenchmarkPlanner):
    """The shipped model's plan, as the network gives it."""

    def prepare(self, setting: Setting) -> Plan:
        """Load the model."""
        if not setting.model:
            raise UsageError(f"no shipped model plans for these problems of {setting.problem.name!r}")
        planner = Planner(setting.model)

        def plan(problem: Plans) -> Plans:
            return planner.plan_batch(problem.boundary, sample_id=problem.sample_id, columns=problem.columns)

        base = planner.robot.base
        planner.plan(base, base)  # what is loaded at the first plan
        return plan


@dataclass(frozen=True)
class RefinedCNPB(BenchmarkPlanner):
    """The shipped model's plan, refined."""

    def prepare(self, setting: Setting) -> Plan:
        """Load the model and the refiner."""
        network = CNPB().prepare(setting)
        refine_plans(near_base(setting.problem), workers=1)

        def plan(problem: Plans) -> Answer:
            drafts = network(problem)
            assert isinstance(drafts, Plans)
            return refine_plans(drafts, workers=1).plans

        return plan
