"""Plan motions from boundary conditions with a trained model, in a fraction of a millisecond; online replanning."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from cnpgen.arrays import Array
from cnpgen.errors import UsageError
from cnpgen.machine.threads import one_thread
from cnpgen.planner.inference_pipeline import loaded_problem, make_inference_pipeline
from cnpgen.planner.model import Model
from cnpgen.planner.model_file import load_model, model_for
from cnpgen.planner.network.features import SCENE
from cnpgen.plans.plans import Plans
from cnpgen.plans.plausible import check_boundary_units
from cnpgen.problems.problem import Problem
from cnpgen.schema.argument_types import checked_arguments
from cnpgen.schema.arguments import check_memory, concerning, numbers
from cnpgen.store.dataset_spec import StoredProblem
from cnpgen.store.scene_table import OBSTACLE_POSES
from cnpgen.trajectory.boundary import Boundary, boundary_of
from cnpgen.trajectory.remaining_trajectory import (
    remaining_trajectory,
    with_finer_knots,
)

GOAL_TOLERANCE = 1e-9  # rad, rad/s and rad/s^2: goals that differ by less are equal
MIN_REMAINING_TIME_S = 1e-6  # motions that end sooner are not reused
# Of a new plan's duration to the remaining time; else the old plan is reused.
MAX_DURATION_RATIO = 0.98
# Fraction of a limit: rounding error of a velocity or an acceleration that was zero.
REST_TOLERANCE = 1e-9


class Planner:
    """Plan motions with a trained model.

    Args:
        model: A model, the path of a model file, the name of a shipped model, or a
            problem (``plans.problem``, ``dataset.problem``) with exactly one shipped
            model.
        scale_time: Whether motions from rest to rest are scaled uniformly in time to
            meet the limits. This is exact, and done only for models whose training rows
            all begin and end at rest. False also disables the time parametrization of
            models such as airhockey-online.
        backend: Backend of the kernels; by default the fastest available.

    Attributes:
        model: The model; its ``goal_acceleration`` is "free" if motions may end with
            any acceleration.
        robot: The robot of its problem.
        backend: Backend of the kernels, as passed.

    Raises:
        UsageError: ``model`` is invalid, there is no such file or shipped model, or
            several are for the problem.
        CnpgenError: The model cannot be read, or a dependency is missing.
    """

    @checked_arguments
    def __init__(
        self,
        model: Model | Problem | StoredProblem | str | Path,
        *,
        scale_time: bool = True,
        backend: str | None = None,
    ) -> None:
        if isinstance(model, Problem | StoredProblem):
            model = model_for(model)
        with concerning("model"):
            self.model = model if isinstance(model, Model) else load_model(model)
        self.backend, self._scale_time = backend, scale_time
        spec = self.model.problem.trajectory
        config = (
            self.model.config
            if scale_time
            else replace(self.model.config, time_parametrized=False)
        )
        with loaded_problem(self.model.problem, backend) as loaded:
            self.robot = loaded.robot
            self._inference = make_inference_pipeline(
                loaded,
                config,
                scale_time=scale_time and self.model.is_rest_to_rest,
                fixed_at_goal=self.model.fixed_at_goal,
                observed=SCENE in self.model.features.blocks,
            )
            self._numbers_per_plan = (
                self.robot.n * spec.path_control_points + spec.rate_control_points
            )
            velocity = REST_TOLERANCE * self.robot.velocity_limit
            acceleration = REST_TOLERANCE * self.robot.acceleration_limit
            self._rest_tolerance = {
                "start_dq": velocity,
                "start_ddq": acceleration,
                "goal_dq": velocity,
                "goal_ddq": acceleration,
            }

    def __repr__(self) -> str:
        return f"<Planner for {self.model.problem.name!r}: a network of {self.model.architecture}>"

    def __reduce__(self) -> tuple[Any, ...]:
        """Pickle without kernels.

        They are loaded again when the planner is unpickled.
        """
        return partial(type(self), scale_time=self._scale_time, backend=self.backend), (
            self.model,
        )

    @checked_arguments
    @one_thread()
    def plan(
        self,
        start_q: ArrayLike,
        goal_q: ArrayLike,
        *,
        start_dq: ArrayLike | None = None,
        start_ddq: ArrayLike | None = None,
        goal_dq: ArrayLike | None = None,
        goal_ddq: ArrayLike | None = None,
        parameters: ArrayLike | None = None,
        allow_large_angles: bool = False,
    ) -> Plans:
        """Plan motions; boundary conditions hold to rounding for any network output.

        Boundary conditions are not checked against the limits. A plan from or to an
        invalid state is returned, and ``evaluate_plans`` reports that it is not valid.

        Args:
            start_q: Start positions [rad], shape (n,) for one motion or (N, n).
            goal_q: Goal positions [rad], shape (n,) or (N, n).
            start_dq: Start velocities [rad/s], shape (n,) or (N, n); zero by default.
            start_ddq: Start accelerations [rad/s^2], shape (n,) or (N, n); zero by
                default.
            goal_dq: Goal velocities [rad/s], shape (n,) or (N, n); zero by default.
            goal_ddq: Goal accelerations [rad/s^2], shape (n,) or (N, n), for models
                trained on rows with goal accelerations; zero by default. Other models
                leave them free.
            parameters: Parameters of the problem, shape (width,) or (N, width), if it
                has any.
            allow_large_angles: Whether to accept values that are probably in degrees or
                millimetres, with a warning.

        Returns:
            One plan or N, not checked yet (status UNKNOWN).

        Raises:
            UsageError: A shape is wrong, a value is not finite, a condition is not zero
                that was zero in all training rows, or goal accelerations are given that
                the model leaves free.
            UnitError: A condition is probably in degrees or millimetres.
        """
        states = start_q, start_dq, start_ddq, goal_q, goal_dq, goal_ddq
        boundary = boundary_of(self.robot.n, *states, parameters)
        self._check_size_and_units(
            "start_q", boundary, allow_large_angles=allow_large_angles
        )
        return self._inference.plan(self.model, self._checked(boundary))

    @checked_arguments
    @one_thread()
    def plan_batch(
        self,
        boundary: Boundary,
        *,
        sample_id: NDArray[np.int64] | None = None,
        columns: Mapping[str, Array] | None = None,
        allow_large_angles: bool = False,
    ) -> Plans:
        """Plan N motions.

        Args:
            boundary: Boundary conditions, shape (N, n) each, float64 and finite.
            sample_id: Dataset samples of the tasks, shape (N,); 0, 1, ... by default.
            columns: Further columns of the tasks, as ``Plans.columns``;
                ``obstacle_poses`` places the obstacles of a model for scenes
                (``cnpgen.scenes.scene_plans``).
            allow_large_angles: See ``plan``.

        Raises:
            UsageError: See ``plan``.
        """
        self._check_size_and_units(
            "boundary", boundary, "boundary", allow_large_angles=allow_large_angles
        )
        return plan_tasks(self, boundary, sample_id, columns)

    @checked_arguments
    @one_thread()
    def replan(
        self,
        plans: Plans,
        time: ArrayLike,
        *,
        goal_q: ArrayLike,
        goal_dq: ArrayLike | None = None,
        goal_ddq: ArrayLike | None = None,
        parameters: ArrayLike | None = None,
    ) -> Plans:
        """Replan from states on plans that are being executed: q, dq and ddq are continuous.

        If goal accelerations are free, a plan may still accelerate at its very end. To
        continue after a motion that ends at rest, call ``plan`` from its goal.

        If the goal is unchanged, the new plan never takes longer than the remaining
        trajectory: unless the network's plan is faster by 2 %, the remaining trajectory
        is returned, with exact ends and the same duration. If its accelerations would
        differ by more than 0.1 % of the limits, all returned plans have two or three
        spans for each original one.

        Args:
            plans: One plan or N, by any planner of the same robot; one plan may be
                replanned to several goals.
            time: Time at which the new plans take over, since the start of the old ones
                [s], one number or shape (N,). Planning itself takes time: choose a time
                in the future.
            goal_q: New goal positions [rad], shape (n,) or (N, n).
            goal_dq: New goal velocities [rad/s], shape (n,) or (N, n); zero by default.
            goal_ddq: New goal accelerations [rad/s^2], as for ``plan``.
            parameters: Parameters of the problem, as for ``plan``; those of the plans
                by default.

        Raises:
            UsageError: The number of times differs from that of plans, a time is
                outside its plan, the plans are of another robot, or see ``plan``.
        """
        if plans.problem.joint_names != self.model.problem.joint_names:
            raise UsageError(
                f"the planner is of {self.model.problem.name!r}, the plans are of {plans.problem.name!r}",
                concerns="plans",
            )
        # The new plan starts at the state of the old one, so that q, dq and ddq are
        # continuous.
        q, dq, ddq = plans.states_at(time)
        parameters = plans.boundary.parameters if parameters is None else parameters
        states = q, dq, ddq, goal_q, goal_dq, goal_ddq
        boundary = boundary_of(self.robot.n, *states, parameters)
        columns = dict[str, Array]()
        if (poses := plans.columns.get(OBSTACLE_POSES)) is not None:
            columns[OBSTACLE_POSES] = np.broadcast_to(
                poses, (len(boundary), poses.shape[1])
            )
        self._check_size_and_units("plans", boundary)
        new = plan_tasks(self, boundary, None, columns)
        times = np.broadcast_to(numbers("time", time), (len(plans),))
        if len(plans) == 1:
            # One plan may be continued to several goals.
            plans, times = plans[np.zeros(len(new), int)], np.repeat(times, len(new))
        return reuse_previous_plan(
            plans, times, new, acceleration_limit=self.robot.acceleration_limit
        )

    def _check_size_and_units(
        self,
        many: str,
        boundary: Boundary,
        concerned: str | None = None,
        *,
        allow_large_angles: bool = False,
    ) -> None:
        """Refuse plans that exceed the memory, and units other than SI.

        The names are arguments of the caller.
        """
        check_memory(many, len(boundary), len(boundary) * self._numbers_per_plan)
        check_boundary_units(
            self.robot,
            boundary,
            argument=concerned,
            allow_large_angles=allow_large_angles,
        )

    def _checked(self, boundary: Boundary) -> Boundary:
        """Set conditions that were zero in all training rows to exactly zero.

        Check that they are zero to rounding.
        """
        boundary, zeroed = self._with_goal_acceleration(boundary), {}
        for name in self.model.zero_conditions:
            values = getattr(boundary, name)
            if not np.count_nonzero(values):
                # Takes a fifth of the time of any().
                continue
            largest = np.abs(values).max(axis=1)
            row = int(largest.argmax())
            # The network has never had such inputs.
            if (np.abs(values) > self._rest_tolerance[name]).any():
                raise UsageError(
                    f"was zero in every row that the model was trained on, got {largest[row]:g} in plan {row}:"
                    " train on such rows, or use a model that was",
                    argument=name,
                )
            zeroed[name] = np.zeros_like(values)
        return replace(boundary, **zeroed) if zeroed else boundary

    def _with_goal_acceleration(self, boundary: Boundary) -> Boundary:
        """Add zero goal accelerations if the model fixes them and none are given."""
        if boundary.fixed_at_goal == self.model.fixed_at_goal:
            return boundary
        if boundary.goal_ddq is not None:
            raise UsageError(
                "the model leaves goal accelerations free, so goal_ddq must be None",
                concerns="goal_ddq",
            )
        return replace(boundary, goal_ddq=np.zeros_like(boundary.goal_q))


def plan_tasks(
    planner: Planner,
    boundary: Boundary,
    sample_id: NDArray[np.int64] | None = None,
    columns: Mapping[str, Array] | None = None,
) -> Plans:
    """Plan N motions like ``Planner.plan_batch``, without checks of types and units, in any number of BLAS threads."""
    return planner._inference.plan(
        planner.model, planner._checked(boundary), sample_id=sample_id, columns=columns
    )


def reuse_previous_plan(
    old: Plans, time: Array, new: Plans, *, acceleration_limit: Array
) -> Plans:
    """Replace new plans by the remaining trajectory of old ones to the same goal, unless the new ones are faster.

    The N new plans take over at times since the start of the old ones [s], shape (N,).
    All have more control points if a remaining trajectory needs them.
    """
    remaining_time = old.duration - time
    reused = np.flatnonzero(
        _same_goal(old.boundary, new.boundary)
        & (remaining_time > MIN_REMAINING_TIME_S)
        # A new plan must be faster by more than 2 %: otherwise plans would change
        # without gain.
        & (MAX_DURATION_RATIO * remaining_time <= new.duration)
    )
    if not len(reused):
        return new
    motion, boundary = old.motion[reused], new.boundary[reused]
    remaining = remaining_trajectory(
        motion,
        time[reused],
        boundary,
        spec=new.motion.spec,
        acceleration_limit=acceleration_limit,
    )
    # The remaining trajectory may have more control points; the new motions get as many
    # without a change of shape.
    refined = with_finer_knots(new.motion, remaining.spec)
    path, rate = refined.path.copy(), refined.rate.copy()
    path[reused], rate[reused] = remaining.path, remaining.rate
    return replace(new, path_control_points=path, rate_control_points=rate)


def _same_goal(old: Boundary, new: Boundary) -> NDArray[np.bool_]:
    pairs = [(old.goal_q, new.goal_q), (old.goal_dq, new.goal_dq)]
    if new.goal_ddq is not None:
        if old.goal_ddq is None:
            # The old motion's goal acceleration was free.
            return np.zeros(len(old), bool)
        pairs.append((old.goal_ddq, new.goal_ddq))
    if new.parameters is not None and old.parameters is not None:
        pairs.append((old.parameters, new.parameters))
    return np.asarray(
        np.all(
            [
                np.abs(before - after).max(axis=1) <= GOAL_TOLERANCE
                for before, after in pairs
            ],
            axis=0,
        )
    )
