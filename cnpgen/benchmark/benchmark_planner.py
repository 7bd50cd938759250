"""What a planner is to the benchmark: boundary problems in, one by one; a plan or a trajectory out."""

from abc import ABC, abstractmethod
from collections.abc import Callable
from dataclasses import dataclass

from cnpgen.benchmark.trajectory import Trajectory
from cnpgen.plans.plans import Plans
from cnpgen.problems.problem_record import ProblemRecord

Answer = Plans | Trajectory | None
"""One plan, a trajectory that is sampled in time, or None where none was found."""

Plan = Callable[[Plans], Answer]
"""A function of one boundary problem: ``Plans`` of length 1 whose control points are nan."""


@dataclass(frozen=True)
class Setting:
    """What a planner is told before the first problem.

    Attributes:
        problem: What a valid motion is.
        model: Name of the shipped model for problems of this kind, or empty.
        time_limit: How long it may take for a problem [s]; who takes much longer is stopped.
        seed: For planners that draw random numbers.
    """

    problem: ProblemRecord
    model: str = ""
    time_limit: float = 60.0
    seed: int = 0


class BenchmarkPlanner(ABC):
    """A planner that can be compared; a frozen dataclass whose fields are declared with ``cnpgen.plugins.field``.

    Packages register theirs under the entry point ``cnpgen.planners``. Each runs in a process of its own: what it
    breaks, it breaks for itself.
    """

    def describe(self) -> str:
        """Say in a line what it does."""
        return (type(self).__doc__ or "").strip().partition("\n")[0]

    @abstractmethod
    def prepare(self, setting: Setting) -> Plan:
        """Load what is loaded once; the time that this takes does not count.

        Args:
            setting: The problem, and what it may take.

        Returns:
            What plans: called with one boundary problem at a time, its time counts.

        Raises:
            UsageError: It cannot plan for problems of this kind.
        """
