"""Problems of scenes as training rows: exact symmetries multiply the training rows."""

from __future__ import annotations

import hashlib
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from cnpgen.errors import UsageError
from cnpgen.planner.control_points import ControlPoints
from cnpgen.plans.format import OBSTACLE_POSES
from cnpgen.plans.scene_plans import scene_plans
from cnpgen.problems.problem import Problem
from cnpgen.problems.problem_record import ProblemRecord
from cnpgen.problems.scenes.scene_problem import SceneProblem
from cnpgen.training.training_rows import TrainingProblems
from cnpgen.trajectory.boundary import Boundary

Array = NDArray[np.float64]

VALIDATION_SHARE = 0.05  # of the problems, the last ones
MAX_VALIDATION_ROWS = 200  # verdicts among obstacles take a quarter of a second
MIN_SCENE_ROWS = 40


@dataclass(frozen=True)
class SceneRows:
    """Problems of scenes to train on; see ``TrainingData``.

    The training rows are the problems and their reverses, from the goal to the start.

    Attributes:
        problem: The robot's problem with parked obstacles for the largest scene.
        boundary: Boundary conditions of all problems, shape (N, n) each.
        obstacle_poses: Poses and sizes of their obstacles, shape (N, width).
        place: File of the scenes.
    """

    problem: ProblemRecord
    boundary: Boundary
    obstacle_poses: Array
    place: str

    @property
    def stages(self) -> list[dict[str, Any]]:
        """See ``TrainingData``."""
        return []

    @property
    def _first_validation(self) -> int:
        count = len(self.boundary)
        return count - min(round(VALIDATION_SHARE * count), MAX_VALIDATION_ROWS)

    def training(self) -> TrainingProblems:
        """See ``TrainingData``."""
        forward = self._rows(0, self._first_validation)
        start, goal = forward.boundary.start_q, forward.boundary.goal_q
        zero = np.zeros((2 * len(start), start.shape[1]))
        there, back = np.concatenate([start, goal]), np.concatenate([goal, start])
        assert forward.obstacle_poses is not None
        return TrainingProblems(Boundary(there, zero, zero, back, zero), np.tile(forward.obstacle_poses, (2, 1)))

    def checked(self, rows: int) -> TrainingProblems:
        """See ``TrainingData``."""
        return self._rows(self._first_validation, self._first_validation + self._checks(rows))

    def judged(self, rows: int, *, after: int) -> TrainingProblems:
        """See ``TrainingData``."""
        first = self._first_validation + self._checks(after)
        return self._rows(first, first + rows)

    def _checks(self, rows: int) -> int:
        return min(rows, (len(self.boundary) - self._first_validation) // 2)

    def _rows(self, first: int, stop: int) -> TrainingProblems:
        rows = slice(first, min(stop, len(self.boundary)))
        return TrainingProblems(self.boundary[rows], self.obstacle_poses[rows])

    def demonstrations(self, joints: int) -> ControlPoints | None:  # noqa: ARG002 - part of the protocol
        """Return None: scene files contain no plans."""
        return None

    def describe(self) -> dict[str, Any]:
        """See ``TrainingData``."""
        digest = hashlib.sha256()
        for values in (self.boundary.start_q, self.boundary.goal_q, self.obstacle_poses):
            digest.update(np.ascontiguousarray(values).tobytes())
        return {"name": self.place, "fingerprint": digest.hexdigest(), "rows": {"scenes": len(self.boundary)}}


def make_scene_rows(problem: Problem, scenes: Sequence[SceneProblem], place: str) -> SceneRows:
    """Make training rows of scenes.

    Args:
        problem: The robot's problem.
        scenes: The scenes; the last ones validate models, so that they should be of other scenes than the others.
        place: File of the scenes.

    Raises:
        SceneError: A scene does not fit the robot.
        UsageError: There are too few scenes, or the problem has no constraint ``robot-clearance``.
    """
    if len(scenes) < MIN_SCENE_ROWS:
        raise UsageError(
            f"{place} has {len(scenes)} problems, expected at least {MIN_SCENE_ROWS} to train and validate",
            concerns="folder",
        )
    plans = scene_plans(problem, scenes)
    return SceneRows(plans.problem, plans.boundary, plans.columns[OBSTACLE_POSES], place)
