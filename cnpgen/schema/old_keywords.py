"""Keywords and names of an earlier version: for one version they are accepted, with a warning."""

import dataclasses
import warnings
from collections.abc import Mapping
from typing import Any, TypeVar

from cnpgen.documents import NamedErrors

Options = TypeVar("Options")

CALLER = 4  # frames from the warning to the caller of a function with checked arguments


def with_old_keywords(
    function: str,
    options: Options | None,
    default: Options,
    old: Mapping[str, Any],
    *,
    keyword: str = "options",
    caller: int = CALLER,
) -> Options:
    """Return the options of a call, with the values of old keywords.

    Args:
        function: Name of the called function.
        options: Its options, or None for the default.
        default: Default options.
        old: Keywords that the function had before it had options, and their values.
        keyword: Keyword of the options.
        caller: Frames from the warning to the caller, more with further decorators.

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
        f"{function}({given}): write {keyword}={type(chosen).__name__}({given});"
        " the next version does not accept these keywords",
        DeprecationWarning,
        stacklevel=caller,
    )
    changed: Options = dataclasses.replace(chosen, **old)
    return changed


def old_attribute(old: str, new: str) -> Any:
    """Return a property with the former name of an attribute, which warns that it has a new one."""

    def read(owner: Any) -> Any:
        warnings.warn(
            f"{type(owner).__name__}.{old} is {new}; the next version has no {old}",
            DeprecationWarning,
            stacklevel=2,
        )
        return getattr(owner, new)

    return property(read, doc=f"The former name of ``{new}``.")


def errors_of(made: Any) -> NamedErrors:
    """Yield the (key, error) pairs of a table's own check, also of a plug-in with the former name of the method.

    The pairs come one by one: a check that fails at a value of a wrong type has reported the errors before it.
    """
    if hasattr(made, "validate"):
        yield from made.validate()
    elif hasattr(made, "find_mistakes"):
        name = type(made).__name__
        warnings.warn(
            f"{name}.find_mistakes: name the method validate; the next version does not call find_mistakes",
            DeprecationWarning,
            stacklevel=2,
        )
        yield from made.find_mistakes()
