"""Processes that are killed at random moments, and started again: what comes of it is what an uncut run gives.

Everything follows from a seed and the number of the kill, but for the moment: a machine that is busy is elsewhere by
then. A finding names both.
"""

import os
import random
import shutil
import signal
import subprocess
import sys
import tempfile
import time
from collections import Counter
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass, field
from pathlib import Path

from cnpgen.validate.dataset import validate_dataset
from tests.cli.test_interruption import descendants
from tests.examples.tiny_datasets import digests

HANGS = 300.0  # [s] without an end: then a process waits for something that will not come
ROUNDS = 3  # times that a run is killed at most, before it may end
SETTINGS = ("--shard-size", "50", "--quiet")
SIGNALS = (signal.SIGKILL, signal.SIGKILL, signal.SIGTERM, signal.SIGINT)
WHO = ("all", "parent", "worker")


@dataclass
class Kills:
    """What came of many kills.

    Attributes:
        struck: How many processes were sent a signal.
        runs: How many runs were killed, by kind and by how the last killed process ended.
        findings: What was not as it must be, a line each.
    """

    struck: int = 0
    runs: Counter[str] = field(default_factory=Counter)
    findings: list[str] = field(default_factory=list)


@dataclass(frozen=True)
class Kind:
    """A command that is killed.

    Attributes:
        prepare: Puts what the command works on into a folder.
        words: The command for a folder and a number of workers.
        product: Bytes or digests of what it makes there.
        codes: Exit codes of an uncut run.
    """

    prepare: Callable[[Path, Path], None]
    words: Callable[[Path, int], list[str]]
    product: Callable[[Path], object]
    codes: tuple[int, ...] = (0,)


def _nothing(_shared: Path, _folder: Path) -> None:
    """Prepare nothing."""


def _small(shared: Path, folder: Path) -> None:
    shutil.copytree(shared / "small", folder / "out")


def _make(folder: Path, workers: int) -> list[str]:
    out = ["--workers", str(workers), "--out", str(folder / "out")]
    return ["make-dataset", "airhockey-hit", "--n", "660", *SETTINGS, *out]


def _extend(folder: Path, workers: int) -> list[str]:
    return ["extend", str(folder / "out"), "--n", "660", "--workers", str(workers), "--quiet"]


def _merge(folder: Path, _workers: int) -> list[str]:
    parts = [str(folder.parent / "shared" / f"part{k}") for k in range(2)]
    return ["merge", *parts, "-o", str(folder / "out"), "--quiet"]


def _solve(folder: Path, workers: int) -> list[str]:
    options = ["--n", "12", "--seed", "5", "--workers", str(workers), "--quiet"]
    return ["solve", "airhockey-hit", *options, "-o", str(folder / "plans.h5")]


def _dataset(folder: Path) -> object:
    """Return the digests of a dataset's shards; the dataset must be sound, and nothing left over."""
    assert validate_dataset(folder / "out").ok
    assert not (folder / "out" / "_work").exists()
    return digests(folder / "out")


def _plans(folder: Path) -> object:
    assert [path.name for path in folder.iterdir()] == ["plans.h5"]
    return (folder / "plans.h5").read_bytes()


KINDS = {
    "make": Kind(_nothing, _make, _dataset),
    "extend": Kind(_small, _extend, _dataset),
    "merge": Kind(_nothing, _merge, _dataset),
    "solve": Kind(_nothing, _solve, _plans, (0, 1)),
}


