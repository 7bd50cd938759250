"""Paths that are not there, or not what a command is about: one line that says what was expected, one exit code."""

import argparse
import shutil
from collections.abc import Callable
from pathlib import Path

import h5py
import pytest

from cnpgen.cli.main import build_parser, main
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
MODELS = {
    "plan": ("plan", "airhockey-hit", "--model", "{}", "-o", "out.h5", "--n", "1")
}
RECIPES = {
    "make-dataset": ("make-dataset", "{}.toml"),
    "show": ("show", "{}.toml"),
    "solve": ("solve", "{}.toml", "--n", "1"),
}


@pytest.fixture
def said(
    capsys: pytest.CaptureFixture[str], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> Said:
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


@pytest.mark.parametrize(
    "words", [*FOLDERS.values(), *FILES.values(), *MODELS.values(), *RECIPES.values()]
)
def test_a_path_that_is_not_there_is_a_wrong_argument(
    said: Said, words: tuple[str, ...], tmp_path: Path
) -> None:
    code, line = said(words, "./nowhere")
    assert code == 2
    assert "nowhere" in line
    assert "not there, expected" in line or "no such file" in line
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("words", FOLDERS.values(), ids=FOLDERS)
def test_a_file_is_not_the_folder_of_a_dataset(
    said: Said, words: tuple[str, ...], tmp_path: Path
) -> None:
    (tmp_path / "mine.h5").write_text("mine")
    assert said(words, "mine.h5") == (
        2,
        "mine.h5 is a file, expected the folder of a dataset",
    )


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
    assert said(MODELS["plan"], "model.h5") == (
        2,
        "model.h5 is a folder, expected a model of cnpgen",
    )


@pytest.mark.parametrize("words", [("show", "{}"), ("make-dataset", "{}")])
def test_a_file_of_plans_is_not_a_recipe(
    said: Said, words: tuple[str, ...], tmp_path: Path, hit: Path
) -> None:
    shutil.copy(hit, tmp_path / "planned.h5")
    line = "planned.h5 is an HDF5 file, a file of plans, expected a recipe: 'cnpgen evaluate planned.h5' judges them"
    assert said(words, "planned.h5") == (2, line)
    h5py.File(tmp_path / "other.h5", "w").close()
    assert said(words, "other.h5")[1].startswith(
        "other.h5 is an HDF5 file, expected a recipe: 'cnpgen inspect'"
    )


@pytest.mark.parametrize("words", [("make-dataset", "{}"), ("solve", "{}", "--n", "1")])
def test_a_model_is_not_a_recipe(
    said: Said, words: tuple[str, ...], tmp_path: Path
) -> None:
    shutil.copy(shipped_models()["airhockey-hit"], tmp_path / "model.h5")
    assert said(words, "model.h5")[1].startswith(
        "model.h5 is an HDF5 file, a model of cnpgen, expected a recipe"
    )


@pytest.mark.parametrize(
    ("words", "hint"),
    [(("show", "{}"), "inspect hits"), (("make-dataset", "{}"), "--out hits")],
)
def test_the_folder_of_a_dataset_is_not_a_recipe(
    said: Said,
    words: tuple[str, ...],
    hint: str,
    tmp_path: Path,
    tiny: Callable[[str], Path],
) -> None:
    shutil.copytree(tiny("airhockey-hit"), tmp_path / "hits")
    code, line = said(words, "hits")
    assert code == 2
    assert line.startswith(
        "hits is the folder of a dataset, expected a recipe: 'cnpgen "
    )
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
        (
            "./hist",
            "./hist is neither a folder nor a file, dataset or pipeline (did you mean 'hits'?)",
        ),
        (
            "airhockey-hot",
            "airhockey-hot is neither a folder nor a file, dataset or pipeline (did you mean 'airhockey-hit'?)",
        ),
        ("hits.tmol/mine.toml", "no such file: hits.tmol/mine.toml"),
        (
            "airhockey-hit",
            "--n is required: the number of fresh problems of the recipe airhockey-hit",
        ),
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
    assert said(FILES["evaluate"], "mine.h5") == (
        2,
        "mine.h5 is a model of cnpgen, expected a file of plans",
    )


def test_force_does_not_replace_a_model_by_plans(
    said: Said, tmp_path: Path, hit: Path
) -> None:
    model = shipped_models()["airhockey-hit"]
    shutil.copy(model, tmp_path / "mine.h5")
    code, line = said(("refine", "{}", "-o", "mine.h5", "--force", "--quiet"), str(hit))
    assert (code, line.partition(":")[0]) == (
        2,
        "mine.h5 is a model of cnpgen, not one of plans",
    )
    assert (tmp_path / "mine.h5").read_bytes() == model.read_bytes()


def test_solve_does_not_take_rows_that_were_changed(
    said: Said, tmp_path: Path, tiny: Callable[[str], Path]
) -> None:
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
    "plan": (
        "plan",
        "{}",
        "--model",
        "airhockey-hit",
        "--split",
        "val",
        "-o",
        "out.h5",
    ),
}


