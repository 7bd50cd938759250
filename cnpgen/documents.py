"""Types of documents, tables of text, names and paths. Those of arrays are in ``arrays``, which loads NumPy."""

from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

JsonObject = dict[str, Any]
"""A table of a JSON or TOML document: name -> text, number, bool, None, list or table."""

JsonMapping = Mapping[str, Any]
"""A table of a JSON or TOML document that is only read."""

TextRows = list[tuple[str, ...]]
"""The cells of the rows of a printed table."""

NamedErrors = Iterator[tuple[str, str]]
"""(name, error) pairs of the keys of a table, or of the arguments of a call."""

Names = tuple[str, ...]
"""Names of joints, columns, links or keys, in their order."""

AnyPath = str | Path
"""A path of a file or folder, as a caller may pass it."""

NamedNumbers = Mapping[str, float]
"""Numbers by the names of joints, links or parameters."""
