"""Recompute what rows claim from their stored numbers: every constraint at both ends, positions and hits."""

import math
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from functools import partial
from itertools import chain
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import ArrayLike

from cnpgen.errors import DatasetError
from cnpgen.judges.rows.diagnostics import ALLOWED, Diagnostic, stored_diagnostics
from cnpgen.judges.rows.fastest_hit import highest_speed
from cnpgen.judges.rows.hits import HitRule, judge_goals
from cnpgen.judges.rows.report import ENDS, Array, Check, Index, RowReport, compare, merge
from cnpgen.problems.constraints.constraint import EXACTNESS, Condition
from cnpgen.problems.constraints.needs import measured_needs
from cnpgen.problems.obstacles import obstacle_tops
from cnpgen.world.state import World

if TYPE_CHECKING:
    from cnpgen.problems.problem import Problem
    from cnpgen.robots.robot import Robot

NO_RULE = HitRule()
BLOCK = 1024  # rows: what is collected of a block before it is judged stays below 10 MB

_REQUIRED = ("start_q", "start_dq", "start_ddq", "goal_q", "goal_dq", "start_xyz", "goal_xyz")
_DERIVATIVES = ("q", "dq", "ddq")

Key = tuple[str, str, str]  # name, unit and exactness of a condition


def verify_rows(
    problem: "Problem",
    robot: "Robot",
    columns: Mapping[str, ArrayLike],
    dtype: str = "float64",
    rule: HitRule = NO_RULE,
) -> RowReport:
    """Verify rows with Pinocchio and Coal.

    Checked are, for every row and both of its ends:

    * "finite": every value is; a row that is not fails under this name only;
    * "tip position": the tip is at ``start_xyz`` and ``goal_xyz``;
    * what every constraint of the problem asks of a boundary state, under its conditions' names. What depends on
      accelerations is skipped at an end whose accelerations are not stored, unless the row rests there: a robot that
      stands still has ddq = 0, so its static torque is checked;
    * "hit direction", where ``hit_speed`` is positive, and "hit speed", along the hit: of the tip at the goal, if the
      rows have ``hit_angle`` and ``hit_speed``;
    * "highest hit speed": ``hit_speed_max`` is the optimum of the linear programme that it is defined by;
    * "holding torque ratio" and "clearance": what the rows store of an end as ``start_torque_ratio``,
      ``goal_torque_ratio``, ``start_clearance`` and ``goal_clearance`` is what is computed there;
    * "hitting configuration" and "hitting velocity", if ``rule`` says how goals came about: see
      ``cnpgen.judges.rows.hits``.

    How exactly each must hold is ``cnpgen.problems.constraints.constraint.EXACTNESS``.

    Args:
        problem: The problem.
        robot: Its robot.
        columns: Field -> values in SI units, shape (rows, width) or (rows,): ``start_q``, ``start_dq``, ``start_ddq``,
            ``goal_q``, ``goal_dq``, ``start_xyz``, ``goal_xyz``; optionally ``goal_ddq``, ``hit_angle``, ``hit_speed``,
            ``hit_speed_max`` and diagnostics. Other fields must be finite.
        dtype: The float type that the rows are stored in, which decides how exact they must be.
        rule: What the stages that drew the rows say of their goals; nothing by default.

    Raises:
        DatasetError: A field is missing or has another shape.
    """
    values = _read(columns, robot.n)
    rows = len(values["start_q"])
    world = World(robot, problem.obstacle, problem.object_size)
    slices = [slice(first, first + BLOCK) for first in range(0, max(rows, 1), BLOCK)]
    blocks = ({name: column[part] for name, column in values.items()} for part in slices)
    with np.errstate(over="ignore", invalid="ignore"):  # what is too large to compute with becomes inf or nan: it fails
        return merge([_verify_block(problem, world, block, dtype, rule) for block in blocks])


