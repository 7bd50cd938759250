"""Stable sparse trees (SST; Li, Littlefield, Bekris, 2016) over the arm's states, with random accelerations.

This implementation exists because the Python wheels of OMPL cannot construct its SST. A state is (q, dq). A control is
an acceleration, constant for 1 to 20 steps of 5 ms and within the torque limits. The distance is that of the tip in the
workspace, and the cost is time. The goal is a position of the tip, as in the paper. If no state reaches the goal, the
nearest state is the result. Random torques would exceed a velocity limit within 5 ms.
"""

from dataclasses import dataclass
from functools import partial

import numpy as np
from numpy.typing import NDArray

from cnpgen.benchmark.benchmark_planner import Answer, BenchmarkPlanner, Plan, Setting
from cnpgen.benchmark.planners.state_check import StateCheck
from cnpgen.benchmark.planners.tree import Tree, radii_of
from cnpgen.plans.plans import Plans
from cnpgen.problems.problem_record import open_problem
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
            extend = partial(self.extend, tree, check, task.scene.poses[0], goal_xyz, setting.random(task))
            return tree.grow(extend, goal_xyz, time_limit=setting.time_limit, max_iterations=MAX_TREE_ITERATIONS)

        return plan

    def extend(
        self, tree: Tree, check: StateCheck, obstacle_poses: Array, goal: Array, random: np.random.Generator
    ) -> int:
        """Apply a random acceleration for a random time at a node near a random position.

        Args:
            tree: The tree, which gets the new node.
            check: Check of states.
            obstacle_poses: Poses and sizes of the obstacles, shape (width,).
            goal: Goal position of the tip [m], shape (3,).
            random: Random generator.

        Returns:
            The new node, or 0 if a state is invalid.
        """
        position = goal if random.random() < self.goal_bias else check.random_position(obstacle_poses, random)
        parent = tree.select(position)
        q, dq = np.split(tree.state(parent), 2)
        limit = check.robot.acceleration_limit
        ddq = random.uniform(-limit, limit) * random.random()  # often small: 12 kg need much torque
        t = CONTROL_STEP_S * np.arange(1.0, random.integers(1, self.max_steps + 1) + 1)[:, None]
        path_q, path_dq = q + t * (dq + t / 2 * ddq), dq + t * ddq
        tips, valid = check(path_q, path_dq, np.broadcast_to(ddq, path_q.shape), obstacle_poses)
        return tree.add(parent, np.concatenate([path_q, path_dq], axis=1), tips[-1]) if valid.all() else 0
