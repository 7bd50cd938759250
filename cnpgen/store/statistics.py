"""Statistics of a field: count, mean, variance, extrema and histogram, which can be merged exactly over shards."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from cnpgen.arrays import AnyArray, Integers, Mask
from cnpgen.documents import JsonMapping, JsonObject
from cnpgen.errors import DatasetError
from cnpgen.store.field import Field
from cnpgen.store.files.document_structure import NUMBER, WHOLE, check_structure

Floats = NDArray[np.float64]
N_BINS = 64


@dataclass(frozen=True, kw_only=True, eq=False)
class FieldStatistics:
    """Statistics of the c columns of one field, in the field's unit; c is 1 for a scalar field.

    Counts, extrema and histograms do not depend on the shard size; mean and m2 depend
    on it by rounding errors only.

    Attributes:
        count: Number of rows.
        mean: Mean, shape (c,).
        m2: Sum of squared deviations from the mean, shape (c,).
        minimum: Smallest value, shape (c,).
        maximum: Largest value, shape (c,).
        low: Lower bounds of the histograms, the ``valid_min`` of the field, shape (c,);
            None without histograms.
        high: Upper bounds of the histograms, the ``valid_max`` of the field, shape
            (c,).
        histogram: Rows per bin, 64 equal bins from ``low`` to ``high``, shape (c, 64).
            Values outside, by rounding errors, are counted in the first or last bin.
    """

    count: int
    mean: Floats
    m2: Floats
    minimum: Floats
    maximum: Floats
    low: Floats | None = None
    high: Floats | None = None
    histogram: Integers | None = None

    @property
    def constant(self) -> Mask:
        """Mask of the columns with one value in all rows, shape (c,).

        Their standard deviation is 0.
        """
        return np.equal(self.minimum, self.maximum)

    @property
    def std(self) -> Floats:
        """Standard deviation sqrt(m2 / count), exactly 0 for constant columns, shape (c,)."""
        return np.where(self.constant, 0.0, np.sqrt(self.m2 / self.count))

    def merge(self, other: FieldStatistics) -> FieldStatistics:
        """Return the statistics of the union of both sets of rows (Chan, Golub and LeVeque 1979).

        Raises:
            DatasetError: The columns or the ranges of the histograms differ.
        """
        ranges = (
            np.array_equal(getattr(self, name), getattr(other, name))
            for name in ("low", "high")
        )
        if self.mean.shape != other.mean.shape or not all(ranges):
            raise DatasetError("statistics of different fields cannot be merged")
        count = self.count + other.count
        # With d = mean2 - mean1: mean = mean1 + d n2 / n, m2 = m2_1 + m2_2 + d^2 n1 n2
        # / n. No large squares are subtracted.
        delta = other.mean - self.mean
        return FieldStatistics(
            count=count,
            mean=self.mean + delta * (other.count / count),
            m2=self.m2 + other.m2 + delta**2 * (self.count * other.count / count),
            minimum=np.minimum(self.minimum, other.minimum),
            maximum=np.maximum(self.maximum, other.maximum),
            low=self.low,
            high=self.high,
            histogram=None
            if self.histogram is None or other.histogram is None
            else self.histogram + other.histogram,
        )

    def to_json(self) -> JsonObject:
        """Return a JSON-able dict, which also contains the derived ``std`` and ``constant``."""
        content: JsonObject = {"count": self.count}
        for name in ("mean", "std", "m2", "minimum", "maximum", "constant"):
            content[{"minimum": "min", "maximum": "max"}.get(name, name)] = getattr(
                self, name
            ).tolist()
        if (
            self.histogram is not None
            and self.low is not None
            and self.high is not None
        ):
            counts = self.histogram.tolist()
            content["histogram"] = {
                "low": self.low.tolist(),
                "high": self.high.tolist(),
                "counts": counts,
            }
        return content


STATISTICS_STRUCTURE = {
    "count": WHOLE,
    "mean": [NUMBER],
    "m2": [NUMBER],
    "min": [NUMBER],
    "max": [NUMBER],
}
_HISTOGRAM_STRUCTURE = {"low": [NUMBER], "high": [NUMBER], "counts": [[WHOLE]]}


def statistics_from_json(content: JsonMapping) -> FieldStatistics:
    """Rebuild statistics from ``STATISTICS_STRUCTURE``.

    Inconsistent shapes or counts raise ValueError.
    """
    keys = {"mean": "mean", "m2": "m2", "minimum": "min", "maximum": "max"}
    arrays = {name: np.array(content[key], np.float64) for name, key in keys.items()}
    counts = None
    if (histogram := content.get("histogram")) is not None:
        check_structure(histogram, _HISTOGRAM_STRUCTURE)
        arrays |= {
            name: np.array(histogram[name], np.float64) for name in ("low", "high")
        }
        counts = np.array(histogram["counts"], np.int64)
    statistics = FieldStatistics(
        count=int(content["count"]), histogram=counts, **arrays
    )
    columns = len(statistics.mean)
    if statistics.count < 1 or any(
        array.shape != (columns,) for array in arrays.values()
    ):
        raise ValueError(
            f"statistics must be of at least 1 row, and all of {columns} columns"
        )
    if counts is not None and counts.shape != (columns, N_BINS):
        raise ValueError(
            f"a histogram must have shape {(columns, N_BINS)}, got {counts.shape}"
        )
    return statistics


def are_of(statistics: Mapping[str, FieldStatistics], fields: Sequence[Field]) -> bool:
    """Return whether statistics are of these fields and have their numbers of columns."""
    columns = {name: len(item.mean) for name, item in statistics.items()}
    return columns == {field.name: max(field.width, 1) for field in fields}


def field_statistics(values: AnyArray, field: Field) -> FieldStatistics:
    """Compute the statistics of the columns of one field from at least one row, shape (rows, width) or (rows,).

    Histograms need two finite limits.
    """
    # Sums over long contiguous rows are fast.
    columns = np.ascontiguousarray(
        np.asarray(values, np.float64).reshape(len(values), -1).T
    )
    mean = columns.mean(axis=1)
    low, high = _limits(field, len(columns))
    return FieldStatistics(
        count=columns.shape[1],
        mean=mean,
        m2=np.square(columns - mean[:, None]).sum(axis=1),
        minimum=columns.min(axis=1),
        maximum=columns.max(axis=1),
        low=low,
        high=high,
        histogram=None
        if low is None or high is None
        else _histogram(columns, low, high),
    )


def _limits(field: Field, columns: int) -> tuple[Floats, Floats] | tuple[None, None]:
    """Return the limits of every column, shape (c,) each, or (None, None) if a limit is missing or infinite."""
    if field.valid_min is None or field.valid_max is None:
        return None, None
    low = np.array(field.valid_min, np.float64)
    high = np.array(field.valid_max, np.float64)
    if low.shape != (columns,) or high.shape != (columns,):
        raise DatasetError(
            f"field {field.name!r} must have {columns} limits, got {low.shape} and {high.shape}"
        )
    return (
        (low, high)
        if np.isfinite(low).all() and np.isfinite(high).all()
        else (None, None)
    )


def _histogram(columns: Floats, low: Floats, high: Floats) -> Integers:
    """Count the rows of every column, shape (c, rows), in its bins, shape (c, 64)."""
    # A column with equal limits has all rows in one bin.
    width = np.where(high > low, high - low, 1.0)
    positions = (columns - low[:, None]) / width[:, None] * N_BINS
    # Rounds down, since no position is negative.
    # Values at or outside the limits count in the outer bins.
    bins = np.clip(positions, 0, N_BINS - 1).astype(np.int64)
    return np.array([np.bincount(row, minlength=N_BINS) for row in bins])


def column_statistics(
    columns: Mapping[str, AnyArray], fields: Sequence[Field]
) -> dict[str, FieldStatistics]:
    """Compute the statistics of every field, in the order of the fields."""
    return {
        field.name: field_statistics(columns[field.name], field) for field in fields
    }


def merge_statistics(
    parts: Sequence[Mapping[str, FieldStatistics]],
) -> dict[str, FieldStatistics]:
    """Merge the statistics of shards, in order.

    None, and those of different fields, raise DatasetError.
    """
    if not parts:
        raise DatasetError("there are no statistics to merge")
    merged = dict(parts[0])
    for part in parts[1:]:
        if part.keys() != merged.keys():
            raise DatasetError(
                f"statistics of different fields cannot be merged: {list(merged)} and {list(part)}"
            )
        merged = {name: merged[name].merge(part[name]) for name in merged}
    return merged
