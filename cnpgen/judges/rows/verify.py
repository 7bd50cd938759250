"""Verification of rows from their stored numbers: every constraint at both ends, positions and hits."""

import math
from collections import defaultdict
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from functools import partial
from itertools import chain

import numpy as np
from numpy.typing import ArrayLike

from cnpgen.errors import DatasetError
from cnpgen.judges.rows.diagnostics import DIAGNOSTIC_TOLERANCES, Diagnostic, stored_diagnostics
from cnpgen.judges.rows.hits import HitRule, highest_speed, judge_goals, velocity_factors
from cnpgen.judges.rows.row_report import ENDS, Array, Check, Index, RowReport, compare, merge
from cnpgen.problems.conditions import measured_needs
from cnpgen.problems.constraints.constraint import BOUNDARY_TOLERANCES, Condition
from cnpgen.problems.obstacles import goal_velocities, scene_of
from cnpgen.problems.problem import Problem
from cnpgen.robots.robot import Robot
from cnpgen.world.world import World

NO_RULE = HitRule()
OBSTACLE_POSES = "obstacle_poses"
VERIFICATION_BLOCK_ROWS = 1024  # measurements of a block need less than 10 MB

_REQUIRED = ("start_q", "start_dq", "start_ddq", "goal_q", "goal_dq", "start_xyz", "goal_xyz")
_DERIVATIVES = ("q", "dq", "ddq")

Key = tuple[str, str, str]  # name, unit and tolerance of a condition


def verify_rows(
    problem: Problem,
    robot: Robot,
    columns: Mapping[str, ArrayLike],
    dtype: str = "float64",
    rule: HitRule = NO_RULE,
) -> RowReport:
    """Verify rows with Pinocchio and Coal.

    The checks, for every row and both of its ends:

    * "finite": every value is finite; a row that is not fails only this check;
    * "tip position": the tip is at ``start_xyz`` and ``goal_xyz``;
    * every constraint of the problem at a boundary state, under the names of its conditions. Conditions on
      accelerations are skipped at an end whose accelerations are not stored, unless the row rests there: then ddq = 0,
      so the static torque is checked;
    * "hit direction", if ``hit_speed`` is positive, and "hit speed" along the hit: of the tip at the goal, if the rows
      have ``hit_angle`` and ``hit_speed``;
    * "highest hit speed": ``hit_speed_max`` is the optimum of the linear program that defines it;
    * "holding torque ratio" and "clearance": the stored ``start_torque_ratio``, ``goal_torque_ratio``,
      ``start_clearance`` and ``goal_clearance`` equal the recomputed values;
    * "hitting configuration" and "hitting velocity", if ``rule`` determines the goals (``cnpgen.judges.rows.hits``).

    The tolerances are ``cnpgen.problems.constraints.constraint.BOUNDARY_TOLERANCES``.

    Args:
        problem: The problem.
        robot: Its robot.
        columns: Field -> values in SI units, shape (rows, width) or (rows,): ``start_q``, ``start_dq``, ``start_ddq``,
            ``goal_q``, ``goal_dq``, ``start_xyz``, ``goal_xyz``; optionally ``goal_ddq``, ``hit_angle``, ``hit_speed``,
            ``hit_speed_max``, diagnostics, and ``obstacle_poses``, which replace those of the problem. Other fields
            must be finite.
        dtype: Float type of the stored rows, which determines the tolerances.
        rule: Rule by which the stages chose the goals; none by default.

    Raises:
        DatasetError: A field is missing or has a wrong shape.
    """
    values = _read(columns, robot.n)
    rows = len(values["start_q"])
    world = World(robot, problem.obstacle, problem.object_size)
    slices = [
        slice(first, first + VERIFICATION_BLOCK_ROWS) for first in range(0, max(rows, 1), VERIFICATION_BLOCK_ROWS)
    ]
    blocks = ({name: column[part] for name, column in values.items()} for part in slices)
    with np.errstate(over="ignore", invalid="ignore"):  # overflows give inf or nan and fail
        return merge([_verify_block(problem, world, block, dtype, rule) for block in blocks])


