"""Families of scenes: valid layouts, objects without overlap, and collision-free ends by Coal."""

from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pytest

import cnpgen
from cnpgen.addons.families.scene_generator import grasp_rotations, shipped_families
from cnpgen.cli.main import main
from cnpgen.errors import UsageError
from cnpgen.pipelines.resting_states import RestingStates
from cnpgen.pipelines.scene_family import Range
from cnpgen.problems.load_robot import load_robot
from cnpgen.problems.problem import Problem
from cnpgen.robots.observation.primitives import primitives_of
from cnpgen.robots.obstacle import Obstacle
from cnpgen.robots.scene import Scene
from cnpgen.robots.solid import place_obstacles, solids_of
from cnpgen.scenes import (
    Grasp,
    Layout,
    SceneFamily,
    SceneProblem,
    load_family,
    load_scenes,
    make_scenes,
    scene_plans,
)
from cnpgen.world.certified import CertifiedDistance, convex_body
from cnpgen.world.pose_ik import PoseKinematics
from tests.examples.example_robots import needs_robots
from tests.examples.numpy_observations import signed_distances
from tests.examples.scene_arm import write_arm
from tests.refusals import assert_said, is_refused

ENDS_MARGIN = 0.005


@pytest.mark.parametrize("name", shipped_families())
def test_layouts_are_valid_and_depend_on_the_random_numbers_only(name: str) -> None:
    family = load_family(name)
    counts = set()
    for seed in range(40):
        layout = family.draw(np.random.default_rng(seed))
        again = family.draw(np.random.default_rng(seed))
        assert layout.obstacles == again.obstacles
        assert len(layout.grasps) >= 2
        assert all(not list(obstacle.validate()) for obstacle in layout.obstacles)
        assert (
            len({obstacle.name for obstacle in layout.obstacles})
            == len(layout.obstacles)
            <= 40
        )
        assert all(
            np.linalg.norm(grasp.approach) == pytest.approx(1)
            for grasp in layout.grasps
        )
        counts.add(len(layout.obstacles))
    assert min(counts) >= 3


@pytest.mark.parametrize(
    "name", ["tabletop", "table-pick", "bookshelf-tall", "table-under-pick"]
)
def test_objects_neither_overlap_nor_sink(name: str) -> None:
    """Measure the distances of all objects by Coal."""
    distance = CertifiedDistance()
    for seed in range(10):
        obstacles = load_family(name).draw(np.random.default_rng(seed)).obstacles
        solids = solids_of(obstacles, place_obstacles(obstacles))
        bodies = [convex_body(solid.corners, solid.radius) for solid in solids]
        objects = [
            index
            for index, obstacle in enumerate(obstacles)
            if obstacle.name.startswith("object")
        ]
        for index in objects:
            for other in range(len(obstacles)):
                if other == index:
                    continue
                poses = [(np.eye(3), solids[body].position) for body in (index, other)]
                gap, _ = distance.between(
                    bodies[index], poses[0], bodies[other], poses[1]
                )
                table = (
                    name == "tabletop" and other not in objects
                )  # tables may stand under objects of others
                assert gap > (-np.inf if table else -1e-9), (
                    seed,
                    obstacles[index].name,
                    obstacles[other].name,
                )


def test_grasps_in_shelves_are_outside_of_all_obstacles() -> None:
    for name in ("cubby", "merged-cubby", "box", "cage", "dresser"):
        for seed in range(10):
            layout = load_family(name).draw(np.random.default_rng(seed))
            primitives = primitives_of(
                layout.obstacles, place_obstacles(layout.obstacles)
            )
            points = np.array([grasp.position for grasp in layout.grasps])
            assert (signed_distances(primitives, points).min(axis=0) > 0).mean() > 0.8


def test_a_merged_cubby_has_one_wall_less() -> None:
    random = [np.random.default_rng(seed) for seed in (1, 1)]
    cubby, merged = (
        load_family(name).draw(random.pop()) for name in ("cubby", "merged-cubby")
    )
    names = {obstacle.name for obstacle in cubby.obstacles} - {
        obstacle.name for obstacle in merged.obstacles
    }
    assert len(names) == 1
    assert len(cubby.obstacles) == 9


def test_rotations_of_grasps_stay_within_the_tilt() -> None:
    grasp = Grasp(np.zeros(3), np.array([0.6, 0.0, -0.8]), tilt=0.4)
    rotations = grasp_rotations(grasp, 500, np.random.default_rng(0))
    assert rotations @ rotations.swapaxes(1, 2) == pytest.approx(
        np.tile(np.eye(3), (500, 1, 1)), abs=1e-12
    )
    assert np.linalg.det(rotations) == pytest.approx(np.ones(500))
    angle = np.arccos(np.clip(rotations[:, :, 2] @ grasp.approach, -1, 1))
    assert 0.35 < angle.max() <= 0.4 + 1e-9


def test_parameters_have_units_and_are_checked() -> None:
    family = load_family("tabletop", {"tables": 2, "height": "[10, 20] cm"})
    assert vars(family)["tables"] == Range(2, 2)
    assert vars(family)["height"] == Range(0.1, 0.2)
    with is_refused(UsageError, argument="name"):
        load_family("tabeltop")
    with is_refused(UsageError, argument="parameters"):
        load_family("tabletop", {"hight": 1})
    with is_refused(UsageError, argument="parameters"):
        load_family("tabletop", {"objects": [0, 1000]})


