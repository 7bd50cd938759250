"""Options of the refiner."""

from dataclasses import asdict, dataclass

from cnpgen.documents import JsonObject
from cnpgen.errors import UsageError
from cnpgen.problems.objectives import read_objective
from cnpgen.refine.solver.sqp import DEFAULT_SETTINGS
from cnpgen.schema.argument_types import check_fields
from cnpgen.schema.arguments import (
    check_range,
    integer,
    not_negative,
    number,
    positive,
)

MAX_STAY_WITHIN = 1.0  # rad or m


@dataclass(frozen=True)
class RefineOptions:
    """Options of ``refine_plans`` and ``solve_plans``.

    Attributes:
        objective: "time": the problem's own objective; or the time with other terms,
            such as "effort", "effort=0.5" or "effort=1, jerk=0.1"
            (``cnpgen.problems.objectives.read_objective``).
        weight: Weight of these terms, or of the problem's centrifugal acceleration; by
            default as they are defined.
        max_iterations: Largest number of iterations on the coarse level; 0 only scales
            plans in time.
        tolerance: Relative change of the objective at which it has converged; further
            steps restore feasibility. Without an input plan a tenth of it applies,
            among obstacles a twentieth.
        deadline: Largest time per plan [s], or None. With a deadline results depend on
            the machine and its load.
        stay_within: Largest difference of every joint from the input path at the same
            phase [rad or m], or None. Input plans that the refiner cannot use as
            initial guesses have no such bound.
        time_limit: Time per plan [s] after which the search ends with the first valid
            plan, or None; 0 returns the first plan that the verdict accepts. Results
            with a limit above 0 depend on the machine and its load.

    Raises:
        UsageError: A value is invalid, or has no effect beside another one.
    """

    objective: str = "time"
    weight: float | None = None
    max_iterations: int = DEFAULT_SETTINGS.max_iterations
    tolerance: float = DEFAULT_SETTINGS.cost_tolerance
    deadline: float | None = None
    stay_within: float | None = None
    time_limit: float | None = None

    def __post_init__(self) -> None:
        check_fields(self)
        read_objective(self.objective)
        if self.weight is not None:
            not_negative("weight", self.weight)
            if "=" in self.objective:
                raise UsageError(
                    f"must be None: the objective {self.objective!r} has weights",
                    argument="weight",
                )
        integer("max_iterations", self.max_iterations, least=0)
        if not 0 < number("tolerance", self.tolerance) < 1:
            raise UsageError(
                f"must be above 0 and below 1, got {self.tolerance}",
                argument="tolerance",
            )
        if self.deadline is not None:
            positive("deadline", self.deadline, "s")
        if self.stay_within is not None:
            positive("stay_within", self.stay_within)
        if self.time_limit is not None:
            not_negative("time_limit", self.time_limit)
        self._check_combinations()
        check_range("stay_within", self.stay_within or 0.0, 0.0, MAX_STAY_WITHIN, "rad")

    def _check_combinations(self) -> None:
        """Raise UsageError for values that exclude each other, or that have no effect."""
        if self.time_limit is not None and self.deadline is not None:
            raise UsageError(
                "a time limit ends the search with a valid plan, a deadline in any case: choose one",
                concerns="time_limit",
            )
        usual = {"tolerance": DEFAULT_SETTINGS.cost_tolerance}
        for name in ("tolerance", "deadline", "stay_within"):
            if not self.max_iterations and getattr(self, name) != usual.get(name):
                raise UsageError(
                    "has no effect with 0 iterations, which only scale plans in time",
                    argument=name,
                )

    def document(self) -> JsonObject:
        """Return the options for JSON, without a deadline, a distance or a limit of None."""
        optional = {"deadline", "stay_within", "time_limit"}
        return {
            name: value
            for name, value in asdict(self).items()
            if name not in optional or value is not None
        }


DEFAULT_OPTIONS = RefineOptions()
