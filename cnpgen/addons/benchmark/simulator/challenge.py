"""Execution in a clone of the Air Hockey Challenge's environment (2023), with its own arm, table and controller.

Two of its classes are used: the environment of one iiwa at the table, and the position
controller at 1 kHz. The controller receives 20 ticks of positions, velocities and
accelerations at a time, each for the end of its tick. The environment simulates no
contact of mallet and table.
"""

import importlib
import sys
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np

from cnpgen.addons.benchmark.simulator.executed import TickRecord, puck_is_done
from cnpgen.addons.benchmark.simulator.plant import Plant, rated_torque
from cnpgen.addons.benchmark.simulator.reference import Reference
from cnpgen.addons.benchmark.simulator.simulator_scene import SimulatorScene
from cnpgen.addons.benchmark.simulator.tip import Tip
from cnpgen.arrays import Array
from cnpgen.errors import MachineError, UsageError
from cnpgen.machine.versions import installed_version
from cnpgen.problems.constraints.table import Table
from cnpgen.problems.problem import Problem
from cnpgen.robots.robot import Robot

MODULE = "air_hockey_challenge.environments.position_control_wrapper"
JOINTS = tuple(f"joint_{number}" for number in range(1, 8))
TICKS_PER_STEP = 20  # of the controller in one step of the environment
CONSTRAINTS = (
    "JointPositionConstraint",
    "JointVelocityConstraint",
    "EndEffectorConstraint",
    "LinkConstraint",
)
PENALTY_POINTS = {
    "joint_pos_constr": 2.0,
    "joint_vel_constr": 1.0,
    "ee_constr": 3.0,
    "link_constr": 3.0,
}
"""Points of an episode that violates a constraint in any step, as in the Challenge's evaluator."""

LIBRARIES = ("numpy", "mujoco", "mushroom-rl")
UNSUPPORTED = (
    AssertionError,
    AttributeError,
    KeyError,
    IndexError,
    TypeError,
    ValueError,
)
"""Errors of the environment's code with other versions of itself or of its libraries."""


def challenge_plant(folder: str | Path) -> Plant:
    """Return the plant of a clone of the environment, which contains the package ``air_hockey_challenge``.

    Raises:
        UsageError: The folder is not a clone.
        MachineError: The environment cannot be imported or is of another version.
    """
    place = Path(folder).resolve()
    module_file = f"{MODULE.replace('.', '/')}.py"
    if not (place / module_file).is_file():
        raise UsageError(
            f"{folder} is no clone of the Air Hockey Challenge's environment: it has no {module_file}",
            concerns="environment",
        )
    plant = Plant(
        "challenge",
        "the environment of the Air Hockey Challenge",
        environment=str(place),
    )
    _environment(plant.environment)
    return plant


def check_challenge(problem: Problem, robot: Robot) -> None:
    """Raise UsageError if a problem is not for an iiwa at the air-hockey table."""
    if problem.first(Table) is None or not set(robot.joint_names) <= set(JOINTS):
        needed = f"a table and an arm with {JOINTS[0]} to {JOINTS[-1]}"
        raise UsageError(
            f"the Air Hockey Challenge has {needed}, {problem.name!r} is another problem"
        )


def execute_in_challenge(
    scene: SimulatorScene, reference: Reference, start_dq: Array
) -> TickRecord:
    """Execute one plan in the environment, with the puck and the planned joints of the scene.

    The robot starts at the first position of the reference with the velocities
    ``start_dq`` [rad/s], shape (n,).

    Raises:
        UsageError: The environment aborted.
        MachineError: The environment cannot be imported or has another version.
    """
    if scene.robot.drive is not None:
        raise UsageError(
            f"the plant {scene.plant.name!r} has drives of its own, {scene.problem.name!r} states others in [drive]",
            concerns="plant",
        )
    environment = _environment(scene.plant.environment)
    try:
        start_q = _all_joints(scene, reference.q[:1])[0]
        start_speed = _all_joints(scene, start_dq[None])[0]
        environment.begin(start_q, start_speed, scene.puck, scene.puck_velocity)
        tick = 0
        done = False
        while not done:
            done = environment.advance(_action(scene, reference, tick))
            tick += TICKS_PER_STEP
            # Violations count up to the end of the plan, not while the puck moves on.
            if tick < reference.ticks + TICKS_PER_STEP:
                environment.count_violations()
            done = tick >= reference.ticks and (
                done or puck_is_done(reference, tick, *environment.puck_state())
            )
        environment.record(np.zeros(len(JOINTS)))
    except RuntimeError as error:
        # The environment turns warnings of MuJoCo into errors.
        raise UsageError(
            f"the Air Hockey Challenge's environment aborted: {error}"
        ) from error
    except UNSUPPORTED as error:
        raise _unsupported(scene.plant.environment, error) from error
    return _tick_record(scene, reference, environment)


