"""Furniture in a frame of its own, and objects that stand on it without overlap."""

from __future__ import annotations

import math
from dataclasses import dataclass, field

import numpy as np
from numpy.random import Generator

from cnpgen.pipelines.scene_family import Grasp, Layout, SceneFamily, uniform, whole
from cnpgen.robots.obstacle import Obstacle
from cnpgen.schema.keys import Range

Point = tuple[float, float, float]
Area = tuple[float, float, float, float]
"""The lowest and highest x, and the lowest and highest y, in the furniture's frame [m]."""

MAX_PLACEMENTS = 60  # attempts to place an object
OBJECT_GAP_M = 0.02  # between the circles round the bases of two objects
GRASP_GAP_M = 0.015  # between an object and the tip


@dataclass
class Furniture:
    """Obstacles and grasps that are placed in a frame: x away from the base of the robot, z up.

    The frame has an origin [m] and a yaw about z [rad] in the frame of the robot's
    base.
    """

    origin: Point
    yaw: float
    obstacles: list[Obstacle] = field(default_factory=list)
    grasps: list[Grasp] = field(default_factory=list)

    def point(self, local: Point) -> Point:
        """Return a point in the frame of the robot's base [m]."""
        x, y, z = local
        # Rotation about z by the yaw, then the shift to the origin.
        cos = math.cos(self.yaw)
        sin = math.sin(self.yaw)
        return (
            self.origin[0] + cos * x - sin * y,
            self.origin[1] + sin * x + cos * y,
            self.origin[2] + z,
        )

    def box(self, name: str, center: Point, size: Point, turn: float = 0.0) -> None:
        """Add a box, whose edges are rotated about z by ``turn`` [rad]."""
        yaw = self.yaw + turn
        self.obstacles.append(
            Obstacle(
                name=name,
                kind="box",
                position=self.point(center),
                size=size,
                rotation=(0.0, 0.0, yaw),
            )
        )

    def cylinder(self, name: str, center: Point, radius: float, height: float) -> None:
        """Add an upright cylinder."""
        self.obstacles.append(
            Obstacle(
                name=name,
                kind="cylinder",
                position=self.point(center),
                radius=radius,
                length=height,
            )
        )

    def grasp(self, position: Point, approach: Point, tilt: float = 0.3) -> None:
        """Add a grasp; the approach is normalized."""
        cos = math.cos(self.yaw)
        sin = math.sin(self.yaw)
        length = math.hypot(*approach)
        x = approach[0] / length
        y = approach[1] / length
        z = approach[2] / length
        direction = np.array([cos * x - sin * y, sin * x + cos * y, z])
        self.grasps.append(Grasp(np.array(self.point(position)), direction, tilt))

    def layout(self, *others: Furniture) -> Layout:
        """Return the obstacles and grasps of this and other furniture."""
        parts = (self, *others)
        obstacles = tuple(obstacle for part in parts for obstacle in part.obstacles)
        return Layout(
            obstacles, tuple(grasp for part in parts for grasp in part.grasps)
        )


def place_furniture(
    random: Generator, family: SceneFamily, z: float = 0.0
) -> Furniture:
    """Draw the frame of furniture: its origin is the center of the front at the height z [m]."""
    distance = uniform(random, family.distance)
    bearing = uniform(random, family.bearing)
    yaw = bearing + uniform(random, family.turn)
    return Furniture(
        (distance * math.cos(bearing), distance * math.sin(bearing), z), yaw
    )


Objects = tuple[Range, Range, Range]
"""Number of objects; widths, of boxes or diameters of cylinders [m].

And heights [m].
"""


def _free_place(
    random: Generator, area: Area, radius: float, circles: list[Point]
) -> tuple[float, float] | None:
    """Draw a position at which a circle is apart from the others (x, y, radius); None without one."""
    for _ in range(MAX_PLACEMENTS):
        x = area[0] + (area[1] - area[0]) * random.random()
        y = area[2] + (area[3] - area[2]) * random.random()
        if all(
            math.hypot(x - u, y - v) > radius + r + OBJECT_GAP_M for u, v, r in circles
        ):
            return x, y
    return None


def place_objects(
    random: Generator,
    furniture: Furniture,
    area: Area,
    z: float,
    objects: Objects,
    *,
    from_above: bool,
    prefix: str = "object",
) -> None:
    """Place boxes and cylinders on a rectangle without overlap, with grasps at each, from above or along x.

    The area is at the height z [m].
    """
    circles: list[Point] = []
    count, widths, heights = objects
    for index in range(whole(random, count)):
        a, b, height = (uniform(random, size) for size in (widths, widths, heights))
        is_box = random.random() < 0.5
        # The circle round the base, whatever the turn of a box.
        radius = math.hypot(a, b) / 2 if is_box else a / 2
        place = _free_place(random, area, radius, circles)
        if place is None:
            # An object without a free place is left out.
            continue
        x, y = place
        circles.append((x, y, radius))
        name = f"{prefix} {index + 1}"
        center = (x, y, z + height / 2)
        if is_box:
            turn = random.uniform(-math.pi, math.pi)
            furniture.box(name, center, (a, b, height), turn)
        else:
            furniture.cylinder(name, center, a / 2, height)
        if from_above:
            # The tip is above the object, and approaches downward.
            furniture.grasp((x, y, z + height + GRASP_GAP_M), (0, 0, -1))
        else:
            # At half the height of the object, but at least 6 cm above its base.
            furniture.grasp(
                (x - radius - GRASP_GAP_M, y, z + max(height / 2, 0.06)), (1, 0, 0)
            )
