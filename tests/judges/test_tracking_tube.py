"""Tracking tube: its verdict holds for random states within it, and is exact for joint limits."""

import dataclasses
import itertools

import numpy as np
import pytest

from cnpgen.errors import UsageError
from cnpgen.judges.plans.continuous_collision import is_contact
from cnpgen.judges.plans.evaluated_trajectory import evaluate_trajectory
from cnpgen.judges.plans.judge import Judge, judge
from cnpgen.judges.plans.verdict import Margin, Verdict
from cnpgen.problems.constraints.clearance import ObjectContact
from cnpgen.problems.constraints.puck_contact import PuckContact
from cnpgen.world.path import PathWorld
from tests.examples.plans import Plan, load
from tests.refusals import is_refused

PHASES = np.linspace(0, 1, 200)


@pytest.mark.parametrize("error", [np.deg2rad(0.05), np.deg2rad(1.0)])
@pytest.mark.parametrize("label", ["hit", "transport"])
def test_no_state_within_the_tube_violates_more_than_the_verdict_states(
    label: str, error: float
) -> None:
    plan, random = load(label), np.random.default_rng(11)
    exact, tube = plan.judged(), plan.judged(tracking_error=error)
    world = PathWorld(plan.robot, plan.problem.obstacle, plan.problem.object_size)
    states, poses = (
        evaluate_trajectory(plan.motion, PHASES, jerk=False),
        plan.scene.poses[0],
    )
    checked = set()
    for _ in range(20):
        offset = error * random.uniform(-1, 1, states.q.shape)
        world.set_path(states.q + offset, states.dq, states.ddq, poses)
        for constraint in plan.problem.constraint:
            if isinstance(constraint, ObjectContact | PuckContact):
                continue  # the object stands on the pedestals, the puck is hit
            for condition in constraint.judged(world):
                if condition.name not in tube.margins or not is_widened(
                    exact, tube, condition.name
                ):
                    continue
                g = np.array(
                    [np.broadcast_to(value, len(PHASES)) for value in condition.g]
                )
                relaxation = constraint.bound_relaxation(
                    condition, PHASES, plan.start_xyz[0]
                )
                below = (condition.lower[:, None] - g - relaxation).max()
                above = (g - condition.upper[:, None] - relaxation).max()
                assert (
                    max(below, above) <= tube.margins[condition.name].violation + 1e-9
                )
                checked.add(condition.name)
    assert len(checked) >= 2


@pytest.mark.parametrize("error", [5e-5, 2e-4, 7e-4])
def test_the_contact_of_a_hit_is_intended_within_the_tube(error: float) -> None:
    plan, random = load("hit"), np.random.default_rng(5)
    verdict = plan.judged(tracking_error=error)
    assert verdict.margins["puck distance"].ok
    (contact,) = (c for c in plan.problem.constraint if isinstance(c, PuckContact))
    world = PathWorld(plan.robot, plan.problem.obstacle, plan.problem.object_size)
    phases = np.linspace(0, 1, 2000)
    states = evaluate_trajectory(plan.motion, phases, jerk=False)
    poses, touched = plan.scene.poses[0], 0
    world.set_path(states.q, states.dq, states.ddq, poses)
    planned = world.tip_position
    for _ in range(10):
        signs = random.choice([-1.0, 1.0], states.q.shape)
        world.set_path(states.q + error * signs, states.dq, states.ddq, poses)
        touches = contact.touches(
            world.tip_position.T, np.asarray(world.scene_values)[None]
        )
        displacement = np.linalg.norm(world.tip_position - planned, axis=0).max()
        distances = contact.distances_from_contact_region(world)
        assert distances[touches].max(initial=0) <= 3 * displacement + 1e-4
        touched += touches.sum()
    assert touched  # a hit touches the puck at its end


@pytest.mark.parametrize("error", [1e-4, np.deg2rad(1.0)])
def test_the_height_of_the_table_changes_by_little_less_than_the_verdict_states(
    error: float,
) -> None:
    # Starts may be off the height.
    plan, phases = load("hit"), np.linspace(0.4, 1, 200)
    world = PathWorld(plan.robot, plan.problem.obstacle, plan.problem.object_size)
    states = evaluate_trajectory(plan.motion, phases, jerk=False)
    heights = []
    for signs in itertools.product([-1, 0, 1], repeat=plan.robot.n):
        offset = error * np.reshape(signs, (-1, 1))
        world.set_path(states.q + offset, states.dq, states.ddq, plan.scene.poses[0])
        heights.append(world.tip_position[2])
    largest = np.abs(np.array(heights) - plan.problem.table_origin[2]).max()
    margin = plan.judged(tracking_error=error).margins["table height"]
    assert largest <= margin.violation + 1e-6
    assert margin.violation <= largest * (1.02 if error < 1e-3 else 1.2)


