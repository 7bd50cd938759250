"""Differentiable plans in torch: control points from network outputs, and their loss."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any

import torch
from numpy.typing import ArrayLike

from cnpgen.addons.frameworks.host_evaluation import evaluate
from cnpgen.arrays import AnyArray
from cnpgen.errors import UsageError
from cnpgen.losses.plan_loss import PlanLoss
from cnpgen.planner.boundary_layer import BoundaryLayer
from cnpgen.planner.tasks import Tasks
from cnpgen.schema.arguments import numbers

Function = Callable[..., tuple[AnyArray, ...]]


def control_points(
    layer: BoundaryLayer, tasks: Tasks, phi: torch.Tensor, log_rate: torch.Tensor
) -> tuple[torch.Tensor, torch.Tensor]:
    """Compute control points that meet the boundary conditions from network outputs; differentiable once.

    The computation runs on the CPU in float64. ``layer.plans`` returns plans of the
    same outputs in float64.

    Args:
        layer: The boundary layer of the problem.
        tasks: N tasks from ``layer.tasks``; constants.
        phi: Network outputs of the path, shape (N, ``layer.path_outputs``), on any
            device.
        log_rate: Network outputs of the rate, shape (N, ``layer.rate_outputs``).

    Returns:
        Path [rad] and rate [1/s] control points, shape (N, C, n) and (N, R), in the
        type of phi, at least float32.

    Raises:
        UsageError: A shape is wrong.
    """
    outputs = (real_tensor("phi", phi), real_tensor("log_rate", log_rate))
    layer.check_shapes(tasks, *(tuple(output.shape) for output in outputs))

    def function(phi: AnyArray, log_rate: AnyArray) -> tuple[AnyArray, AnyArray]:
        points = layer(tasks, phi, log_rate)
        return points.path, points.rate

    def vjp(
        phi: AnyArray, log_rate: AnyArray, by_path: AnyArray, by_rate: AnyArray
    ) -> tuple[AnyArray, AnyArray]:
        return layer.vjp(
            tasks, phi, log_rate, path_gradient=by_path, rate_gradient=by_rate
        )

    path, rate = _HostFunction.apply(
        function, vjp, *(output.to("cpu", torch.float64) for output in outputs)
    )
    dtype = torch.promote_types(outputs[0].dtype, torch.float32)
    return path.to(outputs[0].device, dtype), rate.to(outputs[0].device, dtype)


def plan_loss(
    loss: PlanLoss,
    path: torch.Tensor,
    rate: torch.Tensor,
    *,
    weights: torch.Tensor | ArrayLike | Mapping[str, float],
    obstacle_poses: torch.Tensor | ArrayLike | None = None,
    start_tip: torch.Tensor | ArrayLike | None = None,
    shift: float = 0.0,
) -> tuple[torch.Tensor, torch.Tensor]:
    """Evaluate the loss of N plans on the CPU; differentiable once in control points and weights.

    A plan whose loss is not finite has a gradient of 0, so that it does not affect
    other plans. This holds for ``total[total.isfinite()].mean()`` and for
    ``total.mean()``, which is nan itself.

    Args:
        loss: The loss; its ``dtype`` is the precision of values and gradients.
        path: Path control points [rad], shape (N, C, n), on any device, of any type.
        rate: Rate control points [1/s], shape (N, R), positive.
        weights: Weight of every constraint term (e^alpha), shape (m,); or term ->
            weight, see ``PlanLoss``.
        obstacle_poses: Poses and sizes of the obstacles, shape (N, width); a constant,
            within ``torch.func`` an array.
        start_tip: Positions of the tip at the start [m], shape (N, 3); a constant,
            within ``torch.func`` an array.
        shift: Shift of the quadrature nodes, in [0, 1).

    Returns:
        The totals, shape (N,), and the integrals without weights, shape (N, 1 + m),
        which have no gradient; both in the precision of the loss.

    Raises:
        UsageError: A shape is wrong, or a weight is negative or not finite.
    """
    path = real_tensor("path", path)
    inputs = (
        path,
        real_tensor("rate", rate),
        real_tensor("weights", loss.ordered_weights(weights)),
    )
    host = tuple(tensor.to("cpu", getattr(torch, loss.dtype)) for tensor in inputs)
    gradient = torch.is_grad_enabled() and (
        host[0].requires_grad or host[1].requires_grad
    )
    options = {
        "obstacle_poses": _array(obstacle_poses),
        "start_tip": _array(start_tip),
        "shift": shift,
        "gradient": gradient,
    }
    total, terms, *_ = _PlanLoss.apply(loss, options, *host)
    return total.to(path.device), terms.to(path.device)


class _PlanLoss(torch.autograd.Function):  # type: ignore[misc]
    """The loss with its gradient, which forward computes and backward only scales."""

    @staticmethod
    def forward(
        loss: PlanLoss, options: dict[str, Any], *arguments: torch.Tensor
    ) -> tuple[torch.Tensor, ...]:
        results = evaluate(
            loss, *(tensor.detach().numpy() for tensor in arguments), **options
        )
        return tuple(torch.from_numpy(result) for result in results)

    @staticmethod
    def setup_context(
        ctx: Any, _: tuple[Any, ...], output: tuple[torch.Tensor, ...]
    ) -> None:
        total, terms, *gradients = output
        ctx.mark_non_differentiable(terms, *gradients)
        ctx.save_for_backward(total, *gradients)

    @staticmethod
    def backward(
        ctx: Any, by_total: torch.Tensor, *_: torch.Tensor
    ) -> tuple[torch.Tensor | None, ...]:
        return None, None, *_Scaled.apply(by_total, *ctx.saved_tensors)


class _Scaled(torch.autograd.Function):  # type: ignore[misc]
    """The backward pass; with ``once_differentiable``, ``torch.func`` would take second derivatives as zero."""

    @staticmethod
    def forward(
        by_total: torch.Tensor,
        total: torch.Tensor,
        by_path: torch.Tensor,
        by_rate: torch.Tensor,
        by_weights: torch.Tensor,
    ) -> tuple[torch.Tensor, ...]:
        scale = torch.where(total.isfinite(), by_total, 0)[:, None]
        selected = scale[: len(by_path)]
        return (
            by_path * selected[..., None],
            by_rate * selected,
            (by_weights * scale).sum(0),
        )

    @staticmethod
    def setup_context(*_: Any) -> None:
        """Save nothing."""

    @staticmethod
    def backward(_: Any, *__: torch.Tensor) -> None:
        raise UsageError("gradients of gradients of the loss are not available")


class _HostFunction(torch.autograd.Function):  # type: ignore[misc]
    """A NumPy function on tensors: ``function(*arrays)`` and its ``vjp(*arrays, *gradients)``."""

    @staticmethod
    def forward(
        function: Function, _: Function | None, *arguments: torch.Tensor
    ) -> tuple[torch.Tensor, ...]:
        results = function(*(tensor.detach().numpy() for tensor in arguments))
        return tuple(torch.from_numpy(result) for result in results)

    @staticmethod
    def setup_context(
        ctx: Any, inputs: tuple[Any, ...], _: tuple[torch.Tensor, ...]
    ) -> None:
        _, ctx.vjp_on_host, *arguments = inputs
        ctx.save_for_backward(*arguments)

    @staticmethod
    def backward(
        ctx: Any, *by_results: torch.Tensor
    ) -> tuple[torch.Tensor | None, ...]:
        if ctx.vjp_on_host is None:
            raise UsageError(
                "gradients of gradients of control points are not available"
            )
        return (
            None,
            None,
            *_HostFunction.apply(
                ctx.vjp_on_host, None, *ctx.saved_tensors, *by_results
            ),
        )


def real_tensor(name: str, values: Any) -> torch.Tensor:
    """Return values as a tensor of real numbers.

    Raises:
        UsageError: The values are not real numbers.
    """
    if not isinstance(values, torch.Tensor):
        return torch.tensor(numbers(name, values, differentiable=True))
    if values.is_complex():
        raise UsageError(f"{name} must be real numbers, got {values.dtype}")
    return values


def _array(values: Any) -> Any:
    """Return a tensor on any device as a float64 array.

    Return other values unchanged.
    """
    return (
        values.detach().to("cpu", torch.float64).numpy()
        if isinstance(values, torch.Tensor)
        else values
    )
