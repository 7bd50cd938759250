"""Ipopt on the refiner's transcription, with the Hessian of the Lagrangian: what the refiner's plans are compared with.

A programme with every residual on the grid costs Ipopt's linear solver 0.2 s a step, and almost all of them are far
from their bounds. So it holds those on a coarser grid and where they are largest; what the end of a run breaks is taken
in, and the next run goes on from there.
"""

import copy
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from typing import Any

import casadi as ca
import numpy as np
from numpy.typing import NDArray

from cnpgen.refine.passes import Pass
from cnpgen.refine.refiner import Refiner
from cnpgen.refine.solver.bounds import Bounds
from cnpgen.refine.solver.hulls import Hulls
from cnpgen.refine.solver.sqp import Result, Settings
from cnpgen.refine.solver.transcription import Linearisation, Transcription
from cnpgen.refine.task import Task

Array = NDArray[np.float64]
Indices = NDArray[np.intp]
PATIENCE = 6  # Ipopt takes smaller steps than the refiner: it may take this many times as many
ROUNDS = 6
COARSE = 32  # phases of the coarser grid
NEAR = 0.03  # peaks this close to their bounds are held
FAR = 1.0  # what is further from its bounds is not held on the coarser grid either: obstacles 0.1 m away
QUIET = 8  # iterates among which the objective hardly changes end a run
FIRST, LATER = 1.0, 0.1  # what "hardly" is in the first and in later runs, in multiples of the tolerance
NEARLY = 0.05  # violation up to which a start is worth staying near
WARM = {
    "mu_strategy": "monotone",
    "mu_init": 1e-6,
    "warm_start_init_point": "yes",
    "warm_start_bound_push": 1e-5,
    "warm_start_slack_bound_push": 1e-5,
    "warm_start_slack_bound_frac": 1e-5,
    "warm_start_mult_bound_push": 1e-6,
}
STEP = 1e-5  # of central differences, relative to the largest value along the motion: errors of some 1e-9
SMALL = 1e-2  # values below this are taken for this


def with_ipopt(refiner: Refiner) -> Refiner:
    """Return a refiner whose passes are run by Ipopt, with all else as it is: starts, passes, bounds and verdicts."""

    def minimise(task: Task, which: Pass, x: Array, hulls: Hulls | None = None) -> Result:
        assert hulls is None, "Ipopt keeps capsules clear, not hulls"
        motion = refiner.transcription(task, which)
        bounds = refiner.bounds(task, which, motion.end_residuals())
        return minimise_with_ipopt(motion, bounds, x, which.settings)

    other = copy.copy(refiner)
    other.minimise = minimise  # type: ignore[method-assign]
    return other


@np.errstate(all="ignore")  # steps into what is no number are taken back
def minimise_with_ipopt(motion: Transcription, bounds: Bounds, x: Array, settings: Settings) -> Result:
    """Minimise from x until nothing is broken that Ipopt did not hold.

    Args:
        motion: The transcription.
        bounds: Bounds of its residuals.
        x: First variables, shape (nx,).
        settings: Number of iterations and tolerances; the others are the refiner's own solver's.
    """
    best = Best(bounds, settings.violation_tolerance)
    held, multipliers = np.zeros(bounds.lower.shape, bool), np.zeros(bounds.lower.shape)
    limit, steps, end = PATIENCE * settings.max_iterations, 0, x
    for number in range(ROUNDS):
        at = motion.evaluate(end)
        violation = bounds.violation(at.g)
        best.offer(end, at.cost, violation)
        if steps >= limit or (number > 1 and violation < settings.violation_tolerance):
            break
        held |= choose_held(at.g, bounds)
        best.begin(settings.cost_tolerance * (LATER if number else FIRST))
        programme = Programme(motion, bounds, held, end)
        options = ipopt_options(settings, limit - steps, warm=number > 0 or violation < NEARLY)
        end, multipliers, taken = run(programme, best, end, multipliers, options)
        steps += taken
    return Result(best.x, best.cost, best.violation, steps, steps < limit)