@pytest.mark.parametrize("words", SPLITS.values(), ids=SPLITS)
def test_a_split_that_is_not_there_is_answered_with_those_that_are(
    said: Said, words: tuple[str, ...], tiny: Callable[[str], Path]
) -> None:
    folder = tiny("airhockey-hit")
    text = "has no split 'val' (did you mean 'validation'?), only train, validation"
    assert said(words, str(folder)) == (2, f"{folder} {text}")


DATASETS = {  # commands that take the folder of a dataset, and need an option
    **FOLDERS,
    "extend": ("extend", "{}", "--n", "1000"),
    "merge": ("merge", "{}", "-o", "out"),
    "publish": ("publish", "{}", "--to", "me/mine", "--dry-run"),
    "solve": ("solve", "{}", "--n", "1", "-o", "out.h5"),
    "plan": ("plan", "{}", "--model", "airhockey-hit", "-o", "out.h5"),
    "view": ("view", "{}"),
}
HDF5 = {  # commands that take an HDF5 file
    **FILES,
    **MODELS,
    "simulate": ("simulate", "{}"),
    "view": ("view", "{}"),
    "solve": ("solve", "{}", "--problem", "airhockey"),
    "plan": ("plan", "{}", "--model", "airhockey-hit", "-o", "out.h5"),
}
TABLES = {  # commands that take a recipe or a table
    "evaluate": ("evaluate", "{}", "--problem", "airhockey"),
    "evaluate --problem": ("evaluate", "plans.h5", "--problem", "{}"),
    "import": ("import", "{}", "--problem", "airhockey", "-o", "out.h5"),
    "complete": ("complete", "airhockey-hit", "{}", "-o", "out.h5"),
    "show": ("show", "{}"),
    "make-dataset": ("make-dataset", "{}"),
    "benchmark": ("benchmark", "{}"),
}


@pytest.mark.parametrize(
    "words", [*DATASETS.values(), *HDF5.values(), *TABLES.values()]
)
def test_a_path_without_permission_to_read_is_named_as_that(
    said: Said, words: tuple[str, ...], tmp_path: Path, file_permissions: None
) -> None:
    path = tmp_path / "private.csv"
    path.mkdir() if words in DATASETS.values() else path.touch()
    path.chmod(0)
    line = "cannot read private.csv: Permission denied; its owner can permit reading it (chmod)"
    assert said(words, "private.csv") == (3, line)
    path.chmod(0o700)


@pytest.mark.parametrize("words", HDF5.values(), ids=HDF5)
def test_a_text_file_is_a_wrong_argument(
    said: Said, words: tuple[str, ...], tmp_path: Path
) -> None:
    (tmp_path / "README.md").write_text("# Hits\n")
    code, line = said(words, "README.md")
    assert code == 2
    assert line.startswith("README.md is a text file, expected ")


@pytest.mark.parametrize("words", DATASETS.values(), ids=DATASETS)
def test_a_folder_of_recipes_is_no_dataset_yet(
    said: Said, words: tuple[str, ...], tmp_path: Path
) -> None:
    (tmp_path / "mine").mkdir()
    (tmp_path / "mine" / "dataset.toml").touch()
    line = "mine is not a dataset of cnpgen: it has no specification.json: 'cnpgen make-dataset mine/dataset.toml'"
    code, found = said(words, "mine")
    assert (code, found.startswith(line)) == (2, True), found


