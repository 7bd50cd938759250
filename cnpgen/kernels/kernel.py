"""The contracts of kernels: one SX function on a batch, with arrays of shape (width, N), or on a grid of nodes."""

import ctypes
from abc import ABC, abstractmethod
from collections.abc import Callable, Sequence
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray

from cnpgen.arrays import Array
from cnpgen.kernels.tape import Axes, GridSpec, Tape

_ARRAYS = ctypes.POINTER(ctypes.POINTER(ctypes.c_double))
# ``kernel`` of arrays.h.
_C_KERNEL = ctypes.CFUNCTYPE(
    None, ctypes.c_long, _ARRAYS, ctypes.POINTER(ctypes.c_long), _ARRAYS
)


class Kernel(ABC):
    """A tape ready to run.

    Attributes:
        tape: The program.
    """

    def __init__(self, tape: Tape) -> None:
        self.tape = tape

    @property
    def address(self) -> int:
        """Address of a ``kernel`` of arrays.h, for compiled code: machine code, or a function that calls this object."""
        address = ctypes.cast(self._called_from_c, ctypes.c_void_p).value
        assert address is not None
        return address

    @cached_property
    def _called_from_c(self) -> Any:
        def run(n: int, inputs: Any, distances: Any, outputs: Any) -> None:
            # Rows of an input are ``distance`` apart, those of an output n. An input of
            # no rows may have no address.
            arguments = [
                np.ctypeslib.as_array(inputs[i], (width, distances[i]))[:, :n]
                if width
                else np.empty((0, n))
                for i, width in enumerate(self.tape.inputs)
            ]
            for i, result in enumerate(self(*arguments)):
                np.ctypeslib.as_array(outputs[i], result.shape)[:] = result

        return _C_KERNEL(run)

    @abstractmethod
    def __call__(self, *arguments: Array) -> list[Array]:
        """Evaluate every lane.

        Args:
            arguments: One float64 array of shape (width, N) per input of the tape, rows
                contiguous.

        Returns:
            One new array of shape (width, N) per output. For a tape with a loop: the
            final state and the error of the state before the last step, shape (1, N).

        Raises:
            ValueError: A shape or type does not match the tape.
        """


def evaluate_lanes(
    tape: Tape,
    arguments: Sequence[Array],
    evaluate: Callable[[Sequence[Array], int], list[Array]],
) -> list[Array]:
    """Evaluate a batch, or step its lanes until they have converged, by a function that evaluates N lanes once."""
    n = check_arguments(tape, arguments)
    if tape.loop is None:
        return evaluate(arguments, n)
    state = arguments[0].copy()
    error = np.full((1, n), np.nan)
    active = np.arange(n)
    for _ in range(tape.loop.limit):
        if len(active) == 0:
            break
        # Lanes that have converged are left out, so that NumPy does not evaluate them
        # again.
        inputs = [state, *arguments[1:]]
        if len(active) < n:
            inputs = [np.ascontiguousarray(x[:, active]) for x in inputs]
        next_state, next_error = evaluate(inputs, len(active))
        state[:, active] = next_state
        error[:, active] = next_error
        # A comparison with nan is false: a lane with the error nan stays active to the
        # limit.
        active = active[~(next_error[0] < tape.loop.tolerance)]
    return [state, error]


def check_arguments(tape: Tape, arguments: Sequence[Array]) -> int:
    """Return the number of lanes N.

    Raise ValueError if arguments do not match the tape.
    """
    if len(arguments) != len(tape.inputs):
        raise ValueError(
            f"kernel {tape.name}: expected {len(tape.inputs)} arguments, got {len(arguments)}"
        )
    n = int(arguments[0].shape[-1])
    for index, (argument, width) in enumerate(zip(arguments, tape.inputs, strict=True)):
        if (
            argument.shape != (width, n)
            or argument.dtype != np.float64
            or (argument.size > 1 and n > 1 and argument.strides[1] != 8)
        ):
            raise ValueError(
                f"kernel {tape.name}: argument {index} must be float64 of shape ({width}, {n}) with contiguous rows,"
                f" got {argument.dtype} of shape {argument.shape}"
            )
    return n


class GridKernel(ABC):
    """A tape with a grid, ready to run.

    Attributes:
        tape: The program.
        grid: Axes of its arguments and results.
    """

    def __init__(self, tape: Tape) -> None:
        if tape.grid is None:
            raise ValueError(f"kernel {tape.name}: its tape has no grid")
        self.tape = tape
        self.grid = tape.grid

    @abstractmethod
    def __call__(self, *arguments: NDArray[Any], out: Sequence[NDArray[Any]]) -> None:
        """Evaluate the grid and write into ``out``.

        Args:
            arguments: One array of the tape's type per input: (width, K, N) for axes
                "point", (width, N) for "lane", (width, K) for "node", (width,) for
                "fixed". Rows of lanes are contiguous.
            out: One array per output: (width, K, N), or (width, N), to which the sum
                over the nodes is added.

        Raises:
            ValueError: A shape or type does not match the tape.
        """


def check_grid(
    tape: Tape,
    grid: GridSpec,
    arguments: Sequence[NDArray[Any]],
    out: Sequence[NDArray[Any]],
) -> tuple[int, int]:
    """Return K and N; raise ValueError if arguments or results do not match the tape."""
    if (len(arguments), len(out)) != (len(tape.inputs), len(tape.outputs)):
        raise ValueError(
            f"kernel {tape.name}: expected {len(tape.inputs)} arguments and {len(tape.outputs)} results,"
            f" got {len(arguments)} and {len(out)}"
        )
    arrays, axes = (*arguments, *out), (*grid.arguments, *grid.results)
    # K and N are read from the last array that has the axis; the loop below compares
    # all.
    size: dict[str, int] = {"nodes": 1, "lanes": 1}
    for array, names in zip(arrays, map(axis_names, axes), strict=True):
        size.update(zip(names, array.shape[1:], strict=False))
    for index, (array, width, names) in enumerate(
        zip(arrays, (*tape.inputs, *tape.outputs), map(axis_names, axes), strict=True)
    ):
        shape = (width, *(size[name] for name in names))
        # A row of one element has no distance of lanes.
        rows = (
            "lanes" not in names
            or size["lanes"] == 1
            or array.size == 0
            or array.strides[-1] == array.itemsize
        )
        if array.shape != shape or array.dtype != np.dtype(tape.dtype) or not rows:
            label = (
                f"argument {index}"
                if index < len(arguments)
                else f"result {index - len(arguments)}"
            )
            raise ValueError(
                f"kernel {tape.name}: {label} must be {tape.dtype} of shape {shape} with contiguous rows,"
                f" got {array.dtype} of shape {array.shape}"
            )
    return size["nodes"], size["lanes"]


def axis_names(axes: Axes) -> tuple[str, ...]:
    """Return the names of all axes of an argument or result but the first."""
    return {
        "point": ("nodes", "lanes"),
        "lane": ("lanes",),
        "node": ("nodes",),
        "fixed": (),
    }[axes]
