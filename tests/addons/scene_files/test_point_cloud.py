"""Boxes that contain point clouds: coverage, tightness, the limit of their number, and invalid clouds."""

import numpy as np
import pytest

from cnpgen.errors import UsageError
from cnpgen.robots.obstacle import Obstacle
from cnpgen.scenes import obstacles_of_points

RADIUS = 0.005


def covered(points: np.ndarray, boxes: tuple[Obstacle, ...]) -> np.ndarray:
    """Return which points are inside a box with their radius."""
    low = (
        np.array([box.position for box in boxes])
        - np.array([box.size for box in boxes]) / 2
    )
    high = (
        np.array([box.position for box in boxes])
        + np.array([box.size for box in boxes]) / 2
    )
    inside = (points[:, None] - RADIUS >= low - 1e-12) & (
        points[:, None] + RADIUS <= high + 1e-12
    )
    return inside.all(axis=2).any(axis=1)


def cloud() -> np.ndarray:
    """Return points of a table and of a box on it."""
    random = np.random.default_rng(1)
    table = random.uniform([0.3, -0.6, 0.2], [0.9, 0.6, 0.2], (8000, 3))
    sides = random.uniform([0.5, -0.1, 0.2], [0.6, 0.1, 0.5], (2000, 3))
    sides[:1000, 0], sides[1000:, 1] = 0.5, 0.1
    return np.concatenate([table, sides])


def test_all_points_are_in_boxes_that_hardly_exceed_them() -> None:
    points = cloud()
    boxes = obstacles_of_points(points, radius=RADIUS, resolution=0.05)
    assert covered(points, boxes).all()
    assert len({box.name for box in boxes}) == len(boxes) <= 100
    low = (
        np.array([box.position for box in boxes])
        - np.array([box.size for box in boxes]) / 2
    )
    high = low + np.array([box.size for box in boxes])
    samples = np.random.default_rng(2).uniform(
        low.min(axis=0), high.max(axis=0), (4000, 3)
    )
    inside = (
        ((samples[:, None] >= low) & (samples[:, None] <= high)).all(axis=2).any(axis=1)
    )
    distance = np.linalg.norm(samples[inside][:, None] - points[::3], axis=2).min(
        axis=1
    )
    assert distance.max() < 0.05 * 3**0.5 + 3**0.5 * RADIUS
    assert not inside.all()


def test_the_number_of_boxes_is_bounded() -> None:
    points = np.random.default_rng(3).uniform(0.3, 0.8, (3000, 3))
    for most in (1, 20):
        boxes = obstacles_of_points(points, radius=RADIUS, max_obstacles=most)
        assert len(boxes) <= most
        assert covered(points, boxes).all()
    (alone,) = obstacles_of_points([[0.5, 0.1, 0.2]], radius=RADIUS)
    assert alone.size == pytest.approx((0.01, 0.01, 0.01))


@pytest.mark.parametrize(
    ("points", "options", "message"),
    [
        ([[0.0, 0.0]], {}, r"points must have shape \(N, 3\)"),
        (
            [[0.0, np.nan, 0.0]],
            {},
            "must be finite and at most 100 m, got .* in point 0",
        ),
        (
            [[600.0, 0.0, 0.0]],
            {},
            "at most 100 m, got .* in point 0; did you mean 600 mm = 0.6 m",
        ),
        (
            [[1.0, 0.0, 0.0]],
            {"radius": -1.0},
            "radius must be from 1e-06 to 1 m, got -1 m",
        ),
        (
            [[1.0, 0.0, 0.0]],
            {"resolution": 0.0},
            "resolution must be from 0.01 to 1 m, got 0 m",
        ),
    ],
)
def test_invalid_clouds_are_refused(
    points: list[list[float]], options: dict[str, float], message: str
) -> None:
    with pytest.raises(UsageError, match=message):
        obstacles_of_points(points, **{"radius": RADIUS, **options})