@dataclass
class Best:
    """The best iterate so far, and when a run gains nothing any more.

    Attributes:
        bounds: Bounds of all residuals, held or not.
        enough: Violation of a feasible iterate.
        x: The best variables: feasible or of the smallest violation, then of the smallest cost.
        cost: Objective there.
        violation: Worst violation there.
        costs: Objectives of the run's iterates, nan where one breaks what is held.
        little: Relative change of the objective that ends the run.
    """

    bounds: Bounds
    enough: float
    x: Array = field(default_factory=lambda: np.empty(0))
    cost: float = np.inf
    violation: float = np.inf
    costs: list[float] = field(default_factory=list)
    little: float = 0.0

    def begin(self, little: float) -> None:
        """Begin a run that ends where the objective changes by less than ``little``, relatively."""
        self.costs, self.little = [], little

    def offer(self, x: Array, cost: float, violation: float) -> None:
        """Take an iterate in."""
        if not self.x.size or (max(violation, self.enough), cost) < (max(self.violation, self.enough), self.cost):
            self.x, self.cost, self.violation = x, cost, violation

    def look(self, programme: "Programme", x: Array) -> float:
        """Take an iterate of a run in; return 1 to end it."""
        at = programme.at(x)
        self.offer(x, at.cost, self.bounds.violation(at.g))
        self.costs.append(at.cost if programme.violation(x) < self.enough else np.nan)
        last = self.costs[-QUIET:]
        return float(len(last) == QUIET and max(last) - min(last) < self.little * at.cost)


