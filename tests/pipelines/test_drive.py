"""Boundary accelerations and proofs of infeasibility with drives, by the torques of the motors."""

from dataclasses import replace

import numpy as np
import pinocchio as pin

from cnpgen.pipelines.stages.boundary_motion import table_acceleration, table_velocity
from cnpgen.problems.constraints.joint import JointTorque
from cnpgen.problems.load_robot import load_robot
from cnpgen.problems.problem import Problem
from cnpgen.problems.problem_file import load_problem
from cnpgen.refine.proof.end_check import _limited_torques
from cnpgen.robots.drive import DriveSpec
from cnpgen.schema.keys import PerJoint
from cnpgen.world.world import World

TORQUE = JointTorque(tolerance=5e-3)
DRIVE = DriveSpec(
    armature=PerJoint((3.4, 3.4, 3.4, 3.4, 1.3, 1.2)),
    viscous=PerJoint((3.0,)),
    coulomb=PerJoint((4.0, 5.0, 2.0, 4.0, 5.0, 0.0)),
)


def table_problem(**changes: object) -> Problem:
    return replace(load_problem("airhockey"), drive=replace(DRIVE, **changes))


def violations(world: World) -> float:
    return max(each.violation() for each in TORQUE.measured(world))


def test_accelerations_on_the_table_meet_the_limits_of_the_motors() -> None:
    """At either end of the interval along a direction a limit is active, and none is exceeded."""
    for limits in ("both", "motor", "joint"):
        problem = table_problem(limits=limits, torque=PerJoint((60.0,)))
        robot, random = load_robot(problem), np.random.default_rng(2)
        velocities, accelerations = table_velocity(robot), table_acceleration(robot)
        world, active = World(robot), 0
        for _ in range(120):
            q = robot.home + random.uniform(-0.2, 0.2, robot.n)
            dq, _ = velocities(q, random.uniform(-1, 1, robot.n), random.uniform())
            dq = dq.full().ravel()
            direction = random.uniform(-1, 1, robot.n)
            ddq, length = accelerations(q, dq, direction, 1.0)
            if float(length) < 0:
                continue
            ddq = ddq.full().ravel()
            world.set_state(q, dq, ddq, np.empty(0))
            assert violations(world) < 1e-9
            assert (np.abs(ddq) <= robot.acceleration_limit * (1 + 1e-9)).all()
            further = ddq + 1e-3 * (
                ddq - accelerations(q, dq, direction, 0.0)[0].full().ravel()
            )
            world.set_state(q, dq, further, np.empty(0))
            bounded = (np.abs(further) > robot.acceleration_limit).any()
            assert bounded or violations(world) > 0
            active += not bounded
        assert active > 3 or limits == "joint"  # whose limits are far


def test_proofs_limit_the_torques_of_the_constraint() -> None:
    """The linear program over accelerations has the rows of the constraint, for any acceleration."""
    for limits in ("both", "motor", "joint"):
        robot = load_robot(table_problem(limits=limits))
        world, random = World(robot), np.random.default_rng(3)
        model, data = robot.model, robot.model.createData()
        still = np.zeros(robot.n)
        for _ in range(10):
            q, dq, ddq = robot.home, *random.uniform(-0.2, 0.2, (2, robot.n))
            bias = pin.rnea(model, data, q, dq, still).copy()
            units = [pin.rnea(model, data, q, dq, e) - bias for e in np.eye(robot.n)]
            matrix, value, limit = _limited_torques(robot, np.array(units).T, bias, dq)
            world.set_state(q, dq, ddq, np.empty(0))
            conditions = TORQUE.measured(world)
            rows = np.concatenate([np.array(each.g) for each in conditions])
            bounds = np.concatenate([each.upper for each in conditions])
            order, expected = (
                np.lexsort((limit, matrix @ ddq + value)),
                np.lexsort((bounds, rows)),
            )
            np.testing.assert_allclose(
                (matrix @ ddq + value)[order], rows[expected], atol=1e-9
            )
            np.testing.assert_allclose(limit[order], bounds[expected])
