"""Ways round obstacles, where other starts fail: two trees of configurations that grow towards each other.

RRT-Connect (Kuffner and LaValle 2000) in the space of the joints, with steps that are checked together: kernels say of
all states of a step at once whether they are free as far as capsules tell, Coal's hulls decide where only a capsule is
in the way. Random numbers are the same for every task. Velocities and accelerations are left to the refiner; problems
with equalities, which hardly any configuration meets, have no seeds.
"""

from collections.abc import Callable
from dataclasses import dataclass, field
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from cnpgen.refine.solver.hulls import Hulls
from cnpgen.refine.solver.transcription import ResidualKernels
from cnpgen.trajectory.boundary import Boundary, assemble
from cnpgen.trajectory.spec import TrajectorySpec
from cnpgen.trajectory.spline import basis

if TYPE_CHECKING:
    from cnpgen.robots.robot import Robot

Array = NDArray[np.float64]
Free = Callable[[Array], int]  # of states (n, K) in the order of a way -> how many of the first ones are free

APART = 0.04  # rad, or m: between states that are looked at
TURN = 2 * np.pi  # rad, or m
STEP = 1.0  # of a tree towards a random configuration
BLOCK = 24  # states that are looked at together
GROWTHS = 1000  # of the trees, until they are given up
SHORTCUTS = 150  # tried on a way
SLOWNESS = 2.0  # times what the velocity limits ask for is how long a seed takes
SAMPLES = 20  # per control point, of a way that is fitted


@dataclass(frozen=True)
class Space:
    """The states of a robot at rest among the obstacles of one task.

    Attributes:
        stage: The kernels.
        hulls: What measures where capsules are in the way.
        capsules: Which residuals are clearances of capsules, shape (m,).
        lower: Bounds of the residuals, shape (m,).
        upper: Likewise.
        tops: The numbers of the obstacles, shape (numbers,).
    """

    stage: ResidualKernels
    hulls: Hulls
    capsules: NDArray[np.bool_]
    lower: Array
    upper: Array
    tops: Array

    def free(self, q: Array) -> int:
        """Say how many of the first ones of K states, shape (n, K), are free."""
        (n, count), width = q.shape, self.stage.values.tape.inputs[0]
        w, orders = np.zeros((width, count)), (width + 1) // (n + 1)
        w[:n], w[orders * n] = q, 1.0  # positions and the rate
        (g,) = self.stage.values(w, np.repeat(self.tops[:, None], count, axis=1))
        met = (g >= self.lower[:, None]) & (g <= self.upper[:, None])
        first = _first(~np.logical_and.reduce(met[~self.capsules]))
        if first:
            first = _first(~self.hulls.clear(q[:, :first], self.tops, of_all=False))
        doubtful = np.flatnonzero(~np.logical_and.reduce(met[self.capsules])[:first])
        if not len(doubtful):
            return first
        hit = _first(~self.hulls.clear(q[:, doubtful], self.tops))
        return first if hit == len(doubtful) else int(doubtful[hit])


def _first(yes: NDArray[np.bool_]) -> int:
    """Index of the first one that is true, or their number."""
    return int(np.argmax(yes)) if yes.any() else len(yes)


@dataclass
class _Tree:
    """Configurations that are connected with an end.

    Attributes:
        nodes: The configurations, shape (n,) each.
        parents: Index of the node that each was reached from.
    """

    nodes: list[Array]
    parents: list[int] = field(default_factory=lambda: [-1])

    def grow(self, target: Array, free: Free, step: float) -> bool:
        """Go from the nearest node towards a configuration, as far as it is free; say whether it is reached."""
        nearest = int(np.argmin(np.square(np.array(self.nodes) - target).sum(axis=1)))
        begin = self.nodes[nearest]
        span = float(np.linalg.norm(target - begin))
        end = target if span <= step else begin + (target - begin) * (step / span)
        reached = go(begin, end, free)
        if reached > 0:
            self.nodes.append(begin + (end - begin) * reached)
            self.parents.append(nearest)
        return reached == 1 and span <= step

    def way(self) -> list[Array]:
        """Return the configurations from the root to the last node."""
        found, index = list[Array](), len(self.nodes) - 1
        while index >= 0:
            found.append(self.nodes[index])
            index = self.parents[index]
        return found[::-1]


