"""Families of curves through samples: every curve that they describe stays within their bounds."""

import numpy as np
import pytest
import scipy

from cnpgen.addons.trajectories.curve_family import ORDERS, UNDEFINED, CurveFamily
from cnpgen.addons.trajectories.interpolate import bounded_jerk, interpolated
from cnpgen.addons.trajectories.sampled_trajectory import Trajectory
from cnpgen.errors import UsageError
from tests.refusals import is_refused

EXACT = np.zeros(3)


def smooth(times: np.ndarray, order: int = 0) -> np.ndarray:
    """Return derivatives of a motion of two joints whose jerks are at most (35, 60), shape (K, 2)."""
    rate, phase = np.array([3.0, 5.0]), np.array([0.3, 1.1])
    scale = np.array([34.0, 59.0]) / rate**3
    return (
        scale * rate**order * np.sin(rate * times[:, None] + phase + order * np.pi / 2)
    )


JERK = np.array([35.0, 60.0])


def sampled(times: np.ndarray, orders: int) -> Trajectory:
    return Trajectory(times, *(smooth(times, order) for order in range(orders + 1)))


def irregular(count: int, seed: int = 0) -> np.ndarray:
    steps = np.random.default_rng(seed).uniform(0.2, 1.8, count - 1)
    return np.concatenate([[0.0], np.cumsum(steps)]) / steps.sum()


@pytest.mark.parametrize(("orders", "degree"), [(0, 1), (1, 3), (2, 5)])
def test_the_interpolation_is_that_of_scipy(orders: int, degree: int) -> None:
    times = irregular(9)
    trajectory = sampled(times, orders)
    family = interpolated(trajectory, None, EXACT)
    assert len(family.coefficients) == degree + 1
    s = np.sort(np.random.default_rng(1).uniform(0, 1, 300))
    data = np.stack([smooth(times, order) for order in range(orders + 1)], axis=1)
    reference = scipy.interpolate.BPoly.from_derivatives(times, data)
    states = family.evaluate(s, jerk=False)
    for order, name in enumerate(ORDERS[: min(degree, 2) + 1]):
        assert np.allclose(
            getattr(states, name), reference(s * times[-1], order).T, atol=1e-9
        ), name


def test_derivatives_that_jump_are_undefined() -> None:
    times = np.linspace(0, 1, 8)
    bounds = {
        orders: interpolated(sampled(times, orders), None, EXACT).bounds
        for orders in range(3)
    }
    assert [bool((bound == UNDEFINED).all()) for bound in bounds[0]] == [
        False,
        False,
        True,
        True,
    ]
    assert [bool((bound == UNDEFINED).all()) for bound in bounds[1]] == [
        False,
        False,
        False,
        True,
    ]
    assert not any(bound.any() for bound in bounds[2])


def test_held_positions_lie_within_the_family_of_hold() -> None:
    times = np.linspace(0, 1, 8)
    trajectory = sampled(times, 0)
    family = interpolated(trajectory, "hold", EXACT)
    t = np.linspace(0, 0.999, 500)
    held = trajectory.q[np.searchsorted(times, t, "right") - 1].T
    assert (
        np.abs(family.evaluate(t, jerk=False).q - held)
        <= family.bounds_at(t)[0] + 1e-12
    ).all()


@pytest.mark.parametrize("orders", [0, 1, 2])
def test_noise_moves_the_curve_within_the_bounds(orders: int) -> None:
    times, random = irregular(12), np.random.default_rng(orders)
    noise, exact = np.array([1e-3, 1e-2, 0.1]), sampled(times, orders)
    family = interpolated(exact, None, noise)
    s = np.linspace(0, 1, 997)[:-1]
    nominal, bounds, largest = family.evaluate(s, jerk=False), family.bounds_at(s), 0.0
    for _ in range(30):
        values = [
            smooth(times, k) + noise[k] * random.choice([-1.0, 1.0], (12, 2))
            for k in range(orders + 1)
        ]
        other = interpolated(Trajectory(times, *values), None, EXACT).evaluate(
            s, jerk=False
        )
        for name, bound in zip(ORDERS[:3], bounds[:3], strict=True):
            difference = np.abs(getattr(other, name) - getattr(nominal, name))
            assert (difference <= bound * (1 + 1e-9) + 1e-12).all(), name
        largest = max(largest, float((np.abs(other.q - nominal.q) / bounds[0]).max()))
    assert largest > 0.5, "the bounds are tight"


