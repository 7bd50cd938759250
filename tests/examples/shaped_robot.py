"""A small arm whose links have shapes of every kind, written to a folder with its meshes and a problem file."""

import struct
from functools import cache
from pathlib import Path

import numpy as np
import scipy

from cnpgen.problems.problem import Problem
from cnpgen.problems.problem_file import load_problem

_LYING = 'rpy="0 1.5707963267948966 0"'  # along x
_WEDGE = '<mesh filename="package://crane/meshes/wedge.stl" scale="0.001 0.001 0.001"/>'
LINKS = {  # link -> what its <collision> elements hold
    "base": ['<origin xyz="0 0 0.05"/><geometry><box size="0.3 0.3 0.1"/></geometry>'],
    "turret": [
        '<origin xyz="0 0 0.1"/><geometry><cylinder radius="0.07" length="0.2"/></geometry>'
    ],
    "arm": [
        f'<origin xyz="0.2 0 0" {_LYING}/><geometry><capsule radius="0.05" length="0.3"/></geometry>'
    ],
    "fore": [f'<origin xyz="0.02 0 0" rpy="0.3 0 0"/><geometry>{_WEDGE}</geometry>'],
    "hand": [
        '<origin xyz="0.05 0 0"/><geometry><sphere radius="0.04"/></geometry>',
        '<origin xyz="0.1 0 0.02" rpy="0.1 0.2 0.3"/><geometry><box size="0.06 0.1 0.02"/></geometry>',
    ],
    "claw": ['<geometry><mesh filename="meshes/claw.obj"/></geometry>'],
}
JOINTS = [  # name, type, parent, child, place, axis
    ("swing", "revolute", "base", "turret", "0 0 0.1", "0 0 1"),
    ("lift", "revolute", "turret", "arm", "0 0 0.22", "0 1 0"),
    ("elbow", "revolute", "arm", "fore", "0.4 0 0", "0 1 0"),
    ("roll", "revolute", "fore", "hand", "0.3 0 0", "1 0 0"),
    ("grip", "prismatic", "hand", "claw", "0.12 0 0", "1 0 0"),
]
PLANNED = ("swing", "lift", "elbow", "roll")
WEDGE = np.array(
    [
        [0, -40, -30],
        [0, 40, -30],
        [0, 0, 50],
        [250, -20, -15],
        [250, 20, -15],
        [250, 0, 25.0],
    ]
)  # mm
_SIDES = [
    (0, 2, 1),
    (3, 4, 5),
    (0, 1, 4),
    (0, 4, 3),
    (1, 2, 5),
    (1, 5, 4),
    (2, 0, 3),
    (2, 3, 5),
]
CLAW = np.array([[0, -0.02, -0.01], [0, 0.02, -0.01], [0, 0, 0.02], [0.06, 0, 0.0]])
PROBLEM = """
name = "crane"
[robot]
urdf = "crane/crane.urdf"
joints = ["swing", "lift", "elbow", "roll"]
tip = "hand"
base = [0.0, -0.4, 0.8, 0.0]
{robot}
[limits]
{obstacles}
[[constraint]]
use = "joint-position"
tolerance = 1e-3
[[constraint]]
use = "robot-clearance"
tolerance = 1e-4
{clearance}
{more}
"""
OBSTACLES = """
[[obstacle]]
name = "wall"
x = [0.45, 0.55]
y = [-0.4, 0.4]
top = 0.3
height = 0.3
[[obstacle]]
name = "roof"
x = [-0.5, 0.5]
y = [-0.3, 0.3]
top = 0.9
height = 0.05
"""
KINDS = """
[[obstacle]]
name = "wall"
position = [0.5, 0.0, 0.15]
size = [0.1, 0.5, 0.3]
rotation = "[0, 0, 20] deg"
[[obstacle]]
name = "ball"
kind = "sphere"
position = [0.3, 0.35, 0.55]
radius = 0.08
[[obstacle]]
name = "post"
kind = "cylinder"
position = [0.55, -0.25, 0.3]
radius = 0.05
length = 0.6
[[obstacle]]
name = "pipe"
kind = "capsule"
position = [0.0, 0.0, 0.95]
radius = 0.04
length = 1.0
rotation = "[90, 0, 0] deg"
[[obstacle]]
name = "wedge"
kind = "mesh"
mesh = "crane/meshes/wedge.stl"
scale = [0.001, 0.001, 0.001]
position = [0.2, 0.55, 0.1]
rotation = "[0, -60, 30] deg"
"""
SELF = '[[constraint]]\nuse = "self-clearance"\ntolerance = 1e-4\n'
HELD_OBJECT = """
[object]
size = [0.08, 0.06, 0.12]
touch_links = ["fore", "hand", "claw"]
"""
_PIPELINE = """
name = "{name}"
problem = "problem.toml"
[[stage]]
use = "draw-positions"
start = {start}
goal = {goal}
[[stage]]
use = "start-ik"
guess = {guess}
{collision}
[[stage]]
use = "goal-ik"
[[stage]]
use = "at-rest"
end = "start"
[[stage]]
use = "at-rest"
end = "goal"
{stop}
"""


