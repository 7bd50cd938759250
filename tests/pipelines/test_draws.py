"""Sampled distributions of positions, guesses, directions and speeds: chi-square and Kolmogorov-Smirnov tests."""

from dataclasses import replace

import numpy as np
import pytest
import scipy  # imports its statistics lazily, which takes a second

from cnpgen.errors import RecipeError
from cnpgen.pipelines.pipeline import load_pipeline
from cnpgen.pipelines.prepared import PreparedPipeline, random_generator
from cnpgen.pipelines.stages.draw import DrawPositions
from cnpgen.pipelines.stages.hit_angle import wrap
from cnpgen.pipelines.stages.stage import CandidateBatch
from cnpgen.schema.keys import Range
from tests.conftest import SHIPPED, Prepare, run_stages
from tests.refusals import is_refused

DRAWS = 40_000
PROBABLE = (
    1e-4  # p-value below which a sample is rejected as a sample of its distribution
)


def is_uniform(values: np.ndarray, low: float, high: float) -> bool:
    inside = low <= values.min() and values.max() <= high
    return (
        inside
        and scipy.stats.kstest(values, "uniform", (low, high - low)).pvalue > PROBABLE
    )


def is_fraction(hits: np.ndarray, fraction: float) -> bool:
    counts = np.array([np.sum(hits), np.sum(~hits)])
    return (
        scipy.stats.chisquare(
            counts, len(hits) * np.array([fraction, 1 - fraction])
        ).pvalue
        > PROBABLE
    )


def stage_of(prepared: PreparedPipeline, kind: str):
    return next(
        stage for stage in prepared.pipeline.stage if type(stage).__name__ == kind
    )


# --- positions --------------------------------------------------------------------------------------------------------


@pytest.fixture(scope="module", params=SHIPPED)
def drawn(
    request: pytest.FixtureRequest, prepare: Prepare
) -> tuple[PreparedPipeline, CandidateBatch]:
    prepared = prepare(request.param)
    return prepared, run_stages(prepared, DRAWS, seed=11, until="DrawPositions")


def plain_rejection(stage: DrawPositions, count: int) -> dict[str, np.ndarray]:
    """Sample the distribution with NumPy: uniform in both boxes, rejected if too close together."""
    random = np.random.default_rng(12)
    ends = {}
    for name, box in (("start", stage.start), ("goal", stage.goal)):
        ends[name] = np.array(
            [random.uniform(axis.low, axis.high, count) for axis in box]
        )
    separation = np.linalg.norm((ends["goal"] - ends["start"])[:2], axis=0)
    return {
        name: values[:, separation >= stage.min_distance]
        for name, values in ends.items()
    }


def test_positions_have_the_distribution_of_plain_rejection_sampling(drawn):
    prepared, candidates = drawn
    stage = stage_of(prepared, "DrawPositions")
    expected = plain_rejection(stage, DRAWS)
    if stage.min_distance:
        kept = np.array([len(candidates.alive), expected["start"].shape[1]])
        assert scipy.stats.chi2_contingency([kept, DRAWS - kept]).pvalue > PROBABLE
    for end in ("start", "goal"):
        for axis in range(3):
            assert (
                scipy.stats.ks_2samp(
                    candidates[f"{end}_xyz"][axis], expected[end][axis]
                ).pvalue
                > PROBABLE
            )
    distances = [np.hypot(*(ends[1] - ends[0])[:2]) for ends in (
        (candidates["start_xyz"], candidates["goal_xyz"]), (expected["start"], expected["goal"]),
    )]  # fmt: skip
    assert scipy.stats.ks_2samp(*distances).pvalue > PROBABLE


def test_positions_before_the_rejection_are_uniform_in_their_boxes(drawn):
    prepared, candidates = drawn
    stage = stage_of(prepared, "DrawPositions")
    for end, box in (("start", stage.start), ("goal", stage.goal)):
        for axis, values in zip(box, candidates.drawn[f"{end}_xyz"], strict=True):
            assert values.shape == (DRAWS,)
            if axis.low == axis.high:
                np.testing.assert_array_equal(values, axis.low)
            else:
                assert is_uniform(values, axis.low, axis.high)


