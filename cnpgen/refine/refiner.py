"""Refining one plan: a cheap first pass, a polish on a finer grid where a fine check fails, other starts only then."""

from dataclasses import dataclass, replace
from enum import IntEnum
from functools import cached_property
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from cnpgen.kernels.library import KernelLibrary
from cnpgen.recipes import Problem
from cnpgen.refine import starts
from cnpgen.refine.bounds import BoundsTemplate, Tightening
from cnpgen.refine.sqp import Settings, minimise
from cnpgen.refine.transcription import Grid, Transcription, make_grid, residual_scale, stage_jacobian, stage_values
from cnpgen.trajectory.boundary import Boundary

if TYPE_CHECKING:
    from cnpgen.robots.robot import Robot
    from cnpgen.verify.world import World

Array = NDArray[np.float64]
FINE = 1000  # phases of the fine check


class Outcome(IntEnum):
    """How refining a plan ended."""

    SOLVED = 0
    POLISHED = 1
    RESTARTED = 2
    KEPT = 3
    UNSOLVED = 4

    @property
    def text(self) -> str:
        """The outcome in words."""
        return {
            Outcome.SOLVED: "solved in the first pass",
            Outcome.POLISHED: "solved after a polish on a finer grid",
            Outcome.RESTARTED: "solved from another start",
            Outcome.KEPT: "kept as it was given: nothing better was found",
            Outcome.UNSOLVED: "no plan within the tolerances was found; this is the best one",
        }[self]


@dataclass(frozen=True)
class Pass:
    """One grid with its tightening and iteration settings."""

    points: int
    tightening: Tightening
    settings: Settings


def default_passes(problem: Problem) -> tuple[Pass, Pass, Pass]:
    """First pass, polish, other starts."""
    crowded = bool(problem.obstacle)
    first = Tightening(limit=4e-3 if crowded else 3e-3, gentle=1e-3 if crowded else 1e-4, clearance=1e-3, band=0.1)
    finer = replace(first, limit=4e-3)
    return (
        Pass(128, first, Settings()),
        Pass(256, finer, Settings(radius=0.1, max_iterations=20)),
        Pass(192, finer, Settings(max_iterations=60)),
    )


@dataclass(frozen=True)
class Refined:
    """A refined plan.

    Attributes:
        path: Path control points [rad], shape (C, n).
        rate: Rate control points [1/s], shape (R,).
        outcome: How it ended.
        excess: Worst violation on the fine grid, as a multiple of what is allowed; at most 1 is within the tolerances.
        iterations: Steps of all passes together.
    """

    path: Array
    rate: Array
    outcome: Outcome
    excess: float
    iterations: int


