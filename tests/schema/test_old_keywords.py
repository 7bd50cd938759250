"""Keywords of version 1.0 that became fields of options work, with a warning at the line of the caller."""

import inspect
from dataclasses import fields
from pathlib import Path
from typing import Any

import pytest

import cnpgen
from cnpgen.benchmark import BenchmarkOptions, run_benchmark
from cnpgen.errors import UsageError
from cnpgen.scenes import SceneOptions, solve_scenes
from cnpgen.trajectories import LoadOptions, load_trajectories
from tests.refusals import is_refused

MOVED = [
    (cnpgen.make_dataset, cnpgen.GenerationOptions, ("no-such-dataset",), {"dtype": 3}),
    (cnpgen.train_model, cnpgen.TrainingOptions, ("missing", "a.h5"), {"epochs": "2"}),
    (run_benchmark, BenchmarkOptions, ("hits-81", "out"), {"time_limit": -1.0}),
    (load_trajectories, LoadOptions, ("missing.csv", "airhockey"), {"rate": -1.0}),
    (solve_scenes, SceneOptions, ("panda", ()), {"payload": "2"}),
]


@pytest.mark.parametrize(
    ("function", "options", "arguments", "wrong"),
    MOVED,
    ids=lambda each: str(each)[:20],
)
def test_old_keywords_are_checked_as_fields_of_the_options(
    function: Any,
    options: type,
    arguments: tuple[str, ...],
    wrong: dict[str, Any],
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.chdir(tmp_path)
    (name,) = wrong
    with pytest.raises(UsageError) as by_options:
        options(**wrong)
    with (
        pytest.warns(DeprecationWarning, match=options.__name__) as warned,
        pytest.raises(UsageError) as by_keyword,
    ):
        function(*arguments, **wrong)
    assert warned[0].filename == __file__
    assert str(by_keyword.value) == str(by_options.value)
    assert by_keyword.value.argument == name
    with is_refused(TypeError):
        function(*arguments, unheard_of=1)


@pytest.mark.parametrize(("function", "options"), [each[:2] for each in MOVED])
def test_no_argument_is_in_two_places(function: Any, options: type) -> None:
    arguments = inspect.signature(function).parameters
    assert len(arguments) <= 11  # ten and the old keywords
    assert not {entry.name for entry in fields(options)} & arguments.keys()


def test_batches_are_the_same_with_options_and_with_old_keywords(tiny: Any) -> None:
    dataset = cnpgen.load_dataset(tiny("airhockey-hit"))
    options = cnpgen.BatchOptions(shuffle=False, rank=1, world=2)
    new = next(iter(dataset.batches(8, options=options)))
    with pytest.warns(DeprecationWarning, match="next version") as warned:
        batches = dataset.batches(8, shuffle=False, rank=1, world=2)
    assert warned[0].filename == __file__
    old = next(iter(batches))
    assert (old.table == new.table).all()
    assert old.rows == 4
