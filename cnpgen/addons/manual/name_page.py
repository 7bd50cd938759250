"""The page of all public names with the first sentence of their documentation: ``cnpgen docs api``."""

import ast
import importlib
import inspect
import re
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import cnpgen
from cnpgen.addons.manual.tables import reference_table
from cnpgen.errors import MissingAddonError

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
# Their modules are read without an import of the framework.
BRIDGES = ("torch", "jax", "lerobot")

_INTRODUCTION = """\
# Python interface

All public names with the first sentence of their documentation. `help(cnpgen.make_dataset)` prints the whole text of one,
and the site has a page for each name.
Names that are not listed here may change in every version ([releases](releases.md))."""


def name_page() -> str:
    """List all public names in Markdown."""
    texts = {name: _documentation(value) for name, value in public_objects().items()}
    texts |= {name: text for name, (_, text) in bridge_names().items()}
    groups: dict[str, list[tuple[str, str]]] = {}
    for name, text in texts.items():
        summary = re.split(r"(?<=\.)\s", re.sub(r":\w+:`|``", "`", text))[0]
        module, _, short = name.rpartition(".")
        groups.setdefault(module, []).append((f"`{short}`", " ".join(summary.split())))
    parts = [_INTRODUCTION]
    for module, rows in groups.items():
        parts += [f"## `{module}`", reference_table(("name", "purpose"), rows)]
    return "\n\n".join(parts)


def public_objects() -> dict[str, Any]:
    """Return all public names with their objects, without those of add-ons that are not installed.

    A name of the package is not repeated for its modules.
    """
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
            try:
                value = getattr(module, name)
            except MissingAddonError:
                continue
            if getattr(cnpgen, name, None) is not value:
                objects[f"cnpgen.{part}.{name}"] = value
    return objects


def bridge_names() -> dict[str, tuple[str, str]]:
    """Return the public names of the bridges to frameworks: name -> (class or function, docstring)."""
    bridges = find_spec("cnpgen.addons.frameworks")
    if bridges is None or bridges.origin is None:
        return {}
    folder = Path(bridges.origin).parent
    names = {}
    for framework in BRIDGES:
        single = folder / f"{framework}.py"
        package = folder / framework
        files = [single] if single.is_file() else sorted(package.glob("*.py"))
        public = None if single.is_file() else _imported(package / "__init__.py")
        for node in (
            node
            for file in files
            for node in ast.parse(file.read_text("utf-8")).body
            if isinstance(node, ast.ClassDef | ast.FunctionDef)
            and not node.name.startswith("_")
        ):
            if public is None or node.name in public:
                kind = "class" if isinstance(node, ast.ClassDef) else "function"
                text = ast.get_docstring(node) or ""
                names[f"cnpgen.interop.{framework}.{node.name}"] = (kind, text)
    return dict(sorted(names.items()))


def _imported(file: Path) -> set[str]:
    """Return the names that a module imports."""
    return {
        alias.name
        for node in ast.walk(ast.parse(file.read_text("utf-8")))
        if isinstance(node, ast.ImportFrom)
        for alias in node.names
    }


def _documentation(value: Any) -> str:
    if inspect.isclass(value) or inspect.isroutine(value):
        return inspect.getdoc(value) or ""
    return "Constant."
