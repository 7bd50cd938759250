"""Constraint: the tip with a fixed orientation in a box, a task space region (Berenson, 2011) without rotation."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import TYPE_CHECKING, Any

import numpy as np

from cnpgen.arrays import Array, Vector3
from cnpgen.problems.constraints.constraint import Condition, Conditions, End
from cnpgen.problems.constraints.tip_manifold import TipManifold, TipRegion
from cnpgen.schema.keys import Range, field

if TYPE_CHECKING:
    from cnpgen.kernels.symbolic.symbolic_state import SymbolicState
    from cnpgen.world.world import World


@dataclass(frozen=True, kw_only=True)
class Pose(TipManifold):
    """Constraint: fixed orientation ``R = R_wanted`` in a box of the world, without rotation at the ends.

    A range of a single point fixes that coordinate. The three values of the orientation
    are the axis times the sine of the angle of ``R_wanted^T R``: angles [rad] to first
    order, and 0 at half a turn, too, which is excluded. The verdict limits this angle,
    so the tolerance of each value is that of the angle divided by the square root of 3.
    """

    reason = "not in its pose"
    inside_name = "pose box"
    held_name = "pose position"
    velocity_name = "velocity out of the pose"
    acceleration_name = "acceleration out of the pose"
    rpy: Vector3 = field(
        "orientation in the world: roll, pitch, yaw, as in a URDF",
        unit="rad",
        plausible=2 * np.pi,
    )
    x: Range | None = field("range of the tip along world x", unit="m", default=None)
    y: Range | None = field("range of the tip along world y", unit="m", default=None)
    z: Range | None = field("range of the tip along world z", unit="m", default=None)
    tolerance: float = field(
        "rotation [rad] or offset [m] that a valid motion may have", low=1e-9
    )

    @cached_property
    def place(self) -> TipRegion:
        """Region of the tip: the box, with fixed directions of zero width."""
        given = [
            (row, each)
            for row, each in zip(np.eye(3), (self.x, self.y, self.z), strict=True)
            if each
        ]
        # A range of one point is an equality; the others are bounds.
        held = [(row, each.low) for row, each in given if each.low == each.high]
        free = [(row, each) for row, each in given if each.low < each.high]
        point = sum((row * value for row, value in held), start=np.zeros(3))
        rows = [[row.tolist() for row, _ in pairs] for pairs in (held, free)]
        return TipRegion(
            point, held=rows[0], bounded=rows[1], ranges=tuple(each for _, each in free)
        )

    @property
    def rotation(self) -> Array:
        """Required rotation, shape (3, 3)."""
        cr, cp, cy = np.cos(self.rpy)
        sr, sp, sy = np.sin(self.rpy)
        roll = np.array([[1, 0, 0], [0, cr, -sr], [0, sr, cr]])
        pitch = np.array([[cp, 0, sp], [0, 1, 0], [-sp, 0, cp]])
        yaw = np.array([[cy, -sy, 0], [sy, cy, 0], [0, 0, 1]])
        # URDF convention, fixed axes: R = Rz(yaw) Ry(pitch) Rx(roll).
        return np.asarray(yaw @ pitch @ roll)

    def symbolic(self, state: "SymbolicState") -> Conditions:
        """State position [m] and orientation [rad]."""
        return (*super().symbolic(state), *self._turned(state.kinematics.rotation))

    def measured(self, world: "World") -> Conditions:
        """Evaluate Pinocchio's tip frame."""
        return (*super().measured(world), *self._turned(list(world.tip_rotation)))

    def judged(self, world: "World") -> Conditions:
        """Evaluate the position [m] and the angle of the orientation [rad]."""
        *position, sines, cosine = self.measured(world)
        # |sine| and cosine determine the angle up to half a turn.
        angle = np.arctan2(np.sqrt(sum(sine**2 for sine in sines.g)), cosine.g[0])
        return (
            *position,
            replace(sines, g=[angle], lower=np.zeros(1), upper=np.zeros(1), parts=()),
        )

    def allowed(self, condition: Condition) -> Array:
        """Return the tolerance of an offset, of the angle, or of each component of the angle."""
        allowed = super().allowed(condition)
        return (
            # Three equal components of size a / sqrt(3) have the norm a.
            allowed / np.sqrt(len(condition.g))
            if condition.name == "orientation"
            else allowed
        )

    def symbolic_at(self, state: "SymbolicState", end: End) -> Conditions:  # noqa: ARG002
        """State position, orientation and their rates."""
        return (*self.symbolic(state), *self._resting(state))

    def measured_at(self, world: "World", end: End) -> Conditions:  # noqa: ARG002
        """Evaluate position, orientation and their rates with Pinocchio."""
        return (*self.measured(world), *self._resting(world))

    def _resting(self, state: "SymbolicState | World") -> Conditions:
        """State that the tip moves along its free directions only and does not turn."""
        zero = np.zeros(3)
        axes = ("x", "y", "z")
        omega = list(state.tip_angular_velocity)
        alpha = list(state.tip_angular_acceleration)
        return (
            *self._moving(state.tip_velocity, state.tip_acceleration),
            Condition("turning", "rad/s", omega, zero, zero, "velocity", axes),
            Condition(
                "turning acceleration",
                "rad/s^2",
                alpha,
                zero,
                zero,
                "acceleration",
                axes,
            ),
        )

    def _turned(self, rotation: Sequence[Any]) -> Conditions:
        wanted = self.rotation
        # R_wanted^T R: the rotation that is left.
        relative = [
            [
                sum(float(wanted[k, i]) * rotation[k][j] for k in range(3))
                for j in range(3)
            ]
            for i in range(3)
        ]
        # Vector of the skew part: axis times the sine of the angle.
        sine = [
            (relative[i][j] - relative[j][i]) / 2 for i, j in ((2, 1), (0, 2), (1, 0))
        ]
        # trace R = 1 + 2 cos(angle).
        cosine = (relative[0][0] + relative[1][1] + relative[2][2] - 1) / 2
        return (
            Condition(
                "orientation",
                "rad",
                sine,
                np.zeros(3),
                np.zeros(3),
                "angle",
                ("x", "y", "z"),
            ),
            Condition(
                "less than a quarter turn",
                "1",
                # The sine is zero at half a turn, too; a positive cosine excludes it.
                [cosine],
                np.zeros(1),
                np.full(1, np.inf),
                "angle",
            ),
        )
