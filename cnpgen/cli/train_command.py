"""Train a planner on a dataset.

The loss is the problem's objective and constraints along every motion; no demonstrations are needed. The command also
writes a log (.jsonl), a picture of it (.png, if matplotlib is installed) and, until the end, a checkpoint. After Ctrl-C
(exit code 130), SIGTERM (143), kill -9 or a full disk the same command resumes from the checkpoint and gives the same
parameters. The best of ten models on validation samples is kept; its score is measured on other samples. The model file
is printed on stdout. 'cnpgen docs training' explains the options.
"""

import argparse
import shlex
import sys
from pathlib import Path
from typing import TYPE_CHECKING

from cnpgen.cli import recipe_names, values
from cnpgen.cli.parser import Parser, options_of
from cnpgen.cli.train_options import add_settings, changed_settings, passed_settings
from cnpgen.cli.train_text import Watch, summary
from cnpgen.errors import MachineError

if TYPE_CHECKING:
    from cnpgen.training.train import Trained


_LENGTHS = ("cpu_seconds", "steps", "epochs")
_CHECK = "validation rows to compare models by, half of all at most (default: 200)"
_SECONDS = "how long to train: CPU time of the steps; compiling and validations come on top (default: 2 min)"
_PRESET = (
    "settings of a published method, which other options override; 'paper': outputs, loss, metric and optimizer of the"
    " paper, 2,048 units, 1300 epochs"
)


def add_options(parser: Parser) -> None:
    """Add the options."""
    option = parser.add_argument
    option("folder", metavar="DIR", type=recipe_names.present, help="the dataset; or, with --robot, scenes")
    option("-o", "--out", metavar="MODEL", type=Path, required=True, help="model file to write, .h5")
    length = parser.add_mutually_exclusive_group().add_argument
    length("--cpu-seconds", metavar="S", type=values.seconds, help=_SECONDS)
    length("--steps", metavar="N", type=values.positive, help="length of the run in steps")
    length("--epochs", metavar="E", type=values.positive, help="length of the run in passes over all samples")
    option("--preset", choices=("paper",), help=_PRESET)
    add_settings(parser)
    text = "start from the parameters of a model, by name or file; --hidden, --layers, --features and --expected-time"
    text += " must be those of the model"
    option("--from", dest="start_from", metavar="MODEL", type=recipe_names.model, help=text)
    option("--check", metavar="N", type=values.positive, default=200, help=_CHECK)
    text = "train on scenes with this problem of a robot, such as panda"
    option("--robot", metavar="NAME|FILE", type=recipe_names.problem, help=text)
    option("--workers", metavar="W", type=values.positive, help="processes of the last validation, on up to 2,000 rows")
    option("--force", action="store_true", help="replace MODEL, its log and another run's checkpoint")
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
    if trained.made or not trained.path.with_suffix(".png").exists():  # a run may have ended just before it was drawn
        _draw(trained)
    if not arguments.quiet:
        print(summary(trained), file=sys.stderr)
    print(trained.path)
    return 0


def _train(arguments: argparse.Namespace, watch: Watch) -> "Trained":
    """Train with the settings and the length of a preset where the options have none."""
    from cnpgen.training.presets import PRESETS
    from cnpgen.training.settings import TrainingSettings
    from cnpgen.training.train import train_model

    preset, length = PRESETS.get(arguments.preset), options_of(arguments, *_LENGTHS)
    if preset is not None and all(value is None for value in length.values()):
        length = vars(preset.length)
    return train_model(
        arguments.folder,
        arguments.out,
        settings=changed_settings(TrainingSettings() if preset is None else preset.settings, arguments),
        **length,
        check_rows=arguments.check,
        command=_command(arguments),
        begin=watch.begin,
        watch=watch,
        **options_of(arguments, "start_from", "force", "workers", "robot"),
    )


def _command(arguments: argparse.Namespace) -> str:
    """Return the command that makes this model, without what changes nothing."""
    given = [*options_of(arguments, "preset", *_LENGTHS).items(), *passed_settings(arguments)]
    given.append(("check", arguments.check))
    if arguments.start_from is not None:
        given.insert(0, ("from", shlex.quote(Path(arguments.start_from).name)))
    if arguments.robot is not None:
        given.insert(0, ("robot", shlex.quote(Path(arguments.robot).name)))
    default = arguments.parser.get_default
    options = [f"--{name.replace('_', '-')} {value!s}" for name, value in given if value not in {None, default(name)}]
    options = [option.removesuffix(" True") for option in options]
    places = [shlex.quote(path.resolve().name) for path in (arguments.folder, arguments.out)]
    return " ".join(["cnpgen train", places[0], "-o", places[1], *options])


def _draw(trained: "Trained") -> None:
    """Draw the learning curve where that is possible."""
    from cnpgen.training.curve import plot_curve

    try:
        plot_curve(trained.model.log, trained.path.with_suffix(".png"))
    except MachineError as error:
        print(f"cnpgen: no learning curve: {error}", file=sys.stderr)