def test_start_and_goal_are_independent_before_the_rejection(drawn):
    _, candidates = drawn
    pairs = np.corrcoef(
        np.concatenate(
            [candidates.drawn["start_xyz"][:2], candidates.drawn["goal_xyz"][:2]]
        )
    )
    assert np.abs(pairs - np.eye(4)).max() < 4 / np.sqrt(DRAWS)


def test_start_and_goal_have_the_minimum_distance(drawn):
    prepared, candidates = drawn
    separation = np.hypot(*(candidates["goal_xyz"] - candidates["start_xyz"])[:2])
    assert separation.min() >= stage_of(prepared, "DrawPositions").min_distance
    assert candidates.reasons == ["too close together"]


def test_boxes_out_of_reach_are_a_mistake_in_the_recipe(prepare):
    stage = stage_of(prepare("airhockey-hit"), "DrawPositions")
    far = replace(stage, goal=(Range(2.0, 3.0), Range(0.0, 0.1), Range(0.16, 0.16)))
    with is_refused(RecipeError):
        far.prepare(prepare("airhockey-hit").context)


# --- inverse kinematics: the guess ------------------------------------------------------------------------------------


@pytest.mark.parametrize("name", ["airhockey-replan", "heavy-object"])
def test_guesses_are_uniform_and_independent_in_their_box(prepare, name):
    prepared = prepare(name)
    stage = stage_of(prepared, "StartIK")
    guess, candidates = stage.guess, CandidateBatch(DRAWS)
    candidates["start_xyz"] = np.zeros((3, DRAWS))
    stage.prepare(prepared.context)(candidates, random_generator(13, "train", 0))
    values = candidates.drawn["guess_q"]
    assert values.shape == (len(guess), DRAWS)
    for axis, row in zip(guess, values, strict=True):
        assert is_uniform(row, axis.low, axis.high)
    assert np.abs(np.corrcoef(values) - np.eye(len(guess))).max() < 4 / np.sqrt(DRAWS)


def test_the_replanning_guess_has_the_documented_range(prepare):
    guess = stage_of(prepare("airhockey-replan"), "StartIK").guess
    expected = [
        (-0.6, 0.6),
        (0.5, 1.4),
        (-0.7, 0.7),
        (-0.7, -0.4),
        (-0.4, 0.4),
        (0.4, 1.9),
    ]
    assert [(axis.low, axis.high) for axis in guess] == expected


def test_the_heavy_object_guess_is_table_ii_with_its_erratum(prepare):
    guess = stage_of(prepare("heavy-object"), "StartIK").guess
    half = np.pi / 2
    expected = [
        (-half, half),
        (0, half),
        (-half, half),
        (-half, 0),
        (-half, half),
        (-half, half),
        (-np.pi, np.pi),
    ]
    np.testing.assert_allclose(
        [(axis.low, axis.high) for axis in guess], expected, rtol=1e-15
    )


def test_without_a_guess_the_search_starts_from_the_base_configuration(prepare):
    prepared = prepare("airhockey-hit")
    guess = run_stages(prepared, 50, until="StartIK")["guess_q"]
    np.testing.assert_array_equal(
        guess, np.repeat(prepared.context.robot.home[:, None], guess.shape[1], axis=1)
    )


# --- directions -------------------------------------------------------------------------------------------------------


def test_hits_aim_at_the_target_with_uniform_noise(prepare):
    candidates = run_stages(
        prepare("airhockey-hit"), DRAWS, seed=14, until="HitAngleToGoal"
    )
    x, y, _ = candidates["goal_xyz"]
    noise = wrap(candidates["hit_angle"][0] - np.arctan2(0.0 - y, 2.49 - x))
    assert is_uniform(noise, -0.3 - 1e-12, 0.3 + 1e-12)
    assert abs(np.corrcoef(noise, y)[0, 1]) < 4 / np.sqrt(len(noise))


