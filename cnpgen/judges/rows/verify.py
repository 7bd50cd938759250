"""Verification of rows from their stored numbers: constraints at both ends, positions, hits, diagnostics and plans."""

import math
from collections import defaultdict
from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import dataclass, field
from functools import partial
from itertools import chain

import numpy as np
from numpy.typing import ArrayLike

from cnpgen.arrays import AnyArray, Array
from cnpgen.errors import DatasetError
from cnpgen.judges.plans.judge import judge
from cnpgen.judges.rows.hits import (
    HitRule,
    highest_speed,
    judge_goals,
    velocity_factors,
)
from cnpgen.judges.rows.row_report import ENDS, Check, Index, RowReport, compare, merge
from cnpgen.problems.conditions import measured_needs
from cnpgen.problems.constraints.constraint import BOUNDARY_TOLERANCES, Condition
from cnpgen.problems.obstacles import goal_velocities, scene_of
from cnpgen.problems.problem import Problem
from cnpgen.robots.robot import Robot
from cnpgen.store.scene_table import OBSTACLE_POSES
from cnpgen.trajectory.boundary import Boundary
from cnpgen.trajectory.spline_motion import Motion
from cnpgen.world.world import World

NO_RULE = HitRule()
VERIFICATION_BLOCK_ROWS = 1024  # measurements of a block need less than 10 MB
# Tolerances of stored diagnostics, in their units. Coal's distances have errors of
# 4e-11 m. In float32 the rounding of joint positions moves the arm by 1e-7 m and
# changes its highest speed by 2e-6 m/s in 40,000 rows.
DIAGNOSTIC_TOLERANCES = {"float64": 1e-8, "float32": 1e-4}

