"""Completion in the shell: argcomplete gives the program a line and reads the words from file descriptor 8."""

import os
import subprocess
import sys
from pathlib import Path

import pytest

from cnpgen.cli.main import build_parser
from cnpgen.schema import registry
from cnpgen.schema.catalogue import list_recipes

pytest.importorskip("argcomplete")


def complete(line: str, folder: Path) -> list[str]:
    """Return the completions of a line, as the function of bash calls the program."""
    variables = {
        "_ARGCOMPLETE": "1",
        "_ARGCOMPLETE_IFS": "\n",
        "_ARGCOMPLETE_STDOUT_FILENAME": str(folder / "words"),
        "COMP_LINE": line,
        "COMP_POINT": str(len(line)),
    }
    done = subprocess.run(
        [sys.executable, "-m", "cnpgen"],
        env=os.environ | variables,
        cwd=folder,
        capture_output=True,
        check=False,
    )
    assert done.stdout == b""
    return [word.strip() for word in (folder / "words").read_text().splitlines()]


@pytest.mark.slow
@pytest.mark.parametrize(
    ("line", "expected"),
    [
        ("cnpgen mak", ["make-dataset", "make-scenes"]),
        ("cnpgen docs torch-pl", ["torch-planner"]),
        ("cnpgen list fam", ["families"]),
        ("cnpgen benchmark hits-81 --planners ss", ["sscbirrt", "sst"]),
        ("cnpgen make-scenes table", ["tabletop", "table-pick", "table-under-pick"]),
        ("cnpgen inspect ./some-", ["./some-folder/"]),
        ("cnpgen refine plans.h5 --max-it", ["--max-iterations"]),
    ],
)
def test_the_words_are_those_of_the_command(
    line: str, expected: list[str], tmp_path: Path
) -> None:
    (tmp_path / "some-folder").mkdir()
    words = complete(line, tmp_path)
    if line.endswith("table"):
        expected = [name for name in registry.names(registry.FAMILIES) if name.startswith("table")]  # fmt: skip
    assert sorted(words) == sorted(expected)


@pytest.mark.slow
def test_recipes_and_files_complete_an_argument_that_takes_both(tmp_path: Path) -> None:
    (tmp_path / "airfield.toml").touch()
    words = complete("cnpgen make-dataset air", tmp_path)
    assert "airfield.toml" in words
    recipes = {name for name in list_recipes("dataset") if name.startswith("air")}
    assert recipes < set(words)


def test_every_command_has_the_common_options() -> None:
    parser = build_parser()
    commands = next(a.choices for a in parser._actions if isinstance(a.choices, dict))
    for name, command in commands.items():
        for option in ("-v", "--verbose", "--debug", "-q", "--quiet"):
            assert option in command._option_string_actions, (name, option)
