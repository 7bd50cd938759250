"""Where kernels come from: SX builders, a cache of tapes and compiled libraries, and the backend that runs them."""

import ctypes
import hashlib
import inspect
import json
import warnings
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field
from functools import cache
from pathlib import Path
from typing import Any, Literal, Protocol

import numpy as np

from cnpgen.errors import MachineError, UsageError
from cnpgen.kernels.cache import (
    TAPES,
    default_cache_folder,
    is_trusted,
    keep_from_others,
    make_private,
    require_trusted,
    usable_folder,
)
from cnpgen.kernels.compiled import (
    CompiledGridKernel,
    CompiledKernel,
    compile_source,
    compile_tape,
)
from cnpgen.kernels.compiler import require_compiler
from cnpgen.kernels.grid import GridKernel
from cnpgen.kernels.interpreted import InterpretedGridKernel, InterpretedKernel
from cnpgen.kernels.kernel import Kernel
from cnpgen.kernels.mapped import MappedGridKernel, MappedKernel
from cnpgen.kernels.tape import CODES, Dtype, GridSpec, Loop, Tape, tape_from_function
from cnpgen.kernels.together import Compilers
from cnpgen.schema.registry import package_digest
from cnpgen.store.files.atomic import write_file

Backend = Literal["compiled", "numpy", "casadi"]
BACKENDS: tuple[Backend, ...] = ("compiled", "numpy", "casadi")
PACKAGE = Path(__file__).parents[1]
ROOMS = ("robots", "kernels", "problems", "trajectory")  # what builders of any room import
SLOWER = "10 to 20 times slower than compiled code"  # benchmarks/generator.py measures it: 9 to 24


@dataclass
class KernelLibrary:
    """Loads kernels for one robot and problem, building only what is not cached.

    Attributes:
        backend: "compiled", "numpy" (the tape interpreted) or "casadi" (its own map; slow, for reference).
        cache_folder: Where tapes and libraries are kept.
        identity: Digest of what builders read besides their parameters: of all ``arguments``.
        arguments: Named objects handed to builders that ask for them by parameter name (robot, problem).
    """

    backend: Backend
    cache_folder: Path
    identity: str
    arguments: Mapping[str, Any] = field(default_factory=dict)
    _compilers: Compilers | None = field(default=None, init=False, repr=False)

    def load(self, builder: Callable[..., Any], loop: Loop | None = None, **parameters: Any) -> Kernel:
        """Return the kernel of the SX function that ``builder`` builds.

        Args:
            builder: A module-level function that returns a ``casadi.Function``. Parameters named like entries of
                ``arguments`` are filled from there.
            loop: How to iterate it, or None.
            parameters: Further JSON-able keyword arguments of the builder; part of the cache key.
        """
        given = self._given(builder)
        if self.backend == "casadi":
            function = builder(**given, **parameters)
            return MappedKernel(tape_from_function(function, loop), function)
        tape = self._tape(builder, given, parameters, loop=loop)
        if self.backend == "numpy":
            return InterpretedKernel(tape)
        if self._compilers is not None:
            return self._compilers.kernel(tape)
        return CompiledKernel(tape, compile_tape(tape, self.cache_folder), self.cache_folder)

    @contextmanager
    def compiling_together(self) -> Iterator[None]:
        """Compile what is loaded inside side by side; afterwards all of it is there.

        Raises:
            MachineError: A compiler failed.
        """
        with Compilers(self.cache_folder) as compilers:
            self._compilers = compilers
            try:
                yield
            finally:
                self._compilers = None

    def load_grid(self, builder: Callable[..., Any], grid: GridSpec, *, dtype: Dtype, **parameters: Any) -> GridKernel:
        """Return the kernel that evaluates an SX function on a grid of nodes and lanes.

        Args:
            builder: As for ``load``.
            grid: What its arguments and results vary over.
            dtype: What it computes with.
            parameters: Further JSON-able keyword arguments of the builder; part of the cache key.
        """
        given = self._given(builder)
        if self.backend == "casadi":
            function = builder(**given, **parameters)
            return MappedGridKernel(tape_from_function(function, grid=grid, dtype=dtype), function)
        tape = self._tape(builder, given, parameters, grid=grid, dtype=dtype)
        if self.backend == "numpy":
            return InterpretedGridKernel(tape)
        return CompiledGridKernel(tape, compile_tape(tape, self.cache_folder))

    def load_source(self, *paths: Path) -> ctypes.CDLL | None:
        """Return the library of C source that was written by hand, or None where kernels are not compiled.

        Args:
            paths: Its files, as of ``compile_source``.
        """
        return ctypes.CDLL(str(compile_source(paths, self.cache_folder))) if self.backend == "compiled" else None

    def tape(self, builder: Callable[..., Any], **parameters: Any) -> Tape:
        """Return the operations of the SX function that ``builder`` builds; nothing is compiled.

        Args:
            builder: As for ``load``.
            parameters: Likewise.
        """
        return self._tape(builder, self._given(builder), parameters)

    def _given(self, builder: Callable[..., Any]) -> dict[str, Any]:
        wanted = inspect.signature(builder).parameters
        return {name: value for name, value in self.arguments.items() if name in wanted}

    def _tape(
        self,
        builder: Callable[..., Any],
        given: Mapping[str, Any],
        parameters: Mapping[str, Any],
        *,
        loop: Loop | None = None,
        grid: GridSpec | None = None,
        dtype: Dtype = "float64",
    ) -> Tape:
        identity = {
            "builder": f"{builder.__module__}.{builder.__qualname__}",
            "source": _source_digests(builder),
            "versions": _versions(),
            "problem": self.identity,
            "loop": [loop.tolerance, loop.limit] if loop else None,
            "grid": [grid.arguments, grid.results] if grid else None,
            "dtype": dtype,
            "parameters": parameters,
        }
        digest = hashlib.sha256(json.dumps(identity, sort_keys=True).encode()).hexdigest()
        name = f"{builder.__name__}-{digest[:24]}.npy"
        if (tape := self._cached(name)) is None:
            tape = tape_from_function(builder(**given, **parameters), loop, grid=grid, dtype=dtype)
            self._keep(name, tape)
        return tape

    def _cached(self, name: str) -> Tape | None:
        """Return a tape that is in the cache; damaged ones, and those that others may have changed, do not count."""
        for folder in require_trusted(self.cache_folder):
            path = folder / TAPES / name
            with suppress(OSError, ValueError):
                if is_trusted(path):
                    return Tape.from_bytes(path.read_bytes())
        return None

    def _keep(self, name: str, tape: Tape) -> None:
        """Write a tape to the cache; one that cannot be written only costs time."""
        path = self.cache_folder / TAPES / name
        with suppress(MachineError, OSError):
            make_private(path.parent)
            write_file(path, tape.to_bytes())
            keep_from_others(path)


