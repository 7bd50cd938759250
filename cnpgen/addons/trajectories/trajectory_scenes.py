"""Scenes of sampled trajectories: those of scene files, or of the plans that were sampled.

The demands of requests hold for trajectories, too: scaled limits, attached objects and
constraints of the path.
"""

from __future__ import annotations

import logging
from collections import Counter
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from cnpgen.addons.trajectories.sampled_trajectory import Trajectory
from cnpgen.arrays import Array
from cnpgen.documents import AnyPath
from cnpgen.errors import UsageError, counted, listed
from cnpgen.make.recipe import load_dataset_recipe
from cnpgen.plans.format import PlanStatus
from cnpgen.plans.plan_file import load_plans
from cnpgen.plans.plans import Plans
from cnpgen.plans.scene_plans import (
    capacity_of,
    poses_of_scene,
    shape_of,
    start_state,
)
from cnpgen.problems.constraints.constraint import LinkConstraint
from cnpgen.problems.load_robot import load_robot
from cnpgen.problems.obstacles import with_capacity
from cnpgen.problems.problem import Problem
from cnpgen.problems.problem_record import (
    ProblemRecord,
    as_problem,
    as_record,
    record_problem,
)
from cnpgen.problems.scenes.placement import placed_scene, warn_of_another_robot
from cnpgen.problems.scenes.requested_problem import requested_problem
from cnpgen.problems.scenes.scene_problem import SceneProblem, check_scenes
from cnpgen.problems.scenes.scene_reader import (
    DEFAULT_OPTIONS,
    ReadingOptions,
    read_scenes,
)
from cnpgen.robots.attached_links import attached_link_name
from cnpgen.robots.obstacle import Obstacle
from cnpgen.robots.scene import PARKED_POSITION_M
from cnpgen.robots.urdf import urdf_tree
from cnpgen.schema.arguments import concerning
from cnpgen.schema.catalogue import find_recipe
from cnpgen.schema.toml import Kind, read_table
from cnpgen.store.files.accounted import check_allowed
from cnpgen.store.files.kind import PLANS
from cnpgen.store.paths import file_kind
from cnpgen.store.scene_table import OBSTACLE_POSES

_LOG = logging.getLogger(__name__)
MAX_ROUNDING = 1e-6  # of poses and sizes in float32
_KINDS: tuple[Kind, ...] = ("problem", "pipeline", "dataset")


def problem_of_samples(problem: object) -> ProblemRecord:
    """Return the record of a problem from any argument of ``as_problem``.

    For the name or file of a pipeline or dataset, it has the places for the obstacles
    that its samples bring.
    """
    if not isinstance(problem, str | Path):
        return as_record(problem)
    with concerning("problem"):
        path = find_recipe(_KINDS, problem)
        errors = list[str]()
        table = read_table(path, _KINDS, errors) or {}
        if {"pipeline", "problem"} & table.keys():
            return record_problem(load_dataset_recipe(path).pipeline.problem)
    return as_record(problem)


def with_scenes(
    record: ProblemRecord,
    trajectories: Sequence[Trajectory],
    scenes: str | Path | Sequence[SceneProblem],
    *,
    options: ReadingOptions = DEFAULT_OPTIONS,
) -> tuple[ProblemRecord, tuple[Trajectory, ...]]:
    """Place the obstacles of scenes around trajectories: one scene for each, or one for all.

    Return the problem with as many further obstacles as the scenes have, and the
    trajectories with their poses and sizes. Those of trajectories that have scenes
    already, such as float32 ones of a LeRobotDataset, must be the same.

    Raises:
        UsageError: The number of scenes is wrong, a plan file has no scenes or is of a
            problem with other obstacles, or a trajectory has another scene.
        DatasetError, MissingExtraError: as of the readers of scenes and plans.
    """
    placed, rows = _placed(
        as_problem(record),
        scenes,
        counted(len(trajectories), "trajectory"),
        len(trajectories),
        options,
    )
    for index, (trajectory, row) in enumerate(zip(trajectories, rows, strict=True)):
        own = trajectory.obstacle_poses
        if own is not None and not (
            own.shape == row.shape
            and np.allclose(own, row, rtol=MAX_ROUNDING, atol=MAX_ROUNDING)
        ):
            text = f"trajectory {index} has another scene of its own"
            raise UsageError(text, concerns="scenes")
    pairs = zip(trajectories, rows, strict=True)
    return record_problem(placed), tuple(
        replace(trajectory, obstacle_poses=row.copy()) for trajectory, row in pairs
    )


