"""Verdicts: valid plans pass, and every violation is reported with its name, place and size."""

import json
import subprocess
import sys
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import pytest

from cnpgen.judges.plans import Reason, judge
from cnpgen.problems.constraints.constraint import Condition, Constraint
from cnpgen.problems.constraints.table import Table
from cnpgen.problems.obstacles import scene_of
from cnpgen.trajectory.boundary import Boundary
from cnpgen.trajectory.spline_motion import Motion
from cnpgen.world.world import World
from tests.conftest import some
from tests.examples.plans import (
    PROBLEMS,
    ROBOTS,
    Plan,
    ReferenceTrajectory,
    joined,
    load,
    perturbed,
    reference_trajectory,
)

# --- valid plans -----------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("label", ["hit", "replan", "transport"])
def test_a_valid_plan_passes(label):
    verdict = load(label).judged()
    assert verdict.valid
    assert verdict.reason == Reason.OK == "ok"
    assert verdict.paper.valid
    assert verdict.paper.finished
    assert verdict.paper.broken == ()
    assert all(margin.ok for margin in verdict.margins.values())
    assert verdict.worst is not None
    assert (
        verdict.worst.severity
        == max(margin.severity for margin in verdict.margins.values())
        <= 1
    )


@pytest.mark.parametrize("label", ["hit", "replan", "transport"])
def test_a_valid_plan_meets_its_boundary_conditions_to_rounding(label):
    margins = load(label).judged().margins
    assert margins["boundary position"].violation < 1e-13
    assert margins["boundary velocity"].violation < 1e-12
    assert margins["boundary acceleration"].violation < 1e-9


def test_a_motion_may_start_off_the_table_but_must_reach_it_early():
    plan = load("hit")
    assert abs(plan.start_xyz[0, 2] - 0.16) > 2e-3
    assert plan.judged().valid
    late = plan.with_constraint("Table", z=0.16 + 1e-3).judged().margins["table height"]
    assert late.phase > 0.1  # while the bound is relaxed, there is no violation


def test_verdicts_do_not_depend_on_the_order_of_plans():
    plans = [
        load("hit"),
        load("replan"),
        perturbed(load("hit"), 0.3),
        perturbed(load("replan"), 0.05),
    ]
    forwards, backwards = judge(*joined(*plans)), judge(*joined(*plans[::-1]))
    single = [plan.judged() for plan in plans]
    assert [verdict.to_dict() for verdict in forwards] == [
        verdict.to_dict() for verdict in backwards[::-1]
    ]
    assert [verdict.to_dict() for verdict in forwards] == [
        verdict.to_dict() for verdict in single
    ]


def test_an_empty_batch_has_no_verdicts():
    empty = Boundary(*(np.zeros((0, 6)) for _ in range(5)))
    motion, xyz = Motion(np.zeros((0, 15, 6)), np.zeros((0, 20))), np.zeros((0, 3))
    scene = scene_of(PROBLEMS["airhockey"], xyz, xyz, xyz)
    assert (
        judge(PROBLEMS["airhockey"], ROBOTS["airhockey"], motion, empty, scene, xyz)
        == []
    )


# --- violations ------------------------------------------------------------------------------------------------------


def violations(plan: Plan, seen: ReferenceTrajectory) -> dict[str, np.ndarray]:
    """Compute the violation of every condition independently, shape (count, values)."""
    robot = plan.robot
    found = {
        "joint position": np.maximum(
            robot.position_lower - seen.q, seen.q - robot.position_upper
        ),
        "joint velocity": np.abs(seen.dq) - robot.velocity_limit,
        "joint acceleration": np.abs(seen.ddq) - robot.acceleration_limit,
        "joint torque": np.abs(seen.tau) - robot.torque_limit,
    }
    if plan.problem.name == "airhockey":
        low, high = np.array([0.6, -0.45]), np.array([2.0, 0.45])
        found["table rectangle"] = np.maximum(
            low - seen.tip[:, :2], seen.tip[:, :2] - high
        )
        open_for = np.clip((0.3 - seen.s) / 0.2, 0, 1) * abs(seen.tip[0, 2] - 0.16)
        found["table height"] = (np.abs(seen.tip[:, 2] - 0.16) - open_for)[:, None]
    else:
        found["tilt"] = np.arctan2(
            np.linalg.norm(seen.rotation[:, :2, 2], axis=1), seen.rotation[:, 2, 2]
        )[:, None]
    return found


