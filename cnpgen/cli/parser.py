"""argparse with errors of one line that suggest the nearest known name.

argparse has no public names for the error of a choice, the width of the command column,
the known options and some types. Only this module uses the private ones; others import
``Options`` from here. Tests of the errors detect changes of argparse.
"""

import argparse
import re
from collections.abc import Sequence
from types import ModuleType
from typing import Any, NoReturn, Protocol

from cnpgen.cli import values
from cnpgen.errors import UsageError, nearest

# How values begin: -5ms; before Python 3.14 argparse takes it for an option.
_NEGATIVE = re.compile(r"-\.?[0-9]")


class _Help(argparse.RawDescriptionHelpFormatter):
    """Help with a column wide enough for all commands.

    Argparse ignores their indentation.
    """

    def __init__(self, prog: str, **options: Any) -> None:
        super().__init__(prog, **options)
        self._action_max_length = len("    make-dataset")


class _StoreOnce(argparse._StoreAction):
    """Store the value of an option, and refuse another one after it: one would be lost."""

    def __call__(
        self,
        parser: argparse.ArgumentParser,
        namespace: argparse.Namespace,
        values: Any,
        option_string: str | None = None,
    ) -> None:
        """Store a value.

        Raises:
            argparse.ArgumentError: The option has another value already.
        """
        assert isinstance(parser, Parser)
        before = parser.given.setdefault(self.dest, values)
        if option_string and before != values:
            raise argparse.ArgumentError(
                self, f"given twice, {before} and {values}: expected once"
            )
        super().__call__(parser, namespace, values, option_string)


class Parser(argparse.ArgumentParser):
    """A parser that raises UsageError instead of printing its usage and leaving."""

    def __init__(self, **options: Any) -> None:
        super().__init__(
            # A script must not break when an option is added.
            allow_abbrev=False,
            formatter_class=_Help,
            **options,
        )
        self._negative_number_matcher = _NEGATIVE
        # Groups of options share this registry: None is the action of most options.
        self.register("action", None, _StoreOnce)
        # Option -> its value.
        self.given: dict[str, Any] = {}

    def error(self, message: str) -> NoReturn:
        """Raise UsageError with the error and the help command on one line."""
        raise UsageError(
            f"{message.removeprefix('argument ')}; see '{self.prog} --help'"
        )

    def _check_value(self, action: argparse.Action, value: Any) -> None:
        if action.choices is None or value in action.choices:
            return
        known = list(action.choices)
        hint = nearest(str(value), known)
        if isinstance(action, argparse._SubParsersAction):
            self.error(
                f"unknown command {value!r}{hint or ', expected one of ' + ', '.join(known)}"
            )
        raise argparse.ArgumentError(
            action, f"expected one of {', '.join(known)}, got {value!r}{hint}"
        )

    def refuse(self, extras: Sequence[str]) -> NoReturn:
        """Raise UsageError for unknown arguments."""
        option = next(
            (text.partition("=")[0] for text in extras if text.startswith("-")), None
        )
        if option is None:
            self.error(f"unexpected argument {extras[0]!r}")
        self.error(
            f"unknown option {option!r}{nearest(option, self._option_string_actions)}"
        )


# What ``add_subparsers`` returns: commands are added to it.
Commands = argparse._SubParsersAction
# A parser or a group of its options: options are added to it.
Options = argparse._ActionsContainer


class Alternative(Protocol):
    """A module with another kind of input of a command.

    Its docstring is a title, which names its options, and the part of the help on this
    input.
    """

    __doc__: str | None

    def add_options(self, options: "Options") -> None:
        """Add the options that only this input has."""

    def accepts(self, arguments: argparse.Namespace) -> bool:
        """Return whether the arguments name this input.

        Refuse its options if they name another one.
        """

    def run(self, arguments: argparse.Namespace) -> int:
        """Run the command for this input and return the exit code."""


