"""The entry of the command line: parse, run one command, turn what goes wrong into a line and an exit code."""

import argparse
import io
import os
import sys
import traceback
import warnings
from collections.abc import Container, Iterator, Sequence
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any, NoReturn

from cnpgen.cli import (
    benchmark_command,
    complete_command,
    doctor_command,
    evaluate_command,
    export_command,
    extend_command,
    init_command,
    inspect_command,
    list_command,
    make_command,
    merge_command,
    plan_command,
    refine_command,
    show_command,
    simulate_command,
    solve_command,
    train_command,
    validate_command,
    view_command,
)
from cnpgen.cli.interruption import Terminated, exit_code, interruptible
from cnpgen.cli.parser import Parser, add_debug
from cnpgen.cli.shell import in_shell
from cnpgen.cli.terminal import printing_safely
from cnpgen.errors import CnpgenError, MachineError, RecipeError
from cnpgen.machine.threads import prefer_one_thread

_COMMANDS = (
    make_command,
    merge_command,
    extend_command,
    init_command,
    list_command,
    show_command,
    inspect_command,
    validate_command,
    train_command,
    plan_command,
    complete_command,
    solve_command,
    refine_command,
    evaluate_command,
    view_command,
    simulate_command,
    benchmark_command,
    export_command,
    doctor_command,
)

_DESCRIPTION = "Make, inspect and prove datasets of boundary problems for kinodynamic motion planning."

_EPILOG = """\
examples:
  cnpgen list                                        what there is
  cnpgen init my-arm --urdf arm.urdf                 recipes for an arm of your own
  cnpgen make-dataset airhockey-hit --n 1000         make 1000 rows; run it again to go on after an interruption
  cnpgen inspect airhockey-hit-v1 --plot hits.png    look at them
  cnpgen validate airhockey-hit-v1 --deep            prove that they are right
  cnpgen train airhockey-hit-v1 -o hits.h5           train a planner: two minutes
  cnpgen plan airhockey-hit-v1 --model hits.h5 -o plans.h5; a shipped one: --model airhockey-hit
  cnpgen solve airhockey-hit --n 100 -o plans.h5     plan 100 fresh problems from nothing
  cnpgen complete airhockey-replan pucks.csv -o problems.h5; what is solved, refined or planned for
  cnpgen refine plans.h5 -o better.h5                polish anyone's plans
  cnpgen evaluate plans.h5 --plot plan.png           judge them with Pinocchio and Coal
  cnpgen view plans.h5 --row 3 -o plan.html          look at one in a browser
  cnpgen simulate plans.h5 --video plan.mp4          execute them in MuJoCo
  cnpgen benchmark hits-81 --simulate                compare planners
  cnpgen export plans.h5 --to joint-trajectory       hand plans to robots and simulators

stdout is data, stderr everything else. Exit codes:
  0    done
  1    the answer is no: a dataset or a file is damaged, unfinished, of another kind or of another problem than what
       it is used for; rows or plans are not valid
  2    a wrong argument, such as a path that is not there, or a mistake in a recipe
  3    the machine: no compiler, a full disk, a broken library; also an internal error of cnpgen
  130  interrupted (Ctrl-C); finished shards and plans are kept, the same command goes on
  141  whoever read stdout went away
  143  terminated (SIGTERM, as SLURM and Docker send it); likewise resumable
"""

NOBODY_READS = 141  # 128 + SIGPIPE, as shells have it


class _Version(argparse.Action):
    """Print the version; looking it up takes milliseconds, so it is done on demand."""

    def __call__(self, parser: argparse.ArgumentParser, *_: Any) -> NoReturn:
        from importlib.metadata import PackageNotFoundError, version

        found = "(not installed)"
        with suppress(PackageNotFoundError):
            found = version("cnpgen")
        print(f"cnpgen {found}")
        parser.exit()


