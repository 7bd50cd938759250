"""Sequential quadratic programming with a trust region, for one motion.

The variables x are the free path control points and the logarithms of the rate control
points. With the regularized objective f, scaled residuals g and their bounds l and u,

    minimize f(x)  subject to  l <= g(x) <= u.

A step d from x solves the program

    minimize    f' d + d (H + rho I) d / 2 + c(e)
    subject to  l - e v-  <=  g + J d  <=  u + e v+,    |d| <= Delta s,    0 <= e <= 1,

where v- and v+ are the present violations of the bounds. The elastic variable e is the
fraction of every violation that the step may leave, and c(e) its cost
(``qp_subproblem``). The proximal term rho makes the model strictly convex where the
objective is flat; s scales the trust region. With the largest violation v and its
weight mu, the merit function is

    phi(x) = f(x) + mu v(x),    predicted reduction = gain + mu v (1 - e),

where the gain is the reduction of f that the quadratic model predicts.

The merit function alone rejects good steps along a curved manifold, since they leave it
by their square (the Maratos effect). A step that reduces the objective is therefore
also accepted within a violation bound, which shrinks each time (Gould and Toint,
Mathematical Programming 122, 2010).

Along flat directions of the objective steps never become short, and each violates
residuals by its square. The objective has converged once a step changes it by less than
the tolerance, and predicts no more. Then a heavy proximal term restricts further steps
to the restoration of feasibility.
"""

import time
from dataclasses import dataclass, replace

import numpy as np

from cnpgen.arrays import Array, Mask
from cnpgen.refine.solver.bounds import Bounds
from cnpgen.refine.solver.compiled_backend import CompiledBackend, CompiledSubproblem
from cnpgen.refine.solver.qp_subproblem import (
    ResidualSelection,
    Step,
    local_maxima,
)
from cnpgen.refine.solver.transcription import Transcription

# Trust radius of the logarithms of the rate, relative to that of the path.
RATE_RADIUS_FACTOR = 1.5
MAX_RADIUS, MIN_RADIUS = 1.0, 1e-5  # of the trust region
MAX_STEP_GROWTH = 1.5  # expected factor of the length of successive steps
# See ``Settings.selection_distances``.
SELECTION_DISTANCES = (0.2, 0.4), (0.05, 0.2), (-1.0, 0.1)
CONVERGED_PROXIMAL = 1.0  # weight of the proximal term once the objective has converged
# In shorter motions that weight grows with the cube of the ratio of durations.
SHORT_MOTION_S = 0.2
# A step that leaves a larger fraction of the violations is computed again with relaxed
# residuals.
MAX_REMAINING = 0.9
# Times the objective: weight of violations where the penalty makes violations
# profitable.
PENALTY_FACTOR = 3.0
# Stalled: a larger fraction of the violation is left after so many steps.
STALL_STEPS = 8
STALL_FRACTION = 0.9
# A stalled iteration with a smaller violation restores feasibility before it ends.
MAX_RESTORED_VIOLATION = 0.02
# Of the violation bound; smallest fraction of the predicted gain.
BOUND_SHRINKAGE = 0.7
MIN_GAIN_FRACTION = 0.1
LAST_STEPS = 3  # before a deadline restore feasibility
DEADLINE_PROXIMAL = 30.0  # weight of the proximal term in these
# Tightenings of the bounds for violations between grid points.
MAX_MIDPOINT_CORRECTIONS = 2
# Times the largest duration of a step so far is reserved for the next.
STEP_TIME_FACTOR = 1.3
# Of reduction to prediction: accept, enlarge, shrink.
ACCEPTED_RATIO = 0.05
GOOD_RATIO = 0.7
POOR_RATIO = 0.3


