"""Learning curves of the metric's schedules: the same network, rows and CPU time.

"learned" is the published rule, "bounded" a variant of it for training within minutes, "ramped" the default.

    python benchmarks/metric.py
    python benchmarks/metric.py --seconds 60 --plot docs/images/metric.png
"""

import argparse
import json
import tempfile
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from common import arguments, progress, report, table

import cnpgen
from cnpgen.training.settings import METRICS, TrainingSettings
from cnpgen.training.train import train_model

PLOTTED_TERMS = ("joint-velocity", "joint-acceleration", "table")


@dataclass(frozen=True)
class Curve:
    """Result of one run.

    Attributes:
        checks: Records of the log with a validation.
        weights: Records of the log with weights.
        final: The best model on all validation rows.
    """

    schedule: str
    checks: list[dict[str, Any]]
    weights: list[dict[str, Any]]
    final: dict[str, Any]


def run(schedule: str, data: Path, options: argparse.Namespace) -> Curve:
    progress(f"{schedule}, {options.seconds:g} CPU seconds")
    model = data.parent / f"{schedule}.h5"
    train_model(
        data,
        model,
        settings=TrainingSettings(metric=METRICS[schedule], seed=options.seed),
        cpu_seconds=options.seconds,
        workers=1,
    )
    records = [
        json.loads(line)
        for line in model.with_suffix(".jsonl").read_text(encoding="utf-8").splitlines()
    ]
    return Curve(
        schedule,
        [record for record in records if "validation" in record],
        [record for record in records if "weights" in record],
        next(record["final"] for record in reversed(records) if "final" in record),
    )


def curve_table(curves: list[Curve]) -> str:
    rows = []
    for curve in curves:
        for check in curve.checks:
            validation = check["validation"]
            rows.append(
                (curve.schedule, f"{check['seconds']:.0f}", *_numbers(validation))
            )
        rows.append((curve.schedule, "best, all rows", *_numbers(curve.final)))
    head = ("metric", "CPU s", "valid", "paper's rule", "motion time s", "z error mm s")
    return table(
        "Validation during training (on a part of the rows) and at the end", head, rows
    )


def _numbers(validation: dict[str, Any]) -> tuple[str, str, str, str]:
    return (
        f"{100 * validation['valid']:.1f} %",
        f"{100 * validation['paper_valid']:.1f} %",
        f"{validation['duration_s']:.3f}",
        f"{validation['z_error_mm_s']:.2f}",
    )


def plot(curves: list[Curve], path: str) -> None:
    import matplotlib as mpl

    mpl.use("Agg")
    from matplotlib import pyplot as plt

    figure, axes = plt.subplots(1, 3, figsize=(12, 3.4), layout="constrained")
    for number, curve in enumerate(curves):
        seconds = [check["seconds"] for check in curve.checks]
        for axis, key in ((axes[0], "valid"), (axes[1], "paper_valid")):
            axis.plot(
                seconds,
                [100 * check["validation"][key] for check in curve.checks],
                label=curve.schedule,
            )
        times = [record["seconds"] for record in curve.weights]
        for name, style in zip(PLOTTED_TERMS, ("-", "--", ":"), strict=True):
            label = f"{name.removeprefix('joint-')}" if number == 0 else None
            values = [record["weights"][name] for record in curve.weights]
            axes[2].semilogy(times, values, style, color=f"C{number}", label=label)
    for axis, title in zip(
        axes,
        ("valid [%]", "valid by the paper's rule [%]", "weights e^alpha"),
        strict=True,
    ):
        axis.set(title=title, xlabel="CPU s")
        axis.grid(alpha=0.3)
    axes[0].legend()
    axes[2].legend()
    figure.savefig(path, dpi=110)


def add_options(parser: argparse.ArgumentParser) -> None:
    parser.add_argument(
        "--schedule",
        nargs="+",
        default=METRICS,
        choices=METRICS,
        help="schedules of the metric",
    )
    parser.add_argument(
        "--seconds", type=float, default=60, help="CPU seconds of training each"
    )
    parser.add_argument("--dataset", default="airhockey-hit", help="dataset")
    parser.add_argument("--n", type=int, default=19_800, help="rows of the dataset")
    parser.add_argument(
        "--seed",
        type=int,
        default=0,
        help="seed of the initial parameters and of the order of rows",
    )
    parser.add_argument("--plot", metavar="FILE.png", help="draw the curves")


def main() -> None:
    options = arguments(__doc__, add_options)
    with tempfile.TemporaryDirectory() as folder:
        data = Path(folder) / "data"
        cnpgen.make_dataset(options.dataset, data, n=options.n)
        curves = [run(schedule, data, options) for schedule in options.schedule]
    if options.plot:
        plot(curves, options.plot)
    report(
        {"curves": [vars(curve) for curve in curves]},
        [curve_table(curves)],
        as_json=options.json,
    )


if __name__ == "__main__":
    main()
