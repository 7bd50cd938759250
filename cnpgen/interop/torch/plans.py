"""Plans with gradients: control points from a network's outputs, and their loss."""

from collections.abc import Callable, Mapping
from typing import TYPE_CHECKING, Any

import torch
from numpy.typing import ArrayLike, NDArray

from cnpgen.errors import UsageError
from cnpgen.interop.host import evaluate
from cnpgen.schema.arguments import numbers

if TYPE_CHECKING:
    from cnpgen.losses.plan_loss import PlanLoss
    from cnpgen.planner.omega import Omega
    from cnpgen.planner.tasks import Tasks

Array = NDArray[Any]
Function = Callable[..., tuple[Array, ...]]


def control_points(
    omega: "Omega", tasks: "Tasks", phi: torch.Tensor, log_rate: torch.Tensor
) -> tuple[torch.Tensor, torch.Tensor]:
    """Turn a network's outputs into control points that meet the boundary conditions, differentiably (once).

    Computed on the CPU in float64. ``omega.plans`` makes plans of the same outputs, with all digits.

    Args:
        omega: The problem's block.
        tasks: N tasks, what ``omega.tasks`` returned; constants.
        phi: The network's say on the path, shape (N, ``omega.path_outputs``), on any device.
        log_rate: Its say on the rate, shape (N, ``omega.rate_outputs``).

    Returns:
        Path [rad] and rate [1/s] control points, shape (N, C, n) and (N, R), in the type of phi, at least float32.

    Raises:
        UsageError: A shape is wrong.
    """
    outputs = (_tensor("phi", phi), _tensor("log_rate", log_rate))
    omega.check_shapes(tasks, *(tuple(each.shape) for each in outputs))

    def forth(phi: Array, log_rate: Array) -> tuple[Array, Array]:
        points = omega(tasks, phi, log_rate)
        return points.path, points.rate

    def back(phi: Array, log_rate: Array, by_path: Array, by_rate: Array) -> tuple[Array, Array]:
        return omega.pull_back(tasks, phi, log_rate, path_gradient=by_path, rate_gradient=by_rate)

    path, rate = _OnHost.apply(forth, back, *(each.to("cpu", torch.float64) for each in outputs))
    dtype = torch.promote_types(outputs[0].dtype, torch.float32)
    return path.to(outputs[0].device, dtype), rate.to(outputs[0].device, dtype)


def plan_loss(
    loss: "PlanLoss",
    path: torch.Tensor,
    rate: torch.Tensor,
    *,
    weights: "torch.Tensor | ArrayLike | Mapping[str, float]",
    tops: "torch.Tensor | ArrayLike | None" = None,
    start_tip: "torch.Tensor | ArrayLike | None" = None,
    shift: float = 0.0,
) -> tuple[torch.Tensor, torch.Tensor]:
    """Evaluate a loss of N plans, differentiably (once) in control points and weights, on the CPU.

    A plan whose loss is not finite has a gradient of 0, so that it touches no other: neither through
    ``total[total.isfinite()].mean()`` nor through ``total.mean()``, which is nan itself.

    Args:
        loss: The loss; its ``dtype`` is the precision of values and gradients.
        path: Path control points [rad], shape (N, C, n), on any device, of any type.
        rate: Rate control points [1/s], shape (N, R), positive.
        weights: Weight of every constraint term (e^alpha), shape (m,); or term -> weight, as ``PlanLoss`` takes them.
        tops: Where the obstacles are, as ``obstacle_tops`` says, shape (N, numbers); a constant.
        start_tip: Positions of the tip at the start [m], shape (N, 3); a constant.
        shift: Of the quadrature nodes, in [0, 1).

    Returns:
        The totals, shape (N,), and the integrals without weights, shape (N, 1 + m), which have no gradient; both in the
        loss's precision.

    Raises:
        UsageError: A shape is wrong, or a weight is negative or not finite.
    """
    path = _tensor("path", path)
    given = (path, _tensor("rate", rate), _tensor("weights", loss.in_order(weights)))
    host = tuple(each.to("cpu", getattr(torch, loss.dtype)) for each in given)
    wanted = torch.is_grad_enabled() and (host[0].requires_grad or host[1].requires_grad)
    options = {"tops": _array(tops), "start_tip": _array(start_tip), "shift": shift, "gradient": wanted}
    total, terms, *_ = _PlanLoss.apply(loss, options, *host)
    return total.to(path.device), terms.to(path.device)


