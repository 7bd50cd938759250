"""Stable sparse trees (Li, Littlefield, Bekris, 2016) over the arm's states, with random accelerations.

Our own: the wheels of OMPL have no constructor of its SST for Python. A state is (q, dq), a control an acceleration
that is held for 1 to 20 steps of 5 ms and must be within the torque limits, the distance the tip's in the workspace,
and the cost time; the goal is a place of the tip alone, as the paper's authors simplified it. Where no state comes near
enough to the goal, what comes nearest counts. Random torques were tried: they break a velocity limit within 5 ms.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from cnpgen.benchmark.benchmark_planner import Answer, BenchmarkPlanner, Plan, Setting
from cnpgen.benchmark.planners.state_check import StateCheck
from cnpgen.benchmark.planners.tree import Tree, radii_of
from cnpgen.plans.plans import Plans
from cnpgen.problems.problem_record import open_problem
from cnpgen.robots.robot import Robot

Array = NDArray[np.float64]

STEP, MOST_STEPS = 5e-3, 20  # s, and how many of them a control is held at most
ITERATIONS = 300_000
BIAS = 0.05  # of the samples, which are the goal


@dataclass(frozen=True)
class SST(BenchmarkPlanner):
    """Stable sparse trees over the arm's states with random accelerations, to a place of the tip."""

    def prepare(self, setting: Setting) -> Plan:
        """Load the kernel that checks states."""
        problem, robot = open_problem(setting.problem)
        radii, check, random = radii_of(problem), StateCheck(problem, robot), np.random.default_rng(setting.seed)

        def plan(task: Plans) -> Answer:
            boundary = task.boundary
            start_xyz, goal_xyz = task.columns["start_xyz"][0], task.columns["goal_xyz"][0]
            tree = Tree(np.concatenate([boundary.start_q[0], boundary.start_dq[0]]), start_xyz, radii, STEP)
            extend = RandomExtension(
                tree,
                robot,
                check,
                obstacle_poses=check.obstacle_poses(start_xyz, goal_xyz),
                goal=goal_xyz,
                random=random,
            )
            return tree.grow(extend, goal_xyz, time_limit=setting.time_limit, most=ITERATIONS)

        return plan


@dataclass(frozen=True)
class RandomExtension:
    """Extends a tree by random accelerations, from nodes that are near random places.

    Attributes:
        tree: The tree.
        robot: The robot.
        check: What allows states.
        obstacle_poses: Heights of the obstacles' upper faces [m], shape (obstacles,).
        goal: Where the tip is to be [m], shape (3,).
        random: Where random numbers come from.
    """

    tree: Tree
    robot: Robot
    check: StateCheck
    obstacle_poses: Array
    goal: Array
    random: np.random.Generator

    def __call__(self) -> int:
        """Hold a random acceleration for a random time; return the node that this leads to, 0 if it is not allowed."""
        to_goal = self.random.random() < BIAS
        parent = self.tree.selected(self.goal if to_goal else self.check.random_place(self.obstacle_poses, self.random))
        q, dq = np.split(self.tree.state(parent), 2)
        limit = self.robot.acceleration_limit
        ddq = self.random.uniform(-limit, limit) * self.random.random()  # small ones, too: 12 kg need much torque
        t = STEP * np.arange(1.0, self.random.integers(1, MOST_STEPS + 1) + 1)[:, None]
        path_q, path_dq = q + t * (dq + t / 2 * ddq), dq + t * ddq
        tips, allowed = self.check(path_q, path_dq, np.broadcast_to(ddq, path_q.shape), self.obstacle_poses)
        return self.tree.add(parent, np.concatenate([path_q, path_dq], axis=1), tips[-1]) if allowed.all() else 0
