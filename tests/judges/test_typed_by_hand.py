"""Rows compared with literal values of the data sheet and the paper, to detect wrong limits, frames or obstacles.

Other tests recompute rows from the problem files. This one uses only the rows and the reader of the package.
"""

from collections.abc import Callable
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest
import scipy

from tests.conftest import columns_of

Array = np.ndarray
Columns = dict[str, Array]

HALF_PI = np.pi / 2
JOINTS = [  # origin in the previous joint's frame [m], roll, pitch, yaw [rad]; every axis is z
    ((0, 0, 0.1575), (0, 0, 0)),
    ((0, 0, 0.2025), (HALF_PI, 0, np.pi)),
    ((0, 0.2045, 0), (HALF_PI, 0, np.pi)),
    ((0, 0, 0.2155), (HALF_PI, 0, 0)),
    ((0, 0.1845, 0), (-HALF_PI, np.pi, 0)),
    ((0, 0, 0.2155), (HALF_PI, 0, 0)),
    ((0, 0.081, 0), (-HALF_PI, np.pi, 0)),
]
POSITION = np.deg2rad([170, 120, 170, 120, 170, 120, 175])
VELOCITY = 0.8 * np.deg2rad([85, 85, 100, 75, 130, 135, 135])
ACCELERATION = np.minimum(10 * VELOCITY, 20.0)


def placements(q: Array) -> list[tuple[Array, Array]]:
    """Compute rotations (N, 3, 3) and origins (N, 3) of the seven joint frames, for q of shape (N, 6 or 7)."""
    rotation, origin, frames = np.eye(3), np.zeros(3), []
    for (offset, angles), turn in zip(
        JOINTS, np.hstack([q, np.zeros((len(q), 7 - q.shape[1]))]).T, strict=True
    ):
        origin = origin + rotation @ np.array(offset, float)
        fixed, moved = (
            scipy.spatial.transform.Rotation.from_euler("xyz", angles),
            scipy.spatial.transform.Rotation.from_euler("z", turn[:, None]),
        )
        rotation = rotation @ fixed.as_matrix() @ moved.as_matrix()
        frames.append((rotation, origin))
    return frames


def tip(q: Array, length: float) -> Array:
    """Compute a point on the flange's axis [m], shape (N, 3)."""
    rotation, origin = placements(q)[-1]
    return origin + rotation @ np.array([0.0, 0.0, length])


@pytest.fixture(scope="module", params=["airhockey-hit", "airhockey-replan"])
def hits(request: pytest.FixtureRequest, tiny: Callable[[str], Path]) -> Columns:
    return columns_of(tiny(request.param))


@pytest.fixture(scope="module")
def carries(tiny: Callable[[str], Path]) -> Columns:
    return columns_of(tiny("heavy-object"))


def test_hits_are_within_the_planning_limits_of_the_data_sheet(hits):
    for end in ("start", "goal"):
        assert np.all(np.abs(hits[f"{end}_q"]) <= POSITION[:6] * (1 + 1e-12))
        assert np.all(np.abs(hits[f"{end}_dq"]) <= VELOCITY[:6] * (1 + 1e-12))
    assert np.all(np.abs(hits["start_ddq"]) <= ACCELERATION[:6] * (1 + 1e-12))
    assert (
        np.abs(hits["goal_dq"] / VELOCITY[:6]).max() > 0.999999
    )  # and no lower limit was used for them


def test_the_mallet_is_on_the_table_at_the_stored_position(hits):
    for end in ("start", "goal"):
        position = tip(hits[f"{end}_q"], 0.07 + 0.515)
        assert np.abs(position - hits[f"{end}_xyz"]).max() < 1e-8
        assert np.all((position[:, 0] > 0.6 - 1e-8) & (position[:, 0] < 2.0 + 1e-8))
        assert np.all(np.abs(position[:, 1]) < 0.45 + 1e-8)
        assert np.abs(position[:, 2] - 0.16).max() < (
            0.005 + 1e-8 if end == "start" else 1e-8
        )


def test_the_mallet_moves_along_the_hit_and_not_up_or_down(hits):
    step, angle = 1e-6, hits["hit_angle"]
    velocity = [
        tip(hits["goal_q"] + sign * step * hits["goal_dq"], 0.585) for sign in (1, -1)
    ]
    velocity = (velocity[0] - velocity[1]) / (2 * step)
    expected = hits["hit_speed"][:, None] * np.stack(
        [np.cos(angle), np.sin(angle), 0 * angle], axis=1
    )
    assert np.abs(velocity - expected).max() < 1e-8
    assert hits["hit_speed"].max() > 1.0


def test_the_object_is_upright_between_literal_positions(carries):
    assert np.all(np.abs(carries["start_q"]) <= POSITION * (1 + 1e-12))
    assert np.all(np.abs(carries["goal_q"]) <= POSITION * (1 + 1e-12))
    for end, (low, high) in (("start", (-0.6, -0.3)), ("goal", (0.3, 0.6))):
        rotation, _ = placements(carries[f"{end}_q"])[-1]
        center = tip(carries[f"{end}_q"], 0.07 + 0.1)
        up = (
            rotation
            @ scipy.spatial.transform.Rotation.from_euler("x", -HALF_PI).as_matrix()
        )[:, :, 2]
        assert np.abs(center - carries[f"{end}_xyz"]).max() < 1e-8
        assert np.abs(up - [0, 0, 1]).max() < 1e-8
        assert np.all(
            (center[:, 0] >= 0.2)
            & (center[:, 0] <= 0.6)
            & (center[:, 1] >= low)
            & (center[:, 1] <= high)
        )


def test_the_arm_keeps_clear_of_the_literal_pedestals(carries):
    """Each pedestal is 0.15 m below the object's center at its end; the arm's segments keep 0.14 m of distance."""
    nearest = np.inf
    for q in (carries["start_q"], carries["goal_q"]):
        origins = [origin for _, origin in placements(q)]
        line = [
            np.broadcast_to(origins[1], (len(q), 3)),
            origins[3],
            origins[5],
            tip(q, 0.17),
        ]  # shoulder to object
        points = np.array(
            [
                a + share * (b - a)
                for a, b in pairwise(line)
                for share in np.linspace(0, 1, 51)
            ]
        )
        for end, (low, high) in (("start", (-0.6, -0.3)), ("goal", (0.3, 0.6))):
            top = carries[f"{end}_xyz"][:, 2] - 0.15
            offsets = [
                points[..., 0] - np.clip(points[..., 0], 0.2, 0.6),
                points[..., 1] - np.clip(points[..., 1], low, high),
                np.maximum(points[..., 2] - top, 0.0),
            ]
            nearest = min(nearest, np.sqrt(np.sum(np.square(offsets), axis=0)).min())
    assert 0.14 - 1e-8 < nearest < 0.15  # and no larger distance was used
