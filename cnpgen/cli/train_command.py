"""``cnpgen train``: train a model on a dataset, or go on with one that was interrupted."""

import argparse
import shlex
import sys
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

from cnpgen.cli import values
from cnpgen.cli.parser import Commands, Parser, add_command
from cnpgen.cli.train_text import Watch, summary

if TYPE_CHECKING:
    from cnpgen.training.settings import TrainingSettings
    from cnpgen.training.train import Trained

_TEXT = """\
The loss is the problem's objective and constraints along every motion; no demonstrations are needed. The command also
writes a log (.jsonl), a picture of it (.png, if matplotlib is installed) and, until the end, a checkpoint. After Ctrl-C
(exit code 130), SIGTERM (143), kill -9 or a full disk the same command resumes from the checkpoint and gives the same
parameters. The best of ten models on validation samples is kept; its score is measured on other samples. The model file
is printed on stdout. 'cnpgen docs training' explains the options.
"""

_CHECK = "validation rows to compare models by, half of all at most (default: 200)"
_STEPS, _FLAGS = ("line_projection_steps", "projection_steps"), ("within_limits", "time_parametrized")
_SECONDS = "how long to train: CPU time of the steps; compiling and validations come on top (default: 2 min)"


def add(commands: "Commands[Parser]") -> None:
    """Add the command."""
    parser = add_command(commands, "train", run, title="train a planner on a dataset", text=_TEXT)
    option = parser.add_argument
    option("folder", metavar="DIR", type=Path, help="the dataset")
    option("-o", "--out", metavar="MODEL", type=Path, required=True, help="model file to write, .h5")
    _add_length(parser)
    _add_how(parser)
    option("--check", metavar="N", type=values.positive, default=200, help=_CHECK)
    option("--workers", metavar="W", type=values.positive, help="processes of the last validation, on up to 2,000 rows")
    option("--force", action="store_true", help="replace MODEL, its log and another run's checkpoint")
    option("--quiet", action="store_true", help="no progress and no summary")


def _add_length(parser: Parser) -> None:
    option = parser.add_mutually_exclusive_group().add_argument
    option("--cpu-seconds", metavar="S", type=values.seconds, help=_SECONDS)
    option("--steps", metavar="N", type=values.positive, help="length of the run in steps")
    option("--epochs", metavar="E", type=values.positive, help="length of the run in passes over all samples")


def _add_how(parser: Parser) -> None:
    option, metrics = parser.add_argument, ("ramped", "fixed", "learned", "bounded")
    option("--hidden", metavar="W", type=values.positive, help="width of the network's layers (default: 128)")
    option("--layers", metavar="L", type=values.positive, help="depth of its trunk (default: 5)")
    option("--batch-size", metavar="B", type=values.positive, help="rows per step, or all there are (default: 64)")
    option("--learning-rate", metavar="X", type=float, help="largest learning rate of Adam (default: 1e-3)")
    option("--metric", choices=metrics, help="weights of the constraints (default: ramped)")
    option("--growth", metavar="X", type=float, help="factor by which ramped weights grow (default: 30)")
    option(
        "--margin",
        metavar="TERM=X",
        type=_margin,
        action="append",
        help="train with limits X times those of the problem, such as joint-acceleration=0.96 (default: 0.985; of"
        " joint-velocity 0.99); may be repeated",
    )
    option(
        "--expected-time",
        choices=("distance", "reach"),
        help="unit of the network's durations: the distance over the velocity limits, or the time in which joints"
        " reach their goal states (default: distance)",
    )
    option(
        "--rate-bias",
        metavar="X",
        type=float,
        help="logarithm of the first guess of the duration factor (default: -0.5)",
    )
    option(
        "--line-projection-steps",
        metavar="N",
        type=values.positive,
        help="Gauss-Newton steps that project the line onto the manifold (default: 1)",
    )
    option("--projection-steps", metavar="N", type=values.positive, help="the same for the network's path (default: 1)")
    option("--within-limits", action="store_true", help="keep control points within the joint limits in these steps")
    option("--time-parametrized", action="store_true", help="fit the rates to the limits after the network")
    option(
        "--imitate",
        metavar="X",
        type=float,
        help="fraction of the steps, such as 0.1, that imitate the plans of a dataset made with --certify (default: 0)",
    )
    option(
        "--from",
        dest="start_from",
        metavar="MODEL",
        help="start from the parameters of a model, by name or file; --hidden, --layers and --expected-time"
        " must be those of the model",
    )
    option(
        "--seed",
        metavar="S",
        type=values.seed,
        help="seed of the initial parameters and of the order of samples (default: 0)",
    )