@cache
def _versions() -> list[str]:
    import importlib.metadata

    return [importlib.metadata.version(name) for name in ("casadi", "pin")]


def _source_digests(builder: Callable[..., Any]) -> list[str]:
    """Digests of what a builder may be made of: kernels are rebuilt when one of them changes.

    In this package these are ``ROOMS`` and the builder's own room. A plug-in's builder may import anything, so that all
    of this package counts, and all of its own.
    """
    package, _, module = builder.__module__.partition(".")
    if package != "cnpgen":
        return [_digest_of(PACKAGE), package_digest(package)]
    return [_digest_of(*(PACKAGE / room for room in ROOMS)), _digest_of(PACKAGE / module.partition(".")[0])]


@cache
def _digest_of(*folders: Path) -> str:
    """Digest of all Python files of folders and of the folders in them; 40 files take 2 ms."""
    digest = hashlib.sha256()
    for path in (path for folder in folders for path in sorted(folder.rglob("*.py"))):
        digest.update(path.relative_to(PACKAGE).as_posix().encode() + b"\0" + path.read_bytes())
    return digest.hexdigest()


class Identified(Protocol):
    """What kernels are built for: a problem."""

    @property
    def identity(self) -> str:
        """The sha256 over all that they depend on."""


def problem_kernels(problem: Identified, robot: object, backend: Backend, cache_folder: Path) -> KernelLibrary:
    """Return the library of a problem: what is built of it and its robot is cached under the problem's identity."""
    return KernelLibrary(backend, cache_folder, problem.identity, {"robot": robot, "problem": problem})


def choose_backend(wanted: str | None = None) -> tuple[Backend, Path]:
    """Decide which backend runs and where its cache is; warn once where it is not the fastest.

    Args:
        wanted: A backend, or None for the fastest that works on this machine.

    Returns:
        ``(backend, cache folder)``.

    Raises:
        UsageError: There is no such backend.
        MachineError: The backend was asked for and does not work here.
    """
    if wanted is not None and wanted not in BACKENDS:
        raise UsageError(f"backend {wanted!r} does not exist: expected one of {', '.join(BACKENDS)}")
    folder = usable_folder(default_cache_folder())
    if wanted == "numpy":
        return "numpy", folder
    if wanted == "casadi":
        return "casadi", folder
    try:
        _try_compiler(folder)
    except MachineError as error:
        if wanted == "compiled":
            raise
        warnings.warn(f"{error}; running on the NumPy backend, {SLOWER}", RuntimeWarning, stacklevel=2)
        return "numpy", folder
    return "compiled", folder


def _try_compiler(folder: Path) -> None:
    """Compile, load and run the smallest kernel; raise MachineError where that does not work."""
    require_compiler()
    codes = np.array([CODES["INPUT"], CODES["TWICE"], CODES["OUTPUT"]], np.int16)
    operands = np.array([0, 0, 1], np.int32)
    tape = Tape("selftest", (1,), (1,), codes, operands, np.zeros(3, np.int32), np.zeros(3))
    kernel = CompiledKernel(tape, compile_tape(tape, folder), folder)
    (result,) = kernel(np.arange(5.0)[None])
    if not np.array_equal(result[0], 2 * np.arange(5.0)):
        raise MachineError("the C compiler makes wrong code: 2 x differs from x + x")
