"""Gradients of the loss against finite differences, term by term, of both shipped problems and of a plug-in."""

from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from cnpgen.losses.plan_loss import LossValue, PlanLoss
from cnpgen.schema.keys import Range
from tests.conftest import some
from tests.examples.jerk_limits import jerk_limited
from tests.examples.losses import PROBLEM_OF, Batch, batch, loss, moved, with_weight
from tests.examples.manifolds import MANIFOLDS, joint_limits, problem_on
from tests.examples.plans import PROBLEMS

CASES = [
    (label, term, "signed")
    for label in ("hit", "transport")
    for term in loss(PROBLEM_OF[label]).terms
]
CASES += [
    ("transport", term, "paper")
    for term in ("vertical", "robot-clearance", "object-contact")
]


def weights_of(of: PlanLoss, term: str) -> np.ndarray:
    """Return weights of 0 for all terms but one; all are 0 for "time"."""
    return with_weight(of, of.terms.index(term) - 1) * (term != "time")


def far(label: str) -> Batch:
    """Return plans outside the joint limits, off the table and through pedestals, and some that are almost valid."""
    parts = [batch(label, 3, by=0.1, seed=1), batch(label, 3, by=0.8, seed=2)]
    path, rate, obstacle_poses = (
        np.concatenate([getattr(x, name) for x in parts])
        for name in ("path", "rate", "obstacle_poses")
    )
    return Batch(PROBLEM_OF[label], path, rate, obstacle_poses)


def along(
    given: Batch, of: PlanLoss, direction: tuple[np.ndarray, np.ndarray], **options: Any
) -> np.ndarray:
    """Return the central difference of the total of every plan along a direction."""
    ends = [
        moved(given, given.path + step * direction[0], given.rate + step * direction[1])
        .evaluated(of, gradient=False, **options)
        .total
        for step in (1e-6, -1e-6)
    ]
    return np.asarray((ends[0] - ends[1]) / 2e-6)


def check_along_random_directions(
    given: Batch,
    of: PlanLoss,
    value: LossValue,
    random: np.random.Generator,
    **options: Any,
) -> None:
    """Compare the gradients of a value with central differences of the totals."""
    for _ in range(3):
        direction = (
            random.normal(size=given.path.shape),
            random.normal(size=given.rate.shape),
        )
        expected = along(given, of, direction, **options)
        found = np.einsum("kcn,kcn->k", value.path_gradient, direction[0])
        found += np.einsum("kr,kr->k", value.rate_gradient, direction[1])
        np.testing.assert_allclose(
            found, expected, rtol=1e-6, atol=1e-7 * np.abs(expected).max()
        )


@pytest.mark.parametrize(("label", "term", "form"), some(CASES, 6, "slow"))
def test_the_gradient_of_a_term_agrees_with_central_differences(label, term, form):
    backend = (
        {"backend": "numpy"} if form == "paper" else {}
    )  # faster than compiling for six plans
    of, given, random = (
        loss(PROBLEM_OF[label], form=form, **backend),
        far(label),
        np.random.default_rng(3),
    )
    options = {"weights": weights_of(of, term)}
    if term == "puck-contact":  # move the puck into the way
        given = replace(
            given, obstacle_poses=given.obstacle_poses - [0.2, 0.0, 0.2, 0.0]
        )
    value = given.evaluated(of, **options)
    assert (value.terms[:, of.terms.index(term)] > 0).any()
    check_along_random_directions(given, of, value, random, **options)


@pytest.mark.parametrize("name", some(sorted(MANIFOLDS), 2, "slow"))
def test_the_gradient_of_every_manifold_agrees_with_central_differences(name):
    of = PlanLoss(problem_on(name), dtype="float64", backend="numpy", nodes=16)
    some, random = batch("transport", 3, by=0.5, seed=1), np.random.default_rng(3)
    given = Batch(some.problem, some.path, some.rate, np.zeros((3, 0)))
    for term in of.terms[1 + len(joint_limits()) :]:
        value = given.evaluated(of, weights=weights_of(of, term))
        assert (value.terms[:, of.terms.index(term)] > 0).any()
        check_along_random_directions(
            given, of, value, random, weights=weights_of(of, term)
        )


