"""One plan executed: the world stepped under the controller, what was seen at every tick, and what came of it."""

import os
import sys
from dataclasses import dataclass, replace
from functools import lru_cache
from typing import Any

import numpy as np
from numpy.typing import NDArray

from cnpgen.errors import MachineError, RecipeError
from cnpgen.judges.plans.metrics import tilt
from cnpgen.simulator import hockey
from cnpgen.simulator.controller import Controller
from cnpgen.simulator.executed import Executed
from cnpgen.simulator.reference import TICK, Reference
from cnpgen.simulator.scene import STEP, Scene, scene_xml

Array = NDArray[np.float64]

NEAR = 0.01  # m: how far from the goal a motion has finished, as the paper counts
LEFT = 0.03  # m: a touch with more of the way left than this is an early one
MOVING = 0.02  # m/s: a puck that is slower lies
DEEP = 1e-3  # m: deeper in an obstacle is a collision
WAIT = 4.0  # s: how long a puck may take to arrive
SETTLE = 0.2  # s: how long is watched after a motion without a puck


@dataclass(frozen=True)
class Execution:
    """What happened, tick by tick, and what came of it.

    Attributes:
        executed: What came of it.
        states: Positions of all joints of the simulation, the puck's among them, shape (K, nq): for pictures.
        tip: Positions of the tip [m], shape (K, 3).
        puck: Positions of the puck over the table [m], shape (K, 2); nan without one.
    """

    executed: Executed
    states: Array
    tip: Array
    puck: Array


def load_mujoco() -> Any:
    """Import MuJoCo.

    Raises:
        MachineError: It is not installed, or broken.
    """
    if sys.platform == "linux" and not os.environ.get("DISPLAY"):
        os.environ.setdefault("MUJOCO_GL", "egl")  # pictures without a screen; it is read when MuJoCo is imported
    try:
        import mujoco
    except (ImportError, OSError, AttributeError) as error:
        raise MachineError(f"MuJoCo cannot be imported ({error}): pip install 'cnpgen[benchmark]'") from error
    return mujoco


def compile_scene(scene: Scene) -> Any:
    """Build MuJoCo's model of a scene.

    Raises:
        RecipeError: MuJoCo refuses it: inertias of the URDF that no body can have, for example.
        MachineError: MuJoCo is missing.
    """
    try:
        return _compiled(scene_xml(scene))
    except ValueError as error:
        raise RecipeError([f"{scene.problem.name}: MuJoCo cannot simulate it: {error}"]) from error


@lru_cache(maxsize=8)
def _compiled(text: str) -> Any:
    return load_mujoco().MjModel.from_xml_string(text)


def execute(scene: Scene, reference: Reference, goal_xyz: Array, start_dq: Array | None = None) -> Execution:
    """Execute one plan.

    Args:
        scene: The world.
        reference: What the controller is to follow; the robot begins at its first position.
        goal_xyz: Where the tip must be at the end of the plan [m], shape (3,).
        start_dq: The robot's velocities at the start [rad/s], shape (n,); those of the reference by default.

    Raises:
        RecipeError: As ``compile_scene`` does.
        MachineError: Likewise.
    """
    return _Run(scene, reference, goal_xyz).execution(reference.dq[0] if start_dq is None else start_dq)


