"""Obstacles that a caller builds with sizes or poses of no body are refused with scene and obstacle."""

import math

import numpy as np
import pytest

import cnpgen
from cnpgen.errors import UsageError
from cnpgen.problems.scenes.observe import observe
from cnpgen.problems.scenes.scene_files import save_scenes
from cnpgen.problems.scenes.scene_problem import SceneError, SceneProblem
from cnpgen.recipes import Obstacle
from tests.examples.shaped_robot import write_problem

PLACE = {"name": "block", "position": (0.5, 0.0, 0.3)}
INVALID = {
    r"size must be at least 1e-06 m, got \(-0.1, 0.1, 0.1\)": Obstacle(**PLACE, size=(-0.1, 0.1, 0.1)),
    r"size must be at least 1e-06 m, got \(0.0, 0.1, 0.1\)": Obstacle(**PLACE, size=(0.0, 0.1, 0.1)),
    r"size must be finite and at most 10000, got \(inf, 0.1": Obstacle(**PLACE, size=(math.inf, 0.1, 0.1)),
    "radius must be at least 1e-06 m, got 0.0": Obstacle(**PLACE, kind="sphere", radius=0.0),
    "length must be at least 1e-06 m, got -0.2": Obstacle(**PLACE, kind="cylinder", radius=0.1, length=-0.2),
    r"position must be finite and at most 10000, got \(nan": Obstacle(
        name="block", position=(math.nan, 0.0, 0.3), size=(0.1, 0.1, 0.1)
    ),
    "rotation must be finite and at most 10000": Obstacle(**PLACE, size=(0.1, 0.1, 0.1), rotation=(0.0, math.nan, 0.0)),
}


@pytest.fixture(scope="module")
def problem(tmp_path_factory):
    return cnpgen.load_problem(write_problem(tmp_path_factory.mktemp("crane")))


@pytest.mark.parametrize(("text", "obstacle"), INVALID.items(), ids=list(INVALID))
def test_invalid_obstacles_are_refused_wherever_scenes_enter(problem, tmp_path, text, obstacle):
    scene = SceneProblem("shelf 7", (obstacle,), np.zeros(4), np.full((1, 4), 0.1))
    for call in (
        lambda: cnpgen.scenes.solve_scenes(problem, [scene]),
        lambda: cnpgen.scenes.scene_plans(problem, [scene]),
        lambda: save_scenes(tmp_path / "scenes.h5", [scene]),
    ):
        with pytest.raises(SceneError, match=rf"scene 'shelf 7': obstacle 'block': {text}"):
            call()
    with pytest.raises(UsageError, match=rf"scene 0: obstacle 'block': {text}"):
        observe([scene], "cloud")
    with pytest.raises(UsageError, match=rf"obstacle 'block': {text}"):
        problem.with_obstacles([obstacle])
    assert not (tmp_path / "scenes.h5").exists()
