"""Joint limits between samples: a violation between the points of a grid is found."""

from dataclasses import replace

import numpy as np
import pytest

from cnpgen.judges.plans.joint_limits import is_proven
from cnpgen.problems.constraints.joint import JointAcceleration, JointTorque
from tests.conftest import some
from tests.examples.jerk_limits import jerk_limited_plan
from tests.examples.plans import Plan, load, perturbed, reference_trajectory

NAMES = {"position": "q", "velocity": "dq", "acceleration": "ddq", "jerk": "jerk"}


def violations(plan: Plan, quantity: str, count: int) -> tuple[np.ndarray, np.ndarray]:
    """Compute the violation of planning limits with SciPy, shape (n, K), and the reference of relative tolerances."""
    values = getattr(reference_trajectory(plan, count), NAMES[quantity]).T
    robot = plan.robot
    if quantity == "position":
        return np.maximum(
            robot.position_lower[:, None] - values,
            values - robot.position_upper[:, None],
        ), np.ones(robot.n)
    limit = getattr(robot, f"{quantity}_limit")
    return np.abs(values) - limit[:, None], limit


@pytest.mark.parametrize("label", some(["replan", "transport", "hit"], 1))
@pytest.mark.parametrize("quantity", NAMES)
@pytest.mark.parametrize("by", some([0.2, 0.0]))
def test_the_margin_of_a_limit_agrees_with_a_very_fine_grid(
    label: str, quantity: str, by: float
) -> None:
    plan = perturbed(jerk_limited_plan(label), by, seed=2)
    margin = plan.judged().margins[f"joint {quantity}"]
    found, scale = violations(plan, quantity, 20001)
    joint = int(np.argmax((found / scale[:, None]).max(axis=1)))
    assert margin.part == plan.robot.joint_names[joint]
    assert (
        found[joint].max() - 1.01e-2 * margin.tolerance
        <= margin.violation
        <= found[joint].max() + 1e-3 * margin.tolerance
    )
    exact = reference_trajectory(plan)
    assert margin.time == pytest.approx(
        np.interp(margin.phase, exact.s, exact.t), abs=1e-5
    )


@pytest.mark.slow
def test_violations_between_samples_count() -> None:
    """A plan is invalid at every step if its acceleration exceeds the tolerance for a millisecond."""
    plan = perturbed(jerk_limited_plan("replan"), 0.05, seed=3)
    for quantity in ("acceleration", "jerk"):
        found, scale = violations(plan, quantity, 200_001)
        worst = (found / scale[:, None]).max()
        for more, wanted in ((1e-6, False), (-1e-6, True)):
            judged = plan.with_constraint(
                f"Joint{quantity.capitalize()}", tolerance=worst - more
            )
            for step in (1e-2, 1e-3):
                assert (
                    judged.judged(step=step).margins[f"joint {quantity}"].ok is wanted
                )


def test_a_subclass_of_a_limit_in_another_package_is_sampled_instead_of_proven() -> (
    None
):
    class Mine(JointAcceleration):
        reason = "mine"

    ours = next(
        c for c in load("hit").problem.constraint if type(c) is JointAcceleration
    )
    torque = next(c for c in load("hit").problem.constraint if type(c) is JointTorque)
    assert is_proven(ours)
    assert not is_proven(torque)
    assert not is_proven(Mine(**{name: getattr(ours, name) for name in vars(ours)}))


def test_the_largest_violation_is_found_with_a_tolerance_of_zero() -> None:
    plan = perturbed(load("replan"), 0.05, seed=3).with_constraint(
        "JointVelocity", tolerance=0.0
    )
    margin = plan.judged().margins["joint velocity"]
    found, scale = violations(plan, "velocity", 20001)
    worst = found[np.argmax((found / scale[:, None]).max(axis=1))].max()
    assert margin.tolerance == 0
    assert margin.violation == pytest.approx(worst, abs=1e-6)
    assert replace(margin, tolerance=1.0).ok
