"""Keys of rows: what the deep check finds rows that stand in a dataset twice by."""

import numpy as np
import pytest

from cnpgen.validate.validate_rows import row_keys


@pytest.mark.slow
@pytest.mark.parametrize("dtype", ["float64", "float32"])
def test_keys_of_a_million_different_rows_are_different(dtype):
    rows = np.random.default_rng(1).normal(size=(1_000_000, 6)).astype(dtype)
    assert len(np.unique(row_keys(rows))) == len(rows)


def test_equal_rows_have_equal_keys_and_the_last_bit_counts():
    rows = np.random.default_rng(2).normal(size=(100, 30))
    changed = rows.copy()
    changed[np.arange(100), np.arange(100) % 30] = np.nextafter(
        changed[np.arange(100), np.arange(100) % 30], np.inf
    )
    np.testing.assert_array_equal(row_keys(rows), row_keys(rows.copy()))
    assert (row_keys(rows) != row_keys(changed)).all()


def test_exchanged_columns_change_the_key():
    rows = np.random.default_rng(3).normal(size=(100, 8))
    assert (row_keys(rows) != row_keys(rows[:, ::-1])).all()
