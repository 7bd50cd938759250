"""``cnpgen docs``: pages are listed, found by name or path, searched, and refused with the nearest name."""

import json
from pathlib import Path

import pytest

from cnpgen.cli import docs_command
from cnpgen.cli.main import main
from cnpgen.machine import versions
from tests.refusals import assert_said

DOCS = Path(__file__).parents[2] / "docs"


def test_all_pages_are_listed_by_kind(capsys):
    assert main(["docs"]) == 0
    printed = capsys.readouterr().out
    assert (
        printed.index("tutorials:")
        < printed.index("  hit-a-puck ")
        < printed.index("  your-arm ")
    )
    assert (
        printed.index("  your-arm ")
        < printed.index("  publish-a-dataset ")
        < printed.index("how-to:")
    )
    assert main(["docs", "--json"]) == 0
    rows = json.loads(capsys.readouterr().out)
    assert {row["page"] for row in rows} == set(docs_command.list_pages()) - {"index"}
    assert all(row["title"] for row in rows)
    pages = [path for path in DOCS.rglob("*.md") if "examples" not in path.parts]
    written = {path.stem for path in pages} - {"index"}
    assert {row["page"].rpartition("/")[2] for row in rows} == written | {
        "api",
        "cli",
        "keys",
        "scene-elements",
    }


@pytest.mark.parametrize(
    "name",
    [
        "verdict",
        "verdict.md",
        "docs/concepts/verdict.md",
        "../concepts/verdict.md#between-samples",
    ],
)
def test_a_page_is_printed_as_it_is(name, capsys):
    assert main(["docs", name]) == 0
    assert capsys.readouterr().out == (DOCS / "concepts" / "verdict.md").read_text(
        encoding="utf-8"
    )


def test_pages_of_benchmarks_have_names_of_their_own(capsys):
    assert main(["docs", "benchmarks/verdict"]) == 0
    assert capsys.readouterr().out == (DOCS / "benchmarks" / "verdict.md").read_text(
        encoding="utf-8"
    )


def test_an_unknown_page_is_refused_with_the_nearest_one(capsys):
    assert main(["docs", "tutorials/verdict"]) == 2
    assert main(["docs", ""]) == 2
    capsys.readouterr()
    assert main(["docs", "verdct"]) == 2
    assert_said(capsys.readouterr().err)
    assert main(["docs", "SAFETY"]) == 2
    assert_said(capsys.readouterr().err)


SITE = "https://docs.example.org/"


@pytest.fixture
def site(monkeypatch):
    """Give the documentation an address."""
    monkeypatch.setattr(versions, "DOCUMENTATION_URL", SITE)


def test_the_address_of_a_page_begins_with_that_of_the_site(site, capsys):
    assert main(["docs", "verdict", "--url"]) == 0
    assert capsys.readouterr().out == f"{SITE}docs/concepts/verdict.html\n"
    assert main(["docs", "--url"]) == 0
    assert capsys.readouterr().out == f"{SITE}docs/index.html\n"


def test_nothing_names_an_address_that_is_not_published(monkeypatch, capsys):
    monkeypatch.setattr(versions, "DOCUMENTATION_URL", "")
    assert main(["docs", "verdict", "--url"]) == 2
    assert_said(capsys.readouterr().err)
    assert main(["docs", "verdict", "--json"]) == 0
    assert json.loads(capsys.readouterr().out)["url"] is None
    assert main(["train", "--help"]) == 0
    printed = capsys.readouterr().out
    assert "'cnpgen docs training'" in " ".join(printed.split())
    assert "http" not in printed
    assert "on the site:" not in printed


def test_a_search_prints_lines_and_reports_if_there_are_none(capsys):
    assert main(["docs", "--search", "BERNSTEIN"]) == 0
    lines = capsys.readouterr().out.splitlines()
    assert any(line.startswith("verdict:") for line in lines)
    assert all("bernstein" in line.casefold() for line in lines)
    assert main(["docs", "--search", "certificate Zanzibar"]) == 1
    printed = capsys.readouterr()
    assert printed.out == ""
    assert "no line of the documentation has" in printed.err


def test_a_search_finds_words_in_any_order(capsys):
    assert main(["docs", "--search", "samples grid"]) == 0
    lines = capsys.readouterr().out
    assert main(["docs", "--search", "GRID samples"]) == 0
    assert capsys.readouterr().out == lines


def test_a_search_and_a_page_exclude_each_other(capsys):
    assert main(["docs", "verdict", "--search", "chord"]) == 2
    assert_said(capsys.readouterr().err)


def test_an_installation_without_pages_is_an_error_of_the_machine(
    monkeypatch, tmp_path, capsys
):
    monkeypatch.setattr(docs_command, "docs_folder", lambda: tmp_path)
    assert main(["docs", "verdict"]) == 3
    assert_said(capsys.readouterr().err)


def test_help_has_the_addresses_of_the_pages_that_it_names(site, capsys):
    assert main(["--help"]) == 0
    assert "documentation: 'cnpgen docs' lists the pages" in capsys.readouterr().out
    assert main(["train", "--help"]) == 0
    printed = capsys.readouterr().out
    assert "'cnpgen docs training'" in " ".join(printed.split())
    assert printed.endswith(f"on the site:\n  {SITE}docs/how-to/training.html\n")


def test_an_error_that_names_a_page_has_its_address(site, monkeypatch, capsys):
    def broken(_):
        raise ImportError("libcoal.so: cannot open shared object file")

    monkeypatch.setattr("cnpgen.cli.doctor_command.run", broken)
    assert main(["doctor"]) == 3
    (line,) = capsys.readouterr().err.splitlines()
    assert line.endswith(f"({SITE}docs/how-to/troubleshooting.html)")


def test_texts_without_installed_pages_have_no_addresses(site, monkeypatch, tmp_path):
    text = "'cnpgen docs scale' or 'cnpgen docs\n  no-such-page'"
    addresses = [f"{SITE}docs/how-to/scale.html"]
    assert docs_command.mentioned_addresses(text) == addresses
    monkeypatch.setattr(docs_command, "docs_folder", lambda: tmp_path)
    assert docs_command.mentioned_addresses(text) == []
