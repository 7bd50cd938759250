"""Engines: what is chosen, what a cluster is asked for, and real clusters of processes on this machine."""

import importlib.util
import logging
import os
import pickle
import re
import signal
import socket
import subprocess
import sys
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from functools import partial
from importlib.util import find_spec
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import psutil
import pytest

import cnpgen
from cnpgen.addons.clusters import clusters
from cnpgen.addons.clusters.clusters import Cluster
from cnpgen.cli.main import main
from cnpgen.errors import MachineError, UsageError
from cnpgen.machine.engine import Engine, assembled
from cnpgen.make.make_dataset import _without_local_paths
from cnpgen.make.make_shards import _PREPARED, make_shards
from cnpgen.make.resolve_spec import resolve
from cnpgen.store.dataset_spec import shards, write_dataset_spec
from cnpgen.store.workspace import find_workspace
from cnpgen.validate.validate_dataset import validate_dataset
from tests.conftest import HANGING, TINY_SHARD, tiny_recipe
from tests.examples.tiny_datasets import digests, make_tiny
from tests.machine.test_workers import die_once

ROOT = Path(__file__).parents[2]


def test_what_cannot_be_meant_is_refused_before_anything_is_made(tmp_path):
    wrong = {
        "engine 'dusk' does not exist: expected one of loky, dask, ray (did you mean 'dask'?)": {
            "engine": "dusk"
        },
        "the address 'host:1' is that of a cluster: choose engine= dask or ray": {
            "address": "host:1"
        },
        "workers must be an integer from 1 on, got 0": {"engine": "dask", "workers": 0},
    }
    for text, options in wrong.items():
        with pytest.raises(UsageError, match=re.escape(text)):
            make_tiny(tmp_path / "out", **options)
        with pytest.raises(UsageError, match=re.escape(text)):
            validate_dataset(tmp_path, **options)
    assert not (tmp_path / "out").exists()


COMMANDS = {
    "make-dataset": ["airhockey-hit", "--n", "10", "-o", "{out}"],
    "extend": ["{tiny}", "--n", "700"],
    "validate": ["{tiny}", "--deep"],
    "solve": ["{tiny}", "--n", "2", "-o", "{out}"],
    "refine": ["{plans}", "-o", "{out}"],
    "benchmark": ["hits-81", "--n", "1", "-o", "{out}"],
}


@pytest.mark.parametrize("command", COMMANDS)
def test_every_command_that_shares_work_takes_the_options_and_says_them_in_errors(
    tiny, tmp_path, capsys, command
):
    cnpgen.save_plans(
        tmp_path / "plans.h5", cnpgen.load_boundary_problems(tiny("airhockey-hit"), n=2)
    )
    places = {
        "out": tmp_path / "out.h5",
        "tiny": tiny("airhockey-hit"),
        "plans": tmp_path / "plans.h5",
    }
    words = [command, *(word.format(**places) for word in COMMANDS[command])]
    assert main([*words, "--address", "a:1"]) == 2
    assert capsys.readouterr().err.endswith(
        "is that of a cluster: choose --engine dask or ray\n"
    )
    assert not (tmp_path / "out.h5").exists()
    assert main([*words, "--engine", "dusk"]) == 2
    assert (
        "--engine: expected one of loky, dask, ray, got 'dusk' (did you mean 'dask'?)"
        in capsys.readouterr().err
    )


def test_a_missing_package_is_named_with_what_installs_it(monkeypatch):
    monkeypatch.setitem(sys.modules, "ray", None)
    with (
        pytest.raises(
            MachineError,
            match=r"ray cannot be imported .*: pip install 'cnpgen\[ray\]'",
        ),
        assembled(Engine("ray"), 1),
    ):
        pass


@pytest.mark.parametrize(
    ("engine", "quick", "size"),
    [
        (Engine("loky", None, 2), False, 2),
        (Engine("loky", None, 2), True, 2),
        (Engine(), True, 1),
    ],
)
def test_processes_of_this_machine_are_as_many_as_were_asked_for_or_one_for_little(
    engine, quick, size
):
    with assembled(engine, 10, quick=quick) as pool:
        assert (pool.size, pool.is_remote) == (size, False)
        assert list(pool.distribute(abs, range(-3, 3), ordered=True)) == [
            3,
            2,
            1,
            0,
            1,
            2,
        ]


# --- what any cluster is asked for ------------------------------------------------------------------------------------


