"""Plans: N motions, each for its own boundary conditions, all of one problem."""

from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from cnpgen.errors import UsageError, counted
from cnpgen.plans.format import FLOATS, INTEGERS, NOTES
from cnpgen.plans.status import PlanStatus
from cnpgen.problems.problem import Problem
from cnpgen.problems.record import ProblemRecord, record_problem
from cnpgen.schema.arguments import integer, numbers
from cnpgen.trajectory.boundary import Boundary
from cnpgen.trajectory.motion import Motion

Array = NDArray[np.float64]


@dataclass(frozen=True, kw_only=True, eq=False)
class Plans:
    """N plans of one problem with n planned joints. Values may be garbage (nan, rates below 0); shapes are right.

    Attributes:
        problem: The problem.
        boundary: Boundary conditions, shape (N, n) each.
        path_control_points: Control points of p(s) [rad], shape (N, C, n).
        rate_control_points: Control points of r(s) = ds/dt [1/s], shape (N, R).
        degree: Degree of both splines.
        columns: What else is known of the tasks: name -> values in SI units, shape (N,) or (N, w). ``start_xyz`` and
            ``goal_xyz``, the tip's positions in the world frame [m], shape (N, 3), are always there after
            ``make_plans`` and ``load_plans``.
        sample_id: Which sample of a dataset every plan is for, shape (N,).
        status: What is known of every plan, values of ``PlanStatus``, shape (N,).
        source: Where they are from, a line of text, or nothing.
        refined_with: The options that they were refined with, as JSON, or nothing.
    """

    problem: ProblemRecord
    boundary: Boundary
    path_control_points: Array
    rate_control_points: Array
    degree: int
    columns: Mapping[str, Array] = field(default_factory=dict)
    sample_id: NDArray[np.int64]
    status: NDArray[np.uint8]
    source: str = ""
    refined_with: str = ""

    def __post_init__(self) -> None:
        integer("degree", self.degree, least=3)
        mistake = next(_mistakes(self), None)
        if mistake:
            raise UsageError(mistake)

    def __len__(self) -> int:
        return len(self.path_control_points)

    def __repr__(self) -> str:
        names = {status: status.name.lower() for status in PlanStatus}
        known = Counter(names.get(status, "unknown") for status in self.status.tolist())
        counts = ", ".join(f"{count:,} {name}" for name, count in known.most_common())
        return f"<{counted(len(self), 'plan')} of {self.problem.name!r}{counts and ': '}{counts}>"

    @property
    def motion(self) -> Motion:
        """The N motions."""
        return Motion(self.path_control_points, self.rate_control_points, self.degree)

    @cached_property
    def duration(self) -> Array:
        """Duration of every plan [s], shape (N,); inf or nan where there is none."""
        return self.motion.duration()

    def select(self, which: slice | NDArray[Any]) -> "Plans":
        """Return some of the plans.

        Args:
            which: A mask of shape (N,), indices in any order, or a slice.

        Raises:
            UsageError: The mask has another length, or there are no such plans.
        """
        which = _checked(which, len(self))
        return replace(
            self,
            boundary=self.boundary[which],
            path_control_points=self.path_control_points[which],
            rate_control_points=self.rate_control_points[which],
            columns={name: values[which] for name, values in self.columns.items()},
            sample_id=self.sample_id[which],
            status=self.status[which],
        )


