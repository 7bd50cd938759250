"""Acceptance: the last check of every pipeline evaluates the problem's constraints on the values as stored.

The check is independent of the stages: it makes no assumption about their convergence, order or tolerances.
"""

from collections.abc import Collection
from typing import Any

import numpy as np

from cnpgen.kernels.symbolic.linalg import Scalar, Vec, dot, subtract, symbols
from cnpgen.kernels.symbolic.symbolic_state import SymbolicState
from cnpgen.pipelines.context import Context
from cnpgen.pipelines.stages.collision import candidate_poses
from cnpgen.pipelines.stages.narrow_phase import narrow_phase_of, narrow_phase_of_scenes, unmet
from cnpgen.pipelines.stages.stage import CandidateBatch, StageFunction
from cnpgen.problems.conditions import symbolic_needs
from cnpgen.problems.constraints.constraint import BOUNDARY_TOLERANCES, End
from cnpgen.problems.problem import Problem
from cnpgen.robots.robot import Robot
from cnpgen.robots.scene import scene_capacity
from cnpgen.store.field import Field
from cnpgen.store.scene_table import SCENE_ID

ZERO_VELOCITY_ROUNDING_M_S = 1e-14  # rounding error of a velocity that is zero in exact arithmetic


def acceptance(context: Context, written: set[str], *, given: Collection[End] = ()) -> StageFunction:
    """Prepare the acceptance check of the columns that the stages write.

    Accelerations and torques of the goal are checked if ``goal_ddq`` is among them. The tolerances of motions apply to
    ``given`` ends, whose state is from the user, for example a measurement; to others those of boundary states.

    Returns:
        A stage function that rejects candidates under the reason of the first violated constraint.
    """
    ends: tuple[End, ...] = ("start", "goal")
    hit = {"start": (), "goal": ("hit_angle", "hit_speed") if "hit_angle" in written else ()}
    kernels = {
        end: context.kernels.load_by_structure(
            boundary_unmet,
            end=end,
            needs=2 if f"{end}_ddq" in written else 1,
            dtype=context.dtype,
            exact=end not in given,
            hitting=bool(hit[end]),
        )
        for end in ends
    }
    has_scenes = bool(scene_capacity(context.problem.obstacle)) and context.robot.shape is not None
    narrow_phase = narrow_phase_of_scenes if has_scenes else narrow_phase_of
    decisions = {end: narrow_phase(context, end, exact=end not in given) for end in ends}
    n, constraints = context.robot.n, len(context.problem.constraint)
    reasons = [each.boundary_reason or each.reason for each in context.problem.constraint]
    reasons.append("tip not at its position")
    reasons += ["hit not along its direction"] if hit["goal"] else []

    def accept(candidates: CandidateBatch, _random: np.random.Generator) -> None:
        obstacle_poses = candidate_poses(context.problem, candidates)
        counts = []
        for end in ends:
            acceleration = candidates.columns.get(f"{end}_ddq")
            if acceleration is None:
                acceleration = np.zeros((n, len(candidates.alive)))
            state = candidates[f"{end}_q"], candidates[f"{end}_dq"], acceleration
            (count,) = kernels[end](
                *state, obstacle_poses, candidates[f"{end}_xyz"], *(candidates[name] for name in hit[end])
            )
            if decide := decisions[end]:
                remaining = count[: constraints + 1].max(axis=0) <= 0
                count[:constraints] += decide(state, obstacle_poses, remaining, candidates)
            counts.append(count)
        start, goal = counts
        np.maximum(start, goal[: len(start)], out=goal[: len(start)])
        candidates.reject_first(goal <= 0, reasons)

    return accept


def boundary_unmet(
    robot: Robot, problem: Problem, *, end: End, needs: int, dtype: str, exact: bool = True, hitting: bool = False
) -> Any:
    """Build ``(q, dq, ddq, obstacle_poses, position) -> unmet``, positive for violations above tolerance and for nan.

    For a hit it is ``(q, dq, ddq, obstacle_poses, position, angle, speed) -> unmet``: the tip velocity must be
    horizontal, along the angle, at the speed. Conditions on derivatives of q higher than ``needs`` are omitted. Unless
    the state is ``exact``, the tolerances of motions apply, and conditions for boundary states only are omitted.
    ``cnpgen.pipelines.stages.narrow_phase`` checks conservative conditions.

    Returns:
        A function whose result has one row per constraint, one for the tip position, and one for a hit.
    """
    import casadi as ca

    columns, state = SymbolicState.of_symbols(robot, problem.obstacle, problem.object_size, problem.scene_width)
    p_sx, p = symbols("p", 3)
    rows: list[Scalar] = []
    for constraint in problem.constraint:
        count: Scalar = ca.SX(0)
        along = {condition.name: constraint.allowed(condition) for condition in constraint.symbolic(state)}
        for condition in constraint.symbolic_at(state, end):
            if condition.sufficient:
                continue
            if symbolic_needs(condition, *columns[1:3]) <= needs and (exact or condition.name in along):
                tolerance = condition.tolerance(dtype)
                tolerance = tolerance if exact else np.maximum(along[condition.name], tolerance)
                count = count + unmet(condition, tolerance)
        rows.append(count)
    miss = subtract(p, state.kinematics.tip)
    rows.append(ca.logic_not(ca.sqrt(dot(miss, miss)) <= BOUNDARY_TOLERANCES[dtype]["position"]))
    hit = [ca.SX.sym("angle"), ca.SX.sym("speed")] if hitting else []
    rows += [_direction_unmet(state.along_table(state.tip_velocity), *hit, dtype=dtype)] if hit else []
    return ca.Function(f"boundary_{end}", [*columns, p_sx, *hit], [ca.vertcat(*rows)])


def _direction_unmet(velocity: Vec, angle: Scalar, speed: Scalar, *, dtype: str) -> Scalar:
    """Build a flag that is 1 unless the tip velocity on the table is along the angle, at the speed."""
    import casadi as ca

    cosine, sine = ca.cos(angle), ca.sin(angle)
    across = ca.fabs(cosine * velocity[1] - sine * velocity[0])
    along = cosine * velocity[0] + sine * velocity[1] - speed
    exact = BOUNDARY_TOLERANCES[dtype]
    met = ca.logic_and(
        across <= exact["direction"] * speed + ZERO_VELOCITY_ROUNDING_M_S, ca.fabs(along) <= exact["velocity"]
    )
    return ca.logic_not(met)


def bookkeeping_fields(*, scenes: bool = False) -> tuple[Field, ...]:
    """Return the bookkeeping fields of every dataset, and with ``scenes`` that of the scene of a row."""
    text = "sample_id of the first row in the same scene"
    return (
        *((Field(SCENE_ID, "1", text, role="context", dtype="int64"),) if scenes else ()),
        Field("attempts", "1", "candidates per accepted row, including this row", role="diagnostic", dtype="int64"),
        Field("sample_id", "1", "index of the row in its split", role="diagnostic", dtype="int64"),
    )
