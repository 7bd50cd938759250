"""A published grasp is free of collisions for the open gripper of the problem panda.

It is the first problem of the demo set of robometrics (github.com/fishbotics/robometrics, commit 0b928046), a bookshelf
of MotionBenchMaker.
"""

import numpy as np
import pytest

import cnpgen
from cnpgen.problems.load_robot import load_robot
from cnpgen.robots.solid import place_obstacles
from cnpgen.scenes import load_scenes, solve_scenes
from tests.conftest import needs_compiled_code
from tests.examples.coal_hulls import CoalHulls
from tests.examples.example_robots import needs_robots

pytestmark = needs_robots

TURN = "0.8521017127688338, 0, 0, -0.5233762232815127"
SCENE = f"""\
bookshelf_small_panda:
- start: [0.0, -0.785, 0.0, -2.356, 0.0, 1.571, 0.785]
  goal_ik:
  - [-0.358064085, 0.280899316, -1.074000955, -2.200332403, 2.744006634, 2.244808912, 1.304998040]
  obstacles:
    cuboid:
      board: {{dims: [1.2, 1.0, 0.04], pose: [0.589608886, -1.012333107, 0.217986699, {TURN}]}}
      roof: {{dims: [1.2, 1.0, 0.04], pose: [0.589608886, -1.012333107, 0.517986699, {TURN}]}}
      left: {{dims: [1.2, 0.04, 0.34], pose: [0.143639110, -1.238410436, 0.367986699, {TURN}]}}
      right: {{dims: [1.2, 0.04, 0.34], pose: [1.035578663, -0.786255778, 0.367986699, {TURN}]}}
      stand: {{dims: [0.3, 0.25, 0.8], pose: [-0.05, 0.0, -0.4, 1.0, 0.0, 0.0, 0.0]}}
    cylinder:
      grasped: {{height: 0.14, radius: 0.01, pose: [0.156095227, -0.671519899, 0.297986699, {TURN}]}}
"""


def penetration(name: str, scene: cnpgen.scenes.SceneProblem) -> float:
    """Return the largest penetration of the links at the goal by Coal [m]."""
    problem = cnpgen.load_problem(name).with_obstacles(scene.obstacles)
    return CoalHulls(problem, load_robot(problem)).violation(
        scene.goal_q.T.copy(), place_obstacles(scene.obstacles)
    )


@pytest.mark.slow
@needs_compiled_code
def test_the_open_gripper_reaches_a_published_grasp(tmp_path):
    path = tmp_path / "scenes.yaml"
    path.write_text(SCENE)
    (scene,) = load_scenes(path)
    assert np.isclose(scene.goal_q[0, 0], -0.358064085)
    assert penetration("panda", scene) == 0
    assert (
        penetration("panda-3kg", scene) > 0.004
    )  # the closed gripper is inside of the cylinder
    solved = solve_scenes("panda", [scene])
    assert all(result.valid for result in solved.results)
