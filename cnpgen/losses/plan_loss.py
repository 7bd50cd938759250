"""The loss of plans with its gradient: integrals of the step losses over the phase."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from cnpgen.errors import UsageError, counted, nearest
from cnpgen.kernels.grid import GridKernel
from cnpgen.kernels.library import Backend, choose_backend, problem_kernels
from cnpgen.kernels.tape import DTYPES, Dtype
from cnpgen.losses.funnel import Funnel, make_funnel
from cnpgen.losses.integrand import grid_specs, loss_gradient, loss_values, wider_argument
from cnpgen.losses.margins import Margins
from cnpgen.losses.plan_batch import BLOCK, PlanBatch, check_batch, check_shapes
from cnpgen.losses.quadrature import BasisTable, basis_table, check_quadrature
from cnpgen.machine.threads import one_thread
from cnpgen.problems.problem import Problem
from cnpgen.problems.record import as_problem
from cnpgen.problems.robot import load_robot
from cnpgen.schema import registry
from cnpgen.schema.arguments import flag, number, numbers
from cnpgen.store.blueprint import StoredProblem

Array = NDArray[Any]
FORMS = ("signed", "paper")
_BUILT = {"_gradient", "_values", "_funnel"}


@dataclass(frozen=True)
class LossValue:
    """What N plans cost. A plan that is none costs nan, and no other is touched.

    A plan is none if a control point is not finite, or a control point of the rate not positive: r(s) lies between the
    least and the largest of them, so that positive ones are enough, though not needed, for a motion that runs forward.

    Attributes:
        total: Task loss plus the weighted constraint terms, shape (N,).
        terms: The integrals without weights, the task loss first, shape (N, 1 + m).
        path_gradient: Gradient of every plan's total with respect to its path control points, shape (N, C, n).
        rate_gradient: Likewise with respect to its rate control points, shape (N, R).
    """

    total: Array
    terms: Array
    path_gradient: Array
    rate_gradient: Array

    def __repr__(self) -> str:
        return f"<LossValue of {counted(len(self.total), 'plan')}, {self.terms.shape[1]} terms>"


class PlanLoss:
    """``integral of (task loss + sum of weight_i Huber(violation_i)) dt`` of plans of one problem, and its gradient.

    Args:
        problem: The problem, its record (``plans.problem``, ``dataset.problem``), or the name or the file of a problem,
            a pipeline or a dataset.
        dtype: "float32" or "float64": what is computed with.
        nodes: Number of quadrature nodes.
        rule: Quadrature rule: "cosine" or "gauss".
        form: "signed": every violation has a gradient; "paper": orientation and collisions as the paper has them.
        margins: How much tighter than the problem's the bounds are.
        backend: Which kernels run; by default the fastest that works here.
        cache_folder: Where kernels are kept; by default where all are.

    Attributes:
        terms: "time", then the kind of every constraint of the problem: what the columns of ``LossValue.terms`` are.
        budgets: Acceptable violations from the problem file (the paper's C-bar^2), shape (m,); 0 where it has none.
        weights0: First weights from the problem file (the paper's e^alpha), shape (m,).

    Raises:
        UsageError: An argument is none of what it may be.
        MachineError: The backend that was asked for does not work here.
    """

    def __init__(
        self,
        problem: Problem | StoredProblem | str | Path,
        *,
        dtype: Dtype = "float32",
        nodes: int = 64,
        rule: str = "cosine",
        form: str = "signed",
        margins: Margins | None = None,
        backend: Backend | None = None,
        cache_folder: str | Path | None = None,
    ) -> None:
        _check_choice("dtype", dtype, DTYPES)
        _check_choice("form", form, FORMS)
        check_quadrature(rule, nodes)
        self.problem, self.dtype, self.nodes, self.rule, self.form = as_problem(problem), dtype, nodes, rule, form
        self.terms = ("time", *_names(self.problem))
        self.budgets = np.array([constraint.budget for constraint in self.problem.constraint])
        self.weights0 = np.array([constraint.weight for constraint in self.problem.constraint])
        self._tightening = _checked_margins(margins).tightening(self.terms[1:]).astype(dtype)
        self._robot = load_robot(self.problem)
        chosen, folder = choose_backend(backend)
        folder = folder if cache_folder is None else Path(cache_folder)
        self._kernels = problem_kernels(self.problem, self._robot, chosen, folder)

    def __getstate__(self) -> dict[str, Any]:
        """Leave out what was built for this process; it is built again when it is needed."""
        return {name: part for name, part in vars(self).items() if name not in _BUILT}

    @one_thread()
    def __call__(
        self,
        path: ArrayLike,
        rate: ArrayLike,
        *,
        weights: ArrayLike | Mapping[str, float],
        tops: ArrayLike | None = None,
        start_tip: ArrayLike | None = None,
        shift: float = 0.0,
        gradient: bool = True,
    ) -> LossValue:
        """Evaluate N plans.

        Args:
            path: Path control points [rad], shape (N, C, n).
            rate: Rate control points [1/s], shape (N, R), positive.
            weights: Weight of every constraint term (e^alpha), shape (m,); or term -> weight, where terms that are not
                named keep the problem's, ``weights0``.
            tops: Where the obstacles are, as ``obstacle_tops`` says, shape (N, numbers); needed where there are any.
            start_tip: Positions of the tip at the start [m], shape (N, 3): motions that start off the table are then
                given the way to it that ``Constraint.funnel`` says; by default they must be on it at once.
            shift: Of the quadrature nodes, see ``quadrature``.
            gradient: Whether gradients are wanted; without, theirs are arrays of no plan, shape (0, C, n) and (0, R).

        Raises:
            UsageError: A shape is wrong, something is no real number, or a weight is negative, infinite or of no term.
        """
        gradient, shift = flag("gradient", gradient), number("shift", shift)
        batch = check_batch(self.problem, path, rate, tops, start_tip, dtype=self.dtype)
        scales = self.checked_weights(weights)
        orders = self.problem.path_orders
        table = basis_table(self.problem.trajectory, self.rule, self.nodes, shift, self.dtype, orders=orders)
        n, wanted = len(batch), slice(None) if gradient else slice(0)
        terms = np.empty((n, len(self.terms)), self.dtype)
        path_gradient, rate_gradient = np.empty_like(batch.path[wanted]), np.empty_like(batch.rate[wanted])
        with np.errstate(all="ignore"):  # what overflows is infinite or nan in its own plan
            for rows in (slice(first, first + BLOCK) for first in range(0, n, BLOCK)):
                part = batch[rows]
                results = self._integrate(part, scales, table, gradient=gradient)
                terms[rows], path_gradient[rows], rate_gradient[rows] = (part.back(values) for values in results)
            total = terms[:, 0] + terms[:, 1:] @ scales
        return LossValue(total, terms, path_gradient, rate_gradient)

    def load_kernels(self) -> None:
        """Load what gradients are computed with, compiling it where it is not cached; else the first call does."""
        self._gradient  # noqa: B018 - loaded when it is first asked for

    def _integrate(
        self, batch: PlanBatch, weights: Array, table: BasisTable, *, gradient: bool
    ) -> tuple[Array, Array, Array]:
        """Return terms and gradients of a block, samples last; those of no plan if they are not wanted."""
        nodes, orders, (points, n) = len(table.s), self.problem.path_orders, batch.path.shape[1:]
        rates = batch.lanes(batch.rate)
        lanes = rates.shape[1]
        path = (table.path @ batch.lanes(batch.path).reshape(points, -1)).reshape(orders, nodes, n, lanes)
        rate = (table.rate @ rates).reshape(orders - 1, nodes, lanes)
        terms = np.zeros((len(self.terms), lanes), self.dtype)
        arguments = (
            *path.swapaxes(1, 2), rate, batch.lanes(batch.tops), self._wider(batch, table, lanes, gradient=gradient),
            table.weights, self._tightening, weights,
        )  # fmt: skip
        if not gradient:
            self._values(*arguments, out=[terms])
            return terms, np.empty((points, n, 0), self.dtype), np.empty((len(batch.rate[0]), 0), self.dtype)
        by_path, by_rate = np.empty_like(path), np.empty_like(rate)
        self._gradient(*arguments, out=[terms, *by_path.swapaxes(1, 2), by_rate])
        back = table.path.T @ by_path.reshape(orders * nodes, -1)
        return terms, back.reshape(points, n, lanes), table.rate.T @ by_rate.reshape((orders - 1) * nodes, -1)

    def _wider(self, batch: PlanBatch, table: BasisTable, lanes: int, *, gradient: bool) -> Array:
        """How much wider than their bounds the conditions with a funnel are, shape (values, K, lanes)."""
        kernel = self._gradient if gradient else self._values
        out = np.zeros((kernel.tape.inputs[wider_argument(self.problem)], len(table.s), lanes), self.dtype)
        if batch.start_tip is not None and len(out):
            out[..., : len(batch)] = self._funnel.width(table.s, batch.start_tip)
        return out

    def check_shapes(self, **shapes: tuple[int, ...]) -> None:
        """Refuse arguments by their shapes alone, as bridges do where values are not known yet.

        Args:
            shapes: Those of ``path``, ``rate``, ``weights`` and, where they are given, ``tops`` and ``start_tip``.

        Raises:
            UsageError: A shape is wrong, or what says where the obstacles are is missing.
        """
        self._check_count(shapes.pop("weights"))
        check_shapes(self.problem, shapes)

    def in_order(self, weights: ArrayLike | Mapping[str, float]) -> ArrayLike:
        """Return weights by name in the order of the terms; others are returned as they are.

        Raises:
            UsageError: There is no such term, or a weight is no finite number.
        """
        if not isinstance(weights, Mapping):
            return weights
        names = self.terms[1:]
        unknown = next((name for name in weights if name not in names), None)
        if unknown is not None:
            hint = nearest(str(unknown), names)
            raise UsageError(f"weights: there is no constraint {unknown!r}{hint}, expected some of {', '.join(names)}")
        given = {name: number(f"the weight of {name!r}", weight) for name, weight in weights.items()}
        return np.array([given.get(name, first) for name, first in zip(names, self.weights0, strict=True)])

    def checked_weights(self, weights: ArrayLike | Mapping[str, float]) -> Array:
        """Return weights in the order of the terms and in the loss's precision.

        Raises:
            UsageError: The shape is wrong, a weight is negative or not finite, or there is no such term.
        """
        given = numbers("weights", self.in_order(weights), differentiable=True)
        self._check_count(given.shape)
        for name, weight in zip(self.terms[1:], given.tolist(), strict=True):
            if not 0 <= weight < np.finfo(self.dtype).max:
                raise UsageError(f"the weight of {name!r} must be a number that is not negative, got {weight}")
        return given.astype(self.dtype)

    def _check_count(self, shape: tuple[int, ...]) -> None:
        names = self.terms[1:]
        if shape != (len(names),):
            raise UsageError(f"weights must have shape ({len(names)},) for {', '.join(names)}, got {shape}")

    @cached_property
    def _gradient(self) -> GridKernel:
        return self._kernels.load_grid(loss_gradient, grid_specs(self.problem)[1], dtype=self.dtype, form=self.form)

    @cached_property
    def _values(self) -> GridKernel:
        return self._kernels.load_grid(loss_values, grid_specs(self.problem)[0], dtype=self.dtype, form=self.form)

    @cached_property
    def _funnel(self) -> Funnel:
        return make_funnel(self.problem, self._robot, self.form)


def _check_choice(name: str, value: object, known: Sequence[str]) -> None:
    if value not in known:
        raise UsageError(f"{name} must be one of {', '.join(known)}, got {value!r}{nearest(str(value), known)}")


def _checked_margins(margins: object) -> Margins:
    if not isinstance(margins, Margins | None):
        raise UsageError(f"margins must be a Margins or None, got {margins!r:.100}")
    return margins or Margins()


def _names(problem: Problem) -> list[str]:
    """Name the constraint terms by their kinds; the second of a kind is called kind-2, and so on."""
    names: list[str] = []
    for constraint in problem.constraint:
        kind = registry.name_of(registry.CONSTRAINTS, type(constraint))
        count = 1 + sum(type(other) is type(constraint) for other in problem.constraint[: len(names)])
        names.append(kind if count == 1 else f"{kind}-{count}")
    return names