def _read(columns: Mapping[str, ArrayLike], n: int) -> dict[str, Array]:
    """Convert columns to float64 of shape (rows, width) and check their shapes."""
    missing = [name for name in _REQUIRED if name not in columns]
    if missing:
        raise DatasetError(f"the rows have no field {', '.join(missing)}")
    values = {name: np.asarray(column, np.float64) for name, column in columns.items()}
    rows = len(values["start_q"])
    widths = {f"{end}_{what}": n for end in ENDS for what in _DERIVATIVES} | {f"{end}_xyz": 3 for end in ENDS}
    for name, column in values.items():
        if len(column) != rows or (name in widths and column.shape != (rows, widths[name])):
            raise DatasetError(f"field {name} must have shape ({rows}, {widths.get(name, '...')}), got {column.shape}")
    return {name: column.reshape(rows, math.prod(column.shape[1:])) for name, column in values.items()}


@dataclass
class _Values:
    """One condition in many states, and the row and end of each."""

    found: list[Condition] = field(default_factory=list)
    where: list[tuple[int, int]] = field(default_factory=list)

    def judged(self, key: Key, dtype: str) -> tuple[Check, Index]:
        """Judge all states at once."""
        name, unit, exactness = key
        values = list(chain.from_iterable(condition.g for condition in self.found))
        lower, upper = (np.concatenate([getattr(c, side) for c in self.found]) for side in ("lower", "upper"))
        count = [len(condition.g) for condition in self.found]
        row, end = np.repeat(np.array(self.where, np.int64), count, axis=0).T
        g = np.array(values, float)
        violation = np.maximum(np.maximum(lower - g, g - upper), 0.0)
        allowed = Condition(name, unit, values, lower, upper, exactness).slack(dtype)
        return compare(name, unit, violation=violation, allowed=allowed, row=row, end=end)


@dataclass
class _Block:
    """What is measured in a block of rows.

    Attributes:
        position: Tip positions [m], shape (rows, 2, 3); nan where nothing was measured.
        hit_velocity: Tip velocities at the goal [m/s], shape (rows, 3); likewise.
        hit_jacobian: Jacobians of the tip there [m], shape (rows, 3, n); likewise.
        diagnostics: Those that the rows store.
        conditions: The constraints' conditions, in order of first use.
    """

    position: Array
    hit_velocity: Array
    hit_jacobian: Array
    diagnostics: list[Diagnostic]
    conditions: dict[Key, _Values] = field(default_factory=dict)


def _verify_block(problem: "Problem", world: World, columns: dict[str, Array], dtype: str, rule: HitRule) -> RowReport:
    rows = len(columns["start_q"])
    n_bad = np.sum([np.sum(~np.isfinite(column), axis=1) for column in columns.values()], axis=0)
    finite = np.flatnonzero(n_bad == 0)
    block = _measure(problem, world, columns, finite)
    zeros = np.zeros(rows, np.int64)
    judged = [
        compare(
            "finite", "1", violation=n_bad.astype(float), allowed=zeros.astype(float), row=np.arange(rows), end=zeros
        ),
        _judge_position(block, columns, finite, dtype),
        *(values.judged(key, dtype) for key, values in block.conditions.items()),
        *_judge_hit(block, columns, finite, dtype),
        *_judge_highest(world.robot, block, columns, finite, dtype),
        *judge_goals(world.robot, rule, columns, finite, dtype),
        *(diagnostic.judged(finite, dtype) for diagnostic in block.diagnostics),
    ]
    out = np.unique(np.concatenate([rows_out for _, rows_out in judged]))
    return RowReport(rows, tuple(check for check, _ in judged), out)


