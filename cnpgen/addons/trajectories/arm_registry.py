"""Arms whose recordings are checked: joints, limits with their sources, and errors of their sensors.

The registry is data (``arms.toml``). A limit that the vendor does not state can never
exclude an episode.
"""

import tomllib
from collections.abc import Mapping
from dataclasses import dataclass
from functools import cache
from importlib.resources import files

import numpy as np

from cnpgen.arrays import Array
from cnpgen.documents import JsonMapping, JsonObject, Names
from cnpgen.errors import UsageError, either, nearest

BY_POSITION = "slope", "offset", "lower_end", "upper_end"  # of velocity limits
VENDOR = "vendor"  # the basis of a limit that is a fact
QUANTITIES = {"position": "rad", "velocity": "rad/s", "acceleration": "rad/s^2"}


@dataclass(frozen=True, eq=False)
class ArmLimit:
    """Limits of n joints.

    Attributes:
        lower: Smallest values in SI units, shape (n,).
        upper: Largest values, shape (n,).
        basis: Who states them: "vendor", "urdf" or "guess".
        source: Document that states them.
        by_position: Slopes, offsets, lower and upper ends of velocity limits that depend
            on the position, shape (4, n); see ``velocity_by_position``.
    """

    lower: Array
    upper: Array
    basis: str
    source: str
    by_position: Array | None = None


@dataclass(frozen=True, eq=False)
class RecordedArm:
    """Arm of the registry.

    Attributes:
        name: Its name.
        joints: Names of its joints.
        limits: Quantity -> limits; a limit without a source is absent.
        noise: Largest error of its positions [rad], or None if no source states it.
        noise_source: Document that states the noise.
        steps_per_turn: Steps of an encoder per turn, or None.
        is_normalized: Whether its recordings usually hold shares of a calibrated range.
    """

    name: str
    joints: Names
    limits: Mapping[str, ArmLimit]
    noise: float | None
    noise_source: str
    steps_per_turn: int | None
    is_normalized: bool


def find_arm(name: str) -> RecordedArm:
    """Return the arm of a name or a type of robot; raise UsageError for an unknown one."""
    arm = known_arm(name)
    if arm is None:
        names = tuple(_registry())
        text = f"expected {either(names)}{nearest(name, names)}"
        raise UsageError(f"{name!r} is not a known arm: {text}", concerns="arm")
    return arm


def known_arm(name: str) -> RecordedArm | None:
    """Return the arm of a name or a type of robot, or None."""
    found = name.lower().replace("-", "_")
    return next(
        (
            _arm(key, data)
            for key, data in _registry().items()
            if found in data["names"]
        ),
        None,
    )


@cache
def _registry() -> dict[str, JsonObject]:
    text = files("cnpgen.addons.trajectories").joinpath("arms.toml").read_text("utf-8")
    return tomllib.loads(text)


def _arm(name: str, data: JsonMapping) -> RecordedArm:
    limits = {}
    for quantity in QUANTITIES:
        if quantity in data:
            entry = data[quantity]
            upper = np.array(entry["upper"], float)
            lower = np.array(entry.get("lower", -upper), float)
            by_position = (
                np.array([entry[key] for key in BY_POSITION], float)
                if BY_POSITION[0] in entry
                else None
            )
            limits[quantity] = ArmLimit(
                lower, upper, entry["basis"], entry["source"], by_position
            )
    noise = data.get("noise", {})
    return RecordedArm(
        name,
        tuple(data["joints"]),
        limits,
        noise.get("value"),
        noise.get("source", ""),
        data.get("steps_per_turn"),
        data.get("normalized", False),
    )
