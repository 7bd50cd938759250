"""Execution of one plan: simulation under the controller, with a record of every tick and the result."""

import os
import sys
from collections import deque
from dataclasses import dataclass
from functools import lru_cache
from typing import Any

import numpy as np

from cnpgen.addons.benchmark.simulator.challenge import execute_in_challenge
from cnpgen.addons.benchmark.simulator.executed import (
    Executed,
    TickRecord,
    outcome_of,
    puck_is_done,
)
from cnpgen.addons.benchmark.simulator.plant import (
    Plant,
    known_friction,
    rated_torque,
    rotor_inertia,
)
from cnpgen.addons.benchmark.simulator.reference import TICK_S, Reference
from cnpgen.addons.benchmark.simulator.simulator_scene import (
    SIMULATION_STEP_S,
    SimulatorScene,
    scene_xml,
)
from cnpgen.arrays import Array
from cnpgen.errors import RecipeError, requires_extra
from cnpgen.problems.problem import Problem
from cnpgen.robots.robot import Robot

OBSERVATION_TIME_S = 0.2  # after a motion without a puck
# Natural frequency of the closed loop; an error decays within about 1/80 s.
GAIN_RAD_S = 80.0


class Controller:
    """Computed torque, within the rated torques: ``M(q) (ddq* + w^2 (q* - q) + 2 w (dq* - dq)) + h(q, dq)``.

    w is ``GAIN_RAD_S``. If a torque would exceed its limit, the acceleration is scaled
    down in its direction, and the holding torque keeps priority. The robot is nominal,
    with the rotors of its drives and their friction in the direction of the plan: of a
    plant, only the delay counts. ``limit`` has the rated torques [N m], shape (n,).
    """

    def __init__(self, problem: Problem, robot: Robot, plant: Plant) -> None:
        self._model = robot.model.copy()
        self._model.armature = rotor_inertia(robot)
        self._data = self._model.createData()
        self._robot = robot
        self.limit = rated_torque(problem, robot)
        self._delay = plant.delay
        self._delayed: deque[Array] = deque()

    def __call__(
        self, q: Array, dq: Array, desired: tuple[Array, Array, Array]
    ) -> Array:
        """Compute the torque that takes effect now [N m], shape (n,), from the measured and the desired state."""
        import pinocchio as pin

        # Poles of the error are both at -w: critical damping.
        acceleration = (
            desired[2]
            + GAIN_RAD_S**2 * (desired[0] - q)
            + 2 * GAIN_RAD_S * (desired[1] - dq)
        )
        friction = known_friction(self._robot, desired[1])
        holding_torque = np.clip(
            pin.rnea(self._model, self._data, q, dq, np.zeros_like(q)) + friction,
            -self.limit,
            self.limit,
        )
        acceleration_torque = (
            pin.rnea(self._model, self._data, q, dq, acceleration)
            + friction
            - holding_torque
        )
        with np.errstate(divide="ignore", invalid="ignore"):
            # The largest k with |holding torque + k change| within the limit, over all
            # joints. Joints without a change give inf or nan.
            scale = np.nanmin(
                (self.limit - np.sign(acceleration_torque) * holding_torque)
                / np.abs(acceleration_torque)
            )
        torque = holding_torque + min(scale, 1.0) * acceleration_torque
        # The first tick already holds the arm.
        self._delayed.extend([torque] * (self._delay + 1 - len(self._delayed)))
        return self._delayed.popleft()


@dataclass(frozen=True)
class Execution:
    """Record of an execution and its result.

    ``states`` are the positions of all simulated joints, including the puck, shape (K,
    nq), for rendering. The tip [m] has shape (K, 3). The puck over the table [m] has
    shape (K, 2); it is nan without one.
    """

    scene: SimulatorScene
    reference: Reference
    executed: Executed
    states: Array
    tip: Array
    puck: Array


def load_mujoco() -> Any:
    """Import MuJoCo; raise MissingExtraError if it is not installed or broken."""
    if sys.platform == "linux" and not os.environ.get("DISPLAY"):
        # Renders without a screen; read when MuJoCo is imported.
        os.environ.setdefault("MUJOCO_GL", "egl")
    with requires_extra("benchmark", "MuJoCo"):
        import mujoco
    return mujoco


def compile_scene(scene: SimulatorScene) -> Any:
    """Build MuJoCo's model of a scene.

    Raise RecipeError if MuJoCo refuses it, for example impossible inertias.
    """
    try:
        return _compiled(scene_xml(scene))
    except ValueError as error:
        raise RecipeError(
            [f"{scene.problem.name}: MuJoCo cannot simulate it: {error}"]
        ) from error


@lru_cache(maxsize=8)
def _compiled(text: str) -> Any:
    return load_mujoco().MjModel.from_xml_string(text)


