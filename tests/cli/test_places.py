"""Paths that are not there, or not what a command is about: one line that says what was expected, one exit code."""

import shutil
from collections.abc import Callable
from pathlib import Path

import h5py
import pytest

from cnpgen.cli.main import main
from cnpgen.planner.model_file import shipped_models
from cnpgen.plans import save_plans
from tests.examples.plan_files import plans_of
from tests.examples.plans import load

Said = Callable[..., tuple[int, str]]

FOLDERS = {  # commands that take the folder of a dataset
    "inspect": ("inspect", "{}"),
    "validate": ("validate", "{}"),
    "validate --deep": ("validate", "{}", "--deep"),
    "train": ("train", "{}", "-o", "model.h5", "--steps", "1"),
}
FILES = {  # commands that take a file of plans
    "evaluate": ("evaluate", "{}"),
    "refine": ("refine", "{}", "-o", "out.h5"),
    "export": ("export", "{}", "--to", "npz"),
}
MODELS = {"plan": ("plan", "airhockey-hit", "--model", "{}", "-o", "out.h5", "--n", "1")}
RECIPES = {
    "make-dataset": ("make-dataset", "{}.toml"),
    "show": ("show", "{}.toml"),
    "solve": ("solve", "{}.toml", "--n", "1"),
}


