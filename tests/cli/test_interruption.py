"""Interrupting the command line, with real signals: nothing that was finished is lost, one line says how to go on."""

import os
import random
import signal
import subprocess
import sys
import threading
import time
import types
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

import pytest

import cnpgen
import cnpgen.__main__
from cnpgen.cli.interruption import (
    INTERRUPTED,
    Terminated,
    exit_code,
    interruptible,
    raise_if_interrupted,
)
from cnpgen.cli.main import main
from cnpgen.kernels.compiler import find_compiler
from tests.conftest import HANGING, some
from tests.machine.test_workers import alive

KEPT = "finished shards are kept; run the same command again to resume"
ENVIRONMENT = {**os.environ, "PYTHONPATH": str(Path(cnpgen.__file__).parents[1])}
NAMES = {signal.SIGINT: ("interrupted", 130), signal.SIGTERM: ("terminated", 143)}

linux = pytest.mark.skipif(not Path("/proc/self/task").is_dir(), reason="needs /proc")


@pytest.fixture(scope="module", autouse=True)
def _compiled(tiny) -> None:
    """Have the kernels in the cache: compiling them is announced."""
    tiny("airhockey-hit")


class _Interrupting(types.ModuleType):
    """A module that is interrupted while something is imported from it."""

    def __getattr__(self, name: str) -> None:
        raise KeyboardInterrupt


def test_an_interruption_of_the_imports_is_a_line(monkeypatch, capsys) -> None:
    monkeypatch.setitem(
        sys.modules, "cnpgen.cli.main", _Interrupting("cnpgen.cli.main")
    )
    assert cnpgen.__main__.main() == INTERRUPTED == 130
    assert capsys.readouterr().err == "cnpgen: interrupted\n"


def descendants(pid: int) -> list[int]:
    found: list[int] = []
    for path in Path(f"/proc/{pid}/task").glob("*/children"):
        for child in map(int, path.read_text().split()):
            found += [child, *descendants(child)]
    return found


def wait_for(condition, seconds: float = HANGING) -> None:
    deadline = time.monotonic() + seconds
    while not condition():
        assert time.monotonic() < deadline
        time.sleep(0.01)


@contextmanager
def making(folder: Path, workers: int, rows: str = "5e6") -> Iterator[subprocess.Popen]:
    """Make a dataset that takes a while, in a session of its own, as a terminal's foreground job."""
    words = [
        "airhockey-hit",
        "--n",
        rows,
        "--shard-size",
        "4096",
        "--workers",
        str(workers),
        "--out",
        str(folder),
    ]
    command = [sys.executable, "-m", "cnpgen", "make-dataset", *words]
    options = {"env": ENVIRONMENT, "start_new_session": True, "text": True}
    with subprocess.Popen(
        command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, **options
    ) as process:
        try:
            yield process
        finally:
            process.kill()


def check_end(
    process: subprocess.Popen, number: signal.Signals, offspring: list[int]
) -> str:
    """Wait for the end of an interrupted process and check what it says and leaves; return its other lines."""
    out, err = process.communicate(timeout=HANGING)
    what, code = NAMES[number]
    *others, last = err.splitlines()
    assert (last, out) == (f"cnpgen: {what}: {KEPT}", "")
    assert process.returncode in {
        code,
        -number,
    }  # the latter where a second signal came in its very last time
    wait_for(lambda: not any(map(alive, offspring)))
    return "\n".join(others)


@pytest.mark.slow
@linux
@pytest.mark.parametrize("workers", some([2, 1]))
@pytest.mark.parametrize("number", some(NAMES, 1, "slow"))
def test_a_signal_ends_the_run_and_its_workers_and_keeps_what_is_finished(
    tmp_path, number, workers
):
    folder = tmp_path / "out"
    with making(folder, workers) as process:
        wait_for(lambda: len(list(folder.glob("train/*.json"))) >= 2)
        offspring = descendants(process.pid)
        assert len(offspring) >= 2 * (workers > 1)
        process.send_signal(number)
        assert (
            check_end(process, number, offspring) == f"making {folder}: 5,000,000 rows"
        )
    found = {path.stem for path in folder.glob("train/*.h5")}
    recorded = {path.stem for path in folder.glob("train/*.json")}
    assert recorded <= found
    assert len(recorded) >= 2
    assert not (folder / "manifest.json").exists()


@pytest.mark.slow
@linux
@pytest.mark.parametrize("number", NAMES)
@pytest.mark.parametrize("seed", some(range(2)))
def test_a_signal_to_all_processes_while_workers_start_gives_no_traceback(
    tmp_path, number, seed
):
    folder = tmp_path / "out"
    with making(folder, 2) as process:
        assert process.stderr.readline() == f"making {folder}: 5,000,000 rows\n"
        wait_for(lambda: descendants(process.pid))
        time.sleep(
            random.Random(seed).uniform(0, 0.6)
        )  # anywhere between the first fork and the first shard
        offspring = descendants(process.pid)
        os.killpg(process.pid, number)
        if seed == 0:
            os.killpg(
                process.pid, number
            )  # wrappers pass on what the terminal has sent already
        assert check_end(process, number, offspring) == ""


