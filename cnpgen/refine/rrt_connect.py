"""Joint-space paths between two configurations by RRT-Connect (Kuffner and LaValle 2000).

Kernels check many states of an edge at once against capsules; Coal's hulls decide where
only a capsule collides. Where there are equalities, the states of an edge are first
projected onto the manifold by Gauss-Newton steps within the joint limits (CBiRRT,
Berenson et al. 2009). Where compiled code measures hulls, its trees search instead
(``TreeSearch``). Random numbers are the same for every task. The refiner adds
velocities and accelerations. The tree of ``benchmark/planners/sst.py`` has states,
costs and pruning (SST) and is separate.
"""

from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from itertools import count, islice, pairwise

import numpy as np

from cnpgen.arrays import Array, Mask
from cnpgen.kernels.collision.tree_search import (
    EqualityKernel,
    TreeSettings,
    estimated_duration,
    find_tree_path,
)
from cnpgen.refine.solver.hulls import Hulls
from cnpgen.refine.solver.transcription import ResidualKernels
from cnpgen.refine.task import RefinementTask
from cnpgen.robots.robot import Robot

# States (n, K) of an edge -> the leading valid ones, projected, (n, k).
Follow = Callable[[Array], Array]

STATE_SPACING = 0.04  # rad or m, between checked states
MAX_STATE_SPACING = 0.12  # rad or m, between projected states of one edge
# Rad or m, of random configurations from the range between both ends.
MAX_TURN = 2 * np.pi
MAX_EXTENSION = 1.0  # rad or m, of a tree towards a random configuration
STATES_PER_CHECK = 24
MAX_EXTENSIONS = 1000  # of the trees
SHORTCUTS = 150  # attempted on a path
MAX_PATHS = 5
MAX_PROJECTIONS = 5  # Gauss-Newton steps onto the equalities
MAX_PROJECTION_STEP = 0.5  # rad or m, of any joint
RELATIVE_DAMPING = 1e-6  # of these steps, in scaled units
PROJECTED_FRACTION = 0.05  # of its tolerance, at which an equality is met

# Of small trees in turn, added to the required distances.
TREE_MARGINS_M = 6e-3, 3e-3, 1e-3, 0.0
SMALL_TREES, SMALL_TREE_EXTENSIONS = 12, 4_000  # four, if these find too few paths
MIN_TREE_PATHS = 3
MAX_TREE_PATHS = 8
LARGE_TREE_EXTENSIONS = 128_000  # without margin, in narrow passages
# With edges of either length; three if no tree connects.
LARGE_TREES = 12
MAX_UNCONNECTED_TREES = 3
# Length of an edge [rad or m]; shorter ones after the others.
TREE_EXTENSION_RAD = 1.0
SHORT_TREE_EXTENSION_RAD = 0.5
TREE_SHORTCUTS = 400  # attempted on a path
# Of projected states, which are all nodes, so that trees have more of them.
MANIFOLD_SPACING_RAD = 0.04
MANIFOLD_NODES = 6_000
MANIFOLD_LARGE_TREE_NODES = 24_000


