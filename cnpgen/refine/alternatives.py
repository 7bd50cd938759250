"""CasADi's own solvers on the same transcription, for users who want them or want to compare."""

from typing import Any

import numpy as np
from numpy.typing import NDArray

from cnpgen.refine.sqp import Bounds, Result, Settings
from cnpgen.refine.transcription import Evaluation, Transcription

Array = NDArray[np.float64]
PATIENCE = 5  # these solvers take smaller steps: they may take this many times as many


def minimise_with(motion: Transcription, bounds: Bounds, x: Array, settings: Settings, *, solver: str) -> Result:
    """Minimise from x with ``ipopt`` (limited-memory Hessian) or ``sqpmethod`` (Gauss-Newton Hessian, DAQP).

    Args:
        motion: The transcription.
        bounds: Bounds of its residuals.
        x: First variables, shape (nx,).
        settings: Number of iterations and tolerances; trust region and proximal term are the own solver's alone.
        solver: Name of the CasADi plug-in.
    """
    import casadi as ca

    model = _Model(motion, bounds, x)
    value, constraints = _callbacks(ca, model)
    symbol = ca.MX.sym("x", motion.nx)
    programme = {"x": symbol, "f": value(symbol), "g": constraints(symbol)}
    limit = max(PATIENCE * settings.max_iterations, 0)
    options = _options(solver, limit, settings)
    if solver == "sqpmethod":
        options["hess_lag"] = _curvature(ca, model, settings.proximal)
    function = ca.nlpsol("refine", solver, programme, options)
    best = _Best(model)
    best.offer(x)
    try:
        found = function(x0=x, lbg=model.lower, ubg=model.upper)
    except RuntimeError:  # a plug-in that stops on numbers that it cannot bear: what it began with is still there
        found = {"x": ca.DM(x)}
    if model.interruption is not None:
        raise model.interruption
    best.offer(np.asarray(found["x"], float).ravel())
    iterations = int(function.stats().get("iter_count", 0))
    at, violation = best.found
    return Result(at.x, at.cost, violation, iterations)


class _Model:
    """Objective and bounded residuals as vectors and matrices, evaluated once per x."""

    def __init__(self, motion: Transcription, bounds: Bounds, x: Array) -> None:
        self.motion, self.bounds = motion, bounds
        self.kept: list[Any] = []  # CasADi does not keep its callbacks alive
        self._k, self._which = np.nonzero(np.isfinite(bounds.lower) | np.isfinite(bounds.upper))
        self.lower, self.upper = bounds.lower[self._k, self._which], bounds.upper[self._k, self._which]
        self._last: Evaluation | None = None
        self.interruption: BaseException | None = None  # CasADi drops what is raised in its callbacks
        near = x + 0.01 * np.sin(np.arange(len(x)))  # nowhere special: what is zero here, too, is zero everywhere
        self.row, self.column = np.nonzero((self._dense(x) != 0) | (self._dense(near) != 0))
        order = np.lexsort((self.row, self.column))  # CasADi stores columns
        self.row, self.column = self.row[order], self.column[order]

    def at(self, x: Array) -> Evaluation:
        if self._last is None or not np.array_equal(self._last.x, x):
            self._last = self.motion.evaluate(x)
        return self._last

    def residuals(self, x: Array) -> Array:
        return self.at(x).g[self._k, self._which]

    def jacobian(self, x: Array) -> Array:
        """Derivatives of the residuals at ``row`` and ``column``."""
        return self._dense(x)[self.row, self.column]

    def curvature(self, x: Array, proximal: float) -> Array:
        return self.at(x).curvature + proximal * np.eye(self.motion.nx)

    def _dense(self, x: Array) -> Array:
        return self.motion.rows(self.at(x), self._k, self._which)


class _Best:
    """The better of two ends: smaller violation, then smaller cost."""

    def __init__(self, model: _Model) -> None:
        self._model = model
        self.found: tuple[Evaluation, float] = None  # type: ignore[assignment]

    def offer(self, x: Array) -> None:
        at = self._model.at(x)
        violation = self._model.bounds.violation(at.g)
        if self.found is None or (violation, at.cost) < (self.found[1], self.found[0].cost):
            self.found = at, violation


