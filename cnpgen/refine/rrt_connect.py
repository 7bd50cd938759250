"""Joint-space paths between the ends of a task by RRT-Connect (Kuffner and LaValle 2000).

Compiled trees search them (``cnpgen.kernels.collision.tree_search``), on a manifold if
there are equalities. Where links are capsules, their distances are residuals of a robot
at rest, which the trees check with all others. Random numbers are the same for every
task. The refiner adds velocities and accelerations. The tree of
``benchmark/planners/sst.py`` has states, costs and pruning (SST) and is separate.
"""

from collections.abc import Iterator
from ctypes import CDLL
from dataclasses import dataclass, replace
from itertools import count, islice, pairwise

import numpy as np

from cnpgen.arrays import Array
from cnpgen.kernels.collision.collision_checker import CollisionChecker
from cnpgen.kernels.collision.tree_search import (
    EqualityKernel,
    RestConditions,
    TreeSettings,
    estimated_duration,
    find_tree_path,
)
from cnpgen.refine.solver.hulls import Hulls
from cnpgen.refine.task import RefinementTask
from cnpgen.robots.robot import Robot
from cnpgen.robots.shape.shape import Shape

STATE_SPACING = 0.04  # rad or m, between checked states
# Rad or m, of random configurations from the range between both ends.
MAX_TURN = 2 * np.pi

# Links of a robot whose distances are residuals.
WITHOUT_LINKS = Shape((), {}, (), ())
# Of small trees in turn, added to the required distances.
TREE_MARGINS_M = 6e-3, 3e-3, 1e-3, 0.0
SMALL_TREES, SMALL_TREE_EXTENSIONS = 12, 4_000  # four, if these find too few paths
MIN_TREE_PATHS = 3
MAX_TREE_PATHS = 8
MAX_CHECKED_PATHS = 5  # of trees that check all conditions
LARGE_TREE_EXTENSIONS = 128_000  # without margin, in narrow passages
# With edges of either length; three if no tree connects.
LARGE_TREES = 6
MAX_UNCONNECTED_TREES = 3
# Length of an edge [rad or m]; shorter ones after the others.
TREE_EXTENSION_RAD = 1.0
LARGE_TREE_EXTENSION_RAD = 0.5
SHORT_TREE_EXTENSION_RAD = 0.3
TREE_SHORTCUTS = 400  # attempted on a path
# Of projected states, which are all nodes, so that trees have more of them.
MANIFOLD_SPACING_RAD = 0.04
MANIFOLD_NODES = 6_000
MANIFOLD_LARGE_TREE_NODES = 24_000


def meets_at_rest(conditions: RestConditions, path: Array) -> bool:
    """Return whether the states of a polyline, corners of shape (K, n), meet all conditions at rest."""
    counts = [
        max(int(np.ceil(np.abs(b - a).max() / STATE_SPACING)), 1)
        for a, b in pairwise(path)
    ]
    where = np.concatenate(
        [k + np.arange(count) / count for k, count in enumerate(counts)]
    )
    q = np.stack([np.interp(where, np.arange(len(path)), joint) for joint in path.T])
    w, scene = (
        np.repeat(x[:, None], len(where), axis=1)
        for x in (conditions.w, conditions.scene)
    )
    w[: len(q)] = q
    (g,) = conditions.residuals(w, scene)
    lower, upper = conditions.lower[:, None], conditions.upper[:, None]
    return bool(((g >= lower) & (g <= upper)).all())


