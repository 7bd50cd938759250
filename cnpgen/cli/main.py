"""The command line: parse, run one command, turn errors into one line and an exit code."""

import argparse
import io
import os
import re
import sys
import traceback
import warnings
from collections.abc import Container, Iterator, Sequence
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any, NoReturn

from cnpgen.cli import docs_command
from cnpgen.cli.commands import (
    command_names,
    is_command,
    load_command,
    unused_commands,
)
from cnpgen.cli.interruption import Terminated, exit_code, interruptible
from cnpgen.cli.parser import Parser, add_command, add_common
from cnpgen.cli.terminal import printing_safely
from cnpgen.errors import (
    CnpgenError,
    MachineError,
    RecipeError,
    Spelling,
    python_spelling,
)
from cnpgen.machine import versions
from cnpgen.machine.threads import prefer_one_thread
from cnpgen.schema import addons
from cnpgen.schema.foreign_paths import foreign_path_hint

_DESCRIPTION = "Generate and verify datasets for kinodynamic motion planning, train planners and optimize plans."

_EPILOG = """\
examples:
  cnpgen list                                        list recipes
  cnpgen init my-arm --urdf arm.urdf                 recipes for your own arm
  cnpgen copy airhockey-hit my-hits                  copy a recipe for editing
  cnpgen make-dataset airhockey-hit --n 1000         make 1000 samples; the same command resumes
  cnpgen inspect airhockey-hit-v1 --plot hits.png    summarize them
  cnpgen validate airhockey-hit-v1 --deep            verify them
  cnpgen train airhockey-hit-v1 -o hits.h5           train a planner in two minutes
  cnpgen plan airhockey-hit-v1 --model hits.h5 -o plans.h5; a shipped one: --model airhockey-hit
  cnpgen solve airhockey-hit --n 100 -o plans.h5     plan 100 fresh problems
  cnpgen make-scenes tabletop --robot panda --n 100 -o scenes.h5
  cnpgen solve scenes.h5 --robot panda -o plans.h5   plan problems in scenes, also of MoveIt or MPiNets
  cnpgen complete airhockey-replan pucks.csv -o problems.h5
  cnpgen refine plans.h5 -o better.h5                optimize plans of any source
  cnpgen evaluate plans.h5 --plot plan.png           judge plans with Pinocchio and Coal
  cnpgen view plans.h5 --row 3 -o plan.html          show a plan in a browser
  cnpgen simulate plans.h5 --video plan.mp4          execute plans in MuJoCo
  cnpgen benchmark hits-81 --simulate                compare planners
  cnpgen export plans.h5 --to joint-trajectory       export plans for robots and simulators
  cnpgen docs hit-a-puck                             read a page of the documentation

documentation: 'cnpgen docs' lists the pages, 'cnpgen docs PAGE' prints one

stdout is data, stderr everything else. Exit codes:
  0    done
  1    the check failed: a dataset or a file is damaged, unfinished or of another problem; samples or plans are invalid
  2    a wrong argument, such as a missing path or one of another kind, or an error in a recipe
  3    the machine: no permission to read or write a path, a full disk, a broken library; also an internal
       error of cnpgen
  130  interrupted (Ctrl-C); finished shards and plans are kept, the same command resumes
  141  the reader of stdout closed it
  143  terminated (SIGTERM, as SLURM and Docker send it); resumable
"""

COMPLETION = "cnpgen.completion"  # functions that print completions and end the process
_VERBOSE = {"-v", "--verbose", "--debug"}  # options that show tracebacks
BROKEN_PIPE = 141  # 128 + SIGPIPE, as shells have it
# Arguments whose options have another name.
_OPTIONS = {
    "discard": "force",
    "initial": "initial_plans",
    "other": "other_rows",
}


class _LinkedParser(Parser):
    """A parser whose help ends with the addresses of the pages that it names."""

    def format_help(self) -> str:
        """Return the help."""
        text = super().format_help()
        addresses = docs_command.mentioned_addresses(text)
        return (
            "\n  ".join([f"{text}\non the site:", *addresses]) + "\n"
            if addresses
            else text
        )


