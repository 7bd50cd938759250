"""Ablations of the training: every variant changes one setting of the shipped planners, or of the paper's method.

Each variant is trained with several seeds and judged on new problems. Finished results are in FOLDER/results.jsonl, so
an interrupted run resumes with the same command; other variants and seeds extend it.

    python benchmarks/ablations.py FOLDER --seconds 60 --seeds 1 2 3
    python benchmarks/ablations.py FOLDER --only metric head --plot docs/images/ablations.svg
"""

import argparse
import json
import math
import statistics
from collections.abc import Iterator
from dataclasses import asdict, dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from common import arguments, cpu_of, median, progress, report, table

import cnpgen
from cnpgen.addons.benchmark.hypothesis_tests import wilson
from cnpgen.make.make_dataset import make_dataset
from cnpgen.make.recipe import load_dataset_recipe
from cnpgen.plans.evaluate import evaluate_plans
from cnpgen.plans.plans import Plans
from cnpgen.refine.refine_plans import refine_plans
from cnpgen.store.files.figure_file import new_figure, save_figure
from cnpgen.training.presets import PAPER
from cnpgen.training.settings import METRICS, TrainingSettings
from cnpgen.training.train import train_model

ROWS, VALIDATION_ROWS = 18_000, 200
CHECK_ROWS, VALIDATIONS = 100, 5
PROBLEM_SEED, DATA_SEED = 31_415, 27_182  # used nowhere else
TIMED_PLANS = 200
MAX_REPEATED_FACTOR = (
    1.0  # of the training time; variants with a larger one have one seed
)
BASE = TrainingSettings(validations=VALIDATIONS)
VALID_AXIS, RATIO_AXIS = (80.0, 100.5), (0.98, 1.15)  # of the figure


@dataclass(frozen=True)
class Variant:
    """One variant.

    Attributes:
        group: Subject.
        name: Name in the table.
        settings: Training settings, except the seed.
        rows: Number of training samples.
        time_factor: Factor of the training time.
        once: Whether it is trained with the first seed only.
    """

    group: str
    name: str
    settings: TrainingSettings = BASE
    rows: int = ROWS
    time_factor: float = 1.0
    once: bool = False


def variants() -> Iterator[Variant]:
    """Yield all variants, the unchanged settings first."""
    yield Variant("base", "shipped settings")
    for name in ("fixed", "bounded", "learned"):
        yield Variant("metric", name, replace(BASE, metric=METRICS[name]))
    steps = {"no path": (1, 0), "no line": (0, 1), "neither": (0, 0)}
    for name, (line, path) in steps.items():
        yield Variant(
            "projection",
            name,
            replace(BASE, line_projection_steps=line, projection_steps=path),
        )
    yield Variant(
        "head",
        "pi, Glorot",
        replace(BASE, path_scale=math.pi, head_scale=1.0, rate_bias=0.0),
    )
    for name in ("states", "paper"):
        yield Variant("features", name, replace(BASE, features=name))
    yield Variant("margins", "none", replace(BASE, usual_margins=False))
    yield Variant(
        "clipping", "none", replace(BASE, sample_clip=math.inf, batch_clip=math.inf)
    )
    yield Variant("average", "none", replace(BASE, memory=0.0))
    yield Variant(
        "learning rate",
        "5e-5, constant",
        replace(BASE, learning_rate=5e-5, final_rate=1.0, warm_up=0),
    )
    for hidden in (64, 256):
        yield Variant("width", str(hidden), replace(BASE, hidden=hidden))
    for layers in (3, 8):
        yield Variant("depth", str(layers), replace(BASE, layers=layers))
    for count in (9, 10, 20):  # 8 do not suffice for boundary accelerations
        yield Variant(
            "control points of the path",
            str(count),
            replace(BASE, path_control_points=count),
        )
    for count in (8, 10, 15):
        yield Variant(
            "control points of the rate",
            str(count),
            replace(BASE, rate_control_points=count),
        )
    for rows in (1_000, 5_000, 120_000):
        yield Variant("samples", f"{rows:,}", rows=rows)
    yield Variant(
        "precision of the loss", "float64", replace(BASE, precision="float64")
    )
    for factor in (0.5, 4.0, 15.0, 60.0):
        yield Variant(
            "training time",
            f"x {factor:g}",
            time_factor=factor,
            once=factor > MAX_REPEATED_FACTOR,
        )
    published = replace(PAPER.settings, hidden=128, validations=VALIDATIONS)
    yield Variant("paper", "preset, 5 x 128", published)
    yield Variant(
        "paper",
        "preset, ramped metric",
        replace(published, metric=METRICS["ramped"], loss_form="signed"),
    )


@dataclass(frozen=True)
class Test:
    """New problems and the durations of their refined plans [s], shape (N,); nan where refining failed."""

    problems: Plans
    refined: np.ndarray


