"""Plan air hockey hits: from arm state, puck and target to a boundary problem and its plan."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any
from weakref import WeakKeyDictionary

import numpy as np
from numpy.typing import ArrayLike

from cnpgen.addons.online.hit_tasks import (
    State,
    boundary_of_tasks,
    hit_tasks,
    load_completion,
)
from cnpgen.addons.online.moving_pucks import MovingHits, PuckModel, plan_moving_hits
from cnpgen.arrays import Array, Mask
from cnpgen.documents import Names
from cnpgen.errors import UsageError, counted
from cnpgen.judges.plans.judge import Judge
from cnpgen.machine.threads import one_thread
from cnpgen.pipelines.completion import Completion
from cnpgen.planner.planner import Planner, plan_tasks
from cnpgen.plans.boundary_problems import CONTEXT
from cnpgen.plans.join import JoinedPlans, join_plans
from cnpgen.plans.plans import Plans
from cnpgen.plans.tips import correct_tips
from cnpgen.problems.constraints.puck_contact import PuckContact
from cnpgen.problems.problem_record import as_problem, as_record, open_problem
from cnpgen.schema.argument_types import check_fields, checked_arguments
from cnpgen.schema.arguments import concerning, number, numbers
from cnpgen.schema.old_keywords import CALLER, with_old_keywords

# From the centre of the paper's puck to that of its mallet at contact.

CONTACT_DISTANCE_M = 0.07

# Of hits with a way back, by default: the next one if the hit or the way back is invalid.
RETURNING_SPEED_SHARES = (0.98, 0.95, 0.9, 0.8)

_COMPLETIONS: WeakKeyDictionary[Planner, Completion] = WeakKeyDictionary()


@dataclass(frozen=True, eq=False)
class PlannedHits:
    """Plans of N hits.

    Attributes:
        plans: Plans of the hits that have an answer, not checked yet;
            ``plans.sample_id`` is the index of each hit.
        reasons: Reason why a hit has no answer; empty if it has one. One entry per hit.
        delay: Time to wait before each plan starts [s], shape (M,) for M plans; zero
            without a meeting time.
        overlap: Path of the mallet from the contact to the goal [m].
        return_plans: The ways back, M plans from the ends of the hits to the home
            configuration; None without one.
    """

    plans: Plans
    reasons: Names
    delay: Array
    overlap: float
    return_plans: Plans | None = None

    @property
    def contact_time(self) -> Array:
        """Time from the start of each plan to the contact of mallet and puck [s], shape (M,)."""
        time: Array = (
            self.plans.duration - self.overlap / self.plans.columns["hit_speed"]
        )
        return time

    @property
    def sequences(self) -> JoinedPlans:
        """Hits with their ways back.

        Raises:
            UsageError: The hits were planned without a home configuration.
        """
        if self.return_plans is None:
            raise UsageError(
                "the hits have no ways back: pass home= to plan_hits", concerns="home"
            )
        return join_plans(self.plans, self.return_plans)

    def __repr__(self) -> str:
        return f"<{len(self.plans):,} of {counted(len(self.reasons), 'hit')} of {self.plans.problem.name!r} planned>"


@dataclass(frozen=True, eq=False)
class HitOptions:
    """Options of ``plan_hits``.

    Attributes:
        contact_distance: Distance from the puck's centre to the mallet's at the goal
            [m]; by default that of the problem's constraint ``puck-contact``, or 0.07
            without one.
        speed_share: Speed of the hit as a fraction of the highest possible one, a
            number or shape (N,); by default 1. With ``home`` it is the first of 0.98,
            0.95, 0.9 and 0.8 with which hit and way back are valid: at the highest
            speed, joints reach their velocity limits, which the way back then exceeds.
        puck_model: Drag, restitution and friction of a moving puck; by default those of
            the simulator.

    Raises:
        UsageError: A value has another type.
    """

    contact_distance: float | None = None
    speed_share: ArrayLike | None = None
    puck_model: PuckModel | None = None

    def __post_init__(self) -> None:
        check_fields(self)


@checked_arguments
@one_thread()
def plan_hits(
    planner: Planner,
    state: State,
    puck: ArrayLike,
    target: ArrayLike,
    *,
    puck_velocity: ArrayLike | None = None,
    meeting_time: ArrayLike | None = None,
    home: ArrayLike | None = None,
    parameters: ArrayLike | None = None,
    options: HitOptions | None = None,
    **old_keywords: Any,
) -> PlannedHits:
    """Plan hits from a state of the arm that send a puck towards a target.

    The pipeline stages of the model's training rows compute the goal configuration and
    velocity (``cnpgen.complete`` does the same for files). They are loaded at the first
    call for a planner.

    For a moving puck, the planner solves for the time at which the mallet meets the
    puck, and the direction of the hit accounts for the puck's velocity. With a meeting
    time, an arm at rest waits before the plan starts.

    Args:
        planner: A planner whose model was trained on hits.
        state: Positions [rad], velocities [rad/s] and accelerations [rad/s^2] of the
            arm, shape (n,) or (N, n) each, as returned by ``Plans.states_at``; the
            distance to the table must be within the tolerance of plans.
        puck: Position of the puck's centre, x and y [m], shape (2,) or (N, 2); x, y and
            z for problems without table.
        target: Position to hit the puck towards, x and y [m], shape (2,) or (N, 2).
        puck_velocity: Velocity of the puck in the state of the arm, x and y [m/s],
            shape (2,) or (N, 2).
        meeting_time: Time from the state of the arm to the contact [s], a number or
            shape (N,); by default as soon as possible. A hit that cannot be in time has
            a reason.
        home: Joint positions at which the arm rests after the hit [rad], shape (n,) or
            (N, n).
        parameters: Parameters of the problem, shape (width,) or (N, width); nominal by
            default. Positions are those on a table that they move.
        options: Contact distance, speed, and model of the puck.
        old_keywords: Fields of the options, as keywords of version 1.0.

    Returns:
        Plans of the hits that have an answer, and the reasons why the others have none.
        They are checked only with ``home`` and the default speed.

    Raises:
        UsageError: A shape is wrong, a value is not finite, the contact distance
            differs from that of the problem, the model was not trained on hits, or
            ``home`` is given for a model without moving starts.
    """
    chosen = with_old_keywords(
        "plan_hits", options, HitOptions(), old_keywords, caller=CALLER + 1
    )
    completion = _completion_of(planner)
    distance, overlap = _contact_lengths(planner, chosen.contact_distance)
    is_moving = puck_velocity is not None or meeting_time is not None
    if is_moving and parameters is not None:
        raise UsageError("must be None for moving pucks", argument="parameters")

    def hits_at(speed_share: ArrayLike) -> PlannedHits:
        """Plan hits at shares of the highest speed."""
        if not is_moving:
            task = completion, state, puck, target
            found = _plan_resting(planner, task, speed_share, distance, parameters)
            return PlannedHits(*found, np.zeros(len(found[0])), overlap)
        moving = MovingHits(
            planner.robot.n,
            (state, puck, puck_velocity, target, speed_share, meeting_time),
            model=chosen.puck_model or PuckModel(),
            distance=distance,
            overlap=overlap,
        )
        return PlannedHits(*plan_moving_hits(planner, completion, moving), overlap)

    return _with_returns(planner, hits_at, home, chosen.speed_share)


def _completion_of(planner: Planner) -> Completion:
    """Return the pipeline stages of a planner's model, which are loaded once."""
    found = _COMPLETIONS.get(planner)
    if found is None:
        found = load_completion(planner.model, planner.backend)
        _COMPLETIONS[planner] = found
    return found


