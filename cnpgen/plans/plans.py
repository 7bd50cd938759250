"""Plans: N motions, each for its own boundary conditions, all of one problem."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from cnpgen.arrays import AnyArray, Array, Integers
from cnpgen.documents import NamedErrors
from cnpgen.errors import UsageError, counted
from cnpgen.plans.format import FLOATS, INTEGERS, NOTES, PlanStatus
from cnpgen.plans.plausible import check_boundary_units
from cnpgen.problems.obstacles import goal_velocities, scene_of
from cnpgen.problems.problem import Problem
from cnpgen.problems.problem_record import ProblemRecord, as_record, open_problem
from cnpgen.robots.parameter_ranges import EXTRAPOLATE
from cnpgen.robots.scene import Scene
from cnpgen.schema.argument_types import check_fields, checked_arguments
from cnpgen.schema.arguments import check_memory, integer, numbers, reject_masked
from cnpgen.schema.html_table import html_table
from cnpgen.store.dataset_spec import StoredProblem
from cnpgen.store.scene_table import OBSTACLE_POSES
from cnpgen.trajectory.boundary import Boundary
from cnpgen.trajectory.spline_motion import Motion, states_at_times
from cnpgen.trajectory.trajectory_spec import MAX_CONTROL_POINTS, MAX_DEGREE

_NO_COLUMNS = {*FLOATS, *INTEGERS, "", "."}  # invalid names of columns


@dataclass(frozen=True, kw_only=True, eq=False)
class Plans:
    """N plans of one problem with n planned joints. Values may be invalid (nan, negative rates); shapes are valid.

    Attributes:
        problem: Record of the problem.
        boundary: Boundary conditions, shape (N, n) each.
        path_control_points: Control points of p(s) [rad], shape (N, C, n).
        rate_control_points: Control points of r(s) = ds/dt [1/s], shape (N, R).
        degree: Degree of both splines.
        columns: Further columns of the tasks: name -> values in SI units, shape (N,) or
            (N, w). ``start_xyz`` and ``goal_xyz``, the tip's positions in the world
            frame [m], shape (N, 3), are always there after ``make_plans`` and
            ``load_plans``. ``obstacle_poses``, shape (N, width), replaces the poses and
            sizes of the problem's obstacles (``cnpgen.robots.solid``), so that every
            plan has its own scene.
        sample_id: Sample ID of every plan in a dataset, shape (N,).
        status: Status of every plan, values of ``PlanStatus``, shape (N,).
        source: Source of the plans, a line of text, or empty.
        refined_with: Options of the refinement, as JSON, or empty.
        has_checksum: Whether they are from a file with a verified checksum.
    """

    problem: ProblemRecord
    boundary: Boundary
    path_control_points: Array
    rate_control_points: Array
    degree: int
    columns: Mapping[str, Array] = field(default_factory=dict)
    sample_id: Integers
    status: NDArray[np.uint8]
    source: str = ""
    refined_with: str = ""
    has_checksum: bool = False

    @property
    def checksum(self) -> str:
        """Text for summaries: "right", or "none" without a file or checksum."""
        return "right" if self.has_checksum else "none"

    def __post_init__(self) -> None:
        integer("degree", self.degree, least=3, most=MAX_DEGREE)
        try:
            # The first error in shapes is enough to raise; types are only checked when
            # something fails.
            wrong = next(_errors(self), None)
        except (AttributeError, TypeError, IndexError):
            check_fields(self)
            check_fields(self.boundary)
            raise
        if wrong is not None:
            check_fields(self)
            # The message compares each field with the number of plans that most fields
            # have.
            argument, text = next(_errors(self, _rows(self)))
            remedies = EXTRAPOLATE if "{extrapolate}" in text else None
            raise UsageError(text, concerns=argument, remedies=remedies)

    def __len__(self) -> int:
        return len(self.path_control_points)

    def __repr__(self) -> str:
        names = {status: status.name.lower() for status in PlanStatus}
        known = Counter(names.get(status, "unknown") for status in self.status.tolist())
        counts = ", ".join(f"{count:,} {name}" for name, count in known.most_common())
        return f"<{counted(len(self), 'plan')} of {self.problem.name!r}{counts and ': '}{counts}>"

    def _repr_html_(self) -> str:
        names = {status: status.name.lower() for status in PlanStatus}
        rows = (
            (index, sample, names.get(status, "unknown"), f"{duration:.4g}")
            for index, (sample, status, duration) in enumerate(
                zip(self.sample_id, self.status.tolist(), self.duration, strict=True)
            )
        )
        return html_table(repr(self), ("plan", "sample", "status", "T [s]"), rows)

    @property
    def motion(self) -> Motion:
        """The N motions."""
        return Motion(self.path_control_points, self.rate_control_points, self.degree)

    @cached_property
    def scene(self) -> Scene:
        """Obstacles of the plans.

        Raises:
            RecipeError: The problem needs a plug-in that is not installed.
            UsageError: The column ``obstacle_poses`` does not fit the problem.
        """
        problem, robot = open_problem(self.problem)
        velocity = goal_velocities(
            problem, robot, self.boundary.goal_q, self.boundary.goal_dq
        )
        ends = self.columns["start_xyz"], self.columns["goal_xyz"]
        scene = scene_of(problem, *ends, velocity, self.boundary.parameters)
        return (
            scene.with_poses(self.columns[OBSTACLE_POSES])
            if OBSTACLE_POSES in self.columns
            else scene
        )

    @cached_property
    def duration(self) -> Array:
        """Duration of every plan [s], shape (N,); inf or nan if undefined."""
        return self.motion.duration()

    def states_at(self, time: ArrayLike) -> tuple[Array, Array, Array]:
        """Evaluate each plan at one time.

        Args:
            time: Time since the start of each plan [s], one number or shape (N,).

        Returns:
            Positions [rad], velocities [rad/s] and accelerations [rad/s^2], shape (N,
            n) each.

        Raises:
            UsageError: The number of times differs from that of plans, or a time is
                outside its plan.
        """
        try:
            times = np.broadcast_to(numbers("time", time), (len(self),))
        except (UsageError, ValueError) as error:
            raise UsageError(
                f"must be one number or one for each of {len(self)} plans, got {time!r}",
                argument="time",
            ) from error
        # Negated, so that nan counts as outside.
        outside = ~((times >= 0) & (times <= self.duration))
        if outside.any():
            row = int(outside.argmax())
            check_made(self)
            raise UsageError(
                f"plan {row} lasts from 0 to {self.duration[row]:.9g} s, it cannot be evaluated at {times[row]:.9g} s",
                concerns="time",
            )
        return states_at_times(self.motion, times)

    def __getitem__(self, which: int | slice | Sequence[int] | AnyArray) -> Plans:
        """Return a selection of the plans, as Plans also for a single plan.

        Args:
            which: An index, several indices in any order, a mask of shape (N,), or a
                slice.

        Raises:
            PlanIndexError: The mask has another length, or an index is out of range; a
                subclass of IndexError.
        """
        which = _checked(which, len(self))
        if isinstance(which, np.ndarray):
            # An index array may repeat plans without limit.
            numbers_per_plan = self.path_control_points[0].size if len(self) else 1
            check_memory("which", len(which), len(which) * numbers_per_plan)
        return replace(
            self,
            boundary=self.boundary[which],
            path_control_points=self.path_control_points[which],
            rate_control_points=self.rate_control_points[which],
            columns={name: values[which] for name, values in self.columns.items()},
            sample_id=self.sample_id[which],
            status=self.status[which],
        )

    def __iter__(self) -> Iterator[Plans]:
        return (self[index] for index in range(len(self)))


class PlanIndexError(UsageError, IndexError):
    """Index of a plan that does not exist."""


@checked_arguments
def make_plans(
    problem: Problem | StoredProblem | str | Path,
    boundary: Boundary,
    *,
    path_control_points: ArrayLike,
    rate_control_points: ArrayLike,
    degree: int | None = None,
    columns: Mapping[str, ArrayLike] | None = None,
    sample_id: ArrayLike | None = None,
    status: ArrayLike | None = None,
    source: str = "",
    allow_large_angles: bool = False,
) -> Plans:
    """Build plans; missing data is computed.

    Values may be arrays of NumPy or JAX, or tensors of torch on the CPU, which are
    detached.

    Args:
        problem: Problem, record, or name or path of a problem, pipeline or dataset.
        boundary: Boundary conditions, shape (N, n) each.
        path_control_points: Control points of p(s) [rad], shape (N, C, n).
        rate_control_points: Control points of r(s) [1/s], shape (N, R).
        degree: Degree of both splines; the problem's by default.
        columns: Name -> values, shape (N,) or (N, w); ``start_xyz`` and ``goal_xyz``
            [m] by forward kinematics by default; given values must be consistent with
            it.
        sample_id: Sample IDs, shape (N,); 0, 1, ... by default.
        status: Values of ``PlanStatus``, shape (N,); unknown by default.
        source: Source of the plans, a line of text.
        allow_large_angles: Whether to accept boundary conditions that are probably in
            degrees or millimetres, with a warning.

    Raises:
        UsageError: An array has the wrong shape.
        UnitError: Boundary conditions are probably in degrees or millimetres.
    """
    record = as_record(problem)
    path = numbers("path_control_points", path_control_points)
    parts = {
        name: None if part is None else numbers(name, part)
        for name, part in vars(boundary).items()
    }
    rows = path.shape[0] if path.ndim else 0
    ids = np.arange(rows) if sample_id is None else sample_id
    statuses = np.zeros(rows, np.uint8) if status is None else status
    given = columns or {}
    plans = Plans(
        problem=record,
        boundary=Boundary(**parts),  # type: ignore[arg-type]
        path_control_points=path,
        rate_control_points=numbers("rate_control_points", rate_control_points),
        degree=record.trajectory.degree if degree is None else degree,
        columns={name: numbers(name, values) for name, values in given.items()},
        sample_id=_integers("sample_id", ids, np.int64),
        status=_integers("status", statuses, np.uint8),
        source=source,
    )
    _check_units(plans, allow_large_angles=allow_large_angles)
    return _with_tips(plans)


def _check_units(plans: Plans, *, allow_large_angles: bool) -> None:
    """Refuse boundary conditions that are probably in degrees or millimetres."""
    robot = open_problem(plans.problem)[1]
    boundary = plans.boundary
    check_boundary_units(
        robot, boundary, argument="boundary", allow_large_angles=allow_large_angles
    )


def _with_tips(plans: Plans) -> Plans:
    """Return plans with the positions of the tip at both ends, computed unless they are given."""
    ends = {"start_xyz": plans.boundary.start_q, "goal_xyz": plans.boundary.goal_q}
    missing = {
        name: plans.problem.tip_positions(q)
        for name, q in ends.items()
        if name not in plans.columns
    }
    return replace(plans, columns={**plans.columns, **missing})


def check_made(plans: Plans) -> None:
    """Raise UsageError for a plan without control points."""
    # Boundary problems have nan in all control points; a single nan is a plan that is
    # not finite.
    waiting = np.isnan(plans.path_control_points).all(axis=(1, 2))
    if waiting.any():
        raise UsageError(
            f"plan {int(waiting.argmax())} has no control points yet: solve_plans(plans) makes them",
            concerns="plans",
        )


def screen(plans: Plans) -> NDArray[np.uint8]:
    """Find the plans that cannot be evaluated.

    Returns:
        Status, shape (N,): NOT_FINITE, NOT_FORWARD, or UNKNOWN for plans that can be
            evaluated.
    """
    parts = [*plans.boundary.arrays().values(), plans.rate_control_points]
    finite = np.isfinite(plans.path_control_points).all(axis=(1, 2))
    finite &= np.all([np.isfinite(part).all(axis=1) for part in parts], axis=0)
    # The duration, the integral of 1 / r(s), is finite only if the rate is positive
    # throughout.
    found = np.where(
        np.isfinite(plans.duration), PlanStatus.UNKNOWN, PlanStatus.NOT_FORWARD
    )
    return np.where(finite, found, PlanStatus.NOT_FINITE).astype(np.uint8)


def _integers(name: str, values: ArrayLike, kind: type[np.integer[Any]]) -> AnyArray:
    """Return values as an integer array of a type; raise an error for other values."""
    try:
        reject_masked(name, values)
        found = np.asarray(values)
        whole = found.astype(kind)
    except (TypeError, ValueError, OverflowError) as error:
        raise UsageError(
            f"must be an array of integers: {error}", argument=name
        ) from error
    low = np.iinfo(kind).min
    high = np.iinfo(kind).max
    if found.size and not (
        # astype wraps numbers that do not fit, hence the comparison with the original
        # values.
        found.dtype.kind in "iu" and low <= found.min() and found.max() <= high
    ):
        raise UsageError(
            f"must hold integers from {low} to {high}, got {found.dtype} {found!s:.60}",
            argument=name,
        )
    return whole


def _checked(which: Any, plans: int) -> slice | AnyArray:
    """Return a selection of plans as a slice or an index array of shape (k,)."""
    if isinstance(which, slice):
        return which
    try:
        found = np.asarray(which)
    except ValueError as error:
        raise PlanIndexError(
            f"plans are selected by numbers or a mask: {error}", concerns="which"
        ) from error
    # An empty list.
    found = (
        found.astype(np.int64) if found.size == 0 and found.dtype.kind == "f" else found
    )
    if (
        found.ndim > 1
        or found.dtype.kind not in "biu"
        or (found.ndim == 0 and found.dtype.kind == "b")
    ):
        got = f"{found.dtype} of shape {found.shape}"
        raise PlanIndexError(
            f"plans are selected by a number, numbers, a mask or a slice, got {got}",
            concerns="which",
        )
    if found.dtype.kind == "b":
        if len(found) != plans:
            raise PlanIndexError(
                f"a mask must have shape ({plans},) as there are {plans} plans, got {found.shape}",
                concerns="which",
            )
    # Negative numbers count from the end, as of lists.
    elif found.size and not -plans <= int(found.min()) <= int(found.max()) < plans:
        wrong = int(found.max() if found.max() >= plans else found.min())
        raise PlanIndexError(
            f"there is no plan {wrong}: {counted(plans, 'plan')}, numbered from 0",
            concerns="which",
        )
    return np.atleast_1d(found)


def _errors(plans: Plans, rows: int | None = None) -> NamedErrors:
    """Yield the argument and the message of every error in shapes.

    The default number of plans is that of the paths.
    """
    path = plans.path_control_points
    if path.ndim != 3:
        yield (
            "path_control_points",
            f"path_control_points must have shape (N, C, n), got {path.shape}",
        )
        return
    rows = len(path) if rows is None else rows
    n = path.shape[2]
    yield from _spline_errors(plans, rows)
    for name, values in plans.boundary.conditions().items():
        if values.shape != (rows, n):
            yield (
                "boundary",
                f"{name} must have shape {(rows, n)} (plans, joints), got {values.shape}",
            )
    yield from _parameter_errors(plans, rows)
    for name in ("sample_id", "status"):
        if getattr(plans, name).shape != (rows,):
            yield (
                name,
                f"{name} must have shape {(rows,)}, got {getattr(plans, name).shape}",
            )
    yield from _column_errors(plans, rows)
    for name in NOTES:
        if not isinstance(getattr(plans, name), str):
            yield name, f"{name} must be a text, got {getattr(plans, name)!r:.60}"


def _spline_errors(plans: Plans, rows: int) -> NamedErrors:
    path = plans.path_control_points
    rate = plans.rate_control_points
    degree = plans.degree
    _, points, n = path.shape
    if len(path) != rows:
        yield (
            "path_control_points",
            f"path_control_points must have shape ({rows}, C, n) like the other fields, got {path.shape}",
        )
    joints = len(plans.problem.joint_names)
    if n != joints:
        yield (
            "path_control_points",
            f"path_control_points has {n} joints, but {plans.problem.name!r} plans {joints}: got shape {path.shape}",
        )
    # The conditions at both ends fix control points, of which a path needs at least as
    # many.
    min_count = plans.boundary.min_control_points(degree)
    if points < min_count:
        yield (
            "path_control_points",
            f"path_control_points must have at least {min_count} of degree {degree}, got shape {path.shape}",
        )
    most = max(points, rate.shape[-1] if rate.ndim else 0)
    if most > MAX_CONTROL_POINTS:
        yield (
            "path_control_points",
            f"splines have at most {MAX_CONTROL_POINTS} control points, got {most}",
        )
    if rate.ndim != 2 or len(rate) != rows or rate.shape[1] <= degree:
        yield (
            "rate_control_points",
            f"rate_control_points must have shape ({rows}, R) with R > {degree}, the degree, got {rate.shape}",
        )


def _parameter_errors(plans: Plans, rows: int) -> NamedErrors:
    parameters = plans.boundary.parameters
    width = len(plans.problem.parameters)
    if width and parameters is None:
        names = ", ".join(plans.problem.parameters.names)
        yield (
            "boundary",
            f"parameters are missing: plans of {plans.problem.name!r} have {names}",
        )
    elif parameters is not None and parameters.shape != (rows, width):
        yield (
            "boundary",
            f"parameters must have shape {(rows, width)} (plans, parameters of the problem), got {parameters.shape}",
        )
    elif parameters is not None and (
        text := plans.problem.parameters.out_of_range(parameters)
    ):
        yield "boundary", f"parameters: {text}"


def _rows(plans: Plans) -> int:
    """Return the most frequent number of plans among the fields."""
    fields: list[AnyArray] = [*plans.boundary.arrays().values()]
    fields += [
        plans.path_control_points,
        plans.rate_control_points,
        plans.sample_id,
        plans.status,
    ]
    fields += plans.columns.values()
    # The most frequent length is probably the intended one: the error then names the
    # field that differs.
    return Counter(
        len(field) if getattr(field, "ndim", 0) else 0 for field in fields
    ).most_common(1)[0][0]


def _column_errors(plans: Plans, rows: int) -> NamedErrors:
    for name, values in plans.columns.items():
        array: Any = values
        if not isinstance(array, np.ndarray):
            yield (
                "columns",
                f"columns must hold arrays of NumPy, got {array!r:.60} at {name!r:.60}",
            )
            return
        if name in _NO_COLUMNS or "/" in name:
            yield "columns", f"a column cannot be called {name!r}"
        if values.ndim not in {1, 2} or len(values) != rows:
            yield (
                "columns",
                f"{name} must have shape ({rows},) or ({rows}, w), got {values.shape}",
            )
        elif name in {"start_xyz", "goal_xyz"} and values.shape != (rows, 3):
            yield "columns", f"{name} must have shape {(rows, 3)}, got {values.shape}"