def run(arguments: argparse.Namespace) -> int:
    """Run the command."""
    watch = Watch(quiet=arguments.quiet)
    try:
        trained = _train(arguments, watch)
    except KeyboardInterrupt as interruption:
        checkpoint = arguments.out.with_suffix(".checkpoint")
        kept = f"{checkpoint} keeps the run, run the same command again to go on" if checkpoint.exists() else ""
        raise type(interruption)(kept) from interruption
    finally:
        watch.close()
    if trained.made or not trained.path.with_suffix(".png").exists():  # a run may have ended just before it was drawn
        _draw(trained)
    if not arguments.quiet:
        print(summary(trained), file=sys.stderr)
    print(trained.path)
    return 0


def _margin(text: str) -> tuple[str, float]:
    """Read TERM=X."""
    term, sign, factor = text.partition("=")
    try:
        found = float(factor)
    except ValueError:
        found = -1.0
    if not sign or not term or not 0 < found <= 1:
        raise argparse.ArgumentTypeError(f"expected TERM=X with X above 0 and at most 1, got {text!r}")
    return term, found


def _train(arguments: argparse.Namespace, watch: Watch) -> "Trained":
    from cnpgen.training.train import train_model

    return train_model(
        arguments.folder,
        arguments.out,
        settings=_settings(arguments),
        start_from=arguments.start_from,
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


def _settings(arguments: argparse.Namespace) -> "TrainingSettings":
    from cnpgen.errors import UsageError
    from cnpgen.training.settings import METRICS, TrainingSettings

    names = ("hidden", "layers", "batch_size", "learning_rate", "expected_time", "rate_bias", *_STEPS, *_FLAGS, "seed")
    given = {name: getattr(arguments, name) for name in names if getattr(arguments, name) is not None}
    metric = METRICS[arguments.metric or "ramped"]
    if arguments.growth is not None and metric.kind == "fixed":
        raise UsageError("--growth changes nothing with --metric fixed, whose weights do not grow")
    given["metric"] = metric if arguments.growth is None else replace(metric, growth=arguments.growth)
    if arguments.margin is not None:
        given["margins"] = dict(arguments.margin)
    if arguments.imitate is not None:
        given["imitation"] = arguments.imitate
    return TrainingSettings(**given)


def _command(arguments: argparse.Namespace) -> str:
    """Return the command that makes this model, without what changes nothing."""
    lengths, network = ("cpu_seconds", "steps", "epochs"), ("hidden", "layers", "batch_size", "learning_rate")
    how = ("metric", "growth", "expected_time", "rate_bias", *_STEPS, *_FLAGS, "imitate", "seed", "check")
    names = (*lengths, *network, *how)
    default = arguments.parser.get_default
    said = [(name, getattr(arguments, name)) for name in names]
    said[-2:-2] = [("margin", f"{term}={factor:g}") for term, factor in arguments.margin or ()]
    if arguments.start_from is not None:
        said.insert(0, ("from", shlex.quote(Path(arguments.start_from).name)))
    options = [f"--{name.replace('_', '-')} {value!s}" for name, value in said if value not in {None, default(name)}]
    options = [option.removesuffix(" True") for option in options]
    places = [shlex.quote(path.resolve().name) for path in (arguments.folder, arguments.out)]
    return " ".join(["cnpgen train", places[0], "-o", places[1], *options])


def _draw(trained: "Trained") -> None:
    """Draw the learning curve where that is possible."""
    from cnpgen.errors import MachineError
    from cnpgen.training.curve import plot_curve

    try:
        plot_curve(trained.model.log, trained.path.with_suffix(".png"))
    except MachineError as error:
        print(f"cnpgen: no learning curve: {error}", file=sys.stderr)