def make_plans(
    problem: Problem | ProblemRecord,
    boundary: Boundary,
    *,
    path_control_points: ArrayLike,
    rate_control_points: ArrayLike,
    degree: int | None = None,
    columns: Mapping[str, ArrayLike] | None = None,
    sample_id: ArrayLike | None = None,
    status: ArrayLike | None = None,
    source: str = "",
) -> Plans:
    """Put plans together; what is not given is computed.

    Args:
        problem: The problem, or its record.
        boundary: Boundary conditions, shape (N, n) each.
        path_control_points: Control points of p(s) [rad], shape (N, C, n).
        rate_control_points: Control points of r(s) [1/s], shape (N, R).
        degree: Degree of both splines; the problem's by default.
        columns: Name -> values, shape (N,) or (N, w); ``start_xyz`` and ``goal_xyz`` [m] by forward kinematics unless
            they are given, and then they must be that.
        sample_id: Shape (N,); 0, 1, ... by default.
        status: Values of ``PlanStatus``, shape (N,); unknown by default.
        source: Where they are from, a line of text.

    Raises:
        UsageError: Something has the wrong shape.
    """
    record = problem if isinstance(problem, ProblemRecord) else record_problem(problem)
    path = numbers("path_control_points", path_control_points)
    parts = {name: None if part is None else numbers(name, part) for name, part in vars(boundary).items()}
    rows = path.shape[0] if path.ndim else 0
    plans = Plans(
        problem=record,
        boundary=Boundary(**parts),  # type: ignore[arg-type]
        path_control_points=path,
        rate_control_points=numbers("rate_control_points", rate_control_points),
        degree=record.trajectory.degree if degree is None else degree,
        columns={name: numbers(name, values) for name, values in (columns or {}).items()},
        sample_id=np.arange(rows) if sample_id is None else _integers("sample_id", sample_id, np.int64),
        status=np.zeros(rows, np.uint8) if status is None else _integers("status", status, np.uint8),
        source=source,
    )
    ends = {"start_xyz": plans.boundary.start_q, "goal_xyz": plans.boundary.goal_q}
    missing = {name: record.tip_positions(q) for name, q in ends.items() if name not in plans.columns}
    return replace(plans, columns={**plans.columns, **missing})


def check_plans_type(plans: Any) -> None:
    """Refuse what is not ``Plans``: the name of a file, for example.

    Raises:
        UsageError: It is something else.
    """
    if not isinstance(plans, Plans):
        raise UsageError(f"expected Plans, as load_plans and make_plans return them, got {type(plans).__name__}")


def concatenate(parts: Sequence[Plans]) -> Plans:
    """Join plans of the same problem that have the same control points and columns.

    Raises:
        UsageError: They do not fit together.
    """
    if not parts:
        raise UsageError("there are no plans to join")
    first = parts[0]
    for index, other in enumerate(parts[1:], 1):
        for what, mine, its in _kinds(first, other):
            if mine != its:
                raise UsageError(f"plans cannot be joined: {what} is {its} in part {index}, but {mine} in part 0")
    joined = [
        None if first_part is None else np.concatenate([getattr(part.boundary, name) for part in parts])
        for name, first_part in vars(first.boundary).items()
    ]
    sources, options = (list(dict.fromkeys(getattr(part, name) for part in parts)) for name in NOTES)
    return replace(
        first,
        source="; ".join(filter(None, sources)),
        refined_with=options[0] if len(options) == 1 else "",
        boundary=Boundary(*joined),  # type: ignore[arg-type]
        path_control_points=np.concatenate([part.path_control_points for part in parts]),
        rate_control_points=np.concatenate([part.rate_control_points for part in parts]),
        columns={name: np.concatenate([part.columns[name] for part in parts]) for name in first.columns},
        sample_id=np.concatenate([part.sample_id for part in parts]),
        status=np.concatenate([part.status for part in parts]),
    )


def screen(plans: Plans) -> NDArray[np.uint8]:
    """Find the plans that cannot be evaluated at all.

    Returns:
        Shape (N,): NOT_FINITE, NOT_FORWARD, or UNKNOWN for the plans that can be.
    """
    parts = [part for part in _parts(plans.boundary) if part is not None] + [plans.rate_control_points]
    finite = np.isfinite(plans.path_control_points).all(axis=(1, 2))
    finite &= np.all([np.isfinite(part).all(axis=1) for part in parts], axis=0)
    found = np.where(np.isfinite(plans.duration), PlanStatus.UNKNOWN, PlanStatus.NOT_FORWARD)
    return np.where(finite, found, PlanStatus.NOT_FINITE).astype(np.uint8)


def _integers(name: str, values: ArrayLike, kind: type[np.integer[Any]]) -> NDArray[Any]:
    """Return values as an array of integers of a kind, if they are such."""
    try:
        found = np.asarray(values)
        whole = found.astype(kind)
    except (TypeError, ValueError, OverflowError) as error:
        raise UsageError(f"{name} must be an array of integers: {error}") from error
    low, high = np.iinfo(kind).min, np.iinfo(kind).max
    if found.size and not (found.dtype.kind in "iu" and low <= found.min() and found.max() <= high):
        raise UsageError(f"{name} must hold integers from {low} to {high}, got {found.dtype} {found!s:.60}")
    return whole