class Slow(Cluster):
    """A cluster that finishes one task per look, the last one that it was given first, where somebody is there."""

    def __init__(self, there: Callable[[], int] = lambda: 2) -> None:
        super().__init__("the cluster of the test", None)
        self.there, self.most, self.given_up = there, 0, 0

    def present(self) -> int:
        return self.there()

    def prepared(self, function: Callable[[Any], Any]) -> Callable[[Any], Any]:
        return lambda task: (function, task)

    def finished(self, tickets: Sequence[Any], seconds: float) -> Sequence[Any]:
        self.most = max(self.most, len(tickets))
        return [tickets[-1]] if self.there() else []

    def result(self, ticket: Any) -> Any:
        function, task = ticket
        return function(task)

    def cancel(self, tickets: Sequence[Any]) -> None:
        self.given_up = len(tickets)


def test_a_cluster_is_given_two_tasks_per_worker_and_results_come_in_order_if_asked():
    cluster = Slow()
    assert list(cluster.distribute(abs, range(7))) == [3, 4, 5, 6, 2, 1, 0]
    assert cluster.most == 4
    assert list(cluster.distribute(abs, range(7), ordered=True)) == list(range(7))
    assert cluster.given_up == 0


def test_what_is_under_way_is_given_up_when_the_results_are_not_wanted_any_more():
    cluster = Slow()
    results = cluster.distribute(abs, range(100))
    next(results)
    results.close()
    assert cluster.given_up == 3


def fail(_task: int) -> None:
    raise MachineError("a worker died (killed, or out of memory)")


def test_what_ends_the_workers_says_what_to_do():
    with pytest.raises(MachineError, match=r"^a worker died .*memory\): try again$"):
        list(Slow().distribute(fail, range(3), hint=": try again"))


def test_that_nobody_works_is_said_again_after_twice_the_time(monkeypatch, caplog):
    looks = iter(
        [2, *[0] * 6, 2, 2, 2, 2, 2]
    )  # the first one asks how many tasks to give
    now = [0.0]

    def look() -> int:
        now[0] += 10.0
        return next(looks)

    monkeypatch.setattr(clusters.time, "monotonic", lambda: now[0])
    with caplog.at_level(logging.WARNING):
        assert list(Slow(look).distribute(abs, [5])) == [5]
    assert [record.getMessage() for record in caplog.records] == [
        "the cluster of the test has had no worker for 10 s; waiting for one",
        "the cluster of the test has had no worker for 20 s; waiting for one",
        "the cluster of the test has had no worker for 40 s; waiting for one",
    ]


def test_a_machine_elsewhere_needs_nothing_but_the_folder_and_refuses_to_make_other_rows(
    tmp_path, monkeypatch
):
    recipe = tiny_recipe("airhockey-hit")
    folder = tmp_path / "out"
    job = resolve(
        recipe, find_workspace(folder), shard_size=TINY_SHARD, backend="numpy"
    )
    theirs = pickle.loads(pickle.dumps(_without_local_paths(job)))
    assert theirs.pipeline is theirs.cache_folder is None
    monkeypatch.chdir(tmp_path)
    write_dataset_spec(folder, job.spec)
    (result,) = list(make_shards(theirs, shards(job.spec)[-1:]))
    assert result[0] == 60
    _PREPARED.clear()
    for change in ({"revision": 1}, {"recipe_sha256": "0" * 64}):
        other = replace(theirs, spec=replace(job.spec, **change))
        with pytest.raises(
            MachineError, match="has another version of cnpgen, or of a plug-in"
        ):
            list(make_shards(other, shards(job.spec)[-1:]))


@pytest.mark.parametrize(
    ("engine", "address"),
    [
        ("dask", "nonsense"),
        ("dask", ""),
        ("dask", "tcp://host"),
        ("dask", "http://host:1"),
        ("ray", "tcp://host:1"),
        ("ray", ""),
    ],
)
def test_an_address_of_another_form_is_refused_at_once(engine, address):
    with pytest.raises(
        UsageError, match=rf"address must be the address of a {engine} cluster, such as"
    ) as caught:
        Engine(engine, address)
    assert caught.value.argument == "address"
    for valid in {
        "dask": ("tcp://a:1", "tls://10.0.0.1:8786", "a:1"),
        "ray": ("auto", "a.b:6379", "ray://a:1"),
    }[engine]:
        Engine(engine, valid)


