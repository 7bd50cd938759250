"""Kernels that append distances of a robot's convex parts to the rows of another kernel, for ``hull_rows.c``."""

import ctypes
from ctypes import c_double, c_long, c_void_p
from dataclasses import dataclass, replace
from itertools import count
from typing import Any

import numpy as np
from numpy.typing import NDArray

from cnpgen.arrays import Array
from cnpgen.kernels.collision.collision_checker import CollisionChecker
from cnpgen.kernels.compiled_kernel import address_of, require_memory
from cnpgen.kernels.kernel import Kernel

MAX_CONTACTS_PER_STATE = 4096
NUMBERS_PER_CONTACT = 12  # in hull_rows.c
_GENERATIONS = count(1)


class _RowContext(ctypes.Structure):
    """``row_context`` of hull_rows.c."""

    _fields_ = (
        *((name, c_void_p) for name in ("values", "jacobian", "scene", "scratch")),
        *((name, c_void_p) for name in ("required", "obstacle_column", "pair_column")),
        *(
            (name, c_long)
            for name in ("rows", "columns", "width", "capacity", "generation")
        ),
        *(
            (name, c_double)
            for name in ("range", "scale", "obstacle_distance", "self_distance")
        ),
    )


@dataclass(frozen=True)
class DistanceColumns:
    """Rows of distances.

    Attributes:
        required: Required distance of every row [m], shape (m,).
        of_obstacles: Row of every pair (obstacle, moving part), part by part.
        of_links: Row of every pair of ``CollisionChecker.link_pairs``.
        obstacle_distance: Largest required distance from obstacles [m], None without
            such rows.
        self_distance: Largest required distance of links from each other [m], None
            without such rows.
        range: Distance above the required one [m] at which measured values end. The
            residual of larger ones is 100: solvers do not select rows without a
            gradient.
        scale: Distance of a residual of 1 [m].
    """

    required: Array
    of_obstacles: NDArray[np.int64]
    of_links: NDArray[np.int64]
    obstacle_distance: float | None
    self_distance: float | None
    range: float
    scale: float


class RowKernels:
    """The kernels ``(w, poses) -> g`` and ``-> (g, dg/dw)`` of a problem, with rows of distances.

    They call kernels of the other rows, with derivatives column by column; w
    begins with the joint positions.

    Attributes:
        values: Kernel of all rows.
        jacobian: Kernel of all rows and their derivatives.
    """

    def __init__(
        self,
        values: Kernel,
        jacobian: Kernel,
        checker: CollisionChecker,
        columns: DistanceColumns,
    ) -> None:
        rows, width = values.tape.outputs[0], values.tape.inputs[0]
        m = len(columns.required)
        limits = [
            -np.inf if x is None else x
            for x in (columns.obstacle_distance, columns.self_distance)
        ]
        # Scratch memory of one state: its contacts, then values (m) and gradients (m,
        # width).
        numbers = NUMBERS_PER_CONTACT * MAX_CONTACTS_PER_STATE + m * (1 + width)
        arrays = (
            np.empty(numbers),
            columns.required,
            columns.of_obstacles,
            columns.of_links,
        )
        self._keep: tuple[Any, ...] = (values, jacobian, checker, *arrays)
        addresses = (
            *(part.address for part in (values, jacobian, checker)),
            *map(address_of, arrays),
        )
        counts = rows, m, width, MAX_CONTACTS_PER_STATE, next(_GENERATIONS)
        self._context = _RowContext(
            *addresses, *counts, columns.range, columns.scale, *limits
        )
        self._library = checker.library
        activate = self._library.set_row_context
        activate.argtypes, activate.restype = (c_void_p,), c_long
        activate.errcheck = require_memory
        self.values = _RowKernel(self, values, "row_values", (rows + m,))
        self.jacobian = _RowKernel(
            self, jacobian, "row_jacobian", (rows + m, (rows + m) * width)
        )

    def activate(self) -> None:
        """Make these kernels those of the thread: their machine code has one context per thread.

        Raises:
            MachineError: There is no memory left, or there was none for the last evaluation.
        """
        # A thread-local pointer: the interface of compiled kernels has no room for a
        # context.
        self._library.set_row_context(ctypes.addressof(self._context))


class _RowKernel(Kernel):
    """Kernel of hull_rows.c; see ``Kernel``."""

    def __init__(
        self, kernels: RowKernels, inner: Kernel, name: str, outputs: tuple[int, ...]
    ) -> None:
        super().__init__(replace(inner.tape, outputs=outputs))
        self._kernels = kernels
        self._function = getattr(kernels._library, name)
        self._function.restype = None

    @property
    def address(self) -> int:
        """Address of the machine code; see ``Kernel``."""
        return ctypes.cast(self._function, c_void_p).value or 0

    def __call__(self, *arguments: Array) -> list[Array]:
        """Evaluate the batch; see ``Kernel``."""
        self._kernels.activate()
        n = arguments[0].shape[-1]
        arguments = tuple(np.ascontiguousarray(argument) for argument in arguments)
        results = [np.empty((width, n)) for width in self.tape.outputs]
        strides = (c_long * len(arguments))(*([n] * len(arguments)))
        pointers = [
            (c_void_p * len(arrays))(*map(address_of, arrays))
            for arrays in (arguments, results)
        ]
        self._function(c_long(n), pointers[0], strides, pointers[1])
        # Raises an error if memory was lacking.
        self._kernels.activate()
        return results
