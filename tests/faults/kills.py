"""Runs that are killed at random times and resumed: the result must equal that of an uninterrupted run.

All choices follow from the seed and the index of the run, which a finding names. The state of the run at the time of
the signal also depends on the load of the machine.
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

from cnpgen.planner.model_file import load_model
from cnpgen.store.files.atomic import file_sha256
from cnpgen.validate.validate_dataset import validate_dataset
from tests.cli.test_interruption import descendants
from tests.examples.tiny_datasets import digests

MAX_RUN_TIME_S = 300.0  # longer runs count as hanging
MAX_KILLS_PER_RUN = 3
MIN_WAIT_S, MAX_WAIT_SHARE = (
    0.2,
    0.95,
)  # of the shortest duration seen: a busy machine is slower
SETTINGS = ("--shard-size", "50", "--quiet")
SIGNALS = (signal.SIGKILL, signal.SIGKILL, signal.SIGTERM, signal.SIGINT)
MAX_FINDINGS = 20  # then a run ends
TARGETS = ("all", "parent", "worker")


@dataclass
class Kills:
    """Outcomes of killed runs.

    Attributes:
        n_signals: Number of signals to a running process; one that had ended counts as none.
        n_runs: Number of runs.
        runs: Number of runs by kind and by exit code of the last killed process.
        findings: Failures, one line each.
    """

    n_signals: int = 0
    n_runs: int = 0
    runs: Counter[str] = field(default_factory=Counter)
    findings: list[str] = field(default_factory=list)


@dataclass(frozen=True)
class Kind:
    """A command that is killed.

    Attributes:
        prepare: Copies the input of the command into a folder.
        words: Returns the command for a folder and a number of workers.
        product: Returns bytes or digests of the result in a folder.
        codes: Exit codes of an uninterrupted run.
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
    return [
        "extend",
        str(folder / "out"),
        "--n",
        "660",
        "--workers",
        str(workers),
        "--quiet",
    ]


def _merge(folder: Path, _workers: int) -> list[str]:
    parts = [str(folder.parent / "shared" / f"part{k}") for k in range(2)]
    return ["merge", *parts, "-o", str(folder / "out"), "--quiet"]


def _solve(folder: Path, workers: int) -> list[str]:
    options = ["--n", "12", "--seed", "5", "--workers", str(workers), "--quiet"]
    return ["solve", "airhockey-hit", *options, "-o", str(folder / "plans.h5")]


def _unrefined(shared: Path, folder: Path) -> None:
    shutil.copy(shared / "unrefined.h5", folder / "unrefined.h5")


def _refine(folder: Path, workers: int) -> list[str]:
    options = ["--workers", str(workers), "--quiet"]
    return [
        "refine",
        str(folder / "unrefined.h5"),
        *options,
        "-o",
        str(folder / "plans.h5"),
    ]


def _train(folder: Path, _workers: int) -> list[str]:
    options = [
        "--steps",
        "60",
        "--hidden",
        "16",
        "--layers",
        "2",
        "--batch-size",
        "32",
        "--check",
        "2",
        "--quiet",
    ]
    return [
        "train",
        str(folder.parent / "shared" / "small"),
        *options,
        "-o",
        str(folder / "model.h5"),
    ]


def _publish(folder: Path, _workers: int) -> list[str]:
    dataset, out = folder.parent / "shared" / "small", folder / "hub"
    return ["publish", str(dataset), "--to", "lab/hits", "--dry-run", "-o", str(out)]


def _repository(folder: Path) -> object:
    """Return the digests of all files of a repository, without temporary ones."""
    files = sorted(path for path in (folder / "hub").rglob("*") if path.is_file())
    names = [path.relative_to(folder).as_posix() for path in files]
    assert not any(name.endswith((".tmp", ".part")) for name in names), names
    return {name: file_sha256(path) for name, path in zip(names, files, strict=True)}


def _dataset(folder: Path) -> object:
    """Return the digests of the shards of a dataset, which must be valid and without temporary files."""
    assert validate_dataset(folder / "out").ok
    assert not (folder / "out" / "_work").exists()
    return digests(folder / "out")


def _plans(folder: Path) -> object:
    assert _visible(folder) == ["plans.h5"]
    return (folder / "plans.h5").read_bytes()


def _refined(folder: Path) -> object:
    assert _visible(folder) == ["plans.h5", "unrefined.h5"]
    return (folder / "plans.h5").read_bytes()


def _visible(folder: Path) -> list[str]:
    """Return the names of files, in order, without the request of a result."""
    return sorted(path.name for path in folder.iterdir() if path.name[0] != ".")


def _model(folder: Path) -> object:
    """Return the parameters of a model; its file also has the times of the run.

    A run that is killed after its last step may leave the lock file, which then locks nothing.
    """
    assert not {".checkpoint", ".tmp"} & {path.suffix for path in folder.iterdir()}
    return load_model(folder / "model.h5").parameters.tobytes()


KINDS = {
    "make": Kind(_nothing, _make, _dataset),
    "extend": Kind(_small, _extend, _dataset),
    "merge": Kind(_nothing, _merge, _dataset),
    "solve": Kind(_nothing, _solve, _plans, (0, 1)),
    "refine": Kind(_unrefined, _refine, _refined, (0, 1)),
    "train": Kind(_nothing, _train, _model),
    "publish": Kind(_nothing, _publish, _repository),
}


