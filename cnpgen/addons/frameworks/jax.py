"""The bridge to JAX: batches as JAX arrays.

Control points from network outputs and their loss, which may be jitted.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import fields
from functools import partial
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from cnpgen.addons.frameworks.host_evaluation import evaluate
from cnpgen.arrays import Array
from cnpgen.errors import UsageError, requires_extra
from cnpgen.loader.batch import Batch
from cnpgen.losses.plan_loss import PlanLoss
from cnpgen.losses.quadrature import check_quadrature
from cnpgen.planner.boundary_layer import BoundaryLayer
from cnpgen.planner.tasks import Tasks
from cnpgen.robots.scene import Scene
from cnpgen.schema.arguments import number, numbers
from cnpgen.trajectory.boundary import Boundary

with requires_extra("jax", "jax"):
    import jax
    import jax.numpy as jnp

    for _kind in (Tasks, Boundary):
        # for arguments of jit
        jax.tree_util.register_dataclass(
            _kind, [field.name for field in fields(_kind)], []
        )
    jax.tree_util.register_dataclass(Scene, ["poses"], ["obstacles"])

__all__ = ["control_points", "plan_loss", "to_jax"]
_MAX_INT32 = np.iinfo(np.int32).max


def to_jax(batch: Batch, *, device: Any = None) -> dict[str, jax.Array]:
    """Return a batch as JAX arrays; ``jax.device_put(batch.table)`` transfers its packed table at once.

    Args:
        batch: The batch, which must not be written to afterwards, because JAX may use
            its memory.
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


def control_points(
    layer: BoundaryLayer, tasks: Tasks, phi: jax.Array, log_rate: jax.Array
) -> tuple[jax.Array, jax.Array]:
    """Compute control points that meet the boundary conditions from network outputs; differentiable once.

    The computation runs on the host in float64. ``layer.plans`` returns plans of the
    same outputs in float64.

    Args:
        layer: The boundary layer of the problem.
        tasks: N tasks from ``layer.tasks``; constants, but they may be an argument
            under ``jit``.
        phi: Network outputs of the path, shape (N, ``layer.path_outputs``).
        log_rate: Network outputs of the rate, shape (N, ``layer.rate_outputs``).

    Returns:
        Path [rad] and rate [1/s] control points, shape (N, C, n) and (N, R), in the
        type of phi, at least float32.

    Raises:
        UsageError: A shape is wrong.
    """
    dtype = jnp.promote_types(phi.dtype, np.float32)
    phi = _real("phi", phi, dtype)
    log_rate = _real("log_rate", log_rate, dtype)
    layer.check_shapes(tasks, phi.shape, log_rate.shape)
    path, rate = _control_points(layer, jax.tree.map(jnp.asarray, tasks), phi, log_rate)
    return path, rate


def plan_loss(
    loss: PlanLoss,
    path: jax.Array,
    rate: jax.Array,
    *,
    weights: jax.Array | ArrayLike | Mapping[str, float],
    obstacle_poses: jax.Array | ArrayLike | None = None,
    start_tip: jax.Array | ArrayLike | None = None,
    shift: jax.Array | float = 0.0,
) -> tuple[jax.Array, jax.Array]:
    """Evaluate the loss of N plans on the CPU; differentiable once in control points and weights.

    A plan whose loss is not finite has a gradient of 0, so that it does not affect
    other plans. This holds for ``jnp.where(jnp.isfinite(total), total, 0)`` and for
    ``total.mean()``, which is nan itself.

    Args:
        loss: The loss; its ``dtype`` is the precision of values and gradients.
        path: Path control points [rad], shape (N, C, n), of any type.
        rate: Rate control points [1/s], shape (N, R), positive.
        weights: Weight of every constraint term (e^alpha), shape (m,); or term ->
            weight, see ``PlanLoss``.
        obstacle_poses: Poses and sizes of the obstacles, shape (N, width). A constant
            like the following arguments, but under ``jit`` it may be an argument.
        start_tip: Positions of the tip at the start [m], shape (N, 3).
        shift: Shift of the quadrature nodes, in [0, 1); of a traced value only the
            fractional part is used.

    Returns:
        The totals, shape (N,), and the integrals without weights, shape (N, 1 + m),
        which have no gradient.

    Raises:
        UsageError: A shape or a value known at tracing time is wrong, or the loss is in
            float64 and JAX is not. Wrong traced weights raise it inside JAX's own
            error.
    """
    if loss.dtype == "float64" and not jax.config.jax_enable_x64:
        raise UsageError(
            'JAX would truncate a loss in float64: jax.config.update("jax_enable_x64", True) keeps it'
        )
    if not isinstance(shift, jax.core.Tracer):
        check_quadrature(loss.rule, loss.nodes, number("shift", shift))
    weights = loss.ordered_weights(weights)
    if not isinstance(weights, jax.core.Tracer):
        loss.checked_weights(weights)
    inputs = {
        "path": path,
        "rate": rate,
        "weights": weights,
        "obstacle_poses": obstacle_poses,
        "start_tip": start_tip,
    }
    arrays = {
        name: _real(name, values, loss.dtype)
        for name, values in inputs.items()
        if values is not None
    }
    loss.check_shapes(**{name: array.shape for name, array in arrays.items()})
    variables = [arrays.pop(name) for name in ("path", "rate", "weights")]
    total, terms = _plan_loss(
        loss, *variables, arrays | {"shift": jnp.asarray(shift, loss.dtype)}
    )
    return total, jax.lax.stop_gradient(terms)


