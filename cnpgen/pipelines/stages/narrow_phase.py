"""Narrow phase: exact checks with Pinocchio and Coal of boundary states that conservative conditions cannot accept.

A capsule contains its link: if the capsule has clearance, so has the link. Otherwise the convex parts of the link are
checked.
"""

from collections.abc import Callable
from typing import Any

import numpy as np
from numpy.typing import NDArray

from cnpgen.kernels.symbolic.linalg import Scalar
from cnpgen.kernels.symbolic.symbolic_state import SymbolicState
from cnpgen.pipelines.context import Context
from cnpgen.pipelines.stages.scene_clearance import SceneClearance
from cnpgen.pipelines.stages.stage import CandidateBatch
from cnpgen.problems.constraints.clearance import RobotClearance
from cnpgen.problems.constraints.constraint import BOUNDARY_TOLERANCES, Condition, Constraint, End
from cnpgen.problems.constraints.link_clearance import SelfClearance
from cnpgen.problems.problem import Problem
from cnpgen.robots.robot import Robot
from cnpgen.world.path import PathWorld
from cnpgen.world.world import World

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]
States = tuple[Array, Array, Array]

Decide = Callable[[States, Array, Mask, CandidateBatch | None], Mask]
"""Function of the narrow phase, see ``narrow_phase_of``."""

MIN_SCENE_MARGIN_M = 1e-6  # of distances in compiled code, above which Coal does not measure them again


def narrow_phase_of(context: Context, end: End, *, exact: bool = True) -> Decide | None:
    """Prepare the narrow phase of one end; return None if the problem never needs it.

    The tolerances of boundary states apply if it is ``exact``, otherwise those of motions.

    Returns:
        A function of states ``(q, dq, ddq)``, shape (n, N) each, obstacle poses, shape (width, N), a mask of the states
        to check, shape (N,), and the candidates. It returns a mask of the violated constraints, shape (constraints, N).
    """
    problem, robot = context.problem, context.robot
    if robot.shape is None and robot.held_shape is None and all(obstacle.upright for obstacle in problem.obstacle):
        return None
    kernel = context.kernels.load_by_structure(narrow_phase, end=end, dtype=context.dtype)
    path = PathWorld(robot, problem.obstacle, problem.object_size)

    def decide_states(state: States, obstacle_poses: Array, mask: Mask, _candidates: CandidateBatch | None) -> Mask:
        (unmet_counts,) = kernel(*state, obstacle_poses)
        remaining, violated = (unmet_counts > 0) & mask, np.zeros(unmet_counts.shape, bool)
        one_scene = bool(np.all(obstacle_poses == obstacle_poses[:, :1]))
        for row in np.flatnonzero(remaining.any(axis=1)):
            if problem.constraint[row].uses_obstacles and not one_scene:
                continue
            candidates = np.flatnonzero(remaining[row])
            tolerance = _tolerance(problem.constraint[row], context.dtype, exact=exact)
            q, dq, ddq = (np.ascontiguousarray(values[:, candidates], float) for values in state)
            path.set_path(q, dq, ddq, obstacle_poses[:, 0])
            met = problem.constraint[row].met(path, tolerance)
            if met is not None:
                remaining[row, candidates], violated[row, candidates] = False, ~met
        return violated | measure_one_by_one(state, obstacle_poses, remaining)

    measure_one_by_one = _one_by_one(context, end, exact=exact)
    return decide_states


def narrow_phase_of_scenes(context: Context, end: End, *, exact: bool = True) -> Decide:
    """Prepare the narrow phase of one end among the obstacles of scenes, see ``narrow_phase_of``.

    Compiled collision checks accept states whose distances are more than ``MIN_SCENE_MARGIN_M`` above the required
    ones; Coal measures the others.
    """
    problem, clearance = context.problem, SceneClearance(context)
    by_distance = np.array([isinstance(each, RobotClearance | SelfClearance) for each in problem.constraint], bool)
    measure_one_by_one = _one_by_one(context, end, exact=exact)
    conservative = _conservative(context, end) & ~by_distance

    def decide_states(state: States, obstacle_poses: Array, mask: Mask, candidates: CandidateBatch | None) -> Mask:
        q, remaining = np.ascontiguousarray(state[0], float), np.zeros((len(by_distance), len(mask)), bool)
        clear = np.zeros(len(mask), bool)
        if candidates is not None and candidates.scenes is not None:
            clear = clearance.are_clear(q, candidates.scene, candidates.scenes, MIN_SCENE_MARGIN_M, MIN_SCENE_MARGIN_M)
        remaining[by_distance] = ~clear & mask
        remaining[conservative] = mask
        return measure_one_by_one(state, obstacle_poses, remaining)

    return decide_states