@pytest.mark.parametrize("orders", [0, 1, 2])
@pytest.mark.parametrize("count", [4, 5, 20, 100])
@pytest.mark.parametrize("noise", [0.0, 1e-3])
def test_a_curve_under_the_bound_of_the_jerk_is_in_the_family(
    orders: int, count: int, noise: float
) -> None:
    times, random = irregular(count, seed=count), np.random.default_rng(count)
    values = [
        smooth(times, order) + noise * random.uniform(-1, 1, (count, 2))
        for order in range(orders + 1)
    ]
    family = bounded_jerk(Trajectory(times, *values), JERK, np.full(3, noise))
    assert family is not None
    s = np.sort(random.uniform(0, 1, 2000))
    states, bounds = family.evaluate(s, jerk=True), family.bounds_at(s)
    for order, name in enumerate(ORDERS):
        difference = np.abs(getattr(states, name) - smooth(s * times[-1], order).T)
        assert (difference <= bounds[order] + 1e-9).all(), name


@pytest.mark.parametrize("orders", [0, 1])
def test_curves_whose_jerks_switch_between_the_bounds_are_in_the_family(
    orders: int,
) -> None:
    h, jerk = 0.1, 50.0
    t = np.linspace(0, 1.1, 4000)
    random = np.random.default_rng(0)
    for _ in range(50):
        signs = random.choice([-1.0, 1.0], 40) * jerk
        edges = np.linspace(0, 1.1, len(signs) + 1)
        acceleration = np.concatenate([[0.0], np.cumsum(signs * np.diff(edges))])
        velocity = np.concatenate(
            [
                [0.0],
                np.cumsum(
                    acceleration[:-1] * np.diff(edges) + signs * np.diff(edges) ** 2 / 2
                ),
            ]
        )
        curve = scipy.interpolate.CubicHermiteSpline(
            edges, _positions(edges, acceleration, velocity, signs), velocity
        )
        times = np.arange(12) * h
        values = [curve(times, order)[:, None] for order in range(orders + 1)]
        family = bounded_jerk(Trajectory(times, *values), np.array([jerk]), EXACT)
        assert family is not None
        states, bounds = (
            family.evaluate(t / t[-1], jerk=False),
            family.bounds_at(t / t[-1]),
        )
        for order, name in enumerate(ORDERS[:3]):
            assert (
                np.abs(getattr(states, name)[0] - curve(t, order))
                <= bounds[order][0] + 1e-7
            ).all(), name


def _positions(
    edges: np.ndarray, acceleration: np.ndarray, velocity: np.ndarray, jerk: np.ndarray
) -> np.ndarray:
    h = np.diff(edges)
    steps = velocity[:-1] * h + acceleration[:-1] * h**2 / 2 + jerk * h**3 / 6
    return np.concatenate([[0.0], np.cumsum(steps)])


@pytest.mark.parametrize("orders", [0, 1, 2])
def test_samples_that_contradict_the_bound_of_the_jerk_have_no_family(
    orders: int,
) -> None:
    trajectory = sampled(np.linspace(0, 1, 60), orders)
    assert bounded_jerk(trajectory, JERK, EXACT) is not None
    assert bounded_jerk(trajectory, JERK / 3, EXACT) is None
    assert bounded_jerk(trajectory, JERK / 3, np.array([0.1, 3.0, 30.0])) is not None, (
        "within the noise"
    )


def test_bounds_shrink_with_the_distance_of_samples() -> None:
    sizes = []
    for count in (30, 60):
        family = bounded_jerk(sampled(np.linspace(0, 1, count + 1), 0), JERK, EXACT)
        assert family is not None
        sizes.append([float(bound[:, 0].max()) for bound in family.bounds[:3]])
    ratios = np.array(sizes[0]) / np.array(sizes[1])
    assert np.allclose(ratios, [8, 4, 2], rtol=0.05)


def test_with_noise_of_positions_distant_samples_are_used() -> None:
    times = np.linspace(0, 1, 2001)
    family = bounded_jerk(sampled(times, 0), JERK, np.full(3, 1e-3))
    assert family is not None
    assert len(family.t) < 100
    assert float(family.bounds[1].max()) < 1.0, "not 2 noise / h = 4 rad/s"


@pytest.mark.parametrize(
    ("orders", "kind"), [(0, "cubic"), (0, "quintic"), (1, "quintic")]
)
def test_an_interpolation_without_its_derivatives_is_refused(
    orders: int, kind: str
) -> None:
    with is_refused(UsageError, argument="interpolation"):
        interpolated(sampled(np.linspace(0, 1, 5), orders), kind, EXACT)  # type: ignore[arg-type]


def test_two_positions_say_nothing_under_a_bound_of_the_jerk() -> None:
    with is_refused(UsageError, argument="max_jerk"):
        bounded_jerk(sampled(np.array([0.0, 1.0]), 0), JERK, EXACT)


def test_both_sides_of_a_knot_are_evaluated() -> None:
    family = CurveFamily(
        np.array([0.0, 1.0, 2.0]),
        np.array([[[0.0], [1.0]], [[1.0], [-1.0]]]),
        (np.zeros((2, 1)),) * 4,
    )
    velocities = family.evaluate(np.array([np.nextafter(0.5, 0), 0.5]), jerk=False).dq
    assert velocities.tolist() == [[1.0, -2.0]]
