"""Curves of conditions over time: compared with Pinocchio and with the margins of the verdict."""

from dataclasses import replace

import numpy as np
import pytest

from cnpgen.judges.plans.condition_curves import (
    ConditionCurve,
    condition_curves,
    plot_unit,
)
from cnpgen.judges.plans.plan_plot import along
from cnpgen.problems.constraints.axis import Axis
from tests.examples.plans import Plan, load, perturbed, reference_trajectory


def curves_of(
    plan: Plan, *times: float
) -> tuple[dict[str, ConditionCurve], np.ndarray]:
    """Return the curves of a plan by the name of their condition, and their times."""
    world, s, t = along(
        plan.problem,
        plan.robot,
        plan.motion,
        0,
        samples=300,
        extra_times=times,
        scene=plan.scene,
    )
    return {curve.name: curve for curve in condition_curves(plan.problem, world, s)}, t


def test_the_tilt_is_the_angle_between_the_tip_s_axis_and_the_vertical() -> None:
    plan = perturbed(load("transport"), 0.05)
    curves, t = curves_of(plan)
    reference = reference_trajectory(plan)
    angle = np.degrees(np.arccos(np.clip(reference.rotation[:, 2, 2], -1, 1)))
    np.testing.assert_allclose(
        curves["tilt"].values[0], np.interp(t, reference.t, angle), atol=0.02
    )
    assert (curves["tilt"].unit, curves["tilt"].tolerance) == (
        "deg",
        pytest.approx(1.8),
    )


def test_an_allowed_tilt_is_drawn_as_an_angle_with_its_limit() -> None:
    plan = perturbed(load("transport"), 0.05)
    limited = replace(
        plan,
        problem=replace(plan.problem, constraint=(Axis(angle=0.3, tolerance=0.01),)),
    )
    (curve,) = curves_of(limited)[0].values()
    np.testing.assert_allclose(
        curve.values, curves_of(plan)[0]["tilt"].values, atol=1e-4
    )
    assert curve.upper[0] == pytest.approx(np.degrees(0.3))
    assert curve.tolerance == pytest.approx(np.degrees(0.01))


def test_the_height_over_the_table_is_its_deviation_and_relaxed_for_the_start() -> None:
    plan = load("hit")
    curves, t = curves_of(plan)
    height, reference = curves["table height"], reference_trajectory(plan)
    expected = 1e3 * (np.interp(t, reference.t, reference.tip[:, 2]) - 0.16)
    np.testing.assert_allclose(height.values[0], expected, atol=1e-3)
    assert height.label == "table height, deviation"
    start = 1e3 * abs(plan.start_xyz[0, 2] - 0.16)
    assert (height.upper[0], height.upper[-1]) == (pytest.approx(start), 0)
    assert curves["table rectangle"].parts == ("x", "y")


@pytest.mark.parametrize(("label", "by"), [("hit", 0.1), ("transport", 0.2)])
def test_violations_are_those_of_the_verdict(label: str, by: float) -> None:
    plan = perturbed(load(label), by)
    margins = plan.judged().margins
    curves, t = curves_of(plan, *(margin.time for margin in margins.values()))
    assert curves.keys() <= margins.keys()
    assert any(curve.violated.any() for curve in curves.values())
    for name, curve in curves.items():
        margin, (factor, _) = margins[name], plot_unit(margins[name].unit)
        frame = int(np.abs(t - margin.time).argmin())
        outside = np.maximum(curve.lower - curve.values, curve.values - curve.upper)
        assert outside[:, frame].max() == pytest.approx(
            factor * margin.violation, abs=1e-3
        ), name
        assert outside.max() <= factor * margin.violation + 0.02, name
        assert curve.violated[frame] == (not margin.ok)
        if curve.pairs:
            assert curve.pairs[frame] == margin.part


def test_a_valid_plan_violates_nothing() -> None:
    for label in ("hit", "transport"):
        assert not any(
            curve.violated.any() for curve in curves_of(load(label))[0].values()
        )