@pytest.fixture
def said(capsys: pytest.CaptureFixture[str], tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Said:
    """Run a command about a path in an empty folder; return its exit code and the only line that it prints."""
    monkeypatch.chdir(tmp_path)

    def call(words: tuple[str, ...], path: str) -> tuple[int, str]:
        code = main([word.format(path) for word in words])
        out, err = capsys.readouterr()
        assert out == ""
        (line,) = err.splitlines()
        assert line.startswith("cnpgen: error: ")
        return code, line.removeprefix("cnpgen: error: ")

    return call


@pytest.mark.parametrize("words", [*FOLDERS.values(), *FILES.values(), *MODELS.values(), *RECIPES.values()])
def test_a_path_that_is_not_there_is_a_wrong_argument(said: Said, words: tuple[str, ...], tmp_path: Path) -> None:
    code, line = said(words, "./nowhere")
    assert code == 2
    assert "nowhere" in line
    assert "not there, expected" in line or "no such file" in line
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("words", FOLDERS.values(), ids=FOLDERS)
def test_a_file_is_not_the_folder_of_a_dataset(said: Said, words: tuple[str, ...], tmp_path: Path) -> None:
    (tmp_path / "mine.h5").write_text("mine")
    assert said(words, "mine.h5") == (2, "mine.h5 is a file, expected the folder of a dataset")


@pytest.mark.parametrize("words", FILES.values(), ids=FILES)
def test_a_folder_is_not_a_file_of_plans(
    said: Said, words: tuple[str, ...], tmp_path: Path, tiny: Callable[[str], Path]
) -> None:
    (tmp_path / "mine").mkdir()
    assert said(words, "mine") == (2, "mine is a folder, expected a file of plans")
    shutil.copytree(tiny("airhockey-hit"), tmp_path / "hits")
    expected = "hits is the folder of a dataset, expected a file of plans: 'cnpgen solve' and 'cnpgen plan' make plans"
    assert said(words, "hits") == (2, f"{expected} for its rows")


def test_a_folder_is_not_a_model(said: Said, tmp_path: Path) -> None:
    (tmp_path / "model.h5").mkdir()
    assert said(MODELS["plan"], "model.h5") == (2, "model.h5 is a folder, expected a model of cnpgen")


@pytest.mark.parametrize("words", [("show", "{}"), ("make-dataset", "{}")])
def test_a_file_of_plans_is_not_a_recipe(said: Said, words: tuple[str, ...], tmp_path: Path, hit: Path) -> None:
    shutil.copy(hit, tmp_path / "planned.h5")
    line = "planned.h5 is an HDF5 file, a file of plans, expected a recipe: 'cnpgen evaluate planned.h5' judges them"
    assert said(words, "planned.h5") == (2, line)
    h5py.File(tmp_path / "other.h5", "w").close()
    assert said(words, "other.h5")[1].startswith("other.h5 is an HDF5 file, expected a recipe: 'cnpgen inspect'")


@pytest.mark.parametrize("words", [("show", "{}"), ("make-dataset", "{}"), ("solve", "{}", "--n", "1")])
def test_a_model_is_not_a_recipe(said: Said, words: tuple[str, ...], tmp_path: Path) -> None:
    shutil.copy(shipped_models()["airhockey-hit"], tmp_path / "model.h5")
    assert said(words, "model.h5")[1].startswith("model.h5 is an HDF5 file, a model of cnpgen, expected a recipe")


@pytest.mark.parametrize(("words", "hint"), [(("show", "{}"), "inspect hits"), (("make-dataset", "{}"), "--out hits")])
def test_the_folder_of_a_dataset_is_not_a_recipe(
    said: Said, words: tuple[str, ...], hint: str, tmp_path: Path, tiny: Callable[[str], Path]
) -> None:
    shutil.copytree(tiny("airhockey-hit"), tmp_path / "hits")
    code, line = said(words, "hits")
    assert code == 2
    assert line.startswith("hits is the folder of a dataset, expected a recipe: 'cnpgen ")
    assert hint in line


def test_a_folder_that_is_called_like_a_recipe_does_not_hide_it(
    tmp_path: Path, tiny: Callable[[str], Path], monkeypatch: pytest.MonkeyPatch
) -> None:
    shutil.copytree(tiny("airhockey-hit"), tmp_path / "airhockey-hit")
    monkeypatch.chdir(tmp_path)
    assert main(["show", "airhockey-hit"]) == 0


@pytest.mark.parametrize(
    ("what", "line"),
    [
        (
            "hist",
            "hist is neither a folder nor a file, dataset or pipeline (did you mean 'hits'?): 'cnpgen list' names",
        ),
        ("./hist", "./hist is neither a folder nor a file, dataset or pipeline (did you mean 'hits'?)"),
        (
            "airhockey-hot",
            "airhockey-hot is neither a folder nor a file, dataset or pipeline (did you mean 'airhockey-hit'?)",
        ),
        ("hits.tmol/mine.toml", "no such file: hits.tmol/mine.toml"),
        ("airhockey-hit", "--n is required: the number of fresh problems of the recipe airhockey-hit"),
    ],
)
def test_what_cannot_be_solved_because_it_is_not_there_is_said_first(
    said: Said, what: str, line: str, tmp_path: Path, tiny: Callable[[str], Path]
) -> None:
    shutil.copytree(tiny("airhockey-hit"), tmp_path / "hits")
    code, found = said(("solve", "{}"), what)
    assert code == 2
    assert found.startswith(line)


def test_a_model_is_not_a_file_of_plans(said: Said, tmp_path: Path) -> None:
    shutil.copy(shipped_models()["airhockey-hit"], tmp_path / "mine.h5")
    assert said(FILES["evaluate"], "mine.h5") == (2, "mine.h5 is a model of cnpgen, expected a file of plans")


def test_force_does_not_replace_a_model_by_plans(said: Said, tmp_path: Path, hit: Path) -> None:
    model = shipped_models()["airhockey-hit"]
    shutil.copy(model, tmp_path / "mine.h5")
    code, line = said(("refine", "{}", "-o", "mine.h5", "--force", "--quiet"), str(hit))
    assert (code, line.partition(":")[0]) == (2, "mine.h5 is a model of cnpgen, not one of plans")
    assert (tmp_path / "mine.h5").read_bytes() == model.read_bytes()


def test_solve_does_not_take_rows_that_were_changed(said: Said, tmp_path: Path, tiny: Callable[[str], Path]) -> None:
    shutil.copytree(tiny("airhockey-hit"), tmp_path / "hits")
    (path,) = (tmp_path / "hits" / "validation").glob("*.h5")
    with h5py.File(path) as file:
        offset = file["goal_q"].id.get_offset()
    content = bytearray(path.read_bytes())
    content[offset + 48 : offset + 56] = bytes(8)
    path.write_bytes(content)
    line = f"{path.relative_to(tmp_path)} is damaged: its sha256 is not the recorded one; run make_dataset"
    for words in (
        ("solve", "{}", "--n", "1"),
        ("plan", "{}", "--model", "airhockey-hit", "--n", "1", "-o", "out.h5"),
    ):
        code, found = said(words, "hits")
        assert (code, found.startswith(line)) == (1, True), found
    assert sorted(each.name for each in tmp_path.iterdir()) == ["hits"]


@pytest.fixture
def hit(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A file of plans."""
    path = tmp_path_factory.mktemp("plans") / "hit.h5"
    save_plans(path, plans_of(load("hit")))
    return path


SPLITS = {
    "solve": ("solve", "{}", "--split", "val", "-o", "out.h5"),
    "plan": ("plan", "{}", "--model", "airhockey-hit", "--split", "val", "-o", "out.h5"),
}


@pytest.mark.parametrize("words", SPLITS.values(), ids=SPLITS)
def test_a_split_that_is_not_there_is_answered_with_those_that_are(
    said: Said, words: tuple[str, ...], tiny: Callable[[str], Path]
) -> None:
    folder = tiny("airhockey-hit")
    text = "has no split 'val' (did you mean 'validation'?), only train, validation"
    assert said(words, str(folder)) == (2, f"{folder} {text}")
