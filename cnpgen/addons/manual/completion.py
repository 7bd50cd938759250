"""Completion of words in the shell: argcomplete runs the program with the line in the environment and reads words.

eval "$(register-python-argcomplete cnpgen)"
"""

import argparse
import re
from collections.abc import Iterator
from functools import partial

from cnpgen.addons.manual.list_command import names
from cnpgen.cli.parser import Commands, Parser
from cnpgen.errors import requires_extra

_PROBLEMS = ("datasets", "pipelines", "problems")
_NAMED_BY = {  # argument -> what it names
    "recipe": _PROBLEMS,
    "problems": _PROBLEMS,
    "what": _PROBLEMS,
    "pipeline": _PROBLEMS,
    "problem": _PROBLEMS,
    "robot": ("problems",),
    "suite": ("suites", "datasets", "pipelines"),
    "model": ("models",),
    "planners": ("planners",),
    "reference": ("planners",),
    "family": ("families",),
    "stage": ("stages",),
    "constraint": ("constraints",),
}


def complete_words(parser: Parser) -> None:
    """Print the completions of the line in the environment, and end the process.

    Raises:
        MissingExtraError: argcomplete is not installed.
    """
    with requires_extra("completion", "argcomplete"):
        import argcomplete
        from argcomplete.completers import FilesCompleter

    def words(prefix: str, action: argparse.Action, **_: object) -> list[str]:
        known = [name for what in _NAMED_BY[action.dest] for name in names(what)]
        takes_files = re.search("FILE|SUITE", str(action.metavar))
        return [*known, *(FilesCompleter()(prefix) if takes_files else ())]

    for action in _arguments(parser):
        if action.dest in _NAMED_BY and action.choices is None:
            action.completer = partial(words, action=action)  # type: ignore[attr-defined]
        elif action.dest == "page":
            action.completer = _pages  # type: ignore[attr-defined]
    argcomplete.autocomplete(parser)


def _pages(**_: object) -> list[str]:
    from cnpgen.cli.docs_command import list_pages

    return list(list_pages())


def _arguments(parser: Parser) -> Iterator[argparse.Action]:
    """Yield the arguments of all commands."""
    for action in parser._actions:
        if isinstance(action, Commands):
            for command in action.choices.values():
                yield from command._actions
