"""Stable sparse trees (SST; Li, Littlefield, Bekris, 2016) over the arm's states, with random accelerations.

This implementation exists because the Python wheels of OMPL cannot construct its SST. A
state is (q, dq). A control is an acceleration, constant for 1 to 20 steps of 5 ms and
within the torque limits. The distance is that of the tip in the workspace, and the cost
is time. The goal is a position of the tip, as in the paper. If no state reaches the
goal, the nearest state is the result. Random torques would exceed a velocity limit
within 5 ms.

The compiled trees of ``refine/rrt_connect.py`` have configurations and parents only, so
the two share no code.
"""

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from time import perf_counter

import numpy as np

from cnpgen.addons.benchmark.benchmark_planner import (
    Answer,
    BenchmarkPlanner,
    Plan,
    Setting,
    require_rigid_torque,
)
from cnpgen.addons.benchmark.planners.state_check import StateCheck
from cnpgen.addons.trajectories.sampled_trajectory import Trajectory
from cnpgen.arrays import Array
from cnpgen.plans.plans import Plans
from cnpgen.problems.problem import Problem
from cnpgen.problems.problem_record import open_problem
from cnpgen.schema.keys import field

CONTROL_STEP_S = 5e-3
MAX_TREE_ITERATIONS = 300_000


@dataclass(frozen=True)
class Radii:
    """Radii of the tip's position [m].

    The node of least cost is extended within ``select`` around a sampled position, and
    only it is kept within ``witness`` around a witness. ``goal`` is the maximum
    distance from the goal.
    """

    select: float
    witness: float
    goal: float


HIT_SELECT_M, HIT_GOAL_M = 0.05, 0.02  # the paper's radii
TRANSPORT_SELECT_M = 0.2
TRANSPORT_GOAL_M = 0.2


def radii_of(problem: Problem, witness: float) -> Radii:
    """Return the radii for hits or for transports, with the radius of witnesses [m].

    The paper has 0.1 m for the witnesses of transports, which a state from rest cannot
    leave.
    """
    if problem.object_size is None:
        return Radii(HIT_SELECT_M, witness, HIT_GOAL_M)
    return Radii(TRANSPORT_SELECT_M, witness, TRANSPORT_GOAL_M)


class Tree:
    """Tree of states from a start of shape (2 n,); each node has the path from its parent, with a step in seconds.

    A state is (q, dq), distances are those of the tip in the workspace, the cost of a
    node is the time from the start.
    """

    def __init__(self, start: Array, tip: Array, radii: Radii, step: float) -> None:
        self._radii = radii
        self._step = step
        self._paths = [start[None]]
        self._parents = [-1]
        self._tips = _GrowingArray((3,))
        self._cost = _GrowingArray(())
        self._witnesses = _GrowingArray((3,))
        self._holders = _GrowingArray(())
        for rows, row in (
            (self._tips, tip),
            (self._cost, 0.0),
            (self._witnesses, tip),
            (self._holders, 0),
        ):
            rows.append(row)

    def state(self, node: int) -> Array:
        """Return the state at a node, shape (2 n,)."""
        return np.asarray(self._paths[node][-1])

    def tip(self, node: int) -> Array:
        """Return the tip position of a node [m], shape (3,)."""
        return np.asarray(self._tips.rows[node])

    def select(self, position: Array) -> int:
        """Return the active node of least cost near a position, or the nearest one."""
        # Only the cheapest node near each witness is extended.
        active = self._holders.rows.astype(int)
        distances = np.linalg.norm(self._tips.rows[active] - position, axis=1)
        close = active[distances < self._radii.select]
        return (
            int(close[np.argmin(self._cost.rows[close])])
            if len(close)
            else int(active[np.argmin(distances)])
        )

    def add(self, parent: int, path: Array, tip: Array) -> int:
        """Add a node with states from its parent, shape (K, 2 n), unless a cheaper one exists near the same witness.

        Return the active node near the witness: the new one or the cheaper one.
        """
        # The cost is time: a step for each state of the path.
        node = len(self._paths)
        cost = self._cost.rows[parent] + self._step * len(path)
        distances = np.linalg.norm(self._witnesses.rows - tip, axis=1)
        witness = int(np.argmin(distances))
        if distances[witness] >= self._radii.witness:
            # A position far from all witnesses becomes one itself.
            self._witnesses.append(tip)
            self._holders.append(node)
        elif self._cost.rows[holder := int(self._holders.rows[witness])] <= cost:
            return holder
        else:
            # The former node stays in its branch, but is no longer extended.
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
        return Trajectory(
            self._step * np.arange(float(len(states))), states[:, :n], states[:, n:]
        )

    def grow(
        self,
        extend: Callable[[], int],
        goal: Array,
        *,
        time_limit: float,
        max_iterations: int,
    ) -> Trajectory | None:
        """Call ``extend``, which returns the active node, until one is within the goal radius or the time [s] is over.

        Return the trajectory to the node nearest to the goal [m], shape (3,); None if
        it is the root, node 0.
        """
        deadline = perf_counter() + time_limit
        best = 0
        min_distance = float(np.linalg.norm(self.tip(0) - goal))
        for _ in range(max_iterations):
            if min_distance <= self._radii.goal or perf_counter() > deadline:
                break
            node = extend()
            distance = float(np.linalg.norm(self.tip(node) - goal))
            if distance < min_distance:
                best = node
                min_distance = distance
        return self.path_to(best) if best else None


