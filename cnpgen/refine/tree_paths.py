"""Initial paths among obstacles from compiled trees, on the manifold of a problem's equalities if it has any.

Several small trees with different margins grow in milliseconds, and large ones if these find few paths. The paths are
sorted by an estimated duration. Large trees with shorter edges follow one by one, until a motion along one of their
paths is valid. If the straight line is free, it is the only path.
"""

from collections.abc import Iterator
from dataclasses import dataclass, replace
from itertools import count, islice

import numpy as np
from numpy.typing import NDArray

from cnpgen.kernels.collision.tree_search import EqualityKernel, TreeSettings, estimated_duration, find_tree_path
from cnpgen.refine.rrt_connect import MAX_TURN, RestSpace
from cnpgen.refine.solver.hulls import Hulls
from cnpgen.refine.task import RefinementTask

Array = NDArray[np.float64]

TREE_MARGINS_M = (6e-3, 3e-3, 1e-3, 0.0)  # of small trees in turn, added to the required distances
SMALL_TREES, SMALL_TREE_EXTENSIONS = 12, 4_000  # four, if these find too few paths
MIN_TREE_PATHS, MAX_TREE_PATHS = 3, 8
LARGE_TREE_EXTENSIONS = 128_000  # without margin, in narrow passages
LARGE_TREES, MAX_UNCONNECTED_TREES = 12, 3  # with edges of either length; three if no tree connects
TREE_EXTENSION_RAD, SHORT_TREE_EXTENSION_RAD = 1.0, 0.5  # length of an edge [rad or m]; shorter ones after the others
TREE_SHORTCUTS = 400  # attempted on a path
MANIFOLD_SPACING_RAD = 0.04  # of projected states, which are all nodes, so that trees have more of them
MANIFOLD_NODES, MANIFOLD_LARGE_TREE_NODES = 6_000, 24_000


@dataclass(frozen=True)
class TreeSearch:
    """Search for paths between the ends of a task by trees with different margins.

    Args:
        task: The task.
        space: Valid states at rest; conditions other than distances are checked on the paths, not in the trees.
        hulls: Clearances of the hulls with compiled checks.
        manifold: Equalities of the problem, or None.
    """

    task: RefinementTask
    space: RestSpace
    hulls: Hulls
    manifold: EqualityKernel | None

    def paths(self) -> Iterator[Array]:
        """Yield paths, corners of shape (K, n) each.

        At most ``MAX_TREE_PATHS`` paths of the first trees are sorted: those that meet all conditions at rest come
        first, and then those of shorter estimated duration. Paths of large trees with shorter edges follow.
        """
        found, seeds = list[Array](), count()
        line = self._grow(0, 0, TREE_EXTENSION_RAD)
        if line is not None:
            yield line
            return
        found += self._small_trees(seeds)
        missing = max(MIN_TREE_PATHS - len(found), 0)
        found += islice(self._large_trees(seeds, TREE_EXTENSION_RAD, bool(found)), missing)
        space, limit = self.space, self.space.robot.velocity_limit
        durations = [(not space.meets_other_conditions(path), estimated_duration(path, limit)) for path in found]
        for index in sorted(range(len(found)), key=durations.__getitem__)[:MAX_TREE_PATHS]:
            yield found[index]
        yield from self._large_trees(seeds, SHORT_TREE_EXTENSION_RAD, bool(found))

    def _small_trees(self, seeds: Iterator[int]) -> Iterator[Array]:
        """Yield the paths of small trees with every margin, and of further ones if these find enough."""
        number = 0
        for seed in islice(seeds, SMALL_TREES):
            if seed == len(TREE_MARGINS_M) and number < MIN_TREE_PATHS:
                return
            margin = TREE_MARGINS_M[seed % len(TREE_MARGINS_M)]
            path = self._grow(seed, SMALL_TREE_EXTENSIONS, TREE_EXTENSION_RAD, margin)
            if path is not None:
                number += 1
                yield path

    def _large_trees(self, seeds: Iterator[int], extension: float, connected: bool) -> Iterator[Array]:
        """Yield the paths of large trees; of fewer ones if there is no path yet."""
        for number, seed in enumerate(islice(seeds, LARGE_TREES)):
            if number == MAX_UNCONNECTED_TREES and not connected:
                return  # there is probably no path
            path = self._grow(seed, LARGE_TREE_EXTENSIONS, extension)
            if path is not None:
                connected = True
                yield path

    def _grow(self, seed: int, extensions: int, length: float, margin: float = 0.0) -> Array | None:
        """Return the path of one pair of trees, or None."""
        settings = TreeSettings(
            self.hulls.obstacle_distance,
            self.hulls.self_distance,
            margin=margin,
            extension=length,
            max_extensions=extensions,
            shortcuts=TREE_SHORTCUTS,
        )
        if self.manifold is not None:
            nodes = MANIFOLD_LARGE_TREE_NODES if extensions == LARGE_TREE_EXTENSIONS else MANIFOLD_NODES
            settings = replace(settings, spacing=MANIFOLD_SPACING_RAD, max_nodes=nodes)
        task, robot = self.task, self.space.robot
        start, goal = task.boundary.start_q[0], task.boundary.goal_q[0]
        lower, upper = np.minimum(start, goal) - MAX_TURN, np.maximum(start, goal) + MAX_TURN
        box = np.maximum(robot.position_lower, lower), np.minimum(robot.position_upper, upper)
        checker = self.hulls.placed_checker(task.scene.poses[0])
        return find_tree_path(
            checker, (start, goal), box, robot.velocity_limit, settings, seed=seed, manifold=self.manifold
        )
