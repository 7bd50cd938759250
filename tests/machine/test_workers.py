"""Sharing work out: results in any order or in theirs, workers that end with their parent, and other backends."""

import os
import signal
import subprocess
import sys
import tempfile
import threading
import time
from functools import partial
from pathlib import Path

import joblib
import pytest

import cnpgen
from cnpgen.errors import DatasetError, MachineError, UsageError
from cnpgen.machine.workers import distribute, signals_blocked, worker_count
from tests.conftest import HANGING, some
from tests.examples.tiny_datasets import digests, make_tiny
from tests.refusals import is_refused

ROOT = Path(__file__).parents[2]
linux = pytest.mark.skipif(not Path("/proc/self/task").is_dir(), reason="needs /proc")


def slow_first(number: int) -> int:
    time.sleep(0.05 * (3 - number))
    return number


def test_there_are_no_more_workers_than_tasks():
    assert worker_count(8, 3) == 3
    assert worker_count(2, 300) == 2
    assert worker_count(5, 0) == 1
    assert 1 <= worker_count(None, 1000) <= (os.cpu_count() or 1)
    with is_refused(UsageError, argument="workers"):
        worker_count(0, 3)


@pytest.mark.parametrize("workers", [1, 3])
@pytest.mark.parametrize("ordered", [False, True])
def test_every_task_is_done_and_results_come_in_their_order_if_asked(workers, ordered):
    found = list(distribute(slow_first, range(3), workers, ordered=ordered))
    assert found == [0, 1, 2] if ordered or workers == 1 else sorted(found) == [0, 1, 2]


@pytest.mark.slow
def test_tasks_are_fetched_as_they_are_needed():
    fetched = []

    def tasks():
        for number in range(1000):
            fetched.append(number)
            yield 3

    results = distribute(slow_first, tasks(), 2)
    next(results)
    results.close()
    assert len(fetched) < 50


KILLED = """
import os, signal, sys, time
from cnpgen.machine.workers import distribute

if __name__ == "__main__":
    for _ in distribute(time.sleep, [0.0, 0.0, 60.0, 60.0], 2):
        if sys.stdin.readline().strip() == "die":
            os.kill(os.getpid(), signal.SIGKILL)
"""


KILLED_WHILE_SENDING = """
import os, signal, sys
from multiprocessing.connection import Connection
from cnpgen.errors import DatasetError
from cnpgen.machine.workers import distribute

whole = Connection._send

def half(self, content, write=os.write):  # what a pipe takes as a whole is written as a whole
    if len(content) <= 4096:
        return whole(self, content)
    os.write(self._handle, content[:4096])
    os.kill(os.getpid(), signal.SIGKILL)

def long(task):
    Connection._send = half
    if task == 3:
        raise DatasetError("x" * 100_000)
    return bytes(100_000)

if __name__ == "__main__":
    found = []
    try:
        for each in distribute(long, range(4), 2, ordered=True):
            found.append(len(each))
    except DatasetError as error:
        print(found, len(error.args[0]))
"""


@pytest.mark.slow
@linux
def test_a_worker_that_is_killed_while_it_sends_a_long_result_keeps_nobody_waiting():
    """It never does: what is long goes through a file. Else the parent would wait for the other half for ever."""
    command = [sys.executable, "-c", KILLED_WHILE_SENDING]
    done = subprocess.run(
        command, cwd=ROOT, capture_output=True, text=True, timeout=HANGING, check=False
    )
    assert (done.returncode, done.stdout) == (0, "[100000, 100000, 100000] 100000\n"), (
        done.stderr
    )


def long_or_short(size: int) -> bytes:
    if size < 0:
        raise DatasetError("x" * -size)
    return bytes(size)


@pytest.mark.slow
def test_results_of_any_length_come_back_and_leave_no_file_behind(
    monkeypatch, tmp_path
):
    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path))
    sizes = [0, 1000, 2000, 2040, 2048, 2100, 4096, 16_384, 70_000, 3_000_000]
    assert list(map(len, distribute(long_or_short, sizes, 2, ordered=True))) == sizes
    for size in (10, 100_000):
        with pytest.raises(DatasetError) as caught:
            list(distribute(long_or_short, [5, -size, 7], 2))
        assert caught.value.args == ("x" * size,)
        assert "in long_or_short" in caught.value.__notes__[0]
    assert not list(tmp_path.iterdir())