def kill(count: int, *, seed: int = 0, first: int = 0, kinds: tuple[str, ...] = tuple(KINDS)) -> Kills:
    """Kill runs of commands at random moments, let them go on, and compare what they make with that of an uncut run.

    Args:
        count: How many processes are struck; the last run may be struck more often.
        seed: Seed of all choices.
        first: Number of the first run.
        kinds: Commands that are run.
    """
    outcome = Kills()
    with tempfile.TemporaryDirectory(prefix="cnpgen-kills-") as place:
        _share(Path(place) / "shared")
        uncut = {name: _uncut(KINDS[name], Path(place), name) for name in kinds}
        number = first
        while outcome.struck < count:
            chosen = random.Random(f"{seed} {number}")
            name = chosen.choice(kinds)
            folder = Path(place) / f"run{number}"
            folder.mkdir()
            try:
                struck, how = _killed(KINDS[name], folder, chosen, uncut[name])
                outcome.runs[f"{name}, {how}"] += 1
                outcome.struck += struck
            except (AssertionError, subprocess.TimeoutExpired) as error:
                outcome.findings.append(f"seed {seed}, run {number}, {name}: {type(error).__name__} {error}")
                outcome.struck += 1
            shutil.rmtree(folder)
            number += 1
    return outcome


def _share(shared: Path) -> None:
    """Make what several commands work on: a small dataset, and parts of a larger one."""
    shared.mkdir()
    make = ["make-dataset", "airhockey-hit", *SETTINGS, "--workers", "1"]
    _finish([*make, "--n", "330", "--out", str(shared / "small")], (0,))
    for k in range(2):
        _finish([*make, "--n", "660", "--part", f"{k}/2", "--out", str(shared / f"part{k}")], (0,))


def _uncut(kind: Kind, place: Path, name: str) -> tuple[object, float]:
    """Return what a command makes that is not killed, and how long it takes [s]."""
    (folder := place / f"uncut-{name}").mkdir()
    kind.prepare(place / "shared", folder)
    begun = time.monotonic()
    _finish(kind.words(folder, 2), kind.codes)
    return kind.product(folder), time.monotonic() - begun


def _killed(kind: Kind, folder: Path, chosen: random.Random, uncut: tuple[object, float]) -> tuple[int, str]:
    """Kill a run, perhaps several times, and let it end; say how often, and how the last killed process ended."""
    kind.prepare(folder.parent / "shared", folder)
    expected, seconds = uncut
    struck = 0
    for _ in range(chosen.randint(1, ROUNDS)):
        words = kind.words(folder, chosen.choice((1, 2)))
        with subprocess.Popen(_command(words), start_new_session=True, stderr=subprocess.DEVNULL, stdout=-3) as process:
            with suppress(subprocess.TimeoutExpired):
                process.wait(chosen.uniform(0.2, seconds))
            if process.poll() is None:
                _strike(process, chosen)
                struck += 1
            code = process.wait(HANGS)
        assert code in {0, 1, 3, 130, 143, -signal.SIGKILL, -signal.SIGTERM, -signal.SIGINT}, f"it ended with {code}"
        if (folder / "plans.h5").exists():  # it was faster, and would now refuse to replace them
            break
    else:
        _finish(kind.words(folder, 2), kind.codes)
    assert kind.product(folder) == expected, "another result"
    return struck, f"ended with {code}"


def _strike(process: subprocess.Popen[bytes], chosen: random.Random) -> None:
    """Send a signal to a process, to one of its workers, or to all of them."""
    number, who = chosen.choice(SIGNALS), chosen.choice(WHO)
    workers = [pid for pid in descendants(process.pid) if "popen_loky" in _name(pid)]
    try:
        if who == "worker" and workers:
            os.kill(chosen.choice(workers), signal.SIGKILL)
        elif who == "all":
            os.killpg(process.pid, number)
        else:
            process.send_signal(number)
    except ProcessLookupError:  # it was faster
        pass


def _name(pid: int) -> str:
    try:
        return Path(f"/proc/{pid}/cmdline").read_text()
    except OSError:
        return ""


def _command(words: list[str]) -> list[str]:
    return [sys.executable, "-m", "cnpgen", *words]


def _finish(words: list[str], codes: tuple[int, ...]) -> None:
    """Run a command to its end, or count it as hanging."""
    done = subprocess.run(_command(words), capture_output=True, text=True, check=False, timeout=HANGS)
    assert done.returncode in codes, f"{words[0]} ended with {done.returncode}: {done.stderr[-300:]}"
