"""The ballistic reach rule: straight lines along the tip's velocity stay over the table."""

from dataclasses import replace

import numpy as np
import pytest

from cnpgen.errors import RecipeError
from cnpgen.pipelines.prepared import random_generator
from cnpgen.pipelines.stages.reach import BallisticReach
from cnpgen.pipelines.stages.stage import Round
from cnpgen.problems.constraints.table import Table
from tests.conftest import Arm, Prepare, run_stages, without_stages


def batch_at(
    start: tuple[float, ...], velocity: tuple[float, ...], goal: tuple[float, ...], hit: tuple[float, ...]
) -> Round:
    draws = Round(1)
    draws["start_xyz"], draws["goal_xyz"] = (np.array([[*xy, 0.16]]).T for xy in (start, goal))
    draws["start_tip_velocity"] = np.array([[*velocity, 0.0]]).T
    draws["hit_angle"], draws["hit_speed"] = (np.array([[value]]) for value in hit)
    return draws


CASES = {
    "in the middle": ((1.0, 0.0), (1.0, 1.0), (1.0, 0.0), (0.3, 1.0), ""),
    "start at the left edge, moving along it": ((0.6, 0.0), (0.0, 1.0), (1.0, 0.0), (0.0, 0.0), ""),
    "start leaves to the left": ((0.61, 0.0), (-0.6, 0.0), (1.0, 0.0), (0.0, 0.0), "the start leaves the table"),
    "start comes from the left": ((0.6, 0.0), (2.0, 0.0), (1.0, 0.0), (0.0, 0.0), ""),
    "start leaves at the side": ((1.0, 0.44), (0.0, 0.6), (1.0, 0.0), (0.0, 0.0), "the start leaves the table"),
    "hit goes on over the side": ((1.0, 0.0), (0.0, 0.0), (1.0, 0.44), (np.pi / 2, 0.3), "the hit leaves the table"),
    "hit comes from beyond the side": (
        (1.0, 0.0),
        (0.0, 0.0),
        (1.0, 0.44),
        (-np.pi / 2, 0.3),
        "the hit leaves the table",
    ),
    "hit along the side": ((1.0, 0.0), (0.0, 0.0), (1.0, 0.45), (0.0, 2.0), ""),
    "hit too slow to leave": ((1.0, 0.0), (0.0, 0.0), (1.0, 0.44), (np.pi / 2, 0.1), ""),
}


@pytest.mark.parametrize("case", CASES)
def test_starts_and_hits_that_leave_the_table_are_rejected_and_no_others(prepare: Prepare, case):
    *state, reason = CASES[case]
    draws = batch_at(*state)
    BallisticReach(start_time=0.02, goal_time=0.05).prepare(prepare("airhockey-hit").context)(
        draws, random_generator(0, "train", 0)
    )
    fates = [reason for k, reason in enumerate(draws.reasons) if 1 + k in draws.fate]
    assert fates == ([reason] if reason else [])


@pytest.mark.parametrize(("name", "start_time"), [("airhockey-hit", 0.0), ("airhockey-replan", 0.02)])
def test_no_accepted_row_leaves_the_table_by_pinocchio_s_velocities(prepare: Prepare, name, start_time):
    prepared = prepare(name)
    table = prepared.context.constraint(Table)
    draws = run_stages(prepared, 3000, seed=71)
    arm = Arm(prepared.context.robot)
    ends = [("start", start_time), ("goal", 0.05), ("goal", -0.05)]
    for end, time in ends:
        for position, q, dq in zip(draws[f"{end}_xyz"].T, draws[f"{end}_q"].T, draws[f"{end}_dq"].T, strict=True):
            x, y, _ = position + time * arm.velocity(q, dq)
            assert table.x.low - 1e-9 <= x <= table.x.high + 1e-9
            assert table.y.low - 1e-9 <= y <= table.y.high + 1e-9


def test_the_rule_rejects_exactly_the_draws_that_numpy_says_leave(prepare: Prepare):
    pipeline = without_stages(prepare("airhockey-replan").pipeline, "BallisticReach")
    prepared = prepare(pipeline)
    table = prepared.context.constraint(Table)
    draws = run_stages(prepared, 3000, seed=72)
    velocity = draws["hit_speed"] * np.concatenate([np.cos(draws["hit_angle"]), np.sin(draws["hit_angle"])])
    inside = np.ones(len(draws.alive), bool)
    for points in (
        draws["start_xyz"][:2] + 0.02 * draws["start_tip_velocity"][:2],
        draws["goal_xyz"][:2] + 0.05 * velocity,
        draws["goal_xyz"][:2] - 0.05 * velocity,
    ):
        low, high = np.array([[table.x.low, table.x.high], [table.y.low, table.y.high]]).T[:, :, None]
        inside &= np.all((low <= points) & (points <= high), axis=0)
    expected = draws.alive[inside]
    BallisticReach(start_time=0.02, goal_time=0.05).prepare(prepared.context)(draws, random_generator(0, "train", 0))
    np.testing.assert_array_equal(draws.alive, expected)
    assert 0.05 < 1 - inside.mean() < 0.3


def test_without_times_nothing_is_needed_and_nothing_rejected(prepare: Prepare):
    stage = BallisticReach()
    assert stage.needs == ()
    draws = Round(5)
    stage.prepare(prepare("airhockey-hit").context)(draws, random_generator(0, "train", 0))
    assert draws.reasons == []


def test_a_stage_that_needs_what_no_stage_wrote_is_a_mistake_in_the_recipe(prepare: Prepare):
    pipeline = prepare("airhockey-hit").pipeline
    with pytest.raises(RecipeError) as caught:
        prepare(replace(pipeline, stage=(BallisticReach(start_time=0.02), *pipeline.stage[:2])))
    text = str(caught.value)
    assert "stage 1 (ballistic-reach): needs start_xyz, start_tip_velocity, which no stage before it writes" in text
    assert "no stage writes goal_q, which every sample must have" in text
    assert "no stage writes start_ddq, which every sample must have" in text


def test_the_rule_needs_a_table(prepare: Prepare):
    with pytest.raises(RecipeError, match="needs a constraint 'table'"):
        BallisticReach(goal_time=0.05).prepare(prepare("heavy-object").context)
