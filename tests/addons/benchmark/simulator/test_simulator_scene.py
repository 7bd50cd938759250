"""The simulated arm, compared with Pinocchio: dynamics, kinematics, energy and distances."""

from dataclasses import replace
from pathlib import Path
from xml.sax.saxutils import quoteattr

import numpy as np
import pinocchio as pin
import pytest

from cnpgen.addons.benchmark.simulator import hockey
from cnpgen.addons.benchmark.simulator.execute import Controller
from cnpgen.addons.benchmark.simulator.plant import PLANTS, Plant
from cnpgen.addons.benchmark.simulator.simulator_scene import SimulatorScene, scene_xml
from cnpgen.problems.load_robot import load_robot
from cnpgen.robots.robot_spec import Payload
from cnpgen.robots.solid import place_obstacles
from cnpgen.schema.keys import PerJoint
from cnpgen.world.world import World
from tests.examples.obstacles import KINDS, draw_obstacle
from tests.examples.plans import PROBLEMS, ROBOTS

mujoco = pytest.importorskip("mujoco")


def scene(name: str, plant: Plant = PLANTS["nominal"]) -> SimulatorScene:
    return SimulatorScene(
        PROBLEMS[name], ROBOTS[name], plant, np.full(len(PROBLEMS[name].obstacle), -1.0)
    )


def without_friction(simulated: SimulatorScene, step: float = 1e-4) -> "mujoco.MjModel":
    model = mujoco.MjModel.from_xml_string(scene_xml(simulated))
    model.dof_damping[:], model.dof_frictionloss[:], model.opt.timestep = 0, 0, step
    return model


def with_tool() -> SimulatorScene:
    """Define a tool, a payload and torque limits in the problem, not in the URDF."""
    shipped = PROBLEMS["heavy-object"]
    problem = replace(
        shipped,
        robot=replace(
            shipped.robot, tip_offset=(0.1, -0.05, 0.2), tip_rotation=(0.3, -0.4, 0.5)
        ),
        payload=Payload(mass=2.5, centre=(0.01, 0.02, 0.03), size=(0.1, 0.2, 0.3)),
        limits=replace(
            shipped.limits,
            torque=PerJoint((300.0, 300.0, 200.0, 200.0, 150.0, 60.0, 50.0)),
        ),
    )
    return SimulatorScene(
        problem,
        load_robot(problem),
        PLANTS["nominal"],
        np.full(len(problem.obstacle), -1.0),
    )


def test_a_tool_and_a_payload_of_the_problem_are_simulated() -> None:
    compare_with_pinocchio(with_tool())


def test_names_of_joints_and_obstacles_are_not_written(tmp_path: Path) -> None:
    """Use names that would include a file if they were written to the MJCF text."""
    name = f'x"/><include file="{tmp_path / "private.xml"}"/><geom name="'
    shipped, robot = PROBLEMS["heavy-object"], ROBOTS["heavy-object"]
    problem = replace(
        shipped,
        robot=replace(shipped.robot, joints=(name, *shipped.robot.joints[1:])),
        obstacle=tuple(
            replace(obstacle, name=f"{name}{number}")
            for number, obstacle in enumerate(shipped.obstacle)
        ),
    )
    text = robot.urdf_text.replace('"joint_1"', quoteattr(name))
    urdf = tmp_path / "arm.urdf"
    urdf.write_text(text, encoding="utf-8")
    problem = replace(problem, robot=replace(problem.robot, urdf=str(urdf)))
    strange = SimulatorScene(
        problem,
        load_robot(problem),
        PLANTS["nominal"],
        np.full(len(problem.obstacle), -1.0),
    )
    assert "private" not in scene_xml(strange)
    assert mujoco.MjModel.from_xml_string(scene_xml(strange)).nq == 7


def test_motors_saturate_at_the_torques_of_the_problem() -> None:
    tool = with_tool()
    control = Controller(tool.problem, tool.robot, tool.plant)
    still = np.zeros(tool.robot.n)
    torques = [
        control(tool.robot.home, still, (tool.robot.home + offset, still, still))
        for offset in 10 * np.eye(7)
    ]
    assert tool.problem.limits.torque is not None
    limit = np.array(tool.problem.limits.torque.values)
    for torque in torques:
        assert np.max(np.abs(torque) / limit) == pytest.approx(1)


@pytest.mark.parametrize("name", PROBLEMS)
def test_inverse_dynamics_and_tip_equal_those_of_pinocchio(name: str) -> None:
    compare_with_pinocchio(scene(name))


def compare_with_pinocchio(simulated: SimulatorScene) -> None:
    robot, model = simulated.robot, without_friction(simulated)
    data, other = mujoco.MjData(model), robot.model.createData()
    random = np.random.default_rng(0)
    for _ in range(20):
        q = random.uniform(robot.position_lower, robot.position_upper)
        dq, ddq = random.normal(size=(2, robot.n))
        data.qpos[: robot.n], data.qvel[: robot.n], data.qacc[: robot.n] = q, dq, ddq
        mujoco.mj_inverse(model, data)
        np.testing.assert_allclose(
            data.qfrc_inverse[: robot.n],
            pin.rnea(robot.model, other, q, dq, ddq),
            atol=1e-9,
        )
        pin.framesForwardKinematics(robot.model, other, q)
        tip = other.oMf[robot.tip_frame]
        np.testing.assert_allclose(data.site("tip").xpos, tip.translation, atol=1e-12)
        np.testing.assert_allclose(
            data.site("tip").xmat.reshape(3, 3), tip.rotation, atol=1e-12
        )


