"""Differential dynamic programming of Crocoddyl (Mastalli et al., 2020): BoxFDDP with penalties.

BoxFDDP bounds the torques. Quadratic barriers penalize joint positions, velocities and accelerations outside their
limits, and quadratic costs the manifold, the obstacles and the goal. The duration is fixed in such a program, so the
planner tries increasing durations until the violations are small.
"""

import time
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from cnpgen.benchmark.benchmark_planner import Answer, BenchmarkPlanner, Plan, Setting
from cnpgen.benchmark.planners.crocoddyl_costs import ShootingCosts, load_crocoddyl
from cnpgen.benchmark.planners.obstacle_boxes import require_table_or_transport
from cnpgen.plans.plans import Plans
from cnpgen.problems.problem_record import open_problem
from cnpgen.robots.robot import Robot
from cnpgen.schema.keys import field
from cnpgen.trajectory.boundary import Boundary
from cnpgen.trajectory.sampled_trajectory import Trajectory

Array = NDArray[np.float64]

MIN_DURATION_S, MAX_DURATION_S = 0.05, 10.0
MAX_LIMIT_USE = 1.01  # of velocities and accelerations
MAX_GOAL_ERROR_RAD, MAX_GOAL_ERROR_RAD_S = 2e-5, 1e-3  # the answer ends at the goal exactly
MAX_PENALIZED_VIOLATION = 1e-3  # of the height [m], and of tilt and obstacles


@dataclass(frozen=True)
class Crocoddyl(BenchmarkPlanner):
    """BoxFDDP: torques within bounds, other limits as penalties, increasing durations (Crocoddyl)."""

    nodes: int = field("number of spans of constant torque", default=50, low=5)
    iterations: int = field("largest number of iterations per duration", default=50, low=1)
    growth: float = field("ratio of successive durations", default=1.1, low=1.001)

    def prepare(self, setting: Setting) -> Plan:
        """Import Crocoddyl and check the kind of problem."""
        load_crocoddyl()
        problem, robot = open_problem(setting.problem)
        require_table_or_transport(problem)

        def plan(task: Plans) -> Answer:
            deadline = time.perf_counter() + setting.time_limit
            return self._plan(ShootingCosts(problem, robot, task), robot, task.boundary, deadline)

        return plan

    def _plan(self, costs: ShootingCosts, robot: Robot, boundary: Boundary, deadline: float) -> Trajectory | None:
        """Return the first motion with small violations, or None if none is found in time."""
        duration = min_duration(robot, boundary)
        while duration < MAX_DURATION_S and time.perf_counter() < deadline:
            t = np.linspace(0.0, duration, self.nodes + 1)
            solver = costs.solver(duration / self.nodes, self.nodes)
            guess = cubic_states(boundary, t)
            torques = solver.problem.quasiStatic(guess[:-1])
            solver.solve(guess, torques, self.iterations, False)
            states = np.array(solver.xs.tolist())
            if are_small(robot, boundary, t, states) and costs.residual(states) <= MAX_PENALIZED_VIOLATION:
                states[-1] = np.append(boundary.goal_q[0], boundary.goal_dq[0])
                return Trajectory(t, states[:, : robot.n], states[:, robot.n :])
            duration *= self.growth
        return None


def min_duration(robot: Robot, boundary: Boundary) -> float:
    """Return a duration that no motion within the limits of velocity and acceleration can undercut [s]."""
    distance = np.abs(boundary.goal_q[0] - boundary.start_q[0])
    change = np.abs(boundary.goal_dq[0] - boundary.start_dq[0])
    times = distance / robot.velocity_limit, change / robot.acceleration_limit
    return max(float(np.max(times)), MIN_DURATION_S)


def cubic_states(boundary: Boundary, t: Array) -> list[Array]:
    """Return positions and velocities of the cubic between both ends at K times, a list of arrays of shape (2 n,)."""
    ends = np.array([t[0], t[-1]])
    cubic = Trajectory(
        ends,
        *(
            np.vstack(pair)
            for pair in zip((boundary.start_q, boundary.start_dq), (boundary.goal_q, boundary.goal_dq), strict=True)
        ),
    )
    q, dq, _ = cubic.states(t)
    return list(np.hstack([q, dq]))


def are_small(robot: Robot, boundary: Boundary, t: Array, states: Array) -> bool:
    """Return whether a motion meets its goal and exceeds its limits of velocity and acceleration by 1 % at most.

    Args:
        robot: The robot.
        boundary: Boundary conditions of one motion.
        t: Times [s], shape (K,).
        states: Positions and velocities, shape (K, 2 n).
    """
    q, dq = np.split(states, 2, axis=1)
    use = np.abs(dq) / robot.velocity_limit, np.abs(np.diff(dq, axis=0) / t[1]) / robot.acceleration_limit
    errors = np.abs(q[-1] - boundary.goal_q[0]).max(), np.abs(dq[-1] - boundary.goal_dq[0]).max()
    at_goal = errors[0] <= MAX_GOAL_ERROR_RAD and errors[1] <= MAX_GOAL_ERROR_RAD_S
    return bool(at_goal and max(part.max() for part in use) <= MAX_LIMIT_USE)
