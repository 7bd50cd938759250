"""Verdicts on the results of planners: plans as by ``cnpgen evaluate``, sampled trajectories by the same constraints.

A sampled trajectory is evaluated every millisecond, at the rate of the controller. No spline is fitted, because a fit
would smooth violations. Jumps between spans count as their difference quotient over a millisecond: accelerations of
linear spans are differences of velocities, jerks of linear and cubic spans are differences of accelerations.
"""

from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from cnpgen.judges.plans.evaluated_trajectory import EvaluatedTrajectory
from cnpgen.judges.plans.judge import reason_of
from cnpgen.judges.plans.measure import boundary_margins, by_name, measure
from cnpgen.judges.plans.paper import metrics_of, paper_rule
from cnpgen.judges.plans.sampling import Samples
from cnpgen.judges.plans.verdict import Reason, Verdict
from cnpgen.plans.evaluate import evaluate_plans
from cnpgen.plans.plans import Plans
from cnpgen.problems.problem_record import ProblemRecord, open_problem
from cnpgen.trajectory.sampled_trajectory import Trajectory
from cnpgen.world.path import PathWorld

Array = NDArray[np.float64]

JUDGING_STEP_S = 1e-3
MAX_JUDGED_DURATION_S = 60.0


def judge_answer(problem: Plans, answer: Plans | Trajectory) -> Verdict:
    """Judge the answer of a planner.

    Args:
        problem: One boundary problem, as a plan without motion.
        answer: One plan or a trajectory.
    """
    if isinstance(answer, Plans):
        return evaluate_plans(answer, workers=1).verdicts[0]
    if answer.duration > MAX_JUDGED_DURATION_S:
        return Verdict(Reason.TOO_LONG)
    t = np.linspace(0, answer.duration, int(np.ceil(answer.duration / JUDGING_STEP_S)) + 1)
    with np.errstate(all="ignore"):
        return _judge(problem, Samples(t / answer.duration, t), answer)


def _judge(problem: Plans, samples: Samples, answer: Trajectory) -> Verdict:
    loaded, robot = open_problem(problem.problem)
    states = _trajectory(answer, samples.t, jerk=loaded.uses_jerk)
    goal_xyz, obstacle_poses = problem.columns["goal_xyz"][0], problem.scene.poses[0]
    world = _world(problem.problem)
    world.set_path(states.q, states.dq, states.ddq, obstacle_poses, states.jerk)
    start_tip = world.tip_position[:, 0]
    margins = boundary_margins(states, problem.boundary, samples, robot)
    for constraint in loaded.constraint:
        margins += [condition.margin(loaded, samples) for condition in measure(constraint, world, samples.s, start_tip)]
    unknown = np.full_like(states.q, np.nan)
    metrics = metrics_of(loaded, world, samples, unknown if states.jerk is None else states.jerk)
    paper = paper_rule(loaded, world, obstacle_poses, goal_xyz)
    return Verdict(reason_of(margins), by_name(margins), metrics, paper, len(samples.t))


def _trajectory(answer: Trajectory, t: Array, *, jerk: bool) -> EvaluatedTrajectory:
    """Evaluate a trajectory at times, joint by joint."""
    q, dq, ddq = answer.states(t)
    if answer.dq is None:
        ddq = np.gradient(dq, t, axis=0)
    derivatives = [q, dq, ddq]
    if jerk:
        derivatives.append(np.gradient(ddq, t, axis=0) if answer.ddq is None else answer.jerks(t))
    return EvaluatedTrajectory(*(np.ascontiguousarray(values.T) for values in derivatives))


@lru_cache(maxsize=2)
def _world(record: ProblemRecord) -> PathWorld:
    problem, robot = open_problem(record)
    return PathWorld(robot, problem.obstacle, problem.object_size)