def _all_joints(scene: SimulatorScene, values: Array) -> Array:
    """Set joints without plan to zero, shape (K, 7)."""
    all_values = np.zeros((len(values), len(JOINTS)))
    all_values[:, [JOINTS.index(name) for name in scene.robot.joint_names]] = values
    return all_values


def _action(scene: SimulatorScene, reference: Reference, tick: int) -> Array:
    """Return the positions, velocities and accelerations at the ends of the next 20 ticks, shape (20, 3, 7).

    The environment's own interpolation begins at the end of the first tick, too.
    """
    parts = reference.at(np.arange(tick + 1, tick + 1 + TICKS_PER_STEP))
    return np.stack([_all_joints(scene, part) for part in parts], axis=1)


def _tick_record(
    scene: SimulatorScene, reference: Reference, environment: Any
) -> TickRecord:
    """Return the recorded states in the robot's frame."""
    robot = scene.robot
    planned = [JOINTS.index(name) for name in scene.robot.joint_names]
    q, torque, puck, velocity, touched = (
        np.array(column) for column in zip(*environment.recorded, strict=True)
    )
    q = q[:, planned]
    evaluated = Tip(robot)
    tip, rotation, _ = (
        np.array(part) for part in zip(*map(evaluated.at, q), strict=True)
    )
    # The record begins with the state at tick 0.
    desired = reference.at(np.arange(len(q)))[0]
    torque_use = torque[:, planned] / rated_torque(scene.problem, robot)
    unknown_force = np.full((len(q), 2), np.nan)
    steps = dict(environment.violated_steps)
    penalty = sum(
        PENALTY_POINTS.get(name, 0.0) for name, count in steps.items() if count
    )
    return TickRecord(
        q,
        tip,
        rotation,
        desired,
        torque_use,
        puck,
        velocity,
        touched,
        unknown_force,
        0.0,
        steps,
        penalty,
    )


def _unsupported(folder: str, error: Exception) -> MachineError:
    """Return the error for a version of the environment or of its libraries that does not work."""
    installed = ", ".join(
        f"{name} {installed_version(name) or 'missing'}" for name in LIBRARIES
    )
    return MachineError(
        f"{folder} has a version that cnpgen does not support, or its libraries have: {type(error).__name__}: {error};"
        f" installed: {installed}; 'cnpgen docs benchmark' lists versions that work"
    )


@lru_cache(maxsize=1)
def _environment(folder: str) -> Any:
    """Import the environment and construct one with a given start and a recorder."""
    if folder not in sys.path:
        sys.path.insert(0, folder)
    try:
        control = importlib.import_module(MODULE)
        iiwas = importlib.import_module("air_hockey_challenge.environments.iiwas")
        constraints = importlib.import_module("air_hockey_challenge.constraints")
    except (ImportError, OSError, SyntaxError) as error:
        raise MachineError(
            f"{folder} cannot be imported ({error}): install the requirements in its README"
        ) from error
    if not Path(str(control.__file__)).resolve().is_relative_to(folder):
        raise MachineError(
            f"{folder} is hidden by an installed copy: {control.__file__}"
        )
    try:
        kind = type(
            "Recorded",
            (_Recorder, control.PositionControlIIWA, iiwas.AirHockeySingle),
            {},
        )
        environment = kind(interpolation_order=None)
        environment.constraints = [
            getattr(constraints, name)(environment.env_info) for name in CONSTRAINTS
        ]
        still = np.zeros(len(JOINTS))
        environment.begin(still, still, np.array([1.0, 0.0]))
        environment.advance(np.zeros((TICKS_PER_STEP, 3, len(JOINTS))))
        environment.count_violations()
    except UNSUPPORTED as error:
        raise _unsupported(folder, error) from error
    return environment


