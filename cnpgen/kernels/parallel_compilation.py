"""Parallel compilation of kernels, which are independent of each other."""

import os
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING

from cnpgen.kernels.compiled_kernel import CompiledKernel, compile_tape, find_compiled
from cnpgen.kernels.compiler import kill_compilers
from cnpgen.kernels.kernel import Array, Kernel
from cnpgen.kernels.tape import Tape

if TYPE_CHECKING:
    from concurrent.futures import Future

# A thread may start its compiler just after the others were killed.

_KILL_INTERVAL_S = 0.05
MAX_COMPILERS = 8  # compilers at the same time: each takes some 100 MB


class PendingKernel(Kernel):
    """A kernel whose library is still being compiled; the first call waits for it."""

    def __init__(self, tape: Tape, library: "Future[Path]", cache_folder: Path) -> None:
        super().__init__(tape)
        self._library, self._folder = library, cache_folder

    @cached_property
    def _compiled(self) -> CompiledKernel:
        return CompiledKernel(self.tape, self._library.result(), self._folder)

    def __call__(self, *arguments: Array) -> list[Array]:
        """Evaluate every lane; see ``Kernel``."""
        return self._compiled(*arguments)

    @property
    def address(self) -> int | None:
        """Address of the machine code; waits for its compilation. See ``Kernel``."""
        return self._compiled.address


class CompilerPool:
    """Threads that compile tapes, equal ones once; their user closes it."""

    def __init__(self, cache_folder: Path) -> None:
        from concurrent.futures import ThreadPoolExecutor

        self._folder, self._jobs = cache_folder, dict[bytes, "Future[Path]"]()
        self._pool = ThreadPoolExecutor(
            min(os.cpu_count() or 1, MAX_COMPILERS)
        )  # it starts threads on use

    def kernel(self, tape: Tape) -> Kernel:
        """Return the kernel of a tape; its compilation may still be pending.

        Raises:
            MachineError: There is no working compiler or the cache folder is unusable.
        """
        if library := find_compiled(tape, self._folder):
            return CompiledKernel(tape, library, self._folder)
        key = tape.to_bytes()
        if key not in self._jobs:
            self._jobs[key] = self._pool.submit(compile_tape, tape, self._folder)
        return PendingKernel(tape, self._jobs[key], self._folder)

    def wait(self) -> None:
        """Wait for all compilations.

        Raises:
            MachineError: A compiler failed.
        """
        for job in self._jobs.values():
            job.result()

    def close(self) -> None:
        """End the threads; after an error or an interruption, end compilations that are running or waiting."""
        from concurrent.futures import wait

        self._pool.shutdown(wait=False, cancel_futures=True)
        while running := [
            job for job in self._jobs.values() if not job.done()
        ]:  # canceled jobs are done
            kill_compilers()
            wait(running, timeout=_KILL_INTERVAL_S)
