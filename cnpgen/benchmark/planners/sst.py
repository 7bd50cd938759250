"""Stable sparse trees (Li, Littlefield, Bekris, 2016) over the arm's states, with random accelerations.

Our own: the wheels of OMPL have no constructor of its SST for Python. A state is (q, dq), a control an acceleration
that is held for 1 to 20 steps of 5 ms and must be within the torque limits, the distance the tip's in the workspace,
and the cost time; the goal is a place of the tip alone, as the paper's authors simplified it. Where no state comes near
enough to the goal, what comes nearest counts. Random torques were tried: they break a velocity limit within 5 ms.
"""

from dataclasses import dataclass
from time import perf_counter

import numpy as np
from numpy.typing import NDArray

from cnpgen.benchmark.planner import Answer, BenchmarkPlanner, Plan, Setting
from cnpgen.benchmark.planners.cbirrt import Search
from cnpgen.benchmark.trajectory import Trajectory
from cnpgen.plans.plans import Plans
from cnpgen.problems.problem import Problem
from cnpgen.problems.record import open_problem
from cnpgen.robots.robot import Robot

Array = NDArray[np.float64]

STEP, MOST_STEPS = 5e-3, 20  # s, and how many of them a control is held at most
ITERATIONS = 300_000
BIAS = 0.05  # of the samples, which are the goal
OFF = 0.05  # of 1 - R_22: how far an object may tilt; the tip may be 1 cm off its height


@dataclass(frozen=True)
class Radii:
    """Distances of the tip [m].

    Attributes:
        select: Among nodes so near a sample, the one of least cost is extended.
        witness: Of nodes so near a witness, the one of least cost is kept.
        goal: So near the goal a motion has arrived.
        off: How far off the manifold a state may be [m, or 1].
    """

    select: float
    witness: float
    goal: float
    off: float


HIT = Radii(0.05, 0.02, 0.02, 0.01)
TRANSPORT = Radii(0.2, 0.02, 0.2, OFF)  # the paper has 0.1 for witnesses, which no state from rest gets away from


@dataclass(frozen=True)
class SST(BenchmarkPlanner):
    """Stable sparse trees over the arm's states with random accelerations, to a place of the tip."""

    def prepare(self, setting: Setting) -> Plan:
        """Choose the radii."""
        problem, robot = open_problem(setting.problem)
        random = np.random.default_rng(setting.seed)

        def plan(task: Plans) -> Answer:
            return Tree(problem, robot, task, random).grow(setting.time_limit)

        return plan


class Tree:
    """A tree of states that grows from the start of one boundary problem.

    Args:
        problem: The problem.
        robot: Its robot.
        task: The boundary problem.
        random: Where random numbers come from.
    """

    def __init__(self, problem: Problem, robot: Robot, task: Plans, random: np.random.Generator) -> None:
        self._robot, self._random = robot, random
        self._radii = TRANSPORT if problem.object_size is not None else HIT
        self._asked = Search(problem, robot, task)
        self._data = robot.model.createData()
        self._goal = task.columns["goal_xyz"][0]
        self._paths: list[Array] = [np.concatenate([task.boundary.start_q, task.boundary.start_dq], axis=1)]
        self._parents, self._cost = [-1], [0.0]
        self._tips = np.empty((1024, 3))
        self._active = np.zeros(1024, bool)
        self._count = 0
        self._witnesses: list[tuple[Array, int]] = []
        self._keep(0, self._asked.tip(task.boundary.start_q[0]))

    def grow(self, time_limit: float) -> Trajectory | None:
        """Grow until a state is near enough to the goal; return the way to the nearest one, None if it is the start."""
        until = perf_counter() + time_limit
        best, nearest = 0, float(np.linalg.norm(self._tips[0] - self._goal))
        for _ in range(ITERATIONS):
            if nearest <= self._radii.goal or perf_counter() > until:
                break
            parent = self._selected(self._sample())
            path = self._propagated(self._paths[parent][-1])
            if path is None:
                continue
            node = self._add(parent, path)
            away = float(np.linalg.norm(self._tips[node] - self._goal)) if node else np.inf
            if away < nearest:
                best, nearest = node, away
        return self._way_to(best) if best else None

    def _sample(self) -> Array:
        """Draw a place: where a random configuration has the tip, or now and then the goal."""
        if self._random.random() < BIAS:
            return np.asarray(self._goal)
        return self._asked.tip(self._random.uniform(self._robot.position_lower, self._robot.position_upper))

    def _selected(self, place: Array) -> int:
        """Choose the node of least cost among those near a place, or the nearest one."""
        away = np.linalg.norm(self._tips[: self._count] - place, axis=1)
        away[~self._active[: self._count]] = np.inf
        near = np.flatnonzero(away < self._radii.select)
        return int(near[np.argmin(np.array(self._cost)[near])]) if len(near) else int(np.argmin(away))

    def _propagated(self, state: Array) -> Array | None:
        """Hold a random acceleration for a random time; None if a state on the way is not valid."""
        n, limit = self._robot.n, self._robot.acceleration_limit
        ddq = self._random.uniform(-limit, limit) * self._random.random()  # small ones, too: 12 kg need much torque
        states = [state]
        for _ in range(int(self._random.integers(1, MOST_STEPS + 1))):
            q, dq = states[-1][:n], states[-1][n:]
            q, dq = q + STEP * (dq + STEP / 2 * ddq), dq + STEP * ddq
            if not self._is_valid(q, dq, ddq):
                return None
            states.append(np.concatenate([q, dq]))
        return np.array(states[1:])

    def _is_valid(self, q: Array, dq: Array, ddq: Array) -> bool:
        import pinocchio as pin

        robot = self._robot
        if np.any(np.abs(dq) > robot.velocity_limit):
            return False
        if np.any((q < robot.position_lower) | (q > robot.position_upper)):
            return False
        if np.any(np.abs(pin.rnea(robot.model, self._data, q, dq, ddq)) > robot.torque_limit):
            return False
        return abs(self._asked.residual(q)[0]) <= self._radii.off and self._asked.is_valid(q)

    def _add(self, parent: int, path: Array) -> int:
        """Add a node unless a witness has a cheaper one; return its number, 0 if it was not added."""
        tip, cost = self._asked.tip(path[-1, : self._robot.n]), self._cost[parent] + STEP * len(path)
        near = [k for k, (place, _) in enumerate(self._witnesses) if np.linalg.norm(place - tip) < self._radii.witness]
        if near:
            place, holder = self._witnesses[near[0]]
            if self._cost[holder] <= cost:
                return 0
            self._active[holder] = False
            self._witnesses[near[0]] = place, len(self._paths)
        else:
            self._witnesses.append((tip, len(self._paths)))
        self._paths.append(path)
        self._parents.append(parent)
        self._cost.append(cost)
        self._keep(len(self._paths) - 1, tip)
        return len(self._paths) - 1

    def _keep(self, node: int, tip: Array) -> None:
        if node == len(self._tips):
            self._tips = np.concatenate([self._tips, np.empty_like(self._tips)])
            self._active = np.concatenate([self._active, np.zeros_like(self._active)])
        self._tips[node], self._active[node], self._count = tip, True, node + 1

    def _way_to(self, node: int) -> Trajectory:
        """Return the way from the start to a node."""
        parts = []
        while node >= 0:
            parts.append(self._paths[node])
            node = self._parents[node]
        states, n = np.concatenate(parts[::-1]), self._robot.n
        return Trajectory(STEP * np.arange(float(len(states))), states[:, :n], states[:, n:])
