"""Benchmark runs: every planner on every problem, judged and optionally executed.

Finished problems are kept.
"""

from collections.abc import Callable, Generator, Mapping, Sequence
from contextlib import closing
from dataclasses import asdict, dataclass, replace
from functools import partial
from itertools import chain
from pathlib import Path
from typing import Any

import numpy as np

from cnpgen.addons.benchmark.answers import execute_answer, judge_answer
from cnpgen.addons.benchmark.benchmark_options import BenchmarkOptions
from cnpgen.addons.benchmark.benchmark_planner import PLANNERS, Setting, load_planner
from cnpgen.addons.benchmark.hypothesis_tests import summarize_results
from cnpgen.addons.benchmark.process import PlannerProcess, PlanningOutcome
from cnpgen.addons.benchmark.pucks import ExecutedPrefix
from cnpgen.addons.benchmark.results_file import (
    Results,
    ResultsFolder,
    answer_from_dict,
)
from cnpgen.addons.benchmark.run_record import RunRecord, add_run
from cnpgen.addons.benchmark.simulator.challenge import challenge_plant, check_challenge
from cnpgen.addons.benchmark.simulator.execute import load_mujoco
from cnpgen.addons.benchmark.simulator.executed import PLANE_TOLERANCE_M
from cnpgen.addons.benchmark.simulator.plant import Plant, as_plant
from cnpgen.addons.benchmark.suite import PlannerFields, Suite, load_suite
from cnpgen.documents import JsonMapping, JsonObject
from cnpgen.errors import RecipeError, UsageError, counted
from cnpgen.judges.plans.verdict import Verdict
from cnpgen.machine.engine import Engine, WorkerPool, assembled
from cnpgen.plans.plans import Plans
from cnpgen.problems.problem_record import open_problem
from cnpgen.schema import registry
from cnpgen.schema.argument_types import checked_arguments
from cnpgen.schema.arguments import concerning
from cnpgen.schema.old_keywords import with_old_keywords
from cnpgen.store.files.documents import plain

PROBLEMS_PER_TASK = 4  # of a worker; starting a planner takes some seconds
FASTEST = ("cnpgen", "cnpgen+refine", "solve")  # default; the others take longer

Progress = Callable[[str, int, int], None]
"""Called with the activity, its number of steps, and the number of finished steps."""

Numbered = tuple[int, Plans]
"""The number of a problem and the problem."""

Rows = Generator[JsonObject, None, None]
"""Rows of results, yielded as they are finished."""


@dataclass(frozen=True, eq=False)
class Benchmark:
    """Results of planners on the problems of a suite.

    Attributes:
        suite: The suite.
        problems: Its problems.
        prefix: Of replanning scenarios, the prefixes of the first motions.
        results: Planner -> its rows, ordered by repetition and problem ('cnpgen docs
            benchmark'). They cover all results in the folder, also those of earlier
            runs.
        plants: Plants that executed plans in this run.
        runs: Date, machine, versions and seed of the runs that wrote into the folder;
            the last one is this run.
        reference: Planner with which the others are compared, or None for the default.
        plane_tolerance: Maximum distance of the mallet of a successful hit from the
            table plane [m].
    """

    suite: Suite
    problems: Plans
    prefix: ExecutedPrefix | None
    results: dict[str, list[JsonObject]]
    plants: tuple[Plant, ...] = ()
    runs: tuple[RunRecord, ...] = ()
    reference: str | None = None
    plane_tolerance: float = PLANE_TOLERANCE_M

    def __repr__(self) -> str:
        return f"<{self.suite.name}: {counted(len(self.problems), 'problem')}, {', '.join(self.results)}>"

    @property
    def executions(self) -> tuple[str, ...]:
        """Names of the plants that executed any plan.

        One empty name without execution.
        """
        known = dict.fromkeys(plant.name for plant in self.plants)
        known |= {
            name: None
            for rows in self.results.values()
            for row in rows
            for name in row.get("executed", {})
        }
        return tuple(known) or ("",)

    @checked_arguments
    def summary(self, plant: str = "") -> dict[str, dict[str, dict[str, JsonObject]]]:
        """Return ratios, medians, quartiles and p-values of every planner; see ``summarize_results``.

        Args:
            plant: Name of the plant; empty for plans only.
        """
        return summarize_results(
            self.results,
            plant,
            reference=self.reference,
            plane_tolerance=self.plane_tolerance,
        )


