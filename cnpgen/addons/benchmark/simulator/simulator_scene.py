"""Simulated world in MuJoCo's format (MJCF): the arm of the problem's URDF and its environment.

Only listed pairs collide: mallet and puck, mallet and table, puck and bands, held
object or links and obstacles. The puck moves in the plane of the table only. The mallet
is rigid, so the table supports the tip at its height.

Joints and obstacles have numbers as names, because their own names are untrusted input
and MJCF can refer to files.
"""

from collections.abc import Iterator
from dataclasses import dataclass, field

import numpy as np

from cnpgen.addons.benchmark.simulator import hockey
from cnpgen.addons.benchmark.simulator.plant import (
    Plant,
    joint_friction,
    rotor_inertia,
)
from cnpgen.arrays import Array
from cnpgen.problems.constraints.clearance import ObjectContact
from cnpgen.problems.constraints.table import Table
from cnpgen.problems.problem import Problem
from cnpgen.robots.chain import Joint
from cnpgen.robots.obstacle import Obstacle
from cnpgen.robots.obstacle_shapes.convex_solid import Box, Solid
from cnpgen.robots.robot import Robot
from cnpgen.robots.shape.hull import inflated
from cnpgen.robots.solid import solids_of

SIMULATION_STEP_S = 2.5e-4  # four per tick of the controller
LINK_RADIUS_M = 0.07  # of the iiwa's links, about half of the clearance of plans
PUCK_INERTIA = 2.5e-6  # kg m^2; the puck does not turn
# Shorter links have no shape; the first link collides with nothing.
MIN_LINK_LENGTH_M = 1e-3
MAX_ROUND_CORNERS = 2  # of spheres and capsules; other bodies are meshes
UNBOUNDED_DEPTH_M = 5.0  # depth of obstacles without lower end
MALLET_POINT_RADIUS_M = 1e-3  # of the sphere at the tip that collides
SUPPORT_DEPTH_M = 0.05  # half thickness of the body that supports the tip
# Contact of object and obstacles without bouncing.
_SOFT = 'condim="3" solref="0.004 1" solimp="0.95 0.99 0.001"'
# as in the Air Hockey Challenge
_TABLE = 'condim="3" friction="0.08 0.08" solref="0.0125 0.5" solimp="0.9 0.999 0.001"'
_CENTER_M = hockey.HOME_M + hockey.LENGTH_M / 2
_HALF_SIDE_M = (hockey.WIDTH_M - hockey.GOAL_WIDTH_M) / 4
_SIDES = (("left", 1), ("right", -1))
# The bands and the four halves of both goals' sides: centre and half sizes over the
# table [m].
_RIMS = {
    **{
        side: (
            _CENTER_M,
            sign * (hockey.WIDTH_M / 2 + hockey.BAND_M),
            hockey.LENGTH_M / 2,
            hockey.BAND_M,
        )
        for side, sign in _SIDES
    },
    **{
        f"{end} {side}": (
            x,
            sign * (hockey.GOAL_WIDTH_M + hockey.WIDTH_M) / 4,
            hockey.BAND_M,
            _HALF_SIDE_M,
        )
        for end, x in (
            ("home", hockey.HOME_M - hockey.BAND_M),
            ("far", hockey.GOAL_LINE_M + hockey.BAND_M),
        )
        for side, sign in _SIDES
    },
}


@dataclass(frozen=True)
class SimulatorScene:
    """Simulated world: a problem with its robot, deviations of the plant, and poses of the obstacles, shape (width,).

    The puck on the table [m], shape (2,), is None without one; its velocity at the
    start is in m/s. ``table_rotation`` has the table's axes in the world as columns: x,
    y and the normal. ``table_position`` is the origin of its coordinates [m]. The last
    column of ``upright`` is the upright direction.
    """

    problem: Problem
    robot: Robot
    plant: Plant
    obstacle_poses: Array
    puck: Array | None = None
    puck_velocity: tuple[float, float] = (0.0, 0.0)
    table_rotation: Array = field(default_factory=lambda: np.eye(3))
    table_position: Array = field(default_factory=lambda: np.zeros(3))
    upright: Array = field(default_factory=lambda: np.eye(3))

    @property
    def height(self) -> float | None:
        """Height of the tip over the table [m]; None without a table."""
        table = self.problem.first(Table)
        return None if table is None else table.z

    def on_table(self, positions: Array) -> Array:
        """Return positions in the world [m] in coordinates of the table, shape (..., 3)."""
        return np.asarray((positions - self.table_position) @ self.table_rotation)


