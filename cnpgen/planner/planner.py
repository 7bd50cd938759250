"""The planner: boundary conditions in, plans out, in a fraction of a millisecond; replanning on the fly."""

from collections.abc import Mapping
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from cnpgen.errors import UsageError
from cnpgen.machine.threads import one_thread
from cnpgen.pipelines.completion import Completion
from cnpgen.planner.keeping import keep_what_is_faster
from cnpgen.planner.kit import make_kit, surroundings
from cnpgen.planner.model import Model
from cnpgen.planner.model_file import load_model, model_for
from cnpgen.planner.strike import MEETING, State, Strikes, boundary_of_tasks, load_completion, strike_tasks
from cnpgen.plans.boundary_file import CONTEXT
from cnpgen.plans.plans import Plans, check_made, check_plans_type
from cnpgen.plans.plausible import warn_of_far_joints
from cnpgen.problems.problem import Problem
from cnpgen.schema.arguments import numbers
from cnpgen.store.blueprint import StoredProblem
from cnpgen.trajectory.boundary import Boundary
from cnpgen.trajectory.boundary_arguments import boundary_of
from cnpgen.trajectory.moment import states_at_times

Array = NDArray[np.float64]

AT_REST = 1e-9  # of a limit: what rounding leaves of a velocity or an acceleration that was zero