class _PlanLoss(torch.autograd.Function):  # type: ignore[misc]
    """The loss computes its gradient along with its value: backward only scales it."""

    @staticmethod
    def forward(loss: "PlanLoss", options: dict[str, Any], *arguments: torch.Tensor) -> tuple[torch.Tensor, ...]:
        found = evaluate(loss, *(each.detach().numpy() for each in arguments), **options)
        return tuple(torch.from_numpy(part) for part in found)

    @staticmethod
    def setup_context(ctx: Any, _: tuple[Any, ...], output: tuple[torch.Tensor, ...]) -> None:
        total, terms, *slopes = output
        ctx.mark_non_differentiable(terms, *slopes)
        ctx.save_for_backward(total, *slopes)

    @staticmethod
    def backward(ctx: Any, by_total: torch.Tensor, *_: torch.Tensor) -> tuple[torch.Tensor | None, ...]:
        return None, None, *_Scaled.apply(by_total, *ctx.saved_tensors)


class _Scaled(torch.autograd.Function):  # type: ignore[misc]
    """The backward pass; ``once_differentiable`` would let ``torch.func`` take gradients of gradients to be zero."""

    @staticmethod
    def forward(
        by_total: torch.Tensor,
        total: torch.Tensor,
        by_path: torch.Tensor,
        by_rate: torch.Tensor,
        by_weights: torch.Tensor,
    ) -> tuple[torch.Tensor, ...]:
        scale = torch.where(total.isfinite(), by_total, 0)[:, None]
        wanted = scale[: len(by_path)]
        return by_path * wanted[..., None], by_rate * wanted, (by_weights * scale).sum(0)

    @staticmethod
    def setup_context(*_: Any) -> None:
        """Nothing is kept."""

    @staticmethod
    def backward(_: Any, *__: torch.Tensor) -> None:
        raise UsageError("gradients of gradients of the loss are not available")


class _OnHost(torch.autograd.Function):  # type: ignore[misc]
    """A function of arrays on tensors: ``forth(*arrays)``, and ``back(*arrays, *gradients)`` for its gradient."""

    @staticmethod
    def forward(forth: Function, _: Function | None, *arguments: torch.Tensor) -> tuple[torch.Tensor, ...]:
        return tuple(torch.from_numpy(part) for part in forth(*(each.detach().numpy() for each in arguments)))

    @staticmethod
    def setup_context(ctx: Any, inputs: tuple[Any, ...], _: tuple[torch.Tensor, ...]) -> None:
        _, ctx.back, *arguments = inputs
        ctx.save_for_backward(*arguments)

    @staticmethod
    def backward(ctx: Any, *by_results: torch.Tensor) -> tuple[torch.Tensor | None, ...]:
        if ctx.back is None:
            raise UsageError("gradients of gradients of control points are not available")
        return None, None, *_OnHost.apply(ctx.back, None, *ctx.saved_tensors, *by_results)


def _tensor(name: str, values: Any) -> torch.Tensor:
    """Return a tensor of real numbers; an array becomes one.

    Raises:
        UsageError: These are no real numbers.
    """
    if not isinstance(values, torch.Tensor):
        return torch.tensor(numbers(name, values, differentiable=True))
    if values.is_complex():
        raise UsageError(f"{name} must be real numbers, got {values.dtype}")
    return values


def _array(values: Any) -> Any:
    """Return the numbers of a tensor, on any device and of any type, as an array; anything else as it is."""
    return values.detach().to("cpu", torch.float64).numpy() if isinstance(values, torch.Tensor) else values
