"""The kinds of files of other software: scenes, sampled trajectories, and plans with obstacles of their own."""

import json
import shutil
from collections.abc import Callable
from contextlib import suppress
from dataclasses import replace
from pathlib import Path
from random import Random
from typing import Any

import numpy as np

from cnpgen.addons.scene_files.scene_files import load_scenes, save_scenes
from cnpgen.addons.trajectories.evaluate_trajectories import evaluate_trajectories
from cnpgen.addons.trajectories.import_trajectories import import_trajectories
from cnpgen.addons.trajectories.load_trajectories import load_trajectories
from cnpgen.errors import CnpgenError, MissingExtraError
from cnpgen.plans.boundary_problems import load_boundary_problems
from cnpgen.plans.evaluate import evaluate_plans
from cnpgen.plans.export import export_plans
from cnpgen.plans.plan_file import load_plans, save_plans
from cnpgen.plans.plans import screen
from cnpgen.plans.scene_plans import scene_plans
from cnpgen.problems.load_robot import load_robot
from cnpgen.problems.problem_file import load_problem
from cnpgen.problems.scenes.scene_problem import SceneProblem
from cnpgen.robots.obstacle import Obstacle
from cnpgen.trajectories import LoadOptions
from tests.examples.plan_files import plans_of, remove_checksum
from tests.examples.plans import load as stored_plan
from tests.examples.scene_files import REQUEST, ROBOMETRICS, SCENE
from tests.faults.mutations import change_bytes, change_json, change_text

SCENE_PROBLEM = "heavy-object"  # a robot with the constraint robot-clearance
EXPORT_RATE_HZ = 100.0
EXPORTED = {  # format -> file or folder
    "csv": "csv",
    "joint-trajectory": "joint-trajectory",
    "npz": "plans.npz",
    "parquet": "plans.parquet",
    "lerobot": "lerobot",
}
POST = Obstacle(
    name="post", kind="cylinder", position=(0.5, 0.0, 0.3), radius=0.05, length=0.6
)
START = np.array([-0.6, 0.0, 0.0, -2.0, 0.0, 2.0, 0.8])
SCENE_FILES = ("scenes.h5", "moveit", "scene.yaml")
MAX_JUDGED_SAMPLES = 2_000


def make_scene_files(folder: Path) -> None:
    """Make valid scene files of all formats, exported plans in all formats, and plans among scenes."""
    goal = START + np.array([1.2, *np.zeros(6)])
    scenes = [
        SceneProblem(name=name, obstacles=(POST,), start_q=START, goal_q=goal[None])
        for name in "ab"
    ]
    save_scenes(folder / "scenes.h5", scenes)
    (folder / "moveit").mkdir()
    (folder / "moveit" / "scene0001.yaml").write_text(SCENE, encoding="utf-8")
    (folder / "moveit" / "request0001.yaml").write_text(REQUEST, encoding="utf-8")
    (folder / "scene.yaml").write_text(ROBOMETRICS, encoding="utf-8")
    plans = scene_plans(load_problem(SCENE_PROBLEM), scenes)
    line = np.linspace(START, goal, plans.path_control_points.shape[1])
    paths, rates = np.stack([line, line]), np.ones_like(plans.rate_control_points)
    save_plans(
        folder / "scene_plans.h5",
        replace(plans, path_control_points=paths, rate_control_points=rates),
    )
    remove_checksum(folder / "scene_plans.h5")
    plan, trajectories = stored_plan("hit"), folder / "trajectories"
    trajectories.mkdir()
    for name, file in EXPORTED.items():
        try:
            export_plans(
                plans_of(plan, plan), trajectories / file, to=name, rate=EXPORT_RATE_HZ
            )
        except MissingExtraError:
            continue
    rows = [{"t": k / EXPORT_RATE_HZ, "q": [0.1 * k] * 6} for k in range(4)]
    (trajectories / "rows.json").write_text(json.dumps(rows), encoding="utf-8")
    (trajectories / "columns.yaml").write_text(
        f"t: {[row['t'] for row in rows]}\nq: {[row['q'] for row in rows]}\n",
        encoding="utf-8",
    )


