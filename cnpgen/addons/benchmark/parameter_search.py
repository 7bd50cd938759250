"""Random search over the parameters of a planner, as the paper tuned its baselines."""

import csv
import io
import math
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from cnpgen.addons.benchmark.benchmark_planner import PLANNERS, load_kind
from cnpgen.addons.benchmark.run_suite import Benchmark, run_benchmark
from cnpgen.errors import UsageError
from cnpgen.schema import registry
from cnpgen.schema.arguments import integer
from cnpgen.schema.keys import Key, keys
from cnpgen.store.files.atomic import write_file

SEARCH_FILE = "search.csv"
MAX_TRIALS = 10_000
MIN_LOGARITHMIC_RANGE = 10.0  # ratio of both ends, from which values are log-uniform


@dataclass(frozen=True)
class Trial:
    """Result of one set of parameters; number 0 has the default ones.

    ``solved`` is the ratio of successful executions, the mean of all plants, or of
    valid plans without a plant. The times are medians, nan if the planner does not
    apply or without a plan.
    """

    number: int
    parameters: Mapping[str, Any]
    solved: float
    planning_cpu_ms: float
    duration_s: float


def search_parameters(
    suite: str | Path,
    folder: str | Path,
    planner: str,
    ranges: Mapping[str, Sequence[float]],
    *,
    trials: int = 20,
    seed: int = 0,
    **options: Any,
) -> list[Trial]:
    """Try random parameters of a planner on a suite; an interrupted search resumes.

    A range maps a field to (low, high), in SI units. Values are uniform, or log-uniform
    if both ends are positive and differ by a factor of 10 or more. Fields of type int
    get whole numbers. The default parameters are tried, too. Tune on other problems
    than those of the comparison: the name of a dataset gives fresh ones. Options are
    further arguments of ``run_benchmark``. The folder gets one folder per trial, and
    ``search.csv``.

    Return the trials, the best one first: by solved problems, then by motion time, then
        by planning time.
    """
    trials, seed = (
        integer("trials", trials, least=1, most=MAX_TRIALS),
        integer("seed", seed, least=0),
    )
    whole = {key.name for key in _keys_of(planner) if key.hint is int}
    drawn = (
        random_parameters(ranges, [seed, number], whole=whole)
        for number in range(trials)
    )
    sets: list[dict[str, Any]] = [{}, *drawn]
    done = []
    for number, parameters in enumerate(sets):
        benchmark = run_benchmark(
            suite,
            Path(folder) / f"trial-{number}",
            planners=[planner],
            seed=seed,
            parameters={planner: parameters} if parameters else None,
            **options,
        )
        done.append(_trial(number, parameters, benchmark, planner))
    ranked = sorted(done, key=_rank)
    write_file(Path(folder) / SEARCH_FILE, csv_of(ranked, list(ranges)))
    return ranked


def _keys_of(planner: str) -> tuple[Key, ...]:
    """Return the fields of a planner.

    Empty if it is unknown, which ``run_benchmark`` reports.
    """
    known = registry.names(PLANNERS)
    return keys(load_kind(planner)) if planner in known else ()


def random_parameters(
    ranges: Mapping[str, Sequence[float]],
    seed: Sequence[int],
    *,
    whole: Collection[str] = (),
) -> dict[str, Any]:
    """Draw a value for each field; see ``search_parameters``.

    Raises:
        UsageError: There is no range, or one is not two increasing, finite numbers.
    """
    if not ranges:
        raise UsageError("must have a range for one field at least", argument="ranges")
    random, values = np.random.default_rng(list(seed)), {}
    for key, ends in ranges.items():
        if len(ends) != 2 or not all(map(math.isfinite, ends)) or not ends[0] < ends[1]:
            raise UsageError(
                f"must have two increasing numbers for {key!r}, got {ends!r:.100}",
                argument="ranges",
            )
        low, high = ends
        if low > 0 and high / low >= MIN_LOGARITHMIC_RANGE:
            value = float(np.exp(random.uniform(math.log(low), math.log(high))))
        else:
            value = float(random.uniform(low, high))
        values[key] = int(np.clip(round(value), low, high)) if key in whole else value
    return values


def csv_of(trials: Sequence[Trial], keys: Sequence[str]) -> str:
    """Write trials as CSV, a row each with the values of these fields, which are empty for the default parameters."""
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow(["trial", "solved", "planning_cpu_ms", "duration_s", *keys])
    for trial in trials:
        values = [trial.parameters.get(key, "") for key in keys]
        writer.writerow(
            [
                trial.number,
                trial.solved,
                trial.planning_cpu_ms,
                trial.duration_s,
                *values,
            ]
        )
    return text.getvalue()


def _trial(
    number: int, parameters: Mapping[str, Any], benchmark: Benchmark, planner: str
) -> Trial:
    summaries = {
        plant: benchmark.summary(plant)[planner] for plant in benchmark.executions
    }
    ratios = [
        summary["ratios"].get("success" if plant else "valid", {"share": 0.0})["share"]
        for plant, summary in summaries.items()
    ]
    figures = summaries[benchmark.executions[0]]["figures"]
    medians = [
        figures.get(key, {}).get("median", math.nan)
        for key in ("planning_cpu_ms", "duration_s")
    ]
    return Trial(number, parameters, float(np.mean(ratios)), *medians)


def _rank(trial: Trial) -> tuple[float, float, float, int]:
    times = [
        math.inf if math.isnan(time) else time
        for time in (trial.duration_s, trial.planning_cpu_ms)
    ]
    return -trial.solved, times[0], times[1], trial.number
