"""Fuzzing: changed files are read under limits; the outcome must be a result or a ``CnpgenError``."""

import faulthandler
import resource
import shutil
import signal
import sys
import tempfile
import traceback
from collections import Counter
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from random import Random
from types import FrameType

from cnpgen.errors import CnpgenError
from tests.faults.good_files import make_good_files
from tests.faults.subjects import SUBJECTS, Subject, read_quietly

MAX_READ_TIME_S, MAX_EXTRA_BYTES = (
    10,
    2 << 30,
)  # CPU time and memory for reading one file
MAX_HANG_S = 300  # after it, the process is ended: a library hangs and ignores signals


class TooSlowError(Exception):
    """Reading took more CPU time than ``MAX_READ_TIME_S``."""


@dataclass
class Outcome:
    """Outcomes of all inputs.

    Attributes:
        read: Kind -> number of inputs that were read.
        refused: Kind -> number of inputs that raised a ``CnpgenError``.
        findings: Other outcomes, one line each.
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
) -> Outcome:
    """Read changed files of all kinds in turn.

    Args:
        inputs: Number of inputs.
        seed: Seed; every input is a function of seed, index and kind.
        first: Index of the first input.
        kinds: Kinds of files.
    """
    outcome = Outcome()
    with tempfile.TemporaryDirectory(prefix="cnpgen-faults-") as temporary:
        good = Path(temporary) / "good"
        good.mkdir()
        make_good_files(good)
        with limited_resources():
            for number in range(first, first + inputs):
                _try(
                    number,
                    seed,
                    kinds[number % len(kinds)],
                    good,
                    Path(temporary) / "given",
                    outcome,
                )
    return outcome


def _try(
    number: int, seed: int, kind: str, good: Path, folder: Path, outcome: Outcome
) -> None:
    """Make one input and read it; a finding is printed at once."""
    draw, subject = Random(f"{seed} {number} {kind}"), SUBJECTS[kind]
    shutil.rmtree(folder, ignore_errors=True)
    folder.mkdir()
    subject.change(good, folder, draw)
    try:
        _read(subject, folder, draw)
        outcome.read[kind] += 1
    except CnpgenError as error:
        if not str(error).strip() or len(str(error)) > 20_000:
            outcome.findings.append(
                f"{kind} {number}: a message of {len(str(error))} characters"
            )
        outcome.refused[kind] += 1
    except BaseException as error:
        if isinstance(error, KeyboardInterrupt):
            raise
        frames = traceback.extract_tb(error.__traceback__)
        own_frames = [frame for frame in frames if "/cnpgen/" in frame.filename]
        place = frames[-1].filename
        if own_frames:
            place = f"{own_frames[-1].filename.rpartition('/cnpgen/')[2]}:{own_frames[-1].lineno}"
        finding = (
            f"{kind} {number}: {type(error).__name__} {str(error)[:120]!r} in {place}"
        )
        print(finding, file=sys.stderr, flush=True)
        outcome.findings.append(finding)


def _read(subject: Subject, folder: Path, draw: Random) -> None:
    faulthandler.dump_traceback_later(MAX_HANG_S, exit=True)
    signal.setitimer(signal.ITIMER_PROF, MAX_READ_TIME_S)
    try:
        read_quietly(subject, folder, draw)
    finally:
        signal.setitimer(signal.ITIMER_PROF, 0)
        faulthandler.cancel_dump_traceback_later()


@contextmanager
def limited_resources() -> Iterator[None]:
    """Limit memory to the present use and ``MAX_EXTRA_BYTES`` more, and time by a signal."""

    def too_slow(_number: int, _frame: FrameType | None) -> None:
        raise TooSlowError(f"{MAX_READ_TIME_S} s")

    pages = int(Path("/proc/self/statm").read_text(encoding="ascii").split()[0])
    before, handler = (
        resource.getrlimit(resource.RLIMIT_AS),
        signal.signal(signal.SIGPROF, too_slow),
    )
    resource.setrlimit(
        resource.RLIMIT_AS,
        (pages * resource.getpagesize() + MAX_EXTRA_BYTES, before[1]),
    )
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_AS, before)
        signal.signal(signal.SIGPROF, handler)
