"""Batches as arrays of JAX."""

from typing import Any

import jax
import numpy as np

from cnpgen.errors import UsageError
from cnpgen.loader.batch import Batch

_LARGEST = np.iinfo(np.int32).max


def to_jax(batch: Batch, *, device: Any = None) -> dict[str, jax.Array]:
    """Give a batch as JAX arrays; ``jax.device_put(batch.table)`` gives its packed table in one transfer.

    Args:
        batch: The batch; not to be written to any more, for JAX may go on using its memory.
        device: Device or sharding to put the arrays on; JAX's default if None.

    Returns:
        Field name -> values, shape (B, width) or (B,).

    Raises:
        UsageError: JAX would silently drop digits: float64, or integers that do not fit into int32, without x64.
    """
    if not jax.config.jax_enable_x64:
        _check_digits(batch)
    arrays = jax.device_put(dict(batch), device)
    return {name: arrays[name] for name in batch}  # JAX sorts names


def _check_digits(batch: Batch) -> None:
    large = [name for name, values in batch.integers.items() if values.size and np.abs(values).max() > _LARGEST]
    if batch.table.dtype == np.float64 or large:
        what = f"the integers of {', '.join(large)}" if large else "float64"
        raise UsageError(f'JAX would shorten {what}: jax.config.update("jax_enable_x64", True) keeps all digits')