def urdf(links: dict[str, list[str]] = LINKS) -> str:
    """The text of the URDF."""
    inertial = '<inertial><mass value="1"/><inertia ixx="0.01" ixy="0" ixz="0" iyy="0.01" iyz="0" izz="0.01"/></inertial>'
    parts = ['<robot name="crane" version="1.2">']
    for link, shapes in links.items():
        parts.append(f'<link name="{link}">{inertial}')
        parts += [f"<collision>{shape}</collision>" for shape in shapes]
        parts.append("</link>")
    for name, kind, parent, child, place, axis in JOINTS:
        limit = '<limit lower="-2.5" upper="2.5" velocity="2" effort="100"/>'
        parts.append(
            f'<joint name="{name}" type="{kind}"><parent link="{parent}"/><child link="{child}"/>'
        )
        parts.append(f'<origin xyz="{place}"/><axis xyz="{axis}"/>{limit}</joint>')
    return "\n".join([*parts, "</robot>"])


def stl(corners: np.ndarray, sides: list[tuple[int, int, int]]) -> bytes:
    """A mesh as binary STL."""
    found = [
        struct.pack("<12fH", 0, 0, 0, *corners[list(side)].ravel(), 0) for side in sides
    ]
    return bytes(80) + struct.pack("<I", len(sides)) + b"".join(found)


def write_crane(folder: Path, links: dict[str, list[str]] = LINKS) -> Path:
    """Write the arm and its meshes; return the URDF file."""
    meshes = folder / "crane" / "meshes"
    meshes.mkdir(parents=True, exist_ok=True)
    (meshes / "wedge.stl").write_bytes(stl(WEDGE, _SIDES))
    corners = "".join(f"v {x} {y} {z}\n" for x, y, z in CLAW)
    (meshes / "claw.obj").write_text(corners + "f 1 2 3\nf 1 2 4\nf 2 3 4\nf 3 1 4\n")
    file = folder / "crane" / "crane.urdf"
    file.write_text(urdf(links))
    return file


def write_problem(
    folder: Path,
    *,
    robot: str = "",
    obstacles: str = OBSTACLES,
    clearance: str = "",
    more: str = SELF,
) -> Path:
    """Write the arm and a problem about it; return the problem file."""
    write_crane(folder)
    file = folder / "problem.toml"
    file.write_text(
        PROBLEM.format(robot=robot, obstacles=obstacles, clearance=clearance, more=more)
    )
    return file


def write_pipeline(
    folder: Path,
    *,
    name: str = "crane",
    start: str = "[[0.2, 0.7], [-0.5, -0.1], [0.1, 0.6]]",
    goal: str = "[[0.2, 0.7], [0.1, 0.5], [0.1, 0.6]]",
    guess: str = "[[-1.0, 1.0], [-1.0, 0.5], [0.0, 2.0], [-1.0, 1.0]]",
    collision: str = "",
    stop: str = "",
) -> Path:
    """Write a pipeline of motions from rest to rest for the problem in a folder; return the pipeline file."""
    file = folder / "pipeline.toml"
    file.write_text(
        _PIPELINE.format(
            name=name,
            start=start,
            goal=goal,
            guess=guess,
            collision=collision,
            stop=stop,
        )
    )
    return file


# A channel along x: a floor and two walls [m], lowest and highest corners.
BOXES = np.array(
    [
        [[0, -0.05, 0], [0.3, 0.05, 0.01]],
        [[0, -0.05, 0.01], [0.3, -0.04, 0.08]],
        [[0, 0.04, 0.01], [0.3, 0.05, 0.08]],
    ]
)


def box(low: np.ndarray, high: np.ndarray) -> np.ndarray:
    """The triangles of a box, shape (12, 3, 3), facing outwards."""
    corners = (
        np.array([[x, y, z] for x in (0, 1) for y in (0, 1) for z in (0, 1)])
        * (high - low)
        + low
    )
    hull = scipy.spatial.ConvexHull(corners)
    inwards = np.linalg.det(corners[hull.simplices] - (low + high) / 2) < 0
    sides = np.where(inwards[:, None], hull.simplices[:, ::-1], hull.simplices)
    return corners[sides]


@cache
def channel() -> np.ndarray:
    """Return the triangles of the channel, shape (36, 3, 3)."""
    return np.concatenate([box(*each) for each in BOXES])


def arm_of_channels(folder: Path, robot: str = "") -> Problem:
    """Write the arm without obstacles; its forearm is an open channel, which its hull fills."""
    file = write_problem(folder, robot=robot, obstacles="")
    corners = (channel() * [1.5, 4, 4] - [0.1, 0, 0.1]).reshape(-1, 3)
    sides = [(k, k + 1, k + 2) for k in range(0, len(corners), 3)]
    (folder / "crane" / "channel.stl").write_bytes(stl(corners, sides))
    urdf = folder / "crane" / "crane.urdf"
    wedge = 'package://crane/meshes/wedge.stl" scale="0.001 0.001 0.001"'
    urdf.write_text(urdf.read_text().replace(wedge, 'channel.stl"'))
    file.write_text(
        file.read_text().replace('use = "robot-clearance"', 'use = "joint-velocity"')
    )
    return load_problem(file)