@pytest.mark.slow
@linux
def test_workers_end_where_the_system_has_no_command_to_list_processes(
    tmp_path, monkeypatch
):
    """As in slim container images, where joblib alone fails to kill its workers."""
    (tmp_path / "bin").mkdir()
    if compiler := find_compiler():
        (tmp_path / "bin" / "cc").symlink_to(compiler)
    monkeypatch.setitem(ENVIRONMENT, "PATH", str(tmp_path / "bin"))
    with making(tmp_path / "out", 2) as process:
        wait_for(lambda: len(list(tmp_path.glob("out/train/*.json"))) >= 1)
        offspring = descendants(process.pid)
        process.send_signal(signal.SIGTERM)
        check_end(process, signal.SIGTERM, offspring)


@pytest.mark.slow
@linux
def test_a_killed_run_leaves_no_worker_and_only_whole_shards(tmp_path):
    folder = tmp_path / "out"
    with making(folder, 2) as process:
        wait_for(lambda: len(list(folder.glob("train/*.json"))) >= 2)
        offspring = descendants(process.pid)
        process.kill()
        wait_for(lambda: not any(map(alive, offspring)))
        process.communicate()
    command = [sys.executable, "-m", "cnpgen", "validate", str(folder)]
    validated = subprocess.run(
        command, env=ENVIRONMENT, capture_output=True, text=True, check=False
    )
    (finding,) = [
        line
        for line in validated.stdout.splitlines()
        if line.startswith("manifest.json: ")
    ]
    assert "is missing: the dataset is unfinished" in finding
    assert "shard-" not in validated.stdout


# --- in this process --------------------------------------------------------------------------------------------------


@pytest.fixture(autouse=True)
def same_handlers() -> Iterator[None]:
    """Leave no handler behind: those of an interrupted command stay on purpose."""
    before = {number: signal.getsignal(number) for number in NAMES}
    yield
    for number, handler in before.items():
        signal.signal(number, handler)
    with interruptible():
        pass


def run_into(number: signal.Signals) -> None:
    os.kill(os.getpid(), number)
    time.sleep(1)


@interruptible()
def drop_it() -> None:
    with suppress(KeyboardInterrupt):
        run_into(signal.SIGTERM)
    raise_if_interrupted()


@interruptible()
def turn_it_into_an_error() -> None:
    try:
        run_into(signal.SIGTERM)
    except KeyboardInterrupt:
        raise ZeroDivisionError from None


@interruptible()
def end_tidily(steps: list[str]) -> None:
    try:
        run_into(signal.SIGTERM)
    finally:
        os.kill(os.getpid(), signal.SIGTERM)
        steps.append("ended tidily")


@pytest.mark.parametrize("number", NAMES)
def test_a_signal_is_an_interruption_of_its_own_kind(number):
    with pytest.raises(KeyboardInterrupt) as caught:
        interruptible()(run_into)(number)
    assert isinstance(caught.value, Terminated) == (number == signal.SIGTERM)
    assert exit_code(caught.value) == NAMES[number][1]


def test_an_echo_of_a_signal_does_not_disturb_the_end():
    steps: list[str] = []
    with pytest.raises(Terminated):
        end_tidily(steps)
    assert steps == ["ended tidily"]


def test_an_interruption_that_a_library_drops_is_raised_at_the_next_chance():
    with pytest.raises(Terminated):
        drop_it()


def test_an_error_that_an_interruption_has_caused_is_that_interruption():
    with pytest.raises(Terminated):
        turn_it_into_an_error()


def test_handlers_are_as_before_where_no_signal_came_and_ignored_signals_stay_ignored():
    signal.signal(signal.SIGTERM, signal.SIG_IGN)
    before = {number: signal.getsignal(number) for number in NAMES}
    with interruptible():
        os.kill(os.getpid(), signal.SIGTERM)
        assert signal.getsignal(signal.SIGTERM) is signal.SIG_IGN
        assert signal.getsignal(signal.SIGINT) is not before[signal.SIGINT]
    assert {number: signal.getsignal(number) for number in NAMES} == before


def test_commands_run_in_other_threads_too():
    codes: list[int] = []
    thread = threading.Thread(target=lambda: codes.append(main(["list", "datasets"])))
    thread.start()
    thread.join()
    assert codes == [0]


def test_a_second_interruption_after_a_second_ends_the_process_at_once():
    code = """
import os, signal, time
from cnpgen.cli.interruption import interruptible
from cnpgen.machine import signals
signals.MIN_REPEAT_INTERVAL_S = 0.05
with interruptible():
    try:
        os.kill(os.getpid(), signal.SIGTERM)
        time.sleep(1)
    finally:
        time.sleep(0.2)
        os.kill(os.getpid(), signal.SIGTERM)
        time.sleep(5)
        print("still here")
"""
    done = subprocess.run(
        [sys.executable, "-c", code],
        env=ENVIRONMENT,
        capture_output=True,
        text=True,
        check=False,
    )
    assert (done.returncode, done.stdout, done.stderr) == (143, "", "")
