"""Benchmark runs: every planner on every problem, judged and optionally executed; finished problems are kept."""

from collections.abc import Callable, Generator, Sequence
from contextlib import closing
from dataclasses import asdict, dataclass
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from cnpgen.benchmark.benchmark_planner import Setting
from cnpgen.benchmark.execution import execute_answer
from cnpgen.benchmark.hypothesis_tests import summarize_results
from cnpgen.benchmark.judging import judge_answer
from cnpgen.benchmark.process import PlannerProcess, PlanningOutcome
from cnpgen.benchmark.replanning_scenario import ExecutedPrefix
from cnpgen.benchmark.results_file import Results, answer_from_dict, open_results
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
from cnpgen.schema.argument_types import checked_arguments
from cnpgen.schema.arguments import concerning, integer, number
from cnpgen.store.files.documents import canonical_sha256, plain

PROBLEMS_PER_TASK = 4  # of a worker; starting a planner takes some seconds
FASTEST = ("cnp-b", "cnp-b+refine", "solve")  # default; the others take longer

Progress = Callable[[str, int, int], None]
"""Called with the activity, its number of steps, and the number of finished steps."""

Numbered = tuple[int, Plans]
"""The number of a problem and the problem."""

Rows = Generator[dict[str, Any], None, None]
"""Rows of results, yielded as they are finished."""


@dataclass(frozen=True, eq=False)
class Benchmark:
    """Results of planners on the problems of a suite.

    Attributes:
        suite: The suite.
        problems: Its problems.
        prefix: Of replanning scenarios, the prefixes of the first motions.
        results: Planner -> its rows, one for each problem, in their order ('cnpgen docs benchmark').
        plants: Plants that executed plans in this run.
    """

    suite: Suite
    problems: Plans
    prefix: ExecutedPrefix | None
    results: dict[str, list[dict[str, Any]]]
    plants: tuple[Plant, ...] = ()

    def __repr__(self) -> str:
        return f"<{self.suite.name}: {len(self.problems)} problems, {', '.join(self.results)}>"

    @property
    def executions(self) -> tuple[str, ...]:
        """Names of the plants; one empty name without execution."""
        return tuple(plant.name for plant in self.plants) or ("",)

    @checked_arguments
    def summary(self, plant: str = "") -> dict[str, dict[str, dict[str, dict[str, Any]]]]:
        """Return ratios, medians, quartiles and p-values of every planner; see ``summarize_results``.

        Args:
            plant: Name of the plant; empty for plans only.
        """
        return summarize_results(self.results, plant)


@checked_arguments
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
    """Compare planners; an interrupted run resumes.

    Every planner runs in its own process on one thread, one problem after the other, so planning times are undisturbed.
    Plans are executed in ``workers`` processes. With an engine, its workers also plan, each for other problems;
    planning times are then those of a shared machine.

    Args:
        suite: A suite, or the name or file of a suite or dataset.
        folder: Folder for results, one file per planner; created if missing.
        planners: Names of planners.
        n: Number of problems, the first ones; random suites may have more than the recipe.
        plants: Plants that execute plans; none by default.
        environment: A clone of the Air Hockey Challenge's environment, which also executes plans, as the plant
            "challenge".
        time_limit: Planning time per problem [s]; planners that ignore it may take longer.
        workers: Processes that execute plans and, with an engine, plan; default one per available core.
        engine: Engine of the workers, see ``make_dataset``; by default planners run on this machine.
        address: Address of the engine, see ``make_dataset``.
        force: Whether to overwrite results of another suite, version or time limit.
        progress: Called after every problem.

    Raises:
        UsageError: A planner, plant or environment is unknown or unsuitable, or the folder has results of another
            run.
        RecipeError: The suite has mistakes.
        MachineError: MuJoCo is missing, the results cannot be written, or a cluster cannot be reached.
    """
    where = Engine(engine, address, workers)
    with concerning("suite"):
        loaded = suite if isinstance(suite, Suite) else load_suite(suite)
    _check_planners(planners)
    robots = tuple(as_plant(plant, argument="plants") for plant in plants)
    if environment is not None:
        robots += (challenge_plant(environment),)
    if robots:
        load_mujoco()
    limit = number("time_limit", time_limit)
    if limit <= 0:
        raise UsageError(f"must be above 0 s, got {time_limit:g} s", argument="time_limit")
    problems, prefix = loaded.problems(None if n is None else integer("n", n, least=1))
    if environment is not None:
        check_challenge(*open_problem(problems.problem))
    setting = Setting(problems.problem, loaded.model, limit)
    place = Path(folder)
    if place.exists() and not place.is_dir():
        raise UsageError(f"must be a folder, {place} is a file", argument="folder")
    place.mkdir(parents=True, exist_ok=True)
    report = progress or (lambda *_: None)
    rows = {}
    with assembled(where, len(problems)) as pool:
        for name in planners:
            results = open_results(place / f"{name}.jsonl", _identity(loaded, name, limit), overwrite=force)
            planned = _plan_locally if engine is None else partial(_plan_in_pool, pool)
            _plan_all(results, problems, partial(planned, name, setting), partial(report, f"{name} plans"))
            for plant in robots:
                _execute_all(
                    results, plant, problems, prefix, pool=pool, report=partial(report, f"{name}, {plant.name} plant")
                )
            rows[name] = [results.rows[index] for index in range(len(problems))]
    return Benchmark(loaded, problems, prefix, rows, robots)


