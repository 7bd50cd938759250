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

from cnpgen.benchmark.benchmark_planner import Plan, Setting
from cnpgen.benchmark.results import answer_from_dict, answer_to_dict
from cnpgen.benchmark.trajectory import Trajectory
from cnpgen.errors import CnpgenError, MachineError, UsageError
from cnpgen.machine.threads import one_thread
from cnpgen.plans.plans import Plans
from cnpgen.schema import registry

GRACE = 2.0  # times the limit, and
SPARE = 10.0  # s: a planner that has not answered after this is stopped
STARTING = 300.0  # s: to load what is loaded once, kernels compiled
STDERR = 2  # the file descriptor


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
        answer: The plan or the trajectory as results keep it, if there is one: nothing of the planner's own is in it.
        seconds: Wall time of planning [s].
        cpu_seconds: CPU time of planning [s].
        error: What the planner said, or empty.
    """

    ending: Ending
    answer: dict[str, Any] | None = None
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
        self._unprepared: Attempt | None = None

    def plan(self, problem: Plans) -> Attempt:
        """Let it plan for one problem.

        Raises:
            UsageError: It says that it cannot plan for problems of this kind.
            MachineError: It says what this machine lacks.
        """
        if self._unprepared is None and self._pipe is None:
            self._unprepared = self._start()
        if self._unprepared is not None:
            return self._unprepared
        began = time.perf_counter()
        try:
            assert self._pipe is not None
            self._pipe.send(problem)
            if self._pipe.poll(GRACE * self._setting.time_limit + SPARE):
                found: Attempt = self._pipe.recv()
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

    def _start(self) -> Attempt | None:
        """Start the process; return what becomes of all problems if the planner does not get ready."""
        began = time.perf_counter()
        self._pipe, theirs = multiprocessing.Pipe()
        with theirs:  # no multiprocessing.Process: workers of dask may not start one, and it runs the caller's script
            program = f"import sys; sys.path[:] = {sys.path!r}; from {__name__} import serve; serve({theirs.fileno()})"
            command = [sys.executable, "-c", program]
            self._process = subprocess.Popen(  # what planners print is no data
                command, pass_fds=[theirs.fileno()], stdin=subprocess.DEVNULL, stdout=STDERR
            )
        refusal, said = None, "its process ended, or it did not get ready"
        with suppress(EOFError, OSError):
            self._pipe.send((self._name, self._setting))
            if self._pipe.poll(STARTING):
                refusal, said = self._pipe.recv()
        if not said:
            return None
        self.stop()
        if refusal is not None:
            raise refusal(f"planner {self._name!r} cannot plan here: {said}")
        return Attempt(Ending.CRASHED, seconds=time.perf_counter() - began, error=f"before the first problem: {said}")


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
            pipe.send((_refusal(error), _said(error)))
            return
        pipe.send((None, ""))
        while True:
            pipe.send(_attempt(plan, pipe.recv()))


def _attempt(plan: Plan, problem: Plans) -> Attempt:
    """Plan for one problem and take the time."""
    began, cpu = time.perf_counter(), time.process_time()
    try:
        try:
            with one_thread():
                answer = plan(problem)
        finally:
            seconds, cpu = time.perf_counter() - began, time.process_time() - cpu
        content = _content(answer, problem)
    except Exception as error:  # noqa: BLE001 - likewise
        return Attempt(Ending.FAILED, None, seconds, cpu, _said(error))
    return Attempt(Ending.NO_PLAN if content is None else Ending.PLANNED, content, seconds, cpu)


def _content(answer: Any, problem: Plans) -> dict[str, Any] | None:
    """Return an answer as results keep it, if it is one that can be read back."""
    if answer is None:
        return None
    if not isinstance(answer, Plans | Trajectory) or (isinstance(answer, Plans) and len(answer) != 1):
        raise UsageError(f"expected one plan, a Trajectory or None, got {answer!r:.60}")
    content = answer_to_dict(answer)
    answer_from_dict(problem, content)
    return content


def _refusal(error: Exception) -> type[CnpgenError] | None:
    """Return what the user gets who asked for a planner that says that it cannot plan; None if it just failed."""
    if not isinstance(error, CnpgenError):
        return None
    return MachineError if isinstance(error, MachineError) else UsageError


def _said(error: Exception) -> str:
    text = " ".join(str(error).split())
    return text if text and isinstance(error, CnpgenError) else f"{type(error).__name__}: {text}"
