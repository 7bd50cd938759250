"""Goal poses: batched inverse kinematics, the valid states with the fastest straight line, and tasks of goal poses."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np

from cnpgen.arrays import Array, Columns, Mask
from cnpgen.errors import UsageError, lacks
from cnpgen.pipelines.resting_states import RestingStates, seeds_of
from cnpgen.plans.boundary_problems import plans_of_rows
from cnpgen.plans.format import GOAL_OPTION
from cnpgen.plans.plans import Plans
from cnpgen.problems.constraints.clearance import ObjectContact, RobotClearance
from cnpgen.problems.constraints.link_clearance import SelfClearance
from cnpgen.problems.load_robot import load_robot
from cnpgen.problems.obstacles import scene_of
from cnpgen.problems.problem import Problem
from cnpgen.problems.problem_file import load_problem
from cnpgen.problems.problem_record import record_problem
from cnpgen.problems.scenes.quaternions import quaternion_error, rotation_matrix
from cnpgen.problems.scenes.scene_problem import GoalPose
from cnpgen.robots.obstacle import Obstacle
from cnpgen.robots.robot import Robot
from cnpgen.schema.catalogue import list_recipes
from cnpgen.schema.toml import kind_of_file
from cnpgen.schema.units import PLAUSIBLE_MAX, suggested_unit
from cnpgen.store.field import Field
from cnpgen.world.pose_ik import PoseKinematics, PoseTolerance, solve_pose_ik
from cnpgen.world.world import World

MAX_GOAL_STATES = 5  # of one task that are tried, the nearest first
MAX_TREE_GOALS = 16  # of a scene with a time limit, which one tree has as roots
POSE_REASON = "no inverse kinematics of the goal"
POSE_SEEDS = 128  # of the inverse kinematics of a goal pose
# Rad or m, of two goal states with one pose in their farthest joint.
MIN_DIFFERENCE_RAD = 0.3
START_REASON = "start in collision, outside its limits or off a constraint"
GOAL_REASON = "all goal states in collision or off a constraint"


class EndConditions:
    """Conditions of a problem on states at rest, except for distances of links, which ``RestingStates`` checks."""

    def __init__(
        self, problem: Problem, robot: Robot, obstacles: Sequence[Obstacle] = ()
    ) -> None:
        placed = (
            problem.with_obstacles((*problem.obstacle, *obstacles))
            if obstacles
            else problem
        )
        others = RobotClearance | SelfClearance
        if any(obstacle.below for obstacle in placed.obstacle):
            # Their places depend on both ends.
            others |= ObjectContact
        self._constraints = [
            constraint
            for constraint in placed.constraint
            if not isinstance(constraint, others)
        ]
        self._world = World(robot, placed.obstacle, placed.object_size)
        zero = np.zeros((1, 3))
        # Built-in constraints on obstacles below an end are left out, so that the place
        # of the ends does not matter.
        self._poses = scene_of(placed, zero, zero, zero).poses[0]

    def met(self, q: Array) -> Mask:
        """Return which joint positions (n, K) meet the conditions within their tolerances, shape (K,)."""
        return np.array([self._are_met(state) for state in q.T], bool)

    def _are_met(self, q: Array) -> bool:
        self._world.set_state(q, np.zeros_like(q), np.zeros_like(q), self._poses)
        for constraint in self._constraints:
            for condition in constraint.measured(self._world):
                # max(lower - g, g - upper): positive outside the bounds.
                violation = np.maximum(
                    condition.lower - condition.g, condition.g - condition.upper
                )
                if (violation > constraint.allowed(condition)).any():
                    return False
        return True


def states_of_pose(
    kinematics: PoseKinematics,
    states: RestingStates | None,
    conditions: EndConditions,
    pose: GoalPose,
    *,
    start: Array,
    random: np.random.Generator,
    most: int = MAX_GOAL_STATES,
) -> tuple[Array, Array]:
    """Return joint positions [rad] that can end a motion, nearest to the start (n,) first, and all with a goal pose.

    The shapes are (G, n) and (H, n). Robots without link geometry have no ``states`` of
    rest in a scene. ``random`` draws the seeds.
    """
    positions = np.tile(pose.position, (POSE_SEEDS, 1))
    rotations = np.tile(pose.rotation, (POSE_SEEDS, 1, 1))
    tolerances = [
        np.tile(np.broadcast_to(each, 3), (POSE_SEEDS, 1)) for each in pose.tolerances
    ]
    tolerance = (
        PoseTolerance(*tolerances) if any(each.any() for each in tolerances) else None
    )
    seeds = seeds_of(kinematics.robot, POSE_SEEDS, random)
    q, met = solve_pose_ik(kinematics, positions, rotations, seeds, tolerance=tolerance)
    # The cheap checks first: inverse kinematics, distances of links, then all other
    # conditions state by state.
    found = q[:, met]
    valid = found if states is None else found[:, states.are_ends(found)]
    valid = valid[:, conditions.met(valid)]
    return nearest_states(
        valid.T,
        start,
        kinematics.robot,
        min_difference=MIN_DIFFERENCE_RAD,
        most=most,
    ), found.T.copy()


def nearest_states(
    states: Array,
    start: Array,
    robot: Robot,
    *,
    min_difference: float = 0.0,
    most: int = MAX_GOAL_STATES,
) -> Array:
    """Return at most ``most`` states [rad], shape (G, n), the nearest to the start, shape (n,), first.

    The distance is the duration of the straight line at full speed. A state is left out
    if its farthest joint differs less than ``min_difference`` from a nearer state.
    """
    # Time of the straight line at the velocity limits: max over joints of |q - start| /
    # v_max.
    duration = (np.abs(states - start) / robot.velocity_limit).max(axis=1)
    chosen = list[Array]()
    # Stable: equal durations keep the order of the seeds, on every machine.
    for index in np.argsort(duration, kind="stable"):
        if len(chosen) == most:
            break
        if all(
            np.abs(states[index] - other).max() >= min_difference for other in chosen
        ):
            chosen.append(states[index])
    return np.array(chosen).reshape(-1, states.shape[1])


def problem_of_poses(recipe: object) -> Problem | None:
    """Return the problem if an argument is one, or the name or the file of one.

    Otherwise None.
    """
    if isinstance(recipe, Problem):
        return recipe
    if not isinstance(recipe, str | Path):
        return None
    if Path(recipe).is_file():
        return load_problem(recipe) if kind_of_file(Path(recipe)) == "problem" else None
    others = {**list_recipes("dataset"), **list_recipes("pipeline")}
    return (
        load_problem(recipe)
        if str(recipe) in list_recipes("problem").keys() - others.keys()
        else None
    )


class PoseTasks:
    """Tasks of a problem, with its obstacles, whose goals are poses of the tip.

    Attributes:
        robot: Its robot.
        fields: Columns that tasks may have: name -> field.
    """

    def __init__(self, problem: Problem) -> None:
        self._problem = problem
        self.robot = load_robot(problem)
        joints = self.robot.joint_names
        axes = ("x", "y", "z")
        unit = self.robot.units("rad")
        start = "joint positions at the start, at rest"
        fields = (
            Field("start_q", unit, start, len(joints), joints),
            Field("goal_xyz", "m", "position of the tip at the goal", 3, axes),
            Field(
                "goal_wxyz",
                "1",
                "quaternion of the tip's axes at the goal",
                4,
                ("w", *axes),
            ),
            Field(
                "goal_xyz_tolerance",
                "m",
                "accepted displacements along the axes of the goal pose",
                3,
                axes,
            ),
            Field(
                "goal_rotation_tolerance",
                "1",
                "accepted rotation vector in these axes [rad]",
                3,
                axes,
            ),
        )
        self.fields = {field.name: field for field in fields}
        self._kinematics = PoseKinematics(self.robot)
        self._conditions = EndConditions(problem, self.robot)
        self._states = (
            None if self.robot.shape is None else RestingStates(problem, self.robot)
        )

    def check(self, names: Mapping[str, object]) -> None:
        """Raise UsageError for a column that tasks cannot have, or without goal positions."""
        for name in names:
            if name not in self.fields:
                what = lacks("column to give", name, self.fields)
                raise UsageError(
                    f"the problem {self._problem.name!r} {what}", concerns=name
                )
        if "goal_xyz" not in names:
            raise UsageError(
                "tasks must give goal_xyz, the tip position of the goal",
                concerns="goal_xyz",
            )

    def complete(self, columns: Mapping[str, Array]) -> tuple[Plans, tuple[str, ...]]:
        """Compute goal states of N tasks, columns of shape (N, width) or (1, width), independently of each other.

        The goal states of all tasks are boundary problems, at most ``MAX_GOAL_STATES``
        for each, the nearest first. Tasks without any have a reason.
        """
        count = max(map(len, columns.values()))
        given = {
            name: np.broadcast_to(values, (count, values.shape[1]))
            for name, values in columns.items()
        }
        given.setdefault(
            "start_q", np.broadcast_to(self.robot.home, (count, self.robot.n))
        )
        found = [self._goals(task, given) for task in range(count)]
        reasons = tuple(goals if isinstance(goals, str) else "" for goals in found)
        states = [
            np.empty((0, self.robot.n)) if isinstance(goals, str) else goals
            for goals in found
        ]
        goal = np.concatenate(states)
        tasks = np.repeat(np.arange(count), [len(each) for each in states])
        numbers = np.concatenate([np.arange(len(each), dtype=float) for each in states])
        rows: Columns = {
            name: np.zeros_like(goal) for name in ("start_dq", "start_ddq", "goal_dq")
        }
        rows |= {
            "start_q": given["start_q"][tasks],
            "goal_q": goal,
            GOAL_OPTION: numbers,
            "sample_id": tasks,
        }
        source = f"goal poses of {self._problem.name}"
        return plans_of_rows(
            record_problem(self._problem), rows, source=source
        ), reasons

    def _goals(self, task: int, given: Mapping[str, Array]) -> Array | str:
        """Return the goal states of a task, shape (G, n), or the reason why there are none."""
        start = given["start_q"][task]
        pose = self._pose(task, given)
        clear = self._states is None or self._states.are_ends(start[:, None])[0]
        if not (clear and self._conditions.met(start[:, None])[0]):
            return START_REASON
        # The same seeds for each task: its result does not depend on the other tasks.
        random = np.random.default_rng(POSE_SEEDS)
        checks = self._states, self._conditions
        goals, found = states_of_pose(
            self._kinematics, *checks, pose, start=start, random=random
        )
        if not len(found):
            return POSE_REASON
        return goals if len(goals) else GOAL_REASON

    def _pose(self, task: int, given: Mapping[str, Array]) -> GoalPose:
        """Return the goal pose of a task; without an orientation, any is accepted."""
        wxyz = (
            given["goal_wxyz"][task]
            if "goal_wxyz" in given
            else np.array([1.0, 0.0, 0.0, 0.0])
        )
        if text := quaternion_error(wxyz):
            raise UsageError(f"{text} in task {task}", argument="goal_wxyz")
        # A tolerance of pi about all axes accepts any rotation.
        free = np.zeros(3) if "goal_wxyz" in given else np.full(3, np.pi)
        tolerances = {
            "goal_xyz_tolerance": np.zeros(3),
            "goal_rotation_tolerance": free,
        }
        for name in tolerances.keys() & given.keys():
            tolerances[name] = given[name][task]
            unit = "m" if name == "goal_xyz_tolerance" else "rad"
            if (largest := float(tolerances[name].max())) > (
                limit := PLAUSIBLE_MAX[unit]
            ):
                hint = suggested_unit(largest, unit, high=limit)
                raise UsageError(
                    f"must be at most {limit:.4g} {unit}, got {tolerances[name]} in task {task}{hint}",
                    argument=name,
                )
            if (tolerances[name] < 0).any():
                raise UsageError(
                    f"must not be negative, got {tolerances[name]} in task {task}",
                    argument=name,
                )
        return GoalPose(
            "", given["goal_xyz"][task], rotation_matrix(wxyz), *tolerances.values()
        )
