"""Curves and figures of trainings with the paper's preset, from their logs: files .jsonl, or models that hold them.

cnpgen make-dataset airhockey-hit --out hits
cnpgen train hits -o paper-1.h5 --preset paper --hidden 128 --epochs 1000 --seed 1
cnpgen train hits -o paper-2.h5 --preset paper --hidden 128 --epochs 1000 --seed 2
python benchmarks/paper.py paper-1.h5 paper-2.h5 --plot docs/images/paper.svg --csv curves.csv
"""

import argparse
import csv
import json
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from common import arguments, report, table

import cnpgen
from cnpgen.store.files.figure_file import new_figure, save_figure


@dataclass(frozen=True)
class Curve:
    """Log of one training.

    Attributes:
        name: Name of the file.
        steps: Records with means of the terms and weights.
        checks: Records with a validation.
        score: Final validation.
        budget_factor: Factor of the budgets.
    """

    name: str
    steps: list[dict[str, Any]]
    checks: list[dict[str, Any]]
    score: dict[str, Any]
    budget_factor: float

    @property
    def steps_per_epoch(self) -> float:
        """Number of steps of an epoch."""
        return float(self.steps[-1]["step"] / self.steps[-1]["epoch"])


def read(path: Path, factor: float) -> Curve:
    """Read a log, or the log in a model file, whose settings have the factor of the budgets."""
    if path.suffix == ".jsonl":
        text = path.read_text(encoding="utf-8")
    else:
        model = cnpgen.load_model(path)
        text, factor = (
            model.log,
            float(model.training["settings"]["metric"].get("budget_factor", 1.0)),
        )
    records = [json.loads(line) for line in text.splitlines()]
    steps = [record for record in records if "weights" in record]
    checks = [record for record in records if "validation" in record]
    if not records or "final" not in records[-1]:
        raise SystemExit(
            f"{path}: expected the log of a finished training, whose last line has the key 'final'"
        )
    return Curve(path.stem, steps, checks, records[-1]["final"], factor)


def learned_terms(curve: Curve) -> list[str]:
    """Return the names of the terms with a budget."""
    return [name for name, budget in curve.steps[0]["budgets"].items() if budget]


def ratios(curve: Curve, record: dict[str, Any], names: list[str]) -> list[float]:
    """Return the means of terms over their budgets."""
    return [
        record["terms"][name] / record["budgets"][name] / curve.budget_factor
        for name in names
    ]


def epoch_of_met_budgets(curve: Curve, tolerance: float = 0.05) -> str:
    """Return the first epoch from which velocity and acceleration stay within a tolerance of their budgets."""
    names = ["joint-velocity", "joint-acceleration"]
    outside = [
        max(abs(ratio - 1) for ratio in ratios(curve, record, names)) > tolerance
        for record in curve.steps
    ]
    first = max(
        (index + 1 for index, is_outside in enumerate(outside) if is_outside), default=0
    )
    return (
        "not reached"
        if first == len(outside)
        else f"{curve.steps[first]['epoch']:,.0f}"
    )


def rows(curves: list[Curve]) -> list[tuple[str, ...]]:
    """Format a row per training."""
    cells: list[tuple[str, ...]] = []
    for curve in curves:
        last, score, names = curve.steps[-1], curve.score, learned_terms(curve)
        violations = ", ".join(f"{ratio:.3g}" for ratio in ratios(curve, last, names))
        weights = ", ".join(f"{last['weights'][name]:.3g}" for name in names)
        shares = (f"{100 * score[key]:.1f} %" for key in ("valid", "paper_valid"))
        lengths = f"{last['epoch']:,.0f}", f"{last['seconds']:,.0f}"
        met, duration = epoch_of_met_budgets(curve), f"{score['duration_s']:.3f}"
        cells.append(
            (
                curve.name,
                *lengths,
                met,
                f"{curve.budget_factor:g}",
                violations,
                weights,
                *shares,
                duration,
            )
        )
    return cells