def _check_precision(batch: Batch) -> None:
    large = [
        name
        for name, values in batch.integers.items()
        if values.size and np.abs(values).max() > _MAX_INT32
    ]
    if batch.table.dtype == np.float64 or large:
        values = f"the integers of {', '.join(large)}" if large else "float64"
        raise UsageError(
            f'JAX would truncate {values}: jax.config.update("jax_enable_x64", True) keeps all digits'
        )


def _evaluate(
    loss: PlanLoss, *, gradient: bool, arguments: tuple[Any, ...]
) -> tuple[jax.Array, ...]:
    """Call the loss on the host.

    Return totals and terms, and the gradients if requested.
    """
    path, rate, weights, _ = arguments
    n = len(path)
    m = len(weights)
    shapes = [(n,), (n, 1 + m), *([path.shape, rate.shape, (n, m)] if gradient else [])]

    def call(*arguments: Any) -> tuple[Any, ...]:
        *variables, options = jax.tree.map(np.asarray, arguments)
        # a shift just below 1 is 1 in float32, which is equivalent to 0
        options["shift"] = options["shift"].item() % 1
        return evaluate(loss, *variables, gradient=gradient, **options)[: len(shapes)]

    return _on_host(
        call, [jax.ShapeDtypeStruct(shape, loss.dtype) for shape in shapes], *arguments
    )


@partial(jax.custom_vjp, nondiff_argnums=(0,))
def _plan_loss(loss: PlanLoss, *arguments: Any) -> tuple[jax.Array, ...]:
    return _evaluate(loss, gradient=False, arguments=arguments)


def _loss_forward(
    loss: PlanLoss, *arguments: Any
) -> tuple[tuple[jax.Array, ...], tuple[Any, ...]]:
    total, terms, *gradients = _evaluate(loss, gradient=True, arguments=arguments)
    return (total, terms), (total, gradients, arguments[-1])


def _loss_backward(
    _loss: PlanLoss, residual: tuple[Any, ...], by_results: tuple[jax.Array, ...]
) -> tuple[Any, ...]:
    total, (by_path, by_rate, by_weights), options = residual
    # The loss of an invalid plan is nan, and its gradient 0.
    by_total = jnp.where(jnp.isfinite(total), by_results[0], 0)
    return (
        by_path * by_total[:, None, None],
        by_rate * by_total[:, None],
        by_total @ by_weights,
        jax.tree.map(jnp.zeros_like, options),
    )


_plan_loss.defvjp(_loss_forward, _loss_backward)


@partial(jax.custom_vjp, nondiff_argnums=(0,))
def _control_points(
    layer: BoundaryLayer, tasks: Tasks, phi: jax.Array, log_rate: jax.Array
) -> tuple[jax.Array, ...]:
    spec = layer.problem.trajectory
    shapes = (
        (len(phi), spec.path_control_points, len(layer.problem.robot.joints)),
        (len(phi), spec.rate_control_points),
    )

    def call(*arguments: Any) -> tuple[Any, ...]:
        # The layer computes in float64, whatever the type of the network.
        points = layer(*jax.tree.map(_wide, arguments))
        return points.path.astype(phi.dtype), points.rate.astype(phi.dtype)

    return _on_host(
        call,
        [jax.ShapeDtypeStruct(shape, phi.dtype) for shape in shapes],
        tasks,
        phi,
        log_rate,
    )


def _points_forward(
    layer: BoundaryLayer, *arguments: Any
) -> tuple[tuple[jax.Array, ...], tuple[Any, ...]]:
    return _control_points(layer, *arguments), arguments


def _points_backward(
    layer: BoundaryLayer, residual: tuple[Any, ...], by_results: tuple[jax.Array, ...]
) -> tuple[Any, jax.Array, jax.Array]:
    tasks, *outputs = residual

    def call(*arguments: Any) -> tuple[Any, ...]:
        *inputs, by_path, by_rate = jax.tree.map(_wide, arguments)
        gradients = layer.vjp(*inputs, path_gradient=by_path, rate_gradient=by_rate)
        return tuple(gradient.astype(outputs[0].dtype) for gradient in gradients)

    results = [jax.ShapeDtypeStruct(output.shape, output.dtype) for output in outputs]
    by_phi, by_log_rate = _on_host(call, results, *residual, *by_results)
    return jax.tree.map(jnp.zeros_like, tasks), by_phi, by_log_rate


_control_points.defvjp(_points_forward, _points_backward)


def _on_host(
    call: Callable[..., Any], results: list[Any], *arguments: Any
) -> tuple[jax.Array, ...]:
    # The callback runs in compiled functions, too, and vmap calls it once per element.
    arrays: tuple[jax.Array, ...] = jax.pure_callback(
        call, tuple(results), *arguments, vmap_method="sequential"
    )
    return arrays


def _real(name: str, values: Any, dtype: Any) -> jax.Array:
    """Return a JAX array of a float type.

    Raises:
        UsageError: The values are not real numbers.
    """
    array = (
        values
        if isinstance(values, jax.Array)
        else jnp.asarray(numbers(name, values, differentiable=True))
    )
    if jnp.iscomplexobj(array):
        raise UsageError(f"{name} must be real numbers, got {array.dtype}")
    return array.astype(dtype)


def _wide(values: Any) -> Array:
    return np.asarray(values, np.float64)
