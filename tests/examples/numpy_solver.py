"""The step of the solver in NumPy and DAQP: the reference of ``step.c`` and ``active_set.c``."""

from dataclasses import dataclass
from functools import cached_property, partial

import numpy as np
from numpy.typing import NDArray
from numpy_transcription import (
    Linearization,
    evaluate,
    linearization_errors,
    regularized_values,
    residual_gradients,
)

from cnpgen.arrays import Array, Mask
from cnpgen.refine.solver.bounds import Bounds
from cnpgen.refine.solver.qp_subproblem import (
    ELASTIC_CURVATURE_ROOT,
    ELASTIC_GRADIENT,
    MAX_SPEED_DISTANCE,
    MAX_WORKING_SET_CHANGES,
    MIN_MULTIPLIER,
    QP_TOLERANCE,
    ResidualSelection,
    Step,
    local_maxima,
)
from cnpgen.refine.solver.transcription import Transcription, cache_last

Indices = NDArray[np.intp]
DAQP_INFINITY = 1e30  # DAQP's value of no bound
DAQP_LOWER, DAQP_UPPER = 3, 1  # DAQP's codes of initially active bounds


class NumpyBackend:
    """Evaluations and subproblems of a motion within its bounds, in NumPy and DAQP."""

    def __init__(self, motion: Transcription, bounds: Bounds) -> None:
        self._motion, self._bounds = motion, bounds
        # After a rejected step the iterate is the same.
        self._evaluate = cache_last(partial(evaluate, motion))

    def value(self, x: Array) -> tuple[float, Array, float]:
        """Evaluate the regularized objective, residuals (K, m) and their largest violation."""
        cost, g = regularized_values(self._motion, x)
        return cost, g, self._bounds.max_violation(g)

    def subproblem(
        self,
        x: Array,
        g: Array,
        selection: ResidualSelection,
        *,
        proximal: float,
        penalty: float,
    ) -> "NumpySubproblem":
        """Build the subproblem at x with residuals g.

        It is valid until the next one is built.
        """
        at, bounds, distance = self._evaluate(x), self._bounds, selection.max_distance
        violations, errors = (
            bounds.violations(g),
            linearization_errors(self._motion, at, selection.max_log_rate_change),
        )
        distances = np.where(
            bounds.accelerated, distance, min(distance, MAX_SPEED_DISTANCE)
        )
        # A residual takes part if it is a local maximum near its bound, if it is not
        # smooth and a change of the rate could move it over its bound, if a rejected step
        # violated it, or if it was active in the last program.
        selected: Mask = local_maxima(violations) & (violations > -distances)
        selected |= bounds.nonsmooth & (violations > -errors)
        selected |= selection.missed
        if selection.multipliers is not None:
            selected |= selection.multipliers != 0
        return NumpySubproblem(
            self._motion,
            at,
            self._bounds,
            selected,
            selection.violation,
            proximal,
            penalty,
        )


