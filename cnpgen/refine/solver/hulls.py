"""Clearances of the links' hulls: what passes hold in the place of capsules, where these leave no way.

A capsule sticks out of its link by centimetres. Of pieces that are near each other Coal tells the distance, the points
where they are nearest, and the direction in which they are apart; how fast the points move along it is the derivative
of the distance, since to first order the motion of the points on the pieces, and of the direction, changes nothing.
"""

from dataclasses import replace
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from cnpgen.problems.constraints.clearance import RobotClearance
from cnpgen.problems.constraints.self_clearance import SelfClearance
from cnpgen.refine.solver.grid import Grid
from cnpgen.refine.solver.residuals import DISTANCE
from cnpgen.refine.solver.transcription import Linearisation, ResidualKernels, Transcription, of_last
from cnpgen.robots.solid import solids_of
from cnpgen.trajectory.boundary import Boundary
from cnpgen.world.bodies import Bodies, Contacts
from cnpgen.world.trace import Trace

if TYPE_CHECKING:
    from cnpgen.problems.problem import Problem
    from cnpgen.robots.robot import Robot

Array = NDArray[np.float64]
NEAR = 0.04  # m beyond the distance that is asked for: what is further apart is not measured


def keeps_clear(problem: "Problem", robot: "Robot") -> bool:
    """Whether a problem keeps its robot's links clear of anything."""
    kept = any(isinstance(each, RobotClearance | SelfClearance) for each in problem.constraint)
    return kept and robot.shape is not None