class _ScalarItems(np.ndarray):
    """Array whose items may be assigned arrays of one number, as NumPy before 2.4 allowed.

    The environment does so with the velocities that it filters.
    """

    def __setitem__(self, key: Any, value: Any) -> None:
        super().__setitem__(key, np.squeeze(value) if np.size(value) == 1 else value)


class _Recorder:
    """Mix-in for the environment's classes: sets the start and records every tick."""

    recorded: list[tuple[Array, ...]]

    def begin(
        self: Any,
        q: Array,
        dq: Array,
        puck: Array,
        velocity: tuple[float, float] = (0.0, 0.0),
    ) -> None:
        """Reset to positions and velocities of the arm, shape (7,), and of the puck [m] and [m/s], shape (2,)."""
        self.recorded = []
        self._start = dq
        self.violated_steps = {constraint.name: 0 for constraint in self.constraints}
        self._frame = np.array(self.env_info["robot"]["base_frame"][0])
        self._puck = (self._frame @ [*puck, 0.0, 1.0])[:2]
        self._puck_velocity = (self._frame[:3, :3] @ [*velocity, 0.0])[:2]
        self.init_state = q
        self.reset()

    def setup(self: Any, obs: Any) -> None:
        """Set puck and velocities; called by the environment in ``reset``."""
        for axis, value, speed in zip(
            "xy", self._puck.tolist(), self._puck_velocity.tolist(), strict=True
        ):
            self._write_data(f"puck_{axis}_pos", value)
            self._write_data(f"puck_{axis}_vel", speed)
        for name, speed in zip(JOINTS, self._start.tolist(), strict=True):
            self._data.joint(f"iiwa_1/{name}").qvel = speed
        if hasattr(self, "q_vel_prev"):
            self.q_vel_prev = self.q_vel_prev.view(_ScalarItems)
        super().setup(obs)  # type: ignore[misc]

    def advance(self: Any, action: Array) -> bool:
        """Take one step; return whether the episode is over."""
        self._observed, _, over, _ = self.step(action)
        return bool(over)

    def count_violations(self: Any) -> None:
        """Count the constraints that the observed positions and velocities after a step violate."""
        q, dq = (
            self._observed[self.env_info[f"joint_{name}_ids"]]
            for name in ("pos", "vel")
        )
        for constraint in self.constraints:
            self.violated_steps[constraint.name] += int(
                np.any(constraint.fun(q, dq) > 0)
            )

    def reward(self, *_: Any) -> float:
        """Return 0; rewards are unused."""
        return 0.0

    def puck_state(self: Any) -> tuple[float, float]:
        """Return the position of the puck along the table [m] and its speed [m/s]."""
        puck, velocity = self._puck_in_robot_frame()
        return float(puck[0]), float(np.linalg.norm(velocity))

    def _compute_action(self: Any, obs: Any, action: Any) -> Any:
        """Record the torque; called by the environment at every tick."""
        torque = super()._compute_action(obs, action)  # type: ignore[misc]
        self.record(np.array(torque))
        return torque

    def record(self: Any, torque: Array) -> None:
        """Record the state and the torques that take effect [N m], shape (7,)."""
        q = np.array(
            [
                float(np.squeeze(self._data.joint(f"iiwa_1/{name}").qpos))
                for name in JOINTS
            ]
        )
        # In the last step of MuJoCo.
        touched = np.array(self._check_collision("puck", "robot_1/ee"))
        self.recorded.append((q, torque, *self._puck_in_robot_frame(), touched))

    def _puck_in_robot_frame(self: Any) -> tuple[Array, Array]:
        """Return the puck's position [m] and velocity [m/s] in the robot's frame, shape (2,) each."""
        place = [
            float(np.squeeze(self._read_data(f"puck_{axis}_pos"))) for axis in "xy"
        ]
        velocity = [
            float(np.squeeze(self._read_data(f"puck_{axis}_vel"))) for axis in "xy"
        ]
        rotation = self._frame[:3, :3].T
        return (rotation @ ([*place, 0.0] - self._frame[:3, 3]))[:2], (
            rotation @ [*velocity, 0.0]
        )[:2]
