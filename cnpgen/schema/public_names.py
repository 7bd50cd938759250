"""Public names that load on use: those of a stub in the core, and those that add-ons register.

A module of public names has a stub, ``results.pyi`` beside ``results.py``, that lists
its names of the core with their modules. Add-ons register further ones in the group
``cnpgen.names``, such as ``cnpgen.results.PlanRuntime``.
"""

import ast
import sys
from collections.abc import Callable
from importlib import import_module
from pathlib import Path
from typing import Any

NAMES = "cnpgen.names"


def lazy_exports(
    package: str, file: str
) -> tuple[Callable[[str], Any], Callable[[], list[str]]]:
    """Return ``__getattr__`` and ``__dir__`` of a module of public names.

    ``__all__`` is one of its attributes.
    """
    stub = Path(file).with_suffix(".pyi")
    modules = _modules_of(stub) if stub.is_file() else {}

    def load(name: str) -> Any:
        if name == "__all__":
            return names()
        if name in modules:
            from cnpgen.schema.foreign_paths import import_errors_with_hint

            with import_errors_with_hint():
                value = getattr(import_module(modules[name]), name)
        elif name.startswith("_"):
            # Tools look up special names, for which the metadata need not be read.
            raise AttributeError(f"module {package!r} has no attribute {name!r}")
        else:
            value = _load_of_addon(package, name)
        # The next access finds the name in the module.
        setattr(sys.modules[package], name, value)
        return value

    def names() -> list[str]:
        return sorted({*modules, *_names_of_addons(package)})

    return load, names


def _modules_of(stub: Path) -> dict[str, str]:
    """Read a stub: name -> module."""
    imports = [
        node
        for node in ast.parse(stub.read_text(encoding="utf-8")).body
        if isinstance(node, ast.ImportFrom)
    ]
    own = [node for node in imports if str(node.module).startswith("cnpgen.")]
    return {alias.name: str(node.module) for node in own for alias in node.names}


def _names_of_addons(package: str) -> list[str]:
    """List the names that installed add-ons define in a module."""
    from cnpgen.schema import addons

    parts = (entry.name.rpartition(".") for entry in addons.installed(NAMES))
    return [name for module, _, name in parts if module == package]


def _load_of_addon(package: str, name: str) -> Any:
    """Import a name that an add-on defines.

    A name that none defines raises AttributeError.
    """
    from cnpgen.schema import addons

    entry = addons.find(NAMES, f"{package}.{name}")
    if entry is None:
        raise AttributeError(f"module {package!r} has no attribute {name!r}")
    return addons.load_entry(entry, f"{package}.{name}")
