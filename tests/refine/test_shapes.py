"""Plans for robots with link geometry, without input plan: valid ones are free of collisions by their meshes."""

from pathlib import Path

import numpy as np
import pytest

from cnpgen import (
    draw_boundary_problems,
    evaluate_plans,
    load_plans,
    save_plans,
    solve_plans,
)
from cnpgen.plans import Plans
from cnpgen.problems.load_robot import load_robot
from cnpgen.problems.problem_file import load_problem
from cnpgen.trajectory.spline_motion import Motion
from tests.conftest import needs_compiled_code, some
from tests.examples.example_robots import CLUTTER, folder, needs_robots, write_panda
from tests.examples.meshes import Meshes, states
from tests.examples.shaped_robot import KINDS, OBSTACLES, write_pipeline, write_problem

pytestmark = needs_compiled_code


def solved(where: Path, n: int) -> Plans:
    """Return solved problems of the pipeline in a folder, saved and loaded again."""
    refinement = solve_plans(
        draw_boundary_problems(where / "pipeline.toml", n, seed=5), workers=1
    )
    save_plans(where / "plans.h5", refinement.plans)
    return load_plans(where / "plans.h5")


def valid_states(plans: Plans, step: float = 1e-3) -> list[np.ndarray]:
    """Return the states of valid plans every ``step`` [s], plan by plan."""
    verdicts = evaluate_plans(plans, workers=1).verdicts
    return [
        states(plans, index, step)
        for index, verdict in enumerate(verdicts)
        if verdict.valid
    ]


@pytest.mark.slow
@pytest.mark.parametrize("obstacles", some([KINDS, OBSTACLES]), ids=["kinds", "boxes"])
def test_valid_plans_are_free_of_collisions(tmp_path, obstacles):
    problem = load_problem(write_problem(tmp_path, obstacles=obstacles))
    write_pipeline(tmp_path)
    meshes = Meshes(problem, load_robot(problem), tmp_path)
    found = valid_states(
        solved(tmp_path, 12), step=2e-5
    )  # motions without limits take 10 ms
    assert len(found) >= 8
    assert min(map(len, found)) > 100
    tolerance = 1e-4  # m, of the problem
    for path in found:
        assert (
            min(min(meshes.distances(q)) for q in path[:: max(len(path) // 100, 1)])
            > -tolerance - 1e-6
        )


@pytest.mark.slow
def test_plans_may_be_required_to_stop_without_acceleration(tmp_path):
    write_problem(tmp_path)
    write_pipeline(tmp_path, stop='acceleration = "zero"')
    plans = solved(tmp_path, 3)
    assert all(verdict.valid for verdict in evaluate_plans(plans, workers=1).verdicts)
    motion = Motion(plans.path_control_points, plans.rate_control_points, plans.degree)
    assert np.abs(motion.at(np.array([1.0])).ddq).max() < 1e-8


@needs_robots
@pytest.mark.extended
def test_plans_of_a_panda_between_shelves_are_free_of_collisions(tmp_path):
    problem = load_problem(write_panda(tmp_path))
    meshes = Meshes(problem, load_robot(problem), folder())
    found = valid_states(solved(tmp_path, 40))
    assert len(found) >= 30
    assert not any(meshes.touches(q) for path in found for q in path)


@needs_robots
@pytest.mark.extended
def test_plans_of_a_panda_among_ten_obstacles_of_four_kinds_are_free_of_collisions(
    tmp_path,
):
    problem = load_problem(write_panda(tmp_path, obstacles=CLUTTER))
    meshes = Meshes(problem, load_robot(problem), folder())
    found = valid_states(solved(tmp_path, 100))
    assert len(found) >= 95
    assert not any(meshes.touches(q) for path in found for q in path)