def main(argv: Sequence[str] | None = None) -> int:
    """Run the command line.

    Args:
        argv: The arguments; those of the process by default.

    Returns:
        The exit code, as ``cnpgen --help`` lists them.
    """
    words, given = list(sys.argv[1:] if argv is None else argv), argparse.Namespace()
    prefer_one_thread()
    _prepare_streams()
    with printing_safely(), _warnings_on_one_line():
        try:
            with interruptible():
                code = _run(words, given)
            sys.stdout.flush()
        except BrokenPipeError:
            return _leave_pipe()
        except (Exception, KeyboardInterrupt) as error:  # noqa: BLE001 - the boundary of the process
            if "--debug" in words:
                traceback.print_exc()
            return _report(error, vars(given), words)
    return code


def _run(words: list[str], given: argparse.Namespace) -> int:
    """Run what the words ask for, and leave in ``given`` what they give."""
    parser = build_parser()
    try:
        arguments, extras = parser.parse_known_args(words, given)
    except SystemExit:  # --help and --version have printed what they have to say
        return 0
    chosen: Parser = getattr(arguments, "parser", parser)
    if extras:
        chosen.refuse(extras)
    if chosen is parser:
        parser.print_help(sys.stderr)
        return 2
    from cnpgen.cli.notices import notices

    with notices(quiet=getattr(arguments, "quiet", False)):
        code: int = arguments.run(arguments)
    return code


def build_parser() -> Parser:
    """Build the parser of all commands."""
    parser = Parser(prog="cnpgen", description=_DESCRIPTION, epilog=_EPILOG)
    parser.add_argument("--version", action=_Version, nargs=0, help="show the version")
    add_debug(parser)
    commands = parser.add_subparsers(title="commands", metavar="COMMAND", parser_class=Parser)
    for command in _COMMANDS:
        command.add(commands)
    return parser


def _report(error: BaseException, options: Container[str], words: Sequence[str]) -> int:
    """Print an error as one line per mistake, in the words of the command's options; return its exit code."""
    if isinstance(error, KeyboardInterrupt):
        what = "terminated" if isinstance(error, Terminated) else "interrupted"
        print(f"cnpgen: {what}: {error}" if str(error) else f"cnpgen: {what}", file=sys.stderr)
        return exit_code(error)
    lines, code = _explain(error)
    for line in lines:
        print(f"cnpgen: error: {in_shell(line, options, words)}", file=sys.stderr)
    return code


def _explain(error: BaseException) -> tuple[Sequence[str], int]:
    """Return the lines that tell an error to a user, and the exit code."""
    if isinstance(error, RecipeError):
        return error.mistakes, error.exit_code
    if isinstance(error, CnpgenError):
        return [" ".join(str(error).split())], error.exit_code
    code = MachineError.exit_code
    if isinstance(error, ImportError):
        return [f"{error}; 'cnpgen doctor' says what is wrong with this installation"], code
    if isinstance(error, MemoryError):
        return ["out of memory; fewer --workers need less"], code
    if isinstance(error, OSError) and error.strerror:
        return [f"{error.filename}: {error.strerror}" if error.filename else error.strerror], code
    text = " ".join(f"{type(error).__name__}: {error}".split())
    return [
        f"internal error: {text}; please report it (--debug shows the traceback, 'cnpgen doctor' the machine)"
    ], code


def _prepare_streams() -> None:
    """Make sure that printing does not fail: Python has no stdout or stderr where the shell has closed them."""
    for name in ("stdout", "stderr"):
        if getattr(sys, name) is None:
            setattr(sys, name, Path(os.devnull).open("w", encoding="utf-8"))  # noqa: SIM115 - open until the end
    if isinstance(sys.stdout, io.TextIOWrapper):
        sys.stdout.reconfigure(errors="backslashreplace")  # a title must not stop a terminal that cannot show it


def _leave_pipe() -> int:
    """Give stdout somewhere to go, so that Python does not complain when it flushes it at exit."""
    with suppress(OSError, ValueError):
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
    return NOBODY_READS


@contextmanager
def _warnings_on_one_line() -> Iterator[None]:
    def show(message: Warning | str, *_: Any, **__: Any) -> None:
        print(f"cnpgen: warning: {' '.join(str(message).split())}", file=sys.stderr)

    with warnings.catch_warnings():
        warnings.showwarning = show
        yield
