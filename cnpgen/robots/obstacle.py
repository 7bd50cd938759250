"""Obstacles of a problem file."""

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass

from cnpgen.arrays import Vector3
from cnpgen.documents import NamedErrors
from cnpgen.robots.obstacle_shapes.box_shape import UprightBox
from cnpgen.robots.obstacle_shapes.mesh_shape import MeshShape
from cnpgen.robots.obstacle_shapes.obstacle_shape import (
    ObstacleShape,
    SizedShape,
    shape_class,
    stated_polytope,
)
from cnpgen.robots.parameter_ranges import optional_key
from cnpgen.robots.shape.hull import MAX_COORDINATE_M, check_solid
from cnpgen.robots.shape.inline import is_inline
from cnpgen.schema import registry
from cnpgen.schema.keys import Range, field, keys
from cnpgen.schema.units import PLAUSIBLE_MAX, suggested_unit

CONVEX = "convex"  # kind of an obstacle with the shape of a package
_UPRIGHT = ("x", "y", "top", "height")  # keys of an upright box
_OPTIONAL = {"rotation": (0.0, 0.0, 0.0), "scale": (1.0, 1.0, 1.0)}
_KINDS = (*registry.BUILT_IN[registry.SHAPES], CONVEX)
_POSED = {"position", "size", "radius", "length", "mesh", "shape", *_OPTIONAL}


def _keys_of(kind: str) -> tuple[str, ...]:
    """Return the keys of pose and size of a kind; those of ``_OPTIONAL`` may be omitted."""
    if kind == CONVEX:
        return ("position", "shape", "rotation")
    shape = shape_class(kind)
    return ("position", *shape.sizes(), *shape.placement)


