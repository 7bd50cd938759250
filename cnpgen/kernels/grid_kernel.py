"""The contract of a grid kernel: one SX function at K nodes of N lanes, with sums over the nodes."""

from abc import ABC, abstractmethod
from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from cnpgen.kernels.tape import Axes, GridSpec, Tape

Array = NDArray[Any]


class GridKernel(ABC):
    """A tape with a grid, ready to run.

    Attributes:
        tape: The program.
        grid: Axes of its arguments and results.
    """

    def __init__(self, tape: Tape) -> None:
        if tape.grid is None:
            raise ValueError(f"kernel {tape.name}: its tape has no grid")
        self.tape, self.grid = tape, tape.grid

    @abstractmethod
    def __call__(self, *arguments: Array, out: Sequence[Array]) -> None:
        """Evaluate the grid and write into ``out``.

        Args:
            arguments: One array of the tape's type per input: (width, K, N) for axes "point", (width, N) for "lane",
                (width, K) for "node", (width,) for "fixed". Rows of lanes are contiguous.
            out: One array per output: (width, K, N), or (width, N), to which the sum over the nodes is added.

        Raises:
            ValueError: A shape or type does not match the tape.
        """


def check_grid(tape: Tape, grid: GridSpec, arguments: Sequence[Array], out: Sequence[Array]) -> tuple[int, int]:
    """Return K and N; raise ValueError if arguments or results do not match the tape."""
    if (len(arguments), len(out)) != (len(tape.inputs), len(tape.outputs)):
        raise ValueError(
            f"kernel {tape.name}: expected {len(tape.inputs)} arguments and {len(tape.outputs)} results,"
            f" got {len(arguments)} and {len(out)}"
        )
    arrays, axes = (*arguments, *out), (*grid.arguments, *grid.results)
    size: dict[str, int] = {"nodes": 1, "lanes": 1}
    for array, names in zip(arrays, map(axis_names, axes), strict=True):
        size.update(zip(names, array.shape[1:], strict=False))
    for index, (array, width, names) in enumerate(
        zip(arrays, (*tape.inputs, *tape.outputs), map(axis_names, axes), strict=True)
    ):
        shape = (width, *(size[name] for name in names))
        rows = "lanes" not in names or size["lanes"] == 1 or array.size == 0 or array.strides[-1] == array.itemsize
        if array.shape != shape or array.dtype != np.dtype(tape.dtype) or not rows:
            label = f"argument {index}" if index < len(arguments) else f"result {index - len(arguments)}"
            raise ValueError(
                f"kernel {tape.name}: {label} must be {tape.dtype} of shape {shape} with contiguous rows,"
                f" got {array.dtype} of shape {array.shape}"
            )
    return size["nodes"], size["lanes"]


def axis_names(axes: Axes) -> tuple[str, ...]:
    """Return the names of all axes of an argument or result but the first."""
    return {"point": ("nodes", "lanes"), "lane": ("lanes",), "node": ("nodes",), "fixed": ()}[axes]
