"""Write the page of the reference that lists the public names, and the part of the first page that the README has, too.

    python docs/generate.py

``tests/docs/test_reference.py`` compares the pages with the code.
"""

import ast
import importlib
import inspect
import re
from pathlib import Path
from typing import Any

import cnpgen
import cnpgen.addons.frameworks
from cnpgen.addons.manual.tables import reference_table

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
    "lerobot",
)  # their modules are read without an import of the framework

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
        parts += [f"## `{module}`", reference_table(("name", "purpose"), rows)]
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


PAGES = {
    "reference/api.md": describe_names,
    "index.md": describe_index,
}


def main() -> None:
    """Write the pages."""
    for name, describe in PAGES.items():
        (FOLDER / name).write_text(describe() + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()
