"""Adam (Kingma and Ba, 2015) on one flat vector, in place, with an average of the parameters and clipped gradients.

A few percent of the samples violate a constraint by far. Without clipping one of them
weighs as much as hundreds of others, and Adam's average of squared gradients contains
it for a thousand steps.
"""

import math
from dataclasses import dataclass

import numpy as np

from cnpgen.arrays import AnyArray

BETA_1 = 0.9
BETA_2 = 0.999
EPSILON = 1e-8
# Small enough for the five arrays of a block to stay in the CPU cache.
PARAMETERS_PER_BLOCK = 1 << 17
SAMPLE_MEMORY = 0.98
BATCH_MEMORY = 0.99
# Of a batch's norm to the running norm, in the update of the latter.
MAX_NORM_RATIO = 3.0


@dataclass
class Adam:
    """State of the optimizer after a number of steps; all arrays have shape (n_parameters,).

    ``average`` is the exponential average of the parameters, which is validated and
    kept. ``first`` and ``second`` are the averages of the gradient and of the squared
    gradient.
    """

    parameters: AnyArray
    average: AnyArray
    first: AnyArray
    second: AnyArray
    step: int = 0

    def update(self, gradient: AnyArray, *, rate: float, memory: float = 0.999) -> None:
        """Take one step at a learning rate.

        The decay ``memory`` of the average is smaller during the first steps.
        """
        self.step += 1
        # The memory of the average grows from 2 / 11 to its limit, so that it forgets
        # the initial parameters.
        new = 1 - min(memory, (1 + self.step) / (10 + self.step))
        scratch = np.empty(min(PARAMETERS_PER_BLOCK, len(gradient)), gradient.dtype)
        # The corrected moments are m / (1 - b1^t) and v / (1 - b2^t). Both corrections
        # become factors of the step and of epsilon.
        bias = np.sqrt(1 - BETA_2**self.step)
        factor = rate * bias / (1 - BETA_1**self.step)
        for start in range(0, len(gradient), PARAMETERS_PER_BLOCK):
            part = slice(start, start + PARAMETERS_PER_BLOCK)
            self._update_block(
                part,
                gradient[part],
                scratch,
                factor=factor,
                epsilon=EPSILON * bias,
                new=new,
            )

    def _update_block(
        self,
        part: slice,
        gradient: AnyArray,
        scratch: AnyArray,
        *,
        factor: float,
        epsilon: float,
        new: float,
    ) -> None:
        first = self.first[part]
        second = self.second[part]
        parameters = self.parameters[part]
        average = self.average[part]
        work = scratch[: len(gradient)]
        # m = b1 m + (1 - b1) g
        first *= BETA_1
        first += np.multiply(gradient, 1 - BETA_1, out=work)
        # v = b2 v + (1 - b2) g^2
        second *= BETA_2
        np.multiply(gradient, gradient, out=work)
        work *= 1 - BETA_2
        second += work
        # p = p - factor m / (sqrt(v) + epsilon)
        np.sqrt(second, out=work)
        work += epsilon
        np.divide(first, work, out=work)
        work *= factor
        parameters -= work
        # average = average + new (p - average)
        np.subtract(parameters, average, out=work)
        work *= new
        average += work


def start_adam(parameters: AnyArray) -> Adam:
    """Return the initial state for parameters of shape (n_parameters,)."""
    return Adam(
        parameters,
        parameters.copy(),
        np.zeros_like(parameters),
        np.zeros_like(parameters),
    )


def learning_rate(
    step: int, steps: int, *, peak: float, final: float, warm_up: int
) -> float:
    """Return the learning rate: a cosine from ``peak`` to ``final * peak``, after a linear warm-up of some steps."""
    falling = 0.5 * (1 + math.cos(math.pi * min(step / steps, 1.0)))
    return (
        peak * (final + (1 - final) * falling) * min(1.0, (step + 1) / max(warm_up, 1))
    )


@dataclass
class Clipping:
    """Running median of the samples' gradient norms, running norm of the batch's.

    0 before the first batch.
    """

    sample: float = 0.0
    batch: float = 0.0

    def sample_factors(self, norms: AnyArray, *, limit: float) -> AnyArray:
        """Return the factors of the samples' gradients, shape (N,), in (0, 1], from their finite norms.

        The largest norm is in running medians; inf for no clipping. Factors are 1 while
        half of the gradients of every batch are zero.
        """
        median = float(np.median(norms))
        # The running median is that of the batches so far; the first one starts it.
        self.sample = (
            SAMPLE_MEMORY * self.sample + (1 - SAMPLE_MEMORY) * median
            if self.sample
            else median
        )
        if not self.sample or np.isinf(limit):
            return np.ones_like(norms)
        # A gradient longer than limit times the running median is shortened to this
        # length.
        return np.minimum(1.0, limit * self.sample / np.maximum(norms, 1e-30)).astype(
            norms.dtype
        )

    def batch_factor(self, norm: float, *, limit: float) -> float:
        """Return the factor of the batch's gradient.

        The largest norm is in running norms, inf for no clipping.
        """
        self.batch = (
            BATCH_MEMORY * self.batch
            # A single large norm does not raise the limit for the batches after it.
            + (1 - BATCH_MEMORY) * min(norm, MAX_NORM_RATIO * self.batch)
            or norm
        )
        if not self.batch or np.isinf(limit):
            return 1.0
        return min(1.0, limit * self.batch / max(norm, 1e-30))
