"""The bridge to JAX: batches as its arrays, the loss as a differentiable function that may be jitted."""

from functools import partial
from typing import TYPE_CHECKING, Any

import jax
import jax.numpy as jnp
import numpy as np

from cnpgen.errors import UsageError
from cnpgen.loader.batch import Batch

if TYPE_CHECKING:
    from cnpgen.losses.plan_loss import PlanLoss

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


def plan_loss(
    loss: "PlanLoss", path: jax.Array, rate: jax.Array, *, weights: jax.Array, **options: Any
) -> tuple[jax.Array, jax.Array]:
    """Evaluate a loss of N plans, differentiably (once) in control points and weights, on the CPU.

    Args:
        loss: The loss; its ``dtype`` is the precision of values and gradients.
        path: Path control points [rad], shape (N, C, n).
        rate: Rate control points [1/s], shape (N, R), positive.
        weights: Weight of every constraint term (e^alpha), shape (m,).
        options: ``tops``, ``start_tip``, ``shift`` of :class:`cnpgen.losses.plan_loss.PlanLoss`; constants, but under
            ``jit`` they may be arguments.

    Returns:
        The totals, shape (N,), and the integrals without weights, shape (N, 1 + m), which have no gradient.

    Raises:
        UsageError: The loss is in float64 and JAX is not.
    """
    if loss.dtype == "float64" and not jax.config.jax_enable_x64:
        raise UsageError('JAX would shorten a loss in float64: jax.config.update("jax_enable_x64", True) keeps it')
    given = {name: jnp.asarray(value) for name, value in options.items() if value is not None}
    total, terms = _plan_loss(loss, path, rate, weights, given)
    return total, jax.lax.stop_gradient(terms)


def _evaluate(loss: "PlanLoss", *, gradient: bool, arguments: tuple[Any, ...]) -> tuple[jax.Array, ...]:
    """Call the loss on the host; return totals and terms, and the gradients if they are wanted."""
    path, rate, weights, _ = arguments
    shapes = [(len(path),), (len(path), 1 + len(weights)), *([path.shape, rate.shape] if gradient else [])]

    def call(path: Any, rate: Any, weights: Any, given: dict[str, Any]) -> tuple[Any, ...]:
        extra: dict[str, Any] = {
            name: np.asarray(value) if np.ndim(value) else float(value) for name, value in given.items()
        }
        value = loss(np.asarray(path), np.asarray(rate), weights=np.asarray(weights), gradient=gradient, **extra)
        return (value.total, value.terms, value.path_gradient, value.rate_gradient)[: len(shapes)]

    results = [jax.ShapeDtypeStruct(shape, loss.dtype) for shape in shapes]
    found: tuple[jax.Array, ...] = jax.pure_callback(call, tuple(results), *arguments, vmap_method="sequential")
    return found


@partial(jax.custom_vjp, nondiff_argnums=(0,))
def _plan_loss(loss: "PlanLoss", *arguments: Any) -> tuple[jax.Array, ...]:
    return _evaluate(loss, gradient=False, arguments=arguments)


def _forward(loss: "PlanLoss", *arguments: Any) -> tuple[tuple[jax.Array, ...], tuple[Any, ...]]:
    total, terms, by_path, by_rate = _evaluate(loss, gradient=True, arguments=arguments)
    return (total, terms), (by_path, by_rate, terms, *arguments)


def _backward(_loss: "PlanLoss", residual: tuple[Any, ...], by_results: tuple[jax.Array, ...]) -> tuple[Any, ...]:
    by_path, by_rate, terms, path, rate, weights, given = residual
    by_total = by_results[0]
    return (
        (by_path * by_total[:, None, None]).astype(path.dtype),
        (by_rate * by_total[:, None]).astype(rate.dtype),
        (by_total @ terms[:, 1:]).astype(weights.dtype),
        jax.tree.map(jnp.zeros_like, given),
    )


_plan_loss.defvjp(_forward, _backward)
