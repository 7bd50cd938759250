"""Sequential quadratic programming with a trust region, for one motion.

Each step minimises a quadratic model of the objective subject to the linearised residuals. Violated residuals are
relaxed by one elastic variable: the step may leave the fraction ``beta`` of every violation. The merit function is
the objective plus a multiple of the worst violation. A proximal term on the step makes the model strictly convex
where the objective is flat.

A merit function alone refuses good steps along a curved manifold, since they leave it by their square (Maratos). So a
step is also taken for the objective's sake if it violates no more than the width of a funnel, which narrows each time.

Along flat directions of the objective steps never become short, and every one of them breaks residuals by its square.
Once a step has changed the objective by less than the tolerance, and promised no more, a heavy proximal term keeps the
next ones to what makes the iterate feasible: it lands.
"""

import time
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from cnpgen.refine.solver.bounds import Bounds
from cnpgen.refine.solver.compiled import CompiledSteps
from cnpgen.refine.solver.deadline import Deadline
from cnpgen.refine.solver.quadratic import Mask, Model, Near, PlainSteps, Step, Steps, crests
from cnpgen.refine.solver.transcription import Transcription

Array = NDArray[np.float64]
RATE_SHARE = 1.5  # logarithms of the rate may change by so many trust radii
LARGEST, SMALLEST = 1.0, 1e-5  # trust radii
LEAP = 1.5  # the next step may be longer than the last one by this factor
NEAR = ((0.2, 0.4), (0.05, 0.2), (-1.0, 0.1))  # see ``Settings.near``
LANDING = 1.0  # weight of the proximal term once the objective has settled: what is left is to become feasible
BRIEF = 0.2  # s: in shorter motions landing is heavier with the cube of how much; small steps change much in them
STUCK = 0.9  # a step that leaves more than this fraction of the violations is computed again, with everything relaxed
HEAVY = 3.0  # times the objective is what violations weigh where repairing them would not pay
PATIENCE, PROGRESS = 8, 0.9  # an iteration ends where so many steps leave more than this fraction of the violation
NEARLY = 0.02  # or lands first, where no more than this is violated
NARROWER, WORTH = 0.7, 0.1  # what is left of the funnel's width each time; share of the promised gain
LAST_STEPS = 3  # before a deadline land
SHORTEST = 30.0  # weight of the proximal term in these: nothing but the shortest way to what is feasible counts
LOOKS = 2  # between the points of the grid that may call for tighter bounds
ENOUGH, GOOD, POOR = 0.05, 0.7, 0.3  # reduction over prediction from which a step is taken, or the trust radius changes


@dataclass(frozen=True)
class Settings:
    """How to iterate.

    Attributes:
        max_iterations: Largest number of steps tried.
        radius: First trust radius, infinity norm [rad and log].
        proximal: Weight of the proximal term.
        penalty: First weight of the worst violation in the merit function. To slow down by 1 % costs 1 % of the motion
            time, so that a motion of more seconds than this gains by breaking its limits; where that holds it grows.
        funnel: First width of the funnel, a violation.
        far: A start that violates more is none.
        cost_tolerance: Relative change of the objective, promised and reached, below which it has settled.
        near: After steps longer than the first number of a pair, residuals as near as its second one are held.
        violation_tolerance: Worst scaled violation of a feasible iterate.
        thin: Of the inactive residuals, those at every thin-th grid point are kept in the model.
    """

    max_iterations: int = 40
    radius: float = 0.3
    proximal: float = 0.02
    penalty: float = 2.0
    funnel: float = 0.3
    far: float = np.inf
    cost_tolerance: float = 1e-3
    near: tuple[tuple[float, float], ...] = NEAR
    violation_tolerance: float = 6e-4
    thin: int = 6


DEFAULT = Settings()


