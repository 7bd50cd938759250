"""Accepted rows per second and core: the documentation's table of generator speeds, stage by stage.

The clock is the process's CPU time, so that other processes have little influence. Every repetition measures all
cases in turn. Rates are medians over the repetitions, ratios are medians of the ratios within one repetition.

    python benchmarks/generator.py
    python benchmarks/generator.py --backend compiled numpy --repeat 3
"""

import argparse
import time
from dataclasses import dataclass, field
from typing import Any

from common import (
    arguments,
    installed_recipes,
    median,
    progress,
    report,
    table,
    verdict,
)

from cnpgen.kernels.library import choose_backend
from cnpgen.pipelines.pipeline import load_pipeline
from cnpgen.pipelines.prepared import PreparedPipeline
from cnpgen.pipelines.stages.stage import (
    BLOCK_ROWS,
    CandidateBatch,
    Stage,
    StageFunction,
)

PIPELINES = (
    "airhockey-replan",
    "airhockey-hit",
    "heavy-object",
    "panda-cup",
    "ur5-wipe",
)
BLOCKS = {"compiled": 16, "numpy": 4}  # per repetition
TARGETS = {  # accepted rows per second and core
    ("airhockey-replan", "compiled"): 120_000,
    ("airhockey-replan", "numpy"): 12_000,
    ("heavy-object", "compiled"): 45_000,
    ("panda-cup", "compiled"): 20_000,
    ("ur5-wipe", "compiled"): 20_000,
}


@dataclass
class StageTime:
    """CPU time of one stage [s], and the numbers of candidates before and after it."""

    name: str
    seconds: float = 0.0
    entered: int = 0
    left: int = 0

    def timed(self, run: StageFunction) -> StageFunction:
        """Wrap the stage's function."""

        def timed(candidates: CandidateBatch, random: Any) -> None:
            self.entered += len(candidates.alive)
            start = time.process_time()
            run(candidates, random)
            self.seconds += time.process_time() - start
            self.left += len(candidates.alive)

        return timed


@dataclass
class Case:
    """Measurements of one pipeline on one backend.

    Attributes:
        rates: Accepted rows per second of CPU time, one per repetition.
        stages: Time of each stage and of the acceptance.
        total: Time of the blocks in which the stages were timed [s].
        rows: Accepted rows of these blocks.
        candidates: Candidates of these blocks.
    """

    pipeline: str
    backend: str
    prepared: PreparedPipeline
    next_block: int = 0
    rates: list[float] = field(default_factory=list)
    stages: list[StageTime] = field(default_factory=list)
    total: float = 0.0
    rows: int = 0
    candidates: int = 0

    @property
    def rate(self) -> float:
        """Median rate."""
        return median(self.rates)

    def make(self, blocks: int) -> tuple[float, int]:
        """Make fresh blocks; return the CPU time [s] and the number of candidates."""
        start, candidates = time.process_time(), 0
        for _ in range(blocks):
            candidates += self.prepared.block(
                1, "benchmark", self.next_block
            ).sampling.tried
            self.next_block += 1
        return time.process_time() - start, candidates


def prepare(pipeline: str, backend: str) -> Case:
    """Load a pipeline and run one block to warm it up."""
    chosen, cache_folder = choose_backend(backend)
    case = Case(
        pipeline,
        backend,
        PreparedPipeline(
            load_pipeline(pipeline), backend=chosen, cache_folder=cache_folder
        ),
    )
    case.make(1)
    return case


def measure_rates(cases: list[Case], repeat: int, blocks: dict[str, int]) -> None:
    """Measure all cases in turn, ``repeat`` times."""
    for number in range(repeat):
        progress(f"repetition {number + 1} of {repeat}")
        for case in cases:
            seconds, _ = case.make(blocks[case.backend])
            case.rates.append(blocks[case.backend] * BLOCK_ROWS / seconds)


