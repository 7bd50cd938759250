"""``cnpgen train``: train a model on a dataset, or go on with one that was interrupted."""

import argparse
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
full disk at most a minute before, and gives the bits that it would have given. The model that is kept is the best of
ten that are judged on validation rows as by 'cnpgen evaluate'. Its file is printed on stdout. docs/training.md says
how to choose.
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
    option("--growth", metavar="X", type=float, help="by which factor ramped weights grow in the run (default: 30)")
    option(
        "--imitate",
        metavar="X",
        type=float,
        help="begin with so large a fraction of the steps, such as 0.1, that imitate the plans of a dataset made with"
        " --certify (default: 0)",
    )
    option("--seed", metavar="S", type=values.seed, help="of the first parameters and the order of rows (default: 0)")
    option("--check", metavar="N", type=values.positive, default=200, help="rows to validate on (default: 200)")
    option("--workers", metavar="W", type=values.positive, help="processes of the last validation, on up to 2,000 rows")
    option("--force", action="store_true", help="replace MODEL, and throw away another run's checkpoint")
    option("--quiet", action="store_true", help="no progress and no summary")


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
    if trained.made:
        _draw(trained)
    if not arguments.quiet:
        print(summary(trained), file=sys.stderr)
    print(trained.path)
    return 0


def _train(arguments: argparse.Namespace, watch: Watch) -> "Trained":
    from cnpgen.training.train import train_model

    return train_model(
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


def _settings(arguments: argparse.Namespace) -> "TrainingSettings":
    from cnpgen.training.settings import METRICS, TrainingSettings

    names = ("hidden", "layers", "batch_size", "learning_rate", "seed")
    given = {name: getattr(arguments, name) for name in names if getattr(arguments, name) is not None}
    metric = METRICS[arguments.metric or "ramped"]
    given["metric"] = metric if arguments.growth is None else replace(metric, growth=arguments.growth)
    if arguments.imitate is not None:
        given["imitation"] = arguments.imitate
    return TrainingSettings(**given)


def _command(arguments: argparse.Namespace) -> str:
    """Return the command that makes this model, without what changes nothing."""
    lengths, network = ("cpu_seconds", "steps", "epochs"), ("hidden", "layers", "batch_size", "learning_rate")
    names = (*lengths, *network, "metric", "growth", "imitate", "seed", "check")
    default = arguments.parser.get_default
    said = [(name.replace("_", "-"), getattr(arguments, name)) for name in names]
    said = [(name, value) for name, value in said if value != default(name)]
    options = [
        f"--{name} {value:g}" if isinstance(value, float) else f"--{name} {value}" for name, value in said if value
    ]
    return " ".join(["cnpgen train", arguments.folder.name, "-o", arguments.out.name, *options])


def _draw(trained: "Trained") -> None:
    """Draw the learning curve where that is possible."""
    from cnpgen.errors import MachineError
    from cnpgen.training.curve import plot_curve

    try:
        plot_curve(trained.model.log, trained.path.with_suffix(".png"))
    except MachineError as error:
        print(f"cnpgen: no learning curve: {error}", file=sys.stderr)
