"""Metrics of the paper's tables, and the paper's own rules for valid plans."""

from dataclasses import replace

import numpy as np
import pytest
import scipy

from cnpgen.robots.obstacle import Obstacle
from tests.examples.plans import load, reference_trajectory


@pytest.mark.parametrize("label", ["hit", "replan", "transport", "dragging"])
def test_metrics_agree_with_an_independent_integration(label):
    plan = load(label)
    metrics, seen, robot = (
        plan.judged().metrics,
        reference_trajectory(plan, 20001),
        plan.robot,
    )
    assert metrics.duration == pytest.approx(seen.t[-1], rel=1e-10)
    assert metrics.duration == pytest.approx(plan.motion.duration()[0], rel=1e-10)
    assert metrics.effort == pytest.approx(
        seen.integral(np.sum((seen.tau / robot.torque_limit) ** 2, axis=1)), rel=1e-4
    )
    assert metrics.jerk == pytest.approx(
        np.abs(seen.jerk / (5 * robot.acceleration_limit)).max(), rel=1e-2
    )
    if plan.problem.name == "airhockey":
        assert metrics.z_error == pytest.approx(
            seen.integral(np.abs(seen.tip[:, 2] - 0.16)), rel=1e-4
        )
        speed = np.linalg.norm(seen.tip[-1] - seen.tip[-2]) / (seen.t[-1] - seen.t[-2])
        assert metrics.hit_speed == pytest.approx(speed, rel=1e-3)
        assert np.isnan(metrics.vertical_error)
    else:
        roll, pitch, _ = (
            scipy.spatial.transform.Rotation.from_matrix(seen.rotation)
            .as_euler("xyz")
            .T
        )
        assert metrics.vertical_error == pytest.approx(
            seen.integral(np.abs(roll) + np.abs(pitch)), rel=1e-4
        )
        assert metrics.hit_speed == pytest.approx(0.0, abs=1e-9)
        assert np.isnan(metrics.z_error)


def test_metrics_have_the_units_of_the_papers_tables():
    metrics = load("hit").judged().metrics.to_dict()
    assert set(metrics) == {
        "duration_s",
        "effort_s",
        "jerk",
        "hit_speed_m_s",
        "z_error_mm_s",
    }
    assert metrics["z_error_mm_s"] == pytest.approx(0.304, abs=1e-3)
    assert "vertical_error_rad_s" in load("transport").judged().metrics.to_dict()


# --- the paper's rules -----------------------------------------------------------------------------------------------


def test_a_plan_slightly_over_the_planning_limits_is_valid_by_the_papers_rules_only():
    plan = load("hit")
    robot = plan.robot
    tight = replace(
        robot,
        velocity_limit=0.85 * robot.velocity_limit,
        acceleration_limit=0.85 * robot.acceleration_limit,
    )
    verdict = replace(plan, robot=tight).judged()
    assert not verdict.valid
    assert verdict.paper.valid
    tighter = replace(robot, velocity_limit=0.79 * robot.velocity_limit)
    assert replace(plan, robot=tighter).judged().paper.broken == (
        "joint velocity limit",
    )


def test_the_nominal_limits_follow_from_the_problems_scales():
    plan = load("hit")
    limits = replace(plan.problem.limits, velocity_scale=0.5)
    half = replace(
        plan.robot,
        velocity_limit=0.51 * plan.robot.velocity_limit,
        acceleration_limit=0.51 * plan.robot.acceleration_limit,
    )
    assert (
        replace(plan, robot=half, problem=replace(plan.problem, limits=limits))
        .judged()
        .paper.valid
    )
    assert replace(plan, robot=half).judged().paper.broken == (
        "joint velocity limit",
        "joint acceleration limit",
    )


@pytest.mark.parametrize(("z", "valid"), [(0.169, True), (0.1715, False)])
def test_the_paper_accepts_a_centimeter_of_table_height_error(z, valid):
    verdict = load("replan").with_constraint("Table", z=z).judged()
    assert not verdict.valid
    assert verdict.paper.valid == valid
    assert verdict.paper.broken == (() if valid else ("off the table",))


def test_the_paper_ignores_accelerations_of_a_heavy_object():
    plan = load("transport")
    slow = replace(plan.robot, acceleration_limit=0.1 * plan.robot.acceleration_limit)
    verdict = replace(plan, robot=slow).judged()
    assert verdict.reason == "joint acceleration limit"
    assert verdict.paper.valid


def test_the_paper_accepts_two_centimeters_of_penetration():
    verdict = load("dragging").judged()
    assert not verdict.valid
    assert verdict.paper.valid
    plan = load("transport")
    raised = replace(plan, start_xyz=plan.start_xyz + np.array([0, 0, 0.03]))
    assert "object in collision" in raised.judged().paper.broken


def test_a_plan_that_does_not_end_at_the_goal_is_not_finished():
    plan = load("transport")
    away = replace(plan, goal_xyz=plan.goal_xyz + np.array([0.02, 0, 0])).judged()
    assert not away.paper.finished
    assert not away.paper.valid
    assert away.valid  # its joints meet the boundary conditions
    assert (
        replace(plan, goal_xyz=plan.goal_xyz + np.array([0.005, 0, 0]))
        .judged()
        .paper.finished
    )


@pytest.mark.parametrize(
    ("lower", "valid", "paper"),
    [(0.0, True, True), (-0.01, False, True), (-0.03, False, False)],
)
def test_pedestals_of_another_kind_follow_the_same_rules(lower, valid, paper):
    plan = load("transport")
    places = {"start": plan.start_xyz[0], "goal": plan.goal_xyz[0]}
    stands = tuple(
        Obstacle(
            name=end,
            kind="cylinder",
            radius=0.2,
            length=0.3,
            position=(x, y, -lower),
            below=end,
        )
        for end, (x, y, _) in places.items()
    )
    verdict = replace(plan, problem=replace(plan.problem, obstacle=stands)).judged()
    assert verdict.paper.valid == paper
    assert ("object in collision" in verdict.paper.broken) == (not paper)
    assert valid or not verdict.valid