class _Run:
    """A world while it is stepped."""

    def __init__(self, scene: Scene, reference: Reference, goal_xyz: Array) -> None:
        self._mujoco = load_mujoco()
        self._scene, self._reference, self._goal = scene, reference, goal_xyz
        self._model = compile_scene(scene)
        self._data = self._mujoco.MjData(self._model)
        self._control = Controller(scene.problem, scene.robot, scene.plant)
        self._n = scene.robot.n
        self._tip = self._model.site("tip").id
        self._seen: list[tuple[Array, ...]] = []
        self._deepest = 0.0  # m

    def execution(self, start_dq: Array) -> Execution:
        """Run to the end."""
        data, n = self._data, self._n
        data.qpos[:n], data.qvel[:n] = self._reference.q[0], start_dq
        if self._scene.puck is not None:
            data.qpos[n:] = self._scene.puck
        self._mujoco.mj_forward(self._model, data)
        tick = 0
        while not self._is_over(tick):
            self._step(tick)
            tick += 1
        states, tip, *_ = (np.array(values) for values in zip(*self._seen, strict=True))
        puck = states[:, n:] if self._scene.puck is not None else np.full((len(states), 2), np.nan)
        return Execution(self._result(), states, tip, puck)

    def _step(self, tick: int) -> None:
        """See what there is, decide on a torque, and let a tick pass."""
        data, n, last = self._data, self._n, len(self._reference.q) - 1
        reference, k = self._reference, min(tick, last)
        still = 0.0 if tick > last else 1.0
        wanted = (reference.q[k], still * reference.dq[k], still * reference.ddq[k])
        torque = self._control(data.qpos[:n].copy(), data.qvel[:n].copy(), wanted)
        tip, rotation = data.site_xpos[self._tip].copy(), data.site_xmat[self._tip].reshape(3, 3).copy()
        self._seen.append((data.qpos.copy(), tip, rotation, wanted[0], torque, data.qvel[n:].copy()))
        data.qfrc_applied[:n] = torque
        self._mujoco.mj_step(self._model, data, round(TICK / STEP))
        if self._scene.puck is None and data.ncon:
            self._deepest = max(self._deepest, float(-data.contact.dist.min()))

    def _is_over(self, tick: int) -> bool:
        """Whether nothing can change the result any more."""
        ticks, data, n = self._reference.ticks, self._data, self._n
        if not np.isfinite(data.qpos).all():
            return True
        if tick < ticks:
            return False
        if self._scene.puck is None:
            return tick >= ticks + round(SETTLE / TICK)
        x, speed = float(data.qpos[n]), float(np.linalg.norm(data.qvel[n:]))
        stopped = tick > len(self._reference.q) and speed < MOVING
        return stopped or x > hockey.FAR + hockey.PUCK_RADIUS or tick > ticks + round(WAIT / TICK)

    def _result(self) -> Executed:
        ticks = min(self._reference.ticks, len(self._seen))
        states, tip, rotation, wanted, torque, _ = (np.array(values) for values in zip(*self._seen, strict=True))
        q, during = states[:, : self._n], slice(0, ticks)
        height = self._scene.height
        share = np.abs(torque) / self._control.limit
        common = Executed(
            finished=bool(np.linalg.norm(tip[ticks - 1] - self._goal) < NEAR),
            z_error=np.nan if height is None else TICK * float(np.abs(tip[during, 2] - height).sum()),
            vertical_error=np.nan
            if height is not None
            else TICK * float(tilt(rotation[during].transpose(1, 2, 0)).sum()),
            tracking_error=TICK * float(np.abs(q[during] - wanted[during]).sum()),
            torque_use=float(share.max()),
        )
        if self._scene.puck is None:
            return replace(common, collided=self._deepest > DEEP)
        return self._of_the_puck(common, states[:, self._n :], tip[during])

    def _of_the_puck(self, common: Executed, puck: Array, tip: Array) -> Executed:
        """Add what became of the puck."""
        speed = np.array([np.linalg.norm(seen[5]) for seen in self._seen])
        moved = np.flatnonzero(speed > MOVING)
        if not len(moved):
            return replace(common, hit=False, scored=False, touched_early=False)
        first = int(moved[0])
        steps = np.linalg.norm(np.diff(tip[first:], axis=0), axis=1)
        away = speed[first : first + round(10 * hockey.CONTACT_TIME / TICK)]
        return replace(
            common,
            hit=True,
            scored=bool(np.any((puck[:, 0] > hockey.FAR) & (np.abs(puck[:, 1]) < hockey.GOAL_WIDTH / 2))),
            touched_early=float(steps.sum()) > LEFT,
            hit_time=first * TICK,
            puck_speed=float(away.max()),
        )