def add_command(
    commands: "Commands[Any]",
    name: str,
    module: ModuleType,
    alternatives: Sequence[Alternative] = (),
) -> None:
    """Add the command of a module, whose docstring is the help.

    Its function ``add_options`` adds arguments and options to a parser. ``run`` runs
    the command with the parsed arguments, and returns the exit code if it can be
    another one than 0. An alternative runs in its place where it accepts the arguments.
    """
    title, text = _title_and_text(module)
    text = "\n".join(
        [text, *(_title_and_text(alternative)[1] for alternative in alternatives)]
    )
    summary = f"{title[:1].lower()}{title[1:]}".rstrip(".\n")
    parser = commands.add_parser(
        name, help=summary, description=title, epilog=text or None
    )
    # Keep an option before the command.
    add_common(parser, default=argparse.SUPPRESS)
    module.add_options(parser)
    for alternative in alternatives:
        alternative.add_options(
            parser.add_argument_group(
                _title_and_text(alternative)[0].rstrip(".").lower()
            )
        )

    def run(arguments: argparse.Namespace) -> int | None:
        chosen = next(
            (item for item in alternatives if item.accepts(arguments)), module
        )
        code: int | None = chosen.run(arguments)
        return code

    parser.set_defaults(run=run, parser=parser)


def _title_and_text(module: object) -> tuple[str, str]:
    """Return the first line of a docstring, and what follows it."""
    title, _, text = (module.__doc__ or "").partition("\n\n")
    return title, text


def add_common(parser: Parser, *, default: Any = False) -> None:
    """Add ``--verbose``, also named ``--debug``, and ``--quiet``."""
    for names, text in (
        (
            ("-v", "--verbose", "--debug"),
            "print messages with their time and module, and the traceback of an error",
        ),
        (("-q", "--quiet"), "print no progress, no notices and no summary"),
    ):
        parser.add_argument(*names, action="store_true", default=default, help=text)


ENGINE = ("workers", "engine", "address")


def add_engine(
    parser: Options, workers: str = "processes; default one per available core"
) -> None:
    """Add the options of ``ENGINE``, with a help for ``--workers``."""
    parser.add_argument("--workers", metavar="W", type=values.positive, help=workers)
    parser.add_argument(
        "--engine",
        metavar="NAME",
        type=values.engine,
        help="engine of the workers: local processes (loky, default), or a cluster: dask or ray ('cnpgen "
        "docs scale')",
    )
    parser.add_argument(
        "--address",
        metavar="A",
        help="address of the cluster, such as tcp://host:8786; without it a local cluster is started",
    )


EXTRAPOLATE = (
    "allow parameters outside of their ranges; the problem of the result is marked"
)


def options_of(arguments: argparse.Namespace, *names: str) -> dict[str, Any]:
    """Return options of a command as keyword arguments."""
    return {name: getattr(arguments, name) for name in names}


def refuse(arguments: argparse.Namespace, names: Sequence[str], why: str) -> None:
    """Raise UsageError if an option was passed that has no effect; ``{}`` stands for it in ``why``."""
    for action in arguments.parser._actions:
        name = action.dest
        if name in names and getattr(arguments, name) != action.default:
            # The long name, or that of a positional argument.
            raise UsageError(
                why.replace("{}", (*action.option_strings[-1:], action.metavar)[0])
            )


def refuse_others(arguments: argparse.Namespace, *names: str) -> None:
    """Raise UsageError for all options but some, the first of which is without effect of others."""
    known = {*names, "run", "parser", "json", "quiet", "verbose"}
    others = [name for name in vars(arguments) if name not in known]
    refuse(arguments, others, f"{{}} has no effect with --{names[0]}")


def add_selection(parser: Options) -> None:
    """Add the options that select samples of a folder, or the number and the seed of fresh ones."""
    option = parser.add_argument
    selected = "first sample of the split (default: 0)"
    option("--split", metavar="NAME", help="split of the folder (default: validation)")
    option("--first", metavar="I", type=values.natural, help=selected)
    option(
        "--n",
        metavar="K",
        type=values.rows,
        help="number of problems; for a folder by default all that follow",
    )
    option(
        "--seed",
        metavar="S",
        type=values.seed,
        help="root seed of fresh problems; default the recipe's",
    )


def add_json(parser: Parser) -> None:
    """Add ``--json``."""
    parser.add_argument("--json", action="store_true", help="write JSON")
