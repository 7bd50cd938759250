"""Verdicts on motions of a robot that has a shape: named by link, and true between the moments that are looked at."""

import numpy as np
import pytest

from cnpgen.judges.plans.judge import judge
from cnpgen.problems.load import load_problem
from cnpgen.problems.problem import Problem
from cnpgen.problems.robot import load_robot
from cnpgen.robots.robot import Robot
from cnpgen.trajectory.boundary import Boundary
from cnpgen.trajectory.motion import Motion
from cnpgen.world.state import World
from tests.examples.shaped_robot import write_problem


@pytest.fixture(scope="module")
def crane(tmp_path_factory: pytest.TempPathFactory) -> tuple[Problem, Robot]:
    problem = load_problem(write_problem(tmp_path_factory.mktemp("crane")))
    return problem, load_robot(problem)


def straight(start: np.ndarray, goal: np.ndarray, speed: float) -> tuple[Motion, Boundary]:
    """A straight line in the joints at a constant rate [1/s], whose ends are its own boundary conditions."""
    share = np.concatenate([np.zeros(1), np.cumsum(np.full(14, 1 / 14))])
    motion = Motion((start + share[:, None] * (goal - start))[None], np.full((1, 20), speed))
    ends = [motion.at(np.array([s])) for s in (0.0, 1.0)]
    start_q, start_dq, start_ddq = (getattr(ends[0], what)[:, 0] for what in ("q", "dq", "ddq"))
    return motion, Boundary(start_q, start_dq, start_ddq, ends[1].q[:, 0], ends[1].dq[:, 0])


def verdict(crane: tuple[Problem, Robot], start: list[float], goal: list[float], step: float):
    motion, boundary = straight(np.array(start), np.array(goal), 1.0)
    return judge(*crane, motion, boundary, np.zeros((1, 3)), np.zeros((1, 3)), step=step)[0]


def test_a_motion_into_the_wall_is_refused_with_link_and_obstacle(crane):
    found = verdict(crane, [1.5, -0.2, 0.4, 0.0], [0.0, 0.1, 0.4, 0.0], 1e-3)
    assert found.reason == "robot in collision"
    assert found.margins["robot clearance"].part.split(", ")[0] in ("arm", "fore", "hand", "claw")
    assert found.margins["robot clearance"].part.endswith("wall")


def test_a_motion_into_the_base_is_refused_with_both_links(crane):
    found = verdict(crane, [1.57, -0.2, 0.4, 0.0], [1.57, 0.6, 2.3, 0.0], 1e-3)
    assert found.reason == "robot in collision with itself"
    assert "base" in found.margins["self clearance"].part


def test_the_depth_between_two_moments_is_found(crane):
    """What is found at 10 ms is what is found at 0.1 ms."""
    ends = [0.9, -0.5, 0.3, 0.0], [-0.9, 0.3, 0.9, 2.0]
    coarse, fine = (verdict(crane, *ends, step).margins["robot clearance"] for step in (1e-2, 1e-4))
    assert coarse.value == pytest.approx(fine.value, abs=1e-5)
    assert 0.0 < coarse.time < 1.0


def test_a_margin_is_what_the_world_measures_at_its_moment(crane):
    motion, boundary = straight(np.array([1.57, -0.2, 0.4, 0.0]), np.array([1.0, 0.2, 0.6, 0.3]), 1.0)
    (found,) = judge(*crane, motion, boundary, np.zeros((1, 3)), np.zeros((1, 3)))
    problem, robot = crane
    world, zero = World(robot, problem.obstacle), np.zeros(robot.n)
    for name, what in (("robot clearance", "shape_distances"), ("self clearance", "self_distances")):
        margin = found.margins[name]
        q = motion.at(np.array([margin.phase])).q[0, 0]
        world.set_state(np.ascontiguousarray(q), zero, zero, np.array([0.3, 0.9]))
        assert min(getattr(world, what)()) == pytest.approx(margin.value, abs=1e-7)
