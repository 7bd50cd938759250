"""RRT-Connect with path simplification (OMPL), timed by TOPP-RA (Pham and Pham, 2018).

The search is that of CBiRRT on a constraint manifold, and plain RRT-Connect with Coal's
collision checks without one. The simplified path becomes a cubic spline, which TOPP-RA
times within the limits of velocity and acceleration, and of torque if the problem
limits it and there is no manifold. A goal in motion is met in speed along the path
only, as far as this is feasible.
"""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np

from cnpgen.addons.benchmark.benchmark_planner import (
    Answer,
    BenchmarkPlanner,
    Plan,
    Setting,
    require_rigid_torque,
)
from cnpgen.addons.benchmark.planners.cbirrt import (
    PathSearch,
    Search,
    joint_space,
    load_ompl,
    seed_ompl,
)
from cnpgen.addons.trajectories.sampled_trajectory import Trajectory
from cnpgen.arrays import Array
from cnpgen.errors import requires_extra
from cnpgen.pipelines.resting_states import RestingStates
from cnpgen.plans.plans import Plans
from cnpgen.problems.constraints.joint import JointTorque
from cnpgen.problems.problem import Problem
from cnpgen.problems.problem_record import open_problem
from cnpgen.robots.robot import Robot
from cnpgen.schema.keys import field

OUTPUT_PERIOD_S = 0.005
MIN_WAYPOINT_DISTANCE_RAD = 1e-4  # closer waypoints are joined
# Of the goal's speed, tried in this order.
END_RATE_FRACTIONS = 1.0, 0.75, 0.5, 0.25, 0.0
STATE_DISTANCE_RAD = 0.03  # largest distance of checked states of an edge


def has_manifold(problem: Problem, robot: Robot) -> bool:
    """Return whether a constraint of a problem is an equality, or the robot has no link geometry."""
    from cnpgen.world.world import World

    if robot.shape is None:
        return True
    world = World(robot, problem.obstacle, problem.object_size)
    conditions = [
        condition
        for constraint in problem.constraint
        for condition in constraint.judged(world)
    ]
    return any(
        bool(np.any(np.asarray(item.lower) == np.asarray(item.upper)))
        for item in conditions
    )


class FreeSearch(PathSearch):
    """Search among the obstacles of a boundary problem, which are placed around the states of the robot."""

    def __init__(self, states: RestingStates, robot: Robot, task: Plans) -> None:
        super().__init__(robot, task)
        self._states = states
        states.place_solids(task.scene.bodies(0))

    def is_valid(self, q: Array) -> bool:
        """Return whether the robot can hold joint positions q [rad], shape (n,), without collision."""
        return bool(
            self._states.can_hold(q[:, None])[0]
            and self._states.are_clear(q[:, None])[0]
        )

    def space(self, ompl: Any) -> tuple[Any, list[Any]]:
        """Return OMPL's information about the joint positions, and its states at start and goal."""
        space = joint_space(ompl.base, self._robot)
        information = ompl.base.SpaceInformation(space)
        # OMPL states the resolution as a fraction of the space's extent.
        information.setStateValidityCheckingResolution(
            STATE_DISTANCE_RAD / space.getMaximumExtent()
        )
        ends = [space.allocState() for _ in self._ends]
        for state, q in zip(ends, self._ends, strict=True):
            for index, position in enumerate(q.tolist()):
                state[index] = position
        return information, ends


def path_searches(problem: Problem, robot: Robot) -> Callable[[Plans], PathSearch]:
    """Return the function that prepares the search of a boundary problem: on the manifold, or among obstacles."""
    if has_manifold(problem, robot):
        return lambda task: Search(problem, robot, task)
    states = RestingStates(problem, robot)
    return lambda task: FreeSearch(states, robot, task)


