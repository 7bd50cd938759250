"""Plans fitted to sampled trajectories of any planner, as initial guesses of the refiner.

The ends of the fitted motions are moved onto the constraints.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Literal

import numpy as np
from numpy.typing import ArrayLike

from cnpgen.addons.trajectories.evaluate_trajectories import (
    check_trajectories,
    non_negative,
)
from cnpgen.addons.trajectories.fit import fit_motion, largest_error
from cnpgen.addons.trajectories.sampled_trajectory import Trajectory
from cnpgen.addons.trajectories.samples import sampled_boundary
from cnpgen.addons.trajectories.trajectory_scenes import problem_of_samples
from cnpgen.arrays import Array, Mask
from cnpgen.errors import UsageError
from cnpgen.judges.plans.continuous_collision import is_contact
from cnpgen.machine.threads import one_thread
from cnpgen.plans.plans import Plans, make_plans
from cnpgen.problems.constraints.constraint import End
from cnpgen.problems.obstacles import scene_of
from cnpgen.problems.problem import Problem
from cnpgen.problems.problem_record import open_problem
from cnpgen.robots.robot import Robot
from cnpgen.schema.argument_types import checked_arguments
from cnpgen.store.dataset_spec import StoredProblem
from cnpgen.store.scene_table import OBSTACLE_POSES
from cnpgen.trajectory.boundary import Boundary, join_boundaries
from cnpgen.trajectory.spline_motion import Motion
from cnpgen.trajectory.trajectory_spec import MAX_CONTROL_POINTS, TrajectorySpec
from cnpgen.world.world import World

State = tuple[Array, Array, Array]

# Of the positions at the samples, plus the noise, with more control points otherwise.
MAX_FIT_ERROR_RAD = 2e-3
GROWTH = 1.6  # of the number of control points of the path, per attempt
FIT_SAMPLES_PER_POINT = 4  # of the path, at most
# Of the path, from which velocities of the samples are not needed.
MIN_SAMPLES_PER_POINT = 2
REST_WINDOW_S = 0.05  # in which noise of the positions looks like a velocity
MIN_SNAP_RAD = 1e-3  # distance by which positions may always be moved
SNAP_FACTOR = 3.0  # largest change of positions by snapping, relative to the noise
MAX_ITERATIONS = 12  # of snapping
DIFFERENCE = 1e-6  # of central differences, in units of the scaled state
# Distance from a violated bound, relative to its range, at which a state is placed.
BOUND_INSET = 1e-6
MAX_RESIDUAL = 1e-10  # at which the iteration ends
# A change of 1 mrad counts as much as one of 0.1 rad/s, or of 100 rad/s^2.
SCALES = 1.0, 100.0, 1e5


@dataclass(frozen=True, eq=False)
class ImportedTrajectories:
    """Plans of N sampled trajectories.

    Attributes:
        plans: The plans, with one number of control points for all.
        deviation: Largest distance of a plan from its samples over all joints [rad],
            shape (N,).
        max_deviation: Largest distance that the fit may have [rad]; plans are farther
            from their samples only if no path of ``MAX_CONTROL_POINTS`` meets it.
        snapped: Largest change of a boundary position [rad], shape (N,); nan where the
            constraints cannot be met by a small change, so that the boundary conditions
            are those of the samples.
    """

    plans: Plans
    deviation: Array
    max_deviation: float
    snapped: Array

    @property
    def meets_samples(self) -> Mask:
        """Whether each plan is within the stated error of its samples, shape (N,)."""
        return self.deviation <= self.max_deviation


@checked_arguments
@one_thread()
def import_trajectories(
    problem: Problem | StoredProblem | str | Path,
    trajectories: Sequence[Trajectory],
    *,
    noise: ArrayLike = 0.0,
    at_rest: bool | Literal["start", "goal"] = False,
    source: str = "",
) -> ImportedTrajectories:
    """Fit plans to sampled trajectories.

    Boundary conditions are those of the first and the last sample; derivatives that are
    not given are estimated, and zero within the noise. The states are then moved onto
    the constraints of the problem, by a change of positions of at most three times the
    noise or 1 mrad. The path has as many control points as the samples require for an
    error of 2 mrad plus the noise, at most ``MAX_CONTROL_POINTS``.

    Args:
        problem: Problem, record, or name or path of a problem, pipeline or dataset.
        trajectories: The trajectories, with the problem's joints in their order.
        noise: Largest error of the samples in SI units: one number for positions,
            velocities and accelerations, or three.
        at_rest: Ends at which all motions are at rest: "start", "goal", or True for
            both.
        source: Source of the plans, a line of text.

    Raises:
        UsageError: An argument is invalid, or a trajectory has another number of
            joints.
    """
    record = problem_of_samples(problem)
    check_trajectories(trajectories, record)
    errors = non_negative("noise", noise, 3)
    snapper = StateSnapper(*open_problem(record))
    ends = [
        _boundary(trajectory, errors, snapper, at_rest=at_rest)
        for trajectory in trajectories
    ]
    boundaries = [boundary for boundary, _ in ends]
    snapped = np.array([change for _, change in ends])
    max_error = MAX_FIT_ERROR_RAD + float(errors[0])
    motions, deviation = _fitted(trajectories, boundaries, record.trajectory, max_error)
    poses = [trajectory.obstacle_poses for trajectory in trajectories]
    placed = [row for row in poses if row is not None]
    if 0 < len(placed) < len(poses):
        raise UsageError("must all have scenes, or none", argument="trajectories")
    plans = make_plans(
        record,
        join_boundaries(boundaries),
        columns={OBSTACLE_POSES: np.array(placed)} if placed else {},
        path_control_points=np.concatenate([motion.path for motion in motions]),
        rate_control_points=np.concatenate([motion.rate for motion in motions]),
        source=source,
    )
    return ImportedTrajectories(plans, deviation, max_error, snapped)


def distance_from_samples(
    plans: Plans, imported: Plans, trajectories: Sequence[Trajectory]
) -> Array:
    """Compute the largest distances of refined paths from the samples of their imported plans [rad], shape (N,).

    A path is compared at the phases that the imported plan has at the times of the
    samples, as a refined plan may be faster or slower.
    """
    rows = zip(plans, imported, trajectories, strict=True)
    distances = []
    # Phases are invariant under changes of the timing.
    for plan, before, trajectory in rows:
        s = before.motion.phase_at(trajectory.t[None])
        distances.append(np.abs(plan.motion.at(s).q[0] - trajectory.q).max())
    return np.array(distances)


def _boundary(
    trajectory: Trajectory, noise: Array, snapper: StateSnapper, *, at_rest: bool | str
) -> tuple[Boundary, float]:
    """Return the boundary conditions of one trajectory and the change of their positions by snapping [rad]."""
    estimate = sampled_boundary(trajectory.t, trajectory.q, trajectory.dq)
    speed_error = (
        # Errors e at both ends of a window w look like a velocity 2 e / w, and those of
        # two velocities like an acceleration.
        noise[1] if trajectory.dq is not None else 2 * noise[0] / REST_WINDOW_S
    )
    acceleration_error = (
        noise[2] if trajectory.ddq is not None else 4 * speed_error / REST_WINDOW_S
    )
    allowed = max(MIN_SNAP_RAD, SNAP_FACTOR * float(noise[0]))
    given = [trajectory.dq is not None, trajectory.ddq is not None]
    snapper.set_parameters(trajectory.parameters)
    estimated = estimate.start_ddq[0], np.zeros(trajectory.q.shape[1])
    accelerations = estimated if trajectory.ddq is None else trajectory.ddq[[0, -1]]
    ends: tuple[tuple[End, Array, Array, Array], ...] = (
        ("start", trajectory.q[0], estimate.start_dq[0], accelerations[0]),
        ("goal", trajectory.q[-1], estimate.goal_dq[0], accelerations[1]),
    )
    snapped = []
    for end, q, velocity, acceleration in ends:
        rests = at_rest in {True, end}
        dq = np.where(rests | (np.abs(velocity) <= speed_error), 0.0, velocity)
        ddq = np.where(
            rests | (np.abs(acceleration) <= acceleration_error), 0.0, acceleration
        )
        snapped.append(_snapped(snapper, (q, dq, ddq), end, given, allowed))
    (first, moved_first), (last, moved_last) = snapped
    # Nan if one of them is.
    change = float(np.maximum(moved_first, moved_last))
    parameters = None if trajectory.parameters is None else trajectory.parameters[None]
    start_q, start_dq, start_ddq, goal_q, goal_dq = (
        part[None] for part in (*first, *last[:2])
    )
    return Boundary(
        start_q, start_dq, start_ddq, goal_q, goal_dq, parameters=parameters
    ), change


def _snapped(
    snapper: StateSnapper, state: State, end: End, given: Sequence[bool], allowed: float
) -> tuple[State, float]:
    """Snap a state; estimated derivatives that prevent this are omitted, given ones are kept.

    Return it with its change [rad]; or as it is, with nan, if a change above the
    allowed one is necessary.
    """
    q, dq, ddq = state
    still = np.zeros_like(q)
    candidates = [
        state,
        (q, dq, ddq if given[1] else still),
        (q, dq if given[0] else still, ddq if given[1] else still),
    ]
    for candidate in candidates:
        # From all derivatives to the given ones only.
        found = snapper(candidate, end)
        change = float(np.abs(found[0] - q).max())
        if change <= allowed:
            return found, change
    return state, float("nan")


def _fit_samples(
    trajectory: Trajectory, points: int
) -> tuple[Array, Array, Array | None]:
    """Return times, positions and, only if samples are few, velocities: enough of them for C control points."""
    count = len(trajectory.t)
    chosen = np.unique(
        # Samples are thinned evenly: more of them than the path resolves only cost
        # time.
        np.linspace(0, count - 1, min(count, FIT_SAMPLES_PER_POINT * points))
        .round()
        .astype(np.intp)
    )
    few = trajectory.dq is not None and count < MIN_SAMPLES_PER_POINT * points
    # Velocities determine the path where positions are fewer than control points need.
    return (
        trajectory.t[chosen],
        trajectory.q[chosen],
        trajectory.dq[chosen] if few and trajectory.dq is not None else None,
    )


def _fitted(
    trajectories: Sequence[Trajectory],
    boundaries: Sequence[Boundary],
    spec: TrajectorySpec,
    max_error: float,
) -> tuple[list[Motion], Array]:
    """Fit all trajectories with the smallest number of control points that meets the error; also return the errors."""
    points = spec.path_control_points
    while True:
        larger = replace(spec, path_control_points=points)
        motions = [
            fit_motion(*_fit_samples(each, points), spec=larger, boundary=boundary)
            for each, boundary in zip(trajectories, boundaries, strict=True)
        ]
        pairs = zip(motions, trajectories, strict=True)
        errors = np.array(
            [largest_error(motion, each.t, each.q) for motion, each in pairs]
        )
        if (errors <= max_error).all() or points >= MAX_CONTROL_POINTS:
            # All plans share one number of control points, as one file stores them.
            return motions, errors
        points = min(round(GROWTH * points), MAX_CONTROL_POINTS)


class StateSnapper:
    """Moves boundary states onto the constraints of a problem by Gauss-Newton steps of minimum norm.

    Distances between bodies are not considered.
    """

    def __init__(self, problem: Problem, robot: Robot) -> None:
        self._constraints = [
            constraint
            for constraint in problem.constraint
            if not is_contact(constraint)
        ]
        self._world = World(robot, problem.obstacle, problem.object_size)
        self._problem = problem
        self.set_parameters(None)
        # Scaled states make minimum-norm steps compare positions, velocities and
        # accelerations.
        self._scale = np.repeat(SCALES, robot.n)

    def set_parameters(self, parameters: Array | None) -> None:
        """Set the values of the problem's parameters, shape (p,); nominal for None."""
        rows = None if parameters is None else parameters[None]
        nowhere = np.zeros((1, 3))
        # Distances are not considered, so the scene may have any ends.
        self._poses = scene_of(self._problem, nowhere, nowhere, nowhere, rows).poses[0]

    def __call__(self, state: State, end: End) -> State:
        """Move a state at an end, or return the last one that was reached if the constraints cannot be met."""
        # Gauss-Newton: x -= J^+ r, with the least change of all that meets the
        # linearized rows.
        x = np.concatenate(state) / self._scale
        for _ in range(MAX_ITERATIONS):
            g, lower, upper = self._values(x, end)
            # Targets are slightly inside the bounds, so rounding does not violate them
            # again.
            inset = BOUND_INSET * np.where(
                np.isfinite(upper - lower), upper - lower, 1.0
            )
            residual = np.where(
                g < lower,
                g - lower - inset,
                np.where(g > upper, g - upper + inset, 0.0),
            )
            # Conditions within their bounds do not restrict the step.
            rows = np.flatnonzero(np.abs(residual) > MAX_RESIDUAL)
            if not len(rows) or not np.isfinite(g).all():
                break
            steps = DIFFERENCE * np.eye(len(x))
            # Central differences: J = (g(x + d) - g(x - d)) / (2 d).
            changes = [
                self._values(x + step, end)[0][rows]
                - self._values(x - step, end)[0][rows]
                for step in steps
            ]
            jacobian = np.stack(changes, axis=1) / (2 * DIFFERENCE)
            x = x - np.linalg.lstsq(jacobian, residual[rows], rcond=1e-8)[0]
        q, dq, ddq = np.split(x * self._scale, 3)
        return q, dq, ddq

    def _values(self, x: Array, end: End) -> tuple[Array, Array, Array]:
        """Return the values and both bounds of all conditions, shape (m,) each."""
        q, dq, ddq = np.split(x * self._scale, 3)
        self._world.set_state(q, dq, ddq, self._poses)
        conditions = [
            condition
            for part in self._constraints
            for condition in part.measured_at(self._world, end)
        ]
        parts = (
            [getattr(condition, name) for condition in conditions]
            for name in ("g", "lower", "upper")
        )
        g, lower, upper = (np.concatenate([np.empty(0), *part]) for part in parts)
        return g, lower, upper
