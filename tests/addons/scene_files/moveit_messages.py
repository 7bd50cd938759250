"""The public definitions of MoveIt's messages, field by field, and a scene and a request that use them."""

from __future__ import annotations

from typing import Any

# Fields of moveit_msgs, shape_msgs, geometry_msgs, sensor_msgs, trajectory_msgs and octomap_msgs (ROS 1 and ROS 2).
# A type that ends in [] is a list; "duration" and "time" are seconds and nanoseconds.
MESSAGES: dict[str, dict[str, str]] = {
    "Header": {"seq": "int", "stamp": "time", "frame_id": "string"},
    "Vector3": {"x": "float", "y": "float", "z": "float"},
    "Quaternion": {"x": "float", "y": "float", "z": "float", "w": "float"},
    "Pose": {"position": "Vector3", "orientation": "Quaternion"},
    "Transform": {"translation": "Vector3", "rotation": "Quaternion"},
    "Twist": {"linear": "Vector3", "angular": "Vector3"},
    "Wrench": {"force": "Vector3", "torque": "Vector3"},
    "TransformStamped": {
        "header": "Header",
        "child_frame_id": "string",
        "transform": "Transform",
    },
    "PoseStamped": {"header": "Header", "pose": "Pose"},
    "JointState": {
        "header": "Header",
        "name": "string[]",
        "position": "float[]",
        "velocity": "float[]",
        "effort": "float[]",
    },
    "MultiDOFJointState": {
        "header": "Header",
        "joint_names": "string[]",
        "transforms": "Transform[]",
        "twist": "Twist[]",
        "wrench": "Wrench[]",
    },
    "ObjectType": {"key": "string", "db": "string"},
    "SolidPrimitive": {"type": "int", "dimensions": "float[]", "polygon": "Polygon"},
    "Polygon": {"points": "Vector3[]"},
    "MeshTriangle": {"vertex_indices": "int[]"},
    "Mesh": {"triangles": "MeshTriangle[]", "vertices": "Vector3[]"},
    "Plane": {"coef": "float[]"},
    "CollisionObject": {
        "header": "Header",
        "pose": "Pose",
        "id": "string",
        "type": "ObjectType",
        "primitives": "SolidPrimitive[]",
        "primitive_poses": "Pose[]",
        "meshes": "Mesh[]",
        "mesh_poses": "Pose[]",
        "planes": "Plane[]",
        "plane_poses": "Pose[]",
        "subframe_names": "string[]",
        "subframe_poses": "Pose[]",
        "operation": "int",
    },
    "JointTrajectoryPoint": {
        "positions": "float[]",
        "velocities": "float[]",
        "accelerations": "float[]",
        "effort": "float[]",
        "time_from_start": "time",
    },
    "JointTrajectory": {
        "header": "Header",
        "joint_names": "string[]",
        "points": "JointTrajectoryPoint[]",
    },
    "AttachedCollisionObject": {
        "link_name": "string",
        "object": "CollisionObject",
        "touch_links": "string[]",
        "detach_posture": "JointTrajectory",
        "weight": "float",
    },
    "RobotState": {
        "joint_state": "JointState",
        "multi_dof_joint_state": "MultiDOFJointState",
        "attached_collision_objects": "AttachedCollisionObject[]",
        "is_diff": "bool",
    },
    "AllowedCollisionEntry": {"enabled": "bool[]"},
    "AllowedCollisionMatrix": {
        "entry_names": "string[]",
        "entry_values": "AllowedCollisionEntry[]",
        "default_entry_names": "string[]",
        "default_entry_values": "bool[]",
    },
    "LinkPadding": {"link_name": "string", "padding": "float"},
    "LinkScale": {"link_name": "string", "scale": "float"},
    "ColorRGBA": {"r": "float", "g": "float", "b": "float", "a": "float"},
    "ObjectColor": {"id": "string", "color": "ColorRGBA"},
    "Octomap": {
        "header": "Header",
        "binary": "bool",
        "id": "string",
        "resolution": "float",
        "data": "int[]",
    },
    "OctomapWithPose": {"header": "Header", "origin": "Pose", "octomap": "Octomap"},
    "PlanningSceneWorld": {
        "collision_objects": "CollisionObject[]",
        "octomap": "OctomapWithPose",
    },
    "PlanningScene": {
        "name": "string",
        "robot_state": "RobotState",
        "robot_model_name": "string",
        "fixed_frame_transforms": "TransformStamped[]",
        "allowed_collision_matrix": "AllowedCollisionMatrix",
        "link_padding": "LinkPadding[]",
        "link_scale": "LinkScale[]",
        "object_colors": "ObjectColor[]",
        "world": "PlanningSceneWorld",
        "is_diff": "bool",
    },
    "WorkspaceParameters": {
        "header": "Header",
        "min_corner": "Vector3",
        "max_corner": "Vector3",
    },
    "JointConstraint": {
        "joint_name": "string",
        "position": "float",
        "tolerance_above": "float",
        "tolerance_below": "float",
        "weight": "float",
    },
    "BoundingVolume": {
        "primitives": "SolidPrimitive[]",
        "primitive_poses": "Pose[]",
        "meshes": "Mesh[]",
        "mesh_poses": "Pose[]",
    },
    "PositionConstraint": {
        "header": "Header",
        "link_name": "string",
        "target_point_offset": "Vector3",
        "constraint_region": "BoundingVolume",
        "weight": "float",
    },
    "OrientationConstraint": {
        "header": "Header",
        "orientation": "Quaternion",
        "link_name": "string",
        "absolute_x_axis_tolerance": "float",
        "absolute_y_axis_tolerance": "float",
        "absolute_z_axis_tolerance": "float",
        "parameterization": "int",
        "weight": "float",
    },
    "VisibilityConstraint": {
        "target_radius": "float",
        "target_pose": "PoseStamped",
        "cone_sides": "int",
        "sensor_pose": "PoseStamped",
        "max_view_angle": "float",
        "max_range_angle": "float",
        "sensor_view_direction": "int",
        "weight": "float",
    },
    "Constraints": {
        "name": "string",
        "joint_constraints": "JointConstraint[]",
        "position_constraints": "PositionConstraint[]",
        "orientation_constraints": "OrientationConstraint[]",
        "visibility_constraints": "VisibilityConstraint[]",
    },
    "TrajectoryConstraints": {"constraints": "Constraints[]"},
    "GenericTrajectory": {
        "header": "Header",
        "joint_trajectory": "JointTrajectory[]",
    },
    "MotionPlanRequest": {
        "workspace_parameters": "WorkspaceParameters",
        "start_state": "RobotState",
        "goal_constraints": "Constraints[]",
        "path_constraints": "Constraints",
        "trajectory_constraints": "TrajectoryConstraints",
        "reference_trajectories": "GenericTrajectory[]",
        "pipeline_id": "string",
        "planner_id": "string",
        "group_name": "string",
        "num_planning_attempts": "int",
        "allowed_planning_time": "float",
        "max_velocity_scaling_factor": "float",
        "max_acceleration_scaling_factor": "float",
        "cartesian_speed_end_effector_link": "string",
        "cartesian_speed_limited_link": "string",
        "max_cartesian_speed": "float",
    },
}
VALUES: dict[str, list[Any]] = {  # boundary values of every type
    "float": [0, "nan", "inf", -1, 0.3, ""],
    "int": [0, 1, 2, 3, 4, -1, "nan", ""],
    "bool": [False, True, ""],
    "string": ["", "elsewhere"],
    "time": [{}, {"secs": 3, "nsecs": 4}, {"sec": 3, "nanosec": 4}],
}