def _read(columns: Mapping[str, ArrayLike], n: int) -> dict[str, Array]:
    """Convert columns to float64 of shape (rows, width) and check their shapes."""
    missing = [name for name in _REQUIRED if name not in columns]
    if missing:
        raise DatasetError(f"the rows have no field {', '.join(missing)}")
    values = {name: np.asarray(column, np.float64) for name, column in columns.items()}
    rows = len(values["start_q"])
    widths = {f"{end}_{name}": n for end in ENDS for name in _DERIVATIVES} | {f"{end}_xyz": 3 for end in ENDS}
    for name, column in values.items():
        if len(column) != rows or (name in widths and column.shape != (rows, widths[name])):
            raise DatasetError(f"field {name} must have shape ({rows}, {widths.get(name, '...')}), got {column.shape}")
    return {name: column.reshape(rows, math.prod(column.shape[1:])) for name, column in values.items()}


@dataclass
class _ConditionValues:
    """One condition in many states, and the row and end of each."""

    conditions: list[Condition] = field(default_factory=list)
    places: list[tuple[int, int]] = field(default_factory=list)

    def judged(self, key: Key, dtype: str) -> tuple[Check, Index]:
        """Judge all states at once."""
        name, unit, quantity = key
        values = list(chain.from_iterable(condition.g for condition in self.conditions))
        lower, upper = (np.concatenate([getattr(c, side) for c in self.conditions]) for side in ("lower", "upper"))
        count = [len(condition.g) for condition in self.conditions]
        row, end = np.repeat(np.array(self.places, np.int64), count, axis=0).T
        g = np.array(values, float)
        violation = np.maximum(np.maximum(lower - g, g - upper), 0.0)
        tolerance = Condition(name, unit, values, lower, upper, quantity).tolerance(dtype)
        return compare(name, unit, violation=violation, tolerance=tolerance, row=row, end=end)


@dataclass
class _Measurements:
    """Measurements in a block of rows; nan in rows that were not measured.

    Tip positions [m] have shape (rows, 2, 3). Velocities [m/s], shape (rows, 3), and Jacobians [m], shape (rows, 3, n),
    of hits are those of the tip at the goal along the axes of the table. Conditions are in order of first use.
    """

    position: Array
    hit_velocity: Array
    hit_jacobian: Array
    diagnostics: list[Diagnostic]
    conditions: defaultdict[Key, _ConditionValues] = field(default_factory=lambda: defaultdict(_ConditionValues))


def _verify_block(problem: Problem, world: World, columns: dict[str, Array], dtype: str, rule: HitRule) -> RowReport:
    rows = len(columns["start_q"])
    n_invalid = np.sum([np.sum(~np.isfinite(column), axis=1) for column in columns.values()], axis=0)
    finite = np.flatnonzero(n_invalid == 0)
    measurements = _measure(problem, world, columns, finite)
    judged = [
        compare("finite", "1", violation=n_invalid.astype(float), tolerance=0.0, row=np.arange(rows), end=0),
        _judge_position(measurements, columns, finite, dtype),
        *(values.judged(key, dtype) for key, values in measurements.conditions.items()),
        *_judge_hit(measurements, columns, finite, dtype),
        *_judge_highest(world.robot, measurements, columns, finite, dtype),
        *judge_goals(world.robot, rule, columns, finite, dtype),
        *(diagnostic.judged(finite, dtype) for diagnostic in measurements.diagnostics),
    ]
    failed = np.unique(np.concatenate([failed_rows for _, failed_rows in judged]))
    return RowReport(rows, tuple(check for check, _ in judged), failed)


