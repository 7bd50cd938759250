"""Smooth conditions between samples: their maximum does not depend on the initial samples."""

from collections.abc import Callable
from dataclasses import replace
from importlib import import_module
from types import SimpleNamespace

import numpy as np
import pytest

from cnpgen.judges.plans.judge import Judge
from cnpgen.judges.plans.sampling import Samples
from cnpgen.problems.constraints.joint import JointTorque
from cnpgen.trajectory.boundary import Boundary
from cnpgen.trajectory.spline import basis
from cnpgen.trajectory.spline_motion import Motion
from tests.conftest import some
from tests.examples.plans import load, perturbed, raised, reference_trajectory

judge_module = import_module(
    "cnpgen.judges.plans.judge"
)  # the package has a function of the same name


@pytest.mark.parametrize("label", some(["replan", "transport", "hit"], 2))
@pytest.mark.parametrize("seed", some([1, 2]))
def test_margins_agree_with_a_very_fine_grid(label: str, seed: int) -> None:
    plan = perturbed(load(label), 0.01, seed=seed)
    exact, margins = reference_trajectory(plan, 20001), plan.judged().margins
    found, limit = margins["joint torque"], plan.robot.torque_limit
    joint = plan.robot.joint_names.index(found.part)
    worst = (np.abs(exact.tau[:, joint]) - limit[joint]).max()
    assert found.violation == pytest.approx(worst, abs=1e-2 * found.tolerance)
    if "table height" in margins:
        name, worst = (
            "table height",
            np.abs(exact.tip[:, 2] - margins["table height"].bound).max(),
        )
    else:
        name, worst = (
            "tilt",
            np.arctan2(
                np.hypot(*exact.rotation[:, :2, 2].T), exact.rotation[:, 2, 2]
            ).max(),
        )
    assert margins[name].violation == pytest.approx(
        worst, abs=1e-2 * margins[name].tolerance
    )


