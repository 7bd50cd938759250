"""The loss of plans with its gradient: integrals of the step losses over the phase."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from cnpgen.arrays import AnyArray
from cnpgen.errors import UsageError, counted, nearest
from cnpgen.kernels.kernel import GridKernel
from cnpgen.kernels.library import Backend, choose_backend, problem_kernels
from cnpgen.kernels.tape import DTYPES, Dtype
from cnpgen.losses.hull_loss import HullLoss
from cnpgen.losses.integrand import (
    grid_specs,
    loss_gradient,
    loss_values,
    relaxation_argument,
    relaxation_of,
    time_varying_conditions,
)
from cnpgen.losses.margins import Margins, constraint_terms
from cnpgen.losses.plan_batch import (
    MAX_VECTOR_LANES,
    PLANS_PER_BLOCK,
    PlanBatch,
    check_batch,
    check_shapes,
)
from cnpgen.losses.quadrature import BasisTable, basis_table, check_quadrature
from cnpgen.machine.threads import one_thread
from cnpgen.problems.constraints.constraint import Condition, Constraint
from cnpgen.problems.load_robot import load_robot
from cnpgen.problems.problem import Problem
from cnpgen.problems.problem_record import as_problem
from cnpgen.schema.argument_types import checked_arguments
from cnpgen.schema.arguments import (
    check_choice,
    check_memory,
    flag,
    integer,
    number,
    numbers,
)
from cnpgen.store.dataset_spec import StoredProblem

FORMS = ("signed", "paper")
MAX_LOSS_THREADS = 1024
_BUILT = {"_gradient", "_values", "_time_varying", "_hulls"}


@dataclass(frozen=True)
class LossValue:
    """The losses of N plans; that of an invalid plan is nan and does not affect other plans.

    A plan is invalid if a control point is not finite or a rate control point is not
    positive. Positive rate control points are sufficient, but not necessary, for r(s) >
    0.

    Attributes:
        total: Task loss plus the weighted constraint terms, shape (N,).
        terms: The integrals without weights, the task loss first, shape (N, 1 + m).
        path_gradient: Gradient of every plan's total with respect to its path control
            points, shape (N, C, n).
        rate_gradient: Gradient of every plan's total with respect to its rate control
            points, shape (N, R).
    """

    total: AnyArray
    terms: AnyArray
    path_gradient: AnyArray
    rate_gradient: AnyArray

    def __repr__(self) -> str:
        return f"<LossValue of {counted(len(self.total), 'plan')}, {self.terms.shape[1]} terms>"


class PlanLoss:
    """``integral of (task loss + sum of weight_i Huber(violation_i)) dt`` of plans of one problem, and its gradient.

    If samples place the obstacles, their distances are those of the links' hulls, at
    every fourth node (``HullLoss``).

    Args:
        problem: The problem, its record (``plans.problem``, ``dataset.problem``), or
            the name or the file of a problem, a pipeline or a dataset.
        dtype: Precision of the arithmetic: "float32" or "float64".
        nodes: Number of quadrature nodes.
        rule: Quadrature rule: "cosine" or "gauss".
        form: "signed": every violation has a gradient; "paper": orientation and
            collisions as published.
        margins: Tightening of the bounds.
        backend: Backend of the kernels; by default the fastest that works on this
            machine.
        cache_folder: Cache of kernels; by default that of the user.
        threads: Number of threads that share the plans of a call.

    Attributes:
        terms: Names of the columns of ``LossValue.terms``: "time", then the kinds of
            the constraints.
        budgets: Acceptable violations from the problem file (the paper's C-bar^2),
            shape (m,); 0 for none.
        weights0: First weights from the problem file (the paper's e^alpha), shape (m,).
        tightening: Factors of the limits of all terms, then insets of their other
            bounds (``Margins``), shape (2 m,).

    Raises:
        UsageError: An argument has an unsupported value.
        MachineError: The requested backend does not work on this machine.
    """

    @checked_arguments
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
        threads: int = 1,
    ) -> None:
        self._threads = integer("threads", threads, least=1, most=MAX_LOSS_THREADS)
        check_choice("dtype", dtype, DTYPES)
        check_choice("form", form, FORMS)
        check_quadrature(rule, nodes)
        check_memory("nodes", nodes, nodes)
        self.problem = as_problem(problem)
        self.dtype = dtype
        self.form = form
        self.nodes = nodes
        self.rule = rule
        self.terms = ("time", *constraint_terms(self.problem))
        self.budgets = np.array(
            [constraint.budget for constraint in self.problem.constraint]
        )
        self.weights0 = np.array(
            [constraint.weight for constraint in self.problem.constraint]
        )
        self.tightening = (
            _checked_margins(margins).tightening(self.terms[1:]).astype(dtype)
        )
        self._robot = load_robot(self.problem)
        # Samples that place obstacles have them in ``HullLoss``: the kernels omit them.
        chosen, folder = choose_backend(backend)
        folder = folder if cache_folder is None else Path(cache_folder)
        self._kernels = problem_kernels(
            self.problem.for_planning, self._robot, chosen, folder
        )

    def __getstate__(self) -> dict[str, Any]:
        """Return the state without the kernels, which are loaded again when needed."""
        return {name: part for name, part in vars(self).items() if name not in _BUILT}

    @checked_arguments
    @one_thread()
    def __call__(
        self,
        path: ArrayLike,
        rate: ArrayLike,
        *,
        weights: ArrayLike | Mapping[str, float],
        obstacle_poses: ArrayLike | None = None,
        start_tip: ArrayLike | None = None,
        shift: float = 0.0,
        gradient: bool = True,
    ) -> LossValue:
        """Evaluate N plans.

        Args:
            path: Path control points [rad], shape (N, C, n).
            rate: Rate control points [1/s], shape (N, R), positive.
            weights: Weight of every constraint term (e^alpha), shape (m,); or term ->
                weight, with ``weights0`` for missing terms.
            obstacle_poses: Poses and sizes of the obstacles, shape (N, width); required
                if the problem has obstacles.
            start_tip: Positions of the tip at the start [m], shape (N, 3), for the
                time-varying bounds of motions that start off the table
                (``Constraint.bound_relaxation``). By default bounds are constant.
            shift: Shift of the quadrature nodes, see ``quadrature``.
            gradient: Whether to compute gradients; without, they have shape (0, C, n)
                and (0, R).

        Raises:
            UsageError: A shape is wrong, a value is not a real number, or a weight is
                negative, infinite or of an unknown term.
        """
        gradient = flag("gradient", gradient)
        shift = number("shift", shift)
        batch = check_batch(
            self.problem, path, rate, obstacle_poses, start_tip, dtype=self.dtype
        )
        checked = self.checked_weights(weights)
        terms, path_gradient, rate_gradient = self._evaluate(
            batch, checked, shift=shift, gradient=gradient
        )
        with np.errstate(all="ignore"):
            total = terms[:, 0] + terms[:, 1:] @ checked
        return LossValue(total, terms, path_gradient, rate_gradient)

    def _evaluate(
        self, batch: PlanBatch, weights: AnyArray, *, shift: float, gradient: bool
    ) -> tuple[AnyArray, AnyArray, AnyArray]:
        """Return terms and gradients of a batch, block by block; the gradients are empty if they are not requested."""
        spec = self.problem.trajectory
        orders = self.problem.path_orders
        table = basis_table(
            spec, self.rule, self.nodes, shift, self.dtype, orders=orders
        )
        selected = slice(None) if gradient else slice(0)
        arrays = (
            np.empty((len(batch), len(self.terms)), self.dtype),
            np.empty_like(batch.path[selected]),
            np.empty_like(batch.rate[selected]),
        )
        # Hulls, kernel and bounds are built on first use: here, before threads start.
        hulls = self._hulls
        varying = self._varying(batch, gradient=gradient)

        def evaluate_block(rows: slice) -> None:
            part = batch[rows]
            # An overflow affects its own plan only.
            with one_thread(), np.errstate(all="ignore"):
                results = self._integrate(
                    part, weights, table, varying, gradient=gradient
                )
                if hulls is not None:
                    hulls.add(results, part, weights, table, shift=shift)
                for array, values in zip(arrays, results, strict=True):
                    array[rows] = part.samples(values)

        self._run(evaluate_block, len(batch))
        return arrays

    def _run(self, evaluate_block: Callable[[slice], None], n: int) -> None:
        """Evaluate blocks of plans.

        Compiled kernels release Python's lock, so that threads run in parallel.
        """
        # Every thread gets a share, in blocks that fit the cache.
        # Whole vectors.
        share = -(-n // (self._threads * MAX_VECTOR_LANES)) * MAX_VECTOR_LANES
        size = (
            PLANS_PER_BLOCK
            if self._threads == 1
            else max(min(share, PLANS_PER_BLOCK), MAX_VECTOR_LANES)
        )
        blocks = [slice(first, first + size) for first in range(0, n, size)]
        if self._threads == 1 or len(blocks) < 2:
            for block in blocks:
                evaluate_block(block)
            return
        with ThreadPoolExecutor(self._threads) as pool:
            list(pool.map(evaluate_block, blocks))

    def load_kernels(self) -> None:
        """Load the kernel of gradients, compiling it if it is not cached.

        Otherwise the first call does.
        """
        self._kernel(gradient=True)

    def _kernel(self, *, gradient: bool) -> GridKernel:
        return self._gradient if gradient else self._values

    def _varying(
        self, batch: PlanBatch, *, gradient: bool
    ) -> list[tuple[Constraint, Condition]]:
        """Return the time-varying bounds; none if the kernel or the plans do without them."""
        # A kernel without such bounds has an empty argument.
        used = self._kernel(gradient=gradient).tape.inputs[
            relaxation_argument(self.problem)
        ]
        return self._time_varying if used and batch.start_tip is not None else []

    def _splines(
        self, batch: PlanBatch, table: BasisTable
    ) -> tuple[AnyArray, AnyArray]:
        """Return the path, shape (orders, nodes, n, N), and the rate, shape (orders - 1, nodes, N)."""
        nodes = len(table.s)
        orders = self.problem.path_orders
        points, n = batch.path.shape[1:]
        rates = batch.lanes(batch.rate)
        # Splines at all nodes by one product: rows are p, p', p'' (orders x nodes), columns
        # are joints x samples.
        path = (table.path @ batch.lanes(batch.path).reshape(points, -1)).reshape(
            orders, nodes, n, -1
        )
        return path, (table.rate @ rates).reshape(orders - 1, nodes, -1)

    def _integrate(
        self,
        batch: PlanBatch,
        weights: AnyArray,
        table: BasisTable,
        varying: list[tuple[Constraint, Condition]],
        *,
        gradient: bool,
    ) -> tuple[AnyArray, AnyArray, AnyArray]:
        """Return terms and gradients of a block, samples last.

        The gradients are empty if they are not requested.
        """
        points, n = batch.path.shape[1:]
        # Poses of obstacles that samples place are no argument of the kernels.
        poses = batch.obstacle_poses[:, : self.problem.for_planning.scene_width]
        path, rate = self._splines(batch, table)
        lanes = rate.shape[-1]
        terms = np.zeros((len(self.terms), lanes), self.dtype)
        arguments = (
            *path.swapaxes(1, 2), rate, batch.lanes(poses),
            self._relaxation(batch, table, lanes, varying, gradient=gradient), table.weights, self.tightening, weights,
        )  # fmt: skip
        if not gradient:
            self._values(*arguments, out=[terms])
            empty = ((points, n, 0), (batch.rate.shape[1], 0))
            by_path, by_rate = (np.empty(shape, self.dtype) for shape in empty)
            return terms, by_path, by_rate
        by_path = np.empty_like(path)
        by_rate = np.empty_like(rate)
        self._gradient(*arguments, out=[terms, *by_path.swapaxes(1, 2), by_rate])
        # Chain rule through the splines, which are linear in the control points: the
        # transposed products.
        by_points = table.path.T @ by_path.reshape(len(table.path), -1)
        return (
            terms,
            by_points.reshape(points, n, lanes),
            table.rate.T @ by_rate.reshape(len(table.rate), -1),
        )

    def _relaxation(
        self,
        batch: PlanBatch,
        table: BasisTable,
        lanes: int,
        varying: list[tuple[Constraint, Condition]],
        *,
        gradient: bool,
    ) -> AnyArray:
        """Return the relaxation of the conditions with time-varying bounds, shape (values, K, lanes)."""
        kernel = self._kernel(gradient=gradient)
        out = np.zeros(
            (
                kernel.tape.inputs[relaxation_argument(self.problem)],
                len(table.s),
                lanes,
            ),
            self.dtype,
        )
        if batch.start_tip is not None and len(out):
            out[..., : len(batch)] = relaxation_of(varying, table.s, batch.start_tip)
        return out

    def check_shapes(self, **shapes: tuple[int, ...]) -> None:
        """Check the shapes of arguments, for traced functions whose values are unknown.

        Args:
            shapes: Shapes of ``path``, ``rate``, ``weights`` and, if present,
                ``obstacle_poses`` and ``start_tip``.

        Raises:
            UsageError: A shape is wrong, or the obstacle poses are missing.
        """
        missing = [name for name in ("path", "rate", "weights") if name not in shapes]
        if missing or not all(isinstance(shape, tuple) for shape in shapes.values()):
            wrong = missing or [
                name for name, shape in shapes.items() if not isinstance(shape, tuple)
            ]
            raise UsageError(
                "must be the shape of an array, a tuple", argument=wrong[0]
            )
        self._check_count(shapes.pop("weights"))
        check_shapes(self.problem, shapes)

    def ordered_weights(self, weights: ArrayLike | Mapping[str, float]) -> ArrayLike:
        """Return weights by name in the order of the terms; return arrays unchanged.

        Raises:
            UsageError: There is no such term, or a weight is not a finite number.
        """
        if not isinstance(weights, Mapping):
            return weights
        names = self.terms[1:]
        unknown = next((name for name in weights if name not in names), None)
        if unknown is not None:
            hint = nearest(str(unknown), names)
            raise UsageError(
                f"there is no constraint {unknown!r}{hint}, expected some of {', '.join(names)}",
                concerns="weights",
            )
        values = {name: _weight(name, weight) for name, weight in weights.items()}
        return np.array(
            [
                values.get(name, default)
                for name, default in zip(names, self.weights0, strict=True)
            ]
        )

    def checked_weights(self, weights: ArrayLike | Mapping[str, float]) -> AnyArray:
        """Return weights in the order of the terms and in the loss's precision.

        Raises:
            UsageError: The shape is wrong, a weight is negative or not finite, or there
                is no such term.
        """
        ordered = numbers("weights", self.ordered_weights(weights), differentiable=True)
        self._check_count(ordered.shape)
        for name, weight in zip(self.terms[1:], ordered.tolist(), strict=True):
            if not 0 <= weight < np.finfo(self.dtype).max:
                raise UsageError(
                    f"the weight of {name!r} must be a number that is not negative, got {weight}",
                    concerns="weights",
                )
        return ordered.astype(self.dtype)

    def _check_count(self, shape: tuple[int, ...]) -> None:
        names = self.terms[1:]
        if shape != (len(names),):
            raise UsageError(
                f"must have shape ({len(names)},) for {', '.join(names)}, got {shape}",
                argument="weights",
            )

    @cached_property
    def _gradient(self) -> GridKernel:
        return self._kernels.load_grid(
            loss_gradient, grid_specs(self.problem)[1], dtype=self.dtype, form=self.form
        )

    @cached_property
    def _values(self) -> GridKernel:
        return self._kernels.load_grid(
            loss_values, grid_specs(self.problem)[0], dtype=self.dtype, form=self.form
        )

    @cached_property
    def _hulls(self) -> HullLoss | None:
        if not self.problem.has_sample_obstacles:
            return None
        return HullLoss(self.problem, self._robot, self._kernels, self.tightening)

    @cached_property
    def _time_varying(self) -> list[tuple[Constraint, Condition]]:
        return time_varying_conditions(self.problem, self._robot, self.form)


def _weight(name: str, value: Any) -> float:
    try:
        return number(name, value)
    except UsageError as error:
        raise UsageError(
            f"the weight of {name!r} must be a finite number, got {value!r:.100}",
            concerns="weights",
        ) from error


def _checked_margins(margins: object) -> Margins:
    if not isinstance(margins, Margins | None):
        raise UsageError(
            f"must be a Margins or None, got {margins!r:.100}", argument="margins"
        )
    return margins or Margins()
