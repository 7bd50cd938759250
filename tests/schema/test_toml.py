"""Recipe files of strangers: what takes long to read or long to tell is refused, or told in short."""

import os
import time
from pathlib import Path

import pytest

from cnpgen.errors import RecipeError
from cnpgen.make.recipe import load_dataset_recipe
from cnpgen.schema.toml import MAX_KEY_PARTS, MAX_RECIPE_BYTES, kind_of_file, read_table
from tests.refusals import is_refused


def errors_of(path: Path) -> list[str]:
    found: list[str] = []
    assert read_table(path, ("dataset",), found) is None
    return found


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("name = 1\n" + "a." * 50_000 + "b = 1", "line 2: a key has more than 16 parts"),
        ('"a" . ' * MAX_KEY_PARTS + "b = 1", "line 1: a key has more than 16 parts"),
        ("[" + "a." * 2_000 + "b]", "line 1: a key has more than 16 parts"),
        ("a = {" + "b." * 40 + "c = 1}", "line 1: a key has more than 16 parts"),
        ("a = " + "[" * 5_000, "line 1: not valid TOML"),
        ("a" * (MAX_RECIPE_BYTES + 1), "has 262,145 bytes, expected a recipe of at most 262,144"),
        ("a" * 100_000 + "=" + "b" * 100_000, "not valid TOML"),
        ("a = " + "9" * 5_000, "not valid TOML"),
    ],
)  # fmt: skip
def test_a_file_that_would_take_long_is_refused_at_once(
    tmp_path: Path, text: str, message: str
) -> None:
    path = tmp_path / "recipe.toml"
    path.write_text(text)
    begun = time.process_time()
    (error,) = errors_of(path)
    assert error.startswith(f"{path}: ")
    assert message in error
    assert len(error) < 400
    assert kind_of_file(path) == "dataset"
    assert time.process_time() - begun < 2


def test_texts_with_many_points_are_texts(tmp_path: Path) -> None:
    path = tmp_path / "recipe.toml"
    path.write_text(f'title = "Well {"." * 100} {"a. " * 10}"\nx.y.z = 1\n')
    assert read_table(path, ("dataset",), []) is not None


def test_many_unknown_keys_are_counted(tmp_path: Path) -> None:
    path = tmp_path / "recipe.toml"
    path.write_text(
        "pipeline = 'airhockey-hit'\n" + "".join(f"key{i} = 1\n" for i in range(10_000))
    )
    with pytest.raises(RecipeError) as caught:
        load_dataset_recipe(path)
    assert f"{path}: and 9,980 more unknown keys" in caught.value.errors
    assert len(caught.value.errors) < 30


@pytest.mark.parametrize(
    ("text", "message"),
    [
        (f"name = '{'a' * 5_000}'", r"does not match \^\[a-z0-9\]"),
        (f"name = 'a'\npipeline = '{'a' * 5_000}'", "unknown pipeline 'aaa"),
        (f"name = 'a'\npipeline = '{'a' * 5_000}.toml'", "no such file: .*aaa"),
        (f"name = 'a'\nversion = '{'1' * 5_000}.0.0'", "does not match"),
        (f"name = 'a'\nsplits = {{{'a' * 5_000} = 1}}", "does not match"),
        ('name = "a"\npipeline = "a\\u0000b.toml"', "no such file"),
    ],
)
def test_long_names_are_mistakes_that_are_told_in_short(
    tmp_path: Path, text: str, message: str
) -> None:
    path = tmp_path / "recipe.toml"
    path.write_text(text)
    with pytest.raises(RecipeError, match=message) as caught:
        load_dataset_recipe(path)
    assert all(len(error) < 600 for error in caught.value.errors)


def test_a_name_from_the_shell_may_be_of_any_length() -> None:
    with is_refused(RecipeError, argument="name_or_path"):
        load_dataset_recipe("a" * 5_000)


@pytest.mark.parametrize("what", ["device", "pipe"])
def test_what_is_no_file_is_not_read(tmp_path: Path, what: str) -> None:
    path = tmp_path / "recipe.toml"
    if what == "pipe":
        os.mkfifo(path)
    else:
        path.symlink_to("/dev/zero")
    assert errors_of(path) == [f"{path}: not a file"]
    with is_refused(RecipeError, argument="name_or_path"):
        load_dataset_recipe(path)