@dataclass(frozen=True)
class RestSpace:
    """Valid states of a robot at rest for one task."""

    kernels: ResidualKernels
    robot: Robot
    lower: Array  # bounds of the residuals of a state, shape (m,)
    upper: Array
    capsules: Mask  # mask of the clearances of capsules, shape (m,)
    equal: Mask  # mask of the equalities of positions, shape (m,)
    kernel_poses: Array  # scene values that the kernels take, shape (width,)
    scene_poses: Array  # poses and sizes of the obstacles of the hulls, shape (width,)
    # Hulls that decide where capsules collide, or without capsules everywhere; None
    # where links are capsules.
    hulls: Hulls | None

    def follow(self, q: Array) -> Array:
        """Project K states, shape (n, K), onto the equalities.

        Return the leading valid ones.
        """
        q = self.projected(q) if self.equal.any() else q
        return q[:, : self._count_valid(q)]

    def meets_other_conditions(self, path: Array) -> bool:
        """Return whether the states of a polyline, corners of shape (K, n), meet all conditions except distances."""
        counts = [
            max(int(np.ceil(np.abs(b - a).max() / STATE_SPACING)), 1)
            for a, b in pairwise(path)
        ]
        where = np.concatenate(
            [k + np.arange(count) / count for k, count in enumerate(counts)]
        )
        q = np.stack(
            [np.interp(where, np.arange(len(path)), joint) for joint in path.T]
        )
        return bool(self._met(q)[~self.capsules].all())

    def _met(self, q: Array) -> Mask:
        """Return a mask of the bounds that the states meet, shape (m, K)."""
        (g,) = self.kernels.values(*self._arguments(q))
        return np.asarray((g >= self.lower[:, None]) & (g <= self.upper[:, None]))

    def _count_valid(self, q: Array) -> int:
        """Return the number of leading valid states."""
        met = self._met(q)
        poses = self.scene_poses
        if self.hulls is None:
            return _first(~np.logical_and.reduce(met))
        # Cheap conditions first: each one only checks the states before the first
        # invalid one.
        first = _first(~np.logical_and.reduce(met[~self.capsules]))
        if first:
            first = _first(
                ~self.hulls.clear_states(q[:, :first], poses, links_only=True)
            )
        # Capsules contain their links: where they are clear, the hulls need no check.
        resolved = np.logical_and.reduce(met[self.capsules]) & self.capsules.any()
        unresolved = np.flatnonzero(~resolved[:first])
        if not len(unresolved):
            return first
        collision = _first(~self.hulls.clear_states(q[:, unresolved], poses))
        return first if collision == len(unresolved) else int(unresolved[collision])

    def projected(self, q: Array) -> Array:
        """Project K states onto the equalities.

        Joints that reach a limit stay there.
        """
        low = self.robot.position_lower[:, None]
        high = self.robot.position_upper[:, None]
        q = np.clip(q, low, high)
        rows = self.equal
        lower = self.lower[rows, None]
        upper = self.upper[rows, None]
        for _ in range(MAX_PROJECTIONS):
            g, columns = self.kernels.jacobian(*self._arguments(q))
            # Bounds of equalities are relaxed by their tolerances; the middle is the
            # equality itself.
            error = g[rows] - (lower + upper) / 2
            if (np.abs(error) <= PROJECTED_FRACTION * (upper - lower) / 2).all():
                break
            J = (
                columns.reshape(-1, len(rows), q.shape[1])[: len(q), rows]
                * ((q > low) & (q < high))[:, None]
            )
            # Damped Gauss-Newton: dq = -J^T (J J^T + damping)^-1 error, for all states
            # at once.
            square = np.einsum("iak,ibk->kab", J, J)
            damping = (
                RELATIVE_DAMPING
                * (1 + np.trace(square, axis1=1, axis2=2))[:, None, None]
                * np.eye(len(error))
            )
            force = np.linalg.solve(square + damping, error.T[..., None])[..., 0]
            step = np.clip(
                np.einsum("iak,ka->ik", J, force),
                -MAX_PROJECTION_STEP,
                MAX_PROJECTION_STEP,
            )
            q = np.clip(q - step, low, high)
        return q

    def _arguments(self, q: Array) -> tuple[Array, Array]:
        """Return the kernel arguments of K states at rest."""
        (n, count), width = q.shape, self.kernels.values.tape.inputs[0]
        w = np.zeros((width, count))
        orders = (width + 1) // (n + 1)
        # Positions and the rate.
        w[:n] = q
        w[orders * n] = 1.0
        return w, np.repeat(self.kernel_poses[:, None], count, axis=1)


def _first(mask: Mask) -> int:
    """Return the index of the first true element, or the length if none is true."""
    return int(np.argmax(mask)) if mask.any() else len(mask)


class _Tree:
    """Tree of configurations that are connected with one end: nodes (n,), their parents, and states (k, n) of edges."""

    def __init__(self, root: Array) -> None:
        self.nodes = [root]
        self.parents = [-1]
        self.states = [root[None]]

    def grow(self, target: Array, follow: Follow, max_extension: float) -> bool:
        """Extend the nearest node towards a configuration while states are valid.

        Return whether it is reached.
        """
        nearest = int(np.argmin(np.square(np.array(self.nodes) - target).sum(axis=1)))
        begin = self.nodes[nearest]
        distance = float(np.linalg.norm(target - begin))
        # Long extensions are cut to the largest length.
        end = (
            target
            if distance <= max_extension
            else begin + (target - begin) * (max_extension / distance)
        )
        states, reached = follow_line(begin, end, follow)
        if len(states):
            self.nodes.append(states[-1])
            self.parents.append(nearest)
            self.states.append(states)
        return reached and distance <= max_extension

    def path(self) -> Array:
        """Return the states from the root to the last node, shape (K, n)."""
        edges = list[Array]()
        index = len(self.nodes) - 1
        while index >= 0:
            edges.append(self.states[index])
            index = self.parents[index]
        return np.concatenate(edges[::-1])


def follow_line(begin: Array, end: Array, follow: Follow) -> tuple[Array, bool]:
    """Return the valid states of a straight line, shape (k, n), and whether they reach its end.

    Both ends have shape (n,); ``begin`` is not among the states. See
    ``RestSpace.follow`` for the leading valid states.
    """
    count = max(int(np.ceil(np.abs(end - begin).max() / STATE_SPACING)), 1)
    fractions = np.arange(1, count + 1) / count
    states = begin[:, None]
    for first in range(0, count, STATES_PER_CHECK):
        block = fractions[first : first + STATES_PER_CHECK]
        valid = follow(begin[:, None] + (end - begin)[:, None] * block)
        # Projection may tear neighbors apart: a gap ends the edge.
        spacing = np.abs(np.diff(np.hstack([states[:, -1:], valid]))).max(
            axis=0, initial=0.0
        )
        states = np.hstack([states, valid[:, : _first(spacing > MAX_STATE_SPACING)]])
        if states.shape[1] < 1 + first + len(block):
            break
    return states[:, 1:].T, states.shape[1] == 1 + count


