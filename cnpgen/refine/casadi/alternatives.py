"""CasADi's own solvers on the same transcription, for users who want them or want to compare.

A programme with every residual on the grid costs Ipopt's linear solver 0.2 s a step, and almost all of them are far
from their bounds. So it holds those on a coarser grid and where they are largest; what the end of a run breaks is taken
in, and the next run goes on from there.
"""

from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from cnpgen.machine.signals import Received, signals_wait
from cnpgen.refine.casadi.programme import Programme
from cnpgen.refine.solver.bounds import Bounds
from cnpgen.refine.solver.sqp import Result, Settings
from cnpgen.refine.solver.transcription import Transcription

Array = NDArray[np.float64]
PATIENCE = 6  # these solvers take smaller steps: they may take this many times as many
ROUNDS = 6
COARSE = 32  # phases of the coarser grid
PROXIMAL = 0.1  # weight of sqpmethod's proximal term: it has no trust region
NEAR = 0.03  # peaks this close to their bounds are held
FAR = 1.0  # what is further from its bounds is not held on the coarser grid either: obstacles 0.1 m away
QUIET = 8  # iterates among which the objective hardly changes end a run
FIRST, LATER = 1.0, 0.1  # what hardly is in the first and in later runs, in multiples of the tolerance
WARM = {
    "mu_strategy": "monotone",
    "mu_init": 1e-6,
    "warm_start_init_point": "yes",
    "warm_start_bound_push": 1e-5,
    "warm_start_slack_bound_push": 1e-5,
    "warm_start_slack_bound_frac": 1e-5,
    "warm_start_mult_bound_push": 1e-6,
}
NEARLY = 0.05  # violation up to which a start is worth staying near


def minimise_with(motion: Transcription, bounds: Bounds, x: Array, settings: Settings, *, solver: str) -> Result:
    """Minimise from x with ``ipopt`` (Hessian of the Lagrangian) or ``sqpmethod`` (Gauss-Newton Hessian, DAQP).

    Args:
        motion: The transcription.
        bounds: Bounds of its residuals.
        x: First variables, shape (nx,).
        settings: Number of iterations and tolerances; trust region and proximal term are the own solver's alone.
        solver: Name of the CasADi plug-in.
    """
    with signals_wait() as received, np.errstate(all="ignore"):  # steps into what is no number are taken back
        return _rounds(motion, _Watch(bounds, settings, received), x, solver=solver)


def _rounds(motion: Transcription, watch: "_Watch", x: Array, *, solver: str) -> Result:
    """Run the solver until nothing is broken that it did not hold."""
    bounds, settings = watch.bounds, watch.settings
    held, multipliers = np.zeros(bounds.lower.shape, bool), np.zeros(bounds.lower.shape)
    limit, steps, end = PATIENCE * settings.max_iterations, 0, x
    for number in range(ROUNDS):
        at = motion.evaluate(end)
        violation = bounds.violation(at.g)
        watch.offer(end, at.cost, violation)
        if watch.received.came or steps >= limit or (number > 1 and violation < settings.violation_tolerance):
            break
        held |= _choose(at.g, bounds)
        watch.begin(settings.cost_tolerance * (LATER if number else FIRST))
        programme = Programme(motion, bounds, held, end)
        warm = number > 0 or violation < NEARLY
        options = _options(solver, programme, settings, limit - steps, warm=warm)
        end, multipliers, taken = _run(programme, watch, end, multipliers, options, solver=solver)
        steps += taken
    return Result(watch.x, watch.cost, watch.violation, steps, steps < limit)


