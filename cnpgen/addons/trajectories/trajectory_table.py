"""One trajectory of a file as named columns, before a problem interprets them."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

from numpy.typing import NDArray

from cnpgen.documents import NamedNumbers, Names

Values = NDArray[Any]

# Of a stated rate from that of the file's times, relative.
MAX_RATE_DEVIATION = 0.01


@dataclass(frozen=True, eq=False)
class TrajectoryTable:
    """One trajectory, or several of equal columns, as a file has them.

    Attributes:
        place: The file and the part of it, for messages.
        columns: Name -> values, shape (K,), (K, w) or (N, K, w); texts are kept as
            texts.
        joint_names: Names of the joints of columns with one value per joint; empty if
            the file does not name them.
        lines: Numbers of the lines of a text file, for messages.
        has_head: Whether the file names its columns, which are numbered from 0
            otherwise.
        unused: Further elements of the file that are not read.
        held_joints: Positions of joints that are not planned [rad or m], if the file
            states them.
        start: Positions and velocities (nan if unknown) of joints in the state that a
            message starts from [rad or m, and 1/s].
        robot_name: Name of the robot; empty if the file does not name it.
        has_units: Whether the format defines the units of its columns.
    """

    place: str
    columns: Mapping[str, Values]
    joint_names: Names = ()
    lines: tuple[int, ...] = ()
    has_head: bool = True
    unused: Names = ()
    held_joints: NamedNumbers = field(default_factory=dict)
    start: Mapping[str, tuple[float, float]] = field(default_factory=dict)
    robot_name: str = ""
    has_units: bool = False
