"""Scenes of plans: the column obstacle_poses gives every plan its own obstacles."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

import cnpgen
from cnpgen.errors import UsageError
from cnpgen.plans.plans import make_plans
from cnpgen.problems.constraints.axis import Vertical
from cnpgen.problems.constraints.clearance import ObjectContact
from cnpgen.problems.constraints.link_clearance import ObjectClearance
from cnpgen.robots.obstacle import Obstacle
from cnpgen.robots.scene import PARKED_POSITION_M
from cnpgen.robots.solid import place_obstacles
from cnpgen.trajectory.boundary import Boundary, assemble
from cnpgen.trajectory.trajectory_spec import TrajectorySpec
from tests.refusals import is_refused


def plans_with(poses: np.ndarray) -> cnpgen.Plans:
    """Return slow motions of joint 1 between two ends, one for each row of poses."""
    problem = cnpgen.load_problem("heavy-object")
    box = Obstacle(
        name="box", kind="box", position=PARKED_POSITION_M, size=(0.2, 0.2, 0.2)
    )
    constraints = tuple(
        item
        for item in problem.constraint
        if not isinstance(item, Vertical | ObjectContact | ObjectClearance)
    )
    problem = replace(
        problem, obstacle=(box,), object=None, payload=None, constraint=constraints
    )
    count, spec = (
        len(poses),
        TrajectorySpec(degree=7, path_control_points=15, rate_control_points=20),
    )
    start = np.tile([-0.5, 1.0, 0, -1.0, 0, 0.5, 0], (count, 1))
    goal, zero = start + np.eye(7)[0], np.zeros((count, 7))
    boundary, rate = (
        Boundary(start, zero, zero, goal, zero, None),
        np.full((count, 20), 0.2),
    )
    inner = (
        start[:, None] + np.linspace(0, 1, 10)[None, :, None] * (goal - start)[:, None]
    )
    path = assemble(boundary, inner, rate, spec)
    return make_plans(
        problem,
        boundary,
        path_control_points=path,
        rate_control_points=rate,
        columns={"obstacle_poses": poses},
    )


def poses_of(position: tuple[float, float, float]) -> np.ndarray:
    return place_obstacles(
        [Obstacle(name="box", kind="box", position=position, size=(0.2, 0.2, 0.2))]
    )


def test_every_plan_has_its_own_obstacles() -> None:
    plans = plans_with(
        np.stack(
            [
                poses_of(PARKED_POSITION_M),
                poses_of((0.6, 0.0, 0.6)),
                poses_of((-0.8, 0.0, 0.3)),
            ]
        )
    )
    low = [plans.scene.bodies(sample)[0].low for sample in range(3)]
    assert low[1] == pytest.approx([0.5, -0.1, 0.5])
    assert low[2] == pytest.approx([-0.9, -0.1, 0.2])
    robot = cnpgen.RobotModel(plans.problem)
    q = np.linspace(-0.5, 0.5, 21)[:, None] * np.eye(7)[0] + plans.boundary.start_q[
        0
    ] * (np.arange(7) > 0)
    smallest = [
        robot.min_distance(q, scene=plans.scene[sample]).min() for sample in range(3)
    ]
    reasons = [
        str(verdict.reason)
        for verdict in cnpgen.evaluate_plans(plans, workers=1).verdicts
    ]
    assert [reason == "robot in collision" for reason in reasons] == [
        False,
        True,
        False,
    ]
    assert smallest[1] < 0 < min(smallest[0], smallest[2])


def test_obstacle_poses_are_kept_in_files_and_selections(tmp_path: Path) -> None:
    plans = plans_with(
        np.stack([poses_of((0.6, 0.1 * index, 0.6)) for index in range(3)])
    )
    cnpgen.save_plans(tmp_path / "plans.h5", plans[1:])
    loaded = cnpgen.load_plans(tmp_path / "plans.h5")
    assert np.array_equal(loaded.scene.poses, plans.scene.poses[1:])
    problems = cnpgen.load_boundary_problems(tmp_path / "plans.h5")
    assert np.array_equal(problems.scene.poses, plans.scene.poses[1:])


@pytest.mark.parametrize(
    "poses", [np.zeros((2, 5)), np.full((2, 6), np.nan), np.full((2, 6), 1e6)]
)
def test_poses_that_do_not_fit_are_refused(poses: np.ndarray) -> None:
    with is_refused(UsageError, argument="obstacle_poses"):
        _ = plans_with(poses).scene
