"""Fuzzing of calls: wrong types and values for public functions; the outcome must be a result or a ``CnpgenError``.

A ``UsageError`` must carry the name of an argument of the call.
"""

import faulthandler
import os
import signal
import sys
import tempfile
import traceback
import warnings
from collections import Counter
from collections.abc import Iterator
from contextlib import chdir, redirect_stdout
from dataclasses import dataclass, field
from io import StringIO
from pathlib import Path
from random import Random
from typing import Any

import numpy as np

from cnpgen.errors import CnpgenError, UsageError
from tests.faults.fuzz import MAX_HANG_S, MAX_READ_TIME_S, limited_resources
from tests.faults.valid_calls import ValidCall, valid_calls

HUGE = 10**15  # rows, samples or seconds: more than the memory of any machine
MAX_MESSAGE_LENGTH = 2000


@dataclass
class CallOutcome:
    """Outcomes of all calls.

    Attributes:
        returned: Number of calls that returned a result.
        refused: Number of calls that raised a ``CnpgenError``.
        findings: Other outcomes, one line each.
        functions: Number of calls of each public callable.
    """

    returned: int = 0
    refused: int = 0
    findings: list[str] = field(default_factory=list)
    functions: Counter[str] = field(default_factory=Counter)


@dataclass(frozen=True)
class WrongCall:
    """A valid call with one or two arguments replaced."""

    call: ValidCall
    changes: dict[str, tuple[str, Any]]

    def __str__(self) -> str:
        return f"{self.call.name}({', '.join(f'{name}={label}' for name, (label, _) in self.changes.items())})"


def fuzz_calls(
    calls: int,
    *,
    seed: int = 0,
    first: int = 0,
) -> CallOutcome:
    """Call public functions with invalid arguments: every argument in turn, then two at once.

    Args:
        calls: Number of calls.
        seed: Seed of the order and of the pairs.
        first: Index of the first call.
    """
    outcome = CallOutcome()
    with (
        tempfile.TemporaryDirectory(prefix="cnpgen-calls-") as temporary,
        warnings.catch_warnings(),
    ):
        warnings.simplefilter("ignore")
        folder = Path(temporary)
        (folder / "here").mkdir()
        valid = valid_calls(folder)
        with chdir(folder / "here"), limited_resources(), np.errstate(all="ignore"):
            for wrong in _chosen(valid, calls, seed, first):
                _try_call(wrong, outcome)
    return outcome


def _chosen(
    valid: list[ValidCall], calls: int, seed: int, first: int
) -> Iterator[WrongCall]:
    """Yield calls with one wrong argument in a random order, then calls with two."""
    single = [
        WrongCall(call, {name: value})
        for call in valid
        for name in call.names
        if name not in call.unchanged
        for value in wrong_values(call.arguments.get(name))
    ]
    Random(seed).shuffle(single)
    for number in range(first, first + calls):
        if number < len(single):
            yield single[number]
        else:
            draw = Random(f"{seed} {number}")
            one = draw.choice(single)
            other = draw.choice([wrong for wrong in single if wrong.call is one.call])
            yield WrongCall(one.call, {**one.changes, **other.changes})


def wrong_values(valid: Any) -> list[tuple[str, Any]]:
    """Return wrong types and values for an argument, with names: general ones, and changes of the valid value."""
    values: list[Any] = [
        None,
        "x",
        "",
        "a\0b",
        b"x",
        True,
        0,
        1,
        -1,
        2**70,
        1.5,
        -1.5,
        1e300,
        1j,
    ]
    values += [
        float("nan"),
        float("inf"),
        [],
        [[]],
        {},
        (),
        ["x"],
        [None],
        {"x": 1},
        (1, 2),
        [0.1, 0.2, 0.3],
    ]
    named = [(repr(value), value) for value in values]
    named += [
        ("10**15", HUGE),
        ("np.int64(2)", np.int64(2)),
        ("np.bool_(True)", np.bool_(True)),
    ]
    named += [
        ("np.float32(0.5)", np.float32(0.5)),
        ("object()", object()),
        ("a path", Path("missing")),
    ]
    named += [
        (f"zeros{shape}", np.zeros(shape))
        for shape in ((), (0,), (1,), (0, 6), (2, 6), (2, 3, 4))
    ]
    named += [
        ("masked", np.ma.masked_invalid([0.1, np.nan])),
        ("datetime", np.array(["2026-01-01"], "M8[D]")),
    ]
    named += [
        ("objects", np.array([object(), None])),
        ("texts", np.array(["a", "b"])),
        ("lambda", lambda *_: None),
    ]
    if (
        isinstance(valid, list | tuple)
        and valid
        and all(isinstance(part, np.ndarray) for part in valid)
    ):
        named += [
            (f"its {name}", (value, *valid[1:]))
            for name, value in _wrong_arrays(valid[0])
        ]
        named += [("it, reversed", valid[::-1]), ("a part of it", valid[:-1])]
    if isinstance(valid, np.ndarray):
        named += [(f"it, {name}", value) for name, value in _wrong_arrays(valid)]
    return named


