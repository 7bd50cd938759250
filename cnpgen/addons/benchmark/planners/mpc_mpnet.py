"""MPC-MPNet (Li et al., 2021), the variant with one path: a tree that is steered towards proposals of a network.

From the last state, a network proposes the next configuration, or the goal is chosen,
and the cross-entropy method steers there. After a failure or many steps, the search
continues from a node near a random position. Controls, pruning of nodes, distances and
the goal are those of ``sst.py``.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from cnpgen.addons.benchmark.benchmark_planner import (
    Answer,
    BenchmarkPlanner,
    Plan,
    Setting,
    require_rigid_torque,
)
from cnpgen.addons.benchmark.planners.sst import Tree, tree_of
from cnpgen.addons.benchmark.planners.state_check import StateCheck
from cnpgen.addons.paper.proposals import Proposals, load_proposals, shipped_proposals
from cnpgen.arrays import Array, Integers
from cnpgen.errors import UsageError
from cnpgen.plans.plans import Plans
from cnpgen.problems.problem import Problem
from cnpgen.problems.problem_record import open_problem
from cnpgen.schema.keys import field

MAX_PROPOSALS = 300_000
MAX_CONSECUTIVE_STEPS = 100  # before it continues from another node
STEERING_STEP_S = 0.01
TARGET_TOLERANCE_RAD = 0.02
CEM_LEARNING_RATE = 0.1  # of mean and deviation towards the elites


@dataclass(frozen=True)
class MPCMPNet(BenchmarkPlanner):
    """A tree of states, steered by the cross-entropy method towards proposals of a network (Li et al., 2021)."""

    witness_radius: float = field(
        "distance of the tip within which one node is kept",
        unit="m",
        default=0.02,
        low=0.0,
        plausible=5.0,
    )
    samples: int = field(
        "controls per iteration of the cross-entropy method", default=64, low=2
    )
    elites: int = field(
        "best controls, which determine the next distribution", default=4, low=1
    )
    iterations: int = field(
        "largest number of iterations of the cross-entropy method", default=30, low=1
    )
    goal_bias: float = field(
        "share of targets that are the goal", default=0.05, low=0.0, high=1.0
    )

    def prepare(self, setting: Setting) -> Plan:
        """Load the network and the kernel that checks states."""
        problem, robot = open_problem(setting.problem)
        require_rigid_torque("mpc-mpnet", problem, robot)
        check = StateCheck(problem, robot)
        network = load_proposals(shipped_proposals(problem.name))
        if network.architecture.inputs != 4 * robot.n + len(problem.obstacle):
            raise UsageError(
                f"the network that proposes configurations for {problem.name!r} is trained for another arm or scene"
            )

        def plan(task: Plans) -> Answer:
            tree = tree_of(problem, task, self.witness_radius, STEERING_STEP_S)
            steer = Steering(
                self,
                check,
                task.scene.poses[0],
                spread_of(problem),
                setting.random(task),
            )
            extend = ProposedExtension(tree, network, steer, task.boundary.goal_q[0])
            return tree.grow(
                extend,
                task.columns["goal_xyz"][0],
                time_limit=setting.time_limit,
                max_iterations=MAX_PROPOSALS,
            )

        return plan


@dataclass
class ProposedExtension:
    """Extension of a tree towards proposals of a network for a goal [rad], shape (n,), from one node to the next.

    The next step begins at ``node``, after a number of consecutive steps.
    """

    tree: Tree
    network: Proposals
    steer: Steering
    goal_q: Array
    node: int = 0
    steps: int = 0

    def __call__(self) -> int:
        """Take one step; return the new node, or 0 after a failure."""
        state = self.tree.state(self.node)
        target = self.goal_q
        random = self.steer.random
        if random.random() >= self.steer.settings.goal_bias:
            target = self.network.propose(
                state, self.goal_q, self.steer.obstacle_poses, random
            )
        motion = self.steer(state, target)
        node = 0 if motion is None else self.tree.add(self.node, *motion)
        self.node = node
        self.steps = self.steps + 1
        # After a failure or many steps, the search goes on at a node near a random
        # position.
        if motion is None or self.steps > MAX_CONSECUTIVE_STEPS:
            position = self.steer.check.random_position(
                self.steer.obstacle_poses, random
            )
            self.node = self.tree.select(position)
            self.steps = 0
        return node


@dataclass(frozen=True)
class Spread:
    """Initial distribution of controls; the mean acceleration is 0.

    The deviation of accelerations is a fraction of the limits. Durations [s] have a
    mean, a deviation and a maximum.
    """

    acceleration: float
    mean_time: float
    time: float
    max_duration: float


HIT_SPREAD = Spread(0.4, 0.1, 0.4, 0.5)
TRANSPORT_SPREAD = Spread(0.8, 0.05, 0.1, 0.1)


def spread_of(problem: Problem) -> Spread:
    """Return the initial distribution for hits or for transports."""
    return HIT_SPREAD if problem.object_size is None else TRANSPORT_SPREAD


@dataclass(frozen=True)
class Steering:
    """Steering from states towards configurations, for one boundary problem.

    Its obstacles have shape (width,).
    """

    settings: MPCMPNet
    check: StateCheck
    obstacle_poses: Array
    spread: Spread
    random: np.random.Generator

    @property
    def limit(self) -> Array:
        """Limits of the accelerations [rad/s^2], shape (n,)."""
        return self.check.robot.acceleration_limit

    def __call__(self, state: Array, target: Array) -> tuple[Array, Array] | None:
        """Steer from a state of shape (2 n,) to a configuration of shape (n,) [rad], with any velocity there.

        A control is cut before its first invalid state. Return the states of the best
        motion, one per ``STEERING_STEP_S``, shape (K, 2 n), and the tip position at its
        end [m]; None if all controls are invalid.
        """
        mean = np.append(np.zeros_like(self.limit), self.spread.mean_time)
        deviation = np.append(self.spread.acceleration * self.limit, self.spread.time)
        best = None
        least = np.inf
        for _ in range(self.settings.iterations):
            controls = self._sample_controls(mean, deviation)
            paths, tips, lengths = self.integrate(state, controls)
            ends = paths[np.arange(self.settings.samples), lengths - 1, : len(target)]
            # Controls whose first state is invalid have no end.
            distances = np.where(
                lengths > 0, np.linalg.norm(ends - target, axis=1), np.inf
            )
            order = np.argsort(distances)[: self.settings.elites]
            first = int(order[0])
            length = int(lengths[order[0]])
            if distances[first] < least:
                best = (paths[first, :length], tips[first, length - 1])
                least = float(distances[first])
            elites = controls[order[np.isfinite(distances[order])]]
            if least < TARGET_TOLERANCE_RAD or not len(elites):
                break
            # A small step towards the elites keeps the distribution wide.
            mean = (1 - CEM_LEARNING_RATE) * mean + CEM_LEARNING_RATE * elites.mean(
                axis=0
            )
            deviation = (
                1 - CEM_LEARNING_RATE
            ) * deviation + CEM_LEARNING_RATE * elites.std(axis=0)
        return best

    def _sample_controls(self, mean: Array, deviation: Array) -> Array:
        """Sample controls within their limits: accelerations [rad/s^2] and a time [s], shape (samples, n + 1)."""
        controls = self.random.normal(
            mean, deviation, (self.settings.samples, len(mean))
        )
        low = np.append(-self.limit, STEERING_STEP_S)
        high = np.append(self.limit, self.spread.max_duration)
        return np.clip(controls, low, high)

    def integrate(self, state: Array, controls: Array) -> tuple[Array, Array, Integers]:
        """Integrate controls, accelerations [rad/s^2] and times [s] of shape (N, n + 1), from a state of shape (2 n,).

        Return states every ``STEERING_STEP_S``, shape (N, K, 2 n), tip positions [m],
        shape (N, K, 3), and the numbers of states before the first invalid one, shape
        (N,).
        """
        q, dq = np.split(state, 2)
        n = len(self.limit)
        ddq = np.repeat(
            controls[:, None, :n],
            round(self.spread.max_duration / STEERING_STEP_S),
            axis=1,
        )
        t = STEERING_STEP_S * np.arange(1.0, ddq.shape[1] + 1)[:, None]
        paths = np.concatenate([q + t * (dq + t / 2 * ddq), dq + t * ddq], axis=2)
        flat = paths.reshape(-1, 2 * n)
        tips, valid_states = self.check(
            flat[:, :n], flat[:, n:], ddq.reshape(-1, n), self.obstacle_poses
        )
        # States until the time of each control, rounded to the nearest step.
        active = t[:, 0] < controls[:, n:] + STEERING_STEP_S / 2
        # Everything after the first invalid state counts as invalid.
        valid = np.logical_and.accumulate(
            valid_states.reshape(active.shape) & active, axis=1
        )
        return paths, tips.reshape(*active.shape, 3), valid.sum(axis=1)
