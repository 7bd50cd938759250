"""Refining one plan: a cheap first pass, a polish on a finer grid where a check fails, other starts only then."""

from collections.abc import Generator, Iterator
from dataclasses import replace
from functools import cached_property
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from cnpgen.kernels.library import KernelLibrary
from cnpgen.problems.problem import Problem
from cnpgen.refine.fine import FineCheck
from cnpgen.refine.passes import FAR, Pass, Passes, default_passes
from cnpgen.refine.seeds import Space, along_way, find_ways
from cnpgen.refine.solver import starts
from cnpgen.refine.solver.bounds import Bounds, BoundsTemplate
from cnpgen.refine.solver.compiled import load_steps
from cnpgen.refine.solver.criterion import Criterion, criterion_residuals
from cnpgen.refine.solver.grid import make_grid
from cnpgen.refine.solver.hulls import Hulls, HullTranscription, keeps_clear
from cnpgen.refine.solver.residuals import stage_jacobian, stage_values
from cnpgen.refine.solver.sqp import DEFAULT, Result, Settings, minimise
from cnpgen.refine.solver.transcription import ResidualKernels, Transcription
from cnpgen.refine.task import Attempt, Outcome, Task
from cnpgen.trajectory.motion import Motion
from cnpgen.trajectory.rest import with_fewer_knots, with_finer_knots
from cnpgen.trajectory.spec import TrajectorySpec

if TYPE_CHECKING:
    from cnpgen.robots.robot import Robot
    from cnpgen.world.state import World

Array = NDArray[np.float64]
SLOWEST = 60.0  # s: a plan that takes longer is no start
LOWEST_RATE = 1e-3  # of a plan's largest rate control point
LOST = 10.0  # boundary states further outside, in scaled units, are no problem for steps; DAQP may take hours over them
TOUCHING = 0.02  # m: as deep as links may be in a plan that is gone on from
CERTAIN = 1e-5  # m: what is deeper at an end is not a matter of rounding
ROOM = 1.6  # times slower than bounds of speeds ask for: a start that is within them moves on more easily
ROUNDS = 4  # from a motion that was slowed down; most need one


