"""Validity does not depend on the time step, even for plans very close to a tolerance."""

from dataclasses import replace

import pytest

from cnpgen.judges.plans import Margin
from tests.conftest import some
from tests.examples.plans import Plan, load, perturbed

more = pytest.mark.extended  # the same claim for other plans
RELATIVE_DISTANCE = 1e-5  # of these plans from the tolerance


def at_the_tolerance(plan: Plan, margin: Margin, by: float) -> Plan:
    """Return the plan in a problem with one tolerance just above the plan's violation; all others are large."""
    ratio = margin.violation / margin.tolerance * (1 + by)
    now = plan.problem.constraint
    constraints = tuple(
        replace(
            each,
            tolerance=each.tolerance * (ratio if each.reason == margin.reason else 1e3),
        )
        for each in now
    )
    return replace(plan, problem=replace(plan.problem, constraint=constraints))


@pytest.mark.parametrize(
    "seed", [0, pytest.param(1, marks=more), pytest.param(2, marks=more)]
)
@pytest.mark.parametrize(
    "label", some(["hit", "replan", "transport", "dragging"], 2, "slow")
)
def test_a_plan_at_a_tolerance_is_valid_at_every_step_or_at_none(
    label: str, seed: int
) -> None:
    plan = perturbed(load(label), 0.03, seed=seed)
    tried = 0
    for name, margin in plan.judged().margins.items():
        if margin.reason != "boundary conditions" and margin.violation > 1e-6:
            near = plan
            for _ in range(4):  # more exact each time, because it decides
                near = at_the_tolerance(near, near.judged().margins[name], 0.0)
            exact = near.judged().margins[name]
            for by in (RELATIVE_DISTANCE, -RELATIVE_DISTANCE):
                there = at_the_tolerance(near, exact, by)
                judged = [
                    there.judged(early_exit=True),
                    *(there.judged(step=step) for step in (5e-3, 1e-3, 2e-4)),
                ]
                assert [verdict.valid for verdict in judged] == [by > 0] * 4, name
                tried += 1
    assert tried >= 2
