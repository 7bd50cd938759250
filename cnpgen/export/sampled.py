"""A plan at evenly spaced moments."""

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from cnpgen.trajectory.motion import Motion

Array = NDArray[np.float64]

LEAST_STEP = 0.01  # the last step may be this part of a step; what would be shorter is joined to the step before


@dataclass(frozen=True)
class Sampled:
    """A plan sampled at K moments.

    Attributes:
        t: Times [s], shape (K,), strictly increasing from 0 to the duration.
        q: Joint positions [rad], shape (K, n).
        dq: Joint velocities [rad/s], shape (K, n).
        ddq: Joint accelerations [rad/s^2], shape (K, n).
        jerk: Joint jerks [rad/s^3], shape (K, n).
    """

    t: Array
    q: Array
    dq: Array
    ddq: Array
    jerk: Array


def sample_plan(motion: Motion, rate: float) -> Sampled:
    """Sample one motion at ``rate`` [Hz], and at its last instant."""
    duration = float(motion.duration()[0])
    count = max(math.ceil(duration * rate - LEAST_STEP), 1)
    t = np.append(np.arange(count) / rate, duration)
    states = motion.at(motion.phase_at(t[None]))
    return Sampled(t, states.q[0], states.dq[0], states.ddq[0], states.jerk[0])