def _measure(problem: Problem, world: World, columns: dict[str, Array], finite: Index) -> _Measurements:
    """Move the world to both ends of every finite row and record the measurements."""
    rows = len(columns["start_q"])
    velocity = goal_velocities(problem, world.robot, columns["goal_q"], columns["goal_dq"])
    given = {"parameters": columns.get("parameters"), "obstacle_poses": columns.get(OBSTACLE_POSES)}
    poses = scene_of(problem, columns["start_xyz"], columns["goal_xyz"], velocity, **given).poses
    position, velocity, jacobian = (np.full((rows, *shape), np.nan) for shape in ((2, 3), (3,), (3, world.robot.n)))
    measurements = _Measurements(position, velocity, jacobian, stored_diagnostics(problem, columns))
    for index, end in enumerate(ENDS):
        (q, dq, ddq), orders = _states(columns, end)
        forms = [partial(constraint.measured_at, end=end) for constraint in problem.constraint]
        needs = measured_needs(forms, world)
        for row in finite.tolist():
            world.set_state(q[row], dq[row], ddq[row], poses[row])
            measurements.position[row, index] = world.tip_position
            measured = chain.from_iterable(form(world) for form in forms)
            known = (condition for condition, need in zip(measured, needs, strict=True) if need <= orders[row])
            _record(measurements, known, (row, index))
            for diagnostic in measurements.diagnostics:
                diagnostic.note(world, row, index)
            if end == "goal" and "hit_speed" in columns:
                measurements.hit_velocity[row] = world.parameters.along_table(world.tip_velocity)
            if end == "goal" and "hit_speed_max" in columns:
                measurements.hit_jacobian[row] = world.parameters.along_table(world.tip_jacobian)
    return measurements


def _record(measurements: _Measurements, conditions: Iterator[Condition], place: tuple[int, int]) -> None:
    for condition in conditions:
        key = condition.name, condition.unit, condition.tolerance_kind
        measurements.conditions[key].conditions.append(condition)
        measurements.conditions[key].places.append(place)


def _states(columns: dict[str, Array], end: str) -> tuple[list[Array], list[int]]:
    """Return q, dq and ddq at an end, 0 if not stored, and the highest known derivative of each row."""
    q, dq, ddq = (columns.get(f"{end}_{name}", np.zeros_like(columns[f"{end}_q"])) for name in _DERIVATIVES)
    if f"{end}_ddq" in columns:
        return [q, dq, ddq], [2] * len(q)
    return [q, dq, ddq], np.where(np.any(dq != 0, axis=1), 1, 2).tolist()


def _judge_position(block: _Measurements, columns: dict[str, Array], finite: Index, dtype: str) -> tuple[Check, Index]:
    claimed = np.stack([columns[f"{end}_xyz"] for end in ENDS], axis=1)
    error = np.linalg.norm(block.position - claimed, axis=2)[finite].ravel()
    row, end = np.repeat(finite, len(ENDS)), np.tile(np.arange(len(ENDS)), len(finite))
    tolerance = BOUNDARY_TOLERANCES[dtype]["position"]
    return compare("tip position", "m", violation=error, tolerance=tolerance, row=row, end=end)


def _judge_hit(
    block: _Measurements, columns: dict[str, Array], finite: Index, dtype: str
) -> Iterator[tuple[Check, Index]]:
    """Check direction and speed of the tip at the goal in the plane of the table."""
    if "hit_angle" not in columns or "hit_speed" not in columns:
        return
    angle, speed = columns["hit_angle"][finite, 0], columns["hit_speed"][finite, 0]
    x, y, _ = block.hit_velocity[finite].T
    along, across = x * np.cos(angle) + y * np.sin(angle), y * np.cos(angle) - x * np.sin(angle)
    moving, tolerances = speed > 0, BOUNDARY_TOLERANCES[dtype]
    direction, error = np.abs(np.arctan2(across, along)[moving]), np.abs(along - speed)
    tolerance = tolerances["direction"]
    yield compare("hit direction", "rad", violation=direction, tolerance=tolerance, row=finite[moving])
    yield compare("hit speed", "m/s", violation=error, tolerance=tolerances["velocity"], row=finite)


def _judge_highest(
    robot: Robot, block: _Measurements, columns: dict[str, Array], finite: Index, dtype: str
) -> Iterator[tuple[Check, Index]]:
    """Check the stored highest possible speed of a hit."""
    if "hit_angle" in columns and "hit_speed_max" in columns:
        highest = highest_speed(block.hit_jacobian[finite], columns["hit_angle"][finite, 0], robot.velocity_limit)
        highest *= velocity_factors(robot, columns)[finite]
        error = np.abs(columns["hit_speed_max"][finite, 0] - highest)
        yield compare("highest hit speed", "m/s", violation=error, tolerance=DIAGNOSTIC_TOLERANCES[dtype], row=finite)