@dataclass(frozen=True)
class Settings:
    """Settings of the iteration."""

    max_iterations: int = 40  # largest number of steps tried
    radius: float = 0.3  # initial trust radius, infinity norm [rad and log]
    proximal: float = 0.02  # weight of the proximal term
    # Initial weight of the largest violation in the merit function. A motion that is 1
    # % slower costs 1 % of its duration. Violations are therefore profitable in motions
    # of more seconds than this; there the weight grows.
    penalty: float = 2.0
    # Initial violation up to which steps are accepted for their reduction of the
    # objective.
    violation_bound: float = 0.3
    max_initial_violation: float = np.inf  # largest violation of a usable initial guess
    # Relative change of the objective, predicted and actual, at which it has converged.
    cost_tolerance: float = 1e-3
    # Pairs (step length, distance): after a step longer than the first, residuals
    # within the second of a bound are selected.
    selection_distances: tuple[tuple[float, float], ...] = SELECTION_DISTANCES
    violation_tolerance: float = 6e-4  # largest scaled violation of a feasible iterate


DEFAULT_SETTINGS = Settings()


@dataclass
class Deadline:
    """Time at which a sequence of steps must have ended: iterations of a solver, or verdicts."""

    until: float  # in the clock of ``time.perf_counter`` [s]
    # Time reserved for one step: the largest so far, times ``STEP_TIME_FACTOR`` [s].
    max_duration: float = 0.0

    def allows(self, steps: int) -> bool:
        """Return whether there is time for so many steps."""
        return time.perf_counter() + steps * self.max_duration <= self.until

    def note(self, begun: float) -> None:
        """Record a step that started at ``begun`` and has just ended."""
        self.max_duration = max(
            self.max_duration, STEP_TIME_FACTOR * (time.perf_counter() - begun)
        )


@dataclass(frozen=True)
class Result:
    """Result of an iteration."""

    x: Array  # last accepted iterate
    cost: float  # regularized objective there
    violation: float  # largest scaled violation there
    iterations: int  # number of steps tried
    converged: bool  # whether the iteration ended before its limit of steps


def minimize(
    motion: Transcription,
    bounds: Bounds,
    x: Array,
    settings: Settings,
    *,
    deadline: Deadline | None = None,
) -> Result:
    """Minimize from variables x, shape (nx,).

    The last steps before the deadline restore feasibility.
    """
    iterate = _Iterate(motion, bounds, settings, x)
    feasible: Result | None = None
    iteration = 0
    while (
        iteration < settings.max_iterations
        and not iterate.converged
        and (deadline is None or deadline.allows(1))
    ):
        begun = time.perf_counter()
        # The last steps before a deadline restore feasibility: a slower valid motion is
        # worth more than a faster invalid one.
        iterate.restoring = deadline is not None and not deadline.allows(LAST_STEPS)
        iteration += 1
        iterate.advance()
        if deadline is None:
            continue
        deadline.note(begun)
        # Earlier iterates met the wider bounds only.
        feasible = None if iterate.tightened else feasible
        if iterate.violation < settings.violation_tolerance:
            found = iterate.result(iteration)
            feasible = (
                found if feasible is None or found.cost < feasible.cost else feasible
            )
    last = iterate.result(iteration)
    return (
        last
        if iterate.converged or feasible is None
        else replace(feasible, iterations=iteration)
    )


