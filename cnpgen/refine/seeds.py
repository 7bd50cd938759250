"""Ways between two configurations, where other starts fail: two trees of configurations that grow towards each other.

RRT-Connect (Kuffner and LaValle 2000) in the space of the joints, with steps that are checked together: kernels say of
all states of a step at once whether they are free as far as capsules tell, Coal's hulls decide where only a capsule is
in the way. Where there are equalities, states of straight lines are put on them first, by Gauss-Newton steps within the
joint limits (Berenson et al. 2009). Random numbers are the same for every task. Velocities and accelerations are left
to the refiner.
"""

from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from functools import cached_property
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from cnpgen.refine.fine import AtRest
from cnpgen.refine.solver.hulls import Hulls
from cnpgen.refine.solver.transcription import ResidualKernels
from cnpgen.trajectory.boundary import Boundary, assemble
from cnpgen.trajectory.spec import TrajectorySpec
from cnpgen.trajectory.spline import basis

if TYPE_CHECKING:
    from cnpgen.robots.robot import Robot

Array = NDArray[np.float64]
Follow = Callable[[Array], Array]  # of states (n, K) in the order of a way -> the first ones that are free, (n, k)

APART = 0.04  # rad, or m: between states that are looked at
LEAP = 0.12  # rad, or m: states further apart are not on one way, though both are on the equalities
TURN = 2 * np.pi  # rad, or m
STEP = 1.0  # of a tree towards a random configuration
BLOCK = 24  # states that are looked at together
GROWTHS = 1000  # of the trees, until they are given up
SHORTCUTS = 150  # tried on a way
WAYS = 5  # that are tried
PROJECTIONS = 5  # Gauss-Newton steps onto the equalities
LONGEST = 0.5  # rad, or m: none moves a joint further
DAMPING = 1e-6  # of these steps, relative, and in scaled units
CLOSE = 0.05  # of its tolerance: from there on an equality is met
SLOWNESS = 2.0  # times what the velocity limits ask for is how long a seed takes
SAMPLES = 20  # per control point, of a way that is fitted


@dataclass(frozen=True)
class Space:
    """The states of a robot at rest that may be on the way of one task.

    Attributes:
        stage: The kernels.
        robot: The robot.
        at_rest: What the residuals of a state must be.
        tops: The numbers of the obstacles, shape (numbers,).
        hulls: What measures where capsules are in the way; None where the links are capsules.
    """

    stage: ResidualKernels
    robot: "Robot"
    at_rest: AtRest
    tops: Array
    hulls: Hulls | None = None

    def follow(self, q: Array) -> Array:
        """Put K states, shape (n, K), on the equalities; return the first ones of them that are free."""
        q = self.projected(q) if self.at_rest.equal.any() else q
        return q[:, : self._free(q)]

    def _free(self, q: Array) -> int:
        """Say how many of the first ones of K states are free."""
        (g,) = self.stage.values(*self._arguments(q))
        met = (g >= self.at_rest.lower[:, None]) & (g <= self.at_rest.upper[:, None])
        if self.hulls is None:
            return _first(~np.logical_and.reduce(met))
        first = _first(~np.logical_and.reduce(met[~self.at_rest.capsules]))
        if first:
            first = _first(~self.hulls.clear(q[:, :first], self.tops, of_all=False))
        doubtful = np.flatnonzero(~np.logical_and.reduce(met[self.at_rest.capsules])[:first])
        if not len(doubtful):
            return first
        hit = _first(~self.hulls.clear(q[:, doubtful], self.tops))
        return first if hit == len(doubtful) else int(doubtful[hit])

    def projected(self, q: Array) -> Array:
        """Move K states onto the equalities; joints that come to a limit stay there."""
        low, high = self._limits
        q, rows = np.clip(q, low, high), self.at_rest.equal
        lower, upper = self.at_rest.lower[rows, None], self.at_rest.upper[rows, None]
        for _ in range(PROJECTIONS):
            g, columns = self.stage.jacobian(*self._arguments(q))
            off = g[rows] - (lower + upper) / 2
            if (np.abs(off) <= CLOSE * (upper - lower) / 2).all():
                break
            J = columns.reshape(-1, len(rows), q.shape[1])[: len(q), rows] * ((q > low) & (q < high))[:, None]
            square = np.einsum("iak,ibk->kab", J, J)
            damping = DAMPING * (1 + np.trace(square, axis1=1, axis2=2))[:, None, None] * np.eye(len(off))
            force = np.linalg.solve(square + damping, off.T[..., None])[..., 0]
            q = np.clip(q - np.clip(np.einsum("iak,ka->ik", J, force), -LONGEST, LONGEST), low, high)
        return q

    @cached_property
    def _limits(self) -> tuple[Array, Array]:
        return self.robot.position_lower[:, None], self.robot.position_upper[:, None]

    def _arguments(self, q: Array) -> tuple[Array, Array]:
        """Lay out K states at rest as the kernels take them."""
        (n, count), width = q.shape, self.stage.values.tape.inputs[0]
        w, orders = np.zeros((width, count)), (width + 1) // (n + 1)
        w[:n], w[orders * n] = q, 1.0  # positions and the rate
        return w, np.repeat(self.tops[:, None], count, axis=1)


