"""Paths that are not there, or not what a command is about: one line that says what was expected, one exit code."""

import shutil
from collections.abc import Callable
from pathlib import Path

import pytest

from cnpgen.cli.main import main

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
MODELS = {"plan": ("plan", "problems.h5", "--model", "{}", "-o", "out.h5")}
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
    assert said(MODELS["plan"], "model.h5") == (2, "model.h5 is a folder, expected a model")
