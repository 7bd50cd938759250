"""CBiRRT: OMPL's RRTConnect on a projected state space.

The constraint has one dimension: the height of the tip or the tilt of the object, to
0.01. The planner ignores velocities and accelerations. The path is timed by the
velocity limits and followed linearly, as in the paper.
"""

from abc import ABC, abstractmethod
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np

from cnpgen.addons.benchmark.benchmark_planner import (
    Answer,
    BenchmarkPlanner,
    Plan,
    Setting,
)
from cnpgen.addons.benchmark.planners.obstacle_boxes import (
    MAX_CORNER_PENETRATION_M,
    MIN_OBJECT_DISTANCE_M,
    boxes_of,
    depth,
    distance,
    require_table_or_transport,
)
from cnpgen.addons.benchmark.simulator.tip import Tip
from cnpgen.addons.trajectories.sampled_trajectory import Trajectory
from cnpgen.arrays import Array
from cnpgen.errors import requires_extra
from cnpgen.plans.plans import Plans
from cnpgen.problems.constraints.table import Table
from cnpgen.problems.problem import Problem
from cnpgen.problems.problem_record import open_problem
from cnpgen.robots.robot import Robot
from cnpgen.robots.shape.hull import CUBE
from cnpgen.schema.keys import field

MANIFOLD_TOLERANCE = 0.01
MAX_PROJECTIONS, LAMBDA = 50, 2.0  # defaults of OMPL
MAX_GOAL_ERROR_RAD = 0.01
SEEDS = 2**31  # number of seeds of OMPL
STEP_PAUSE_S = 1e-4  # added to the time of every step


@dataclass(frozen=True)
class CBiRRT(BenchmarkPlanner):
    """Bidirectional trees on the constraint manifold (OMPL's RRTConnect on ProjectedStateSpace)."""

    step_size: float = field(
        "largest step of the trees; 0: OMPL's automatic value",
        unit="rad",
        default=0.0,
        low=0.0,
    )
    delta: float = field(
        "distance of projected states along an edge", unit="rad", default=0.05, low=1e-3
    )

    def prepare(self, setting: Setting) -> Plan:
        """Import OMPL."""
        ompl = load_ompl()
        problem, robot = open_problem(setting.problem)
        require_table_or_transport(problem)

        def plan(task: Plans) -> Answer:
            seed_ompl(ompl, setting, task)
            search = Search(problem, robot, task, self.delta)
            path = search.solve(ompl, setting.time_limit, step_size=self.step_size)
            return None if path is None else timed(path, robot.velocity_limit)

        return plan


def load_ompl() -> Any:
    """Import OMPL without its messages; raise MissingExtraError if it is missing."""
    with requires_extra("benchmark", "OMPL"):
        import ompl.base
        import ompl.geometric
        import ompl.util
    ompl.util.setLogLevel(ompl.util.LogLevel.LOG_NONE)
    return ompl


def seed_ompl(ompl: Any, setting: Setting, task: Plans) -> None:
    """Seed the generators that OMPL constructs next, so that a search depends on its own problem only."""
    ompl.util.RNG.setSeed(int(setting.random(task).integers(1, SEEDS)))


def joint_space(base: Any, robot: Robot) -> Any:
    """Return OMPL's space of joint positions within the limits of a robot."""
    space = base.RealVectorStateSpace(robot.n)
    bounds = base.RealVectorBounds(robot.n)
    for index, (low, high) in enumerate(
        zip(robot.position_lower.tolist(), robot.position_upper.tolist(), strict=True)
    ):
        bounds.setLow(index, low)
        bounds.setHigh(index, high)
    space.setBounds(bounds)
    return space


def timed(path: Array, velocity_limit: Array) -> Trajectory:
    """Time a path, shape (K, n), so that one joint is at its velocity limit [rad/s] in every step."""
    # The slowest joint determines a step: max_j |dq_j| / V_j.
    steps = (
        np.max(np.abs(np.diff(path, axis=0)) / velocity_limit, axis=1) + STEP_PAUSE_S
    )
    return Trajectory(np.append(0.0, np.cumsum(steps)), path)