@pytest.mark.parametrize("engine", ["dask", "ray"])
def test_an_address_where_nobody_listens_is_one_sentence_within_seconds(
    engine, monkeypatch
):
    nothing = SimpleNamespace(import_module=lambda _name: None, util=importlib.util)
    monkeypatch.setattr(clusters, "importlib", nothing)
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        address = f"127.0.0.1:{free.getsockname()[1]}"
    begun = time.monotonic()
    with (
        pytest.raises(
            MachineError,
            match=rf"^cannot reach the {engine} cluster at {address}: Connection refused$",
        ),
        assembled(Engine(engine, address), 1),
    ):
        pass
    assert time.monotonic() - begun < clusters.CONNECTION_TIMEOUT_S


def test_the_answer_of_another_service_is_one_sentence(monkeypatch):
    def connect(*_: object, **_options: object) -> None:
        raise MemoryError  # of dask, which reads a length from the answer

    distributed = pytest.importorskip("distributed")
    monkeypatch.setattr(distributed, "Client", connect)
    with socket.create_server(("127.0.0.1", 0)) as server:
        address = f"127.0.0.1:{server.getsockname()[1]}"
        with (
            pytest.raises(
                MachineError, match=f"^cannot reach the dask cluster at {address}: "
            ),
            assembled(Engine("dask", address), 1),
        ):
            pass


def test_ray_without_tokens_is_refused_for_local_clusters(monkeypatch):
    monkeypatch.setenv("RAY_AUTH_MODE", "disabled")
    monkeypatch.setenv("RAY_AUTH_TOKEN", "replaced below, and restored after the test")
    monkeypatch.setattr(clusters.importlib.metadata, "version", lambda _name: "2.51.3")
    with pytest.raises(
        MachineError,
        match=r"^ray 2.51.3 starts clusters without authentication: .* 'ray>=2.52'",
    ):
        clusters._prepare_ray()
    monkeypatch.setattr(
        clusters.importlib.metadata, "version", lambda _name: "2.52.0rc1"
    )
    monkeypatch.setitem(
        sys.modules, "ray", SimpleNamespace(is_initialized=lambda: False)
    )
    with pytest.raises(MachineError, match="ray was imported without a token"):
        clusters._prepare_ray()
    monkeypatch.delitem(sys.modules, "ray")
    clusters._prepare_ray()
    assert os.environ["RAY_AUTH_MODE"] == "token"
    assert len(os.environ["RAY_AUTH_TOKEN"]) == 64


# --- real ones --------------------------------------------------------------------------------------------------------


@pytest.fixture
def start(tmp_path) -> Iterator[Callable[..., subprocess.Popen]]:
    """Start processes of dask in a folder of their own; they end with the test."""
    started: list[subprocess.Popen] = []
    (elsewhere := tmp_path / "elsewhere").mkdir()
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join([str(ROOT), *sys.path])}

    def run(kind: str, *options: str) -> subprocess.Popen:
        command = [
            sys.executable,
            "-m",
            f"distributed.cli.dask_{kind}",
            "--scheduler-file",
            str(tmp_path / "file"),
        ]
        with (tmp_path / f"{kind}-{len(started)}.log").open("w") as log:
            started.append(
                subprocess.Popen(
                    [*command, *options], cwd=elsewhere, env=environment, stderr=log
                )
            )
        return started[-1]

    run.started = started
    yield run
    for process in started:
        process.kill()
        process.wait()


@pytest.fixture
def scheduler(start, tmp_path) -> str:
    """The address of a scheduler of dask on the loopback interface, which has no workers yet."""
    import json

    pytest.importorskip("distributed")
    start(
        "scheduler",
        "--host",
        "127.0.0.1",
        "--port",
        "0",
        "--no-dashboard",
        "--no-jupyter",
    )
    deadline = time.monotonic() + HANGING
    while not (tmp_path / "file").exists() and time.monotonic() < deadline:
        time.sleep(0.05)
    return json.loads((tmp_path / "file").read_text())["address"]


def require(name: str) -> None:
    """Skip a test without a package, and do not import it: ray reads its token on import."""
    package = {"dask": "distributed"}.get(name, name)
    if find_spec(package) is None:
        pytest.skip(f"{package} is not installed")


WORKER = (
    "worker",
    "--nthreads",
    "1",
    "--no-nanny",
    "--no-dashboard",
    "--host",
    "127.0.0.1",
)


