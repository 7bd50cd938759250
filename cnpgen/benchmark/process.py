"""A planner in a process of its own: what crashes, hangs or leaks there costs the problem that it happened at."""

import multiprocessing
import signal
import time
from collections.abc import Iterator
from contextlib import contextmanager, suppress
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
        self._process: Any = None
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
            self._process.join()
        if self._pipe is not None:
            self._pipe.close()
        self._process = self._pipe = None

    def _started(self) -> Connection:
        if self._pipe is not None:
            return self._pipe
        context = multiprocessing.get_context("spawn")
        self._pipe, theirs = context.Pipe()
        self._process = context.Process(target=_serve, args=(theirs, self._name, self._setting), daemon=True)
        with _hidden_main():
            self._process.start()
        theirs.close()
        said: str | None = "it did not begin"
        with suppress(EOFError, OSError):
            if self._pipe.poll(STARTING):
                said = self._pipe.recv()
        if said is not None:
            self.stop()
            raise UsageError(f"planner {self._name!r} cannot plan here: {said}")
        return self._pipe


@contextmanager
def _hidden_main() -> Iterator[None]:
    """Keep the new process from importing the caller's script, which may have no guard against running twice."""
    import sys

    main = sys.modules["__main__"]
    kept = {name: getattr(main, name) for name in ("__file__", "__spec__") if hasattr(main, name)}
    for name in kept:
        setattr(main, name, None)
    try:
        yield
    finally:
        for name, value in kept.items():
            setattr(main, name, value)


def _serve(pipe: Connection, name: str, setting: Setting) -> None:
    """Prepare a planner and plan for what comes through the pipe, until it is closed."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # a terminal sends it to all; the parent decides
    try:
        plan = registry.load(registry.PLANNERS, name)().prepare(setting)
    except Exception as error:  # noqa: BLE001 - somebody else's code may raise anything
        pipe.send(_said(error))
        return
    pipe.send(None)
    with suppress(EOFError, OSError):
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