class PathSearch(ABC):
    """Search for a path of one boundary problem by OMPL's RRTConnect."""

    max_goal_error = float(np.finfo(float).eps)  # rad

    def __init__(self, robot: Robot, task: Plans) -> None:
        self._robot = robot
        self._ends = (task.boundary.start_q[0], task.boundary.goal_q[0])

    @abstractmethod
    def is_valid(self, q: Array) -> bool:
        """Return whether joint positions q [rad], shape (n,), are valid."""

    @abstractmethod
    def space(self, ompl: Any) -> tuple[Any, list[Any]]:
        """Return OMPL's information about the space, and its states at start and goal."""

    def solve(
        self,
        ompl: Any,
        time_limit: float,
        *,
        simplify_time: float = 0.0,
        step_size: float = 0.0,
    ) -> Array | None:
        """Search for a path and simplify it; return joint positions [rad], shape (K, n), or None.

        Times are in seconds; without time for simplifying, the path is kept as it was
        found. The largest step of the trees is in radians; 0 is the automatic value of
        OMPL.
        """
        information, ends = self.space(ompl)
        setup = ompl.geometric.SimpleSetup(information)
        planner = ompl.geometric.RRTConnect(information)
        joints = range(self._robot.n)
        setup.setStateValidityChecker(
            lambda state: self.is_valid(np.array([state[index] for index in joints]))
        )
        setup.setStartAndGoalStates(*ends, self.max_goal_error)
        planner.setRange(step_size)
        setup.setPlanner(planner)
        setup.setup()
        setup.solve(time_limit)
        if not setup.haveExactSolutionPath():
            return None
        if simplify_time > 0:
            setup.simplifySolution(simplify_time)
        path = setup.getSolutionPath()
        path.interpolate()
        return np.array(
            [[state[index] for index in joints] for state in path.getStates()]
        )


class Search(PathSearch):
    """Search on the constraint manifold.

    ``delta`` is the distance of projected states along an edge [rad].
    """

    max_goal_error = MAX_GOAL_ERROR_RAD

    def __init__(
        self, problem: Problem, robot: Robot, task: Plans, delta: float = 0.05
    ) -> None:
        super().__init__(robot, task)
        self._tip = Tip(robot)
        self._data = robot.model.createData()
        self._delta = delta
        self._table = problem.first(Table)
        if self._table is None:
            self._size, self._boxes = boxes_of(problem, task.scene)

    def residual(self, q: Array) -> tuple[float, Array]:
        """Return the residual of the manifold at q [m or 1] and its gradient, shape (n,)."""
        position, rotation, J = self._tip.at(q)
        if self._table is not None:
            return float(position[2] - self._table.z), J[2]
        # With dR/dt = w x R, the gradient of R_22 has the z components of w_j x (R
        # e_z).
        return float(rotation[2, 2] - 1.0), np.cross(J[3:].T, rotation[:, 2])[:, 2]

    def is_valid(self, q: Array) -> bool:
        """Return whether the tip is over the table, or the object is clear and the torques are within limits."""
        import pinocchio as pin

        position, rotation, _ = self._tip.at(q)
        if self._table is not None:
            x = self._table.x
            y = self._table.y
            return bool(
                x.low <= position[0] <= x.high and y.low <= position[1] <= y.high
            )
        # Velocities are ignored, so only torques of gravity count.
        gravity_torque = pin.computeGeneralizedGravity(self._robot.model, self._data, q)
        if np.any(np.abs(gravity_torque) > self._robot.holding_limit):
            return False
        corners = position + (CUBE * self._size) @ rotation.T
        return all(
            distance(position, box)[0] > MIN_OBJECT_DISTANCE_M
            and all(
                depth(corner, box)[0] < MAX_CORNER_PENETRATION_M for corner in corners
            )
            for box in self._boxes
        )

    def space(self, ompl: Any) -> tuple[Any, list[Any]]:
        """Return OMPL's information about the manifold, and its states at start and goal."""
        constraint = _constraint(ompl.base, self._robot.n, self.residual)
        manifold = ompl.base.ProjectedStateSpace(
            joint_space(ompl.base, self._robot), constraint
        )
        manifold.setDelta(self._delta)
        manifold.setLambda(LAMBDA)
        ends = [manifold.allocState() for _ in self._ends]
        for state, q in zip(ends, self._ends, strict=True):
            state.copy(q.tolist())
        return ompl.base.ConstrainedSpaceInformation(manifold), ends


def _constraint(
    base: Any, n: int, residual: Callable[[Array], tuple[float, Array]]
) -> Any:
    """Wrap a residual for OMPL."""

    class Manifold(base.Constraint):  # type: ignore[misc]
        def __init__(self) -> None:
            super().__init__(n, 1, MANIFOLD_TOLERANCE)

        def function(self, x: Any, out: Any) -> None:
            out[0] = residual(np.array(x))[0]

        def jacobian(self, x: Any, out: Any) -> None:
            out[0, :] = residual(np.array(x))[1]

    manifold = Manifold()
    manifold.setMaxIterations(MAX_PROJECTIONS)
    return manifold
