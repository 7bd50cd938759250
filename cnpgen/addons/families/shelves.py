"""Family of shelves, open towards the robot: boards with objects on them, or a cubby of two columns and two rows."""

from __future__ import annotations

from dataclasses import make_dataclass
from functools import partial
from typing import Any

from numpy.random import Generator

from cnpgen.addons.families.furniture import Furniture, place_furniture, place_objects
from cnpgen.pipelines.scene_family import Layout, SceneFamily, length, uniform, whole
from cnpgen.schema.keys import Range, field

SHELF_BOARD_M = 0.03
Interval = tuple[float, float]


class Shelf(SceneFamily):
    """A shelf: the families of ``PRESETS`` have some of its parameters, with defaults of their own."""

    bottom: Range
    width: Range
    depth: Range
    # Of levels between boards, with objects.
    levels: Range
    spacing: Range
    objects: Range
    object_width: Range
    object_height: Range
    # Of a cubby, which has a back and inner walls.
    height: Range
    shift: Range | None = None
    merged: bool

    def draw(self, random: Generator) -> Layout:
        """Draw boards, sides and objects, or the walls of a cubby, and grasps between them."""
        shelf = place_furniture(random, self, uniform(random, self.bottom))
        width = uniform(random, self.width)
        if self.shift is None:
            self._fill_levels(random, shelf, width)
        else:
            self._fill_cells(random, shelf, width, self.shift)
        return shelf.layout()

    def _fill_levels(self, random: Generator, shelf: Furniture, width: float) -> None:
        depth = uniform(random, self.depth)
        levels = whole(random, self.levels)
        spacing = uniform(random, self.spacing)
        # One board more than levels: the top board closes the last one.
        heights = [level * spacing for level in range(levels + 1)]
        _add_frame(shelf, heights, depth, width, width - SHELF_BOARD_M)
        objects = self.objects, self.object_width, self.object_height
        # Objects keep a distance from the front, the back and the sides.
        area = (0.12, depth - 0.08, -width / 2 + 0.12, width / 2 - 0.12)
        for level, height in enumerate(heights[:-1], 1):
            z = height + SHELF_BOARD_M / 2
            prefix = f"object {level}"
            place_objects(
                random, shelf, area, z, objects, from_above=False, prefix=prefix
            )
            y = random.uniform(area[2], area[3])
            # A free place in front of the objects, halfway between two boards.
            shelf.grasp((0.08, y, z + spacing / 2), (1, 0, 0), tilt=0.4)

    def _fill_cells(
        self, random: Generator, shelf: Furniture, width: float, shift: Range
    ) -> None:
        height, depth = (uniform(random, size) for size in (self.height, self.depth))
        y = (uniform(random, shift) - 0.5) * width
        z = uniform(random, shift) * height
        thin = SHELF_BOARD_M
        _add_frame(shelf, [0, height], depth, width, width)
        shelf.box("back", (depth + thin / 2, 0, height / 2), (thin, width, height))
        columns = [(-width / 2, y), (y, width / 2)]
        rows = [(0.0, z), (z, height)]
        walls = {
            f"shelf {side}": ((low + high) / 2, z, high - low - thin, thin)
            for side, (low, high) in zip(("left", "right"), columns[::-1], strict=True)
        } | {
            f"wall {side}": (y, (low + high) / 2, thin, high - low - thin)
            for side, (low, high) in zip(("below", "above"), rows, strict=True)
        }
        # All cubbies draw it, so merged ones have no other walls.
        removed = list(walls)[int(random.integers(len(walls)))]
        for name, (center_y, center_z, across, up) in walls.items():
            if not (self.merged and name == removed):
                shelf.box(name, (depth / 2, center_y, center_z), (depth, across, up))
        _add_grasps(random, shelf, depth, columns, rows)


