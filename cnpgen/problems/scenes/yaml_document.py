"""YAML files of scenes and trajectories, read as plain mappings, lists and texts in bounded memory and depth."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import suppress
from pathlib import Path
from typing import Any

from cnpgen.errors import requires_extra
from cnpgen.problems.scenes.scene_problem import SceneError
from cnpgen.store.files.atomic import read_file

MAX_YAML_BYTES = 1 << 25
MAX_YAML_DEPTH = 32  # nested mappings and lists


def read_yaml(path: Path, *, numbers: bool = False) -> list[Any]:
    """Read the documents of a YAML file; scalars stay texts, or with ``numbers`` become float, and plain nulls None.

    Anchors and aliases are refused, so the memory is proportional to the size of the
    file. Keys stay texts.
    """
    with requires_extra("ros", "PyYAML"):
        import yaml
    loader = getattr(yaml, "CSafeLoader", yaml.SafeLoader)
    try:
        events = yaml.parse(read_file(path, max_bytes=MAX_YAML_BYTES), Loader=loader)
        return list(_documents(path, yaml, events, numbers))
    except (yaml.YAMLError, UnicodeDecodeError, RecursionError, ValueError) as error:
        raise SceneError(
            f"{path} is not YAML: {' '.join(str(error).split()):.300}"
        ) from error


def _documents(path: Path, yaml: Any, events: Any, numbers: bool) -> Iterator[Any]:
    """Build documents from the events of a parser, without recursion."""
    # Open mappings and lists, and the keys that wait for their values, each in a tuple.
    stack: list[Any] = []
    for event in events:
        # Nested aliases expand exponentially.
        if getattr(event, "anchor", None) is not None:
            raise SceneError(
                f"{path} has the anchor {event.anchor!r:.60}, expected a file without anchors"
            )
        if isinstance(event, yaml.MappingStartEvent | yaml.SequenceStartEvent):
            stack.append({} if isinstance(event, yaml.MappingStartEvent) else [])
            if sum(isinstance(part, dict | list) for part in stack) > MAX_YAML_DEPTH:
                raise SceneError(
                    f"{path} is nested too deeply, expected at most {MAX_YAML_DEPTH} levels"
                )
            continue
        if isinstance(event, yaml.MappingEndEvent | yaml.SequenceEndEvent):
            value = stack.pop()
        elif isinstance(event, yaml.ScalarEvent):
            # In a mapping without a waiting key, the next scalar is a key.
            is_key = bool(stack) and isinstance(stack[-1], dict)
            value = _scalar(event, numbers and not is_key)
        else:
            continue
        yield from _put(stack, value)


def _scalar(event: Any, numbers: bool) -> str | float | None:
    """Return the value of a scalar; quoted ones are texts."""
    text: str = event.value
    # implicit[0] is true for plain scalars.
    if event.implicit[0]:
        if text in {"", "~", "null"}:
            return None
        if numbers:
            with suppress(ValueError):
                return float(text)
    return text


def _put(stack: list[Any], value: Any) -> Iterator[Any]:
    """Put a value into the innermost open collection; yield it if there is none."""
    if not stack:
        yield value
    elif isinstance(stack[-1], list):
        stack[-1].append(value)
    elif isinstance(stack[-1], dict):
        # The key waits for its value, on top of its mapping.
        stack.append((value if isinstance(value, str) else repr(value),))
    else:
        (key,) = stack.pop()
        if key in stack[-1]:
            raise ValueError(f"a mapping has the key {key!r:.60} twice")
        stack[-1][key] = value
