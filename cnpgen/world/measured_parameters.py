"""Parameters of a sample in Pinocchio's terms: inertia of the load, pose of the table, upright direction."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import TYPE_CHECKING, Any

import numpy as np

from cnpgen.arrays import Array
from cnpgen.robots.chain import frame_of
from cnpgen.robots.parameter_ranges import PAYLOAD_CENTRE, UPRIGHT_TURN
from cnpgen.robots.robot import Robot, reduced_model

if TYPE_CHECKING:
    import pinocchio as pin


class MeasuredParameters:
    """Parameters of the sample of a world; ``set`` replaces them.

    Attributes:
        model: Pinocchio's model with the load of the sample, a copy of the robot's if
            loads differ.
        values: Parameters of the sample, by name.
        scene_values: Values for a constraint (``Constraint.scene_values``); empty if
            none were given.
    """

    def __init__(self, robot: Robot) -> None:
        self._robot = robot
        self.model = robot.model
        self.scene_values: Array = np.empty(0)
        self.values: dict[str, float] = robot.parameters.split(
            np.empty(0), robot.nominal_parameters
        )[1]
        self._turn = np.eye(3)
        self._origin = np.zeros(3)
        self._upright = np.eye(3)
        self._load: tuple[int, pin.Inertia, pin.SE3] | None = None
        if self.changes_payload:
            self._hold_load()

    def set(self, values: Array) -> None:
        """Take the values of a scene after its obstacles: those for a constraint, then parameters, shape (width,)."""
        self.scene_values, self.values = self._robot.parameters.split(
            values, self._robot.nominal_parameters
        )
        if self._load is not None:
            self._set_load()
        if self._robot.parameters.tilts_table:
            self._turn = self._turned("table_roll", "table_pitch")
            self._origin = self._robot.table_origin + np.array(
                [0.0, 0.0, self.values.get("table_height", 0.0)]
            )
        if self._robot.parameters.turns_upright:
            self._upright = self._turned(*UPRIGHT_TURN)

    @property
    def changes_payload(self) -> bool:
        """Whether ``model`` differs from sample to sample."""
        return self._robot.parameters.changes_payload

    def along_world(self, vector: Array) -> Array:
        """Return vectors along the axes of the table along those of the world, shape (3,) or (3, K)."""
        return np.asarray(self._turn @ vector)

    def on_table(self, position: Array) -> Array:
        """Return world positions [m], shape (3,) or (3, K), in the frame of the table, by default the world's."""
        if not self._robot.parameters.tilts_table:
            return position
        # The axes of states come last, so the pivot is repeated for each.
        shape = 3, *[1] * (position.ndim - 1)
        pivot = self._robot.table_origin.reshape(shape)
        return np.asarray(
            self._turn.T @ (position - self._origin.reshape(shape)) + pivot
        )

    def along_table(self, vector: Array) -> Array:
        """Return vectors along the axes of the table, shape (3,) or (3, K)."""
        return (
            np.asarray(self._turn.T @ vector)
            if self._robot.parameters.tilts_table
            else vector
        )

    def along_upright(self, vector: Sequence[Any] | Array) -> Array:
        """Return vectors along axes that parameters turn with the upright direction, shape (3, ...)."""
        if not self._robot.parameters.turns_upright:
            return np.asarray(vector)
        return np.tensordot(self._upright.T, np.asarray(vector), axes=1)

    def _hold_load(self) -> None:
        """Copy the model, and keep the last body without its load."""
        robot = self._robot
        # Without the load, so that a sample's load can be added to the bare body.
        bare = reduced_model(
            robot.urdf,
            robot.urdf_text,
            robot.joint_names,
            replace(robot.attached, payload=None),
        )
        self.model = robot.model.copy()
        frame = bare.frames[frame_of(bare, robot.tip)]
        self._load = (
            frame.parentJoint,
            bare.inertias[frame.parentJoint].copy(),
            frame.placement.copy(),
        )

    def _set_load(self) -> None:
        import pinocchio as pin

        payload = self._robot.attached.payload
        assert self._load is not None
        assert payload is not None
        joint, bare, placement = self._load
        mass = self.values.get("payload_mass", payload.mass)
        centre = [
            self.values.get(name, value)
            for name, value in zip(PAYLOAD_CENTRE, payload.centre, strict=True)
        ]
        shape = payload.inertia_matrix * self.values.get("payload_inertia", 1.0)
        # Inertia of a body of the same shape is proportional to its mass.
        body = pin.Inertia(mass, np.array(centre), shape * (mass / payload.mass))
        self.model.inertias[joint] = bare + placement.act(body)

    def _turned(self, *names: str) -> Array:
        """Return the rotation by two parameters, Ry(pitch) Rx(roll)."""
        import pinocchio as pin

        roll, pitch = (self.values.get(name, 0.0) for name in names)
        return np.asarray(pin.rpy.rpyToMatrix(roll, pitch, 0.0))