@pytest.mark.extended
@pytest.mark.filterwarnings("default")  # of dask's own
def test_a_dataset_is_made_by_two_workers_of_dask_of_which_one_is_killed(
    tiny, tmp_path, monkeypatch, start, scheduler
):
    workers = [start(*WORKER) for _ in range(2)]
    monkeypatch.chdir(tmp_path)
    made = make_tiny(
        Path("out"),
        engine="dask",
        address=scheduler,
        workers=None,
        shard_size=50,
        progress=lambda *_: workers[0].kill(),
    )
    assert made.complete
    make_tiny(tmp_path / "uncut", shard_size=50)
    assert digests(tmp_path / "out") == digests(tmp_path / "uncut")
    assert not list((tmp_path / "elsewhere").glob("out*"))
    report = validate_dataset(
        "out", deep=True, regenerate=1, engine="dask", address=scheduler
    )
    assert report.ok
    assert report.deep.rows == 660


@pytest.mark.extended
@pytest.mark.filterwarnings("default")
def test_that_the_last_worker_of_dask_is_gone_is_said_until_another_one_comes(
    tmp_path, monkeypatch, caplog, start, scheduler
):
    monkeypatch.setattr(clusters, "FIRST_WARNING_S", 2.0)
    first = start(*WORKER)

    class Starter(logging.Handler):
        """Starts another worker when it is said that there is none."""

        def emit(self, record: logging.LogRecord) -> None:
            logger.removeHandler(self)
            start(*WORKER)

    logger = logging.getLogger("cnpgen.addons.clusters.clusters")
    logger.addHandler(Starter())
    kill = {"progress": lambda *_: first.kill()}
    made = make_tiny(
        tmp_path / "out",
        engine="dask",
        address=scheduler,
        workers=None,
        shard_size=50,
        **kill,
    )
    assert made.complete
    assert (
        f"the dask cluster at {scheduler} has had no worker for 2 s; waiting for one"
        in caplog.text
    )


def end_workers(_task: int) -> None:
    os.kill(os.getpid(), signal.SIGKILL)


@pytest.mark.extended
@pytest.mark.filterwarnings("default")
@pytest.mark.parametrize("name", ["dask", "ray"])
def test_a_task_that_ends_every_worker_is_a_machine_error(name):
    require(name)
    with (
        assembled(Engine(name, None, 2), 3) as pool,
        pytest.raises(MachineError, match=r"^a worker died .*: try again$"),
    ):
        list(pool.distribute(end_workers, range(3), hint=": try again"))


STRANGERS = {  # programs of another process of this machine that try to run a task
    "dask": """
from distributed import Client
from distributed.security import Security
for options in ({"address": "tcp://" + ADDRESS}, {"address": "tls://" + ADDRESS, "security": Security.temporary()}):
    try:
        print("ran", Client(timeout=3, **options).submit(sum, [1, 2]).result(timeout=3))
    except OSError as error:
        print("refused", type(error).__name__)
""",
    "ray": """
import ray
try:
    ray.init(ADDRESS, log_to_driver=False)
    print("ran", ray.get(ray.remote(lambda: 3).remote()))
except Exception as error:
    print("refused", type(error).__name__)
""",
}
STRANGER_TIME_S = (
    20  # after it, a stranger is ended: ray repeats refused calls for minutes
)


@pytest.mark.extended
@pytest.mark.filterwarnings("default")
@pytest.mark.parametrize("name", ["dask", "ray"])
def test_a_local_cluster_is_on_loopback_and_runs_no_task_of_another_process(name):
    require(name)
    with assembled(Engine(name, None, 1), 3) as pool:
        assert list(pool.distribute(abs, [-3])) == [3]
        processes = [psutil.Process(), *psutil.Process().children(recursive=True)]
        listening = {
            c.laddr
            for p in processes
            for c in p.net_connections("tcp")
            if c.status == psutil.CONN_LISTEN
        }
        assert {laddr.ip.removeprefix("::ffff:") for laddr in listening} == {
            "127.0.0.1"
        }
        if name == "dask":
            address = pool._client.scheduler.address
            assert address.startswith("tls://")
        else:
            address = sys.modules["ray"].get_runtime_context().gcs_address
        program = f"ADDRESS = {address.rpartition('/')[2]!r}\n{STRANGERS[name]}"
        environment = {
            key: value
            for key, value in os.environ.items()
            if not key.startswith("RAY_")
        }
        stranger = subprocess.Popen(
            [sys.executable, "-c", program],
            stdout=subprocess.PIPE,
            stderr=subprocess.DEVNULL,
            env=environment,
            text=True,
        )
        try:
            said, _ = stranger.communicate(timeout=STRANGER_TIME_S)
        except subprocess.TimeoutExpired:
            stranger.kill()
            said, _ = stranger.communicate()
        assert "ran" not in said
        assert list(pool.distribute(abs, [-4])) == [4]