_REQUIRED = (
    "start_q",
    "start_dq",
    "start_ddq",
    "goal_q",
    "goal_dq",
    "start_xyz",
    "goal_xyz",
)
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
      accelerations are skipped at an end whose accelerations are not stored, unless the
      row rests there: then ddq = 0, so the static torque is checked;
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
        columns: Field -> values in SI units, shape (rows, width) or (rows,):
            ``start_q``, ``start_dq``, ``start_ddq``, ``goal_q``, ``goal_dq``,
            ``start_xyz``, ``goal_xyz``; optionally ``goal_ddq``, ``hit_angle``,
            ``hit_speed``, ``hit_speed_max``, diagnostics, and ``obstacle_poses``, which
            replace those of the problem. Other fields must be finite.
        dtype: Float type of the stored rows, which determines the tolerances.
        rule: Rule by which the stages chose the goals; none by default.

    Raises:
        DatasetError: A field is missing or has a wrong shape.
    """
    values = _read(columns, robot.n)
    rows = len(values["start_q"])
    world = World(robot, problem.obstacle, problem.object_size)
    # Blocks bound the memory of the measurements.
    slices = [
        slice(first, first + VERIFICATION_BLOCK_ROWS)
        for first in range(0, max(rows, 1), VERIFICATION_BLOCK_ROWS)
    ]
    blocks = (
        {name: column[part] for name, column in values.items()} for part in slices
    )
    # Overflows give inf or nan and fail.
    with np.errstate(over="ignore", invalid="ignore"):
        return merge(
            [_verify_block(problem, world, block, dtype, rule) for block in blocks]
        )


def _read(columns: Mapping[str, ArrayLike], n: int) -> dict[str, Array]:
    """Convert columns to float64 of shape (rows, width) and check their shapes."""
    missing = [name for name in _REQUIRED if name not in columns]
    if missing:
        raise DatasetError(f"the rows have no field {', '.join(missing)}")
    values = {name: np.asarray(column, np.float64) for name, column in columns.items()}
    rows = len(values["start_q"])
    widths = {f"{end}_{name}": n for end in ENDS for name in _DERIVATIVES} | {
        f"{end}_xyz": 3 for end in ENDS
    }
    for name, column in values.items():
        if len(column) != rows or (
            name in widths and column.shape != (rows, widths[name])
        ):
            raise DatasetError(
                f"field {name} must have shape ({rows}, {widths.get(name, '...')}), got {column.shape}"
            )
    return {
        name: column.reshape(rows, math.prod(column.shape[1:]))
        for name, column in values.items()
    }


@dataclass
class _ConditionValues:
    """One condition in many states, and the row and end of each."""

    conditions: list[Condition] = field(default_factory=list)
    places: list[tuple[int, int]] = field(default_factory=list)

    def judged(self, key: Key, dtype: str) -> tuple[Check, Index]:
        """Judge all states at once."""
        name, unit, quantity = key
        values = list(chain.from_iterable(condition.g for condition in self.conditions))
        lower, upper = (
            np.concatenate([getattr(c, side) for c in self.conditions])
            for side in ("lower", "upper")
        )
        count = [len(condition.g) for condition in self.conditions]
        # One entry per value of each condition, with the row and end that it belongs
        # to.
        row, end = np.repeat(np.array(self.places, np.int64), count, axis=0).T
        g = np.array(values, float)
        violation = np.maximum(np.maximum(lower - g, g - upper), 0.0)
        tolerance = Condition(name, unit, values, lower, upper, quantity).tolerance(
            dtype
        )
        return compare(
            name, unit, violation=violation, tolerance=tolerance, row=row, end=end
        )


@dataclass(frozen=True)
class Diagnostic:
    """One diagnostic of both ends."""

    name: str  # name of the diagnostic
    unit: str  # SI unit
    compute: Callable[[World], float]  # function that computes it from a world's state
    stored: Array  # stored values, shape (rows, 2); nan at an end without one
    recomputed: Array  # recomputed values, shape (rows, 2)

    def judged(self, finite: Index, dtype: str) -> tuple[Check, Index]:
        """Compare stored and recomputed values in finite rows."""
        index, end = np.nonzero(~np.isnan(self.stored[finite]))
        row = finite[index]
        error = np.abs(self.stored[row, end] - self.recomputed[row, end])
        tolerance = DIAGNOSTIC_TOLERANCES[dtype]
        return compare(
            self.name, self.unit, violation=error, tolerance=tolerance, row=row, end=end
        )


@dataclass
class _Measurements:
    """Measurements in a block of rows; nan in rows that were not measured.

    Tip positions [m] have shape (rows, 2, 3). Velocities [m/s], shape (rows, 3), and
    Jacobians [m], shape (rows, 3, n), of hits are those of the tip at the goal along
    the axes of the table. Conditions are in order of first use.
    """

    position: Array
    hit_velocity: Array
    hit_jacobian: Array
    diagnostics: list[Diagnostic]
    conditions: defaultdict[Key, _ConditionValues] = field(
        default_factory=lambda: defaultdict(_ConditionValues)
    )

    def add_conditions(
        self, conditions: Iterable[Condition], row: int, end: int
    ) -> None:
        """Record the conditions of one state."""
        for condition in conditions:
            key = condition.name, condition.unit, condition.tolerance_kind
            self.conditions[key].conditions.append(condition)
            self.conditions[key].places.append((row, end))

    def add_hit(self, world: World, row: int, columns: Mapping[str, Array]) -> None:
        """Record what the hitting speeds of a row need of the world at its goal, along the axes of the table."""
        along_table = world.parameters.along_table
        if "hit_speed" in columns:
            self.hit_velocity[row] = along_table(world.tip_velocity)
        if "hit_speed_max" in columns:
            self.hit_jacobian[row] = along_table(world.tip_jacobian)


def _verify_block(
    problem: Problem, world: World, columns: dict[str, Array], dtype: str, rule: HitRule
) -> RowReport:
    rows = len(columns["start_q"])
    # A row with a nan would fail every check; it is reported once.
    n_invalid = np.sum(
        [np.sum(~np.isfinite(column), axis=1) for column in columns.values()], axis=0
    )
    finite = np.flatnonzero(n_invalid == 0)
    measurements = _measure(problem, world, columns, finite)
    judged = [
        compare(
            "finite",
            "1",
            violation=n_invalid.astype(float),
            tolerance=0.0,
            row=np.arange(rows),
            end=0,
        ),
        _judge_position(measurements, columns, finite, dtype),
        *(values.judged(key, dtype) for key, values in measurements.conditions.items()),
        *_judge_hit(world.robot, measurements, columns, finite, dtype),
        *judge_goals(world.robot, rule, columns, finite, dtype),
        *(diagnostic.judged(finite, dtype) for diagnostic in measurements.diagnostics),
    ]
    failed = np.unique(np.concatenate([failed_rows for _, failed_rows in judged]))
    return RowReport(rows, tuple(check for check, _ in judged), failed)


def _stored_diagnostics(
    problem: Problem, columns: Mapping[str, Array]
) -> list[Diagnostic]:
    """List the diagnostics in columns that can be recomputed: torque ratio, and clearance of an arm with a radius."""
    radius = problem.arm_radius
    missing = np.full((len(columns["start_q"]), 1), np.nan)
    kinds: dict[str, tuple[str, str, Callable[[World], float]]] = {
        "torque_ratio": ("holding torque ratio", "1", _holding_torque_ratio)
    }
    if radius is not None and problem.obstacle:
        kinds["clearance"] = (
            "clearance",
            "m",
            lambda world: min(world.segment_distances()) - radius,
        )
    diagnostics = []
    for field_name, kind in kinds.items():
        stored = np.concatenate(
            [columns.get(f"{end}_{field_name}", missing) for end in ENDS], axis=1
        )
        if not np.isnan(stored).all():
            diagnostics.append(Diagnostic(*kind, stored, np.full_like(stored, np.nan)))
    return diagnostics


def _holding_torque_ratio(world: World) -> float:
    return float(np.max(np.abs(world.holding_torque) / world.robot.holding_limit))


def _measure(
    problem: Problem, world: World, columns: dict[str, Array], finite: Index
) -> _Measurements:
    """Move the world to both ends of every finite row and record the measurements."""
    poses = _scene(problem, world.robot, columns)
    rows = len(columns["start_q"])
    measurements = _Measurements(
        np.full((rows, 2, 3), np.nan),
        np.full((rows, 3), np.nan),
        np.full((rows, 3, world.robot.n), np.nan),
        _stored_diagnostics(problem, columns),
    )
    for index, end in enumerate(ENDS):
        (q, dq, ddq), orders = _states(columns, end)
        forms = [
            partial(constraint.measured_at, end=end)
            for constraint in problem.constraint
        ]
        # Highest derivative that each condition reads: 0, 1 or 2.
        needs = measured_needs(forms, world)
        for row in finite.tolist():
            world.set_state(q[row], dq[row], ddq[row], poses[row])
            measurements.position[row, index] = world.tip_position
            measured = chain.from_iterable(form(world) for form in forms)
            # A row that stores no acceleration knows only conditions on positions and
            # velocities.
            known = (
                condition
                for condition, need in zip(measured, needs, strict=True)
                if need <= orders[row]
            )
            measurements.add_conditions(known, row, index)
            for diagnostic in measurements.diagnostics:
                if np.isfinite(diagnostic.stored[row, index]):
                    diagnostic.recomputed[row, index] = diagnostic.compute(world)
            if end == "goal":
                measurements.add_hit(world, row, columns)
    return measurements


def _scene(problem: Problem, robot: Robot, columns: dict[str, Array]) -> Array:
    """Return the obstacle poses of rows: the stored ones, or those that follow from both ends."""
    velocity = goal_velocities(problem, robot, columns["goal_q"], columns["goal_dq"])
    return scene_of(
        problem,
        columns["start_xyz"],
        columns["goal_xyz"],
        velocity,
        parameters=columns.get("parameters"),
        obstacle_poses=columns.get(OBSTACLE_POSES),
    ).poses


def _states(columns: dict[str, Array], end: str) -> tuple[list[Array], list[int]]:
    """Return q, dq and ddq at an end, 0 if not stored, and the highest known derivative of each row."""
    q, dq, ddq = (
        columns.get(f"{end}_{name}", np.zeros_like(columns[f"{end}_q"]))
        for name in _DERIVATIVES
    )
    if f"{end}_ddq" in columns:
        return [q, dq, ddq], [2] * len(q)
    # A row at rest stays at rest: its acceleration is 0, so torques are known.
    return [q, dq, ddq], np.where(np.any(dq != 0, axis=1), 1, 2).tolist()


def _judge_position(
    block: _Measurements, columns: dict[str, Array], finite: Index, dtype: str
) -> tuple[Check, Index]:
    claimed = np.stack([columns[f"{end}_xyz"] for end in ENDS], axis=1)
    error = np.linalg.norm(block.position - claimed, axis=2)[finite].ravel()
    row = np.repeat(finite, len(ENDS))
    end = np.tile(np.arange(len(ENDS)), len(finite))
    tolerance = BOUNDARY_TOLERANCES[dtype]["position"]
    return compare(
        "tip position", "m", violation=error, tolerance=tolerance, row=row, end=end
    )


def _judge_hit(
    robot: Robot,
    block: _Measurements,
    columns: dict[str, Array],
    finite: Index,
    dtype: str,
) -> Iterator[tuple[Check, Index]]:
    """Check direction, speed and highest possible speed of the tip at the goal in the plane of the table."""
    if "hit_angle" not in columns:
        return
    angle = columns["hit_angle"][finite, 0]
    if "hit_speed" in columns:
        yield from _judge_velocity(
            block.hit_velocity[finite],
            angle,
            columns["hit_speed"][finite, 0],
            finite,
            dtype,
        )
    if "hit_speed_max" in columns:
        # Factors scale all velocity limits, and the optimum of the linear program with
        # them.
        highest = highest_speed(block.hit_jacobian[finite], angle, robot.velocity_limit)
        highest *= velocity_factors(robot, columns)[finite]
        error = np.abs(columns["hit_speed_max"][finite, 0] - highest)
        yield compare(
            "highest hit speed",
            "m/s",
            violation=error,
            tolerance=DIAGNOSTIC_TOLERANCES[dtype],
            row=finite,
        )


def _judge_velocity(
    velocity: Array, angle: Array, speed: Array, rows: Index, dtype: str
) -> Iterator[tuple[Check, Index]]:
    """Compare tip velocities on the table, shape (rows, 3), with directions [rad] and speeds [m/s] of hits."""
    tolerances = BOUNDARY_TOLERANCES[dtype]
    x, y, _ = velocity.T
    along = x * np.cos(angle) + y * np.sin(angle)
    across = y * np.cos(angle) - x * np.sin(angle)
    # A hit of speed 0 has no direction.
    moving = speed > 0
    yield compare(
        "hit direction",
        "rad",
        violation=np.abs(np.arctan2(across, along)[moving]),
        tolerance=tolerances["direction"],
        row=rows[moving],
    )
    yield compare(
        "hit speed",
        "m/s",
        violation=np.abs(along - speed),
        tolerance=tolerances["velocity"],
        row=rows,
    )


@dataclass(frozen=True)
class PlanCheck:
    """Number of plans in rows of a certified dataset, number of valid ones, and error messages of one line."""

    judged: int = 0
    valid: int = 0
    problems: tuple[str, ...] = ()


def check_plans(
    problem: Problem, robot: Robot, columns: Mapping[str, AnyArray]
) -> PlanCheck:
    """Judge the plans in columns of a certified dataset, field -> values.

    Rows of other datasets have none.
    """
    if "path_control_points" not in columns:
        return PlanCheck()
    rows = len(columns["start_q"])
    spec = problem.trajectory
    path = columns["path_control_points"].reshape(
        rows, spec.path_control_points, robot.n
    )
    motion = Motion(path, columns["rate_control_points"], spec.degree)
    boundary = Boundary.from_batch(columns, None)
    velocity = goal_velocities(problem, robot, boundary.goal_q, boundary.goal_dq)
    poses = columns.get(OBSTACLE_POSES)
    scene = scene_of(
        problem,
        columns["start_xyz"],
        columns["goal_xyz"],
        velocity,
        boundary.parameters,
        obstacle_poses=poses,
    )
    verdicts = judge(problem, robot, motion, boundary, scene, columns["goal_xyz"])
    invalid = [
        (row, verdict.reason)
        for row, verdict in enumerate(verdicts)
        if not verdict.valid
    ]
    problems = []
    if invalid:
        row, reason = invalid[0]
        problems.append(
            f"{len(invalid)} of {rows} plans are not valid, the first one is that of row {row}: {reason}"
        )
    if not np.allclose(columns["duration"], motion.duration(), rtol=1e-9, atol=0):
        problems.append("stored durations differ from those of the plans")
    return PlanCheck(rows, rows - len(invalid), tuple(problems))