class Hulls:
    """The clearances of a robot's convex pieces at many states. One process, one thread: Coal's memory is reused.

    Args:
        problem: The problem.
        robot: Its robot; ``keeps_clear`` says that there is something to measure.

    Attributes:
        least: What the distances must be at least [m], shape (m,): of two links, or of a link and an obstacle.
        tolerance: How much may be missing of them in a valid motion [m].
    """

    def __init__(self, problem: "Problem", robot: "Robot") -> None:
        assert robot.shape is not None
        self._model, self._obstacles, self._n = robot.model, problem.obstacle, robot.n
        self._data, self._trace = self._model.createData(), Trace(self._model)
        self._bodies = Bodies(robot.shape, len(problem.obstacle), robot.n)
        kept = [each for each in problem.constraint if isinstance(each, RobotClearance | SelfClearance)]
        links = [piece.link for piece in robot.shape.pieces]
        names = [*links, *range(len(problem.obstacle))]
        columns: dict[Any, int] = {}
        self._groups, self._unseen, least = [], [], dict[int, float]()
        seen = {frozenset((pair.first, pair.second)) for pair in robot.shape.pairs if pair.for_solvers}
        for constraint in kept:
            around = isinstance(constraint, RobotClearance)
            pairs = self._bodies.from_obstacles if around else self._bodies.among_links
            which = [columns.setdefault((names[a], names[b]), len(columns)) for a, b in pairs.tolist()]
            least |= {column: max(least.get(column, 0.0), constraint.distance) for column in which}
            self._groups.append((pairs, np.array(which, np.intp), constraint.distance))
            if not around:
                unseen = [frozenset((names[a], names[b])) not in seen for a, b in pairs.tolist()]
                self._unseen.append((pairs[np.array(unseen, bool)], which, constraint.distance))
        self.least = np.array([least[column] for column in range(len(columns))])
        self.tolerance = max(each.tolerance for each in kept)
        supports = [list(each) for each in self._model.supports]
        self._moves = np.array([[joint in above for joint in range(1, robot.n + 1)] for above in supports])

    def near(self, q: Array, tops: Array) -> tuple[Array, list[Contacts]]:
        """Measure what is near.

        Args:
            q: Joint positions [rad], shape (n, K).
            tops: The numbers of the obstacles, shape (numbers,).

        Returns:
            Distances [m], shape (K, m), ``NEAR`` beyond the least where they are larger; and all contacts, constraint
            by constraint. Positions that are no numbers have no distances.
        """
        if not np.isfinite(q).all():
            return np.full((q.shape[1], len(self.least)), np.nan), []
        self._place(q, tops)
        distances = np.repeat((self.least + NEAR)[None], q.shape[1], axis=0)
        found = [self._bodies.contacts(pairs, least + NEAR) for pairs, _, least in self._groups]
        for contacts, (_, columns, _) in zip(found, self._groups, strict=True):
            np.minimum.at(distances, (contacts.k, columns[contacts.pair]), contacts.distance)
        return distances, found

    def clear(self, q: Array, tops: Array, *, of_all: bool = True) -> NDArray[np.bool_]:
        """Say at which of the states (n, K) distances are large enough, shape (K,).

        Args:
            q: Joint positions [rad], shape (n, K).
            tops: The numbers of the obstacles, shape (numbers,).
            of_all: Whether of all that ``least`` is about, or only of links whose capsules nobody keeps apart.
        """
        self._place(q, tops)
        met = np.ones(q.shape[1], bool)
        for pairs, _, least in self._groups if of_all else self._unseen:
            met &= self._bodies.between(pairs).clear(least)
        return met

    def depth(self, q: Array, tops: Array) -> float:
        """How much is missing of the distances at the worst of the states (n, K) [m]."""
        return float((self.least - self.near(q, tops)[0]).max(initial=-NEAR))

    def slopes(self, q: Array, distances: Array, found: list[Contacts]) -> Array:
        """Differentiate what ``near`` measured with respect to q: shape (n, m, K), 0 where nothing is near."""
        import pinocchio as pin

        slopes, model, data = np.zeros((q.shape[1], len(self.least), self._n)), self._model, self._data
        J = np.array([pin.computeJointJacobians(model, data, state).reshape(6, -1) for state in q.T.copy()])
        for contacts, (_, columns, _) in zip(found, self._groups, strict=True):
            k, column = contacts.k, columns[contacts.pair]
            away = np.repeat(contacts.away[:, None], 2, axis=1)
            twist = np.concatenate([away, np.cross(contacts.points, away)], axis=2)  # times that of a body: its speed
            speeds = np.einsum("cbi,cij,cbj->cbj", twist, J[k], self._moves[contacts.joints], optimize=True)
            nearest = contacts.distance <= distances[k, column]
            slopes[k[nearest], column[nearest]] = (speeds[:, 1] - speeds[:, 0])[nearest]
        return slopes.transpose(2, 1, 0)

    def _place(self, q: Array, tops: Array) -> None:
        self._bodies.place(*self._trace.poses(q), solids_of(self._obstacles, tops))


class HullTranscription(Transcription):
    """One motion on one grid with the clearances of the links' hulls as further residuals, evaluated in NumPy.

    Args:
        stage: The kernels.
        grid: The grid.
        hulls: What measures.
        boundary: As of ``Transcription``.
        tops: Likewise.
    """

    def __init__(self, stage: ResidualKernels, grid: Grid, hulls: Hulls, *, boundary: Boundary, tops: Array) -> None:
        super().__init__(replace(stage, steps=None), grid, boundary=boundary, tops=tops)
        self._hulls = hulls
        self._near = of_last(lambda w: hulls.near(w[: self.n], tops))

    def measured(self, x: Array) -> tuple[float, Array]:
        """Evaluate the objective and residuals (K, m + columns)."""
        cost, g = super().measured(x)
        return cost, np.hstack([g, self._near(self._at(x)[0])[0] / DISTANCE])

    def evaluate(self, x: Array) -> Linearisation:
        """Evaluate objective and residuals with their derivatives."""
        at, (w, _, _) = super().evaluate(x), self._at(x)
        distances, found = self._near(w)
        slopes = np.zeros((len(w), len(self._hulls.least), w.shape[1]))
        slopes[: self.n] = self._hulls.slopes(w[: self.n], distances, found) / DISTANCE
        jacobian = np.concatenate([at.jacobian, slopes], axis=1)
        return replace(at, g=np.hstack([at.g, distances / DISTANCE]), jacobian=jacobian)