@dataclass
class _Watch:
    """Who looks at every iterate: keeps the best one, and ends a run that gains nothing any more.

    Attributes:
        bounds: Bounds of all residuals, held or not.
        settings: Tolerances.
        received: Whether a signal has come meanwhile: it ends the run.
        x: The best variables: feasible or of the smallest violation, then of the smallest cost.
        cost: Objective there.
        violation: Worst violation there.
        costs: Objectives of the run's iterates, nan where one breaks what is held.
        little: Relative change of the objective that ends the run.
    """

    bounds: Bounds
    settings: Settings
    received: Received
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
        enough = self.settings.violation_tolerance
        if not self.x.size or (max(violation, enough), cost) < (max(self.violation, enough), self.cost):
            self.x, self.cost, self.violation = x, cost, violation

    def look(self, programme: Programme, x: Array) -> float:
        """Take an iterate of a run in; return 1 to end it."""
        at = programme.at(x)
        self.offer(x, at.cost, self.bounds.violation(at.g))
        met = programme.violation(x) < self.settings.violation_tolerance
        self.costs.append(at.cost if met else np.nan)
        last = self.costs[-QUIET:]
        quiet = len(last) == QUIET and max(last) - min(last) < self.little * at.cost
        return float(quiet or self.received.came)


def _choose(g: Array, bounds: Bounds) -> NDArray[np.bool_]:
    """Pick the residuals that a programme holds, shape (K, m): on a coarser grid, where they leap, at their peaks."""
    excess = bounds.excess(g)
    outer = np.pad(excess, [(1, 1), (0, 0)], constant_values=-np.inf)
    peak = np.pad((excess >= outer[:-2]) & (excess >= outer[2:]) & (excess > -NEAR), [(1, 1), (0, 0)])
    chosen = peak[:-2] | peak[1:-1] | peak[2:] | bounds.sharp
    every = max(len(g) // COARSE, 1)
    chosen[::every] |= excess[::every] > -FAR
    return np.asarray(chosen & (np.isfinite(bounds.lower) | np.isfinite(bounds.upper)))


def _run(
    programme: Programme, watch: _Watch, x: Array, multipliers: Array, options: dict[str, Any], *, solver: str
) -> tuple[Array, Array, int]:
    """Run a solver once; return where it ended, the multipliers (K, m), and its number of steps."""
    import casadi as ca

    shapes = {"x": len(x), "f": 1, "g": len(programme.lower), "lam_x": len(x), "lam_g": len(programme.lower)}
    inputs = [ca.Sparsity.dense(shapes.get(ca.nlpsol_out(i), 0), 1) for i in range(ca.nlpsol_n_out())]
    callback = programme.callbacks.wrap("look", inputs, ca.Sparsity.dense(1, 1), lambda x, *_: watch.look(programme, x))
    function = ca.nlpsol("refine", solver, programme.problem(), {**options, "iteration_callback": callback})
    try:
        found = function(x0=x, lbg=programme.lower, ubg=programme.upper, lam_g0=programme.held(multipliers))
    except RuntimeError:  # a plug-in that stops on numbers that it cannot bear: what it began with is still there
        found = None
    if programme.callbacks.raised is not None:
        raise programme.callbacks.raised
    end = x if found is None else np.array(found["x"].nonzeros())
    if found is None or not np.isfinite(programme.at(end).g).all():
        return watch.x, multipliers, max(len(watch.costs), 1)
    steps = int(function.stats().get("iter_count", 0))
    return end, programme.multipliers(np.array(found["lam_g"].nonzeros())), max(steps, 1)


def _options(solver: str, programme: Programme, settings: Settings, limit: int, *, warm: bool) -> dict[str, Any]:
    quiet = {"print_time": False, "error_on_fail": False, "show_eval_warnings": False}
    if solver == "ipopt":
        ipopt = {
            "print_level": 0,
            "sb": "yes",
            "mumps_scaling": 0,  # like the next, it costs half as much again as the factorisation
            "mumps_permuting_scaling": 0,
            "max_iter": limit,
            "tol": settings.cost_tolerance / 500,  # times the active residuals, what the barrier adds to the objective
            "constr_viol_tol": settings.violation_tolerance / 2,
            **(WARM if warm else {"mu_strategy": "adaptive"}),
        }
        return {**quiet, "ipopt": ipopt, "hess_lag": programme.hessian()}
    return {
        **quiet,
        "hess_lag": programme.hessian(proximal=PROXIMAL),
        "qpsol": "daqp",
        "qpsol_options": {"error_on_fail": False, "print_time": False},
        "max_iter": limit,
        "tol_pr": settings.violation_tolerance / 2,
        "tol_du": settings.cost_tolerance * 4,
        "print_header": False,
        "print_iteration": False,
        "print_status": False,
    }
