"""Kernels as shared libraries: compiled once with the machine's C compiler, cached by content."""

import ctypes
import hashlib
import logging
import shlex
import tempfile
from collections.abc import Callable, Sequence
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np

from cnpgen.errors import MachineError
from cnpgen.kernels.cache import (
    LIBRARIES,
    is_trusted,
    keep_from_others,
    make_private,
    one_at_a_time,
    require_trusted,
    warm_folder,
)
from cnpgen.kernels.compiler import compiler_version, flags_of, require_compiler, run_compiler, target
from cnpgen.kernels.emit import VECTORS, emit, prelude
from cnpgen.kernels.grid import GridKernel, check_grid
from cnpgen.kernels.kernel import Array, Kernel, check_arguments
from cnpgen.kernels.tape import Tape

CALL = Path(__file__).with_name("call.c")
LINE = 8  # numbers in a line of the cache
LONG = 6000  # instructions: above, GCC's register allocator takes minutes at -O2 and gains nothing
_LOG = logging.getLogger(__name__)


class _Callee(ctypes.Structure):
    """``callee`` of call.c."""

    _fields_ = (
        ("kernel", ctypes.c_void_p),
        ("inputs", ctypes.c_long),
        ("outputs", ctypes.c_long),
        ("widths", ctypes.POINTER(ctypes.c_long)),
    )


class CompiledKernel(Kernel):
    """A tape as machine code.

    Args:
        tape: The tape.
        library: Its library.
        cache_folder: Where libraries are kept, for the one that calls kernels.
    """

    def __init__(self, tape: Tape, library: Path, cache_folder: Path) -> None:
        super().__init__(tape)
        self._address = ctypes.cast(_load(library), ctypes.c_void_p).value
        sizes = len(tape.inputs), len(tape.outputs)
        widths = (ctypes.c_long * sum(sizes))(*tape.inputs, *tape.outputs)
        self._callee, self._call = _Callee(self._address, *sizes, widths), _load_call(cache_folder)

    def __call__(self, *arguments: Array) -> list[Array]:
        """Evaluate the batch; see ``Kernel``."""
        n = arguments[0].shape[-1]
        results = [np.empty((width, n)) for width in self.tape.outputs]
        if not self._call(self._callee, arguments, results):
            check_arguments(self.tape, arguments)
            raise ValueError(f"kernel {self.tape.name}: arguments must be NumPy arrays")
        return results

    @property
    def address(self) -> int | None:
        """Where its machine code begins; see ``Kernel``."""
        return self._address


class CompiledGridKernel(GridKernel):
    """A tape with a grid as machine code."""

    def __init__(self, tape: Tape, library: Path) -> None:
        super().__init__(tape)
        self._function = _load(library)

    def __call__(self, *arguments: Array, out: Sequence[Array]) -> None:
        """Evaluate the grid; see ``GridKernel``."""
        nodes, lanes = check_grid(self.tape, self.grid, arguments, out)
        if nodes and lanes:
            size = ctypes.c_long(nodes), ctypes.c_long(lanes)
            self._function(*size, _pointers(arguments), _distances(arguments), _pointers(out), _distances(out))


def _load(library: Path) -> Any:
    try:
        function = ctypes.CDLL(str(library)).kernel
    except (OSError, AttributeError) as error:
        raise MachineError(f"cannot load the compiled kernel {library}: {error}; delete it and run again") from error
    function.restype = None
    return function


@cache
def _load_call(cache_folder: Path) -> Any:
    """Return the function of call.c."""
    library = compile_source([CALL], cache_folder)
    try:
        function = ctypes.PyDLL(str(library)).call
    except OSError as error:
        raise MachineError(f"cannot load {library}, which calls compiled kernels: {error}") from error
    function.argtypes = (ctypes.POINTER(_Callee), ctypes.py_object, ctypes.py_object)
    return function