def new_problems(dataset: str, n: int) -> Test:
    """Draw problems that no training has seen; refine the shipped planner's plans for them."""
    progress(f"refining {n:,} new problems")
    problems = cnpgen.draw_boundary_problems(dataset, n, seed=PROBLEM_SEED)
    drafts = cnpgen.Planner(dataset).plan_batch(
        problems.boundary, columns=problems.columns
    )
    refinement = refine_plans(drafts, workers=1)
    return Test(problems, np.where(refinement.valid, refinement.plans.duration, np.nan))


def result_of(
    variant: Variant, seed: int, test: Test, options: argparse.Namespace
) -> dict[str, Any]:
    """Train one variant with one seed and judge it."""
    folder: Path = options.folder
    data = folder / f"{options.dataset}-{variant.rows}"
    splits = {"train": variant.rows, "validation": VALIDATION_ROWS}
    make_dataset(
        replace(load_dataset_recipe(options.dataset), splits=splits, seed=DATA_SEED),
        data,
        workers=1,
    )
    trained = train_model(
        data,
        folder / f"{key_of(variant, seed).replace(' ', '-').replace(',', '')}.h5",
        settings=replace(variant.settings, seed=seed),
        cpu_seconds=options.seconds * variant.time_factor,
        check_rows=CHECK_ROWS,
        workers=1,
    )
    planner = cnpgen.Planner(trained.path)
    plans = planner.plan_batch(test.problems.boundary, columns=test.problems.columns)
    evaluation = evaluate_plans(plans, workers=1)
    worst = [
        max((m.severity for m in verdict.margins.values()), default=math.inf)
        for verdict in evaluation.verdicts
    ]
    summary = evaluation.summary()
    return {
        "variant": key_of(variant, seed),
        "group": variant.group,
        "name": variant.name,
        "seed": seed,
        "seconds": options.seconds * variant.time_factor,
        "problems": len(plans),
        "valid": int(evaluation.valid.sum()),
        "paper_valid": round(summary["paper_valid_ratio"] * len(plans)),
        "duration_ratio": float(np.nanmean(plans.duration) / np.nanmean(test.refined)),
        "worst_median": float(np.median(worst)),
        "worst_p95": float(np.quantile(worst, 0.95)),
        "training_cpu_s": trained.model.training["cpu_seconds"],
        "steps": trained.model.training["steps"],
        "planning_cpu_ms": planning_time(planner, test),
    }


def planning_time(planner: cnpgen.Planner, test: Test) -> float:
    """Measure the median CPU time of single plans [ms]."""
    count = min(TIMED_PLANS, len(test.refined))
    boundaries = [test.problems.boundary[index : index + 1] for index in range(count)]
    return 1e3 * median(
        cpu_of(partial(planner.plan_batch, boundary)) for boundary in boundaries
    )


def key_of(variant: Variant, seed: int) -> str:
    """Return the identity of a result in the folder."""
    return f"{variant.group} {variant.name} {seed}"


def run(options: argparse.Namespace) -> list[dict[str, Any]]:
    """Compute the missing results: all variants with the first seed, then with the next ones."""
    options.folder.mkdir(parents=True, exist_ok=True)
    file = options.folder / "results.jsonl"
    chosen = [
        variant
        for variant in variants()
        if not options.only or variant.group in {"base", *options.only}
    ]
    seeds = list(enumerate(options.seeds))
    wanted = [
        (variant, seed)
        for index, seed in seeds
        for variant in chosen
        if not (index and variant.once)
    ]
    done = read(file)
    missing = [
        (variant, seed) for variant, seed in wanted if key_of(variant, seed) not in done
    ]
    test = (
        new_problems(options.dataset, options.n)
        if missing and not options.tables
        else None
    )
    for variant, seed in missing if test is not None else ():
        progress(key_of(variant, seed))
        assert test is not None
        record = result_of(variant, seed, test, options)
        with file.open("a", encoding="utf-8") as lines:
            lines.write(json.dumps(record) + "\n")
    keys = {key_of(variant, seed) for variant, seed in wanted}
    return [record for key, record in read(file).items() if key in keys]


def read(file: Path) -> dict[str, dict[str, Any]]:
    """Read the finished results by their key."""
    lines = file.read_text(encoding="utf-8").splitlines() if file.exists() else []
    return {record["variant"]: record for record in map(json.loads, lines)}


@dataclass(frozen=True)
class Row:
    """Results of one variant over its seeds."""

    group: str
    name: str
    records: list[dict[str, Any]]

    def ratio(self, key: str) -> tuple[float, float, float]:
        """Return a pooled ratio and its 95 % interval by Wilson."""
        count = sum(record[key] for record in self.records)
        total = sum(record["problems"] for record in self.records)
        return count / total, *wilson(count / total, total)

    def spread(self, key: str) -> tuple[float, float, float]:
        """Return the mean over seeds of a figure, its minimum and its maximum."""
        values = [record[key] for record in self.records]
        return statistics.mean(values), min(values), max(values)


