"""Passes on the links' hulls: right derivatives, and a way where capsules see none."""

import numpy as np
import pytest

from cnpgen.problems.load import load_problem
from cnpgen.problems.robot import load_robot
from cnpgen.refine.jury import Jury
from cnpgen.refine.solver.hulls import NEAR, Hulls, keeps_clear
from cnpgen.refine.solver.sqp import DEFAULT
from cnpgen.refine.task import Attempt, Outcome
from cnpgen.robots.solid import place_obstacles
from cnpgen.trajectory.motion import Motion
from tests.conftest import needs_compiler
from tests.examples.meshes import Meshes
from tests.examples.narrow import IN_SLOT, SLOT, between, narrow, refiner
from tests.examples.shaped_robot import KINDS, OBSTACLES, write_problem

STEP = 1e-6  # rad, of finite differences


@pytest.mark.parametrize("obstacles", [KINDS, OBSTACLES], ids=["kinds", "boxes"])
def test_slopes_are_those_of_the_distances(tmp_path, obstacles):
    problem = load_problem(write_problem(tmp_path, obstacles=obstacles))
    robot = load_robot(problem)
    hulls, tops = Hulls(problem, robot), place_obstacles(problem.obstacle)
    q = np.random.default_rng(0).uniform(robot.position_lower, robot.position_upper, (40, robot.n)).T.copy()
    distances, contacts = hulls.near(q, tops)
    slopes = hulls.slopes(q, distances, contacts)
    compared = 0
    for joint, step in enumerate(STEP * np.eye(robot.n)[..., None]):
        ends = [hulls.near(q + side * step, tops)[0] for side in (1, -1)]
        near = (np.array([distances, *ends]) < hulls.least + NEAR).all(axis=0)
        found = (ends[0] - ends[1]) / (2 * STEP)
        assert np.abs(found - slopes[joint].T)[near].max() < 1e-6
        compared += near.sum()
    assert compared > 150


def test_distances_are_those_of_meshes(tmp_path):
    problem = load_problem(write_problem(tmp_path))
    robot = load_robot(problem)
    hulls, meshes = Hulls(problem, robot), Meshes(problem, robot, tmp_path)
    q = np.random.default_rng(1).uniform(robot.position_lower, robot.position_upper, (400, robot.n))
    tops = place_obstacles(problem.obstacle)
    expected = np.array([min(meshes.distances(each)) for each in q])
    found = hulls.near(q.T.copy(), tops)[0].min(axis=1)
    apart = (expected > 0) & (expected < NEAR)
    assert apart.sum() > 15
    assert np.abs(found - expected)[apart].max() < 1e-4  # round pieces are prisms
    assert (found[expected > NEAR + 1e-4] == NEAR).all()
    assert np.array_equal(hulls.clear(q.T.copy(), tops), found >= 0)
    assert hulls.depth(q.T.copy(), tops) == -found.min()


def test_positions_that_are_no_numbers_have_no_distances(tmp_path):
    problem = load_problem(write_problem(tmp_path))
    robot = load_robot(problem)
    q = np.where(np.arange(3) == 1, np.nan, 0.0) + np.zeros((robot.n, 1))
    assert np.isnan(Hulls(problem, robot).near(q, place_obstacles(problem.obstacle))[0]).all()


@pytest.mark.slow
@needs_compiler
def test_where_an_end_is_inside_an_obstacle_nothing_is_tried(tmp_path):
    problem = narrow(tmp_path, SLOT)
    tool, inside = refiner(problem), between(problem, np.add(IN_SLOT, [0.0, 0.0, 0.1, 0.0]))
    best = Attempt(tool.straight(inside), 0.0, 1.0, Outcome.SOLVED)
    assert list(tool._around(inside, best)) == []


def test_robots_without_a_shape_have_no_hulls(tmp_path):
    shaped = load_problem(write_problem(tmp_path))
    assert keeps_clear(shaped, load_robot(shaped))
    paper = 'geometry = "paper-capsules"'
    bare = load_problem(write_problem(tmp_path, robot=paper, clearance='radius = "5 cm"', more=""))
    assert not keeps_clear(bare, load_robot(bare))


@pytest.mark.slow
@needs_compiler
def test_a_slot_that_is_too_narrow_for_capsules_is_wide_enough_for_hulls(tmp_path):
    problem = narrow(tmp_path, SLOT)
    robot, tool, task = load_robot(problem), refiner(problem), between(problem, IN_SLOT)
    hulls, jury, start = Hulls(problem, robot), Jury(problem, robot, degree=tool.spec.degree), tool.straight(task)
    capsules = tool.minimise(task, tool.passes.given, start)
    assert capsules.violation > 0.01  # 1 mm
    found = tool.minimise(task, tool.passes.given, start, hulls)
    assert found.violation < DEFAULT.violation_tolerance
    path, rate = tool.check.transcription(task).unpack(found.x)
    assert jury.verdict(task, path, rate).valid
    states = Motion(path[None], rate[None], tool.spec.degree).at(np.linspace(0, 1, 300)).q[0]
    meshes = Meshes(problem, robot, tmp_path)
    assert min(min(meshes.distances(q)) for q in states) > -1e-4  # what the problem allows
