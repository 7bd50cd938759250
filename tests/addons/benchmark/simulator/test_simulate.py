"""Hits that score or miss the goal or the puck; transports with and without collision."""

from dataclasses import replace
from importlib.util import find_spec
from pathlib import Path

import numpy as np
import pinocchio as pin
import pytest

from cnpgen.addons.benchmark.simulator.execute import _Run, execute
from cnpgen.addons.benchmark.simulator.executed import succeeded
from cnpgen.addons.benchmark.simulator.plant import (
    PLANTS,
    as_plant,
    joint_friction,
    rated_torque,
)
from cnpgen.addons.benchmark.simulator.reference import TICK_S, Reference
from cnpgen.addons.benchmark.simulator.simulate import (
    execute_plan,
    simulate_plans,
    simulator_scene,
)
from cnpgen.addons.benchmark.simulator.simulator_scene import SimulatorScene
from cnpgen.addons.benchmark.simulator.tip import Tip
from cnpgen.errors import UsageError
from cnpgen.make.draw_boundary_problems import draw_boundary_problems
from cnpgen.plans import Plans, make_plans
from cnpgen.plans.join import concatenate
from cnpgen.refine.refine_plans import solve_plans
from cnpgen.schema.catalogue import list_recipes
from tests.examples.plans import ROBOTS, load
from tests.refusals import is_refused

pytestmark = pytest.mark.skipif(not find_spec("mujoco"), reason="needs mujoco")


def hit_towards(folder: Path, target: str) -> Plans:
    """Return a valid hit that sends its puck towards a target."""
    recipe = (list_recipes("pipeline")["airhockey-hit"]).read_text(encoding="utf-8")
    path = folder / "pipeline.toml"
    path.write_text(
        recipe.replace("0.3 rad", "0 rad").replace("[2.49, 0] m", target),
        encoding="utf-8",
    )
    solved = solve_plans(draw_boundary_problems(path, 1, seed=3), workers=1)
    assert solved.valid.all()
    return solved.plans


@pytest.fixture(scope="module")
def hit(tmp_path_factory: pytest.TempPathFactory) -> Plans:
    return hit_towards(tmp_path_factory.mktemp("hit"), "[2.49, 0] m")


def stored(label: str) -> Plans:
    plan = load(label)
    return make_plans(
        plan.problem,
        plan.boundary,
        path_control_points=plan.motion.path,
        rate_control_points=plan.motion.rate,
    )


@pytest.mark.parametrize("plant", PLANTS)
def test_a_valid_hit_scores_on_every_plant(hit: Plans, plant: str) -> None:
    (executed,) = simulate_plans(hit, plant=plant, workers=1).executed
    assert executed.success
    assert executed.hit
    assert executed.scored
    assert executed.finished
    assert not executed.touched_early
    assert executed.z_error < 1e-3
    assert executed.hit_time == pytest.approx(float(hit.duration[0]), abs=0.02)
    assert executed.torque_use < 1


def test_a_hit_with_an_angle_error_of_03_rad_does_not_score(tmp_path: Path) -> None:
    plan = hit_towards(tmp_path, "[2.49, 0.47] m")
    goal, (velocity, _, _) = (
        plan.columns["goal_xyz"][0],
        np.array([2.49, 0.0, 0.16]) - plan.columns["goal_xyz"][0],
    )
    (executed,) = simulate_plans(plan, workers=1).executed
    angle = np.arctan2(0.47 - goal[1], 2.49 - goal[0]) - np.arctan2(-goal[1], velocity)
    assert angle == pytest.approx(0.3, abs=0.05)
    assert executed.finished
    assert executed.hit
    assert not executed.scored
    assert not executed.success


def raised(reference: Reference, height: float) -> Reference:
    """Lift the arm, so that the tip passes over the puck."""
    lifted = reference.q.copy()
    lifted[:, 3] += height
    return replace(reference, q=lifted)


