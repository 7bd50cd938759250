"""Deep check of a dataset: recomputation of every row with Pinocchio and Coal, and detection of duplicate rows."""

from collections.abc import Callable, Iterator, Mapping
from contextlib import closing
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from cnpgen.arrays import AnyArray, Array, Indices
from cnpgen.errors import CnpgenError, counted
from cnpgen.judges.rows.hits import hit_rule, repeated_fraction, speed_fractions
from cnpgen.judges.rows.row_report import RowReport, merge
from cnpgen.judges.rows.verify import PlanCheck, check_plans, verify_rows
from cnpgen.machine.engine import Engine, assembled
from cnpgen.make.recipe import restored
from cnpgen.problems.constraints.constraint import BOUNDARY_TOLERANCES
from cnpgen.problems.load_robot import load_robot
from cnpgen.robots.scene import scene_poses
from cnpgen.store.check import DELETE_HINT, Finding
from cnpgen.store.checked_shard import Shard, read_checked, read_scenes
from cnpgen.store.dataset_spec import DatasetSpec, ShardTask
from cnpgen.store.field import Field
from cnpgen.store.scene_table import OBSTACLE_POSES, SCENE_ID
from cnpgen.store.shard_record import ShardRecord, load_record
from cnpgen.store.statistics import FieldStatistics, field_statistics

# Accepted relative difference of sums of the same numbers between versions of NumPy.
MAX_RELATIVE_SUM_ERROR = 1e-9
_ODD_MULTIPLIERS = np.random.default_rng(0).integers(
    0, 2**63, 64, dtype=np.uint64
) * np.uint64(2) + np.uint64(1)


@dataclass(frozen=True)
class DeepCheck:
    """Report of Pinocchio and Coal on all rows, numbers of judged and valid plans, and problems by file."""

    rows: RowReport | None = None
    judged: int = 0
    valid: int = 0
    findings: tuple[Finding, ...] = ()


def check_rows(
    folder: Path,
    spec: DatasetSpec,
    tasks: list[ShardTask],
    engine: Engine,
    progress: Callable[[int], None] | None,
) -> DeepCheck:
    """Recompute every row, shard by shard, and judge every plan.

    Report the rows of every shard that was read.
    """
    checks = []
    findings = []
    with assembled(engine, len(tasks)) as pool:
        verify = partial(
            _verify_shard, folder.absolute() if pool.is_remote else folder, spec
        )
        with closing(pool.distribute(verify, tasks, ordered=True)) as results:
            for task, result in zip(tasks, results, strict=True):
                findings += [
                    Finding(task.file, problem, hint=DELETE_HINT)
                    for problem in result.problems
                ]
                checks.append(result)
                if progress is not None:
                    progress(task.rows)
    # Equal rows have equal keys; 64 bits make equal keys of different rows improbable.
    keys = np.concatenate([np.empty(0, np.uint64), *(check.keys for check in checks)])
    n_duplicates = len(keys) - len(np.unique(keys))
    if n_duplicates:
        findings.append(
            Finding("(all splits)", f"{counted(n_duplicates, 'duplicate row')}")
        )
    findings += [
        Finding("(all splits)", text) for text in _check_speed_fractions(spec, checks)
    ]
    reports = [check.report for check in checks if check.report is not None]
    judged = sum(check.plans.judged for check in checks)
    valid = sum(check.plans.valid for check in checks)
    return DeepCheck(
        merge(reports) if reports else None, judged, valid, tuple(findings)
    )


@dataclass(frozen=True)
class _ShardCheck:
    """Result of the deep check of one shard, without a report if it cannot be read.

    The keys are hashes of the boundary states of its rows, the goals those of its hits.
    Hit speeds are fractions of the maximum speed, and empty if the rows are no hits.
    All have shape (rows,).
    """

    report: RowReport | None
    problems: list[str]
    keys: NDArray[np.uint64]
    plans: PlanCheck
    fractions: Array
    goals: NDArray[np.uint64]


_END_COLUMNS = ("start_q", "start_dq", "start_ddq", "goal_q", "goal_dq")


def _verify_shard(folder: Path, spec: DatasetSpec, task: ShardTask) -> _ShardCheck:
    """Verify one shard; a shard that cannot be read is a finding, not an exception."""
    try:
        record = load_record(folder, task)
        shard = Shard(folder, spec, task, record.bytes, record.sha256)
        columns = read_checked(shard)
        scenes = read_scenes(shard) if spec.scene_obstacles else None
    except CnpgenError as error:
        none = np.empty(0, np.uint64)
        return _ShardCheck(None, [str(error)], none, PlanCheck(), np.empty(0), none)
    with restored(spec) as recipe:
        problem = recipe.pipeline.problem
        robot = load_robot(problem)
        if scenes is not None:
            table = scenes[scenes.rows_of(columns[SCENE_ID])]
            columns[OBSTACLE_POSES] = scene_poses(problem.obstacle, table)
        rule = hit_rule(spec.stages)
        report = verify_rows(problem, robot, columns, dtype=spec.dtype, rule=rule)
        plans = check_plans(problem, robot, columns)
    problems = [*plans.problems, *check_numbers(spec, task, columns, record)]
    problems += [
        f"{check.name}: {counted(check.n_failed, 'row')} out, worst {check.worst:.3g} {check.unit}"
        f" (allowed {check.tolerance:.3g}) in row {task.first_row + check.worst_row}"
        for check in report.failed
    ]
    ends = [columns[name] for name in _END_COLUMNS if name in columns]
    is_hit = {"hit_speed", "hit_speed_max"} <= columns.keys()
    fractions = speed_fractions(columns) if is_hit else np.empty(0)
    goals = row_keys(columns["goal_q"])[: len(fractions)]
    keys = row_keys(np.concatenate(ends, axis=1))
    return _ShardCheck(report, problems, keys, plans, fractions, goals)


