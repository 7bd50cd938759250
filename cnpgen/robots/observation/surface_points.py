"""Seeds of the points of clouds."""

import numpy as np
from numpy.typing import NDArray

Seeds = NDArray[np.uint64]

_GOLDEN, _FIRST, _SECOND = (
    np.uint64(x) for x in (0x9E3779B97F4A7C15, 0xBF58476D1CE4E5B9, 0x94D049BB133111EB)
)


def mixed(values: Seeds) -> Seeds:
    """Hash 64-bit integers by the finalizer of splitmix64 (Steele et al. 2014)."""
    with np.errstate(over="ignore"):
        x = np.asarray(values, np.uint64) + _GOLDEN
        x = (x ^ x >> np.uint64(30)) * _FIRST
        x = (x ^ x >> np.uint64(27)) * _SECOND
    return np.asarray(x ^ x >> np.uint64(31))


def scene_seeds(seed: int, count: int) -> Seeds:
    """Return the seeds of scenes, shape (count,)."""
    # The seed of a scene depends on its index, not on the number of scenes.
    return mixed(
        mixed(np.full(count, seed, np.uint64)) ^ np.arange(count, dtype=np.uint64)
    )
