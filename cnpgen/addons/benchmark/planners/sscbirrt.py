"""CBiRRT of the package ``sscbirrt`` (Berenson et al., 2011), with its own shortcuts and timing.

Its Python search is used, because the validity checks are those of the other samplers.
The path is shortened and timed within the limits of velocity and acceleration by Hauser
and Ng-Thow-Hing (2010). It ignores the velocities of both ends, which are at rest.
"""

from dataclasses import dataclass
from types import SimpleNamespace
from typing import Any

import numpy as np

from cnpgen.addons.benchmark.benchmark_planner import (
    BenchmarkPlanner,
    Plan,
    Setting,
    distinct_times,
)
from cnpgen.addons.benchmark.planners.cbirrt import (
    MANIFOLD_TOLERANCE,
    MAX_PROJECTIONS,
    SEEDS,
    PathSearch,
    Search,
)
from cnpgen.addons.benchmark.planners.rrtconnect import path_searches
from cnpgen.addons.trajectories.sampled_trajectory import Trajectory
from cnpgen.arrays import Array
from cnpgen.errors import requires_extra
from cnpgen.plans.plans import Plans
from cnpgen.problems.problem_record import open_problem
from cnpgen.robots.robot import Robot
from cnpgen.schema.keys import field

# Default of the package; states of the path may be ten times further away.

PROJECTION_TOLERANCE = 1e-3
MIN_BREAK_DISTANCE_S = 1e-9  # closer breaks of the acceleration are joined


@dataclass(frozen=True)
class SSCBiRRT(BenchmarkPlanner):
    """CBiRRT with shortcuts in time and timing (package sscbirrt), from rest to rest."""

    step_size: float = field(
        "largest step of the trees", unit="rad", default=0.1, low=1e-3
    )

    def prepare(self, setting: Setting) -> Plan:
        """Import the package."""
        load_sscbirrt()
        problem, robot = open_problem(setting.problem)
        search_for = path_searches(problem, robot)
        return lambda task: self._plan(setting, robot, task, search_for(task))

    def _plan(
        self, setting: Setting, robot: Robot, task: Plans, search: PathSearch
    ) -> Trajectory | None:
        """Search for a path and time it; return None without a path in time."""
        package = load_sscbirrt()
        manifold = ManifoldSet(search) if isinstance(search, Search) else None
        joints = SimpleNamespace(
            dof=robot.n, joint_limits=(robot.position_lower, robot.position_upper)
        )
        validity = SimpleNamespace(is_valid=search.is_valid)
        config = package.CBiRRTConfig(
            timeout=setting.time_limit, step_size=self.step_size
        )
        planner = package.CBiRRT(joints, collision_checker=validity, config=config)
        start, goal = (
            package.FiniteSet([q[0]], metric=planner.space.distance)
            for q in (task.boundary.start_q, task.boundary.goal_q)
        )
        question = package.PlanningProblem(
            planner.space, start, goal, validity, path_constraint=manifold
        )
        limits = package.TrajectoryOptions(
            robot.velocity_limit, robot.acceleration_limit
        )
        seed = int(setting.random(task).integers(SEEDS))
        try:
            result = planner.solve(question, seed=seed, trajectory=limits)
        except package.PlanningError:
            # An end is invalid.
            return None
        return sampled(result.trajectory) if result.success else None


class ManifoldSet:
    """Set of joint positions at which the residual of a search is small, in the interface of the package."""

    def __init__(self, search: Search) -> None:
        self._search = search

    def contains(self, q: Array) -> bool:
        """Return whether the residual at q is within the tolerance."""
        return abs(self._search.residual(q)[0]) <= MANIFOLD_TOLERANCE

    def project(self, _previous: Array, proposed: Array) -> Array | None:
        """Project a configuration by Newton's method.

        Return None if it does not converge.
        """
        q = np.array(proposed, float)
        for _ in range(MAX_PROJECTIONS):
            residual, gradient = self._search.residual(q)
            if abs(residual) <= PROJECTION_TOLERANCE:
                return q
            # Newton step of minimum norm: q -= r g / |g|^2.
            q -= (
                residual
                * gradient
                / max(float(gradient @ gradient), np.finfo(float).tiny)
            )
        return None


def load_sscbirrt() -> Any:
    """Import the package; raise MissingExtraError if it is missing."""
    with requires_extra("planners", "sscbirrt"):
        import sscbirrt
    return sscbirrt


def sampled(motion: Any) -> Trajectory | None:
    """Return a ``sscbirrt.Trajectory`` at the breaks of its accelerations, between which cubics are exact."""
    times = [np.zeros(1)]
    for piece, start in zip(motion.pieces, motion.breaks, strict=False):
        for ramp in piece.ramps:
            ends = np.cumsum([span for span, _ in ramp.pieces])
            times.append(start + ends)
    times.append(np.array([motion.duration]))
    t = distinct_times(np.concatenate(times), MIN_BREAK_DISTANCE_S)
    if len(t) < 2:
        return None
    q, dq, _ = motion.evaluate(t)
    return Trajectory(t, q, dq)
