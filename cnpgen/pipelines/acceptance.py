"""Acceptance: the last check of every pipeline evaluates the problem's constraints on the values as stored.

The check is independent of the stages: it makes no assumption about their convergence,
order or tolerances. States that conservative conditions do not accept go to a narrow
phase: exact checks with Pinocchio and Coal. A capsule contains its link: if the capsule
has clearance, so has the link. Otherwise the convex parts of the link are checked.
"""

from collections.abc import Callable, Collection
from typing import Any

import numpy as np

from cnpgen.arrays import Array, Mask
from cnpgen.kernels.symbolic.linalg import Scalar, Vec, dot, subtract, symbols
from cnpgen.kernels.symbolic.symbolic_state import SymbolicState
from cnpgen.pipelines.stages.collision import candidate_poses
from cnpgen.pipelines.stages.scene_clearance import SceneClearance
from cnpgen.pipelines.stages.stage import CandidateBatch, Context, StageFunction
from cnpgen.problems.conditions import symbolic_needs
from cnpgen.problems.constraints.clearance import RobotClearance
from cnpgen.problems.constraints.constraint import (
    BOUNDARY_TOLERANCES,
    Condition,
    Constraint,
    End,
)
from cnpgen.problems.constraints.link_clearance import SelfClearance
from cnpgen.problems.problem import Problem
from cnpgen.robots.robot import Robot
from cnpgen.robots.scene import scene_capacity
from cnpgen.world.path import PathWorld
from cnpgen.world.world import World

States = tuple[Array, Array, Array]

Decide = Callable[[States, Array, Mask, CandidateBatch | None], Mask]
"""Function of the narrow phase, see ``narrow_phase_of``."""

# Of distances in compiled code, above which Coal does not measure them again.

MIN_SCENE_MARGIN_M = 1e-6
# Rounding error of a velocity that is zero in exact arithmetic.
ZERO_VELOCITY_ROUNDING_M_S = 1e-14


def acceptance(
    context: Context, written: set[str], *, given: Collection[End] = ()
) -> StageFunction:
    """Prepare the check of the columns that the stages write, which rejects under the first violated constraint.

    Accelerations and torques of the goal are checked if ``goal_ddq`` is among them. The
    tolerances of motions apply to ``given`` ends, whose state is from the user, for
    example a measurement; to others those of boundary states.
    """
    hit = ("hit_angle", "hit_speed") if "hit_angle" in written else ()
    start_count = _unmet_count(context, "start", (), written, given)
    goal_count = _unmet_count(context, "goal", hit, written, given)
    constraints = context.problem.constraint
    reasons = [each.boundary_reason or each.reason for each in constraints]
    reasons.append("tip not at its position")
    reasons += ["hit not along its direction"] if hit else []

    def accept(candidates: CandidateBatch, _random: np.random.Generator) -> None:
        poses = candidate_poses(context.problem, candidates)
        start = start_count(candidates, poses)
        goal = goal_count(candidates, poses)
        # A row is unmet if it is at one of both ends; the goal may have one row more,
        # the direction of the hit.
        np.maximum(start, goal[: len(start)], out=goal[: len(start)])
        candidates.reject_first(goal <= 0, reasons)

    return accept


def _unmet_count(
    context: Context,
    end: End,
    hit: tuple[str, ...],
    written: set[str],
    given: Collection[End],
) -> Callable[[CandidateBatch, Array], Array]:
    """Return the function that counts unmet conditions of one end, a row per constraint, the tip position and a hit."""
    exact = end not in given
    n = context.robot.n
    obstacles = context.problem.obstacle
    constraints = len(context.problem.constraint)
    kernel = context.kernels.load_by_structure(
        boundary_unmet,
        end=end,
        needs=2 if f"{end}_ddq" in written else 1,
        dtype=context.dtype,
        exact=exact,
        hitting=bool(hit),
    )
    has_scenes = scene_capacity(obstacles) and context.robot.shape is not None
    narrow_phase = narrow_phase_of_scenes if has_scenes else narrow_phase_of
    decide = narrow_phase(context, end, exact=exact)

    def unmet_count(candidates: CandidateBatch, obstacle_poses: Array) -> Array:
        # A free acceleration is not checked: zero takes its place in the kernel.
        acceleration = candidates.columns.get(f"{end}_ddq")
        if acceleration is None:
            acceleration = np.zeros((n, len(candidates.alive)))
        state = candidates[f"{end}_q"], candidates[f"{end}_dq"], acceleration
        others = (candidates[name] for name in (f"{end}_xyz", *hit))
        (count,) = kernel(*state, obstacle_poses, *others)
        if decide:
            # Only candidates that meet everything else need Coal.
            remaining = count[: constraints + 1].max(axis=0) <= 0
            count[:constraints] += decide(state, obstacle_poses, remaining, candidates)
        return np.asarray(count)

    return unmet_count