@pytest.mark.parametrize(
    ("words", "file"),
    [
        (("make-dataset", "{}"), "dataset"),
        (("show", "{}"), "dataset"),
        (("benchmark", "{}"), "dataset"),
        (("complete", "{}", "tasks.csv", "-o", "out.h5"), "dataset"),
        (("evaluate", "plans.h5", "--problem", "{}"), "problem"),
    ],
)
def test_a_folder_of_recipes_is_answered_with_its_file(
    said: Said, words: tuple[str, ...], file: str, tmp_path: Path
) -> None:
    (tmp_path / "mine").mkdir()
    (tmp_path / "tasks.csv").touch()
    for name in ("dataset", "pipeline", "problem"):
        (tmp_path / "mine" / f"{name}.toml").touch()
    code, line = said(words, "mine")
    assert code == 2
    assert f"(did you mean 'mine/{file}.toml'?)" in line


@pytest.mark.parametrize(
    ("words", "line"),
    [
        (
            ("plan", "airhokey"),
            "airhokey is neither a folder nor a file, dataset or pipeline (did you mean 'airhockey-",
        ),
        (
            ("plan", "airhockey-hit", "--model", "airhokey-hit"),
            "unknown model 'airhokey-hit' (did you mean 'airhockey",
        ),
        (
            ("complete", "airhokey"),
            "airhokey is neither a folder nor a file, problem, pipeline or dataset",
        ),
        (
            ("copy", "airhokey"),
            "airhokey is neither a folder nor a file, problem, pipeline or dataset",
        ),
        (
            ("make-scenes", "tabeltop"),
            "unknown family 'tabeltop' (did you mean 'tabletop'?)",
        ),
        (
            ("make-scenes", "tabletop", "--robot", "pandda"),
            "unknown problem, pipeline or dataset 'pandda'",
        ),
        (
            ("benchmark", "hits-18", "--plant", "delayed"),
            "unknown suite, dataset or pipeline 'hits-18'",
        ),
        (
            ("train", "hist"),
            "hist is not there, expected a file or a folder (did you mean 'hits'?)",
        ),
        (
            ("train", "airhockey-hit"),
            "airhockey-hit is a recipe, expected a path: 'cnpgen make-dataset airhockey-hit'",
        ),
        (
            ("extend", "hist"),
            "hist is not there, expected the folder of a dataset (did you mean 'hits'?)",
        ),
        (
            ("merge", "hist"),
            "hist is not there, expected the folder of a dataset (did you mean 'hits'?)",
        ),
        (
            ("publish", "hist"),
            "hist is not there, expected the folder of a dataset (did you mean 'hits'?)",
        ),
        (("export", "nowhere.h5"), "nowhere.h5 is not there"),
        (("import", "nowhere.csv"), "nowhere.csv is not there"),
        (
            ("import", ".", "--problem", "airhokey"),
            "unknown problem, pipeline or dataset 'airhokey'",
        ),
        (("init", "My-Arm"), "NAME must be lower-case letters"),
        (("evaluate", ""), "the argument after 'evaluate' is empty"),
        (("refine", "plans.h5", "--out="), "the argument after '--out=' is empty"),
    ],
)
def test_a_wrong_name_is_named_before_options_that_are_missing(
    said: Said, words: tuple[str, ...], line: str, tmp_path: Path
) -> None:
    (tmp_path / "hits").mkdir()
    code, found = said(words, "")
    assert (code, found.startswith(line)) == (2, True), found


