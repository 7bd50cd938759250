"""Type checks of the arguments of public functions and of the fields of options, by their annotations."""

import collections.abc
import dataclasses
import functools
import inspect
import math
import os
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path
from types import SimpleNamespace
from typing import (
    Any,
    Literal,
    ParamSpec,
    TypeVar,
    get_args,
    get_origin,
    get_type_hints,
)

import numpy as np
from numpy.typing import ArrayLike

from cnpgen.errors import CnpgenError, MachineError, either, nearest
from cnpgen.schema.arguments import (
    UnexpectedValueError,
    flag,
    integer,
    number,
    reject_masked,
)
from cnpgen.schema.keys import alternatives

P = ParamSpec("P")
R = TypeVar("R")
Check = Callable[[str, Any], Any]
"""Returns a checked argument, by its name and value; raises UsageError."""

# Class name -> description for messages; arguments of these classes are checked before
# the call.
NOUNS = {
    "Plans": "Plans, as load_plans and make_plans return them",
    "Boundary": "a Boundary, such as plans.boundary",
    "Planner": "a Planner",
    "Tasks": "Tasks, as BoundaryLayer.tasks returns them",
    "Benchmark": "a Benchmark, as run_benchmark returns it",
}
_ARRAYS = set(get_args(ArrayLike))


def checked_arguments(function: Callable[P, R]) -> Callable[P, R]:
    """Check the types of the arguments of every call by the annotations.

    Flags, texts, functions, masked arrays and the classes of ``NOUNS`` are checked
    first. The function itself checks ranges and shapes. If it raises another error than
    a ``CnpgenError``, the types of all arguments are compared with the annotations, and
    the first wrong one becomes a UsageError.
    """
    prepared = functools.cache(functools.partial(_checks_of, function))

    @functools.wraps(function)
    def call(*args: P.args, **keywords: P.kwargs) -> R:
        names, first, late = prepared()
        # Only types that the function would accept and misuse are checked before the
        # call, all others after an error.
        _run(first, names, args, keywords)
        try:
            return function(*args, **keywords)
        # The function has reported the error itself.
        except CnpgenError:
            raise
        except MemoryError as error:
            raise MachineError(
                f"out of memory in {function.__name__}: {error or 'pass fewer or smaller arrays'}"
            ) from error
        # An exception of Python may come from a wrong type: then the argument is named,
        # otherwise it is raised again.
        except Exception:
            _run(late, names, args, keywords)
            raise

    return call


def _checks_of(
    function: Callable[..., Any],
) -> tuple[tuple[str, ...], dict[str, Check], dict[str, Check]]:
    """Return the positional parameters, their checks before the call, and those after an error."""
    parameters = inspect.signature(function).parameters.values()
    # Positional arguments are matched with their names, keywords have theirs.
    names = tuple(
        p.name
        for p in parameters
        if p.kind in {p.POSITIONAL_ONLY, p.POSITIONAL_OR_KEYWORD}
    )
    annotations = {
        p.name: p.annotation
        for p in parameters
        if p.kind != p.VAR_KEYWORD and p.annotation != p.empty
    }
    hints = {name: _evaluated(function, hint) for name, hint in annotations.items()}
    found = {name: _check_of(hint) for name, hint in hints.items()}
    late = {name: check for name, check in found.items() if check is not None}
    first = {name: check for name, check in late.items() if _is_first(hints[name])}
    return names, first, late


def _run(
    checks: dict[str, Check],
    names: tuple[str, ...],
    args: tuple[Any, ...],
    keywords: dict[str, Any],
) -> None:
    """Raise a UsageError for the first invalid argument."""
    for name, value in (*zip(names, args, strict=False), *keywords.items()):
        if name in checks:
            checks[name](name, value)


def _is_first(hint: Any) -> bool:
    """Return whether a wrong type must be found before the call."""
    present = alternatives(hint)
    if len(present) != 1:
        # Masked arrays behave like arrays and would be used without their masks.
        return set(present) >= _ARRAYS
    (kind,) = present
    kind = get_origin(kind) or kind
    return (
        kind in {bool, str, collections.abc.Callable, np.ndarray}
        or getattr(kind, "__name__", kind) in NOUNS
    )


def _evaluated(function: Callable[..., Any], annotation: Any) -> Any:
    """Evaluate a postponed annotation.

    Return its text if a name in it is imported for type checkers only.
    """
    if not isinstance(annotation, str):
        return annotation
    names = vars(collections.abc) | inspect.unwrap(function).__globals__
    holder = SimpleNamespace(__annotations__={"value": annotation})
    with suppress(NameError):
        return get_type_hints(holder, names)["value"]
    return annotation