class Planner:
    """Plans with a trained model.

    Args:
        model: A model, the path of a model file, or the name of a model that cnpgen ships; or a problem
            (``plans.problem``, ``dataset.problem``) for which it ships just one.
        slow_down: Whether motions from rest to rest are slowed down uniformly as far as the limits need it. It is done
            only by models whose training rows all begin and end at rest: then it is exact. False also leaves the rates
            of models that are paced, such as airhockey-onthefly, as the network has them.
        backend: What computes kinematics and limits; by default the fastest that works.

    Attributes:
        model: The model.
        robot: The robot of its problem.

    Raises:
        UsageError: ``model`` is none, there is no such file or shipped model, or several are for the problem.
        CnpgenError: The model cannot be read, or the machine lacks what it needs.
    """

    def __init__(
        self,
        model: Model | Problem | StoredProblem | str | Path,
        *,
        slow_down: bool = True,
        backend: str | None = None,
    ) -> None:
        if isinstance(model, Problem | StoredProblem):
            model = model_for(model)
        self.model = model if isinstance(model, Model) else load_model(model)
        self._options: dict[str, Any] = {"slow_down": slow_down, "backend": backend}
        meaning = self.model.meaning if slow_down else replace(self.model.meaning, paced=False)
        with surroundings(self.model.problem, backend) as given:
            self.robot = given.robot
            self._kit = make_kit(
                given,
                meaning,
                slow_down=slow_down and self.model.rests,
                fixed_at_goal=self.model.fixed_at_goal,
            )
            limits = {"dq": given.robot.velocity_limit, "ddq": given.robot.acceleration_limit}
            self._still = {f"{end}_{what}": AT_REST * limits[what] for end in ("start", "goal") for what in limits}
        self._completion: Completion | None = None

    def __repr__(self) -> str:
        return f"<Planner for {self.model.problem.name!r}: a network of {self.model.architecture}>"

    def __reduce__(self) -> tuple[Any, ...]:
        """Pickle without kernels: they are loaded anew where the planner goes."""
        return partial(type(self), **self._options), (self.model,)

    def plan(
        self,
        start_q: ArrayLike,
        goal_q: ArrayLike,
        *,
        start_dq: ArrayLike | None = None,
        start_ddq: ArrayLike | None = None,
        goal_dq: ArrayLike | None = None,
        goal_ddq: ArrayLike | None = None,
    ) -> Plans:
        """Plan motions; boundary conditions hold to rounding, whatever the network gives.

        Boundary conditions are not judged: of a start or goal outside of the limits or off the table comes a plan that
        goes there, and ``evaluate_plans`` says that it is not valid. Only where a joint is so far outside that its
        position is probably in degrees, or normalised, there is a warning.

        Args:
            start_q: Start positions [rad], shape (n,) for one motion or (N, n).
            goal_q: Goal positions [rad], likewise, as all that follow.
            start_dq: Start velocities [rad/s]; at rest by default.
            start_ddq: Start accelerations [rad/s^2]; none by default.
            goal_dq: Goal velocities [rad/s]; at rest by default.
            goal_ddq: Goal accelerations [rad/s^2], of models that were trained on rows that give them; none by default.
                Other models leave them free.

        Returns:
            One plan or N, not checked yet (status UNKNOWN).

        Raises:
            UsageError: A shape is wrong, something is not finite, something moves that was at rest in every row that
                the model was trained on, or goal accelerations are given that the model leaves free.
        """
        return self.plan_batch(boundary_of(self.robot.n, start_q, start_dq, start_ddq, goal_q, goal_dq, goal_ddq))

    @one_thread()
    def plan_batch(
        self,
        boundary: Boundary,
        *,
        sample_id: NDArray[np.int64] | None = None,
        columns: Mapping[str, Array] | None = None,
    ) -> Plans:
        """Plan N motions.

        Args:
            boundary: Boundary conditions, shape (N, n) each, float64 and finite.
            sample_id: Which samples of a dataset these are, shape (N,); 0, 1, ... by default.
            columns: What else is known of the tasks, as ``Plans.columns``.

        Raises:
            UsageError: As for ``plan``.
        """
        warn_of_far_joints(self.robot, boundary)
        return self._kit.plan(self.model, self._accepted(boundary), sample_id=sample_id, columns=columns)

    @one_thread()
    def strike(
        self,
        state: State,
        puck: ArrayLike,
        towards: ArrayLike,
        *,
        meeting: float = MEETING,
        speed_share: ArrayLike = 1.0,
    ) -> Strikes:
        """Plan hits: from where the arm is, to the puck, so that it goes where it is to go.

        The stages that completed the rows which the model was trained on find the goal configuration and velocity
        (``cnpgen.complete`` does the same in files). They are loaded at the first strike.

        Args:
            state: Where the arm is: positions [rad], velocities [rad/s] and accelerations [rad/s^2], shape (n,) or
                (N, n) each, as ``states_at`` gives them; off the table by no more than motions may be.
            puck: Where the puck's centre is, x and y [m], shape (2,) or (N, 2); with its z [m] where there is no table.
            towards: Where it is to go, x and y [m], shape (2,) or (N, 2).
            meeting: From the puck's centre to the mallet's when they meet [m].
            speed_share: Speed of the hit as a fraction of the highest possible one, a number or shape (N,).

        Returns:
            Plans for the strikes that have an answer, not checked yet, and why the others have none.

        Raises:
            UsageError: A shape is wrong, something is not finite, or the model was not trained on hits.
        """
        if self._completion is None:
            self._completion = load_completion(self.model, self._options["backend"])
        tasks = strike_tasks(self._completion, state, puck, towards, meeting=meeting, share=speed_share)
        columns = {name: tasks[name][0] for name in CONTEXT}
        boundary = self._accepted(boundary_of_tasks(tasks, self.model.fixed_at_goal))
        return Strikes(self._kit.plan(self.model, boundary, sample_id=tasks.alive, columns=columns), tasks.why())

    def replan(
        self,
        plans: Plans,
        time: ArrayLike,
        *,
        goal_q: ArrayLike,
        goal_dq: ArrayLike | None = None,
        goal_ddq: ArrayLike | None = None,
    ) -> Plans:
        """Plan on from points on plans that are being executed: q, dq and ddq go on without a jump.

        At its very end a plan may still accelerate where goal accelerations are free. What follows a motion that
        ends at rest begins at rest: ``plan`` from its goal.

        To a goal that has not moved no plan takes longer than what was left: where the network's is not faster by 2 %,
        it is the rest of the old plan, with exact ends and the same duration, written anew. Where accelerations would
        differ by more than 0.1 % of the limits, all plans that are returned have two or three spans for each of theirs.

        Args:
            plans: One plan or N, by any planner of the same robot; one may be left for several goals.
            time: When the new plans take over, since the start of the old ones [s], one number or shape (N,). Planning
                itself takes time: choose a moment that is still to come.
            goal_q: New goal positions [rad], shape (n,) or (N, n).
            goal_dq: New goal velocities [rad/s]; at rest by default.
            goal_ddq: New goal accelerations [rad/s^2], as for ``plan``.

        Raises:
            UsageError: There are not as many times as plans, one is not within its plan, they are of another robot, or
                as for ``plan``.
        """
        check_plans_type(plans)
        if plans.problem.joint_names != self.model.problem.joint_names:
            raise UsageError(f"the planner is of {self.model.problem.name!r}, the plans are of {plans.problem.name!r}")
        q, dq, ddq = states_at(plans, time)
        new = self.plan(q, goal_q, start_dq=dq, start_ddq=ddq, goal_dq=goal_dq, goal_ddq=goal_ddq)
        times = np.broadcast_to(numbers("time", time), (len(plans),))
        if len(plans) == 1:
            plans, times = plans[np.zeros(len(new), int)], np.repeat(times, len(new))
        return keep_what_is_faster(plans, times, new, acceleration_limit=self.robot.acceleration_limit)

    def _accepted(self, boundary: Boundary) -> Boundary:
        """Set to zero what was zero in every training row and differs from it by rounding; refuse what moves."""
        boundary, still = self._arriving(boundary), {}
        for name in self.model.rest:
            values = getattr(boundary, name)
            if not np.count_nonzero(values):  # a fifth of the time of any()
                continue
            moving = np.abs(values).max(axis=1)
            row = int(moving.argmax())
            if (np.abs(values) > self._still[name]).any():
                raise UsageError(
                    f"{name} was zero in every row that the model was trained on, got {moving[row]:g} in plan {row}:"
                    " train on such rows, or use a model that was"
                )
            still[name] = np.zeros_like(values)
        return replace(boundary, **still) if still else boundary

    def _arriving(self, boundary: Boundary) -> Boundary:
        """Give the goal an acceleration, of zero where none is said, just where the model holds one."""
        if boundary.fixed_at_goal == self.model.fixed_at_goal:
            return boundary
        if boundary.goal_ddq is not None:
            raise UsageError("the model leaves goal accelerations free, so goal_ddq must be None")
        return replace(boundary, goal_ddq=np.zeros_like(boundary.goal_q))


def states_at(plans: Plans, time: ArrayLike) -> tuple[Array, Array, Array]:
    """Evaluate each of N plans at one moment.

    Args:
        plans: N plans.
        time: Since their start [s], one number or shape (N,).

    Returns:
        Positions [rad], velocities [rad/s] and accelerations [rad/s^2], shape (N, n) each.

    Raises:
        UsageError: There are not as many times as plans, one is not within its plan, or a plan is still to be made.
    """
    try:
        times = np.broadcast_to(numbers("time", time), (len(plans),))
    except (UsageError, ValueError) as error:
        raise UsageError(f"time must be one number or one for each of {len(plans)} plans, got {time!r}") from error
    outside = ~((times >= 0) & (times <= plans.duration))
    if outside.any():
        row = int(outside.argmax())
        check_made(plans)
        raise UsageError(
            f"plan {row} lasts from 0 to {plans.duration[row]:.9g} s, it cannot be evaluated at {times[row]:.9g} s"
        )
    return states_at_times(plans.motion, times)
