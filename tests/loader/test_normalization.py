"""Normalization with stored statistics."""

from pathlib import Path

import numpy as np
import pytest

from cnpgen.errors import DatasetError
from cnpgen.loader.load import load_dataset
from cnpgen.loader.row_format import Normalization, make_normalization
from cnpgen.store.field import Field
from cnpgen.store.statistics import column_statistics
from tests.examples.loader import columns, make
from tests.examples.store import FIELDS
from tests.refusals import is_refused


@pytest.fixture(scope="module")
def normalization(tmp_path_factory: pytest.TempPathFactory) -> Normalization:
    found = load_dataset(make(tmp_path_factory.mktemp("loader") / "set")).normalization
    assert found is not None
    return found


def test_means_and_deviations_are_those_of_the_training_rows(
    normalization: Normalization,
) -> None:
    rows = columns()
    for name in ("start_q", "goal_p", "clearance"):
        values = rows[name].reshape(50, -1)
        assert np.allclose(normalization.mean[name], values.mean(0), rtol=0, atol=1e-14)
        assert np.allclose(normalization.std[name], values.std(0), rtol=0, atol=1e-14)
    assert "sample_id" not in normalization.mean


def test_a_constant_column_is_normalized_to_zero_and_back(
    normalization: Normalization,
) -> None:
    found = normalization.normalize(columns())
    assert (found["goal_p"][:, 1] == 0).all()
    assert np.allclose(
        normalization.denormalize(found)["goal_p"][:, 1], 0.1, rtol=0, atol=1e-15
    )


def test_denormalize_is_the_inverse_of_normalize(normalization: Normalization) -> None:
    rows = columns()
    found = normalization.denormalize(normalization.normalize(rows))
    for name, values in rows.items():
        assert found[name].shape == values.shape
        assert found[name].dtype == values.dtype
        assert np.allclose(found[name], values, rtol=0, atol=1e-14)


@pytest.mark.parametrize("shape", [(), (4,), (2, 5)])
def test_leading_dimensions_are_arbitrary(
    normalization: Normalization, shape: tuple[int, ...]
) -> None:
    rows = {"start_q": np.ones((*shape, 3)), "clearance": np.ones(shape)}
    found = normalization.normalize(rows)
    assert found["start_q"].shape == (*shape, 3)
    assert found["clearance"].shape == shape
    assert np.allclose(
        found["clearance"],
        (1 - normalization.mean["clearance"]) / normalization.std["clearance"],
    )


def test_a_column_with_a_deviation_below_float32_resolution_counts_as_constant() -> (
    None
):
    random = np.random.default_rng(0)
    fields = (Field("height", "m", "of the tip", 3),)
    values = 0.16 + random.standard_normal((1000, 3)) * np.array([1e-9, 1e-6, 0.0])
    found = make_normalization(column_statistics({"height": values}, fields), fields)
    assert found.std["height"][0] == 0
    assert found.std["height"][1] == pytest.approx(1e-6, rel=0.1)
    assert found.std["height"][2] == 0
    assert np.ptp(found.normalize({"height": values})["height"][:, 0]) == 0


def test_columns_lie_side_by_side_in_the_order_of_the_fields(
    normalization: Normalization,
) -> None:
    by_name = {field.name: field for field in FIELDS}
    mean, scale = normalization.side_by_side([by_name["clearance"], by_name["goal_p"]])
    assert mean.tolist() == [
        *normalization.mean["clearance"],
        *normalization.mean["goal_p"],
    ]
    assert scale.tolist() == pytest.approx(
        [1 / normalization.std["clearance"][0], 1 / normalization.std["goal_p"][0], 0]
    )
    assert normalization.side_by_side([])[0].shape == (0,)


def test_a_field_without_statistics_cannot_be_normalized(
    tmp_path: Path, normalization: Normalization
) -> None:
    dataset = load_dataset(make(tmp_path / "set"))
    lacking = Normalization(
        {"start_q": normalization.mean["start_q"]},
        {"start_q": normalization.std["start_q"]},
    )
    with is_refused(DatasetError):
        dataset.batches(8, normalize=lacking)
