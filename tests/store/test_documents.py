"""JSON documents with a checksum: every changed byte is detected."""

import json
import os
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from cnpgen.errors import DatasetError
from cnpgen.store.files.document_structure import (
    ANY_KEY,
    ANYTHING,
    NUMBER,
    TEXT,
    WHOLE,
    Nullable,
    check_structure,
    structure_of,
)
from cnpgen.store.files.documents import (
    canonical_sha256,
    load_document,
    parse_json,
    plain,
    render,
    save_document,
)
from cnpgen.store.files.size_limits import MAX_DOCUMENT_BYTES, MAX_DOCUMENT_DEPTH
from tests.refusals import is_refused

DOCUMENT = {
    "format": "test",
    "format_version": 1,
    "text": 'a "quoted" \\ [\n 1 ] line, grün',
    "floats": (0.1, 1e-300, -0.0, 3.0),
    "nested": {
        "empty": {},
        "table": [[1, 2], [3, 4]],
        "nothing": None,
        "yes": True,
        "list": [],
    },
}


def test_documents_round_trip(tmp_path: Path) -> None:
    save_document(tmp_path / "a.json", DOCUMENT)
    assert load_document(
        tmp_path / "a.json", "test", version=1, structure={}
    ) == json.loads(json.dumps(DOCUMENT))


def test_rendered_json_is_json_with_short_lists_on_one_line() -> None:
    text = render(plain(DOCUMENT))
    assert json.loads(text) == json.loads(json.dumps(DOCUMENT))
    assert "      [1, 2],\n" in text


def test_numpy_values_become_plain_and_infinities_become_readable_strings() -> None:
    value = plain(
        {
            "a": np.float32(0.5),
            "b": np.arange(3),
            "c": (np.inf, -np.inf),
            "d": np.bool_(True),
            5: Path("x"),
        }
    )
    assert value == {
        "a": 0.5,
        "b": [0, 1, 2],
        "c": ["inf", "-inf"],
        "d": True,
        "5": "x",
    }
    assert float(value["c"][1]) == -np.inf
    with is_refused(TypeError):
        plain({"a": {1}})


def test_the_canonical_digest_ignores_order_and_nothing_else() -> None:
    assert canonical_sha256({"a": 1, "b": (2,)}) == canonical_sha256({"b": [2], "a": 1})
    assert canonical_sha256({"a": 1}) != canonical_sha256({"a": 1.0})


def test_every_flipped_byte_is_detected(tmp_path: Path) -> None:
    path = tmp_path / "a.json"
    save_document(path, DOCUMENT)
    good = path.read_bytes()
    for position in range(len(good)):
        for mask in (0x01, 0x20, 0x80):
            path.write_bytes(
                good[:position] + bytes([good[position] ^ mask]) + good[position + 1 :]
            )
            with pytest.raises(DatasetError, match=r"a\.json"):
                load_document(path, "test", version=1, structure={})
    path.write_bytes(good.replace(b" ", b"\t", 1))
    with pytest.raises(DatasetError, match="changed after it was written"):
        load_document(path, "test", version=1, structure={})


def test_every_truncation_is_detected(tmp_path: Path) -> None:
    path = tmp_path / "a.json"
    save_document(path, DOCUMENT)
    good = path.read_bytes()
    for length in range(len(good)):
        path.write_bytes(good[:length])
        with pytest.raises(DatasetError, match="damaged"):
            load_document(path, "test", version=1, structure={})


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"format": "other"}, "not a test file"),
        (
            {"format_version": 2},
            "has format version 2, this cnpgen reads version 1: upgrade cnpgen",
        ),
        (
            {"format_version": 0},
            "has format version 0, this cnpgen reads version 1: make it again",
        ),
    ],
)
def test_other_formats_and_versions_are_refused_and_named(
    tmp_path: Path, change: dict[str, object], message: str
) -> None:
    save_document(tmp_path / "a.json", {**DOCUMENT, **change})
    with pytest.raises(DatasetError, match=message):
        load_document(tmp_path / "a.json", "test", version=1, structure={})


def test_missing_and_foreign_files_are_refused(tmp_path: Path) -> None:
    with is_refused(DatasetError):
        load_document(tmp_path / "a.json", "test", version=1, structure={})
    (tmp_path / "a.json").write_text("[1]")
    with is_refused(DatasetError):
        load_document(tmp_path / "a.json", "test", version=1, structure={})


