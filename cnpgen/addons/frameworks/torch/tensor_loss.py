"""The loss of plans in torch operations, on the device of its arguments, differentiable any number of times."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import torch
from numpy.typing import ArrayLike

from cnpgen.addons.frameworks.torch.tensor_tape import TensorTape
from cnpgen.addons.frameworks.torch.torch_plans import real_tensor
from cnpgen.errors import UsageError
from cnpgen.kernels.library import choose_backend, problem_kernels
from cnpgen.losses.integrand import (
    loss_values,
    relaxation_argument,
    relaxation_of,
    time_varying_conditions,
)
from cnpgen.losses.plan_loss import PlanLoss
from cnpgen.losses.quadrature import BasisTable, basis_table
from cnpgen.problems.load_robot import load_robot
from cnpgen.schema.argument_types import checked_arguments
from cnpgen.schema.arguments import number

MAX_KEPT_TABLES = 16  # of one loss: twice the shifts of ``rotating_shift``


class TensorLoss:
    """The loss of ``PlanLoss`` without a copy to the CPU; ``plan_loss`` is faster for tensors on the CPU.

    The same operations as those of the compiled loss run in torch, so that results
    agree to rounding. Gradients are those of torch's automatic differentiation, which
    may be repeated. ``start_tip`` is read on the CPU. Problems whose obstacles samples
    place (planners of scenes) are refused: their clearance is measured on the CPU.

    Args:
        loss: The loss whose problem, nodes, rule, form and margins are used.
        compiled: Whether ``torch.compile`` fuses the operations, which takes minutes on
            first use; the gradient is then differentiable once only.

    Raises:
        UsageError: Samples place the obstacles of the problem.
    """

    @checked_arguments
    def __init__(self, loss: PlanLoss, *, compiled: bool = False) -> None:
        if loss.problem.has_sample_obstacles:
            raise UsageError(
                f"must be of a problem whose obstacles samples do not place, got that of {loss.problem.name!r}:"
                " use cnpgen.addons.frameworks.torch.plan_loss, which measures their distances on the CPU",
                argument="loss",
            )
        self.loss = loss
        robot = load_robot(loss.problem)
        kernels = problem_kernels(loss.problem, robot, *choose_backend("numpy"))
        tape = kernels.tape(loss_values, form=loss.form)
        self._tape = TensorTape(tape)
        self._relaxed_values = tape.inputs[relaxation_argument(loss.problem)]
        self._time_varying = time_varying_conditions(loss.problem, robot, loss.form)
        self._tables: dict[tuple[Any, ...], tuple[torch.Tensor, ...]] = {}  # the latest
        self._integrate = torch.compile(self._terms) if compiled else self._terms

    def __repr__(self) -> str:
        return (
            f"<TensorLoss of {self.loss.problem.name!r}: {len(self._tape)} operations>"
        )

    def __call__(
        self,
        path: torch.Tensor,
        rate: torch.Tensor,
        *,
        weights: torch.Tensor | ArrayLike | Mapping[str, float],
        obstacle_poses: torch.Tensor | ArrayLike | None = None,
        start_tip: torch.Tensor | ArrayLike | None = None,
        shift: float = 0.0,
    ) -> tuple[torch.Tensor, torch.Tensor]:
        """Evaluate the loss of N plans in the type of the path, at least float32.

        A plan that is not finite or has a rate that is not positive has a loss of nan
        and a gradient of 0, so that it does not affect other plans.

        Args:
            path: Path control points [rad], shape (N, C, n).
            rate: Rate control points [1/s], shape (N, R), positive, on the same device.
            weights: Weight of every constraint term (e^alpha), shape (m,); or term ->
                weight, see ``PlanLoss``.
            obstacle_poses: Poses and sizes of the obstacles, shape (N, width).
            start_tip: Positions of the tip at the start [m], shape (N, 3), for
                time-varying bounds; a constant.
            shift: Shift of the quadrature nodes, in [0, 1).

        Returns:
            The totals, shape (N,), and the integrals without weights, shape (N, 1 + m),
            both differentiable.

        Raises:
            UsageError: A shape is wrong, or a tensor is not real.
        """
        tensors = self._checked(
            path=path,
            rate=rate,
            weights=self.loss.ordered_weights(weights),
            obstacle_poses=obstacle_poses,
            start_tip=start_tip,
        )
        kind = {
            "device": tensors["path"].device,
            "dtype": torch.promote_types(tensors["path"].dtype, torch.float32),
        }
        path, rate, weights = (
            tensors[name].to(**kind) for name in ("path", "rate", "weights")
        )
        poses = tensors.get("obstacle_poses", path.new_zeros((len(path), 0))).to(**kind)
        relaxation = path.new_zeros((self._relaxed_values, 1, 1))
        shift = number("shift", shift)
        if start_tip is not None and self._relaxed_values:
            tip = tensors["start_tip"].detach().to("cpu", torch.float64).numpy()
            bound = relaxation_of(self._time_varying, self._basis(shift).s, tip)
            relaxation = torch.tensor(bound, **kind)
        tightening = torch.tensor(self.loss.tightening, **kind)
        arguments = (poses, relaxation, *self._table(shift, kind), tightening, weights)
        return self._evaluate(path, rate, arguments)

    def _checked(self, **arguments: Any) -> dict[str, torch.Tensor]:
        """Return the arguments that are not None as tensors with the right shapes."""
        tensors = {
            name: real_tensor(name, values)
            for name, values in arguments.items()
            if values is not None
        }
        self.loss.check_shapes(
            **{name: tuple(tensor.shape) for name, tensor in tensors.items()}
        )
        return tensors

    def _evaluate(
        self,
        path: torch.Tensor,
        rate: torch.Tensor,
        arguments: tuple[torch.Tensor, ...],
    ) -> tuple[torch.Tensor, torch.Tensor]:
        """Return totals and terms.

        Invalid plans are replaced by ones before and by nan after the evaluation.
        """
        valid = (
            (rate > 0).all(1)
            & path.isfinite().flatten(1).all(1)
            & rate.isfinite().all(1)
        )
        # Ones keep operations and gradients finite; their results are dropped.
        path = torch.where(valid[:, None, None], path, 1.0)
        rate = torch.where(valid[:, None], rate, 1.0)
        terms = self._integrate(*_FiniteGradient.apply(path, rate), *arguments)
        # Nan marks the loss of an invalid plan.
        terms = torch.where(valid[:, None], terms, torch.nan)
        return terms[:, 0] + terms[:, 1:] @ arguments[-1], terms

    def _terms(
        self, path: torch.Tensor, rate: torch.Tensor, *constants: torch.Tensor
    ) -> torch.Tensor:
        """Return the integrals, shape (N, 1 + m).

        Constants are the arguments of ``_evaluate``.
        """
        poses, relaxation, path_basis, rate_basis, nodes, tightening, weights = (
            constants
        )
        p = torch.einsum("okc,ncj->ojkn", path_basis, path)
        r = torch.einsum("okc,nc->okn", rate_basis, rate)
        fixed = (tightening[:, None, None], weights[:, None, None])
        # The tape has quadrature weights as input, so its results are the summands of
        # integrals.
        (summands,) = self._tape(
            *p.unbind(0), r, poses.T[:, None], relaxation, nodes[None, :, None], *fixed
        )
        return summands.sum(1).T

    def _table(self, shift: float, kind: dict[str, Any]) -> tuple[torch.Tensor, ...]:
        """Return the basis functions of path and rate, shape (orders, K, C), and the quadrature weights, shape (K,)."""
        key = (shift, *kind.values())
        if key not in self._tables:
            # The oldest table makes room: dictionaries keep the order of insertion.
            if len(self._tables) == MAX_KEPT_TABLES:
                self._tables.pop(next(iter(self._tables)))
            table = self._basis(shift)
            path, rate = (
                x.reshape(-1, self.loss.nodes, x.shape[1])
                for x in (table.path, table.rate)
            )
            arrays = (path, rate, table.weights[0])
            self._tables[key] = tuple(torch.tensor(array, **kind) for array in arrays)
        return self._tables[key]

    def _basis(self, shift: float) -> BasisTable:
        problem = self.loss.problem
        return basis_table(
            problem.trajectory,
            self.loss.rule,
            self.loss.nodes,
            shift,
            "float64",
            orders=problem.path_orders,
        )


class _FiniteGradient(torch.autograd.Function):  # type: ignore[misc]
    """The identity; the gradient of a plan whose gradient is not finite is 0."""

    generate_vmap_rule = True

    @staticmethod
    def forward(
        path: torch.Tensor, rate: torch.Tensor
    ) -> tuple[torch.Tensor, torch.Tensor]:
        return path.clone(), rate.clone()

    @staticmethod
    def setup_context(*_: Any) -> None:
        """Save nothing."""

    @staticmethod
    def backward(
        _: Any, by_path: torch.Tensor, by_rate: torch.Tensor
    ) -> tuple[torch.Tensor, torch.Tensor]:
        finite = by_path.isfinite().flatten(1).all(1) & by_rate.isfinite().all(1)
        return torch.where(finite[:, None, None], by_path, 0.0), torch.where(
            finite[:, None], by_rate, 0.0
        )