@dataclass(frozen=True)
class Result:
    """Where the iteration ended.

    Attributes:
        x: The last iterate that was accepted.
        cost: Objective there.
        violation: Worst scaled violation there.
        iterations: Steps tried.
        ended: Whether nothing was left to gain, rather than no step.
    """

    x: Array
    cost: float
    violation: float
    iterations: int
    ended: bool


def minimise(
    motion: Transcription, bounds: Bounds, x: Array, settings: Settings, *, deadline: Deadline | None = None
) -> Result:
    """Minimise from x.

    Args:
        motion: The transcription.
        bounds: Bounds of its residuals.
        x: First variables, shape (nx,).
        settings: How to iterate.
        deadline: When to be done: the last steps before it land on what is feasible.
    """
    descent = _Descent(motion, bounds, settings, x)
    feasible: Result | None = None
    iteration = 0
    while iteration < settings.max_iterations and not descent.ended and (deadline is None or deadline.allows(1)):
        begun = time.perf_counter()
        descent.landing = deadline is not None and not deadline.allows(LAST_STEPS)
        iteration += 1
        descent.advance()
        if deadline is None:
            continue
        deadline.note(begun)
        feasible = None if descent.tightened else feasible  # bounds hid what lies between the points of the grid
        if descent.violation < settings.violation_tolerance:
            feasible = _cheaper(feasible, descent.result(iteration))
    last = descent.result(iteration)
    return last if descent.ended or feasible is None else replace(feasible, iterations=iteration)


def _cheaper(one: Result | None, other: Result) -> Result:
    return other if one is None or other.cost < one.cost else one


def steps_of(motion: Transcription, bounds: Bounds, thin: int) -> Steps:
    """Return the steps of a motion, compiled where its kernels are."""
    return PlainSteps(motion, bounds, thin) if motion.stage.steps is None else CompiledSteps(motion, bounds, thin)


