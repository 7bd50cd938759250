"""Invalid inputs get a verdict with the right reason and do not change those of other plans."""

import json
from collections.abc import Callable
from dataclasses import replace
from unittest.mock import ANY

import numpy as np
import pytest

from cnpgen.errors import UsageError
from cnpgen.judges.plans import Reason, judge, summarize_verdicts
from tests.conftest import some
from tests.examples.plans import Plan, joined, load, perturbed
from tests.refusals import is_refused


def _with(plan: Plan, name: str, index: tuple[int, ...], value: float) -> Plan:
    changed = getattr(plan.motion, name).copy()
    changed[(0, *index)] = value
    return plan.changed(**{name: changed})


def _boundary_with(plan: Plan, value: float) -> Plan:
    goal_dq = plan.boundary.goal_dq.copy()
    goal_dq[0, 1] = value
    return replace(plan, boundary=replace(plan.boundary, goal_dq=goal_dq))


GARBAGE: dict[str, tuple[Callable[[Plan], Plan], str | None]] = {
    "nan in the path": (lambda plan: _with(plan, "path", (5, 2), np.nan), "not finite"),
    "inf in the path": (
        lambda plan: _with(plan, "path", (0, 0), -np.inf),
        "not finite",
    ),
    "nan in the rate": (lambda plan: _with(plan, "rate", (7,), np.nan), "not finite"),
    "inf in the rate": (lambda plan: _with(plan, "rate", (7,), np.inf), "not finite"),
    "nan in the boundary": (lambda plan: _boundary_with(plan, np.nan), "not finite"),
    "nan as the goal": (
        lambda plan: replace(plan, goal_xyz=plan.goal_xyz * np.nan),
        "not finite",
    ),
    "no rate": (
        lambda plan: plan.changed(rate=0 * plan.motion.rate),
        "rate not positive",
    ),
    "backwards": (
        lambda plan: plan.changed(rate=-plan.motion.rate),
        "rate not positive",
    ),
    "partly backwards": (
        lambda plan: _with(plan, "rate", (9,), -50.0),
        "rate not positive",
    ),
    "zero rate at the goal": (
        lambda plan: _with(plan, "rate", (19,), 0.0),
        "rate not positive",
    ),
    "a control point below 0, r above": (
        lambda plan: _with(plan, "rate", (9,), -0.1),
        None,
    ),
    "a very slow rate": (
        lambda plan: plan.changed(rate=plan.motion.rate * 1e-7),
        "too long",
    ),
    "an infinite duration": (
        lambda plan: plan.changed(rate=plan.motion.rate * 1e-306),
        "too long",
    ),
    "a very fast rate": (lambda plan: plan.changed(rate=plan.motion.rate * 1e12), None),
    "an overflowing rate": (
        lambda plan: plan.changed(rate=plan.motion.rate * 1e300),
        "not finite",
    ),
    "meters of error": (lambda plan: perturbed(plan, 100.0), None),
    "very large control points": (lambda plan: perturbed(plan, 1e150), None),
    "squares that overflow": (lambda plan: perturbed(plan, 1e300), None),
    "a path of zeros": (
        lambda plan: plan.changed(path=0 * plan.motion.path),
        "boundary conditions",
    ),
    "very large speeds": (lambda plan: _with(plan, "rate", (10,), 1e200), None),
}


@pytest.mark.parametrize("label", ["replan", "transport"])
@pytest.mark.parametrize("name", GARBAGE)
def test_invalid_inputs_get_the_right_reason(name, label):
    make, reason = GARBAGE[name]
    verdict = make(load(label)).judged()
    assert not verdict.valid or name == "a control point below 0, r above"
    assert reason is None or verdict.reason == reason
    json.dumps(verdict.to_dict(), allow_nan=False)
    if verdict.reason in (Reason.NOT_FINITE, Reason.RATE, Reason.TOO_LONG):
        assert verdict.worst is None
        assert not verdict.paper.finished


@pytest.mark.parametrize("label", some(["replan", "transport"], 1, "slow"))
def test_invalid_inputs_do_not_change_the_other_verdicts(label):
    good = load(label)
    plans = [good]
    for make, _ in GARBAGE.values():
        plans += [make(good), good]
    verdicts = judge(*joined(*plans))
    assert all(verdict == verdicts[0] for verdict in verdicts[::2])
    assert verdicts[0].valid
    summary = summarize_verdicts(verdicts)
    json.dumps(summary, allow_nan=False)
    assert summary["plans"] == len(verdicts)
    assert sum(summary["reasons"].values()) == len(verdicts)
    assert summary["reasons"]["rate not positive"] == 4


@pytest.mark.parametrize(
    "change",
    [
        lambda plan: replace(plan, start_xyz=np.zeros((2, 3))),
        lambda plan: replace(plan, goal_xyz=np.zeros(3)),
        lambda plan: plan.changed(path=plan.motion.path[:, :, :5]),
        lambda plan: plan.changed(path=plan.motion.path[0]),
        lambda plan: plan.changed(path=plan.motion.path[:, :7]),
        lambda plan: plan.changed(rate=plan.motion.rate[0]),
        lambda plan: plan.changed(rate=np.ones((2, 20))),
        lambda plan: replace(
            plan, boundary=replace(plan.boundary, start_ddq=np.zeros((1, 7)))
        ),
        lambda plan: replace(
            plan, boundary=replace(plan.boundary, goal_ddq=np.zeros((3, 6)))
        ),
    ],
)
def test_shapes_that_do_not_match_raise_a_usage_error(change):
    with is_refused(UsageError, argument=ANY):
        change(load("hit")).judged()


@pytest.mark.parametrize("step", [0.0, -1e-3, np.nan, np.inf, 0.0101, 5.0])
def test_a_time_step_must_be_positive_and_short_enough(step):
    with is_refused(UsageError, argument="step"):
        load("hit").judged(step=step)