OUTPUTS = {  # command and option -> words; the option is the last one
    ("evaluate", "plot"): ("evaluate", "{plans}", "--plot", "{out}.png"),
    ("inspect", "plot"): ("inspect", "{hits}", "--plot", "{out}.png"),
    ("simulate", "image"): ("simulate", "{plans}", "--image", "{out}.png"),
    ("simulate", "video"): ("simulate", "{plans}", "--video", "{out}.mp4"),
    ("view", "out"): ("view", "{plans}", "-o", "{out}.html"),
    ("plan", "out"): ("plan", "{hits}", "--model", "airhockey-hit", "-o", "{out}.h5"),
    ("solve", "out"): ("solve", "{hits}", "-o", "{out}.h5"),
    ("refine", "out"): ("refine", "{plans}", "--quiet", "-o", "{out}.h5"),
    ("train", "out"): ("train", "{hits}", "-o", "{out}.h5"),
    ("complete", "out"): ("complete", "airhockey-replan", "{plans}", "-o", "{out}.h5"),
    ("export", "out"): ("export", "{plans}", "--to", "npz", "-o", "{out}.npz"),
    ("import", "out"): (
        "import",
        "{table}",
        "--problem",
        "airhockey",
        "-o",
        "{out}.h5",
    ),
    ("make-scenes", "out"): (
        "make-scenes",
        "tabletop",
        "--robot",
        "airhockey",
        "--n",
        "1",
        "-o",
        "{out}.h5",
    ),
    ("make-dataset", "out"): ("make-dataset", "airhockey-hit", "-o", "{out}"),
    ("merge", "out"): ("merge", "{hits}", "-o", "{out}"),
    ("benchmark", "out"): (
        "benchmark",
        "hits-81",
        "--planners",
        "solve",
        "-o",
        "{out}",
    ),
    ("publish", "out"): (
        "publish",
        "{hits}",
        "--to",
        "me/mine",
        "--dry-run",
        "-o",
        "{out}",
    ),
    ("copy", "folder"): ("copy", "airhockey-hit", "{out}"),
    ("init", "name"): ("init", "{out}", "--planner"),
}


def test_every_option_that_names_an_output_is_tested() -> None:
    (commands,) = (
        action
        for action in build_parser()._actions
        if isinstance(action, argparse._SubParsersAction)
    )
    outputs = {
        (name, action.dest)
        for name, command in commands.choices.items()
        for action in command._actions
        if action.dest in {"out", "plot", "image", "video"} and action.nargs != 0
    }
    assert outputs == {key for key in OUTPUTS if key[1] not in {"folder", "name"}}


@pytest.mark.parametrize("words", OUTPUTS.values(), ids=map("-".join, OUTPUTS))
def test_an_output_that_cannot_be_written_is_named_before_anything_is_computed(
    said: Said,
    words: tuple[str, ...],
    tmp_path: Path,
    hit: Path,
    tiny: Callable[[str], Path],
    file_permissions: None,
) -> None:
    (tmp_path / "table.csv").touch()
    (tmp_path / "ro").mkdir(0o555)
    inputs = {
        "plans": hit,
        "hits": tiny("airhockey-hit"),
        "table": "table.csv",
        "out": "ro/mine",
    }
    out = words[-1 if words[0] != "init" else 1].format(**inputs)
    line = (
        f"cannot write {out}: Permission denied; choose a folder that you may write to"
    )
    assert said(tuple(word.format(**inputs) for word in words), "") == (3, line)


def test_files_of_recipes_are_not_written_into_a_file(
    said: Said, tmp_path: Path
) -> None:
    (tmp_path / "mine").touch()
    code, line = said(("copy", "airhockey-hit", "mine/hits"), "")
    assert code == 3
    assert line.startswith(
        "cannot write mine/hits: Not a directory; a file is where a folder should be"
    )


def test_extending_needs_a_folder_that_can_be_written(
    said: Said, tmp_path: Path, tiny: Callable[[str], Path], file_permissions: None
) -> None:
    shutil.copytree(tiny("airhockey-hit"), tmp_path / "hits")
    (tmp_path / "hits").chmod(0o555)
    line = "cannot write hits: Permission denied; choose a folder that you may write to"
    assert said(("extend", "hits", "--n", "1000"), "") == (3, line)


def test_plans_are_not_imported_as_trajectories(said: Said, hit: Path) -> None:
    line = f"{hit} is a file of plans already: 'cnpgen refine' optimizes them"
    assert said(("import", str(hit), "--problem", "airhockey", "-o", "out.h5"), "") == (
        2,
        line,
    )


@pytest.mark.parametrize(
    "option", [("refine", "--stay-within"), ("evaluate", "--tracking-error")]
)
def test_large_angles_need_a_unit(said: Said, option: tuple[str, str]) -> None:
    code, line = said((option[0], "plans.h5", option[1], "2"), "")
    assert code == 2
    assert "expected at most 1 rad or m, such as 2deg; got '2'" in line
