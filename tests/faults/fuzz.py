"""Files of strangers by the thousand, read in this process under limits: a result or a ``CnpgenError``, no more."""

import faulthandler
import resource
import shutil
import signal
import sys
import tempfile
import traceback
from collections import Counter
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from random import Random
from types import FrameType

from cnpgen.errors import CnpgenError
from tests.faults.good_files import make_good_files
from tests.faults.subjects import SUBJECTS, Subject, read_quietly

SECONDS, BYTES = 10, 2 << 30  # what reading one file may take
STUCK = 60  # [s] after which the process itself is ended: something hangs that no signal interrupts


class TooSlowError(Exception):
    """Reading took longer than ``SECONDS``."""


@dataclass
class Outcome:
    """What came of the inputs.

    Attributes:
        read: Kind -> how many were read.
        refused: Kind -> how many were refused by a ``CnpgenError``.
        findings: What was neither: one line each.
    """

    read: Counter[str] = field(default_factory=Counter)
    refused: Counter[str] = field(default_factory=Counter)
    findings: list[str] = field(default_factory=list)


def fuzz(
    inputs: int,
    *,
    seed: int = 0,
    first: int = 0,
    kinds: tuple[str, ...] = tuple(SUBJECTS),
    progress: Callable[[int], None] | None = None,
) -> Outcome:
    """Make changed files of all kinds in turn and read them.

    Args:
        inputs: How many.
        seed: Seed; every input is a function of it, its number and its kind.
        first: Number of the first input.
        kinds: Which kinds.
        progress: Called after every input with their number so far.
    """
    outcome = Outcome()
    with tempfile.TemporaryDirectory(prefix="cnpgen-faults-") as temporary:
        good = Path(temporary) / "good"
        good.mkdir()
        make_good_files(good)
        with _limited():
            for number in range(first, first + inputs):
                _try(number, seed, kinds[number % len(kinds)], good, Path(temporary) / "given", outcome)
                if progress is not None:
                    progress(number + 1 - first)
    return outcome


def _try(number: int, seed: int, kind: str, good: Path, folder: Path, outcome: Outcome) -> None:
    """Make one input and read it; what is found is told at once."""
    draw, subject = Random(f"{seed} {number} {kind}"), SUBJECTS[kind]
    shutil.rmtree(folder, ignore_errors=True)
    folder.mkdir()
    subject.change(good, folder, draw)
    try:
        _read(subject, folder, draw)
        outcome.read[kind] += 1
    except CnpgenError as error:
        if not str(error).strip() or len(str(error)) > 20_000:
            outcome.findings.append(f"{kind} {number}: a message of {len(str(error))} characters")
        outcome.refused[kind] += 1
    except BaseException as error:
        if isinstance(error, KeyboardInterrupt):
            raise
        where = traceback.extract_tb(error.__traceback__)[-1]
        ours = [each for each in traceback.extract_tb(error.__traceback__) if "/cnpgen/" in each.filename]
        place = f"{ours[-1].filename.rpartition('/cnpgen/')[2]}:{ours[-1].lineno}" if ours else where.filename
        finding = f"{kind} {number}: {type(error).__name__} {str(error)[:120]!r} in {place}"
        print(finding, file=sys.stderr, flush=True)
        outcome.findings.append(finding)


def _read(subject: Subject, folder: Path, draw: Random) -> None:
    faulthandler.dump_traceback_later(STUCK, exit=True)
    signal.alarm(SECONDS)
    try:
        read_quietly(subject, folder, draw)
    finally:
        signal.alarm(0)
        faulthandler.cancel_dump_traceback_later()


@contextmanager
def _limited() -> Iterator[None]:
    """Limit memory to what there is now and ``BYTES`` more, and time by a signal."""

    def too_slow(_number: int, _frame: FrameType | None) -> None:
        raise TooSlowError(f"{SECONDS} s")

    pages = int(Path("/proc/self/statm").read_text(encoding="ascii").split()[0])
    before, handler = resource.getrlimit(resource.RLIMIT_AS), signal.signal(signal.SIGALRM, too_slow)
    resource.setrlimit(resource.RLIMIT_AS, (pages * resource.getpagesize() + BYTES, before[1]))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_AS, before)
        signal.signal(signal.SIGALRM, handler)