@pytest.mark.parametrize("by", [0.003, 0.03, 0.3, 2.0])
@pytest.mark.parametrize("label", ["hit", "replan", "transport"])
def test_every_margin_of_a_perturbed_plan_agrees_with_an_independent_evaluation(
    label, by
):
    plan = perturbed(load(label), by)
    verdict, seen = plan.judged(), reference_trajectory(plan)
    broken = []
    for name, violation in violations(plan, seen).items():
        margin = verdict.margins[name]
        tolerance = (
            margin.tolerance
            if name not in ("joint velocity", "joint acceleration", "joint torque")
            else None
        )
        ratio = violation / (tolerance or _relative(plan, name))
        k, part = np.unravel_index(np.argmax(ratio), ratio.shape)
        assert margin.severity == pytest.approx(ratio.max(), rel=2e-3, abs=2e-3), name
        assert margin.violation == pytest.approx(
            violation[k, part], rel=2e-3, abs=1e-5
        ), name
        at = np.interp(margin.time, seen.t, ratio.max(axis=1))
        assert at == pytest.approx(ratio.max(), rel=5e-3, abs=5e-3), name
        assert np.interp(margin.time, seen.t, seen.s) == pytest.approx(
            margin.phase, abs=1e-6
        )
        assert margin.ok == (margin.severity <= 1)
        broken += [name] if ratio.max() > 1 else []
    assert not verdict.valid
    assert verdict.worst is not None
    assert verdict.worst.name in {*broken, "robot clearance", "object contact"}
    assert verdict.worst.severity == max(
        margin.severity for margin in verdict.margins.values()
    )


def _relative(plan: Plan, name: str) -> np.ndarray:
    ratio = {"joint velocity": 2e-3, "joint acceleration": 5e-3, "joint torque": 5e-3}[
        name
    ]
    return ratio * getattr(plan.robot, f"{name[6:]}_limit")


@pytest.mark.parametrize("by", some([0.0, 0.02, 0.3], 1, "slow"))
@pytest.mark.parametrize("label", ["transport", "dragging"])
def test_distances_from_the_pedestals_agree_with_coal_at_every_state(label, by):
    plan = perturbed(load(label), by)
    verdict, seen = plan.judged(), reference_trajectory(plan, 1501)
    world, poses = (
        World(plan.robot, plan.problem.obstacle, plan.problem.object_size),
        np.array([plan.start_xyz[0, 2], plan.goal_xyz[0, 2]]) - 0.15,
    )
    segments, objects = [], []

    def distances(
        q: np.ndarray, dq: np.ndarray, ddq: np.ndarray
    ) -> tuple[float, float]:
        world.set_state(q, dq, ddq, poses)
        return min(world.segment_distances()), min(world.object_distances())

    for state in zip(seen.q, seen.dq, seen.ddq, strict=True):
        segment, held = distances(*state)
        segments.append(segment)
        objects.append(held)
    for index, (name, bound, found) in enumerate(
        (("robot clearance", 0.14, segments), ("object contact", -1e-3, objects))
    ):
        margin = verdict.margins[name]
        states = plan.motion.at(np.array([margin.phase]))
        there = distances(states.q[0, 0], states.dq[0, 0], states.ddq[0, 0])[index]
        assert margin.value == pytest.approx(there, abs=1e-8)
        assert margin.violation == pytest.approx(bound - margin.value, abs=1e-12)
        assert min(found) > margin.value - 1e-5  # no deeper state exists
        assert np.interp(margin.phase, seen.s, found) == pytest.approx(
            margin.value, abs=2e-3 * (1 + 10 * by)
        )


def _limit(name: str, factor: float) -> Callable[[Plan], Plan]:
    def change(plan: Plan) -> Plan:
        return replace(
            plan,
            robot=replace(plan.robot, **{name: factor * getattr(plan.robot, name)}),
        )

    return change


