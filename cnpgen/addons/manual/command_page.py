"""The page of all commands with their arguments and options, from the parsers: ``cnpgen docs cli``."""

import argparse
import re
from collections.abc import Iterator

from cnpgen.addons.manual.reference_tables import escaped, reference_table
from cnpgen.cli.main import build_parser
from cnpgen.cli.parser import Commands

_INTRODUCTION = """\
# Command line

All commands with their arguments and options. `cnpgen --help` and `cnpgen COMMAND --help` print the same texts.

Every command writes data to stdout and everything else to stderr. `-q` or `--quiet` omits progress, notices and summaries.
`-v`, `--verbose` or `--debug` prints messages with their times, and the traceback of an error."""


def command_page() -> str:
    """Describe all commands in Markdown."""
    parser = build_parser()
    (commands,) = (item for item in parser._actions if isinstance(item, Commands))
    parts = [_INTRODUCTION]
    for name, command in commands.choices.items():
        parts += [
            f"## `cnpgen {name}`",
            _with_code(escaped(command.description)),
            *_tables(command),
        ]
        paragraphs = (command.epilog or "").split("\n\n")
        parts += [
            _with_code(escaped(" ".join(text.split()))) for text in paragraphs if text
        ]
    codes = str(parser.epilog).partition("Exit codes:\n")[2]
    rows = [
        " ".join(row.split()).partition(" ")
        for row in re.split(r"\n(?=  \d)", codes.strip("\n"))
    ]
    return "\n\n".join(
        [
            *parts,
            "## Exit codes",
            reference_table(
                ("code", "definition"), [(code, text) for code, _, text in rows]
            ),
        ]
    )


def _tables(command: argparse.ArgumentParser) -> Iterator[str]:
    """Yield the tables of the positional arguments and of the options."""
    shown = [
        action for action in command._actions if action.help is not argparse.SUPPRESS
    ]
    arguments = [action for action in shown if not action.option_strings]
    options = [
        action
        for action in shown
        if action.option_strings and action.dest not in {"help", "verbose", "quiet"}
    ]
    for head, actions in (("argument", arguments), ("option", options)):
        if actions:
            yield reference_table(
                (head, "description"),
                [
                    (f"`{_spelling(action)}`", _with_code(_help(action)))
                    for action in actions
                ],
            )


def _with_code(text: str) -> str:
    """Write the commands and options of a text as code."""
    names = r"'(?P<command>cnpgen [^']*)'|(?<![\w-])(?P<option>--[a-z][\w-]*)"
    return re.sub(names, lambda name: f"`{name['command'] or name['option']}`", text)


def _spelling(action: argparse.Action) -> str:
    """Return an argument as users write it: ``-o FILE, --out FILE``."""
    value = action.metavar or (
        "|".join(map(str, action.choices)) if action.choices else action.dest.upper()
    )
    value = " ".join(value) if isinstance(value, tuple) else value
    value = {"+": f"{value}...", "*": f"[{value}...]", "?": f"[{value}]"}.get(
        str(action.nargs), value
    )
    if not action.option_strings:
        return value
    return ", ".join(
        option if action.nargs == 0 else f"{option} {value}"
        for option in action.option_strings
    )


def _help(action: argparse.Action) -> str:
    """Return the help of an argument with its choices."""
    text = (action.help or "") % {**vars(action), "prog": "cnpgen"}
    hidden = action.choices if action.metavar else None
    return (
        text
        if hidden is None or all(str(choice) in text for choice in hidden)
        else f"{text} ({', '.join(hidden)})"
    )