@dataclass(frozen=True)
class NumpySubproblem:
    """Quadratic model of the objective and linear model of the selected residuals, solved by DAQP."""

    motion: Transcription
    at: Linearization
    bounds: Bounds
    selected: Mask  # residuals in the programs, shape (K, m)
    violation: float  # the largest one at the iterate
    proximal: float  # weight of the proximal term
    penalty: float  # weight of the violation

    def solve(
        self, box: Array, *, warm: Array | None = None, relax: bool = False
    ) -> Step | None:
        """Return the best step within the box of largest changes, shape (nx,), or None without a solution.

        ``warm`` are the multipliers of the residuals in the initial working set, shape
        (K, m). With ``relax`` satisfied residuals may be violated, too, up to the
        remaining largest violation.
        """
        import daqp

        nx, unwhiten = self.motion.nx, self._unwhiten
        if unwhiten is None:
            return None
        k, residual = np.nonzero(self.selected)
        rows, low, high = self._rows(k, residual, unwhiten, relax=relax)
        sense = np.zeros(nx + 1 + len(k), np.int32)
        # The active residuals of the last program are the initial working set: a positive
        # multiplier belongs to an upper bound, a negative one to a lower bound.
        if warm is not None:
            before = warm[k, residual]
            sense[nx + 1 :] = DAQP_UPPER * (before > MIN_MULTIPLIER) + DAQP_LOWER * (
                before < -MIN_MULTIPLIER
            )
        elastic_cost = self.penalty * self.violation + ELASTIC_GRADIENT
        solution, _, flag, info = daqp.solve(
            np.eye(nx + 1),
            np.append(
                self.at.gradient @ unwhiten, elastic_cost / ELASTIC_CURVATURE_ROOT
            ),
            rows,
            np.concatenate([box, [1.0], np.minimum(high, DAQP_INFINITY)]),
            np.concatenate([-box, [0.0], np.maximum(low, -DAQP_INFINITY)]),
            sense,
            primal_tol=QP_TOLERANCE,
            iter_limit=MAX_WORKING_SET_CHANGES,
        )
        dx = unwhiten @ solution[:-1]
        if flag < 1 or not np.isfinite(dx).all():
            return None
        # gain = -(f' d + d (H + rho I) d / 2); ``curvature`` lacks the proximal term
        multipliers = np.zeros(self.at.g.shape)
        multipliers[k, residual] = info["lam"][nx + 1 :]
        cost = float(
            self.at.gradient @ dx
            + 0.5 * dx @ self.at.curvature @ dx
            + 0.5 * self.proximal * dx @ dx
        )
        return Step(
            dx, float(solution[-1]) / ELASTIC_CURVATURE_ROOT, multipliers, gain=-cost
        )

    @cached_property
    def _unwhiten(self) -> Array | None:
        """Matrix from variables with unit Hessian to steps, shape (nx, nx).

        None if the Hessian is not positive.
        """
        from scipy.linalg.lapack import dpotrf, dtrtri

        hessian = self.at.curvature.copy()
        hessian.flat[:: len(hessian) + 1] += self.proximal
        factor, failed = dpotrf(hessian, lower=True)
        return None if failed else np.asarray(dtrtri(factor, lower=True)[0].T)

    def _rows(
        self, k: Indices, residual: Indices, unwhiten: Array, *, relax: bool
    ) -> tuple[Array, Array, Array]:
        """Return gradients of box, elastic variable and residuals, (nx + 1 + m, nx + 1), and bounds of their change."""
        g, lower, upper = (
            self.at.g[k, residual],
            self.bounds.lower[k, residual],
            self.bounds.upper[k, residual],
        )
        nx = self.motion.nx
        rows = np.zeros((nx + 1 + len(k), nx + 1))
        rows[:nx, :-1] = unwhiten
        np.matmul(
            residual_gradients(self.motion, self.at, k, residual),
            unwhiten,
            out=rows[nx + 1 :, :-1],
        )
        rows[nx, -1] = 1 / ELASTIC_CURVATURE_ROOT
        elastic = rows[nx + 1 :, -1]
        # Relaxed: every residual may exceed its closer bound by e v, not only violated ones.
        if relax:
            upper_is_closer = upper - g < g - lower
            elastic[:] = (
                np.where(upper_is_closer, -self.violation, self.violation)
                / ELASTIC_CURVATURE_ROOT
            )
            low = np.where(upper_is_closer, -DAQP_INFINITY, lower - g)
            return rows, low, np.where(upper_is_closer, upper - g, DAQP_INFINITY)
        # A violated residual keeps only the bound that it violates, relaxed by e times the
        # violation; its other bound is far away and would only slow the program down.
        above, below = np.maximum(g - upper, 0), np.maximum(lower - g, 0)
        elastic[:] = (below - above) / ELASTIC_CURVATURE_ROOT
        return (
            rows,
            np.where(above > 0, -DAQP_INFINITY, lower - g),
            np.where(below > 0, DAQP_INFINITY, upper - g),
        )