def _wrong_arrays(valid: np.ndarray) -> list[tuple[str, Any]]:
    array = valid.astype(float)
    changed = {
        "masked": np.ma.masked_greater(array, -np.inf),
        "as objects": array.astype(object),
        "as texts": array.astype(str),
        "complex": array + 1j,
        "in degrees": np.rad2deg(array),
        "nan": np.full_like(array, np.nan),
        "infinite": np.full_like(array, np.inf),
        "huge": array + 1e300,
        "negative": -np.abs(array) - 1,
        "as a list": array.tolist(),
        "repeated": np.concatenate([array, array]) if array.ndim else array,
        "empty": array[:0] if array.ndim else array,
        "one more axis": array[None],
        "narrower": array[..., :-1] if array.ndim else array,
        "transposed": array.T,
        "as float16": array.astype("f2"),
    }
    return list(changed.items())


def _try_call(wrong: WrongCall, outcome: CallOutcome) -> None:
    """Make one call; a finding is printed at once."""
    outcome.functions[wrong.call.name] += 1
    try:
        _limited_call(wrong)
        outcome.returned += 1
    except CnpgenError as error:
        outcome.refused += 1
        problem = _message_problem(error, wrong)
        if problem:
            _add(outcome, f"{wrong}: {problem}")
    except BaseException as error:
        if isinstance(error, KeyboardInterrupt):
            raise
        _add(
            outcome,
            f"{wrong}: {type(error).__name__} {str(error)[:120]!r} in {_place(error)}",
        )


def _message_problem(error: CnpgenError, wrong: WrongCall) -> str:
    """Return what a message lacks, or an empty string."""
    text = str(error)
    if not text.strip() or len(text) > MAX_MESSAGE_LENGTH:
        return f"a message of {len(text)} characters"
    if isinstance(error, UsageError) and error.argument not in wrong.call.names:
        return f"UsageError with argument {error.argument!r}: {text[:160]!r} in {_place(error)}"
    return ""


def _place(error: BaseException) -> str:
    """Return file and line of the innermost frame of cnpgen."""
    frames = [
        frame
        for frame in traceback.extract_tb(error.__traceback__)
        if "/cnpgen/" in frame.filename
    ]
    return (
        f"{frames[-1].filename.rpartition('/cnpgen/')[2]}:{frames[-1].lineno}"
        if frames
        else "no frame"
    )


def _limited_call(wrong: WrongCall) -> None:
    faulthandler.dump_traceback_later(MAX_HANG_S, exit=True)
    signal.setitimer(signal.ITIMER_PROF, MAX_READ_TIME_S)
    before = Path.cwd()
    try:
        with redirect_stdout(StringIO()):
            result = wrong.call(
                **{name: value for name, (_, value) in wrong.changes.items()}
            )
            if hasattr(result, "__next__"):
                for _ in zip(result, range(10), strict=False):
                    pass
        del result
    finally:
        signal.setitimer(signal.ITIMER_PROF, 0)
        faulthandler.cancel_dump_traceback_later()
        os.chdir(before)


def _add(outcome: CallOutcome, finding: str) -> None:
    print(finding, file=sys.stderr, flush=True)
    outcome.findings.append(finding)
