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
The loss is the problem's objective and its constraints along every motion; no demonstrations are needed. Beside the
model there are a log, .jsonl, a picture of it, .png (if matplotlib is installed), and until it is finished a
checkpoint: after Ctrl-C (exit code 130) or SIGTERM (143) the same command goes on where it was, after kill -9 or a
full disk at most a minute before, and gives the parameters that it would have given. The model that is kept is the
best of ten, compared on validation rows as 'cnpgen evaluate' judges them; its score is that on others. Its file is
printed on stdout. docs/training.md says how to choose.
"""

_CHECK = "validation rows to compare models by, half of all at most (default: 200)"
_STEPS, _FLAGS = ("bending_steps", "landing_steps"), ("within_limits", "paced")
_SECONDS = "how long to train: CPU time of the steps; compiling and validations come on top (default: 2 min)"


def add(commands: "Commands[Parser]") -> None:
    """Add the command."""
    parser = add_command(commands, "train", run, title="train a planner on a dataset", text=_TEXT)
    option = parser.add_argument
    option("folder", metavar="DIR", type=Path, help="the dataset")
    option("-o", "--out", metavar="MODEL", type=Path, required=True, help="where the model goes, .h5")
    _add_length(parser)
    _add_how(parser)
    option("--check", metavar="N", type=values.positive, default=200, help=_CHECK)
    option("--workers", metavar="W", type=values.positive, help="processes of the last validation, on up to 2,000 rows")
    option("--force", action="store_true", help="replace MODEL and the files beside it, another run's checkpoint too")
    option("--quiet", action="store_true", help="no progress and no summary")


def _add_length(parser: Parser) -> None:
    option = parser.add_mutually_exclusive_group().add_argument
    option("--cpu-seconds", metavar="S", type=values.seconds, help=_SECONDS)
    option("--steps", metavar="N", type=values.positive, help="likewise, in steps")
    option("--epochs", metavar="E", type=values.positive, help="likewise, in passes over all rows")


def _add_how(parser: Parser) -> None:
    option, metrics = parser.add_argument, ("ramped", "fixed", "learned", "bounded")
    option("--hidden", metavar="W", type=values.positive, help="width of the network's layers (default: 128)")
    option("--layers", metavar="L", type=values.positive, help="depth of its trunk (default: 5)")
    option("--batch-size", metavar="B", type=values.positive, help="rows per step, or all there are (default: 64)")
    option("--learning-rate", metavar="X", type=float, help="largest learning rate of Adam (default: 1e-3)")
    option("--metric", choices=metrics, help="weights of the constraints (default: ramped)")
    option("--growth", metavar="X", type=float, help="by which factor ramped weights grow in the run (default: 30)")
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
        help="what motion times are a multiple of: the time of the distance at the velocity limits, or that in which"
        " joints could reach their goal states (default: distance)",
    )
    option("--rate-bias", metavar="X", type=float, help="logarithm of the first guess of that factor (default: -0.5)")
    option(
        "--bending-steps", metavar="N", type=values.positive, help="steps that bend the line to the goal (default: 1)"
    )
    option("--landing-steps", metavar="N", type=values.positive, help="likewise of what the network gives (default: 1)")
    option("--within-limits", action="store_true", help="keep control points within the joint limits in these steps")
    option("--paced", action="store_true", help="let the planner fit rates to the limits behind the network")
    option(
        "--imitate",
        metavar="X",
        type=float,
        help="begin with so large a fraction of the steps, such as 0.1, that imitate the plans of a dataset made with"
        " --certify (default: 0)",
    )
    option(
        "--from",
        dest="start_from",
        metavar="MODEL",
        help="begin with the parameters of a model, by name or file, instead of random ones; --hidden, --layers and"
        " --expected-time must be as it was trained with",
    )
    option("--seed", metavar="S", type=values.seed, help="of the first parameters and the order of rows (default: 0)")


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
