"""Verdicts on motions of a robot with link geometry: names of links, and violations between samples."""

import numpy as np
import pytest

from cnpgen.judges.plans.judge import judge
from cnpgen.problems.load_robot import load_robot
from cnpgen.problems.obstacles import scene_of
from cnpgen.problems.problem import Problem
from cnpgen.problems.problem_file import load_problem
from cnpgen.robots.robot import Robot
from cnpgen.trajectory.boundary import Boundary
from cnpgen.trajectory.spline_motion import Motion
from cnpgen.world.world import World
from tests.examples.shaped_robot import write_problem


@pytest.fixture(scope="module")
def crane(tmp_path_factory: pytest.TempPathFactory) -> tuple[Problem, Robot]:
    problem = load_problem(write_problem(tmp_path_factory.mktemp("crane")))
    return problem, load_robot(problem)


def straight(
    start: np.ndarray, goal: np.ndarray, speed: float
) -> tuple[Motion, Boundary]:
    """Return a straight line in joint space at a constant rate [1/s], with its ends as boundary conditions."""
    fraction = np.concatenate([np.zeros(1), np.cumsum(np.full(14, 1 / 14))])
    motion = Motion(
        (start + fraction[:, None] * (goal - start))[None], np.full((1, 20), speed)
    )
    ends = [motion.at(np.array([s])) for s in (0.0, 1.0)]
    start_q, start_dq, start_ddq = (
        getattr(ends[0], name)[:, 0] for name in ("q", "dq", "ddq")
    )
    return motion, Boundary(
        start_q, start_dq, start_ddq, ends[1].q[:, 0], ends[1].dq[:, 0]
    )


def verdict(
    crane: tuple[Problem, Robot], start: list[float], goal: list[float], step: float
):
    motion, boundary = straight(np.array(start), np.array(goal), 1.0)
    return judge(
        *crane,
        motion,
        boundary,
        scene_of(crane[0], np.zeros((1, 3)), np.zeros((1, 3))),
        np.zeros((1, 3)),
        step=step,
    )[0]


def test_a_motion_into_the_wall_is_invalid_with_link_and_obstacle(crane):
    found = verdict(crane, [1.5, -0.2, 0.4, 0.0], [0.0, 0.1, 0.4, 0.0], 1e-3)
    assert found.reason == "robot in collision"
    assert found.margins["robot clearance"].part.split(", ")[0] in (
        "arm",
        "fore",
        "hand",
        "claw",
    )
    assert found.margins["robot clearance"].part.endswith("wall")


def test_a_motion_into_the_base_is_invalid_with_both_links(crane):
    found = verdict(crane, [1.57, -0.2, 0.4, 0.0], [1.57, 0.6, 2.3, 0.0], 1e-3)
    assert found.reason == "robot in collision with itself"
    assert "base" in found.margins["self clearance"].part


def test_the_depth_between_samples_is_found(crane):
    """The results with steps of 10 ms and 0.1 ms agree."""
    ends = [0.9, -0.5, 0.3, 0.0], [-0.9, 0.3, 0.9, 2.0]
    coarse, fine = (
        verdict(crane, *ends, step).margins["robot clearance"] for step in (1e-2, 1e-4)
    )
    assert coarse.value == pytest.approx(fine.value, abs=1e-5)
    assert 0.0 < coarse.time < 1.0


def test_a_margin_agrees_with_the_world_at_its_phase(crane):
    motion, boundary = straight(
        np.array([1.57, -0.2, 0.4, 0.0]), np.array([1.0, 0.2, 0.6, 0.3]), 1.0
    )
    tip = np.zeros((1, 3))
    (found,) = judge(*crane, motion, boundary, scene_of(crane[0], tip, tip), tip)
    problem, robot = crane
    world, zero = World(robot, problem.obstacle), np.zeros(robot.n)
    for name, what in (
        ("robot clearance", "shape_distances"),
        ("self clearance", "self_distances"),
    ):
        margin = found.margins[name]
        q = motion.at(np.array([margin.phase])).q[0, 0]
        world.set_state(np.ascontiguousarray(q), zero, zero, np.array([0.3, 0.9]))
        assert min(getattr(world, what)()) == pytest.approx(margin.value, abs=1e-7)