@dataclass(frozen=True, kw_only=True)
class Posts(SceneFamily):
    """Two posts in front of the robot."""

    def draw(self, random: np.random.Generator) -> Layout:
        posts = tuple(
            Obstacle(
                name=f"post {side}",
                kind="cylinder",
                position=(0.3, 0.2 * side, 0.2),
                radius=0.03,
                length=0.6,
            )
            for side in (-1, 1)
        )
        places = random.uniform([0.2, -0.4, 0.0], [0.4, 0.4, 0.3], (12, 3))
        return Layout(
            posts,
            tuple(
                Grasp(place, np.array([0.0, 0.0, -1.0]), tilt=3.0) for place in places
            ),
        )


@pytest.fixture(scope="module")
def arm(tmp_path_factory: pytest.TempPathFactory) -> Problem:
    """Return an arm of seven joints whose links are spheres."""
    return cnpgen.load_problem(write_arm(tmp_path_factory.mktemp("arm")))


def check_problems(problem: Problem, scenes: list[SceneProblem]) -> float:
    """Check both ends by Coal, and return the share of straight lines that are clear."""
    robot, straight = load_robot(problem), 0
    for index, scene in enumerate(scenes):
        plans = scene_plans(problem, [scene])
        model = cnpgen.RobotModel(plans.problem)
        ends = np.array([scene.start_q, scene.goal_q[0]])
        assert (model.min_distance(ends, scene=plans.scene[0]) > -1e-9).all(), index
        low, high = robot.position_lower, robot.position_upper
        assert ((ends >= low) & (ends <= high)).all()
        line = np.linspace(*ends, 100)
        straight += bool(
            (model.min_distance(line, scene=plans.scene[0]) >= -1e-9).all()
        )
    return straight / len(scenes)


def test_families_of_users_give_problems_with_collision_free_ends(arm: Problem) -> None:
    scenes = make_scenes(Posts(), arm, 8, seed=3)
    assert check_problems(arm, scenes) <= 0.2
    again = make_scenes(Posts(), arm, 8, seed=3)
    assert all(
        np.array_equal(one.goal_q, other.goal_q)
        for one, other in zip(scenes, again, strict=True)
    )
    other = make_scenes(Posts(), arm, 12, seed=4)
    assert not np.array_equal(scenes[0].goal_q, other[0].goal_q)


def test_goals_are_at_the_grasps(arm: Problem) -> None:
    robot = load_robot(arm)
    (scene,) = make_scenes(Posts(), arm, 1, seed=5)
    position, _, _ = PoseKinematics(robot).evaluate(scene.goal_q.T.copy())
    assert 0.2 - 1e-6 <= position[0, 0] <= 0.4 + 1e-6


def test_robots_out_of_reach_are_an_error(arm: Problem) -> None:
    far = load_family("cage", {"distance": "5 m"})
    with is_refused(UsageError):
        make_scenes(far, arm, 1)
    with is_refused(UsageError, argument="problem"):
        make_scenes("cage", "heavy-object", 1)


def test_states_of_rest_agree_with_the_model(arm: Problem) -> None:
    obstacles = Posts().draw(np.random.default_rng(0)).obstacles
    robot = load_robot(arm)
    q = np.random.default_rng(1).uniform(-1.5, 1.5, (200, robot.n))
    clear = RestingStates(arm, robot, obstacles).are_clear(q.T.copy())
    plans = scene_plans(
        arm, [SceneProblem(name="", obstacles=obstacles, start_q=q[0], goal_q=q[:1])]
    )
    distances = cnpgen.RobotModel(plans.problem).min_distance(
        q, scene=Scene(plans.scene.obstacles, plans.scene.poses)
    )
    assert np.array_equal(clear, distances >= 0)
    assert 20 < clear.sum() < 180


def test_the_command_writes_both_formats(
    arm: Problem, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    words = [
        "make-scenes",
        "free",
        "--robot",
        str(arm.path),
        "--n",
        "3",
        "--seed",
        "2",
        "--quiet",
    ]
    words += ["--set", "count=3", "radius=[40, 60] cm"]
    assert main([*words, "-o", str(tmp_path / "scenes.h5")]) == 0
    assert main([*words, "-o", str(tmp_path / "scenes")]) == 0
    one, other = load_scenes(tmp_path / "scenes.h5"), load_scenes(tmp_path / "scenes")
    assert len(one) == len(other) == 3
    assert {len(scene.obstacles) for scene in one} == {3}
    for first, second in zip(one, other, strict=True):
        assert first.goal_q == pytest.approx(second.goal_q, abs=1e-15)
    assert main([*words, "-o", str(tmp_path / "scenes.h5")]) == 2
    assert_said(capsys.readouterr().err)
    assert main(["make-scenes", "--list"]) == 0
    assert "tabletop: One to three tables" in capsys.readouterr().out


@needs_robots
@pytest.mark.slow
@pytest.mark.parametrize("name", shipped_families())
def test_every_family_has_problems_for_a_panda(name: str) -> None:
    problem = cnpgen.load_problem("panda-3kg")
    scenes = make_scenes(name, problem, 4, seed=77, per_scene=2)
    check_problems(problem, scenes)


@needs_robots
def test_families_refuse_problems_on_a_manifold():
    with is_refused(UsageError, argument="problem"):
        make_scenes("tabletop", "panda-cup", 1)
