"""A transcription with some of its residuals as the nonlinear programme that CasADi's solvers ask for."""

from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from cnpgen.refine.casadi.callbacks import Callbacks
from cnpgen.refine.solver.bounds import Bounds
from cnpgen.refine.solver.hessian import lagrangian_hessian
from cnpgen.refine.solver.transcription import Linearisation, Transcription

Array = NDArray[np.float64]


class Programme:
    """Objective and held residuals as vectors and sparse matrices, evaluated once per x.

    Args:
        motion: The transcription.
        bounds: Bounds of its residuals.
        held: Residuals that the programme holds, shape (K, m).
        x: Any variables: where derivatives vanish by structure is found out there.

    Attributes:
        callbacks: Its functions.
        lower: Lower bounds of the held residuals.
        upper: Upper bounds.
    """

    def __init__(self, motion: Transcription, bounds: Bounds, held: NDArray[np.bool_], x: Array) -> None:
        self.motion, self.callbacks, self._bounds = motion, Callbacks(), bounds
        self._k, self._which = np.nonzero(held)
        self.lower, self.upper = bounds.lower[held], bounds.upper[held]
        self._last: Linearisation | None = None
        self._row, self._column = self._pattern(x)

    def at(self, x: Array) -> Linearisation:
        """Evaluate, or remember."""
        if self._last is None or not np.array_equal(self._last.x, x):
            self._last = self.motion.evaluate(x)
        return self._last

    def violation(self, x: Array) -> float:
        """Worst violation of the held residuals."""
        g = self.held(self.at(x).g)
        worst = float(np.maximum(g - self.upper, self.lower - g).max(initial=0.0))
        return worst if np.isfinite(worst) else np.inf

    def multipliers(self, held: Array) -> Array:
        """Return multipliers of held residuals among zeros for the others, shape (K, m)."""
        every = np.zeros(self._bounds.lower.shape)
        every[self._k, self._which] = held
        return every

    def held(self, every: Array) -> Array:
        """Return those of (K, m) values that belong to held residuals."""
        return every[self._k, self._which]

    def problem(self) -> dict[str, Any]:
        """Return x, f and g as ``casadi.nlpsol`` takes them."""
        import casadi as ca

        nx, m, dense, wrap = self.motion.nx, len(self.lower), ca.Sparsity.dense, self.callbacks.wrap
        x, one, many = dense(nx, 1), dense(1, 1), dense(m, 1)
        pattern = ca.Sparsity.triplet(m, nx, self._row.tolist(), self._column.tolist())
        gradient = wrap("gradient", [x, one], dense(1, nx), lambda x, _: self.at(x).gradient)
        jacobian = wrap("jacobian", [x, many], pattern, lambda x, _: self._jacobian(x))
        value = wrap("value", [x], one, lambda x: self.at(x).cost, slope=gradient)
        residuals = wrap("residuals", [x], many, lambda x: self.held(self.at(x).g), slope=jacobian)
        symbol = ca.MX.sym("x", nx)
        return {"x": symbol, "f": value(symbol), "g": residuals(symbol)}

    def hessian(self, *, proximal: float | None = None) -> Any:
        """Return the option ``hess_lag``.

        Args:
            proximal: Weight of the proximal term that stands in the place of the residuals' curvature; None for the
                Hessian of the Lagrangian itself, of which ipopt takes the upper triangle.
        """
        import casadi as ca

        nx, m, dense = self.motion.nx, len(self.lower), ca.Sparsity.dense
        output = dense(nx, nx) if proximal is not None else ca.Sparsity.upper(nx)
        row, column = (np.array(each) for each in output.get_triplet())

        def compute(x: Array, _: Array, weight: Array, held: Array) -> Array:
            at = self.at(x)
            if proximal is not None:
                return np.asarray((weight * at.curvature + proximal * np.eye(nx))[row, column])
            hessian = lagrangian_hessian(self.motion, at, self.multipliers(held), float(weight[0]))
            return np.asarray(hessian[row, column])

        inputs = [dense(nx, 1), ca.Sparsity(0, 0), dense(1, 1), dense(m, 1)]
        wrapped = self.callbacks.wrap("curvature", inputs, output, compute)
        symbols = [ca.MX.sym(name, *pattern.shape) for name, pattern in zip("xpfg", inputs, strict=True)]
        name = "hess_gamma_x_x" if proximal is not None else "triu_hess_gamma_x_x"
        return ca.Function("nlp_hess_l", symbols, [wrapped(*symbols)], ["x", "p", "lam_f", "lam_g"], [name])

    def _jacobian(self, x: Array) -> Array:
        rows = self.motion.rows(self.at(x), self._k, self._which)
        return np.asarray(rows[self._row, self._column])

    def _pattern(self, x: Array) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
        """Rows and columns of derivatives that are not always zero, in CasADi's order, column by column.

        A residual that depends on a part of w anywhere along either of two motions may do so everywhere.
        """
        near = x + 0.01 * np.sin(np.arange(len(x)))
        depends = np.logical_or.reduce([(self.motion.evaluate(each).jacobian != 0).any(axis=2) for each in (x, near)])
        random = np.random.default_rng(0).uniform(1, 2, (*depends.shape, len(self._bounds.lower)))
        generic = replace(self.at(x), jacobian=depends[..., None] * random)
        row, column = np.nonzero(self.motion.rows(generic, self._k, self._which))
        order = np.lexsort((row, column))
        return row[order], column[order]
