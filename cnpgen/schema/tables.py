"""Types of tables: JSON objects, and errors by names."""

from collections.abc import Iterator
from typing import Any

JsonObject = dict[str, Any]
"""A table of a JSON or TOML document: name -> text, number, bool, None, list or table."""

NamedErrors = Iterator[tuple[str, str]]
"""(name, error) pairs of the keys of a table, or of the arguments of a call."""
