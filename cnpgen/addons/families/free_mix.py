"""Family of free obstacles: boxes, spheres and cylinders at random poses around the robot."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.random import Generator

from cnpgen.pipelines.scene_family import (
    Grasp,
    Layout,
    SceneFamily,
    angle,
    length,
    uniform,
    whole,
)
from cnpgen.robots.obstacle import Obstacle
from cnpgen.schema.keys import Range, field

# Of an obstacle's center from the axis of the base, plus its radius.

MIN_BASE_DISTANCE_M = 0.3


@dataclass(frozen=True, kw_only=True)
class FreeMix(SceneFamily):
    """Boxes, spheres and cylinders at random poses around the robot."""

    count: Range = field("number of obstacles", default=Range(6, 12), low=1, high=60)
    spheres: float = field("share of spheres", default=0.0, low=0.0, high=1.0)
    cylinders: float = field("share of cylinders", default=0.4, low=0.0, high=1.0)
    size: Range = length(
        "edge lengths of boxes, diameters and lengths", Range(0.06, 0.35), low=0.01
    )
    radius: Range = length(
        "distance of the centers from the axis of the base", Range(0.35, 0.85)
    )
    height: Range = length("heights of the centers", Range(0.05, 0.9))
    bearing: Range = angle("directions of the centers from the base", Range(-2.2, 2.2))

    def draw(self, random: Generator) -> Layout:
        """Draw the obstacles, and grasps between them in all directions."""
        obstacles = [
            self._obstacle(random, index) for index in range(whole(random, self.count))
        ]
        grasps = []
        for _ in range(10):
            bearing = uniform(random, self.bearing)
            radius = random.uniform(0.35, 0.65)
            position = np.array(
                [
                    radius * math.cos(bearing),
                    radius * math.sin(bearing),
                    random.uniform(0.15, 0.7),
                ]
            )
            approach = np.array(
                [math.cos(bearing), math.sin(bearing), random.uniform(-2.0, 0.3)]
            )
            grasps.append(
                Grasp(position, approach / np.linalg.norm(approach), tilt=0.6)
            )
        return Layout(tuple(obstacles), tuple(grasps))

    def _obstacle(self, random: Generator, index: int) -> Obstacle:
        a, b, c = (uniform(random, self.size) for _ in range(3))
        share = random.random()
        bearing = uniform(random, self.bearing)
        extent = math.hypot(a, b, c) / 2
        radius = max(uniform(random, self.radius), MIN_BASE_DISTANCE_M + extent)
        position = (
            radius * math.cos(bearing),
            radius * math.sin(bearing),
            uniform(random, self.height),
        )
        roll, pitch, yaw = random.uniform(-math.pi, math.pi, 3).tolist()
        name = f"obstacle {index + 1}"
        turn = (roll, pitch, yaw)
        if share < self.spheres:
            return Obstacle(name=name, kind="sphere", position=position, radius=a / 2)
        if share < self.spheres + self.cylinders:
            return Obstacle(
                name=name,
                kind="cylinder",
                position=position,
                radius=a / 4,
                length=b,
                rotation=turn,
            )
        return Obstacle(
            name=name, kind="box", position=position, size=(a, b, c), rotation=turn
        )
