"""Archives of arrays and entries of the cache: every damage is one error, and a damaged entry is computed again."""

import errno
import io
import zipfile
from pathlib import Path
from random import Random

import numpy as np
import pytest

from cnpgen.robots.shape.decomposition import convex_parts
from cnpgen.store.files import cache_entry
from cnpgen.store.files.archives import ArchiveError, read_arrays
from cnpgen.store.files.cache_entry import read_entry, write_entry
from tests.conftest import some
from tests.refusals import is_refused


def archive(*, compressed: bool = False, **arrays: np.ndarray) -> bytes:
    buffer = io.BytesIO()
    (np.savez_compressed if compressed else np.savez)(buffer, **arrays)
    return buffer.getvalue()


@pytest.mark.parametrize("compressed", [False, True])
def test_arrays_are_those_that_numpy_wrote(tmp_path: Path, compressed: bool) -> None:
    arrays = {
        "q": np.random.default_rng(0).normal(size=(5, 3)),
        "names": np.array(["a", "bc"]),
        "one": np.array(4.0),
        "none": np.zeros((0, 2), np.float32),
        "columns": np.asfortranarray(np.arange(6.0).reshape(2, 3)),
    }
    content = archive(compressed=compressed, **arrays)
    (tmp_path / "a.npz").write_bytes(content)
    for source in (content, tmp_path / "a.npz"):
        found = read_arrays(source, max_bytes=1000_000)
        assert found.keys() == arrays.keys()
        for name, values in arrays.items():
            np.testing.assert_array_equal(found[name], values)
            assert found[name].dtype == values.dtype


@pytest.mark.parametrize("seed", some(range(12), kept=3))
def test_a_damaged_archive_gives_one_error_or_the_arrays(seed: int) -> None:
    random = Random(seed)
    for compressed in (False, True):
        good = archive(compressed=compressed, q=np.arange(40.0), t=np.arange(9))
        for _ in range(300):
            damaged = bytearray(good)
            for _ in range(random.randint(1, 4)):
                damaged[random.randrange(len(damaged))] = random.randrange(256)
            if random.random() < 0.2:
                del damaged[random.randrange(len(damaged)) :]
            message = ""
            try:
                read_arrays(bytes(damaged), max_bytes=1 << 20)
            except ArchiveError as error:
                message = str(error)
            assert "\0" not in message


def test_sizes_are_compared_before_the_arrays_are_read() -> None:
    bomb = archive(compressed=True, q=np.zeros(30_000_000))
    assert len(bomb) < 1 << 19
    with is_refused(ArchiveError):
        read_arrays(bomb, max_bytes=1 << 20)
    with is_refused(ArchiveError):
        read_arrays(bomb, max_bytes=1 << 30, stored=True)
    buffer, header = io.BytesIO(), io.BytesIO()
    np.lib.format.write_array_header_1_0(
        header, {"descr": "<f8", "fortran_order": False, "shape": (10**12,)}
    )
    with zipfile.ZipFile(buffer, "w") as file:
        file.writestr("q.npy", header.getvalue() + bytes(80))
    with is_refused(ArchiveError):
        read_arrays(buffer.getvalue(), max_bytes=1 << 20)


@pytest.mark.parametrize(
    "content", [b"", b"PK\x03\x04", b"\x93NUMPY\x01\x00", b"no archive", bytes(900)]
)
def test_foreign_content_is_refused(content: bytes) -> None:
    with pytest.raises(ArchiveError):
        read_arrays(content, max_bytes=1000)


def test_objects_are_refused() -> None:
    buffer = io.BytesIO()
    np.savez(buffer, q=np.array([{}], object))
    with is_refused(ArchiveError):
        read_arrays(buffer.getvalue(), max_bytes=1000_000)


def test_every_flipped_bit_of_a_cache_entry_is_noticed(tmp_path: Path) -> None:
    path = tmp_path / "entry"
    write_entry(path, b"some content")
    assert read_entry(path) == b"some content"
    good = path.read_bytes()
    for position in range(len(good)):
        damaged = bytearray(good)
        damaged[position] ^= 1
        path.write_bytes(damaged)
        assert read_entry(path) is None
    path.unlink()
    assert read_entry(path) is None


def test_damaged_parts_are_computed_again(tmp_path: Path) -> None:
    points = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1.0]])
    triangles = np.array([[0, 1, 2], [0, 1, 3], [0, 2, 3], [1, 2, 3]])
    expected = convex_parts(points, triangles, 1, tmp_path)
    (entry,) = tmp_path.iterdir()
    good = entry.read_bytes()
    for content in (b"", b"PK", good[:-1], good.replace(b"NUMPY", b"NUMPX"), bytes(99)):
        entry.write_bytes(content)
        again = convex_parts(points, triangles, 1, tmp_path)
        np.testing.assert_array_equal(again, expected)
        assert entry.read_bytes() == good


def test_a_full_disk_is_named_and_no_error(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def write(path: Path, _: bytes) -> None:
        from cnpgen.store.files.atomic import machine_errors

        with machine_errors("write", path):
            raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr(cache_entry, "write_file", write)
    with pytest.warns(RuntimeWarning, match=r"the disk of the cache .* is full"):
        write_entry(tmp_path / "entry", b"content")


def test_arrays_are_counted_as_floats_before_they_are_read() -> None:
    content = archive(compressed=True, q=np.zeros(1_000_000, np.int8))
    assert len(content) < 10_000
    with is_refused(ArchiveError):
        read_arrays(content, max_bytes=7_999_999)
    assert read_arrays(content, max_bytes=8_000_000)["q"].shape == (1_000_000,)