def _torque_limited(plan: Plan) -> Plan:
    """Return the plan with torque limits close to its torques."""
    largest = np.abs(reference_trajectory(plan, 401).tau).max(axis=0)
    return replace(
        plan,
        robot=replace(
            plan.robot,
            torque_limit=1.5
            * largest
            * np.array([1, 0.6, 1, 1, 1, 1, 1])[: plan.robot.n],
        ),
    )


@pytest.mark.parametrize(
    ("label", "reason", "name", "change"),
    [
        (
            "replan",
            "joint position limit",
            "joint position",
            _limit("position_upper", 0.6),
        ),
        (
            "hit",
            "joint velocity limit",
            "joint velocity",
            _limit("velocity_limit", 0.9),
        ),
        (
            "hit",
            "joint acceleration limit",
            "joint acceleration",
            _limit("acceleration_limit", 0.9),
        ),
        ("replan", "joint torque limit", "joint torque", _torque_limited),
        ("transport", "joint torque limit", "joint torque", _torque_limited),
        (
            "hit",
            "off the table",
            "table height",
            lambda plan: plan.with_constraint("Table", tolerance=2e-4),
        ),
        (
            "hit",
            "off the table",
            "table height",
            lambda plan: plan.with_constraint("Table", z=0.163),
        ),
        (
            "transport",
            "not vertical",
            "tilt",
            lambda plan: plan.with_constraint("Vertical", tolerance=1e-3),
        ),
        (
            "transport",
            "robot in collision",
            "robot clearance",
            lambda p: p.with_constraint("RobotClearance", radius=0.2),
        ),
        (
            "transport",
            "object in collision",
            "object contact",
            lambda p: p.with_constraint("ObjectContact", tolerance=0.0),
        ),
        ("dragging", "object in collision", "object contact", lambda plan: plan),
    ],
)
def test_a_violated_constraint_is_named(label, reason, name, change):
    plan = change(load(label))
    verdict = plan.judged()
    assert not verdict.valid
    assert verdict.reason == reason
    assert verdict.worst is not None
    assert verdict.worst.name == name
    assert [other for other, margin in verdict.margins.items() if not margin.ok] == [
        name
    ]
    assert str(verdict.worst).startswith(name)


def test_the_joint_that_violates_a_limit_is_named():
    plan = load("hit")
    limit = plan.robot.velocity_limit.copy()
    limit[2] *= 0.5
    worst = (
        replace(plan, robot=replace(plan.robot, velocity_limit=limit)).judged().worst
    )
    assert worst is not None
    assert worst.part == "joint_3"
    assert abs(worst.bound) == limit[2]
    assert abs(worst.value) == pytest.approx(worst.violation + limit[2])


@pytest.mark.parametrize(
    ("field", "by", "name"),
    [
        ("start_q", 1e-5, "boundary position"),
        ("goal_q", 1e-5, "boundary position"),
        ("start_dq", 1e-5, "boundary velocity"),
        ("goal_dq", -1e-5, "boundary velocity"),
        ("start_ddq", 1e-3, "boundary acceleration"),
    ],
)
def test_a_violated_boundary_condition_is_the_reason(field, by, name):
    plan = load("replan")
    changed = getattr(plan.boundary, field).copy()
    changed[0, 4] += by
    verdict = replace(
        plan, boundary=replace(plan.boundary, **{field: changed})
    ).judged()
    assert verdict.reason == Reason.BOUNDARY
    worst = verdict.worst
    assert worst is not None
    assert (worst.name, worst.part) == (name, "joint_5")
    assert worst.violation == pytest.approx(abs(by), rel=1e-4)
    assert worst.phase == (0.0 if field.startswith("start") else 1.0)
    assert worst.time == pytest.approx(
        0.0 if field.startswith("start") else verdict.metrics.duration
    )


