"""Verdicts on the answers of planners, as by ``cnpgen evaluate``, and their execution in the simulator.

A sampled trajectory stands for the curve of a controller: linear through positions,
cubic with velocities, quintic with accelerations. A condition that needs a derivative
which this curve lacks at its samples counts as violated.
"""

from dataclasses import replace
from functools import lru_cache

import numpy as np

from cnpgen.addons.benchmark.pucks import ExecutedPrefix
from cnpgen.addons.benchmark.results_file import answer_from_dict
from cnpgen.addons.benchmark.simulator.execute import Execution
from cnpgen.addons.benchmark.simulator.executed import Executed
from cnpgen.addons.benchmark.simulator.plant import Plant
from cnpgen.addons.benchmark.simulator.reference import StatesAt, states_of
from cnpgen.addons.benchmark.simulator.simulate import execute_states
from cnpgen.addons.paper.paper_rule import paper_rule
from cnpgen.addons.trajectories.interpolate import interpolated
from cnpgen.addons.trajectories.judge_family import FamilyJudge
from cnpgen.addons.trajectories.sampled_trajectory import Trajectory
from cnpgen.addons.trajectories.trajectory_verdict import ConditionDecision, Decision
from cnpgen.arrays import Array
from cnpgen.documents import JsonObject
from cnpgen.errors import UsageError
from cnpgen.judges.plans.evaluated_trajectory import EvaluatedTrajectory
from cnpgen.judges.plans.judge import reason_of
from cnpgen.judges.plans.measure import boundary_margins, by_name
from cnpgen.judges.plans.metrics import metrics_of
from cnpgen.judges.plans.sampling import Samples
from cnpgen.judges.plans.verdict import Margin, PaperRule, Reason, Verdict
from cnpgen.plans.evaluate import evaluate_plans
from cnpgen.plans.plans import Plans
from cnpgen.problems.problem_record import ProblemRecord, open_problem
from cnpgen.world.path import PathWorld

Task = tuple[Plans, JsonObject, ExecutedPrefix | None]
"""One boundary problem, the stored answer, and the executed prefix of a replanning scenario."""

JUDGING_STEP_S = 1e-3
MAX_JUDGED_DURATION_S = 60.0


def judge_answer(problem: Plans, answer: Plans | Trajectory) -> Verdict:
    """Judge an answer, one plan or a trajectory, for one boundary problem."""
    if isinstance(answer, Plans):
        return evaluate_plans(answer, workers=1).verdicts[0]
    if answer.duration > MAX_JUDGED_DURATION_S:
        return Verdict(Reason.TOO_LONG)
    loaded, robot = open_problem(problem.problem)
    judge, world = _judge_and_world(problem.problem)
    scene = problem.scene.poses[0]
    verdict = judge(interpolated(answer, None, np.zeros(3)), answer, scene=scene)
    if not verdict.conditions:
        return Verdict(verdict.reason)
    t = np.linspace(
        0, answer.duration, int(np.ceil(answer.duration / JUDGING_STEP_S)) + 1
    )
    samples = Samples(t / answer.duration, t)
    with np.errstate(all="ignore"):
        states = _states(answer, t)
        world.set_path(states.q, states.dq, states.ddq, scene, states.jerk)
        jerk = (
            states.jerk
            if loaded.uses_jerk and states.jerk is not None
            else np.full_like(states.q, np.nan)
        )
        metrics = metrics_of(loaded, world, samples, jerk)
        finished, broken = paper_rule(
            loaded, world, scene, problem.columns["goal_xyz"][0]
        )
    margins = boundary_margins(states, problem.boundary, samples, robot)
    margins += [_evaluated(entry) for entry in verdict.conditions.values()]
    paper = PaperRule(finished, finished and not broken, broken)
    return Verdict(
        reason_of(margins), by_name(margins), metrics, paper, verdict.samples
    )


def _states(answer: Trajectory, t: Array) -> EvaluatedTrajectory:
    """Evaluate a trajectory at times, for metrics and the paper's rule.

    Steps of linear spans are differences.
    """
    q, dq, ddq = answer.states(t)
    if answer.dq is None:
        ddq = np.gradient(dq, t, axis=0)
    jerk = np.gradient(ddq, t, axis=0) if answer.ddq is None else answer.jerks(t)
    return EvaluatedTrajectory(
        *(np.ascontiguousarray(values.T) for values in (q, dq, ddq, jerk))
    )


def _evaluated(entry: ConditionDecision) -> Margin:
    """Return the margin of a condition, without a value if the curve lacks a derivative that it needs."""
    if entry.decision == Decision.UNDECIDED and entry.uncertainty > 0:
        return replace(entry.margin, value=np.nan, violation=np.inf)
    return entry.margin


@lru_cache(maxsize=2)
def _judge_and_world(record: ProblemRecord) -> tuple[FamilyJudge, PathWorld]:
    problem, robot = open_problem(record)
    return FamilyJudge(problem, robot, step=JUDGING_STEP_S), PathWorld(
        robot, problem.obstacle, problem.object_size
    )


def execute_answer(task: Task, *, plant: Plant) -> Executed:
    """Execute an answer on a plant.

    If this is impossible, ``failure`` has the reason.
    """
    try:
        return execution_of(task, plant).executed
    except UsageError as error:
        return Executed(failure=str(error))


def execution_of(task: Task, plant: Plant) -> Execution:
    """Execute an answer; in a replanning scenario, the first motion is executed up to the switch.

    Raise UsageError if the answer is invalid or cannot be executed, and RecipeError if
    MuJoCo cannot simulate the robot.
    """
    problem, content, prefix = task
    states, duration = _timed(answer_from_dict(problem, content))
    if prefix is None:
        return execute_states(
            problem, states, duration, plant, problem.boundary.start_dq[0]
        )
    return execute_states(
        problem, joined(prefix, states), float(prefix.until[0]) + duration, plant
    )


def joined(prefix: ExecutedPrefix, states: StatesAt) -> StatesAt:
    """Join the prefix of one motion with its continuation, whose time starts at 0."""
    first = states_of(prefix.motion)
    until = float(prefix.until[0])

    def at(t: Array) -> tuple[Array, Array, Array]:
        before = first(np.minimum(t, until))
        after = states(np.maximum(t - until, 0.0))
        q, dq, ddq = (
            np.where((t < until)[:, None], a, b)
            for a, b in zip(before, after, strict=True)
        )
        return q, dq, ddq

    return at


def _timed(answer: Plans | Trajectory) -> tuple[StatesAt, float]:
    if isinstance(answer, Plans):
        return states_of(answer.motion), float(answer.duration[0])
    return answer.states, answer.duration