def _measure(problem: "Problem", world: World, columns: dict[str, Array], finite: Index) -> _Block:
    """Move the world to both ends of every finite row and note what it measures there."""
    rows = len(columns["start_q"])
    tops = obstacle_tops(problem, columns["start_xyz"], columns["goal_xyz"])
    position, velocity, jacobian = (np.full((rows, *shape), np.nan) for shape in ((2, 3), (3,), (3, world.robot.n)))
    block = _Block(position, velocity, jacobian, stored_diagnostics(problem, columns))
    for index, end in enumerate(ENDS):
        (q, dq, ddq), orders = _states(columns, end)
        forms = [partial(constraint.measured_at, end=end) for constraint in problem.constraint]
        needs = measured_needs(forms, world)
        for row in finite.tolist():
            world.set_state(q[row], dq[row], ddq[row], tops[row])
            block.position[row, index] = world.tip_position
            found = chain.from_iterable(form(world) for form in forms)
            known = (condition for condition, need in zip(found, needs, strict=True) if need <= orders[row])
            _note(block, known, (row, index))
            for diagnostic in block.diagnostics:
                diagnostic.note(world, row, index)
            if end == "goal" and "hit_speed" in columns:
                block.hit_velocity[row] = world.tip_velocity
            if end == "goal" and "hit_speed_max" in columns:
                block.hit_jacobian[row] = world.tip_jacobian
    return block


def _note(block: _Block, found: Iterator[Condition], where: tuple[int, int]) -> None:
    for condition in found:
        key = condition.name, condition.unit, condition.exactness
        values = block.conditions.get(key) or block.conditions.setdefault(key, _Values())
        values.found.append(condition)
        values.where.append(where)


def _states(columns: dict[str, Array], end: str) -> tuple[list[Array], list[int]]:
    """Return q, dq and ddq at an end, 0 where not stored, and per row the highest derivative that is known."""
    q, dq, ddq = (columns.get(f"{end}_{what}", np.zeros_like(columns[f"{end}_q"])) for what in _DERIVATIVES)
    if f"{end}_ddq" in columns:
        return [q, dq, ddq], [2] * len(q)
    return [q, dq, ddq], np.where(np.any(dq != 0, axis=1), 1, 2).tolist()


def _judge_position(block: _Block, columns: dict[str, Array], finite: Index, dtype: str) -> tuple[Check, Index]:
    claimed = np.stack([columns[f"{end}_xyz"] for end in ENDS], axis=1)
    error = np.linalg.norm(block.position - claimed, axis=2)[finite].ravel()
    row, end = np.repeat(finite, len(ENDS)), np.tile(np.arange(len(ENDS)), len(finite))
    allowed = np.full(error.shape, EXACTNESS[dtype]["position"])
    return compare("tip position", "m", violation=error, allowed=allowed, row=row, end=end)


def _judge_hit(block: _Block, columns: dict[str, Array], finite: Index, dtype: str) -> Iterator[tuple[Check, Index]]:
    """Judge direction and speed of the tip at the goal, in the x-y plane."""
    if "hit_angle" not in columns or "hit_speed" not in columns:
        return
    angle, speed = columns["hit_angle"][finite, 0], columns["hit_speed"][finite, 0]
    x, y, _ = block.hit_velocity[finite].T
    along, across = x * np.cos(angle) + y * np.sin(angle), y * np.cos(angle) - x * np.sin(angle)
    moving = speed > 0

    def judged(name: str, unit: str, error: Any, rows: Index, exactness: str) -> tuple[Check, Index]:
        allowed = np.full(len(rows), EXACTNESS[dtype][exactness])
        return compare(name, unit, violation=np.abs(error), allowed=allowed, row=rows, end=np.ones(len(rows), np.int64))

    direction = np.arctan2(across, along)[moving]
    yield judged("hit direction", "rad", direction, finite[moving], "direction")
    yield judged("hit speed", "m/s", along - speed, finite, "velocity")


def _judge_highest(
    robot: "Robot", block: _Block, columns: dict[str, Array], finite: Index, dtype: str
) -> Iterator[tuple[Check, Index]]:
    """Judge what is stored as the highest possible speed of a hit."""
    if "hit_angle" in columns and "hit_speed_max" in columns:
        highest = highest_speed(block.hit_jacobian[finite], columns["hit_angle"][finite, 0], robot.velocity_limit)
        error = np.abs(columns["hit_speed_max"][finite, 0] - highest)
        allowed, end = np.full(len(finite), ALLOWED[dtype]), np.ones(len(finite), np.int64)
        yield compare("highest hit speed", "m/s", violation=error, allowed=allowed, row=finite, end=end)