def _check_speed_fractions(spec: DatasetSpec, checks: list[_ShardCheck]) -> list[str]:
    """Describe hits with equal fractions of their maximum speed, if there are more than random numbers explain."""
    if hit_rule(spec.stages).full_speed is None or not checks:
        return []
    fractions, goals = (
        np.concatenate([getattr(check, name) for check in checks])
        for name in ("fractions", "goals")
    )
    # Several starts may have the same goal.
    _, unique = np.unique(goals, return_index=True)
    count, fraction = repeated_fraction(fractions[unique], spec.dtype)
    text = f"{counted(count, 'hit')} with the same fraction of their maximum speed, {fraction:.6g}"
    return (
        [f"{text}; fractions are random, so these hits were scaled in time afterwards"]
        if count
        else []
    )


def row_keys(values: AnyArray) -> NDArray[np.uint64]:
    """Hash every row of numbers, shape (rows, width), to 64 bits.

    Equal rows have equal keys.
    """
    bits = np.ascontiguousarray(values, np.float64).view(np.uint64)
    # float32 values have zero low bits, which products would not mix
    bits = bits ^ (bits >> np.uint64(32))
    # Multiplication by an odd number is a bijection of 64 bits; each column has its
    # own.
    bits *= np.resize(_ODD_MULTIPLIERS, bits.shape[1])
    bits ^= bits >> np.uint64(29)
    return np.asarray(
        (bits * np.resize(_ODD_MULTIPLIERS[::-1], bits.shape[1])).sum(
            axis=1, dtype=np.uint64
        )
    )


def check_numbers(
    spec: DatasetSpec,
    task: ShardTask,
    columns: Mapping[str, AnyArray],
    record: ShardRecord,
) -> list[str]:
    """Describe the problems of all rows of a shard, shape (rows, width) or (rows,), by specification and record."""
    problems = [
        text
        for field in spec.fields
        for text in _check_range(field, columns[field.name], task, spec.dtype)
    ]
    problems += [
        text
        for field in spec.fields
        for text in _check_statistics(field, columns[field.name], record)
    ]
    if {"hit_speed", "hit_speed_max"} <= columns.keys():
        faster = np.flatnonzero(~(columns["hit_speed"] <= columns["hit_speed_max"]))
        if len(faster):
            problems.append(
                f"hit_speed is above hit_speed_max: {_rows_text(faster, task)}"
            )
    if not np.array_equal(columns["sample_id"], task.first_row + np.arange(task.rows)):
        problems.append("sample_id is not the index of the row in the split")
    if int(columns["attempts"].sum()) != record.sampling.tried:
        problems.append(
            f"attempts sum to {columns['attempts'].sum()}, but {record.sampling.tried} candidates are recorded"
        )
    return problems


def _check_range(
    field: Field, values: AnyArray, task: ShardTask, dtype: str
) -> Iterator[str]:
    for name, bound, sign in (
        ("valid_min", field.valid_min, 1.0),
        ("valid_max", field.valid_max, -1.0),
    ):
        if bound is not None:
            # min - x for lower bounds, x - max for upper ones.
            violation = sign * (np.array(bound) - values.reshape(len(values), -1))
            rows = np.flatnonzero(
                (violation > tolerance(np.array(bound), dtype)).any(axis=1)
            )
            if len(rows):
                unit = field.units[int(np.argmax(violation.max(axis=0)))]
                text = f"{field.name} is outside its {name} by up to {violation.max():.3g} {unit}"
                yield f"{text}: {_rows_text(rows, task)}"


def _check_statistics(
    field: Field, values: AnyArray, record: ShardRecord
) -> Iterator[str]:
    recorded = record.statistics.get(field.name)
    if np.isfinite(values).all() and not (
        recorded and _agree(recorded, field_statistics(values, field))
    ):
        yield f"the recorded statistics of {field.name} are not those of its values"


def tolerance(bound: Array, dtype: str) -> Array:
    """Return the accepted violation of a bound by a stored number: the tolerance of limits plus float32 rounding."""
    size = np.abs(bound)
    rounding = (
        np.spacing(size.astype(np.float32)).astype(float) if dtype == "float32" else 0.0
    )
    return BOUNDARY_TOLERANCES[dtype]["limit"] * np.maximum(size, 1.0) + rounding


def _rows_text(rows: Indices, task: ShardTask) -> str:
    return f"{len(rows)} of {task.rows} rows, the first one is row {task.first_row + int(rows[0])}"


def _agree(a: FieldStatistics, b: FieldStatistics) -> bool:
    """Return whether two statistics are of the same numbers: equal up to rounding errors of their sums."""
    exact = ("count", "minimum", "maximum", "low", "high", "histogram")
    if not all(np.array_equal(getattr(a, name), getattr(b, name)) for name in exact):
        return False
    # Sums of n numbers up to s in size round relative to n s, their squares relative to
    # n s^2.
    spread = np.maximum(np.abs(a.minimum), np.abs(a.maximum))
    mean = MAX_RELATIVE_SUM_ERROR * spread
    m2 = MAX_RELATIVE_SUM_ERROR * a.count * spread**2
    return bool(
        (np.abs(a.mean - b.mean) <= mean).all() and (np.abs(a.m2 - b.m2) <= m2).all()
    )