class Refiner:
    """Refines plans of one problem, one at a time.

    Args:
        problem: The problem.
        robot: Its robot.
        kernels: Where kernels are loaded from.
        world: Any world of the problem.
        spec: Degree and numbers of control points; the problem's by default.
        criterion: What is minimised beside the time, or None.
        settings: How to iterate.
        passes: Grids and tightening; ``default_passes`` by default.
        coarser: A refiner for the problem's own control points, where plans have several spans for each of its spans.
    """

    def __init__(
        self,
        problem: Problem,
        robot: "Robot",
        *,
        kernels: KernelLibrary,
        world: "World",
        spec: TrajectorySpec | None = None,
        criterion: Criterion | None = None,
        settings: Settings = DEFAULT,
        passes: Passes | None = None,
        coarser: "Refiner | None" = None,
    ) -> None:
        self.problem, self.robot, self.settings, self.coarser = problem, robot, settings, coarser
        self.spec = problem.trajectory if spec is None else spec
        residuals = None if criterion is None else kernels.load(criterion_residuals, kind=criterion.kind)
        self.stage = ResidualKernels(
            self.spec,
            kernels.load(stage_values),
            kernels.load(stage_jacobian),
            criterion,
            residuals,
            load_steps(kernels),
        )
        self.passes = default_passes(problem, settings) if passes is None else passes
        self.check = FineCheck(problem, world, self.stage)
        orders = problem.path_orders
        self._grids = {points: make_grid(self.spec, points, orders) for points in {each.points for each in self._every}}
        self._bounds = {
            each: BoundsTemplate(problem, world, self._grids[each.points].s, each.tightening) for each in self._every
        }

    @property
    def _every(self) -> tuple[Pass, ...]:
        return tuple(vars(self.passes).values())

    @cached_property
    def _middle(self) -> Array:
        return (self.robot.position_lower + self.robot.position_upper) / 2

    def given(self, task: Task) -> Array | None:
        """Return the variables of the task's plan, or None where there is no usable one.

        One that takes longer than a minute is none: from there the quadratic programmes hardly move.

        Rate control points that are not positive, though r may be, are raised: the variables are logarithms.
        """
        if task.path is None or task.rate is None or not np.isfinite(task.path).all():
            return None
        if not np.isfinite(task.rate).all() or not np.any(task.rate > 0):
            return None
        motion, rate = self.check.transcription(task), np.maximum(task.rate, LOWEST_RATE * task.rate.max())
        return motion.pack(task.path, rate) if motion.duration(rate) < SLOWEST else None

    def attempts(self, task: Task, given: Array | None) -> Iterator[Attempt]:
        """Yield plans, dearer ones later; whoever asks for the next one found something wrong with the last one.

        Args:
            task: What to plan; its boundary conditions are numbers.
            given: What ``given`` says of it.
        """
        if self.settings.max_iterations == 0:
            yield self._slowed_only(task, given)
            return
        if given is not None and self.coarser is not None:
            yield from self._by_coarser(self.coarser, task, given)
        repaired = self._measured(task, given, Outcome.ADJUSTED) if given is not None and task.at_rest else None
        best = yield from self._passes(task, given, repaired)
        if self.check.refutes_ends(task):
            return
        for other in self._from_others(task, given if repaired is None else repaired.x, best):
            yield other
            best = other if other.is_better(best) else best
        even = self._slow_enough(task, starts.straight(task.boundary, self.robot.velocity_limit, self.spec))
        # what all of these began with may have led them astray
        if given is not None or not np.array_equal(even, self.straight(task)):
            best = yield from self._restarted(task, None, even, best)
        best = yield from self._restarted(task, best.x, even, best)
        if task.deadline is None and keeps_clear(self.problem, self.robot):
            yield from self._around(task, best)
        elif task.deadline is None and task.at_rest:
            yield from (self._along(task, start) for start in self._ways(task))

    def _by_coarser(self, coarser: "Refiner", task: Task, given: Array) -> Iterator[Attempt]:
        """Yield what the passes make of a plan with fewer control points, written with all of them.

        With three times as many a step takes ten times as long, for objectives that are 0.3 % lower.
        """
        if coarser.spec.path_control_points < task.boundary.fewest_points(coarser.spec.degree):
            return
        own, fewer, degree = self.check.transcription(task), coarser.check.transcription(task), self.spec.degree
        path, rate = own.unpack(given)
        fitted = with_fewer_knots(Motion(path[None], rate[None], degree), task.boundary, coarser.spec)
        start = coarser.given(replace(task, path=fitted.path[0], rate=fitted.rate[0]))
        for attempt in () if start is None else coarser._passes(task, start, None):
            path, rate = fewer.unpack(attempt.x)
            same = with_finer_knots(Motion(path[None], rate[None], degree), self.spec)
            yield replace(attempt, x=own.pack(same.path[0], same.rate[0]))
        if task.deadline is not None:
            task.deadline.longest *= (own.nx / fewer.nx) ** 2  # what steps with all of them may take

    def _restarted(
        self, task: Task, given: Array | None, line: Array, best: Attempt
    ) -> Generator[Attempt, None, Attempt]:
        """Yield the plans of the three passes from another start; return the best attempt of these and ``best``."""
        for attempt in self._passes(task, given, None, line):
            yield replace(attempt, outcome=Outcome.RESTARTED)
            best = attempt if attempt.is_better(best) else best
        return best

    def _passes(
        self, task: Task, given: Array | None, repaired: Attempt | None, line: Array | None = None
    ) -> Generator[Attempt, None, Attempt]:
        """Yield the plans of the three passes, from a given one or from nothing; return the best one.

        Args:
            task: What to plan.
            given: Variables of the given plan.
            repaired: The given plan with exact ends, slowed down, where that may be: where passes begin.
            line: Where they begin where there is no plan, or one that is far off; the straight line by default.
        """
        first = self._first(task, given if repaired is None else repaired.x, line)
        outcome = Outcome.SOLVED if first.ended else Outcome.UNSETTLED
        feasible = first.violation <= self.settings.violation_tolerance
        if feasible:
            cost = first.cost - self.check.transcription(task).gauge(first.x)
            yield Attempt(first.x, 0.0, cost, outcome, first.iterations)  # most are valid; no need to measure
        best = self._measured(task, first.x, outcome, 0 if feasible else first.iterations)
        best = self._iterated_on(task, best)
        if not feasible or best.x is not first.x:
            yield best
        polished = self._attempt(task, self.passes.polish, best.x, Outcome.POLISHED)
        yield polished
        if repaired is not None and repaired.outcome is Outcome.SLOWED and repaired.excess <= 1:
            yield repaired
        best = polished if polished.is_better(best) else best
        strict = self._attempt(task, self.passes.strict, best.x, Outcome.POLISHED)
        yield strict
        return strict if strict.is_better(best) else best

    def _iterated_on(self, task: Task, best: Attempt) -> Attempt:
        """Go on from a motion that had to be slowed down, for as long as that gains.

        A slow-down makes a motion slower everywhere by what a single moment of it asks for.
        """
        for _ in range(ROUNDS):
            if best.outcome is not Outcome.SLOWED:
                break
            again = self._attempt(task, self.passes.given, best.x, Outcome.SOLVED)
            if not (again.excess <= 1 and again.cost < best.cost):
                break
            best = replace(again, iterations=best.iterations + again.iterations)
        return best

    def _slowed_only(self, task: Task, given: Array | None) -> Attempt:
        x, outcome = (self.straight(task), Outcome.SOLVED) if given is None else (given, Outcome.ADJUSTED)
        return self._measured(task, x, outcome, at_any_cost=True)

    def _from_others(self, task: Task, given: Array | None, best: Attempt) -> Iterator[Attempt]:
        """Yield the dearest plans: from the given one with more care, from other starts, from the best one of all.

        ``best`` is the best one so far.
        """
        for x in [*([] if given is None else [given]), *self._other_starts(task)]:
            other = self._attempt(task, self.passes.other, x, Outcome.RESTARTED)
            yield other
            best = other if other.is_better(best) else best
        last = self._slowed(task, best, at_any_cost=True) if task.at_rest else best
        yield self._attempt(task, self.passes.given, last.x, Outcome.RESTARTED)
        if task.at_rest:  # what is left to be said of it is why no speed is slow enough
            yield last

    def _around(self, task: Task, best: Attempt) -> Iterator[Attempt]:
        """Yield plans along ways round the obstacles, and plans that keep the links clear, not their capsules.

        ``best`` is the best one so far; where its links hardly touch anything, it is what is gone on from first.
        """
        hulls, ends = (
            Hulls(self.problem, self.robot),
            np.stack([task.boundary.start_q[0], task.boundary.goal_q[0]], axis=1),
        )
        if hulls.depth(ends, task.tops) > hulls.tolerance + CERTAIN:
            return  # no motion will do
        touching = hulls.depth(self.check.transcription(task).positions(best.x), task.tops) < TOUCHING
        if touching:
            yield from self._on_hulls(task, best, hulls)
        for start in self._ways(task, hulls):
            first = self._along(task, start)
            yield first
            yield from self._on_hulls(task, first if first.excess <= 1 else start, hulls)
        if not touching:
            yield from self._on_hulls(task, best, hulls)

    def _on_hulls(self, task: Task, start: Attempt, hulls: Hulls) -> Iterator[Attempt]:
        """Yield plans with clear links: from a given one, and once more with more room."""
        first = self._attempt(task, self.passes.given, start.x, Outcome.RESTARTED, hulls)
        yield first
        if first.excess <= 1:
            yield self._attempt(task, self.passes.strict, first.x, Outcome.RESTARTED, hulls)

    def _ways(self, task: Task, hulls: Hulls | None = None) -> Iterator[Attempt]:
        """Yield motions along ways that are free, slow enough where they may be."""
        ends, robot = task.boundary, self.robot
        space = Space(self.stage, robot, self.check.bounds_at_rest(task), task.tops, hulls)
        for way in find_ways(ends.start_q[0], ends.goal_q[0], robot, space.follow):
            x = self._slow_enough(task, along_way(way, ends, robot.velocity_limit, self.spec))
            yield self._measured(task, x, Outcome.RESTARTED, at_any_cost=True)

    def _along(self, task: Task, start: Attempt) -> Attempt:
        """Go on from a motion along a way: first so that no step leaves what is free by much, then as usual."""
        best = self._attempt(task, self.passes.way, start.x, Outcome.RESTARTED)
        if best.excess <= 1:
            then = self._attempt(task, self.passes.given, best.x, Outcome.RESTARTED)
            best = self._iterated_on(task, then if then.is_better(best) else best)
        return replace(best, outcome=Outcome.RESTARTED)

    def minimise(self, task: Task, which: Pass, x: Array, hulls: Hulls | None = None) -> Result:
        """Run one pass from variables x, shape (nx,); with hulls these are kept clear in the place of capsules."""
        settings, motion = which.settings, self.transcription(task, which)
        ends = motion.end_residuals()
        bounds = self.bounds(task, which, ends)
        if not np.nanmax(bounds.beyond(ends)) < LOST:
            settings = replace(settings, max_iterations=0)
        if hulls is not None:
            motion = HullTranscription(self.stage, motion.grid, hulls, boundary=task.boundary, tops=task.tops)
            bounds = self._bounds[which].on_hulls(bounds, hulls.least)
        return minimise(motion, bounds, x, settings, deadline=task.deadline)

    def transcription(self, task: Task, which: Pass) -> Transcription:
        """Return the motion on the grid of a pass."""
        return Transcription(self.stage, self._grids[which.points], boundary=task.boundary, tops=task.tops)

    def bounds(self, task: Task, which: Pass, ends: Array) -> Bounds:
        """Return the bounds of a pass for a motion whose boundary states have residuals ``ends``, shape (2, m)."""
        return self._bounds[which].of(task.start_xyz, ends=ends)

    def straight(self, task: Task) -> Array:
        """Return the variables of the straight line, where the first pass begins."""
        return self._slow_enough(task, starts.gentle(task.boundary, self.robot.velocity_limit, self.spec))

    def _first(self, task: Task, x: Array | None, line: Array | None) -> Result:
        """Run the first pass from variables, or from a line where there are none, or far off."""
        if x is not None:
            result = self.minimise(task, self.passes.given, x)
            if result.violation < FAR:
                return result
        return self.minimise(task, self.passes.first, self.straight(task) if line is None else line)

    def _attempt(self, task: Task, which: Pass, x: Array, outcome: Outcome, hulls: Hulls | None = None) -> Attempt:
        result = self.minimise(task, which, x, hulls)
        return self._measured(task, result.x, outcome, result.iterations)

    def _measured(
        self, task: Task, x: Array, outcome: Outcome, iterations: int = 0, *, at_any_cost: bool = False
    ) -> Attempt:
        """Look at a motion on the fine grid; slow it down if it may be and needs it."""
        cost, excess = self.check.measure(task, x)
        attempt = Attempt(x, excess.worst, cost, outcome, iterations)
        return self._slowed(task, attempt, at_any_cost=at_any_cost) if attempt.excess > 1 and task.at_rest else attempt

    def _slowed(self, task: Task, attempt: Attempt, *, at_any_cost: bool = False) -> Attempt:
        motion = self.check.transcription(task)
        x, cost, excess = self.check.slow_down(task, motion, attempt.x, at_any_cost=at_any_cost)
        slowed = Attempt(x, excess.worst, cost, Outcome.SLOWED, attempt.iterations)
        return slowed if slowed.is_better(attempt) else attempt

    def _other_starts(self, task: Task) -> list[Array]:
        boundary, spec, limit = task.boundary, self.spec, self.robot.velocity_limit
        found = [
            starts.straight(boundary, limit, spec),
            starts.through(boundary, limit, spec, middle=self.robot.base),
            starts.smooth(boundary, limit, spec),
            starts.through(boundary, limit, spec, middle=self._middle),
        ]
        return [self._slow_enough(task, start) for start in found]

    def _slow_enough(self, task: Task, start: tuple[Array, Array]) -> Array:
        """Return the variables of a start, slower where other speeds than those of joints are bounded.

        From a motion that is many times too fast the iteration ends far from what is feasible.
        """
        interior, rate = start
        x = np.concatenate([interior.ravel(), np.log(rate)])
        factor = self.check.too_fast(task, x)
        return x if factor == 1 else np.concatenate([interior.ravel(), np.log(rate / (ROOM * factor))])
