"""MPC-MPNet (Li et al., 2021), the variant with one path: a tree that is steered towards proposals of a network.

From the last state, a network proposes the next configuration, or the goal is chosen, and the cross-entropy method
steers there. After a failure or many steps, the search continues from a node near a random position. Controls, pruning
of nodes, distances and the goal are those of ``sst.py``.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from cnpgen.benchmark.benchmark_planner import Answer, BenchmarkPlanner, Plan, Setting
from cnpgen.benchmark.planners.proposals import Proposals, load_proposals, shipped_proposals
from cnpgen.benchmark.planners.state_check import StateCheck
from cnpgen.benchmark.planners.steering import STEERING_STEP_S, Steering, spread_of
from cnpgen.benchmark.planners.tree import Tree, radii_of
from cnpgen.errors import UsageError
from cnpgen.plans.plans import Plans
from cnpgen.problems.problem_record import open_problem
from cnpgen.schema.keys import field

Array = NDArray[np.float64]

MAX_PROPOSALS = 300_000
MAX_CONSECUTIVE_STEPS = 100  # before it continues from another node


@dataclass(frozen=True)
class MPCMPNet(BenchmarkPlanner):
    """A tree of states, steered by the cross-entropy method towards proposals of a network (Li et al., 2021)."""

    witness_radius: float = field(
        "distance of the tip within which one node is kept", unit="m", default=0.02, low=0.0, plausible=5.0
    )
    samples: int = field("controls per iteration of the cross-entropy method", default=64, low=2)
    elites: int = field("best controls, which determine the next distribution", default=4, low=1)
    iterations: int = field("largest number of iterations of the cross-entropy method", default=30, low=1)
    goal_bias: float = field("share of targets that are the goal", default=0.05, low=0.0, high=1.0)

    def prepare(self, setting: Setting) -> Plan:
        """Load the network and the kernel that checks states."""
        problem, robot = open_problem(setting.problem)
        check = StateCheck(problem, robot)
        network = load_proposals(shipped_proposals(problem.name))
        if network.architecture.inputs != 4 * robot.n + len(problem.obstacle):
            raise UsageError(
                f"the network that proposes configurations for {problem.name!r} is trained for another arm or scene"
            )
        spread = spread_of(problem)

        def plan(task: Plans) -> Answer:
            boundary = task.boundary
            start_xyz, goal_xyz = task.columns["start_xyz"][0], task.columns["goal_xyz"][0]
            start = np.concatenate([boundary.start_q[0], boundary.start_dq[0]])
            tree = Tree(start, start_xyz, radii_of(problem, self.witness_radius), STEERING_STEP_S)
            poses, random = task.scene.poses[0], setting.random(task)
            counts = self.samples, self.elites, self.iterations
            steer = Steering(check, poses, robot.acceleration_limit, spread, random, *counts)
            extend = ProposedExtension(tree, network, steer, boundary.goal_q[0], self.goal_bias)
            return tree.grow(extend, goal_xyz, time_limit=setting.time_limit, max_iterations=MAX_PROPOSALS)

        return plan


@dataclass
class ProposedExtension:
    """Extension of a tree towards proposals of a network, from one node to the next.

    Attributes:
        tree: The tree.
        network: Network of the proposals.
        steer: Steering.
        goal_q: Goal configuration [rad], shape (n,).
        goal_bias: Share of targets that are the goal.
        node: Node of the next step.
        steps: Consecutive steps.
    """

    tree: Tree
    network: Proposals
    steer: Steering
    goal_q: Array
    goal_bias: float
    node: int = 0
    steps: int = 0

    def __call__(self) -> int:
        """Take one step; return the new node, or 0 after a failure."""
        state, target, random = self.tree.state(self.node), self.goal_q, self.steer.random
        if random.random() >= self.goal_bias:
            target = self.network.propose(state, self.goal_q, self.steer.obstacle_poses, random)
        motion = self.steer(state, target)
        node = 0 if motion is None else self.tree.add(self.node, *motion)
        self.node, self.steps = node, self.steps + 1
        if motion is None or self.steps > MAX_CONSECUTIVE_STEPS:
            position = self.steer.check.random_position(self.steer.obstacle_poses, random)
            self.node, self.steps = self.tree.select(position), 0
        return node
