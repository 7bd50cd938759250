"""Arguments of make_dataset are checked before any file changes."""

from dataclasses import replace
from pathlib import Path
from typing import Any
from unittest.mock import ANY

import numpy as np
import pytest

from cnpgen.errors import RecipeError, UsageError
from cnpgen.make.make_dataset import make_dataset
from cnpgen.make.recipe import DatasetRecipe, as_dataset_recipe
from cnpgen.make.resolve_spec import resolve
from cnpgen.pipelines.pipeline import load_pipeline
from cnpgen.schema.arguments import flag, integer, number, numbers
from cnpgen.store.workspace import find_workspace
from cnpgen.validate.validate_dataset import validate_dataset
from tests.conftest import tiny_recipe
from tests.examples.tiny_datasets import make_tiny
from tests.refusals import is_refused


@pytest.mark.parametrize("value", [3, np.int64(3), np.uint8(3)])
def test_integers_of_numpy_are_integers(value: Any) -> None:
    found = integer("n", value, least=3, most=3)
    assert (found, type(found)) == (3, int)


@pytest.mark.parametrize("value", [2, 8, 3.0, "3", None, True, [3]])
def test_values_that_are_no_integers_or_outside_their_bounds_are_refused(
    value: object,
) -> None:
    with is_refused(UsageError, argument="n"):
        integer("n", value, least=3, most=7)


@pytest.mark.parametrize("value", [np.bool_(True), np.float64(3)])
def test_other_numbers_of_numpy_are_no_integers(value: object) -> None:
    # Their representation depends on the version of NumPy.
    with pytest.raises(UsageError, match=r"^n must be an integer from 3 to 7, got "):
        integer("n", value, least=3, most=7)


@pytest.mark.parametrize("value", [0.5, np.float32(0.5), np.array(0.5)])
def test_numbers_of_numpy_are_numbers(value: Any) -> None:
    found = number("x", value)
    assert (found, type(found)) == (0.5, float)


@pytest.mark.parametrize(
    "value",
    ["0.5", None, True, np.nan, np.inf, 1j, [0.5], np.array([0.5])],
)
def test_what_is_no_finite_number_is_refused(value: object) -> None:
    with is_refused(UsageError, argument="x"):
        number("x", value)


@pytest.mark.parametrize(
    "values",
    [[1, 2.5], (1, 2.5), np.array([1, 2.5], "f4"), [True, 2.5], np.array([1.0, 2.5])],
)
def test_arrays_of_numbers_are_floats_of_the_type_that_was_asked_for(
    values: Any,
) -> None:
    for dtype in ("float64", "float32"):
        found = numbers("x", values, dtype)
        assert found.dtype == dtype
        assert found[1] == 2.5
    assert not np.isfinite(numbers("x", [np.nan, np.inf])).any()


@pytest.mark.parametrize(
    ("values", "why"),
    [
        ([[1.0], [1.0, 2.0]], "got list: its rows have different lengths"),
        (["1", "2"], "got list: <U1 is no real type"),
        ("fast", "got str"),
        ([1j], "got list: complex128 is no real type"),
        (
            np.array(["2026-01-01"], "M8[D]"),
            r"got ndarray: datetime64\[D\] is no real type",
        ),
        ([object()], "got list: .*object"),
    ],
)
def test_what_is_no_array_of_numbers_is_refused_with_what_it_is(
    values: Any, why: str
) -> None:
    with pytest.raises(UsageError, match=f"^x must be an array of numbers, {why}"):
        numbers("x", values)


class Tensor:
    """Imitation of a tensor with a gradient: NumPy cannot convert it until it is detached."""

    def __array__(self, *_: Any, **__: Any) -> np.ndarray:
        raise RuntimeError("it requires grad")

    def detach(self) -> np.ndarray:
        return np.array([1.0, 2.0])


def test_a_gradient_is_left_behind_unless_it_must_not_be_lost() -> None:
    assert numbers("x", Tensor()).tolist() == [1.0, 2.0]
    with is_refused(UsageError, argument="x"):
        numbers("x", Tensor(), differentiable=True)


def test_yes_and_no_are_booleans_and_nothing_else() -> None:
    assert flag("on", True) is flag("on", np.bool_(True)) is True
    for value in (1, "no", None, [True]):
        with is_refused(UsageError, argument="on"):
            flag("on", value)


WRONG: dict[str, list[Any]] = {
    "n": [50.0, "50", True],
    "seed": [1.5, "7", False, 2**63],
    "shard_size": [10.5, "250"],
    "workers": [1.5, "2"],
    "part": [3, ("0", "2"), (0, 1, 2), (0.0, 2.0)],
    "dtype": ["float16", ["float64"], None],
    "backend": [3],
}