class Refiner:
    """Refines plans of one problem.

    Args:
        problem: The problem.
        robot: Its robot.
        kernels: Where kernels are loaded from.
        world: Any world of the problem.
    """

    def __init__(self, problem: Problem, robot: "Robot", *, kernels: KernelLibrary, world: "World") -> None:
        self.problem, self.robot = problem, robot
        self._values, self._jacobian = kernels.load(stage_values), kernels.load(stage_jacobian)
        self._passes = default_passes(problem)
        self._grids = [make_grid(problem, each.points) for each in self._passes]
        self._bounds = [
            BoundsTemplate(problem, world, grid.s, each.tightening)
            for grid, each in zip(self._grids, self._passes, strict=True)
        ]
        self._fine = make_grid(problem, FINE)
        self._fine_bounds = BoundsTemplate(problem, world, self._fine.s, Tightening(0.0, 0.0, 0.0, 0.0))
        self._allowed = np.concatenate(
            [
                constraint.allowed(condition)
                / residual_scale(condition.lower, condition.upper, constraint.tolerance, condition.exactness)
                for constraint in problem.constraint
                for condition in constraint.measured(world)
            ]
        )

    @cached_property
    def _middle(self) -> Array:
        return (self.robot.position_lower + self.robot.position_upper) / 2

    def refine(
        self, boundary: Boundary, *, tops: Array, start_tip: Array, path: Array | None = None, rate: Array | None = None
    ) -> Refined:
        """Refine one plan, or make one from nothing.

        Args:
            boundary: Boundary conditions of one motion.
            tops: Heights of its obstacles [m], shape (obstacles,).
            start_tip: Position of the tip at the start [m], shape (3,).
            path: Path control points of the given plan [rad], shape (C, n), or None.
            rate: Its rate control points [1/s], shape (R,), positive.
        """
        given = path is not None and rate is not None
        fine = self._transcription(self._fine, boundary, tops)
        limits = self._fine_bounds.of(start_tip)

        def excess(x: Array) -> float:
            _, g = fine.value(x)
            worst = (np.maximum(g - limits.upper, limits.lower - g) / self._allowed).max()
            return float(worst) if np.isfinite(worst) else np.inf

        if given:
            assert path is not None
            assert rate is not None
            first = fine.pack(path, rate)
        else:
            first = np.concatenate([part.ravel() for part in self._straight(boundary)])
        x, iterations = self._pass(0, boundary, tops, start_tip, first, warm=given)
        best, outcome = (excess(x), x), Outcome.SOLVED
        if best[0] > 1:
            x, more = self._pass(1, boundary, tops, start_tip, best[1], warm=True)
            iterations += more
            best, outcome = min(best, (excess(x), x), key=lambda pair: pair[0]), Outcome.POLISHED
        for other in self._other_starts(boundary) if best[0] > 1 else ():
            x, more = self._pass(2, boundary, tops, start_tip, np.concatenate([p.ravel() for p in other]), warm=False)
            iterations += more
            best, outcome = min(best, (excess(x), x), key=lambda pair: pair[0]), Outcome.RESTARTED
            if best[0] <= 1:
                break
        if best[0] > 1:
            outcome = Outcome.UNSOLVED
        if given and self._worse(fine, best, (excess(first), first)):
            best, outcome = (excess(first), first), Outcome.KEPT
        return Refined(*fine.unpack(best[1]), outcome, best[0], iterations)

    def _worse(self, fine: Transcription, new: tuple[float, Array], old: tuple[float, Array]) -> bool:
        """Whether the new plan breaks more than the old one, or breaks as little and costs more."""
        if max(new[0], 1.0) != max(old[0], 1.0):
            return max(new[0], 1.0) > max(old[0], 1.0)
        return fine.value(new[1])[0] > fine.value(old[1])[0]

    def _pass(
        self, index: int, boundary: Boundary, tops: Array, start_tip: Array, x: Array, *, warm: bool
    ) -> tuple[Array, int]:
        each = self._passes[index]
        settings = replace(each.settings, radius=min(each.settings.radius, 0.1)) if warm else each.settings
        motion = self._transcription(self._grids[index], boundary, tops)
        result = minimise(motion, self._bounds[index].of(start_tip), x, settings)
        return result.x, result.iterations

    def _transcription(self, grid: Grid, boundary: Boundary, tops: Array) -> Transcription:
        return Transcription(
            self.problem, grid, values=self._values, jacobian=self._jacobian, boundary=boundary, tops=tops
        )

    def _straight(self, boundary: Boundary) -> tuple[Array, Array]:
        interior, rate = starts.straight(boundary, self.robot.velocity_limit, self.problem.trajectory)
        return interior, np.log(rate)

    def _other_starts(self, boundary: Boundary) -> "list[tuple[Array, Array]]":
        spec, limit = self.problem.trajectory, self.robot.velocity_limit
        found = [
            starts.straight(boundary, limit, spec),
            starts.through(boundary, limit, spec, middle=self.robot.base),
            starts.smooth(boundary, limit, spec),
            starts.through(boundary, limit, spec, middle=self._middle),
        ]
        return [(interior, np.log(rate)) for interior, rate in found]
