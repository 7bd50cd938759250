"""Ipopt on the refiner's transcription, with the Hessian of the Lagrangian, for the comparison of plans.

A program with every residual on the grid costs Ipopt's linear solver 0.2 s a step, and most residuals are far from
their bounds. The program therefore contains those on a coarser grid and at local maxima. Residuals that the result of a
run violates are added, and the next run continues.
"""

import copy
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from typing import Any

import casadi as ca
import numpy as np
from numpy.typing import NDArray
from numpy_transcription import Linearization, evaluate, residual_gradients

from cnpgen.refine.grid_levels import GridLevel
from cnpgen.refine.refiner import Refiner
from cnpgen.refine.solver.bounds import Bounds
from cnpgen.refine.solver.hulls import Hulls
from cnpgen.refine.solver.sqp import Result, Settings
from cnpgen.refine.solver.transcription import Transcription
from cnpgen.refine.task import RefinementTask

Array = NDArray[np.float64]
Indices = NDArray[np.intp]
ITERATION_FACTOR = 6  # of the refiner's iteration limit: Ipopt takes smaller steps
MAX_RUNS = 6
COARSE_POINTS = 32  # phases of the coarser grid
MAX_PEAK_DISTANCE = 0.03  # of local maxima in the program from their bounds
MAX_GRID_DISTANCE = (
    1.0  # of residuals on the coarser grid from their bounds: obstacles 0.1 m away
)
CONVERGED_ITERATES = 8  # with hardly changing objectives, which end a run
FIRST_TOLERANCE, LATER_TOLERANCE = (
    1.0,
    0.1,
)  # of these changes, in multiples of the refiner's tolerance
MAX_WARM_VIOLATION = 0.05  # of an initial guess for a warm start
WARM_OPTIONS = {
    "mu_strategy": "monotone",
    "mu_init": 1e-6,
    "warm_start_init_point": "yes",
    "warm_start_bound_push": 1e-5,
    "warm_start_slack_bound_push": 1e-5,
    "warm_start_slack_bound_frac": 1e-5,
    "warm_start_mult_bound_push": 1e-6,
}
DIFFERENCE_STEP = 1e-5  # of central differences, relative to the largest value along the motion: errors of 1e-9
MIN_STATE = 1e-2  # smallest value for these steps


def with_ipopt(refiner: Refiner) -> Refiner:
    """Return a refiner whose levels are run by Ipopt, with the same guesses, levels, bounds and verdicts."""

    def run_level(
        task: RefinementTask, level: GridLevel, x: Array, hulls: Hulls | None = None
    ) -> Result:
        assert hulls is None, "Ipopt keeps capsules clear, not hulls"
        motion = refiner.transcription(task, level)
        bounds = refiner.bounds(task, level, motion.end_residuals())
        return minimize_with_ipopt(motion, bounds, x, level.settings)

    other = copy.copy(refiner)
    other.run_level = run_level  # type: ignore[method-assign, assignment]
    return other


@np.errstate(all="ignore")  # Ipopt takes back steps to nan
def minimize_with_ipopt(
    motion: Transcription, bounds: Bounds, x: Array, settings: Settings
) -> Result:
    """Minimize from x until no residual outside the program is violated.

    Args:
        motion: The transcription.
        bounds: Bounds of its residuals.
        x: Initial variables, shape (nx,).
        settings: Number of iterations and tolerances; other settings are not used.
    """
    best = Best(bounds, settings.violation_tolerance)
    selected, multipliers = (
        np.zeros(bounds.lower.shape, bool),
        np.zeros(bounds.lower.shape),
    )
    limit, steps, end = ITERATION_FACTOR * settings.max_iterations, 0, x
    for number in range(MAX_RUNS):
        at = evaluate(motion, end)
        violation = bounds.max_violation(at.g)
        best.offer(end, at.cost, violation)
        if steps >= limit or (number > 1 and violation < settings.violation_tolerance):
            break
        selected |= choose_residuals(at.g, bounds)
        best.begin(
            settings.cost_tolerance * (LATER_TOLERANCE if number else FIRST_TOLERANCE)
        )
        program = Program(motion, bounds, selected, end)
        options = ipopt_options(
            settings, limit - steps, warm=number > 0 or violation < MAX_WARM_VIOLATION
        )
        end, multipliers, taken = run(program, best, end, multipliers, options)
        steps += taken
    return Result(best.x, best.cost, best.violation, steps, steps < limit)