def _distances(arrays: Sequence[Array]) -> "ctypes.Array[ctypes.c_long]":
    """Distances from component to component and from node to node, in numbers; 0 where there are no nodes."""
    flat = (stride // array.itemsize for array in arrays for stride in (*array.strides, 0)[:2])
    found: ctypes.Array[ctypes.c_long] = _array_type(ctypes.c_long, 2 * len(arrays))(*flat)
    return found


def _pointers(arrays: Sequence[Array]) -> "ctypes.Array[ctypes.c_void_p]":
    found: ctypes.Array[ctypes.c_void_p] = _array_type(ctypes.c_void_p, len(arrays))(*map(address_of, arrays))
    return found


@cache
def _array_type(kind: Any, count: int) -> Any:
    """Return ``kind * count``; ctypes makes the type anew, in several microseconds, where nobody keeps it."""
    return kind * count


def aligned(count: int) -> Array:
    """Return memory for so many numbers, from where a line of the cache begins, and with it a vector of any width."""
    found = np.empty(count + LINE)
    return found[-address_of(found) // found.itemsize % LINE :][:count]


def address_of(array: Any) -> int:
    """Return where an array's numbers begin."""
    try:
        return ctypes.addressof(ctypes.c_char.from_buffer(array))  # takes a third of the time of what follows
    except (TypeError, ValueError):  # read-only, strided, or empty
        return int(array.__array_interface__["data"][0])


def optimisation(tape: Tape) -> str:
    """Return the level of optimisation that pays for a tape."""
    return "-O1" if len(tape) > LONG else "-O2"


@cache
def _emitter_digest() -> str:
    source = Path(emit.__code__.co_filename).read_bytes()
    return hashlib.sha256(source + VECTORS.read_bytes()).hexdigest()


def library_stem(tape: Tape, compiler: str) -> str:
    """How the file name of a tape's library begins: with everything that determines its content."""
    return _stem(tape.name, tape.to_bytes(), optimisation(tape), compiler)


def _stem(name: str, content: bytes, level: str, compiler: str) -> str:
    identity = hashlib.sha256(content)
    flags = (*flags_of(level), *shlex.split(compiler)[1:])
    for text in (*flags, compiler_version(compiler), target(), _emitter_digest()):
        identity.update(text.encode() + b"\0")
    return f"{name}-{identity.hexdigest()[:24]}"


def find_library(folder: Path, stem: str) -> Path | None:
    """Return a library that nobody else may have changed and whose content is what its file name says, or None.

    Loading a damaged one would be fatal.
    """
    found = (path for path in folder.glob(f"{stem}-*.so") if is_trusted(path))
    return next((path for path in found if path.stem == f"{stem}-{_content_digest(path)}"), None)


def _content_digest(path: Path) -> str:
    return hashlib.sha256(path.read_bytes()).hexdigest()[:24]


def find_compiled(tape: Tape, cache_folder: Path) -> Path | None:
    """Return the library of a tape if it is in the cache.

    Raises:
        MachineError: There is no working compiler, or the cache folder cannot be read or may be changed by others.
    """
    return _find(library_stem(tape, require_compiler()), cache_folder)


def _find(stem: str, cache_folder: Path) -> Path | None:
    try:
        found = (find_library(folder / LIBRARIES, stem) for folder in require_trusted(cache_folder))
        return next((library for library in found if library), None)
    except OSError as error:
        raise _unusable(cache_folder, error) from error


def compile_tape(tape: Tape, cache_folder: Path) -> Path:
    """Return the library of a tape, compiling it if it is not in the cache or damaged there.

    Raises:
        MachineError: There is no working compiler, or the cache folder cannot be written or may be changed by others.
    """
    stem = library_stem(tape, require_compiler())
    return _find(stem, cache_folder) or _compile(stem, lambda: emit(tape), optimisation(tape), cache_folder)


def compile_source(paths: Sequence[Path], cache_folder: Path) -> Path:
    """Return the library of C source that was written by hand, over the vectors of double that kernels use.

    Args:
        paths: Its files in the order in which they are read, as one; the last one names the library.
        cache_folder: Where libraries are kept.

    Raises:
        MachineError: As of ``compile_tape``.
    """
    text, level = "".join([prelude("float64"), *(path.read_text(encoding="utf-8") for path in paths)]), "-O3"
    stem = _stem(paths[-1].stem, text.encode(), level, require_compiler())
    return _find(stem, cache_folder) or _compile(stem, lambda: text, level, cache_folder)


def _compile(stem: str, source: Callable[[], str], level: str, cache_folder: Path) -> Path:
    """Compile C source into the cache, unless another process has done so while this one waited for it."""
    libraries = cache_folder / LIBRARIES
    try:
        make_private(libraries)
        require_trusted(cache_folder)
        with one_at_a_time(libraries / f".{stem}.lock"):
            return find_library(libraries, stem) or _build(stem, source, level, cache_folder)
    except OSError as error:
        raise _unusable(cache_folder, error) from error


def _build(stem: str, source: Callable[[], str], level: str, cache_folder: Path) -> Path:
    libraries = cache_folder / LIBRARIES
    _announce(cache_folder)
    with tempfile.TemporaryDirectory(dir=libraries, prefix=".build-") as folder:
        written, built = Path(folder) / f"{stem.rpartition('-')[0]}.c", Path(folder) / "kernel.so"
        written.write_text(source(), encoding="utf-8")
        run_compiler(require_compiler(), level, written, built)
        keep_from_others(built)
        return built.replace(libraries / f"{stem}-{_content_digest(built)}.so")


def _unusable(cache_folder: Path, error: OSError) -> MachineError:
    return MachineError(f"cannot use the kernel cache {cache_folder / LIBRARIES}: {error.strerror or error}")


def _announce(cache_folder: Path) -> None:
    if warm := warm_folder(cache_folder):
        _LOG.info("compiling kernels for this run only: the cache %s lacks them and cannot be written", warm)
    else:
        _LOG.info("compiling kernels, once per problem and machine")
