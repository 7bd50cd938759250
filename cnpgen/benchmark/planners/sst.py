"""Stable sparse trees (SST; Li, Littlefield, Bekris, 2016) over the arm's states, with random accelerations.

This implementation exists because the Python wheels of OMPL cannot construct its SST. A state is (q, dq). A control is
an acceleration, constant for 1 to 20 steps of 5 ms and within the torque limits. The distance is that of the tip in the
workspace, and the cost is time. The goal is a position of the tip, as in the paper. If no state reaches the goal, the
nearest state is the result. Random torques would exceed a velocity limit within 5 ms.
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
from cnpgen.schema.keys import field

Array = NDArray[np.float64]

CONTROL_STEP_S = 5e-3
MAX_TREE_ITERATIONS = 300_000


@dataclass(frozen=True)
class SST(BenchmarkPlanner):
    """Stable sparse trees over the arm's states with random accelerations, to a position of the tip."""

    witness_radius: float = field(
        "distance of the tip within which one node is kept", unit="m", default=0.02, low=0.0, plausible=5.0
    )
    max_steps: int = field("largest number of steps of 5 ms of a control", default=20, low=1)
    goal_bias: float = field("share of samples that are the goal", default=0.05, low=0.0, high=1.0)

    def prepare(self, setting: Setting) -> Plan:
        """Load the kernel that checks states."""
        problem, robot = open_problem(setting.problem)
        radii, check = radii_of(problem, self.witness_radius), StateCheck(problem, robot)

        def plan(task: Plans) -> Answer:
            boundary = task.boundary
            start_xyz, goal_xyz = task.columns["start_xyz"][0], task.columns["goal_xyz"][0]
            tree = Tree(np.concatenate([boundary.start_q[0], boundary.start_dq[0]]), start_xyz, radii, CONTROL_STEP_S)
            random = setting.random(task)
            extend = RandomExtension(tree, robot, check, task.scene.poses[0], goal_xyz, random, self)
            return tree.grow(extend, goal_xyz, time_limit=setting.time_limit, max_iterations=MAX_TREE_ITERATIONS)

        return plan


@dataclass(frozen=True)
class RandomExtension:
    """Extension of a tree by random accelerations, from nodes near random positions.

    Attributes:
        tree: The tree.
        robot: The robot.
        check: Check of states.
        obstacle_poses: Poses and sizes of the obstacles, shape (width,).
        goal: Goal position of the tip [m], shape (3,).
        random: Random generator.
        settings: Fields of the planner.
    """

    tree: Tree
    robot: Robot
    check: StateCheck
    obstacle_poses: Array
    goal: Array
    random: np.random.Generator
    settings: SST

    def __call__(self) -> int:
        """Apply a random acceleration for a random time; return the new node, or 0 if a state is invalid."""
        to_goal = self.random.random() < self.settings.goal_bias
        position = self.goal if to_goal else self.check.random_position(self.obstacle_poses, self.random)
        parent = self.tree.select(position)
        q, dq = np.split(self.tree.state(parent), 2)
        limit = self.robot.acceleration_limit
        ddq = self.random.uniform(-limit, limit) * self.random.random()  # often small: 12 kg need much torque
        t = CONTROL_STEP_S * np.arange(1.0, self.random.integers(1, self.settings.max_steps + 1) + 1)[:, None]
        path_q, path_dq = q + t * (dq + t / 2 * ddq), dq + t * ddq
        tips, valid = self.check(path_q, path_dq, np.broadcast_to(ddq, path_q.shape), self.obstacle_poses)
        return self.tree.add(parent, np.concatenate([path_q, path_dq], axis=1), tips[-1]) if valid.all() else 0
