"""Tables that take much more memory than their files: decoded sizes are counted before they are read."""

import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from cnpgen.addons.trajectories import parquet_tables, text_tables, trajectory_tables
from cnpgen.addons.trajectories.trajectory_tables import read_trajectory_tables
from cnpgen.errors import UsageError
from tests.refusals import is_refused

LONG_TEXT = 8_000_000  # characters


def write_parquet(path: Path, **columns: Any) -> Path:
    pyarrow = pytest.importorskip("pyarrow")
    parquet = pytest.importorskip("pyarrow.parquet")
    parquet.write_table(pyarrow.table(columns), path)
    return path


def repeated(text: str, count: int) -> Any:
    """A text that is in the file once."""
    pyarrow = pytest.importorskip("pyarrow")
    indices = pyarrow.array([0] * count, pyarrow.int32())
    return pyarrow.DictionaryArray.from_arrays(indices, pyarrow.array([text]))


def test_repeated_long_texts_of_parquet_are_refused(tmp_path: Path) -> None:
    note = repeated("z" * LONG_TEXT, 1000)
    path = write_parquet(tmp_path / "a.parquet", t=np.arange(1000.0), note=note)
    assert path.stat().st_size < 2 * LONG_TEXT
    with is_refused(UsageError):
        read_trajectory_tables(path)


def test_texts_of_parquet_are_read(tmp_path: Path) -> None:
    note = repeated("home", 3)
    path = write_parquet(
        tmp_path / "a.parquet",
        t=np.arange(3.0),
        note=note,
        q=[[0.0, 1.0]] * 3,
        names=[["a", "b"]] * 3,
    )
    (table,) = read_trajectory_tables(path)
    assert table.columns["note"].tolist() == ["home"] * 3
    assert table.columns["q"].shape == (3, 2)
    assert table.columns["names"].tolist() == [["a", "b"]] * 3


@pytest.mark.parametrize(
    ("name", "limit"), [("MAX_PARQUET_VALUES", 1999), ("MAX_UNPACKED_BYTES", 100)]
)
def test_values_and_bytes_of_parquet_are_counted(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, name: str, limit: int
) -> None:
    path = write_parquet(tmp_path / "a.parquet", t=np.zeros(1000), q=np.zeros(1000))
    read_trajectory_tables(path)
    monkeypatch.setattr(parquet_tables, name, limit)
    # The size of the file depends on PyArrow.
    with pytest.raises(
        UsageError, match=r"2,000 values in \d+ bytes, expected at most"
    ):
        read_trajectory_tables(path)


def test_a_long_text_in_a_column_of_many_is_refused(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = tmp_path / "a.csv"
    path.write_text("t,note\n0,x\n1,y\n2," + "z" * 1000 + "\n", encoding="utf-8")
    read_trajectory_tables(path)
    monkeypatch.setattr(text_tables, "MAX_TEXT_ARRAY_BYTES", 11_999)
    with is_refused(UsageError):
        read_trajectory_tables(path)


def test_text_files_have_a_limit_that_their_cells_fit_into(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    assert 40 * text_tables.MAX_TEXT_TABLE_BYTES < 3 << 30  # of 8 GB
    monkeypatch.setattr(text_tables, "MAX_TEXT_TABLE_BYTES", 8)
    monkeypatch.setattr(trajectory_tables, "MAX_TEXT_TABLE_BYTES", 8)
    for name, text in (("a.csv", "t,q\n0,1\n1,2\n"), ("a.json", '{"t": [0, 1]}')):
        (tmp_path / name).write_text(text, encoding="utf-8")
        with is_refused(UsageError):
            read_trajectory_tables(tmp_path / name)


def test_lists_and_objects_of_json_are_counted_before_they_are_read(
    tmp_path: Path,
) -> None:
    path = tmp_path / "a.json"
    path.write_text("[" + "[]," * 2_000_000 + "0]", encoding="utf-8")
    with is_refused(UsageError):
        read_trajectory_tables(path)


# Reads files with a changed bit in each byte of the footer; a crash would end the process.
READ_CHANGED = """
import sys
from pathlib import Path
from cnpgen.addons.trajectories.parquet_tables import read_parquet
from cnpgen.errors import UsageError

good = Path(sys.argv[1])
content, changed, refused = good.read_bytes(), good.with_name("b.parquet"), 0
footer = int.from_bytes(content[-8:-4], "little")
for i in range(len(content) - 8 - footer, len(content) - 8):
    changed.write_bytes(content[:i] + bytes([content[i] ^ 1]) + content[i + 1 :])
    try:
        read_parquet(changed)
    except UsageError:
        refused += 1
assert refused > footer // 4
"""


def test_damaged_footers_of_parquet_do_not_end_the_process(tmp_path: Path) -> None:
    path = write_parquet(tmp_path / "a.parquet", t=np.arange(3.0), q=[[0.0, 1.0]] * 3)
    words = [sys.executable, "-c", READ_CHANGED, str(path)]
    subprocess.run(words, check=True, capture_output=True)
