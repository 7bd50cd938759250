"""Values of documents of scenes: entries of mappings, vectors and numbers, each with its place in errors."""

from __future__ import annotations

from typing import Any

import numpy as np

from cnpgen.arrays import Array
from cnpgen.problems.scenes.scene_problem import SceneError


def part(document: Any, key: str, kind: type, where: str) -> Any:
    """Return an entry of a mapping, or an empty mapping, list or text if it is missing; ``where`` is for messages."""
    if not isinstance(document, dict):
        raise SceneError(f"{where} must be a mapping, got {document!r:.60}")
    value = document.get(key)
    if value is None:
        return kind()
    if not isinstance(value, kind):
        name = "a mapping" if kind is dict else "a list" if kind is list else "a text"
        raise SceneError(f"{where}: {key} must be {name}, got {value!r:.60}")
    return value


def vector(value: Any, keys: str, where: str) -> Array:
    """Return the numbers of a list, or of a mapping by its keys in order, such as "xyz"; without keys, of any list."""
    entries = (
        [value.get(key) for key in keys] if isinstance(value, dict) and keys else value
    )
    if not isinstance(entries, list) or (keys and len(entries) != len(keys)):
        expected = f"{len(keys)} numbers" if keys else "a list of numbers"
        raise SceneError(f"{where} must be {expected}, got {value!r:.60}")
    return np.array([scalar(entry, where) for entry in entries])


def scalar(value: Any, where: str) -> float:
    """Return a number; ``where`` is for messages."""
    try:
        return float(value)
    except (TypeError, ValueError) as error:
        raise SceneError(f"{where} must be a number, got {value!r:.60}") from error