def change_scene(good: Path, folder: Path, draw: Random) -> None:
    """Change a scene file of one format."""
    name = draw.choice(SCENE_FILES)
    if name == "moveit":
        shutil.copytree(good / "moveit", folder / "moveit")
        change_text_file(draw.choice(sorted((folder / "moveit").iterdir())), draw)
    else:
        shutil.copy(good / name, folder)
        change_text_file(folder / name, draw)


def change_trajectory(good: Path, folder: Path, draw: Random) -> None:
    """Change one file of trajectories."""
    entry = draw.choice(sorted((good / "trajectories").iterdir()))
    target = folder / entry.name
    if entry.is_dir():
        shutil.copytree(entry, target)
        target = draw.choice(
            [path for path in sorted(target.rglob("*")) if path.is_file()]
        )
    else:
        shutil.copy(entry, target)
    change_text_file(target, draw)


def change_text_file(path: Path, draw: Random) -> None:
    """Change a text file mostly as a text, and every other file byte by byte."""
    content = path.read_bytes()
    if path.suffix not in {".json", ".yaml", ".csv"} or draw.random() < 0.2:
        path.write_bytes(change_bytes(content, draw))
        return
    text = content.decode()
    if path.suffix == ".json":
        text = json.dumps(change_json(json.loads(text), draw))
    else:
        separator = ": " if path.suffix == ".yaml" else ","
        if (
            path.suffix == ".yaml" and draw.random() < 0.1
        ):  # a list of itself, and aliases
            text = (
                text.replace("[", "&x [*x, ", 1)
                if draw.random() < 0.5
                else f"x: &x [1, 2]\ny: [*x, *x]\n{text}"
            )
        text = change_text(text.replace(separator, f"={separator}"), draw).replace(
            f"={separator}", separator
        )
    path.write_text(text, encoding="utf-8", errors="replace")


def read_scene(folder: Path, draw: Random) -> None:
    """Read scenes; make plans of them and write them again, which is refused if they are of another robot."""
    (path,) = folder.iterdir()
    scenes = load_scenes(path, n=draw.choice((None, 1)))[:3]
    problem = load_problem(SCENE_PROBLEM)
    with suppress(CnpgenError):
        read_all(
            lambda: scene_plans(problem, scenes),
            lambda: save_scenes(folder / "again.h5", scenes),
            lambda: save_scenes(
                folder / "again", scenes, joints=load_robot(problem).joint_names
            ),
        )


def read_trajectory(folder: Path, draw: Random) -> None:
    """Read trajectories, judge short ones, and make plans of them."""
    (path,) = folder.iterdir()
    loaded = load_trajectories(
        path, "airhockey", options=LoadOptions(rate=draw.choice((None, EXPORT_RATE_HZ)))
    )
    short = [
        trajectory
        for trajectory in loaded.trajectories
        if len(trajectory.t) <= MAX_JUDGED_SAMPLES
    ][:1]
    if short and draw.random() < 0.1:
        read_all(
            lambda: evaluate_trajectories("airhockey", short, workers=1),
            lambda: import_trajectories("airhockey", short),
        )


def read_scene_plans(folder: Path, draw: Random) -> None:
    """Read plans with a column of obstacle poses."""
    path = folder / "plans.h5"
    plans = load_plans(path)
    screen(plans)
    readers: list[Callable[[], Any]] = [
        lambda: load_boundary_problems(path),
        lambda: plans.scene.bodies(0),
    ]
    if draw.random() < 0.1:
        readers.append(lambda: evaluate_plans(plans[:1], workers=1))
    read_all(*readers)


def read_all(*readers: Callable[[], Any]) -> None:
    """Call all readers; raise the first ``CnpgenError`` after that."""
    failures = []
    for read in readers:
        try:
            read()
        except CnpgenError as error:
            failures.append(error)
    if failures:
        raise failures[0]
