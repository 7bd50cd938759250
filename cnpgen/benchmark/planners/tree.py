"""Sparse trees of states that grow from a start, as in SST (Li, Littlefield, Bekris, 2016).

The tree of ``refine/rrt_connect.py`` has other nodes and no pruning, so the two share no code.
"""

from collections.abc import Callable
from dataclasses import dataclass
from time import perf_counter

import numpy as np
from numpy.typing import NDArray

from cnpgen.benchmark.trajectory import Trajectory
from cnpgen.problems.problem import Problem

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


HIT = Radii(0.05, 0.02, 0.02)
TRANSPORT = Radii(0.2, 0.02, 0.2)  # the paper has 0.1 for witnesses, which a state from rest cannot leave


def radii_of(problem: Problem) -> Radii:
    """Return the radii for hits or for transports."""
    return HIT if problem.object_size is None else TRANSPORT


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
        self._tips, self._cost = _Rows((3,)), _Rows(())
        self._witnesses, self._holders = _Rows((3,)), _Rows(())
        for rows, row in ((self._tips, tip), (self._cost, 0.0), (self._witnesses, tip), (self._holders, 0)):
            rows.append(row)

    def state(self, node: int) -> Array:
        """Return the state at a node, shape (2 n,)."""
        return np.asarray(self._paths[node][-1])

    def tip(self, node: int) -> Array:
        """Return the tip position of a node [m], shape (3,)."""
        return np.asarray(self._tips.rows[node])

    def selected(self, place: Array) -> int:
        """Return the active node of least cost near a position, or the nearest one."""
        kept = self._holders.rows.astype(int)
        away = np.linalg.norm(self._tips.rows[kept] - place, axis=1)
        near = kept[away < self._radii.select]
        return int(near[np.argmin(self._cost.rows[near])]) if len(near) else int(kept[np.argmin(away)])

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
        away = np.linalg.norm(self._witnesses.rows - tip, axis=1)
        witness = int(np.argmin(away))
        if away[witness] >= self._radii.witness:
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
        until = perf_counter() + time_limit
        best, nearest = 0, float(np.linalg.norm(self.tip(0) - goal))
        for _ in range(max_iterations):
            if nearest <= self._radii.goal or perf_counter() > until:
                break
            node = extend()
            away = float(np.linalg.norm(self.tip(node) - goal))
            if away < nearest:
                best, nearest = node, away
        return self.path_to(best) if best else None


class _Rows:
    """An array that grows by rows."""

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