@pytest.mark.parametrize(
    ("structure", "message"),
    [
        ({"absent": TEXT}, r"a\.json is damaged: absent is missing"),
        (
            {"nested": {"nothing": TEXT}},
            "damaged: nested.nothing must be a text, got None",
        ),
        (
            {"nested": {ANY_KEY: ANYTHING}, "text": WHOLE},
            "damaged: text must be a whole number from 0 to 9223372036854775807",
        ),
        (
            {"floats": [WHOLE]},
            r"damaged: floats\[0\] must be a whole number from 0 to \d+, got 0.1",
        ),
        ({"floats": TEXT}, "damaged: floats must be a text, got a list of 4"),
        (
            {"nested": {"table": [[TEXT]]}},
            r"damaged: nested.table\[0\]\[0\] must be a text, got 1",
        ),
        ({"nested": {"yes": NUMBER}}, "damaged: nested.yes must be a number, got True"),
        ({"nested": [TEXT]}, "damaged: nested must be a list, got a table"),
        ({"text": {"a": TEXT}}, "damaged: text must be a table, got 'a"),
        (
            {"nested": {ANY_KEY: Nullable(TEXT)}},
            "damaged: nested.empty must be a text, got a table",
        ),
        ({"format_version": TEXT}, "format_version must be a text, got 1"),
    ],
)
def test_a_document_with_another_structure_is_refused_and_the_key_is_named(
    tmp_path: Path, structure: object, message: str
) -> None:
    save_document(tmp_path / "a.json", DOCUMENT)
    with pytest.raises(DatasetError, match=message):
        load_document(tmp_path / "a.json", "test", version=1, structure=structure)


def test_a_document_with_the_expected_structure_is_accepted() -> None:
    nested = {"table": [[WHOLE]], "nothing": Nullable(TEXT), "list": [TEXT]}
    check_structure(
        json.loads(json.dumps(DOCUMENT)),
        {"floats": [NUMBER], "nested": nested, "text": TEXT},
    )
    check_structure({"a": "inf", "b": -1, "c": 1e300}, {ANY_KEY: NUMBER})
    for wrong in (-1, 2**63, 1.0, "1", None, True):
        with is_refused(ValueError):
            check_structure({"a": wrong}, {"a": WHOLE})
    with is_refused(ValueError):
        check_structure({"a": -(10**400)}, {"a": NUMBER})


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("[" * 200_000, "nested tables and lists"),
        ("[" * 200_000 + "]" * 200_000, "nested tables and lists"),
        (
            "[" * (MAX_DOCUMENT_DEPTH + 1) + "]" * (MAX_DOCUMENT_DEPTH + 1),
            "nested tables and lists",
        ),
        ('{"a":' * 100 + "1" + "}" * 100, "nested tables and lists"),
        (r'{"a": "\ud800"}', "surrogates not allowed"),
        ("9" * 5000, "4300 digits"),
    ],
    ids=["open", "closed", "one too deep", "tables", "single surrogate", "digits"],
)
def test_invalid_json_is_refused(tmp_path: Path, text: str, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        parse_json(text)
    (tmp_path / "a.json").write_text(text)
    with is_refused(DatasetError):
        load_document(tmp_path / "a.json", "test", version=1, structure={})


def test_json_of_the_maximum_depth_is_read() -> None:
    assert parse_json("[" * MAX_DOCUMENT_DEPTH + "]" * MAX_DOCUMENT_DEPTH)[0]
    assert parse_json(r'"\ud83d\ude00"') == "\U0001f600"
    assert parse_json("3") == 3


def test_a_document_that_is_too_large_is_not_read(tmp_path: Path) -> None:
    with (tmp_path / "a.json").open("wb") as file:
        file.truncate(MAX_DOCUMENT_BYTES + 1)
    with is_refused(DatasetError):
        load_document(tmp_path / "a.json", "test", version=1, structure={})


def test_devices_and_pipes_are_refused_without_blocking(tmp_path: Path) -> None:
    os.mkfifo(tmp_path / "a.json")
    for path in (Path("/dev/zero"), tmp_path / "a.json"):
        with is_refused(DatasetError):
            load_document(path, "test", version=1, structure={})


@dataclass
class Inner:
    text: str
    limits: tuple[float, ...] | None


@dataclass
class Outer:
    counts: Mapping[str, int]
    inner: tuple[Inner, ...]
    anything: dict[str, Any]
    array: np.ndarray

    @property
    def other(self) -> int:
        return 0


def test_the_structure_of_a_dataclass_is_that_of_its_fields() -> None:
    assert structure_of(Outer) == {
        "counts": {ANY_KEY: WHOLE},
        "inner": [{"text": TEXT, "limits": Nullable([NUMBER])}],
        "anything": {ANY_KEY: ANYTHING},
        "array": ANYTHING,
    }
    inner = {"text": "", "limits": None}
    stored = {"counts": {"a": 1}, "inner": [inner], "anything": {}, "array": []}
    check_structure(stored, structure_of(Outer))
    with pytest.raises(ValueError, match=r"inner\[0\]\.limits must be a list"):
        check_structure(
            stored | {"inner": [inner | {"limits": 5}]}, structure_of(Outer)
        )
