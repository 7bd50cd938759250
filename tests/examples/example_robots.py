"""Robots of the package example-robot-data, if it is installed, and a Panda among obstacles."""

from collections.abc import Iterable
from importlib import metadata
from pathlib import Path
from typing import Any

import pytest

from tests.examples.shaped_robot import write_pipeline


def folder() -> Path | None:
    """The folder in which ``package://example-robot-data`` begins."""
    try:
        share = Path(
            str(
                metadata.distribution("example-robot-data").locate_file(
                    "cmeel.prefix/share"
                )
            )
        )
    except metadata.PackageNotFoundError:
        return None
    return share if (share / "example-robot-data" / "robots").is_dir() else None


needs_robots = pytest.mark.skipif(
    folder() is None, reason="example-robot-data is not installed"
)
SHIPPED = ("panda-cup", "ur5-wipe")  # problems, pipelines and datasets of these robots


def with_robots(names: Iterable[str]) -> list[Any]:
    """The names of recipes as parameters of a test, those of robots that are not installed to be skipped."""
    own = (*SHIPPED, "panda-scenes", "panda-scenes-drive")
    return [
        pytest.param(name, marks=needs_robots) if name in own else name
        for name in names
    ]


PANDA = """
name = "panda-shelves"
[robot]
urdf = "{share}/example-robot-data/robots/panda_description/urdf/panda.urdf"
joints = [{joints}]
tip = "panda_hand_tcp"
base = "[0, -40, 0, -126, 0, 92, 45] deg"
{robot}
[limits]
acceleration_cap = "10 rad/s^2"
{obstacles}[[constraint]]
use = "joint-position"
tolerance = "1e-3 rad"
[[constraint]]
use = "joint-velocity"
tolerance = "0.2 %"
[[constraint]]
use = "joint-acceleration"
tolerance = "0.5 %"
[[constraint]]
use = "joint-torque"
tolerance = "0.5 %"
[[constraint]]
use = "robot-clearance"
tolerance = "0 mm"
[[constraint]]
use = "self-clearance"
tolerance = "0 mm"
"""
SHELVES = """
[[obstacle]]
name = "table"
x = "[0.3, 0.9] m"
y = "[-0.5, 0.5] m"
top = "0.1 m"
height = "0.1 m"
[[obstacle]]
name = "shelf"
x = "[0.4, 0.9] m"
y = "[-0.5, 0.5] m"
top = "0.75 m"
height = "0.03 m"
[[obstacle]]
name = "post"
x = "[0.5, 0.6] m"
y = "[-0.05, 0.05] m"
top = "0.4 m"
height = "0.3 m"
"""
CAGE = """
[[obstacle]]
name = "cage-{number}"
kind = "cylinder"
position = [{x}, {y}, 0.6]
radius = "2 cm"
length = 1.2
"""
BARS = ((0.3, 0.6), (0.3, -0.6), (-0.35, 0.35), (-0.35, -0.35))
FURNITURE = """
[[obstacle]]
name = "table"
position = [0.6, 0.0, 0.05]
size = [0.6, 1.2, 0.1]
[[obstacle]]
name = "shelf"
position = [0.65, 0.35, 0.5]
size = [0.4, 0.4, 0.02]
[[obstacle]]
name = "shelf-side"
position = [0.6, 0.12, 0.3]
size = [0.3, 0.02, 0.4]
rotation = "[0, 0, 10] deg"
"""
PIPES = """
[[obstacle]]
name = "pipe-across"
kind = "capsule"
position = [0.45, 0.0, 0.9]
rotation = "[90, 0, 0] deg"
radius = "3 cm"
length = 1.2
[[obstacle]]
name = "pipe-slanting"
kind = "capsule"
position = [0.75, -0.3, 0.4]
rotation = "[30, 0, 0] deg"
radius = "3 cm"
length = 0.6
[[obstacle]]
name = "lamp"
kind = "sphere"
position = [0.5, -0.1, 0.65]
radius = "8 cm"
"""
CLUTTER = (
    FURNITURE
    + "".join(CAGE.format(number=i, x=x, y=y) for i, (x, y) in enumerate(BARS, 1))
    + PIPES
)
START = '["[0.4, 0.7] m", "[-0.4, -0.1] m", "[0.2, 0.6] m"]'
GOAL = '["[0.4, 0.7] m", "[0.1, 0.4] m", "[0.2, 0.6] m"]'
GUESS = """[
  "[-60, 60] deg", "[-60, 60] deg", "[-30, 30] deg", "[-150, -60] deg", "[-30, 30] deg", "[60, 140] deg", "[0, 90] deg",
]"""


def write_panda(where: Path, robot: str = "", obstacles: str = SHELVES) -> Path:
    """Write the problem and its pipeline; return the problem file."""
    joints = ", ".join(f'"panda_joint{number}"' for number in range(1, 8))
    (where / "problem.toml").write_text(
        PANDA.format(share=folder(), joints=joints, robot=robot, obstacles=obstacles)
    )
    write_pipeline(where, name="panda-shelves", start=START, goal=GOAL, guess=GUESS)
    return where / "problem.toml"