@dataclass
class Best:
    """Best iterate so far, and the convergence of a run.

    Attributes:
        bounds: Bounds of all residuals, in the program or not.
        tolerance: Violation of a feasible iterate.
        x: The best variables: feasible or of the smallest violation, then of the smallest cost.
        cost: Objective there.
        violation: Worst violation there.
        costs: Objectives of the run's iterates, nan where one violates the program.
        min_change: Relative change of the objective that ends the run.
    """

    bounds: Bounds
    tolerance: float
    x: Array = field(default_factory=lambda: np.empty(0))
    cost: float = np.inf
    violation: float = np.inf
    costs: list[float] = field(default_factory=list)
    min_change: float = 0.0

    def begin(self, min_change: float) -> None:
        """Start a run that ends where the objective changes relatively by less than ``min_change``."""
        self.costs, self.min_change = [], min_change

    def offer(self, x: Array, cost: float, violation: float) -> None:
        """Compare an iterate with the best one."""
        if not self.x.size or (max(violation, self.tolerance), cost) < (
            max(self.violation, self.tolerance),
            self.cost,
        ):
            self.x, self.cost, self.violation = x, cost, violation

    def observe(self, program: "Program", x: Array) -> float:
        """Record an iterate of a run; return 1 to end it."""
        at = program.at(x)
        self.offer(x, at.cost, self.bounds.max_violation(at.g))
        self.costs.append(at.cost if program.violation(x) < self.tolerance else np.nan)
        last = self.costs[-CONVERGED_ITERATES:]
        return float(
            len(last) == CONVERGED_ITERATES
            and max(last) - min(last) < self.min_change * at.cost
        )


