"""Shipped problems with limited jerks, and their stored plans."""

from dataclasses import replace
from functools import cache

import numpy as np

from cnpgen.problems.constraints.joint import JointJerk
from cnpgen.problems.load_robot import load_robot
from cnpgen.problems.problem import Problem
from cnpgen.robots.robot import Robot
from cnpgen.schema.keys import PerJoint
from tests.examples.plans import PROBLEMS, Plan, load

RATE = 20.0  # 1/s: jerk limits / acceleration limits; the limits of every joint differ a little


@cache
def jerk_limited(name: str, rate: float = RATE) -> tuple[Problem, Robot]:
    """Return a shipped problem with limited jerks, and its robot."""
    robot = load_robot(PROBLEMS[name])
    limits = rate * robot.acceleration_limit * (1 + 0.01 * np.arange(robot.n))
    problem = replace(
        PROBLEMS[name],
        limits=replace(PROBLEMS[name].limits, jerk=PerJoint(tuple(limits.tolist()))),
        constraint=(*PROBLEMS[name].constraint, JointJerk(tolerance=0.01)),
    )
    return problem, load_robot(problem)


def jerk_limited_plan(label: str) -> Plan:
    """Return a stored plan in the problem with limited jerks, which it violates by far."""
    plan = load(label)
    problem, robot = jerk_limited(plan.problem.name)
    return replace(plan, problem=problem, robot=robot)