def _conservative(context: Context, end: End) -> Mask:
    """Return which constraints have conservative conditions at an end, shape (constraints,)."""
    robot, problem = context.robot, context.problem
    _, state = SymbolicState.of_symbols(robot, problem.obstacle, problem.object_size, problem.scene_width)
    each = (
        () if isinstance(constraint, RobotClearance | SelfClearance) else constraint.symbolic_at(state, end)
        for constraint in problem.constraint
    )
    return np.array([any(condition.sufficient for condition in conditions) for conditions in each], bool)


def _one_by_one(context: Context, end: End, *, exact: bool) -> Callable[[States, Array, Mask], Mask]:
    """Return a function that measures chosen constraints of states, one by one, with Pinocchio and Coal."""
    problem = context.problem
    world = World(context.robot, problem.obstacle, problem.object_size)

    def measure(state: States, obstacle_poses: Array, remaining: Mask) -> Mask:
        violated = np.zeros(remaining.shape, bool)
        for candidate in np.flatnonzero(remaining.any(axis=0)):
            q, dq, ddq = (np.ascontiguousarray(values[:, candidate]) for values in state)
            world.set_state(q, dq, ddq, obstacle_poses[:, candidate])
            for row in np.flatnonzero(remaining[:, candidate]):
                violated[row, candidate] = _violates(problem.constraint[row], world, end, context.dtype, exact=exact)
        return violated

    return measure


def _tolerance(constraint: Constraint, dtype: str, *, exact: bool) -> float:
    """Return the tolerance of a boundary state for conditions in units of length [m]."""
    tolerance = BOUNDARY_TOLERANCES[dtype]["position"]
    return tolerance if exact else max(tolerance, constraint.effective_tolerance)


def _violates(constraint: Constraint, world: World, end: End, dtype: str, *, exact: bool) -> bool:
    """Return whether the measured form of a constraint is violated by more than the tolerance of a boundary state."""
    for condition in constraint.measured_at(world, end):
        g, tolerance = np.array(condition.g, float), condition.tolerance(dtype)
        tolerance = tolerance if exact else np.maximum(tolerance, constraint.allowed(condition))
        if not ((g >= condition.lower - tolerance) & (g <= condition.upper + tolerance)).all():
            return True
    return False


def narrow_phase(robot: Robot, problem: Problem, *, end: End, dtype: str) -> Any:
    """Build ``(q, dq, ddq, obstacle_poses) -> unmet``: number of unmet conservative values of every constraint."""
    import casadi as ca

    columns, state = SymbolicState.of_symbols(robot, problem.obstacle, problem.object_size, problem.scene_width)
    rows: list[Scalar] = []
    for constraint in problem.constraint:
        conditions = [condition for condition in constraint.symbolic_at(state, end) if condition.sufficient]
        rows.append(sum((unmet(condition, condition.tolerance(dtype)) for condition in conditions), ca.SX(0)))
    return ca.Function(f"narrow_phase_{end}", columns, [ca.vertcat(*rows)])


def unmet(condition: Condition, tolerance: Array) -> Scalar:
    """Count the values of a condition that violate its bounds by more than a tolerance; nan counts as a violation."""
    import casadi as ca

    count: Scalar = ca.SX(0)
    for value, low, high, allowed in zip(condition.g, condition.lower, condition.upper, tolerance, strict=True):
        if np.isfinite(low):
            count = count + ca.logic_not(value >= float(low - allowed))
        if np.isfinite(high):
            count = count + ca.logic_not(value <= float(high + allowed))
    return count
