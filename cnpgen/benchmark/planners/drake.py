"""KinematicTrajectoryOptimization of Drake (Tedrake et al., 2019): a B-spline of least duration.

As in Drake's own examples, the program is first solved with the limits of the joints only, and then again from that
solution with the manifold, the obstacles and the torques. Drake chooses the solver, which is SNOPT in its wheels.
"""

from dataclasses import dataclass
from typing import Any

import numpy as np

from cnpgen.benchmark.benchmark_planner import Answer, BenchmarkPlanner, Plan, Setting
from cnpgen.benchmark.planners.drake_arm import DrakeArm, check_robot, load_drake
from cnpgen.plans.plans import Plans
from cnpgen.problems.constraints.joint import JointJerk
from cnpgen.problems.problem import Problem
from cnpgen.problems.problem_record import open_problem
from cnpgen.robots.robot import Robot
from cnpgen.schema.keys import field
from cnpgen.trajectory.boundary import Boundary
from cnpgen.trajectory.sampled_trajectory import Trajectory

SPLINE_ORDER = 4  # cubic, the default of Drake
MIN_KNOT_DISTANCE_S = 1e-9  # closer knots are one
MIN_DURATION_S, MAX_DURATION_S = 0.05, 20.0


@dataclass(frozen=True)
class Drake(BenchmarkPlanner):
    """B-spline of least duration within limits of joints, torques, manifold and obstacles (Drake)."""

    control_points: int = field("number of control points", default=15, low=6)
    samples: int = field("equidistant samples of manifold, obstacles and torques", default=25, low=2)
    path_length_weight: float = field("weight of the path's length beside the duration", default=0.01, low=0.0)
    optimality_tolerance: float = field("optimality tolerance of SNOPT", default=1e-4, low=1e-9)
    iterations: int = field("largest number of iterations of SNOPT", default=300, low=1)

    def prepare(self, setting: Setting) -> Plan:
        """Import Drake and check that it can model the problem."""
        load_drake()
        problem, robot = open_problem(setting.problem)
        check_robot(problem, robot)

        def plan(task: Plans) -> Answer:
            return self._plan(problem, robot, task)

        return plan

    def _plan(self, problem: Problem, robot: Robot, task: Plans) -> Trajectory | None:
        """Solve both programs; return None if the second one has no solution."""
        arm, samples = DrakeArm(problem, robot, task.scene), np.linspace(0, 1, self.samples)
        free = self._program(problem, robot, task.boundary)
        program = self._program(problem, robot, task.boundary)
        program.SetInitialGuess(free.ReconstructTrajectory(self._solve(free)))
        for constraint in arm.path_constraints():
            for s in samples[1:-1].tolist():
                program.AddPathPositionConstraint(constraint, s)
        arm.limit_torques(program, samples)
        result = self._solve(program)
        return sampled(program.ReconstructTrajectory(result)) if result.is_success() else None

    def _solve(self, program: Any) -> Any:
        from pydrake.solvers import SnoptSolver, Solve, SolverOptions

        options, solver = SolverOptions(), SnoptSolver.id()
        options.SetOption(solver, "Major optimality tolerance", self.optimality_tolerance)
        options.SetOption(solver, "Major iterations limit", self.iterations)
        return Solve(program.prog(), None, options)

    def _program(self, problem: Problem, robot: Robot, boundary: Boundary) -> Any:
        """Return the program with the limits of the joints and the boundary conditions, guessed as a straight line."""
        from pydrake.planning import KinematicTrajectoryOptimization

        program = KinematicTrajectoryOptimization(robot.n, self.control_points, SPLINE_ORDER)
        program.AddDurationCost(1.0)
        program.AddPathLengthCost(self.path_length_weight)
        program.AddDurationConstraint(MIN_DURATION_S, MAX_DURATION_S)
        program.AddPositionBounds(robot.position_lower, robot.position_upper)
        program.AddVelocityBounds(-robot.velocity_limit, robot.velocity_limit)
        program.AddAccelerationBounds(-robot.acceleration_limit, robot.acceleration_limit)
        if problem.first(JointJerk) is not None:
            program.AddJerkBounds(-robot.jerk_limit, robot.jerk_limit)
        add_boundary_conditions(program, boundary)
        distance = np.abs(boundary.goal_q[0] - boundary.start_q[0])
        times = 2 * distance / robot.velocity_limit, np.sqrt(6 * distance / robot.acceleration_limit)
        duration = np.clip(np.max(times), MIN_DURATION_S, MAX_DURATION_S)
        line = np.linspace(boundary.start_q[0], boundary.goal_q[0], self.control_points).T
        program.get_mutable_prog().SetInitialGuess(program.control_points(), line)
        program.get_mutable_prog().SetInitialGuess(program.duration(), duration)
        return program


def add_boundary_conditions(program: Any, boundary: Boundary) -> None:
    """Add positions and velocities of both ends, and the acceleration at the start; a goal at rest has none, too.

    Args:
        program: A ``KinematicTrajectoryOptimization``.
        boundary: Boundary conditions of one motion.
    """
    from pydrake.solvers import Binding, LinearConstraint
    from pydrake.trajectories import BsplineTrajectory

    n, still = boundary.start_q.shape[1], not np.any(boundary.goal_dq)
    for s, q, dq in ((0.0, boundary.start_q[0], boundary.start_dq[0]), (1.0, boundary.goal_q[0], boundary.goal_dq[0])):
        program.AddPathPositionConstraint(q, q, s)
        velocity = LinearConstraint(np.eye(n), dq, dq)
        program.AddVelocityConstraintAtNormalizedTime(Binding[LinearConstraint](velocity, program.qdot()), s)
    if still:
        program.AddPathAccelerationConstraint(np.zeros(n), np.zeros(n), 1.0)
    points, duration = program.control_points(), program.duration()
    units = [np.eye(points.shape[1])[:, [index]] for index in range(points.shape[1])]
    second = BsplineTrajectory(program.basis(), units).EvalDerivative(0.0, 2)[:, 0]  # weights of the control points
    for row, acceleration in zip(points, boundary.start_ddq[0].tolist(), strict=True):
        curvature = sum(weight * point for weight, point in zip(second.tolist(), row, strict=True) if weight)
        condition = curvature - acceleration * duration**2
        program.get_mutable_prog().AddConstraint(condition == 0.0)


def sampled(spline: Any) -> Trajectory:
    """Sample a cubic spline of Drake at its knots, between which quintics with accelerations equal it."""
    t = np.unique(spline.basis().knots())
    t = np.append(t[:-1][np.diff(t) > MIN_KNOT_DISTANCE_S], t[-1])
    states = (spline, spline.MakeDerivative(1), spline.MakeDerivative(2))
    return Trajectory(t - t[0], *(np.array([state.value(time)[:, 0] for time in t.tolist()]) for state in states))