def find_paths(
    start: Array, goal: Array, robot: Robot, follow: Follow
) -> Iterator[Array]:
    """Yield valid paths between two configurations, shape (K, n): the line, if it is valid, or several of the trees.

    Random configurations are within the robot's limits and at most a turn away from
    both ends. The search ends with the first trees that do not connect.
    """
    states, reached = follow_line(start, goal, follow)
    if reached:
        yield np.vstack([start, states])
        return
    for seed in range(MAX_PATHS):
        path = find_path(start, goal, robot, follow, seed=seed)
        if path is None:
            return
        yield path


def find_path(
    start: Array, goal: Array, robot: Robot, follow: Follow, *, seed: int
) -> Array | None:
    """Search for one path by RRT-Connect; return its states, shape (K, n), or None if the trees do not connect.

    The arguments are those of ``find_paths``, and the seed of the random numbers.
    """
    random = np.random.default_rng(seed)
    trees = (_Tree(start), _Tree(goal))
    # Joints with wide ranges are sampled near both ends only.
    lower = np.maximum(robot.position_lower, np.minimum(start, goal) - MAX_TURN)
    upper = np.minimum(robot.position_upper, np.maximum(start, goal) + MAX_TURN)
    for extension in range(MAX_EXTENSIONS):
        tree = trees[extension % 2]
        other = trees[1 - extension % 2]
        before = len(tree.nodes)
        tree.grow(random.uniform(lower, upper), follow, MAX_EXTENSION)
        # Connect: the other tree grows as far as the new node.
        if len(tree.nodes) > before and other.grow(tree.nodes[-1], follow, np.inf):
            return _shortened(
                np.vstack([trees[0].path(), trees[1].path()[::-1]]), follow, random
            )
    return None


def _shortened(path: Array, follow: Follow, random: np.random.Generator) -> Array:
    """Replace sections of a path by valid straight lines with fewer states."""
    for _ in range(SHORTCUTS):
        # Random pairs of states: a valid line between them replaces the section if it
        # has fewer states.
        first, last = np.sort(random.integers(len(path), size=2))
        states, reached = follow_line(path[first], path[last], follow)
        if reached and len(states) < last - first:
            path = np.vstack([path[: first + 1], states, path[last + 1 :]])
    return path


@dataclass(frozen=True)
class TreeSearch:
    """Search for paths between the ends of a task by compiled trees, on a manifold if there are equalities.

    Several small trees with different margins grow in milliseconds, and large ones if
    these find few paths. The paths are sorted by an estimated duration. Large trees
    with shorter edges follow one by one, until a motion along one of their paths is
    valid. Conditions other than distances are checked on the paths, not in the trees.
    Of several ``goals``, shape (G, n), which replace that of the task, all are roots of
    one tree.
    """

    task: RefinementTask
    space: RestSpace
    hulls: Hulls
    manifold: EqualityKernel | None
    goals: Array | None = None

    def paths(self) -> Iterator[Array]:
        """Yield paths, corners of shape (K, n) each.

        At most ``MAX_TREE_PATHS`` paths of the first trees are sorted: those that meet
        all conditions at rest come first, and then those of shorter estimated duration.
        Paths of large trees with shorter edges follow.
        """
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
            self._large_trees(seeds, TREE_EXTENSION_RAD, bool(found)), missing
        )
        space = self.space
        limit = self.space.robot.velocity_limit
        # Paths that meet all other conditions come first, then the fastest.
        durations = [
            (not space.meets_other_conditions(path), estimated_duration(path, limit))
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
        settings = TreeSettings(
            self.hulls.obstacle_distance,
            self.hulls.self_distance,
            margin=margin,
            extension=length,
            max_extensions=extensions,
            shortcuts=TREE_SHORTCUTS,
        )
        if self.manifold is not None:
            nodes = (
                MANIFOLD_LARGE_TREE_NODES
                if extensions == LARGE_TREE_EXTENSIONS
                else MANIFOLD_NODES
            )
            settings = replace(settings, spacing=MANIFOLD_SPACING_RAD, max_nodes=nodes)
        task = self.task
        robot = self.space.robot
        start = task.boundary.start_q[0]
        goals = task.boundary.goal_q if self.goals is None else self.goals
        lower = np.minimum(start, goals.min(axis=0)) - MAX_TURN
        upper = np.maximum(start, goals.max(axis=0)) + MAX_TURN
        box = (
            np.maximum(robot.position_lower, lower),
            np.minimum(robot.position_upper, upper),
        )
        checker = self.hulls.placed_checker(task.scene.poses[0])
        return find_tree_path(
            checker,
            (start, goals),
            box,
            robot.velocity_limit,
            settings,
            seed=seed,
            manifold=self.manifold,
        )