class _Descent:
    """An iterate and what is known for the next step.

    Attributes:
        x: The variables.
        cost: Objective there.
        violation: Worst violation there.
        ended: Whether there is nothing more to gain.
        landing: Whether all that is still wanted is to become feasible.
        tightened: Whether the last step made bounds tighter, for residuals outside between the points of the grid.
    """

    landing = False
    tightened = False

    def __init__(self, motion: Transcription, bounds: Bounds, settings: Settings, x: Array) -> None:
        self._steps, self._motion, self._looks = steps_of(motion, bounds, settings.thin), motion, LOOKS
        self.x = self._start = x
        self.cost, self._g, self.violation = self._steps.value(x)
        self.ended = not self.violation < settings.far
        # since the start was left, which may violate less than what it leads to, and is only told where it is feasible
        self._violations = [self.violation] if self.violation <= settings.violation_tolerance else []
        self._bounds, self._settings = bounds, settings
        self._scale = np.ones(motion.nx)
        self._scale[motion.split :] = RATE_SHARE
        self._radius, self._funnel, self._penalty = settings.radius, settings.funnel, settings.penalty
        self._length = LARGEST  # of the last step, in the same norm
        self._multipliers: Array | None = None
        self._settled = self._creeps = False  # the second: along its limits, which it does not come to meet
        self._missed = np.zeros(self._g.shape, bool)  # residuals that a rejected step broke unseen

    def result(self, iterations: int) -> Result:
        """Return where the iteration is."""
        return Result(self.x, self.cost, self.violation, iterations, self.ended and not self.landing)

    def advance(self) -> None:
        """Try a step: take it, or know better for the next one."""
        settings, self.tightened = self._settings, False
        proximal = self._landing_weight() if self.landing or self._settled or self._creeps else settings.proximal
        near = next(near for length, near in settings.near if self._length > length)
        where = Near(self.violation, near, LEAP * self._length, self._missed, self._multipliers)
        model = self._steps.model(self.x, self._g, where, proximal=proximal, penalty=self._penalty)
        step = self._propose(model)
        if step is None:
            self._radius *= 0.25
        else:
            self._try(step, model.held)
        if self.x is not self._start:
            self._violations.append(self.violation)
        if self._is_stuck() and self._penalty < self.cost:  # breaking its limits may pay: it will not
            self._penalty, self._violations = HEAVY * self.cost, [self.violation]
        if self._is_stuck() and not self._creeps and self.violation < NEARLY:
            self._creeps, self._violations = True, [self.violation]
        self.ended |= self._radius < SMALLEST or self._is_stuck()

    def _landing_weight(self) -> float:
        brief = max(BRIEF / self._motion.duration(np.exp(self.x[self._motion.split :])), 1.0)
        return (SHORTEST if self.landing else LANDING) * brief**3

    def _is_stuck(self) -> bool:
        """Whether it was never feasible, and the least violation hardly falls any more."""
        before, recent = self._violations[:-PATIENCE], self._violations[-PATIENCE:]
        least, enough = min(before, default=0.0), self._settings.violation_tolerance
        return least > enough and min(recent) > max(PROGRESS * least, enough)

    def _propose(self, model: Model) -> Step | None:
        """Solve the quadratic programme, again in other ways where that helps little."""
        box = self._radius * self._scale
        step = model.solve(box, warm=self._multipliers)
        if self.violation > self._settings.violation_tolerance and (step is None or step.left > STUCK):
            relaxed = model.solve(box, relax=True)
            if relaxed is not None and relaxed.left > STUCK and self._penalty < self.cost:
                self._penalty = HEAVY * self.cost
            return relaxed or step
        if step is None and self._multipliers is not None:
            return model.solve(box)
        return step

    def _try(self, step: Step, held: Mask) -> None:
        """Take a step if it holds what it promised."""
        settings = self._settings
        x = self.x + step.dx
        cost, g, violation = self._steps.value(x)
        gain = step.gain
        predicted = gain + self._penalty * self.violation * (1 - step.left)
        reduction = self.cost - cost + self._penalty * (self.violation - violation)
        cheaper = violation <= self._funnel and self.cost - cost > WORTH * gain > 0
        size = float(np.abs(step.dx / self._scale).max())
        self._multipliers = step.multipliers
        if np.isfinite(reduction) and (cheaper or reduction > ENOUGH * predicted):
            if reduction <= ENOUGH * predicted:
                self._funnel *= NARROWER
            if cheaper or reduction > GOOD * predicted:
                self._radius = min(2.5 * self._radius, LARGEST) if size > 0.8 * self._radius else self._radius
            elif reduction < POOR * predicted:
                self._radius *= 0.5
            self._settled = max(abs(self.cost - cost), abs(gain)) < settings.cost_tolerance * cost
            self.ended = (self._settled or self._creeps or self.landing) and violation < settings.violation_tolerance
            self.x, self.cost, self._g, self.violation, self._length = x, cost, g, violation, size
            self._missed[:] = False
            if self.ended and not self.landing and self._looks:
                self._look_between()
        else:
            self._learn(self._bounds.excess(g), held, size)

    def _look_between(self) -> None:
        """Go on within tighter bounds where residuals are too far outside between the points of the grid."""
        tighter = self._bounds.tightened(self._g, self._motion.grid.midway)
        if tighter is None:
            return
        self.ended, self.tightened, self._looks, self._bounds = False, True, self._looks - 1, tighter
        self._steps = steps_of(self._motion, tighter, self._settings.thin)
        self.violation = tighter.violation(self._g)

    def _learn(self, excess: Array, held: Mask, size: float) -> None:
        """Hold what a refused step broke unseen; make the next one shorter unless that was the worst of it."""
        broken = excess > self._settings.violation_tolerance
        unseen = crests(excess, thin=self._settings.thin) & broken & ~held
        self._missed |= unseen
        if not (unseen.any() and excess[unseen].max() >= excess.max()):
            self._radius = 0.35 * min(self._radius, size)
