"""Batches as a ``tf.data.Dataset``."""

from collections.abc import Iterator
from typing import Any

from cnpgen.errors import requires_extra
from cnpgen.loader.batches import Batches

with requires_extra("tensorflow", "tensorflow"):
    import tensorflow as tf


def to_tensorflow(batches: Batches) -> Any:
    """Return batches as a ``tf.data.Dataset`` of dicts; every pass yields the remaining batches of an epoch.

    TensorFlow may prefetch batches: the position is ``batches.state(epoch=...,
        batch=...)``.

    Args:
        batches: Batches from ``dataset.batches(...)``; observations are left out.
    """

    def generate() -> Iterator[dict[str, Any]]:
        return ({name: batch[name] for name in signature} for batch in batches)

    signature = {
        name: tf.TensorSpec((None, *shape), dtype)
        for name, (shape, dtype) in batches.signature.items()
    }
    return tf.data.Dataset.from_generator(generate, output_signature=signature)
