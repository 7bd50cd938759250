"""Boundary problems of the refiner and the attempts at solving them."""

from __future__ import annotations

from dataclasses import dataclass, replace
from enum import IntEnum

import numpy as np

from cnpgen.arrays import Array
from cnpgen.judges.plans.verdict import Reason
from cnpgen.refine.solver.sqp import Deadline
from cnpgen.robots.scene import Scene
from cnpgen.trajectory.boundary import Boundary
from cnpgen.trajectory.spline import basis

# Tolerances on the fine grid; attempts with larger ones are judged only without better
# ones.
MAX_JUDGED_VIOLATION = 3.0
DISTANCE_PHASES = 512  # at which motions are compared with their input path


class Outcome(IntEnum):
    """Result of refining a plan."""

    SOLVED = 0
    TIME_SCALED = 1
    SOLVED_FINE = 2
    RESTARTED = 3
    UNCHANGED = 4
    UNSOLVED = 5
    INVALID_INPUT = 6
    ADJUSTED = 7
    NOT_CONVERGED = 8
    OUT_OF_TIME = 9
    NO_PATH = 10

    @property
    def text(self) -> str:
        """Description of the outcome."""
        return {
            Outcome.SOLVED: "solved on the coarse level",
            Outcome.TIME_SCALED: "valid after uniform time scaling",
            Outcome.SOLVED_FINE: "solved on a finer level",
            Outcome.RESTARTED: "solved from another initial guess",
            Outcome.UNCHANGED: "input plan returned unchanged: no better plan was found",
            Outcome.UNSOLVED: "no valid plan was found; this is the best attempt",
            Outcome.ADJUSTED: "input plan returned with exact boundary conditions and positive rates",
            Outcome.NOT_CONVERGED: "valid, but the objective still decreased at the iteration limit",
            Outcome.OUT_OF_TIME: "the best plan until the deadline; more time may give a better one",
            Outcome.NO_PATH: "no path among the obstacles was found by the trees; this is the best attempt",
            Outcome.INVALID_INPUT: "the boundary conditions are not finite",
        }[self]


@dataclass(frozen=True)
class RefinementTask:
    """Boundary problem with an optional input plan."""

    boundary: Boundary  # boundary conditions of one motion, shape (1, n) each
    scene: Scene  # its obstacles, one sample
    start_xyz: Array  # position of the tip at the start [m], shape (3,)
    goal_xyz: Array  # position of the tip at the goal [m], shape (3,)
    # Path control points of the input plan [rad], shape (C, n), or None.
    path: Array | None = None
    # Rate control points of the input plan [1/s], shape (R,), or None.
    rate: Array | None = None
    deadline: Deadline | None = None  # deadline of the solver's iterations, or None
    # Largest difference of every joint from the path of the input plan [rad or m], or
    # None.
    stay_within: float | None = None

    def reference(self, s: Array, degree: int) -> Array | None:
        """Return the input path at phases s, shape (K, n), if motions must stay near it, else None."""
        if (
            self.stay_within is None
            or self.path is None
            or not np.isfinite(self.path).all()
        ):
            return None
        positions: Array = basis(s, len(self.path), degree) @ self.path
        return positions

    def is_near(self, path: Array, degree: int) -> bool:
        """Return whether path control points (C, n) stay within the distance from the input path."""
        s = np.linspace(0, 1, DISTANCE_PHASES)
        reference = self.reference(s, degree)
        if reference is None or self.stay_within is None:
            return True
        return bool(
            np.abs(basis(s, len(path), degree) @ path - reference).max()
            <= self.stay_within
        )

    @property
    def ends(self) -> Array:
        """Joint positions at the start and at the goal [rad], shape (n, 2)."""
        return np.stack([self.boundary.start_q[0], self.boundary.goal_q[0]], axis=1)

    @property
    def at_rest(self) -> bool:
        """Whether the motion starts and ends at rest.

        Time scaling then preserves its boundary conditions.
        """
        ends = (
            self.boundary.start_dq,
            self.boundary.start_ddq,
            self.boundary.goal_dq,
            self.boundary.goal_ddq,
        )
        return all(values is None or not np.any(values) for values in ends)

    @property
    def is_finite(self) -> bool:
        """Whether the boundary conditions are finite."""
        conditions = (
            self.scene.poses,
            self.start_xyz,
            self.goal_xyz,
            *vars(self.boundary).values(),
        )
        return all(
            values is None or bool(np.isfinite(values).all()) for values in conditions
        )


@dataclass(frozen=True, eq=False, kw_only=True)
class Attempt:
    """Trajectory for a boundary problem; after the independent check also its verdict.

    ``violation``, ``severity``, ``is_precise``, ``touches`` and ``x`` are used by the
    search, not part of its result.

    Attributes:
        path: Path control points [rad], shape (C, n).
        rate: Rate control points [1/s], shape (R,).
        cost: Objective [s].
        outcome: Outcome of the refinement if this attempt is its result.
        iterations: Iterations of the solver.
        reason: Reason of the independent verdict: "ok", or why the plan is not valid;
            None before it is judged. For ends that violate a constraint, the reason of
            that constraint.
        violation: Largest violation on the 600-point grid, as a multiple of its
            tolerance; at most 1 is accepted. It is 0 where it was not evaluated because
            the solver converged within its bounds.
        severity: 1 if the plan is valid; otherwise larger, inf if it cannot be
            evaluated.
        is_precise: Whether equalities are met within a fraction of their tolerance, and
            links do not touch anything.
        touches: Whether it is valid and its links touch something within the tolerance.
        x: Variables of the transcription, shape (nx,), or None.
    """

    path: Array
    rate: Array
    cost: float
    outcome: Outcome
    iterations: int = 0
    reason: str | None = None
    violation: float = np.nan
    severity: float = np.nan
    is_precise: bool = False
    touches: bool = False
    x: Array | None = None

    @property
    def valid(self) -> bool:
        """Whether the independent verdict accepts the plan."""
        return self.reason == Reason.OK

    @property
    def rank(self) -> tuple[float, float]:
        """Sort key of judged attempts: the severity first, then the objective."""
        return self.severity, self.cost

    @property
    def variables(self) -> Array:
        """Variables of the transcription, of an attempt that has them, shape (nx,)."""
        assert self.x is not None
        return self.x

    def is_better(self, other: Attempt) -> bool:
        """Return whether the violation is smaller than another's, or as small at a lower cost."""
        # Violations up to 1 are within the tolerances and count as equal.
        mine = max(self.violation, 1.0)
        others = max(other.violation, 1.0)
        return self.cost < other.cost if mine == others else mine < others

    def result(self, iterations: int, outcome: Outcome | None = None) -> Attempt:
        """Return the attempt as the result of a search with so many iterations in total."""
        return replace(
            self,
            iterations=iterations,
            outcome=self.outcome if outcome is None else outcome,
            violation=np.nan,
            severity=np.nan,
            is_precise=False,
            touches=False,
            x=None,
        )
