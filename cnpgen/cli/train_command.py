"""``cnpgen train``: train a model on a dataset, or go on with one that was interrupted."""

import argparse
import sys
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

from cnpgen.cli import values
from cnpgen.cli.parser import Commands, Parser, add_command
from cnpgen.cli.progress import Meter

if TYPE_CHECKING:
    from cnpgen.training.run import Run
    from cnpgen.training.settings import TrainingSettings
    from cnpgen.training.state import State
    from cnpgen.training.train import Trained

_TEXT = """\
The loss is the problem's objective and its constraints along every motion; no demonstrations are needed. Beside the
model there are a log, .jsonl, a picture of it, .png (if matplotlib is installed), and until it is finished a
checkpoint: after Ctrl-C, kill -9 or a full disk the same command goes on, and gives the bits that it would have given.
The model that is kept is the best of ten that are judged on validation rows as by 'cnpgen evaluate'. Its file is
printed on stdout. docs/training.md says how to choose.
"""


def add(commands: "Commands[Parser]") -> None:
    """Add the command."""
    parser = add_command(commands, "train", run, title="train a planner on a dataset", text=_TEXT)
    option = parser.add_argument
    option("folder", metavar="DIR", type=Path, help="the dataset")
    option("-o", "--out", metavar="MODEL", type=Path, required=True, help="where the model goes, .h5")
    length = parser.add_mutually_exclusive_group()
    length.add_argument("--cpu-seconds", metavar="S", type=values.seconds, help="how long to train (default: 2 min)")
    length.add_argument("--steps", metavar="N", type=values.positive, help="likewise, in steps")
    length.add_argument("--epochs", metavar="E", type=values.positive, help="likewise, in passes over all rows")
    option("--hidden", metavar="W", type=values.positive, help="width of the network's layers (default: 128)")
    option("--layers", metavar="L", type=values.positive, help="depth of its trunk (default: 5)")
    option("--batch-size", metavar="B", type=values.positive, help="rows per step (default: 64)")
    option("--learning-rate", metavar="X", type=float, help="largest learning rate of Adam (default: 1e-3)")
    option(
        "--metric",
        choices=("ramped", "fixed", "learned", "bounded"),
        help="weights of the constraints (default: ramped)",
    )
    option("--seed", metavar="S", type=values.seed, help="of the first parameters and the order of rows (default: 0)")
    option("--check", metavar="N", type=values.positive, default=200, help="rows to validate on (default: 200)")
    option("--workers", metavar="W", type=values.positive, help="processes of the last validation, on up to 2,000 rows")
    option("--force", action="store_true", help="begin again, and replace what is there")
    option("--quiet", action="store_true", help="no progress and no summary")


def run(arguments: argparse.Namespace) -> int:
    """Run the command."""
    from cnpgen.training.train import train_model

    watch = _Watch(quiet=arguments.quiet)
    try:
        trained = train_model(
            arguments.folder,
            arguments.out,
            settings=_settings(arguments),
            steps=arguments.steps,
            epochs=arguments.epochs,
            cpu_seconds=arguments.cpu_seconds,
            check_rows=arguments.check,
            command=_command(arguments),
            force=arguments.force,
            workers=arguments.workers,
            begin=watch.begin,
            watch=watch,
        )
    finally:
        watch.close()
    _draw(trained)
    if not arguments.quiet:
        print(_summary(trained), file=sys.stderr)
    print(trained.path)
    return 0


def _settings(arguments: argparse.Namespace) -> "TrainingSettings":
    from cnpgen.training.settings import METRICS, TrainingSettings

    names = ("hidden", "layers", "batch_size", "learning_rate", "seed")
    given = {name: getattr(arguments, name) for name in names if getattr(arguments, name) is not None}
    if arguments.metric is not None:
        given["metric"] = METRICS[arguments.metric]
    return TrainingSettings(**given)


def _command(arguments: argparse.Namespace) -> str:
    """Return the command that makes this model, without what changes nothing."""
    names = ("cpu_seconds", "steps", "epochs", "hidden", "layers", "batch_size", "learning_rate", "metric", "seed")
    said = [(name.replace("_", "-"), getattr(arguments, name)) for name in names]
    options = [
        f"--{name} {value:g}" if isinstance(value, float) else f"--{name} {value}" for name, value in said if value
    ]
    return " ".join(["cnpgen train", arguments.folder.name, "-o", arguments.out.name, *options])


class _Watch:
    """Shows how training goes."""

    def __init__(self, *, quiet: bool) -> None:
        self._meter, self._quiet = Meter(quiet=quiet, noun="step"), quiet
        self._last = 0
        self._seen: Mapping[str, Any] = {}

    def begin(self, state: "State", run: "Run") -> None:
        """Say what begins."""
        step, steps = state.adam.step, state.steps
        self._last = step
        parameters = run.learner.architecture.n_parameters
        self._meter.begin(f"training {parameters:,} parameters on {len(run.rows):,} rows", steps, step)

    def __call__(self, record: Mapping[str, Any]) -> None:
        """Show a line of the log."""
        step = record["step"]
        self._meter(step - self._last)
        self._last = step
        if "loss" in record:
            self._seen = record
            self._meter.note(f"loss {record['loss']:.4g}")
        if "validation" in record and not self._quiet:
            print(f"step {step:,}, {record['seconds']:.0f} s: {_words(record['validation'])}", file=sys.stderr)
            print(f"  {_terms(self._seen)}", file=sys.stderr, flush=True)

    def close(self) -> None:
        """Remove the bar."""
        self._meter.close()


def _words(found: Mapping[str, Any]) -> str:
    words = [f"{found['valid']:.1%} of {found['plans']:,} plans valid", f"{found['duration_s']:.3f} s"]
    if "z_error_mm_s" in found:
        words.append(f"z error {found['z_error_mm_s']:.3f} mm s")
    if "vertical_error_rad_s" in found:
        words.append(f"vertical error {found['vertical_error_rad_s']:.4f} rad s")
    broken = sorted(found["broken"].items(), key=lambda item: -item[1])[:3]
    return ", ".join(words) + (f"; broken: {', '.join(f'{name} {count}' for name, count in broken)}" if broken else "")


def _terms(record: Mapping[str, Any]) -> str:
    """Say how large the terms are, as multiples of their budgets where they have one, and their weights."""
    words = [f"loss {record['loss']:.4g}, learning rate {record['learning_rate']:.2g}"]
    for name, weight in record["weights"].items():
        value, budget = record["terms"][name], record["budgets"][name]
        against = f"{value / budget:.2g} of its budget" if budget else f"{value:.2g}"
        words.append(f"{name} {against} (weight {weight:.2g})")
    return ", ".join(words)


def _draw(trained: "Trained") -> None:
    """Draw the learning curve where that is possible."""
    from cnpgen.errors import MachineError
    from cnpgen.training.curve import plot_curve

    try:
        plot_curve(trained.model.log, trained.path.with_suffix(".png"))
    except MachineError as error:
        print(f"cnpgen: no learning curve: {error}", file=sys.stderr)


def _summary(trained: "Trained") -> str:
    training = trained.model.training
    return (
        f"trained {training['steps']:,} steps in {training['cpu_seconds']:.0f} s of CPU time; the model of step"
        f" {training['best_step']:,} is kept: {_words(trained.score)}"
    )
