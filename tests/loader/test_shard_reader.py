"""Reading shards: mapped where possible, read where not, checked once."""

import mmap
import pickle
from dataclasses import replace
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pytest

from cnpgen.errors import DatasetError
from cnpgen.loader import shard_reader
from cnpgen.loader.load import load_dataset
from cnpgen.loader.shard_reader import ShardReader
from cnpgen.store.checked_shard import Shard
from tests.examples.loader import columns, make
from tests.examples.store import FIELDS
from tests.refusals import is_refused


@pytest.fixture
def shard(tmp_path: Path) -> Shard:
    return load_dataset(make(tmp_path / "set")).shards["train"][0]


ROWS = {name: values[:32] for name, values in columns().items()}


def rewritten(shard: Shard, **options: Any) -> Shard:
    """Write a shard's fields anew, as another program might, with other layout or types."""
    with h5py.File(shard.path) as file:
        attributes, content = dict(file.attrs), {name: file[name][()] for name in file}
    with h5py.File(shard.path, "w") as file:
        file.attrs.update(attributes)
        for name, values in content.items():
            dtype = (
                values.dtype.newbyteorder(">")
                if options.get("swapped")
                else values.dtype
            )
            extra = (
                {"chunks": True, "compression": "gzip"}
                if options.get("compressed")
                else {}
            )
            file.create_dataset(name, data=values.astype(dtype), **extra)
    return replace(shard, size=shard.path.stat().st_size)


def test_fields_are_mapped_into_memory_and_cannot_be_written_to(shard: Shard) -> None:
    reader = ShardReader(verify=True)
    assert all(
        values.flags.owndata for values in reader.map(shard, FIELDS).values()
    )  # read, to check all values
    found = reader.map(shard, FIELDS)
    for name, values in ROWS.items():
        assert np.array_equal(found[name], values)
        assert isinstance(found[name].base, mmap.mmap)
        assert not found[name].flags.writeable


@pytest.mark.parametrize(
    "options",
    [{"swapped": True}, {"compressed": True}, {"compressed": True, "swapped": True}],
)
def test_fields_that_cannot_be_mapped_are_read(
    shard: Shard, options: dict[str, bool]
) -> None:
    reader, shard = ShardReader(verify=False), rewritten(shard, **options)
    reader.map(shard, FIELDS)
    found = reader.map(shard, FIELDS)
    for name, values in ROWS.items():
        assert not isinstance(found[name].base, mmap.mmap)
        assert np.array_equal(found[name], values)


def test_a_file_system_without_memory_maps_is_read(
    shard: Shard, monkeypatch: pytest.MonkeyPatch
) -> None:
    def refuse(*_arguments: Any, **_options: Any) -> None:
        raise OSError(19, "No such device")

    monkeypatch.setattr(shard_reader.mmap, "mmap", refuse)
    reader = ShardReader(verify=True)
    reader.map(shard, FIELDS)
    found = reader.map(shard, FIELDS)
    assert all(np.array_equal(found[name], values) for name, values in ROWS.items())


def test_batches_of_shards_that_cannot_be_mapped_are_the_same(tmp_path: Path) -> None:
    dataset = load_dataset(make(tmp_path / "set"), verify=False)
    expected = [batch.table for batch in dataset.batches(10)]
    changed = {
        split: tuple(rewritten(s, compressed=True, swapped=True) for s in part)
        for split, part in dataset.shards.items()
    }
    found = [
        batch.table
        for batch in replace(
            dataset, shards=changed, reader=ShardReader(verify=False)
        ).batches(10)
    ]
    assert np.array_equal(found, expected)


def test_the_oldest_memory_maps_are_dropped_above_the_maximum(tmp_path: Path) -> None:
    dataset, most = (
        load_dataset(make(tmp_path / "set", splits={"train": 40}, shard_size=1)),
        shard_reader.MAX_MEMORY_MAPS,
    )
    shards = dataset.shards["train"]
    assert len(shards) > most
    for count, shard in enumerate(shards, 1):
        dataset.reader.map(shard, FIELDS)
        dataset.reader.map(shard, FIELDS)
        assert len(dataset.reader._maps) == min(count, most)
    assert list(dataset.reader._maps) == [shard.path for shard in shards[-most:]]


def test_a_shard_is_checked_once(shard: Shard, monkeypatch: pytest.MonkeyPatch) -> None:
    counted = []
    original = shard_reader.file_sha256
    monkeypatch.setattr(
        shard_reader, "file_sha256", lambda path: counted.append(path) or original(path)
    )
    reader = ShardReader(verify=True)
    for _ in range(3):
        reader.read(shard, FIELDS)
    pickle.loads(pickle.dumps(reader)).read(shard, FIELDS)
    assert counted == [shard.path]
    ShardReader(verify=False).read(shard, FIELDS)
    assert counted == [shard.path]


def test_a_shard_that_is_cut_off_after_its_check_raises_an_error(shard: Shard) -> None:
    reader = ShardReader(verify=True)
    reader.read(shard, FIELDS)
    shard.path.write_bytes(shard.path.read_bytes()[:100])
    with is_refused(DatasetError):
        reader.read(shard, FIELDS)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (
            {"width": 4},
            r"field 'start_q' is float64 of shape \(32, 3\), expected float64 of shape \(32, 4\) by specification.json",
        ),
        ({"dtype": "int64"}, r"is float64 of shape \(32, 3\), expected int64"),
        ({"name": "end_q"}, "field 'end_q' is missing"),
    ],
)
def test_a_shard_that_contradicts_the_specification_is_refused(
    shard: Shard, change: dict[str, Any], message: str
) -> None:
    with pytest.raises(DatasetError, match=message):
        ShardReader(verify=True).read(shard, [replace(FIELDS[0], **change)])
