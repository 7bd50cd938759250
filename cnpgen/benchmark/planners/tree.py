"""Sparse trees of states that grow from a start, as in SST (Li, Littlefield, Bekris, 2016).

A node has a path of states, a cost and a witness, and expensive nodes are pruned. The trees of
``refine/rrt_connect.py`` have configurations and parents only, so the two share no code.
"""

from collections.abc import Callable
from dataclasses import dataclass
from time import perf_counter

import numpy as np
from numpy.typing import NDArray

from cnpgen.problems.problem import Problem
from cnpgen.trajectory.sampled_trajectory import Trajectory

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Radii:
    """Distances of the tip [m].

    Attributes:
        select: Radius around a sampled position in which the node of least cost is extended.
        witness: Radius around a witness in which only the node of least cost is kept.
        goal: Maximum distance from the goal.
    """

    select: float
    witness: float
    goal: float


HIT_SELECT_M, HIT_GOAL_M = 0.05, 0.02  # the paper's radii
TRANSPORT_SELECT_M, TRANSPORT_GOAL_M = 0.2, 0.2


def radii_of(problem: Problem, witness: float) -> Radii:
    """Return the radii for hits or for transports, with the radius of witnesses [m].

    The paper has 0.1 m for the witnesses of transports, which a state from rest cannot leave.
    """
    if problem.object_size is None:
        return Radii(HIT_SELECT_M, witness, HIT_GOAL_M)
    return Radii(TRANSPORT_SELECT_M, witness, TRANSPORT_GOAL_M)


class Tree:
    """Tree of states; each node has the path from its parent.

    A state is (q, dq), distances are those of the tip in the workspace, the cost of a node is the time from the start.

    Args:
        start: The root, shape (2 n,).
        tip: Tip position of the root [m], shape (3,).
        radii: The distances.
        step: Time between two states of a path [s].
    """

    def __init__(self, start: Array, tip: Array, radii: Radii, step: float) -> None:
        self._radii, self._step = radii, step
        self._paths, self._parents = [start[None]], [-1]
        self._tips, self._cost = _GrowingArray((3,)), _GrowingArray(())
        self._witnesses, self._holders = _GrowingArray((3,)), _GrowingArray(())
        for rows, row in ((self._tips, tip), (self._cost, 0.0), (self._witnesses, tip), (self._holders, 0)):
            rows.append(row)

    def state(self, node: int) -> Array:
        """Return the state at a node, shape (2 n,)."""
        return np.asarray(self._paths[node][-1])

    def tip(self, node: int) -> Array:
        """Return the tip position of a node [m], shape (3,)."""
        return np.asarray(self._tips.rows[node])

    def select(self, position: Array) -> int:
        """Return the active node of least cost near a position, or the nearest one."""
        active = self._holders.rows.astype(int)
        distances = np.linalg.norm(self._tips.rows[active] - position, axis=1)
        close = active[distances < self._radii.select]
        return int(close[np.argmin(self._cost.rows[close])]) if len(close) else int(active[np.argmin(distances)])

    def add(self, parent: int, path: Array, tip: Array) -> int:
        """Add a node unless a cheaper one exists near the same witness.

        Args:
            parent: Parent of the node.
            path: States from the parent, shape (K, 2 n).
            tip: Tip position of the node [m], shape (3,).

        Returns:
            The active node near the witness: the new one or the cheaper one.
        """
        node, cost = len(self._paths), self._cost.rows[parent] + self._step * len(path)
        distances = np.linalg.norm(self._witnesses.rows - tip, axis=1)
        witness = int(np.argmin(distances))
        if distances[witness] >= self._radii.witness:
            self._witnesses.append(tip)
            self._holders.append(node)
        elif self._cost.rows[holder := int(self._holders.rows[witness])] <= cost:
            return holder
        else:
            self._holders.rows[witness] = node
        self._paths.append(path)
        self._parents.append(parent)
        self._tips.append(tip)
        self._cost.append(cost)
        return node

    def path_to(self, node: int) -> Trajectory:
        """Return the trajectory from the start to a node."""
        parts = []
        while node >= 0:
            parts.append(self._paths[node])
            node = self._parents[node]
        states = np.concatenate(parts[::-1])
        n = states.shape[1] // 2
        return Trajectory(self._step * np.arange(float(len(states))), states[:, :n], states[:, n:])

    def grow(
        self, extend: Callable[[], int], goal: Array, *, time_limit: float, max_iterations: int
    ) -> Trajectory | None:
        """Grow until a node is within the goal radius.

        Args:
            extend: Function that extends the tree and returns the active node; 0 is the root.
            goal: Goal position of the tip [m], shape (3,).
            time_limit: Maximum time [s].
            max_iterations: Maximum number of extensions.

        Returns:
            The trajectory to the node nearest to the goal; None if it is the root.
        """
        deadline = perf_counter() + time_limit
        best, min_distance = 0, float(np.linalg.norm(self.tip(0) - goal))
        for _ in range(max_iterations):
            if min_distance <= self._radii.goal or perf_counter() > deadline:
                break
            node = extend()
            distance = float(np.linalg.norm(self.tip(node) - goal))
            if distance < min_distance:
                best, min_distance = node, distance
        return self.path_to(best) if best else None


class _GrowingArray:
    """Array to which rows are appended."""

    def __init__(self, shape: tuple[int, ...]) -> None:
        self._all, self._count = np.empty((1024, *shape)), 0

    @property
    def rows(self) -> Array:
        """The rows so far."""
        return self._all[: self._count]

    def append(self, row: Array | float) -> None:
        """Add a row."""
        if self._count == len(self._all):
            self._all = np.concatenate([self._all, np.empty_like(self._all)])
        self._all[self._count] = row
        self._count += 1
