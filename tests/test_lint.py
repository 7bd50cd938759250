"""The lint step finds private words in names and headings, ambiguous constants and repeated names, not prose."""

import ast
from pathlib import Path

import pytest

from tests import lint

WORDS = {"fate": "outcome", "tally": "statistics"}


def source(text: str, path: str = "cnpgen/a.py") -> lint.Source:
    return lint.Source(path, ast.parse(text))


def texts(findings) -> list[str]:
    return [text for _, _, text in findings]


@pytest.mark.parametrize(
    "text",
    [
        "def fate(): ...",
        "class RowFate: ...",
        "def f(*, old_fate=1): ...",
        "FATE = 3",
        "self.fate = 2",
        "for fate in x: ...",
    ],
)
def test_private_words_are_found_in_names(text: str) -> None:
    ((path, line, message),) = lint.check_words([source(text)], [], WORDS)
    assert (path, line) == ("cnpgen/a.py", 1)
    assert "use: outcome" in message


@pytest.mark.parametrize(
    "text",
    ['"""The fate of a row."""', "x = 'fate'  # fate", "fate()", "moment = door"],
)
def test_prose_and_names_that_others_define_are_free(text: str) -> None:
    assert not list(lint.check_words([source(text)], [], WORDS))


def test_private_words_are_found_in_headings_and_module_names(tmp_path: Path) -> None:
    (tmp_path / "docs").mkdir()
    (tmp_path / "docs" / "a.md").write_text(
        "# The fate\n\nThe tally.\n\n```\n# a tally\n```\n\n## Two\n\n## Two\n\n### End:\n"
    )
    pages = lint.read_pages(tmp_path)
    assert pages[0].headings == ((1, "The fate"), (9, "Two"), (11, "Two"), (13, "End:"))
    assert texts(lint.check_words([], pages, WORDS)) == [
        "'fate' in 'The fate', use: outcome"
    ]
    assert [(line, text[-14:]) for _, line, text in lint.check_headings(pages)] == [
        (11, ", as in line 9"),
        (13, "t its last sign"[-14:]),
    ]
    named = source("", "cnpgen/tally.py")
    assert texts(lint.check_words([named], [], WORDS)) == [
        "'tally' in 'tally', use: statistics"
    ]


def test_a_constant_has_one_value_and_a_prefix_of_the_field() -> None:
    one, other = source("MAX_N = 3"), source("MAX_N = 2 * 2", "cnpgen/b.py")
    assert texts(lint.check_constants([one, other])) == [
        "MAX_N = 2 * 2 has another value in cnpgen/a.py"
    ]
    assert not list(lint.check_constants([one, source("MAX_N = 3", "cnpgen/b.py")]))
    assert texts(lint.check_constants([source("MOST_ROWS = 3")])) == [
        "MOST_ROWS: begin with MAX_"
    ]
    assert texts(lint.check_constants([source("A = [1]\nA = [2]")])) == [
        "A hides its value of line 1"
    ]
    assert not list(lint.check_constants([source("A = [1]\nA = [*A, 2]")]))


def test_classes_and_modules_have_names_of_their_own(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    sources = [source("class A: ..."), source("class A: ...", "cnpgen/x/a.py")]
    assert texts(lint.check_classes_and_modules(sources)) == [
        "class A, as in cnpgen/a.py:1"
    ]
    monkeypatch.setattr(lint, "MAX_REPEATED_STEMS", 0)
    assert "1 names of modules occur twice: a" in texts(
        lint.check_classes_and_modules(sources)
    )


def test_findings_are_printed_with_their_places_and_end_with_1(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "cnpgen").mkdir()
    (tmp_path / "cnpgen" / "a.py").write_text("x = 1\nFATES = 2\n")
    monkeypatch.setattr(lint, "find_all", lambda real=lint.find_all: real(tmp_path))
    assert lint.main() == 1
    assert capsys.readouterr().out == (
        "cnpgen/a.py:2: 'fates' in 'FATES', use: sampling statistics\n"
    )
    (tmp_path / "cnpgen" / "a.py").write_text("x = 1\n")
    assert lint.main() == 0
