"""How the learning rate and the progress of a run follow from the step alone, so that a resumed run is the same run."""

import math


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
