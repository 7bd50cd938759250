"""A planner in a process of its own: what crashes, hangs or leaks there costs the problem that it happened at."""

import multiprocessing
import signal
import subprocess
import sys
import time
from contextlib import suppress
from dataclasses import dataclass
from enum import StrEnum
from multiprocessing.connection import Connection
from typing import Any

from cnpgen.benchmark.planner import Answer, Setting
from cnpgen.benchmark.trajectory import Trajectory
from cnpgen.errors import CnpgenError, UsageError
from cnpgen.machine.threads import one_thread
from cnpgen.plans.plans import Plans
from cnpgen.schema import registry

GRACE = 2.0  # times the limit, and
SPARE = 10.0  # s: a planner that has not answered after this is stopped
STARTING = 300.0  # s: to load what is loaded once, kernels compiled


class Ending(StrEnum):
    """How planning ended."""

    PLANNED = "planned"
    NO_PLAN = "no plan"
    FAILED = "failed"
    OUT_OF_TIME = "out of time"
    CRASHED = "crashed"


@dataclass(frozen=True)
class Attempt:
    """What became of one problem.

    Attributes:
        ending: How it ended.
        answer: The plan or the trajectory, if there is one.
        seconds: Wall time of planning [s].
        cpu_seconds: CPU time of planning [s].
        error: What the planner said, or empty.
    """

    ending: Ending
    answer: Answer = None
    seconds: float = 0.0
    cpu_seconds: float = 0.0
    error: str = ""


class PlannerProcess:
    """Plans in another process, which is started anew after it died or was stopped.

    Args:
        name: Name of the planner.
        setting: What it is told.
    """

    def __init__(self, name: str, setting: Setting) -> None:
        self._name, self._setting = name, setting
        self._process: subprocess.Popen[bytes] | None = None
        self._pipe: Connection | None = None

    def plan(self, problem: Plans) -> Attempt:
        """Let it plan for one problem.

        Raises:
            UsageError: It cannot plan for problems of this kind.
        """
        pipe = self._started()
        began = time.perf_counter()
        try:
            pipe.send(problem)
            if pipe.poll(GRACE * self._setting.time_limit + SPARE):
                found: Attempt = pipe.recv()
                return found
        except (EOFError, OSError):
            self.stop()
            return Attempt(Ending.CRASHED, seconds=time.perf_counter() - began, error="its process ended")
        self.stop()
        return Attempt(Ending.OUT_OF_TIME, seconds=time.perf_counter() - began, error="stopped: it did not answer")

    def stop(self) -> None:
        """End the process."""
        if self._process is not None:
            self._process.kill()
            self._process.wait()
        if self._pipe is not None:
            self._pipe.close()
        self._process = self._pipe = None

    def _started(self) -> Connection:
        if self._pipe is not None:
            return self._pipe
        self._pipe, theirs = multiprocessing.Pipe()
        with theirs:  # no multiprocessing.Process: workers of dask may not start one, and it runs the caller's script
            program = f"import sys; sys.path[:] = {sys.path!r}; from {__name__} import serve; serve({theirs.fileno()})"
            command = [sys.executable, "-c", program]
            self._process = subprocess.Popen(command, pass_fds=[theirs.fileno()], stdin=subprocess.DEVNULL)
        said: str | None = "it did not begin"
        with suppress(EOFError, OSError):
            self._pipe.send((self._name, self._setting))
            if self._pipe.poll(STARTING):
                said = self._pipe.recv()
        if said is not None:
            self.stop()
            raise UsageError(f"planner {self._name!r} cannot plan here: {said}")
        return self._pipe


def serve(descriptor: int) -> None:
    """Prepare the planner that is named through a pipe, and plan for what comes next, until it is closed.

    Args:
        descriptor: Of the pipe.
    """
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # a terminal sends it to all; the parent decides
    with Connection(descriptor) as pipe, suppress(EOFError, OSError):
        name, setting = pipe.recv()
        try:
            plan = registry.load(registry.PLANNERS, name)().prepare(setting)
        except Exception as error:  # noqa: BLE001 - somebody else's code may raise anything
            pipe.send(_said(error))
            return
        pipe.send(None)
        while True:
            pipe.send(_attempt(plan, pipe.recv()))


def _attempt(plan: Any, problem: Plans) -> Attempt:
    """Plan for one problem and take the time."""
    began, cpu = time.perf_counter(), time.process_time()
    answer, ending, error = None, Ending.FAILED, ""
    try:
        with one_thread():
            answer = plan(problem)
        ending, error = _ending_of(answer, problem)
    except Exception as found:  # noqa: BLE001 - likewise
        error = _said(found)
    seconds, cpu = time.perf_counter() - began, time.process_time() - cpu
    return Attempt(ending, answer if ending == Ending.PLANNED else None, seconds, cpu, error)


def _ending_of(answer: Any, problem: Plans) -> tuple[Ending, str]:
    """Say whether an answer is one, with the joints of the problem."""
    if answer is None:
        return Ending.NO_PLAN, ""
    if isinstance(answer, Plans) and len(answer) == 1:
        joints = answer.path_control_points.shape[2]
    elif isinstance(answer, Trajectory):
        joints = answer.q.shape[1]
    else:
        return Ending.FAILED, f"expected one plan, a Trajectory or None, got {answer!r:.60}"
    wanted = problem.boundary.start_q.shape[1]
    if joints != wanted:
        return Ending.FAILED, f"the problem has {wanted} joints, its answer {joints}"
    return Ending.PLANNED, ""


def _said(error: Exception) -> str:
    text = " ".join(str(error).split())
    return text if isinstance(error, CnpgenError) else f"{type(error).__name__}: {text}"
