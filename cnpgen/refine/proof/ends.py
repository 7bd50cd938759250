"""What is wrong with the ends of a motion themselves, whatever lies between them: measured by Pinocchio and Coal."""

from collections.abc import Iterator

import numpy as np
from numpy.typing import NDArray

from cnpgen.problems.constraints.constraint import Condition, Constraint
from cnpgen.problems.constraints.joint import JointTorque
from cnpgen.problems.constraints.needs import measured_needs
from cnpgen.problems.obstacles import obstacle_tops
from cnpgen.problems.problem import Problem
from cnpgen.refine.proof.reachable import joint_limits
from cnpgen.robots.robot import Robot
from cnpgen.store.joint_units import unit_of
from cnpgen.trajectory.boundary import Boundary
from cnpgen.world.state import World

Array = NDArray[np.float64]
# Relative to the bound, or absolute, by the derivative that a condition needs: more than it can change within what the
# verdict lets boundary conditions be missed by, 1e-6 rad, 1e-6 rad/s and 1e-4 rad/s^2.
MARGIN = (1e-5, 1e-5, 1e-3)


def end_mistakes(
    problem: Problem, robot: Robot, boundary: Boundary, *, start_xyz: Array, goal_xyz: Array
) -> Iterator[str]:
    """Say which constraints an end of one motion breaks by more than they allow.

    The acceleration at the goal is free unless the boundary conditions hold it: then there must be one within the
    limits whose torques are, too.

    Args:
        problem: The problem.
        robot: Its robot.
        boundary: Boundary conditions of one motion.
        start_xyz: Position of the tip at the start [m], shape (3,).
        goal_xyz: Position of the tip at the goal [m], shape (3,).
    """
    world, tops = World(robot, problem.obstacle, problem.object_size), obstacle_tops(problem, start_xyz, goal_xyz)
    goal_ddq = np.zeros(robot.n) if boundary.goal_ddq is None else boundary.goal_ddq[0]
    ends = {
        "start": (boundary.start_q[0], boundary.start_dq[0], boundary.start_ddq[0]),
        "goal": (boundary.goal_q[0], boundary.goal_dq[0], goal_ddq),
    }
    needs = measured_needs([constraint.measured for constraint in problem.constraint], world)
    world.set_state(*ends["start"], tops)
    tip = world.tip_position
    for end, state in ends.items():
        world.set_state(*state, tops)
        free = end == "goal" and boundary.goal_ddq is None
        found = [(each, condition) for each in problem.constraint for condition in each.measured(world)]
        for (constraint, condition), need in zip(found, needs, strict=True):
            if not (free and need == 2):
                yield from _broken(constraint, condition, tip, end, MARGIN[need])
    if boundary.goal_ddq is None and not _has_acceleration(problem, robot, *ends["goal"][:2]):
        yield "at the goal there is no acceleration within its limits whose torques are within theirs"


def _broken(constraint: Constraint, condition: Condition, start_tip: Array, end: str, margin: float) -> Iterator[str]:
    """Say whether a measured condition is exceeded by more than its constraint allows and a margin, see ``MARGIN``."""
    g = np.array(condition.g, float)
    wider = float(constraint.funnel(condition, np.array([0.0 if end == "start" else 1.0]), start_tip)[0])
    bound = np.where(g < condition.lower, condition.lower - wider, condition.upper + wider)
    excess = np.maximum(condition.lower - g, g - condition.upper) - wider
    allowed = constraint.allowed(condition)
    worst = int(np.argmax(excess - allowed))
    if excess[worst] > allowed[worst] + margin * max(1.0, abs(bound[worst])):
        unit = "" if condition.unit == "1" else f" {unit_of(condition.unit, worst)}"
        yield (
            f"at the {end} {condition.name} is {g[worst]:.6g}{unit}, expected {bound[worst]:.6g}{unit}"
            f" with a tolerance of {allowed[worst]:.2g}{unit}"
        )


def _has_acceleration(problem: Problem, robot: Robot, q: Array, dq: Array) -> bool:
    """Whether accelerations within their limits, tolerances included, exist whose torques are within theirs."""
    import pinocchio as pin
    from scipy.optimize import linprog

    torque = [each for each in problem.constraint if isinstance(each, JointTorque)]
    if not torque:
        return True
    acceleration = joint_limits(problem, robot, tolerances=1.0).acceleration
    limit = robot.torque_limit * (1 + min(each.tolerance for each in torque) + MARGIN[2]) + MARGIN[2]
    data = robot.model.createData()
    bias = np.array(pin.rnea(robot.model, data, q, dq, np.zeros(robot.n)))
    inertia = np.array([pin.rnea(robot.model, data, q, dq, unit) - bias for unit in np.eye(robot.n)]).T
    solved = linprog(
        np.zeros(robot.n),
        A_ub=np.vstack([inertia, -inertia]),
        b_ub=np.concatenate([limit - bias, limit + bias]),
        bounds=[(-each, each) for each in acceleration],
        method="highs",
    )
    return bool(solved.status != 2)  # 2: HiGHS calls it infeasible