def command_of(name: str, out: Path, *options: str) -> subprocess.Popen:
    """Start a command that takes long, on an engine."""
    words = [
        "make-dataset",
        "airhockey-hit",
        "--n",
        "4e7",
        "--shard-size",
        "4096",
        "--engine",
        name,
        *options,
    ]
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join([str(ROOT), *sys.path])}
    return subprocess.Popen(
        [sys.executable, "-m", "cnpgen", *words, "--quiet", "--out", str(out)],
        stderr=subprocess.PIPE,
        env=environment,
        text=True,
    )


def wait_for_shards(out: Path) -> None:
    deadline = time.monotonic() + HANGING
    while not list(out.glob("train/*.json")) and time.monotonic() < deadline:
        time.sleep(0.1)


def error_of(process: subprocess.Popen) -> str:
    """Return what a process printed until its end."""
    try:
        return process.communicate(timeout=HANGING)[1]
    finally:
        process.kill()


@pytest.mark.extended
@pytest.mark.parametrize("name", ["loky", "dask", "ray"])
def test_sigterm_ends_a_command_with_143_under_each_engine(tmp_path, name):
    if name != "loky":
        require(name)
    process = command_of(name, tmp_path / "out", "--workers", "2")
    wait_for_shards(tmp_path / "out")
    process.terminate()
    assert (
        error_of(process)
        .splitlines()[-1]
        .startswith("cnpgen: terminated: finished shards are kept")
    )
    assert process.returncode == 143


@pytest.mark.extended
@pytest.mark.filterwarnings("default")
def test_a_killed_scheduler_of_dask_is_one_sentence(tmp_path, start, scheduler):
    start(*WORKER)
    process = command_of("dask", tmp_path / "out", "--address", scheduler)
    wait_for_shards(tmp_path / "out")
    start.started[0].kill()
    (line,) = error_of(process).splitlines()
    assert line.startswith(
        f"cnpgen: error: the connection to the dask cluster at {scheduler} is lost: the shards"
    )
    assert process.returncode == MachineError.exit_code


@pytest.mark.extended
def test_a_killed_head_of_ray_is_one_sentence(tmp_path):
    require("ray")
    process = command_of("ray", tmp_path / "out", "--workers", "2")
    wait_for_shards(tmp_path / "out")
    (head,) = [
        p
        for p in psutil.Process(process.pid).children(recursive=True)
        if p.name() == "gcs_server"
    ]
    head.kill()
    assert (
        error_of(process)
        .splitlines()[-1]
        .startswith("cnpgen: error: cannot reach the ray cluster on this machine")
    )
    assert process.returncode == MachineError.exit_code


def refuse(_task: int) -> None:
    raise UsageError("not this one")


@pytest.mark.extended
@pytest.mark.filterwarnings("default")
def test_ray_makes_the_same_bytes_and_gives_the_task_of_a_dead_worker_to_another(
    tiny, tmp_path
):
    require("ray")
    with assembled(Engine("ray", None, 2), 6) as pool:
        assert sorted(
            pool.distribute(partial(die_once, tmp_path / "died"), range(6))
        ) == list(range(6))
        assert (tmp_path / "died").exists()
        with pytest.raises(UsageError, match=r"^not this one$"):
            list(pool.distribute(refuse, range(3)))
        made = make_tiny(tmp_path / "out", engine="ray", workers=2)
    assert not sys.modules["ray"].is_initialized()
    assert made.complete
    assert digests(tmp_path / "out") == digests(tiny("airhockey-hit"))


@pytest.mark.extended
@pytest.mark.filterwarnings("default")
@pytest.mark.parametrize("name", ["dask", "ray"])
def test_plans_are_the_same_whichever_engine_makes_them(tmp_path, name):
    require(name)
    problems = cnpgen.draw_boundary_problems("airhockey-hit", 6, seed=3)
    here = cnpgen.solve_plans(problems, workers=1)
    there = cnpgen.solve_plans(
        problems, workers=2, engine=name, journal=tmp_path / "journal"
    )
    np.testing.assert_array_equal(
        there.plans.path_control_points, here.plans.path_control_points
    )
    np.testing.assert_array_equal(
        there.plans.rate_control_points, here.plans.rate_control_points
    )