def measure_stages(case: Case, blocks: int) -> None:
    """Time every stage of some blocks."""
    prepared = case.prepared
    stages, accept = prepared._stages, prepared._accept
    names = [
        _name(label, stage)
        for (label, _), stage in zip(stages, prepared.pipeline.stage, strict=True)
    ]
    case.stages = [StageTime(name) for name in [*names, "(acceptance)"]]
    timed = [
        stage.timed(run)
        for stage, run in zip(
            case.stages, [*(run for _, run in stages), accept], strict=True
        )
    ]
    prepared._stages = [
        (label, run) for (label, _), run in zip(stages, timed, strict=False)
    ]
    prepared._accept = timed[-1]
    case.total, case.candidates = case.make(blocks)
    case.rows = blocks * BLOCK_ROWS
    prepared._stages, prepared._accept = stages, accept


def _name(label: str, stage: Stage) -> str:
    """Name a stage by the kind in its label and by the options that distinguish stages of one kind."""
    details = [getattr(stage, key, None) for key in ("end", "judge")]
    return " ".join(
        [label.partition(". ")[2], *(str(detail) for detail in details if detail)]
    )


def rate_table(cases: list[Case]) -> str:
    rows = []
    for case in cases:
        first = next(other for other in cases if other.pipeline == case.pipeline)
        ratio = median(a / b for a, b in zip(first.rates, case.rates, strict=True))
        numbers = (
            f"{case.rate:,.0f}",
            f"{max(case.rates):,.0f}",
            f"{1e6 / case.rate:.2f}",
        )
        candidates = f"{case.candidates / case.rows:.3f}"
        target = TARGETS.get((case.pipeline, case.backend))
        rows.append(
            (
                case.pipeline,
                case.backend,
                *numbers,
                candidates,
                f"{ratio:.1f}",
                *verdict(case.rate, target),
            )
        )
    head = (
        "pipeline",
        "backend",
        "rows/s/core",
        "best",
        "us/row",
        "candidates/row",
        "times slower",
        "target",
        "",
    )
    return table(
        "Accepted rows per second of CPU time (median, and best repetition)",
        head,
        rows,
        left=2,
    )


def stage_table(case: Case) -> str:
    rows = [
        (stage.name, f"{100 * stage.seconds / case.total:.1f} %", f"{1e6 * stage.seconds / case.rows:.3f}",
         f"{100 * stage.left / max(stage.entered, 1):.2f} %")
        for stage in case.stages
    ]  # fmt: skip
    rest = case.total - sum(stage.seconds for stage in case.stages)
    rows.append(
        (
            "(batches, statistics, concatenation)",
            f"{100 * rest / case.total:.1f} %",
            f"{1e6 * rest / case.rows:.3f}",
            "",
        )
    )
    return table(
        f"{case.pipeline}, {case.backend}",
        ("stage", "share", "us/row", "accepted"),
        rows,
    )


def results(cases: list[Case]) -> dict[str, Any]:
    return {
        "cases": [
            {
                "pipeline": case.pipeline,
                "backend": case.backend,
                "rows_per_second": case.rate,
                "repetitions": case.rates,
                "candidates_per_row": case.candidates / case.rows,
                "target": TARGETS.get((case.pipeline, case.backend)),
                "stage_seconds": {
                    f"{number}. {stage.name}": stage.seconds
                    for number, stage in enumerate(case.stages, 1)
                },
                "total_seconds": case.total,
            }
            for case in cases
        ]
    }


def add_options(parser: argparse.ArgumentParser) -> None:
    parser.add_argument(
        "--pipeline",
        nargs="+",
        help="pipelines; by default all whose robots are installed",
    )
    parser.add_argument(
        "--backend",
        nargs="+",
        default=("compiled", "numpy"),
        choices=BLOCKS,
        help="backends",
    )
    parser.add_argument("--repeat", type=int, default=9, help="repetitions")
    parser.add_argument(
        "--blocks",
        type=int,
        help=f"blocks of {BLOCK_ROWS} rows per repetition; default {BLOCKS}",
    )


def main() -> None:
    options = arguments(__doc__, add_options)
    chosen = options.pipeline or installed_recipes(PIPELINES)
    blocks = {name: options.blocks or number for name, number in BLOCKS.items()}
    cases = [
        prepare(pipeline, backend) for pipeline in chosen for backend in options.backend
    ]
    measure_rates(cases, options.repeat, blocks)
    for case in cases:
        measure_stages(case, 2 * blocks[case.backend])
    report(
        results(cases),
        [rate_table(cases), *map(stage_table, cases)],
        as_json=options.json,
    )


if __name__ == "__main__":
    main()
