"""Concatenated and joined plans: more plans, or sequences in which a plan is cut at a time and continued by another."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from cnpgen.arrays import Array, Integers
from cnpgen.errors import UsageError, counted
from cnpgen.plans.format import NOTES, PlanStatus
from cnpgen.plans.plans import Plans, check_made
from cnpgen.problems.problem_record import ProblemRecord
from cnpgen.schema.argument_types import checked_arguments
from cnpgen.schema.arguments import numbers
from cnpgen.trajectory.boundary import join_boundaries
from cnpgen.trajectory.joined import JoinedMotion


@dataclass(frozen=True, eq=False)
class JoinedPlans:
    """N sequences of plans in the order of execution; ``export_plans`` accepts them.

    Attributes:
        parts: Plans, N each, in the order of execution.
        begins: Start time of each part, since the start of the first [s], shape (parts,
            N).
    """

    parts: tuple[Plans, ...]
    begins: Array

    def __len__(self) -> int:
        return len(self.parts[0])

    def __repr__(self) -> str:
        return f"<{counted(len(self), 'sequence')} of {counted(len(self.parts), 'plan')} of {self.problem.name!r}>"

    @property
    def problem(self) -> ProblemRecord:
        """Problem of all plans."""
        return self.parts[0].problem

    @property
    def sample_id(self) -> Integers:
        """Sample IDs of the first plans, shape (N,)."""
        return self.parts[0].sample_id

    @property
    def status(self) -> NDArray[np.uint8]:
        """Status of each sequence, shape (N,): valid if all plans are valid, not valid if one plan is not valid."""
        status = np.array([part.status for part in self.parts])
        # A sequence is valid only if all parts are; one invalid part decides, whatever
        # is known of the others.
        known = np.where(
            (status == PlanStatus.VALID).all(axis=0),
            PlanStatus.VALID,
            PlanStatus.UNKNOWN,
        )
        return np.where(
            (status == PlanStatus.INVALID).any(axis=0), PlanStatus.INVALID, known
        ).astype(np.uint8)

    @cached_property
    def motion(self) -> JoinedMotion:
        """The N motions."""
        return JoinedMotion(tuple(part.motion for part in self.parts), self.begins)

    @cached_property
    def duration(self) -> Array:
        """Duration of every sequence [s], shape (N,)."""
        return self.motion.duration()


@checked_arguments
def join_plans(
    first: Plans | JoinedPlans, following: Plans, *, at: ArrayLike | None = None
) -> JoinedPlans:
    """Cut each of N plans at a time and join it with the plan that follows it.

    Positions, velocities and accelerations must be continuous up to 1e-9 in SI units,
    as for plans from the state at that time (``Planner.replan``, ``plan_hits``,
    ``refine_plans``). The tolerance includes rounding errors of control points for
    plans of a few milliseconds.

    Args:
        first: N plans, or joined plans.
        following: N plans, each starting at the cut of a plan.
        at: Times of the cuts, since the start of the first [s], one number or shape
            (N,); by default at the end.

    Raises:
        UsageError: The numbers of plans or times or the problems differ, a time is
            outside its plan, a plan has no motion, or there is a discontinuity.
    """
    if isinstance(first, JoinedPlans):
        joined = first
    else:
        check_made(first)
        joined = JoinedPlans((first,), np.zeros((1, len(first))))
    if len(following) != len(joined):
        raise UsageError(
            f"{len(joined)} plans are followed by {len(following)}, expected one for each",
            concerns="following",
        )
    # Tolerances and the base configuration may differ.
    if following.problem.comparable_sha256 != joined.problem.comparable_sha256:
        differs = ", ".join(following.problem.differences(joined.problem)[:4])
        raise UsageError(
            f"plans of {joined.problem.name!r} and {following.problem.name!r} differ in {differs}",
            concerns="following",
        )
    check_made(following)
    try:
        begins = (
            joined.duration
            if at is None
            else np.broadcast_to(numbers("at", at), (len(joined),))
        )
    except ValueError as error:
        raise UsageError(
            f"must be one number or one for each of {len(joined)} plans, got {at!r:.60}",
            argument="at",
        ) from error
    found = JoinedPlans(
        (*joined.parts, following), np.concatenate([joined.begins, begins[None]])
    )
    # Raises an error for discontinuities.
    _ = found.motion
    return found


def concatenate(parts: Sequence[Plans]) -> Plans:
    """Concatenate plans of the same problem with the same numbers of control points and columns.

    Raises:
        UsageError: The plans are not compatible.
    """
    if not parts:
        raise UsageError("there are no plans to join")
    first = parts[0]
    for index, other in enumerate(parts[1:], 1):
        for what, mine, its in _kinds(first, other):
            if mine != its:
                raise UsageError(
                    f"plans cannot be joined: {what} is {its} in part {index}, but {mine} in part 0"
                )
    sources, options = (
        list(dict.fromkeys(getattr(part, name) for part in parts)) for name in NOTES
    )
    return replace(
        first,
        source="; ".join(filter(None, sources)),
        # Different options cannot be stated in one note.
        refined_with=options[0] if len(options) == 1 else "",
        boundary=join_boundaries([part.boundary for part in parts]),
        path_control_points=np.concatenate(
            [part.path_control_points for part in parts]
        ),
        rate_control_points=np.concatenate(
            [part.rate_control_points for part in parts]
        ),
        columns={
            name: np.concatenate([part.columns[name] for part in parts])
            for name in first.columns
        },
        sample_id=np.concatenate([part.sample_id for part in parts]),
        status=np.concatenate([part.status for part in parts]),
    )


def _kinds(first: Plans, other: Plans) -> Iterator[tuple[str, Any, Any]]:
    """Yield the properties that concatenated plans must share."""
    yield (
        "the problem",
        first.problem.comparable_sha256,
        other.problem.comparable_sha256,
    )
    yield "the degree", first.degree, other.degree
    for name in ("path_control_points", "rate_control_points"):
        yield (
            f"the shape of a plan's {name}",
            getattr(first, name).shape[1:],
            getattr(other, name).shape[1:],
        )
    yield (
        "goal_ddq",
        first.boundary.goal_ddq is not None,
        other.boundary.goal_ddq is not None,
    )
    yield "the set of columns", sorted(first.columns), sorted(other.columns)
    for name, values in first.columns.items():
        yield (
            f"the shape of column {name!r}",
            values.shape[1:],
            other.columns[name].shape[1:],
        )
