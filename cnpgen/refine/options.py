"""What users choose about refining."""

from dataclasses import asdict, dataclass
from typing import Any

from cnpgen.errors import UsageError, nearest
from cnpgen.refine.solver import sqp
from cnpgen.refine.solver.criterion import OBJECTIVES
from cnpgen.schema.arguments import integer, number


@dataclass(frozen=True)
class RefineOptions:
    """How to refine.

    Attributes:
        objective: "time": the problem's own objective, time and centrifugal acceleration; "effort" or "jerk" beside the
            time.
        weight: Weight of what is minimised beside the time; by default the problem's, or 1 for effort and jerk.
        max_iterations: Steps of the first pass; 0 only repairs plans by slowing them down.
        tolerance: Relative change of the objective below which it has settled: what follows only makes it feasible.
            From nothing a tenth of it counts, among obstacles a twentieth.
        deadline: How long refining a plan may take [s]; None for as long as it takes. What comes of it then depends on
            the machine and on what else it does.

    Raises:
        UsageError: A value makes no sense.
    """

    objective: str = "time"
    weight: float | None = None
    max_iterations: int = sqp.DEFAULT.max_iterations
    tolerance: float = sqp.DEFAULT.cost_tolerance
    deadline: float | None = None

    def __post_init__(self) -> None:
        if self.objective not in OBJECTIVES:
            expected = f"expected one of {', '.join(OBJECTIVES)}{nearest(self.objective, OBJECTIVES)}"
            raise UsageError(f"objective {self.objective!r} does not exist: {expected}")
        if self.weight is not None and number("weight=", self.weight) < 0:
            raise UsageError(f"weight= must not be negative, got {self.weight}")
        integer("max_iterations", self.max_iterations, least=0)
        if not 0 < number("tolerance=", self.tolerance) < 1:
            raise UsageError(f"tolerance= must be above 0 and below 1, got {self.tolerance}")
        if self.deadline is not None and number("deadline", self.deadline) <= 0:
            raise UsageError(f"the deadline must be above 0 s, got {self.deadline}")

    def said(self) -> dict[str, Any]:
        """Return the options for JSON; no deadline is not mentioned."""
        return {name: value for name, value in asdict(self).items() if name != "deadline" or value is not None}


DEFAULT = RefineOptions()
