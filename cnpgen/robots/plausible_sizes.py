"""Plausible sizes of robots: lengths far outside of their ranges are probably in millimetres."""

from collections.abc import Iterator

import numpy as np

from cnpgen.errors import RecipeError
from cnpgen.robots.robot import Robot

MIN_REACH_M, MAX_REACH_M = 0.01, 100.0  # of an arm, along its joints
MAX_LINK_RATIO = 20.0  # size of a link / reach; pedestals and mobile bases may be larger than arms
MIN_LINK_RATIO = 0.02  # size of the largest moving link / reach
MIN_LINK_M = 1e-3  # size of a link with collision geometry
MIN_MASS_KG = 0.01  # of bodies whose inertia is checked; lighter ones have placeholders


def check_plausible_sizes(robot: Robot) -> None:
    """Raise an error for an arm or a link that is so small or large that its lengths are probably in another unit.

    Raises:
        RecipeError: A length is far outside of its range; the error lists all of them.
    """
    if mistakes := list(_mistakes(robot)):
        raise RecipeError([f"{robot.urdf}: {mistake}" for mistake in mistakes])


def _mistakes(robot: Robot) -> Iterator[str]:
    reach = robot.reach
    if not MIN_REACH_M <= reach <= MAX_REACH_M:
        remedy = "lengths of a URDF are in m, not in mm: convert the <origin xyz> of its joints"
        yield f"the arm is {reach:.3g} m long, expected {MIN_REACH_M:g} to {MAX_REACH_M:g} m; {remedy}"
        return
    for name, joint in zip(robot.joint_names, robot.chain.joints, strict=True):
        if joint.mass < MIN_MASS_KG:
            continue
        center, gyration = np.linalg.norm(joint.com), np.sqrt(max(np.trace(joint.inertia), 0.0) / (2 * joint.mass))
        if max(center, gyration) > MAX_LINK_RATIO * reach:
            text = f"the center of mass is {center:.3g} m away, the radius of gyration {gyration:.3g} m"
            yield f"{name}: {text}, the arm {reach:.3g} m long; an <inertial> is in kg, m and kg m^2, not in mm or g"
    if robot.shape is None:
        return
    sizes: dict[str, float] = {}
    for part in robot.shape.convex_parts:
        size = float(np.ptp(part.vertices, axis=0).max()) + 2 * part.radius
        sizes[part.link] = max(size, sizes.get(part.link, 0.0))
    for link, size in sizes.items():
        if size > MAX_LINK_RATIO * reach:
            remedy = 'write scale="0.001 0.001 0.001" in the <mesh> of a file in mm'
            yield f"link {link!r}: its collision geometry is {size:.3g} m large, the arm {reach:.3g} m; {remedy}"
        elif size < MIN_LINK_M:
            remedy = "remove the scale of its <mesh> elements, or correct it"
            text = f"its collision geometry is {size:.3g} m large, expected {MIN_LINK_M:g} m or more"
            yield f"link {link!r}: {text}; {remedy}"
    largest = max(size for link, size in sizes.items() if robot.shape.joints[link])
    if largest < MIN_LINK_RATIO * reach:
        remedy = "remove the scale of its <mesh> elements, or correct it"
        yield f"no moving link is larger than {largest:.3g} m, where the arm is {reach:.3g} m long; {remedy}"
