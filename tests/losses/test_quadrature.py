"""Quadrature rules against closed forms and fine grids, and peaks that uniform nodes miss."""

import numpy as np
import pytest

from cnpgen.errors import UsageError
from cnpgen.losses.quadrature import basis_table, quadrature, rotating_shift
from cnpgen.trajectory.boundary import assemble
from cnpgen.trajectory.spline import basis
from tests.examples.losses import Batch, batch, huber, loss, states
from tests.examples.plans import PROBLEMS, ROBOTS, load


@pytest.mark.parametrize(
    ("rule", "shift"),
    [("cosine", 0.0), ("cosine", 0.45), ("cosine", 0.99), ("gauss", 0.0)],
)
@pytest.mark.parametrize("nodes", [1, 8, 64])
def test_nodes_are_ascending_within_the_phase_and_weights_sum_to_one(
    rule, shift, nodes
):
    s, weights = quadrature(rule, nodes, shift)
    assert s.shape == weights.shape == (nodes,)
    assert (s >= 0).all()
    assert (s <= 1).all()
    assert len(set(s)) == nodes
    assert (weights > 0).all()
    assert weights.sum() == pytest.approx(1, abs=1e-13)


@pytest.mark.parametrize("shift", [0.0, 0.2, 0.7])
def test_the_cosine_rule_converges_with_the_square_of_its_nodes_for_any_shift(shift):
    errors = []
    for nodes in (16, 32, 64):
        s, weights = quadrature("cosine", nodes, shift)
        errors.append(abs(weights @ np.exp(2 * s) - np.expm1(2.0) / 2))
    assert errors[0] > 3 * errors[1] > 9 * errors[2]
    assert errors[2] < 1e-3


def test_gauss_integrates_polynomials_exactly():
    s, weights = quadrature("gauss", 6)
    for power in range(12):
        assert weights @ s**power == pytest.approx(1 / (power + 1), rel=1e-13)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (
            ("uniform", 64),
            "expected one of cosine, gauss; between uniform nodes the ends of r hide violations",
        ),
        (("cosin", 64), r"did you mean 'cosine'\?"),
        (("cosine", 0), "must be an integer from 1 on, got 0"),
        (("cosine", 64.5), "must be an integer from 1 on, got 64.5"),
        (("cosine", 8, -0.1), r"must be in \[0, 1\), got -0.1"),
        (("cosine", 8, np.nan), r"must be in \[0, 1\), got nan"),
        (("gauss", 8, 0.5), "must be 0, Gauss nodes cannot be moved, got 0.5"),
    ],
)
def test_unknown_rules_are_refused(arguments, message):
    with pytest.raises(UsageError, match=message):
        quadrature(*arguments)


def test_shifts_rotate_and_put_no_node_on_an_end():
    shifts = [rotating_shift(step, 8) for step in range(16)]
    assert shifts[:8] == shifts[8:]
    assert len(set(shifts)) == 8
    assert all(quadrature("cosine", 32, shift)[0][0] > 0 for shift in shifts)
    assert [rotating_shift(step, 1) for step in range(3)] == [0.0, 0.0, 0.0]
    together = np.sort(
        np.concatenate(
            [
                np.arccos(1 - 2 * quadrature("cosine", 32, shift)[0])
                for shift in shifts[:8]
            ]
        )
    )
    np.testing.assert_allclose(np.diff(together), np.pi / (8 * 32), rtol=1e-6)


def test_the_table_has_the_derivatives_of_both_splines():
    spec = PROBLEMS["airhockey"].trajectory
    table = basis_table(spec, "cosine", 12, 0.25, "float64")
    for order in range(3):
        np.testing.assert_array_equal(
            table.path[12 * order : 12 * (order + 1)], basis(table.s, 15, 7, order)
        )
    for order in range(2):
        np.testing.assert_array_equal(
            table.rate[12 * order : 12 * (order + 1)], basis(table.s, 20, 7, order)
        )


# Relative errors of 64 nodes against 4096, on plans with 0.1 rad of noise on every control point.
@pytest.mark.parametrize("label", ["hit", "transport"])
@pytest.mark.parametrize("rule", ["cosine", "gauss"])
def test_64_nodes_are_within_a_few_percent_of_4096(label, rule):
    given = batch(label, 8)
    fine = given.evaluated(loss(given.problem, rule="cosine", nodes=4096))
    found = given.evaluated(loss(given.problem, rule=rule, nodes=64))
    np.testing.assert_allclose(found.terms[:, 0], fine.terms[:, 0], rtol=5e-3)
    np.testing.assert_allclose(found.total, fine.total, rtol=0.02)
    for name in ("path_gradient", "rate_gradient"):
        a, b = (getattr(value, name).reshape(8, -1) for value in (found, fine))
        assert (
            np.median(np.linalg.norm(a - b, axis=1) / np.linalg.norm(b, axis=1)) < 0.1
        )


def test_the_average_over_shifts_reduces_the_error():
    given = batch("hit", 8)
    fine = given.evaluated(loss("airhockey", nodes=4096)).path_gradient
    of = loss("airhockey", nodes=32)

    def error(gradients: list[np.ndarray]) -> float:
        return float(
            np.linalg.norm(np.mean(gradients, axis=0) - fine) / np.linalg.norm(fine)
        )

    turns = [
        given.evaluated(of, shift=rotating_shift(step)).path_gradient
        for step in range(8)
    ]
    assert error(turns) < 0.3 * error(turns[:1])


def spiked() -> Batch:
    """Return a stored plan whose rate jumps at the end of the phase, with the same boundary conditions and a large ddq.

    The last basis function of r is about 0.01 wide; this is how training hides from uniform nodes.
    """
    plan = load("hit")
    rate = plan.motion.rate.copy()
    rate[:, -1] *= 10
    path = assemble(
        plan.boundary, plan.motion.path[:, 3:13], rate, plan.problem.trajectory
    )
    return Batch("airhockey", path, rate, plan.scene.poses)


def acceleration_loss(
    given: Batch, s: np.ndarray, weights: np.ndarray
) -> tuple[float, np.ndarray]:
    """Return the acceleration term from SciPy's splines, and |ddq| relative to its limit at every node."""
    limit, at = (
        ROBOTS["airhockey"].acceleration_limit,
        states(given.path[0], given.rate[0], s),
    )
    excess = np.maximum(np.abs(at.ddq) - limit, 0)
    return float((weights / at.rate) @ huber(excess).sum(axis=1)), (
        np.abs(at.ddq) / limit
    ).max(axis=1)


def test_an_acceleration_peak_in_the_last_percent_of_the_phase_is_detected():
    given, of = spiked(), loss("airhockey")
    s, weights = quadrature("cosine", 4096)
    truth, peak = acceleration_loss(given, s, weights)
    assert peak.max() > 100
    assert s[peak > 25].min() > 0.985
    between = acceleration_loss(given, (np.arange(64) + 0.5) / 64, np.full(64, 1 / 64))[
        0
    ]
    with_ends = acceleration_loss(given, np.linspace(0, 1, 64), np.full(64, 1 / 64))[0]
    assert between < 0.6 * truth
    assert with_ends > 2 * truth
    for rule in ("cosine", "gauss"):
        seen = given.evaluated(loss("airhockey", rule=rule)).terms[
            0, of.terms.index("joint-acceleration")
        ]
        assert seen == pytest.approx(truth, rel=0.02)
