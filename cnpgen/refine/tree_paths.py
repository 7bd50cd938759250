"""Initial paths among obstacles from compiled trees, for problems whose states at rest are free of equalities.

Several trees with different margins grow in milliseconds; their paths are sorted by an estimated duration. Larger trees
follow one by one, until a motion along one of their paths is valid. If the straight line is free, it is the only path.
"""

from collections.abc import Iterator
from dataclasses import dataclass
from itertools import count, islice

import numpy as np
from numpy.typing import NDArray

from cnpgen.kernels.collision.tree_search import TreeSettings, estimated_duration, find_tree_path
from cnpgen.refine.rrt_connect import MAX_TURN, RestSpace
from cnpgen.refine.solver.hulls import Hulls
from cnpgen.refine.task import RefinementTask

Array = NDArray[np.float64]

TREE_MARGINS_M = (6e-3, 3e-3, 1e-3, 0.0)  # of the trees in turn, added to the required distances
TREE_ROUNDS = ((12, 4_000), (8, 16_000))  # trees and their extensions, until there are enough paths
MIN_TREE_PATHS, MAX_TREE_PATHS = 3, 8
TREE_EXTENSION_RAD = 1.0  # length of an edge [rad or m]
LARGE_TREES, MAX_UNCONNECTED_TREES, LARGE_TREE_EXTENSIONS = 12, 6, 128_000  # six if no tree connected before
LARGE_TREE_EXTENSION_RAD = 0.5  # shorter edges find narrower passages
TREE_SHORTCUTS = 400  # attempted on a path


@dataclass(frozen=True)
class TreeSearch:
    """Search for paths between the ends of a task by trees with different margins.

    Args:
        task: The task.
        space: Valid states at rest; conditions other than distances are checked on the paths, not in the trees.
        hulls: Clearances of the hulls with compiled checks.
    """

    task: RefinementTask
    space: RestSpace
    hulls: Hulls

    def paths(self) -> Iterator[Array]:
        """Yield paths, corners of shape (K, n) each.

        At most ``MAX_TREE_PATHS`` paths of the first trees are sorted: those that meet all conditions at rest come
        first, and then those of shorter estimated duration. Paths of large trees follow, of fewer ones if there is no
        path yet.
        """
        found = self._first_paths()
        space, limit = self.space, self.space.robot.velocity_limit
        durations = [(not space.meets_other_conditions(path), estimated_duration(path, limit)) for path in found]
        for index in sorted(range(len(found)), key=durations.__getitem__)[:MAX_TREE_PATHS]:
            yield found[index]
        if found and len(found[0]) == 2:
            return  # the straight line is free
        large = self._settings(0.0, LARGE_TREE_EXTENSIONS, LARGE_TREE_EXTENSION_RAD)
        first = sum(trees for trees, _ in TREE_ROUNDS)
        for number in range(LARGE_TREES):
            if not found and number == MAX_UNCONNECTED_TREES:
                return  # there is probably no path
            path = self._grow(first + number, large)
            if path is not None:
                found.append(path)
                yield path

    def _first_paths(self) -> list[Array]:
        """Return the paths of the first trees; the straight line alone if it is free."""
        paths, seeds = list[Array](), count()
        for trees, extensions in TREE_ROUNDS:
            for seed in islice(seeds, trees):
                margin = TREE_MARGINS_M[seed % len(TREE_MARGINS_M)]
                path = self._grow(seed, self._settings(margin, extensions, TREE_EXTENSION_RAD))
                if path is not None and len(path) == 2:
                    return [path]
                if path is not None:
                    paths.append(path)
            if len(paths) >= MIN_TREE_PATHS:
                break
        return paths

    def _settings(self, margin: float, extensions: int, length: float) -> TreeSettings:
        return TreeSettings(
            self.hulls.obstacle_distance,
            self.hulls.self_distance,
            margin=margin,
            extension=length,
            max_extensions=extensions,
            shortcuts=TREE_SHORTCUTS,
        )

    def _grow(self, seed: int, settings: TreeSettings) -> Array | None:
        """Return the path of one pair of trees, or None."""
        task, robot = self.task, self.space.robot
        start, goal = task.boundary.start_q[0], task.boundary.goal_q[0]
        lower, upper = np.minimum(start, goal) - MAX_TURN, np.maximum(start, goal) + MAX_TURN
        box = np.maximum(robot.position_lower, lower), np.minimum(robot.position_upper, upper)
        checker = self.hulls.placed_checker(task.scene.poses[0])
        return find_tree_path(checker, (start, goal), box, robot.velocity_limit, settings, seed=seed)
