"""Planner in its own process: a crash or a hang affects only the problem at which it happens."""

import multiprocessing
import os
import resource
import signal
import subprocess
import sys
import time
from contextlib import suppress
from dataclasses import dataclass, replace
from enum import StrEnum
from multiprocessing.connection import Connection
from typing import Any

from cnpgen.addons.benchmark.benchmark_planner import Plan, Setting, load_planner
from cnpgen.addons.benchmark.results_file import answer_from_dict, answer_to_dict
from cnpgen.addons.trajectories.sampled_trajectory import Trajectory
from cnpgen.documents import JsonObject
from cnpgen.errors import CnpgenError, MachineError, UsageError
from cnpgen.machine.threads import one_thread
from cnpgen.plans.plans import Plans

# After its time limit a planner is stopped; an answer in between is not counted.
STOP_MARGIN_S = 1.0
MAX_PREPARATION_TIME_S = 300.0  # including the compilation of kernels
STDERR = 2  # the file descriptor


class Ending(StrEnum):
    """Outcome of planning for one problem."""

    PLANNED = "planned"
    NO_PLAN = "no plan"
    FAILED = "failed"
    OUT_OF_TIME = "out of time"
    NOT_APPLICABLE = "not applicable"
    CRASHED = "crashed"


@dataclass(frozen=True)
class PlanningOutcome:
    """Result of planning for one problem: the answer in its stored form, wall and CPU time [s], and an error message.

    The CPU time includes that of ended child processes; of a stopped planner, also that
    of its running child processes.
    """

    ending: Ending
    answer: JsonObject | None = None
    seconds: float = 0.0
    cpu_seconds: float = 0.0
    error: str = ""


class PlannerProcess:
    """Planner in another process, which is restarted after it died or was stopped."""

    def __init__(self, name: str, setting: Setting) -> None:
        self._name = name
        self._setting = setting
        self._process: subprocess.Popen[bytes] | None = None
        self._pipe: Connection | None = None
        self._unprepared: PlanningOutcome | None = None

    def plan(self, problem: Plans) -> PlanningOutcome:
        """Plan for one problem; raise MachineError if this machine lacks a requirement of the planner."""
        if self._unprepared is None and self._pipe is None:
            self._unprepared = self._start()
        if self._unprepared is not None:
            return self._unprepared
        assert self._pipe is not None
        assert self._process is not None
        # A stopped planner reports nothing, so its times are measured from here, too.
        start = time.perf_counter()
        used = cpu_time_of(self._process.pid)
        try:
            self._pipe.send(problem)
            # Planners may end a little after their limit; their answer then does not
            # count.
            if self._pipe.poll(self._setting.time_limit + STOP_MARGIN_S):
                return self._in_time(self._pipe.recv())
        except (EOFError, OSError):
            self.stop()
            return PlanningOutcome(
                Ending.CRASHED,
                seconds=time.perf_counter() - start,
                error="its process ended",
            )
        seconds = time.perf_counter() - start
        used = cpu_time_of(self._process.pid) - used
        self.stop()
        return PlanningOutcome(
            Ending.OUT_OF_TIME, None, seconds, used, "stopped: no answer"
        )

    def _in_time(self, outcome: PlanningOutcome) -> PlanningOutcome:
        """Return an outcome, without an answer that is late."""
        if outcome.answer is None or outcome.seconds <= self._setting.time_limit:
            return outcome
        return replace(
            outcome,
            ending=Ending.OUT_OF_TIME,
            answer=None,
            error="answered after the time limit",
        )

    def stop(self) -> None:
        """End the process and its child processes."""
        if self._process is not None:
            end_processes(self._process.pid)
            self._process.wait()
        if self._pipe is not None:
            self._pipe.close()
        self._process = self._pipe = None

    def _start(self) -> PlanningOutcome | None:
        """Start the process; return the outcome of all problems if the planner cannot be prepared."""
        start = time.perf_counter()
        self._pipe, child_end = multiprocessing.Pipe()
        # multiprocessing.Process would run the caller's script and is forbidden in dask
        # workers.
        with child_end:
            program = f"import sys; sys.path[:] = {sys.path!r}; from {__name__} import serve; "
            program += f"serve({child_end.fileno()})"
            command = [sys.executable, "-c", program]
            # Output of planners is not data.
            self._process = subprocess.Popen(
                command,
                pass_fds=[child_end.fileno()],
                stdin=subprocess.DEVNULL,
                stdout=STDERR,
                start_new_session=True,
            )
        refuses = False
        lacks = False
        message = "its process ended or was not ready in time"
        with suppress(EOFError, OSError):
            self._pipe.send((self._name, self._setting))
            if self._pipe.poll(MAX_PREPARATION_TIME_S):
                refuses, lacks, message = self._pipe.recv()
        if not message:
            return None
        self.stop()
        if lacks:
            raise MachineError(f"planner {self._name!r} cannot plan here: {message}")
        if refuses:
            return PlanningOutcome(Ending.NOT_APPLICABLE, error=message)
        return PlanningOutcome(
            Ending.CRASHED,
            seconds=time.perf_counter() - start,
            error=f"before the first problem: {message}",
        )