class _Version(argparse.Action):
    """Print the version; looking it up takes milliseconds, so it is done on demand."""

    def __call__(self, parser: argparse.ArgumentParser, *_: Any) -> NoReturn:
        print(f"cnpgen {versions.installed_version('cnpgen') or '(not installed)'}")
        parser.exit()


def main(argv: Sequence[str] | None = None) -> int:
    """Run the command line with arguments, by default those of the process.

    Return the exit code.
    """
    # The namespace exists before parsing, so that an error knows the options read so
    # far.
    words = list(sys.argv[1:] if argv is None else argv)
    given = argparse.Namespace()
    prefer_one_thread()
    _prepare_streams()
    with printing_safely(), _warnings_on_one_line():
        try:
            with interruptible():
                code = _run(words, given)
            # A closed reader of stdout shows at the latest here, where the error can be
            # handled.
            sys.stdout.flush()
        except BrokenPipeError:
            return _leave_pipe()
        except (Exception, KeyboardInterrupt) as error:  # noqa: BLE001 - the boundary of the process
            if _VERBOSE.intersection(words):
                traceback.print_exc()
            return _report(error, vars(given))
    return code


def _run(words: list[str], given: argparse.Namespace) -> int:
    """Parse the words into ``given`` and run the command."""
    if "_ARGCOMPLETE" in os.environ:
        # Set by the functions of argcomplete in the shell.
        for entry in addons.installed(COMPLETION):
            entry.load()(build_parser())
    # The parser of one command needs the modules of that command only.
    first = next((word for word in words if not word.startswith("-")), "")
    parser = build_parser([first] if first and is_command(first) else None)
    # ``before`` is the word in front of each word, that of the first one is the
    # program.
    for before, word in zip(["cnpgen", *words], words, strict=False):
        if word == "" or re.fullmatch("--[a-z-]+=", word):
            parser.error(
                f"the argument after {word or before!r} is empty: is it an unset variable of the shell?"
            )
    try:
        arguments, extras = parser.parse_known_args(words, given)
    except SystemExit:
        # --help and --version have printed their text
        return 0
    # Unknown options are compared with those of the command, if there is one.
    chosen: Parser = getattr(arguments, "parser", parser)
    if extras:
        chosen.refuse(extras)
    # No command was given.
    if chosen is parser:
        parser.print_help(sys.stderr)
        return 2
    level = "WARNING" if arguments.quiet else "DEBUG" if arguments.verbose else "INFO"
    with notices(level):
        # Most commands return nothing.
        code: int = arguments.run(arguments) or 0
    return code


def build_parser(names: Sequence[str] | None = None) -> Parser:
    """Build the parser of some commands, by default of all; importing the modules of all commands takes time.

    Raises:
        MissingAddonError: A named command belongs to an add-on that this installation
            lacks.
    """
    parser = _LinkedParser(prog="cnpgen", description=_DESCRIPTION, epilog=_EPILOG)
    parser.add_argument("--version", action=_Version, nargs=0, help="show the version")
    add_common(parser)
    commands = parser.add_subparsers(
        title="commands", metavar="COMMAND", parser_class=_LinkedParser
    )
    for name in command_names() if names is None else names:
        try:
            module, alternatives = load_command(name)
        except MachineError as error:
            # A command that is asked for must work; in a list of all it is only marked.
            if names is not None:
                raise
            commands.add_parser(name, help=f"cannot be used: {error}")
        else:
            add_command(commands, name, module, alternatives)
    if names is None:
        for sentence in unused_commands():
            warnings.warn(sentence, stacklevel=2)
    return parser


def _report(error: BaseException, options: Container[str]) -> int:
    """Print an error as one line per error, with the options of the command.

    Return its exit code.
    """
    if isinstance(error, KeyboardInterrupt):
        what = "terminated" if isinstance(error, Terminated) else "interrupted"
        print(
            f"cnpgen: {what}: {error}" if str(error) else f"cnpgen: {what}",
            file=sys.stderr,
        )
        return exit_code(error)
    lines, code = _explain(error, options)
    for line in lines:
        addresses = "".join(
            f" ({address})" for address in docs_command.mentioned_addresses(line)
        )
        print(f"cnpgen: error: {line}{addresses}", file=sys.stderr)
    return code