def execute(
    scene: SimulatorScene,
    reference: Reference,
    goal_xyz: Array,
    start_dq: Array | None = None,
) -> Execution:
    """Execute one plan, which ends with the tip at ``goal_xyz`` [m], shape (3,).

    The robot starts at the first position of the reference, with the velocities
    ``start_dq`` [rad/s], shape (n,), or those of the reference.
    """
    start_dq = reference.dq[0] if start_dq is None else start_dq
    if scene.plant.environment:
        record = execute_in_challenge(scene, reference, start_dq)
    else:
        record = _Run(scene, reference).simulate(start_dq)
    states = (
        record.q
        if scene.puck is None
        else np.concatenate([record.q, record.puck], axis=1)
    )
    executed = outcome_of(scene, reference, goal_xyz, record)
    return Execution(scene, reference, executed, states, record.tip, record.puck)


class _Run:
    """Simulation of one execution."""

    def __init__(self, scene: SimulatorScene, reference: Reference) -> None:
        self._mujoco = load_mujoco()
        self._scene = scene
        self._reference = reference
        self._model = compile_scene(scene)
        self._data = self._mujoco.MjData(self._model)
        self._control = Controller(scene.problem, scene.robot, scene.plant)
        self._n = scene.robot.n
        self._tip = self._model.site("tip").id
        self._rows: list[tuple[Array, ...]] = []
        self._max_penetration = 0.0  # m
        self._mallet, self._puck, self._table = (
            self._geometry(name) for name in ("mallet", "reach", "support")
        )

    def simulate(self, start_dq: Array) -> TickRecord:
        """Simulate to the end and return the record."""
        data = self._data
        n = self._n
        data.qpos[:n] = self._reference.q[0]
        data.qvel[:n] = start_dq
        if self._scene.puck is not None:
            data.qpos[n:] = self._scene.puck
            data.qvel[n:] = self._scene.puck_velocity
        self._mujoco.mj_forward(self._model, data)
        tick = 0
        while not self._is_over(tick):
            self._step(tick)
            tick += 1
        states, tip, rotation, reference, torque, speeds, touched, force = (
            np.array(column) for column in zip(*self._rows, strict=True)
        )
        puck = states[:, n:]
        velocity = speeds[:, n:]
        if self._scene.puck is None:
            puck = velocity = np.full((len(states), 2), np.nan)
        use = torque / self._control.limit
        return TickRecord(
            states[:, :n],
            tip,
            rotation,
            reference,
            use,
            puck,
            velocity,
            touched,
            force,
            self._max_penetration,
        )

    def _step(self, tick: int) -> None:
        """Record the state, compute the torque, and simulate one tick."""
        data = self._data
        n = self._n
        desired = self._reference.at(tick)
        torque = self._control(data.qpos[:n].copy(), data.qvel[:n].copy(), desired)
        tip = data.site_xpos[self._tip].copy()
        rotation = data.site_xmat[self._tip].reshape(3, 3).copy()
        state = data.qpos.copy(), tip, rotation, desired[0], torque, data.qvel.copy()
        data.qfrc_applied[:n] = torque
        self._mujoco.mj_step(self._model, data, round(TICK_S / SIMULATION_STEP_S))
        # With a puck, all listed contacts are legal.
        if self._scene.puck is None and data.ncon:
            self._max_penetration = max(
                self._max_penetration, float(-data.contact.dist.min())
            )
        self._rows.append((*state, *self._contacts()))

    def _geometry(self, name: str) -> int:
        """Return the number of a geometry; -1 if the scene does not have it."""
        return int(
            self._mujoco.mj_name2id(self._model, self._mujoco.mjtObj.mjOBJ_GEOM, name)
        )

    def _contacts(self) -> tuple[Array, Array]:
        """Return whether the mallet touches the puck, and its normal and friction force on the table [N]."""
        touched = False
        total = np.zeros(2)
        force = np.zeros(6)
        for index in range(self._data.ncon):
            contact = self._data.contact[index]
            pair = {int(contact.geom1), int(contact.geom2)}
            touched |= pair == {self._mallet, self._puck}
            if pair == {self._mallet, self._table}:
                self._mujoco.mj_contactForce(self._model, self._data, index, force)
                total += force[0], np.linalg.norm(force[1:3])
        return np.array(touched), total

    def _is_over(self, tick: int) -> bool:
        """Return whether the result is final."""
        reference = self._reference
        data = self._data
        n = self._n
        if not np.isfinite(data.qpos).all():
            return True
        if tick < reference.ticks:
            return False
        if self._scene.puck is None:
            return tick >= reference.ticks + round(OBSERVATION_TIME_S / TICK_S)
        return puck_is_done(
            reference, tick, float(data.qpos[n]), float(np.linalg.norm(data.qvel[n:]))
        )
