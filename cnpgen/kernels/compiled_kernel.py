"""Kernels in shared libraries, compiled once with the C compiler of the machine and cached by content."""

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
from cnpgen.kernels.compiler import (
    compiler_version,
    flags_of,
    require_compiler,
    run_compiler,
    target,
)
from cnpgen.kernels.emit import VECTORS, emit, prelude
from cnpgen.kernels.kernel import Array, GridKernel, Kernel, check_arguments, check_grid
from cnpgen.kernels.tape import Tape
from cnpgen.store.files.cache_folder import (
    LIBRARIES,
    exclusive_lock,
    is_trusted,
    make_private_folder,
    make_read_only_for_others,
    read_only_cache,
    require_trusted,
)

CALL_SOURCE = Path(__file__).with_name("call.c")
CACHE_LINE_DOUBLES = 8
# GCC's register allocator takes minutes at -O2 for longer tapes, without a gain.
MAX_O2_INSTRUCTIONS = 6000
_LOG = logging.getLogger(__name__)


class _Callee(ctypes.Structure):
    """The struct ``callee`` of call.c."""

    _fields_ = (
        ("kernel", ctypes.c_void_p),
        ("inputs", ctypes.c_long),
        ("outputs", ctypes.c_long),
        ("widths", ctypes.POINTER(ctypes.c_long)),
    )


class CompiledKernel(Kernel):
    """A tape as machine code of its library.

    The cache folder also has the library of call.c.
    """

    def __init__(self, tape: Tape, library: Path, cache_folder: Path) -> None:
        super().__init__(tape)
        self._address = ctypes.cast(_load(library), ctypes.c_void_p).value
        sizes = len(tape.inputs), len(tape.outputs)
        widths = (ctypes.c_long * sum(sizes))(*tape.inputs, *tape.outputs)
        self._callee, self._call = (
            _Callee(self._address, *sizes, widths),
            _load_call(cache_folder),
        )

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
        """Address of the machine code; see ``Kernel``."""
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
            self._function(
                *size,
                _pointers(arguments),
                _strides(arguments),
                _pointers(out),
                _strides(out),
            )


def _load(library: Path) -> Any:
    try:
        function = ctypes.CDLL(str(library)).kernel
    except (OSError, AttributeError) as error:
        raise MachineError(
            f"cannot load the compiled kernel {library}: {error}; delete it and run again"
        ) from error
    function.restype = None
    return function


@cache
def _load_call(cache_folder: Path) -> Any:
    """Return the function ``call`` of call.c."""
    library = compile_source([CALL_SOURCE], cache_folder)
    try:
        function = ctypes.PyDLL(str(library)).call
    except OSError as error:
        raise MachineError(
            f"cannot load the library that calls compiled kernels, {library}: {error}"
        ) from error
    function.argtypes = (ctypes.POINTER(_Callee), ctypes.py_object, ctypes.py_object)
    return function


def _strides(arrays: Sequence[Array]) -> "ctypes.Array[ctypes.c_long]":
    """Return strides between components and between nodes, in elements.

    0 without a node axis.
    """
    flat = (
        stride // array.itemsize
        for array in arrays
        for stride in (*array.strides, 0)[:2]
    )
    strides: ctypes.Array[ctypes.c_long] = _array_type(ctypes.c_long, 2 * len(arrays))(
        *flat
    )
    return strides


def _pointers(arrays: Sequence[Array]) -> "ctypes.Array[ctypes.c_void_p]":
    pointers: ctypes.Array[ctypes.c_void_p] = _array_type(ctypes.c_void_p, len(arrays))(
        *map(address_of, arrays)
    )
    return pointers


@cache
def _array_type(kind: Any, count: int) -> Any:
    """Return ``kind * count``.

    Without the cache ctypes creates the type again, which takes several microseconds.
    """
    return kind * count