def rows_of(results: list[dict[str, Any]]) -> list[Row]:
    """Group the results by variant, in the order of ``variants``."""
    rows = []
    for variant in variants():
        records = [
            item
            for item in results
            if (item["group"], item["name"]) == (variant.group, variant.name)
        ]
        if records:
            rows.append(Row(variant.group, variant.name, records))
    return rows


def cells(row: Row) -> tuple[str, ...]:
    """Format a row of the table; the archive and the figure have more."""
    return (
        row.group,
        row.name,
        f"{100 * row.ratio('valid')[0]:.1f}",
        f"{row.spread('duration_ratio')[0]:.3f}",
        f"{row.spread('worst_median')[0]:.2f}",
    )


def differing(rows: list[Row]) -> list[Row]:
    """Return the base and the variants that are less valid or differ in duration, by decreasing validity.

    A difference is one of two intervals without a common value: 95 % intervals of the
    valid ratios, and ranges of the durations over the seeds.
    """
    base, *others = rows
    _, least, _ = base.ratio("valid")
    _, low, high = base.spread("duration_ratio")
    kept = [
        row
        for row in others
        if row.ratio("valid")[2] < least
        or row.spread("duration_ratio")[2] < low
        or row.spread("duration_ratio")[1] > high
    ]
    return [base, *sorted(kept, key=lambda row: -row.ratio("valid")[0])]


def plot(rows: list[Row], path: str) -> None:
    """Draw the variants that differ from the base; values outside the axes are printed at their edges."""
    rows = differing(rows)
    figure = new_figure(9, 0.3 * len(rows) + 1, dpi=100)
    left, right = figure.subplots(1, 2, sharey=True)
    places = np.arange(len(rows))[::-1]
    for axis, key, factor, limits in (
        (left, "valid", 100, VALID_AXIS),
        (right, "duration_ratio", 1, RATIO_AXIS),
    ):
        for place, row in zip(places, rows, strict=True):
            value, low, high = row.spread(key) if axis is right else row.ratio(key)
            interval = (factor * value, factor * low, factor * high)
            draw_interval(
                axis, place, interval, limits, "C1" if row is rows[0] else "C0"
            )
        _, low, high = rows[0].spread(key) if axis is right else rows[0].ratio(key)
        axis.axvspan(factor * low, factor * high, color="C1", alpha=0.15, lw=0)
        axis.set(xlim=limits)
        axis.grid(axis="y", alpha=0.3)
    left.set_ylim(-0.6, len(rows) - 0.4)
    left.set_xlabel("valid plans [%]")
    right.set_xlabel("duration / refined duration")
    left.set_yticks(places, [f"{row.group}: {row.name}" for row in rows], fontsize=9)
    save_figure(figure, Path(path))


def draw_interval(
    axis: Any,
    place: int,
    interval: tuple[float, float, float],
    limits: tuple[float, float],
    color: str,
) -> None:
    """Draw a value with its bounds in a row, or print it at the edge of the axis outside of which it lies."""
    value, low, high = interval
    if limits[0] <= value <= limits[1]:
        axis.plot([low, high], [place, place], color=color)
        axis.plot([value], [place], "o", color=color, markersize=4)
        return
    is_low = value < limits[0]
    edge, alignment = (limits[0], "left") if is_low else (limits[1], "right")
    text = f" \u2190 {value:.3g}" if is_low else f"{value:.3g} \u2192 "
    axis.text(
        edge,
        place,
        text,
        color=color,
        fontsize=9,
        va="center",
        ha=alignment,
    )


def main() -> None:
    def add(parser: argparse.ArgumentParser) -> None:
        parser.add_argument(
            "folder", type=Path, help="folder of datasets, models and results"
        )
        parser.add_argument(
            "--dataset", default="airhockey-hit", help="dataset and shipped model"
        )
        parser.add_argument(
            "--seconds", type=float, default=60.0, help="CPU time of a training [s]"
        )
        parser.add_argument("--seeds", type=int, nargs="+", default=[1, 2, 3])
        parser.add_argument("--n", type=int, default=1000, help="new problems")
        parser.add_argument("--only", nargs="+", help="groups of variants")
        parser.add_argument(
            "--tables", action="store_true", help="print finished results only"
        )
        parser.add_argument("--plot", metavar="FILE", help="figure to write")

    options = arguments(__doc__, add)
    results = run(options)
    rows = rows_of(results)
    if options.plot:
        plot(rows, options.plot)
    head = (
        "subject",
        "variant",
        "valid %",
        "duration / refined",
        "violation / tolerance, median",
    )
    title = f"{options.dataset}: {options.seconds:g} CPU s, {options.n:,} new problems, 95 % intervals over seeds"
    report(
        {"results": results, "base": str(asdict(BASE))},
        [table(title, head, map(cells, rows), left=2)],
        as_json=options.json,
    )


if __name__ == "__main__":
    main()