@checked_arguments
def run_benchmark(
    suite: str | Path | Suite,
    folder: str | Path,
    *,
    planners: Sequence[str] = FASTEST,
    n: int | None = None,
    plants: Sequence[str | Plant] = (),
    parameters: Mapping[str, JsonMapping] | None = None,
    workers: int | None = None,
    force: bool = False,
    progress: Progress | None = None,
    options: BenchmarkOptions | None = None,
    **old_keywords: Any,
) -> Benchmark:
    """Compare planners; an interrupted run resumes.

    Every planner runs in its own process on one thread, one problem after the other, so
    planning times are undisturbed. Plans are executed in ``workers`` processes. With an
    engine, its workers also plan, each for other problems; planning times are then
    those of a shared machine.

    Args:
        suite: A suite, or the name or file of a suite or dataset.
        folder: Folder for results, one file per planner; created if missing.
        planners: Names of planners.
        n: Number of problems, the first ones; random suites may have more than the
            recipe.
        plants: Plants that execute plans; none by default.
        parameters: Planner -> its field -> value, as in a recipe; the others have the
            values of the suite, or their defaults.
        workers: Processes that execute plans and, with an engine, plan; default one per
            available core.
        force: Whether to delete results of another suite, version, time limit or
            planner parameters in the folder.
        progress: Called after every problem.
        options: Time limit, seed, repetitions, engine and others.
        old_keywords: Fields of the options, as keywords of version 1.0.

    Raises:
        UsageError: A planner, plant or environment is unknown or unsuitable, or the
            folder has results of another run.
        RecipeError: The suite has errors.
        MachineError: MuJoCo is missing, the results cannot be written, or a cluster
            cannot be reached.
    """
    chosen = with_old_keywords(
        "run_benchmark", options, BenchmarkOptions(), old_keywords
    )
    where = Engine(chosen.engine, chosen.address, workers)
    with concerning("suite"):
        loaded = suite if isinstance(suite, Suite) else load_suite(suite)
    # Planners, plants and their parameters are checked before any planning.
    given = _checked_planners(planners, loaded.planners or {}, parameters or {})
    values = {name: _checked_parameters(name, given[name]) for name in planners}
    robots = _checked_plants(plants, chosen.environment)
    problems, prefix = loaded.problems(n)
    if chosen.environment is not None:
        check_challenge(*open_problem(problems.problem))
    setting = Setting(problems.problem, loaded.model, chosen.time_limit, chosen.seed)
    place = ResultsFolder(Path(folder), loaded, setting)
    names = {*place.planners(delete_others=force), *planners}
    _check_reference(chosen.reference, names)
    runs = add_run(place.path, chosen.seed, planners)
    with assembled(where, len(problems)) as pool:
        tools = pool, chosen, force, progress
        run = _BenchmarkRun(place, robots, problems, prefix, *tools)
        for name in planners:
            run.compare(name, replace(setting, parameters=given[name]), values[name])
    return run.collected(loaded, planners, runs)


def _check_reference(reference: str | None, names: set[str]) -> None:
    """Check that the reference is a planner with results."""
    if reference is not None and reference not in names:
        raise UsageError(
            f"must be one of {', '.join(sorted(names))}, got {reference!r}",
            argument="reference",
        )


def _checked_plants(
    plants: Sequence[str | Plant], environment: str | Path | None
) -> tuple[Plant, ...]:
    """Return the plants, with that of the environment."""
    robots = tuple(as_plant(plant, argument="plants") for plant in plants)
    if environment is not None:
        robots += (challenge_plant(environment),)
    if robots:
        load_mujoco()
    return robots


def _checked_planners(
    planners: Sequence[str],
    of_suite: PlannerFields,
    parameters: Mapping[str, JsonMapping],
) -> PlannerFields:
    """Return planner -> given values of its fields, after checking names before any work."""
    known = registry.names(PLANNERS)
    if not planners:
        raise UsageError(
            f"no planners, expected some of {', '.join(known)}", concerns="planners"
        )
    for name in planners:
        if not isinstance(name, str):
            raise UsageError(
                f"must be names of planners, got {name!r:.100}", argument="planners"
            )
        if name not in known:
            raise UsageError(
                f"unknown planner {name!r}{registry.name_hint(PLANNERS, name)}; known: {', '.join(known)}",
                concerns="planners",
            )
    if unused := sorted(parameters.keys() - set(planners)):
        raise UsageError(
            f"must be of planners of this run, got those of {', '.join(unused)}",
            argument="parameters",
        )
    return {
        name: {**of_suite.get(name, {}), **parameters.get(name, {})}
        for name in planners
    }


def _checked_parameters(planner: str, parameters: JsonMapping) -> JsonObject:
    """Return the values of all fields of a planner."""
    try:
        # A dataclass, as its contract requires.
        loaded: Any = load_planner(planner, parameters)
    except RecipeError:
        # It cannot be imported; its own process reports the error.
        return {}
    return dict(plain(asdict(loaded)))


