"""Families of shelves: bookshelves and cubbies, which are open towards the robot."""

from __future__ import annotations

from dataclasses import dataclass

from numpy.random import Generator

from cnpgen.addons.families.furniture import Furniture, place_furniture, place_objects
from cnpgen.pipelines.scene_family import Layout, SceneFamily, length, uniform, whole
from cnpgen.schema.keys import Range, field

SHELF_BOARD_M = 0.03


@dataclass(frozen=True, kw_only=True)
class Bookshelf(SceneFamily):
    """A bookshelf with boards one above the other and objects on them."""

    distance: Range = length("distance of the front from the base", Range(0.4, 0.55))
    bottom: Range = length("height of the lowest board", Range(0.05, 0.3))
    levels: Range = field(
        "number of levels between boards", default=Range(1, 1), low=1, high=6
    )
    spacing: Range = length("height of a level", Range(0.32, 0.42), low=0.1)
    width: Range = length("width of the boards", Range(0.8, 1.2), low=0.2)
    depth: Range = length("depth of the boards", Range(0.35, 0.45), low=0.1)
    objects: Range = field(
        "number of objects on each level", default=Range(1, 3), low=0, high=10
    )
    object_width: Range = length("widths of objects", Range(0.04, 0.09), low=0.01)
    object_height: Range = length("heights of objects", Range(0.1, 0.22), low=0.01)

    def draw(self, random: Generator) -> Layout:
        """Draw boards, sides and objects."""
        shelf = place_furniture(random, self, uniform(random, self.bottom))
        width = uniform(random, self.width)
        depth = uniform(random, self.depth)
        levels = whole(random, self.levels)
        spacing = uniform(random, self.spacing)
        height = levels * spacing
        # One board more than levels: the top board closes the last one.
        for level in range(levels + 1):
            shelf.box(
                f"board {level + 1}",
                (depth / 2, 0, level * spacing),
                (depth, width, SHELF_BOARD_M),
            )
        for name, side in (("left side", 0.5), ("right side", -0.5)):
            center = (depth / 2, side * (width - SHELF_BOARD_M), height / 2)
            shelf.box(name, center, (depth, SHELF_BOARD_M, height - SHELF_BOARD_M))
        objects = self.objects, self.object_width, self.object_height
        for level in range(levels):
            z, area = (
                level * spacing + SHELF_BOARD_M / 2,
                # Objects keep a distance from the front, the back and the sides.
                (0.12, depth - 0.08, -width / 2 + 0.12, width / 2 - 0.12),
            )
            place_objects(
                random,
                shelf,
                area,
                z,
                objects,
                from_above=False,
                prefix=f"object {level + 1}",
            )
            y = random.uniform(area[2], area[3])
            # A free place in front of the objects, halfway between two boards.
            shelf.grasp((0.08, y, z + spacing / 2), (1, 0, 0), tilt=0.4)
        return shelf.layout()


@dataclass(frozen=True, kw_only=True)
class BookshelfSmall(Bookshelf):
    """A bookshelf of one level."""


@dataclass(frozen=True, kw_only=True)
class BookshelfTall(Bookshelf):
    """A bookshelf of three levels."""

    bottom: Range = length("height of the lowest board", Range(0.0, 0.1))
    levels: Range = field(
        "number of levels between boards", default=Range(3, 3), low=1, high=6
    )
    spacing: Range = length("height of a level", Range(0.28, 0.34), low=0.1)
    objects: Range = field(
        "number of objects on each level", default=Range(0, 2), low=0, high=10
    )


@dataclass(frozen=True, kw_only=True)
class BookshelfThin(Bookshelf):
    """A narrow bookshelf of two levels."""

    bottom: Range = length("height of the lowest board", Range(0.0, 0.2))
    levels: Range = field(
        "number of levels between boards", default=Range(2, 2), low=1, high=6
    )
    width: Range = length("width of the boards", Range(0.42, 0.5), low=0.2)
    objects: Range = field(
        "number of objects on each level", default=Range(0, 1), low=0, high=10
    )


@dataclass(frozen=True, kw_only=True)
class Cubby(SceneFamily):
    """A cubby: two columns and two rows of cells, open towards the robot."""

    distance: Range = length("distance of the front from the base", Range(0.4, 0.55))
    bottom: Range = length("height of the lowest board", Range(0.0, 0.2))
    width: Range = length("width of the cubby", Range(0.8, 1.2), low=0.4)
    height: Range = length("height of the cubby", Range(0.7, 0.85), low=0.4)
    depth: Range = length("depth of the cubby", Range(0.25, 0.35), low=0.1)
    shift: Range = field(
        "place of the inner walls relative to the size",
        default=Range(0.42, 0.58),
        low=0.3,
        high=0.7,
    )
    merged: bool = field("whether two of the cells are joined", default=False)

    def draw(self, random: Generator) -> Layout:
        """Draw the walls and grasps inside of the cells."""
        cubby = place_furniture(random, self, uniform(random, self.bottom))
        width, height, depth = (
            uniform(random, size) for size in (self.width, self.height, self.depth)
        )
        y = (uniform(random, self.shift) - 0.5) * width
        z = uniform(random, self.shift) * height
        thin = SHELF_BOARD_M
        left = width / 2
        right = -width / 2
        cubby.box("bottom", (depth / 2, 0, 0), (depth, width, thin))
        cubby.box("top", (depth / 2, 0, height), (depth, width, thin))
        cubby.box("left", (depth / 2, left, height / 2), (depth, thin, height - thin))
        cubby.box("right", (depth / 2, right, height / 2), (depth, thin, height - thin))
        cubby.box("back", (depth + thin / 2, 0, height / 2), (thin, width, height))
        walls = {
            "shelf left": (
                (depth / 2, (y + left) / 2, z),
                (depth, left - y - thin, thin),
            ),
            "shelf right": (
                (depth / 2, (y + right) / 2, z),
                (depth, y - right - thin, thin),
            ),
            "wall below": ((depth / 2, y, z / 2), (depth, thin, z - thin)),
            "wall above": (
                (depth / 2, y, (z + height) / 2),
                (depth, thin, height - z - thin),
            ),
        }
        # All cubbies draw it, so merged ones have no other walls.
        removed = list(walls)[int(random.integers(len(walls)))]
        for name, (center, size) in walls.items():
            if not (self.merged and name == removed):
                cubby.box(name, center, size)
        _cell_grasps(
            random, cubby, depth, [(right, y), (y, left)], [(0.0, z), (z, height)]
        )
        return cubby.layout()


@dataclass(frozen=True, kw_only=True)
class MergedCubby(Cubby):
    """A cubby in which two neighboring cells are joined."""

    merged: bool = field("whether two of the cells are joined", default=True)


def _cell_grasps(
    random: Generator,
    cubby: Furniture,
    depth: float,
    columns: list[tuple[float, float]],
    rows: list[tuple[float, float]],
) -> None:
    """Add two grasps in each cell, away from its walls."""
    for low_y, high_y in columns:
        for low_z, high_z in rows:
            for _ in range(2):
                # The middle 30 % of a cell are away from its walls.
                y = low_y + (high_y - low_y) * random.uniform(0.35, 0.65)
                z = low_z + (high_z - low_z) * random.uniform(0.35, 0.65)
                cubby.grasp(
                    (depth * random.uniform(0.2, 0.6), y, z), (1, 0, 0), tilt=0.35
                )