@dataclass(frozen=True)
class RRTConnect(BenchmarkPlanner):
    """RRT-Connect on the constraint manifold with simplification (OMPL), timed by TOPP-RA."""

    simplify_time: float = field(
        "time for simplifying the path", unit="s", default=1.0, low=0.0
    )
    step_size: float = field(
        "largest step of the trees; 0: OMPL's automatic value",
        unit="rad",
        default=0.0,
        low=0.0,
    )

    def prepare(self, setting: Setting) -> Plan:
        """Import OMPL and TOPP-RA."""
        ompl = load_ompl()
        load_toppra()
        problem, robot = open_problem(setting.problem)
        search_for = path_searches(problem, robot)
        torque_limited = problem.first(JointTorque) is not None
        if torque_limited:
            require_rigid_torque("rrtconnect", problem, robot)

        def plan(task: Plans) -> Answer:
            seed_ompl(ompl, setting, task)
            # At least half of the time is for the search.
            simplify_time = min(self.simplify_time, setting.time_limit / 2)
            search = search_for(task)
            search_time = setting.time_limit - simplify_time
            path = search.solve(
                ompl, search_time, simplify_time=simplify_time, step_size=self.step_size
            )
            if path is None:
                return None
            if isinstance(search, Search):
                return timed_by_toppra(path, robot, task.boundary.goal_dq[0])
            return timed_by_toppra(
                path, robot, np.zeros(robot.n), torque=torque_limited
            )

        return plan


def load_toppra() -> Any:
    """Import TOPP-RA without its messages; raise MissingExtraError if it is missing."""
    with requires_extra("benchmark", "TOPP-RA"):
        import toppra
        import toppra.algorithm
        import toppra.constraint
    toppra.setup_logging("CRITICAL")
    return toppra


def timed_by_toppra(
    path: Array, robot: Robot, goal_dq: Array, *, torque: bool = False
) -> Trajectory | None:
    """Time a path from rest as fast as possible within the limits of velocity, acceleration and, optionally, torque.

    The path has shape (K, n) [rad], the velocities at the goal shape (n,) [rad/s].
    Return None if TOPP-RA finds no timing.
    """
    toppra = load_toppra()
    steps = np.linalg.norm(np.diff(path, axis=0), axis=1)
    kept = np.append(True, steps > MIN_WAYPOINT_DISTANCE_RAD)
    # The goal is a waypoint, however close the one before it is.
    kept[-1] = True
    points = path[kept]
    # The parameter of the spline is the length of the path, scaled to 1.
    length = np.append(0.0, np.cumsum(np.linalg.norm(np.diff(points, axis=0), axis=1)))
    if not np.all(np.diff(length, prepend=-1.0) > 0):
        # Start and goal coincide.
        return None
    spline = toppra.SplineInterpolator(length / length[-1], points)
    limits = [
        kind(np.stack([-limit, limit], axis=1))
        for kind, limit in (
            (toppra.constraint.JointVelocityConstraint, robot.velocity_limit),
            (toppra.constraint.JointAccelerationConstraint, robot.acceleration_limit),
        )
    ]
    if torque:
        limits.append(_torque_constraint(toppra, robot))
    timing = toppra.algorithm.TOPPRA(
        limits, spline, parametrizer="ParametrizeConstAccel"
    )
    tangent = spline(1.0, 1)
    # Speed ds/dt whose velocity p' ds/dt is nearest to that of the goal.
    end_rate = max(float(tangent @ goal_dq / (tangent @ tangent)), 0.0)
    # The full speed may be infeasible at the end of the path.
    for fraction in END_RATE_FRACTIONS:
        timed = timing.compute_trajectory(0.0, fraction * end_rate)
        if timed is not None:
            return _sampled(timed)
    return None


def _torque_constraint(toppra: Any, robot: Robot) -> Any:
    """Return TOPP-RA's constraint of joint torques by inverse dynamics, without friction."""
    import pinocchio as pin

    data = robot.model.createData()

    def inverse_dynamics(q: Array, dq: Array, ddq: Array) -> Array:
        return np.array(pin.rnea(robot.model, data, q, dq, ddq))

    limits = np.stack([-robot.torque_limit, robot.torque_limit], axis=1)
    return toppra.constraint.JointTorqueConstraint(
        inverse_dynamics, limits, np.zeros(robot.n)
    )


def _sampled(timed: Any) -> Trajectory:
    """Sample a timed path; cubics interpolate positions and velocities."""
    duration = float(timed.duration)
    t = np.linspace(0.0, duration, max(int(np.ceil(duration / OUTPUT_PERIOD_S)), 1) + 1)
    return Trajectory(t, np.asarray(timed(t)), np.asarray(timed(t, 1)))
