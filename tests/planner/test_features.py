"""The network's inputs: their values, and standardization by the training rows."""

from dataclasses import replace

import numpy as np

from cnpgen.planner.network.features import (
    USUAL,
    count_features,
    feature_blocks,
    fit_features,
    raw_features,
)
from tests.planner.test_control_points import tasks
from tests.refusals import is_refused


def test_features_of_the_rows_they_were_fitted_to_have_mean_zero_and_deviation_one():
    given = tasks()
    found = fit_features([given]).of(given, "float64")
    np.testing.assert_allclose(found.mean(axis=0), 0, atol=1e-12)
    np.testing.assert_allclose(found.std(axis=0), 1, rtol=1e-9)


def test_mean_and_deviation_of_parts_equal_those_of_the_whole():
    given = tasks()
    whole, parts = (
        fit_features([given]),
        fit_features(given.take(rows) for rows in (slice(0, 1), slice(1, None))),
    )
    np.testing.assert_allclose(parts.mean, whole.mean, rtol=1e-12, atol=1e-15)
    np.testing.assert_allclose(parts.scale, whole.scale, rtol=1e-9)


def test_features_that_were_constant_in_training_rows_are_zero():
    given, other = tasks(seed=0), tasks(seed=1)
    given.boundary.start_dq[:] = 0.5
    features = fit_features([given])
    found = features.of(other)
    assert np.isfinite(found).all()
    np.testing.assert_array_equal(found[:, 3:6], 0)  # where start_dq is
    assert (np.abs(found[:, :3]) > 0).all()


def test_features_are_states_their_sines_tips_and_the_expected_time():
    given = tasks()
    raw, b = raw_features(given, USUAL), given.boundary
    expected = [
        b.start_q, b.start_dq, b.start_ddq, b.goal_q, b.goal_dq,
        np.sin(b.start_q), np.sin(b.goal_q), np.cos(b.start_q), np.cos(b.goal_q),
        given.start_xyz, given.goal_xyz, np.log(given.expected_time)[:, None],
    ]  # fmt: skip
    np.testing.assert_allclose(raw, np.concatenate(expected, axis=1))


def test_the_goal_acceleration_is_a_feature_if_it_is_given():
    assert feature_blocks(tasks().boundary) == USUAL
    given = tasks(goal_ddq=True)
    blocks = (*USUAL, "goal_ddq")
    assert feature_blocks(given.boundary) == blocks
    raw = raw_features(given, blocks)
    np.testing.assert_array_equal(raw[:, :-3], raw_features(given, USUAL))
    np.testing.assert_array_equal(raw[:, -3:], given.boundary.goal_ddq)


def test_the_parameters_of_a_problem_are_features_if_there_are_any():
    given = tasks()
    parameters = np.arange(2.0 * len(given)).reshape(-1, 2)
    given = replace(given, boundary=replace(given.boundary, parameters=parameters))
    assert feature_blocks(given.boundary) == (*USUAL, "parameters")
    np.testing.assert_array_equal(
        raw_features(given, (*USUAL, "parameters"))[:, -2:], parameters
    )
    assert count_features((*USUAL, "parameters"), 7, 2) == count_features(USUAL, 7) + 2


def test_an_unknown_feature_block_raises_an_error_with_the_known_ones():
    with is_refused(ValueError):
        raw_features(tasks(), ("colour",))
