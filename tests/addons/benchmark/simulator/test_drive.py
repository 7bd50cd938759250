"""Drives in the simulation: rotors and friction in the plant and the controller; baselines refuse by name."""

import numpy as np
import pinocchio as pin
import pytest

from cnpgen.addons.benchmark.benchmark_planner import require_rigid_torque
from cnpgen.addons.benchmark.simulator.challenge import execute_in_challenge
from cnpgen.addons.benchmark.simulator.execute import Controller
from cnpgen.addons.benchmark.simulator.plant import (
    PLANTS,
    Plant,
    joint_friction,
    rated_torque,
)
from cnpgen.addons.benchmark.simulator.simulator_scene import SimulatorScene, scene_xml
from cnpgen.errors import UsageError
from cnpgen.problems.load_robot import load_robot
from cnpgen.problems.problem_file import load_problem
from tests.examples.shipped import PROBLEMS, ROBOTS
from tests.refusals import is_refused

mujoco = pytest.importorskip("mujoco")
NAME = "heavy-object-drive"


def scene(plant: Plant = PLANTS["nominal"]) -> SimulatorScene:
    heights = np.full(len(PROBLEMS[NAME].obstacle), -1.0)
    return SimulatorScene(PROBLEMS[NAME], ROBOTS[NAME], plant, heights)


def test_the_plant_has_the_drives_of_the_problem() -> None:
    drive, model = (
        ROBOTS[NAME].drive,
        mujoco.MjModel.from_xml_string(scene_xml(scene())),
    )
    assert drive is not None
    np.testing.assert_allclose(model.dof_armature, drive.armature)
    np.testing.assert_allclose(model.dof_damping, drive.viscous)
    np.testing.assert_allclose(model.dof_frictionloss, drive.coulomb)
    assert [each.dry for each in joint_friction(PROBLEMS[NAME], ROBOTS[NAME])] == list(
        drive.coulomb
    )
    np.testing.assert_allclose(
        rated_torque(PROBLEMS[NAME], ROBOTS[NAME]) * PROBLEMS[NAME].limits.torque_scale,
        drive.torque_limit,
    )


def test_inverse_dynamics_of_the_plant_are_the_torques_of_the_motors() -> None:
    """MuJoCo and Pinocchio share no code; dry friction, which is soft in MuJoCo, is left out."""
    model = mujoco.MjModel.from_xml_string(scene_xml(scene()))
    model.dof_frictionloss[:] = 0
    data, drive = mujoco.MjData(model), ROBOTS[NAME].drive
    reference, random = ROBOTS[NAME].model.createData(), np.random.default_rng(4)
    assert drive is not None
    for _ in range(20):
        q = random.uniform(ROBOTS[NAME].position_lower, ROBOTS[NAME].position_upper)
        dq, ddq = random.uniform(-1, 1, (2, ROBOTS[NAME].n))
        data.qpos[:], data.qvel[:], data.qacc[:] = q, dq, ddq
        mujoco.mj_inverse(model, data)
        torque = pin.rnea(ROBOTS[NAME].model, reference, q, dq, ddq)
        expected = torque + drive.armature * ddq + drive.viscous * dq
        np.testing.assert_allclose(data.qfrc_inverse, expected, atol=1e-6)


def test_the_controller_accelerates_the_rotors() -> None:
    control, drive = (
        Controller(PROBLEMS[NAME], ROBOTS[NAME], PLANTS["nominal"]),
        ROBOTS[NAME].drive,
    )
    assert drive is not None
    q, dq = ROBOTS[NAME].home, np.zeros(ROBOTS[NAME].n)
    data, ddq = ROBOTS[NAME].model.createData(), np.full(ROBOTS[NAME].n, 0.5)
    torque = control(q, dq, (q, dq, ddq))
    rigid = pin.rnea(ROBOTS[NAME].model, data, q, dq, ddq)
    np.testing.assert_allclose(torque, rigid + drive.armature * ddq, atol=1e-9)


def test_the_controller_adds_the_friction_of_the_drives_in_the_direction_of_the_plan() -> (
    None
):
    control, drive = (
        Controller(PROBLEMS[NAME], ROBOTS[NAME], PLANTS["nominal"]),
        ROBOTS[NAME].drive,
    )
    assert drive is not None
    q, zero = ROBOTS[NAME].home, np.zeros(ROBOTS[NAME].n)
    dq = np.array([0.2, -0.2, 0.3, -0.3, 0.1, -0.1, 0.2])  # beyond the reversal speed
    torque = control(q, dq, (q, dq, zero))
    rigid = pin.rnea(ROBOTS[NAME].model, ROBOTS[NAME].model.createData(), q, dq, zero)
    friction = drive.viscous * dq + drive.coulomb * np.sign(dq)
    np.testing.assert_allclose(torque, rigid + friction, atol=1e-9)


def test_parts_without_drives_refuse_by_name() -> None:
    with is_refused(UsageError):
        require_rigid_torque("trajopt", PROBLEMS[NAME], ROBOTS[NAME])
    rigid = load_problem("heavy-object")
    require_rigid_torque("trajopt", rigid, load_robot(rigid))
    strange = scene(Plant("challenge", "another one", environment="folder"))
    with is_refused(UsageError, argument="plant"):
        execute_in_challenge(strange, None, np.zeros(7))  # type: ignore[arg-type]


@pytest.mark.parametrize("name", ["trajopt", "sst", "mpc-mpnet"])
def test_baselines_refuse_drives(name: str) -> None:
    from cnpgen.addons.benchmark.benchmark_planner import Setting, load_planner
    from cnpgen.problems.problem_record import record_problem

    with is_refused(UsageError):
        load_planner(name, {}).prepare(Setting(record_problem(PROBLEMS[NAME])))
