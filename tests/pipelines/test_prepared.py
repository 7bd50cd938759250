"""Blocks: pure functions of seed, split and index, in chunks of any size, equal for all backends."""

from dataclasses import replace
from functools import partial

import numpy as np
import pytest

from cnpgen.errors import RecipeError
from cnpgen.pipelines.prepared import (
    Block,
    PreparedPipeline,
    as_stored,
    random_generator,
)
from cnpgen.pipelines.stages.hitting_velocity import HittingVelocity
from cnpgen.pipelines.stages.stage import BLOCK_ROWS, CandidateBatch
from cnpgen.problems.constraints.link_clearance import ObjectClearance
from cnpgen.store.field import Field
from cnpgen.store.sampling_statistics import SamplingStatistics, merge_sampling
from tests.conftest import SHIPPED, Prepare, needs_compiled_code, some

CLOSE = 1e-9  # maximum difference of the backends, in SI units
SEED = 20261121


@pytest.fixture(scope="module", params=SHIPPED)
def prepared(request: pytest.FixtureRequest, prepare: Prepare) -> PreparedPipeline:
    return prepare(request.param)


@pytest.fixture(scope="module")
def whole(prepared: PreparedPipeline) -> Block:
    return prepared.block(SEED, "train", 0)


def assert_same_columns(
    found: dict[str, np.ndarray], expected: dict[str, np.ndarray]
) -> None:
    assert list(found) == list(expected)
    for name, values in expected.items():
        np.testing.assert_array_equal(found[name], values, err_msg=name)


def assert_same_sampling(
    found: SamplingStatistics, expected: SamplingStatistics
) -> None:
    assert (found.tried, found.accepted) == (expected.tried, expected.accepted)
    assert dict(found.rejections) == dict(expected.rejections)
    for name, density in expected.densities.items():
        np.testing.assert_array_equal(
            found.densities[name].candidates, density.candidates
        )
        np.testing.assert_array_equal(found.densities[name].accepted, density.accepted)


def test_a_block_is_reproducible_bit_for_bit(prepared, whole):
    again = prepared.block(SEED, "train", 0)
    assert_same_columns(again.columns, whole.columns)
    assert_same_sampling(again.sampling, whole.sampling)


@pytest.mark.parametrize(
    "other", [(SEED + 1, "train", 0), (SEED, "validation", 0), (SEED, "train", 1)]
)
def test_blocks_of_another_seed_split_or_index_share_no_row(prepared, whole, other):
    columns = prepared.block(*other, stop=500).columns
    assert not np.isin(columns["goal_xyz"][0], whole.columns["goal_xyz"][0]).any()
    first = other[2] * BLOCK_ROWS
    np.testing.assert_array_equal(columns["sample_id"], [np.arange(first, first + 500)])


def test_every_stage_accepts_a_batch_without_remaining_candidates(prepared):
    for emptied in range(1, len(prepared._stages) + 1):
        candidates, random = CandidateBatch(8), random_generator(SEED, "train", 0)
        for _, work in prepared._stages[:emptied]:
            work(candidates, random)
        candidates.reject(np.zeros(len(candidates.alive), bool), "all of them")
        for _, work in prepared._stages[emptied:]:
            work(candidates, random)
        prepared._accept(candidates, random)
        assert {candidates[field.name].shape[1] for field in prepared.fields[:-2]} == {
            0
        }


def chunks(
    prepared: PreparedPipeline, cuts: list[int], index: int = 0
) -> tuple[dict[str, np.ndarray], SamplingStatistics]:
    """Compute a block in chunks."""
    made = [
        prepared.block(SEED, "train", index, first=first, stop=stop)
        for first, stop in zip([0, *cuts], [*cuts, BLOCK_ROWS], strict=True)
    ]
    columns = {
        name: np.concatenate([part.columns[name] for part in made], axis=1)
        for name in made[0].columns
    }
    return columns, merge_sampling([part.sampling for part in made])


@pytest.mark.parametrize(
    "cuts",
    some(
        [[1], [4095], [100, 1000, 3000], [2048], list(range(512, 4096, 512)), [17, 18]],
        2,
        "slow",
    ),
)
def test_chunks_of_a_block_have_its_rows_and_its_total_statistics(
    prepared, whole, cuts
):
    columns, sampling = chunks(prepared, cuts)
    assert_same_columns(columns, whole.columns)
    assert_same_sampling(sampling, whole.sampling)


def test_chunks_computed_together_equal_chunks_computed_one_by_one(prepared, whole):
    ranges = [
        (0, 1),
        (1, 64),
        (64, 1500),
        (1700, 1701),
        (3000, BLOCK_ROWS),
    ]  # with gaps
    drawn = []
    run = PreparedPipeline._sample_batch
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(
            PreparedPipeline,
            "_sample_batch",
            lambda *x: (drawn.append(x[2]), run(*x))[1],
        )
        together = list(prepared.chunks(SEED, "train", 0, ranges))
    assert sum(drawn) < 1.3 * whole.sampling.tried + 300
    assert len(together) == len(ranges)
    for (first, stop), chunk in zip(ranges, together, strict=True):
        alone = prepared.block(SEED, "train", 0, first=first, stop=stop)
        assert_same_columns(chunk.columns, alone.columns)
        assert_same_sampling(chunk.sampling, alone.sampling)


