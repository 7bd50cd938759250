"""Batches as JAX arrays."""

from typing import Any

import jax
import numpy as np

from cnpgen.errors import UsageError
from cnpgen.loader.batch import Batch

_MAX_INT32 = np.iinfo(np.int32).max


def to_jax(batch: Batch, *, device: Any = None) -> dict[str, jax.Array]:
    """Return a batch as JAX arrays; ``jax.device_put(batch.table)`` transfers its packed table at once.

    Args:
        batch: The batch, which must not be written to afterwards, because JAX may use its memory.
        device: Device or sharding of the arrays; JAX's default if None.

    Returns:
        Field name -> values, shape (B, width) or (B,).

    Raises:
        UsageError: Without x64, JAX would truncate float64 or integers outside int32.
    """
    if not jax.config.jax_enable_x64:
        _check_precision(batch)
    arrays = jax.device_put(dict(batch), device)
    return {name: arrays[name] for name in batch}  # JAX sorts names


def _check_precision(batch: Batch) -> None:
    large = [name for name, values in batch.integers.items() if values.size and np.abs(values).max() > _MAX_INT32]
    if batch.table.dtype == np.float64 or large:
        values = f"the integers of {', '.join(large)}" if large else "float64"
        raise UsageError(f'JAX would truncate {values}: jax.config.update("jax_enable_x64", True) keeps all digits')
