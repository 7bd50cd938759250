"""Running a benchmark: every planner on every problem, judged and, if wanted, executed; what is finished stays."""

from collections.abc import Callable, Generator, Sequence
from contextlib import closing
from dataclasses import asdict, dataclass
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from cnpgen.benchmark.benchmark_planner import Setting
from cnpgen.benchmark.execution import execute_answer
from cnpgen.benchmark.hypothesis_tests import summarise_results
from cnpgen.benchmark.judging import judge_answer
from cnpgen.benchmark.process import Attempt, PlannerProcess
from cnpgen.benchmark.replanning_scenario import Lead
from cnpgen.benchmark.results import Results, answer_from_dict, open_results
from cnpgen.benchmark.simulator.challenge import challenge_plant, check_challenge
from cnpgen.benchmark.simulator.execute import load_mujoco
from cnpgen.benchmark.simulator.plant import Plant, as_plant
from cnpgen.benchmark.suite import Suite, load_suite
from cnpgen.errors import UsageError, nearest
from cnpgen.judges.plans.verdict import Verdict
from cnpgen.machine.engine import Engine, WorkerPool, assembled
from cnpgen.machine.versions import __version__
from cnpgen.plans.plans import Plans
from cnpgen.problems.problem import resolved
from cnpgen.problems.problem_record import open_problem
from cnpgen.schema import registry
from cnpgen.schema.arguments import integer, number
from cnpgen.store.files.documents import canonical_sha256, plain

PART = 4  # problems that one of several planners of a kind plans for: its start takes some seconds
FASTEST = ("cnp-b", "cnp-b+refine", "solve")  # what runs where nothing else is said: the others take longer

Progress = Callable[[str, int, int], None]
"""Called with what is being done, how many steps it has, and how many of them are done."""

Numbered = tuple[int, Plans]
"""The number of a problem and the problem."""

Rows = Generator[dict[str, Any], None, None]
"""What became of problems, as it is known."""


@dataclass(frozen=True, eq=False)
class Benchmark:
    """What planners did with the problems of a suite.

    Attributes:
        suite: The suite.
        problems: Its problems.
        lead: Of turns, the first motions that lead to them.
        results: Planner -> its rows, one for each problem, in their order (docs/benchmark.md).
        plants: The plants that plans were executed on in this run.
    """

    suite: Suite
    problems: Plans
    lead: Lead | None
    results: dict[str, list[dict[str, Any]]]
    plants: tuple[Plant, ...] = ()

    def __repr__(self) -> str:
        return f"<{self.suite.name}: {len(self.problems)} problems, {', '.join(self.results)}>"

    @property
    def executions(self) -> tuple[str, ...]:
        """Names of the plants; one empty name where nothing was executed."""
        return tuple(plant.name for plant in self.plants) or ("",)

    def summary(self, plant: str = "") -> dict[str, dict[str, dict[str, dict[str, Any]]]]:
        """Return ratios, medians, quartiles and p-values of every planner; see ``summarise_results``.

        Args:
            plant: The plant whose executions count; none by default.
        """
        return summarise_results(self.results, plant)


def run_benchmark(
    suite: str | Path | Suite,
    folder: str | Path,
    *,
    planners: Sequence[str] = FASTEST,
    n: int | None = None,
    plants: Sequence[str | Plant] = (),
    environment: str | Path | None = None,
    time_limit: float = 60.0,
    workers: int | None = None,
    engine: str | None = None,
    address: str | None = None,
    force: bool = False,
    progress: Progress | None = None,
) -> Benchmark:
    """Compare planners; a run that was interrupted goes on where it was.

    Every planner plans for one problem after the other, in a process of its own on one thread: its times are not
    disturbed by others of the same run. Plans are executed in as many processes as are wanted. With an engine, its
    workers plan, too, each for other problems: planning times are then those of a shared machine.

    Args:
        suite: A suite, or the name or the file of one, or of a dataset.
        folder: Where results are kept, a file per planner; made if it is not there.
        planners: Names of planners.
        n: Only the first so many problems; of a random suite it may be more.
        plants: Plants that plans are executed on; none by default.
        environment: A clone of the Air Hockey Challenge's environment; plans are executed there, too, as by a plant
            that is called "challenge".
        time_limit: How long a planner may take for a problem [s]; those that cannot tell the time may take longer.
        workers: Processes that execute plans, and with an engine plan; default one per available core.
        engine: Where the workers run, as of ``make_dataset``; by default plans are made on this machine, one by one.
        address: Likewise.
        force: Whether results of another suite, version or time limit may be thrown away.
        progress: Called after every problem.

    Raises:
        UsageError: There is no such planner, plant or environment, it cannot plan for such problems, or the folder
            has results of another run.
        RecipeError: The suite has mistakes.
        MachineError: MuJoCo is missing, the results cannot be written, or a cluster cannot be reached.
    """
    where = Engine(engine, address, workers)
    loaded = suite if isinstance(suite, Suite) else load_suite(suite)
    _check_planners(planners)
    robots = tuple(as_plant(plant) for plant in plants)
    if environment is not None:
        robots += (challenge_plant(environment),)
    if robots:
        load_mujoco()
    limit = number("time_limit", time_limit)
    if limit <= 0:
        raise UsageError(f"must be above 0 s, got {time_limit:g} s", argument="time_limit")
    problems, lead = loaded.problems(None if n is None else integer("n", n, least=1))
    if environment is not None:
        check_challenge(*open_problem(problems.problem))
    setting = Setting(problems.problem, loaded.model, limit)
    place = Path(folder)
    place.mkdir(parents=True, exist_ok=True)
    tell = progress or (lambda *_: None)
    rows = {}
    with assembled(where, len(problems)) as pool:
        for name in planners:
            results = open_results(place / f"{name}.jsonl", _identity(loaded, name, limit), discard=force)
            planned = _planned_here if engine is None else partial(_planned_by, pool)
            _plan_all(results, problems, partial(planned, name, setting), partial(tell, f"{name} plans"))
            for plant in robots:
                _execute_all(
                    results, plant, problems, lead, pool=pool, tell=partial(tell, f"{name}, {plant.name} plant")
                )
            rows[name] = [results.rows[index] for index in range(len(problems))]
    return Benchmark(loaded, problems, lead, rows, robots)


