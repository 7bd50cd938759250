"""Kernels by CasADi's own map: the reference that the fast backends are tested against."""

from typing import Any

import numpy as np

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
        if n == 0:
            return [np.empty((width, 0)) for width in self.tape.outputs]
        results = self._function.map(n)(*arguments)
        results = results if isinstance(results, tuple) else (results,)
        return [np.ascontiguousarray(np.array(result)) for result in results]
