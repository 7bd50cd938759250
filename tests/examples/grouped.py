"""Calls with keywords of one dictionary, of which some are fields of the function's options."""

from collections.abc import Callable
from dataclasses import fields
from typing import Any


def grouped(
    function: Callable[..., Any], options: type, *arguments: Any, **keywords: Any
) -> Any:
    """Call a function; keywords that are fields of its options become ``options``."""
    names = {entry.name for entry in fields(options)} & keywords.keys()
    chosen = options(**{name: keywords.pop(name) for name in names})
    return function(*arguments, **keywords, options=chosen)