def tree_of(problem: Problem, task: Plans, witness_radius: float, step: float) -> Tree:
    """Return the tree of a boundary problem with its root, the start; see ``radii_of``."""
    boundary = task.boundary
    tip = task.columns["start_xyz"][0]
    start = np.concatenate([boundary.start_q[0], boundary.start_dq[0]])
    return Tree(start, tip, radii_of(problem, witness_radius), step)


class _GrowingArray:
    """Array to which rows are appended."""

    def __init__(self, shape: tuple[int, ...]) -> None:
        self._all = np.empty((1024, *shape))
        self._count = 0

    @property
    def rows(self) -> Array:
        """The rows so far."""
        return self._all[: self._count]

    def append(self, row: Array | float) -> None:
        """Add a row."""
        if self._count == len(self._all):
            # Doubling keeps the cost of all copies linear in the number of rows.
            self._all = np.concatenate([self._all, np.empty_like(self._all)])
        self._all[self._count] = row
        self._count += 1


@dataclass(frozen=True)
class SST(BenchmarkPlanner):
    """Stable sparse trees over the arm's states with random accelerations, to a position of the tip."""

    witness_radius: float = field(
        "distance of the tip within which one node is kept",
        unit="m",
        default=0.02,
        low=0.0,
        plausible=5.0,
    )
    max_steps: int = field(
        "largest number of steps of 5 ms of a control", default=20, low=1
    )
    goal_bias: float = field(
        "share of samples that are the goal", default=0.05, low=0.0, high=1.0
    )

    def prepare(self, setting: Setting) -> Plan:
        """Load the kernel that checks states."""
        problem, robot = open_problem(setting.problem)
        require_rigid_torque("sst", problem, robot)
        check = StateCheck(problem, robot)

        def plan(task: Plans) -> Answer:
            tree = tree_of(problem, task, self.witness_radius, CONTROL_STEP_S)
            goal_xyz = task.columns["goal_xyz"][0]
            extend = partial(
                self.extend,
                tree,
                check,
                task.scene.poses[0],
                goal_xyz,
                setting.random(task),
            )
            return tree.grow(
                extend,
                goal_xyz,
                time_limit=setting.time_limit,
                max_iterations=MAX_TREE_ITERATIONS,
            )

        return plan

    def extend(
        self,
        tree: Tree,
        check: StateCheck,
        obstacle_poses: Array,
        goal: Array,
        random: np.random.Generator,
    ) -> int:
        """Apply a random acceleration for a random time at a node near a random position or the goal [m], shape (3,).

        Return the new node of the tree, or 0 if a state is invalid.
        """
        position = (
            goal
            if random.random() < self.goal_bias
            else check.random_position(obstacle_poses, random)
        )
        parent = tree.select(position)
        q, dq = np.split(tree.state(parent), 2)
        limit = check.robot.acceleration_limit
        # Often small: 12 kg need much torque.
        ddq = random.uniform(-limit, limit) * random.random()
        t = (
            CONTROL_STEP_S
            * np.arange(1.0, random.integers(1, self.max_steps + 1) + 1)[:, None]
        )
        # Constant acceleration: q + dq t + ddq t^2 / 2.
        path_q = q + t * (dq + t / 2 * ddq)
        path_dq = dq + t * ddq
        tips, valid = check(
            path_q, path_dq, np.broadcast_to(ddq, path_q.shape), obstacle_poses
        )
        return (
            tree.add(parent, np.concatenate([path_q, path_dq], axis=1), tips[-1])
            if valid.all()
            else 0
        )
