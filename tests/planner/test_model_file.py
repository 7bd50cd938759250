"""Model files: what is written comes back; what is damaged, cut off, or of something else is an error."""

import json
import time
from dataclasses import replace
from pathlib import Path

import h5py
import numpy as np
import pytest

from cnpgen.errors import CnpgenError, DatasetError, UsageError
from cnpgen.planner import model_file
from cnpgen.planner.model import Model
from cnpgen.planner.model_file import find_model, load_model, save_model
from cnpgen.planner.network.features import STATES
from cnpgen.store.files.sealed import Content, read_sealed, seal
from tests.conftest import columns_of
from tests.examples.models import boundary_of_columns, untrained_model


@pytest.fixture(scope="module")
def model(tiny) -> Model:
    made = untrained_model("airhockey", boundary_of_columns(columns_of(tiny("airhockey-hit")), 20))
    return replace(made, training={"command": "cnpgen train", "score": {"valid": 0.5}}, log='{"step": 1}\n')


def test_a_model_comes_back_as_it_was_written(model, tmp_path):
    save_model(tmp_path / "m.h5", model)
    found = load_model(tmp_path / "m.h5")
    np.testing.assert_array_equal(found.parameters, model.parameters)
    np.testing.assert_array_equal(found.features.mean, model.features.mean)
    np.testing.assert_array_equal(found.features.scale, model.features.scale)
    for name in ("architecture", "meaning", "rest", "training", "log"):
        assert getattr(found, name) == getattr(model, name)
    assert found.features.blocks == model.features.blocks
    assert found.problem.comparable_sha256 == model.problem.comparable_sha256


def test_a_model_says_which_expected_time_it_means_unless_it_is_the_usual_one(model, tmp_path):
    save_model(tmp_path / "m.h5", model)
    said = json.loads(read_sealed(tmp_path / "m.h5", kind="cnpgen-model", version=1).texts["description"])
    assert "expected_time" not in said["meaning"]
    reach = replace(model, meaning=replace(model.meaning, expected_time="reach"))
    save_model(tmp_path / "r.h5", reach)
    assert load_model(tmp_path / "r.h5").meaning == reach.meaning
    save_model(tmp_path / "w.h5", replace(model, meaning=replace(model.meaning, expected_time="soon")))
    with pytest.raises(DatasetError, match="expected_time must be one of distance, reach, got 'soon'"):
        load_model(tmp_path / "w.h5")


def test_a_model_says_what_is_done_behind_its_network_unless_it_is_the_usual(model, tmp_path):
    save_model(tmp_path / "m.h5", model)
    said = json.loads(read_sealed(tmp_path / "m.h5", kind="cnpgen-model", version=1).texts["description"])["meaning"]
    assert set(said) == {"path_scale", "bending_steps", "landing_steps"}
    both = replace(model, meaning=replace(model.meaning, paced=True, within_limits=True, landing_steps=0))
    save_model(tmp_path / "b.h5", both)
    assert load_model(tmp_path / "b.h5").meaning == both.meaning
    save_model(tmp_path / "w.h5", replace(model, meaning=replace(model.meaning, paced="often")))
    with pytest.raises(DatasetError, match="paced must be true or false, got 'often'"):
        load_model(tmp_path / "w.h5")


def test_a_model_comes_back_with_the_corners_of_its_other_lines(model, tmp_path):
    corners = tuple(map(tuple, np.random.default_rng(0).uniform(-1, 1, (2, 6)).tolist()))
    cornered = replace(model, meaning=replace(model.meaning, middles=corners))
    save_model(tmp_path / "c.h5", cornered)
    assert load_model(tmp_path / "c.h5").meaning == cornered.meaning
    save_model(tmp_path / "w.h5", replace(model, meaning=replace(model.meaning, middles=((0.1, 0.2),))))
    with pytest.raises(DatasetError, match="middles must be 6 numbers each"):
        load_model(tmp_path / "w.h5")


def test_equal_models_give_equal_bytes(model, tmp_path):
    for name in ("a.h5", "b.h5"):
        save_model(tmp_path / name, model)
    assert (tmp_path / "a.h5").read_bytes() == (tmp_path / "b.h5").read_bytes()


def test_any_hdf5_reader_opens_a_model_and_finds_the_layers_by_name(model, tmp_path):
    save_model(tmp_path / "m.h5", model)
    with h5py.File(tmp_path / "m.h5") as file:
        assert file["trunk_0_weight"].shape == (model.architecture.inputs, 16)
        assert file["rate_output_bias"].shape == (20,)
        assert b"cnpgen train" in file["training"][()].tobytes()