_SKY_AND_FLOOR = (
    '<texture type="skybox" builtin="gradient" rgb1="0.97 0.98 1" rgb2="0.72 0.8 0.9"'
    ' width="64" height="384"/>'
    '<texture name="floor" type="2d" builtin="checker" rgb1="0.87 0.88 0.9"'
    ' rgb2="0.82 0.83 0.86" width="256" height="256"/>'
    '<material name="floor" texture="floor" texrepeat="16 16"/>'
)


def scene_xml(scene: SimulatorScene) -> str:
    """Write the scene as MJCF."""
    gravity = _numbers(scene.robot.chain.gravity)
    return f"""<mujoco model="{scene.problem.name}">
<compiler angle="radian" autolimits="true"/>
<option timestep="{SIMULATION_STEP_S}" gravity="{gravity}" integrator="implicitfast" cone="elliptic"/>
<visual><global offwidth="1280" offheight="960"/><quality shadowsize="4096"/><map shadowclip="3"/>
<headlight ambient="0.45 0.45 0.45" diffuse="0.35 0.35 0.35"/></visual>
<default><geom contype="0" conaffinity="0" mass="0"/></default>
<asset>{_SKY_AND_FLOOR}{"".join(_meshes(scene))}</asset>
<worldbody>
<light directional="true" pos="1 1 4" dir="-0.25 -0.3 -1" diffuse="0.45 0.45 0.45"/>
<geom type="plane" pos="0 0 -0.5" size="8 8 0.1" material="floor"/>
<geom type="cylinder" fromto="0 0 -0.5 0 0 0.1" size="0.1" rgba="0.4 0.4 0.4 1"/>
{"".join(_arm(scene))}
{"".join(_environment(scene))}
</worldbody>
<contact>
{"".join(_pairs(scene))}
</contact>
</mujoco>"""


def _arm(scene: SimulatorScene) -> Iterator[str]:
    """Yield the nested bodies of the arm.

    The last one has the tip and the attached bodies.
    """
    chain = scene.robot.chain
    last = len(chain.joints) - 1
    ends = [joint.translation for joint in chain.joints[1:]] + [chain.tip_translation]
    rotors = rotor_inertia(scene.robot).tolist()
    for index, (joint, end, friction) in enumerate(
        zip(chain.joints, ends, joint_friction(scene.problem, scene.robot), strict=True)
    ):
        kind = "slide" if joint.prismatic else "hinge"
        place = (
            f'pos="{_numbers(joint.translation)}" quat="{quaternion(joint.rotation)}"'
        )
        yield f'<body name="link {index + 1}" {place}>{_inertial(joint, scene.plant.mass)}'
        yield f'<joint name="joint {index + 1}" type="{kind}" axis="{_numbers(joint.axis)}"'
        rotor = f' armature="{rotors[index]}"' if rotors[index] else ""
        yield f' damping="{friction.viscous}" frictionloss="{friction.dry}"{rotor}/>'
        if np.linalg.norm(end) > MIN_LINK_LENGTH_M:
            is_last = index == last
            radius, color = (
                (0.012, "0.3 0.3 0.3 1")
                if is_last
                else (LINK_RADIUS_M, "1 0.55 0.15 1")
            )
            yield f'<geom name="link {index + 1}" type="capsule" fromto="0 0 0 {_numbers(end)}" size="{radius}"'
            yield f' rgba="{color}"/>'
    yield f'<body name="tip" pos="{_numbers(chain.tip_translation)}" quat="{quaternion(chain.tip_rotation)}">'
    yield '<site name="tip" size="0.001"/>'
    yield f'<geom name="mallet" type="sphere" size="{MALLET_POINT_RADIUS_M}"/>'
    if scene.problem.object_size is not None:
        size = _numbers(
            # MuJoCo's boxes have half edges.
            np.array(scene.problem.object_size) / 2 - _legal_depth(scene.problem)
        )
        yield f'<geom name="object" type="box" size="{size}" rgba="0.2 0.4 0.8 1"/>'
    yield "</body>" * (len(chain.joints) + 1)