def _explain(
    error: BaseException, options: Container[str]
) -> tuple[Sequence[str], int]:
    """Return the lines that describe an error, and the exit code."""
    if isinstance(error, RecipeError):
        return str(error).splitlines(), error.exit_code
    if isinstance(error, CnpgenError):
        return [" ".join(error.text(shell_spelling(options)).split())], error.exit_code
    code = MachineError.exit_code
    if isinstance(error, ImportError):
        causes = "'cnpgen doctor' checks this installation, 'cnpgen docs troubleshooting' lists causes"
        hint = foreign_path_hint()
        remedy = hint if hint and hint not in str(error) else causes
        return [" ".join(f"{error}; {remedy}".split())], code
    if isinstance(error, MemoryError):
        return ["out of memory; fewer --workers need less"], code
    if isinstance(error, OSError) and error.strerror:
        return [
            f"{error.filename}: {error.strerror}" if error.filename else error.strerror
        ], code
    return [_describe_bug(error)], code


def _describe_bug(error: BaseException) -> str:
    """Describe an error that no module expects, with the package of a plug-in whose code raised it."""
    from cnpgen.schema.registry import package_in

    text = " ".join(f"{type(error).__name__}: {error}".split())
    if package := package_in(error):
        return f"error in the package {package!r}: {text}; --debug shows the traceback"
    return f"internal error: {text}; please report it (--debug shows the traceback, 'cnpgen doctor' the machine)"


def shell_spelling(options: Container[str]) -> Spelling:
    """Return a spelling for ``CnpgenError.text``: ``force=True`` becomes ``--force``, ``workers=2`` ``--workers 2``.

    Arguments that are no options of the command, as argparse names them, keep the
    Python spelling.
    """

    def spell(name: str, value: object) -> str:
        option = _OPTIONS.get(name, name)
        if option not in options:
            return python_spelling(name, value)
        text = f"--{option.replace('_', '-')}"
        return text if value is None or isinstance(value, bool) else f"{text} {value}"

    return spell


@contextmanager
def notices(level: str = "INFO") -> Iterator[None]:
    """Print the library's log messages of the block on stderr, from a level on, each one once."""
    import logging

    logger = logging.getLogger("cnpgen")
    handler = logging.StreamHandler(sys.stderr)
    seen = set[str]()
    # Time since the start [ms] and module only with --verbose.
    text = "%(relativeCreated)d ms, %(name)s: " if level == "DEBUG" else "cnpgen: "
    handler.setFormatter(logging.Formatter(f"{text}%(message)s"))

    def is_new(record: logging.LogRecord) -> bool:
        known = record.getMessage() in seen
        seen.add(record.getMessage())
        return not known

    handler.addFilter(is_new)
    before = logger.level
    logger.setLevel(level)
    logger.addHandler(handler)
    try:
        yield
    finally:
        logger.removeHandler(handler)
        logger.setLevel(before)


def _prepare_streams() -> None:
    """Replace closed streams, so that printing does not fail."""
    for name in ("stdout", "stderr"):
        if getattr(sys, name) is None:
            setattr(sys, name, Path(os.devnull).open("w", encoding="utf-8"))  # noqa: SIM115 - open until the end
    if isinstance(sys.stdout, io.TextIOWrapper):
        # A title must not stop a terminal that cannot show it.
        sys.stdout.reconfigure(errors="backslashreplace")


def _leave_pipe() -> int:
    """Redirect stdout to null, so that flushing at exit does not fail."""
    with suppress(OSError, ValueError):
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
    return BROKEN_PIPE


@contextmanager
def _warnings_on_one_line() -> Iterator[None]:
    def show(message: Warning | str, *_: Any, **__: Any) -> None:
        print(f"cnpgen: warning: {' '.join(str(message).split())}", file=sys.stderr)

    with warnings.catch_warnings():
        warnings.showwarning = show
        yield
