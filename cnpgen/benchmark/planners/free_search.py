"""RRT-Connect of OMPL among obstacles, for problems without equality constraints; Coal checks the states."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from cnpgen.benchmark.planners.cbirrt import PathSearch, joint_space
from cnpgen.pipelines.families.resting_states import RestingStates
from cnpgen.plans.plans import Plans
from cnpgen.problems.problem import Problem
from cnpgen.robots.robot import Robot

Array = NDArray[np.float64]

STATE_DISTANCE_RAD = 0.03  # largest distance of checked states of an edge


def has_manifold(problem: Problem, robot: Robot) -> bool:
    """Return whether a constraint of a problem is an equality, or the robot has no link geometry."""
    from cnpgen.world.world import World

    if robot.shape is None:
        return True
    world = World(robot, problem.obstacle, problem.object_size)
    conditions = [condition for constraint in problem.constraint for condition in constraint.judged(world)]
    return any(bool(np.any(np.asarray(item.lower) == np.asarray(item.upper))) for item in conditions)


class FreeSearch(PathSearch):
    """Search among obstacles.

    Args:
        states: States of the robot, which has link geometry; the obstacles of the boundary problem are placed.
        robot: The robot.
        task: The boundary problem.
    """

    def __init__(self, states: RestingStates, robot: Robot, task: Plans) -> None:
        super().__init__(robot, task)
        self._states = states
        states.place_solids(task.scene.bodies(0))

    def is_valid(self, q: Array) -> bool:
        """Return whether the robot can hold joint positions q [rad], shape (n,), without collision."""
        return bool(self._states.can_hold(q[:, None])[0] and self._states.are_clear(q[:, None])[0])

    def space(self, ompl: Any) -> tuple[Any, list[Any]]:
        """Return OMPL's information about the joint positions, and its states at start and goal."""
        space = joint_space(ompl.base, self._robot)
        information = ompl.base.SpaceInformation(space)
        information.setStateValidityCheckingResolution(STATE_DISTANCE_RAD / space.getMaximumExtent())
        ends = [space.allocState() for _ in self._ends]
        for state, q in zip(ends, self._ends, strict=True):
            for index, position in enumerate(q.tolist()):
                state[index] = position
        return information, ends