ABORTED_TASK = """
from joblib.externals.loky import process_executor
from cnpgen.machine.workers import distribute
from tests.machine.test_workers import long_or_short

manager = process_executor._ExecutorManagerThread
flag = manager.flag_executor_shutting_down
manager.flag_executor_shutting_down = lambda thread: (thread.work_ids_queue.put(123456), flag(thread))
list(distribute(long_or_short, [5, -10, 7], 2))
"""  # an abort removes the task 123456 before its dispatch


@pytest.mark.slow
def test_an_abort_between_submission_and_dispatch_ends_with_the_error_of_the_task():
    command = [sys.executable, "-c", ABORTED_TASK]
    done = subprocess.run(
        command, cwd=ROOT, capture_output=True, text=True, check=False, timeout=HANGING
    )
    assert done.returncode == 1
    assert "DatasetError: xxxxxxxxxx" in done.stderr
    assert "KeyError" not in done.stderr


@pytest.mark.slow
@linux
def test_what_a_killed_process_leaves_is_tidied_up_without_a_word(tmp_path):
    options, pipe = list(sys.warnoptions), subprocess.PIPE
    command = [sys.executable, "-c", KILLED]
    environment = os.environ | {"TMPDIR": str(tmp_path)}
    with subprocess.Popen(
        command,
        cwd=ROOT,
        env=environment,
        stdin=pipe,
        stdout=pipe,
        stderr=pipe,
        text=True,
    ) as process:
        said = process.communicate(
            "go on\ndie\n", timeout=HANGING
        )  # until the helpers are gone, too
    assert (process.returncode, *said) == (-signal.SIGKILL, "", "")
    assert not [
        path
        for path in Path("/dev/shm").iterdir()
        if f"loky-{process.pid}-" in path.name
    ]
    assert not list(tmp_path.iterdir())
    assert sys.warnoptions == options


def fail(_task: int) -> None:
    raise ZeroDivisionError("on purpose")


def test_an_error_of_a_task_is_that_error():
    with is_refused(ZeroDivisionError):
        list(distribute(fail, range(4), 2))


def die(_task: int) -> None:
    os.kill(os.getpid(), signal.SIGKILL)


def test_a_dead_worker_is_a_machine_error_with_a_hint():
    with is_refused(MachineError):
        list(distribute(die, range(4), 2, hint=": try again"))


# --- signals ----------------------------------------------------------------------------------------------------------


def blocked(_task: int) -> set[int]:
    return {int(number) for number in signal.pthread_sigmask(signal.SIG_BLOCK, ())}


def test_workers_never_see_the_interruption_that_a_terminal_sends_to_all():
    assert not blocked(0)
    for found in distribute(blocked, range(4), 2):
        assert {signal.SIGINT, signal.SIGTERM} <= found
    assert not blocked(0)


def test_a_signal_that_comes_while_workers_start_is_only_delayed():
    started, over = [], threading.Event()

    def interrupted() -> None:
        with signals_blocked():
            os.kill(os.getpid(), signal.SIGINT)
            time.sleep(0.05)
            started.append(True)

    other = threading.Thread(target=over.wait)  # blocks no signal
    other.start()
    try:
        with pytest.raises(KeyboardInterrupt):
            interrupted()
    finally:
        over.set()
        other.join()
    assert started == [True]
    assert signal.getsignal(signal.SIGINT) is signal.default_int_handler


CHILD = """
import os, sys, time
from cnpgen.machine.workers import distribute
def pid(number):
    time.sleep(number)
    return os.getpid()
if __name__ == "__main__":
    for found in distribute(pid, [0.2, 0.2, 100, 100], 2):
        print(found, flush=True)
"""


def alive(pid: int) -> bool:
    try:
        return (
            Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[0] != "Z"
        )
    except OSError:
        return False


