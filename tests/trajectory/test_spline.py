"""Clamped uniform B-splines against SciPy's."""

import subprocess
import sys

import numpy as np
import pytest
import scipy

from cnpgen.trajectory.spline import (
    basis,
    chebyshev,
    clamped_knots,
    edges_around,
    end_derivatives,
    extrema,
    graded_edges,
    horner,
    power_coefficients,
    select_spans,
)

SIZES = [(15, 7), (20, 7), (10, 7), (30, 7), (12, 5), (7, 5), (6, 3), (4, 3)]


def test_the_knots_agree_with_appendix_a() -> None:
    assert (
        clamped_knots(15, 7).tolist()
        == [0.0] * 8 + [i / 8 for i in range(1, 8)] + [1.0] * 8
    )
    assert all(
        len(clamped_knots(points, degree)) == points + degree + 1
        for points, degree in SIZES
    )


@pytest.mark.parametrize(("points", "degree"), SIZES)
@pytest.mark.parametrize("order", [0, 1, 2, 3])
def test_the_basis_agrees_with_scipy(points: int, degree: int, order: int) -> None:
    random = np.random.default_rng([points, degree])
    control, s = random.normal(size=(points, 3)), np.linspace(0, 1, 97)
    spline = scipy.interpolate.BSpline(clamped_knots(points, degree), control, degree)
    expected = spline.derivative(order)(s) if order else spline(s)
    found = basis(s, points, degree, order)
    assert found.shape == (97, points)
    assert np.abs(found @ control - expected).max() <= 1e-12 * np.abs(expected).max()


@pytest.mark.parametrize(
    ("points", "degree"), [size for size in SIZES if size[0] >= size[1] + 2]
)
def test_eta_and_beta_give_the_end_derivatives_and_the_printed_eta_does_not(
    points: int, degree: int
) -> None:
    control = np.random.default_rng([points, degree]).normal(size=points)
    spline = scipy.interpolate.BSpline(clamped_knots(points, degree), control, degree)
    ends = end_derivatives(points, degree)
    for c0, c1, c2, s, sign in (
        (*control[:3], 0.0, 1.0),
        (*control[:-4:-1], 1.0, -1.0),
    ):
        first, second = spline.derivative(1)(s), spline.derivative(2)(s)
        assert sign * ends.eta * (c1 - c0) == pytest.approx(first, rel=1e-12)
        assert ends.beta * (c2 - 3 * c1 + 2 * c0) == pytest.approx(second, rel=1e-10)
        printed = degree * (points - degree) ** 2  # Appendix A
        assert sign * printed * (c1 - c0) == pytest.approx(
            (points - degree) * first, rel=1e-12
        )


@pytest.mark.parametrize(("points", "degree"), SIZES)
@pytest.mark.parametrize("shape", [(), (2,)])
def test_power_coefficients_agree_with_the_splines_at_their_own_phases(
    points: int, degree: int, shape: tuple[int, ...]
) -> None:
    random = np.random.default_rng([points, degree])
    control = random.normal(size=(4, points, *shape))
    knots = np.unique(clamped_knots(points, degree))
    s = np.array(
        [
            np.concatenate([knots, row, [0.0, 1.0, 1 - 1e-12]])
            for row in random.uniform(size=(4, 50))
        ]
    )
    picked = select_spans(power_coefficients(control, degree), s)
    for order in range(4):
        found = horner(*picked, order)
        expected = np.array(
            [
                np.tensordot(basis(row, points, degree, order), own, 1)
                for row, own in zip(s, control, strict=True)
            ]
        )
        inner = (
            np.abs(s[..., None] - knots).min(axis=2) > 1e-9
            if order >= degree
            else np.full(s.shape, True)
        )
        inner |= s == 0  # derivatives of order D jump at inner knots
        assert found.shape == (4, s.shape[1], *shape)
        assert np.abs(found - expected)[inner].max() <= 1e-11 * np.abs(expected).max()


def test_phases_of_nan_give_nan_and_do_not_change_other_values() -> None:
    coefficients = power_coefficients(np.ones((1, 15)), 7)
    found = horner(*select_spans(coefficients, np.array([[0.2, np.nan, 1.0]])))[0]
    assert np.isnan(found).tolist() == [False, True, False]


@pytest.mark.slow
def test_the_minimum_between_samples_is_found() -> None:
    random = np.random.default_rng(3)
    s = np.linspace(0, 1, 20_001)
    for _ in range(30):
        control = random.normal(size=20)
        sampled = float((basis(s, 20, 7) @ control).min())
        at, values = extrema(control, 7)
        assert sampled - 1e-5 <= values.min() <= sampled + 1e-14
        np.testing.assert_allclose(basis(at, 20, 7) @ control, values, atol=1e-14)
    assert extrema(np.full(20, 0.7), 7)[1] == pytest.approx(
        0.7, rel=1e-14
    )  # a constant has no isolated extremum
    assert extrema(np.arange(20.0) + 1, 7)[1].min() == 1.0  # at an end


def test_cells_shrink_towards_prescribed_phases() -> None:
    edges = edges_around(np.array([0.0, 0.3, 1.0]), 20, 7)
    assert edges[[0, -1]].tolist() == [0, 1]
    assert np.all(np.diff(edges) > 0)
    assert np.isin(np.append(graded_edges(20, 7), 0.3), edges).all()
    assert np.abs(np.diff(edges)[np.searchsorted(edges, 0.3)]) < 1e-8


@pytest.mark.parametrize(("points", "degree"), SIZES)
def test_graded_edges_ascend_and_contain_the_knots(points: int, degree: int) -> None:
    edges = graded_edges(points, degree)
    assert edges[0] == 0
    assert edges[-1] == 1
    assert np.all(np.diff(edges) > 0)
    assert np.isin(np.arange(points - degree) / (points - degree), edges).all()


def test_chebyshev_points_are_dense_at_both_ends() -> None:
    s = chebyshev(128)
    assert s[[0, -1]].tolist() == [0, 1]
    assert s[1] < 2e-4
    assert np.allclose(s + s[::-1], 1, atol=1e-15)


def test_the_trajectory_does_not_import_scipy() -> None:
    """Its import takes longer than most commands."""
    modules = ", ".join(
        f"cnpgen.trajectory.{name}" for name in ("spline", "boundary", "spline_motion")
    )
    evaluate = "cnpgen.trajectory.spline.basis(numpy.linspace(0, 1, 9), 15, 7, 2)"
    code = f"import sys, numpy, {modules}; {evaluate}; sys.exit('scipy' in sys.modules)"
    subprocess.run([sys.executable, "-c", code], check=True)