@pytest.mark.parametrize("label", some(["hit", "transport"], 1, "slow"))
def test_the_gradient_of_limited_jerks_agrees_with_central_differences(label):
    of = PlanLoss(
        jerk_limited(PROBLEM_OF[label])[0], dtype="float64", backend="numpy", nodes=16
    )
    given, random = batch(label, 3, by=0.3, seed=1), np.random.default_rng(3)
    term = of.terms.index("joint-jerk")
    value = given.evaluated(of, weights=weights_of(of, "joint-jerk"))
    assert (value.terms[:, term] > 0).all()
    check_along_random_directions(
        given, of, value, random, weights=weights_of(of, "joint-jerk")
    )


@pytest.mark.parametrize(
    "start", [0.163, 0.19], ids=["in the band", "outside the band"]
)
def test_the_gradient_of_a_motion_that_starts_off_the_table_agrees_with_central_differences(
    start,
):
    of, given, random = (
        loss("airhockey"),
        batch("hit", 6, by=0.1, seed=1),
        np.random.default_rng(5),
    )
    options = {
        "weights": 1e4 * weights_of(of, "table"),
        "start_tip": np.tile([0.65, 0.0, start], (6, 1)),
    }
    value, closed = (
        given.evaluated(of, **options),
        given.evaluated(of, weights=options["weights"]),
    )
    table = of.terms.index("table")
    assert (value.terms[:, table] < closed.terms[:, table]).all()
    assert np.abs(value.path_gradient - closed.path_gradient).max() > 0.1
    check_along_random_directions(given, of, value, random, **options)


@pytest.mark.parametrize("label", some(["hit", "transport"], 1, "slow"))
def test_single_components_of_the_gradient_of_all_terms_agree_with_central_differences(
    label,
):
    of, given = loss(PROBLEM_OF[label]), far(label)[2:4]
    value = given.evaluated(of)
    random = np.random.default_rng(4)
    chosen = [("path", random.integers(0, size)) for size in [given.path[0].size] * 12]
    chosen += [("rate", k) for k in (0, 1, 7, 18, 19)]
    for name, index in chosen:
        direction = {
            "path": np.zeros_like(given.path),
            "rate": np.zeros_like(given.rate),
        }
        direction[name].reshape(2, -1)[:, index] = 1
        expected = along(given, of, (direction["path"], direction["rate"]))
        found = getattr(value, f"{name}_gradient").reshape(2, -1)[:, index]
        scale = np.abs(getattr(value, f"{name}_gradient")).reshape(2, -1).max(1)
        np.testing.assert_allclose(found, expected, rtol=1e-5, atol=1e-7 * scale.max())


def test_a_robot_inside_an_obstacle_has_a_gradient_in_the_signed_form_and_none_in_the_paper_s():
    problem = PROBLEMS["heavy-object"]
    around = replace(problem.obstacle[0], x=Range(-3.0, 3.0), y=Range(-3.0, 3.0))
    given = batch("transport", 4, by=0.05)
    inside = replace(given, obstacle_poses=np.full((4, 1), 2.5))
    for form in ("signed", "paper"):
        of = PlanLoss(
            replace(problem, obstacle=(around,)),
            dtype="float64",
            nodes=8,
            form=form,
            backend="numpy",
        )
        term = of.terms.index("robot-clearance")
        value = inside.evaluated(of, weights=with_weight(of, term - 1))
        without = inside.evaluated(of, weights=np.zeros(len(of.terms) - 1))
        assert (value.terms[:, term] > 1).all()
        change = np.abs(value.path_gradient - without.path_gradient).max(axis=(1, 2))
        assert (change > 0.1).all() if form == "signed" else (change == 0).all()


@pytest.mark.parametrize("label", some(["hit", "transport"], 1, "slow"))
def test_float32_gradients_agree_with_float64_to_a_thousandth(label):
    given = far(label)
    exact, rough = (
        given.evaluated(loss(PROBLEM_OF[label])),
        given.evaluated(loss(PROBLEM_OF[label], dtype="float32")),
    )
    assert (
        rough.total.dtype
        == rough.terms.dtype
        == rough.path_gradient.dtype
        == np.float32
    )
    np.testing.assert_allclose(rough.terms, exact.terms, rtol=2e-4, atol=1e-7)
    for name in ("path_gradient", "rate_gradient"):
        found, expected = (
            getattr(x, name).reshape(len(given.path), -1) for x in (rough, exact)
        )
        error = np.linalg.norm(found - expected, axis=1) / np.linalg.norm(
            expected, axis=1
        )
        assert error.max() < 1e-3, name