def batch_ends(prepared: PreparedPipeline, index: int) -> tuple[list[int], list[int]]:
    """Return the rows after each batch of a block, and the rejected candidates at the end of each batch."""
    sizes, tails = [], []
    run = PreparedPipeline._sample_batch

    def noted(
        self: PreparedPipeline, random: np.random.Generator, size: int
    ) -> CandidateBatch:
        candidates = run(self, random, size)
        sizes.append(len(candidates.alive))
        tails.append(candidates.size - 1 - int(candidates.alive[-1]))
        return candidates

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(PreparedPipeline, "_sample_batch", noted)
        prepared.block(SEED, "train", index)
    return np.cumsum(sizes).tolist(), tails


@pytest.mark.slow
def test_a_chunk_that_begins_with_a_batch_counts_the_last_rejections_of_the_previous_batch(
    prepare: Prepare,
):
    prepared = prepare("heavy-object")
    tested = 0
    for index in range(20):
        ends, tails = batch_ends(prepared, index)
        if tails[0] == 0 or tested == 3:
            continue
        tested += 1
        whole, (columns, sampling) = (
            prepared.block(SEED, "train", index),
            chunks(prepared, [ends[0]], index),
        )
        assert_same_columns(columns, whole.columns)
        assert_same_sampling(sampling, whole.sampling)
    assert tested == 3


def test_a_shorter_block_is_the_beginning_of_a_longer_one(prepared, whole):
    for stop in (1, 7, 1500, 2900):
        short = prepared.block(SEED, "train", 0, stop=stop)
        assert_same_columns(
            short.columns,
            {name: values[:, :stop] for name, values in whole.columns.items()},
        )
        assert short.sampling.accepted == stop
        assert short.sampling.tried == whole.columns["attempts"][0, :stop].sum()


# --- counts -----------------------------------------------------------------------------------------------------------


def test_every_candidate_is_accepted_or_counted_under_one_reason(prepared, whole):
    sampling = whole.sampling
    assert sampling.accepted == BLOCK_ROWS == whole.columns["attempts"].shape[1]
    assert sampling.tried == sampling.accepted + sum(sampling.rejections.values())
    assert sum(sampling.rejections.values()) > 100


def test_attempts_sum_to_the_number_of_candidates(prepared, whole):
    attempts = whole.columns["attempts"]
    assert attempts.dtype == np.int64
    assert attempts.min() == 1
    assert attempts.sum() == whole.sampling.tried


def test_attempts_count_the_candidates_between_rows_across_batches(prepared, whole):
    """The reference concatenates the outcomes of the candidates of all batches."""
    sampling: list[int] = []
    run = PreparedPipeline._sample_batch

    def noted(
        self: PreparedPipeline, random: np.random.Generator, size: int
    ) -> CandidateBatch:
        candidates = run(self, random, size)
        sampling.extend(candidates.outcome.tolist())
        return candidates

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(PreparedPipeline, "_sample_batch", noted)
        prepared.block(SEED, "train", 0)
    accepted = np.flatnonzero(np.array(sampling) == 0)[:BLOCK_ROWS]
    np.testing.assert_array_equal(
        whole.columns["attempts"][0], np.diff(accepted, prepend=-1)
    )


def test_every_reason_of_stages_and_constraints_is_listed_even_without_rejections(
    prepared, whole
):
    reasons = list(whole.sampling.rejections)
    constraints = [
        each.boundary_reason or each.reason
        for each in prepared.context.problem.constraint
    ]
    assert reasons[0] == "too close together"
    assert [reason for reason in reasons if reason in constraints] == constraints
    assert "tip not at its position" in reasons
    assert len(set(reasons)) == len(reasons)


def test_density_maps_count_every_candidate_and_every_row(prepared, whole):
    assert whole.sampling.densities.keys() == {"start_xyz", "goal_xyz"}
    for name, density in whole.sampling.densities.items():
        assert density.candidates.sum() == whole.sampling.tried
        assert density.accepted.sum() == BLOCK_ROWS
        x, y, _ = whole.columns[name]
        expected, _, _ = np.histogram2d(
            x, y, density.accepted.shape, [density.x, density.y]
        )
        np.testing.assert_allclose(
            density.accepted, expected, atol=2
        )  # a candidate on the line between two cells


@pytest.mark.parametrize("name", some(SHIPPED, 1, "slow"))
def test_the_acceptance_check_rejects_no_candidate_of_the_stages(
    prepare: Prepare, name
):
    """The stages are exact; the acceptance check guards against unforeseen errors.

    No stage measures the distance between object and arm, so the check rejects these candidates.
    """
    prepared = prepare(name)
    sampling = merge_sampling(
        [prepared.block(SEED, "test", index).sampling for index in range(8)]
    )
    constraints = prepared.context.problem.constraint
    gate = [
        constraint.reason
        for constraint in constraints
        if not isinstance(constraint, ObjectClearance)
    ]
    gate += ["tip not at its position", "hit not along its direction"]
    assert {
        reason: count
        for reason, count in sampling.rejections.items()
        if reason in gate and count
    } == {}