@dataclass(frozen=True, eq=False)
class _BenchmarkRun:
    """A run: where its results are, its plants and problems; planners run in the pool only with an engine."""

    place: ResultsFolder
    plants: tuple[Plant, ...]
    problems: Plans
    prefix: ExecutedPrefix | None
    pool: WorkerPool
    options: BenchmarkOptions
    overwrite: bool
    progress: Progress | None

    def compare(self, name: str, setting: Setting, values: JsonObject) -> None:
        """Plan for all problems and execute the plans, once per repetition; ``values`` are those of all fields."""
        for repetition in range(self.options.repeat):
            results = self.place.open(
                name,
                repetition,
                values,
                overwrite=self.overwrite,
                discard=self.options.replan,
            )
            with closing(results.file):
                self.plan(results, name, replace(setting, repetition=repetition))
                for plant in self.plants:
                    self.execute(results, name, repetition, plant)

    def collected(
        self, suite: Suite, planners: Sequence[str], runs: tuple[RunRecord, ...]
    ) -> Benchmark:
        """Return the results of this run and of earlier ones, those of the given planners first."""
        rows = self.place.rows(planners)
        options = self.options
        problems = self.problems
        prefix = self.prefix
        # The folder may have results of more problems than this run.
        count = max((row["problem"] + 1 for row in chain(*rows.values())), default=0)
        if count > len(problems):
            problems, prefix = suite.problems(count)
        settled = options.reference, options.plane_tolerance
        return Benchmark(suite, problems, prefix, rows, self.plants, runs, *settled)

    def _report(self, activity: str, total: int, done: int) -> None:
        if self.progress is not None:
            self.progress(activity, total, done)

    def _label(self, name: str, repetition: int) -> str:
        return name if self.options.repeat == 1 else f"{name}, repetition {repetition}"

    def plan(self, results: Results, name: str, setting: Setting) -> None:
        """Plan for the problems without result."""
        total = len(self.problems)
        indices = results.missing(len(self.problems))
        waiting = [(index, self.problems[index]) for index in indices]
        if not waiting:
            return
        rows = (
            _plan_locally(name, setting, waiting)
            if self.options.engine is None
            else _plan_in_pool(self.pool, name, setting, waiting)
        )
        label = self._label(name, setting.repetition)
        with closing(rows):
            for done, row in enumerate(rows, start=total - len(waiting) + 1):
                results.append(row)
                self._report(f"{label} plans", total, done)

    def execute(
        self, results: Results, name: str, repetition: int, plant: Plant
    ) -> None:
        """Execute the plans that this plant has not executed."""
        waiting = list(results.unexecuted(plant.name, len(self.problems)))
        if not waiting:
            return
        prefix = self.prefix
        activity = f"{self._label(name, repetition)}, {plant.name} plant"
        tasks = (
            (
                self.problems[index],
                results.rows[index]["answer"],
                prefix and prefix[index],
            )
            for index in waiting
        )
        run = partial(execute_answer, plant=plant)
        with closing(self.pool.distribute(run, tasks, ordered=True)) as executions:
            pairs = zip(waiting, executions, strict=True)
            for done, (index, executed) in enumerate(pairs, start=1):
                row = {"problem": index, "executed": {plant.name: executed.to_dict()}}
                results.append(row)
                self._report(activity, len(waiting), done)


def _plan_locally(name: str, setting: Setting, waiting: list[Numbered]) -> Rows:
    """Yield the rows of problems, one after the other."""
    process = PlannerProcess(name, setting)
    try:
        for index, problem in waiting:
            yield _row(index, problem, process.plan(problem))
    finally:
        process.stop()


def _plan_in_pool(
    pool: WorkerPool, name: str, setting: Setting, waiting: list[Numbered]
) -> Rows:
    """Yield the rows of problems that are distributed over a worker pool."""
    # Small parts keep all workers busy, larger ones save starts of planners.
    size = min(PROBLEMS_PER_TASK, -(-len(waiting) // pool.size))
    parts = (waiting[first : first + size] for first in range(0, len(waiting), size))
    with closing(pool.distribute(partial(_plan_task, name, setting), parts)) as results:
        for rows in results:
            # Planning times with others on the machine are marked as such.
            yield from ({**row, "planners_at_once": pool.size} for row in rows)


def _plan_task(name: str, setting: Setting, part: list[Numbered]) -> list[JsonObject]:
    return list(_plan_locally(name, setting, part))


def _row(index: int, problem: Plans, outcome: PlanningOutcome) -> JsonObject:
    """Return the row of a problem."""
    row: JsonObject = {
        "problem": index,
        "ending": str(outcome.ending),
        "planning_s": outcome.seconds,
        "planning_cpu_s": outcome.cpu_seconds,
        "error": outcome.error,
        "answer": outcome.answer,
    }
    if outcome.answer is not None:
        # With the boundary conditions of the problem, not those of the answer.
        row["verdict"] = verdict_to_dict(
            judge_answer(problem, answer_from_dict(problem, outcome.answer))
        )
    return row


def verdict_to_dict(verdict: Verdict) -> JsonObject:
    """Return the stored part of a verdict: reason, paper's rule, metrics, and the severity of every condition."""
    severity = {name: margin.severity for name, margin in verdict.margins.items()}
    return {
        "valid": verdict.valid,
        "reason": str(verdict.reason),
        "paper": verdict.paper and asdict(verdict.paper),
        "metrics": verdict.metrics.to_dict(),
        "value_over_bound": {
            name: abs(margin.value) / abs(margin.bound)
            for name, margin in verdict.margins.items()
            # A bound of 0 has no ratio.
            if margin.bound and np.isfinite(margin.value / margin.bound)
        },
        "severity": {
            name: value for name, value in severity.items() if np.isfinite(value)
        },
    }
