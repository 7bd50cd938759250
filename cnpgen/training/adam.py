"""Adam (Kingma and Ba, 2015) on one flat vector, in place, with an average of the parameters beside them."""

import math
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

Array = NDArray[Any]

FIRST, SECOND, TINY = 0.9, 0.999, 1e-8
BLOCK = 1 << 17  # numbers at once: the five arrays of a block stay in the cache


@dataclass
class Adam:
    """The optimiser's state; everything has shape (n_parameters,).

    Attributes:
        parameters: The parameters.
        average: Their exponential average, which is what is validated and kept.
        first: Average of the gradient.
        second: Average of its square.
        step: Steps taken.
    """

    parameters: Array
    average: Array
    first: Array
    second: Array
    step: int = 0

    def update(self, gradient: Array, *, rate: float, memory: float = 0.999) -> None:
        """Take one step.

        Args:
            gradient: Gradient of the loss.
            rate: Learning rate.
            memory: How much of the average stays; less at the beginning.
        """
        self.step += 1
        new = 1 - min(memory, (1 + self.step) / (10 + self.step))
        scratch = np.empty(min(BLOCK, len(gradient)), gradient.dtype)
        bias = np.sqrt(1 - SECOND**self.step)
        factor = rate * bias / (1 - FIRST**self.step)
        for start in range(0, len(gradient), BLOCK):
            part = slice(start, start + BLOCK)
            self._update_block(part, gradient[part], scratch, factor=factor, tiny=TINY * bias, new=new)

    def _update_block(
        self, part: slice, gradient: Array, scratch: Array, *, factor: float, tiny: float, new: float
    ) -> None:
        first, second, parameters = self.first[part], self.second[part], self.parameters[part]
        average, work = self.average[part], scratch[: len(gradient)]
        first *= FIRST
        first += np.multiply(gradient, 1 - FIRST, out=work)
        second *= SECOND
        np.multiply(gradient, gradient, out=work)
        work *= 1 - SECOND
        second += work
        np.sqrt(second, out=work)
        work += tiny
        np.divide(first, work, out=work)
        work *= factor
        parameters -= work
        np.subtract(parameters, average, out=work)
        work *= new
        average += work


def start_adam(parameters: Array) -> Adam:
    """Begin with given parameters, shape (n_parameters,)."""
    return Adam(parameters, parameters.copy(), np.zeros_like(parameters), np.zeros_like(parameters))


def learning_rate(step: int, steps: int, *, peak: float, final: float, warm_up: int) -> float:
    """Cosine from ``peak`` to ``final * peak``, after a linear warm-up.

    Args:
        step: Steps taken.
        steps: Steps of the whole run.
        peak: Largest learning rate.
        final: The last one, as a fraction of it.
        warm_up: Steps of the warm-up.
    """
    falling = 0.5 * (1 + math.cos(math.pi * min(step / steps, 1.0)))
    return peak * (final + (1 - final) * falling) * min(1.0, (step + 1) / max(warm_up, 1))
