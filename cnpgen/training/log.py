"""Training log, one JSON object per line, in a file to follow the run and in the checkpoint; its learning curve."""

import json
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

from cnpgen.errors import UsageError
from cnpgen.store.files.atomic import committing, write_file
from cnpgen.store.files.documents import parse_json
from cnpgen.store.files.figure_file import new_figure
from cnpgen.store.files.journal import append_line

if TYPE_CHECKING:
    from matplotlib.axes import Axes

FIRST_LINE_KEYS = {"step", "epoch", "learning_rate", "seconds", "lost"}
MIN_DRAWN_TERM = 1e-12  # smaller terms are drawn here


class TrainingLog:
    """A log that records are appended to.

    Its file begins with the previous lines; new lines are appended to this list, too.
    """

    def __init__(self, path: Path, lines: list[str]) -> None:
        self.path, self.lines = path, lines
        write_file(path, self.text)

    def write(self, record: Mapping[str, Any]) -> None:
        """Append a record."""
        line = json.dumps(record, allow_nan=False)
        self.lines.append(line)
        append_line(self.path, line)

    @property
    def text(self) -> str:
        """Text of the whole log."""
        return "".join(f"{line}\n" for line in self.lines)


def is_log(path: Path) -> bool:
    """Return whether a file is a training log, by its first line, or empty."""
    try:
        with path.open("rb") as file:
            first = file.readline(1 << 16)
        record = parse_json(first.decode() or "null")
    except (OSError, ValueError):
        return False
    return not first or (isinstance(record, dict) and record.keys() >= FIRST_LINE_KEYS)


def plot_curve(log: str, path: str | Path) -> None:
    """Draw a training log, one JSON object per line, as ``.png``, ``.pdf`` or ``.svg``; an existing file is replaced.

    Raise UsageError if the log contains no step, and MachineError if matplotlib is
    missing or the file cannot be written.
    """
    records = [json.loads(line) for line in log.splitlines()]
    steps = [record for record in records if "loss" in record]
    if not steps:
        raise UsageError("the log contains no step: nothing to draw")
    figure = new_figure(12, 7)
    axes = figure.subplots(2, 2, sharex=True).ravel()
    _draw_loss(axes[0], steps)
    _draw_terms(axes[1], steps)
    checks = [record for record in records if "validation" in record]
    _draw_validity(axes[2], checks)
    durations = [record["validation"]["duration_s"] for record in checks]
    axes[3].plot(_column(checks, "seconds"), durations, marker=".")
    axes[3].set_ylabel("mean motion time [s]")
    for axis in axes[2:]:
        axis.set_xlabel("CPU time of training [s]")
    for axis in axes:
        axis.grid(alpha=0.3)
    with committing(Path(path)) as temporary:
        figure.savefig(temporary, format=Path(path).suffix.removeprefix("."))


def _draw_loss(axis: "Axes", steps: list[dict[str, Any]]) -> None:
    seconds = _column(steps, "seconds")
    axis.plot(seconds, _column(steps, "loss"), label="weighted sum")
    axis.plot(
        seconds, [record["terms"]["time"] for record in steps], label="task loss alone"
    )
    axis.set_ylabel("loss [s]")
    axis.set_yscale("log")
    _name_lines(axis)


def _draw_terms(axis: "Axes", steps: list[dict[str, Any]]) -> None:
    """Draw every constraint term, and its budget in the problem file as a dashed line."""
    seconds, budgets = _column(steps, "seconds"), steps[0].get("budgets", {})
    for name in steps[0]["weights"]:
        (line,) = axis.plot(
            seconds,
            [max(record["terms"][name], MIN_DRAWN_TERM) for record in steps],
            label=name,
        )
        if budgets.get(name):
            axis.axhline(
                budgets[name], color=line.get_color(), linestyle="--", linewidth=0.8
            )
    axis.set_ylabel("terms (dashed: budgets)")
    axis.set_yscale("log")
    _name_lines(axis)


def _draw_validity(axis: "Axes", checks: list[dict[str, Any]]) -> None:
    seconds = _column(checks, "seconds")
    for name, label in (
        ("valid", "strict verdict"),
        ("paper_valid", "the paper's rules"),
    ):
        if all(name in record["validation"] for record in checks):
            axis.plot(
                seconds,
                [100 * record["validation"][name] for record in checks],
                marker=".",
                label=label,
            )
    axis.set_ylabel("valid plans [%]")
    axis.set_ylim(0, 101)
    _name_lines(axis)


def _name_lines(axis: "Axes") -> None:
    """Draw a legend above the axes, so that it covers no curve."""
    axis.legend(
        fontsize=8,
        loc="lower center",
        bbox_to_anchor=(0.5, 1.0),
        ncols=4,
        frameon=False,
    )


def _column(records: list[dict[str, Any]], name: str) -> list[float]:
    return [record[name] for record in records]
