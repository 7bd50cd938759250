"""The verdict on one task's plan, in the form in which refining asks for it."""

from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from cnpgen.judges.plans.judge import Judge
from cnpgen.judges.plans.verdict import Verdict
from cnpgen.problems.problem import Problem
from cnpgen.refine.task import Task
from cnpgen.trajectory.boundary import Boundary
from cnpgen.trajectory.motion import Motion

if TYPE_CHECKING:
    from cnpgen.robots.robot import Robot

Array = NDArray[np.float64]


class Jury:
    """Decides whether plans of a problem are valid.

    Args:
        problem: The problem.
        robot: Its robot.
        degree: Degree of the plans' splines.
    """

    def __init__(self, problem: Problem, robot: "Robot", *, degree: int) -> None:
        self._judge, self._degree = Judge(problem, robot), degree

    def verdict(self, task: Task, path: Array, rate: Array) -> Verdict:
        """Judge path control points (C, n) and rate control points (R,) as a plan of the task, briefly."""
        return self._judge(*self._arguments(task, path, rate), brief=True)[0]

    def refutes(self, task: Task, path: Array, rate: Array) -> bool:
        """Whether a few samples show already that such a plan is not valid."""
        return self._judge.refutes(*self._arguments(task, path, rate))[0]

    def _arguments(self, task: Task, path: Array, rate: Array) -> tuple[Motion, Boundary, Array, Array]:
        return Motion(path[None], rate[None], self._degree), task.boundary, task.start_xyz[None], task.goal_xyz[None]
