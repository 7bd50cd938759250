"""Kernels that are compiled side by side: they are independent of each other, and most machines have several cores."""

import os
from functools import cached_property
from pathlib import Path
from types import TracebackType
from typing import TYPE_CHECKING

from cnpgen.kernels.compiled import CompiledKernel, compile_tape, find_compiled
from cnpgen.kernels.kernel import Array, Kernel
from cnpgen.kernels.tape import Tape

if TYPE_CHECKING:
    from concurrent.futures import Future, ThreadPoolExecutor

MOST = 8  # compilers at once: each takes some 100 MB


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
        """Where its machine code begins, once it is compiled; see ``Kernel``."""
        return self._compiled.address


class Compilers:
    """Compiles tapes in the background, equal ones once; at the end of its ``with`` block all of them are compiled.

    Args:
        cache_folder: Where libraries are kept.
    """

    def __init__(self, cache_folder: Path) -> None:
        self._folder = cache_folder
        self._pool: ThreadPoolExecutor | None = None
        self._jobs: dict[bytes, Future[Path]] = {}

    def kernel(self, tape: Tape) -> Kernel:
        """Return the kernel of a tape, which may still have to be compiled.

        Raises:
            MachineError: There is no working compiler or the cache folder cannot be used.
        """
        if found := find_compiled(tape, self._folder):
            return CompiledKernel(tape, found, self._folder)
        key = tape.to_bytes()
        if key not in self._jobs:
            self._jobs[key] = self._threads().submit(compile_tape, tape, self._folder)
        return PendingKernel(tape, self._jobs[key], self._folder)

    def _threads(self) -> "ThreadPoolExecutor":
        from concurrent.futures import ThreadPoolExecutor

        if self._pool is None:  # where everything is cached no thread is started
            self._pool = ThreadPoolExecutor(min(os.cpu_count() or 1, MOST))
        return self._pool

    def __enter__(self) -> "Compilers":
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        """Wait for all; after an error, or where one of them fails, start no more.

        Raises:
            MachineError: A compiler failed.
        """
        try:
            if kind is None:
                for job in self._jobs.values():
                    job.result()
        finally:
            if self._pool is not None:
                self._pool.shutdown(cancel_futures=True)
