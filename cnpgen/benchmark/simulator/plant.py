"""What the simulated robot has that its controller does not know: friction, other masses, a delay.

Dry and viscous friction of the iiwa's joints are those of the Air Hockey Challenge (2023), whose simulation of the
same arm comes from the laboratory of the real one (docs/references.md). Joints of other names get a share of their
rated torque.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from cnpgen.errors import UsageError, nearest
from cnpgen.problems.problem import Problem
from cnpgen.robots.robot import Robot

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Friction:
    """What brakes one joint.

    Attributes:
        dry: Dry friction [N m].
        viscous: Viscous friction [N m s/rad].
    """

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
DRY, VISCOUS = 2e-3, 1e-3  # of the rated torque, and of it per rad/s: of joints that no figures are known of


@dataclass(frozen=True)
class Plant:
    """A simulated robot.

    Attributes:
        name: Its name.
        title: What is different from what the controller believes, in a line.
        mass: Its masses and inertias are so many times those of the URDF.
        delay: Ticks of the controller, of 1 ms, after which a torque takes effect.
        environment: The folder of somebody else's environment that executes; empty for cnpgen's own.
    """

    name: str
    title: str
    mass: float = 1.0
    delay: int = 0
    environment: str = ""


PLANTS = {
    plant.name: plant
    for plant in (
        Plant("nominal", "friction and damping that the controller does not know"),
        Plant("heavier", "the same with 10 % more mass and inertia", mass=1.1),
        Plant("delayed", "the same with torques that take effect 1 ms late", delay=1),
    )
}


def as_plant(plant: Plant | str) -> Plant:
    """Return a plant by its name.

    Raises:
        UsageError: There is none of this name.
    """
    if isinstance(plant, Plant):
        return plant
    if plant not in PLANTS:
        raise UsageError(f"unknown plant {plant!r}{nearest(plant, PLANTS)}, expected one of {', '.join(PLANTS)}")
    return PLANTS[plant]


def joint_friction(problem: Problem, robot: Robot) -> tuple[Friction, ...]:
    """Return the friction of the planned joints: the iiwa's, or some by the rated torque."""
    if set(robot.joint_names) <= IIWA.keys():
        return tuple(IIWA[name] for name in robot.joint_names)
    return tuple(Friction(DRY * rated, VISCOUS * rated) for rated in rated_torque(problem, robot).tolist())


def rated_torque(problem: Problem, robot: Robot) -> Array:
    """Return the torque limits of the problem or else of the URDF, at which the motors saturate [N m], shape (n,)."""
    return robot.torque_limit / problem.limits.torque_scale
