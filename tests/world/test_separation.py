"""Lower bounds of distances: comparison with Coal, exact if a face is closest."""

import coal
import numpy as np
import pytest
import scipy

from cnpgen.robots.obstacle_shapes.convex_solid import Box
from cnpgen.robots.shape.hull import coal_hull
from cnpgen.world import certified
from cnpgen.world.path import cuboid_gaps, cuboid_separation, gaps, separation

SIZE = np.array([0.2, 0.2, 0.3])
CORNERS = np.array(
    [[x, y, z] for x in (-0.5, 0.5) for y in (-0.5, 0.5) for z in (-0.5, 0.5)]
)


def box_between(low: np.ndarray, high: np.ndarray) -> Box:
    return Box((low + high) / 2, CORNERS * (high - low), low, high)


def draw(seed: int, count: int = 400) -> tuple[np.ndarray, np.ndarray, Box]:
    """Draw poses of a cuboid and a box: overlapping to distant, upright, slightly tilted or random."""
    random = np.random.default_rng(seed)
    low = random.uniform(-0.3, 0, 3)
    box = box_between(low, low + random.uniform(0.1, 0.6, 3))
    turn = (
        random.normal(0, 1, (count, 3)) * [0.02, 0.02, 2.0]
        if seed % 2
        else random.normal(0, 3, (count, 3))
    )
    rotation = (
        scipy.spatial.transform.Rotation.from_rotvec(turn)
        .as_matrix()
        .transpose(1, 2, 0)
    )
    position = (box.low + box.high)[:, None] / 2 + random.normal(0, 0.4, (3, count))
    return position, rotation, box


def coal_distance(
    shape: object, position: np.ndarray, rotation: np.ndarray, box: Box
) -> tuple[float, np.ndarray]:
    request, result = coal.DistanceRequest(), coal.DistanceResult()
    request.gjk_tolerance, request.epa_tolerance = 1e-12, 1e-9
    block = coal.Box(*(box.high - box.low))
    place = coal.Transform3s(np.eye(3), (box.low + box.high) / 2)
    distance = coal.distance(
        shape, coal.Transform3s(rotation, position), block, place, request, result
    )
    return distance, -np.array(result.normal)


@pytest.mark.parametrize("seed", range(6))
def test_bounds_of_a_cuboid_are_never_above_its_distance(seed: int) -> None:
    position, rotation, box = draw(seed)
    vertices = np.einsum("vj,ijk->vik", CORNERS * SIZE, rotation) + position
    bounds = cuboid_gaps(position, rotation, SIZE, [box])[0]
    random, tight, overlapping = np.random.default_rng(seed), 0, 0
    for k in range(position.shape[1]):
        distance, direction = coal_distance(
            coal.Box(*SIZE), position[:, k], rotation[..., k].copy(), box
        )
        assert bounds[k] <= distance + 1e-9
        anywhere = random.normal(size=3)
        for unit in (direction, anywhere / np.linalg.norm(anywhere)):
            assert separation(vertices, box, unit)[k] <= distance + 1e-9
        assert separation(vertices, box, direction)[k] == pytest.approx(
            distance, abs=1e-8
        )
        same = cuboid_separation(position, rotation, SIZE, box, direction)
        np.testing.assert_allclose(
            same, separation(vertices, box, direction), atol=1e-14
        )
        tight += bool(abs(bounds[k] - distance) < 1e-9)
        overlapping += distance < 0
    assert tight > 20
    assert overlapping > 20


@pytest.mark.parametrize("seed", range(3))
def test_bounds_of_a_segment_are_never_above_its_distance(seed: int) -> None:
    center, rotation, box = draw(seed)
    half = 0.2 * rotation[:, 2]
    ends = np.array([center - half, center + half])
    bounds = np.maximum(gaps(ends.min(axis=0), ends.max(axis=0), [box])[0], 0.0)
    for k in range(center.shape[1]):
        distance, direction = coal_distance(
            coal.Capsule(0.0, 0.4), center[:, k], rotation[..., k].copy(), box
        )
        assert bounds[k] <= max(distance, 0.0) + 1e-9
        assert separation(ends, box, direction)[k] == pytest.approx(distance, abs=1e-8)


def test_gaps_along_several_axes_form_a_distance() -> None:
    low, high = (
        np.array([[0.3, 0.0, 0.2], [0.4, 0.5, 0.2], [0.0, 0.0, 0.2]]),
        np.array([[1.0] * 3, [1.0] * 3, [1.0] * 3]),
    )
    box = box_between(np.array([-1.0, -1.0, -1.0]), np.array([0.0, 0.0, 0.5]))
    np.testing.assert_allclose(
        gaps(low, high, [box])[0], [0.5, 0.5, np.sqrt(0.08)], atol=1e-15
    )


def test_the_bound_of_overlapping_boxes_is_the_smallest_depth() -> None:
    low, high = np.array([[0.0], [0.0], [0.9]]), np.array([[1.0], [1.0], [1.5]])
    assert gaps(low, high, [box_between(np.zeros(3), np.ones(3))])[
        0, 0
    ] == pytest.approx(-0.1)


def test_the_hull_of_a_body_is_built_when_a_distance_is_measured(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    built = list[np.ndarray]()
    monkeypatch.setattr(
        certified,
        "coal_hull",
        lambda corners: built.append(corners) or coal_hull(corners),
    )
    corners = np.random.default_rng(8).uniform(-1, 1, (12, 3))
    body, pose = (
        certified.convex_body(corners, 0.1),
        (np.eye(3), np.array([5.0, 0.0, 0.0])),
    )
    assert built == []
    for _ in range(2):
        distance, _ = certified.CertifiedDistance().between(
            body, (np.eye(3), np.zeros(3)), body, pose
        )
    assert distance > 0
    assert len(built) == 1