def test_a_puck_beside_the_path_needs_the_displacement_as_clearance() -> None:
    plan = load("hit")
    (contact,) = (c for c in plan.problem.constraint if isinstance(c, PuckContact))
    world = PathWorld(plan.robot, plan.problem.obstacle, plan.problem.object_size)
    states = evaluate_trajectory(plan.motion, np.linspace(0, 1, 4000), jerk=False)
    world.set_path(states.q, states.dq, states.ddq, plan.scene.poses[0])
    x, y = world.tip_position[:2]
    along = np.array([np.gradient(x), np.gradient(y)])[:, 2000]
    across = np.array([-along[1], along[0]]) / np.hypot(*along)
    puck = np.array([x[2000], y[2000]]) + (contact.contact_range + 2e-4) * across
    while (gap := np.hypot(x - puck[0], y - puck[1]).min()) < (
        contact.contact_range + 1.5e-4
    ):
        puck += (contact.contact_range + 2e-4 - gap) * across
    goal = puck + np.array([contact.contact_distance, 0])  # far from the path
    poses = plan.scene.poses.copy()
    poses[0, -4:] = [*goal, *puck]
    scene = dataclasses.replace(plan.scene, poses=poses)

    def margin(error: float | None) -> Margin:
        judge = Judge(plan.problem, plan.robot, tracking_error=error)
        (verdict,) = judge(plan.motion, plan.boundary, scene, plan.goal_xyz)
        return verdict.margins["puck distance"]

    assert margin(None).ok
    assert not margin(1e-3).ok
    assert margin(1e-3).violation > margin(None).violation + 5e-4


def is_widened(exact: Verdict, tube: Verdict, name: str) -> bool:
    """Whether the tube changes a condition: only those of positions."""
    return tube.margins[name].violation > exact.margins[name].violation + 1e-12


@pytest.mark.parametrize("label", ["hit", "transport"])
def test_only_conditions_of_positions_change(label: str) -> None:
    plan = load(label)
    exact, tube = plan.judged(), plan.judged(tracking_error=0.01)
    for name in (
        "joint velocity",
        "joint acceleration",
        "joint torque",
        "boundary velocity",
    ):
        assert tube.margins[name] == exact.margins[name]
    assert {name for name in tube.margins if is_widened(exact, tube, name)} >= {
        "joint position"
    }


def test_position_limits_are_exact_for_every_joint() -> None:
    plan = load("transport")
    error = np.linspace(0.001, 0.02, plan.robot.n)
    exact, tube = plan.judged(), plan.judged(tracking_error=error)
    margin, before = tube.margins["joint position"], exact.margins["joint position"]
    joint = plan.robot.joint_names.index(before.part)
    assert margin.violation >= before.violation + error[joint] - 1e-9
    assert margin.violation <= before.violation + error.max() + 1e-9


def test_distances_change_by_at_most_the_displacement_and_contact_with_the_support_is_legal() -> (
    None
):
    plan, error = load("transport"), np.deg2rad(0.5)
    exact, tube = plan.judged(), plan.judged(tracking_error=error)
    names = {
        condition.name
        for constraint in plan.problem.constraint
        if is_contact(constraint)
        for condition in constraint.measured(
            PathWorld(plan.robot, plan.problem.obstacle, plan.problem.object_size)
        )
    }
    assert {"robot clearance", "object contact", "object clearance"} <= names
    assert tube.margins["object contact"].violation == pytest.approx(
        exact.margins["object contact"].violation
    )
    for name in ("robot clearance", "object clearance"):
        change = tube.margins[name].violation - exact.margins[name].violation
        assert 0 < change <= error * plan.robot.n * plan.robot.reach * 1.2


def test_an_error_of_zero_changes_nothing() -> None:
    plan: Plan = load("transport")
    exact, tube = plan.judged(), plan.judged(tracking_error=0.0)
    assert tube.valid == exact.valid
    for name, margin in exact.margins.items():
        assert tube.margins[name].violation == pytest.approx(margin.violation, abs=1e-9)


@pytest.mark.parametrize("error", [-0.1, np.nan, [0.1, 0.2], np.inf])
def test_wrong_errors_are_refused(error: object) -> None:
    plan = load("transport")
    with is_refused(UsageError, argument="tracking_error"):
        judge(
            plan.problem,
            plan.robot,
            plan.motion,
            plan.boundary,
            plan.scene,
            plan.goal_xyz,
            tracking_error=error,  # type: ignore[arg-type]
        )
