"""Model of a robot, its table or held object, and its obstacles in Drake, with the constraints of a problem."""

from typing import Any
from xml.etree import ElementTree

import numpy as np
from numpy.typing import NDArray

from cnpgen.benchmark.planners.obstacle_boxes import require_table_or_transport
from cnpgen.errors import UsageError, requires_extra
from cnpgen.problems.constraints.joint import JointTorque
from cnpgen.problems.constraints.table import Table
from cnpgen.problems.problem import Problem
from cnpgen.robots.robot import Robot
from cnpgen.robots.scene import Scene

Array = NDArray[np.float64]

MAX_SAMPLED_HEIGHT_ERROR_M = 5e-4  # half of the verdict's tolerance, because samples lie between those of the program
MAX_PLANE_TILT_RAD = 0.01
INFLUENCE_DISTANCE_M = 0.05  # closer pairs count in the smooth minimum of distances
MAX_DEPTH_M = 0.0
OMITTED_ELEMENTS = ("visual", "collision", "dynamics", "mimic")  # of links and joints; obstacles have own geometry


def load_drake() -> Any:
    """Import Drake.

    Raises:
        MissingExtraError: Drake is missing.
    """
    with requires_extra("planners", "Drake"):
        import pydrake
        import pydrake.planning
    return pydrake


def check_robot(problem: Problem, robot: Robot) -> None:
    """Check that Drake can model a problem from its URDF.

    Raises:
        UsageError: The problem has neither a table nor a held object among boxes, or a payload or another tip frame.
    """
    require_table_or_transport(problem)
    if robot.attached.payload is not None or robot.attached.tip != robot.attached.frame:
        raise UsageError(f"supported are tips of the URDF without payload, {problem.name!r} has another one")


class DrakeArm:
    """A robot in its scene; Drake's objects live as long as this one.

    Args:
        problem: The problem, see ``check_robot``.
        robot: Its robot.
        scene: Obstacles of one boundary problem.
    """

    def __init__(self, problem: Problem, robot: Robot, scene: Scene) -> None:
        from pydrake.multibody.parsing import Parser
        from pydrake.multibody.plant import AddMultibodyPlantSceneGraph
        from pydrake.systems.framework import DiagramBuilder

        self._problem, self._robot = problem, robot
        builder = DiagramBuilder()
        self._plant, self._scene_graph = AddMultibodyPlantSceneGraph(builder, time_step=0.0)
        text, root = model_text(robot)
        Parser(self._plant).AddModelsFromString(text, "urdf")
        if root != "world":
            self._plant.WeldFrames(self._plant.world_frame(), self._plant.GetFrameByName(root))
        for name, limit in zip(robot.joint_names, robot.torque_limit.tolist(), strict=True):
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

        plant, friction = self._plant, CoulombFriction()
        held = plant.GetFrameByName(self._robot.tip).body()
        plant.RegisterCollisionGeometry(held, RigidTransform(), Box(*size), "held", friction)
        for index, solid in enumerate(scene.bodies()):
            place, edges = RigidTransform((solid.low + solid.high) / 2), solid.high - solid.low
            plant.RegisterCollisionGeometry(plant.world_body(), place, Box(*edges), f"obstacle {index}", friction)

    def path_constraints(self) -> list[Any]:
        """Return the constraints of the joint positions at a sample: table, or tilt and distance of the object."""
        from pydrake.multibody.inverse_kinematics import (
            AngleBetweenVectorsConstraint,
            MinimumDistanceLowerBoundConstraint,
            PositionConstraint,
        )

        plant, table = self._plant, self._problem.first(Table)
        context = plant.GetMyMutableContextFromRoot(self._context)
        tip, world, up = plant.GetFrameByName(self._robot.tip), plant.world_frame(), np.array([0.0, 0.0, 1.0])
        if table is not None:
            low = np.array([table.x.low, table.y.low, table.z - MAX_SAMPLED_HEIGHT_ERROR_M])
            high = np.array([table.x.high, table.y.high, table.z + MAX_SAMPLED_HEIGHT_ERROR_M])
            return [PositionConstraint(plant, world, low, high, tip, np.zeros(3), context)]
        return [
            AngleBetweenVectorsConstraint(plant, world, up, tip, up, 0.0, MAX_PLANE_TILT_RAD, context),
            MinimumDistanceLowerBoundConstraint(plant, MAX_DEPTH_M, context, None, INFLUENCE_DISTANCE_M),
        ]

    def limit_torques(self, program: Any, samples: Array) -> None:
        """Limit the torques of a ``KinematicTrajectoryOptimization`` at samples of the path, if the problem does."""
        if self._problem.first(JointTorque) is None:
            return
        limit = self._robot.torque_limit
        context = self._plant.GetMyMutableContextFromRoot(self._context)
        program.AddEffortBoundsAtNormalizedTimes(self._plant, samples, -limit, limit, context)


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
    return ElementTree.tostring(root, encoding="unicode"), next(name for name in links if name not in children)
