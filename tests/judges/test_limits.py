"""Joint limits between moments: a motion that keeps a limit wherever a grid looks is found out all the same."""

from dataclasses import replace

import numpy as np
import pytest

from cnpgen.judges.plans.limits import is_proven
from cnpgen.problems.constraints.joint import JointAcceleration, JointTorque
from tests.conftest import some
from tests.examples.jerky import jerky_plan
from tests.examples.plans import Plan, bent, course, load

NAMES = {"position": "q", "velocity": "dq", "acceleration": "ddq", "jerk": "jerk"}


def beyond(plan: Plan, quantity: str, count: int) -> tuple[np.ndarray, np.ndarray]:
    """How far a quantity is beyond its planning limits, by SciPy, shape (n, K), and of what tolerances are shares."""
    values = getattr(course(plan, count), NAMES[quantity]).T
    robot = plan.robot
    if quantity == "position":
        return np.maximum(robot.position_lower[:, None] - values, values - robot.position_upper[:, None]), np.ones(
            robot.n
        )
    limit = getattr(robot, f"{quantity}_limit")
    return np.abs(values) - limit[:, None], limit


@pytest.mark.parametrize("label", some(["replan", "transport", "hit"], 1))
@pytest.mark.parametrize("quantity", NAMES)
@pytest.mark.parametrize("by", some([0.2, 0.0]))
def test_the_margin_of_a_limit_is_the_worst_of_a_very_fine_grid(label: str, quantity: str, by: float) -> None:
    plan = bent(jerky_plan(label), by, seed=2)
    margin = plan.judged().margins[f"joint {quantity}"]
    found, scale = beyond(plan, quantity, 20001)
    joint = int(np.argmax((found / scale[:, None]).max(axis=1)))
    assert margin.part == plan.robot.joint_names[joint]
    assert found[joint].max() - 1.01e-2 * margin.allowed <= margin.excess <= found[joint].max() + 1e-3 * margin.allowed
    exact = course(plan)
    assert margin.time == pytest.approx(np.interp(margin.phase, exact.s, exact.t), abs=1e-5)


@pytest.mark.slow
def test_what_lies_between_moments_counts() -> None:
    """A plan is called valid by no step if its acceleration is beyond what is allowed for a thousandth of a second."""
    plan = bent(jerky_plan("replan"), 0.05, seed=3)
    for quantity in ("acceleration", "jerk"):
        found, scale = beyond(plan, quantity, 200_001)
        worst = (found / scale[:, None]).max()
        for more, wanted in ((1e-6, False), (-1e-6, True)):
            judged = plan.with_constraint(f"Joint{quantity.capitalize()}", tolerance=worst - more)
            for step in (1e-2, 1e-3):
                assert judged.judged(step=step).margins[f"joint {quantity}"].ok is wanted


def test_a_limit_that_was_changed_by_a_package_is_sampled_and_not_taken_for_ours() -> None:
    class Mine(JointAcceleration):
        reason = "mine"

    ours = next(each for each in load("hit").problem.constraint if type(each) is JointAcceleration)
    torque = next(each for each in load("hit").problem.constraint if type(each) is JointTorque)
    assert is_proven(ours)
    assert not is_proven(torque)
    assert not is_proven(Mine(**{name: getattr(ours, name) for name in vars(ours)}))


def test_where_nothing_is_allowed_the_worst_is_found_all_the_same() -> None:
    plan = bent(load("replan"), 0.05, seed=3).with_constraint("JointVelocity", tolerance=0.0)
    margin = plan.judged().margins["joint velocity"]
    found, scale = beyond(plan, "velocity", 20001)
    worst = found[np.argmax((found / scale[:, None]).max(axis=1))].max()
    assert margin.allowed == 0
    assert margin.excess == pytest.approx(worst, abs=1e-6)
    assert replace(margin, allowed=1.0).ok
