"""Keywords of an earlier version: for one version a function accepts them, with a warning."""

import dataclasses
import warnings
from collections.abc import Mapping
from typing import Any, TypeVar

Options = TypeVar("Options")

CALLER = 4  # frames from the warning to the caller of a function with checked arguments


def with_old_keywords(
    function: str, options: Options | None, default: Options, old: Mapping[str, Any]
) -> Options:
    """Return the options of a call, with the values of old keywords.

    Args:
        function: Name of the called function.
        options: Its options, or None for the default.
        default: Default options.
        old: Keywords that the function had before it had options, and their values.

    Raises:
        TypeError: There is no such keyword, as Python reports it.
    """
    chosen: Any = default if options is None else options
    if not old:
        return chosen  # type: ignore[no-any-return]
    names = [entry.name for entry in dataclasses.fields(chosen)]
    for name in old:
        if name not in names:
            raise TypeError(f"{function}() got an unexpected keyword argument {name!r}")
    given = ", ".join(f"{name}=..." for name in old)
    warnings.warn(
        f"{function}({given}): write options={type(chosen).__name__}({given});"
        " the next version does not accept these keywords",
        DeprecationWarning,
        stacklevel=CALLER,
    )
    changed: Options = dataclasses.replace(chosen, **old)
    return changed