def end_processes(root: int) -> None:
    """End a process that leads its own session, and all processes that it started."""
    import psutil

    with suppress(psutil.NoSuchProcess):
        # Also those with a session of their own.
        descendants = psutil.Process(root).children(recursive=True)
        with suppress(ProcessLookupError):
            os.killpg(root, signal.SIGKILL)
        for process in descendants:
            with suppress(psutil.NoSuchProcess):
                process.kill()
        psutil.wait_procs(descendants, timeout=STOP_MARGIN_S)


def cpu_time_of(root: int) -> float:
    """Return the CPU time of a process and all of its child processes [s].

    0 if it has ended.
    """
    import psutil

    seconds = 0.0
    with suppress(psutil.NoSuchProcess):
        process = psutil.Process(root)
        for part in (process, *process.children(recursive=True)):
            with suppress(psutil.NoSuchProcess):
                # User, system, and those of ended child processes.
                seconds += sum(part.cpu_times()[:4])
    return seconds


def _cpu_time() -> float:
    """Return the CPU time of this process and of its ended child processes [s]."""
    children = resource.getrusage(resource.RUSAGE_CHILDREN)
    return time.process_time() + children.ru_utime + children.ru_stime


def serve(descriptor: int) -> None:
    """Prepare the planner whose name arrives on a pipe, then plan until the pipe is closed."""
    # A terminal sends it to all processes; the parent decides.
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    with Connection(descriptor) as pipe, suppress(EOFError, OSError):
        name, setting = pipe.recv()
        try:
            plan = load_planner(name, setting.parameters).prepare(setting)
        except Exception as error:  # noqa: BLE001 - a plug-in may raise any exception
            refuses = isinstance(error, CnpgenError)
            lacks = isinstance(error, MachineError)
            pipe.send((refuses, lacks, _message(error)))
            return
        pipe.send((False, False, ""))
        while True:
            pipe.send(_plan_once(plan, pipe.recv()))


def _plan_once(plan: Plan, problem: Plans) -> PlanningOutcome:
    """Plan for one problem and measure the time."""
    start = time.perf_counter()
    cpu = _cpu_time()
    try:
        # Times begin once the number of threads is set, which takes time itself.
        with one_thread():
            start = time.perf_counter()
            cpu = _cpu_time()
            try:
                answer = plan(problem)
            finally:
                seconds = time.perf_counter() - start
                cpu = _cpu_time() - cpu
        content = _content(answer, problem)
    except Exception as error:  # noqa: BLE001 - a plug-in may raise any exception
        return PlanningOutcome(Ending.FAILED, None, seconds, cpu, _message(error))
    return PlanningOutcome(
        Ending.NO_PLAN if content is None else Ending.PLANNED, content, seconds, cpu
    )


def _content(answer: Any, problem: Plans) -> JsonObject | None:
    """Return the stored form of an answer after checking that it can be read."""
    if answer is None:
        return None
    if not isinstance(answer, Plans | Trajectory) or (
        isinstance(answer, Plans) and len(answer) != 1
    ):
        raise UsageError(f"expected one plan, a Trajectory or None, got {answer!r:.60}")
    content = answer_to_dict(answer)
    # An answer that cannot be read fails here, with its problem, and not in a later
    # run.
    answer_from_dict(problem, content)
    return content


def _message(error: Exception) -> str:
    text = " ".join(str(error).split())
    return (
        text
        if text and isinstance(error, CnpgenError)
        else f"{type(error).__name__}: {text}"
    )
