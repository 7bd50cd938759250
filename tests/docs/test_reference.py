"""The reference pages follow the code, and every page has its place."""

import importlib.util
import json
import re
from pathlib import Path
from types import ModuleType

import numpy as np
import pytest

from cnpgen.addons.manual.name_page import MODULES as NAMED_MODULES
from cnpgen.addons.manual.name_page import name_page
from cnpgen.cli.docs_command import KINDS, list_pages, page_text, rendered_pages
from cnpgen.cli.main import build_parser
from cnpgen.errors import CnpgenError
from cnpgen.refine.task import Outcome
from tests.docs.test_blocks import blocks
from tests.test_public_names import MODULES

ROOT = Path(__file__).parents[2]
DOCS = ROOT / "docs"
MAX_BYTES = 460_000  # of all Markdown in the wheel
MAX_DIFFERENCE = 0.008  # mean over the pixels of a picture, of 1
MIN_PICTURE_TEXT = 20  # [characters] a description, not a name


def script(name: str) -> ModuleType:
    """Load a script of docs/."""
    spec = importlib.util.spec_from_file_location(f"docs_{name}", DOCS / f"{name}.py")
    assert spec
    assert spec.loader
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def test_the_first_page_has_the_commands_of_the_readme() -> None:
    page = (DOCS / "index.md").read_text(encoding="utf-8")
    described = script("generate").describe_index()
    assert page == described + "\n", "run: python docs/generate.py"


def test_every_option_of_every_command_is_on_the_page() -> None:
    page = page_text(list_pages()["cli"])
    commands = next(
        action.choices
        for action in build_parser()._actions
        if isinstance(action.choices, dict)
    )
    assert len(commands) >= 20
    common = {"-h", "--help", "-v", "--verbose", "--debug", "-q", "--quiet"}
    for name, command in commands.items():
        section = page.split(f"## `cnpgen {name}`\n")[1].split("\n## ")[0]
        for option in set(command._option_string_actions) - common:
            assert re.search(rf"`([^`]*, )?{option}[ `,]", section), (name, option)


def test_pages_from_the_code_are_no_files_of_the_repository() -> None:
    ignored = (ROOT / ".gitignore").read_text().splitlines()
    assert len(rendered_pages()) >= 4
    for page in rendered_pages():
        assert page.relative_to(ROOT).as_posix() in ignored
        assert page_text(page).startswith("# ")


def test_every_public_name_has_a_summary_of_one_sentence() -> None:
    rows = re.findall(r"^\| `(\w+)` \| (.*) \|$", name_page(), re.M)
    assert len(rows) > 120
    assert [name for name, summary in rows if not summary.endswith(".")] == []


def test_the_page_of_names_has_all_public_modules() -> None:
    assert set(NAMED_MODULES) == set(MODULES)


@pytest.mark.parametrize("framework", ["torch", "jax"])
def test_the_page_of_names_has_the_bridges_to_frameworks(
    framework: str,
) -> None:
    section = (
        name_page().split(f"## `cnpgen.interop.{framework}`\n")[1].split("\n## ")[0]
    )
    names = re.findall(r"^\| `(\w+)` \| .*\. \|$", section, re.M)
    assert {"torch": "TensorLoss", "jax": "plan_loss"}[framework] in names
    module = pytest.importorskip(f"cnpgen.interop.{framework}", exc_type=CnpgenError)
    assert names == sorted(getattr(module, "__all__", [f"to_{framework}"]))


def test_every_page_is_of_one_kind_and_in_the_index() -> None:
    index = (DOCS / "index.md").read_text(encoding="utf-8")
    pages = {path.relative_to(DOCS) for path in written_pages()} - {Path("index.md")}
    assert {page.parts[0] for page in pages} == set(KINDS), (
        "a page belongs to one of the folders"
    )
    assert all(len(page.parts) == 2 for page in pages)
    missing = [
        page.as_posix() for page in pages if f"]({page.as_posix()})" not in index
    ]
    assert missing == [], "link the page in docs/index.md"
    names = [page.stem for page in pages if page.parts[0] != "benchmarks"]
    assert len(names) == len(set(names)), "'cnpgen docs NAME' needs unique names"


def written_pages() -> list[Path]:
    """Return the pages that have a file in the repository and in the wheel: not those of examples."""
    examples = DOCS / "examples"
    return [
        path
        for path in DOCS.rglob("*.md")
        if path not in rendered_pages() and examples not in path.parents
    ]


def test_concepts_have_a_picture() -> None:
    for name in (
        "splines",
        "constraint-manifold",
        "certification",
        "verdict",
        "scenes",
    ):
        assert pictures(DOCS / "concepts" / f"{name}.md"), name


def test_every_picture_has_an_alternative_text() -> None:
    pages = [
        *ROOT.glob("*.md"),
        *(
            path
            for name in ("docs", "datasets", "problems", "pipelines")
            for path in (ROOT / name).rglob("*.md")
        ),
    ]
    texts = {(page.name, file): text for page in pages for text, file in pictures(page)}
    assert len(texts) > 15
    assert {
        key: text for key, text in texts.items() if len(text) < MIN_PICTURE_TEXT
    } == {}


