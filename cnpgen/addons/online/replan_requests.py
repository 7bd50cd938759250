"""Requests that are planned in the background, one after the other, by a thread that never delays the end of the process."""

from __future__ import annotations

import threading
from collections import deque
from collections.abc import Callable
from concurrent.futures import Future, InvalidStateError
from contextlib import suppress
from dataclasses import dataclass, field

from cnpgen.addons.online.switches import Switch, SwitchOutcome
from cnpgen.errors import UsageError


@dataclass(eq=False)
class _Request:
    """A request for the state at a time [s]."""

    serve: Callable[[], Switch]
    at: float
    future: Future[Switch] = field(default_factory=Future)


class ReplanRequests:
    """A queue of requests and the thread that serves them, which is started with the first request."""

    def __init__(self) -> None:
        self._changed = threading.Condition()
        self._waiting: deque[_Request] = deque()
        self._running: _Request | None = None
        self._thread: threading.Thread | None = None
        self._closed = False

    def submit(self, serve: Callable[[], Switch], at: float) -> Future[Switch]:
        """Add a request; its future has the result of ``serve``.

        Raises:
            UsageError: The queue is closed.
        """
        request = _Request(serve, at)
        with self._changed:
            if self._closed:
                raise UsageError("the runtime is closed, so it cannot plan")
            self._waiting.append(request)
            if self._thread is None:
                # A daemon: a planner that hangs must not keep the process alive.
                self._thread = threading.Thread(
                    target=self._serve_all, name="cnpgen-replan", daemon=True
                )
                self._thread.start()
            self._changed.notify()
        return request.future

    def refuse_waiting(self, outcome: SwitchOutcome) -> None:
        """Resolve all requests that have not begun."""
        with self._changed:
            waiting = self._waiting
            self._waiting = deque()
        for request in waiting:
            _resolve(request, Switch(outcome, request.at))

    def close(self, timeout: float) -> bool:
        """Refuse all requests and wait at most a time [s] for the one that is served; return whether it has ended."""
        with self._changed:
            self._closed = True
            thread = self._thread
            self._changed.notify()
        self.refuse_waiting(SwitchOutcome.CLOSED)
        if thread is None or thread is threading.current_thread():
            return True
        thread.join(timeout)
        with self._changed:
            running = self._running
        if running is not None:
            _resolve(running, Switch(SwitchOutcome.CLOSED, running.at))
        return not thread.is_alive()

    def _serve_all(self) -> None:
        """Serve requests until the queue is closed."""
        while True:
            with self._changed:
                self._running = None
                self._changed.wait_for(lambda: self._waiting or self._closed)
                if not self._waiting:
                    return
                request = self._running = self._waiting.popleft()
            if request.future.set_running_or_notify_cancel():
                _resolve(request, request.serve())


def _resolve(request: _Request, result: Switch) -> None:
    """Set the result of a request, unless it has one or was cancelled."""
    with suppress(InvalidStateError):
        request.future.set_result(result)
