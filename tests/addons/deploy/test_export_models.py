"""``cnpgen export MODEL --to c``: files, refusals and exit codes."""

import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from cnpgen.addons.deploy.input_ranges import input_ranges
from cnpgen.cli.main import main
from cnpgen.planner.inference_pipeline import loaded_problem
from cnpgen.planner.model import Model
from cnpgen.planner.model_file import find_model, load_model, save_model
from cnpgen.training.prepare import input_ranges as ranges_of_rows
from tests.refusals import assert_said


def test_a_model_becomes_a_source_a_header_and_a_readme(tmp_path: Path, capsys):
    file = tmp_path / "My Hits*.h5"
    shutil.copy(find_model("airhockey-hit"), file)
    out = tmp_path / "out"
    assert main(["export", str(file), "--to", "c", "-o", str(out)]) == 0
    assert capsys.readouterr().out == f"{out / 'my_hits.c'}\n"
    assert {path.name for path in out.iterdir()} == {
        "my_hits.c",
        "my_hits.h",
        "README.md",
    }
    header = (out / "my_hits.h").read_text()
    assert "my_hits_plan(const my_hits_request" in header
    assert load_model(file).problem.comparable_sha256 in header
    assert main(["export", str(file), "--to", "c", "-o", str(out)]) == 0
    (out / "my_hits.h").write_text("changed")
    assert main(["export", str(file), "--to", "c", "-o", str(out)]) == 2
    assert_said(capsys.readouterr().err)
    assert main(["export", str(file), "--to", "c", "-o", str(out), "--force"]) == 0


@pytest.mark.parametrize(
    ("options", "text"),
    [
        (["airhockey-hit", "--to", "npz"], "a model is exported with --to c"),
        (["airhockey-hit", "--to", "c", "--plan", "0"], "--plan is for plans"),
        (["airhockey-hit", "--to", "c", "--at", "1s"], "--at is for plans"),
        (["airhockey-hit", "--to", "c", "--rate", "1000"], "--rate is for plans"),
        (["airhockey-hit", "--to", "c", "-o", "FILE"], "is a file"),
        (["panda-scenes", "--to", "c"], "its samples place obstacles"),
        (["FILE", "--to", "c"], "needs a model"),
        (["FILE", "--to", "npz", "--rows", "FOLDER"], "dataset"),
        (["airhockey-hit", "--to", "c", "--rows", "FOLDER"], "dataset"),
        (["missing.h5", "--to", "c"], "missing.h5"),
    ],
)
def test_invalid_input_is_refused_by_exit_code_2(tmp_path, capsys, options, text):
    (tmp_path / "text.txt").write_text("no model")
    (tmp_path / "empty").mkdir()
    places = {"FILE": str(tmp_path / "text.txt"), "FOLDER": str(tmp_path / "empty")}
    code = main(["export", *[places.get(option, option) for option in options]])
    assert code in {1, 2}
    error = capsys.readouterr().err
    assert text in error
    assert "Traceback" not in error


def test_a_damaged_model_is_reported(tmp_path, capsys):
    content = bytearray(find_model("airhockey-hit").read_bytes())
    content[len(content) // 2] ^= 1
    (tmp_path / "model.h5").write_bytes(content)
    assert main(["export", str(tmp_path / "model.h5"), "--to", "c"]) == 1
    assert_said(capsys.readouterr().err)


def test_parameters_that_are_not_finite_are_refused(tmp_path, capsys):
    model = load_model("airhockey-hit")
    parameters = model.parameters.copy()
    parameters[7] = np.nan
    save_model(tmp_path / "model.h5", replace(model, parameters=parameters))
    file = str(tmp_path / "model.h5")
    assert main(["export", file, "--to", "c", "-o", str(tmp_path / "out")]) in {1, 2}
    assert_said(capsys.readouterr().err)
    assert not (tmp_path / "out").exists()


def with_training(model: Model, **changes: object) -> Model:
    return replace(model, training={**model.training, **changes})


def test_ranges_are_those_of_the_model_of_rows_or_a_substitute():
    hits = load_model("airhockey-hit")
    low, high = np.full(61, -2.0), np.full(61, 3.0)
    stored = {"low": low.tolist(), "high": high.tolist()}
    with loaded_problem(hits.problem, "numpy") as loaded:
        of_model = input_ranges(with_training(hits, input_ranges=stored), loaded)
        substitute = input_ranges(hits, loaded)
        unknown = input_ranges(with_training(hits, start_from="0" * 64), loaded)
    np.testing.assert_allclose(of_model.low, low, atol=2e-5)
    np.testing.assert_allclose(of_model.high, high, atol=2e-5)
    assert "stored in the model" in of_model.source
    assert set(substitute.high) == {6.0}
    assert "6 standard deviations" in substitute.source
    assert unknown.low.max() < -1e100
    assert unknown.source.startswith("unknown")


def test_training_stores_the_range_of_its_rows_and_of_those_before():
    inputs = np.array([[0.0, 1.0], [2.0, -1.0]], np.float32)
    first = ranges_of_rows(inputs)
    assert first == {"low": [0.0, -1.0], "high": [2.0, 1.0]}
    model = with_training(load_model("airhockey-hit"), input_ranges=first)
    later = ranges_of_rows(np.array([[5.0, 0.0]], np.float32), model)
    assert later == {"low": [0.0, -1.0], "high": [5.0, 1.0]}


def test_stored_ranges_of_another_size_are_refused(tmp_path, capsys):
    model = load_model("airhockey-hit")
    ranges = {"low": [0.0], "high": [1.0]}
    save_model(tmp_path / "model.h5", with_training(model, input_ranges=ranges))
    assert main(["export", str(tmp_path / "model.h5"), "--to", "c"]) == 1
    assert_said(capsys.readouterr().err)
