"""Obstacles that a caller builds with sizes or poses of no body are refused with scene and obstacle."""

import math

import numpy as np
import pytest

import cnpgen
from cnpgen.addons.scene_files.scene_files import save_scenes
from cnpgen.errors import UsageError
from cnpgen.problems.scenes.observe import observe
from cnpgen.problems.scenes.scene_problem import GoalPose, SceneError, SceneProblem
from cnpgen.recipes import Obstacle
from tests.examples.shaped_robot import write_problem
from tests.refusals import is_refused

PLACE = {"name": "block", "position": (0.5, 0.0, 0.3)}
INVALID = {
    r"size must be at least 1e-06 m, got \(-0.1, 0.1, 0.1\)": Obstacle(
        **PLACE, size=(-0.1, 0.1, 0.1)
    ),
    r"size must be at least 1e-06 m, got \(0.0, 0.1, 0.1\)": Obstacle(
        **PLACE, size=(0.0, 0.1, 0.1)
    ),
    r"size must be finite, got \(inf, 0.1": Obstacle(
        **PLACE, size=(math.inf, 0.1, 0.1)
    ),
    "radius must be at least 1e-06 m, got 0.0": Obstacle(
        **PLACE, kind="sphere", radius=0.0
    ),
    "length must be at least 1e-06 m, got -0.2": Obstacle(
        **PLACE, kind="cylinder", radius=0.1, length=-0.2
    ),
    r"position must be finite, got \(nan": Obstacle(
        name="block", position=(math.nan, 0.0, 0.3), size=(0.1, 0.1, 0.1)
    ),
    "rotation must be finite, got": Obstacle(
        **PLACE, size=(0.1, 0.1, 0.1), rotation=(0.0, math.nan, 0.0)
    ),
}

SIZE = (0.1, 0.1, 0.1)
INVALID |= {
    "kind must be one of box, sphere, cylinder, capsule, mesh, convex, got 'cone'": Obstacle(
        **PLACE, kind="cone"
    ),
    "is a box and needs 'position' and 'size'": Obstacle(**PLACE),
    "is a sphere and needs 'position' and 'radius'": Obstacle(**PLACE, kind="sphere"),
    "is a cylinder and needs": Obstacle(**PLACE, kind="cylinder", radius=0.1),
    "radius a box has no such key, expected": Obstacle(**PLACE, size=SIZE, radius=0.1),
    "rotation must be at most 6.283 rad, got .*; 90 rad is 5157 deg; did you mean 90 deg = 1.57 rad": Obstacle(
        **PLACE, size=SIZE, rotation=(90.0, 0.0, 0.0)
    ),
    r"position must be at most 100 m, got \(600, 0, 100\); did you mean 600 mm = 0.6 m": Obstacle(
        name="block", position=(600, 0, 100), size=SIZE
    ),
    r"x must be a Range, got \(0.5, 0.7\)": Obstacle(
        name="block", x=(0.5, 0.7), y=(-0.1, 0.1), top=0.1
    ),
}


@pytest.fixture(scope="module")
def problem(tmp_path_factory):
    return cnpgen.load_problem(write_problem(tmp_path_factory.mktemp("crane")))


@pytest.mark.parametrize(("text", "obstacle"), INVALID.items(), ids=list(INVALID))
def test_invalid_obstacles_are_refused_wherever_scenes_enter(
    problem, tmp_path, text, obstacle
):
    scene = SceneProblem("shelf 7", (obstacle,), np.zeros(4), np.full((1, 4), 0.1))
    for call in (
        lambda: cnpgen.scenes.solve_scenes(problem, [scene]),
        lambda: cnpgen.scenes.scene_plans(problem, [scene]),
        lambda: save_scenes(tmp_path / "scenes.h5", [scene]),
    ):
        with is_refused(SceneError):
            call()
    with is_refused(UsageError, argument="scenes"):
        observe([scene], "cloud")
    with is_refused(UsageError, argument="obstacles"):
        problem.with_obstacles([obstacle])
    assert not (tmp_path / "scenes.h5").exists()


@pytest.mark.parametrize(
    ("scene", "text"),
    [
        ({"goal_q": np.zeros(4)}, r"goal_q must have shape \(G, n\), got \(4,\)"),
        (
            {"start_q": np.zeros((1, 4))},
            r"start_q must have shape \(n,\), got \(1, 4\)",
        ),
        (
            {"goal_pose": GoalPose("", np.ones(3), 2 * np.eye(3))},
            "the rotation of the goal pose is no rotation matrix",
        ),
        (
            {"goal_pose": GoalPose("", np.ones(3), np.ones(4))},
            r"a goal pose has .* got \(3,\), \(4,\), \(\), \(\)",
        ),
        (
            {"goal_pose": GoalPose("", np.ones(3), np.eye(3), np.ones(2))},
            r"a goal pose has .* got \(3,\), \(3, 3\), \(2,\)",
        ),
        (
            {"goal_pose": GoalPose("", np.ones(3), -np.eye(3))},
            "the rotation of the goal pose is no rotation matrix",
        ),
        (
            {"goal_pose": GoalPose("", np.ones(3), np.eye(3), 0.0, 180.0)},
            "tolerances of the goal pose are in m and rad",
        ),
    ],
)
def test_invalid_ends_are_refused(problem, scene, text):
    ends = {"start_q": np.zeros(4), "goal_q": np.full((1, 4), 0.1)} | scene
    with pytest.raises(SceneError, match=f"scene 'shelf 7': {text}"):
        cnpgen.scenes.solve_scenes(problem, [SceneProblem("shelf 7", (), **ends)])
