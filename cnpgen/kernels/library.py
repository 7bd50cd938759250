"""The library of kernels: SX builders, a cache of tapes and compiled libraries, and the choice of the backend."""

import ctypes
import hashlib
import inspect
import json
import warnings
from collections.abc import Callable, Mapping
from contextlib import suppress
from dataclasses import dataclass, field, replace
from functools import cache
from pathlib import Path
from typing import Any, Literal, Protocol

import numpy as np

from cnpgen.errors import MachineError, UsageError
from cnpgen.kernels.c_library import ARRAYS, load_library
from cnpgen.kernels.compiled_kernel import CompiledGridKernel, CompiledKernel
from cnpgen.kernels.interpreted_kernel import InterpretedGridKernel, InterpretedKernel
from cnpgen.kernels.kernel import GridKernel, Kernel
from cnpgen.kernels.shipped_tapes import find_shipped
from cnpgen.kernels.tape import CODES, Dtype, GridSpec, Loop, Tape, tape_from_function
from cnpgen.schema import addons, registry
from cnpgen.schema.registry import package_digest
from cnpgen.store.files.atomic import write_file
from cnpgen.store.files.cache_folder import (
    TAPES,
    default_cache_folder,
    is_trusted,
    make_private_folder,
    make_read_only_for_others,
    require_trusted,
    usable_cache_folder,
)

Backend = Literal["compiled", "numpy"]
BACKENDS: tuple[Backend, ...] = ("compiled", "numpy")
PACKAGE_FOLDER = Path(__file__).parents[1]
# Imported by builders of any package.
BUILDER_PACKAGES = "robots", "kernels", "problems", "trajectory"
# Benchmarks/generator.py: 9 to 24.
NUMPY_SLOWDOWN = "10 to 20 times slower than compiled code"


@dataclass
class KernelLibrary:
    """Loader of kernels for one robot and problem, which builds those that are not cached.

    Attributes:
        backend: "compiled", or "numpy" (interpreted tape).
        cache_folder: Folder of cached tapes and libraries.
        identity: Digest of all ``arguments``.
        arguments: Objects passed to builders that have a parameter of that name (robot,
            problem).
        structure: Digest of the arguments without the poses and sizes of obstacles, or
            None; see ``load_by_structure``.
    """

    backend: Backend
    cache_folder: Path
    identity: str
    arguments: Mapping[str, Any] = field(default_factory=dict)
    structure: str | None = None

    def load_by_structure(
        self, builder: Callable[..., Any], **parameters: Any
    ) -> Kernel:
        """Return the kernel of an SX function that reads poses and sizes of obstacles from its arguments only.

        Problems that differ only in these numbers share its tape; see ``load``.
        """
        return replace(self, identity=self.structure or self.identity).load(
            builder, **parameters
        )

    def load(
        self, builder: Callable[..., Any], loop: Loop | None = None, **parameters: Any
    ) -> Kernel:
        """Return the kernel of an SX function.

        Args:
            builder: A module-level function that returns a ``casadi.Function``.
                Parameters named like entries of ``arguments`` are filled from there.
            loop: The iteration of the function, or None.
            parameters: Further JSON-able keyword arguments of the builder; part of the
                cache key.
        """
        tape = self._tape(builder, parameters, loop=loop)
        if self.backend == "numpy":
            return InterpretedKernel(tape)
        return CompiledKernel(tape, self.cache_folder)

    def load_grid(
        self,
        builder: Callable[..., Any],
        grid: GridSpec,
        *,
        dtype: Dtype,
        **parameters: Any,
    ) -> GridKernel:
        """Return the kernel that evaluates an SX function on a grid of nodes and lanes, in a type; see ``load``."""
        tape = self._tape(builder, parameters, grid=grid, dtype=dtype)
        if self.backend == "numpy":
            return InterpretedGridKernel(tape)
        return CompiledGridKernel(tape, self.cache_folder)

    def load_source(self, *paths: Path) -> ctypes.CDLL:
        """Return the library of C source that follows ``arrays.h``, see ``load_library``."""
        return load_library((ARRAYS, *paths), self.cache_folder)

    def tape(self, builder: Callable[..., Any], **parameters: Any) -> Tape:
        """Return the tape of an SX function without compiling it; see ``load``."""
        return self._tape(builder, parameters)

    def _build(self, builder: Callable[..., Any], parameters: Mapping[str, Any]) -> Any:
        """Return the SX function."""
        expected = inspect.signature(builder).parameters
        return builder(
            **{
                name: value
                for name, value in self.arguments.items()
                if name in expected
            },
            **parameters,
        )

    def _tape(
        self,
        builder: Callable[..., Any],
        parameters: Mapping[str, Any],
        *,
        loop: Loop | None = None,
        grid: GridSpec | None = None,
        dtype: Dtype = "float64",
    ) -> Tape:
        identity = {
            "builder": f"{builder.__module__}.{builder.__qualname__}",
            "source": _source_digests(builder),
            "problem": self.identity,
            "loop": [loop.tolerance, loop.limit] if loop else None,
            "grid": [grid.arguments, grid.results] if grid else None,
            "dtype": dtype,
            "parameters": parameters,
        }
        # The tapes of the package do not depend on the installed CasADi.
        if (tape := find_shipped(_key(builder, identity))) is not None:
            return tape
        name = f"{_key(builder, identity | {'versions': _versions()})}.npy"
        if (tape := self._cached(name)) is None:
            tape = tape_from_function(
                self._build(builder, parameters), loop, grid=grid, dtype=dtype
            )
            self._store(name, tape)
        return tape

    def _cached(self, name: str) -> Tape | None:
        """Return a tape from the cache, or None.

        Damaged and untrusted files are ignored.
        """
        for folder in require_trusted(self.cache_folder):
            path = folder / TAPES / name
            with suppress(OSError, ValueError):
                if is_trusted(path):
                    return Tape.from_bytes(path.read_bytes())
        return None

    def _store(self, name: str, tape: Tape) -> None:
        """Write a tape to the cache.

        A failure is ignored, because it only costs time.
        """
        path = self.cache_folder / TAPES / name
        with suppress(MachineError, OSError):
            make_private_folder(path.parent)
            write_file(path, tape.to_bytes())
            make_read_only_for_others(path)