def _checked(which: Any, plans: int) -> slice | NDArray[Any]:
    """Return what is selected as a slice or an array of shape (k,), if there are such plans."""
    if isinstance(which, slice):
        return which
    found = np.asarray(which)
    found = found.astype(np.int64) if found.size == 0 and found.dtype.kind == "f" else found  # an empty list
    if found.ndim != 1 or found.dtype.kind not in "biu":
        raise UsageError(f"plans are selected by a mask, integers or a slice, got {found.dtype} of shape {found.shape}")
    if found.dtype.kind == "b":
        if len(found) != plans:
            raise UsageError(f"a mask must have shape ({plans},) as there are {plans} plans, got {found.shape}")
    elif found.size and not -plans <= int(found.min()) <= int(found.max()) < plans:
        wrong = int(found.max() if found.max() >= plans else found.min())
        raise UsageError(f"there is no plan {wrong}: {plans} plans are numbered from 0")
    return found


def _parts(boundary: Boundary) -> list[Array | None]:
    return list(vars(boundary).values())


def _kinds(first: Plans, other: Plans) -> Iterator[tuple[str, Any, Any]]:
    """Yield what must be the same in plans that are joined."""
    yield "the problem", first.problem.comparable_sha256, other.problem.comparable_sha256
    yield "the degree", first.degree, other.degree
    for name in ("path_control_points", "rate_control_points"):
        yield f"the shape of a plan's {name}", getattr(first, name).shape[1:], getattr(other, name).shape[1:]
    yield "goal_ddq", first.boundary.goal_ddq is not None, other.boundary.goal_ddq is not None
    yield "the set of columns", sorted(first.columns), sorted(other.columns)
    for name, values in first.columns.items():
        yield f"the shape of column {name!r}", values.shape[1:], other.columns[name].shape[1:]


def _mistakes(plans: Plans) -> Iterator[str]:
    """Yield what is wrong with the shapes."""
    path, rate, degree = plans.path_control_points, plans.rate_control_points, plans.degree
    if path.ndim != 3:
        yield f"path_control_points must have shape (N, C, n), got {path.shape}"
        return
    _, points, n = path.shape
    rows = _rows(plans)
    if len(path) != rows:
        yield f"path_control_points must have shape ({rows}, C, n) like the other fields, got {path.shape}"
    joints = len(plans.problem.joint_names)
    if n != joints:
        yield f"path_control_points has {n} joints, but {plans.problem.name!r} plans {joints}: got shape {path.shape}"
    fewest = max(degree + 2, 3 + plans.boundary.fixed_at_goal)
    if points < fewest:
        yield f"path_control_points must have at least {fewest} of degree {degree}, got shape {path.shape}"
    if rate.ndim != 2 or len(rate) != rows or rate.shape[1] <= degree:
        yield f"rate_control_points must have shape ({rows}, R) with R > {degree}, the degree, got {rate.shape}"
    for name, values in vars(plans.boundary).items():
        if values is not None and values.shape != (rows, n):
            yield f"{name} must have shape {(rows, n)} (plans, joints), got {values.shape}"
    for name in ("sample_id", "status"):
        if getattr(plans, name).shape != (rows,):
            yield f"{name} must have shape {(rows,)}, got {getattr(plans, name).shape}"
    yield from _column_mistakes(plans, rows)
    for name in NOTES:
        if not isinstance(getattr(plans, name), str):
            yield f"{name} must be a text, got {getattr(plans, name)!r:.60}"


def _rows(plans: Plans) -> int:
    """Return how many plans most of the fields are about: the others are wrong."""
    fields: list[NDArray[Any]] = [part for part in _parts(plans.boundary) if part is not None]
    fields += [plans.path_control_points, plans.rate_control_points, plans.sample_id, plans.status]
    fields += plans.columns.values()
    return Counter(len(field) if field.ndim else 0 for field in fields).most_common(1)[0][0]


def _column_mistakes(plans: Plans, rows: int) -> Iterator[str]:
    for name, values in plans.columns.items():
        if name in {*FLOATS, *INTEGERS} or "/" in name or name in {"", "."}:
            yield f"a column cannot be called {name!r}"
        if values.ndim not in {1, 2} or len(values) != rows:
            yield f"{name} must have shape ({rows},) or ({rows}, w), got {values.shape}"
        elif name in {"start_xyz", "goal_xyz"} and values.shape != (rows, 3):
            yield f"{name} must have shape {(rows, 3)}, got {values.shape}"
