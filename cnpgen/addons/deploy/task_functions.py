"""Build the CasADi function of a task: expected time, scene and features from the boundary conditions.

It is flattened to a tape like all functions of the planner, so that the C file needs no
handwritten kinematics.
"""

from functools import reduce
from typing import Any

from cnpgen.addons.deploy.check_functions import relaxed
from cnpgen.errors import UsageError
from cnpgen.kernels.symbolic.kinematics import forward_kinematics, tip_velocity
from cnpgen.kernels.symbolic.linalg import Vec, symbols
from cnpgen.kernels.symbolic.symbolic_state import SymbolicState
from cnpgen.planner.network.features import ARRIVAL, PARAMETERS, STATES
from cnpgen.planner.tasks import (
    MIN_EXPECTED_TIME_S,
    MIN_TRAVEL_TIME_S,
    reaching_time,
)
from cnpgen.problems.constraints.puck_contact import (
    MIN_HIT_SPEED_M_S,
    PUCK_OUT_OF_REACH_M,
    PuckContact,
)
from cnpgen.problems.constraints.tip_manifold import TipManifold, along
from cnpgen.problems.problem import Problem
from cnpgen.robots.robot import Robot
from cnpgen.robots.solid import height_places, place_obstacles

CONDITION_NAMES = (*STATES, ARRIVAL)  # columns of the ends, in their order


def task(
    robot: Robot,
    problem: Problem,
    *,
    fixed_at_goal: int,
    expected_time: str,
    blocks: tuple[str, ...],
) -> Any:
    """Build ``(ends, parameters) -> (expected time [s], scene, features)`` of one task.

    The scene are its obstacle poses, then the relaxations of ``_start_off``.
    The feature of the expected time is the time itself; the C code takes its logarithm,
    which is no operation of tapes. Ends are those of ``control_point_functions``.
    """
    import casadi as ca

    ends_sx, ends = symbols("ends", (3 + fixed_at_goal) * robot.n)
    parameters_sx, parameters = symbols("parameters", len(problem.parameters))
    split = [ends[i : i + robot.n] for i in range(0, len(ends), robot.n)]
    conditions = dict(zip(CONDITION_NAMES, split, strict=False))
    start = forward_kinematics(robot.chain, conditions["start_q"])
    goal = forward_kinematics(robot.chain, conditions["goal_q"])
    velocity = tip_velocity(goal, conditions["goal_dq"])
    given = {"velocity": velocity, "parameters": parameters}
    poses = _scene(robot, problem, start.tip, goal.tip, **given)
    time = _expected_time(
        robot, problem, ends_sx, conditions, parameters, kind=expected_time
    )
    features = {
        **conditions,
        "sin_cos": _sin_cos([*conditions["start_q"], *conditions["goal_q"]]),
        "tips": [*start.tip, *goal.tip],
        "expected_time": [time],
        PARAMETERS: parameters,
    }
    values = [value for block in blocks for value in features[block]]
    scene = [*poses, *_start_off(robot, problem, start.tip, poses)]
    outputs = [ca.SX(time), _column(scene), _column(values)]
    return ca.Function("task", [ends_sx, parameters_sx], ca.cse(outputs))


def _sin_cos(angles: Vec) -> Vec:
    import casadi as ca

    return [*map(ca.sin, angles), *map(ca.cos, angles)]


def _expected_time(
    robot: Robot,
    problem: Problem,
    ends: Any,
    conditions: dict[str, Vec],
    parameters: Vec,
    *,
    kind: str,
) -> Any:
    """Return the unit of durations, as ``planner.task_preprocessor`` computes it [s]."""
    import casadi as ca

    if kind == "reach":
        fixed = ends.numel() // robot.n - 3
        return reaching_time(robot, fixed_at_goal=fixed)(ends)
    names = problem.parameters.names
    factor = (
        parameters[names.index("velocity_factor")]
        if "velocity_factor" in names
        else 1.0
    )
    least = MIN_TRAVEL_TIME_S if kind == "travel" else MIN_EXPECTED_TIME_S
    pairs = zip(conditions["start_q"], conditions["goal_q"], strict=True)
    times = [
        ca.fabs(goal - start) / (float(limit) * factor)
        for (start, goal), limit in zip(pairs, robot.velocity_limit, strict=True)
    ]
    return reduce(ca.fmax, times, ca.SX(least))


def _scene(
    robot: Robot,
    problem: Problem,
    start_tip: Vec,
    goal_tip: Vec,
    *,
    velocity: Vec,
    parameters: Vec,
) -> Vec:
    """Return the values of a scene as ``problems.obstacles.scene_of`` computes them."""
    half = 0.0 if problem.object is None else problem.object.size[2] / 2
    bottoms = {"start": start_tip[2] - half, "goal": goal_tip[2] - half}
    poses: Vec = place_obstacles(problem.obstacle).tolist()
    for obstacle, place in zip(
        problem.obstacle, height_places(problem.obstacle), strict=True
    ):
        # The heights are those for a bottom at 0, and move with it.
        if obstacle.below and obstacle.top is None:
            poses[place] = poses[place] + bottoms[obstacle.below]
    constraint = problem.scene_constraint
    if constraint is not None:
        if not isinstance(constraint, PuckContact):
            raise UsageError(
                f"{type(constraint).__name__} has values of each motion that C planners do not compute"
            )
        values = [0.0] * constraint.scene_width
        state = _still(robot, problem, [*poses, *values, *parameters])
        poses += _puck(
            constraint, state.on_table(goal_tip), state.along_table(velocity)
        )
    return [*poses, *parameters]


def _puck(constraint: PuckContact, goal: Vec, velocity: Vec) -> Vec:
    """Return x and y of the goal and of the puck ahead of it [m], out of reach if the goal is no hit."""
    import casadi as ca

    speed = ca.sqrt(velocity[0] ** 2 + velocity[1] ** 2)
    factor = constraint.contact_distance / ca.fmax(speed, MIN_HIT_SPEED_M_S)
    puck = [goal[i] + factor * velocity[i] for i in range(2)]
    is_hit = speed > MIN_HIT_SPEED_M_S
    return [
        ca.if_else(is_hit, value, PUCK_OUT_OF_REACH_M) for value in (*goal[:2], *puck)
    ]


def _start_off(robot: Robot, problem: Problem, tip: Vec, poses: Vec) -> Vec:
    """Return the distances of the start from the manifolds, as ``TipManifold.start_off`` computes them [m]."""
    import casadi as ca

    state = _still(robot, problem, poses)
    distances = []
    for index in relaxed(problem):
        manifold = problem.constraint[index]
        assert isinstance(manifold, TipManifold)
        place = manifold.place
        position = state.on_table(tip) if manifold.moves_with_table else tip
        pairs = zip(place.held, place.height.tolist(), strict=True)
        off = [ca.fabs(along(row, position) - height) for row, height in pairs]
        distances.append(ca.fmin(reduce(ca.fmax, off), manifold.band))
    return distances


def _still(robot: Robot, problem: Problem, poses: Vec) -> SymbolicState:
    """Return a state for the frame of its table, which parameters among the poses may move."""
    zero = [0.0] * robot.n
    return SymbolicState(robot, zero, zero, zero, poses, problem.obstacle, None)


def _column(values: Vec) -> Any:
    import casadi as ca

    return ca.densify(ca.vertcat(*values)) if values else ca.SX(0, 1)
