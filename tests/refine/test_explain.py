"""Proofs of infeasibility: none for solved problems, and all of some infeasible ones."""

import json
from dataclasses import replace
from functools import cache
from pathlib import Path

import numpy as np
import pinocchio as pin
import pytest

from cnpgen.cli.main import main
from cnpgen.errors import UsageError
from cnpgen.make.draw_boundary_problems import draw_boundary_problems
from cnpgen.plans.plan_file import save_plans
from cnpgen.plans.plans import Plans
from cnpgen.refine.proof import table_proof
from cnpgen.refine.proof.explain import (
    Explanation,
    Feasibility,
    explain_failure,
    explain_plans,
)
from cnpgen.refine.proof.reachable_positions import (
    EndState,
    JointLimits,
    end_states,
    joint_limits,
    sample_times,
)
from cnpgen.refine.proof.table_proof import table_bounds
from cnpgen.refine.proof.tip_bound import ArmKinematics, bound_projection
from cnpgen.refine.refine_plans import refine_plans
from cnpgen.trajectory.boundary import Boundary
from tests.conftest import some
from tests.examples.plans import ROBOTS, Plan, load, raised
from tests.examples.refiner import refine
from tests.refusals import is_refused

LABELS = ("hit", "replan", "transport")


def explain(plan: Plan, **changes: np.ndarray) -> Explanation:
    boundary = replace(plan.boundary, **changes)
    return explain_failure(plan.problem, plan.robot, boundary, plan.scene)


@cache
def solved(name: str, count: int) -> Plans:
    plans = refine_plans(draw_boundary_problems(name, count, seed=8), workers=1)
    return plans.plans[np.flatnonzero(plans.valid)]


def tip_at(name: str, q: np.ndarray) -> np.ndarray:
    model = ROBOTS[name].model
    data = model.createData()
    pin.framesForwardKinematics(model, data, q)
    return np.array(data.oMf[model.getFrameId(ROBOTS[name].tip)].translation)


def at_the_edge(clearance: float, speed: float) -> Plan:
    """Return the stored replan, moving sideways where the table ends ``clearance`` [m] from its start."""
    plan = load("replan")
    edge = float(plan.start_xyz[0, 1]) - clearance
    jacobian = ArmKinematics(plan.robot).at(plan.boundary.start_q[0]).jacobian
    sideways = np.linalg.pinv(jacobian) @ [0.0, -speed, 0.0]
    table = plan.with_constraint("Table", y=replace(table_of(plan).y, low=edge))
    return replace(table, boundary=replace(plan.boundary, start_dq=sideways[None]))


def table_of(plan: Plan):
    return next(
        item for item in plan.problem.constraint if type(item).__name__ == "Table"
    )


@pytest.mark.parametrize("label", LABELS)
def test_nothing_is_proven_about_a_problem_with_a_valid_plan(label: str) -> None:
    assert load(label).judged().valid
    assert explain(load(label)).kind is Feasibility.UNKNOWN


@pytest.mark.slow
@pytest.mark.parametrize(
    ("name", "count"),
    some(
        [("airhockey-replan", 3), ("airhockey-hit", 3), ("heavy-object", 1)], 1, "slow"
    ),
)
def test_no_solved_problem_is_infeasible(name: str, count: int) -> None:
    plans = solved(name, count)
    explanations = explain_plans(plans, range(len(plans)))
    assert len(explanations) > count / 2
    assert Feasibility.INFEASIBLE not in {item.kind for item in explanations.values()}


def mirrored(plan: Plan) -> Plan:
    """Return the problem with reversed time, at rest at its former start."""
    b = plan.boundary
    backwards = Boundary(b.goal_q, -b.goal_dq, 0 * b.start_ddq, b.start_q, -b.start_dq)
    return replace(
        plan, boundary=backwards, start_xyz=plan.goal_xyz, goal_xyz=plan.start_xyz
    )


def off_the_height(plan: Plan, by: float) -> Plan:
    """Return the problem with a start ``by`` [m] off the table at the same velocity of the tip."""
    speed = (
        ArmKinematics(plan.robot).at(plan.boundary.start_q[0]).jacobian
        @ plan.boundary.start_dq[0]
    )
    high = raised(plan, by)
    dq = (
        np.linalg.pinv(ArmKinematics(plan.robot).at(high.boundary.start_q[0]).jacobian)
        @ speed
    )
    return replace(high, boundary=replace(high.boundary, start_dq=dq[None]))


