"""Plans for scenes: structure, goals of several kinds, reasons of unsolved scenes, and the command."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

import cnpgen
from cnpgen.cli.main import main
from cnpgen.errors import UsageError
from cnpgen.plans.scene_plans import capacity_of
from cnpgen.problems.load_robot import load_robot
from cnpgen.problems.scenes.scene_problem import make_mesh
from cnpgen.robots.obstacle import Obstacle
from cnpgen.robots.solid import place_obstacles, solids_of
from cnpgen.scenes import (
    GoalPose,
    SceneError,
    SceneOptions,
    SceneProblem,
    load_scenes,
    save_scenes,
    scene_plans,
    solve_scenes,
)
from cnpgen.world.pose_ik import PoseKinematics
from tests.examples.shaped_robot import SELF, write_problem
from tests.refusals import assert_said, is_refused

LIMITS = """[[constraint]]
use = "joint-velocity"
tolerance = "0.2 %"
[[constraint]]
use = "joint-acceleration"
tolerance = "0.5 %"
"""
START, GOAL = np.array([-0.9, -0.5, 0.9, 0.0]), np.array([0.9, -0.5, 0.9, 0.0])
POST = Obstacle(
    name="post", kind="cylinder", position=(0.6, 0.0, 0.25), radius=0.04, length=0.5
)
BOARD = Obstacle(
    name="board",
    kind="box",
    position=(0.0, 0.8, 0.4),
    size=(1.0, 0.05, 0.8),
    rotation=(0.0, 0.0, 0.2),
)
BALL = Obstacle(name="ball", kind="sphere", position=(-0.5, -0.3, 0.5), radius=0.1)
CORNERS = np.array(
    [[-0.1, -0.1, 0.0], [0.1, -0.1, 0.0], [0.0, 0.1, 0.0], [0.0, 0.0, 0.5]]
)
SCENES = [
    SceneProblem(name="post", obstacles=(POST,), start_q=START, goal_q=GOAL[None]),
    SceneProblem(
        name="all", obstacles=(BALL, BOARD, POST), start_q=START, goal_q=GOAL[None]
    ),
    SceneProblem(name="free", obstacles=(), start_q=START, goal_q=GOAL[None]),
]


@pytest.fixture
def crane(tmp_path: Path) -> Path:
    return write_problem(tmp_path, obstacles="", more=SELF + LIMITS).rename(
        tmp_path / "crane.toml"
    )


def test_scenes_become_boundary_problems_of_one_problem(crane: Path) -> None:
    problem = cnpgen.load_problem(crane)
    plans = scene_plans(problem, SCENES)
    assert capacity_of(SCENES) == {"box": 4, "sphere": 4, "cylinder": 4}
    assert len(plans.scene.obstacles) == 12
    for sample, scene in enumerate(SCENES):
        placed = [body for body in plans.scene.bodies(sample) if body.position[2] > -10]
        wanted = solids_of(scene.obstacles, place_obstacles(scene.obstacles))
        assert len(placed) == len(wanted)
        for body in wanted:
            same = min(
                placed,
                key=lambda other, body=body: float(np.abs(other.low - body.low).max()),
            )
            assert same.low == pytest.approx(body.low, abs=1e-12)
            assert same.high == pytest.approx(body.high, abs=1e-12)
    assert plans.boundary.start_q == pytest.approx(np.tile(START, (3, 1)))
    others = scene_plans(
        problem,
        [replace(SCENES[0], obstacles=(replace(POST, position=(0.5, 0.1, 0.3)),))],
    )
    assert (
        others.problem == scene_plans(problem, SCENES[:1]).problem
    )  # kernels depend on the numbers of obstacles only


def test_new_scenes_read_neither_the_urdf_nor_the_robot_again(
    crane: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    problem = cnpgen.load_problem(crane)
    first = scene_plans(problem, SCENES[:1])

    def refused(*_: object, **__: object) -> None:
        pytest.fail("the URDF is read again")

    monkeypatch.setattr("cnpgen.problems.problem.read_urdf", refused)
    monkeypatch.setattr("cnpgen.robots.robot.reduced_model", refused)
    assert scene_plans(problem, SCENES[:1]).problem == first.problem
    assert (
        scene_plans(problem, SCENES).problem != first.problem
    )  # more places for obstacles


def test_joints_are_ordered_by_name_and_checked(crane: Path) -> None:
    problem = cnpgen.load_problem(crane)
    names = ("grip", "roll", "elbow", "lift", "swing")
    scene = replace(SCENES[0], joint_names=names, start_q=np.append(0.0, START[::-1]))
    scene = replace(scene, goal_q=np.append(0.0, GOAL[::-1])[None])
    plans = scene_plans(problem, [scene])
    assert plans.boundary.start_q[0] == pytest.approx(START)
    assert plans.boundary.goal_q[0] == pytest.approx(GOAL)
    with is_refused(SceneError):
        scene_plans(problem, [replace(scene, joint_names=(*names[:4], "slew"))])
    with is_refused(SceneError):
        scene_plans(problem, [replace(scene, joint_names=())])
    with is_refused(SceneError):
        scene_plans(problem, [replace(SCENES[0], goal_q=np.array([[0, 2.7, 0, 0]]))])


def test_problems_that_ignore_obstacles_are_refused(tmp_path: Path) -> None:
    file = write_problem(tmp_path, obstacles="", more=SELF)
    file.write_text(
        file.read_text().replace('use = "robot-clearance"', 'use = "joint-velocity"')
    )
    with is_refused(UsageError, argument="problem"):
        scene_plans(cnpgen.load_problem(file), SCENES)


@pytest.mark.slow
def test_scenes_are_solved_and_judged(crane: Path, tmp_path: Path) -> None:
    problem = cnpgen.load_problem(crane)
    robot = load_robot(problem)
    position, rotation, _ = PoseKinematics(robot).evaluate(GOAL[:, None])
    pose = GoalPose("hand", position[0], rotation[0])
    inside = replace(SCENES[0], name="inside", goal_q=np.array([[0.0, -0.5, 0.9, 0.0]]))
    several = replace(
        SCENES[0],
        name="several",
        goal_q=np.array([inside.goal_q[0], GOAL, START + 0.1]),
    )
    posed = replace(SCENES[0], name="posed", goal_q=np.zeros((0, 4)), goal_pose=pose)
    wedge = make_mesh("wedge", CORNERS, np.array([0.6, 0.0, 0.0]), np.eye(3), place="")
    meshed = replace(SCENES[1], name="meshed", obstacles=(wedge, BALL))
    solved = solve_scenes(
        problem, [SCENES[0], inside, several, posed, meshed], workers=1
    )
    assert solved.valid.tolist() == [True, False, True, True, True]
    (wedge,) = [
        body
        for body in solved.plans.scene.bodies(4)
        if len(body.corners) == 4 and body.position[2] > -10
    ]
    assert wedge.low[:2] == pytest.approx([0.5, -0.1])
    assert (
        cnpgen.evaluate_plans(solved.plans, workers=1).valid.tolist()
        == solved.valid.tolist()
    )
    assert solved.plans.boundary.goal_q[2] == pytest.approx(
        START + 0.1
    )  # the nearest goal that is free
    reached, turned, _ = PoseKinematics(robot).evaluate(
        solved.plans.boundary.goal_q[3][:, None]
    )
    assert reached[0] == pytest.approx(pose.position, abs=1e-5)
    assert turned[0] == pytest.approx(pose.rotation, abs=1e-5)
    (failure,) = solved.summary()["not_valid"]
    assert failure["scene"] == "inside"
    assert failure["finding"] == "infeasible"
    assert (
        "at the goal robot clearance of fore, post is" in failure["explanation"]
    )  # as the scene names it
    model = cnpgen.RobotModel(solved.plans.problem)
    states = solved.plans.motion.at(np.linspace(0, 1, 300))
    for index in np.flatnonzero(solved.valid):
        assert (
            model.min_distance(
                states.q[index], scene=solved.plans.scene[int(index)]
            ).min()
            > -1e-4
        )


def test_a_scene_whose_goal_pose_is_out_of_reach_is_not_solved(crane: Path) -> None:
    far = GoalPose("hand", np.array([3.0, 0.0, 0.5]), np.eye(3))
    posed = replace(SCENES[0], name="far", goal_q=np.zeros((0, 4)), goal_pose=far)
    solved = solve_scenes(crane, [SCENES[0], posed, SCENES[2]], workers=1)
    assert solved.valid.tolist() == [True, False, True]
    (failure,) = solved.summary()["not_valid"]
    assert failure["reason"] == "no inverse kinematics of the goal"
    assert failure["finding"] == "gave up"
    assert "none with the goal pose" in failure["explanation"]


@pytest.mark.slow
def test_the_command_solves_scenes(
    crane: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    inside = replace(SCENES[0], name="inside", goal_q=np.array([[0.0, -0.5, 0.9, 0.0]]))
    save_scenes(tmp_path / "scenes.h5", [*SCENES[:1], inside])
    out = tmp_path / "plans.h5"
    call = [
        "solve",
        str(tmp_path / "scenes.h5"),
        "--robot",
        str(crane),
        "-o",
        str(out),
        "--workers",
        "1",
    ]
    assert main(call) == 1
    assert "scene 'inside'" in capsys.readouterr().err
    assert cnpgen.load_plans(out).status.tolist() == [1, 2]
    assert not list(tmp_path.glob("plans.h5.part*"))
    assert main([*call, "--force", "--n", "1"]) == 0
    assert len(cnpgen.load_plans(out)) == 1


def test_the_command_names_what_is_missing(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    save_scenes(tmp_path / "scenes.h5", SCENES[:1])
    assert main(["solve", str(tmp_path / "scenes.h5")]) == 2
    assert_said(capsys.readouterr().err)
    assert main(["solve", str(tmp_path / "none.h5"), "--robot", "panda"]) == 2
    assert_said(capsys.readouterr().err)
    assert len(load_scenes(tmp_path / "scenes.h5")) == 1


def test_earlier_plans_are_initial_guesses_for_moved_obstacles(crane: Path) -> None:
    before = solve_scenes(crane, SCENES, workers=1)
    post = replace(POST, position=(0.61, 0.01, 0.25))
    moved = [
        replace(
            scene,
            obstacles=tuple(post if o is POST else o for o in scene.obstacles),
        )
        for scene in SCENES
    ]
    scratch = solve_scenes(crane, moved, workers=1)
    after = solve_scenes(
        crane, moved, workers=1, run=SceneOptions(initial=before.plans)
    )
    assert after.valid.all()
    assert all(v.valid for v in cnpgen.evaluate_plans(after.plans, workers=1).verdicts)
    # The obstacles are those of the new scenes.
    np.testing.assert_array_equal(
        after.plans.columns["obstacle_poses"], scratch.plans.columns["obstacle_poses"]
    )
    steps = [sum(result.iterations for result in found.results) for found in (after, scratch)]  # fmt: skip
    assert steps[0] < steps[1] / 2
    assert (after.plans.duration < 1.02 * scratch.plans.duration).all()
    with is_refused(UsageError, argument="initial"):
        solve_scenes(crane, moved, run=SceneOptions(initial=before.plans[:2]))


def test_segments_with_smooth_stops_are_joined(crane: Path) -> None:
    back = replace(SCENES[0], name="back", start_q=GOAL, goal_q=START[None])
    run = SceneOptions(smooth_stop=True)
    solved = solve_scenes(crane, [SCENES[0], back], workers=1, run=run)
    assert solved.valid.all()
    end = solved.plans.motion.at(np.ones(1))
    np.testing.assert_allclose(end.ddq, 0, atol=1e-6)
    joined = cnpgen.join_plans(solved.plans[:1], solved.plans[1:])
    assert joined.duration == pytest.approx(solved.plans.duration.sum())


def test_the_command_starts_from_earlier_plans_and_stops_smoothly(
    crane: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    scenes, old, new = (tmp_path / name for name in ("scenes.h5", "old.h5", "new.h5"))
    save_scenes(scenes, SCENES[:1])
    command = ["solve", str(scenes), "--robot", str(crane), "--workers", "1"]
    assert main([*command, "--smooth-stop", "-o", str(old)]) == 0
    plans = cnpgen.load_plans(old)
    np.testing.assert_allclose(plans.motion.at(np.ones(1)).ddq, 0, atol=1e-6)
    assert main([*command, "--initial-plans", str(old), "-o", str(new)]) == 0
    capsys.readouterr()
    assert main([*command, "--initial-plans", str(old), "-o", str(new)]) == 0
    assert "already" in capsys.readouterr().err
    assert main(["solve", "airhockey-hit", "--n", "1", "--smooth-stop"]) == 2
    assert "--robot" in capsys.readouterr().err
