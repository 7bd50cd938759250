"""Train a planner on a dataset.

The loss is the problem's objective and constraints along every motion; no
demonstrations are needed. The command also writes a log (.jsonl), a picture of it
(.png, if matplotlib is installed) and, until the end, a checkpoint. After Ctrl-C (exit
code 130), SIGTERM (143), kill -9 or a full disk the same command resumes from the
checkpoint and gives the same parameters. The best of ten models on validation samples
is kept; its score is measured on other samples. The model file is printed on stdout.
'cnpgen docs training' explains the options.
"""

import argparse
import shlex
import sys
import textwrap
from pathlib import Path
from typing import TYPE_CHECKING

from cnpgen.cli import recipe_names, values
from cnpgen.cli.parser import Parser, options_of
from cnpgen.cli.terminal import LINE_WIDTH, Meter
from cnpgen.cli.train_options import add_settings, changed_settings, passed_settings
from cnpgen.documents import JsonMapping
from cnpgen.errors import MachineError, counted

if TYPE_CHECKING:
    from cnpgen.training.checkpoint import State
    from cnpgen.training.train import Trained
    from cnpgen.training.training_run import Run


OFTEN = 100  # passes over the same rows after which more rows help more

_LENGTHS = ("cpu_seconds", "steps", "epochs")
_CHECK = "validation rows to compare models by, half of all at most (default: 200)"
_SECONDS = "how long to train: CPU time of the steps; compiling and validations come on top (default: 2 min)"
_PRESET = (
    "settings of a published method, which other options override; 'paper': outputs, loss, metric and optimizer of the"
    " paper, 2,048 units, 1300 epochs"
)


def add_options(parser: Parser) -> None:
    option = parser.add_argument
    option(
        "folder",
        metavar="DIR",
        type=recipe_names.present,
        help="the dataset; or, with --robot, scenes",
    )
    option(
        "-o",
        "--out",
        metavar="MODEL",
        type=Path,
        required=True,
        help="model file to write, .h5",
    )
    length = parser.add_mutually_exclusive_group().add_argument
    length("--cpu-seconds", metavar="S", type=values.seconds, help=_SECONDS)
    text = "length of the run in steps"
    length("--steps", metavar="N", type=values.positive, help=text)
    text = "length of the run in passes over all samples"
    length("--epochs", metavar="E", type=values.positive, help=text)
    option("--preset", choices=("paper",), help=_PRESET)
    add_settings(parser)
    text = "start from the parameters of a model, by name or file; --hidden, --layers, --features and --expected-time"
    text += " must be those of the model"
    option(
        "--from", dest="start_from", metavar="MODEL", type=recipe_names.model, help=text
    )
    option("--check", metavar="N", type=values.positive, default=200, help=_CHECK)
    text = "train on scenes with this problem of a robot, such as panda"
    option("--robot", metavar="NAME|FILE", type=recipe_names.problem, help=text)
    text = "processes of the last validation, on up to 2,000 rows"
    option("--workers", metavar="W", type=values.positive, help=text)
    text = "replace MODEL, its log and another run's checkpoint"
    option("--force", action="store_true", help=text)


class Watch:
    """Shows how training goes."""

    def __init__(self, *, quiet: bool) -> None:
        self._meter = Meter(quiet=quiet, noun="step")
        self._quiet = quiet
        self._last = 0
        self._seen: JsonMapping = {}

    def begin(self, state: "State", run: "Run") -> None:
        """Say what begins."""
        step = state.adam.step
        steps = state.steps
        self._last = step
        parameters = run.learner.architecture.n_parameters
        self._meter.begin(
            f"training {parameters:,} parameters on {counted(len(run.rows), 'row')}",
            steps,
            step,
        )
        wanted = run.learner.settings.batch_size
        taken = run.order.batch_size
        if taken < wanted and not self._quiet:
            print(
                f"every step takes all {taken:,} rows: there are no {wanted:,} for a batch",
                file=sys.stderr,
            )
        # Passes = steps * rows per step / rows of the data set.
        passes = steps * taken / len(run.rows)
        if passes > OFTEN and not self._quiet:
            print(
                f"every row is seen {passes:,.0f} times: a planner from more rows is better",
                file=sys.stderr,
            )

    def __call__(self, record: JsonMapping) -> None:
        """Show a line of the log."""
        step = record["step"]
        self._meter(step - self._last)
        self._last = step
        for name in ("imitation", "loss"):
            if name in record:
                self._meter.note(f"{name} {record[name]:.4g}")
        if "loss" in record:
            self._seen = record
        if "validation" in record and not self._quiet:
            text = _fitted(
                f"step {step:,}, {record['seconds']:.0f} s: {_words(record['validation'])}"
            )
            print(
                "\n".join([text, *([_terms(self._seen)] if self._seen else [])]),
                file=sys.stderr,
                flush=True,
            )

    def close(self) -> None:
        """Remove the bar."""
        self._meter.close()