def _add_frame(
    shelf: Furniture, heights: list[float], depth: float, width: float, apart: float
) -> None:
    """Add boards at heights and both sides, whose centers are ``apart`` [m]."""
    thin, top = SHELF_BOARD_M, heights[-1]
    for number, height in enumerate(heights, 1):
        shelf.box(f"board {number}", (depth / 2, 0, height), (depth, width, thin))
    for name, side in (("left side", 0.5), ("right side", -0.5)):
        center = (depth / 2, side * apart, top / 2)
        shelf.box(name, center, (depth, thin, top - thin))


def _add_grasps(
    random: Generator,
    shelf: Furniture,
    depth: float,
    columns: list[Interval],
    rows: list[Interval],
) -> None:
    """Add two grasps in each cell, away from its walls."""
    cells = [(column, row) for column in columns for row in rows for _ in range(2)]
    for (low_y, high_y), (low_z, high_z) in cells:
        # The middle 30 % of a cell are away from its walls.
        y = low_y + (high_y - low_y) * random.uniform(0.35, 0.65)
        z = low_z + (high_z - low_z) * random.uniform(0.35, 0.65)
        shelf.grasp((depth * random.uniform(0.2, 0.6), y, z), (1, 0, 0), tilt=0.35)


_KEYS = {  # of recipes; the families have those of their rows
    "distance": partial(length, "distance of the front from the base"),
    "bottom": partial(length, "height of the lowest board"),
    "levels": partial(field, "number of levels between boards", low=1, high=6),
    "spacing": partial(length, "height of a level", low=0.1),
    "width": partial(length, "width of the shelf", low=0.2),
    "height": partial(length, "height of the shelf", low=0.4),
    "depth": partial(length, "depth of the shelf", low=0.1),
    "objects": partial(field, "number of objects on each level", low=0, high=10),
    "object_width": partial(length, "widths of objects", low=0.01),
    "object_height": partial(length, "heights of objects", low=0.01),
    "shift": partial(
        field, "place of the inner walls relative to the size", low=0.3, high=0.7
    ),
    "merged": partial(field, "whether two of the cells are joined"),
}
_BOOKSHELF = {
    "distance": Range(0.4, 0.55),
    "bottom": Range(0.05, 0.3),
    "levels": Range(1, 1),
    "spacing": Range(0.32, 0.42),
    "width": Range(0.8, 1.2),
    "depth": Range(0.35, 0.45),
    "objects": Range(1, 3),
    "object_width": Range(0.04, 0.09),
    "object_height": Range(0.1, 0.22),
}
_TALL = {
    "bottom": Range(0.0, 0.1),
    "levels": Range(3, 3),
    "spacing": Range(0.28, 0.34),
    "objects": Range(0, 2),
}
_THIN = {
    "bottom": Range(0.0, 0.2),
    "levels": Range(2, 2),
    "width": Range(0.42, 0.5),
    "objects": Range(0, 1),
}
_CUBBY = {
    "distance": Range(0.4, 0.55),
    "bottom": Range(0.0, 0.2),
    "width": Range(0.8, 1.2),
    "height": Range(0.7, 0.85),
    "depth": Range(0.25, 0.35),
    "shift": Range(0.42, 0.58),
    "merged": False,
}


def _preset(name: str, doc: str, defaults: dict[str, Any]) -> type[Shelf]:
    """Return the family of a row: its keys are those of the defaults."""
    keys = [
        (key, type(default), _KEYS[key](default=default))
        for key, default in defaults.items()
    ]
    about = {"__doc__": doc, "__module__": __name__}
    return make_dataclass(
        name, keys, bases=(Shelf,), namespace=about, frozen=True, kw_only=True
    )


PRESETS = (
    ("BookshelfSmall", "A bookshelf of one level.", _BOOKSHELF),
    ("BookshelfTall", "A bookshelf of three levels.", _BOOKSHELF | _TALL),
    ("BookshelfThin", "A narrow bookshelf of two levels.", _BOOKSHELF | _THIN),
    ("Cubby", "A cubby: two columns and two rows of cells, open in front.", _CUBBY),
    ("MergedCubby", "A cubby with two joined cells.", _CUBBY | {"merged": True}),
)
BookshelfSmall, BookshelfTall, BookshelfThin, Cubby, MergedCubby = (
    _preset(*row) for row in PRESETS
)