def boundary_unmet(
    robot: Robot,
    problem: Problem,
    *,
    end: End,
    needs: int,
    dtype: str,
    exact: bool = True,
    hitting: bool = False,
) -> Any:
    """Build ``(q, dq, ddq, obstacle_poses, position) -> unmet``, positive for violations above tolerance and for nan.

    For a hit it is ``(q, dq, ddq, obstacle_poses, position, angle, speed) -> unmet``:
    the tip velocity must be horizontal, along the angle, at the speed. Conditions on
    derivatives of q higher than ``needs`` are omitted. Unless the state is ``exact``,
    the tolerances of motions apply, and conditions for boundary states only are
    omitted. The narrow phase checks conservative conditions. There is a row per
    constraint, for the tip position, and for a hit.
    """
    import casadi as ca

    scene = problem.obstacle, problem.object_size, problem.scene_width
    columns, state = SymbolicState.of_symbols(robot, *scene)
    p_sx, p = symbols("p", 3)
    rows: list[Scalar] = []
    for constraint in problem.constraint:
        count: Scalar = ca.SX(0)
        conditions = constraint.symbolic(state)
        along = {item.name: constraint.allowed(item) for item in conditions}
        for condition in constraint.symbolic_at(state, end):
            # A conservative condition proves no violation; the narrow phase decides.
            if condition.sufficient or not (exact or condition.name in along):
                continue
            if symbolic_needs(condition, *columns[1:3]) <= needs:
                tolerance = condition.tolerance(dtype)
                if not exact:
                    tolerance = np.maximum(along[condition.name], tolerance)
                count = count + unmet(condition, tolerance)
        rows.append(count)
    miss = subtract(p, state.kinematics.tip)
    accepted = BOUNDARY_TOLERANCES[dtype]
    rows.append(ca.logic_not(ca.sqrt(dot(miss, miss)) <= accepted["position"]))
    hit = [ca.SX.sym("angle"), ca.SX.sym("speed")] if hitting else []
    if hit:
        velocity = state.along_table(state.tip_velocity)
        rows.append(_direction_unmet(velocity, *hit, dtype=dtype))
    return ca.Function(f"boundary_{end}", [*columns, p_sx, *hit], [ca.vertcat(*rows)])


def _direction_unmet(
    velocity: Vec, angle: Scalar, speed: Scalar, *, dtype: str
) -> Scalar:
    """Build a flag that is 1 unless the tip velocity on the table is along the angle, at the speed."""
    import casadi as ca

    cosine = ca.cos(angle)
    sine = ca.sin(angle)
    # Components of the velocity across the hit, d x v, and along it, d . v.
    across = ca.fabs(cosine * velocity[1] - sine * velocity[0])
    along = cosine * velocity[0] + sine * velocity[1] - speed
    exact = BOUNDARY_TOLERANCES[dtype]
    met = ca.logic_and(
        across <= exact["direction"] * speed + ZERO_VELOCITY_ROUNDING_M_S,
        ca.fabs(along) <= exact["velocity"],
    )
    return ca.logic_not(met)


def narrow_phase_of(context: Context, end: End, *, exact: bool = True) -> Decide | None:
    """Prepare the narrow phase of one end; return None if the problem never needs it.

    The tolerances of boundary states apply if it is ``exact``, otherwise those of
    motions.

    Returns:
        A function of states ``(q, dq, ddq)``, shape (n, N) each, obstacle poses, shape
        (width, N), a mask of the states to check, shape (N,), and the candidates. It
        returns a mask of the violated constraints, shape (constraints, N).
    """
    problem, robot, dtype = context.problem, context.robot, context.dtype
    has_shape = robot.shape is not None or robot.held_shape is not None
    if not has_shape and all(obstacle.upright for obstacle in problem.obstacle):
        return None
    kernel = context.kernels.load_by_structure(narrow_phase, end=end, dtype=dtype)
    path = PathWorld(robot, problem.obstacle, problem.object_size)

    def decide_states(
        state: States,
        obstacle_poses: Array,
        mask: Mask,
        _candidates: CandidateBatch | None,
    ) -> Mask:
        (unmet_counts,) = kernel(*state, obstacle_poses)
        remaining = (unmet_counts > 0) & mask
        violated = np.zeros_like(remaining)
        # The batched check has one scene for all states; others are measured one by
        # one.
        one_scene = bool(np.all(obstacle_poses == obstacle_poses[:, :1]))
        for row in np.flatnonzero(remaining.any(axis=1)):
            constraint = problem.constraint[row]
            if constraint.uses_obstacles and not one_scene:
                continue
            candidates = np.flatnonzero(remaining[row])
            tolerance = BOUNDARY_TOLERANCES[dtype]["position"]
            if not exact:
                tolerance = max(tolerance, constraint.effective_tolerance)
            chosen = (values[:, candidates] for values in state)
            q, dq, ddq = (np.ascontiguousarray(values, float) for values in chosen)
            path.set_path(q, dq, ddq, obstacle_poses[:, 0])
            met = constraint.met(path, tolerance)
            if met is not None:
                remaining[row, candidates], violated[row, candidates] = False, ~met
        return violated | measure_one_by_one(state, obstacle_poses, remaining)

    measure_one_by_one = _one_by_one(context, end, exact=exact)
    return decide_states