def kill(
    count: int, *, seed: int = 0, first: int = 0, kinds: tuple[str, ...] = tuple(KINDS)
) -> Kills:
    """Kill runs of commands at random times, resume them, and compare the results with uninterrupted runs.

    Args:
        count: Minimum number of signals that hit a running process.
        seed: Seed of all choices.
        first: Index of the first run.
        kinds: Commands to run.
    """
    outcome = Kills()
    with tempfile.TemporaryDirectory(prefix="cnpgen-kills-") as place:
        _share(Path(place) / "shared")
        uninterrupted = {
            name: _uninterrupted(KINDS[name], Path(place), name) for name in kinds
        }
        shortest = {name: seconds for name, (_, seconds) in uninterrupted.items()}
        number = first
        while outcome.n_signals < count and len(outcome.findings) < MAX_FINDINGS:
            chosen = random.Random(f"{seed} {number}")
            name = chosen.choice(kinds)
            folder = Path(place) / f"run{number}"
            folder.mkdir()
            try:
                n_signals, ending, shortest[name] = _killed(
                    KINDS[name], folder, chosen, uninterrupted[name][0], shortest[name]
                )
                outcome.runs[f"{name}, {ending}"] += 1
                outcome.runs[f"{name}, signals"] += n_signals
                outcome.n_signals += n_signals
            except (AssertionError, subprocess.TimeoutExpired) as error:
                outcome.findings.append(
                    f"seed {seed}, run {number}, {name}: {type(error).__name__} {error}"
                )
            shutil.rmtree(folder)
            number += 1
            outcome.n_runs += 1
    return outcome


def _share(shared: Path) -> None:
    """Make the inputs of several commands: a small dataset, and parts of a larger one."""
    shared.mkdir()
    make = ["make-dataset", "airhockey-hit", *SETTINGS, "--workers", "1"]
    _finish([*make, "--n", "330", "--out", str(shared / "small")], (0,))
    plan = [
        "plan",
        str(shared / "small"),
        "--model",
        "airhockey-hit",
        "--n",
        "12",
        "-o",
        str(shared / "unrefined.h5"),
    ]
    _finish(plan, (0, 1))
    for k in range(2):
        _finish(
            [
                *make,
                "--n",
                "660",
                "--part",
                f"{k}/2",
                "--out",
                str(shared / f"part{k}"),
            ],
            (0,),
        )


def _uninterrupted(kind: Kind, place: Path, name: str) -> tuple[object, float]:
    """Return the result and the duration [s] of an uninterrupted run."""
    (folder := place / f"uninterrupted-{name}").mkdir()
    kind.prepare(place / "shared", folder)
    begun = time.monotonic()
    _finish(kind.words(folder, 2), kind.codes)
    return kind.product(folder), time.monotonic() - begun


def _killed(
    kind: Kind, folder: Path, chosen: random.Random, expected: object, shortest: float
) -> tuple[int, str, float]:
    """Kill a run and resume it; return the number of signals, the last exit code and the shortest duration [s]."""
    kind.prepare(folder.parent / "shared", folder)
    n_signals = 0
    for _ in range(chosen.randint(1, MAX_KILLS_PER_RUN)):
        words = kind.words(folder, chosen.choice((1, 2)))
        begun = time.monotonic()
        with subprocess.Popen(
            _command(words),
            start_new_session=True,
            stderr=subprocess.DEVNULL,
            stdout=-3,
        ) as process:
            with suppress(subprocess.TimeoutExpired):
                process.wait(chosen.uniform(MIN_WAIT_S, MAX_WAIT_SHARE * shortest))
            if process.poll() is None:
                n_signals += _hit(process, chosen)
            else:
                shortest = min(shortest, max(time.monotonic() - begun, 2 * MIN_WAIT_S))
            code = process.wait(MAX_RUN_TIME_S)
        assert code in {
            0,
            1,
            3,
            130,
            143,
            -signal.SIGKILL,
            -signal.SIGTERM,
            -signal.SIGINT,
        }, f"it ended with {code}"
        if (folder / "plans.h5").exists():  # complete, but perhaps not its request
            break
    else:
        _finish(kind.words(folder, 2), kind.codes)
    assert kind.product(folder) == expected, "another result"
    return n_signals, f"ended with {code}", shortest


def _hit(process: subprocess.Popen[bytes], chosen: random.Random) -> bool:
    """Send a signal to a process, to one of its workers, or to all of them; return whether it arrived."""
    number, target = chosen.choice(SIGNALS), chosen.choice(TARGETS)
    workers = [pid for pid in descendants(process.pid) if "popen_loky" in _name(pid)]
    try:
        if target == "worker" and workers:
            os.kill(chosen.choice(workers), signal.SIGKILL)
        elif target == "all":
            os.killpg(process.pid, number)
        else:
            process.send_signal(number)
    except ProcessLookupError:  # the process has ended before
        return False
    return True


def _name(pid: int) -> str:
    try:
        return Path(f"/proc/{pid}/cmdline").read_text()
    except OSError:
        return ""


def _command(words: list[str]) -> list[str]:
    return [sys.executable, "-m", "cnpgen", *words]


def _finish(words: list[str], codes: tuple[int, ...]) -> None:
    """Run a command to its end."""
    done = subprocess.run(
        _command(words),
        capture_output=True,
        text=True,
        check=False,
        timeout=MAX_RUN_TIME_S,
    )
    assert done.returncode in codes, (
        f"{words[0]} ended with {done.returncode}: {done.stderr[-300:]}"
    )
