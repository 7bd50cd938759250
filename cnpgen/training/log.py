"""Training log, one JSON object per line, in a file to follow the run and in the checkpoint; its learning curve."""

import json
from pathlib import Path
from typing import TYPE_CHECKING

from cnpgen.documents import JsonMapping, JsonObject
from cnpgen.errors import UsageError
from cnpgen.store.files.atomic import append_to_file, committing, write_file
from cnpgen.store.files.documents import parse_json
from cnpgen.store.files.figure_file import new_figure

if TYPE_CHECKING:
    from matplotlib.axes import Axes

FIRST_LINE_KEYS = {"step", "epoch", "learning_rate", "seconds", "lost"}
MIN_DRAWN_RATIO = 1e-6  # smaller violations over their budgets are drawn here


class TrainingLog:
    """A log that records are appended to.

    Its file begins with the previous lines; new lines are appended to this list, too.
    """

    def __init__(self, path: Path, lines: list[str]) -> None:
        self.path = path
        self.lines = lines
        write_file(path, self.text)

    def write(self, record: JsonMapping) -> None:
        """Append a record."""
        line = json.dumps(record, allow_nan=False)
        self.lines.append(line)
        append_to_file(self.path, f"{line}\n".encode())

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
    checks = [record for record in records if "validation" in record]
    figure = new_figure(12, 3.6)
    axes = figure.subplots(1, 3)
    _draw_validity(axes[0], checks)
    durations = [record["validation"]["duration_s"] for record in checks]
    axes[1].plot(_column(checks, "seconds"), durations, marker=".")
    axes[1].set_title("mean motion time [s]")
    _draw_violations(axes[2], steps)
    for axis in axes:
        axis.set_xlabel("CPU time of training [s]")
        axis.grid(alpha=0.3)
    with committing(Path(path)) as temporary:
        figure.savefig(temporary, format=Path(path).suffix.removeprefix("."))


def _draw_violations(axis: "Axes", steps: list[JsonObject]) -> None:
    """Draw the mean violations over their budgets in the problem file, or as they are if none has a budget."""
    seconds = _column(steps, "seconds")
    budgets = steps[0].get("budgets", {})
    weights = steps[0]["weights"]
    for name in [name for name in weights if budgets.get(name)] or weights:
        values = [record["terms"][name] / (budgets.get(name) or 1) for record in steps]
        axis.plot(seconds, [max(v, MIN_DRAWN_RATIO) for v in values], label=name)
    axis.axhline(1, color="0.3", linestyle="--", linewidth=0.8)
    axis.set_title("mean violation over budget")
    axis.set_yscale("log")
    axis.legend(fontsize=8)


def _draw_validity(axis: "Axes", checks: list[JsonObject]) -> None:
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
    axis.set_title("valid plans [%]")
    axis.set_ylim(top=100.5)
    axis.legend(fontsize=8)


def _column(records: list[JsonObject], name: str) -> list[float]:
    return [record[name] for record in records]