@pytest.mark.parametrize(
    ("name", "value"),
    [(name, value) for name, values in WRONG.items() for value in values],
)
def test_a_wrong_type_is_a_usage_error_that_names_the_argument_and_touches_nothing(
    tmp_path: Path, name: str, value: object
) -> None:
    with is_refused(UsageError, argument=ANY):
        make_tiny(tmp_path / "out", **{name: value})
    assert not list(tmp_path.iterdir())


def test_whole_numbers_of_numpy_give_the_specification_of_python_integers(
    tmp_path: Path,
) -> None:
    recipe, place = tiny_recipe("airhockey-hit"), find_workspace(tmp_path)
    jobs = [
        resolve(recipe, place, n=kind(50), seed=kind(3), shard_size=kind(20))
        for kind in (int, np.int64)
    ]
    assert jobs[0].spec.fingerprint == jobs[1].spec.fingerprint


@pytest.mark.parametrize("out", [3, b"folder", "", "  "])
def test_what_names_no_folder_is_refused(out: Any) -> None:
    with is_refused(UsageError, argument="out"):
        make_dataset(tiny_recipe("airhockey-hit"), out)


@pytest.mark.parametrize(
    "recipe", [None, 7, b"airhockey-hit", {"name": "airhockey-hit"}]
)
def test_what_is_no_recipe_is_refused_with_what_is_one(
    tmp_path: Path, recipe: Any
) -> None:
    with is_refused(UsageError, argument="recipe"):
        make_dataset(recipe, tmp_path / "out")


def test_a_pipeline_is_refused_with_the_dataset_recipe_to_make_of_it() -> None:
    pipeline = load_pipeline("airhockey-hit")
    with is_refused(UsageError, argument="recipe"):
        as_dataset_recipe(pipeline)
    recipe = DatasetRecipe(
        name="airhockey-hit", pipeline=pipeline, splits={"train": 1000}
    )
    assert as_dataset_recipe(recipe) is recipe


@pytest.mark.parametrize(
    ("splits", "said"),
    [({}, "has no splits"), ({"train": 9.5}, "split 'train' must be an int")],
)
def test_splits_that_no_file_could_have_are_refused(
    tmp_path: Path, splits: Any, said: str
) -> None:
    with pytest.raises(UsageError, match=said):
        resolve(
            replace(tiny_recipe("airhockey-hit"), splits=splits),
            find_workspace(tmp_path),
            n=50,
        )


@pytest.mark.parametrize("regenerate", [1.5, "1", True, -1])
def test_the_number_of_blocks_to_make_again_is_an_integer(
    tmp_path: Path, regenerate: Any
) -> None:
    (tmp_path / "specification.json").write_text('{"format": "cnpgen-plan"}')
    with is_refused(UsageError, argument="regenerate"):
        validate_dataset(tmp_path, regenerate=regenerate)


@pytest.mark.parametrize("epoch", ["abc", "1e9", "9" * 30])
def test_a_source_date_that_is_none_is_refused_before_anything_is_made(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, epoch: str
) -> None:
    monkeypatch.setenv("SOURCE_DATE_EPOCH", epoch)
    with is_refused(UsageError):
        make_tiny(tmp_path / "out")
    assert not list(tmp_path.iterdir())


# --- the data card of a user's recipe ---------------------------------------------------------------------------------


def test_the_card_beside_a_recipe_is_part_of_the_dataset_s(tmp_path: Path) -> None:
    (tmp_path / "mine.md").write_bytes("\ufeffFrom Kraków.\n".encode())
    recipe = tiny_recipe("airhockey-hit", path=tmp_path / "mine.toml")
    folder = make_dataset(recipe, tmp_path / "out", n=20, workers=1).folder
    assert "From Kraków." in (folder / "README.md").read_text(encoding="utf-8")


@pytest.mark.parametrize("content", [b"caf\xe9", b"one\ntwo\n\xff\xfe"])
def test_a_card_that_is_not_utf_8_is_named_before_anything_is_made(
    tmp_path: Path, content: bytes
) -> None:
    (tmp_path / "mine.md").write_bytes(content)
    line = content.count(b"\n") + 1
    with pytest.raises(
        RecipeError, match=rf"mine\.md: line {line}: not UTF-8: byte 0x(e9|ff)"
    ):
        make_dataset(
            tiny_recipe("airhockey-hit", path=tmp_path / "mine.toml"), tmp_path / "out"
        )
    assert [item.name for item in tmp_path.iterdir()] == ["mine.md"]


def test_a_recipe_from_no_file_has_no_card(tmp_path: Path) -> None:
    recipe = DatasetRecipe(
        name="own", pipeline=load_pipeline("airhockey-hit"), splits={"train": 20}
    )
    assert make_dataset(recipe, tmp_path / "out", workers=1).complete


def test_an_integer_beyond_floats_is_no_finite_number() -> None:
    with is_refused(UsageError, argument="rate"):
        number("rate", 10**400)
