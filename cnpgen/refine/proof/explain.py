"""Explanations of boundary problems without a valid plan: a proof of infeasibility, or none.

A proof does not depend on splines: it holds for every motion that the verdict would
accept, tolerances included. The ends, the reachable joint positions and the edges of
the table suffice for most infeasible problems. A problem without a proof may have a
valid plan.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from enum import StrEnum
from itertools import chain

import numpy as np
from numpy.typing import NDArray

from cnpgen.errors import UsageError
from cnpgen.plans.plans import Plans
from cnpgen.problems.conditions import measured_needs
from cnpgen.problems.constraints.constraint import Condition, Constraint
from cnpgen.problems.constraints.joint import (
    POWER_UNIT,
    JointTorque,
    MotorTorques,
    motor_conditions,
)
from cnpgen.problems.problem import Problem
from cnpgen.refine.proof.reachable_positions import (
    end_states,
    joint_limits,
    sample_times,
)
from cnpgen.refine.proof.table_proof import find_table_exit
from cnpgen.robots.robot import Robot
from cnpgen.robots.scene import Scene
from cnpgen.schema.argument_types import checked_arguments
from cnpgen.schema.arguments import integer
from cnpgen.store.joint_units import unit_of
from cnpgen.trajectory.boundary import Boundary
from cnpgen.world.drive import friction_bounds
from cnpgen.world.world import World

Array = NDArray[np.float64]
# Relative to the bound, or absolute, by the derivative on which a condition depends:
# more than the condition changes within the verdict's tolerances of boundary
# conditions, 1e-6 rad, 1e-6 rad/s and 1e-4 rad/s^2.
BOUNDARY_MARGIN = (1e-5, 1e-5, 1e-3)
# For motion between the times of the verdict, and its tolerance of boundary conditions.
POSITION_MARGIN_RAD = 1e-4


class Feasibility(StrEnum):
    """Result of an explanation."""

    INFEASIBLE = "infeasible"
    VERGE = "on the verge"
    UNKNOWN = "gave up"


@dataclass(frozen=True)
class Explanation:
    """Explanation of one problem.

    Attributes:
        kind: Result.
        text: The proof, or a description of what else is known.
    """

    kind: Feasibility
    text: str

    def __str__(self) -> str:
        """Return result and text in one line."""
        return f"{self.kind}: {self.text}"


def explain_failure(
    problem: Problem, robot: Robot, boundary: Boundary, scene: Scene
) -> Explanation:
    """Explain why no valid plan of a boundary problem was found: one motion, with a scene of one sample."""
    conditions = (scene.poses, *vars(boundary).values())
    if not all(values is None or np.isfinite(values).all() for values in conditions):
        return Explanation(
            Feasibility.INFEASIBLE, "the boundary conditions are not finite"
        )
    violations = (text for _, text in end_violations(problem, robot, boundary, scene))
    for text in chain(violations, _cannot_brake(problem, robot, boundary)):
        return Explanation(Feasibility.INFEASIBLE, text)
    unknown = Explanation(Feasibility.UNKNOWN, "there is no proof of infeasibility")
    return _off_table(problem, robot, boundary) or unknown


@checked_arguments
def explain_plans(
    plans: Plans, indices: Sequence[int] | None = None
) -> dict[int, Explanation]:
    """Explain why no valid plans of some problems were found.

    Args:
        plans: The plans.
        indices: Indices of the plans to explain; by default all whose status is not
            valid.

    Returns:
        Index -> explanation.

    Raises:
        UsageError: An index is out of range.
    """
    from cnpgen.plans.format import PlanStatus
    from cnpgen.plans.tips import correct_tips
    from cnpgen.problems.problem_record import open_problem

    if indices is None:
        indices = np.flatnonzero(plans.status != PlanStatus.VALID).tolist()
    indices = [integer("indices", index) for index in indices]
    if wrong := [index for index in indices if not 0 <= index < len(plans)]:
        raise UsageError(
            f"there are plans 0 to {len(plans) - 1}, got {wrong[0]}", concerns="indices"
        )
    if not indices:
        return {}
    plans = correct_tips(plans)
    problem, robot = open_problem(plans.problem)
    return {
        index: explain_failure(
            problem, robot, plans.boundary[index : index + 1], plans.scene[index]
        )
        for index in indices
    }


def end_violations(
    problem: Problem, robot: Robot, boundary: Boundary, scene: Scene
) -> Iterator[tuple[Constraint, str]]:
    """Yield the constraints that an end of one motion violates by more than their tolerance, with a description.

    If the boundary conditions leave the acceleration at the goal free, there must be
    one within its limits whose torques are within theirs.
    """
    world = World(robot, problem.obstacle, problem.object_size)
    (obstacle_poses,) = scene.poses
    goal_ddq = np.zeros(robot.n) if boundary.goal_ddq is None else boundary.goal_ddq[0]
    ends = {
        "start": (boundary.start_q[0], boundary.start_dq[0], boundary.start_ddq[0]),
        "goal": (boundary.goal_q[0], boundary.goal_dq[0], goal_ddq),
    }
    orders = measured_needs(
        [constraint.judged for constraint in problem.constraint], world
    )
    world.set_state(*ends["start"], obstacle_poses)
    tip = world.tip_position
    for end, state in ends.items():
        world.set_state(*state, obstacle_poses)
        free = end == "goal" and boundary.goal_ddq is None
        pairs = [
            (constraint, condition)
            for constraint in problem.constraint
            for condition in constraint.judged(world)
        ]
        for (constraint, condition), order in zip(pairs, orders, strict=True):
            if not (free and order == 2):
                texts = _violation(
                    constraint, condition, tip, end, BOUNDARY_MARGIN[order]
                )
                yield from ((constraint, text) for text in texts)
    torque = problem.first(JointTorque)
    if (
        boundary.goal_ddq is None
        and torque is not None
        and not _has_acceleration(problem, world, torque)
    ):
        yield (
            torque,
            "at the goal there is no acceleration within its limits whose torques are within theirs",
        )


def _violation(
    constraint: Constraint,
    condition: Condition,
    start_tip: Array,
    end: str,
    margin: float,
) -> Iterator[str]:
    """Describe a violation of a measured condition by more than tolerance and margin, see ``BOUNDARY_MARGIN``."""
    g = np.array(condition.g, float)
    phase = np.array([0.0 if end == "start" else 1.0])
    relaxation = float(constraint.bound_relaxation(condition, phase, start_tip)[0])
    bound = np.where(
        g < condition.lower, condition.lower - relaxation, condition.upper + relaxation
    )
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
    model, data = world.parameters.model, world.parameters.model.createData()
    bias = np.array(pin.rnea(model, data, q, dq, np.zeros(robot.n)))
    inertia = np.array(
        [pin.rnea(model, data, q, dq, unit) - bias for unit in np.eye(robot.n)]
    ).T
    inertia, bias, limit = _limited_torques(robot, inertia, bias, dq)
    limit = limit * (1 + torque.tolerance + BOUNDARY_MARGIN[2]) + BOUNDARY_MARGIN[2]
    solved = linprog(
        np.zeros(robot.n),
        A_ub=np.vstack([inertia, -inertia]),
        b_ub=np.concatenate([limit - bias, limit + bias]),
        bounds=[(-value, value) for value in acceleration],
        method="highs",
    )
    return bool(solved.status != 2)  # 2: infeasible


def _limited_torques(
    robot: Robot, inertia: Array, bias: Array, dq: Array
) -> tuple[Array, Array, Array]:
    """Return matrix, torque without acceleration, and limit of all limited torques: (m, n), (m,), (m,).

    With drives they are the torques at the joints and at the motors, whose friction has
    a highest and a lowest value.
    """
    drive = robot.drive
    if drive is None:
        return inertia, bias, robot.torque_limit
    lowest, highest = friction_bounds(drive, dq)
    with_rotors = inertia + np.diag(drive.armature)
    rows = (
        [(inertia, bias, robot.torque_limit)]
        if drive.limits_joint
        else [(inertia[:0], bias[:0], robot.torque_limit[:0])]
    )
    state = MotorTorques(dq, (bias + lowest, bias + highest))
    for condition in motor_conditions(robot, drive, state):
        centers, halves = condition.middle
        joints = [robot.joint_names.index(name) for name in condition.parts]
        # A power is the torque times the velocity, which does not change.
        factor = dq[joints] if condition.unit == POWER_UNIT else np.ones(len(joints))
        matrix = factor[:, None] * with_rotors[joints]
        rows.append((matrix, np.array(condition.g) - centers, halves))
    matrices, values, limits = map(np.concatenate, zip(*rows, strict=True))
    return matrices, values, limits


def _cannot_brake(problem: Problem, robot: Robot, boundary: Boundary) -> Iterator[str]:
    """Describe the joints that leave their range for any acceleration."""
    limits = joint_limits(problem, robot, tolerances=1.0)
    times = sample_times(boundary, limits)
    for end, state in end_states(boundary).items():
        for time in times:
            lower, upper = state.box(float(time), limits)
            for joint in np.flatnonzero(lower > upper + POSITION_MARGIN_RAD):
                instant, name = _time_text(end, float(time)), robot.joint_names[joint]
                violation = float(lower[joint] - upper[joint]) - POSITION_MARGIN_RAD
                unit = unit_of(robot.units("rad"), int(joint))
                yield f"{instant} {name} is {violation:.2g} {unit} or more outside its range, for any acceleration"


def _off_table(
    problem: Problem, robot: Robot, boundary: Boundary
) -> Explanation | None:
    """Explain whether the tip must leave a table."""
    table_exit = find_table_exit(problem, robot, boundary)
    if table_exit is None:
        return None
    subject = f"{_time_text(table_exit.end, table_exit.time)} the tip"
    distance = f"{1e3 * abs(table_exit.distance):.2g} mm"
    if table_exit.proven:
        text = f"{subject} is {distance} or more off the table, for any acceleration"
        return Explanation(Feasibility.INFEASIBLE, text)
    best = (
        f"has {distance} of the table left"
        if table_exit.distance < 0
        else f"is {distance} off the table"
    )
    return Explanation(
        Feasibility.VERGE,
        f"{subject} {best} at best, by a local search without tolerances",
    )


def _time_text(end: str, time: float) -> str:
    return f"{1e3 * time:.0f} ms {'after the start' if end == 'start' else 'before the goal'}"