def check_fields(options: Any) -> None:
    """Check the fields of a frozen dataclass by their annotations.

    Convert NumPy's scalars.
    """
    for name, check in _field_checks(type(options)):  # type: ignore[arg-type]
        object.__setattr__(options, name, check(name, getattr(options, name)))


@functools.cache
def _field_checks(cls: type) -> tuple[tuple[str, Check], ...]:
    hints = get_type_hints(cls)
    found = (
        (entry.name, _check_of(hints[entry.name], strict=True))
        for entry in dataclasses.fields(cls)
    )
    return tuple((name, check) for name, check in found if check is not None)


def _check_of(hint: Any, *, strict: bool = False) -> Check | None:
    """Return the check of an annotation, None if every value is accepted.

    Fields are ``strict``.
    """
    options = alternatives(hint)
    arrays = set(options) >= _ARRAYS
    present = [option for option in options if not (arrays and option in _ARRAYS)]
    checks: list[Check] = [reject_masked] if arrays else []
    if set(present) >= {str, Path}:
        checks.append(_path)
        present = [option for option in present if option not in {str, Path}]
    for option in present:
        check = _check_of_type(option, strict=strict)
        if check is None:
            return None
        checks.append(check)
    optional = hint != options[0] and type(None) in get_args(hint)

    def check_options(name: str, value: Any) -> Any:
        if (optional and value is None) or (arrays and type(value) is np.ndarray):
            # The usual case.
            return value
        errors = []
        for check in checks:
            try:
                return check(name, value)
            except UnexpectedValueError as error:
                errors.append(error)
        # One alternative: its own message is more exact than a list of one.
        if len(errors) == 1:
            raise errors[0]
        expected = either([error.expected for error in errors])
        raise UnexpectedValueError(expected, errors[0].got, argument=name)

    return check_options if checks else None


def _check_of_type(hint: Any, *, strict: bool) -> Check | None:
    """Return the check of one alternative.

    If ``strict`` only NumPy's arrays, and numbers may be infinite.
    """
    if isinstance(hint, str):
        return functools.partial(_named, hint) if hint.isidentifier() else None
    kind = get_origin(hint) or hint
    if kind is Literal:
        return functools.partial(_choice, get_args(hint))
    known: dict[Any, Check] = {
        int: integer,
        bool: flag,
        float: _real if strict else number,
    }
    known |= {
        str: functools.partial(
            _accepted, lambda value: isinstance(value, str), "a text"
        ),
        collections.abc.Callable: functools.partial(_accepted, callable, "a function"),
        np.ndarray: _array if strict else reject_masked,
    }
    if kind in known:
        return known[kind]
    if (
        not inspect.isclass(kind)
        or kind is object
        or getattr(kind, "_is_protocol", False)
    ):
        return None
    if kind in {collections.abc.Iterable, collections.abc.Sequence}:
        return functools.partial(
            _accepted,
            lambda value: (
                isinstance(value, kind) and not isinstance(value, str | bytes)
            ),
            "a list",
        )
    return functools.partial(_instance, kind)


def _array(name: str, value: Any) -> Any:
    reject_masked(name, value)
    if not isinstance(value, np.ndarray):
        got = type(value).__name__
        raise UnexpectedValueError("an array of NumPy", got, argument=name)
    return value


def _real(name: str, value: Any) -> float:
    """Return a number; accept infinity."""
    return (
        value if isinstance(value, float) and math.isinf(value) else number(name, value)
    )


def _accepted(accepts: Callable[[Any], bool], noun: str, name: str, value: Any) -> Any:
    if not accepts(value):
        raise UnexpectedValueError(noun, f"{value!r:.100}", argument=name)
    return value


def _path(name: str, value: Any) -> str | Path:
    """Return a name or a path.

    Reject empty ones, and null characters, which no operating system accepts.
    """
    if (
        not isinstance(value, str | os.PathLike)
        or not os.fspath(value)
        or "\0" in str(value)
    ):
        raise UnexpectedValueError("a name or a path", f"{value!r:.100}", argument=name)
    return value if isinstance(value, str) else Path(value)


def _choice(choices: tuple[Any, ...], name: str, value: Any) -> Any:
    if not isinstance(value, str) or value not in choices:
        hint = nearest(value, choices) if isinstance(value, str) else ""
        expected = f"one of {', '.join(map(str, choices))}"
        raise UnexpectedValueError(expected, f"{value!r:.100}{hint}", argument=name)
    return value


def _instance(kind: type, name: str, value: Any) -> Any:
    return value if isinstance(value, kind) else _named(kind.__name__, name, value)


def _named(kind: str, name: str, value: Any) -> Any:
    if kind not in {base.__name__ for base in type(value).__mro__}:
        expected = NOUNS.get(kind, f"of type {kind}")
        raise UnexpectedValueError(expected, type(value).__name__, argument=name)
    return value
