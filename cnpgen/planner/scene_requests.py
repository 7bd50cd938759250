"""Plan the problems of scenes with a model whose samples place obstacles."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from cnpgen.errors import UsageError
from cnpgen.planner.model import Model
from cnpgen.planner.plan_requests import Requests
from cnpgen.planner.planner import Planner
from cnpgen.plans.format import OBSTACLE_POSES
from cnpgen.plans.plans import Plans
from cnpgen.plans.scene_plans import scene_plans, shape_of
from cnpgen.problems.problem_record import open_problem
from cnpgen.problems.scenes.scene_problem import SceneProblem, checked_scene
from cnpgen.robots.scene import PARKED_POSITION_M


def plan_scenes(
    planner: Planner, scenes: Sequence[SceneProblem], *, goals: Sequence[NDArray[np.float64]] | None = None
) -> Plans:
    """Plan the problems of scenes, from rest to rest.

    Args:
        planner: Planner of a model that was trained on scenes.
        scenes: The scenes.
        goals: Joint positions at the goals in the order of the planned joints [rad], shape (n,) each; by default the
            first goal state of each scene.

    Returns:
        A plan per scene, not checked yet (status UNKNOWN).

    Raises:
        SceneError: A scene does not fit the robot.
        UsageError: The model is for other problems, there are no scenes, or a scene has more obstacles of a kind than
            the model's problem.
    """
    requests = scene_requests(planner.model, scenes, goals=goals)
    return planner.plan_batch(requests.boundary, sample_id=requests.sample_id, columns=requests.columns)


def scene_requests(
    model: Model, scenes: Sequence[SceneProblem], *, goals: Sequence[NDArray[np.float64]] | None = None
) -> Requests:
    """Return the tasks of scenes; see ``plan_scenes``."""
    if len(scenes) == 0:
        raise UsageError("there are no scenes", concerns="scenes")
    problem, _ = open_problem(model.problem)
    if not problem.has_sample_obstacles:
        raise UsageError(
            f"the model is for {problem.name!r}, whose obstacles do not differ from plan to plan: expected a model"
            " that was trained on scenes",
            concerns="model",
        )
    own = tuple(obstacle for obstacle in problem.obstacle if obstacle.position != PARKED_POSITION_M)
    parked = Counter(shape_of(obstacle) for obstacle in problem.obstacle if obstacle.position == PARKED_POSITION_M)
    checked = [checked_scene(scene) for scene in scenes]
    plans = scene_plans(problem.with_obstacles(own), checked, goals=goals, capacity=parked)
    columns = {OBSTACLE_POSES: plans.columns[OBSTACLE_POSES]}
    return Requests(plans.boundary, plans.sample_id, columns)