def _wrap(  # noqa: PLR0917
    ca: Any, model: _Model, name: str, inputs: list[Any], output: Any, compute: Any, slope: Any = None
) -> Any:
    """Wrap a NumPy function of x as a CasADi function.

    Args:
        ca: CasADi.
        model: What keeps the function alive, and what is raised in it.
        name: Name of the function.
        inputs: Sparsity patterns of its arguments; the first is x, the others are ignored.
        output: Sparsity pattern of its result.
        compute: x -> the result's nonzeros, column by column.
        slope: The wrapped Jacobian, a function of x and the result, or None.
    """

    class Wrapped(ca.Callback):  # type: ignore[misc]
        def __init__(self) -> None:
            ca.Callback.__init__(self)
            self.construct(name, {})

        def get_n_in(self) -> int:
            return len(inputs)

        def get_n_out(self) -> int:
            return 1

        def get_sparsity_in(self, index: int) -> Any:
            return inputs[index]

        def get_sparsity_out(self, _: int) -> Any:
            return output

        def has_jacobian(self) -> bool:
            return slope is not None

        def get_jacobian(self, *_: Any) -> Any:
            return slope

        def eval(self, arguments: list[Any]) -> list[Any]:
            try:
                return [ca.DM(output, compute(np.asarray(arguments[0], float).ravel()))]
            except BaseException as error:
                model.interruption = error
                raise

    model.kept.append(Wrapped())
    return model.kept[-1]


def _callbacks(ca: Any, model: _Model) -> tuple[Any, Any]:
    """Wrap objective and residuals."""
    nx, m, dense = model.motion.nx, len(model.lower), ca.Sparsity.dense
    x, one, many = dense(nx, 1), dense(1, 1), dense(m, 1)
    pattern = ca.Sparsity.triplet(m, nx, model.row.tolist(), model.column.tolist())
    gradient = _wrap(ca, model, "gradient", [x, one], dense(1, nx), lambda at: model.at(at).gradient)
    jacobian = _wrap(ca, model, "jacobian", [x, many], pattern, model.jacobian)
    value = _wrap(ca, model, "value", [x], one, lambda at: model.at(at).cost, gradient)
    return value, _wrap(ca, model, "constraints", [x], many, model.residuals, jacobian)


def _curvature(ca: Any, model: _Model, proximal: float) -> Any:
    """Wrap the Gauss-Newton Hessian in the place of the Lagrangian's."""
    nx, m, dense = model.motion.nx, len(model.lower), ca.Sparsity.dense
    inputs = [dense(nx, 1), ca.Sparsity(0, 0), dense(1, 1), dense(m, 1)]
    hessian = _wrap(ca, model, "hessian", inputs, dense(nx, nx), lambda x: model.curvature(x, proximal).ravel())
    x, p, f, g = ca.MX.sym("x", nx), ca.MX.sym("p", 0, 0), ca.MX.sym("lam_f"), ca.MX.sym("lam_g", m)
    names = (["x", "p", "lam_f", "lam_g"], ["hess_gamma_x_x"])
    return ca.Function("nlp_hess_l", [x, p, f, g], [hessian(x, p, f, g)], *names)


def _options(solver: str, limit: int, settings: Settings) -> dict[str, Any]:
    quiet = {"print_time": False, "error_on_fail": False}
    if solver == "ipopt":
        ipopt = {
            "print_level": 0,
            "sb": "yes",
            "hessian_approximation": "limited-memory",
            "limited_memory_max_history": 20,
            "max_iter": limit,
            "tol": settings.cost_tolerance / 10,
            "constr_viol_tol": settings.violation_tolerance,
            "acceptable_tol": settings.cost_tolerance,
        }
        return {**quiet, "ipopt": ipopt}
    return {
        **quiet,
        "qpsol": "daqp",
        "qpsol_options": {"error_on_fail": False, "print_time": False},
        "max_iter": limit,
        "tol_pr": settings.violation_tolerance,
        "tol_du": settings.cost_tolerance * 10,
        "print_header": False,
        "print_iteration": False,
        "print_status": False,
    }
