"""The ballistic reach rule: straight lines along the tip's velocity stay over the table."""

from dataclasses import replace

import numpy as np
import pytest

from cnpgen.errors import RecipeError
from cnpgen.pipelines.prepared import random_generator
from cnpgen.pipelines.stages.reach import BallisticReach
from cnpgen.pipelines.stages.stage import CandidateBatch
from cnpgen.problems.constraints.table import Table
from tests.conftest import Arm, Prepare, run_stages, without_stages
from tests.refusals import is_refused


def batch_at(
    start: tuple[float, ...],
    velocity: tuple[float, ...],
    goal: tuple[float, ...],
    hit: tuple[float, ...],
) -> CandidateBatch:
    candidates = CandidateBatch(1)
    candidates["start_xyz"], candidates["goal_xyz"] = (
        np.array([[*xy, 0.16]]).T for xy in (start, goal)
    )
    candidates["start_tip_velocity"] = np.array([[*velocity, 0.0]]).T
    candidates["hit_angle"], candidates["hit_speed"] = (
        np.array([[value]]) for value in hit
    )
    return candidates


CASES = {
    "in the centre": ((1.0, 0.0), (1.0, 1.0), (1.0, 0.0), (0.3, 1.0), ""),
    "start at the left edge, moving along it": (
        (0.6, 0.0),
        (0.0, 1.0),
        (1.0, 0.0),
        (0.0, 0.0),
        "",
    ),
    "start leaves to the left": (
        (0.61, 0.0),
        (-0.6, 0.0),
        (1.0, 0.0),
        (0.0, 0.0),
        "the start leaves the table",
    ),
    "start comes from the left": ((0.6, 0.0), (2.0, 0.0), (1.0, 0.0), (0.0, 0.0), ""),
    "start leaves at the side": (
        (1.0, 0.44),
        (0.0, 0.6),
        (1.0, 0.0),
        (0.0, 0.0),
        "the start leaves the table",
    ),
    "hit goes on over the side": (
        (1.0, 0.0),
        (0.0, 0.0),
        (1.0, 0.44),
        (np.pi / 2, 0.3),
        "the hit leaves the table",
    ),
    "hit comes from outside the side": (
        (1.0, 0.0),
        (0.0, 0.0),
        (1.0, 0.44),
        (-np.pi / 2, 0.3),
        "the hit leaves the table",
    ),
    "hit along the side": ((1.0, 0.0), (0.0, 0.0), (1.0, 0.45), (0.0, 2.0), ""),
    "hit too slow to leave": (
        (1.0, 0.0),
        (0.0, 0.0),
        (1.0, 0.44),
        (np.pi / 2, 0.1),
        "",
    ),
}


@pytest.mark.parametrize("case", CASES)
def test_starts_and_hits_that_leave_the_table_are_rejected_and_no_others(
    prepare: Prepare, case
):
    *state, reason = CASES[case]
    candidates = batch_at(*state)
    BallisticReach(start_time=0.02, goal_time=0.05).prepare(
        prepare("airhockey-hit").context
    )(candidates, random_generator(0, "train", 0))
    sampling = [
        reason
        for k, reason in enumerate(candidates.reasons)
        if 1 + k in candidates.outcome
    ]
    assert sampling == ([reason] if reason else [])


@pytest.mark.parametrize(
    ("name", "start_time"), [("airhockey-hit", 0.0), ("airhockey-replan", 0.02)]
)
def test_no_accepted_row_leaves_the_table_by_pinocchio_s_velocities(
    prepare: Prepare, name, start_time
):
    prepared = prepare(name)
    table = prepared.context.constraint(Table)
    candidates = run_stages(prepared, 3000, seed=71)
    arm = Arm(prepared.context.robot)
    ends = [("start", start_time), ("goal", 0.05), ("goal", -0.05)]
    for end, time in ends:
        for position, q, dq in zip(
            candidates[f"{end}_xyz"].T,
            candidates[f"{end}_q"].T,
            candidates[f"{end}_dq"].T,
            strict=True,
        ):
            x, y, _ = position + time * arm.velocity(q, dq)
            assert table.x.low - 1e-9 <= x <= table.x.high + 1e-9
            assert table.y.low - 1e-9 <= y <= table.y.high + 1e-9


def test_the_rule_rejects_exactly_the_candidates_that_leave_the_table_according_to_numpy(
    prepare: Prepare,
):
    pipeline = without_stages(prepare("airhockey-replan").pipeline, "BallisticReach")
    prepared = prepare(pipeline)
    table = prepared.context.constraint(Table)
    candidates = run_stages(prepared, 3000, seed=72)
    velocity = candidates["hit_speed"] * np.concatenate(
        [np.cos(candidates["hit_angle"]), np.sin(candidates["hit_angle"])]
    )
    inside = np.ones(len(candidates.alive), bool)
    for points in (
        candidates["start_xyz"][:2] + 0.02 * candidates["start_tip_velocity"][:2],
        candidates["goal_xyz"][:2] + 0.05 * velocity,
        candidates["goal_xyz"][:2] - 0.05 * velocity,
    ):
        low, high = np.array(
            [[table.x.low, table.x.high], [table.y.low, table.y.high]]
        ).T[:, :, None]
        inside &= np.all((low <= points) & (points <= high), axis=0)
    expected = candidates.alive[inside]
    BallisticReach(start_time=0.02, goal_time=0.05).prepare(prepared.context)(
        candidates, random_generator(0, "train", 0)
    )
    np.testing.assert_array_equal(candidates.alive, expected)
    assert 0.05 < 1 - inside.mean() < 0.3


def test_without_times_the_rule_has_no_inputs_and_rejects_no_candidate(
    prepare: Prepare,
):
    stage = BallisticReach()
    assert stage.inputs == ()
    candidates = CandidateBatch(5)
    stage.prepare(prepare("airhockey-hit").context)(
        candidates, random_generator(0, "train", 0)
    )
    assert candidates.reasons == []


def test_an_input_that_no_stage_writes_is_a_mistake_in_the_recipe(prepare: Prepare):
    pipeline = prepare("airhockey-hit").pipeline
    with pytest.raises(RecipeError) as caught:
        prepare(
            replace(
                pipeline, stage=(BallisticReach(start_time=0.02), *pipeline.stage[:2])
            )
        )
    text = str(caught.value)
    assert (
        "stage 1 (ballistic-reach): needs start_xyz, start_tip_velocity, which no stage before it writes"
        in text
    )
    assert "no stage writes goal_q, which every sample must have" in text
    assert "no stage writes start_ddq, which every sample must have" in text


def test_the_rule_needs_a_table(prepare: Prepare):
    with is_refused(RecipeError):
        BallisticReach(goal_time=0.05).prepare(prepare("heavy-object").context)