def run(arguments: argparse.Namespace) -> None:
    watch = Watch(quiet=arguments.quiet)
    try:
        trained = _train(arguments, watch)
    except KeyboardInterrupt as interruption:
        checkpoint = arguments.out.with_suffix(".checkpoint")
        kept = (
            f"{checkpoint} keeps the run, run the same command again to go on"
            if checkpoint.exists()
            else ""
        )
        raise type(interruption)(kept) from interruption
    finally:
        watch.close()
    if trained.made or not trained.path.with_suffix(".png").exists():
        # A run may have ended just before it was drawn.
        _draw(trained)
    if not arguments.quiet:
        print(summary(trained), file=sys.stderr)
    print(trained.path)


def _train(arguments: argparse.Namespace, watch: Watch) -> "Trained":
    """Train with the settings and the length of a preset where the options have none."""
    from cnpgen.training.presets import PRESETS
    from cnpgen.training.settings import TrainingSettings
    from cnpgen.training.train import train_model
    from cnpgen.training.training_options import TrainingOptions

    preset = PRESETS.get(arguments.preset)
    length = options_of(arguments, *_LENGTHS)
    # A length that is given replaces that of the preset as a whole.
    if preset is not None and all(value is None for value in length.values()):
        length = dict(vars(preset.length))
    options = TrainingOptions(
        epochs=length.pop("epochs"),
        command=_command(arguments),
        begin=watch.begin,
        watch=watch,
        **options_of(arguments, "robot"),
    )
    return train_model(
        arguments.folder,
        arguments.out,
        settings=changed_settings(
            TrainingSettings() if preset is None else preset.settings, arguments
        ),
        **length,
        check_rows=arguments.check,
        options=options,
        **options_of(arguments, "start_from", "force", "workers"),
    )


def _command(arguments: argparse.Namespace) -> str:
    """Return the command that makes this model, without what changes nothing."""
    given = [
        *options_of(arguments, "preset", *_LENGTHS).items(),
        *passed_settings(arguments),
    ]
    given.append(("check", arguments.check))
    if arguments.start_from is not None:
        given.insert(0, ("from", shlex.quote(Path(arguments.start_from).name)))
    if arguments.robot is not None:
        given.insert(0, ("robot", shlex.quote(Path(arguments.robot).name)))
    default = arguments.parser.get_default
    options = [
        f"--{name.replace('_', '-')} {value!s}"
        for name, value in given
        if value not in {None, default(name)}
    ]
    options = [option.removesuffix(" True") for option in options]
    places = [
        shlex.quote(path.resolve().name) for path in (arguments.folder, arguments.out)
    ]
    return " ".join(["cnpgen train", places[0], "-o", places[1], *options])


def _draw(trained: "Trained") -> None:
    """Draw the learning curve where that is possible."""
    from cnpgen.training.log import plot_curve

    try:
        plot_curve(trained.model.log, trained.path.with_suffix(".png"))
    except MachineError as error:
        print(f"cnpgen: no learning curve: {error}", file=sys.stderr)


def _words(found: JsonMapping) -> str:
    text = f"{found['valid']:.1%} of {found['plans']:,} plans valid, {found['duration_s']:.3f} s"
    if "z_error_mm_s" in found:
        text += f", z error {found['z_error_mm_s']:.3f} mm s"
    if "vertical_error_rad_s" in found:
        text += f", vertical error {found['vertical_error_rad_s']:.4f} rad s"
    broken = sorted(found["broken"].items(), key=lambda item: -item[1])[:3]
    return text + (
        f"; broken: {', '.join(f'{name} {count}' for name, count in broken)}"
        if broken
        else ""
    )


def _terms(record: JsonMapping) -> str:
    """Say how large the terms are, as multiples of their budgets where they have one, and their weights."""
    words = []
    for name, weight in record["weights"].items():
        value = record["terms"][name]
        budget = record["budgets"][name]
        amount = f"{value / budget:.2g}" if budget else f"({value:.2g})"
        words.append(f"{name} {amount} x {weight:.2g}")
    head = f"loss {record['loss']:.4g}, learning rate {record['learning_rate']:.2g}; terms / budgets x weights: "
    return _fitted("  " + head + ", ".join(words))


def summary(trained: "Trained") -> str:
    """Say in a line what came of a run."""
    training = trained.model.training
    steps = f"{training['steps']:,} steps"
    best = f"{training['best_step']:,}"
    words = _words(trained.score)
    if not trained.made:
        return _fitted(
            f"already trained: {steps}, of which that of step {best}: {words}"
        )
    return _fitted(
        f"trained {steps} in {training['cpu_seconds']:.0f} s of CPU time and"
        f" {training['validation_cpu_seconds']:.0f} s for validations; this run took {trained.times};"
        f" the model of step {best} is kept: {words}; goal_acceleration ="
        f" {trained.model.goal_acceleration!r}"
    )


def _fitted(text: str) -> str:
    """Wrap a line to ``LINE_WIDTH``."""
    return "\n".join(
        textwrap.wrap(
            text, LINE_WIDTH, subsequent_indent="    ", break_on_hyphens=False
        )
    )
