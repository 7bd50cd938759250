"""Concatenation of plans of several files or runs."""

from collections.abc import Iterator, Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from cnpgen.errors import UsageError
from cnpgen.plans.format import NOTES
from cnpgen.plans.plans import Plans
from cnpgen.trajectory.boundary import join_boundaries


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
                raise UsageError(f"plans cannot be joined: {what} is {its} in part {index}, but {mine} in part 0")
    sources, options = (list(dict.fromkeys(getattr(part, name) for part in parts)) for name in NOTES)
    return replace(
        first,
        source="; ".join(filter(None, sources)),
        refined_with=options[0] if len(options) == 1 else "",
        boundary=join_boundaries([part.boundary for part in parts]),
        path_control_points=np.concatenate([part.path_control_points for part in parts]),
        rate_control_points=np.concatenate([part.rate_control_points for part in parts]),
        columns={name: np.concatenate([part.columns[name] for part in parts]) for name in first.columns},
        sample_id=np.concatenate([part.sample_id for part in parts]),
        status=np.concatenate([part.status for part in parts]),
    )


def _kinds(first: Plans, other: Plans) -> Iterator[tuple[str, Any, Any]]:
    """Yield the properties that concatenated plans must share."""
    yield "the problem", first.problem.comparable_sha256, other.problem.comparable_sha256
    yield "the degree", first.degree, other.degree
    for name in ("path_control_points", "rate_control_points"):
        yield f"the shape of a plan's {name}", getattr(first, name).shape[1:], getattr(other, name).shape[1:]
    yield "goal_ddq", first.boundary.goal_ddq is not None, other.boundary.goal_ddq is not None
    yield "the set of columns", sorted(first.columns), sorted(other.columns)
    for name, values in first.columns.items():
        yield f"the shape of column {name!r}", values.shape[1:], other.columns[name].shape[1:]