@dataclass(frozen=True)
class TreeSearch:
    """Search for paths between the ends of a task by compiled trees, on a manifold if there are equalities.

    Several small trees with different margins grow in milliseconds, and large ones if
    these find few paths. The paths are sorted by an estimated duration. Large trees
    with shorter edges follow one by one, until a motion along one of their paths is
    valid. If the hulls are all distances of the problem, other conditions are checked
    on the paths, not in the trees, where they cost most of the time.

    Attributes:
        task: The task.
        robot: Its robot.
        library: Library of ``load_collision_library``.
        at_rest: Conditions other than distances of the hulls.
        manifold: Equalities of positions, or None.
        hulls: Clearances of the links, or None where links are capsules.
        hulls_only: Whether the hulls are all distances.
        goals: Goals that replace that of the task, shape (G, n), all roots of one tree.
    """

    task: RefinementTask
    robot: Robot
    library: CDLL
    at_rest: RestConditions
    manifold: EqualityKernel | None
    hulls: Hulls | None
    hulls_only: bool
    goals: Array | None = None

    def paths(self) -> Iterator[Array]:
        """Yield paths, corners of shape (K, n) each.

        At most ``MAX_TREE_PATHS`` paths of the first trees are sorted: those that meet
        all conditions at rest come first, and then those of shorter estimated duration.
        Paths of large trees with shorter edges follow. Unless the hulls are all
        distances, only small trees grow, and a path is yielded as soon as it is found.
        """
        if not self.hulls_only:
            yield from islice(self.first_paths(), MAX_CHECKED_PATHS)
            return
        found = list[Array]()
        seeds = count()
        line = self.line()
        if line is not None:
            yield line
            return
        found += self.small_trees(seeds)
        # Large trees only if small ones find too few paths.
        missing = max(MIN_TREE_PATHS - len(found), 0)
        found += islice(
            self._large_trees(seeds, LARGE_TREE_EXTENSION_RAD, bool(found)), missing
        )
        limit = self.robot.velocity_limit
        # Paths that meet all other conditions come first, then the fastest.
        durations = [
            (not meets_at_rest(self.at_rest, path), estimated_duration(path, limit))
            for path in found
        ]
        for index in sorted(range(len(found)), key=durations.__getitem__)[
            :MAX_TREE_PATHS
        ]:
            yield found[index]
        yield from self._large_trees(seeds, SHORT_TREE_EXTENSION_RAD, bool(found))

    def first_paths(self) -> Iterator[Array]:
        """Yield the line if it is valid, else the paths of small trees, each as soon as it is found."""
        line = self.line()
        yield from self.small_trees(count()) if line is None else [line]

    def line(self) -> Array | None:
        """Return the straight line if it is valid: trees without extensions connect."""
        return self._grow(0, 0, TREE_EXTENSION_RAD)

    def small_trees(self, seeds: Iterator[int]) -> Iterator[Array]:
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

    def _large_trees(
        self, seeds: Iterator[int], extension: float, connected: bool
    ) -> Iterator[Array]:
        """Yield the paths of large trees; of fewer ones if there is no path yet."""
        for number, seed in enumerate(islice(seeds, LARGE_TREES)):
            if number == MAX_UNCONNECTED_TREES and not connected:
                # There is probably no path.
                return
            path = self._grow(seed, LARGE_TREE_EXTENSIONS, extension)
            if path is not None:
                connected = True
                yield path

    def _grow(
        self, seed: int, extensions: int, length: float, margin: float = 0.0
    ) -> Array | None:
        """Return the path of one pair of trees, or None."""
        hulls = self.hulls
        task = self.task
        robot = self.robot
        start = task.boundary.start_q[0]
        goals = task.boundary.goal_q if self.goals is None else self.goals
        lower = np.minimum(start, goals.min(axis=0)) - MAX_TURN
        upper = np.maximum(start, goals.max(axis=0)) + MAX_TURN
        box = (
            np.maximum(robot.position_lower, lower),
            np.minimum(robot.position_upper, upper),
        )
        checker = (
            CollisionChecker(self.library, robot, WITHOUT_LINKS)
            if hulls is None
            else hulls.placed_checker(task.scene.poses[0])
        )
        return find_tree_path(
            checker,
            (start, goals),
            box,
            robot.velocity_limit,
            self._settings(extensions, length, margin),
            seed=seed,
            manifold=self.manifold,
            at_rest=None if self.hulls_only else self.at_rest,
        )

    def _settings(self, extensions: int, length: float, margin: float) -> TreeSettings:
        """Return the settings of one pair of trees."""
        hulls = self.hulls
        settings = TreeSettings(
            None if hulls is None else hulls.obstacle_distance,
            None if hulls is None else hulls.self_distance,
            margin=margin,
            extension=length,
            max_extensions=extensions,
            shortcuts=TREE_SHORTCUTS,
        )
        if self.manifold is None:
            return settings
        nodes = (
            MANIFOLD_LARGE_TREE_NODES
            if extensions == LARGE_TREE_EXTENSIONS
            else MANIFOLD_NODES
        )
        return replace(settings, spacing=MANIFOLD_SPACING_RAD, max_nodes=nodes)
