"""MPC-MPNet (Li et al., 2021), its variant that follows one path: a tree that is steered to what a network proposes.

From the state that it has just reached, a network proposes where to be next, now and then it is the goal, and the
cross-entropy method steers there. Where that fails, or after many steps, it goes on from a node near a random place.
Controls are accelerations within the torque limits, as those of SST are here; how nodes are
kept, distances and the goal, a place of the tip alone, are those of SST, too.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from cnpgen.benchmark.benchmark_planner import Answer, BenchmarkPlanner, Plan, Setting
from cnpgen.benchmark.planners import steering
from cnpgen.benchmark.planners.proposals import Proposals, load_proposals, shipped_proposals
from cnpgen.benchmark.planners.state_check import StateCheck
from cnpgen.benchmark.planners.steering import Steering
from cnpgen.benchmark.planners.tree import Tree, radii_of
from cnpgen.errors import UsageError
from cnpgen.plans.plans import Plans
from cnpgen.problems.problem_record import open_problem

Array = NDArray[np.float64]

ITERATIONS = 300_000
BIAS = 0.05  # of the targets, which are the goal
MOST_STEPS = 100  # steps in a row before it goes on elsewhere


@dataclass(frozen=True)
class MPCMPNet(BenchmarkPlanner):
    """A tree of states, steered by the cross-entropy method to what a network proposes (Li et al., 2021)."""

    def prepare(self, setting: Setting) -> Plan:
        """Load the network and the kernel that checks states."""
        problem, robot = open_problem(setting.problem)
        check = StateCheck(problem, robot)
        network = load_proposals(shipped_proposals(problem.name))
        if network.architecture.inputs != 4 * robot.n + len(problem.obstacle):
            raise UsageError(
                f"the network that proposes configurations for {problem.name!r} is of another arm or world"
            )
        spread = steering.HIT if problem.object_size is None else steering.TRANSPORT
        random = np.random.default_rng(setting.seed)

        def plan(task: Plans) -> Answer:
            boundary = task.boundary
            start_xyz, goal_xyz = task.columns["start_xyz"][0], task.columns["goal_xyz"][0]
            start = np.concatenate([boundary.start_q[0], boundary.start_dq[0]])
            tree = Tree(start, start_xyz, radii_of(problem), steering.STEP)
            steer = Steering(check, check.obstacle_poses(start_xyz, goal_xyz), robot.acceleration_limit, spread, random)
            extend = ProposedExtension(tree, network, steer, boundary.goal_q[0])
            return tree.grow(extend, goal_xyz, time_limit=setting.time_limit, most=ITERATIONS)

        return plan


@dataclass
class ProposedExtension:
    """Extends a tree towards what a network proposes, from one node to the next.

    Attributes:
        tree: The tree.
        network: What proposes.
        steer: What steers there.
        goal_q: Where the arm is to be in the end [rad], shape (n,).
        node: Where it goes on.
        steps: Steps in a row.
    """

    tree: Tree
    network: Proposals
    steer: Steering
    goal_q: Array
    node: int = 0
    steps: int = 0

    def __call__(self) -> int:
        """Take one step; return the node that it led to, 0 if it led nowhere."""
        state, target, random = self.tree.state(self.node), self.goal_q, self.steer.random
        if random.random() >= BIAS:
            target = self.network.propose(state, self.goal_q, self.steer.obstacle_poses, random)
        found = self.steer(state, target)
        reached = 0 if found is None else self.tree.add(self.node, *found)
        self.node, self.steps = reached, self.steps + 1
        if found is None or self.steps > MOST_STEPS:
            self.node, self.steps = (
                self.tree.selected(self.steer.check.random_place(self.steer.obstacle_poses, random)),
                0,
            )
        return reached
