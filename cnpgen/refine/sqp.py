"""Sequential quadratic programming with a trust region and DAQP, for one motion.

Each step minimises a quadratic model of the objective subject to the linearised residuals. Violated residuals are
relaxed by one elastic variable: the step may leave the fraction ``beta`` of every violation. The merit function is
the objective plus a multiple of the worst violation. A proximal term on the step makes the model strictly convex
where the objective is flat.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from cnpgen.refine.transcription import Evaluation, Transcription

Array = NDArray[np.float64]
INFINITE = 1e30
ELASTIC = 1e-2  # curvature of the elastic variable's cost; far smaller ones triple the working-set changes
LEAP = 1.5  # the next step may be longer than the last one by this factor
STUCK = 0.9  # a step that leaves more than this fraction of the violations is computed again, with everything relaxed


@dataclass(frozen=True)
class Settings:
    """How to iterate.

    Attributes:
        max_iterations: Largest number of steps tried.
        radius: First trust radius, infinity norm [rad and log].
        proximal: Weight of the proximal term.
        penalty: Weight of the worst violation in the merit function.
        cost_tolerance: Relative change of the objective below which a feasible iterate is optimal.
        violation_tolerance: Worst scaled violation of a feasible iterate.
        thin: Of the inactive residuals, those at every thin-th grid point are kept in the model.
        qp_iterations: Largest number of working-set changes in one quadratic programme.
    """

    max_iterations: int = 40
    radius: float = 0.3
    proximal: float = 0.1
    penalty: float = 2.0
    cost_tolerance: float = 2e-4
    violation_tolerance: float = 6e-4
    thin: int = 6
    qp_iterations: int = 3000


DEFAULT = Settings()


@dataclass(frozen=True)
class Bounds:
    """Bounds of the residuals on the grid, in scaled units.

    Attributes:
        lower: Shape (K, m), -inf where there is none.
        upper: Shape (K, m).
        sharp: Which residuals leap with the last rate control points, shape (K, m): accelerations at the ends.
    """

    lower: Array
    upper: Array
    sharp: NDArray[np.bool_]

    def excess(self, g: Array) -> Array:
        """How far residuals g are outside, shape (K, m); negative inside."""
        return np.maximum(g - self.upper, self.lower - g)

    def violation(self, g: Array) -> float:
        """Worst violation of residuals g, shape (K, m); inf where g is not finite."""
        worst = float(self.excess(g).max())
        return max(worst, 0.0) if np.isfinite(worst) else np.inf


@dataclass(frozen=True)
class Result:
    """Where the iteration ended.

    Attributes:
        x: The best variables: smallest violation, then smallest cost.
        cost: Objective there.
        violation: Worst scaled violation there.
        iterations: Steps tried.
    """

    x: Array
    cost: float
    violation: float
    iterations: int


def minimise(motion: Transcription, bounds: Bounds, x: Array, settings: Settings) -> Result:
    """Minimise from x.

    Args:
        motion: The transcription.
        bounds: Bounds of its residuals.
        x: First variables, shape (nx,).
        settings: How to iterate.
    """
    scale = np.ones(motion.nx)
    scale[motion.split :] = 1.5
    radius, length = settings.radius, 1.0 if settings.radius > 0.15 else 0.2
    at = motion.evaluate(x)
    violation = bounds.violation(at.g)
    multipliers: Array | None = None
    extra = np.zeros(at.g.shape, bool)
    iteration = 0
    for iteration in range(1, settings.max_iterations + 1):
        near = 0.4 if length > 0.2 else 0.2 if length > 0.05 else 0.1
        held = _choose(at.g, bounds, settings.thin, near, motion.leaps(at, LEAP * length)) | extra
        chosen = _indices(held)
        step = _solve(motion, at, bounds, chosen, multipliers, settings, radius * scale, violation)
        if violation > settings.violation_tolerance and (step is None or step[1] > STUCK):
            step = _solve(motion, at, bounds, chosen, None, settings, radius * scale, violation, relax=True) or step
        if step is None:
            radius *= 0.25
            if radius < 1e-5:
                break
            continue
        dx, beta, active = step
        cost, g = motion.value(at.x + dx)
        new_violation = bounds.violation(g)
        model = at.gradient @ dx + 0.5 * dx @ at.curvature @ dx + 0.5 * settings.proximal * dx @ dx
        predicted = -model + settings.penalty * violation * (1 - beta)
        reduction = at.cost - cost + settings.penalty * (violation - new_violation)
        size = float(np.abs(dx / scale).max())
        if np.isfinite(reduction) and reduction > 0.05 * predicted:
            change, length, multipliers = abs(at.cost - cost), size, active
            if reduction > 0.7 * predicted and size > 0.8 * radius:
                radius = min(2.5 * radius, 1.0)
            elif reduction < 0.3 * predicted:
                radius *= 0.5
            done = change < settings.cost_tolerance * cost and new_violation < settings.violation_tolerance
            if done:
                return Result(at.x + dx, cost, new_violation, iteration)
            at = motion.evaluate(at.x + dx)
            violation = new_violation
            extra[:] = False
        else:
            left_out = (bounds.excess(g) > settings.violation_tolerance) & ~held
            extra |= left_out
            if not left_out.any():
                radius = 0.35 * min(radius, size)
        if radius < 1e-5:
            break
    return Result(at.x, at.cost, violation, iteration)


def _indices(held: NDArray[np.bool_]) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
    k, which = np.nonzero(held)
    return k, which


def _choose(g: Array, bounds: Bounds, thin: int, near: float, leaps: Array) -> NDArray[np.bool_]:
    """Pick the residuals that matter, shape (K, m).

    They are close to a bound, and at a local maximum, active, or on the thinned grid; or they are sharp and may leap
    over it.
    """
    excess = bounds.excess(g)
    peak = np.zeros(excess.shape, bool, order="F")
    peak[1:-1] = (excess[1:-1] >= excess[:-2]) & (excess[1:-1] >= excess[2:])
    peak[0], peak[-1] = excess[0] >= excess[1], excess[-1] >= excess[-2]
    wide = peak.copy("F")
    wide[1:] |= peak[:-1]
    wide[:-1] |= peak[1:]
    wide[::thin] = True
    wide |= excess > -0.003
    picked: NDArray[np.bool_] = (wide & (excess > -near)) | (bounds.sharp & (excess > -leaps))
    return picked


def _solve(  # noqa: PLR0917
    motion: Transcription,
    at: Evaluation,
    bounds: Bounds,
    chosen: tuple[NDArray[np.intp], NDArray[np.intp]],
    multipliers: Array | None,
    settings: Settings,
    box: Array,
    violation: float,
    *,
    relax: bool = False,
) -> tuple[Array, float, Array] | None:
    """Solve the quadratic model; return the step, the elastic variable and the multipliers, or None."""
    import daqp

    k, which = chosen
    nx, m = motion.nx, len(k)
    g, lower, upper = at.g[k, which], bounds.lower[k, which], bounds.upper[k, which]
    above, below = np.maximum(g - upper, 0), np.maximum(lower - g, 0)
    rows = np.empty((m, nx + 1))
    rows[:, :nx] = motion.rows(at, k, which)
    rows[:, nx] = below - above
    high = np.where(below > 0, INFINITE, upper - g)
    low = np.where(above > 0, -INFINITE, lower - g)
    if relax:  # what is met may be broken, too, as far as the worst violation is left
        nearer = upper - g < g - lower
        rows[:, nx] = np.where(nearer, -violation, violation)
        high, low = np.where(nearer, upper - g, INFINITE), np.where(nearer, -INFINITE, lower - g)
    hessian = np.zeros((nx + 1, nx + 1))
    hessian[:nx, :nx] = at.curvature
    diagonal = np.arange(nx)
    hessian[diagonal, diagonal] += settings.proximal
    hessian[nx, nx] = ELASTIC
    linear = np.append(at.gradient, settings.penalty * violation + 1e-3)
    sense = np.zeros(nx + 1 + m, np.int32)
    if multipliers is not None:
        before = multipliers[k, which]
        sense[nx + 1 :][before > 1e-9] = 1
        sense[nx + 1 :][before < -1e-9] = 3
    solution, _, flag, info = daqp.solve(
        hessian,
        linear,
        rows,
        np.concatenate([box, [1.0], np.minimum(high, INFINITE)]),
        np.concatenate([-box, [0.0], np.maximum(low, -INFINITE)]),
        sense,
        primal_tol=1e-6,
        iter_limit=settings.qp_iterations,
    )
    if flag < 1 or not np.isfinite(solution).all():
        return None
    active = np.zeros(at.g.shape)
    active[k, which] = info["lam"][nx + 1 :]
    return solution[:nx], float(solution[nx]), active