def _plan_resting(
    planner: Planner,
    task: tuple[Completion, State, ArrayLike, ArrayLike],
    speed_share: ArrayLike,
    distance: float,
    parameters: ArrayLike | None,
) -> tuple[Plans, Names]:
    """Plan hits of pucks at rest at a contact distance [m]; return plans, and reasons of the others."""
    tasks = hit_tasks(
        *task, contact_distance=distance, share=speed_share, parameters=parameters
    )
    columns = {name: tasks[name][0] for name in CONTEXT}
    boundary = boundary_of_tasks(tasks, planner.model.fixed_at_goal)
    return plan_tasks(planner, boundary, tasks.alive, columns), tasks.why()


def _with_returns(
    planner: Planner,
    hits_at: Callable[[ArrayLike], PlannedHits],
    home: ArrayLike | None,
    speed_share: ArrayLike | None,
) -> PlannedHits:
    """Plan hits at a share of the highest speed, 1 by default, and ways back to home if it is given.

    With ways back, the default is the first share with which hit and way back are
    valid.
    """
    if home is None:
        return hits_at(1.0 if speed_share is None else speed_share)
    rest = numbers("home", home)

    def with_return(share: ArrayLike) -> PlannedHits:
        hits = hits_at(share)
        return replace(hits, return_plans=_plan_returns(planner, hits, rest))

    if speed_share is None:
        return _first_valid(planner, with_return)
    return with_return(speed_share)