def _check_planners(planners: Sequence[str]) -> None:
    """Check names before any work."""
    known = registry.names(registry.PLANNERS)
    if not planners:
        raise UsageError(f"no planners, expected some of {', '.join(known)}", concerns="planners")
    for name in planners:
        if not isinstance(name, str):
            raise UsageError(f"must be names of planners, got {name!r:.100}", argument="planners")
        if name not in known:
            raise UsageError(
                f"unknown planner {name!r}{nearest(name, known)}; known: {', '.join(known)}", concerns="planners"
            )


def _identity(suite: Suite, planner: str, time_limit: float) -> dict[str, Any]:
    """Return the identity of the results of a planner."""
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
    results: Results, problems: Plans, planned: Callable[[list[Numbered]], Rows], report: Callable[[int, int], None]
) -> None:
    """Plan for the problems without result."""
    waiting = [(index, problems[index]) for index in results.missing(len(problems))]
    if not waiting:
        return
    with closing(planned(waiting)) as rows:
        for done, row in enumerate(rows, start=len(problems) - len(waiting) + 1):
            results.append(row)
            report(len(problems), done)


def _plan_locally(name: str, setting: Setting, waiting: list[Numbered]) -> Rows:
    """Yield the rows of problems, one after the other."""
    process = PlannerProcess(name, setting)
    try:
        for index, problem in waiting:
            yield _row(index, problem, process.plan(problem))
    finally:
        process.stop()


def _plan_in_pool(pool: WorkerPool, name: str, setting: Setting, waiting: list[Numbered]) -> Rows:
    """Yield the rows of problems that are distributed over a worker pool."""
    size = min(PROBLEMS_PER_TASK, -(-len(waiting) // pool.size))
    parts = (waiting[first : first + size] for first in range(0, len(waiting), size))
    with closing(pool.distribute(partial(_plan_task, name, setting), parts)) as results:
        for rows in results:
            yield from ({**row, "planners_at_once": pool.size} for row in rows)


def _plan_task(name: str, setting: Setting, part: list[Numbered]) -> list[dict[str, Any]]:
    return list(_plan_locally(name, setting, part))


def _row(index: int, problem: Plans, outcome: PlanningOutcome) -> dict[str, Any]:
    """Return the row of a problem."""
    row: dict[str, Any] = {
        "problem": index,
        "ending": str(outcome.ending),
        "planning_s": outcome.seconds,
        "planning_cpu_s": outcome.cpu_seconds,
        "error": outcome.error,
        "answer": outcome.answer,
    }
    if outcome.answer is not None:  # with the boundary conditions of the problem, not those of the answer
        row["verdict"] = verdict_to_dict(judge_answer(problem, answer_from_dict(problem, outcome.answer)))
    return row


def verdict_to_dict(verdict: Verdict) -> dict[str, Any]:
    """Return the stored part of a verdict: reason, paper's rule, metrics, and the severity of every condition."""
    severity = {name: margin.severity for name, margin in verdict.margins.items()}
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
        "severity": {name: value for name, value in severity.items() if np.isfinite(value)},
    }


def _execute_all(
    results: Results,
    plant: Plant,
    problems: Plans,
    prefix: ExecutedPrefix | None,
    *,
    pool: WorkerPool,
    report: Callable[[int, int], None],
) -> None:
    """Execute the plans that this plant has not executed."""
    waiting = list(results.unexecuted(plant.name, len(problems)))
    if not waiting:
        return
    tasks = ((problems[index], results.rows[index]["answer"], prefix and prefix[index]) for index in waiting)
    with closing(pool.distribute(partial(execute_answer, plant=plant), tasks, ordered=True)) as executions:
        for done, (index, executed) in enumerate(zip(waiting, executions, strict=True), start=1):
            results.append({"problem": index, "executed": {plant.name: executed.to_dict()}})
            report(len(waiting), done)