def header(frame: str) -> dict[str, Any]:
    return {"seq": 1, "stamp": {"secs": 1, "nsecs": 2}, "frame_id": frame}


def pose(x: float, y: float, z: float) -> dict[str, Any]:
    turn = {"x": 0, "y": 0, "z": 0.6, "w": 0.8}
    return {"position": {"x": x, "y": y, "z": z}, "orientation": turn}


def collision_object(name: str, frame: str, operation: int = 0) -> dict[str, Any]:
    corners = [(0, 0, 0), (0.1, 0, 0), (0, 0.1, 0), (0, 0, 0.1)]
    vertices = [dict(zip("xyz", corner, strict=True)) for corner in corners]
    return {
        "header": header(frame),
        "pose": pose(0.5, 0.1, 0.2),
        "id": name,
        "type": {"key": "a", "db": "b"},
        "primitives": [{"type": 1, "dimensions": [0.1, 0.2, 0.3]}],
        "primitive_poses": [pose(0.1, 0, 0)],
        "meshes": [
            {"triangles": [{"vertex_indices": [0, 1, 2]}], "vertices": vertices}
        ],
        "mesh_poses": [pose(0, 0.4, 0)],
        "subframe_names": ["handle"],
        "subframe_poses": [pose(0, 0, 0.3)],
        "operation": operation,
    }


def without_mesh(item: dict[str, Any]) -> dict[str, Any]:
    """Return an object without its mesh, whose hull takes long."""
    return {key: value for key, value in item.items() if not key.startswith("mesh")}


