"""Symbolic distances of obstacles of every kind: lower bounds of Coal's distances, with correct derivatives."""

import casadi as ca
import coal
import numpy as np
import pytest
import scipy

from cnpgen.kernels.symbolic.linalg import symbols
from cnpgen.kernels.symbolic.obstacle_distances import SOLIDS
from cnpgen.robots.obstacle import Obstacle
from cnpgen.robots.shape.hull import supporting_planes
from cnpgen.robots.shape.inline import corners_of
from cnpgen.robots.solid import place_obstacles
from tests.conftest import some
from tests.examples.obstacles import (
    KINDS,
    ROUNDER,
    coal_distance,
    draw_obstacle,
    segment,
)

SIZE = (0.2, 0.14, 0.3)
DEPTH_OF_A_POINT = (
    "box",
    "turned box",
    "cylinder",
    "mesh",
)  # inside, the depth is that of a point, not of the segment
EXACT = {  # maximum underestimation of the distance of a segment [m]
    "cylinder": 2e-3,
}


def forms(obstacle: Obstacle) -> ca.Function:
    """Build ``(ends, poses) -> separation, smooth_separation, distance``; poses and sizes are inputs."""
    (ends_sx, ends), (numbers_sx, numbers) = (
        symbols("ends", 6),
        symbols("numbers", len(place_obstacles([obstacle]))),
    )
    solid = obstacle.form.symbolic(numbers, SOLIDS)
    first, second = ends[:3], ends[3:]
    values = [
        solid.separation(first, second, lambda value: value),
        solid.smooth_separation(first, second, lambda value: value),
        solid.distance(first, second),
    ]
    return ca.Function("forms", [ends_sx, numbers_sx], values)


@pytest.mark.parametrize("kind", some(KINDS, 1, "slow"))
def test_distances_of_segments_are_lower_bounds(kind: str) -> None:
    random = np.random.default_rng(sum(map(ord, kind)))
    outside = inside = 0
    short = []
    for _ in range(5):
        obstacle = draw_obstacle(kind, random)
        function, numbers = forms(obstacle), place_obstacles([obstacle])
        rounder = ROUNDER * (obstacle.radius or 0.0)
        for _ in range(40):
            first = random.normal(0, 0.2, 3)
            second = first + random.normal(0, 0.2, 3)
            expected = coal_distance(*segment(first, second), obstacle)
            separation, smooth_separation, distance = map(
                float, function(np.r_[first, second], numbers)
            )
            if kind in DEPTH_OF_A_POINT:
                assert separation <= max(expected, 0.0) + 2e-6
            else:
                assert separation <= expected + 2e-6
            assert distance <= max(expected, 0.0) + 2e-6
            assert (smooth_separation > 0) <= (expected > -2e-6)
            if expected > 0:
                short.append(expected - separation - rounder)
                assert kind == "mesh" or smooth_separation == pytest.approx(
                    separation, abs=1e-5
                )
            elif kind != "mesh":
                assert separation > expected - EXACT.get(kind, 2e-6) - rounder
            outside, inside = outside + (expected > 0), inside + (expected <= 0)
    assert outside > 50
    assert inside > 10
    if kind != "mesh":
        assert max(short) < EXACT.get(kind, 2e-6)
    else:
        assert np.median(short) < 0.01


@pytest.mark.parametrize("kind", some(KINDS, 1, "slow"))
def test_distances_of_cuboids_are_lower_bounds(kind: str) -> None:
    """Check upright boxes with upright cuboids."""
    random = np.random.default_rng(sum(map(ord, kind)))
    tilted = kind not in ("upright", "box")
    clear = deep = 0
    for _ in range(5):
        obstacle = draw_obstacle(kind, random)
        numbers_sx, numbers = symbols("numbers", len(place_obstacles([obstacle])))
        (place_sx, place), (turn_sx, turn) = symbols("place", 3), symbols("turn", 9)
        found = obstacle.form.symbolic(numbers, SOLIDS).cuboid_separation(
            place, [turn[:3], turn[3:6], turn[6:]], SIZE
        )
        function = ca.Function("cuboid", [place_sx, turn_sx, numbers_sx], [found])
        for _ in range(40):
            position = random.normal(0, 0.25, 3)
            rotation = scipy.spatial.transform.Rotation.from_rotvec(
                random.normal(0, 2, 3) * [tilted, tilted, 1]
            ).as_matrix()
            at = coal.Transform3s(rotation, position)
            expected = coal_distance(coal.Box(*SIZE), at, obstacle)
            value = float(
                function(position, rotation.ravel(), place_obstacles([obstacle]))
            )
            assert value <= expected + 2e-6
            assert value > expected - 0.25
            clear, deep = clear + (value > 0), deep + (expected < 0)
    assert clear > 50
    assert deep > 15


@pytest.mark.parametrize("kind", some(KINDS, 1, "slow"))
def test_derivatives_agree_with_finite_differences(kind: str) -> None:
    random = np.random.default_rng(2)
    right = total = 0
    for _ in range(4):
        obstacle = draw_obstacle(kind, random)
        function, numbers = forms(obstacle), place_obstacles([obstacle])
        ends = ca.SX.sym("ends", 6)
        separation, smooth_separation, _ = function(ends, numbers)
        gradient = ca.Function(
            "gradient",
            [ends],
            [ca.jacobian(separation, ends), ca.jacobian(smooth_separation, ends)],
        )
        for _ in range(10):
            x = random.normal(0, 0.3, 6)
            for index, found in enumerate(gradient(x)):
                steps = 1e-6 * np.eye(6)
                expected = [
                    (
                        float(function(x + step, numbers)[index])
                        - float(function(x - step, numbers)[index])
                    )
                    / 2e-6
                    for step in steps
                ]
                right += np.allclose(
                    np.array(found)[0],
                    expected,
                    atol=2e-3 if kind == "cylinder" else 1e-4,
                )
                total += 1
    assert right > 0.9 * total  # except at kinks


def test_an_upright_object_on_a_round_pedestal_has_distance_zero() -> None:
    stand = Obstacle(
        name="stand", kind="cylinder", radius=0.3, length=0.5, position=(0.5, 0.0, 0.25)
    )
    numbers = place_obstacles([stand])
    form, upright = (
        stand.form.symbolic(list(numbers), SOLIDS),
        [[1.0, 0, 0], [0, 1.0, 0], [0, 0, 1.0]],
    )
    for gap in (-1e-3, 0.0, 0.02):
        found = form.cuboid_separation(
            [0.45, 0.02, 0.5 + SIZE[2] / 2 + gap], upright, SIZE
        )
        assert float(ca.SX(found)) == pytest.approx(gap, abs=1e-9)


def test_a_hull_is_behind_its_supporting_planes() -> None:
    random = np.random.default_rng(5)
    for _ in range(20):
        corners = corners_of(draw_obstacle("mesh", random).mesh)
        planes = supporting_planes(corners)
        assert len(planes) <= 24
        np.testing.assert_allclose(np.linalg.norm(planes[:, :3], axis=1), 1)
        distances = planes[:, :3] @ corners.T - planes[:, 3:]
        assert distances.max() <= 1e-15
        np.testing.assert_allclose(distances.max(axis=1), 0, atol=1e-12)
    cube = np.array([[x, y, z] for x in (0, 1) for y in (0, 1) for z in (0, 1)], float)
    assert supporting_planes(cube).shape == (
        0,
        4,
    )  # its bounding box has the same faces
