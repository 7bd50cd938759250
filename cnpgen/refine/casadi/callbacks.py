"""NumPy functions as CasADi functions: kept alive, and with whatever was raised in them."""

from collections.abc import Callable
from typing import Any

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
Compute = Callable[..., Array | float]


class Callbacks:
    """The functions of one run of a solver.

    Attributes:
        raised: What a function raised first: CasADi keeps the message at most, and goes on or gives up as it likes.
    """

    def __init__(self) -> None:
        self.raised: BaseException | None = None
        self._kept: list[Any] = []  # CasADi holds no reference

    def wrap(self, name: str, inputs: list[Any], output: Any, compute: Compute, *, slope: Any = None) -> Any:
        """Wrap a function.

        Args:
            name: Its name.
            inputs: Sparsity patterns of its arguments.
            output: Sparsity pattern of its result.
            compute: Arguments, as vectors of their nonzeros -> nonzeros of the result, column by column.
            slope: Its wrapped Jacobian, a function of the same arguments and the result, or None.
        """
        import casadi

        ca: Any = casadi  # of some versions mypy knows types, of others none

        def evaluate(arguments: list[Any]) -> list[Any]:
            if self.raised is not None:
                raise self.raised
            try:
                return [ca.DM(output, compute(*(np.array(each.nonzeros()) for each in arguments)))]
            except BaseException as error:
                self.raised = error
                raise

        class Wrapped(ca.Callback):  # type: ignore[misc]
            def __init__(self) -> None:
                ca.Callback.__init__(self)
                self.construct(name, {})

            def get_n_in(self) -> int:
                return len(inputs)

            def get_n_out(self) -> int:
                return 1

            def get_sparsity_in(self, index: int) -> Any:
                return inputs[index]

            def get_sparsity_out(self, _: int) -> Any:
                return output

            def has_jacobian(self) -> bool:
                return slope is not None

            def has_jac_sparsity(self, *_: int) -> bool:
                return slope is not None

            def get_jac_sparsity(self, *_: Any) -> Any:
                return slope.sparsity_out(0)

            def get_jacobian(self, *_: Any) -> Any:
                return slope

            def eval(self, arguments: list[Any]) -> list[Any]:
                return evaluate(arguments)

        self._kept.append(Wrapped())
        return self._kept[-1]