def save_csv(curves: list[Curve], path: Path) -> None:
    """Write all records as CSV."""
    names = learned_terms(curves[0])
    with path.open("w", encoding="utf-8", newline="") as file:
        writer = csv.writer(file)
        head = [
            "model",
            "step",
            "epoch",
            "cpu_s",
            "loss",
            "task_loss",
            *names,
            *(f"weight {name}" for name in names),
        ]
        writer.writerow([*head, "valid", "paper_valid", "duration_s"])
        for curve in curves:
            for record in curve.steps:
                values = [
                    record["loss"],
                    record["terms"]["time"],
                    *(record["terms"][name] for name in names),
                ]
                common = [
                    curve.name,
                    record["step"],
                    record["epoch"],
                    record["seconds"],
                    *values,
                ]
                writer.writerow([*common, *(record["weights"][name] for name in names)])
            for record in curve.checks:
                found, epoch = (
                    record["validation"],
                    record["step"] / curve.steps_per_epoch,
                )
                blank = [""] * (2 + 2 * len(names))
                values = [found["valid"], found["paper_valid"], found["duration_s"]]
                writer.writerow(
                    [
                        curve.name,
                        record["step"],
                        epoch,
                        record["seconds"],
                        *blank,
                        *values,
                    ]
                )


def plot(curves: list[Curve], path: Path) -> None:
    """Draw loss, terms over budgets, weights and validity over epochs."""
    figure = new_figure(11, 6.5, dpi=100)
    axes = figure.subplots(2, 2, sharex=True).ravel()
    styles = ("-", "--", ":", "-.")
    for number, curve in enumerate(curves):
        style, epochs = (
            styles[number % len(styles)],
            [record["epoch"] for record in curve.steps],
        )
        axes[0].plot(
            epochs,
            [record["loss"] for record in curve.steps],
            style,
            color="C0",
            label=curve.name,
        )
        for index, name in enumerate(learned_terms(curve)):
            label = name if number == 0 else None
            means = [ratios(curve, record, [name])[0] for record in curve.steps]
            axes[1].plot(epochs, means, style, color=f"C{index}", label=label)
            weights = [record["weights"][name] for record in curve.steps]
            axes[2].plot(epochs, weights, style, color=f"C{index}", label=label)
        checked = [record["step"] / curve.steps_per_epoch for record in curve.checks]
        for key, color in (("paper_valid", "C1"), ("valid", "C0")):
            shares = [100 * record["validation"][key] for record in curve.checks]
            label = (
                {"valid": "strict", "paper_valid": "paper's rules"}[key]
                if number == 0
                else None
            )
            axes[3].plot(checked, shares, style, color=color, label=label)
    titles = (
        "loss [s]",
        "mean violation / budget",
        "weights e^alpha",
        "valid plans [%]",
    )
    for axis, title in zip(axes, titles, strict=True):
        axis.set_title(title, fontsize=9)
        axis.grid(alpha=0.3)
        axis.legend(fontsize=7)
    for axis in axes[:3]:
        axis.set_yscale("log")
    axes[1].set_ylim(1e-2, 1e4)
    axes[2].set_ylim(1e-4, 1e6)
    for axis in axes[2:]:
        axis.set_xlabel("epoch")
    save_figure(figure, path)


def main() -> None:
    def add(parser: argparse.ArgumentParser) -> None:
        parser.add_argument("files", nargs="+", type=Path, help="logs or models")
        parser.add_argument(
            "--budget-factor",
            type=float,
            default=1.0,
            help="factor of the budgets of logs (default: 1)",
        )
        parser.add_argument("--plot", metavar="FILE", type=Path, help="figure to write")
        parser.add_argument(
            "--csv", metavar="FILE", type=Path, help="table of the curves to write"
        )

    options = arguments(__doc__, add)
    curves = [read(path, options.budget_factor) for path in options.files]
    if options.plot:
        plot(curves, options.plot)
    if options.csv:
        save_csv(curves, options.csv)
    names = ", ".join(learned_terms(curves[0]))
    head = (
        "training",
        "epochs",
        "seconds",
        "budgets met from epoch",
        "budget factor",
        f"violation / budget: {names}",
    )
    outcome = ("weights", "valid", "paper's rules", "duration s")
    results = {"trainings": {curve.name: curve.score for curve in curves}}
    report(
        results,
        [table("The paper's preset", (*head, *outcome), rows(curves))],
        as_json=options.json,
    )


if __name__ == "__main__":
    main()
