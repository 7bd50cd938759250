"""Plants: deviations of the simulated robot from the nominal model, such as friction, other masses and a delay.

Dry and viscous friction of the iiwa's joints are those of the Air Hockey Challenge
(2023), which simulates the same arm ('cnpgen docs references'). The friction of other
joints is a fraction of their rated torque.
"""

from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np

from cnpgen.arrays import Array
from cnpgen.errors import UsageError, nearest
from cnpgen.problems.problem import Problem
from cnpgen.robots.robot import Robot
from cnpgen.world.drive import friction_bounds


class Friction(NamedTuple):
    """Dry [N m] and viscous [N m s/rad] friction of one joint."""

    dry: float
    viscous: float


IIWA = {
    "joint_1": Friction(0.384477, 0.33032),
    "joint_2": Friction(0.496333, 0.21216),
    "joint_3": Friction(0.173951, 0.1),
    "joint_4": Friction(0.3751, 0.219041),
    "joint_5": Friction(0.481099, 0.185923),
    "joint_6": Friction(0.196149, 0.1),
    "joint_7": Friction(0.299238, 0.1),
}
# Of the rated torque, the second per rad/s; for other joints.
DRY_FRACTION = 2e-3
VISCOUS_FRACTION = 1e-3


@dataclass(frozen=True)
class Plant:
    """A simulated robot.

    Attributes:
        name: Its name.
        title: Deviations from the nominal model, in one line.
        mass: Factor of masses and inertias.
        delay: Delay of torques in ticks of the controller, 1 ms each.
        environment: Folder of an external environment; empty for cnpgen's own
            simulation.
    """

    name: str
    title: str
    mass: float = 1.0
    delay: int = 0
    environment: str = ""


PLANTS = {
    plant.name: plant
    for plant in (
        Plant("nominal", "friction and damping; the controller knows those of [drive]"),
        Plant("heavier", "the same with 10 % more mass and inertia", mass=1.1),
        Plant("delayed", "the same with torques that take effect 1 ms late", delay=1),
    )
}


def as_plant(plant: Plant | str, *, argument: str = "plant") -> Plant:
    """Return a plant by its name; raise UsageError if the name is unknown."""
    if isinstance(plant, Plant):
        return plant
    if not isinstance(plant, str):
        raise UsageError(
            f"must be the name of a plant or a Plant, got {plant!r:.100}",
            argument=argument,
        )
    if plant not in PLANTS:
        raise UsageError(
            f"unknown plant {plant!r}{nearest(plant, PLANTS)}, expected one of {', '.join(PLANTS)}",
            concerns=argument,
        )
    return PLANTS[plant]


def joint_friction(problem: Problem, robot: Robot) -> tuple[Friction, ...]:
    """Return the friction of the planned joints: that of the drives, of the iiwa, or a fraction of the rated torque."""
    if robot.drive is not None:
        terms = robot.drive.coulomb.tolist(), robot.drive.viscous.tolist()
        return tuple(Friction(*each) for each in zip(*terms, strict=True))
    if set(robot.joint_names) <= IIWA.keys():
        return tuple(IIWA[name] for name in robot.joint_names)
    return tuple(
        Friction(DRY_FRACTION * rated, VISCOUS_FRACTION * rated)
        for rated in rated_torque(problem, robot).tolist()
    )


def rated_torque(problem: Problem, robot: Robot) -> Array:
    """Return the torque limits of the problem or else of the URDF, at which the motors saturate [N m], shape (n,)."""
    limit = robot.torque_limit if robot.drive is None else robot.drive.torque_limit
    return limit / problem.limits.torque_scale


def rotor_inertia(robot: Robot) -> Array:
    """Return the inertias of the rotors seen at the joints [kg m^2], shape (n,); zero without drives."""
    return np.zeros(robot.n) if robot.drive is None else robot.drive.armature


def known_friction(robot: Robot, dq: Array) -> Array:
    """Return the friction of the drives at velocities [N m], shape (n,); zero without drives and at rest."""
    if robot.drive is None:
        return np.zeros(robot.n)
    # Both bounds of friction that is certain are its value, but for a reversal.
    certain = replace(robot.drive, friction_help=1.0)
    return np.asarray(np.mean(friction_bounds(certain, dq), axis=0))
