"""RRT-Connect of OMPL among obstacles, for problems without equality constraints; Coal checks the states."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from cnpgen.benchmark.planners.cbirrt import found_path, joint_bounds
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


class FreeSearch:
    """Search for a path of boundary problems of one problem.

    Args:
        problem: The problem.
        robot: Its robot, with link geometry.
    """

    def __init__(self, problem: Problem, robot: Robot) -> None:
        self._robot, self._states = robot, RestingStates(problem, robot)

    def place_obstacles(self, task: Plans) -> None:
        """Place the obstacles of a boundary problem."""
        self._states.place_solids(task.scene.bodies(0))

    def is_valid(self, q: Array) -> bool:
        """Return whether the robot can hold joint positions q [rad], shape (n,), without collision."""
        return bool(self._states.can_hold(q[:, None])[0] and self._states.are_clear(q[:, None])[0])

    def solve(
        self, ompl: Any, task: Plans, time_limit: float, simplify_time: float, step_size: float = 0.0
    ) -> Array | None:
        """Search for a path and simplify it.

        Args:
            ompl: The modules of OMPL.
            task: The boundary problem.
            time_limit: Time for the search [s].
            simplify_time: Time for simplifying the path [s].
            step_size: Largest step of the trees [rad]; 0 is the automatic value of OMPL.

        Returns:
            Joint positions [rad], shape (K, n), or None.
        """
        base, n = ompl.base, self._robot.n
        self.place_obstacles(task)
        space = base.RealVectorStateSpace(n)
        space.setBounds(joint_bounds(base, self._robot))
        information = base.SpaceInformation(space)
        information.setStateValidityCheckingResolution(STATE_DISTANCE_RAD / space.getMaximumExtent())
        setup = ompl.geometric.SimpleSetup(information)
        setup.setStateValidityChecker(lambda state: self.is_valid(np.array([state[index] for index in range(n)])))
        ends = [space.allocState() for _ in range(2)]
        for state, q in zip(ends, (task.boundary.start_q[0], task.boundary.goal_q[0]), strict=True):
            for index in range(n):
                state[index] = float(q[index])
        setup.setStartAndGoalStates(*ends)
        planner = ompl.geometric.RRTConnect(information)
        planner.setRange(step_size)
        setup.setPlanner(planner)
        return found_path(setup, n, time_limit, simplify_time)
