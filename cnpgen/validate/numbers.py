"""Checks of the values of a shard without a robot model: ranges, order, and recorded statistics."""

from collections.abc import Iterator, Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from cnpgen.problems.constraints.constraint import BOUNDARY_TOLERANCES
from cnpgen.store.dataset_spec import DatasetSpec, ShardTask
from cnpgen.store.field import Field
from cnpgen.store.shard_record import ShardRecord
from cnpgen.store.statistics import FieldStatistics, field_statistics

Columns = Mapping[str, NDArray[Any]]

MAX_RELATIVE_SUM_ERROR = 1e-9  # accepted relative difference of sums of the same numbers between versions of NumPy


def check_numbers(spec: DatasetSpec, task: ShardTask, columns: Columns, record: ShardRecord) -> list[str]:
    """Describe the problems of all rows of a shard, shape (rows, width) or (rows,), by specification and record."""
    problems = [text for field in spec.fields for text in _check_range(field, columns[field.name], task, spec.dtype)]
    problems += [text for field in spec.fields for text in _check_statistics(field, columns[field.name], record)]
    if {"hit_speed", "hit_speed_max"} <= columns.keys():
        faster = np.flatnonzero(~(columns["hit_speed"] <= columns["hit_speed_max"]))
        if len(faster):
            problems.append(f"hit_speed is above hit_speed_max: {_rows_text(faster, task)}")
    if not np.array_equal(columns["sample_id"], task.first_row + np.arange(task.rows)):
        problems.append("sample_id is not the index of the row in the split")
    if int(columns["attempts"].sum()) != record.sampling.tried:
        problems.append(
            f"attempts sum to {columns['attempts'].sum()}, but {record.sampling.tried} candidates are recorded"
        )
    return problems


def _check_range(field: Field, values: NDArray[Any], task: ShardTask, dtype: str) -> Iterator[str]:
    for name, bound, sign in (("valid_min", field.valid_min, 1.0), ("valid_max", field.valid_max, -1.0)):
        if bound is not None:
            violation = sign * (np.array(bound) - values.reshape(len(values), -1))
            rows = np.flatnonzero((violation > tolerance(np.array(bound), dtype)).any(axis=1))
            if len(rows):
                unit = field.units[int(np.argmax(violation.max(axis=0)))]
                text = f"{field.name} is outside its {name} by up to {violation.max():.3g} {unit}"
                yield f"{text}: {_rows_text(rows, task)}"


def _check_statistics(field: Field, values: NDArray[Any], record: ShardRecord) -> Iterator[str]:
    recorded = record.statistics.get(field.name)
    if np.isfinite(values).all() and not (recorded and _agree(recorded, field_statistics(values, field))):
        yield f"the recorded statistics of {field.name} are not those of its values"


def tolerance(bound: NDArray[np.float64], dtype: str) -> NDArray[np.float64]:
    """Return the accepted violation of a bound by a stored number: the tolerance of limits plus float32 rounding."""
    size = np.abs(bound)
    rounding = np.spacing(size.astype(np.float32)).astype(float) if dtype == "float32" else 0.0
    return BOUNDARY_TOLERANCES[dtype]["limit"] * np.maximum(size, 1.0) + rounding


def _rows_text(rows: NDArray[np.intp], task: ShardTask) -> str:
    return f"{len(rows)} of {task.rows} rows, the first one is row {task.first_row + int(rows[0])}"


def _agree(a: FieldStatistics, b: FieldStatistics) -> bool:
    """Return whether two statistics are of the same numbers: equal up to rounding errors of their sums."""
    exact = ("count", "minimum", "maximum", "low", "high", "histogram")
    if not all(np.array_equal(getattr(a, name), getattr(b, name)) for name in exact):
        return False
    spread = np.maximum(np.abs(a.minimum), np.abs(a.maximum))
    mean, m2 = MAX_RELATIVE_SUM_ERROR * spread, MAX_RELATIVE_SUM_ERROR * a.count * spread**2
    return bool((np.abs(a.mean - b.mean) <= mean).all() and (np.abs(a.m2 - b.m2) <= m2).all())