def robot_state(name: str) -> dict[str, Any]:
    return {
        "joint_state": {
            "header": header("base"),
            "name": ["a", "b"],
            "position": [0.1, 0.2],
            "velocity": [0.3, 0.4],
            "effort": [1, 2],
        },
        "attached_collision_objects": [
            {
                "link_name": "hand",
                "object": without_mesh(collision_object(name, "hand")),
                "touch_links": ["finger"],
                "detach_posture": {"joint_names": ["finger"]},
                "weight": 0.5,
            }
        ],
        "is_diff": True,
    }


def octomap() -> dict[str, Any]:
    # eight inner nodes down to an occupied leaf, child 7 of each
    tree = {"header": header(""), "binary": True, "id": "OcTree", "resolution": 1e-3}
    data = [0, -64] * 8 + [0, -128]
    return {
        "header": header("panda_link0"),
        "origin": pose(40, 40, 40),
        "octomap": tree | {"data": data},
    }


def document() -> dict[str, Any]:
    """Return a scene with its request, whose elements are all used or listed."""
    state = robot_state("cup")
    state["multi_dof_joint_state"] = {
        "header": header("map"),
        "joint_names": ["virtual_joint"],
        "transforms": [
            {
                "translation": {"x": 0.1, "y": 0, "z": 0},
                "rotation": {"x": 0, "y": 0, "z": 0, "w": 1},
            }
        ],
        "twist": [{"linear": {"x": 1, "y": 0, "z": 0}}],
        "wrench": [{"force": {"x": 1, "y": 0, "z": 0}}],
    }
    present = robot_state("tool")
    return {
        "name": "kitchen",
        "robot_state": present,
        "robot_model_name": "panda",
        "fixed_frame_transforms": [
            {
                "header": header("world"),
                "child_frame_id": "cabinet",
                "transform": {
                    "translation": {"x": 0.3, "y": 0, "z": 0},
                    "rotation": {"x": 0, "y": 0, "z": 0.6, "w": 0.8},
                },
            }
        ],
        "allowed_collision_matrix": {
            "entry_names": ["hand", "finger"],
            "entry_values": [{"enabled": [False, True]}, {"enabled": [True, False]}],
        },
        "link_padding": [{"link_name": "hand", "padding": 0}],
        "link_scale": [{"link_name": "hand", "scale": 1}],
        "object_colors": [{"id": "box", "color": {"r": 1, "g": 0, "b": 0, "a": 1}}],
        "world": {
            "collision_objects": [
                collision_object("box", "cabinet"),
                *(
                    without_mesh(collision_object(name, f"{parent}/handle"))
                    for name, parent in (
                        ("lid", "box"),
                        ("flag", "cup"),
                        ("bit", "tool"),
                    )
                ),
            ],
            "octomap": octomap(),
        },
        "start_state": state,
        "goal_constraints": [
            {
                "name": "first",
                "joint_constraints": [
                    {
                        "joint_name": "a",
                        "position": 0.5,
                        "tolerance_above": 0.1,
                        "tolerance_below": 0.2,
                        "weight": 1,
                    }
                ],
            },
            {
                "name": "second",
                "position_constraints": [
                    {
                        "header": header("map"),
                        "link_name": "hand",
                        "constraint_region": {
                            "primitives": [{"type": 2, "dimensions": [0.1]}],
                            "primitive_poses": [pose(0.4, 0, 0.5)],
                        },
                        "weight": 1,
                    }
                ],
                "orientation_constraints": [
                    {
                        "header": header("map"),
                        "orientation": {"x": 0, "y": 0, "z": 0.6, "w": 0.8},
                        "link_name": "hand",
                        "absolute_x_axis_tolerance": 0.1,
                        "absolute_y_axis_tolerance": 0.2,
                        "absolute_z_axis_tolerance": 0.25,
                        "parameterization": 0,
                        "weight": 1,
                    }
                ],
            },
        ],
        "max_velocity_scaling_factor": 0.5,
        "max_acceleration_scaling_factor": 0.5,
        "workspace_parameters": {"min_corner": {"x": -1, "y": -1, "z": -1}},
        "group_name": "arm",
        "planner_id": "RRTConnect",
        "pipeline_id": "ompl",
        "num_planning_attempts": 3,
        "allowed_planning_time": 5.0,
        "cartesian_speed_end_effector_link": "hand",
        "cartesian_speed_limited_link": "hand",
        "reference_trajectories": [{"header": header("")}],
    }