@linux
@pytest.mark.parametrize(
    "number", some([signal.SIGKILL, signal.SIGTERM, signal.SIGHUP])
)
def test_workers_end_soon_after_their_parent_whatever_they_are_doing(tmp_path, number):
    if signal.getsignal(number) is signal.SIG_IGN:
        pytest.skip("the tests run under nohup, and so do those that they start")
    (tmp_path / "child.py").write_text(CHILD)
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join([str(ROOT), *sys.path])}
    command = [sys.executable, str(tmp_path / "child.py")]
    with subprocess.Popen(
        command,
        env=environment,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
    ) as child:
        workers = {int(child.stdout.readline()) for _ in range(2)}
        assert all(map(alive, workers))
        child.send_signal(number)
        assert child.wait(HANGING) == -number
        deadline = time.monotonic() + HANGING
        while any(map(alive, workers)) and time.monotonic() < deadline:
            time.sleep(0.05)
        assert not any(map(alive, workers))
        assert "Traceback" not in child.stderr.read()


# --- other backends ---------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    "backend", some(["threading", "sequential", "multiprocessing"], 1, "slow")
)
def test_other_backends_make_the_same_bytes(tiny, tmp_path, backend):
    with joblib.parallel_config(backend=backend):
        make_tiny(tmp_path / "out", workers=4, shard_size=250)
    assert digests(tmp_path / "out") == digests(tiny("airhockey-hit"))


def test_a_backend_that_knows_only_lists_is_given_a_few_tasks_at_a_time():
    fetched = []

    def tasks():
        for number in range(1000):
            fetched.append(number)
            yield number

    with joblib.parallel_config(backend="multiprocessing"):
        results = distribute(abs, tasks(), 2)
        assert [next(results) for _ in range(20)] == list(range(20))
        results.close()
    assert len(fetched) < 50


@pytest.fixture
def cluster():
    """Dask's scheduler and two workers, each a process."""
    distributed = pytest.importorskip("distributed")
    local = distributed.LocalCluster(
        n_workers=2, threads_per_worker=1, dashboard_address=None
    )
    with local as cluster, distributed.Client(cluster) as client:
        yield client


@pytest.mark.extended
@pytest.mark.filterwarnings("default")  # of dask's own
def test_dask_makes_the_same_bytes(tiny, tmp_path, cluster):
    with joblib.parallel_config(backend="dask"):
        made = make_tiny(tmp_path / "out", workers=2)
    assert made.complete
    assert digests(tmp_path / "out") == digests(tiny("airhockey-hit"))


@pytest.mark.extended
@pytest.mark.filterwarnings("default")
def test_ray_makes_the_same_bytes_and_plans_as_a_backend_of_joblib(tiny, tmp_path):
    ray = pytest.importorskip("ray")
    from ray.util.joblib import register_ray

    problems = cnpgen.draw_boundary_problems("airhockey-hit", 6, seed=3)
    here = cnpgen.solve_plans(problems, workers=1)
    ray.init("local", num_cpus=2, include_dashboard=False, log_to_driver=False)
    try:
        register_ray()
        with joblib.parallel_config(backend="ray"):
            made = make_tiny(tmp_path / "out", workers=2)
            there = cnpgen.solve_plans(problems, workers=2)
            assert cnpgen.validate_dataset(tmp_path / "out", deep=True, workers=2).ok
    finally:
        ray.shutdown()
    assert made.complete
    assert digests(tmp_path / "out") == digests(tiny("airhockey-hit"))
    assert (there.plans.path_control_points == here.plans.path_control_points).all()


def die_once(marker: Path, task: int) -> int:
    try:
        marker.touch(exist_ok=False)
    except FileExistsError:
        return task
    os.kill(os.getpid(), signal.SIGKILL)
    raise AssertionError


@pytest.mark.extended
@pytest.mark.filterwarnings("default")
def test_dask_gives_the_task_of_a_dead_worker_to_another(tmp_path, cluster):
    with joblib.parallel_config(backend="dask"):
        assert sorted(
            distribute(partial(die_once, tmp_path / "died"), range(6), 2)
        ) == list(range(6))
    assert (tmp_path / "died").exists()
