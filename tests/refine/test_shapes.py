"""Plans for robots that have a shape, from nothing: what is called valid touches nothing, as its meshes tell."""

from pathlib import Path

import numpy as np
import pytest

from cnpgen import draw_boundary_problems, evaluate_plans, load_plans, save_plans, solve_plans
from cnpgen.plans import Plans
from cnpgen.problems.load import load_problem
from cnpgen.problems.robot import load_robot
from cnpgen.trajectory.motion import Motion
from tests.conftest import needs_compiler, some
from tests.examples.example_robots import CLUTTER, folder, needs_robots, write_panda
from tests.examples.meshes import Meshes, states
from tests.examples.shaped_robot import KINDS, OBSTACLES, write_pipeline, write_problem

pytestmark = needs_compiler


def solved(where: Path, n: int) -> Plans:
    """Fresh problems of the pipeline in a folder, solved, saved and loaded again."""
    refinement = solve_plans(draw_boundary_problems(where / "pipeline.toml", n, seed=5), workers=1)
    save_plans(where / "plans.h5", refinement.plans)
    return load_plans(where / "plans.h5")


def valid_states(plans: Plans, step: float = 1e-3) -> list[np.ndarray]:
    """What valid plans do every ``step`` [s], plan by plan."""
    verdicts = evaluate_plans(plans, workers=1).verdicts
    return [states(plans, index, step) for index, verdict in enumerate(verdicts) if verdict.valid]


@pytest.mark.slow
@pytest.mark.parametrize("obstacles", some([KINDS, OBSTACLES]), ids=["kinds", "boxes"])
def test_valid_plans_touch_nothing(tmp_path, obstacles):
    problem = load_problem(write_problem(tmp_path, obstacles=obstacles))
    write_pipeline(tmp_path)
    meshes = Meshes(problem, load_robot(problem), tmp_path)
    found = valid_states(solved(tmp_path, 12), step=2e-5)  # motions without limits take 10 ms
    assert len(found) >= 8
    assert min(map(len, found)) > 100
    allowed = 1e-4  # m: the tolerance of the problem
    for path in found:
        assert min(min(meshes.distances(q)) for q in path[:: max(len(path) // 100, 1)]) > -allowed - 1e-6


@pytest.mark.slow
def test_plans_may_have_to_stop_without_acceleration(tmp_path):
    write_problem(tmp_path)
    write_pipeline(tmp_path, stop='acceleration = "zero"')
    plans = solved(tmp_path, 3)
    assert all(verdict.valid for verdict in evaluate_plans(plans, workers=1).verdicts)
    motion = Motion(plans.path_control_points, plans.rate_control_points, plans.degree)
    assert np.abs(motion.at(np.array([1.0])).ddq).max() < 1e-8


@needs_robots
@pytest.mark.extended
def test_a_panda_between_shelves_touches_nothing(tmp_path):
    problem = load_problem(write_panda(tmp_path))
    meshes = Meshes(problem, load_robot(problem), folder())
    found = valid_states(solved(tmp_path, 40))
    assert len(found) >= 30
    assert not any(meshes.touches(q) for path in found for q in path)


@needs_robots
@pytest.mark.extended
def test_a_panda_finds_its_way_among_ten_obstacles_of_four_kinds_and_touches_nothing(tmp_path):
    problem = load_problem(write_panda(tmp_path, obstacles=CLUTTER))
    meshes = Meshes(problem, load_robot(problem), folder())
    found = valid_states(solved(tmp_path, 100))
    assert len(found) >= 95
    assert not any(meshes.touches(q) for path in found for q in path)
