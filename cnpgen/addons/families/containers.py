"""Families of containers: an open box, a cage with bars, and a dresser with open drawers."""

from __future__ import annotations

from dataclasses import dataclass

from numpy.random import Generator

from cnpgen.addons.families.furniture import Furniture, place_furniture
from cnpgen.arrays import Vector3
from cnpgen.pipelines.scene_family import Layout, SceneFamily, length, uniform, whole
from cnpgen.schema.keys import Range, field

WALL_M = 0.02


def _open_box(
    furniture: Furniture,
    prefix: str,
    center: tuple[float, float],
    bottom: float,
    size: Vector3,
) -> None:
    """Add a bottom and four walls."""
    (x, y), (depth, width, height) = center, size
    furniture.box(
        f"{prefix} bottom", (x, y, bottom + WALL_M / 2), (depth, width, WALL_M)
    )
    z = bottom + WALL_M + height / 2
    for name, sign in (("front", -0.5), ("back", 0.5)):
        furniture.box(
            f"{prefix} {name}",
            (x + sign * (depth - WALL_M), y, z),
            (WALL_M, width, height),
        )
    for name, sign in (("left", 0.5), ("right", -0.5)):
        furniture.box(
            f"{prefix} {name}",
            (x, y + sign * (width - WALL_M), z),
            (depth - 2 * WALL_M, WALL_M, height),
        )


@dataclass(frozen=True, kw_only=True)
class OpenBox(SceneFamily):
    """A box that is open at the top, with objects in it."""

    distance: Range = length(
        "distance of the box's front from the base", Range(0.3, 0.42)
    )
    bottom: Range = length("height of the bottom", Range(-0.05, 0.2))
    width: Range = length("width of the box", Range(0.4, 0.6), low=0.2)
    depth: Range = length("depth of the box", Range(0.32, 0.42), low=0.2)
    height: Range = length("height of the walls", Range(0.2, 0.32), low=0.05)
    objects: Range = field(
        "number of cylinders in the box", default=Range(0, 2), low=0, high=10
    )

    def draw(self, random: Generator) -> Layout:
        """Draw the box, the cylinders and grasps inside of it."""
        box = place_furniture(random, self)
        width, depth, height = (
            uniform(random, size) for size in (self.width, self.depth, self.height)
        )
        bottom = uniform(random, self.bottom)
        _open_box(box, "box", (depth / 2, 0.0), bottom, (depth, width, height))
        floor = bottom + WALL_M
        for index in range(whole(random, self.objects)):
            x = depth * random.uniform(0.25, 0.75)
            y = width * (index - 0.5) * random.uniform(0.3, 0.6)
            box.cylinder(f"object {index + 1}", (x, y, floor + 0.05), 0.03, 0.1)
            box.grasp((x, y, floor + 0.12), (0, 0, -1))
        for _ in range(6):
            x = depth * random.uniform(0.3, 0.7)
            y = width * random.uniform(-0.25, 0.25)
            box.grasp(
                (x, y, floor + random.uniform(0.06, 0.16)),
                (0.15, 0, -1),
            )
        return box.layout()


@dataclass(frozen=True, kw_only=True)
class Cage(SceneFamily):
    """A cage with walls, a roof and bars in front, through which an object is grasped."""

    distance: Range = length("distance of the bars from the base", Range(0.36, 0.48))
    bottom: Range = length("height of the floor", Range(0.0, 0.2))
    size: Range = length(
        "width, depth and height of the cage", Range(0.6, 0.75), low=0.3
    )
    opening: Range = length(
        "height between the bars in front", Range(0.3, 0.42), low=0.15
    )

    def draw(self, random: Generator) -> Layout:
        """Draw walls, bars and an object in the cage."""
        cage = place_furniture(random, self, uniform(random, self.bottom))
        size = uniform(random, self.size)
        opening = uniform(random, self.opening)
        thin = 0.04
        bar = 0.04
        low = float(random.uniform(0.08, max(size - opening - 0.08, 0.1)))
        cage.box("floor", (size / 2, 0, 0), (size, size, thin))
        cage.box("roof", (size / 2, 0, size), (size, size, thin))
        for name, y in (("left", 0.5), ("right", -0.5)):
            cage.box(name, (size / 2, y * size, size / 2), (size, thin, size - thin))
        cage.box("back", (size, 0, size / 2), (thin, size - thin, size - thin))
        cage.box("bar below", (0, 0, low), (bar, size - thin, bar))
        cage.box("bar above", (0, 0, low + opening), (bar, size - thin, bar))
        x = random.uniform(0.15, 0.3)
        y = random.uniform(-0.15, 0.15)
        cage.box("cube", (x, y, thin / 2 + 0.035), (0.07, 0.07, 0.07))
        cage.grasp((x - 0.06, y, 0.15), (1, 0, -0.6), tilt=0.4)
        for _ in range(5):
            center_z = low + opening * random.uniform(0.4, 0.6)
            position = random.uniform(0.08, 0.22), random.uniform(-0.18, 0.18), center_z
            cage.grasp(position, (1, 0, 0), tilt=0.4)
        return cage.layout()


@dataclass(frozen=True, kw_only=True)
class Dresser(SceneFamily):
    """A dresser with one or two open drawers, into which the tip reaches."""

    distance: Range = length(
        "distance of the open drawers from the base", Range(0.3, 0.4)
    )
    drawers: Range = field("number of open drawers", default=Range(1, 2), low=1, high=2)
    width: Range = length("width of a drawer", Range(0.4, 0.5), low=0.2)
    extension: Range = length(
        "length of the open part of a drawer", Range(0.28, 0.36), low=0.1
    )
    height: Range = length("height of a drawer", Range(0.12, 0.18), low=0.05)
    bottom: Range = length("height of the lower drawer's bottom", Range(0.05, 0.25))

    def draw(self, random: Generator) -> Layout:
        """Draw the body, the drawers side by side, and grasps in them."""
        dresser = place_furniture(random, self)
        width, height, bottom = (
            uniform(random, size) for size in (self.width, self.height, self.bottom)
        )
        count = whole(random, self.drawers)
        lengths = [uniform(random, self.extension) for _ in range(count)]
        body = 0.3
        total = random.uniform(0.6, 0.9)
        front = max(lengths)
        dresser.box("body", (front + body / 2, 0, total / 2), (body, 1.0, total))
        for index, extended in enumerate(lengths):
            y = 0.0 if count == 1 else (index - 0.5) * (width + 0.03)
            z = bottom + (random.uniform(0.0, 0.25) if index else 0.0)
            x = front - extended / 2
            _open_box(
                dresser, f"drawer {index + 1}", (x, y), z, (extended, width, height)
            )
            for _ in range(4):
                place = (
                    x + extended * random.uniform(-0.15, 0.15),
                    y + width * random.uniform(-0.2, 0.2),
                )
                level = z + WALL_M + random.uniform(0.05, height)
                dresser.grasp((*place, level), (0.2, 0, -1), tilt=0.35)
        return dresser.layout()
