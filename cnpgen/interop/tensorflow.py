"""Batches as a ``tf.data.Dataset``."""

from collections.abc import Iterator
from typing import Any

from cnpgen.loader.batches import Batches

try:
    import tensorflow as tf
except ImportError as error:
    raise ImportError(f"tensorflow cannot be imported ({error}): pip install tensorflow") from error


def to_tensorflow(batches: Batches) -> Any:
    """Give batches as a ``tf.data.Dataset`` of dicts: every pass gives the rest of an epoch.

    TensorFlow may take batches ahead of their use: the position is ``batches.state(epoch=..., batch=...)``.

    Args:
        batches: What ``dataset.batches(...)`` returned.
    """

    def generate() -> Iterator[dict[str, Any]]:
        return map(dict, batches)

    signature = {name: tf.TensorSpec((None, *shape), dtype) for name, (shape, dtype) in batches.signature.items()}
    return tf.data.Dataset.from_generator(generate, output_signature=signature)
