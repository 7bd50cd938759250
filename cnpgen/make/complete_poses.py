"""Tasks of a robot's problem: from a start at rest to a pose of the tip, with tolerances and free axes."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from cnpgen.errors import UsageError, lacks
from cnpgen.make.goal_poses import POSE_REASON, POSE_SEEDS, EndConditions, states_of_pose
from cnpgen.pipelines.families.resting_states import RestingStates
from cnpgen.plans.format import GOAL_OPTION
from cnpgen.plans.plans import Plans, make_plans
from cnpgen.problems.load_robot import load_robot
from cnpgen.problems.problem import Problem
from cnpgen.problems.problem_file import load_problem
from cnpgen.problems.problem_record import record_problem
from cnpgen.problems.scenes.quaternions import quaternion_mistake, rotation_matrix
from cnpgen.problems.scenes.scene_problem import GoalPose
from cnpgen.schema.catalogue import list_recipes
from cnpgen.schema.toml import kind_of_file
from cnpgen.schema.units import PLAUSIBLE_MAX, suggested_unit
from cnpgen.store.field import Field
from cnpgen.trajectory.boundary import Boundary
from cnpgen.world.pose_ik import PoseKinematics

Array = NDArray[np.float64]

START_REASON = "start in collision, outside its limits or off a constraint"
GOAL_REASON = "all goal states in collision or off a constraint"


def problem_of_poses(recipe: object) -> Problem | None:
    """Return the problem if an argument is one, or the name or the file of one; otherwise None.

    Raises:
        RecipeError: The file has mistakes.
    """
    if isinstance(recipe, Problem):
        return recipe
    if not isinstance(recipe, str | Path):
        return None
    if Path(recipe).is_file():
        return load_problem(recipe) if kind_of_file(Path(recipe)) == "problem" else None
    others = {**list_recipes("dataset"), **list_recipes("pipeline")}
    return load_problem(recipe) if str(recipe) in list_recipes("problem").keys() - others.keys() else None


class PoseTasks:
    """Tasks of a problem, with its obstacles, whose goals are poses of the tip.

    Attributes:
        robot: Its robot.
        fields: Columns that tasks may have: name -> field.
    """

    def __init__(self, problem: Problem) -> None:
        self._problem, self.robot = problem, load_robot(problem)
        joints, axes = self.robot.joint_names, ("x", "y", "z")
        unit = self.robot.units("rad")
        fields = (
            Field("start_q", unit, "joint positions at the start, at rest", len(joints), joints),
            Field("goal_xyz", "m", "position of the tip at the goal", 3, axes),
            Field("goal_wxyz", "1", "quaternion of the tip's axes at the goal", 4, ("w", *axes)),
            Field("goal_xyz_tolerance", "m", "accepted displacements along the axes of the goal pose", 3, axes),
            Field("goal_rotation_tolerance", "1", "accepted rotation vector in these axes [rad]", 3, axes),
        )
        self.fields = {field.name: field for field in fields}
        self._kinematics = PoseKinematics(self.robot)
        self._conditions = EndConditions(problem, self.robot)
        self._states = None if self.robot.shape is None else RestingStates(problem, self.robot)

    def check(self, names: Mapping[str, object]) -> None:
        """Raise UsageError for a column that tasks cannot have, or without goal positions."""
        for name in names:
            if name not in self.fields:
                what = lacks("column to give", name, self.fields)
                raise UsageError(f"the problem {self._problem.name!r} {what}", concerns=name)
        if "goal_xyz" not in names:
            raise UsageError("tasks must give goal_xyz, the tip position of the goal", concerns="goal_xyz")

    def complete(self, rows: Mapping[str, Array]) -> tuple[Plans, tuple[str, ...]]:
        """Compute goal states of N tasks independently of each other.

        Args:
            rows: Name -> values, shape (N, width) or (1, width) for all tasks.

        Returns:
            The goal states of all tasks as boundary problems, at most ``MAX_GOAL_STATES`` for each, the nearest
            first; and the reason of each task without any.
        """
        count = max(map(len, rows.values()))
        given = {name: np.broadcast_to(values, (count, values.shape[1])) for name, values in rows.items()}
        given.setdefault("start_q", np.broadcast_to(self.robot.base, (count, self.robot.n)))
        found = [self._goals(task, given) for task in range(count)]
        reasons = tuple(goals if isinstance(goals, str) else "" for goals in found)
        states = [np.empty((0, self.robot.n)) if isinstance(goals, str) else goals for goals in found]
        goal, tasks = np.concatenate(states), np.repeat(np.arange(count), [len(each) for each in states])
        numbers = np.concatenate([np.arange(len(each), dtype=float) for each in states])
        spec, zero, start = self._problem.trajectory, np.zeros_like(goal), given["start_q"][tasks]
        plans = make_plans(
            record_problem(self._problem),
            Boundary(start, zero, zero, goal, zero, None),
            path_control_points=np.full((len(goal), spec.path_control_points, self.robot.n), np.nan),
            rate_control_points=np.full((len(goal), spec.rate_control_points), np.nan),
            columns={GOAL_OPTION: numbers},
            sample_id=tasks,
            source=f"goal poses of {self._problem.name}",
        )
        return plans, reasons

    def _goals(self, task: int, given: Mapping[str, Array]) -> Array | str:
        """Return the goal states of a task, shape (G, n), or the reason why there are none."""
        start, pose = given["start_q"][task], self._pose(task, given)
        clear = self._states is None or self._states.are_ends(start[:, None])[0]
        if not (clear and self._conditions.met(start[:, None])[0]):
            return START_REASON
        random = np.random.default_rng(POSE_SEEDS)
        checks = self._states, self._conditions
        goals, found = states_of_pose(self._kinematics, *checks, pose, start=start, random=random)
        if not len(found):
            return POSE_REASON
        return goals if len(goals) else GOAL_REASON

    def _pose(self, task: int, given: Mapping[str, Array]) -> GoalPose:
        """Return the goal pose of a task; without an orientation, any is accepted."""
        wxyz = given["goal_wxyz"][task] if "goal_wxyz" in given else np.array([1.0, 0.0, 0.0, 0.0])
        if text := quaternion_mistake(wxyz):
            raise UsageError(f"{text} in task {task}", argument="goal_wxyz")
        free = np.zeros(3) if "goal_wxyz" in given else np.full(3, np.pi)
        tolerances = {"goal_xyz_tolerance": np.zeros(3), "goal_rotation_tolerance": free}
        for name in tolerances.keys() & given.keys():
            tolerances[name] = given[name][task]
            unit = "m" if name == "goal_xyz_tolerance" else "rad"
            if (largest := float(tolerances[name].max())) > (limit := PLAUSIBLE_MAX[unit]):
                hint = suggested_unit(largest, unit, high=limit)
                text = f"must be at most {limit:.4g} {unit}, got {tolerances[name]} in task {task}{hint}"
                raise UsageError(text, argument=name)
            if (tolerances[name] < 0).any():
                raise UsageError(f"must not be negative, got {tolerances[name]} in task {task}", argument=name)
        return GoalPose("", given["goal_xyz"][task], rotation_matrix(wxyz), *tolerances.values())