def _first_valid(
    planner: Planner, plan: Callable[[ArrayLike], PlannedHits]
) -> PlannedHits:
    """Plan hits with ways back at the first speed of each at which both motions are valid."""
    first, *slower = RETURNING_SPEED_SHARES
    # All hits begin with the highest speed share.
    hits = plan(first)
    judge = Judge(*open_problem(as_record(planner.model.problem)))
    shares = np.full(len(hits.reasons), first)
    for share in slower:
        invalid = ~(_valid(judge, hits.plans) & _valid(judge, hits.return_plans))
        if not invalid.any():
            break
        # Only hits that are not valid become slower; the others are planned again
        # unchanged.
        shares[hits.plans.sample_id[invalid]] = share
        hits = plan(shares)
    return hits


def _valid(judge: Judge, plans: Plans | None) -> Mask:
    """Return which plans are valid by the independent verdict, shape (M,)."""
    if plans is None or not len(plans):
        return np.zeros(0, bool)
    plans = correct_tips(plans)
    conditions = plans.boundary, plans.scene, plans.columns["goal_xyz"]
    verdicts = judge(plans.motion, *conditions, early_exit=True)
    return np.array([verdict.valid for verdict in verdicts])


def _plan_returns(planner: Planner, hits: PlannedHits, home: Array) -> Plans:
    """Plan the ways back, from the ends of hits to rest at home, shape (n,) or (N, n)."""
    plans = hits.plans
    n = planner.robot.n
    if home.shape not in ((n,), (len(hits.reasons), n)):
        expected = f"({n},) or ({len(hits.reasons)}, {n})"
        raise UsageError(
            f"must have shape {expected}, got {home.shape}", argument="home"
        )
    home = home[plans.sample_id] if home.ndim == 2 else home
    q, dq, ddq = plans.states_at(plans.duration)
    goal = np.broadcast_to(home, q.shape) if len(q) else q
    with concerning("home"):
        back = planner.plan(
            q, goal, start_dq=dq, start_ddq=ddq, parameters=plans.boundary.parameters
        )
        return replace(back, sample_id=plans.sample_id)


def _contact_lengths(planner: Planner, given: float | None) -> tuple[float, float]:
    """Return the distance of the centres at the goal, and the path of the mallet from the contact to the goal [m].

    The distance must equal that of the problem's constraint, if there is one.
    """
    contact = as_problem(planner.model.problem).first(PuckContact)
    if given is not None:
        given = number("contact_distance", given)
    if contact is None:
        return CONTACT_DISTANCE_M if given is None else given, 0.0
    if given not in {None, contact.contact_distance}:
        expected = f"{contact.contact_distance:g} m, as in the problem's constraint puck-contact"
        raise UsageError(
            f"must be {expected}, got {given:g} m", argument="contact_distance"
        )
    return contact.contact_distance, contact.overlap