def narrow_phase_of_scenes(context: Context, end: End, *, exact: bool = True) -> Decide:
    """Prepare the narrow phase of one end among the obstacles of scenes, see ``narrow_phase_of``.

    Compiled collision checks accept states whose distances are more than
    ``MIN_SCENE_MARGIN_M`` above the required ones; Coal measures the others.
    """
    problem = context.problem
    clearance = SceneClearance(context)
    kinds = RobotClearance | SelfClearance
    by_distance = np.array(
        [isinstance(each, kinds) for each in problem.constraint], bool
    )
    measure_one_by_one = _one_by_one(context, end, exact=exact)
    obstacles, width = problem.obstacle, problem.scene_width
    _, symbolic_state = SymbolicState.of_symbols(
        context.robot, obstacles, problem.object_size, width
    )
    # The constraints with conservative conditions.
    conservative = ~by_distance
    for row in np.flatnonzero(conservative):
        conditions = problem.constraint[row].symbolic_at(symbolic_state, end)
        conservative[row] = any(condition.sufficient for condition in conditions)

    def decide_states(
        state: States,
        obstacle_poses: Array,
        mask: Mask,
        candidates: CandidateBatch | None,
    ) -> Mask:
        remaining = np.zeros((len(by_distance), len(mask)), bool)
        clear = np.zeros(len(mask), bool)
        if candidates is not None and candidates.scenes is not None:
            q = np.ascontiguousarray(state[0], float)
            margins = [MIN_SCENE_MARGIN_M] * 2
            scene, scenes = candidates.scene, candidates.scenes
            clear = clearance.are_clear(q, scene, scenes, *margins)
        # Compiled code proves most states clear; Coal decides on the others.
        remaining[by_distance] = ~clear & mask
        remaining[conservative] = mask
        return measure_one_by_one(state, obstacle_poses, remaining)

    return decide_states


def _one_by_one(
    context: Context, end: End, *, exact: bool
) -> Callable[[States, Array, Mask], Mask]:
    """Return a function that measures chosen constraints of states, one by one, with Pinocchio and Coal."""
    problem = context.problem
    world = World(context.robot, problem.obstacle, problem.object_size)

    def measure(state: States, obstacle_poses: Array, remaining: Mask) -> Mask:
        violated = np.zeros(remaining.shape, bool)
        for candidate in np.flatnonzero(remaining.any(axis=0)):
            q, dq, ddq = (
                np.ascontiguousarray(values[:, candidate]) for values in state
            )
            world.set_state(q, dq, ddq, obstacle_poses[:, candidate])
            for row in np.flatnonzero(remaining[:, candidate]):
                violated[row, candidate] = _violates(
                    problem.constraint[row], world, end, context.dtype, exact=exact
                )
        return violated

    return measure


def _violates(
    constraint: Constraint, world: World, end: End, dtype: str, *, exact: bool
) -> bool:
    """Return whether the measured form of a constraint is violated by more than the tolerance of a boundary state."""
    for condition in constraint.measured_at(world, end):
        g = np.array(condition.g, float)
        tolerance = condition.tolerance(dtype)
        tolerance = (
            tolerance if exact else np.maximum(tolerance, constraint.allowed(condition))
        )
        if not (
            (g >= condition.lower - tolerance) & (g <= condition.upper + tolerance)
        ).all():
            return True
    return False


def narrow_phase(robot: Robot, problem: Problem, *, end: End, dtype: str) -> Any:
    """Build ``(q, dq, ddq, obstacle_poses) -> unmet``: number of unmet conservative values of every constraint."""
    import casadi as ca

    columns, state = SymbolicState.of_symbols(
        robot, problem.obstacle, problem.object_size, problem.scene_width
    )
    rows: list[Scalar] = []
    for constraint in problem.constraint:
        conditions = [
            condition
            for condition in constraint.symbolic_at(state, end)
            if condition.sufficient
        ]
        rows.append(
            sum(
                (
                    unmet(condition, condition.tolerance(dtype))
                    for condition in conditions
                ),
                ca.SX(0),
            )
        )
    return ca.Function(f"narrow_phase_{end}", columns, [ca.vertcat(*rows)])


def unmet(condition: Condition, tolerance: Array) -> Scalar:
    """Count the values of a condition that violate its bounds by more than a tolerance; nan counts as a violation."""
    import casadi as ca

    count: Scalar = ca.SX(0)
    for value, low, high, allowed in zip(
        condition.g, condition.lower, condition.upper, tolerance, strict=True
    ):
        if np.isfinite(low):
            # Negated, so that nan counts as unmet.
            count = count + ca.logic_not(value >= float(low - allowed))
        if np.isfinite(high):
            count = count + ca.logic_not(value <= float(high + allowed))
    return count