@dataclass(frozen=True, kw_only=True)
class Obstacle:
    """Convex static obstacle: an upright box given by ranges, or another kind with a pose.

    With ``below`` its highest point touches the bottom of the object at that end of the
    motion; the z of a ``position`` is then an additional offset.
    """

    name: str = field("name of the obstacle")
    x: Range | None = field(
        "extent of an upright box along world x", unit="m", default=None
    )
    y: Range | None = field(
        "extent of an upright box along world y", unit="m", default=None
    )
    height: float | None = field(
        "height of the upright box, measured down from its top; default: without lower end",
        unit="m",
        default=None,
        low=1e-6,
    )
    top: float | None = field("height of the upper face", unit="m", default=None)
    below: str = field(
        "end whose object stands on this obstacle",
        choices=("", "start", "goal"),
        default="",
    )
    kind: str = optional_key(
        "kind of the obstacle",
        choices=_KINDS,
        default="box",
        form='a shape of a package: kind = "convex" and shape = {use = NAME}',
    )
    position: Vector3 | None = optional_key(
        "position of the centre, for a mesh of the origin of its file: x, y, z",
        unit="m",
    )
    rotation: Vector3 = optional_key(
        "rotation: roll, pitch and yaw about the world's axes, as <origin rpy> of a URDF",
        unit="rad",
        default=_OPTIONAL["rotation"],
        plausible=2 * math.pi,
    )
    size: Vector3 | None = optional_key("edge lengths of a box", unit="m", low=1e-6)
    radius: float | None = optional_key(
        "radius of a sphere, a cylinder, a capsule", unit="m", low=1e-6
    )
    length: float | None = optional_key(
        "length of a cylinder, or of a capsule without its round ends, along its z axis",
        unit="m",
        low=1e-6,
    )
    mesh: str = optional_key(
        "mesh file (STL, DAE, OBJ), relative to the problem file; its convex hull is used",
        default="",
    )
    scale: Vector3 = optional_key(
        "scale factors of the mesh along x, y and z", default=_OPTIONAL["scale"]
    )
    shape: ObstacleShape | None = optional_key(
        "shape of a package for the kind convex, and its dimensions",
        form="a table with 'use'",
    )

    def validate(self) -> NamedErrors:
        """Yield (key, error) pairs."""
        yield from self._mistakes_upright() if self.upright else self._mistakes_posed()

    def value_errors(self) -> NamedErrors:
        """Yield (key, error) pairs of an obstacle that Python has built: its kind, missing keys, and numbers."""
        if self.kind not in _KINDS:
            yield "kind", f"must be one of {', '.join(_KINDS)}, got {self.kind!r}"
            return
        for name, kind in (("x", Range), ("y", Range), ("shape", ObstacleShape)):
            value = getattr(self, name)
            if not isinstance(value, kind | None):
                yield name, f"must be a {kind.__name__}, got {value!r}"
                return
        owners = [each for each in (self, self.shape) if each is not None]
        for owner, key in [(each, key) for each in owners for key in keys(type(each))]:
            value = getattr(owner, key.name)
            ends = (value.low, value.high) if isinstance(value, Range) else value
            entries = ends if isinstance(ends, tuple) else (ends,)
            numbers = [entry for entry in entries if isinstance(entry, int | float)]
            largest = max(map(abs, numbers), default=0.0)
            limit = (
                PLAUSIBLE_MAX.get(key.unit, MAX_COORDINATE_M)
                if key.plausible is None
                else key.plausible
            )
            if not all(map(math.isfinite, numbers)):
                yield key.name, f"must be finite, got {value}"
            elif largest > limit:
                hint = suggested_unit(largest, key.unit, high=limit)
                yield (
                    key.name,
                    f"must be at most {limit:.4g} {key.unit}, got {value}{hint}",
                )
            elif key.low is not None and numbers and min(numbers) < key.low:
                yield key.name, f"must be at least {key.low:g} {key.unit}, got {value}"
        yield from self.validate()

    @property
    def form(self) -> ObstacleShape:
        """The shape with its dimensions."""
        if self.shape is not None:
            return self.shape
        if self.upright:
            none = Range(0, 0)
            return UprightBox(x=self.x or none, y=self.y or none, height=self.height)
        shape = shape_class(self.kind)
        return shape(**{name: getattr(self, name) for name in shape.sizes()})

    @property
    def upright(self) -> bool:
        """Whether it is an upright box given by ranges along the world's axes."""
        return self.kind == "box" and (self.x is not None or self.y is not None)

    @property
    def is_turned(self) -> bool:
        """Whether its axes differ from the world's axes."""
        return self.rotation != _OPTIONAL["rotation"]

    def _mistakes_upright(self) -> NamedErrors:
        if self.top is None and not self.below:
            yield (
                "top",
                f"obstacle {self.name!r} has no height: expected a 'top', or 'below' = \"start\" or \"goal\"",
            )
        if self.top is not None and self.below:
            yield (
                "top",
                f"obstacle {self.name!r} has both a 'top' and a 'below', expected one of them",
            )
        for key, extent in (("x", self.x), ("y", self.y)):
            if extent is None:
                yield (
                    key,
                    f"obstacle {self.name!r} is an upright box and needs its extent here",
                )
            elif extent.low == extent.high:
                yield (
                    key,
                    f"obstacle {self.name!r} has no extent here, expected a low end below the high end",
                )
        for key in self._given(_POSED):
            yield (
                key,
                f"an upright box has {_listed(_UPRIGHT)}: leave this out, or give a box with a pose",
            )

    def _mistakes_posed(self) -> NamedErrors:
        known = _keys_of(self.kind)
        needed = [key for key in known if key not in _OPTIONAL]
        instead = (
            f", or {_listed(_UPRIGHT)} in their place" if self.kind == "box" else ""
        )
        for key in sorted(set(needed) - set(self._given(needed))):
            yield (
                key,
                f"obstacle {self.name!r} is a {self.kind} and needs {_listed(needed)}{instead}",
            )
        for key in self._given(_POSED.union(_UPRIGHT) - set(known)):
            yield key, f"a {self.kind} has no such key, expected {_listed(known)}"
        if 0.0 in self.scale:
            yield "scale", f"factors must not be 0, got {list(self.scale)}"
        yield from self._mistakes_of_body()

    def _mistakes_of_body(self) -> NamedErrors:
        if isinstance(self.shape, SizedShape | MeshShape):
            yield "shape", "is a kind of the core: set 'kind' and its keys instead"
            return
        body = MeshShape(mesh=self.mesh) if is_inline(self.mesh) else self.shape
        if body is None:
            return
        try:
            corners, radius = stated_polytope(body)
            check_solid(corners)
        except ValueError as error:
            yield "mesh" if self.mesh else "shape", str(error)
            return
        if not 0 <= radius < MAX_COORDINATE_M:
            yield "shape", f"its radius must not be negative or large, got {radius} m"

    def _given(self, keys: Iterable[str]) -> list[str]:
        """Return the given keys among some keys."""
        return [
            key
            for key in sorted(keys)
            if getattr(self, key) not in (None, "", _OPTIONAL.get(key))
        ]


def invalid_obstacle(obstacles: Iterable[Obstacle]) -> str:
    """Return the first error of obstacles, with the name of the obstacle.

    Empty without one.
    """
    errors = (
        (f"obstacle {each.name!r}", *error)
        for each in obstacles
        for error in each.value_errors()
    )
    # Some errors begin with the name of the obstacle already.
    return next(
        (
            text if text.startswith(name) else f"{name}: {key} {text}"
            for name, key, text in errors
        ),
        "",
    )


def _listed(keys: Sequence[str]) -> str:
    return f"{', '.join(map(repr, keys[:-1]))} and {keys[-1]!r}"
