"""The last gate of every pipeline: the problem's own constraints, evaluated on the numbers as they will be stored.

It shares no assumption with the stages before it: nothing about convergence, order or exactness is taken for granted.
"""

from collections.abc import Collection
from typing import TYPE_CHECKING, Any

import numpy as np

from cnpgen.kernels.symbolic.linalg import Scalar, Vec, dot, subtract, symbols
from cnpgen.kernels.symbolic.state import SymbolicState
from cnpgen.pipelines.context import Context
from cnpgen.pipelines.stages.collision import sample_tops
from cnpgen.pipelines.stages.stage import Round, Work
from cnpgen.pipelines.undecided import settle, unmet
from cnpgen.problems.constraints.constraint import EXACTNESS, End
from cnpgen.problems.constraints.needs import symbolic_needs
from cnpgen.problems.problem import Problem
from cnpgen.robots.solid import count_numbers
from cnpgen.store.field import Field

if TYPE_CHECKING:
    from cnpgen.robots.robot import Robot

ROUNDING = 1e-14  # m/s: of a velocity that ought to be zero


def acceptance(context: Context, written: set[str], *, given: Collection[End] = ()) -> Work:
    """Prepare the gate.

    Args:
        context: The surroundings.
        written: Columns that the stages write; accelerations and torques of the goal are checked if its acceleration
            is known.
        given: Ends whose state is somebody else's, measured perhaps: they need not be exact, but no further outside of
            the constraints than motions may be.

    Returns:
        A function that rejects, under each constraint's reason, what is not exactly a boundary problem.
    """
    ends: tuple[End, ...] = ("start", "goal")
    hit = {"start": (), "goal": ("hit_angle", "hit_speed") if "hit_angle" in written else ()}
    kernels = {
        end: context.kernels.load(
            boundary_unmet,
            end=end,
            needs=2 if f"{end}_ddq" in written else 1,
            dtype=context.dtype,
            exact=end not in given,
            hitting=bool(hit[end]),
        )
        for end in ends
    }
    decisions = {end: settle(context, end, exact=end not in given) for end in ends}
    n, constraints = context.robot.n, len(context.problem.constraint)
    reasons = [*(constraint.reason for constraint in context.problem.constraint), "tip not at its position"]
    reasons += ["hit not along its direction"] if hit["goal"] else []

    def work(draws: Round, _random: np.random.Generator) -> None:
        tops = sample_tops(context.problem, draws)
        missed = []
        for end in ends:
            acceleration = draws.columns.get(f"{end}_ddq")
            if acceleration is None:
                acceleration = np.zeros((n, len(draws.alive)))
            state = draws[f"{end}_q"], draws[f"{end}_dq"], acceleration
            (count,) = kernels[end](*state, tops, draws[f"{end}_xyz"], *(draws[name] for name in hit[end]))
            if decide := decisions[end]:
                count[:constraints] += decide(state, tops, count[: constraints + 1].max(axis=0) <= 0)
            missed.append(count)
        start, goal = missed
        np.maximum(start, goal[: len(start)], out=goal[: len(start)])
        draws.reject_first(goal <= 0, reasons)

    return work


def boundary_unmet(
    robot: "Robot", problem: Problem, *, end: End, needs: int, dtype: str, exact: bool = True, hitting: bool = False
) -> Any:
    """Build ``(q, dq, ddq, tops, position) -> unmet``, positive where a boundary state is not exact or not a number.

    That of a hit is ``(q, dq, ddq, tops, position, angle, speed) -> unmet``: the tip must move along the angle,
    horizontally, at that speed.

    Conditions that ask for more than is meant are left to ``cnpgen.pipelines.undecided``.

    Args:
        robot: The robot.
        problem: The problem.
        end: Which end of the motion.
        needs: The highest derivative of q that is known there; conditions on higher ones are left out.
        dtype: How exactly (see ``EXACTNESS``).
        exact: Whether it must be exact; else it may be as far outside as motions may, and what only boundary states
            must meet is left out.
        hitting: Whether it is a hit.

    Returns:
        A function whose result has one row per constraint, in order, one for the position of the tip, and one for the
        hit if it is one.
    """
    import casadi as ca

    names = (("q", robot.n), ("dq", robot.n), ("ddq", robot.n), ("tops", count_numbers(problem.obstacle)), ("p", 3))
    (q_sx, q), (dq_sx, dq), (ddq_sx, ddq), (tops_sx, tops), (p_sx, p) = (symbols(name, width) for name, width in names)
    size = problem.object_size
    state = SymbolicState(robot, q, dq, ddq, tops, problem.obstacle, size)
    rows: list[Scalar] = []
    for constraint in problem.constraint:
        count: Scalar = ca.SX(0)
        along = {each.name: constraint.allowed(each) for each in constraint.symbolic(state)}
        for condition in (each for each in constraint.symbolic_at(state, end) if not each.sufficient):
            if symbolic_needs(condition, dq_sx, ddq_sx) <= needs and (exact or condition.name in along):
                slack = condition.slack(dtype) if exact else np.maximum(along[condition.name], condition.slack(dtype))
                count = count + unmet(condition, slack)
        rows.append(count)
    miss = subtract(p, state.kinematics.tip)
    rows.append(ca.logic_not(ca.sqrt(dot(miss, miss)) <= EXACTNESS[dtype]["position"]))
    hit = [ca.SX.sym("angle"), ca.SX.sym("speed")] if hitting else []
    rows += [_direction_unmet(state.tip_velocity, *hit, dtype=dtype)] if hit else []
    return ca.Function(f"boundary_{end}", [q_sx, dq_sx, ddq_sx, tops_sx, p_sx, *hit], [ca.vertcat(*rows)])


def _direction_unmet(velocity: Vec, angle: Scalar, speed: Scalar, *, dtype: str) -> Scalar:
    """Whether a tip's velocity is not along the angle, horizontally, at a speed."""
    import casadi as ca

    cosine, sine = ca.cos(angle), ca.sin(angle)
    across = ca.fabs(cosine * velocity[1] - sine * velocity[0])
    along = cosine * velocity[0] + sine * velocity[1] - speed
    exact = EXACTNESS[dtype]
    met = ca.logic_and(across <= exact["direction"] * speed + ROUNDING, ca.fabs(along) <= exact["velocity"])
    return ca.logic_not(met)


def bookkeeping_fields() -> tuple[Field, ...]:
    """The fields that every dataset has."""
    return (
        Field(
            "attempts", "1", "draws that it took to find this row, itself included", role="diagnostic", dtype="int64"
        ),
        Field("sample_id", "1", "index of the row in its split", role="diagnostic", dtype="int64"),
    )