def test_hit_directions_are_uniform_in_the_cone_about_the_line_from_start_to_goal(
    prepare,
):
    candidates = run_stages(
        prepare("airhockey-replan"), DRAWS, seed=15, until="HitAngleInCone"
    )
    x, y = (candidates["goal_xyz"] - candidates["start_xyz"])[:2]
    off = wrap(candidates["hit_angle"][0] - np.arctan2(y, x))
    assert is_uniform(off, -2 * np.pi / 3 - 1e-12, 2 * np.pi / 3 + 1e-12)
    assert -np.pi <= candidates["hit_angle"].min() < -3.1
    assert 3.1 < candidates["hit_angle"].max() <= np.pi


def test_angles_are_wrapped_to_half_a_turn_on_either_side():
    turns = np.array(
        [0.0, np.pi, -np.pi, 3 * np.pi, -3.5 * np.pi, 7.0, -7.0, 1e-18 - np.pi]
    )
    wrapped = wrap(turns)
    assert np.all((-np.pi <= wrapped) & (wrapped <= np.pi))
    np.testing.assert_allclose(np.exp(1j * wrapped), np.exp(1j * turns), atol=1e-14)


# --- speeds and rest --------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("name", "fraction"), [("airhockey-hit", 0.5), ("airhockey-replan", 0.2)]
)
def test_the_stated_fraction_of_hits_is_at_full_speed_and_the_rest_uniformly_slower(
    prepare, name, fraction
):
    candidates = run_stages(prepare(name), DRAWS, seed=16, until="HittingVelocity")
    speed, fastest = candidates["hit_speed"][0], candidates["hit_speed_max"][0]
    full = speed == fastest
    assert is_fraction(full, fraction)
    assert is_uniform((speed / fastest)[~full], 0.0, 1.0)
    slow = (
        np.abs(candidates["goal_dq"])
        / prepare(name).context.robot.velocity_limit[:, None]
    )
    np.testing.assert_array_less(slow.max(0)[~full], 1.0)


def test_a_fifth_of_the_starts_is_exactly_at_rest(prepare):
    candidates = run_stages(
        prepare("airhockey-replan"), DRAWS, seed=17, until="TableVelocity"
    )
    rest = np.all(candidates["start_dq"] == 0.0, axis=0)
    assert is_fraction(rest, 0.2)
    np.testing.assert_array_equal(candidates["start_tip_velocity"][:, rest], 0.0)
    max_duration = np.abs(candidates["start_dq"][:, ~rest]).max(0)
    assert max_duration.min() > 0


def test_moving_starts_reach_a_uniform_fraction_of_their_tightest_limit(prepare):
    prepared = prepare("airhockey-replan")
    candidates = run_stages(prepared, DRAWS, seed=18, until="TableVelocity")
    ratio = (
        np.abs(candidates["start_dq"]) / prepared.context.robot.velocity_limit[:, None]
    ).max(0)
    assert is_uniform(ratio[ratio > 0], 0.0, 1.0)


def test_accelerations_are_uniform_in_the_interval_of_the_limits(prepare):
    from cnpgen.pipelines.stages.boundary_motion import table_acceleration

    prepared = prepare("airhockey-replan")
    kernel = prepared.context.kernels.load(table_acceleration)
    state = run_stages(prepared, 2000, seed=19, until="TableVelocity")
    q, dq = state["start_q"], state["start_dq"]
    random = np.random.default_rng(20)
    u, s = random.uniform(-1, 1, q.shape), random.random((1, q.shape[1]))
    low, _ = kernel(q, dq, u, np.zeros_like(s))
    high, _ = kernel(q, dq, u, np.ones_like(s))
    between, _ = kernel(q, dq, u, s)
    np.testing.assert_allclose(between, low + s * (high - low), atol=1e-11)


