"""Elements of MoveIt's messages that cannot change the answer: harmless ones, and those for other software."""

from cnpgen.store.files.accounted import UnusedElements

HARMLESS = {
    ".name": "name of the scene",
    ".object_colors": "colors",
    "header.stamp": "time of the message",
    "header.seq": "number of the message",
    "joint_state.header": "joint positions have no frame",
    "multi_dof_joint_state.joint_names": "name of the joint that places the base",
    ".robot_state.multi_dof_joint_state.header": "it has no transforms",
    "path_constraints.name": "name of constraints",
    "octomap.octomap.header": "the frame is that of the message around it",
    "collision_objects.type": "key of a database of objects",
    "object.type": "key of a database of objects",
    "goal_constraints.name": "name of a goal",
    ".robot_state.is_diff": "the file has the whole scene",
    "meshes.triangles": "the convex hull of the vertices counts",
    "constraint_region.primitive_poses.orientation": "the ball in the region counts",
    "joint_constraints.weight": "every constraint must be met",
    "position_constraints.weight": "every constraint must be met",
    "orientation_constraints.weight": "every constraint must be met",
}
UNUSED = {
    ".allowed_collision_matrix": "pairs of links are those of the robot's problem, and objects of the world do not move",
    ".group_name": "the problem of --robot names the planned joints",
    ".pipeline_id": "MoveIt's choice of a planner",
    ".planner_id": "MoveIt's choice of a planner",
    ".num_planning_attempts": "effort of MoveIt's planner",
    ".allowed_planning_time": "effort of MoveIt's planner",
    ".workspace_parameters": "bounds of the base, which is fixed",
    ".reference_trajectories": "hints for MoveIt's planner",
    ".cartesian_speed_end_effector_link": "max_cartesian_speed is 0",
    ".cartesian_speed_limited_link": "max_cartesian_speed is 0",
    ".robot_state.joint_state": "start_state replaces it",
    "joint_state.effort": "torques follow from the motion",
    "multi_dof_joint_state.twist": "the base is fixed",
    "multi_dof_joint_state.wrench": "torques follow from the motion",
    "attached_collision_objects.detach_posture": "nothing is detached",
}
UNUSED_ELEMENTS = UnusedElements(HARMLESS, UNUSED)
