"""Write the pages of the reference that follow from the code, and the part of the first page that the README has, too.

    python docs/generate.py

``tests/docs/test_reference.py`` compares the pages with the code.
"""

import argparse
import ast
import importlib
import inspect
import re
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import cnpgen
import cnpgen.addons.frameworks
from cnpgen.cli.describe_keys import describe_keys, recipe_types
from cnpgen.cli.main import build_parser

FOLDER = Path(__file__).parent
MODULES = (
    "recipes",
    "losses",
    "results",
    "benchmark",
    "scenes",
    "trajectories",
    "plugins",
    "errors",
)
BRIDGES = (
    "torch",
    "jax",
)  # their modules are read without an import of the framework

COMMANDS_INTRODUCTION = """\
# Command line

All commands with their arguments and options. `python docs/generate.py` writes this page from the parsers.
`cnpgen --help` and `cnpgen COMMAND --help` print the same texts.

Every command writes data to stdout and everything else to stderr. `-q` or `--quiet` omits progress, notices and summaries.
`-v`, `--verbose` or `--debug` prints messages with their times, and the traceback of an error."""

NAMES_INTRODUCTION = """\
# Python interface

All public names with the first sentence of their documentation. `python docs/generate.py` writes this page.
The site has a page for each name, and `help(cnpgen.make_dataset)` prints the same text.
Names that are not listed here may change in every version ([releases](releases.md))."""


def public_objects() -> dict[str, Any]:
    """Return all public names with their objects; a name of the package is not repeated for its modules."""
    objects = {
        f"cnpgen.{name}": getattr(cnpgen, name)
        for name in sorted(dir(cnpgen))
        if name != "__version__"
    }
    for part in MODULES:
        module = importlib.import_module(f"cnpgen.{part}")
        names = getattr(
            module, "__all__", [name for name in vars(module) if name.endswith("Error")]
        )
        for name in sorted(names):
            if getattr(cnpgen, name, None) is not getattr(module, name):
                objects[f"cnpgen.{part}.{name}"] = getattr(module, name)
    return objects


def bridge_names() -> dict[str, tuple[str, str]]:
    """Return the public names of the bridges to frameworks: name -> (class or function, docstring)."""
    folder = Path(cnpgen.addons.frameworks.__path__[0])
    names = {}
    for framework in BRIDGES:
        single = folder / f"{framework}.py"
        for file in (
            [single] if single.is_file() else sorted((folder / framework).glob("*.py"))
        ):
            public = (
                _imported(folder / framework / "__init__.py")
                if file != single
                else None
            )
            for node in ast.parse(file.read_text("utf-8")).body:
                if not isinstance(
                    node, ast.ClassDef | ast.FunctionDef
                ) or node.name.startswith("_"):
                    continue
                if public is None or node.name in public:
                    kind = "class" if isinstance(node, ast.ClassDef) else "function"
                    names[f"cnpgen.interop.{framework}.{node.name}"] = (
                        kind,
                        ast.get_docstring(node) or "",
                    )
    return dict(sorted(names.items()))


def _imported(file: Path) -> set[str]:
    """Return the names that a module imports."""
    nodes = ast.walk(ast.parse(file.read_text("utf-8")))
    return {
        alias.name
        for node in nodes
        if isinstance(node, ast.ImportFrom)
        for alias in node.names
    }


def describe_commands() -> str:
    """Describe all commands in Markdown."""
    parser = build_parser()
    (commands,) = (
        action
        for action in parser._actions
        if isinstance(action, argparse._SubParsersAction)
    )
    parts = [COMMANDS_INTRODUCTION]
    for name, command in commands.choices.items():
        parts += [
            f"## `cnpgen {name}`",
            _escaped(command.description),
            *_tables(command),
        ]
        parts += [f"```\n{command.epilog.strip()}\n```"] if command.epilog else []
    codes = str(parser.epilog).partition("Exit codes:\n")[2]
    rows = [
        " ".join(row.split()).partition(" ")
        for row in re.split(r"\n(?=  \d)", codes.strip("\n"))
    ]
    return "\n\n".join(
        [
            *parts,
            "## Exit codes",
            _table(("code", "definition"), [(code, text) for code, _, text in rows]),
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
            yield _table(
                (head, "description"),
                [(f"`{_spelling(action)}`", _help(action)) for action in actions],
            )


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


def describe_names() -> str:
    """List all public names in Markdown."""
    groups: dict[str, list[tuple[str, str]]] = {}
    texts = {name: _documentation(value) for name, value in public_objects().items()}
    for name, text in (
        texts | {name: text for name, (_, text) in bridge_names().items()}
    ).items():
        summary = re.split(r"(?<=\.)\s", re.sub(r":\w+:`|``", "`", text))[0]
        module, _, short = name.rpartition(".")
        groups.setdefault(module, []).append((f"`{short}`", " ".join(summary.split())))
    parts = [NAMES_INTRODUCTION]
    for module, rows in groups.items():
        parts += [f"## `{module}`", _table(("name", "purpose"), rows)]
    return "\n\n".join(parts)


def _documentation(value: Any) -> str:
    return (
        inspect.getdoc(value) or ""
        if inspect.isclass(value) or inspect.isroutine(value)
        else "Constant."
    )


def describe_index() -> str:
    """Return the first page, with the section of the README on its two commands."""
    shared = (FOLDER.parent / "README.md").read_text(encoding="utf-8")
    shared = shared[
        shared.index("## Two commands") : shared.index("## Plan, optimize, check")
    ].replace("](docs/", "](")
    page = (FOLDER / "index.md").read_text(encoding="utf-8")
    return (
        page[: page.index("## Two commands")]
        + shared
        + page[page.index("## When to use it") :].rstrip("\n")
    )


def _table(head: tuple[str, str], rows: list[tuple[str, str]]) -> str:
    lines = [head, ("---", "---"), *((_cell(one), _cell(other)) for one, other in rows)]
    return "\n".join(f"| {one} | {other} |" for one, other in lines)


def _cell(text: str) -> str:
    return _escaped(" ".join(text.split()).replace("|", r"\|"))


def _escaped(text: str | None) -> str:
    """Return a text without accidental markup."""
    return re.sub(r"(?<!`)\*", r"\*", re.sub(r"<(?=\w)", r"\<", text or ""))


PAGES = {
    "reference/keys.md": lambda: describe_keys(tuple(recipe_types())),
    "reference/cli.md": describe_commands,
    "reference/api.md": describe_names,
    "index.md": describe_index,
}


def main() -> None:
    """Write the pages."""
    for name, describe in PAGES.items():
        (FOLDER / name).write_text(describe() + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()
