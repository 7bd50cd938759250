"""Kernels that CasADi's virtual machine evaluates: the reference of the fast backends."""

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np

from cnpgen.arrays import Array
from cnpgen.kernels.kernel import (
    GridKernel,
    Kernel,
    axis_names,
    check_grid,
    evaluate_lanes,
)
from cnpgen.kernels.library import KernelLibrary
from cnpgen.kernels.tape import Loop, Tape, tape_from_function


class CasadiLibrary(KernelLibrary):
    """``KernelLibrary`` whose kernels CasADi evaluates."""

    def load(
        self, builder: Callable[..., Any], loop: Loop | None = None, **parameters: Any
    ) -> Kernel:
        """See ``KernelLibrary``."""
        function = self._build(builder, parameters)
        return MappedKernel(tape_from_function(function, loop), function)


class MappedKernel(Kernel):
    """An SX function evaluated lane by lane by CasADi's virtual machine."""

    def __init__(self, tape: Tape, function: Any) -> None:
        super().__init__(tape)
        self._function = function

    def __call__(self, *arguments: Array) -> list[Array]:
        """Evaluate the batch; see ``Kernel``."""
        widths = self.tape.outputs
        return evaluate_lanes(
            self.tape,
            arguments,
            lambda inputs, n: _map(self._function, inputs, n, widths),
        )


class MappedGridKernel(GridKernel):
    """An SX function evaluated point by point by CasADi's virtual machine, always in float64."""

    def __init__(self, tape: Tape, function: Any) -> None:
        super().__init__(tape)
        self._function = function

    def __call__(self, *arguments: Array, out: Sequence[Array]) -> None:
        """Evaluate the grid; see ``GridKernel``."""
        nodes, lanes = check_grid(self.tape, self.grid, arguments, out)
        points = []
        for argument, axes in zip(arguments, self.grid.arguments, strict=True):
            names = axis_names(axes)
            shape = (
                len(argument),
                nodes if "nodes" in names else 1,
                lanes if "lanes" in names else 1,
            )
            spread = np.broadcast_to(
                argument.reshape(shape), (len(argument), nodes, lanes)
            )
            points.append(spread.reshape(len(argument), nodes * lanes))
        results = _map(self._function, points, nodes * lanes, self.tape.outputs)
        for result, values, axes in zip(out, results, self.grid.results, strict=True):
            grid = values.reshape(len(values), nodes, lanes)
            result[...] = grid if axes == "point" else result + grid.sum(axis=1)


def _map(
    function: Any, arguments: Sequence[Array], n: int, widths: Sequence[int]
) -> list[Array]:
    if n == 0:
        return [np.empty((width, 0)) for width in widths]
    results = function.map(n)(*arguments)
    results = results if isinstance(results, tuple) else (results,)
    return [np.ascontiguousarray(np.array(result)) for result in results]
