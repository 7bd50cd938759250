"""The bridge to TensorFlow, against TensorFlow itself; in the extended run only."""

import warnings
from pathlib import Path

import numpy as np
import pytest

from tests.examples.loader import ALL, ids, make

with warnings.catch_warnings():
    warnings.simplefilter("ignore")  # warnings of its imports
    tensorflow = pytest.importorskip("tensorflow")

from cnpgen.interop.tensorflow import to_tensorflow
from cnpgen.loader.dataset import Dataset
from cnpgen.loader.load import load_dataset

pytestmark = [
    pytest.mark.extended,
    pytest.mark.filterwarnings("ignore::DeprecationWarning:tensorflow.*"),
]


@pytest.fixture(scope="module")
def dataset(tmp_path_factory: pytest.TempPathFactory) -> Dataset:
    return load_dataset(make(tmp_path_factory.mktemp("loader") / "set", shard_size=8))


def test_tensors_have_the_values_of_the_batches(dataset: Dataset) -> None:
    expected = list(dataset.batches(8, fields=ALL, drop_last=False))
    found = list(to_tensorflow(dataset.batches(8, fields=ALL, drop_last=False)))
    for tensors, batch in zip(found, expected, strict=True):
        assert tensors.keys() == set(ALL)
        for name, values in batch.items():
            assert tensors[name].dtype == values.dtype
            assert np.array_equal(tensors[name].numpy(), values)


def test_the_signature_is_known_before_the_first_batch(dataset: Dataset) -> None:
    specification = to_tensorflow(
        dataset.batches(8, fields=ALL, dtype="float64")
    ).element_spec
    assert specification["start_q"].shape.as_list() == [None, 3]
    assert specification["clearance"].shape.as_list() == [None]
    assert specification["start_q"].dtype == tensorflow.float64
    assert specification["sample_id"].dtype == tensorflow.int64


def test_every_pass_is_the_next_epoch_and_prefetching_changes_nothing(
    dataset: Dataset,
) -> None:
    wanted = to_tensorflow(dataset.batches(10, fields=ALL)).prefetch(3)
    for epoch in range(3):
        found = [batch["sample_id"].numpy().tolist() for batch in wanted]
        assert found == ids(dataset.batches(10, fields=ALL, epoch=epoch))


def test_keras_trains_on_it(dataset: Dataset, tmp_path: Path) -> None:
    model = tensorflow.keras.Sequential(
        [tensorflow.keras.Input((3,)), tensorflow.keras.layers.Dense(2)]
    )
    model.compile(loss="mse", optimizer="adam")
    batches = to_tensorflow(dataset.batches(10)).map(
        lambda batch: (batch["start_q"], batch["goal_p"])
    )
    history = model.fit(
        batches.repeat(), epochs=2, steps_per_epoch=5, shuffle=False, verbose=0
    ).history
    assert np.isfinite(history["loss"]).all()