def _legal_depth(problem: Problem) -> float:
    """Return the legal penetration of the object [m].

    The colliding shape is smaller by it.
    """
    return max(
        (
            item.depth + item.tolerance
            for item in problem.constraint
            if isinstance(item, ObjectContact)
        ),
        default=0.0,
    )


def _inertial(joint: Joint, mass: float) -> str:
    """Write the inertia of a link about its centre of mass, in joint axes."""
    tensor = mass * joint.inertia
    rows = [
        tensor[0, 0],
        tensor[1, 1],
        tensor[2, 2],
        tensor[0, 1],
        tensor[0, 2],
        tensor[1, 2],
    ]
    numbers = _numbers(np.array(rows))
    return f'<inertial pos="{_numbers(joint.com)}" mass="{mass * joint.mass!r}" fullinertia="{numbers}"/>'


def _environment(scene: SimulatorScene) -> Iterator[str]:
    """Yield the obstacles and, if there is one, the table with its puck."""
    for name, obstacle, solid in _obstacles(scene):
        yield f'<geom name="{name}" {_shape(name, obstacle, solid)} rgba="0.6 0.65 0.7 1"/>'
    if scene.height is None:
        return
    surface = scene.height - hockey.MALLET_HEIGHT_M
    place = f'pos="{_numbers(scene.table_position)}" quat="{quaternion(scene.table_rotation)}"'
    yield f'<body name="table" {place}>'
    yield f'<geom type="box" pos="{_CENTER_M} 0 {surface - 0.02}" rgba="0.97 0.97 1 1"'
    yield f' size="{hockey.LENGTH_M / 2} {hockey.WIDTH_M / 2} 0.02"/>'
    support = scene.height - MALLET_POINT_RADIUS_M - SUPPORT_DEPTH_M
    yield f'<geom name="support" type="box" pos="{_CENTER_M} 0 {support}" rgba="0 0 0 0"'
    yield f' size="{hockey.LENGTH_M / 2} {hockey.WIDTH_M / 2} {SUPPORT_DEPTH_M}"/>'
    for name, (x, y, half_x, half_y) in _RIMS.items():
        yield f'<geom name="{name}" type="box" pos="{x} {y} {surface}" size="{half_x} {half_y} 0.015"'
        yield ' rgba="0.5 0.5 0.5 1"/>'
    if scene.puck is not None:
        yield from _puck(surface, scene.height)
    yield "</body>"
    yield '<body name="shown mallet" mocap="true">'
    yield f'<geom type="cylinder" size="{hockey.MALLET_RADIUS_M} 0.01" pos="0 0 0.01" rgba="0.15 0.15 0.15 1"/>'
    yield f'<geom type="cylinder" size="0.015 {hockey.MALLET_HEIGHT_M / 2}" pos="0 0 {hockey.MALLET_HEIGHT_M / 2}"'
    yield ' rgba="0.15 0.15 0.15 1"/></body>'


def _shape(name: str, obstacle: Obstacle, solid: Solid) -> str:
    """Return shape and pose of an obstacle as MJCF attributes."""
    if isinstance(solid, Box):
        # Obstacles without a lower end are cut far below.
        low = (
            solid.low
            if obstacle.height is not None
            else np.array([*solid.low[:2], solid.high[2] - UNBOUNDED_DEPTH_M])
        )
        return f'type="box" pos="{_numbers((low + solid.high) / 2)}" size="{_numbers((solid.high - low) / 2)}"'
    if len(solid.corners) > MAX_ROUND_CORNERS:
        return f'type="mesh" mesh="{name}"'
    # One corner with a radius is a sphere, two are a capsule.
    kind, key = ("sphere", "pos") if len(solid.corners) == 1 else ("capsule", "fromto")
    ends = _numbers(np.ravel(solid.position + solid.corners))
    return f'type="{kind}" {key}="{ends}" size="{solid.radius!r}"'


