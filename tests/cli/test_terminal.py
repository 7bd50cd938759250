"""Untrusted text is shown and does not control the terminal."""

import io
import json
import sys
from contextlib import suppress
from pathlib import Path

import pytest

from cnpgen.cli.main import main
from cnpgen.cli.terminal import Printable, printable, printing_safely
from cnpgen.schema.catalogue import list_recipes
from tests.refusals import assert_said

EVIL = "\x1b]0;owned\x07\x1b[31mred\x9b2J\u202egnp.exe"
SHOWN = r"\u001b]0;owned\u0007\u001b[31mred\u009b2J\u202egnp.exe"


def test_control_characters_are_shown_as_json_has_them() -> None:
    assert printable(EVIL) == SHOWN
    assert json.loads(f'"{printable(EVIL)}"') == EVIL
    assert (
        printable("ordinary text: \t äöü 漢字 😀\n")
        == "ordinary text: \t äöü 漢字 😀\n"
    )


def test_streams_are_what_they_were_when_the_block_ends() -> None:
    before = sys.stdout, sys.stderr
    with suppress(ValueError), printing_safely():
        inside = sys.stdout
        raise ValueError
    assert isinstance(inside, Printable)
    assert (sys.stdout, sys.stderr) == before


def test_a_stream_is_otherwise_itself() -> None:
    buffer = io.StringIO()
    stream = Printable(buffer)
    assert stream.write("\x1b") == 1
    stream.flush()
    assert buffer.getvalue() == r"\u001b"
    assert stream.terminal is buffer
    assert not stream.isatty()


@pytest.fixture
def recipe(tmp_path: Path) -> Path:
    """A dataset recipe with such a title."""
    text = list_recipes("dataset")["airhockey-hit"].read_text(encoding="utf-8")
    lines = [
        f"title = {json.dumps(EVIL)}" if line.startswith("title") else line
        for line in text.splitlines()
    ]
    (tmp_path / "evil.toml").write_text("\n".join(lines), encoding="utf-8")
    return tmp_path / "evil.toml"


def test_the_title_of_a_recipe_is_shown_so(
    recipe: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["show", str(recipe)]) == 0
    out = capsys.readouterr().out
    assert "\x1b" not in out
    assert r"\u001b]0;owned\u0007" in out
    assert main(["show", str(recipe), "--json"]) == 0
    assert repr(EVIL) in repr(json.loads(capsys.readouterr().out))


def test_a_name_that_does_not_exist_is_shown_so(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["inspect", f"{tmp_path}/\x1b[31m"]) == 2
    assert_said(capsys.readouterr().err)


def test_recipe_errors_in_a_recipe_are_shown_so(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "evil.toml").write_text(
        '"\\u001b[31mkey" = 1\nname = "\\u001b[31m"\n"\\u009b2J" = 2', encoding="utf-8"
    )
    assert main(["show", str(tmp_path / "evil.toml")]) == 2
    assert not {"\x1b", "\x9b"} & set(capsys.readouterr().err)