def test_a_changed_bit_anywhere_is_noticed(model, tmp_path):
    save_model(tmp_path / "m.h5", model)
    whole = (tmp_path / "m.h5").read_bytes()
    used = [*range(80), *np.random.default_rng(0).integers(512, len(whole), 60).tolist()]
    for place in used:
        data = bytearray(whole)
        data[place] ^= 1 << (place % 8)
        (tmp_path / "m.h5").write_bytes(data)
        with pytest.raises(DatasetError, match=r"m\.h5"):
            load_model(tmp_path / "m.h5")


@pytest.mark.parametrize("size", [0, 40, 512, 5000, -1])
def test_a_model_that_was_cut_off_is_an_error(model, tmp_path, size):
    save_model(tmp_path / "m.h5", model)
    whole = (tmp_path / "m.h5").read_bytes()
    (tmp_path / "m.h5").write_bytes(whole[:size])
    with pytest.raises(DatasetError, match="damaged"):
        load_model(tmp_path / "m.h5")


@pytest.mark.parametrize("place", [3, 9, 20, 40, 200])
def test_a_model_whose_first_block_was_changed_is_called_damaged_and_nothing_else(model, tmp_path, place):
    save_model(tmp_path / "m.h5", model)
    data = bytearray((tmp_path / "m.h5").read_bytes())
    data[place] ^= 0x10 if place != 9 else 0x02  # "mmdel"
    (tmp_path / "m.h5").write_bytes(data)
    with pytest.raises(DatasetError, match=r"m\.h5 is damaged: its first 512 bytes are not as they were written$"):
        load_model(tmp_path / "m.h5")


def test_a_missing_file_and_other_files_are_named(tmp_path, tiny):
    with pytest.raises(UsageError, match=r"none\.h5 is not there, expected a model"):
        load_model(tmp_path / "none.h5")
    shard = next(tiny("airhockey-hit").rglob("*.h5"))
    with pytest.raises(DatasetError, match="not a model of cnpgen"):
        load_model(shard)
    other = tmp_path / "other.h5"
    other.write_bytes(seal(Content({}, {"a": "b"}), kind="cnpgen-checkpoint", version=1))
    with pytest.raises(DatasetError, match="a checkpoint of cnpgen, not a model"):
        load_model(other)


def test_a_newer_format_asks_for_an_upgrade(tmp_path):
    path = tmp_path / "new.h5"
    path.write_bytes(seal(Content({}, {}), kind=model_file.KIND, version=99))
    with pytest.raises(DatasetError, match=r"format version 99.*upgrade"):
        load_model(path)


@pytest.mark.parametrize("change", ["fewer joints", "unknown features", "no description"])
def test_a_sealed_file_that_does_not_fit_is_an_error_too(model, tmp_path, change):
    content = model_file.model_content(model)
    arrays, texts = dict(content.arrays), dict(content.texts)
    if change == "fewer joints":
        arrays["path_output_weight"] = arrays["path_output_weight"][:, :50]
    elif change == "unknown features":
        texts["description"] = texts["description"].replace("sin_cos", "colours")
    else:
        del texts["description"]
    path = tmp_path / "odd.h5"
    path.write_bytes(seal(Content(arrays, texts), kind=model_file.KIND, version=1))
    with pytest.raises(DatasetError, match="does not fit this version"):
        load_model(path)


def described(part, **values):
    def apply(arrays, texts):
        description = json.loads(texts["description"])
        (description[part] if part else description).update(values)
        texts["description"] = json.dumps(description)

    return apply