def _meshes(scene: SimulatorScene) -> Iterator[str]:
    """Yield the convex hulls of the obstacles that MuJoCo represents by meshes."""
    for name, _, solid in _obstacles(scene):
        if not isinstance(solid, Box) and len(solid.corners) > MAX_ROUND_CORNERS:
            points = inflated(solid.corners, solid.radius)
            corners = _numbers(np.ravel(solid.position + points))
            yield f'<mesh name="{name}" vertex="{corners}"/>'


def _obstacles(scene: SimulatorScene) -> Iterator[tuple[str, Obstacle, Solid]]:
    """Yield name, definition and body of every obstacle."""
    obstacles = scene.problem.obstacle
    for number, pair in enumerate(
        zip(obstacles, solids_of(obstacles, scene.obstacle_poses), strict=True), start=1
    ):
        yield f"obstacle {number}", *pair


def _puck(surface: float, height: float) -> Iterator[str]:
    """Yield the puck: a disc for the bands, and a disc with the sum of both radii for the mallet.

    The coordinates are those of its centre on the table. The larger disc extends from
    below the table to the height at which the mallet's lower face passes over the puck.
    Gravity does not move the puck on a tilted table.
    """
    inertia = f"{PUCK_INERTIA} {PUCK_INERTIA} {2 * PUCK_INERTIA}"
    low = height - 0.05
    high = height + hockey.PUCK_HEIGHT_M
    yield f'<body name="puck" pos="0 0 {surface}" gravcomp="1">'
    yield f'<inertial pos="0 0 0" mass="{hockey.PUCK_MASS_KG}" diaginertia="{inertia}"/>'
    yield f'<joint name="puck x" type="slide" axis="1 0 0" damping="{hockey.PUCK_DRAG_N_S_M}"/>'
    yield f'<joint name="puck y" type="slide" axis="0 1 0" damping="{hockey.PUCK_DRAG_N_S_M}"/>'
    yield f'<geom name="puck" type="sphere" size="{hockey.PUCK_RADIUS_M}" rgba="0 0 0 0"/>'
    yield f'<geom type="cylinder" size="{hockey.PUCK_RADIUS_M} {hockey.PUCK_HEIGHT_M / 2}" rgba="0.85 0.1 0.1 1"'
    yield f' pos="0 0 {hockey.PUCK_HEIGHT_M / 2}"/>'
    # The mallet collides as a small sphere, so the disc has the sum of both radii less
    # the sphere's.
    radius = hockey.PUCK_RADIUS_M + hockey.MALLET_RADIUS_M - MALLET_POINT_RADIUS_M
    yield f'<geom name="reach" type="cylinder" size="{radius} {(high - low) / 2}" rgba="0 0 0 0"'
    yield f' pos="0 0 {(low + high) / 2 - surface}"/></body>'


def _pairs(scene: SimulatorScene) -> Iterator[str]:
    """Yield the colliding pairs."""
    if scene.height is not None:
        yield f'<pair geom1="mallet" geom2="support" {_TABLE}/>'
    if scene.puck is not None:
        k, b = hockey.bounce()
        # Negative numbers of solref are stiffness and damping themselves.
        bouncing = f'condim="1" solref="{-k} {-b}" solimp="0.9999 0.9999 0.001"'
        yield f'<pair geom1="mallet" geom2="reach" {bouncing}/>'
        for name in _RIMS:
            yield f'<pair geom1="puck" geom2="{name}" {bouncing}/>'
    chain = scene.robot.chain
    lengths = [float(np.linalg.norm(joint.translation)) for joint in chain.joints[1:]]
    names = [
        f"link {index}"
        for index, length in enumerate(lengths, start=1)
        if index > 1 and length > MIN_LINK_LENGTH_M
    ]
    names += ["object"] if scene.problem.object_size is not None else []
    for obstacle, _, _ in _obstacles(scene):
        for name in names:
            yield f'<pair geom1="{name}" geom2="{obstacle}" {_SOFT}/>'


def quaternion(rotation: Array) -> str:
    """Write a rotation matrix as MuJoCo's quaternion, scalar first."""
    from scipy.spatial.transform import Rotation

    # SciPy has the scalar last.
    return _numbers(np.roll(Rotation.from_matrix(rotation).as_quat(), 1))


def _numbers(values: Array) -> str:
    """Format numbers without loss of float64 precision."""
    return " ".join(repr(value) for value in np.asarray(values, float).tolist())
