"""Kernels as machine code, generated once by LLVM and cached by content."""

import ctypes
import sys
from collections.abc import Sequence
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np

from cnpgen.arrays import Array
from cnpgen.errors import MachineError
from cnpgen.kernels.call_text import CALL, PYTHON_FUNCTIONS
from cnpgen.kernels.code_cache import (
    MAX_DIRECT,
    content_key,
    final_text,
    find_final,
    make_final,
    make_first,
    note_generation,
    request_final,
    tape_key,
)
from cnpgen.kernels.kernel import GridKernel, Kernel, check_arguments, check_grid
from cnpgen.kernels.machine_code import LoadedCode, define_symbol
from cnpgen.kernels.optimizer import Replacement, replacer
from cnpgen.kernels.tape import Tape

CACHE_LINE_DOUBLES = 8
# Code of the first level of this process.
_first: dict[tuple[Path, str], LoadedCode] = {}


def kernel_address(tape: Tape, cache_folder: Path) -> int:
    """Return the address of a tape's machine code; generate it if the cache lacks it or its copy is damaged.

    A long tape gets code of the first level, whose address stays the same when the final code
    replaces it.

    Raises:
        MachineError: LLVM does not work, or the cache folder is writable for other
            users.
    """
    key = tape_key(tape)
    if (code := find_final(key, cache_folder)) is not None:
        return code.address("kernel")
    place = cache_folder, key
    if place not in _first:
        note_generation(cache_folder)
        # Short tapes get final code at once; a longer one starts with code that is
        # generated ten times faster.
        if len(tape) <= MAX_DIRECT or not sys.executable:
            return make_final(key, final_text(tape), cache_folder).address("kernel")
        code = _first[place] = make_first(tape)
        if request := request_final(key, tape, cache_folder):
            replacer.add(Replacement(key, request, code, cache_folder))
    return _first[place].address("dispatch")


class _Callee(ctypes.Structure):
    """The struct ``callee`` of ``call_text``."""

    _fields_ = (
        ("kernel", ctypes.c_void_p),
        ("inputs", ctypes.c_long),
        ("outputs", ctypes.c_long),
        ("widths", ctypes.POINTER(ctypes.c_long)),
    )


class CompiledKernel(Kernel):
    """A tape as machine code."""

    def __init__(self, tape: Tape, cache_folder: Path) -> None:
        super().__init__(tape)
        self._address = kernel_address(tape, cache_folder)
        sizes = len(tape.inputs), len(tape.outputs)
        widths = (ctypes.c_long * sum(sizes))(*tape.inputs, *tape.outputs)
        self._callee = _Callee(self._address, *sizes, widths)
        self._call = _load_call(cache_folder)

    def __call__(self, *arguments: Array) -> list[Array]:
        """Evaluate the batch; see ``Kernel``."""
        n = arguments[0].shape[-1]
        results = [np.empty((width, n)) for width in self.tape.outputs]
        # The fast path checks nothing in Python; only a refusal is explained, by a
        # slower check.
        if not self._call(self._callee, arguments, results):
            check_arguments(self.tape, arguments)
            raise ValueError(f"kernel {self.tape.name}: arguments must be NumPy arrays")
        return results

    @property
    def address(self) -> int:
        """Address of the machine code; see ``Kernel``."""
        return self._address


_GRID_FUNCTION = ctypes.CFUNCTYPE(
    None, ctypes.c_long, ctypes.c_long, *[ctypes.c_void_p] * 4
)


class CompiledGridKernel(GridKernel):
    """A tape with a grid as machine code."""

    def __init__(self, tape: Tape, cache_folder: Path) -> None:
        super().__init__(tape)
        self._function = _GRID_FUNCTION(kernel_address(tape, cache_folder))

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


@cache
def _load_call(cache_folder: Path) -> Any:
    """Return the function ``call`` of ``call_text``."""
    for name in PYTHON_FUNCTIONS:
        define_symbol(name, getattr(ctypes.pythonapi, name))
    code = make_final(content_key(CALL.encode()), CALL, cache_folder)
    # Such a function keeps Python's lock, which calls of Python's C API need.
    kind = ctypes.PYFUNCTYPE(
        ctypes.c_int, ctypes.POINTER(_Callee), ctypes.py_object, ctypes.py_object
    )
    return kind(code.address("call"))


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
    # Skip o elements of 8 bytes: o = (-address / 8) mod 8 ends at a multiple of 64
    # bytes.
    return memory[-address_of(memory) // memory.itemsize % CACHE_LINE_DOUBLES :][:count]


def require_memory(result: Any, *_: Any) -> Any:
    """Return the result of a function in C, which is negative if it ran out of memory (``errcheck`` of ctypes).

    Raises:
        MachineError: The result is negative.
    """
    if result < 0:
        raise MachineError("there is no memory left for collision checks or scenes")
    return result


def address_of(array: Any) -> int:
    """Return the address of the first element of an array."""
    try:
        # A third of the time of the array interface.
        return ctypes.addressof(ctypes.c_char.from_buffer(array))
    except (TypeError, ValueError):
        # Read-only, strided, or empty.
        return int(array.__array_interface__["data"][0])
