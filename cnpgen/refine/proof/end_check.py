"""Check of the ends of a motion alone: no path between them helps if one of them is invalid.

For an end with state ``(q, dq, ddq)`` and every condition ``lower <= g(q, dq, ddq) <= upper``
of the problem, in its measured form (Pinocchio and Coal), an end is invalid if

    max(lower - g, g - upper) > tolerance + margin.

The tolerance is that of the verdict. The margin covers what the verdict accepts as the
same boundary conditions, so that a violation is a proof for every motion.
"""

from collections.abc import Iterator

import numpy as np

from cnpgen.arrays import Array
from cnpgen.problems.conditions import condition_orders
from cnpgen.problems.constraints.constraint import Condition, Constraint
from cnpgen.problems.constraints.joint import (
    POWER_UNIT,
    JointTorque,
    MotorTorques,
    motor_conditions,
)
from cnpgen.problems.problem import Problem
from cnpgen.refine.proof.reachable_positions import joint_limits
from cnpgen.robots.robot import Robot
from cnpgen.robots.scene import Scene
from cnpgen.store.joint_units import unit_of
from cnpgen.trajectory.boundary import Boundary
from cnpgen.world.drive import friction_bounds
from cnpgen.world.world import World

# Relative to the bound, or absolute, by the derivative on which a condition depends:
# more than the condition changes within the verdict's tolerances of boundary
# conditions, 1e-6 rad, 1e-6 rad/s and 1e-4 rad/s^2.
BOUNDARY_MARGIN = (1e-5, 1e-5, 1e-3)


class EndCheck:
    """Check of the ends of the motions of one problem.

    It keeps the robot among its obstacles between calls. Making them again takes four
    times as long as a check.
    """

    def __init__(self, problem: Problem, robot: Robot) -> None:
        self._problem = problem
        self._world = World(robot, problem.obstacle, problem.object_size)
        self._torque = problem.first(JointTorque)
        self._orders = condition_orders(problem, self._world, "judged")

    def violations(
        self, boundary: Boundary, scene: Scene
    ) -> Iterator[tuple[Constraint, str]]:
        """Yield the constraints that an end of one motion violates, with a description of end, part and value.

        If the boundary conditions leave the acceleration at the goal free, there must be
        one within its limits whose torques are within theirs.
        """
        world, (obstacle_poses,) = self._world, scene.poses
        free_goal = boundary.goal_ddq is None
        goal_ddq = (
            np.zeros(world.robot.n)
            if boundary.goal_ddq is None
            else boundary.goal_ddq[0]
        )
        ends = {
            "start": (boundary.start_q[0], boundary.start_dq[0], boundary.start_ddq[0]),
            "goal": (boundary.goal_q[0], boundary.goal_dq[0], goal_ddq),
        }
        world.set_state(*ends["start"], obstacle_poses)
        # Relaxations of bounds depend on the start of the motion, at both ends.
        start_tip = world.tip_position
        for end, state in ends.items():
            world.set_state(*state, obstacle_poses)
            for constraint, condition, order in self._conditions():
                # an acceleration that is free may still meet its limits
                if not (end == "goal" and free_goal and order == 2):
                    margin = BOUNDARY_MARGIN[order]
                    texts = _violation(constraint, condition, start_tip, end, margin)
                    yield from ((constraint, text) for text in texts)
        if self._torque is None or not free_goal:
            return
        if not _has_acceleration(self._problem, world, self._torque):
            yield (
                self._torque,
                "at the goal there is no acceleration within its limits whose torques are within theirs",
            )

    def _conditions(self) -> Iterator[tuple[Constraint, Condition, int]]:
        """Yield the constraints with their conditions at the present state and the derivatives that these need."""
        pairs = (
            (constraint, condition)
            for constraint in self._problem.constraint
            for condition in constraint.judged(self._world)
        )
        for (constraint, condition), order in zip(pairs, self._orders, strict=True):
            yield constraint, condition, order


def _violation(
    constraint: Constraint,
    condition: Condition,
    start_tip: Array,
    end: str,
    margin: float,
) -> Iterator[str]:
    """Describe a violation of a measured condition by more than tolerance and margin, see ``BOUNDARY_MARGIN``."""
    g = np.array(condition.g, float)
    if not g.size:
        # Distances from obstacles, in a scene without any.
        return
    phase = np.array([0.0 if end == "start" else 1.0])
    relaxation = float(constraint.bound_relaxation(condition, phase, start_tip)[0])
    bound = np.where(
        g < condition.lower, condition.lower - relaxation, condition.upper + relaxation
    )
    violation = np.maximum(condition.lower - g, g - condition.upper) - relaxation
    tolerance = constraint.allowed(condition)
    # One value is named: the one furthest beyond its tolerance.
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

    robot = world.robot
    q = world.q
    dq = world.dq
    acceleration = joint_limits(problem, robot, tolerances=1.0).acceleration
    model = world.parameters.model
    data = world.parameters.model.createData()
    # tau(ddq) = M ddq + bias: columns of the inertia matrix M are tau(unit) - bias.
    bias = np.array(pin.rnea(model, data, q, dq, np.zeros(robot.n)))
    inertia = np.array(
        [pin.rnea(model, data, q, dq, unit) - bias for unit in np.eye(robot.n)]
    ).T
    inertia, bias, limit = _limited_torques(robot, inertia, bias, dq)
    limit = limit * (1 + torque.tolerance + BOUNDARY_MARGIN[2]) + BOUNDARY_MARGIN[2]
    # Feasibility of |M ddq + bias| <= limit with |ddq| <= ddq_max, a linear program
    # without an objective.
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
    # The motor also accelerates its rotor: tau + J ddq.
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
