"""Families of tables: objects on one to three tables, a pick among dense objects, and a pick below a table."""

from __future__ import annotations

import math
from dataclasses import dataclass

from numpy.random import Generator

from cnpgen.addons.families.furniture import Furniture, place_furniture, place_objects
from cnpgen.pipelines.scene_family import Layout, SceneFamily, length, uniform, whole
from cnpgen.schema.keys import Range, field

BOARD_M = 0.04  # thickness of table boards


@dataclass(frozen=True, kw_only=True)
class Tabletop(SceneFamily):
    """One to three tables around the robot with boxes and cylinders on them."""

    tables: Range = field("number of tables", default=Range(1, 3), low=1, high=3)
    height: Range = length(
        "height of the upper faces of the tables", Range(0.0, 0.3), low=0.0
    )
    width: Range = length("width of the tables", Range(0.6, 1.0), low=0.2)
    depth: Range = length("depth of the tables", Range(0.4, 0.6), low=0.2)
    distance: Range = length(
        "distance of the first table's front from the base", Range(0.22, 0.35)
    )
    objects: Range = field(
        "number of objects on each table", default=Range(2, 4), low=0, high=20
    )
    object_width: Range = length("widths of objects", Range(0.05, 0.14), low=0.01)
    object_height: Range = length("heights of objects", Range(0.08, 0.35), low=0.01)

    def draw(self, random: Generator) -> Layout:
        """Draw the tables, at right angles, and their objects."""
        tables = []
        first = uniform(random, self.bearing)
        side = 1.0 if random.random() < 0.5 else -1.0
        for index in range(whole(random, self.tables)):
            # The second and the third table are at right angles to the first, on either
            # side.
            bearing = first + (0.0, side, -side)[index] * math.pi / 2
            distance = uniform(random, self.distance)
            height = uniform(random, self.height)
            width = uniform(random, self.width)
            depth = uniform(random, self.depth)
            origin = distance * math.cos(bearing), distance * math.sin(bearing), height
            table = Furniture(origin, bearing)
            table.box(
                f"table {index + 1}",
                (depth / 2, 0, -BOARD_M / 2),
                (depth, width, BOARD_M),
            )
            area = (0.08, depth - 0.08, -width / 2 + 0.08, width / 2 - 0.08)
            objects = self.objects, self.object_width, self.object_height
            place_objects(
                random,
                table,
                area,
                0.0,
                objects,
                from_above=True,
                prefix=f"object {index + 1}",
            )
            for _ in range(2):  # free places
                x = random.uniform(area[0], area[1])
                y = random.uniform(area[2], area[3])
                table.grasp((x, y, 0.05), (0, 0, -1))
            tables.append(table)
        return tables[0].layout(*tables[1:])


@dataclass(frozen=True, kw_only=True)
class TablePick(SceneFamily):
    """A table with dense objects, from which one is grasped."""

    height: Range = length("height of the table top", Range(0.0, 0.35), low=0.0)
    distance: Range = length(
        "distance of the table's front from the base", Range(0.22, 0.32)
    )
    objects: Range = field("number of objects", default=Range(7, 11), low=1, high=40)
    object_width: Range = length("widths of objects", Range(0.05, 0.1), low=0.01)
    object_height: Range = length("heights of objects", Range(0.1, 0.4), low=0.01)

    def draw(self, random: Generator) -> Layout:
        """Draw the table and the objects."""
        table = place_furniture(random, self, uniform(random, self.height))
        depth = 0.55
        width = 0.9
        table.box("table", (depth / 2, 0, -BOARD_M / 2), (depth, width, BOARD_M))
        objects = self.objects, self.object_width, self.object_height
        place_objects(
            random, table, (0.08, 0.47, -0.37, 0.37), 0.0, objects, from_above=True
        )
        # Low places beside the objects.
        # The first obstacle is the table itself.
        for obstacle in list(table.obstacles[1:]):
            # Positions are in the frame of the robot's base, and grasps in that of the
            # table.
            x, y, _ = obstacle.position or (0.0, 0.0, 0.0)
            dx = x - table.origin[0]
            dy = y - table.origin[1]
            cos = math.cos(table.yaw)
            sin = math.sin(table.yaw)
            table.grasp(
                (cos * dx + sin * dy - 0.1, -sin * dx + cos * dy, 0.06),
                (0.5, 0, -1),
                tilt=0.5,
            )
        return table.layout()


@dataclass(frozen=True, kw_only=True)
class TableUnderPick(SceneFamily):
    """A table with legs and objects below its top, which are grasped from the front."""

    height: Range = length("height of the table top", Range(0.45, 0.65), low=0.2)
    floor: Range = length("height of the floor below the table", Range(-0.1, 0.05))
    distance: Range = length(
        "distance of the table's front from the base", Range(0.25, 0.4)
    )
    objects: Range = field("number of objects", default=Range(2, 4), low=1, high=20)
    object_width: Range = length("widths of objects", Range(0.05, 0.09), low=0.01)
    object_height: Range = length("heights of objects", Range(0.1, 0.25), low=0.01)

    def draw(self, random: Generator) -> Layout:
        """Draw the table, the plate on which it stands, and the objects."""
        floor = uniform(random, self.floor)
        top = uniform(random, self.height)
        table = place_furniture(random, self)
        depth = 0.55
        width = 0.9
        leg = 0.05
        table.box("top", (depth / 2, 0, top), (depth, width, BOARD_M))
        table.box(
            "floor", (depth / 2 + 0.05, 0, floor - BOARD_M / 2), (depth, width, BOARD_M)
        )
        for index, (x, y) in enumerate([(0, -1), (0, 1), (1, -1), (1, 1)], 1):
            center = (
                leg / 2 + x * (depth - leg),
                y * (width - leg) / 2,
                (floor + top) / 2,
            )
            # Legs end at the lower face of the top.
            table.box(f"leg {index}", center, (leg, leg, top - floor - BOARD_M))
        objects = self.objects, self.object_width, self.object_height
        place_objects(
            random, table, (0.15, 0.4, -0.3, 0.3), floor, objects, from_above=False
        )
        center_z = (floor + top) / 2
        for _ in range(3):
            place = random.uniform([0.1, -0.3, -0.08], [0.3, 0.3, 0.08]).tolist()
            table.grasp((place[0], place[1], center_z + place[2]), (1, 0, 0), tilt=0.5)
        return table.layout()
