"""Final code in the background: a detached process generates it, and a thread replaces the first code.

The process holds a lock, so that there is one per cache; it ends when no request is left.
"""

import ctypes
import os
import sys
import threading
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path

from cnpgen.errors import MachineError
from cnpgen.kernels.code_cache import (
    REQUEST,
    final_text,
    find_final,
    store,
    tape_key,
)
from cnpgen.kernels.machine_code import (
    FINAL,
    LoadedCode,
    generate,
    set_background_options,
)
from cnpgen.kernels.tape import Tape
from cnpgen.store.files.cache_folder import LIBRARIES, is_trusted, trust_problem
from cnpgen.store.files.file_lock import try_lock, unlock

CHECK_INTERVAL_S = 0.1
MAX_STARTS = 3  # of the process by one command, so that a broken one is not started again and again
NICENESS = 5  # the command itself comes first
LOCK_NAME = ".optimizer.lock"
START = "import sys; sys.path[:] = sys.argv[2:]; from cnpgen.kernels.optimizer import main; main()"


@dataclass(frozen=True)
class Replacement:
    """First code that waits for final code.

    Attributes:
        key: Name of the final code.
        request: Path of the request.
        code: The first code.
        cache_folder: Where the final code will be.
    """

    key: str
    request: Path
    code: LoadedCode
    cache_folder: Path


class Replacer:
    """The thread of a process that replaces first code as soon as final code is cached."""

    def __init__(self) -> None:
        self._waiting: list[Replacement] = []
        self._mutex = threading.Lock()
        self._thread: threading.Thread | None = None
        self._processes: list[int] = []  # their identifiers

    def add(self, replacement: Replacement) -> None:
        """Wait for the final code of a kernel."""
        with self._mutex:
            self._waiting.append(replacement)
            self._start_process(replacement)
            self._start_thread()

    def wait(self, seconds: float) -> bool:
        """Wait until all code is final; return whether it is."""
        thread = self._thread
        if thread is not None:
            thread.join(seconds)
        return not self._waiting

    def _start_thread(self) -> None:
        if self._thread is None and self._waiting:
            self._thread = threading.Thread(
                target=self._run, name="cnpgen-kernels", daemon=True
            )
            self._thread.start()

    def _run(self) -> None:
        interval = threading.Event()
        # The mutex is held at every change, so that a fork never copies half a
        # replacement.
        while True:
            with self._mutex:
                self._waiting = [one for one in self._waiting if not self._done(one)]
                if not self._waiting:
                    self._thread = None
                    return
            interval.wait(CHECK_INTERVAL_S)

    def _done(self, replacement: Replacement) -> bool:
        """Replace code if its final code is there; return whether waiting has ended."""
        # Before the search: it is removed last.
        requested = replacement.request.exists()
        try:
            code = find_final(replacement.key, replacement.cache_folder)
        except MachineError:
            # The cache is not trusted any more.
            return True
        if code is not None:
            # One aligned store of the address: ``dispatch`` loads it atomically, so
            # calls in other threads run either the first or the final code, which give
            # equal bits.
            target = ctypes.c_void_p.from_address(replacement.code.address("target"))
            target.value = code.address("kernel")
            self._processes = [one for one in self._processes if _runs(one)]
            return True
        # Without a request the process has finished or failed; then the first code
        # stays.
        return not requested or not self._start_process(replacement)

    def _start_process(self, replacement: Replacement) -> bool:
        """Start the process unless it runs; return False if it was started too often."""
        if any(map(_runs, self._processes)):
            return True
        # Another command's process serves the same cache.
        with optimizer_lock(replacement.request.parent) as free:
            if not free:
                return True
        if len(self._processes) == MAX_STARTS:
            return False
        with suppress(OSError):
            self._processes.append(_start(replacement.cache_folder.absolute()))
            return True
        return False

    def before_fork(self) -> None:
        """Finish the present replacement."""
        self._mutex.acquire()

    def after_fork_in_parent(self) -> None:
        """Go on."""
        self._mutex.release()

    def after_fork_in_child(self) -> None:
        """Start the thread again, which a forked process lacks; the parent's processes are not its own."""
        self._thread = None
        self._processes = []
        self._mutex.release()
        self._start_thread()


def _start(cache_folder: Path) -> int:
    """Start the detached process of a cache; it outlives this one, unlike a child of ``subprocess``."""
    command = [sys.executable, "-c", START, str(cache_folder), *sys.path]
    nothing = [
        (os.POSIX_SPAWN_OPEN, stream, os.devnull, os.O_RDWR, 0) for stream in range(3)
    ]
    return os.posix_spawn(
        sys.executable, command, os.environ, file_actions=nothing, setsid=True
    )


def _runs(process: int) -> bool:
    """Return whether a process that this one has started still runs."""
    try:
        return os.waitpid(process, os.WNOHANG) == (0, 0)
    except ChildProcessError:
        return False


replacer = Replacer()
os.register_at_fork(
    before=replacer.before_fork,
    after_in_parent=replacer.after_fork_in_parent,
    after_in_child=replacer.after_fork_in_child,
)


@contextmanager
def optimizer_lock(folder: Path) -> Iterator[bool]:
    """Hold the lock of a folder's process in the block if it is free; yield whether it is."""
    with (folder / LOCK_NAME).open("ab") as file:
        free = try_lock(file)
        try:
            yield free
        finally:
            if free:
                unlock(file)


def main() -> None:
    """Generate final code for the requests of a cache folder, the smallest first."""
    folder = Path(sys.argv[1])
    with suppress(OSError, MachineError):
        os.nice(NICENESS)
        with optimizer_lock(folder / LIBRARIES) as free:
            if free and not trust_problem(folder):
                set_background_options()
                while request := _next_request(folder / LIBRARIES):
                    fulfil(request, folder)


def _next_request(libraries: Path) -> Path | None:
    requests = [path for path in libraries.glob(f"*{REQUEST}") if is_trusted(path)]
    return min(requests, key=lambda path: path.stat().st_size, default=None)


def fulfil(request: Path, folder: Path) -> None:
    """Store the final code of a request and remove the request, also if it is damaged."""
    try:
        tape = Tape.from_bytes(request.read_bytes())
        key = request.name.removesuffix(REQUEST)
        # The name must be the key of the content: a renamed file would otherwise serve
        # its code to another tape.
        if key == tape_key(tape) and find_final(key, folder) is None:
            store(key, generate(final_text(tape), FINAL), folder)
    except ValueError:  # a damaged request
        pass
    finally:
        request.unlink(missing_ok=True)
