"""Plans: motions for boundary problems, and their file format."""

from cnpgen.plans.format import PlanStatus
from cnpgen.plans.join import concatenate
from cnpgen.plans.plan_file import load_plans, save_plans
from cnpgen.plans.plans import PlanIndexError, Plans, make_plans, screen
from cnpgen.problems.problem_record import ProblemRecord, open_problem, record_problem

__all__ = [
    "PlanIndexError",
    "PlanStatus",
    "Plans",
    "ProblemRecord",
    "concatenate",
    "load_plans",
    "make_plans",
    "open_problem",
    "record_problem",
    "save_plans",
    "screen",
]
