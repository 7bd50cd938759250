"""What the numbers of a shard must be by themselves, without any robot: in range, in order, summed up as recorded."""

from collections.abc import Iterator, Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from cnpgen.problems.constraints.constraint import EXACTNESS
from cnpgen.store.blueprint import Blueprint, ShardTask
from cnpgen.store.field import Field
from cnpgen.store.record import ShardRecord
from cnpgen.store.statistics import FieldStatistics, field_statistics

Columns = Mapping[str, NDArray[Any]]

SUMMATION = 1e-9  # relative: what sums of the same numbers may differ by from one NumPy to another


def check_numbers(blueprint: Blueprint, task: ShardTask, columns: Columns, record: ShardRecord) -> list[str]:
    """Check the rows of a shard against its blueprint and its record.

    Args:
        blueprint: The blueprint of the dataset.
        task: The shard.
        columns: All its fields, shape (rows, width) or (rows,).
        record: What is recorded of it.

    Returns:
        What is wrong.
    """
    problems = [
        text for field in blueprint.fields for text in _check_range(field, columns[field.name], task, blueprint.dtype)
    ]
    problems += [text for field in blueprint.fields for text in _check_statistics(field, columns[field.name], record)]
    if {"hit_speed", "hit_speed_max"} <= columns.keys():
        faster = np.flatnonzero(~(columns["hit_speed"] <= columns["hit_speed_max"]))
        if len(faster):
            problems.append(f"hit_speed is above hit_speed_max: {_rows(faster, task)}")
    if not np.array_equal(columns["sample_id"], task.first_row + np.arange(task.rows)):
        problems.append("sample_id does not count the rows of the split")
    if int(columns["attempts"].sum()) != record.fates.tried:
        problems.append(f"attempts sum to {columns['attempts'].sum()}, but {record.fates.tried} draws are recorded")
    return problems


def _check_range(field: Field, values: NDArray[Any], task: ShardTask, dtype: str) -> Iterator[str]:
    for name, bound, sign in (("valid_min", field.valid_min, 1.0), ("valid_max", field.valid_max, -1.0)):
        if bound is not None:
            beyond = sign * (np.array(bound) - values.reshape(len(values), -1))
            out = np.flatnonzero((beyond > slack(np.array(bound), dtype)).any(axis=1))
            if len(out):
                unit = field.units[int(np.argmax(beyond.max(axis=0)))]
                text = f"{field.name} is beyond its {name} by up to {beyond.max():.3g} {unit}"
                yield f"{text}: {_rows(out, task)}"


def _check_statistics(field: Field, values: NDArray[Any], record: ShardRecord) -> Iterator[str]:
    found = record.statistics.get(field.name)
    if np.isfinite(values).all() and not (found and _agree(found, field_statistics(values, field))):
        yield f"the recorded statistics of {field.name} are not those of its values"


def slack(bound: NDArray[np.float64], dtype: str) -> NDArray[np.float64]:
    """How far a stored number may be beyond a bound: what limits are held to, and half a digit of float32."""
    size = np.abs(bound)
    digit = np.spacing(size.astype(np.float32)).astype(float) if dtype == "float32" else 0.0
    return EXACTNESS[dtype]["limit"] * np.maximum(size, 1.0) + digit


def _rows(rows: NDArray[np.intp], task: ShardTask) -> str:
    return f"{len(rows)} of {task.rows} rows, the first one is row {task.first_row + int(rows[0])}"


def _agree(a: FieldStatistics, b: FieldStatistics) -> bool:
    """Whether two statistics are of the same numbers: all that is no sum must be the same to the bit."""
    exact = ("count", "minimum", "maximum", "low", "high", "histogram")
    if not all(np.array_equal(getattr(a, name), getattr(b, name)) for name in exact):
        return False
    spread = np.maximum(np.abs(a.minimum), np.abs(a.maximum))
    mean, m2 = SUMMATION * spread, SUMMATION * a.count * spread**2
    return bool((np.abs(a.mean - b.mean) <= mean).all() and (np.abs(a.m2 - b.m2) <= m2).all())