@pytest.mark.parametrize(
    ("plan", "always"),
    some(
        [
            (mirrored(at_the_edge(0.0145, 1.0)), False),
            (mirrored(at_the_edge(0.015, 1.0)), True),
            (at_the_edge(0.016, 1.0), True),
            (off_the_height(at_the_edge(0.016, 1.0), 3e-3), True),
            (off_the_height(at_the_edge(0.016, 1.0), -4e-3), True),
        ],
        1,
        "slow",
    ),
    ids=["goal on the verge", "goal", "start", "above", "below"],
)
def test_proofs_about_solved_problems_at_the_edge_are_tried_and_fail(
    plan: Plan, always: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    calls, prove = [], table_proof._prove
    monkeypatch.setattr(
        table_proof,
        "_prove",
        lambda *arguments: calls.append(arguments) or prove(*arguments),
    )
    if always:  # no case is skipped for its distance from the edge
        monkeypatch.setattr(table_proof, "VERGE_DISTANCE_M", 1.0)
        monkeypatch.setattr(table_proof, "MIN_DRIFT_M", -1.0)
    assert refine(plan).valid
    assert explain_case(plan).kind is Feasibility.VERGE
    assert calls


@pytest.mark.parametrize("label", LABELS)
def test_valid_motions_stay_in_the_reachable_boxes(label: str) -> None:
    plan = load(label)
    limits = joint_limits(plan.problem, plan.robot, tolerances=1.0)
    times = sample_times(plan.boundary, limits)
    assert len(times) > 5
    for end, state in end_states(plan.boundary).items():
        phase = plan.motion.phase_at(
            (times if end == "start" else plan.motion.duration()[0] - times)[None]
        )[0]
        for time, q in zip(times, plan.motion.at(phase).q[0], strict=True):
            lower, upper = state.box(float(time), limits)
            assert (lower <= q).all()
            assert (q <= upper).all()


@pytest.mark.parametrize(
    ("steps", "last"), [(148, 0.14), (149, 0.14), (150, 0.14), (152, 0.15)]
)
def test_no_time_is_sampled_at_which_a_motion_may_be_over(
    steps: int, last: float
) -> None:
    still = np.zeros((1, 1))
    limits = JointLimits(*(np.array([limit]) for limit in (-9.0, 9.0, 1.0, 1e9)))
    boundary = Boundary(still, still, still, still + (steps - 0.5) * 1e-3, still)
    assert sample_times(boundary, limits)[-1] == pytest.approx(last)


def test_the_largest_position_is_that_of_full_acceleration_up_to_the_velocity_limit() -> (
    None
):
    plan = load("replan")
    limits = joint_limits(plan.problem, plan.robot, tolerances=0.0)
    start = EndState(plan.boundary.start_q[0], plan.boundary.start_dq[0])
    step, time = 1e-5, 0.12
    q, dq = start.q.copy(), start.dq.copy()
    for _ in range(round(time / step)):
        faster = np.minimum(dq + limits.acceleration * step, limits.velocity)
        q, dq = q + (dq + faster) / 2 * step, faster
    np.testing.assert_allclose(
        start.box(time, limits)[1], np.minimum(q, limits.upper), atol=1e-5
    )


@pytest.mark.parametrize("name", ["airhockey", "heavy-object"])
def test_a_bound_of_the_tip_over_a_box_is_below_every_sample_and_tight(
    name: str,
) -> None:
    robot, arm = ROBOTS[name], ArmKinematics(ROBOTS[name])
    random = np.random.default_rng(3)
    for _ in range(4):
        q, direction = (
            random.uniform(robot.position_lower, robot.position_upper) / 2,
            random.normal(size=3),
        )
        lower, upper = q - 0.01, q + 0.01
        corners = np.stack(np.meshgrid(*[(0.0, 1.0)] * robot.n), axis=-1).reshape(
            -1, robot.n
        )
        samples = [
            lower + corner * (upper - lower)
            for corner in (*corners, *random.random((100, robot.n)))
        ]
        least = min(float(direction @ tip_at(name, sample)) for sample in samples)
        bound = bound_projection(arm, direction, lower, upper, above=least - 2e-4)
        assert bound is not None
        assert least - 2e-4 < bound <= least
        assert bound_projection(arm, direction, lower, upper, above=least) is None


@pytest.mark.parametrize("name", ["airhockey", "heavy-object"])
def test_derivatives_of_the_tip_are_those_of_finite_differences_and_within_the_reach(
    name: str,
) -> None:
    robot, arm = ROBOTS[name], ArmKinematics(ROBOTS[name])
    q, step, direction = robot.home + 0.3, 1e-6, np.array([0.3, -0.8, 0.5])
    tip = arm.at(q)
    np.testing.assert_allclose(tip.position, tip_at(name, q), atol=1e-14)
    for joint, unit in enumerate(np.eye(robot.n)):
        up, down = arm.at(q + step * unit), arm.at(q - step * unit)
        np.testing.assert_allclose(
            (up.position - down.position) / (2 * step),
            tip.jacobian[:, joint],
            atol=1e-8,
        )
        gradient = direction @ (up.jacobian - down.jacobian) / (2 * step)
        np.testing.assert_allclose(gradient, tip.curvature(direction)[joint], atol=1e-8)
    assert (np.linalg.norm(tip.jacobian, axis=0) <= arm.reach + 1e-12).all()


@pytest.mark.slow
def test_a_tip_that_cannot_stop_before_the_edge_is_proven_to_leave_the_table() -> None:
    finding = explain_case(at_the_edge(clearance=0.01, speed=1.5))
    assert finding.kind is Feasibility.INFEASIBLE
    assert "after the start the tip is" in finding.text


@pytest.mark.slow
def test_the_same_at_the_goal() -> None:
    plan = at_the_edge(clearance=0.01, speed=1.5)
    finding = explain_case(mirrored(plan))
    assert finding.kind is Feasibility.INFEASIBLE
    assert "before the goal the tip is" in finding.text


@pytest.mark.slow
def test_with_larger_clearance_infeasible_becomes_verge_and_then_unknown() -> None:
    kinds = [
        explain_case(at_the_edge(clearance, speed=1.0)).kind
        for clearance in (0.012, 0.014, 0.016)
    ]
    assert kinds == [Feasibility.INFEASIBLE, Feasibility.VERGE, Feasibility.UNKNOWN]


def test_an_end_at_rest_near_the_edge_is_not_on_the_verge() -> None:
    assert (
        explain_case(at_the_edge(clearance=0.0005, speed=0.0)).kind
        is Feasibility.UNKNOWN
    )


def explain_case(plan: Plan) -> Explanation:
    return explain_failure(plan.problem, plan.robot, plan.boundary, plan.scene)


def test_a_motion_that_starts_off_the_table_may_be_off_at_any_time() -> None:
    def above(height: float) -> np.ndarray:
        return load("hit").goal_xyz[0] + np.array([0.0, 0.0, height])

    for band, start, off in (
        (0.005, 0.0, True),
        (0.005, 4e-3, False),
        (0.0, 4e-3, True),
        (0.005, 0.2, False),
    ):
        problem = load("hit").with_constraint("Table", start_band=band).problem
        bounds = table_bounds(problem, above(start), tolerances=1.0)
        assert bounds is not None
        violated = [
            bounds.normals @ above(height) > bounds.limits for height in (4e-3, 7e-3)
        ]
        assert [mask[bounds.height].any() for mask in violated] == [off, True]


def test_a_start_further_off_the_table_than_allowed_is_infeasible() -> None:
    plan = raised(load("hit"), 6e-3).with_constraint(
        "Table", start_band=0.0, tolerance=3e-3
    )
    assert (
        "at the start table height is 0.166 m, expected 0.16 m"
        in explain_case(plan).text
    )
    assert explain_case(raised(plan, 2e-3)).kind is Feasibility.UNKNOWN


def test_violations_of_the_ends_are_reported_with_value_and_bound() -> None:
    hit, transport = load("hit"), load("transport")
    fast = explain(hit, goal_dq=3 * hit.boundary.goal_dq)
    assert fast.kind is Feasibility.INFEASIBLE
    assert fast.text.startswith("at the goal joint velocity is")
    tilted = explain(transport, start_q=transport.boundary.start_q + 0.2)
    assert tilted.kind is Feasibility.INFEASIBLE
    heavy = explain_case(transport.with_constraint("RobotClearance", radius=0.5))
    assert heavy.text.startswith(
        "at the start robot clearance of segment 3, pedestal-1 is"
    )
    assert "expected 0.5 m" in heavy.text


def test_ends_have_the_tolerances_of_the_verdict() -> None:
    hit = load("hit")
    limit = hit.robot.acceleration_limit * 1.005
    for violation, kind in (
        (9e-5, Feasibility.UNKNOWN),
        (0.1, Feasibility.INFEASIBLE),
    ):  # tolerance 1e-4 rad/s^2
        start_ddq = np.zeros((1, 6))
        start_ddq[0, 5] = limit[5] + violation
        assert explain(hit, start_ddq=start_ddq).kind is kind


def test_a_goal_whose_torque_no_acceleration_can_lower_is_infeasible() -> None:
    plan = load("transport")
    model, zero = plan.robot.model, np.zeros(plan.robot.n)
    start, goal = (
        np.abs(pin.rnea(model, model.createData(), q[0], zero, zero))
        for q in (plan.boundary.start_q, plan.boundary.goal_q)
    )
    joint = int(np.argmax(goal - start))
    assert goal[joint] > start[joint] + 0.2
    limit = plan.robot.torque_limit.copy()
    limit[joint] = (start[joint] + goal[joint]) / 2
    weak = replace(plan, robot=replace(plan.robot, torque_limit=limit))
    assert (
        explain_case(weak).kind is Feasibility.UNKNOWN
    )  # it may arrive braking, which reduces the torque
    slow = replace(weak.robot, acceleration_limit=1e-3 * plan.robot.acceleration_limit)
    finding = explain_case(replace(weak, robot=slow))
    assert finding.kind is Feasibility.INFEASIBLE
    assert finding.text.startswith("at the goal there is no acceleration")


def test_a_joint_that_cannot_brake_before_its_limit_is_named() -> None:
    plan = load("hit")
    q, dq = plan.boundary.start_q.copy(), np.zeros_like(plan.boundary.start_dq)
    limit = float(plan.robot.position_upper[5])
    q[0, 5], dq[0, 5] = limit - 1e-3, plan.robot.velocity_limit[5]
    only = replace(plan.problem, constraint=plan.problem.constraint[:3])
    finding = explain_failure(
        only, plan.robot, replace(plan.boundary, start_q=q, start_dq=dq), plan.scene
    )
    assert finding.kind is Feasibility.INFEASIBLE
    assert "joint_6 is" in finding.text


def test_boundary_conditions_that_are_not_finite_are_infeasible() -> None:
    plan = load("hit")
    assert "not finite" in explain(plan, goal_q=plan.boundary.goal_q * np.nan).text


def test_by_default_the_plans_that_are_not_valid_are_explained() -> None:
    plans = solved("airhockey-hit", 3)[np.arange(2)]
    invalid = replace(plans, status=np.array([1, 2], np.uint8))
    assert list(explain_plans(plans)) == []
    assert list(explain_plans(invalid)) == [1]
    with is_refused(UsageError, argument="indices"):
        explain_plans(plans, [2])


def test_the_commands_explain_plans_that_are_not_valid(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    plans = solved("airhockey-hit", 3)[np.arange(2)]
    boundary = replace(
        plans.boundary, goal_dq=plans.boundary.goal_dq * np.array([[1.0], [20.0]])
    )
    path = tmp_path / "plans.h5"
    save_plans(path, replace(plans, boundary=boundary))
    words = [
        "refine",
        str(path),
        "--explain",
        "--json",
        "--max-iterations",
        "0",
        "-o",
        str(tmp_path / "out.h5"),
    ]
    assert main(words) == 1
    out, err = capsys.readouterr()
    (failure,) = json.loads(out)["not_valid"]
    assert (failure["plan"], failure["finding"]) == (1, "infeasible")
    assert failure["explanation"].startswith("at the goal joint velocity is")
    assert "infeasible: at the goal joint velocity is" in " ".join(err.split())
    assert "cnpgen docs troubleshooting" not in err
    words.remove("--explain")
    assert main([*words, "--force"]) == 1
    assert capsys.readouterr().err.endswith(
        "is infeasible; 'cnpgen docs troubleshooting' lists causes\n"
    )
