"""The site builds without a warning from the Markdown of the repository; in the extended run only."""

import re
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

from cnpgen.cli.docs_command import list_pages, page_url
from cnpgen.machine.versions import DOCUMENTATION_URL
from tests.conftest import HANGING

ROOT = Path(__file__).parents[2]
PARTS = ("cnpgen", "docs", "datasets", "pipelines", "problems")


def copy_of_the_repository(folder: Path) -> Path:
    """Copy the sources of the site, because a build writes pages of the API beside the others."""
    for name in PARTS:
        shutil.copytree(ROOT / name, folder / name, ignore=shutil.ignore_patterns("__pycache__", "api"))
    for page in ROOT.glob("*.md"):
        shutil.copy(page, folder)

    return folder


def build(source: Path, out: Path, *, builder: str = "html") -> subprocess.CompletedProcess[str]:
    command = [
        sys.executable,
        "-m",
        "sphinx",
        "-q",
        "-W",
        "--keep-going",
        "-b",
        builder,
        "-c",
        str(source / "docs"),
        str(source),
        str(out),
    ]
    return subprocess.run(command, capture_output=True, text=True, timeout=HANGING, check=False)


@pytest.fixture(scope="module")
def site(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Build the site."""
    for library in ("sphinx", "myst_parser", "furo"):
        pytest.importorskip(library)
    source, out = copy_of_the_repository(tmp_path_factory.mktemp("source")), tmp_path_factory.mktemp("site")
    done = build(source, out)
    assert done.returncode == 0, done.stderr
    return out


@pytest.mark.extended
def test_every_page_is_on_the_site_at_its_address_and_in_the_navigation(site: Path) -> None:
    front = (site / "docs" / "index.html").read_text(encoding="utf-8")
    for name, page in list_pages().items():
        address = page_url(page).removeprefix(DOCUMENTATION_URL)
        assert (site / address).is_file(), name
        assert name == "index" or f'href="{address.removeprefix("docs/")}"' in front, name
    assert "docs/index.html" in (site / "index.html").read_text(encoding="utf-8")


@pytest.mark.extended
def test_every_tutorial_links_to_its_notebook(site: Path) -> None:
    tutorials = sorted((ROOT / "docs" / "tutorials").glob("*.md"))
    assert len(tutorials) >= 5
    for page in tutorials:
        text = (site / "docs" / "tutorials" / f"{page.stem}.html").read_text(encoding="utf-8")
        assert f'href="../../notebooks/{page.stem}.ipynb"' in text
        assert (site / "notebooks" / f"{page.stem}.ipynb").is_file()


@pytest.mark.extended
def test_every_public_name_has_a_page_with_its_signature(site: Path) -> None:
    names = re.findall(r"^\| `(\w+)` \|", (ROOT / "docs" / "reference" / "api.md").read_text(encoding="utf-8"), re.M)
    pages = {path.stem.rpartition(".")[2]: path for path in (site / "docs" / "reference" / "api").glob("*.html")}
    assert set(names) == set(pages)
    assert 'id="cnpgen.make_dataset"' in pages["make_dataset"].read_text(encoding="utf-8")
    assert "certify" in pages["make_dataset"].read_text(encoding="utf-8")


@pytest.mark.extended
def test_the_search_finds_words_of_pages_and_names(site: Path) -> None:
    index = (site / "searchindex.js").read_text(encoding="utf-8")
    assert "docs/concepts/splines" in index
    assert "make_dataset" in index
    assert (site / "search.html").is_file()


@pytest.mark.extended
@pytest.mark.parametrize("mistake", ["[gone](gone.md)", "[gone](splines.md#no-such-heading)"])
def test_a_broken_link_fails_the_build(mistake: str, tmp_path: Path) -> None:
    for library in ("sphinx", "myst_parser", "furo"):
        pytest.importorskip(library)
    source = copy_of_the_repository(tmp_path / "source")
    with (source / "docs" / "concepts" / "scenes.md").open("a", encoding="utf-8") as page:
        page.write(f"\n{mistake}\n")
    done = build(source, tmp_path / "site", builder="dummy")  # resolves links and writes nothing
    assert done.returncode != 0
    assert "scenes.md" in done.stderr
