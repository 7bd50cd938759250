"""Entry points of the installed packages for the groups of cnpgen.

``importlib.metadata`` finds them, too, but importing it takes 20 ms, a fifth of ``cnpgen --help``. A test compares both.
"""

import functools
import pkgutil
import re
import sys
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

PREFIX = "cnpgen."  # of all groups
_METADATA = ("*.dist-info/entry_points.txt", "*.egg-info/entry_points.txt")
_NAME = re.compile(r"^Name: *(\S+)", re.MULTILINE)
_GROUP = re.compile(r"\[(.+)\]")
_ENTRY = re.compile(r"([^=]+?)\s*=\s*([\w.:]+)")  # name = module:object [extra]


@dataclass(frozen=True)
class EntryPoint:
    """An object that an installed package registers under a name.

    Attributes:
        group: Group of the entry point, such as "cnpgen.planners".
        name: Its name in the group.
        value: ``module:object``, or a module.
        distribution: Name of the package in the index; empty if unknown.
    """

    group: str
    name: str
    value: str
    distribution: str = ""

    @property
    def module(self) -> str:
        """Name of the module that has the object."""
        return self.value.partition(":")[0]

    def load(self) -> Any:
        """Import the object; its module may raise any exception."""
        return pkgutil.resolve_name(self.value)


@functools.cache
def entry_points() -> Mapping[str, tuple[EntryPoint, ...]]:
    """Return the entry points of all groups of cnpgen: group -> entries."""
    groups: dict[str, list[EntryPoint]] = {}
    known: set[str] = set()
    for file in _metadata_files():
        # The name of a distribution ends at the first hyphen: NAME-VERSION.dist-info.
        key = file.parent.name.partition("-")[0].lower()
        if key in known:
            # The first one on the path hides the others.
            continue
        known.add(key)
        text = file.read_text(encoding="utf-8")
        # Most packages have no entry points of cnpgen.
        if f"[{PREFIX}" in text:
            for entry in _read(text, _distribution(file.parent)):
                groups.setdefault(entry.group, []).append(entry)
    return {group: tuple(entries) for group, entries in groups.items()}


def _metadata_files() -> Iterator[Path]:
    for folder in map(Path, sys.path):
        for pattern in _METADATA:
            yield from folder.glob(pattern)


def _distribution(folder: Path) -> str:
    """Return the name of a package as its metadata spell it; empty if they are not there."""
    for file in (folder / "METADATA", folder / "PKG-INFO"):
        if file.is_file():
            found = _NAME.search(file.read_text(encoding="utf-8"))
            return found[1] if found else ""
    return ""


def _read(text: str, distribution: str) -> Iterator[EntryPoint]:
    """Yield the entries of cnpgen's groups in a file of the format of INI files."""
    group = ""
    for line in map(str.strip, text.splitlines()):
        if section := _GROUP.fullmatch(line):
            group = section[1]
        elif group.startswith(PREFIX) and (entry := _ENTRY.match(line)):
            yield EntryPoint(group, entry[1], entry[2], distribution)
