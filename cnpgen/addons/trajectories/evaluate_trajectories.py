"""Evaluation of sampled trajectories of any planner by the independent verdict."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property, partial
from pathlib import Path

import numpy as np
from numpy.typing import ArrayLike

from cnpgen.addons.trajectories.curve_family import CurveFamily
from cnpgen.addons.trajectories.interpolate import (
    Interpolation,
    bounded_jerk,
    interpolated,
)
from cnpgen.addons.trajectories.judge_family import FamilyJudge
from cnpgen.addons.trajectories.judge_samples import (
    NO_JITTER_BOUND,
    judge_samples,
    refute,
    with_jitter,
)
from cnpgen.addons.trajectories.sample_errors import SampleErrors, errors_of
from cnpgen.addons.trajectories.sampled_trajectory import Trajectory
from cnpgen.addons.trajectories.trajectory_scenes import problem_of_samples
from cnpgen.addons.trajectories.trajectory_verdict import (
    Decision,
    Statement,
    TrajectoryVerdict,
)
from cnpgen.arrays import Array, Mask
from cnpgen.documents import JsonObject
from cnpgen.errors import UsageError, counted
from cnpgen.judges.plans.judge import check_step
from cnpgen.plans.evaluate import MAX_VERDICT_STEP_S, judged_in_parts
from cnpgen.problems.limit_sources import JudgedLimits
from cnpgen.problems.problem import Problem
from cnpgen.problems.problem_record import ProblemRecord, open_problem
from cnpgen.robots.scene import Scene
from cnpgen.robots.solid import pose_width
from cnpgen.schema.argument_types import checked_arguments
from cnpgen.schema.arguments import number, numbers
from cnpgen.store.dataset_spec import StoredProblem

FORMAT = "cnpgen-trajectory-evaluation"
TRAJECTORY_EVALUATION_VERSION = 1
TRAJECTORIES_PER_TASK = 10  # that a process judges at a time
CONTRADICTION = "no curve with jerks within the bound passes through the samples"


@dataclass(frozen=True, eq=False)
class TrajectoryEvaluation:
    """Verdicts of N sampled trajectories.

    Attributes:
        problem: The problem.
        trajectories: The trajectories, in the order of the problem's joints.
        verdicts: Verdicts, in the same order.
        errors: Largest errors of the samples that were used, in the same order.
        step: Maximum distance of checked times [s].
    """

    problem: ProblemRecord
    trajectories: tuple[Trajectory, ...]
    verdicts: tuple[TrajectoryVerdict, ...]
    errors: tuple[SampleErrors, ...]
    step: float

    def __repr__(self) -> str:
        texts = ", ".join(
            f"{count:,} {decision}" for decision, count in self.counts.items() if count
        )
        return f"<{counted(len(self.verdicts), 'trajectory')}: {texts}>"

    @property
    def counts(self) -> dict[str, int]:
        """Numbers of valid, invalid and undecided trajectories."""
        found = Counter(str(verdict.decision) for verdict in self.verdicts)
        return {str(decision): found[str(decision)] for decision in Decision}

    @property
    def statements(self) -> dict[str, int]:
        """Numbers of trajectories by the statement that is proven."""
        found = Counter(str(verdict.statement) for verdict in self.verdicts)
        return {str(statement): found[str(statement)] for statement in Statement}

    @property
    def assumed_errors(self) -> dict[str, int]:
        """Errors that were assumed since the numbers are rounded, with the number of trajectories."""
        return dict(Counter(each.source for each in self.errors if each.source))

    @property
    def valid(self) -> Mask:
        """Whether each trajectory is proven to be valid, or a valid motion through it exists, shape (N,)."""
        return np.array([verdict.valid for verdict in self.verdicts], bool)

    @cached_property
    def judged_limits(self) -> JudgedLimits:
        """Limits that were judged, with who states them."""
        return JudgedLimits.of(*open_problem(self.problem))

    def summary(self) -> JsonObject:
        """Return the summary of all trajectories for JSON ('cnpgen docs trajectories')."""
        conditions: dict[str, JsonObject] = {}
        for verdict in self.verdicts:
            for name, entry in verdict.conditions.items():
                counts = conditions.setdefault(
                    name, {str(decision): 0 for decision in Decision}
                )
                counts[str(entry.decision)] += 1
        return {
            "format": FORMAT,
            "format_version": TRAJECTORY_EVALUATION_VERSION,
            "problem": self.problem.name,
            "problem_sha256": self.problem.comparable_sha256,
            **self.judged_limits.to_dict(),
            "step_s": self.step,
            "trajectories": len(self.verdicts),
            **self.counts,
            "statements": self.statements,
            "assumed_errors": self.assumed_errors,
            "reasons": dict(
                Counter(str(v.reason) for v in self.verdicts if v.reason).most_common()
            ),
            "conditions": conditions,
        }


@checked_arguments
def evaluate_trajectories(
    problem: Problem | StoredProblem | str | Path,
    trajectories: Sequence[Trajectory],
    *,
    interpolation: Interpolation | None = None,
    noise: ArrayLike | None = None,
    time_jitter: float | None = None,
    max_jerk: ArrayLike | None = None,
    ignore_velocities: bool = False,
    step: float = MAX_VERDICT_STEP_S,
    workers: int = 1,
    progress: Callable[[int], None] | None = None,
) -> TrajectoryEvaluation:
    """Judge sampled trajectories: valid, invalid or undecided.

    Lower bounds come first: a trajectory is invalid if no curve through its samples,
    within their errors, meets the joint limits. By default, it is valid if a curve
    within the errors of all samples is: a valid motion exists. Otherwise all curves
    within the errors of the samples' resolution decide. With ``interpolation``, the
    curve of a controller is judged. With ``max_jerk``, all curves through the samples
    whose jerks are within it are judged. They are valid if every curve is, invalid if
    every curve violates a condition, and otherwise undecided. Obstacles that depend on
    the ends of a motion are placed at its first and last sample.

    Args:
        problem: Problem, record, or name or path of a problem, pipeline or dataset.
        trajectories: The trajectories, with the problem's joints in their order.
        interpolation: "hold", "linear", "cubic" or "quintic"; not with ``max_jerk``.
        noise: Largest error of the samples in SI units: one number for positions,
            velocities and accelerations, or three; by default half a unit of the
            rounding that the numbers show, which is stated in the result.
        time_jitter: Largest error of the times [s]; by default half a unit of their
            rounding.
        max_jerk: Bound of the jerks [rad/s^3], one number or shape (n,).
        ignore_velocities: Whether velocities and accelerations of the samples are not
            used.
        step: Maximum distance of checked times [s].
        workers: Number of processes.
        progress: Called with the number of trajectories that were judged since the last
            call.

    Raises:
        UsageError: An argument is invalid, or a trajectory has another number of joints
            or of parameters.
        RecipeError: A required plug-in is not installed.
    """
    check_step(step := number("step", step))
    record = problem_of_samples(problem)
    check_trajectories(trajectories, record)
    if interpolation is not None and max_jerk is not None:
        text = "interpolation and max_jerk exclude each other"
        raise UsageError(text, concerns="interpolation")
    n = len(record.joint_names)
    task = partial(
        _judge,
        record=record,
        interpolation=interpolation,
        noise=None if noise is None else non_negative("noise", noise, 3),
        jitter=_seconds("time_jitter", time_jitter),
        max_jerk=None if max_jerk is None else non_negative("max_jerk", max_jerk, n),
        step=step,
    )
    chosen = tuple(trajectories)
    if ignore_velocities:
        chosen = tuple(replace(each, dq=None, ddq=None) for each in chosen)
    judged = judged_in_parts(
        task, chosen, size=TRAJECTORIES_PER_TASK, workers=workers, progress=progress
    )
    verdicts, errors = zip(*judged, strict=True)
    return TrajectoryEvaluation(record, chosen, verdicts, errors, step)


def check_trajectories(
    trajectories: Sequence[Trajectory], record: ProblemRecord
) -> None:
    """Check that there are trajectories with the joints, the parameters and the scenes of a problem."""
    n = len(record.joint_names)
    names = ", ".join(record.parameters.names)
    problem = open_problem(record)[0]
    if not len(trajectories):
        raise UsageError("there are no trajectories", concerns="trajectories")
    for index, trajectory in enumerate(trajectories):
        if not isinstance(trajectory, Trajectory):
            raise UsageError(
                f"must hold objects of Trajectory, got {trajectory!r:.60}",
                argument="trajectories",
            )
        if trajectory.q.shape[1] != n:
            raise UsageError(
                f"trajectory {index} has {trajectory.q.shape[1]} joints, the problem plans {n}",
                concerns="trajectories",
            )
        _check_scene(index, trajectory, problem)
        if trajectory.parameters is not None:
            record.parameters.checked(trajectory.parameters)
        elif names:
            text = f"trajectory {index} has no values of {names}: its file needs columns of these names, or {{parameters}}"
            raise UsageError(
                text, concerns="trajectories", remedies={"parameters": None}
            )


def _check_scene(index: int, trajectory: Trajectory, problem: Problem) -> None:
    """Check that a trajectory has the obstacles that samples of a problem place."""
    if trajectory.obstacle_poses is not None:
        obstacles = tuple(problem.obstacle)
        got = len(trajectory.obstacle_poses)
        if got != pose_width(obstacles):
            text = (
                f"trajectory {index} has a scene of {got} numbers, and {problem.name!r}"
                f" takes {pose_width(obstacles)}: its scene file as {{scenes}} adds the obstacles"
            )
            raise UsageError(text, concerns="trajectories", remedies={"scenes": None})
        # Checks the values.
        Scene(obstacles, np.empty((1, pose_width(obstacles)))).with_poses(
            trajectory.obstacle_poses[None]
        )
    elif problem.has_sample_obstacles:
        text = f"trajectory {index} has no scene: samples of {problem.name!r} place its obstacles, which"
        raise UsageError(
            f"{text} {{scenes}} gives",
            concerns="trajectories",
            remedies={"scenes": None},
        )


def non_negative(name: str, value: ArrayLike, size: int) -> Array:
    """Return one number or several as an array of shape (size,)."""
    found = numbers(name, value)
    if (
        found.shape not in {(), (size,)}
        or not (np.isfinite(found) & (found >= 0)).all()
    ):
        raise UsageError(
            f"must be one number or {size}, finite and at least 0, got {found!s:.60}",
            argument=name,
        )
    return np.broadcast_to(found, (size,)).astype(float)


def _seconds(name: str, value: float | None) -> float | None:
    return None if value is None else float(non_negative(name, value, 1)[0])


def _judge(  # noqa: PLR0917 - the arguments of evaluate_trajectories
    trajectories: Sequence[Trajectory],
    record: ProblemRecord,
    interpolation: Interpolation | None,
    noise: Array | None,
    jitter: float | None,
    max_jerk: Array | None,
    step: float,
) -> list[tuple[TrajectoryVerdict, SampleErrors]]:
    """Judge some trajectories, with the errors of their samples."""
    problem, robot = open_problem(record)
    judge = FamilyJudge(problem, robot, step=step)
    found = []
    for trajectory in trajectories:
        errors = errors_of(trajectory, noise, jitter)
        verdict = refute(judge, trajectory, errors)
        if verdict is None and max_jerk is None and interpolation is None:
            verdict = judge_samples(judge, trajectory, errors)
        if verdict is None:
            moved = with_jitter(errors, judge.limits(trajectory.parameters), trajectory)
            verdict = _judge_assumed(
                judge, trajectory, moved.values, interpolation, max_jerk
            )
        found.append((verdict, errors))
    return found


def _judge_assumed(
    judge: FamilyJudge,
    trajectory: Trajectory,
    noise: Array,
    interpolation: Interpolation | None,
    max_jerk: Array | None,
) -> TrajectoryVerdict:
    """Judge all curves that meet a stated assumption."""
    undecided = partial(
        TrajectoryVerdict, Decision.UNDECIDED, duration=trajectory.duration
    )
    if not np.isfinite(noise).all():
        return undecided(NO_JITTER_BOUND)
    family: CurveFamily | None
    if max_jerk is None:
        family = interpolated(trajectory, interpolation, noise)
        text = f"{interpolation} interpolation"
    else:
        family = bounded_jerk(trajectory, max_jerk, noise)
        largest = ", ".join(f"{value:g}" for value in np.unique(max_jerk))
        text = f"jerks of at most {largest} rad/s^3"
    if family is None:
        return undecided(CONTRADICTION)
    return replace(judge(family, trajectory), assumption=text)
