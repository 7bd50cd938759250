"""Contract of families: draw the obstacles of one scene and the grasps in it."""

from __future__ import annotations

from abc import ABC, abstractmethod
from dataclasses import dataclass
from typing import Any

import numpy as np

from cnpgen.arrays import Array
from cnpgen.robots.obstacle import Obstacle
from cnpgen.schema.argument_types import check_fields
from cnpgen.schema.keys import Range, field

MAX_LENGTH_M = 10.0  # of furniture; larger lengths are probably in another unit


@dataclass(frozen=True, eq=False)
class Grasp:
    """A place of the tip at rest, such as a grasp of an object or a free place in a shelf.

    Attributes:
        position: Position of the tip in the frame of the robot's base [m], shape (3,).
        approach: Unit vector along which the tip's z axis points, shape (3,).
        tilt: Largest angle between the approach and the z axis of the tip [rad].
    """

    position: Array
    approach: Array
    tilt: float = 0.3

    def __post_init__(self) -> None:
        check_fields(self)


@dataclass(frozen=True, eq=False)
class Layout:
    """Obstacles and grasps of one scene, in the frame of the robot's base."""

    obstacles: tuple[Obstacle, ...]
    grasps: tuple[Grasp, ...]

    def __post_init__(self) -> None:
        check_fields(self)


def length(doc: str, default: Range, *, low: float | None = None) -> Any:
    """Declare a range of lengths around an arm; see ``field``."""
    return field(doc, unit="m", default=default, low=low, plausible=MAX_LENGTH_M)


def angle(doc: str, default: Range) -> Any:
    """Declare a range of angles; see ``field``."""
    return field(doc, unit="rad", default=default, plausible=2 * np.pi)


@dataclass(frozen=True, kw_only=True)
class SceneFamily(ABC):
    """Family of scenes: a frozen dataclass whose fields are the ranges of its random numbers.

    The furniture stands around the base of an arm with a reach of about 0.85 m, which
    is the origin of the world.
    """

    distance: Range = length(
        "distance of the furniture's front from the base", Range(0.42, 0.6), low=0.1
    )
    bearing: Range = angle("direction of the furniture from the base", Range(-0.7, 0.7))
    turn: Range = angle(
        "rotation of the furniture against its direction", Range(-0.3, 0.3)
    )
    share: float = field(
        "share of the family among the scenes of a pipeline, relative to others",
        default=1.0,
        low=0.0,
    )

    @classmethod
    def describe(cls) -> str:
        """Return a description of one line."""
        return (cls.__doc__ or "").strip().partition("\n")[0]

    @abstractmethod
    def draw(self, random: np.random.Generator) -> Layout:
        """Draw the obstacles and the grasps of one scene.

        Args:
            random: Random numbers of the scene.
        """


def uniform(random: np.random.Generator, interval: Range) -> float:
    """Draw a number from an interval."""
    return interval.low + (interval.high - interval.low) * random.random()


def whole(random: np.random.Generator, interval: Range) -> int:
    """Draw a whole number from an interval, both ends included."""
    # The upper end of integers() is exclusive.
    return int(random.integers(round(interval.low), round(interval.high) + 1))
