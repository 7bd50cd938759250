"""Narrow passages for the crane of ``shaped_robot``: two boxes with poses, so that kernels are compiled once."""

from functools import cache
from pathlib import Path

import numpy as np

from cnpgen.problems.load_robot import load_robot
from cnpgen.problems.obstacles import scene_of
from cnpgen.problems.problem import Problem
from cnpgen.problems.problem_file import load_problem
from cnpgen.refine.refiner import Refiner
from cnpgen.refine.task import RefinementTask
from cnpgen.trajectory.boundary import Boundary
from tests.examples.shaped_robot import write_problem

BOXES = """
[[obstacle]]
name = "one"
position = {}
size = {}
[[obstacle]]
name = "other"
position = {}
size = {}
"""
# The hulls have a clearance of 1 mm on either side in the slot.
SLOT = BOXES.format(
    [0.75, 0.0, 0.3478], [0.5, 1.4, 0.1], [0.75, 0.0, 0.571], [0.5, 1.4, 0.1]
)
WALL = BOXES.format(
    [0.55, 0.0, 0.4], [0.9, 0.06, 0.8], [-2.0, 0.0, 0.4], [0.1, 0.1, 0.1]
)
LIMITS = """
[[constraint]]
use = "joint-velocity"
tolerance = "0.2 %"
[[constraint]]
use = "self-clearance"
tolerance = "0.1 mm"
"""
IN_SLOT = np.array([[-0.6, -0.3, 0.3, 0.0], [0.6, -0.3, 0.3, 0.0]])
BESIDE_WALL = np.array([[-0.8, -0.1, 0.4, 0.0], [0.8, -0.1, 0.4, 0.0]])


def narrow(folder: Path, obstacles: str) -> Problem:
    """Return the problem of the crane among two boxes."""
    return load_problem(write_problem(folder, obstacles=obstacles, more=LIMITS))


@cache
def refiner(problem: Problem) -> Refiner:
    """Return the refiner of a problem."""
    return Refiner(problem, load_robot(problem))


def between(problem: Problem, ends: np.ndarray) -> RefinementTask:
    """Return the task of moving from one configuration to another, from rest to rest."""
    (start, goal), rest = ends[:, None], np.zeros((1, ends.shape[1]))
    boundary = Boundary(start, rest, rest, goal, rest)
    return RefinementTask(
        boundary,
        scene_of(problem, np.zeros((1, 3)), np.zeros((1, 3))),
        np.zeros(3),
        np.zeros(3),
    )