def choose_held(g: Array, bounds: Bounds) -> NDArray[np.bool_]:
    """Pick the residuals that a programme holds, shape (K, m): on a coarser grid, where they leap, at their peaks."""
    excess = bounds.excess(g)
    outer = np.pad(excess, [(1, 1), (0, 0)], constant_values=-np.inf)
    peak = np.pad((excess >= outer[:-2]) & (excess >= outer[2:]) & (excess > -NEAR), [(1, 1), (0, 0)])
    chosen = peak[:-2] | peak[1:-1] | peak[2:] | bounds.sharp
    every = max(len(g) // COARSE, 1)
    chosen[::every] |= excess[::every] > -FAR
    return np.asarray(chosen & (np.isfinite(bounds.lower) | np.isfinite(bounds.upper)))


def ipopt_options(settings: Settings, limit: int, *, warm: bool) -> dict[str, Any]:
    """Return the options of a run."""
    return {
        "print_level": 0,
        "sb": "yes",
        "mumps_scaling": 0,  # like the next, it costs half as much again as the factorisation
        "mumps_permuting_scaling": 0,
        "max_iter": limit,
        "tol": settings.cost_tolerance / 500,  # times the active residuals, what the barrier adds to the objective
        "constr_viol_tol": settings.violation_tolerance / 2,
        **(WARM if warm else {"mu_strategy": "adaptive"}),
    }


def run(
    programme: "Programme", best: Best, x: Array, multipliers: Array, options: dict[str, Any]
) -> tuple[Array, Array, int]:
    """Run Ipopt once; return where it ended, the multipliers (K, m), and its number of steps."""
    shapes = {"x": len(x), "f": 1, "g": len(programme.lower), "lam_x": len(x), "lam_g": len(programme.lower)}
    inputs = [ca.Sparsity.dense(shapes.get(ca.nlpsol_out(i), 0), 1) for i in range(ca.nlpsol_n_out())]
    callback = programme.wrap("look", inputs, ca.Sparsity.dense(1, 1), lambda x, *_: best.look(programme, x))
    quiet = {"print_time": False, "error_on_fail": False, "show_eval_warnings": False}
    solver = {**quiet, "ipopt": options, "hess_lag": programme.hessian(), "iteration_callback": callback}
    function = ca.nlpsol("refine", "ipopt", programme.problem(), solver)
    found = function(x0=x, lbg=programme.lower, ubg=programme.upper, lam_g0=programme.held(multipliers))
    if programme.raised:
        raise programme.raised[0]
    end = np.array(found["x"].nonzeros())
    if not np.isfinite(programme.at(end).g).all():
        return best.x, multipliers, max(len(best.costs), 1)
    steps = int(function.stats().get("iter_count", 0))
    return end, programme.multipliers(np.array(found["lam_g"].nonzeros())), max(steps, 1)


class Programme:
    """Objective and held residuals as vectors and sparse matrices, evaluated once per x.

    Args:
        motion: The transcription.
        bounds: Bounds of its residuals.
        held: Residuals that the programme holds, shape (K, m).
        x: Any variables: where derivatives vanish by structure is found out there.

    Attributes:
        lower: Lower bounds of the held residuals.
        upper: Upper bounds.
        raised: What was raised in its functions: Ipopt goes on, or gives up without a word.
    """

    def __init__(self, motion: Transcription, bounds: Bounds, held: NDArray[np.bool_], x: Array) -> None:
        self.motion, self._bounds = motion, bounds
        self._k, self._which = np.nonzero(held)
        self.lower, self.upper = bounds.lower[held], bounds.upper[held]
        self.raised: list[BaseException] = []
        self._functions: list[Any] = []  # CasADi holds no reference
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
        nx, m, dense = self.motion.nx, len(self.lower), ca.Sparsity.dense
        x, one, many = dense(nx, 1), dense(1, 1), dense(m, 1)
        pattern = ca.Sparsity.triplet(m, nx, self._row.tolist(), self._column.tolist())
        gradient = self.wrap("gradient", [x, one], dense(1, nx), lambda x, _: self.at(x).gradient)
        jacobian = self.wrap("jacobian", [x, many], pattern, lambda x, _: self._jacobian(x))
        value = self.wrap("value", [x], one, lambda x: self.at(x).cost, slope=gradient)
        residuals = self.wrap("residuals", [x], many, lambda x: self.held(self.at(x).g), slope=jacobian)
        symbol = ca.MX.sym("x", nx)
        return {"x": symbol, "f": value(symbol), "g": residuals(symbol)}

    def hessian(self) -> Any:
        """Return the option ``hess_lag``: the upper triangle of the Hessian of the Lagrangian."""
        nx, m, dense = self.motion.nx, len(self.lower), ca.Sparsity.dense
        output = ca.Sparsity.upper(nx)
        row, column = (np.array(each) for each in output.get_triplet())

        def compute(x: Array, _: Array, weight: Array, held: Array) -> Array:
            full = lagrangian_hessian(self.motion, self.at(x), self.multipliers(held), float(weight[0]))
            return np.asarray(full[row, column])

        inputs = [dense(nx, 1), ca.Sparsity(0, 0), dense(1, 1), dense(m, 1)]
        wrapped = self.wrap("curvature", inputs, output, compute)
        symbols = [ca.MX.sym(name, *pattern.shape) for name, pattern in zip("xpfg", inputs, strict=True)]
        names = ["x", "p", "lam_f", "lam_g"], ["triu_hess_gamma_x_x"]
        return ca.Function("nlp_hess_l", symbols, [wrapped(*symbols)], *names)

    def wrap(self, name: str, inputs: list[Any], output: Any, compute: Callable[..., Any], *, slope: Any = None) -> Any:
        """Wrap a NumPy function of vectors of nonzeros as a CasADi function; ``slope`` is its wrapped Jacobian."""
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
                return slope is not None

            def has_jac_sparsity(self, *_: int) -> bool:
                return slope is not None

            def get_jac_sparsity(self, *_: Any) -> Any:
                return slope.sparsity_out(0)

            def get_jacobian(self, *_: Any) -> Any:
                return slope

            def eval(self, arguments: Any) -> list[Any]:
                try:
                    return [ca.DM(output, compute(*(np.array(each.nonzeros()) for each in arguments)))]
                except BaseException as error:
                    raised.append(error)
                    raise

        self._functions.append(Wrapped())
        return self._functions[-1]

    def _jacobian(self, x: Array) -> Array:
        rows = self.motion.rows(self.at(x), self._k, self._which)
        return np.asarray(rows[self._row, self._column])

    def _pattern(self, x: Array) -> tuple[Indices, Indices]:
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


def lagrangian_hessian(motion: Transcription, at: Linearisation, multipliers: Array, weight: float = 1.0) -> Array:
    """Return the Hessian of ``weight * objective + multipliers . residuals``, shape (nx, nx).

    With w(x) the state of the splines at a phase and g(w) the residuals there, it is the sum over phases of
    ``(dw/dx)^T (lambda . d2g/dw2) dw/dx + (lambda . dg/dw) . d2w/dx2``. The objective's share is the positive
    semidefinite model of ``Linearisation.curvature``; w depends on x linearly but for the logarithms of the rate.

    Args:
        motion: The transcription.
        at: Where.
        multipliers: One per residual, shape (K, m); phases where all are zero cost nothing.
        weight: Multiplier of the objective.
    """
    points = np.flatnonzero(multipliers.any(axis=1))
    hessian: Array = weight * at.curvature
    if len(points) == 0:
        return hessian
    width = len(at.jacobian)
    bent = node_hessians(motion, at, multipliers[points].T, points)
    unit = np.broadcast_to(np.eye(width)[:, :, None], (width, width, len(at.g)))
    slopes = motion.rows(replace(at, jacobian=unit), np.repeat(points, width), np.tile(np.arange(width), len(points)))
    slopes = slopes.reshape(len(points), width, motion.nx)
    inner = slopes.reshape(-1, motion.nx).T @ (bent @ slopes).reshape(-1, motion.nx)
    outer = rate_hessian(motion, at, multipliers, points)
    return hessian + (inner + inner.T + outer + outer.T) / 2


def node_hessians(motion: Transcription, at: Linearisation, multipliers: Array, points: Indices) -> Array:
    """Second derivatives of the residuals in w, weighted by the multipliers (m, P), at P phases: shape (P, W, W)."""
    w = motion.grid.bases.states(*motion.unpack(at.x))[:, points]
    width, count = w.shape
    step = STEP * np.maximum(np.abs(w).max(axis=1), SMALL)
    shift = np.stack([np.diag(step), -np.diag(step)], axis=1)[..., None]  # (W, sign, direction, 1)
    shifted = (w[:, None, None] + shift).reshape(width, -1)
    tops = np.repeat(motion.tops[:, None], shifted.shape[1], axis=1)
    _, jacobian = motion.stage.jacobian(shifted, tops)
    slopes = np.einsum("wmsdp,mp->swdp", jacobian.reshape(width, -1, 2, width, count), multipliers)
    return np.asarray(((slopes[0] - slopes[1]) / (2 * step[:, None])).transpose(2, 0, 1))


def rate_hessian(motion: Transcription, at: Linearisation, multipliers: Array, points: Indices) -> Array:
    """The second term: each log r has its own curvature, the first and last two bend the boundary points, too."""
    pull = replace(at, jacobian=np.einsum("wmk,km->wk", at.jacobian, multipliers)[:, None])
    only = np.zeros(len(points), np.intp)

    def gradient(rate: Array) -> Array:
        return np.asarray(motion.rows(replace(pull, rate=rate), points, only).sum(axis=0))

    size, split = len(at.rate), motion.split
    hessian = np.zeros((motion.nx, motion.nx))
    own = np.arange(split + 2, split + size - 2)
    hessian[own, own] = gradient(at.rate)[own]
    for index in {0, 1, size - 2, size - 1}:
        factor = np.exp(STEP * np.eye(size)[index])
        hessian[:, split + index] = (gradient(at.rate * factor) - gradient(at.rate / factor)) / (2 * STEP)
    return hessian
