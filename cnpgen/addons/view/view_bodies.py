"""Bodies of a robot in a page: its visual meshes if they are found, else its collision geometry, as triangles."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from itertools import product
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import numpy as np
from numpy.typing import NDArray

from cnpgen.arrays import Array
from cnpgen.documents import JsonObject
from cnpgen.errors import RecipeError
from cnpgen.problems.problem import Problem
from cnpgen.robots.chain import frame_of
from cnpgen.robots.robot import Robot
from cnpgen.robots.shape.convex_part import convex_part_of, origin_of
from cnpgen.robots.shape.hull import inflated, outward_triangles
from cnpgen.robots.shape.inline import read_mesh, scale_of, sides_of
from cnpgen.robots.shape.mesh_files import find_named_file
from cnpgen.robots.urdf import urdf_tree

# Radius of an arm without link geometry, if no constraint gives one.

LINE_ARM_RADIUS_M = 0.04
MAX_TRIANGLES = 400_000  # of all visual meshes; larger pages open slowly
PROBE = 0.5  # joint displacement from which the axis of a joint is computed


@dataclass(frozen=True)
class Body:
    """Triangles that a joint moves."""

    name: str
    joint: int  # index from 1; 0 for a fixed body
    corners: Array  # in the frame of the joint [m], shape (V, 3)
    triangles: NDArray[np.integer[Any]]  # numbers of their corners, shape (F, 3)
    smooth: bool = False  # whether the surface is drawn without edges


def robot_bodies(
    problem: Problem, robot: Robot, *, with_meshes: bool = True
) -> tuple[list[Body], str]:
    """Return the bodies of a robot, and their kind: "meshes", "convex parts" or "line".

    ``with_meshes`` reads the visual meshes that the URDF names; it is false for
    untrusted files.
    """
    try:
        visual = list(_visual_bodies(problem, robot)) if with_meshes else []
    except (
        RecipeError,
        ValueError,
    ):
        # A mesh is missing or unreadable; the verdict does not need it.
        visual = []
    if visual and sum(len(body.triangles) for body in visual) <= MAX_TRIANGLES:
        return visual, "meshes"
    if robot.shape is not None:
        parts = robot.shape.convex_parts
        joints = robot.shape.joints
        return [
            wrapped(each.link, joints[each.link], each.vertices, each.radius)
            for each in parts
        ], "convex parts"
    return list(_line(robot, problem.arm_radius or LINE_ARM_RADIUS_M)), "line"


def capsule_bodies(robot: Robot) -> list[Body]:
    """Return the capsules round the links; none of a robot without a shape."""
    found = robot.shape.capsules if robot.shape else ()
    joints = robot.shape.joints if robot.shape else {}
    ends = [np.array([each.first, each.second]) for each in found]
    pairs = zip(found, ends, strict=True)
    return [
        wrapped(each.link, joints[each.link], points, each.radius, smooth=True)
        for each, points in pairs
    ]


def planned_joints(robot: Robot) -> tuple[list[JsonObject], list[float]]:
    """Return the planned joints and the placement of the tip, by columns, from which the page computes poses."""
    import pinocchio as pin

    model = robot.model
    data = robot.model.createData()
    pin.forwardKinematics(model, data, np.full(robot.n, PROBE))
    joints = []
    for index, name in enumerate(robot.joint_names):
        placement = model.jointPlacements[index + 1]
        # Linear, then angular.
        # The logarithm of the motion from its placement, per unit of displacement, is
        # the twist of a joint.
        twist = pin.log6(placement.actInv(data.liMi[index + 1])).vector / PROBE
        joints.append(
            {
                "name": name,
                "placement": _by_columns(placement.homogeneous),
                "twist": twist.round(12).tolist(),
                "low": float(robot.position_lower[index]),
                "high": float(robot.position_upper[index]),
            }
        )
    return joints, _by_columns(model.frames[robot.tip_frame].placement.homogeneous)


def _by_columns(matrix: NDArray[np.float64]) -> list[float]:
    """Return a matrix by columns, as three.js reads it."""
    return [float(value) for value in matrix.T.ravel()]


def wrapped(
    name: str, joint: int, corners: Array, radius: float, *, smooth: bool = False
) -> Body:
    """Return the hull of points [m], shape (V, 3), inflated by a radius [m], as triangles that face outwards."""
    # The hull of balls around all points is the inflated hull.
    points = inflated(corners, radius)
    used, numbers = np.unique(outward_triangles(points), return_inverse=True)
    return Body(name, joint, points[used], numbers.reshape(-1, 3), smooth)


def tube(name: str, points: Array, radius: float) -> Body:
    """Return a tube through points [m], shape (K, 3), as triangles."""
    along = np.gradient(points, axis=0)
    along /= np.maximum(np.linalg.norm(along, axis=1, keepdims=True), 1e-12)
    across = np.cross(along, [0.0, 0.0, 1.0])
    level = np.linalg.norm(across, axis=1, keepdims=True)
    # A vertical tangent has no horizontal normal, so x takes its place.
    across = np.where(level > 1e-3, across / np.maximum(level, 1e-12), [1.0, 0.0, 0.0])
    angles = np.arange(6) * np.pi / 3
    ring = (
        np.cos(angles)[:, None] * across[:, None]
        + np.sin(angles)[:, None] * np.cross(along, across)[:, None]
    )
    # Two triangles fill each side between two rings of six corners.
    first = [
        (6 * k + i, 6 * k + (i + 1) % 6, 6 * k + 6 + i)
        for k, i in product(range(len(points) - 1), range(6))
    ]
    second = [(b, b + 6, a + 6) for a, b, _ in first]
    corners = (points[:, None] + radius * ring).reshape(-1, 3)
    return Body(name, 0, corners, np.array(first + second).reshape(-1, 3), smooth=True)


def extent(bodies: Sequence[Body], poses: Array) -> tuple[Array, Array]:
    """Return the corners of the box around bodies [m], shape (3,), at transposed poses, shape (K, joints, 4, 4)."""
    parts = [
        body.corners @ pose[body.joint, :3, :3] + pose[body.joint, 3, :3]
        for body in bodies
        for pose in poses
    ]
    corners = np.concatenate(parts)
    return corners.min(axis=0), corners.max(axis=0)


def _visual_bodies(problem: Problem, robot: Robot) -> Iterator[Body]:
    """Read the visual elements of the URDF."""
    packages = [problem.path.parent / each for each in problem.robot.packages]
    for link in urdf_tree(robot.urdf_text).findall("link"):
        name = link.get("name", "")
        frame = robot.model.frames[frame_of(robot.model, name)]
        for element in link.findall("visual"):
            corners, triangles = _visual(name, element, robot.urdf, packages)
            placed = corners @ frame.placement.rotation.T + frame.placement.translation
            yield Body(name, int(frame.parentJoint), placed, triangles, smooth=True)


def _visual(
    link: str, element: ElementTree.Element, urdf: Path, packages: Sequence[Path]
) -> tuple[Array, NDArray[np.integer[Any]]]:
    """Return corners in the link's frame [m], and triangles, of one visual element."""
    mesh = element.find("geometry/mesh")
    if mesh is None:
        piece = convex_part_of(link, element)
        body = wrapped(link, 0, piece.vertices, piece.radius)
        return body.corners, body.triangles
    rotation, translation = origin_of(element.find("origin"))
    points, loaded = read_mesh(
        find_named_file(mesh.get("filename", ""), urdf, packages), scale_of(mesh)
    )
    return points @ rotation.T + translation, sides_of(loaded)


def _line(robot: Robot, radius: float) -> Iterator[Body]:
    """Return the segments of an arm that is a line through its joints' origins, each moved by the joint at its end."""
    import pinocchio as pin

    model = robot.model
    data = robot.model.createData()
    pin.framesForwardKinematics(model, data, pin.neutral(model))
    origins = [data.oMi[i].translation for i in range(1, model.njoints)]
    origins.append(data.oMf[robot.tip_frame].translation)
    foot = np.array([np.zeros(3), origins[robot.capsule_axes[0][0]]])
    if np.ptp(foot, axis=0).any():
        yield wrapped("foot", 0, foot, radius, smooth=True)
    for a, b in robot.capsule_axes:
        ends = np.array(
            [data.oMi[b].actInv(origins[a]), data.oMi[b].actInv(origins[b])]
        )
        yield wrapped(f"segment {a}-{b}", b, ends, radius, smooth=True)
