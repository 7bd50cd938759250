"""The suite clutter and RRT-Connect among obstacles."""

from collections import Counter
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

import cnpgen
from cnpgen.addons.benchmark.benchmark_planner import load_planner
from cnpgen.addons.benchmark.planners.rrtconnect import has_manifold
from cnpgen.addons.families.scene_generator import shipped_families
from cnpgen.addons.trajectories.sampled_trajectory import Trajectory
from cnpgen.benchmark import Setting, load_suite
from cnpgen.errors import RecipeError
from cnpgen.pipelines.resting_states import RestingStates
from cnpgen.problems.load_robot import load_robot
from cnpgen.scenes import SceneProblem, load_scenes, save_scenes
from cnpgen.schema.catalogue import list_recipes
from tests.examples.example_robots import needs_robots
from tests.examples.shaped_robot import SELF, write_problem
from tests.make.test_solve_scenes import LIMITS, SCENES
from tests.refusals import is_refused

CLUTTER = list_recipes("suite")["clutter"].with_suffix(".h5")
SUITE = """name = "posts"
version = "1.0.0"
[scenes]
file = "posts.h5"
robot = "problem.toml"
"""


@pytest.fixture
def posts(tmp_path: Path) -> Path:
    """Return a suite of the crane's scenes."""
    write_problem(tmp_path, obstacles="", more=SELF + LIMITS)
    save_scenes(tmp_path / "posts.h5", SCENES[:2])
    (tmp_path / "posts.toml").write_text(SUITE)
    return tmp_path / "posts.toml"


def test_the_suite_has_two_hundred_problems_of_every_family() -> None:
    scenes = load_scenes(CLUTTER)
    families = Counter(scene.name.rsplit(" ", 2)[0] for scene in scenes)
    assert len(scenes) == 200
    assert set(families) == set(shipped_families())
    assert set(families.values()) == {16, 17}
    assert (
        len({scene.name.rsplit(" ", 1)[0] for scene in scenes}) == 200
    )  # every problem has a scene of its own


@needs_robots
@pytest.mark.slow
def test_few_problems_of_a_family_have_a_clear_straight_line() -> None:
    problem = cnpgen.load_problem("panda-3kg")
    robot, straight = load_robot(problem), Counter[str]()
    for scene in load_scenes(CLUTTER):
        states = RestingStates(problem, robot, scene.obstacles)
        ends = np.stack([scene.start_q, scene.goal_q[0]], axis=1)
        assert states.are_ends(ends).all(), scene.name
        straight[scene.name.rsplit(" ", 2)[0]] += states.is_line_clear(
            scene.start_q, scene.goal_q[0]
        )
    assert max(straight.values()) <= 0.2 * 16


def test_suites_of_scene_files_are_boundary_problems(posts: Path) -> None:
    suite = load_suite(posts)
    problems, prefix = suite.problems()
    assert prefix is None
    assert len(problems) == 2
    assert len(suite.problems(1)[0]) == 1
    assert (
        suite.problems(1)[0].problem == problems.problem
    )  # one set of kernels for any number
    assert problems.boundary.goal_q == pytest.approx(
        np.concatenate([scene.goal_q for scene in SCENES[:2]])
    )
    posts.write_text(SUITE + '[samples]\nrecipe = "heavy-object"\n')
    with is_refused(RecipeError):
        load_suite(posts)


def test_manifolds_are_detected(posts: Path) -> None:
    crane = cnpgen.load_problem(posts.parent / "problem.toml")
    assert not has_manifold(crane, load_robot(crane))
    for name in ("airhockey", "heavy-object"):
        problem = cnpgen.load_problem(name)
        assert has_manifold(problem, load_robot(problem))


def test_rrtconnect_avoids_obstacles(posts: Path) -> None:
    pytest.importorskip("ompl")
    pytest.importorskip("toppra")
    problems, _ = load_suite(posts).problems()
    plan = load_planner("rrtconnect", {"simplify_time": 0.3}).prepare(
        Setting(problems.problem, time_limit=20.0)
    )
    model = cnpgen.RobotModel(problems.problem)
    for index in range(2):
        answer = plan(problems[index])
        assert isinstance(answer, Trajectory)
        assert answer.q[0] == pytest.approx(problems.boundary.start_q[index], abs=1e-6)
        assert answer.q[-1] == pytest.approx(problems.boundary.goal_q[index], abs=1e-6)
        assert (
            model.min_distance(answer.q, scene=problems.scene[index]).min() > -0.01
        )  # splines cut corners
        line = np.linspace(
            problems.boundary.start_q[index], problems.boundary.goal_q[index], 100
        )
        assert model.min_distance(line, scene=problems.scene[index]).min() < -0.01


def test_scenes_of_a_suite_must_be_solvable_by_its_robot(posts: Path) -> None:
    scene: SceneProblem = replace(
        SCENES[0], start_q=np.zeros(7), goal_q=np.zeros((1, 7))
    )
    save_scenes(posts.parent / "posts.h5", [scene])
    with is_refused(cnpgen.CnpgenError):
        load_suite(posts).problems()
