"""Evaluation of a motion for the verdict: agreement with SciPy's splines, and time derivatives."""

import numpy as np
import pytest
import scipy

from cnpgen.judges.plans.evaluated_trajectory import (
    Phases,
    evaluate_at_phases,
    evaluate_trajectory,
    jerks,
)
from cnpgen.trajectory.spline_motion import Motion
from tests.examples.plans import KNOTS, load
from tests.examples.plans import reference_trajectory as reference


@pytest.mark.parametrize("label", ["hit", "replan", "transport"])
def test_states_agree_with_scipys_splines(label: str) -> None:
    plan = load(label)
    seen = reference(plan, 1001)
    states = evaluate_trajectory(plan.motion, seen.s)
    found = {**vars(states), "jerk": jerks(plan.motion, seen.s)}
    for name, size in (("q", 1e-14), ("dq", 1e-12), ("ddq", 1e-11), ("jerk", 1e-11)):
        expected = getattr(seen, name).T
        np.testing.assert_allclose(
            found[name], expected, atol=size * max(1.0, np.abs(expected).max())
        )


@pytest.mark.parametrize("degree", [3, 5, 7])
def test_any_degree_and_number_of_control_points_is_supported(degree: int) -> None:
    random = np.random.default_rng(degree)
    motion = Motion(
        random.normal(size=(1, degree + 4, 2)),
        random.uniform(0.5, 1, (1, degree + 1)),
        degree,
    )
    s, h = np.linspace(0.07, 0.94, 19), 1e-5
    states, before, after = (
        evaluate_trajectory(motion, s + shift) for shift in (0.0, -h, h)
    )
    expected = motion.at(s)
    rate = expected.rate[0]
    found = {**vars(states), "jerk": jerks(motion, s)}
    for name, values in found.items():
        np.testing.assert_allclose(
            values, getattr(expected, name)[0].T, rtol=1e-9, atol=1e-9
        )
    for lower, higher in (("q", "dq"), ("dq", "ddq"), ("ddq", "jerk")):
        difference = (getattr(after, lower) - getattr(before, lower)) / (2 * h) * rate
        np.testing.assert_allclose(difference, found[higher], rtol=1e-4, atol=1e-3)


@pytest.mark.parametrize("jerk", [False, True])
def test_cached_bases_give_the_same_states(jerk: bool) -> None:
    random = np.random.default_rng(5)
    for points in (12, 17):  # numbers of control points
        motion = Motion(
            random.normal(size=(1, points, 3)), random.uniform(0.5, 1, (1, points + 2))
        )
        s = np.sort(random.uniform(size=31))
        expected, found = (
            evaluate_trajectory(motion, s, jerk=jerk),
            evaluate_at_phases(motion, Phases(s), jerk=jerk),
        )
        for name, values in vars(expected).items():
            assert (getattr(found, name) is None) == (values is None)
            if values is not None:
                np.testing.assert_allclose(
                    getattr(found, name), values, rtol=1e-10, atol=1e-8
                )


def test_values_at_both_ends_and_every_knot_are_correct() -> None:
    plan = load("hit")
    s = np.arange(9) / 8
    spline = scipy.interpolate.BSpline(KNOTS[15], plan.motion.path[0], 7)
    np.testing.assert_allclose(
        evaluate_trajectory(plan.motion, s).q, spline(s).T, atol=1e-13
    )
