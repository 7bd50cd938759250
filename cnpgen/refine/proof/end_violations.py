"""Violations of constraints by the boundary states themselves, measured by Pinocchio and Coal."""

from collections.abc import Iterator

import numpy as np
from numpy.typing import NDArray

from cnpgen.problems.conditions import measured_needs
from cnpgen.problems.constraints.constraint import Condition, Constraint
from cnpgen.problems.constraints.joint import JointTorque
from cnpgen.problems.problem import Problem
from cnpgen.refine.proof.reachable_positions import joint_limits
from cnpgen.robots.robot import Robot
from cnpgen.robots.scene import Scene
from cnpgen.store.joint_units import unit_of
from cnpgen.trajectory.boundary import Boundary
from cnpgen.world.world import World

Array = NDArray[np.float64]
# Relative to the bound, or absolute, by the derivative on which a condition depends: more than the condition changes
# within the verdict's tolerances of boundary conditions, 1e-6 rad, 1e-6 rad/s and 1e-4 rad/s^2.
BOUNDARY_MARGIN = (1e-5, 1e-5, 1e-3)


def end_violations(
    problem: Problem, robot: Robot, boundary: Boundary, scene: Scene
) -> Iterator[tuple[Constraint, str]]:
    """Yield the constraints that an end of one motion violates by more than their tolerance, with a description.

    If the boundary conditions leave the acceleration at the goal free, there must be one within its limits whose
    torques are within theirs.
    """
    world = World(robot, problem.obstacle, problem.object_size)
    (obstacle_poses,) = scene.poses
    goal_ddq = np.zeros(robot.n) if boundary.goal_ddq is None else boundary.goal_ddq[0]
    ends = {
        "start": (boundary.start_q[0], boundary.start_dq[0], boundary.start_ddq[0]),
        "goal": (boundary.goal_q[0], boundary.goal_dq[0], goal_ddq),
    }
    orders = measured_needs([constraint.judged for constraint in problem.constraint], world)
    world.set_state(*ends["start"], obstacle_poses)
    tip = world.tip_position
    for end, state in ends.items():
        world.set_state(*state, obstacle_poses)
        free = end == "goal" and boundary.goal_ddq is None
        pairs = [(constraint, condition) for constraint in problem.constraint for condition in constraint.judged(world)]
        for (constraint, condition), order in zip(pairs, orders, strict=True):
            if not (free and order == 2):
                texts = _violation(constraint, condition, tip, end, BOUNDARY_MARGIN[order])
                yield from ((constraint, text) for text in texts)
    torque = problem.first(JointTorque)
    if boundary.goal_ddq is None and torque is not None and not _has_acceleration(problem, world, torque):
        yield torque, "at the goal there is no acceleration within its limits whose torques are within theirs"


def _violation(
    constraint: Constraint, condition: Condition, start_tip: Array, end: str, margin: float
) -> Iterator[str]:
    """Describe a violation of a measured condition by more than tolerance and margin, see ``BOUNDARY_MARGIN``."""
    g = np.array(condition.g, float)
    phase = np.array([0.0 if end == "start" else 1.0])
    relaxation = float(constraint.bound_relaxation(condition, phase, start_tip)[0])
    bound = np.where(g < condition.lower, condition.lower - relaxation, condition.upper + relaxation)
    violation = np.maximum(condition.lower - g, g - condition.upper) - relaxation
    tolerance = constraint.allowed(condition)
    worst = int(np.argmax(violation - tolerance))
    if violation[worst] > tolerance[worst] + margin * max(1.0, abs(bound[worst])):
        unit = "" if condition.unit == "1" else f" {unit_of(condition.unit, worst)}"
        part = f" of {condition.parts[worst]}" if condition.parts else ""
        yield (
            f"at the {end} {condition.name}{part} is {g[worst]:.6g}{unit}, expected {bound[worst]:.6g}{unit}"
            f" with a tolerance of {tolerance[worst]:.2g}{unit}"
        )


def _has_acceleration(problem: Problem, world: World, torque: JointTorque) -> bool:
    """Return whether an acceleration within its limits, tolerances included, has torques within theirs."""
    import pinocchio as pin
    from scipy.optimize import linprog

    robot, q, dq = world.robot, world.q, world.dq
    acceleration = joint_limits(problem, robot, tolerances=1.0).acceleration
    limit = robot.torque_limit * (1 + torque.tolerance + BOUNDARY_MARGIN[2]) + BOUNDARY_MARGIN[2]
    model, data = world.parameters.model, world.parameters.model.createData()
    bias = np.array(pin.rnea(model, data, q, dq, np.zeros(robot.n)))
    inertia = np.array([pin.rnea(model, data, q, dq, unit) - bias for unit in np.eye(robot.n)]).T
    solved = linprog(
        np.zeros(robot.n),
        A_ub=np.vstack([inertia, -inertia]),
        b_ub=np.concatenate([limit - bias, limit + bias]),
        bounds=[(-value, value) for value in acceleration],
        method="highs",
    )
    return bool(solved.status != 2)  # 2: infeasible
