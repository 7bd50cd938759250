"""The contract of a kernel: one SX function on a batch, with arrays of shape (width, N)."""

from abc import ABC, abstractmethod
from collections.abc import Callable, Sequence

import numpy as np
from numpy.typing import NDArray

from cnpgen.kernels.tape import Tape

Array = NDArray[np.float64]


class Kernel(ABC):
    """A tape ready to run.

    Attributes:
        tape: The program.
    """

    def __init__(self, tape: Tape) -> None:
        self.tape = tape

    @property
    def address(self) -> int | None:
        """Address of the machine code, for other compiled code; None if there is none."""
        return None

    @abstractmethod
    def __call__(self, *arguments: Array) -> list[Array]:
        """Evaluate every lane.

        Args:
            arguments: One float64 array of shape (width, N) per input of the tape, rows contiguous.

        Returns:
            One new array of shape (width, N) per output. For a tape with a loop: the final state and the error of the
            state before the last step, shape (1, N).

        Raises:
            ValueError: A shape or type does not match the tape.
        """


def evaluate_lanes(
    tape: Tape, arguments: Sequence[Array], evaluate: Callable[[Sequence[Array], int], list[Array]]
) -> list[Array]:
    """Evaluate a batch, or step its lanes until they have converged, by a function that evaluates N lanes once."""
    n = check_arguments(tape, arguments)
    if tape.loop is None:
        return evaluate(arguments, n)
    state, error, active = arguments[0].copy(), np.full((1, n), np.nan), np.arange(n)
    for _ in range(tape.loop.limit):
        if len(active) == 0:
            break
        inputs = [state, *arguments[1:]]
        if len(active) < n:
            inputs = [np.ascontiguousarray(x[:, active]) for x in inputs]
        next_state, next_error = evaluate(inputs, len(active))
        state[:, active], error[:, active] = next_state, next_error
        active = active[~(next_error[0] < tape.loop.tolerance)]
    return [state, error]


def check_arguments(tape: Tape, arguments: Sequence[Array]) -> int:
    """Return the number of lanes N; raise ValueError if arguments do not match the tape."""
    if len(arguments) != len(tape.inputs):
        raise ValueError(f"kernel {tape.name}: expected {len(tape.inputs)} arguments, got {len(arguments)}")
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
