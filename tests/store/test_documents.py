"""Sealed JSON: every changed byte is noticed."""

import json
from pathlib import Path

import numpy as np
import pytest

from cnpgen.errors import DatasetError
from cnpgen.store.files.documents import canonical_sha256, load_document, plain, render, save_document

DOCUMENT = {
    "format": "test",
    "format_version": 1,
    "text": 'a "quoted" \\ [\n 1 ] line, grün',
    "floats": (0.1, 1e-300, -0.0, 3.0),
    "nested": {"empty": {}, "table": [[1, 2], [3, 4]], "nothing": None, "yes": True, "list": []},
}


def test_documents_survive_a_round_trip(tmp_path: Path) -> None:
    save_document(tmp_path / "a.json", DOCUMENT)
    assert load_document(tmp_path / "a.json", "test", version=1) == json.loads(json.dumps(DOCUMENT))


def test_rendered_json_is_json_with_short_lists_on_one_line() -> None:
    text = render(plain(DOCUMENT))
    assert json.loads(text) == json.loads(json.dumps(DOCUMENT))
    assert "      [1, 2],\n" in text


def test_numpy_values_become_plain_and_infinities_become_readable_strings() -> None:
    value = plain({"a": np.float32(0.5), "b": np.arange(3), "c": (np.inf, -np.inf), "d": np.bool_(True), 5: Path("x")})
    assert value == {"a": 0.5, "b": [0, 1, 2], "c": ["inf", "-inf"], "d": True, "5": "x"}
    assert float(value["c"][1]) == -np.inf
    with pytest.raises(TypeError, match="set"):
        plain({"a": {1}})


def test_the_canonical_digest_ignores_order_and_nothing_else() -> None:
    assert canonical_sha256({"a": 1, "b": (2,)}) == canonical_sha256({"b": [2], "a": 1})
    assert canonical_sha256({"a": 1}) != canonical_sha256({"a": 1.0})


def test_every_flipped_byte_is_noticed(tmp_path: Path) -> None:
    path = tmp_path / "a.json"
    save_document(path, DOCUMENT)
    good = path.read_bytes()
    for position in range(len(good)):
        for mask in (0x01, 0x20, 0x80):
            path.write_bytes(good[:position] + bytes([good[position] ^ mask]) + good[position + 1 :])
            with pytest.raises(DatasetError, match=r"a\.json"):
                load_document(path, "test", version=1)
    path.write_bytes(good.replace(b" ", b"\t", 1))
    with pytest.raises(DatasetError, match="changed after it was written"):
        load_document(path, "test", version=1)


def test_every_truncation_is_noticed(tmp_path: Path) -> None:
    path = tmp_path / "a.json"
    save_document(path, DOCUMENT)
    good = path.read_bytes()
    for length in range(len(good)):
        path.write_bytes(good[:length])
        with pytest.raises(DatasetError, match="damaged"):
            load_document(path, "test", version=1)


@pytest.mark.parametrize(
    ("change", "message"),
    [({"format": "other"}, "not a test file"), ({"format_version": 2}, "upgrade cnpgen")],
)
def test_other_and_newer_formats_are_refused_by_name(tmp_path: Path, change: dict[str, object], message: str) -> None:
    save_document(tmp_path / "a.json", {**DOCUMENT, **change})
    with pytest.raises(DatasetError, match=message):
        load_document(tmp_path / "a.json", "test", version=1)


def test_missing_and_foreign_files_are_refused(tmp_path: Path) -> None:
    with pytest.raises(DatasetError, match="missing"):
        load_document(tmp_path / "a.json", "test", version=1)
    (tmp_path / "a.json").write_text("[1]")
    with pytest.raises(DatasetError, match="JSON object"):
        load_document(tmp_path / "a.json", "test", version=1)
