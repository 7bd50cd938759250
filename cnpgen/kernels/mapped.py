"""Kernels by CasADi's own map: the reference that the fast backends are tested against."""

from collections.abc import Sequence
from typing import Any

import numpy as np

from cnpgen.kernels.grid import GridKernel, axis_names, check_grid
from cnpgen.kernels.kernel import Array, Kernel, check_arguments
from cnpgen.kernels.tape import Tape


class MappedKernel(Kernel):
    """An SX function evaluated lane by lane by CasADi's virtual machine."""

    def __init__(self, tape: Tape, function: Any) -> None:
        super().__init__(tape)
        self._function = function

    def __call__(self, *arguments: Array) -> list[Array]:
        """Evaluate the batch; see ``Kernel``."""
        n = check_arguments(self.tape, arguments)
        if self.tape.loop is None:
            return self._evaluate(list(arguments), n)
        state, error, active = arguments[0].copy(), np.full((1, n), np.nan), np.arange(n)
        for _ in range(self.tape.loop.limit):
            if len(active) == 0:
                break
            following, now = self._evaluate([x[:, active] for x in (state, *arguments[1:])], len(active))
            state[:, active], error[:, active] = following, now
            active = active[~(now[0] < self.tape.loop.tolerance)]
        return [state, error]

    def _evaluate(self, arguments: list[Array], n: int) -> list[Array]:
        return _map(self._function, arguments, n, self.tape.outputs)


class MappedGridKernel(GridKernel):
    """An SX function evaluated point by point by CasADi's virtual machine, in float64 whatever the tape says."""

    def __init__(self, tape: Tape, function: Any) -> None:
        super().__init__(tape)
        self._function = function

    def __call__(self, *arguments: Array, out: Sequence[Array]) -> None:
        """Evaluate the grid; see ``GridKernel``."""
        nodes, lanes = check_grid(self.tape, self.grid, arguments, out)
        everywhere = []
        for argument, axes in zip(arguments, self.grid.arguments, strict=True):
            shape = (len(argument), nodes, lanes)
            spread = np.broadcast_to(_spread(argument, axis_names(axes)), shape)
            everywhere.append(spread.reshape(len(argument), nodes * lanes))
        found = _map(self._function, everywhere, nodes * lanes, self.tape.outputs)
        for result, values, axes in zip(out, found, self.grid.results, strict=True):
            grid = values.reshape(len(values), nodes, lanes)
            result[...] = grid if axes == "point" else result + grid.sum(axis=1)


def _spread(array: Array, names: tuple[str, ...]) -> Array:
    """Insert the axes that an argument does not vary over."""
    sizes = dict(zip(names, array.shape[1:], strict=True))
    return array.reshape(len(array), sizes.get("nodes", 1), sizes.get("lanes", 1))


def _map(function: Any, arguments: Sequence[Array], n: int, widths: Sequence[int]) -> list[Array]:
    if n == 0:
        return [np.empty((width, 0)) for width in widths]
    results = function.map(n)(*arguments)
    results = results if isinstance(results, tuple) else (results,)
    return [np.ascontiguousarray(np.array(result)) for result in results]
