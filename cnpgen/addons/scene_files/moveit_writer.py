"""MoveIt planning scenes and motion plan requests in YAML, written as MotionBenchMaker writes them."""

from __future__ import annotations

from collections.abc import Sequence

from cnpgen.problems.scenes.quaternions import quaternion_of
from cnpgen.problems.scenes.scene_problem import SceneError, SceneProblem
from cnpgen.problems.scenes.scene_request import NO_REQUEST
from cnpgen.robots.obstacle import Obstacle
from cnpgen.robots.shape.convex_part import turned
from cnpgen.robots.shape.hull import outward_triangles
from cnpgen.robots.shape.inline import corners_of

_SHAPES = ("mesh", "box", "sphere", "cylinder")


def moveit_texts(scene: SceneProblem, joints: Sequence[str]) -> tuple[str, str]:
    """Return a scene and its request, with these names of joints, as YAML.

    SceneError without a primitive or a goal.
    """
    lines = [
        f"name: {_text(scene.name)}",
        "world:",
        "  collision_objects:" + ("" if scene.obstacles else " []"),
    ]
    for obstacle in scene.obstacles:
        if obstacle.kind not in _SHAPES or obstacle.position is None:
            raise SceneError(
                f"{scene.place}: obstacle {obstacle.name!r} is a {obstacle.kind}, MoveIt has no such shape"
            )
        lines += [f"    - id: {_text(obstacle.name)}", *_shape(obstacle)]
        w, x, y, z = quaternion_of(turned(*obstacle.rotation)).tolist()
        lines += [
            f"        - position: {list(obstacle.position)}",
            f"          orientation: {[x, y, z, w]}",
        ]
    return "\n".join(lines) + "\n", _request(scene, joints)


def _shape(obstacle: Obstacle) -> list[str]:
    """Return the lines of the shape of an obstacle, up to its pose."""
    if obstacle.kind == "mesh":
        corners = corners_of(obstacle.mesh)
        faces = [
            f"            - vertex_indices: {triangle}"
            for triangle in outward_triangles(corners).tolist()
        ]
        vertices = [
            f"            - {dict(zip('xyz', corner, strict=True))}"
            for corner in corners.tolist()
        ]
        return [
            "      meshes:",
            "        - triangles:",
            *faces,
            "          vertices:",
            *vertices,
            "      mesh_poses:",
        ]
    lengths = obstacle.form.lengths()
    # The height of a cylinder is before its radius.
    dimensions = lengths if obstacle.kind == "box" else lengths[::-1]
    lines = [
        "      primitives:",
        f"        - type: {obstacle.kind}",
        f"          dimensions: {dimensions}",
    ]
    return [*lines, "      primitive_poses:"]


def _request(scene: SceneProblem, joints: Sequence[str]) -> str:
    if not len(scene.goal_q):
        raise SceneError(
            f"{scene.place} has no goal state, and goal poses are not written"
        )
    names = [_text(name) for name in joints]
    lines = ["start_state:", "  joint_state:"]
    lines += [
        f"    name: [{', '.join(names)}]",
        f"    position: {scene.start_q.tolist()}",
        "goal_constraints:",
    ]
    for goal in scene.goal_q:
        lines.append("  - joint_constraints:")
        for name, position in zip(names, goal.tolist(), strict=True):
            lines += [
                f"      - joint_name: {name}",
                f"        position: {position!r}",
                "        weight: 1.0",
            ]
    return "\n".join(lines) + "\n"


def _text(name: str) -> str:
    """Quote a text for YAML."""
    return "'" + name.replace("'", "''") + "'"


def check_plain(scene: SceneProblem) -> None:
    """Raise SceneError if a scene has demands that the writers of scene files would lose."""
    request = scene.request
    if (
        request.changes_problem
        or any(request.obstacle_frames)
        or any(request.obstacle_touch_links)
        or request.goal_frame
        or scene.other_goal_poses
        or request.start_dq is not NO_REQUEST.start_dq
        or request.goal_below is not NO_REQUEST.goal_below
    ):
        raise SceneError(
            f"{scene.place} has a start velocity, tolerances, frames, alternative poses, scaling factors, attached"
            " objects or path constraints, which are not written"
        )