FORGERIES = {
    "as many steps as never end": (
        described("meaning", landing_steps=10**18), "there are at most 20 steps"),
    "unknown zeros": (described("", rest=["../../x"]), "unknown boundary conditions ../../x"),
    "zeros that cannot be": (described("", rest=["start_q"]), "start_q: only velocities and accelerations are zero"),
    "an infinite scale": (described("meaning", path_scale="inf"), "cannot be meant"),
    "layers without end": (described("architecture", layers=10**30), "layers must be a whole"),
    "many layers": (described("architecture", layers=10**9), "1000000000 layers cannot be in"),
    "a wide layer": (described("architecture", hidden=10**9), "must have shape"),
    "no layer": (described("architecture", layers=0), "at least 1 of layers, got 0"),
    "other inputs": (described("architecture", inputs=3), "inputs, path outputs and rate"),
    "a text for a number": (described("architecture", hidden="16"), "hidden must be a whole"),
    "another key": (described("meaning", more=1), "unexpected keyword argument 'more'"),
    "an acceleration that it leaves free": (
        described("", features=[*STATES[:4], "goal_ddq", "sin_cos", "tips", "expected_time"]),
        "its outputs leave goal accelerations free"),
    "no features": (described("", features=[]), "inputs, path outputs and rate outputs"),
    "a layer that is missing": (lambda arrays, texts: arrays.pop("trunk_1_bias"), "it has no 'trunk_1_bias'"),
    "another mean": (lambda arrays, texts: arrays.update(feature_mean=np.zeros(3)), "feature_mean must have shape"),
    "training that is a list": (lambda arrays, texts: texts.update(training="[1]"), "the document must be a table"),
    "a dataset that is a number": (
        lambda arrays, texts: texts.update(training='{"dataset": 1}'), "dataset must be a table, got 1"),
    "deep training": (lambda arrays, texts: texts.update(training="[" * 10**5), "tables and lists in one another"),
    "no problem": (lambda arrays, texts: texts.update(problem_recipe="{}"), "problem_recipe is not that of a problem"),
    "no text": (lambda arrays, texts: arrays.update(log=np.array([255], np.uint8)), "a text that is not UTF-8"),
}  # fmt: skip


@pytest.mark.parametrize("what", FORGERIES)
def test_what_a_model_declares_is_compared_with_what_it_has(model, tmp_path, what):
    forge, message = FORGERIES[what]
    content = model_file.model_content(model)
    arrays, texts = dict(content.arrays), dict(content.texts)
    texts.pop("log") if what == "no text" else None
    forge(arrays, texts)
    path = tmp_path / "forged.h5"
    path.write_bytes(seal(Content(arrays, texts), kind=model_file.KIND, version=1))
    begun = time.process_time()
    with pytest.raises(DatasetError, match=rf"forged\.h5 .*{message}"):
        load_model(path)
    assert time.process_time() - begun < 2


def test_every_bit_of_the_first_block_counts(model, tmp_path):
    save_model(tmp_path / "m.h5", model)
    whole = (tmp_path / "m.h5").read_bytes()
    for place in range(0, 512, 7):
        data = bytearray(whole)
        data[place] ^= 1 << (place % 8)
        (tmp_path / "m.h5").write_bytes(data)
        with pytest.raises(DatasetError, match=r"m\.h5"):
            load_model(tmp_path / "m.h5")


def test_an_empty_text_and_a_scalar_come_back(tmp_path):
    path = tmp_path / "x.h5"
    path.write_bytes(seal(Content({"a": np.array(1.5)}, {"t": ""}), kind="cnpgen-thing", version=1))
    found = read_sealed(path, kind="cnpgen-thing", version=1)
    assert found.texts == {"t": ""}
    assert found.arrays["a"] == 1.5


def test_shipped_models_are_found_by_name_and_others_by_path(tmp_path, monkeypatch):
    monkeypatch.setattr(model_file, "shipped_models", lambda: {"airhockey-hit": Path("/somewhere/airhockey-hit.h5")})
    assert find_model("airhockey-hit") == Path("/somewhere/airhockey-hit.h5")
    assert find_model("mine.h5") == Path("mine.h5")
    assert find_model(tmp_path / "mine") == tmp_path / "mine"
    with pytest.raises(UsageError, match=r"unknown model 'airhockey-hot' \(did you mean 'airhockey-hit'\?\)"):
        find_model("airhockey-hot")


@pytest.mark.parametrize("path", model_file.shipped_models().values(), ids=lambda path: path.stem)
def test_every_shipped_model_is_small_whole_and_says_how_it_was_made(path):
    assert path.stat().st_size <= 3e6
    model = load_model(path)
    assert model.training["command"].startswith("cnpgen train")
    assert model.training["score"]["plans"] >= 1000
    assert model.log.count("\n") > 50


def test_no_error_is_a_traceback(tmp_path):
    (tmp_path / "m.h5").write_bytes(b"cnpgen-model 1\nsha256 " + b"0" * 64 + b"\n" + bytes(600))
    with pytest.raises(CnpgenError):
        load_model(tmp_path / "m.h5")