def choose_residuals(g: Array, bounds: Bounds) -> NDArray[np.bool_]:
    """Choose the residuals of a program, shape (K, m): on a coarser grid, nonsmooth ones, and local maxima."""
    violations = bounds.violations(g)
    outer = np.pad(violations, [(1, 1), (0, 0)], constant_values=-np.inf)
    peak = np.pad(
        (violations >= outer[:-2])
        & (violations >= outer[2:])
        & (violations > -MAX_PEAK_DISTANCE),
        [(1, 1), (0, 0)],
    )
    chosen = peak[:-2] | peak[1:-1] | peak[2:] | bounds.nonsmooth
    every = max(len(g) // COARSE_POINTS, 1)
    chosen[::every] |= violations[::every] > -MAX_GRID_DISTANCE
    return np.asarray(chosen & (np.isfinite(bounds.lower) | np.isfinite(bounds.upper)))


def ipopt_options(settings: Settings, limit: int, *, warm: bool) -> dict[str, Any]:
    """Return the options of a run."""
    return {
        "print_level": 0,
        "sb": "yes",
        "mumps_scaling": 0,  # with the next one, half the time of the factorization
        "mumps_permuting_scaling": 0,
        "max_iter": limit,
        "tol": settings.cost_tolerance
        / 500,  # the barrier adds this, times the active residuals, to the objective
        "constr_viol_tol": settings.violation_tolerance / 2,
        **(WARM_OPTIONS if warm else {"mu_strategy": "adaptive"}),
    }


def run(
    program: "Program",
    best: Best,
    x: Array,
    multipliers: Array,
    options: dict[str, Any],
) -> tuple[Array, Array, int]:
    """Run Ipopt once; return where it ended, the multipliers (K, m), and its number of steps."""
    shapes = {
        "x": len(x),
        "f": 1,
        "g": len(program.lower),
        "lam_x": len(x),
        "lam_g": len(program.lower),
    }
    inputs = [
        ca.Sparsity.dense(shapes.get(ca.nlpsol_out(i), 0), 1)
        for i in range(ca.nlpsol_n_out())
    ]
    callback = program.wrap(
        "observe",
        inputs,
        ca.Sparsity.dense(1, 1),
        lambda x, *_: best.observe(program, x),
    )
    quiet = {"print_time": False, "error_on_fail": False, "show_eval_warnings": False}
    solver = {
        **quiet,
        "ipopt": options,
        "hess_lag": program.hessian(),
        "iteration_callback": callback,
    }
    function = ca.nlpsol("refine", "ipopt", program.problem(), solver)
    solution = function(
        x0=x, lbg=program.lower, ubg=program.upper, lam_g0=program.select(multipliers)
    )
    if program.raised:
        raise program.raised[0]
    end = np.array(solution["x"].nonzeros())
    if not np.isfinite(program.at(end).g).all():
        return best.x, multipliers, max(len(best.costs), 1)
    steps = int(function.stats().get("iter_count", 0))
    return (
        end,
        program.multipliers(np.array(solution["lam_g"].nonzeros())),
        max(steps, 1),
    )


class Program:
    """Objective and selected residuals as vectors and sparse matrices, evaluated once per x.

    Args:
        motion: The transcription.
        bounds: Bounds of its residuals.
        selected: Mask of the residuals in the program, shape (K, m).
        x: Variables at which the sparsity of the derivatives is determined.

    Attributes:
        lower: Lower bounds of the selected residuals.
        upper: Upper bounds.
        raised: Errors in its functions, which Ipopt ignores.
    """

    def __init__(
        self,
        motion: Transcription,
        bounds: Bounds,
        selected: NDArray[np.bool_],
        x: Array,
    ) -> None:
        self.motion, self._bounds = motion, bounds
        self._k, self._residual = np.nonzero(selected)
        self.lower, self.upper = bounds.lower[selected], bounds.upper[selected]
        self.raised: list[BaseException] = []
        self._functions: list[Any] = []  # CasADi holds no reference
        self._last: Linearization | None = None
        self._row, self._column = self._pattern(x)

    def at(self, x: Array) -> Linearization:
        """Evaluate at x, or return the last evaluation."""
        if self._last is None or not np.array_equal(self._last.x, x):
            self._last = evaluate(self.motion, x)
        return self._last

    def violation(self, x: Array) -> float:
        """Return the largest violation of the selected residuals."""
        g = self.select(self.at(x).g)
        worst = float(np.maximum(g - self.upper, self.lower - g).max(initial=0.0))
        return worst if np.isfinite(worst) else np.inf

    def multipliers(self, selected: Array) -> Array:
        """Return multipliers of selected residuals among zeros for the others, shape (K, m)."""
        every = np.zeros(self._bounds.lower.shape)
        every[self._k, self._residual] = selected
        return every

    def select(self, every: Array) -> Array:
        """Return those of (K, m) values that belong to selected residuals."""
        return every[self._k, self._residual]

    def problem(self) -> dict[str, Any]:
        """Return x, f and g as ``casadi.nlpsol`` takes them."""
        nx, m, dense = self.motion.nx, len(self.lower), ca.Sparsity.dense
        x, one, many = dense(nx, 1), dense(1, 1), dense(m, 1)
        pattern = ca.Sparsity.triplet(m, nx, self._row.tolist(), self._column.tolist())
        gradient = self.wrap(
            "gradient", [x, one], dense(1, nx), lambda x, _: self.at(x).gradient
        )
        jacobian = self.wrap(
            "jacobian", [x, many], pattern, lambda x, _: self._jacobian(x)
        )
        value = self.wrap(
            "value", [x], one, lambda x: self.at(x).cost, gradient=gradient
        )
        residuals = self.wrap(
            "residuals",
            [x],
            many,
            lambda x: self.select(self.at(x).g),
            gradient=jacobian,
        )
        symbol = ca.MX.sym("x", nx)
        return {"x": symbol, "f": value(symbol), "g": residuals(symbol)}

    def hessian(self) -> Any:
        """Return the option ``hess_lag``: the upper triangle of the Hessian of the Lagrangian."""
        nx, m, dense = self.motion.nx, len(self.lower), ca.Sparsity.dense
        output = ca.Sparsity.upper(nx)
        row, column = (np.array(indices) for indices in output.get_triplet())

        def compute(x: Array, _: Array, weight: Array, selected: Array) -> Array:
            full = lagrangian_hessian(
                self.motion, self.at(x), self.multipliers(selected), float(weight[0])
            )
            return np.asarray(full[row, column])

        inputs = [dense(nx, 1), ca.Sparsity(0, 0), dense(1, 1), dense(m, 1)]
        wrapped = self.wrap("curvature", inputs, output, compute)
        symbols = [
            ca.MX.sym(name, *pattern.shape)
            for name, pattern in zip("xpfg", inputs, strict=True)
        ]
        names = ["x", "p", "lam_f", "lam_g"], ["triu_hess_gamma_x_x"]
        return ca.Function("nlp_hess_l", symbols, [wrapped(*symbols)], *names)

    def wrap(
        self,
        name: str,
        inputs: list[Any],
        output: Any,
        compute: Callable[..., Any],
        *,
        gradient: Any = None,
    ) -> Any:
        """Wrap a NumPy function of vectors of nonzeros as a CasADi function; ``gradient`` is its wrapped Jacobian."""
        raised = self.raised

        class Wrapped(ca.Callback):
            def __init__(self) -> None:
                ca.Callback.__init__(self)
                self.construct(name, {})

            def get_n_in(self) -> int:
                return len(inputs)

            def get_sparsity_in(self, index: int) -> Any:
                return inputs[index]

            def get_sparsity_out(self, _: int) -> Any:
                return output

            def has_jacobian(self) -> bool:
                return gradient is not None

            def has_jac_sparsity(self, *_: int) -> bool:
                return gradient is not None

            def get_jac_sparsity(self, *_: Any) -> Any:
                return gradient.sparsity_out(0)

            def get_jacobian(self, *_: Any) -> Any:
                return gradient

            def eval(self, arguments: Any) -> list[Any]:
                try:
                    return [
                        ca.DM(
                            output,
                            compute(
                                *(
                                    np.array(argument.nonzeros())
                                    for argument in arguments
                                )
                            ),
                        )
                    ]
                except BaseException as error:
                    raised.append(error)
                    raise

        self._functions.append(Wrapped())
        return self._functions[-1]

    def _jacobian(self, x: Array) -> Array:
        rows = residual_gradients(self.motion, self.at(x), self._k, self._residual)
        return np.asarray(rows[self._row, self._column])

    def _pattern(self, x: Array) -> tuple[Indices, Indices]:
        """Return rows and columns of derivatives that are not always zero, in CasADi's order, column by column.

        A residual that depends on an entry of w at any phase of two motions is assumed to depend on it everywhere.
        """
        close = x + 0.01 * np.sin(np.arange(len(x)))
        depends = np.logical_or.reduce(
            [
                (evaluate(self.motion, variables).jacobian != 0).any(axis=2)
                for variables in (x, close)
            ]
        )
        random = np.random.default_rng(0).uniform(
            1, 2, (*depends.shape, len(self._bounds.lower))
        )
        generic = replace(self.at(x), jacobian=depends[..., None] * random)
        row, column = np.nonzero(
            residual_gradients(self.motion, generic, self._k, self._residual)
        )
        order = np.lexsort((row, column))
        return row[order], column[order]


def lagrangian_hessian(
    motion: Transcription, at: Linearization, multipliers: Array, weight: float = 1.0
) -> Array:
    """Return the Hessian of ``weight * objective + multipliers . residuals``, shape (nx, nx).

    With w(x) the state of the splines at a phase and g(w) the residuals there, it is the sum over phases of
    ``(dw/dx)^T (lambda . d2g/dw2) dw/dx + (lambda . dg/dw) . d2w/dx2``. The objective's share is the positive
    semidefinite model of ``Linearization.curvature``; w depends on x linearly but for the logarithms of the rate.

    Args:
        motion: The transcription.
        at: Linearization of the motion.
        multipliers: Multipliers of the residuals, shape (K, m); phases without multipliers are skipped.
        weight: Multiplier of the objective.
    """
    points = np.flatnonzero(multipliers.any(axis=1))
    hessian: Array = weight * at.curvature
    if len(points) == 0:
        return hessian
    width = len(at.jacobian)
    projected = node_hessians(motion, at, multipliers[points].T, points)
    unit = np.broadcast_to(np.eye(width)[:, :, None], (width, width, len(at.g)))
    gradients = residual_gradients(
        motion,
        replace(at, jacobian=unit),
        np.repeat(points, width),
        np.tile(np.arange(width), len(points)),
    )
    gradients = gradients.reshape(len(points), width, motion.nx)
    inner = gradients.reshape(-1, motion.nx).T @ (projected @ gradients).reshape(
        -1, motion.nx
    )
    outer = rate_hessian(motion, at, multipliers, points)
    return hessian + (inner + inner.T + outer + outer.T) / 2


def node_hessians(
    motion: Transcription, at: Linearization, multipliers: Array, points: Indices
) -> Array:
    """Return second derivatives of the residuals in w, weighted by multipliers (m, P), at P phases: (P, W, W)."""
    w = motion.grid.bases.states(*motion.unpack(at.x))[:, points]
    width, count = w.shape
    step = DIFFERENCE_STEP * np.maximum(np.abs(w).max(axis=1), MIN_STATE)
    shift = np.stack([np.diag(step), -np.diag(step)], axis=1)[
        ..., None
    ]  # (W, sign, direction, 1)
    shifted = (w[:, None, None] + shift).reshape(width, -1)
    obstacle_poses = np.repeat(motion.obstacle_poses[:, None], shifted.shape[1], axis=1)
    _, jacobian = motion.kernels.jacobian(shifted, obstacle_poses)
    gradients = np.einsum(
        "wmsdp,mp->swdp", jacobian.reshape(width, -1, 2, width, count), multipliers
    )
    return np.asarray(
        ((gradients[0] - gradients[1]) / (2 * step[:, None])).transpose(2, 0, 1)
    )


def rate_hessian(
    motion: Transcription, at: Linearization, multipliers: Array, points: Indices
) -> Array:
    """Return the second term: the curvature of w in log r; the first and last two also move the boundary points."""
    weighted = replace(
        at, jacobian=np.einsum("wmk,km->wk", at.jacobian, multipliers)[:, None]
    )
    only = np.zeros(len(points), np.intp)

    def gradient(rate: Array) -> Array:
        return np.asarray(
            residual_gradients(motion, replace(weighted, rate=rate), points, only).sum(
                axis=0
            )
        )

    size, split = len(at.rate), motion.split
    hessian = np.zeros((motion.nx, motion.nx))
    own = np.arange(split + 2, split + size - 2)
    hessian[own, own] = gradient(at.rate)[own]
    for index in {0, 1, size - 2, size - 1}:
        factor = np.exp(DIFFERENCE_STEP * np.eye(size)[index])
        hessian[:, split + index] = (
            gradient(at.rate * factor) - gradient(at.rate / factor)
        ) / (2 * DIFFERENCE_STEP)
    return hessian
