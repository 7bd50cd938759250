"""Texts of scene files as MoveIt and robometrics write them."""

SCENE = """\
name: shelf
robot_model_name: panda
fixed_frame_transforms:
  - child_frame_id: base_link
    transform: {translation: [0, 0, 0], rotation: [0, 0, 0, 1]}
world:
  collision_objects:
    - header: {frame_id: base_link}
      id: Can1
      primitives:
        - type: cylinder
          dimensions: [0.14, 0.03]
      primitive_poses:
        - position: [0.9, 0, 1.08]
          orientation: [0, 0, 0, 1]
    - header:
        frame_id: base_link
      id: shelf
      pose: {position: {x: 0.5, y: 0, z: 0.25}, orientation: {x: 0, y: 0, z: 0.7071067811865476, w: 0.7071067811865476}}
      primitives:
        - {type: 1, dimensions: [1.2, 1, 4e-2]}
        - {type: SPHERE, dimensions: [0.1]}
      primitive_poses:
        - {position: [0.25, 0, 0], orientation: [0, 0, 0.3826834323650898, 0.9238795325112867]}
        - {position: [0, 0.5, 0.3], orientation: [0, 0, 0, 1]}
"""
REQUEST = """\
group_name: panda_arm
start_state:
  joint_state:
    name: [panda_finger_joint1, panda_joint1, panda_joint2]
    position: [0.035, 0.1, -0.2]
goal_constraints:
  - joint_constraints:
      - {joint_name: panda_joint2, position: 0.7, tolerance_above: 0.0001, weight: 1}
      - {joint_name: panda_joint1, position: 1.5e0}
      - {joint_name: panda_finger_joint1, position: 0.035}
  - position_constraints:
      - link_name: panda_hand
        target_point_offset: {x: 0, y: 0, z: 0}
        constraint_region:
          primitives: [{type: 2, dimensions: [0.002]}]
          primitive_poses: [{position: [0.4, 0.1, 0.6], orientation: [0, 0, 0, 1]}]
    orientation_constraints:
      - link_name: panda_hand
        orientation: {x: 1, y: 0, z: 0, w: 0}
        absolute_x_axis_tolerance: 0.05
"""
ROBOMETRICS = """\
bookshelf_small_panda:
- collision_buffer_ik: 0
  goal_ik:
  - [0.1, 0.2, 0.3, -2.0, 0.5, 1.6, 0.7]
  - [0.4, 0.2, 0.3, -2.0, 0.5, 1.6, 0.7]
  goal_pose:
    frame: panda_hand
    position_xyz: [0.1, -0.56, 0.35]
    quaternion_wxyz: [0.5, 0.5, 0.5, 0.5]
  obstacles:
    cuboid:
      cube0:
        dims: [1.2, 1.0, 0.04]
        pose: [0.6, -1.0, 0.2, 0.8521017127688338, 0.0, 0.0, -0.5233762232815127]
    cylinder:
      cylinder0: {height: 0.14, radius: 0.01, pose: [0.25, -1.07, 0.3, 1, 0, 0, 0]}
  start: [0.0, -0.785, 0.0, -2.356, 0.0, 1.571, 0.785]
  world_frame: panda_link0
"""
