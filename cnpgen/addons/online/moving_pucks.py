"""Moving pucks: their motion, the contact with the mallet, and hits that meet them.

Mallet and puck are two discs with restitution and Coulomb friction, and the mallet is
much heavier. At the contact, the velocity of the mallet relative to the puck has a
normal part, which the contact reverses by the restitution, and a tangential part, which
friction reduces at most to rolling (Stronge, Impact Mechanics, 2000, chapter 3). The
puck is a homogeneous disc: rolling transfers a third of it.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import cache

import numpy as np
from numpy.typing import ArrayLike, NDArray

from cnpgen.addons.online.hit_tasks import (
    State,
    boundary_of_tasks,
    hit_tasks,
    lanes,
    state_lanes,
)
from cnpgen.arrays import Array, Indices, Mask
from cnpgen.documents import Names
from cnpgen.errors import UsageError
from cnpgen.pipelines.completion import Completion
from cnpgen.pipelines.stages.stage import TaskBatch
from cnpgen.planner.planner import Planner, plan_tasks
from cnpgen.plans.boundary_problems import CONTEXT
from cnpgen.plans.plans import Plans
from cnpgen.problems.constraints.puck_contact import (
    PuckContact,
    distances_from_segments,
)
from cnpgen.schema.argument_types import check_fields
from cnpgen.schema.arguments import check_range, numbers
from cnpgen.trajectory.spline import basis

HitArguments = tuple[
    State, ArrayLike, ArrayLike | None, ArrayLike, ArrayLike, ArrayLike | None
]

MAX_MEETING_TIME_S = 60.0
MAX_PUCK_SPEED_M_S = 20.0
# At which early contacts are checked; motion between them is straight.
EARLY_CONTACT_PHASES = 65
# Of the mallet's path before the contact, on which it is no early one.
EARLY_CONTACT_MARGIN_M = 2e-3
MAX_EARLY_DEPTH_M = 5e-4
MAX_MEETING_ITERATIONS = 12
MAX_MEETING_ERROR_S = 1e-4  # of the time at which mallet and puck meet
EXPECTED_HIT_SPEED_M_S = 1.5  # of the first iteration
TOO_LATE = "the mallet cannot meet the puck in time"
NO_MEETING = "no meeting time: the iteration does not converge"
# Of the tangential velocity that a homogeneous disc takes over when it rolls.
ROLLING_SHARE = 1 / 3
MAX_BOUNCES = 4  # on the bands, of one prediction
ANGLE_ITERATIONS = 8


@dataclass(frozen=True, kw_only=True)
class PuckModel:
    """Motion and contacts of a puck; the defaults are those of the simulator's plants.

    Attributes:
        drag: Deceleration over velocity on the table [1/s].
        restitution: Speed of separation over speed of approach, for mallet and puck.
        friction: Coefficient of friction of mallet and puck.
        band_restitution: The restitution of bands and puck.
        band_loss: Fraction of the velocity along a band that a bounce takes.
        half_width: Distance of the puck's centre from the table's centre line at a side
            band [m].
        home_edge: Coordinate x of the puck's centre at the band of the arm's side [m].

    Raises:
        UsageError: A parameter is negative or not finite.
    """

    drag: float = 0.5
    restitution: float = 0.75
    friction: float = 0.0
    band_restitution: float = 0.75
    band_loss: float = 0.0
    half_width: float = 0.48735
    home_edge: float = 0.56165

    def __post_init__(self) -> None:
        check_fields(self)
        for name, value in vars(self).items():
            if not (np.isfinite(value) and value >= 0):
                raise UsageError(
                    f"must be finite and not negative, got {value:g}", argument=name
                )

    def predict(
        self, position: Array, velocity: Array, time: Array
    ) -> tuple[Array, Array]:
        """Predict N pucks, with bounces on the two side bands and the band of the arm's side.

        Args:
            position: Positions of the centres now [m], shape (N, 2).
            velocity: Velocities now [m/s], shape (N, 2).
            time: Times from now [s], shape (N,).

        Returns:
            Positions and velocities at these times, shape (N, 2) each.
        """
        # The path over the velocity that a puck still covers [s].
        # With dv/dt = -k v, a puck covers v (1 - exp(-k t)) / k within t.
        left = np.array(time, np.float64)
        if self.drag:
            left = -np.expm1(-self.drag * time) / self.drag
        position = position.copy()
        velocity = velocity.copy()
        low = np.array([self.home_edge, -self.half_width])
        high = np.array([np.inf, self.half_width])
        for _ in range(MAX_BOUNCES):
            # The side band or the home band that each coordinate moves to, if there is
            # one.
            bound = np.where(velocity > 0, high, low)
            with np.errstate(divide="ignore", invalid="ignore"):
                share = np.maximum((bound - position) / velocity, 0.0)
            share[velocity == 0] = np.inf
            # The first of both bands that the puck reaches.
            axis = np.argmin(share, axis=1)
            rows = np.arange(len(share))
            bounces = share[rows, axis] < left
            step = np.where(bounces, share[rows, axis], left)
            position += velocity * step[:, None]
            # The velocity falls linearly along the path: v - k x.
            decay = 1 - self.drag * step
            velocity *= decay[:, None]
            # The rest of the path, over the velocity that is left.
            left = (left - step) / decay
            if not bounces.any():
                break
            # A bounce reverses the normal part by the restitution and reduces the
            # tangential one.
            factors = np.full(velocity.shape, 1 - self.band_loss)
            factors[rows, axis] = -self.band_restitution
            velocity = np.where(bounces[:, None], velocity * factors, velocity)
        return position, velocity

    def velocity_after(
        self, velocity: Array, mallet_velocity: Array, normal: Array
    ) -> Array:
        """Compute the velocities of N pucks after the contact [m/s], shape (N, 2).

        Args:
            velocity: Velocities before the contact [m/s], shape (N, 2).
            mallet_velocity: Velocities of the mallet [m/s], shape (N, 2).
            normal: Unit vectors from the mallet's centre to the puck's, shape (N, 2).
        """
        relative = mallet_velocity - velocity
        # Discs that separate have no contact.
        approach = np.maximum(np.sum(relative * normal, axis=1), 0.0)
        tangent = np.stack([-normal[:, 1], normal[:, 0]], axis=1)
        sliding = np.sum(relative * tangent, axis=1)
        # Momentum over the mass of the puck, as the mallet is much heavier: (1 + e)
        # v_n.
        impulse = (1 + self.restitution) * approach
        # Friction reduces sliding at most to rolling, and by no more than mu times the
        # normal impulse.
        dragged = np.clip(
            ROLLING_SHARE * sliding, -self.friction * impulse, self.friction * impulse
        )
        after: Array = velocity + impulse[:, None] * normal + dragged[:, None] * tangent
        return after

    def hit_angle(self, velocity: Array, speed: Array, direction: Array) -> Array:
        """Compute the directions of N hits that send moving pucks in given directions [rad], shape (N,).

        The mallet moves along the line to the puck's centre.

        Args:
            velocity: Velocities of the pucks before the contact [m/s], shape (N, 2).
            speed: Speeds of the mallet [m/s], shape (N,).
            direction: Directions of the pucks after the contact, shape (N, 2), of any
                length.
        """
        wanted = np.arctan2(direction[:, 1], direction[:, 0])
        angle = wanted.copy()
        for _ in range(ANGLE_ITERATIONS):
            normal = np.stack([np.cos(angle), np.sin(angle)], axis=1)
            # The mallet moves along the normal and adds no tangential velocity itself.
            after = self.velocity_after(velocity, speed[:, None] * normal, normal)
            error = np.arctan2(after[:, 1], after[:, 0]) - wanted
            # The angle is corrected by the error, wrapped to [-pi, pi).
            angle -= (error + np.pi) % (2 * np.pi) - np.pi
        return angle


class MovingHits:
    """Arguments of ``plan_hits`` for N moving pucks, checked and brought to one length.

    They are state, puck, velocity, None at rest, target, speed share and meeting time,
    None for the earliest. ``distance`` is that of the centres at the goal, and ``overlap`` the path
    of the mallet from the contact to the goal [m].
    """

    def __init__(
        self,
        n: int,
        arguments: HitArguments,
        *,
        model: PuckModel,
        distance: float,
        overlap: float,
    ) -> None:
        state, puck, velocity, target, share, meeting_time = arguments
        self.model = model
        self.distance = distance
        self.overlap = overlap
        self.waits = meeting_time is not None
        moves = np.zeros(2) if velocity is None else velocity
        given = {"puck": puck, "puck_velocity": moves, "target": target}
        parts = {name: lanes(name, values, {2}).T for name, values in given.items()}
        time = 0.0 if meeting_time is None else meeting_time
        for name, values in {"speed_share": share, "meeting_time": time}.items():
            column = np.reshape(numbers(name, values), (-1, 1))
            parts[name] = lanes(name, column, {1}).T
        for index, values in enumerate(state_lanes(state, n)):
            parts[f"state {index}"] = values.T
        check_range("meeting_time", parts["meeting_time"], 0.0, MAX_MEETING_TIME_S, "s")
        check_range(
            "puck_velocity",
            parts["puck_velocity"],
            -MAX_PUCK_SPEED_M_S,
            MAX_PUCK_SPEED_M_S,
            "m/s",
        )
        parts = _of_one_length(parts)
        self.puck, self.velocity, self.target = (parts[name] for name in given)
        self.share = parts["speed_share"][:, 0]
        self.meeting_time = parts["meeting_time"][:, 0]
        self.state = tuple(parts[f"state {index}"] for index in range(3))
        if self.waits and (self.state[1].any() or self.state[2].any()):
            text = "is not at rest: an arm that waits for the puck must be"
            raise UsageError(text, argument="state")

    def tasks_at(
        self,
        time: Array,
        speed: Array,
        rows: Indices,
        completion: Completion,
    ) -> TaskBatch:
        """Complete the tasks of some hits that meet the pucks at these times [s] with these speeds [m/s]."""
        position, velocity = self.model.predict(
            self.puck[rows], self.velocity[rows], time
        )
        angle = self.model.hit_angle(velocity, speed, self.target[rows] - position)
        return hit_tasks(
            completion,
            tuple(part[rows] for part in self.state),  # type: ignore[arg-type]
            position,
            self.target[rows],
            contact_distance=self.distance,
            share=self.share[rows],
            angle=angle,
        )

    def touching_at_start(self, completion: Completion) -> Mask:
        """Return which pucks touch the mallet in the state of the arm, shape (N,)."""
        start = completion.tip_positions(self.state[0].T)[:2].T
        distance = np.linalg.norm(self.puck - start, axis=1)
        touching: Mask = distance < self.distance + self.overlap
        return touching

    def with_pucks(self, plans: Plans, delay: Array) -> Plans:
        """Add the pucks at the starts of the plans: columns ``puck_xy`` [m] and ``puck_velocity`` [m/s]."""
        rows = plans.sample_id
        position, velocity = self.model.predict(
            self.puck[rows], self.velocity[rows], delay
        )
        return replace(
            plans,
            columns={**plans.columns, "puck_xy": position, "puck_velocity": velocity},
        )


def _of_one_length(parts: Mapping[str, Array]) -> dict[str, Array]:
    """Return arguments by name, in which one value of an argument is repeated for all hits."""
    size = max(len(values) for values in parts.values())
    for name, values in parts.items():
        if len(values) not in {1, size}:
            raise UsageError(
                f"has {len(values)} hits, another argument has {size}",
                argument=name.partition(" ")[0],
            )
    return {
        name: np.repeat(values, size // len(values), axis=0)
        for name, values in parts.items()
    }


def plan_moving_hits(
    planner: Planner, completion: Completion, hits: MovingHits
) -> tuple[Plans, Names, Array]:
    """Plan hits of moving pucks; return plans, reasons of the others, and waiting times before the plans [s].

    The earliest meeting time is a fixed point: the time of the contact in the plan to
    the puck at this time. The iteration converges if the puck is slower than the
    mallet.
    """
    reasons = np.full(len(hits.puck), "", object)
    active, plans, contact, change = _planned(planner, completion, hits, reasons)
    if hits.waits:
        # The arm waits until the plan meets the puck at the stated time.
        delay = hits.meeting_time[active] - contact
        accepted = delay >= 0
    else:
        delay = np.zeros(len(active))
        accepted = change <= MAX_MEETING_ERROR_S
    reasons[active[~accepted]] = TOO_LATE if hits.waits else NO_MEETING
    # Pucks must not touch the mallet before the meeting, nor at the start.
    touched = _touched_early(completion, hits, plans, delay)
    reasons[active[accepted & touched]] = PuckContact.reason
    touching = hits.touching_at_start(completion)
    reasons[touching] = PuckContact.boundary_reason
    accepted &= ~touched & ~touching[active]
    delay = delay[accepted]
    return hits.with_pucks(plans[accepted], delay), tuple(reasons.tolist()), delay


def _planned(
    planner: Planner,
    completion: Completion,
    hits: MovingHits,
    reasons: NDArray[np.object_],
) -> tuple[Indices, Plans, Array, Array]:
    """Iterate the meeting times, and write the reasons of hits without an answer.

    Return the indices of the others, their plans, the times of their contacts, and the
    last changes of the meeting times [s].
    """
    time = hits.meeting_time.copy()
    speed = np.full(len(hits.puck), EXPECTED_HIT_SPEED_M_S)
    active = np.arange(len(hits.puck))
    for iteration in range(MAX_MEETING_ITERATIONS):
        tasks = hits.tasks_at(time[active], speed[active], active, completion)
        reasons[active] = tasks.why()
        active = active[tasks.alive]
        speed[active] = tasks["hit_speed"][0]
        if hits.waits and iteration == 0 and len(active):
            # The direction depends on the speed.
            continue
        boundary = boundary_of_tasks(tasks, planner.model.fixed_at_goal)
        columns = {name: tasks[name][0] for name in CONTEXT}
        plans = plan_tasks(planner, boundary, active, columns)
        # The mallet covers the overlap after the contact, at about its final speed.
        contact = plans.duration - hits.overlap / speed[active]
        # Fixed point: the contact time of the plan is the next meeting time.
        last = time[active]
        change = np.abs(contact - last)
        has_converged = change <= MAX_MEETING_ERROR_S
        if hits.waits or has_converged.all():
            break
        # Hits that have converged keep their time, so that their plans stay.
        time[active] = np.where(has_converged, last, contact)
    return active, plans, contact, change


def _touched_early(
    completion: Completion, hits: MovingHits, plans: Plans, delay: Array
) -> Mask:
    """Return whether moving pucks touch the mallet before the meeting, while it waits (if not negative) or moves."""
    if not len(plans):
        return np.zeros(0, bool)
    # The row of a plan is that of its hit.
    phases = np.linspace(0, 1, EARLY_CONTACT_PHASES)
    rows = plans.sample_id
    speed = plans.columns["hit_speed"]
    q = (
        _path_basis(plans.path_control_points.shape[1], plans.motion.degree)
        @ plans.path_control_points
    )
    moving = completion.tip_positions(q.reshape(-1, q.shape[2]).T)[:2].T.reshape(
        *q.shape[:2], 2
    )
    # Plans begin after the waiting time.
    start = np.maximum(delay, 0.0)[:, None]
    times = start + plans.motion.time_at(phases)
    # The last part of the path, and a margin before it, are the contact itself.
    before = (
        times
        <= times[:, -1:] - (hits.overlap + EARLY_CONTACT_MARGIN_M) / speed[:, None]
    )
    touching = _touching(hits, rows, moving, times)
    touched = np.zeros(len(plans), bool)
    touched |= (touching & before[:, 1:]).any(axis=1)
    if start.any():
        # While it waits, the mallet rests at its start.
        resting = np.repeat(moving[:, :1], len(phases), axis=1)
        touched |= _touching(hits, rows, resting, start * phases).any(axis=1)
    return touched


def _touching(hits: MovingHits, rows: Indices, mallet: Array, time: Array) -> Mask:
    """Return whether pucks touch mallets at positions, shape (P, K, 2), between times, shape (P, K)."""
    puck, velocity = (
        np.repeat(values[rows], time.shape[1], axis=0)
        for values in (hits.puck, hits.velocity)
    )
    # In the frame of the mallet, the puck passes the origin along segments.
    relative = (
        hits.model.predict(puck, velocity, time.ravel())[0].reshape(mallet.shape)
        - mallet
    )
    distance = distances_from_segments(np.zeros(2), relative[:, :-1], relative[:, 1:])
    touching: Mask = distance < hits.distance + hits.overlap - MAX_EARLY_DEPTH_M
    return touching


@cache
def _path_basis(points: int, degree: int) -> Array:
    """Return the basis of paths at the phases of ``_touched_early``, shape (K, C)."""
    return basis(np.linspace(0, 1, EARLY_CONTACT_PHASES), points, degree)
