"""Accounted documents report every element that was not read, with its path and the nearest known name."""

import json

import pytest

from cnpgen.errors import UsageError
from cnpgen.store.files.accounted import (
    Account,
    AccountedMapping,
    UnusedElements,
    accounted,
    is_default,
    mark_read,
)
from tests.refusals import is_refused

UNUSED_ELEMENTS = UnusedElements(
    {".title": "a title", "header.stamp": "a time"}, {"planner": "another's"}
)
CONTENT = {
    "title": "x",
    "header": {"stamp": 3, "frame": "a"},
    "items": [{"size": 1, "color": 2}, {"size": 3}],
    "planner": {"name": "RRT"},
}


def document(**changes: object) -> tuple[AccountedMapping, Account]:
    account = Account(
        "file.yaml", UNUSED_ELEMENTS, allow_unused=changes.pop("allowed", ())
    )
    return accounted(CONTENT | changes, account), account


def test_elements_that_were_not_read_are_errors_with_their_paths() -> None:
    content, account = document()
    assert content["header"].get("frame") == "a"
    assert [each["size"] for each in content["items"]] == [1, 3]
    with pytest.raises(UsageError) as error:
        account.finish(content)
    assert str(error.value) == (
        "file.yaml has 1 unknown element, items[0].color; allow_unused='color' leaves one unused"
    )
    assert account.unused == ["planner"]


def test_the_nearest_known_name_is_proposed() -> None:
    content, account = document(itms=[], items=[], header={})
    assert content.get("items") == []
    assert "widths" not in content
    mark_read(content["header"])
    with is_refused(UsageError, argument="allow_unused"):
        account.finish(content)
    content, account = document(width=1, items=[], header={})
    mark_read(content["header"])
    mark_read(content["items"])
    assert "widths" not in content  # a check of a key does not read it
    with is_refused(UsageError, argument="allow_unused"):
        account.finish(content)


def test_entries_of_lists_are_read_one_by_one() -> None:
    content, account = document(items=[{"size": 1}, {"size": 2}, 3, 4], header={})
    mark_read(content["header"])
    assert content["items"][-1] == 4
    assert content["items"][1:2] == [{"size": 2}]
    with is_refused(UsageError, argument="allow_unused"):
        account.finish(content)


def test_the_loss_of_an_element_is_accepted_by_its_key_or_the_end_of_its_path() -> None:
    for allowed in ("color", "items.color"):
        content, account = document(allowed=[allowed], header={})
        mark_read(content["header"])
        assert [each["size"] for each in content["items"]] == [1, 3]
        account.finish(content)
        assert account.accepted == ["items.color"]
    content, account = document(allowed=["other.color"])
    with pytest.raises(UsageError):
        account.finish(content)


def test_an_element_that_is_not_honoured_is_refused_unless_it_is_empty() -> None:
    content, account = document(header={"scale": 0, "stamp": 1})
    content["header"].refuse("scale", "must be 0")
    content["header"].refuse("missing", "must be 0")
    content, account = document(header={"scale": 2})
    with is_refused(UsageError, argument="allow_unused"):
        content["header"].refuse("scale", "must be 0")
    content, account = document(header={"scale": 2}, allowed=["scale"])
    content["header"].refuse("scale", "must be 0")
    assert account.accepted == ["header.scale"]


def test_accounted_documents_are_plain_mappings_and_lists() -> None:
    content, _ = document()
    assert content == CONTENT
    assert json.loads(json.dumps(content)) == CONTENT


@pytest.mark.parametrize(
    ("value", "expected"),
    [
        *((value, True) for value in (None, "", "0", "0.0", "false", 0, False, [], {})),
        *((value, True) for value in ([0, "0"], {"x": 0, "y": {"z": ""}})),
        *((value, False) for value in ("nan", "x", 1e-9, True, [{}], {"x": [0, 1]})),
    ],
)
def test_empty_elements_have_default_values(value: object, expected: bool) -> None:
    assert is_default(value) is expected