def plans_in_scenes(
    plans: Plans, scenes: AnyPath, allow_unused: Sequence[str] = ()
) -> Plans:
    """Place the obstacles of scenes around plans that have none: one scene for each, or one for all.

    The status of the plans is unknown then. Errors are those of ``with_scenes``.
    """
    if OBSTACLE_POSES in plans.columns:
        raise UsageError("the plans have scenes of their own", concerns="scenes")
    count = len(plans)
    options = ReadingOptions(allow_unused)
    placed, rows = _placed(
        as_problem(plans.problem), scenes, counted(count, "plan"), count, options
    )
    return replace(
        plans,
        problem=record_problem(placed),
        columns={**plans.columns, OBSTACLE_POSES: rows.copy()},
        status=np.full(count, PlanStatus.UNKNOWN, np.uint8),
    )


def _placed(
    problem: Problem,
    scenes: str | Path | Sequence[SceneProblem],
    motions: str,
    count: int,
    options: ReadingOptions,
) -> tuple[Problem, Array]:
    """Return the problem with the obstacles of scenes, and their poses around each of some motions, (count, width)."""
    if isinstance(scenes, str | Path) and file_kind(Path(scenes)) != PLANS:
        placed, poses = _of_problems(
            problem, read_scenes(Path(scenes), options=options)
        )
    else:
        check_allowed(options.allow_unused, [])
        if isinstance(scenes, str | Path):
            placed, poses = _of_plans(problem, Path(scenes))
        else:
            check_scenes(scenes)
            placed, poses = _of_problems(problem, scenes)
    if len(poses) not in {1, count}:
        raise UsageError(
            f"must have one scene, or one for each of {motions}, got {len(poses)}",
            argument="scenes",
        )
    return placed, np.broadcast_to(poses, (count, poses.shape[1]))


def _of_problems(
    problem: Problem, scenes: Sequence[SceneProblem]
) -> tuple[Problem, Array]:
    """Return the problem with the demands of scenes and their capacity, and the poses of their obstacles, (N, width)."""
    _LOG.info(
        "not used of the scenes: their goals, and their starts but for frames of links: the motions have ends of their own"
    )
    if any(each.request.places or each.request.changes_problem for each in scenes):
        robot = load_robot(problem)
        placed_scenes = [
            placed_scene(each, robot, start_state(each, robot)) for each in scenes
        ]
        problem, _, scenes = requested_problem(problem, robot, placed_scenes)
    elif any(each.request.robot_name for each in scenes):
        robot = load_robot(problem)
        for each in scenes:
            warn_of_another_robot(each, robot)
    own = problem.with_obstacles(problem.own_obstacles)
    capacity = Counter(map(shape_of, _parked(problem))) | Counter(capacity_of(scenes))
    placed = with_capacity(own, capacity)
    fixed = len(own.obstacle)
    return placed, np.array([poses_of_scene(placed, fixed, scene) for scene in scenes])


def _of_plans(problem: Problem, path: Path) -> tuple[Problem, Array]:
    """Return the problem with the obstacles that plans place, and their poses, shape (N, width)."""
    plans = load_plans(path)
    if OBSTACLE_POSES not in plans.columns:
        raise UsageError(
            f"{path} has no scenes: its plans have no column {OBSTACLE_POSES}",
            concerns="scenes",
        )
    other = as_problem(plans.problem)
    if other.own_obstacles != problem.own_obstacles:
        raise UsageError(
            f"{path} is of {other.name!r}, whose obstacles are others than those of {problem.name!r}",
            concerns="scenes",
        )
    if lost := _lost_demands(problem, other):
        raise UsageError(
            f"{path} is of a problem with {listed(lost)}, which {problem.name!r} lacks:"
            " give the scene file of its request",
            concerns="scenes",
        )
    return problem.with_obstacles(other.obstacle), plans.columns[OBSTACLE_POSES]


def _lost_demands(problem: Problem, other: Problem) -> list[str]:
    """List the demands of requests that the problem of plans has, and another one lacks."""
    links = _links(other) - _links(problem)
    bodies = sorted(link for link in links if link.startswith(attached_link_name("")))
    constraints = [
        f"a constraint of the path of {each.link!r}"
        for each in other.constraint
        if isinstance(each, LinkConstraint) and each not in problem.constraint
    ]
    return [*map(repr, bodies), *constraints]


def _links(problem: Problem) -> set[str]:
    """Return the names of the links of a problem's robot."""
    return {link.get("name", "") for link in urdf_tree(problem.urdf_text).iter("link")}


def _parked(problem: Problem) -> list[Obstacle]:
    """Return the obstacles that samples place."""
    return [
        obstacle
        for obstacle in problem.obstacle
        if obstacle.position == PARKED_POSITION_M
    ]