def _key(builder: Callable[..., Any], identity: Mapping[str, Any]) -> str:
    """Return the name of a tape: that of its builder and a digest of its identity."""
    digest = hashlib.sha256(json.dumps(identity, sort_keys=True).encode()).hexdigest()
    return f"{builder.__name__}-{digest[:24]}"


@cache
def _versions() -> list[str]:
    import importlib.metadata

    return [importlib.metadata.version(name) for name in ("casadi", "pin")]


def _source_digests(builder: Callable[..., Any]) -> list[str]:
    """Return digests of the sources that a builder may use; kernels are rebuilt when one of them changes.

    In the core these are ``BUILDER_PACKAGES`` and the builder's own subpackage; losses
    also use the conditions of published rules. The builder of an add-on or a plug-in may
    import anything: the digests cover this package and the plug-in's.
    """
    module = builder.__module__
    # A builder of another distribution depends on all of this package and on its own
    # one.
    if module.partition(".")[0] != "cnpgen":
        return [_digest_of(PACKAGE_FOLDER), package_digest(module.partition(".")[0])]
    # A builder of an add-on may use any module of the package.
    if addons.addon_of(module):
        return [_digest_of(PACKAGE_FOLDER)]
    shared = (PACKAGE_FOLDER / name for name in BUILDER_PACKAGES)
    own = subpackage_of(module)
    digests = [_digest_of(*shared), _digest_of(PACKAGE_FOLDER / own)]
    # Losses also depend on published rules, which other packages may install.
    return digests + _rules_digests() if own == "losses" else digests


def subpackage_of(module: str) -> str:
    """Return the path of the subpackage of a module of this package: "refine", "addons/benchmark"."""
    if addon := addons.addon_of(module):
        return f"addons/{addon}"
    return module.split(".")[1]


def _rules_digests() -> list[str]:
    """Return digests of the sources of all installed published rules."""
    modules = [entry.module for entry in addons.installed(registry.RULES)]
    own = [PACKAGE_FOLDER / subpackage_of(m) for m in modules if addons.addon_of(m)]
    others = {m.partition(".")[0] for m in modules if not addons.addon_of(m)}
    return [_digest_of(*own), *map(package_digest, sorted(others))]


@cache
def _digest_of(*folders: Path) -> str:
    """Return the digest of all Python files below the folders; 40 files take 2 ms."""
    digest = hashlib.sha256()
    for path in (path for folder in folders for path in sorted(folder.rglob("*.py"))):
        digest.update(
            path.relative_to(PACKAGE_FOLDER).as_posix().encode()
            + b"\0"
            + path.read_bytes()
        )
    return digest.hexdigest()


class Identified(Protocol):
    """A problem that kernels are built for."""

    @property
    def identity(self) -> str:
        """SHA-256 digest of everything that its kernels depend on."""

    @property
    def structure(self) -> str | None:
        """Digest of the same without poses and sizes of obstacles, or None if kernels may depend on those."""


def problem_kernels(
    problem: Identified, robot: object, backend: Backend, cache_folder: Path
) -> KernelLibrary:
    """Return the kernel library of a problem and its robot, cached under the problem's identity."""
    arguments = {"robot": robot, "problem": problem}
    return KernelLibrary(
        backend, cache_folder, problem.identity, arguments, problem.structure
    )


def choose_backend(requested: str | None = None) -> tuple[Backend, Path]:
    """Choose the backend and the cache folder; warn once if the backend is not the fastest.

    Args:
        requested: A backend, or None for the fastest that works on this machine.

    Returns:
        ``(backend, cache folder)``.

    Raises:
        UsageError: There is no such backend.
        MachineError: The requested backend does not work on this machine.
    """
    if requested not in {None, *BACKENDS}:
        raise UsageError(
            f"backend {requested!r} does not exist: expected one of {', '.join(BACKENDS)}",
            concerns="backend",
        )
    folder = usable_cache_folder(default_cache_folder())
    if requested == "numpy":
        return requested, folder
    try:
        _try_generator(folder)
    except MachineError as error:
        if requested == "compiled":
            raise
        text = f"{error}; running on the NumPy backend, {NUMPY_SLOWDOWN} ('cnpgen docs troubleshooting')"
        warnings.warn(text, RuntimeWarning, stacklevel=2)
        return "numpy", folder
    return "compiled", folder


def _try_generator(folder: Path) -> None:
    """Generate, load and run the smallest kernel; raise MachineError if that fails."""
    codes = np.array([CODES["INPUT"], CODES["TWICE"], CODES["OUTPUT"]], np.int16)
    operands = np.array([0, 0, 1], np.int32)
    tape = Tape(
        "selftest", (1,), (1,), codes, operands, np.zeros(3, np.int32), np.zeros(3)
    )
    kernel = CompiledKernel(tape, folder)
    (result,) = kernel(np.arange(5.0)[None])
    if not np.array_equal(result[0], 2 * np.arange(5.0)):
        raise MachineError("LLVM generates wrong code: 2 x differs from x + x")
