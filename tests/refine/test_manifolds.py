"""Refiner on every tip manifold: motions from rest to rest that stay on it, without input plan."""

from pathlib import Path

import numpy as np
import pytest

from cnpgen.kernels.library import problem_kernels
from cnpgen.refine.refiner import Refiner
from cnpgen.refine.strategy import PlanChecker, refine_task
from cnpgen.refine.task import RefinementTask
from cnpgen.robots.scene import Scene
from cnpgen.trajectory.boundary import Boundary
from cnpgen.world.world import World
from tests.examples.manifolds import MANIFOLDS, ends_on, problem_on
from tests.examples.shipped import ROBOTS

REPEATS = pytest.mark.extended  # similar to a plane and a pose
MARKS = {"plane": (), "rectangle": REPEATS, "line": REPEATS}  # the others are slow


@pytest.mark.parametrize(
    "name",
    [pytest.param(name, marks=MARKS.get(name, pytest.mark.slow)) for name in MANIFOLDS],
)
def test_a_motion_on_a_manifold_is_found_without_input_plan(
    name: str, tmp_path: Path
) -> None:
    problem, q, world = (
        problem_on(name),
        ends_on(name),
        World(ROBOTS["heavy-object"], (), None),
    )
    rest, tips = np.zeros((1, ROBOTS["heavy-object"].n)), []
    for configuration in q:
        world.set_state(
            configuration, 0 * configuration, 0 * configuration, np.zeros(0)
        )
        tips.append(world.tip_position)
    kernels = problem_kernels(problem, ROBOTS["heavy-object"], "numpy", tmp_path)
    tool = Refiner(problem, ROBOTS["heavy-object"], kernels=kernels)
    boundary = Boundary(q[0][None], rest, rest, q[1][None], rest)
    found = refine_task(
        tool,
        PlanChecker(problem, ROBOTS["heavy-object"], degree=7),
        RefinementTask(boundary, Scene((), np.empty((1, 0))), *tips),
    )
    assert found.valid, found
    assert np.linalg.norm(tips[1] - tips[0]) > 0.2
