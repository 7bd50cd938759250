"""Hits of moving pucks: the time at which the mallet meets the puck, and the direction of the hit."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cache

import numpy as np
from numpy.typing import ArrayLike, NDArray

from cnpgen.errors import UsageError
from cnpgen.pipelines.completion import Completion
from cnpgen.planner.hit_tasks import State, boundary_of_tasks, hit_tasks, lanes
from cnpgen.planner.planner import Planner, plan_tasks
from cnpgen.planner.puck_model import PuckModel
from cnpgen.plans.boundary_file import CONTEXT
from cnpgen.plans.plans import Plans
from cnpgen.problems.constraints.puck_contact import PuckContact, distances_from_segments
from cnpgen.schema.arguments import check_range, numbers
from cnpgen.trajectory.spline import basis

Array = NDArray[np.float64]

MAX_MEETING_TIME_S = 60.0
MAX_PUCK_SPEED_M_S = 20.0
EARLY_CONTACT_PHASES = 65  # at which early contacts are checked; motion between them is straight
EARLY_CONTACT_MARGIN_M = 2e-3  # of the mallet's path before the contact, on which it is no early one
MAX_EARLY_DEPTH_M = 5e-4
MAX_MEETING_ITERATIONS = 12
MAX_MEETING_ERROR_S = 1e-4  # of the time at which mallet and puck meet
EXPECTED_HIT_SPEED_M_S = 1.5  # of the first iteration
TOO_LATE = "the mallet cannot meet the puck in time"
NO_MEETING = "no meeting time: the iteration does not converge"


@dataclass(frozen=True)
class Meeting:
    """Rules of the meeting of mallet and puck.

    Attributes:
        model: Motion and contact of the puck.
        distance: Distance of the centres at the goal [m].
        overlap: Path of the mallet from the contact to the goal [m].
        time: Given times of the contact [s], or None for the earliest.
    """

    model: PuckModel
    distance: float
    overlap: float
    time: ArrayLike | None


def plan_moving_hits(  # noqa: PLR0917 - in the order of plan_hits
    planner: Planner,
    completion: Completion,
    meeting: Meeting,
    state: State,
    puck: ArrayLike,
    velocity: ArrayLike,
    target: ArrayLike,
    *,
    share: ArrayLike,
) -> tuple[Plans, tuple[str, ...], Array]:
    """Plan hits of moving pucks; see ``plan_hits``.

    The earliest meeting time is a fixed point: the time of the contact in the plan to the puck at this time. The
    iteration converges if the puck is slower than the mallet.

    Returns:
        Plans, reasons of the others, and waiting times before the plans [s].

    Raises:
        UsageError: As ``plan_hits``.
    """
    hits = _Hits(completion.context.robot.n, state, puck, velocity, target, share, meeting.time)
    time, speed = hits.meeting_time.copy(), np.full(len(hits.puck), EXPECTED_HIT_SPEED_M_S)
    reasons, active = [""] * len(hits.puck), np.arange(len(hits.puck))
    for iteration in range(MAX_MEETING_ITERATIONS):
        position, puck_velocity = meeting.model.predict(hits.puck[active], hits.velocity[active], time[active])
        angle = meeting.model.hit_angle(puck_velocity, speed[active], hits.target[active] - position)
        tasks = hit_tasks(
            completion,
            tuple(part[active] for part in hits.state),  # type: ignore[arg-type]
            position,
            hits.target[active],
            contact_distance=meeting.distance,
            share=hits.share[active],
            angle=angle,
        )
        for row, reason in zip(active.tolist(), tasks.why(), strict=True):
            reasons[row] = reason
        active = active[tasks.alive]
        speed[active] = tasks["hit_speed"][0]
        if meeting.time is not None and iteration == 0 and len(active):
            continue  # the direction depends on the speed
        columns = {name: tasks[name][0] for name in CONTEXT}
        plans = plan_tasks(planner, boundary_of_tasks(tasks, planner.model.fixed_at_goal), active, columns)
        contact = plans.duration - meeting.overlap / speed[active]
        change, last = np.abs(contact - time[active]), time[active]
        if meeting.time is not None or not len(active) or (change <= MAX_MEETING_ERROR_S).all():
            break
        time[active] = np.where(change <= MAX_MEETING_ERROR_S, last, contact)
    if meeting.time is None:
        delay, accepted, reason = np.zeros(len(active)), change <= MAX_MEETING_ERROR_S, NO_MEETING
    else:
        delay, reason = hits.meeting_time[active] - contact, TOO_LATE
        accepted = delay >= 0
    for row in active[~accepted].tolist():
        reasons[row] = reason
    touched = _touched_early(completion, meeting, hits, plans, delay)
    for row in active[accepted & touched].tolist():
        reasons[row] = PuckContact.reason
    start = completion.tip_positions(hits.state[0].T)[:2].T
    touching = np.linalg.norm(hits.puck - start, axis=1) < meeting.distance + meeting.overlap
    for row in np.flatnonzero(touching).tolist():
        reasons[row] = PuckContact.boundary_reason
    accepted &= ~touched & ~touching[active]
    return hits.with_pucks(plans[accepted], meeting.model, delay[accepted]), tuple(reasons), delay[accepted]


def _touched_early(
    completion: Completion, meeting: Meeting, hits: _Hits, plans: Plans, delay: Array
) -> NDArray[np.bool_]:
    """Return whether moving pucks touch the mallet before the meeting, while it waits (if not negative) or moves."""
    if not len(plans):
        return np.zeros(0, bool)
    phases, rows, speed = np.linspace(0, 1, EARLY_CONTACT_PHASES), plans.sample_id, plans.columns["hit_speed"]
    q = _path_basis(plans.path_control_points.shape[1], plans.motion.degree) @ plans.path_control_points
    moving = completion.tip_positions(q.reshape(-1, q.shape[2]).T)[:2].T.reshape(*q.shape[:2], 2)
    start = np.maximum(delay, 0.0)[:, None]
    times = start + plans.motion.time_at(phases)
    before = times <= times[:, -1:] - (meeting.overlap + EARLY_CONTACT_MARGIN_M) / speed[:, None]
    parts = [(moving, times, before)]
    if start.any():
        parts.append((np.repeat(moving[:, :1], len(phases), axis=1), start * phases, np.ones_like(before)))
    touched = np.zeros(len(plans), bool)
    for mallet, time, is_early in parts:
        puck, velocity = (np.repeat(values[rows], len(phases), axis=0) for values in (hits.puck, hits.velocity))
        relative = meeting.model.predict(puck, velocity, time.ravel())[0].reshape(mallet.shape) - mallet
        distance = distances_from_segments(np.zeros(2), relative[:, :-1], relative[:, 1:])
        touching = distance < meeting.distance + meeting.overlap - MAX_EARLY_DEPTH_M
        touched |= (touching & is_early[:, 1:]).any(axis=1)
    return touched


@cache
def _path_basis(points: int, degree: int) -> Array:
    """Return the basis of paths at the phases of ``_touched_early``, shape (K, C)."""
    return basis(np.linspace(0, 1, EARLY_CONTACT_PHASES), points, degree)


class _Hits:
    """Arguments of N hits, brought to one length."""

    def __init__(  # noqa: PLR0917 - in the order of plan_hits
        self,
        n: int,
        state: State,
        puck: ArrayLike,
        velocity: ArrayLike,
        target: ArrayLike,
        share: ArrayLike,
        meeting_time: ArrayLike | None,
    ) -> None:
        given = {"puck": puck, "puck_velocity": velocity, "target": target}
        parts = {name: lanes(name, values, {2}).T for name, values in given.items()}
        scalars = {"speed_share": share, "meeting_time": 0.0 if meeting_time is None else meeting_time}
        parts |= {
            name: lanes(name, np.reshape(numbers(name, values), (-1, 1)), {1}).T for name, values in scalars.items()
        }
        parts |= {f"state {index}": lanes("state", values, {n}).T for index, values in enumerate(state)}
        check_range("meeting_time", parts["meeting_time"], 0.0, MAX_MEETING_TIME_S, "s")
        check_range("puck_velocity", parts["puck_velocity"], -MAX_PUCK_SPEED_M_S, MAX_PUCK_SPEED_M_S, "m/s")
        size = max(len(values) for values in parts.values())
        for name, values in parts.items():
            if len(values) not in {1, size}:
                argument = name.partition(" ")[0]
                raise UsageError(f"has {len(values)} hits, another argument has {size}", argument=argument)
            parts[name] = np.repeat(values, size // len(values), axis=0)
        self.puck, self.velocity, self.target = (parts[name] for name in given)
        self.share, self.meeting_time = parts["speed_share"][:, 0], parts["meeting_time"][:, 0]
        self.state = tuple(parts[f"state {index}"] for index in range(3))
        if meeting_time is not None and (self.state[1].any() or self.state[2].any()):
            raise UsageError("is not at rest: an arm that waits for the puck must be", argument="state")

    def with_pucks(self, plans: Plans, model: PuckModel, delay: Array) -> Plans:
        """Add the pucks at the starts of the plans: columns ``puck_xy`` [m] and ``puck_velocity`` [m/s]."""
        rows = plans.sample_id
        position, velocity = model.predict(self.puck[rows], self.velocity[rows], delay)
        return replace(plans, columns={**plans.columns, "puck_xy": position, "puck_velocity": velocity})
