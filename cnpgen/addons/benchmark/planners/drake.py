"""KinematicTrajectoryOptimization of Drake (Tedrake et al., 2019): a B-spline of least duration.

As in Drake's own examples, the program is first solved with the limits of the joints
only, and then again from that solution with the manifold, the obstacles and the
torques. Drake chooses the solver, which is SNOPT in its wheels.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any
from xml.etree import ElementTree

import numpy as np

from cnpgen.addons.benchmark.benchmark_planner import (
    BenchmarkPlanner,
    Plan,
    Setting,
    distinct_times,
    require_rigid_torque,
)
from cnpgen.addons.benchmark.planners.obstacle_boxes import require_table_or_transport
from cnpgen.addons.trajectories.sampled_trajectory import Trajectory
from cnpgen.arrays import Array
from cnpgen.errors import UsageError, requires_extra
from cnpgen.plans.plans import Plans
from cnpgen.problems.constraints.joint import JointJerk, JointTorque
from cnpgen.problems.constraints.table import Table
from cnpgen.problems.problem import Problem
from cnpgen.problems.problem_record import open_problem
from cnpgen.robots.robot import Robot
from cnpgen.robots.scene import Scene
from cnpgen.schema.keys import field
from cnpgen.trajectory.boundary import Boundary

SPLINE_ORDER = 4  # cubic, the default of Drake
MIN_KNOT_DISTANCE_S = 1e-9  # closer knots are one
MIN_DRAKE_DURATION_S = 0.05
MAX_DRAKE_DURATION_S = 20.0
# Half of the verdict's tolerance, because samples lie between those of the program.
MAX_SAMPLED_HEIGHT_ERROR_M = 5e-4
MAX_PLANE_TILT_RAD = 0.01
INFLUENCE_DISTANCE_M = 0.05  # closer pairs count in the smooth minimum of distances
MAX_DEPTH_M = 0.0
# Of links and joints; obstacles have own geometry.
OMITTED_ELEMENTS = "visual", "collision", "dynamics", "mimic"


@dataclass(frozen=True)
class Drake(BenchmarkPlanner):
    """B-spline of least duration within limits of joints, torques, manifold and obstacles (Drake)."""

    control_points: int = field("number of control points", default=15, low=6)
    samples: int = field(
        "equidistant samples of manifold, obstacles and torques", default=25, low=2
    )
    path_length_weight: float = field(
        "weight of the path's length beside the duration", default=0.01, low=0.0
    )
    optimality_tolerance: float = field(
        "optimality tolerance of SNOPT", default=1e-4, low=1e-9
    )
    iterations: int = field("largest number of iterations of SNOPT", default=300, low=1)

    def prepare(self, setting: Setting) -> Plan:
        """Import Drake and check that it can model the problem."""
        load_drake()
        problem, robot = open_problem(setting.problem)
        require_rigid_torque("drake", problem, robot)
        require_table_or_transport(problem)
        if (
            robot.attached.payload is not None
            or robot.attached.tip != robot.attached.frame
        ):
            raise UsageError(
                f"supported are tips of the URDF without payload, {problem.name!r} has another one"
            )
        return lambda task: self._plan(problem, robot, task)

    def _plan(self, problem: Problem, robot: Robot, task: Plans) -> Trajectory | None:
        """Solve both programs; return None if the second one has no solution."""
        arm = DrakeArm(problem, robot, task.scene)
        samples = np.linspace(0, 1, self.samples)
        free = self._program(problem, robot, task.boundary)
        program = self._program(problem, robot, task.boundary)
        program.SetInitialGuess(free.ReconstructTrajectory(self._solve(free)))
        for constraint in arm.path_constraints():
            for s in samples[1:-1].tolist():
                program.AddPathPositionConstraint(constraint, s)
        arm.limit_torques(program, samples)
        result = self._solve(program)
        return (
            sampled(program.ReconstructTrajectory(result))
            if result.is_success()
            else None
        )

    def _solve(self, program: Any) -> Any:
        from pydrake.solvers import SnoptSolver, Solve, SolverOptions

        options = SolverOptions()
        solver = SnoptSolver.id()
        options.SetOption(
            solver, "Major optimality tolerance", self.optimality_tolerance
        )
        options.SetOption(solver, "Major iterations limit", self.iterations)
        return Solve(program.prog(), None, options)

    def _program(self, problem: Problem, robot: Robot, boundary: Boundary) -> Any:
        """Return the program with the limits of the joints and the boundary conditions, guessed as a straight line."""
        from pydrake.planning import KinematicTrajectoryOptimization

        program = KinematicTrajectoryOptimization(
            robot.n, self.control_points, SPLINE_ORDER
        )
        program.AddDurationCost(1.0)
        program.AddPathLengthCost(self.path_length_weight)
        program.AddDurationConstraint(MIN_DRAKE_DURATION_S, MAX_DRAKE_DURATION_S)
        program.AddPositionBounds(robot.position_lower, robot.position_upper)
        program.AddVelocityBounds(-robot.velocity_limit, robot.velocity_limit)
        program.AddAccelerationBounds(
            -robot.acceleration_limit, robot.acceleration_limit
        )
        if problem.first(JointJerk) is not None:
            program.AddJerkBounds(-robot.jerk_limit, robot.jerk_limit)
        add_boundary_conditions(program, boundary)
        distance = np.abs(boundary.goal_q[0] - boundary.start_q[0])
        # A cubic from rest to rest accelerates by at most 6 d / T^2, and is slower than
        # 2 d / T.
        times = (
            2 * distance / robot.velocity_limit,
            np.sqrt(6 * distance / robot.acceleration_limit),
        )
        duration = np.clip(np.max(times), MIN_DRAKE_DURATION_S, MAX_DRAKE_DURATION_S)
        line = np.linspace(
            boundary.start_q[0], boundary.goal_q[0], self.control_points
        ).T
        program.get_mutable_prog().SetInitialGuess(program.control_points(), line)
        program.get_mutable_prog().SetInitialGuess(program.duration(), duration)
        return program


def add_boundary_conditions(program: Any, boundary: Boundary) -> None:
    """Add positions and velocities of both ends, and the acceleration at the start.

    A goal at rest has none, too.
    """
    from pydrake.solvers import Binding, LinearConstraint
    from pydrake.trajectories import BsplineTrajectory

    n = boundary.start_q.shape[1]
    still = not np.any(boundary.goal_dq)
    for s, q, dq in (
        (0.0, boundary.start_q[0], boundary.start_dq[0]),
        (1.0, boundary.goal_q[0], boundary.goal_dq[0]),
    ):
        program.AddPathPositionConstraint(q, q, s)
        velocity = LinearConstraint(np.eye(n), dq, dq)
        program.AddVelocityConstraintAtNormalizedTime(
            Binding[LinearConstraint](velocity, program.qdot()), s
        )
    if still:
        program.AddPathAccelerationConstraint(np.zeros(n), np.zeros(n), 1.0)
    points = program.control_points()
    duration = program.duration()
    units = [np.eye(points.shape[1])[:, [index]] for index in range(points.shape[1])]
    # Weights of the control points.
    second = BsplineTrajectory(program.basis(), units).EvalDerivative(0.0, 2)[:, 0]
    for row, acceleration in zip(points, boundary.start_ddq[0].tolist(), strict=True):
        curvature = sum(
            weight * point
            for weight, point in zip(second.tolist(), row, strict=True)
            if weight
        )
        # With s = t / T, the second derivative by s is ddq T^2.
        condition = curvature - acceleration * duration**2
        program.get_mutable_prog().AddConstraint(condition == 0.0)


def sampled(spline: Any) -> Trajectory:
    """Sample a cubic spline of Drake at its knots, between which quintics with accelerations equal it."""
    t = distinct_times(spline.basis().knots(), MIN_KNOT_DISTANCE_S)
    states = (spline, spline.MakeDerivative(1), spline.MakeDerivative(2))
    return Trajectory(
        t - t[0],
        *(
            np.array([state.value(time)[:, 0] for time in t.tolist()])
            for state in states
        ),
    )


def load_drake() -> Any:
    """Import Drake; raise MissingExtraError if it is missing."""
    with requires_extra("planners", "Drake"):
        import pydrake
        import pydrake.planning
    return pydrake


class DrakeArm:
    """A robot in the scene of one boundary problem.

    Drake's objects live as long as this one.
    """

    def __init__(self, problem: Problem, robot: Robot, scene: Scene) -> None:
        from pydrake.multibody.parsing import Parser
        from pydrake.multibody.plant import AddMultibodyPlantSceneGraph
        from pydrake.systems.framework import DiagramBuilder

        self._problem = problem
        self._robot = robot
        builder = DiagramBuilder()
        self._plant, self._scene_graph = AddMultibodyPlantSceneGraph(
            builder, time_step=0.0
        )
        text, root = model_text(robot)
        Parser(self._plant).AddModelsFromString(text, "urdf")
        if root != "world":
            self._plant.WeldFrames(
                self._plant.world_frame(), self._plant.GetFrameByName(root)
            )
        for name, limit in zip(
            robot.joint_names, robot.torque_limit.tolist(), strict=True
        ):
            self._plant.AddJointActuator(name, self._plant.GetJointByName(name), limit)
        if problem.object_size is not None:
            self._add_boxes(np.array(problem.object_size), scene)
        self._plant.Finalize()
        self._diagram = builder.Build()
        self._context = self._diagram.CreateDefaultContext()

    def _add_boxes(self, size: Array, scene: Scene) -> None:
        """Register the held object and the obstacles."""
        from pydrake.geometry import Box
        from pydrake.math import RigidTransform
        from pydrake.multibody.plant import CoulombFriction

        plant = self._plant
        friction = CoulombFriction()
        held = plant.GetFrameByName(self._robot.tip).body()
        plant.RegisterCollisionGeometry(
            held, RigidTransform(), Box(*size), "held", friction
        )
        for index, solid in enumerate(scene.bodies()):
            place = RigidTransform((solid.low + solid.high) / 2)
            edges = solid.high - solid.low
            plant.RegisterCollisionGeometry(
                plant.world_body(), place, Box(*edges), f"obstacle {index}", friction
            )

    def path_constraints(self) -> list[Any]:
        """Return the constraints of the joint positions at a sample: table, or tilt and distance of the object."""
        from pydrake.multibody.inverse_kinematics import (
            AngleBetweenVectorsConstraint,
            MinimumDistanceLowerBoundConstraint,
            PositionConstraint,
        )

        plant = self._plant
        table = self._problem.first(Table)
        context = plant.GetMyMutableContextFromRoot(self._context)
        tip = plant.GetFrameByName(self._robot.tip)
        world = plant.world_frame()
        up = np.array([0.0, 0.0, 1.0])
        if table is not None:
            low = np.array(
                [table.x.low, table.y.low, table.z - MAX_SAMPLED_HEIGHT_ERROR_M]
            )
            high = np.array(
                [table.x.high, table.y.high, table.z + MAX_SAMPLED_HEIGHT_ERROR_M]
            )
            return [
                PositionConstraint(plant, world, low, high, tip, np.zeros(3), context)
            ]
        return [
            AngleBetweenVectorsConstraint(
                plant, world, up, tip, up, 0.0, MAX_PLANE_TILT_RAD, context
            ),
            MinimumDistanceLowerBoundConstraint(
                plant, MAX_DEPTH_M, context, None, INFLUENCE_DISTANCE_M
            ),
        ]

    def limit_torques(self, program: Any, samples: Array) -> None:
        """Limit the torques of a ``KinematicTrajectoryOptimization`` at samples of the path, if the problem does."""
        if self._problem.first(JointTorque) is None:
            return
        limit = self._robot.torque_limit
        context = self._plant.GetMyMutableContextFromRoot(self._context)
        program.AddEffortBoundsAtNormalizedTimes(
            self._plant, samples, -limit, limit, context
        )


def model_text(robot: Robot) -> tuple[str, str]:
    """Return the URDF with fixed joints in place of those without plan and without geometry, and its root link."""
    root = ElementTree.fromstring(robot.urdf_text)  # noqa: S314 - the problem was loaded from it
    for parent in (*root.iter("link"), *root.iter("joint")):
        for child in [child for child in parent if child.tag in OMITTED_ELEMENTS]:
            parent.remove(child)
    for joint in root.iter("joint"):
        if joint.get("type") is not None and joint.get("name") not in robot.joint_names:
            joint.set("type", "fixed")
    children = {child.get("link") for child in root.iter("child")}
    links = [link.get("name", "") for link in root.findall("link")]
    return ElementTree.tostring(root, encoding="unicode"), next(
        name for name in links if name not in children
    )