def _check_planners(planners: Sequence[str]) -> None:
    """Refuse names before any work."""
    known = registry.names(registry.PLANNERS)
    if not planners:
        raise UsageError(f"no planners, expected some of {', '.join(known)}")
    for name in planners:
        if name not in known:
            raise UsageError(f"unknown planner {name!r}{nearest(name, known)}; known: {', '.join(known)}")


def _identity(suite: Suite, planner: str, time_limit: float) -> dict[str, Any]:
    """Say what distinguishes the results of a planner from others."""
    digest = canonical_sha256(plain(resolved(suite)))
    return {
        "suite": suite.name,
        "suite_version": suite.version,
        "suite_sha256": digest,
        "planner": planner,
        "cnpgen": __version__,
        "time_limit_s": time_limit,
    }


def _plan_all(
    results: Results, problems: Plans, planned: Callable[[list[Numbered]], Rows], tell: Callable[[int, int], None]
) -> None:
    """Let a planner plan for the problems that have no result yet."""
    waiting = [(index, problems[index]) for index in results.missing(len(problems))]
    if not waiting:
        return
    with closing(planned(waiting)) as rows:
        for done, row in enumerate(rows, start=len(problems) - len(waiting) + 1):
            results.append(row)
            tell(len(problems), done)


def _planned_here(name: str, setting: Setting, waiting: list[Numbered]) -> Rows:
    """Yield what becomes of problems, one after the other."""
    process = PlannerProcess(name, setting)
    try:
        for index, problem in waiting:
            yield _row(index, problem, process.plan(problem))
    finally:
        process.stop()


def _planned_by(pool: WorkerPool, name: str, setting: Setting, waiting: list[Numbered]) -> Rows:
    """Yield what becomes of problems that are shared out to a worker pool, a few at a time."""
    size = min(PART, -(-len(waiting) // pool.size))
    parts = (waiting[first : first + size] for first in range(0, len(waiting), size))
    with closing(pool.distribute(partial(_planned_part, name, setting), parts)) as found:
        for rows in found:
            yield from ({**row, "planners_at_once": pool.size} for row in rows)


def _planned_part(name: str, setting: Setting, part: list[Numbered]) -> list[dict[str, Any]]:
    return list(_planned_here(name, setting, part))


def _row(index: int, problem: Plans, attempt: Attempt) -> dict[str, Any]:
    """Write down what became of a problem."""
    row: dict[str, Any] = {
        "problem": index,
        "ending": str(attempt.ending),
        "planning_s": attempt.seconds,
        "planning_cpu_s": attempt.cpu_seconds,
        "error": attempt.error,
        "answer": attempt.answer,
    }
    if attempt.answer is not None:  # by the problem's boundary conditions, not by those that came with the answer
        row["verdict"] = verdict_to_dict(judge_answer(problem, answer_from_dict(problem, attempt.answer)))
    return row


def verdict_to_dict(verdict: Verdict) -> dict[str, Any]:
    """Return what is kept of a verdict: reason, paper's rule, metrics, and the excess of every condition."""
    excess = {name: margin.severity for name, margin in verdict.margins.items()}
    return {
        "valid": verdict.valid,
        "reason": str(verdict.reason),
        "paper": asdict(verdict.paper),
        "metrics": verdict.metrics.to_dict(),
        "value_over_bound": {
            name: abs(margin.value) / abs(margin.bound)
            for name, margin in verdict.margins.items()
            if margin.bound and np.isfinite(margin.value / margin.bound)
        },
        "severity": {name: value for name, value in excess.items() if np.isfinite(value)},
    }


def _execute_all(
    results: Results,
    plant: Plant,
    problems: Plans,
    lead: Lead | None,
    *,
    pool: WorkerPool,
    tell: Callable[[int, int], None],
) -> None:
    """Execute the plans that were not executed on this plant yet."""
    waiting = list(results.unexecuted(plant.name, len(problems)))
    if not waiting:
        return
    tasks = ((problems[index], results.rows[index]["answer"], lead and lead[index]) for index in waiting)
    with closing(pool.distribute(partial(execute_answer, plant=plant), tasks, ordered=True)) as found:
        for done, (index, executed) in enumerate(zip(waiting, found, strict=True), start=1):
            results.append({"problem": index, "executed": {plant.name: executed.to_dict()}})
            tell(len(waiting), done)
