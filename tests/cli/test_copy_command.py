"""Copies of recipes: they load, differ from the originals in their names only, and can be edited."""

from pathlib import Path

import pytest

from cnpgen.cli.main import main
from cnpgen.make.recipe import load_dataset_recipe
from cnpgen.pipelines.pipeline import load_pipeline
from cnpgen.problems.problem import resolved
from cnpgen.problems.problem_file import load_problem
from cnpgen.problems.problem_record import record_problem
from tests.conftest import SHIPPED


@pytest.mark.parametrize("name", SHIPPED)
def test_a_copy_differs_from_its_original_in_names_only(name, tmp_path, capsys):
    folder = tmp_path / "mine"
    assert main(["copy", name, str(folder), "--kind", "dataset"]) == 0
    out, err = capsys.readouterr()
    assert out == f"{folder / 'dataset.toml'}\n"
    assert f"cnpgen make-dataset {folder / 'dataset.toml'}" in err
    copy, original = (
        load_dataset_recipe(folder / "dataset.toml"),
        load_dataset_recipe(name),
    )
    assert (copy.name, copy.pipeline.name, copy.pipeline.problem.name) == (
        "mine",
        "mine",
        "mine",
    )
    assert (copy.splits, copy.seed, copy.version) == (
        original.splits,
        original.seed,
        original.version,
    )
    assert resolved(copy.pipeline)["stage"] == resolved(original.pipeline)["stage"]
    copied, shipped = (
        record_problem(recipe.pipeline.problem) for recipe in (copy, original)
    )
    assert copied.comparable_sha256 == shipped.comparable_sha256
    text = (folder / "pipeline.toml").read_text(encoding="utf-8")
    assert text.count("#") == original.pipeline.path.read_text(encoding="utf-8").count(
        "#"
    )


def test_a_copy_can_be_edited(tmp_path):
    assert main(["copy", "airhockey", str(tmp_path / "slow")]) == 0
    file = tmp_path / "slow" / "problem.toml"
    original = load_problem("airhockey")
    text = file.read_text(encoding="utf-8")
    file.write_text(text.replace("title =", 'title = "slow" #'), encoding="utf-8")
    assert load_problem(file).title == "slow"
    assert (tmp_path / "slow" / original.robot.urdf).is_file()


def test_a_pipeline_and_a_recipe_of_a_package_are_copied(tmp_path):
    assert main(["copy", "panda-cup", str(tmp_path / "cup"), "--kind", "pipeline"]) == 0
    assert sorted(path.name for path in (tmp_path / "cup").iterdir()) == [
        "pipeline.toml",
        "problem.toml",
    ]
    assert load_pipeline(tmp_path / "cup" / "pipeline.toml").name == "cup"


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["airhokey", "x"], "did you mean 'airhockey'?"),
        (
            ["airhockey", "My Folder"],
            "DIR must be lower-case letters, digits and hyphens",
        ),
        (["some/problem.toml", "x"], "expected the name of a shipped recipe"),
    ],
)
def test_mistakes_are_one_line_and_write_nothing(
    words, message, tmp_path, monkeypatch, capsys
):
    monkeypatch.chdir(tmp_path)
    assert main(["copy", *words]) == 2
    assert message in capsys.readouterr().err
    assert list(tmp_path.iterdir()) == []


def test_existing_files_are_replaced_only_with_force(tmp_path: Path, capsys):
    words = ["copy", "airhockey", str(tmp_path / "mine")]
    assert main(words) == 0
    (tmp_path / "mine" / "problem.toml").write_text("mine")
    assert main(words) == 2
    assert (
        "iiwa14_striker.urdf exist already: --force" in capsys.readouterr().err
    )  # two files
    assert (tmp_path / "mine" / "problem.toml").read_text() == "mine"
    assert main([*words, "--force"]) == 0
    assert load_problem(tmp_path / "mine" / "problem.toml").name == "mine"
