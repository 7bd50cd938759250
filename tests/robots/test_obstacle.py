"""Obstacles of every kind in a problem file: what is read, what is refused, and what travels with the problem."""

import base64
import shutil
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import scipy

from cnpgen.errors import RecipeError
from cnpgen.problems.obstacles import scene_of
from cnpgen.problems.problem_file import load_problem
from cnpgen.problems.problem_record import as_problem, record_problem
from cnpgen.robots.obstacle import Obstacle
from cnpgen.robots.shape.inline import corners_of
from cnpgen.robots.solid import place_obstacles, pose_width, solids_of
from tests.examples.shaped_robot import KINDS, WEDGE, write_problem
from tests.refusals import is_refused

HERE = (0.1, 0.2, 0.3)


def errors(**keys: Any) -> dict[str, str]:
    return dict(Obstacle(name="it", **keys).validate())


@pytest.mark.parametrize(
    "keys",
    [
        {"position": HERE, "size": (1.0, 1.0, 1.0)},
        {
            "position": HERE,
            "size": (1.0, 1.0, 1.0),
            "rotation": (0.1, 0.0, 0.0),
            "below": "goal",
        },
        {"kind": "sphere", "position": HERE, "radius": 0.1},
        {
            "kind": "cylinder",
            "position": HERE,
            "radius": 0.1,
            "length": 1.0,
            "rotation": (0.1, 0.0, 0.0),
        },
        {"kind": "capsule", "position": HERE, "radius": 0.1, "length": 1.0},
        {"kind": "mesh", "position": HERE, "mesh": "it.stl", "scale": (1.0, -1.0, 1.0)},
    ],
)
def test_what_has_all_that_its_kind_needs_is_an_obstacle(keys: dict[str, Any]) -> None:
    assert not errors(**keys)
    for key in set(keys) - {"kind", "rotation", "scale", "below"}:
        without = {name: value for name, value in keys.items() if name != key}
        assert "needs 'position'" in errors(**without)[key]


@pytest.mark.parametrize(
    ("keys", "key", "says"),
    [
        (
            {"kind": "sphere", "position": HERE, "radius": 0.1, "length": 0.2},
            "length",
            "a sphere has no such key",
        ),
        (
            {
                "kind": "sphere",
                "position": HERE,
                "radius": 0.1,
                "rotation": (1.0, 0, 0),
            },
            "rotation",
            "a sphere has no",
        ),
        (
            {"kind": "mesh", "position": HERE, "mesh": "a", "scale": (1.0, 0.0, 1.0)},
            "scale",
            "must not be 0",
        ),
        (
            {"position": HERE, "size": (1.0, 1.0, 1.0), "top": 0.3},
            "top",
            "a box has no such key",
        ),
        (
            {"top": 0.3},
            "position",
            "a box and needs 'position' and 'size', or 'x', 'y', 'top' and 'height' in their",
        ),
        (
            {
                "kind": "mesh",
                "position": HERE,
                "mesh": "data:application/octet-stream;base64,AAAA",
            },
            "mesh",
            "buffer",
        ),
    ],
)
def test_what_does_not_go_with_a_kind_is_refused(
    keys: dict[str, Any], key: str, says: str
) -> None:
    assert says in errors(**keys)[key]


def test_an_upright_box_has_no_pose(tmp_path: Path) -> None:
    table = "\n".join(
        [
            '[[obstacle]]\nname = "it"',
            "x = [0, 1]",
            "y = [0, 1]",
            "top = 0.1",
            "rotation = [0, 0, 1]",
        ]
    )
    with is_refused(RecipeError):
        load_problem(write_problem(tmp_path, obstacles=table))


def test_kinds_are_where_their_keys_say(tmp_path: Path) -> None:
    problem = load_problem(write_problem(tmp_path, obstacles=KINDS))
    wall, ball, post, pipe, wedge = solids_of(
        problem.obstacle, place_obstacles(problem.obstacle)
    )
    assert pose_width(problem.obstacle) == 15 + 4 + 7 + 7 + 12
    turn = scipy.spatial.transform.Rotation.from_euler(
        "xyz", [0, 0, 20], degrees=True
    ).as_matrix()
    corner = np.array([0.5, 0.0, 0.15]) + turn @ [0.05, 0.25, 0.15]
    assert np.linalg.norm(wall.position + wall.corners - corner, axis=1).min() < 1e-12
    assert (ball.corners.tolist(), ball.radius) == ([[0, 0, 0]], 0.08)
    np.testing.assert_allclose([post.low[2], post.high[2]], [0, 0.6], atol=1e-12)
    assert 0.05 <= (post.high - post.position)[0] < 0.05 * 1.002
    np.testing.assert_allclose([pipe.low[1], pipe.high[1]], [-0.54, 0.54], atol=1e-12)
    turn = scipy.spatial.transform.Rotation.from_euler(
        "xyz", [0, -60, 30], degrees=True
    ).as_matrix()
    expected = 1e-3 * WEDGE @ turn.T + [0.2, 0.55, 0.1]
    for corner in wedge.position + wedge.corners:
        assert np.linalg.norm(expected - corner, axis=1).min() < 1e-8


def test_a_problem_holds_its_meshes(tmp_path: Path) -> None:
    problem = load_problem(write_problem(tmp_path, obstacles=KINDS))
    record = record_problem(problem)
    shutil.rmtree(tmp_path)
    again = as_problem(record)
    assert again.obstacle == problem.obstacle
    assert record_problem(again).comparable_sha256 == record.comparable_sha256
    assert len(corners_of(again.obstacle[-1].mesh)) == len(WEDGE)


def test_a_missing_mesh_is_reported_with_the_searched_paths(tmp_path: Path) -> None:
    file = write_problem(tmp_path, obstacles=KINDS.replace("wedge.stl", "wegde.stl"))
    with is_refused(RecipeError):
        load_problem(file)
    (tmp_path / "crane" / "meshes" / "wegde.stl").write_bytes(b"solid")
    with is_refused(RecipeError):
        load_problem(file)


@pytest.mark.parametrize(
    "content",
    [b"", b"1234", np.array([np.nan, 0, 0]).tobytes(), np.zeros(4).tobytes()],
    ids=range(4),
)
def test_corners_that_are_none_are_refused(content: bytes) -> None:
    address = (
        "data:application/octet-stream;base64," + base64.b64encode(content).decode()
    )
    assert "mesh" in errors(kind="mesh", position=HERE, mesh=address)


def test_poses_hold_the_entries_of_all_obstacles(tmp_path: Path) -> None:
    problem = load_problem(write_problem(tmp_path, obstacles=KINDS))
    upright = load_problem(write_problem(tmp_path)).obstacle
    problem = replace(problem, obstacle=(*upright, *problem.obstacle))
    obstacle_poses = scene_of(problem, np.zeros((4, 3)), np.zeros((4, 3))).poses
    assert obstacle_poses.shape == (4, 2 + 45)
    np.testing.assert_array_equal(obstacle_poses[:, :2], [[0.3, 0.9]] * 4)
    np.testing.assert_array_equal(obstacle_poses[2], place_obstacles(problem.obstacle))
