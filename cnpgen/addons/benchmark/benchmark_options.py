"""Options of a benchmark run beside its suite, planners and plants."""

from dataclasses import dataclass
from pathlib import Path

from cnpgen.addons.benchmark.simulator.executed import PLANE_TOLERANCE_M
from cnpgen.schema.argument_types import check_fields
from cnpgen.schema.arguments import integer, not_negative, positive

MAX_REPETITIONS = 10_000


@dataclass(frozen=True)
class BenchmarkOptions:
    """Options of ``run_benchmark``.

    Attributes:
        environment: A clone of the Air Hockey Challenge's environment, which also
            executes plans, as the plant "challenge".
        time_limit: Planning time per problem [s]; later answers are not counted, and
            the planner's processes are ended.
        seed: Seed of random planners. Each problem and repetition has its own random
            generator.
        repeat: Number of repetitions of every problem.
        plane_tolerance: Maximum distance of the mallet of a successful hit from the
            table plane [m].
        reference: Planner with which the others are compared; default
            ``cnpgen+refine``, or the first one without it.
        engine: Engine of the workers, see ``make_dataset``; by default planners run on
            this machine.
        address: Address of the engine, see ``make_dataset``.
        replan: Whether to discard the earlier answers of the planners.

    Raises:
        UsageError: A value is invalid.
    """

    environment: str | Path | None = None
    time_limit: float = 60.0
    seed: int = 0
    repeat: int = 1
    plane_tolerance: float = PLANE_TOLERANCE_M
    reference: str | None = None
    engine: str | None = None
    address: str | None = None
    replan: bool = False

    def __post_init__(self) -> None:
        check_fields(self)
        positive("time_limit", self.time_limit, "s")
        not_negative("plane_tolerance", self.plane_tolerance)
        integer("seed", self.seed, least=0)
        integer("repeat", self.repeat, least=1, most=MAX_REPETITIONS)