def test_a_motion_5_cm_too_high_misses_the_puck(hit: Plans) -> None:
    execution = execute_plan(hit, PLANTS["nominal"])
    scene, reference = execution.scene, execution.reference
    goal = hit.columns["goal_xyz"][0]
    for change in (-0.08, 0.08):
        lifted = execute(scene, raised(reference, change), goal)
        if lifted.tip[reference.ticks, 2] > execution.tip[reference.ticks, 2] + 0.05:
            assert not lifted.executed.hit
            assert not lifted.executed.scored
            return
    raise AssertionError("neither change lifts the tip by 5 cm")


def test_the_puck_is_placed_by_the_tip_frame_if_a_joint_has_the_same_name(
    hit: Plans,
) -> None:
    urdf = hit.problem.urdf.replace(
        'joint name="world_F_base_joint"', 'joint name="striker_tip"'
    )
    assert urdf != hit.problem.urdf
    same = replace(hit, problem=replace(hit.problem, urdf=urdf))
    puck = simulator_scene(hit, PLANTS["nominal"]).puck
    assert puck is not None
    np.testing.assert_array_equal(simulator_scene(same, PLANTS["nominal"]).puck, puck)


def test_a_puck_on_the_path_is_touched_early(hit: Plans) -> None:
    execution = execute_plan(hit, PLANTS["nominal"])
    scene, reference = execution.scene, execution.reference
    goal = hit.columns["goal_xyz"][0]
    halfway = execution.tip[reference.ticks // 2, :2]
    executed = execute(replace(scene, puck=halfway), reference, goal).executed
    assert executed.hit
    assert executed.touched_early
    assert not executed.success


@pytest.mark.parametrize("plant", PLANTS)
def test_an_object_is_carried_without_collision(plant: str) -> None:
    (executed,) = simulate_plans(stored("transport"), plant=plant, workers=1).executed
    assert executed.success
    assert executed.finished
    assert executed.collided is False
    assert executed.hit is None
    assert 0 < executed.vertical_error < 0.05
    assert executed.torque_use < 1


def test_an_object_dragged_through_a_pedestal_collides() -> None:
    execution = execute_plan(stored("transport"), PLANTS["nominal"])
    scene, reference = execution.scene, execution.reference
    higher = replace(scene, obstacle_poses=scene.obstacle_poses + 0.1)
    executed = execute(
        higher, reference, stored("transport").columns["goal_xyz"][0]
    ).executed
    assert executed.collided
    assert not executed.success


@pytest.mark.slow
def test_two_processes_give_the_results_of_one(hit: Plans) -> None:
    plans = concatenate([hit] * 3)
    one, two = (simulate_plans(plans, workers=workers).executed for workers in (1, 2))
    assert [result.to_dict() for result in one] == [result.to_dict() for result in two]
    assert one[0].to_dict() == one[2].to_dict()  # executions are independent


def lowered(reference: Reference, scene: SimulatorScene, depth: float) -> Reference:
    """Command tip positions below the table, by differential inverse kinematics."""
    tip, q = Tip(scene.robot), reference.q.copy()
    for index in range(len(q)):
        share = min(1.0, index / 100)
        for _ in range(3):
            position, _, J = tip.at(q[index])
            target = tip.at(reference.q[index])[0] - [0.0, 0.0, share * depth]
            q[index] += np.linalg.pinv(J[:3]) @ (target - position)
    return replace(reference, q=q, dq=np.gradient(q, TICK_S, axis=0))


def test_a_mallet_commanded_below_the_table_is_supported_and_fails_by_the_plane(
    hit: Plans,
) -> None:
    execution = execute_plan(hit, PLANTS["nominal"])
    scene, reference = execution.scene, execution.reference
    goal = hit.columns["goal_xyz"][0]
    low = execute(scene, lowered(reference, scene, 0.03), goal).executed
    assert low.commanded_plane_error == pytest.approx(0.03, abs=1e-4)
    assert low.plane_error < 0.02  # the table supports the mallet
    assert low.table_force > 10 * execution.executed.table_force
    assert low.table_friction == pytest.approx(0.08 * low.table_force, rel=0.2)
    assert low.scored
    assert not low.success
    values = {
        **low.to_dict(),
        "touched_early": False,
    }  # the executed path is shorter than the commanded one
    assert not succeeded(values, 0.029)
    assert succeeded(values, 0.031)


def test_a_mallet_on_the_table_is_carried_by_it() -> None:
    """Compare the normal force of a mallet at rest, commanded below the table, with the arm's static equilibrium."""
    scene = simulator_scene(
        solve_plans(
            draw_boundary_problems("airhockey-pucks", 1, seed=1), workers=1
        ).plans,
        PLANTS["nominal"],
    )
    base = scene.robot.home
    still = Reference(
        np.repeat(base[None], 500, axis=0),
        np.zeros((500, 6)),
        np.zeros((500, 6)),
        0.499,
    )
    run = _Run(replace(scene, puck=np.array([2.0, 0.0])), lowered(still, scene, 0.002))
    record = run.simulate(np.zeros(6))
    J, force = Tip(scene.robot).at(record.q[499])[2][:3], record.table_force[499, 0]
    holding = pin.computeGeneralizedGravity(
        scene.robot.model, scene.robot.model.createData(), record.q[499]
    )
    torque = record.torque_use[499] * rated_torque(scene.problem, scene.robot)
    excess = np.linalg.lstsq(J.T, holding - torque, rcond=None)[0][2]
    friction = np.abs(np.linalg.pinv(J.T)[2]) @ [
        item.dry for item in joint_friction(scene.problem, scene.robot)
    ]
    assert force > 10
    assert force == pytest.approx(excess, abs=friction + 0.08 * force)


def test_an_invalid_plan_does_not_affect_the_others(hit: Plans) -> None:
    good = hit
    bad = replace(good, rate_control_points=-good.rate_control_points)
    simulation = simulate_plans(concatenate([bad, good]), workers=1)
    assert "cannot be executed" in simulation.executed[0].failure
    assert not simulation.executed[0].success
    assert simulation.executed[1].success
    assert simulation.summary()["success"] == 1
    assert simulation.summary()["plans"] == 2


def test_a_plan_that_cannot_be_stopped_is_not_executed(hit: Plans) -> None:
    rate = hit.rate_control_points.copy()
    rate[:, -1] = 1e9
    (executed,) = simulate_plans(
        replace(hit, rate_control_points=rate), workers=1
    ).executed
    assert "s to stop cannot be executed" in executed.failure


def test_an_unknown_plant_is_refused_by_name() -> None:
    with is_refused(UsageError, argument="plant"):
        as_plant("heavyer")


def test_the_robot_stops_after_a_hit_within_its_limits(hit: Plans) -> None:
    reference = execute_plan(hit, PLANTS["nominal"]).reference
    limit = ROBOTS["airhockey"].acceleration_limit
    after = slice(reference.ticks, None)
    assert np.abs(reference.dq[-1]).max() == 0
    assert np.all(np.abs(reference.ddq[after]) <= limit * (1 + 1e-12))
    step = (
        np.diff(reference.q, axis=0)
        - TICK_S * (reference.dq[1:] + reference.dq[:-1]) / 2
    )
    assert (
        np.abs(step).max() < 1e-5
    )  # consistent positions and velocities, also across the end of the plan


def test_holding_torque_has_priority_if_a_motor_saturates() -> None:
    """Follow a jump of 0.1 rad, which exceeds the motors: the robot arrives late and does not fall."""
    execution = execute_plan(stored("transport"), PLANTS["nominal"])
    scene, reference = execution.scene, execution.reference
    q = np.vstack([reference.q[-1:] - 0.1, np.repeat(reference.q[-1:], 2000, axis=0)])
    jump = Reference(q, np.zeros_like(q), np.zeros_like(q), 2.0)
    without_obstacles = replace(scene, obstacle_poses=scene.obstacle_poses - 2)
    execution = execute(
        without_obstacles, jump, stored("transport").columns["goal_xyz"][0]
    )
    assert execution.executed.torque_use == pytest.approx(1)
    assert execution.executed.finished
