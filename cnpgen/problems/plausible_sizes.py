"""Plausible sizes of robots and obstacles: lengths far outside of their ranges are probably in another unit."""

from collections.abc import Iterator

import numpy as np

from cnpgen.errors import RecipeError
from cnpgen.problems.problem import Problem
from cnpgen.robots.obstacle import Obstacle
from cnpgen.robots.robot import Robot
from cnpgen.robots.scene import PARKED_POSITION_M
from cnpgen.robots.urdf import urdf_tree

MIN_REACH_M, MAX_REACH_M = 0.01, 100.0  # of an arm, along its joints
MAX_LINK_RATIO = 20.0  # size of a link / reach; pedestals and mobile bases may be larger than arms
MIN_LINK_RATIO = 0.02  # size of the largest moving link / reach
MIN_MESH_M = 1e-3  # size of a link with a mesh
MIN_MASS_KG = 0.01  # of bodies whose inertia is checked; lighter ones have placeholders
MIN_ARM_KG = 0.1  # that a payload is compared with
MAX_CENTER_RATIO = 3.0  # distance of a center of mass from its joint, and radius of gyration / reach
MAX_PAYLOAD_RATIO = 10.0  # mass of a payload / mass of the arm
MAX_OBSTACLE_RATIO = 10.0  # distance of an obstacle / reach


def check_plausible_sizes(robot: Robot, problem: Problem) -> None:
    """Raise an error for lengths and masses that are probably in another unit.

    Raises:
        RecipeError: A value is far outside of its range; the error lists all of them.
    """
    mistakes = [f"{robot.urdf}: {mistake}" for mistake in _robot_mistakes(robot, problem)]
    if not mistakes:
        mistakes = [f"{problem.path}: {mistake}" for mistake in _problem_mistakes(robot, problem)]
    if mistakes:
        raise RecipeError(mistakes)


def _robot_mistakes(robot: Robot, problem: Problem) -> Iterator[str]:
    """Yield error messages for lengths of the URDF."""
    reach = robot.reach
    if not MIN_REACH_M <= reach <= MAX_REACH_M:
        remedy = "lengths of a URDF are in m, not in mm: convert the <origin xyz> of its joints"
        yield f"the arm is {reach:.3g} m long, expected {MIN_REACH_M:g} to {MAX_REACH_M:g} m; {remedy}"
        return
    joints = robot.chain.joints if problem.payload is None else robot.chain.joints[:-1]
    for name, joint in zip(robot.joint_names, joints, strict=False):
        if joint.mass < MIN_MASS_KG:
            continue
        center, gyration = np.linalg.norm(joint.com), np.sqrt(max(np.trace(joint.inertia), 0.0) / (2 * joint.mass))
        if max(center, gyration) > MAX_CENTER_RATIO * reach:
            text = f"the center of mass is {center:.3g} m away, the radius of gyration {gyration:.3g} m"
            yield f"{name}: {text}, the arm {reach:.3g} m long; an <inertial> is in kg, m and kg m^2, not in mm or g"
    yield from _link_mistakes(robot, reach)


def _link_mistakes(robot: Robot, reach: float) -> Iterator[str]:
    """Yield error messages for sizes of links."""
    if robot.shape is None:
        return
    sizes: dict[str, float] = {}
    for part in robot.shape.convex_parts:
        size = float(np.ptp(part.vertices, axis=0).max()) + 2 * part.radius
        sizes[part.link] = max(size, sizes.get(part.link, 0.0))
    large = {link: size for link, size in sizes.items() if size > MAX_LINK_RATIO * reach}
    small = {link: size for link, size in sizes.items() if size < MIN_MESH_M}
    for link, size in large.items():
        remedy = 'write scale="0.001 0.001 0.001" in the <mesh> of a file in mm'
        yield f"link {link!r}: its collision geometry is {size:.3g} m large, the arm {reach:.3g} m; {remedy}"
    remedy = "remove the scale of its <mesh> elements, or correct it"
    for link in _mesh_links(robot.urdf_text) & small.keys() if small else ():  # spheres and boxes may be placeholders
        text = f"its collision geometry is {small[link]:.3g} m large, expected {MIN_MESH_M:g} m or more"
        yield f"link {link!r}: {text}; {remedy}"
    largest = max(size for link, size in sizes.items() if robot.shape.joints[link])
    if largest < MIN_LINK_RATIO * reach:
        yield f"no moving link is larger than {largest:.3g} m, where the arm is {reach:.3g} m long; {remedy}"


def _mesh_links(urdf: str) -> set[str]:
    links = urdf_tree(urdf).findall("link")
    return {link.get("name", "") for link in links if link.find("collision/geometry/mesh") is not None}


def _problem_mistakes(robot: Robot, problem: Problem) -> Iterator[str]:
    """Yield error messages for lengths and masses of the problem."""
    reach, payload = robot.reach, problem.payload
    mass = sum(joint.mass for joint in robot.chain.joints)
    if payload is not None:
        arm, distance = mass - payload.mass, float(np.linalg.norm(payload.centre))
        gyration = float(np.sqrt(np.trace(payload.inertia_matrix) / (2 * payload.mass)))
        if arm > MIN_ARM_KG and payload.mass > MAX_PAYLOAD_RATIO * arm:
            yield f"payload.mass: is {payload.mass:g} kg, where the arm has {arm:.3g} kg: masses are in kg, not in g"
        for key, length in {"centre": distance, "inertia": gyration}.items():
            if length > MAX_CENTER_RATIO * reach:
                text = f"a length of {length:.3g} m from it, where the arm is {reach:.3g} m long"
                yield f"payload.{key}: {text}; lengths are in m and inertias in kg m^2"
    for index, obstacle in enumerate(problem.obstacle, 1):
        distance = _distance(obstacle)
        if distance > MAX_OBSTACLE_RATIO * reach and obstacle.position != PARKED_POSITION_M:
            text = f"{obstacle.name!r} is {distance:.3g} m away, where the arm is {reach:.3g} m long"
            yield f"obstacle {index}: {text}: check its unit"


def _distance(obstacle: Obstacle) -> float:
    """Return a lower bound of the distance of an obstacle from the origin of the world [m]."""
    if obstacle.position is not None and not obstacle.mesh:
        lengths = [*(obstacle.size or ()), obstacle.radius or 0.0, obstacle.radius or 0.0, obstacle.length or 0.0]
        return float(np.linalg.norm(obstacle.position) - sum(lengths))
    sides = [max(each.low, -each.high, 0.0) for each in (obstacle.x, obstacle.y) if each is not None]
    return float(np.linalg.norm(sides))