@pytest.mark.parametrize(
    ("name", "ends"),
    [("airhockey-hit", ["start"]), ("heavy-object", ["start", "goal"])],
)
def test_ends_at_rest_have_zero_velocity_and_acceleration(prepare, name, ends):
    candidates = run_stages(prepare(name), 300)
    for end in ends:
        for what in ("dq", "ddq"):
            assert candidates[f"{end}_{what}"].shape == candidates["start_q"].shape
            np.testing.assert_array_equal(candidates[f"{end}_{what}"], 0.0)


# --- batches ----------------------------------------------------------------------------------------------------------


def test_random_numbers_of_a_stage_do_not_depend_on_earlier_rejections():
    whole, thinned = CandidateBatch(100), CandidateBatch(100)
    random = [np.random.default_rng(21) for _ in range(2)]
    first = whole.draw(random[0], 2)
    keep = np.arange(100) % 3 != 0
    np.testing.assert_array_equal(thinned.draw(random[1], 2), first)
    thinned.reject(keep, "a third")
    np.testing.assert_array_equal(
        thinned.draw(random[1], 4), whole.draw(random[0], 4)[:, keep]
    )


def test_every_rejected_candidate_has_one_outcome_and_is_dropped_from_every_column():
    candidates = CandidateBatch(10)
    candidates["x"] = np.arange(10.0)[None]
    candidates.reject(np.arange(10) % 2 == 0, "odd")
    candidates["y"] = 2 * candidates["x"]
    candidates.reject(candidates["x"][0] > 3, "small")
    candidates.reject(np.ones(3, bool), "never")
    assert candidates.reasons == ["odd", "small", "never"]
    assert candidates.outcome.tolist() == [2, 1, 2, 1, 0, 1, 0, 1, 0, 1]
    assert candidates.alive.tolist() == [4, 6, 8]
    np.testing.assert_array_equal(candidates["x"], [[4, 6, 8]])
    np.testing.assert_array_equal(candidates["y"], [[8, 12, 16]])
    np.testing.assert_array_equal(candidates.drawn["x"], [np.arange(10)])


def test_joint_and_sequential_rejections_have_the_same_reasons():
    names, met = (
        ["first", "second", "first again", "none", "second"],
        np.random.default_rng(3).random((5, 200)) > 0.2,
    )
    met[3] = True
    together, one_by_one = CandidateBatch(200), CandidateBatch(200)
    for candidates in (together, one_by_one):
        candidates["x"] = np.arange(200.0)[None]
        candidates.reject(np.arange(200) % 7 != 0, "before")
    together.reject_first(met[:, together.alive], names)
    for name, ok in zip(names, met, strict=True):
        one_by_one.reject(ok[one_by_one.alive], name)
    assert (
        together.reasons
        == one_by_one.reasons
        == ["before", "first", "second", "first again", "none"]
    )
    assert len(set(together.outcome.tolist())) == 5
    for name in ("outcome", "alive"):
        np.testing.assert_array_equal(
            getattr(together, name), getattr(one_by_one, name)
        )
    np.testing.assert_array_equal(together["x"], one_by_one["x"])
    assert "y" not in candidates.drawn


def test_columns_of_the_wrong_length_raise_an_error():
    candidates = CandidateBatch(4)
    with is_refused(ValueError):
        candidates["x"] = np.zeros((2, 3))
    with is_refused(ValueError):
        candidates["x"] = np.zeros(4)


@pytest.mark.parametrize("name", SHIPPED)
def test_every_stage_accepts_an_empty_batch(prepare, name):
    prepared = prepare(name)
    candidates, random = CandidateBatch(64), random_generator(0, "train", 0)
    for stage in load_pipeline(name).stage:
        run = stage.prepare(prepared.context)
        run(candidates, random)
        candidates.reject(np.zeros(len(candidates.alive), bool), "everything")
    assert len(candidates.alive) == 0