class _Iterate:
    """State of the iteration: variables, regularized objective, largest violation."""

    restoring = False  # whether steps only restore feasibility, before a deadline
    # Whether the last step tightened the bounds for violations between grid points.
    tightened = False

    def __init__(
        self, motion: Transcription, bounds: Bounds, settings: Settings, x: Array
    ) -> None:
        self._backend = CompiledBackend(motion, bounds)
        self._motion = motion
        self._corrections = MAX_MIDPOINT_CORRECTIONS
        self.x = self._start = x
        self.cost, self._g, self.violation = self._backend.value(x)
        self.converged = not self.violation < settings.max_initial_violation
        # of iterates after the initial guess, which may violate less than its
        # successors; it counts only if feasible
        self._violations = (
            [self.violation] if self.violation <= settings.violation_tolerance else []
        )
        self._bounds = bounds
        self._settings = settings
        self._scale = np.ones(motion.nx)
        self._scale[motion.split :] = RATE_RADIUS_FACTOR
        self._radius = settings.radius
        self._violation_bound = settings.violation_bound
        self._penalty = settings.penalty
        # Of the last step, in the norm of the trust region.
        self._step_length = MAX_RADIUS
        self._multipliers: Array | None = None
        self._cost_converged = self._stalled = False
        # Residuals that a rejected step violated without their selection.
        self._missed = np.zeros(self._g.shape, bool)

    def result(self, iterations: int) -> Result:
        """Return the current iterate as a result."""
        return Result(
            self.x,
            self.cost,
            self.violation,
            iterations,
            self.converged and not self.restoring,
        )

    def advance(self) -> None:
        """Try a step, and accept it or adapt the trust region and the selection."""
        settings = self._settings
        self.tightened = False
        # A step that only restores feasibility stays close to x: a large proximal weight
        # makes changes of the objective expensive, the constraints are unchanged.
        restore = self.restoring or self._cost_converged or self._stalled
        proximal = self._restoration_weight() if restore else settings.proximal
        # After long steps the linearization is poor, so more residuals near their
        # bounds take part in the program; after short ones a few are enough.
        distance = next(
            distance
            for length, distance in settings.selection_distances
            if self._step_length > length
        )
        change = MAX_STEP_GROWTH * self._step_length
        selection = ResidualSelection(
            self.violation, distance, change, self._missed, self._multipliers
        )
        subproblem = self._backend.subproblem(
            self.x, self._g, selection, proximal=proximal, penalty=self._penalty
        )
        step = self._propose(subproblem)
        if step is None:
            # No feasible point in the box, or a failure of the program.
            self._radius *= 0.25
        else:
            self._try(step, subproblem.selected)
        if self.x is not self._start:
            self._violations.append(self.violation)
        self._continue_if_stuck()
        self.converged |= self._radius < MIN_RADIUS or self._is_stuck()

    def _continue_if_stuck(self) -> None:
        """Change what is minimized if violations do not decrease any more."""
        # A motion that is 1 % slower costs 1 % of its duration. Where the duration [s] is
        # larger than mu, a violation may pay for itself: raise mu above it.
        if self._is_stuck() and self._penalty < self.cost:
            self._penalty = PENALTY_FACTOR * self.cost
            self._violations = [self.violation]
        # Small violations that do not decrease any more: give up the objective once, and
        # restore feasibility before the iteration ends.
        if (
            self._is_stuck()
            and not self._stalled
            and self.violation < MAX_RESTORED_VIOLATION
        ):
            self._stalled = True
            self._violations = [self.violation]

    def _restoration_weight(self) -> float:
        ratio = max(
            SHORT_MOTION_S
            / self._motion.duration(np.exp(self.x[self._motion.split :])),
            1.0,
        )
        return (DEADLINE_PROXIMAL if self.restoring else CONVERGED_PROXIMAL) * ratio**3

    def _is_stuck(self) -> bool:
        """Return whether no iterate was feasible and the smallest violation hardly decreases any more."""
        # min over the last steps > 0.9 min over all earlier ones, and neither is feasible
        before = self._violations[:-STALL_STEPS]
        recent = self._violations[-STALL_STEPS:]
        smallest = min(before, default=0.0)
        tolerance = self._settings.violation_tolerance
        return smallest > tolerance and min(recent) > max(
            STALL_FRACTION * smallest, tolerance
        )

    def _propose(self, subproblem: CompiledSubproblem) -> Step | None:
        """Solve the subproblem; solve it again, relaxed or without warm start, if the step is of little use."""
        box = self._radius * self._scale
        step = subproblem.solve(box, warm=self._multipliers)
        # An infeasible iterate whose step removes hardly any violation: residuals that
        # hold now block it. The relaxed program lets all of them grow up to v.
        if self.violation > self._settings.violation_tolerance and (
            step is None or step.remaining > MAX_REMAINING
        ):
            relaxed = subproblem.solve(box, relax=True)
            if (
                relaxed is not None
                and relaxed.remaining > MAX_REMAINING
                and self._penalty < self.cost
            ):
                self._penalty = PENALTY_FACTOR * self.cost
            return relaxed or step
        if step is None and self._multipliers is not None:
            return subproblem.solve(box)
        return step

    def _try(self, step: Step, selected: Mask) -> None:
        """Accept a step if its reduction agrees with the prediction."""
        settings = self._settings
        x = self.x + step.dx
        cost, g, violation = self._backend.value(x)
        # Reductions of the merit function: predicted by the models, and actual.
        gain = step.gain
        predicted = gain + self._penalty * self.violation * (1 - step.remaining)
        reduction = self.cost - cost + self._penalty * (self.violation - violation)
        # Second way of acceptance: the violation stays below its bound, and the objective
        # decreases by a fraction of the prediction (against the Maratos effect).
        within_bound = (
            violation <= self._violation_bound
            and self.cost - cost > MIN_GAIN_FRACTION * gain > 0
        )
        size = float(np.abs(step.dx / self._scale).max())
        self._multipliers = step.multipliers
        if np.isfinite(reduction) and (
            within_bound or reduction > ACCEPTED_RATIO * predicted
        ):
            self._adapt_radius(reduction, predicted, size, within_bound=within_bound)
            self._cost_converged = (
                max(abs(self.cost - cost), abs(gain)) < settings.cost_tolerance * cost
            )
            # Converged: the objective cannot be improved (or is given up), and all
            # residuals hold.
            restored = self._cost_converged or self._stalled or self.restoring
            self.converged = restored and violation < settings.violation_tolerance
            self.x = x
            self.cost = cost
            self._g = g
            self.violation = violation
            self._step_length = size
            self._missed[:] = False
            if self.converged and not self.restoring and self._corrections:
                self._check_midpoints()
        else:
            self._reject(self._bounds.violations(g), selected, size)

    def _adapt_radius(
        self, reduction: float, predicted: float, size: float, *, within_bound: bool
    ) -> None:
        """Adapt the trust region and the bound of the violation to an accepted step."""
        # Accepted by the bound alone: it shrinks, so that this cannot go on forever.
        if reduction <= ACCEPTED_RATIO * predicted:
            self._violation_bound *= BOUND_SHRINKAGE
        # The models were good: enlarge the region if the step reached its edge.
        if within_bound or reduction > GOOD_RATIO * predicted:
            if size > 0.8 * self._radius:
                self._radius = min(2.5 * self._radius, MAX_RADIUS)
        elif reduction < POOR_RATIO * predicted:
            self._radius *= 0.5

    def _check_midpoints(self) -> None:
        """Continue within tighter bounds if residuals violate them between grid points."""
        tighter = self._bounds.tightened(self._g, self._motion.grid.midpoint_weights)
        if tighter is None:
            return
        self.converged = False
        self.tightened = True
        self._corrections = self._corrections - 1
        self._bounds = tighter
        self._backend = CompiledBackend(self._motion, tighter)
        self.violation = tighter.max_violation(self._g)

    def _reject(self, violations: Array, selected: Mask, size: float) -> None:
        """Select the residuals that a rejected step violated.

        Shrink the radius unless they explain the rejection.
        """
        # Residuals that the step violated although the program had not selected them:
        # they explain the rejection, and the next program has them. Otherwise the models
        # are wrong in the region, and a smaller one is tried.
        violated = violations > self._settings.violation_tolerance
        missed = local_maxima(violations) & violated & ~selected
        self._missed |= missed
        if not (missed.any() and violations[missed].max() >= violations.max()):
            self._radius = 0.35 * min(self._radius, size)