def test_a_goal_acceleration_counts_only_if_it_is_prescribed():
    plan = load("hit")
    acceleration = plan.motion.at(np.array([1.0])).ddq[:, 0]
    assert (
        replace(plan, boundary=replace(plan.boundary, goal_ddq=acceleration))
        .judged()
        .valid
    )
    missed = replace(
        plan, boundary=replace(plan.boundary, goal_ddq=acceleration + 1e-3)
    ).judged()
    assert missed.reason == Reason.BOUNDARY


def test_a_narrow_maximum_between_the_points_of_a_uniform_grid_is_found():
    """The violation is in the first basis function of r, which is about 0.01 wide."""
    plan = load("transport")
    rate = plan.motion.rate / 3
    rate[:, 0] *= 6
    spiked = plan.changed(rate=rate)
    coarse = (
        np.abs(spiked.motion.at(np.linspace(0, 1, 100)).ddq[0])
        / plan.robot.acceleration_limit
    )
    assert coarse.max() < 0.9
    verdict = spiked.judged()
    assert verdict.reason == "joint acceleration limit"
    assert verdict.worst is not None
    assert 0.003 < verdict.worst.phase < 0.006
    assert abs(verdict.worst.value / verdict.worst.bound) == pytest.approx(
        1.667, abs=0.005
    )


def test_the_same_narrow_maximum_at_the_goal_is_found():
    plan = load("transport")
    rate = plan.motion.rate / 3
    rate[:, -1] *= 6
    verdict = plan.changed(rate=rate).judged()
    assert verdict.reason == "joint acceleration limit"
    assert verdict.worst is not None
    assert verdict.worst.phase > 0.99


def test_a_fast_passage_between_two_time_steps_is_found():
    """If r is very large, a plan passes any obstacle in less than a millisecond."""
    plan = load("transport")
    rate = plan.motion.rate.copy()
    rate[:, 9:11] = 1e5
    verdict = plan.changed(rate=rate).judged()
    assert not verdict.valid
    assert verdict.margins["joint velocity"].violation > 1e3


def test_two_constraints_with_the_same_name_are_both_reported():
    plan = load("hit")
    table = next(
        constraint
        for constraint in plan.problem.constraint
        if isinstance(constraint, Table)
    )
    both = replace(
        plan.problem, constraint=(*plan.problem.constraint, replace(table, z=0.17))
    )
    verdict = replace(plan, problem=both).judged()
    assert verdict.margins["table height"].ok
    assert verdict.margins["table height 2"].violation == pytest.approx(0.01, abs=1e-3)
    assert verdict.worst == verdict.margins["table height 2"]


@dataclass(frozen=True, kw_only=True)
class Constant(Constraint):
    """A constraint that does not depend on the state, with a condition without values."""

    reason = "constant"
    tolerance: float = 0.0
    value: float = 0.0

    def symbolic(self, state: Any) -> tuple[Condition, ...]:
        raise NotImplementedError

    def measured(self, world: Any) -> tuple[Condition, ...]:
        high = np.array([1.0])
        return Condition(
            "constant", "1", [self.value], -high, high, "limit"
        ), Condition("no", "1", [], -high[:0], high[:0], "limit")


@pytest.mark.parametrize(
    ("value", "severity"), [(0.0, -1e200), (1.0, 0.0), (1.5, 5e199), (np.nan, np.inf)]
)
def test_a_constraint_without_tolerance_and_with_one_number_is_judged(value, severity):
    plan = load("hit")
    verdict = replace(
        plan, problem=replace(plan.problem, constraint=(Constant(value=value),))
    ).judged()
    assert verdict.margins["constant"].severity == pytest.approx(severity)
    assert "no" not in verdict.margins
    assert verdict.reason == ("constant" if severity > 1 else "ok")
    json.dumps(verdict.to_dict(), allow_nan=False)


def test_the_verdict_shares_no_code_with_the_refiner():
    script = """
import sys
import cnpgen.judges.plans.plan_plot, cnpgen.judges.plans, cnpgen.world.path
banned = ("cnpgen.kernels", "cnpgen.refine")
heavy = ("casadi", "pinocchio", "coal", "matplotlib", "scipy", "h5py")
found = [name for name in sys.modules if name.startswith(banned) or name in heavy]
assert not found, found
"""
    subprocess.run([sys.executable, "-c", script], check=True)