def pictures(page: Path) -> list[tuple[str, str]]:
    """Return the alternative text and the file of each picture of a page."""
    text = page.read_text(encoding="utf-8")
    assert "<img" not in text, f"{page.name}: write pictures in Markdown"
    return re.findall(r"!\[([^\]]*)\]\(([^)\s]+)\)", text)


def test_the_pages_are_small_enough_for_the_wheel() -> None:
    assert sum(path.stat().st_size for path in written_pages()) <= MAX_BYTES


def test_help_texts_and_docstrings_name_pages_that_exist_and_no_files() -> None:
    pages = list_pages()
    for path in (ROOT / "cnpgen").rglob("*.py"):
        text = " ".join(path.read_text(encoding="utf-8").split())
        assert not re.search(r"docs/[\w/-]+\.md", text), (
            f"{path}: the wheel has no such file, name 'cnpgen docs PAGE'"
        )
        for name in re.findall(r"['`]cnpgen docs ([a-z][\w/-]*)['`]", text):
            assert name in pages, f"{path}: no page {name!r}"


@pytest.mark.parametrize(
    "page", sorted((DOCS / "tutorials").glob("*.md")), ids=lambda page: page.stem
)
def test_the_notebook_of_a_tutorial_has_every_block_as_a_cell(
    page: Path, tmp_path: Path
) -> None:
    pytest.importorskip("jupytext")
    script("notebooks").write_notebooks(tmp_path)
    notebook = json.loads((tmp_path / f"{page.stem}.ipynb").read_text(encoding="utf-8"))
    assert (notebook["nbformat"], notebook["nbformat_minor"]) == (4, 5)
    assert len({cell["id"] for cell in notebook["cells"]}) == len(notebook["cells"])
    runnable = [
        (marks, language, text) for marks, language, text in blocks(page) if language
    ]
    cells = [
        "".join(cell["source"])
        for cell in notebook["cells"]
        if cell["cell_type"] == "code"
    ]
    assert len(cells) == len(runnable) > 3
    for (marks, language, text), cell in zip(runnable, cells, strict=True):
        first, _, rest = cell.partition("\n")
        if "file" in marks:
            assert first == f"%%writefile {marks['file']}"
        elif language == "bash":
            assert first == "%%bash"
        else:
            rest = cell
        assert rest == text.strip("\n")
    prose = "\n".join(
        "".join(cell["source"])
        for cell in notebook["cells"]
        if cell["cell_type"] == "markdown"
    )
    headings = [
        line
        for line in page.read_text(encoding="utf-8").splitlines()
        if re.match(r"#+ [A-Z0-9]", line)
    ]
    assert [line for line in headings if line not in prose] == []


@pytest.mark.slow
def test_the_pictures_of_the_pages_are_drawn_from_computed_plans(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    imread = pytest.importorskip("matplotlib.image").imread
    pictures = script("pictures")
    monkeypatch.setattr(pictures, "FOLDER", tmp_path)
    pictures.main()
    drawn = {path.name for path in tmp_path.iterdir()}
    assert len(drawn) == 7
    text = "".join(page.read_text(encoding="utf-8") for page in written_pages())
    for name in drawn:
        assert f"../images/{name}" in text
        shown, now = (imread(folder / name) for folder in (DOCS / "images", tmp_path))
        assert shown.shape == now.shape, name
        difference = np.abs(shown - now).mean()
        assert difference < MAX_DIFFERENCE, f"{name}: run python docs/pictures.py"


def test_the_plan_format_lists_every_outcome_of_refining() -> None:
    page = (DOCS / "reference" / "plan-format.md").read_text(encoding="utf-8")
    table = page.split("| outcome | definition |")[1].split("\n\n")[0]
    assert re.findall(r"^\| (\d+) \|", table, re.MULTILINE) == [
        str(int(outcome)) for outcome in Outcome
    ]


def test_the_new_names_of_modules_in_the_change_log_exist() -> None:
    table = (
        (ROOT / "CHANGELOG.md")
        .read_text(encoding="utf-8")
        .split("| `benchmarks/loader_ways.py` |")[1]
        .split("\n\n")[0]
    )
    names = re.findall(r"\| `([\w/.-]+)` \|$", table, re.MULTILINE)
    assert len(names) > 100
    moved = moved_modules()
    assert len(moved) > 20
    assert all((ROOT / "cnpgen" / new).exists() for new in moved.values())
    present = [re.sub(r"^[\w/.]+", lambda m: moved_path(m[0], moved), n) for n in names]
    assert [
        name
        for name in present
        if not (ROOT / name).exists() and not (ROOT / "cnpgen" / name).exists()
    ] == []


def moved_modules() -> dict[str, str]:
    """Return the table of moved modules: old path below cnpgen/ -> new path."""
    text = (ROOT / "CHANGELOG.md").read_text(encoding="utf-8")
    table = text.split("| was in `cnpgen/` | is in `cnpgen/` |")[1].split("\n\n")[0]
    return dict(re.findall(r"\| `([\w/.-]+)` \| `([\w/.-]+)` \|", table))


def moved_path(path: str, moved: dict[str, str]) -> str:
    """Return the present path of a module or of a module in a moved folder."""
    for old, new in sorted(moved.items(), key=lambda item: -len(item[0])):
        if path == old or (old.endswith("/") and path.startswith(old)):
            return new + path.removeprefix(old)
    return path
