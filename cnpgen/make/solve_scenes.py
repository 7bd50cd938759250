"""Plans for the problems of scene files: scenes of one structure share kernels, and all plans fit into one file."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from cnpgen.arrays import Array, Mask
from cnpgen.documents import JsonObject
from cnpgen.errors import UsageError, counted
from cnpgen.machine.engine import Engine
from cnpgen.machine.times import NO_TIME, Times
from cnpgen.make.goal_poses import (
    MAX_GOAL_STATES,
    MAX_TREE_GOALS,
    POSE_REASON,
    POSE_SEEDS,
    EndConditions,
    nearest_states,
    states_of_pose,
)
from cnpgen.pipelines.resting_states import RestingStates
from cnpgen.plans.format import GOAL_OPTION
from cnpgen.plans.join import concatenate
from cnpgen.plans.plans import Plans
from cnpgen.plans.scene_plans import (
    capacity_of,
    goal_states,
    goal_tolerances,
    scene_plans,
    start_state,
    with_wider_capacity,
)
from cnpgen.problems.load_robot import load_robot
from cnpgen.problems.obstacles import Capacity
from cnpgen.problems.problem import Problem
from cnpgen.problems.problem_record import as_problem, open_problem
from cnpgen.problems.scenes.placement import placed_scene
from cnpgen.problems.scenes.requested_problem import requested_problem
from cnpgen.problems.scenes.scene_problem import (
    GoalPose,
    SceneError,
    SceneProblem,
    check_scenes,
    checked_scene,
)
from cnpgen.refine.goal_options import Progress
from cnpgen.refine.options import DEFAULT_OPTIONS, RefineOptions
from cnpgen.refine.proof.explain import Explanation, Feasibility, explain_failure
from cnpgen.refine.refine_plans import refine_tasks
from cnpgen.refine.refinement import Refinement
from cnpgen.refine.task import Attempt
from cnpgen.robots.robot import Robot
from cnpgen.robots.scene import Scene
from cnpgen.robots.solid import place_obstacles
from cnpgen.schema.argument_types import check_fields, checked_arguments
from cnpgen.schema.old_keywords import with_old_keywords
from cnpgen.store.dataset_spec import StoredProblem
from cnpgen.world.pose_ik import PoseKinematics

TOLERANCE_SEEDS = 256  # random states within the tolerances of a goal in collision
POSE_EXPLANATION = f"{POSE_SEEDS} searches from random joint positions found none with the goal pose within the limits"


@dataclass(frozen=True)
class SceneOptions:
    """Options of ``solve_scenes`` beside those of refining.

    Attributes:
        payload: Mass of attached objects of unknown weight [kg].
        engine: Engine that runs the work, see ``refine_plans``.
        address: Address of the engine's cluster.
        begin: Called once before the first scene, with the number of scenes and 0.
        initial: Earlier plans, one for each scene in their order, as initial guesses:
            obstacles or ends may have moved a little since.
        smooth_stop: Whether motions end with zero acceleration, so that ``join_plans``
            accepts the next one.

    Raises:
        UsageError: A value has another type.
    """

    payload: float | None = None
    engine: str | None = None
    address: str | None = None
    begin: Callable[[int, int], None] | None = None
    initial: Plans | None = None
    smooth_stop: bool = False

    def __post_init__(self) -> None:
        check_fields(self)


@dataclass(frozen=True, eq=False)
class SolvedScenes:
    """Plans for the problems of N scenes.

    Attributes:
        scenes: The scenes.
        plans: The plans in the same order, all of one problem; ``obstacle_poses`` has
            the obstacles of each.
        results: Best attempt at every plan with its verdict.
        times: Times of the run.
    """

    scenes: tuple[SceneProblem, ...]
    plans: Plans
    results: tuple[Attempt, ...]
    times: Times = NO_TIME

    def __repr__(self) -> str:
        return f"<{counted(len(self.scenes), 'scene')} of {self.plans.problem.name!r}, {int(self.valid.sum())} solved>"

    @property
    def valid(self) -> Mask:
        """Mask of the scenes with a plan that the independent verdict accepts, shape (N,)."""
        return np.array([result.valid for result in self.results], bool)

    def summary(self) -> JsonObject:
        """Return a summary for JSON.

        Unsolved scenes have a name, a reason and an explanation.
        """
        facts = Refinement(self.plans, self.plans, self.results, self.times).summary()
        for failure in facts["not_valid"]:
            scene = self.scenes[failure["plan"]]
            explanation = Explanation(Feasibility.UNKNOWN, POSE_EXPLANATION)
            if failure["reason"] != POSE_REASON:
                explanation = self._explain(failure["plan"])
            failure |= {"scene": scene.name, "file": scene.source}
            failure |= {
                "finding": str(explanation.kind),
                "explanation": explanation.text,
            }
        return facts

    def _explain(self, index: int) -> Explanation:
        """Explain why a scene is not solved.

        Obstacles have the names of the scene, not those of the plans' problem.
        """
        problem, robot = open_problem(self.plans.problem)
        obstacles = self.scenes[index].obstacles
        names = {obstacle.name for obstacle in obstacles}
        own = (
            replace(each, name=f"{each.name} of the problem")
            if each.name in names
            else each
            for each in problem.own_obstacles
        )
        problem = replace(problem, obstacle=(*own, *obstacles))
        scene = Scene(problem.obstacle, place_obstacles(problem.obstacle)[None])
        return explain_failure(
            problem, robot, self.plans.boundary[index : index + 1], scene
        )


@checked_arguments
def solve_scenes(
    problem: Problem | StoredProblem | str | Path,
    scenes: Sequence[SceneProblem],
    *,
    options: RefineOptions = DEFAULT_OPTIONS,
    workers: int | None = None,
    journal: str | Path | None = None,
    discard: bool = False,
    progress: Progress | None = None,
    run: SceneOptions | None = None,
    **old_keywords: Any,
) -> SolvedScenes:
    """Plan the problems of scenes, which end at rest, with the limits and constraints of a robot's problem.

    Scenes with equal numbers of obstacles of each kind, rounded up to multiples of
    four, share compiled kernels. Of several goal states, the ``MAX_GOAL_STATES``
    collision-free ones with the fastest straight lines are tried, and the result is the
    best valid motion to any of them; with a time limit ``MAX_TREE_GOALS``, and the first
    valid motion. A goal pose without goal states gets some by
    inverse kinematics; a scene for which it finds none is not solved, with the reason
    "no inverse kinematics of the goal".

    ``problem`` is the robot's problem, such as "panda"; obstacles of the scenes are
    added to its own. Requests change it: scaling factors multiply its limits, and
    attached objects become links. ``run`` has the mass of attached objects of unknown
    weight, the engine and others; its fields are also accepted as keywords of version
    1.0 (``old_keywords``). The other arguments are those of ``refine_plans``. The names
    of the journals are that of ``journal`` with a number.

    Raises:
        SceneError: A scene does not fit the robot.
        UsageError: There are no scenes, or the problem has no constraint
            ``robot-clearance``.
        MachineError: See ``refine_plans``.
    """
    chosen = with_old_keywords(
        "solve_scenes", run, SceneOptions(), old_keywords, keyword="run"
    )
    check_scenes(scenes)
    loaded, robot, scenes = _requested(as_problem(problem), scenes, chosen)
    goals = _goals_of_all(loaded, robot, scenes, options)
    if chosen.begin is not None:
        chosen.begin(len(scenes), 0)
    # Scenes of one capacity share kernels; each group has its own journal.
    groups = _groups(scenes)
    journals = _journals(journal, len(groups))
    refine = _refiner(chosen, progress, options, workers=workers, discard=discard)
    found = dict[int, tuple[Plans, Attempt]]()
    times = NO_TIME
    for (own, indices), file in zip(groups, journals, strict=True):
        of_group = {index: goals[index] for index in indices}
        plans = _adjusted(_plans_of(loaded, scenes, of_group, own), chosen)
        refinement = refine(plans, journal=file)
        times += refinement.times
        # Plans of one file have the same obstacles: smaller groups get parked ones.
        wide = with_wider_capacity(refinement.plans, loaded, own, capacity_of(scenes))
        found |= _found(of_group, wide, refinement.results)
    every, results = zip(*(found[index] for index in range(len(scenes))), strict=True)
    # The journals serve to resume; a finished run needs none.
    for file in filter(None, journals):
        file.unlink(missing_ok=True)
    return SolvedScenes(tuple(scenes), concatenate(every), results, times)


def _journals(journal: str | Path | None, count: int) -> list[Path | None]:
    """Return the journals of some groups of scenes: numbered ones, or none."""
    if journal is None:
        return [None] * count
    return [Path(f"{journal}.{number}") for number in range(count)]


def _found(
    goals: Mapping[int, Array], plans: Plans, results: Sequence[Attempt]
) -> dict[int, tuple[Plans, Attempt]]:
    """Return plan and attempt of the scenes of one group, by their indices, as the keys of ``goals``."""
    # One column numbers the goal states of a scene; only the best one is left.
    columns = {
        name: values for name, values in plans.columns.items() if name != GOAL_OPTION
    }
    plans = replace(plans, columns=columns)
    # Goal poses without joint positions are the reason of their scenes.
    attempts = (
        replace(result, reason=POSE_REASON) if np.isnan(states).all() else result
        for states, result in zip(goals.values(), results, strict=True)
    )
    return dict(zip(goals, zip(plans, attempts, strict=True), strict=True))


def _requested(
    problem: Problem, scenes: Sequence[SceneProblem], run: SceneOptions
) -> tuple[Problem, Robot, list[SceneProblem]]:
    """Return the problem that scenes ask for, its robot, and the placed scenes."""
    checked = [checked_scene(scene) for scene in scenes]
    robot = load_robot(problem)
    _check_initial(problem, len(scenes), run.initial)
    # Scenes are placed before the problem changes, since attached objects have poses in
    # frames of links.
    placed = [placed_scene(each, robot, start_state(each, robot)) for each in checked]
    return requested_problem(problem, robot, placed, payload=run.payload)


def _refiner(
    run: SceneOptions,
    progress: Progress | None,
    options: RefineOptions,
    *,
    workers: int | None,
    discard: bool,
) -> Callable[..., Refinement]:
    """Return ``refine_tasks`` with the options of a run; ``progress`` gets finished plans of all groups."""

    def report(finished: int, valid: int) -> None:
        if progress is not None and finished:
            progress(finished, valid)

    return partial(
        refine_tasks,
        options=options,
        engine=Engine(run.engine, run.address, workers),
        discard=discard,
        begin=lambda _, finished: report(finished, finished),
        progress=report,
    )


def _check_initial(problem: Problem, count: int, initial: Plans | None) -> None:
    """Raise UsageError if initial plans do not fit the scenes or the robot."""
    if initial is None:
        return
    joints = len(problem.robot.joints)
    spec = problem.trajectory
    expected = (count, spec.path_control_points, joints), (count, spec.rate_control_points)  # fmt: skip
    actual = initial.path_control_points.shape, initial.rate_control_points.shape
    if (*actual, initial.degree) != (*expected, spec.degree):
        raise UsageError(
            f"must have one plan for each of {counted(count, 'scene')}, with control points of"
            f" shapes {expected[0]} and {expected[1]} and degree {spec.degree},"
            f" got {actual[0]} and {actual[1]} of degree {initial.degree}",
            argument="initial",
        )


def _adjusted(plans: Plans, run: SceneOptions) -> Plans:
    """Return plans with the motions of the initial plans of their scenes, and with a smooth stop."""
    if run.initial is not None:
        rows = plans.sample_id
        plans = replace(
            plans,
            path_control_points=run.initial.path_control_points[rows],
            rate_control_points=run.initial.rate_control_points[rows],
        )
    if not run.smooth_stop:
        return plans
    # Without a goal acceleration it is free; zero makes the stop smooth.
    zero = np.zeros_like(plans.boundary.goal_q)
    return replace(plans, boundary=replace(plans.boundary, goal_ddq=zero))


def _groups(scenes: Sequence[SceneProblem]) -> list[tuple[dict[str, int], list[int]]]:
    """Return the capacities of the scenes with the indices of the scenes of each."""
    groups: dict[tuple[tuple[str, int], ...], list[int]] = {}
    for index, scene in enumerate(scenes):
        groups.setdefault(tuple(capacity_of([scene]).items()), []).append(index)
    return [(dict(capacity), members) for capacity, members in groups.items()]


def _plans_of(
    problem: Problem,
    scenes: Sequence[SceneProblem],
    goals: Mapping[int, Array],
    capacity: Capacity,
) -> Plans:
    """Return boundary problems of scenes of one capacity, by index, one for each goal state, shape (G, n) each."""
    options = [
        (index, option, goal)
        for index, states in goals.items()
        for option, goal in enumerate(states)
    ]
    rows, numbers, states = zip(*options, strict=True)
    plans = scene_plans(
        problem,
        [scenes[i] for i in rows],
        goals=states,
        capacity=capacity,
        sample_id=rows,
    )
    return (
        replace(plans, columns={**plans.columns, GOAL_OPTION: np.array(numbers, float)})
        if any(numbers)
        else plans
    )


def _goals_of_all(
    problem: Problem,
    robot: Robot,
    scenes: Sequence[SceneProblem],
    options: RefineOptions,
) -> list[Array]:
    """Return the goal states that are tried for each scene."""
    # One tree has all goals as roots; without a limit each of them is optimized.
    most = MAX_GOAL_STATES if options.time_limit is None else MAX_TREE_GOALS
    return [
        _goals(problem, robot, scene, index, most=most)
        for index, scene in enumerate(scenes)
    ]


def _goals(
    problem: Problem, robot: Robot, scene: SceneProblem, index: int, *, most: int
) -> Array:
    """Return at most so many goal states of a scene that are tried, in this order, shape (G, n), G > 0."""
    if scene.goal_pose is not None:
        _frame_of(robot, scene, scene.goal_pose)
    if scene.other_goal_poses:
        return _of_alternatives(problem, robot, scene, index, most=most)
    if not len(scene.goal_q):
        return _states_of_pose(problem, robot, scene, index, most=most)
    states = goal_states(scene, robot)
    below, above = goal_tolerances(scene, robot)
    widths = below + above
    # A single exact goal state leaves no choice.
    if robot.shape is None or (len(states) == 1 and not widths.any()):
        return states[:most]
    valid = _valid_ends(problem, robot, scene, states)
    if not len(valid) and widths.any():
        # The exact goal states are preferred; states within the tolerances are tried
        # where none of them is valid.
        near = _states_within(states, below, above, robot=robot, index=index)
        valid = _valid_ends(problem, robot, scene, near)
    start = start_state(scene, robot)
    return nearest_states(valid, start, robot, most=most) if len(valid) else states[:1]


def _valid_ends(
    problem: Problem, robot: Robot, scene: SceneProblem, states: Array
) -> Array:
    """Return the states that can end a motion, shape (K, n)."""
    resting = RestingStates(problem, robot, scene.obstacles)
    valid = states[resting.are_ends(states.T.copy())]
    conditions = EndConditions(problem, robot, scene.obstacles)
    return np.asarray(valid[conditions.met(valid.T)])


def _of_alternatives(
    problem: Problem, robot: Robot, scene: SceneProblem, index: int, *, most: int
) -> Array:
    """Return goal states of all alternatives, the nearest valid ones if there are any, shape (G, n)."""
    plain = replace(scene, other_goal_poses=())
    poses = (
        replace(plain, goal_q=scene.goal_q[:0], goal_pose=pose)
        for pose in scene.other_goal_poses
    )
    found = [_goals(problem, robot, each, index, most=most) for each in (plain, *poses)]
    states = np.concatenate(found)
    # nan stands for a goal pose without joint positions.
    known = states[~np.isnan(states).any(axis=1)]
    if robot.shape is None or not len(known):
        return (known if len(known) else states)[:most]
    valid = _valid_ends(problem, robot, scene, known)
    start = start_state(scene, robot)
    return nearest_states(valid, start, robot, most=most) if len(valid) else known[:1]


def _states_within(
    states: Array, below: Array, above: Array, *, robot: Robot, index: int
) -> Array:
    """Return random states within the tolerances of goal states and the joint limits, shape (K, n)."""
    random = np.random.default_rng([index, TOLERANCE_SEEDS])
    count = TOLERANCE_SEEDS // len(states) + 1
    shares = random.uniform(size=(count, *states.shape))
    # Uniform in [goal - below, goal + above].
    near = (states - below + shares * (below + above)).reshape(-1, robot.n)
    return np.clip(near, robot.position_lower, robot.position_upper)


def _states_of_pose(
    problem: Problem, robot: Robot, scene: SceneProblem, index: int, *, most: int
) -> Array:
    """Return collision-free joint positions with the goal pose of a scene, shape (G, n), G > 0; nan without any."""
    pose = scene.goal_pose
    if pose is None:
        raise SceneError(f"{scene.place} has neither goal states nor a goal pose")
    kinematics = PoseKinematics(robot, _frame_of(robot, scene, pose))
    states = RestingStates(problem, robot, scene.obstacles)
    conditions = EndConditions(problem, robot, scene.obstacles)
    # The index of the scene seeds the search: its result does not depend on the number
    # of workers.
    random = np.random.default_rng([index, POSE_SEEDS])
    start = start_state(scene, robot)
    goals, found = states_of_pose(
        kinematics, states, conditions, pose, start=start, random=random, most=most
    )
    if not len(found):
        return np.full((1, robot.n), np.nan)
    # In collision: the explanation of the unsolved scene names it.
    return goals if len(goals) else found[:1]


def _frame_of(robot: Robot, scene: SceneProblem, pose: GoalPose) -> int | None:
    """Return the index of the frame of a goal pose; None for the tip."""
    if not pose.frame:
        return None
    if not robot.model.existFrame(pose.frame):
        raise SceneError(
            f"{scene.place}: the robot has no frame {pose.frame!r}, which its goal pose names"
        )
    return int(robot.model.getFrameId(pose.frame))