def _first(yes: NDArray[np.bool_]) -> int:
    """Index of the first one that is true, or their number."""
    return int(np.argmax(yes)) if yes.any() else len(yes)


@dataclass
class _Tree:
    """Configurations that are connected with an end.

    Attributes:
        nodes: The configurations, shape (n,) each.
        parents: Index of the node that each was reached from.
        states: The states on the way from there, shape (k, n) each.
    """

    nodes: list[Array]
    parents: list[int] = field(default_factory=lambda: [-1])
    states: list[Array] = field(init=False)

    def __post_init__(self) -> None:
        self.states = [self.nodes[0][None]]

    def grow(self, target: Array, follow: Follow, step: float) -> bool:
        """Go from the nearest node towards a configuration, as far as it is free; say whether it is reached."""
        nearest = int(np.argmin(np.square(np.array(self.nodes) - target).sum(axis=1)))
        begin = self.nodes[nearest]
        span = float(np.linalg.norm(target - begin))
        end = target if span <= step else begin + (target - begin) * (step / span)
        states, reached = go(begin, end, follow)
        if len(states):
            self.nodes.append(states[-1])
            self.parents.append(nearest)
            self.states.append(states)
        return reached and span <= step

    def way(self) -> Array:
        """Return the states from the root to the last node, shape (K, n)."""
        found, index = list[Array](), len(self.nodes) - 1
        while index >= 0:
            found.append(self.states[index])
            index = self.parents[index]
        return np.concatenate(found[::-1])


def go(begin: Array, end: Array, follow: Follow) -> tuple[Array, bool]:
    """Return the states along a straight line up to the first one that is not free, and whether that is all of them.

    Args:
        begin: Where the line begins, shape (n,); not among the states.
        end: Where it ends.
        follow: Looks at states.

    Returns:
        States, shape (k, n), and whether the last one is the end.
    """
    count = max(int(np.ceil(np.abs(end - begin).max() / APART)), 1)
    share, states = np.arange(1, count + 1) / count, begin[:, None]
    for first in range(0, count, BLOCK):
        block = share[first : first + BLOCK]
        found = follow(begin[:, None] + (end - begin)[:, None] * block)
        leaps = np.abs(np.diff(np.hstack([states[:, -1:], found]))).max(axis=0, initial=0.0) > LEAP
        states = np.hstack([states, found[:, : _first(leaps)]])
        if states.shape[1] < 1 + first + len(block):
            break
    return states[:, 1:].T, states.shape[1] == 1 + count


def find_ways(start: Array, goal: Array, robot: "Robot", follow: Follow) -> Iterator[Array]:
    """Yield ways between two configurations along which all is free: the line, if it is one, or several of the trees.

    Args:
        start: The first configuration, shape (n,).
        goal: The last one.
        robot: The robot: random configurations are within its limits, no more than a turn away from both ends.
        follow: Looks at states.

    Yields:
        The states of a way, shape (K, n); none any more after trees that did not meet.
    """
    states, reached = go(start, goal, follow)
    if reached:
        yield np.vstack([start, states])
        return
    for seed in range(WAYS):
        way = find_way(start, goal, robot, follow, seed=seed)
        if way is None:
            return
        yield way


def find_way(start: Array, goal: Array, robot: "Robot", follow: Follow, *, seed: int) -> Array | None:
    """Search for one way with trees; arguments as of ``find_ways``, and the seed of the random numbers.

    Returns:
        Its states, shape (K, n), or None where none was found.
    """
    random, trees = np.random.default_rng(seed), (_Tree([start]), _Tree([goal]))
    lower = np.maximum(robot.position_lower, np.minimum(start, goal) - TURN)
    upper = np.minimum(robot.position_upper, np.maximum(start, goal) + TURN)
    for growth in range(GROWTHS):
        one, other = trees[growth % 2], trees[1 - growth % 2]
        before = len(one.nodes)
        one.grow(random.uniform(lower, upper), follow, STEP)
        if len(one.nodes) > before and other.grow(one.nodes[-1], follow, np.inf):
            return _shortened(np.vstack([trees[0].way(), trees[1].way()[::-1]]), follow, random)
    return None


def _shortened(way: Array, follow: Follow, random: np.random.Generator) -> Array:
    """Replace parts of a way by straight lines, where these are free and shorter."""
    for _ in range(SHORTCUTS):
        first, last = np.sort(random.integers(len(way), size=2))
        states, reached = go(way[first], way[last], follow)
        if reached and len(states) < last - first:
            way = np.vstack([way[: first + 1], states, way[last + 1 :]])
    return way


def _lengths(way: Array) -> Array:
    """How long the way to each of its states is, shape (K,)."""
    return np.append(0.0, np.cumsum(np.linalg.norm(np.diff(way, axis=0), axis=1)))


def along_way(way: Array, boundary: Boundary, velocity_limit: Array, spec: TrajectorySpec) -> tuple[Array, Array]:
    """Fit a motion to a way, in least squares; it meets the boundary conditions.

    Args:
        way: States of the way, shape (K, n).
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