def aligned_array(count: int) -> Array:
    """Return an uninitialized array of ``count`` float64 values, aligned to a cache line and so to any vector."""
    memory = np.empty(count + CACHE_LINE_DOUBLES)
    return memory[-address_of(memory) // memory.itemsize % CACHE_LINE_DOUBLES :][:count]


def address_of(array: Any) -> int:
    """Return the address of the first element of an array."""
    try:
        return ctypes.addressof(
            ctypes.c_char.from_buffer(array)
        )  # a third of the time of the array interface
    except (TypeError, ValueError):  # read-only, strided, or empty
        return int(array.__array_interface__["data"][0])


def optimization_level(tape: Tape) -> str:
    """Return the optimization level of the compiler for a tape."""
    return "-O1" if len(tape) > MAX_O2_INSTRUCTIONS else "-O2"


@cache
def _emitter_digest() -> str:
    source = Path(emit.__code__.co_filename).read_bytes()
    return hashlib.sha256(source + VECTORS.read_bytes()).hexdigest()


def library_file_stem(tape: Tape, compiler: str) -> str:
    """Return the stem of the library's file name, which contains a digest of all inputs of the compilation."""
    return _stem(tape.name, tape.to_bytes(), optimization_level(tape), compiler)


def _stem(name: str, content: bytes, level: str, compiler: str) -> str:
    identity = hashlib.sha256(content)
    flags = (*flags_of(level), *shlex.split(compiler)[1:])
    for text in (*flags, compiler_version(compiler), target(), _emitter_digest()):
        identity.update(text.encode() + b"\0")
    return f"{name}-{identity.hexdigest()[:24]}"


def find_library(folder: Path, stem: str) -> Path | None:
    """Return a trusted library whose content has the digest in its file name, or None.

    Loading a damaged library would crash the process.
    """
    libraries = (path for path in folder.glob(f"{stem}-*.so") if is_trusted(path))
    return next(
        (path for path in libraries if path.stem == f"{stem}-{_content_digest(path)}"),
        None,
    )


def _content_digest(path: Path) -> str:
    return hashlib.sha256(path.read_bytes()).hexdigest()[:24]


def find_compiled(tape: Tape, cache_folder: Path) -> Path | None:
    """Return the library of a tape if it is in the cache.

    Raises:
        MachineError: There is no working compiler, or the cache folder is unreadable or
            writable for other users.
    """
    return _find(library_file_stem(tape, require_compiler()), cache_folder)


def _find(stem: str, cache_folder: Path) -> Path | None:
    try:
        libraries = (
            find_library(folder / LIBRARIES, stem)
            for folder in require_trusted(cache_folder)
        )
        return next((library for library in libraries if library), None)
    except OSError as error:
        raise _unusable(cache_folder, error) from error


def compile_tape(tape: Tape, cache_folder: Path) -> Path:
    """Return the library of a tape; compile it if the cache lacks it or its copy is damaged.

    Raises:
        MachineError: There is no working compiler, or the cache folder is not writable
            or writable for other users.
    """
    stem = library_file_stem(tape, require_compiler())
    return _compile(stem, lambda: emit(tape), optimization_level(tape), cache_folder)


def compile_source(paths: Sequence[Path], cache_folder: Path) -> Path:
    """Return the library of handwritten C source that uses the double vectors of kernels.

    The files are concatenated in their order; the last one names the library.

    Raises:
        MachineError: See ``compile_tape``.
    """
    text, level = (
        "".join(
            [prelude("float64"), *(path.read_text(encoding="utf-8") for path in paths)]
        ),
        "-O3",
    )
    stem = _stem(paths[-1].stem, text.encode(), level, require_compiler())
    return _compile(stem, lambda: text, level, cache_folder)


def _compile(
    stem: str, source: Callable[[], str], level: str, cache_folder: Path
) -> Path:
    """Compile C source unless its library is cached, also by another process while this one waited for the lock."""
    if library := _find(stem, cache_folder):
        return library
    libraries = cache_folder / LIBRARIES
    try:
        make_private_folder(libraries)
        require_trusted(cache_folder)
        with exclusive_lock(libraries / f".{stem}.lock"):
            return find_library(libraries, stem) or _build(
                stem, source, level, cache_folder
            )
    except OSError as error:
        raise _unusable(cache_folder, error) from error


def _build(
    stem: str, source: Callable[[], str], level: str, cache_folder: Path
) -> Path:
    libraries = cache_folder / LIBRARIES
    if linked := read_only_cache(cache_folder):
        _LOG.info(
            "compiling kernels for this run only: the cache %s lacks them and is not writable",
            linked,
        )
    else:
        _LOG.info("compiling kernels, once per problem and machine")
    with tempfile.TemporaryDirectory(dir=libraries, prefix=".build-") as folder:
        source_file, built = (
            Path(folder) / f"{stem.rpartition('-')[0]}.c",
            Path(folder) / "kernel.so",
        )
        source_file.write_text(source(), encoding="utf-8")
        run_compiler(require_compiler(), level, source_file, built)
        make_read_only_for_others(built)
        return built.replace(libraries / f"{stem}-{_content_digest(built)}.so")


def _unusable(cache_folder: Path, error: OSError) -> MachineError:
    return MachineError(
        f"cannot use the kernel cache {cache_folder / LIBRARIES}: {error.strerror or error}"
    )