def test_a_pipeline_without_accepted_candidates_raises_an_error_with_the_reasons(
    prepare: Prepare,
):
    pipeline = prepare("airhockey-hit").pipeline
    stages = [
        replace(stage, min_speed=100.0) if isinstance(stage, HittingVelocity) else stage
        for stage in pipeline.stage
    ]
    prepared = prepare(replace(pipeline, stage=tuple(stages)))
    text = (
        r"airhockey-hit\.toml: 0 of [\d,]+ candidates were accepted; of the last [\d,]+,"
        r" rejected for no hitting velocity \("
    )
    with pytest.raises(RecipeError, match=text):
        prepared.block(1, "train", 0)


# --- backends ---------------------------------------------------------------------------------------------------------


def same_round(prepared: PreparedPipeline, size: int) -> CandidateBatch:
    return prepared._sample_batch(random_generator(SEED, "train", 0), size)


@pytest.mark.parametrize("name", some(SHIPPED, 1, "slow"))
@pytest.mark.parametrize(
    ("backend", "size"),
    [pytest.param("compiled", 6000, marks=needs_compiled_code), ("numpy", 300)],
)
def test_backends_agree_on_the_same_candidates(prepare: Prepare, name, backend, size):
    """Exceptions are candidates close to a rejection limit and searches with two equal optima."""
    one, other = (
        same_round(prepare(name, "numpy"), size),
        same_round(prepare(name, backend), size),
    )
    flipped = np.setxor1d(one.alive, other.alive)
    assert len(flipped) <= 2
    assert set(one.reasons) == set(other.reasons)
    common = np.intersect1d(one.alive, other.alive)
    rows = [np.searchsorted(candidates.alive, common) for candidates in (one, other)]
    assert one.columns.keys() == other.columns.keys()
    off = np.zeros(len(common), bool)
    for column in one.columns:
        differences = np.abs(one[column][:, rows[0]] - other[column][:, rows[1]])
        off |= differences.max(0) > CLOSE
    assert off.sum() <= 1e-3 * len(common)


# --- rows in float32 --------------------------------------------------------------------------------------------------


def test_rounding_to_float32_never_violates_a_limit(prepare: Prepare):
    robot = prepare("heavy-object").context.robot
    field = Field(
        "x",
        "rad",
        "",
        7,
        valid_min=tuple(robot.position_lower),
        valid_max=tuple(robot.position_upper),
    )
    low, high = robot.position_lower[:, None], robot.position_upper[:, None]
    inside = np.concatenate(
        [low, high, np.nextafter(low, 0), np.nextafter(high, 0), 0.5 * (low + high)],
        axis=1,
    )
    stored = as_stored(inside, field)
    np.testing.assert_array_equal(stored, stored.astype(np.float32))
    assert np.all(low <= stored)
    assert np.all(stored <= high)
    np.testing.assert_allclose(stored, inside, rtol=2e-7)


def test_values_outside_a_limit_stay_outside_after_rounding(prepare: Prepare):
    field = Field("x", "rad", "", 1, valid_min=(-1 / 3,), valid_max=(1 / 3,))
    outside = np.array([[-0.34, 0.34, np.nan]])
    np.testing.assert_array_equal(
        as_stored(outside, field), outside.astype(np.float32).astype(float)
    )


def test_fields_without_limits_are_rounded_to_the_nearest(prepare: Prepare):
    values = np.random.default_rng(0).normal(size=(2, 50))
    np.testing.assert_array_equal(
        as_stored(values, Field("x", "m", "", 2)), values.astype(np.float32)
    )


# --- fields -----------------------------------------------------------------------------------------------------------


def test_rows_have_the_declared_fields_in_order(prepared, whole):
    assert sorted(whole.columns) == sorted(field.name for field in prepared.fields)
    for field in prepared.fields:
        assert whole.columns[field.name].shape == (max(field.width, 1), BLOCK_ROWS)
        assert len(field.names) == field.width
    names = [field.name for field in prepared.fields]
    assert names[:5] == ["start_q", "start_dq", "start_ddq", "goal_q", "goal_dq"]
    assert names[-2:] == ["attempts", "sample_id"]


def test_values_are_within_the_limits_that_their_fields_state(prepared, whole):
    for field in prepared.fields:
        values = whole.columns[field.name]
        if field.valid_min is not None:
            assert np.all(values >= np.array(field.valid_min)[:, None] - 1e-14), (
                field.name
            )
        if field.valid_max is not None:
            assert np.all(values <= np.array(field.valid_max)[:, None] + 1e-14), (
                field.name
            )


def test_random_numbers_depend_on_seed_split_and_block():
    draw = partial(lambda *key: random_generator(*key).random(4).tolist())
    keys = [
        (0, "train", 0),
        (1, "train", 0),
        (0, "validation", 0),
        (0, "train", 1),
        (2**63, "train", 0),
    ]
    assert len({tuple(draw(*key)) for key in keys}) == len(keys)
    assert draw(*keys[0]) == draw(*keys[0])