@pytest.mark.parametrize("name", PROBLEMS)
def test_a_falling_arm_conserves_energy(name: str) -> None:
    robot, model = ROBOTS[name], without_friction(scene(name))
    model.opt.integrator = mujoco.mjtIntegrator.mjINT_RK4
    data, other = mujoco.MjData(model), robot.model.createData()
    data.qpos[: robot.n] = robot.home + 0.3
    first = pin.computeMechanicalEnergy(
        robot.model, other, data.qpos[: robot.n].copy(), np.zeros(robot.n)
    )
    mujoco.mj_step(model, data, 4000)
    q, dq = data.qpos[: robot.n].copy(), data.qvel[: robot.n].copy()
    assert pin.computeKineticEnergy(robot.model, other, q, dq) > 1  # the arm moves
    assert pin.computeMechanicalEnergy(robot.model, other, q, dq) == pytest.approx(
        first, abs=1e-5
    )


def test_friction_dissipates_energy() -> None:
    robot = ROBOTS["airhockey"]
    model = mujoco.MjModel.from_xml_string(scene_xml(scene("airhockey")))
    data, other = mujoco.MjData(model), robot.model.createData()
    data.qpos[: robot.n] = robot.home + 0.3
    first = pin.computeMechanicalEnergy(
        robot.model, other, data.qpos[: robot.n].copy(), np.zeros(robot.n)
    )
    mujoco.mj_step(model, data, 1600)
    last = pin.computeMechanicalEnergy(
        robot.model, other, data.qpos[: robot.n].copy(), data.qvel[: robot.n].copy()
    )
    assert last < first - 0.1


def test_a_heavier_plant_has_a_tenth_more_mass() -> None:
    mass = {
        name: mujoco.MjModel.from_xml_string(
            scene_xml(scene("heavy-object", PLANTS[name]))
        ).body_mass.sum()
        for name in ("nominal", "heavier")
    }
    moving = sum(joint.mass for joint in ROBOTS["heavy-object"].chain.joints)
    assert mass["nominal"] == pytest.approx(moving, rel=1e-12)
    assert mass["heavier"] == pytest.approx(1.1 * moving, rel=1e-12)


@pytest.mark.parametrize("restitution", [0.5, 0.75, 0.95])
def test_a_bounce_has_the_given_restitution(
    restitution: float, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Compare the speeds of a puck before and after a band, which cannot move."""
    k, b = hockey.bounce(restitution)
    monkeypatch.setattr(hockey, "bounce", lambda: (k, b))
    hit = SimulatorScene(
        PROBLEMS["airhockey"],
        ROBOTS["airhockey"],
        PLANTS["nominal"],
        np.empty(0),
        np.zeros(2),
    )
    model = mujoco.MjModel.from_xml_string(scene_xml(hit))
    model.dof_damping[-2:] = 0
    data = mujoco.MjData(model)
    data.qpos[-2:], data.qvel[-2:] = (
        (1.5, hockey.WIDTH_M / 2 - hockey.PUCK_RADIUS_M - 0.05),
        (0.0, 2.0),
    )
    mujoco.mj_step(model, data, 400)
    assert -data.qvel[-1] == pytest.approx(2.0 * restitution, abs=0.07)


@pytest.mark.parametrize("kind", KINDS)
def test_distances_to_obstacles_of_every_kind_equal_those_of_the_judge(
    kind: str,
) -> None:
    problem, robot = PROBLEMS["heavy-object"], ROBOTS["heavy-object"]
    random = np.random.default_rng(6)
    obstacles = tuple(draw_obstacle(kind, random, spread=0.5) for _ in range(3))
    problem = replace(problem, obstacle=obstacles)
    obstacle_poses = place_obstacles(problem.obstacle)
    model = mujoco.MjModel.from_xml_string(
        scene_xml(SimulatorScene(problem, robot, PLANTS["nominal"], obstacle_poses))
    )
    data, world = (
        mujoco.MjData(model),
        World(robot, problem.obstacle, problem.object_size),
    )
    held, zero = (
        mujoco.mj_name2id(model, mujoco.mjtObj.mjOBJ_GEOM, "object"),
        np.zeros(robot.n),
    )
    for q in random.uniform(robot.position_lower, robot.position_upper, (20, robot.n)):
        world.set_state(q, zero, zero, obstacle_poses)
        data.qpos[:] = q
        mujoco.mj_kinematics(model, data)
        for index, expected in enumerate(world.object_distances()):
            geom = mujoco.mj_name2id(
                model, mujoco.mjtObj.mjOBJ_GEOM, f"obstacle {index + 1}"
            )
            distance = mujoco.mj_geomDistance(model, data, held, geom, 10.0, None)
            if expected > 0.01:  # the simulated object is 2 mm smaller on every side
                assert 0 <= distance - expected < 0.004