@pytest.mark.slow
def test_without_the_search_a_maximum_between_samples_would_be_missed(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """The plan exceeds the tolerance of the table height by a nanometer, between samples at steps of 10 ms."""
    plan = perturbed(load("replan"), 0.05, seed=1)
    off = np.abs(
        reference_trajectory(plan, 200_001).tip[:, 2]
        - plan.judged().margins["table height"].bound
    ).max()
    strict = plan.with_constraint("Table", tolerance=off - 1e-9)
    assert not strict.judged(step=1e-2).margins["table height"].ok
    monkeypatch.setattr(judge_module, "check_local_maxima", lambda _: iter(()))
    assert strict.judged(step=1e-2).margins["table height"].ok


def test_the_largest_violation_at_a_kink_of_a_relaxed_bound_is_found() -> None:
    """A slow motion down to the table violates the relaxed bound most at its kinks."""
    plan = raised(load("replan"), 0.01)
    fine, coarse = (
        plan.judged(step=step).margins["table height"] for step in (1e-4, 1e-2)
    )
    assert coarse.violation == pytest.approx(fine.violation, abs=1e-2 * fine.tolerance)


class OneCondition:
    """An evaluation context of one condition, whose violation is a function of the phase, at uniform samples."""

    def __init__(
        self, violation: Callable[[np.ndarray], np.ndarray], samples: int = 24
    ) -> None:
        self._violation, s = violation, np.linspace(0, 1, samples)
        self.samples, self.measured, self.evaluations = (
            Samples(s, s),
            self.measure(None, s),
            0,
        )

    def move(self, s: np.ndarray) -> None:
        self.evaluations += len(s)

    def measure(self, _: object, s: np.ndarray) -> list[SimpleNamespace]:
        return [
            SimpleNamespace(
                constraint=None,
                condition=SimpleNamespace(name="it"),
                relative_violation=self._violation(s)[None],
            )
        ]

    def margin(self, found: SimpleNamespace, _: np.ndarray) -> float:
        return float(found.relative_violation.max())

    def largest(self) -> float:
        """Return the largest violation at the samples and in the search."""
        return max(
            [
                self.measured[0].relative_violation.max(),
                *(margin for _, margin in judge_module.check_local_maxima(self)),
            ]
        )


@pytest.mark.parametrize("top", [1.2, 1 + 1e-6, 1 - 1e-6, 0.9])
@pytest.mark.parametrize("first", [0.3, 0.5123])
def test_a_narrow_smooth_maximum_is_resolved_if_it_decides(
    first: float, top: float
) -> None:
    """One condition has a maximum between samples, which is sampled until its value is known."""
    context = OneCondition(
        lambda s: top - 40 * np.square(s - first) - 300 * np.abs(s - first) ** 3
    )
    largest = context.largest()
    assert largest == pytest.approx(top, abs=1e-2)
    assert (largest > 1) == (top > 1)
    assert context.evaluations < 100


def _rises_slowly_and_falls_fast(s: np.ndarray) -> np.ndarray:
    return np.exp(8 * (s - 0.5)) - 0.3 * np.exp(40 * (s - 0.5))


def _starts_near_its_maximum(s: np.ndarray) -> np.ndarray:
    return -30 * np.square(s - 0.01)


def _has_two_maxima_in_one_interval(s: np.ndarray) -> np.ndarray:
    return -4e5 * np.square(np.square(s - 0.5) - 1e-4)


@pytest.mark.parametrize("by", [1e-5, -1e-5])
@pytest.mark.parametrize(
    "shape",
    [
        _rises_slowly_and_falls_fast,
        _starts_near_its_maximum,
        _has_two_maxima_in_one_interval,
    ],
)
def test_maxima_that_are_not_parabolic_are_decided_correctly(
    shape: Callable[[np.ndarray], np.ndarray], by: float
) -> None:
    top = shape(np.linspace(0, 1, 10_000_001)).max()
    context = OneCondition(lambda s: 1 + 10 * (shape(s) - top) + by)
    assert (context.largest() > 1) == (by > 0)


def test_a_kink_of_the_torque_at_a_knot_of_either_spline_is_sampled() -> None:
    """Splines of degree 3 have accelerations with kinks, here with a maximum at a knot of one of them."""
    plan, points, rates, knot = load("hit"), 9, 16, 1 / 6
    path = np.repeat(plan.robot.home[None, None], points, axis=1)
    bumps = np.clip(1 - 6 * np.abs(np.arange(7) / 6 - knot), 0, None) - 0.5 * (
        np.abs(np.arange(7) - 1) == 1
    )
    path[0, :, 1] += (
        300
        * np.linalg.lstsq(basis(np.arange(7) / 6, points, 3, 2), bumps, rcond=None)[0]
    )
    motion = Motion(path, np.full((1, rates), 2.0), 3)
    state = motion.at(np.array([0.0, 1.0]))
    ends = Boundary(
        *(getattr(state, name)[:, k] for k in (0, 1) for name in ("q", "dq", "ddq"))
    )
    only = tuple(
        constraint
        for constraint in plan.problem.constraint
        if isinstance(constraint, JointTorque)
    )
    arguments = motion, ends, plan.scene, plan.goal_xyz
    margin = Judge(replace(plan.problem, constraint=only), plan.robot)(*arguments)[
        0
    ].margins["joint torque"]
    assert margin.phase == pytest.approx(knot, abs=1e-9)
    ratio = margin.violation / margin.tolerance
    for by in (0.999, 1.001):
        constraint = tuple(
            replace(each, tolerance=each.tolerance * ratio * by) for each in only
        )
        judge = Judge(replace(plan.problem, constraint=constraint), plan.robot)
        assert [
            judge(*arguments, early_exit=early_exit)[0].valid
            for early_exit in (True, False)
        ] == [by > 1] * 2