def go(begin: Array, end: Array, free: Free) -> float:
    """Return which share of a straight line is free from its beginning."""
    count = max(int(np.ceil(np.abs(end - begin).max() / APART)), 1)
    share = np.arange(1, count + 1) / count
    for first in range(0, count, BLOCK):
        block = share[first : first + BLOCK]
        found = free(begin[:, None] + (end - begin)[:, None] * block)
        if found < len(block):
            return float((first + found) / count)
    return 1.0


def find_way(start: Array, goal: Array, robot: "Robot", free: Free, *, seed: int) -> Array | None:
    """Search for a way between two configurations along which all is free.

    Args:
        start: The first configuration, shape (n,).
        goal: The last one.
        robot: The robot: random configurations are within its limits, no more than a turn away from both ends.
        free: Looks at states.
        seed: Of the random numbers.

    Returns:
        Its corners, shape (corners, n), or None where none was found.
    """
    if go(start, goal, free) == 1:
        return np.array([start, goal])
    random, trees = np.random.default_rng(seed), (_Tree([start]), _Tree([goal]))
    lower = np.maximum(robot.position_lower, np.minimum(start, goal) - TURN)
    upper = np.minimum(robot.position_upper, np.maximum(start, goal) + TURN)
    for growth in range(GROWTHS):
        one, other = trees[growth % 2], trees[1 - growth % 2]
        before = len(one.nodes)
        one.grow(random.uniform(lower, upper), free, STEP)
        if len(one.nodes) > before and other.grow(one.nodes[-1], free, np.inf):
            ways = trees[0].way(), trees[1].way()[::-1]
            return _shortened(np.array([*ways[0], *ways[1][1:]]), free, random)
    return None


def _shortened(way: Array, free: Free, random: np.random.Generator) -> Array:
    """Replace parts of a way by straight lines, where these are free."""
    for _ in range(SHORTCUTS):
        along = _lengths(way)
        low, high = np.sort(random.uniform(0, along[-1], 2))
        first, last = (int(np.searchsorted(along, each, side="right")) for each in (low, high))
        if first == last:
            continue
        ends = np.array([[np.interp(each, along, q) for q in way.T] for each in (low, high)])
        if go(ends[0], ends[1], free) == 1:
            way = np.concatenate([way[:first], ends, way[last:]])
    return way


def _lengths(way: Array) -> Array:
    """How long the way to each of its corners is, shape (corners,)."""
    return np.append(0.0, np.cumsum(np.linalg.norm(np.diff(way, axis=0), axis=1)))


def along_way(way: Array, boundary: Boundary, velocity_limit: Array, spec: TrajectorySpec) -> tuple[Array, Array]:
    """Fit a motion to a way, in least squares; it meets the boundary conditions.

    Args:
        way: Corners of the way, shape (corners, n).
        boundary: Boundary conditions of one motion.
        velocity_limit: Of every joint [rad/s], shape (n,).
        spec: Degree and numbers of control points.

    Returns:
        As of ``cnpgen.refine.solver.starts.straight``.
    """
    shortest = float((np.abs(np.diff(way, axis=0)) / velocity_limit).max(axis=1).sum())
    rate = np.full(spec.rate_control_points, 1.0 / (SLOWNESS * shortest + 0.1))
    s = np.linspace(0, 1, SAMPLES * spec.path_control_points)
    along, eased = _lengths(way), s**3 * (10 - 15 * s + 6 * s**2)  # it begins and ends without velocity
    q = np.stack([np.interp(eased * along[-1], along, each) for each in way.T], axis=1)
    count, n = spec.path_control_points - 3 - boundary.fixed_at_goal, way.shape[1]
    fixed = assemble(boundary, np.zeros((1, count, n)), rate[None], spec)[0]
    table = basis(s, spec.path_control_points, spec.degree)
    inner = slice(3, 3 + count)
    return np.linalg.lstsq(table[:, inner], q - table @ fixed, rcond=None)[0], rate
