"""Obstacles of sampled trajectories: a problem whose samples bring them is judged with them only."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

import cnpgen
from cnpgen.addons.scene_files.link_constraints import LinkPosition
from cnpgen.cli.main import main
from cnpgen.errors import UsageError
from cnpgen.plans.plans import Plans
from cnpgen.plans.scene_plans import scene_plans
from cnpgen.problems.problem_record import as_problem, record_problem
from cnpgen.problems.scenes.scene_problem import SceneProblem
from cnpgen.problems.scenes.scene_request import AttachedObject, SceneRequest
from cnpgen.robots.obstacle import Obstacle
from cnpgen.trajectories import import_trajectories, load_trajectories
from cnpgen.trajectory.boundary import Boundary
from tests.examples.example_robots import needs_robots
from tests.refusals import assert_said, is_refused

pytestmark = needs_robots

START = np.array([0.0, -0.785, 0.0, -2.356, 0.0, 1.571, 0.785])
GOAL = START + np.array([0.8, 0, 0, 0, 0, 0, 0])


def scene(x: float) -> SceneProblem:
    """A column at half of the turn, in the way if it is near the robot."""
    direction = np.array([np.cos(0.4), np.sin(0.4)])
    column = Obstacle(
        name="column",
        kind="cylinder",
        position=(*(x * direction).tolist(), 0.5),
        radius=0.05,
        length=1.0,
    )
    return SceneProblem(
        name=f"column at {x}", start_q=START, goal_q=GOAL[None], obstacles=(column,)
    )


@pytest.fixture(scope="module")
def lines() -> Plans:
    """Two straight lines: one through a column, one that turns before a column."""
    plans = scene_plans(as_problem("panda-3kg"), [scene(0.4), scene(1.2)])
    share = np.concatenate(
        [[0, 0], np.linspace(0, 1, plans.path_control_points.shape[1] - 4), [1, 1]]
    )
    path = START + (GOAL - START) * share[None, :, None]
    return replace(
        plans,
        path_control_points=np.repeat(path, 2, axis=0),
        rate_control_points=np.full_like(plans.rate_control_points, 0.2),
    )


@pytest.fixture(scope="module")
def files(lines: Plans, tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Path]:
    folder = tmp_path_factory.mktemp("scenes")
    cnpgen.save_plans(folder / "plans.h5", lines)
    cnpgen.export_plans(lines, folder / "lines", to="csv", rate=100)
    return folder / "lines", folder / "plans.h5"


def test_the_verdict_in_the_scenes_of_a_plan_file_is_that_of_the_plans(
    lines: Plans, files: tuple[Path, Path]
) -> None:
    expected = cnpgen.evaluate_plans(lines, workers=1).valid.tolist()
    assert expected == [False, True]
    for problem in ("panda-3kg", "panda-scenes"):
        loaded = load_trajectories(files[0], problem, scenes=files[1])
        found = cnpgen.evaluate_trajectories(loaded.problem, loaded.trajectories)
        assert found.valid.tolist() == expected
        clearance = found.verdicts[0].conditions["robot clearance"]
        assert "cylinder" in clearance.margin.part


def test_one_scene_is_that_of_all_and_other_numbers_are_refused(
    files: tuple[Path, Path],
) -> None:
    loaded = load_trajectories(files[0], "panda-3kg", scenes=[scene(0.4)])
    found = cnpgen.evaluate_trajectories(loaded.problem, loaded.trajectories)
    assert found.valid.tolist() == [False, False]
    with is_refused(UsageError, argument="scenes"):
        load_trajectories(files[0], "panda-3kg", scenes=[scene(1.0)] * 3)


def test_without_scenes_a_problem_whose_samples_bring_them_is_refused(
    files: tuple[Path, Path], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = str(tmp_path / "out")
    for words in (
        ["evaluate", str(files[0])],
        ["import", str(files[0]), "-o", f"{out}.h5"],
        ["view", str(files[0]), "-o", f"{out}.html"],
    ):
        assert main([*words, "--problem", "panda-scenes"]) == 2
        assert "has no scene: samples of 'panda-3kg' place" in (
            text := capsys.readouterr().err
        )
        assert "--scenes" in text
    words = ["evaluate", str(files[0]), "--problem", "panda-scenes"]
    assert main([*words, "--scenes", str(files[1])]) == 1
    assert "trajectories of panda-3kg: 1 invalid, 1 " in capsys.readouterr().out


def test_imported_plans_have_the_scenes(lines: Plans, files: tuple[Path, Path]) -> None:
    loaded = load_trajectories(files[0], "panda-3kg", scenes=files[1])
    imported = import_trajectories(loaded.problem, loaded.trajectories)
    assert np.array_equal(
        imported.plans.columns["obstacle_poses"], lines.columns["obstacle_poses"]
    )
    assert cnpgen.evaluate_plans(imported.plans, workers=1).valid.tolist() == [
        False,
        True,
    ]


def test_a_dataset_of_lerobot_has_its_scenes(lines: Plans, tmp_path: Path) -> None:
    pytest.importorskip("pyarrow")
    cnpgen.export_plans(lines, tmp_path / "le", to="lerobot", rate=100)
    loaded = load_trajectories(tmp_path / "le", lines.problem)
    found = cnpgen.evaluate_trajectories(loaded.problem, loaded.trajectories)
    assert not found.verdicts[0].valid
    decisions = [v.conditions["robot clearance"].decision for v in found.verdicts]
    assert decisions == ["invalid", "valid"]
    with is_refused(UsageError, argument="scenes"):
        load_trajectories(tmp_path / "le", lines.problem, scenes=[scene(1.0)])


def test_the_scenes_of_a_dataset_of_lerobot_add_their_obstacles_to_a_problem(
    lines: Plans,
    files: tuple[Path, Path],
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
) -> None:
    pytest.importorskip("pyarrow")
    cnpgen.export_plans(lines, tmp_path / "le", to="lerobot", rate=100)
    words = ["evaluate", str(tmp_path / "le"), "--problem", "panda-3kg"]
    assert main(words) == 2
    err = capsys.readouterr().err
    assert "numbers, and 'panda-3kg' takes 0: its scene file as --scenes adds" in err
    assert main([*words, "--scenes", str(files[1])]) == 1
    assert "1 invalid, 1 a valid motion exists" in capsys.readouterr().out
    for option in ("--scenes", "--topic"):
        given = [option, str(files[0]), option, str(files[1])]
        assert main([*words, *given]) == 2
        assert_said(capsys.readouterr().err)


def test_export_takes_scenes_for_plans_without(
    lines: Plans,
    files: tuple[Path, Path],
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
) -> None:
    pytest.importorskip("pyarrow")
    alone = cnpgen.make_plans(
        "panda-3kg",
        lines.boundary,
        path_control_points=lines.path_control_points,
        rate_control_points=lines.rate_control_points,
    )
    cnpgen.save_plans(tmp_path / "alone.h5", alone)
    words = ["export", str(tmp_path / "alone.h5"), "--rate", "100", "--to"]
    scenes = ["--scenes", str(files[1])]
    assert main([*words, "lerobot", *scenes, "-o", str(tmp_path / "le")]) == 0
    loaded = load_trajectories(tmp_path / "le", lines.problem)
    found = cnpgen.evaluate_trajectories(loaded.problem, loaded.trajectories)
    decisions = [v.conditions["robot clearance"].decision for v in found.verdicts]
    assert decisions == ["invalid", "valid"]
    capsys.readouterr()
    for to, other, text in (
        ("csv", scenes, "csv stores no obstacles, expected lerobot"),
        ("lerobot", [*scenes, "--join", str(files[1])], "plans without --join"),
    ):
        assert main([*words, to, *other, "-o", str(tmp_path / "no")]) == 2
        assert text in capsys.readouterr().err
    given = ["export", str(files[1]), "--to", "lerobot", *scenes]
    assert main([*given, "-o", str(tmp_path / "no")]) == 2
    assert_said(capsys.readouterr().err)
    assert not (tmp_path / "no").exists()


def test_scenes_of_other_obstacles_and_plans_without_scenes_are_refused(
    files: tuple[Path, Path], tmp_path: Path
) -> None:
    rest = START[None]
    plans = cnpgen.make_plans(
        "panda-3kg",
        Boundary(rest, 0 * rest, 0 * rest, rest, 0 * rest),
        path_control_points=np.repeat(rest[:, None], 15, axis=1),
        rate_control_points=np.ones((1, 20)),
    )
    cnpgen.save_plans(tmp_path / "free.h5", plans)
    with is_refused(UsageError, argument="scenes"):
        load_trajectories(files[0], "panda-3kg", scenes=tmp_path / "free.h5")


def demanding(**demands: object) -> SceneProblem:
    """Return a scene without obstacles, and with demands of its request."""
    request = SceneRequest(**demands)  # type: ignore[arg-type]
    return replace(scene(1.2), obstacles=(), request=request)


STICK = Obstacle(name="stick", position=(0.0, 0.0, 0.3), size=(0.04, 0.04, 0.4))


@pytest.mark.parametrize(
    ("demands", "reason"),
    [
        ({}, ""),
        ({"velocity_scale": 0.01}, "joint velocity limit"),
        ({"constraints": (LinkPosition(link="panda_hand", region=(STICK,)),)}, LinkPosition.reason),
    ],
)  # fmt: skip
def test_demands_of_requests_hold_for_trajectories(
    files: tuple[Path, Path], demands: dict[str, object], reason: str
) -> None:
    loaded = load_trajectories(files[0], "panda-3kg", scenes=[demanding(**demands)])
    found = cnpgen.evaluate_trajectories(loaded.problem, loaded.trajectories)
    assert [each.reason for each in found.verdicts] == [reason] * 2


@pytest.mark.parametrize("name", ["", "panda", "fetch"])
@pytest.mark.parametrize("scale", [1.0, 0.5])
def test_scenes_of_another_robot_are_a_warning_and_their_ends_are_listed(
    files: tuple[Path, Path],
    name: str,
    scale: float,
    caplog: pytest.LogCaptureFixture,
) -> None:
    caplog.set_level("INFO", "cnpgen")
    scenes = [demanding(robot_name=name, velocity_scale=scale)]
    load_trajectories(files[0], "panda-3kg", scenes=scenes)
    text = f"is for the robot {name!r}, the URDF is that of 'panda'"
    assert caplog.text.count(text) == (name == "fetch")
    assert "not used of the scenes: their goals, and their starts" in caplog.text


def test_attached_objects_of_scenes_collide_along_trajectories(
    files: tuple[Path, Path],
) -> None:
    links = ("panda_leftfinger", "panda_rightfinger")
    stick = AttachedObject(
        "stick", "panda_hand", (STICK,), ("panda_hand",), links, mass=0.1
    )
    below = Obstacle(name="below", position=(0.28, 0.12, 0.08), size=(0.1, 0.1, 0.1))
    free = replace(scene(1.2), obstacles=(below,))  # within reach of the stick only
    carrying = replace(free, request=SceneRequest(attached=(stick,)))
    for each, valid in ((free, True), (carrying, False)):
        loaded = load_trajectories(files[0], "panda-3kg", scenes=[each])
        found = cnpgen.evaluate_trajectories(loaded.problem, loaded.trajectories)
        assert found.valid.tolist() == [valid] * 2
    part = found.verdicts[0].conditions["robot clearance"].margin.part
    assert "attached stick" in part


def test_plan_files_with_demands_that_the_problem_lacks_are_refused(
    lines: Plans, files: tuple[Path, Path], tmp_path: Path
) -> None:
    problem = as_problem(lines.problem)
    inside = LinkPosition(link="panda_hand", region=(STICK,))
    constrained = problem.replaced(constraint=(*problem.constraint, inside))
    plans = replace(lines, problem=record_problem(constrained))
    cnpgen.save_plans(tmp_path / "plans.h5", plans)
    with is_refused(UsageError, argument="scenes"):
        load_trajectories(files[0], "panda-3kg", scenes=tmp_path / "plans.h5")
