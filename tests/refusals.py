"""Errors that tests expect: the test states the class and the argument, a snapshot file the wording.

After a change of wording ``pytest --snapshot-update PATH`` writes the files of a path
again (syrupy); the reviewer reads their difference.
"""

import re
from collections.abc import Iterator
from contextlib import contextmanager
from math import isclose
from pathlib import Path
from typing import Any

import pytest
from syrupy.assertion import SnapshotAssertion
from syrupy.extensions.amber import AmberSnapshotExtension

ROOT = str(Path(__file__).parents[1])
# Of files and data that tests compute, whole or shortened.
DIGEST = re.compile(r"\b[0-9a-f]{12}(?:[0-9a-f]{52}\b|(?=\.\.\.))")
# Fractions, whose last digits depend on the processor.
FRACTION = re.compile(r"(?<![\w.])-?\d+\.\d+(?:e[+-]?\d+)?(?![\w.])")
RELATIVE_ERROR = 1e-2  # texts show three or four digits


class RunningTest:
    """The running test.

    Attributes:
        texts: Its stored texts, set by tests/conftest.py, as the next one.
        base: Folder for the folders of tests, which pytest chose; workers of it have
            folders of their own there.
    """

    texts: SnapshotAssertion
    base: Path


class Wording(AmberSnapshotExtension):
    """Texts that are equal but for the last digits of fractions."""

    def matches(self, *, serialized_data: Any, snapshot_data: Any) -> bool:
        """Compare the text of this run with the stored one."""
        ours, theirs = str(serialized_data), str(snapshot_data)
        pairs = zip(FRACTION.findall(ours), FRACTION.findall(theirs), strict=False)
        return FRACTION.sub("#", ours) == FRACTION.sub("#", theirs) and all(
            isclose(float(a), float(b), rel_tol=RELATIVE_ERROR) for a, b in pairs
        )


def portable(text: str) -> str:
    """Replace the folders of a machine, and digests, in a text."""
    base = re.escape(str(RunningTest.base))
    text = re.sub(rf"{base}(/popen-gw\d+)?/[^/\s'\",:)]+", "TEST", text)
    return DIGEST.sub("DIGEST", text.replace(ROOT, "ROOT"))


@contextmanager
def is_refused(
    kind: type[BaseException], *, argument: str | None = None
) -> Iterator[pytest.ExceptionInfo[Any]]:
    """Expect an error of a class about an argument, with the stored wording."""
    with pytest.raises(kind) as caught:
        yield caught
    assert getattr(caught.value, "argument", None) == argument
    assert portable(str(caught.value)) == RunningTest.texts


def assert_said(text: str) -> None:
    """Compare what a command printed with the stored wording."""
    assert portable(text) == RunningTest.texts
