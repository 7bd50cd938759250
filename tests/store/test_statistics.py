"""Statistics: merged statistics of parts equal those of all rows."""

import json
from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from cnpgen.errors import DatasetError
from cnpgen.store.dataset_spec import shards
from cnpgen.store.field import Field
from cnpgen.store.statistics import (
    FieldStatistics,
    column_statistics,
    field_statistics,
    merge_statistics,
    statistics_from_json,
)
from tests.examples.store import FIELDS, SPEC, make_columns
from tests.refusals import is_refused

FIELD = Field(
    "q",
    "rad",
    "positions",
    4,
    valid_min=(-3.0, 0.0, 5.0, -1.0),
    valid_max=(3.0, 1.0, 5.0, 1.0),
)


def values(rows: int) -> NDArray[np.float64]:
    """Return columns that are uniform, far from zero, constant, and heavy-tailed outside their limits."""
    random = np.random.default_rng(rows)
    columns = [
        random.uniform(-3, 3, rows),
        10 + random.random(rows),
        np.full(rows, 0.1),
        random.standard_cauchy(rows),
    ]
    return np.stack(columns, axis=1)


def assert_same(found: FieldStatistics, expected: FieldStatistics) -> None:
    assert found.count == expected.count
    assert np.array_equal(found.minimum, expected.minimum)
    assert np.array_equal(found.maximum, expected.maximum)
    assert found.histogram is not None
    assert np.array_equal(found.histogram, expected.histogram)
    np.testing.assert_allclose(found.mean, expected.mean, rtol=1e-12, atol=1e-15)
    np.testing.assert_allclose(found.m2, expected.m2, rtol=1e-12, atol=1e-20)


@pytest.mark.parametrize(
    "cuts", [[], [1], [999], [1, 2, 3], [500], [100, 101, 640], list(range(7, 1000, 7))]
)
def test_merged_statistics_are_those_of_the_concatenation(cuts: Sequence[int]) -> None:
    table = values(1000)
    parts = [field_statistics(part, FIELD) for part in np.split(table, cuts)]
    merged = merge_statistics([{"q": part} for part in parts])["q"]
    assert_same(merged, field_statistics(table, FIELD))


def test_the_deviation_of_a_narrow_column_far_from_zero_is_accurate() -> None:
    table = 1e6 + np.random.default_rng(0).random((1000, 1))
    field = Field("q", "1", "far", 1)
    parts = [{"q": field_statistics(part, field)} for part in np.split(table, 10)]
    np.testing.assert_allclose(
        merge_statistics(parts)["q"].std, table.std(axis=0), rtol=1e-9
    )


def test_mean_deviation_and_histogram_equal_those_of_numpy() -> None:
    table = values(500)
    found = field_statistics(table, FIELD)
    np.testing.assert_allclose(found.mean, table.mean(axis=0), rtol=1e-13)
    np.testing.assert_allclose(
        found.std[[0, 1, 3]], table.std(axis=0)[[0, 1, 3]], rtol=1e-13
    )
    assert found.histogram is not None
    assert np.array_equal(
        found.histogram[0], np.histogram(table[:, 0], bins=64, range=(-3, 3))[0]
    )


def test_histograms_count_values_outside_the_limits_in_the_first_or_last_bin() -> None:
    table = np.array([[-9.0, 0.0, 5.0, -1.0], [9.0, 1.0, 5.1, 1.0]])
    histogram = field_statistics(table, FIELD).histogram
    assert histogram is not None
    assert histogram.sum(axis=1).tolist() == [2, 2, 2, 2]
    assert histogram[:, 0].tolist() == [1, 1, 1, 1]
    assert histogram[:2, 63].tolist() == [1, 1]


def test_constant_columns_are_flagged_and_have_no_deviation() -> None:
    found = field_statistics(values(999), FIELD)
    assert found.constant.tolist() == [False, False, True, False]
    assert found.std[2] == 0.0
    one = field_statistics(values(1), FIELD)
    assert one.constant.all()
    assert not one.std.any()


@pytest.mark.parametrize(
    "field",
    [
        replace(FIELD, valid_min=None),
        replace(FIELD, valid_max=None),
        replace(FIELD, valid_max=(3.0, 1.0, np.inf, 1.0)),
    ],
)
def test_fields_without_finite_limits_have_no_histogram(field: Field) -> None:
    found = field_statistics(values(10), field)
    assert found.histogram is None
    assert "histogram" not in found.to_json()
    assert found.merge(found).count == 20


def test_limits_of_another_width_are_refused() -> None:
    with is_refused(DatasetError):
        field_statistics(values(10), replace(FIELD, valid_min=(0.0,)))


def test_statistics_survive_json_exactly() -> None:
    found = column_statistics(make_columns(shards(SPEC)[0]), FIELDS)
    assert list(found) == [field.name for field in FIELDS]
    for item in found.values():
        content: dict[str, Any] = item.to_json()
        assert (
            statistics_from_json(json.loads(json.dumps(content))).to_json() == content
        )


def test_statistics_of_single_precision_are_computed_in_double() -> None:
    table = np.full((100_000, 4), 0.1, np.float32)
    np.testing.assert_allclose(
        field_statistics(table, FIELD).mean, float(np.float32(0.1)), rtol=1e-14
    )


def test_statistics_of_different_fields_are_not_merged() -> None:
    a = field_statistics(values(10), FIELD)
    others = [
        field_statistics(values(10)[:, :1], Field("q", "rad", "one column", 1)),
        field_statistics(values(10), replace(FIELD, valid_min=None)),
        field_statistics(values(10), replace(FIELD, valid_min=(-4.0,) * 4)),
    ]
    for other in others:
        with is_refused(DatasetError):
            a.merge(other)
    with is_refused(DatasetError):
        merge_statistics([{"q": a}, {"p": a}])
    with is_refused(DatasetError):
        merge_statistics([])
