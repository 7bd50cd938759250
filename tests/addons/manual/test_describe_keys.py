"""The keys of recipe files: every one is described, on the page and by a command."""

import dataclasses
import json
import re

import pytest

from cnpgen.addons.manual.describe_keys import (
    describe_kind,
    keys_to_dict,
    kind_summary,
    kind_to_dict,
    recipe_types,
)
from cnpgen.cli.docs_command import list_pages, page_text
from cnpgen.cli.main import main
from cnpgen.cli.terminal import LINE_WIDTH
from cnpgen.errors import RecipeError
from cnpgen.schema import registry
from cnpgen.schema.keys import keys
from cnpgen.schema.toml import MARKS
from cnpgen.store.files.documents import plain
from tests.refusals import assert_said, is_refused

KINDS = [
    (group, name)
    for group in (registry.STAGES, registry.CONSTRAINTS)
    for name in registry.names(group)
]


@pytest.mark.parametrize(("group", "name"), KINDS)
def test_every_kind_of_stage_and_constraint_is_described(group, name):
    text, content = (
        describe_kind(group, name),
        json.loads(json.dumps(plain(kind_to_dict(group, name)))),
    )
    assert name in text.splitlines()[0]
    assert content["summary"]
    for key in content["keys"]:
        assert key["name"] in text
        assert key["doc"]
        assert key["required"] == ("default" not in key)
    assert all(len(line) <= LINE_WIDTH for line in text.splitlines())


def test_an_unknown_kind_is_refused_with_the_nearest_one():
    with is_refused(RecipeError):
        describe_kind(registry.STAGES, "start-ikk")


def test_a_summary_is_the_first_line_without_markup():
    class Kind:
        """Do ``this``.

        And that.
        """

    assert kind_summary(Kind) == "Do this."
    assert kind_summary(type("Bare", (), {})) == ""


def test_the_page_of_all_keys_is_what_the_command_prints(capsys):
    assert main(["show", "--keys"]) == 0
    printed = capsys.readouterr().out
    assert main(["docs", "keys"]) == 0
    assert capsys.readouterr().out == printed


def test_every_key_of_every_table_is_on_the_page_with_a_sentence():
    page = page_text(list_pages()["keys"])
    named = [
        *recipe_types().values(),
        *(registry.load(group, name) for group, name in KINDS),
    ]
    tables = {
        spec.type
        for kind in named
        for spec in dataclasses.fields(kind)
        if dataclasses.is_dataclass(spec.type)
    }
    for kind in {*named, *tables}:
        for key in keys(kind):
            assert len(key.doc) > 5
            assert f"| `{key.name}` |" in page
    for _, name in KINDS:
        assert f"#### `{name}`" in page
    for part in (
        "[robot]",
        "[limits]",
        "[payload]",
        "[[obstacle]]",
        "[[stage]]",
        "[replanning.pucks]",
    ):
        assert f"### `{part}`" in page


def test_no_default_is_a_python_object():
    page = page_text(list_pages()["keys"])
    assert "| `parameters` | a table | those of its keys |" in page
    assert not re.search(r"\w\(\w+=", page)


def test_every_row_of_every_table_has_four_cells():
    rows = [
        line
        for line in page_text(list_pages()["keys"]).splitlines()
        if line.startswith("|")
    ]
    assert len(rows) > 150
    assert {len(re.split(r"(?<!\\)\|", row)) for row in rows} == {6}


def test_a_key_is_described_with_unit_bounds_and_default():
    page = page_text(list_pages()["keys"])
    assert "| `velocity_scale` | a number, at least 0.001, at most 1 | 1 |" in page
    assert "| `radius` | a length [m], at least 1e-06 | none |" in page
    assert "| `urdf` | a string | required |" in page


@pytest.mark.parametrize("kind", list(recipe_types()))
def test_the_keys_of_one_kind_of_file_are_a_part_of_all(kind, capsys):
    assert main(["show", "--keys", kind]) == 0
    part = capsys.readouterr().out
    assert part.startswith(f"## {kind.capitalize()} files\n")
    assert part.strip() in page_text(list_pages()["keys"])


def test_the_keys_have_a_json_form_with_tables_and_kinds():
    content = json.loads(json.dumps(plain(keys_to_dict(tuple(recipe_types())))))
    problem = {key["name"]: key for key in content["problem"]["keys"]}
    assert [key["name"] for key in problem["robot"]["table"]["keys"]][:3] == [
        "urdf",
        "joints",
        "tip",
    ]
    assert {kind["name"] for kind in problem["constraint"]["kinds"]} == set(
        registry.names(registry.CONSTRAINTS)
    )
    assert (
        "table"
        not in {key["name"]: key for key in content["pipeline"]["keys"]}["problem"]
    )


def test_there_are_keys_of_every_kind_of_file():
    assert set(recipe_types()) == set(MARKS)


def test_the_keys_of_what_is_no_file_are_refused(capsys):
    assert main(["show", "--keys", "problems"]) == 2
    assert_said(capsys.readouterr().err)
