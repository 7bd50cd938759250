"""Model files: round trip, and errors for damaged, truncated, inconsistent and other files."""

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
from cnpgen.store.files.checksum_file import (
    Content,
    encode_with_checksum,
    read_with_checksum,
)
from tests.conftest import columns_of
from tests.examples.models import boundary_of_columns, untrained_model
from tests.refusals import is_refused


@pytest.fixture(scope="module")
def model(tiny) -> Model:
    made = untrained_model(
        "airhockey", boundary_of_columns(columns_of(tiny("airhockey-hit")), 20)
    )
    return replace(
        made,
        training={"command": "cnpgen train", "score": {"valid": 0.5}},
        log='{"step": 1}\n',
    )


def test_a_loaded_model_equals_the_saved_one(model, tmp_path):
    save_model(tmp_path / "m.h5", model)
    found = load_model(tmp_path / "m.h5")
    np.testing.assert_array_equal(found.parameters, model.parameters)
    np.testing.assert_array_equal(found.features.mean, model.features.mean)
    np.testing.assert_array_equal(found.features.scale, model.features.scale)
    for name in ("architecture", "config", "zero_conditions", "training", "log"):
        assert getattr(found, name) == getattr(model, name)
    assert found.features.blocks == model.features.blocks
    assert found.problem.comparable_sha256 == model.problem.comparable_sha256


def test_a_model_file_contains_the_expected_time_unless_it_is_the_default(
    model, tmp_path
):
    save_model(tmp_path / "m.h5", model)
    stored = json.loads(
        read_with_checksum(tmp_path / "m.h5", kind="cnpgen-model", version=2).texts[
            "description"
        ]
    )
    assert "expected_time" not in stored["config"]
    reach = replace(model, config=replace(model.config, expected_time="reach"))
    save_model(tmp_path / "r.h5", reach)
    assert load_model(tmp_path / "r.h5").config == reach.config
    save_model(
        tmp_path / "w.h5",
        replace(model, config=replace(model.config, expected_time="soon")),
    )
    with is_refused(DatasetError):
        load_model(tmp_path / "w.h5")


def test_a_model_file_contains_options_after_the_network_unless_they_are_defaults(
    model, tmp_path
):
    save_model(tmp_path / "m.h5", model)
    stored = json.loads(
        read_with_checksum(tmp_path / "m.h5", kind="cnpgen-model", version=2).texts[
            "description"
        ]
    )["config"]
    assert set(stored) == {"path_scale", "line_projection_steps", "projection_steps"}
    both = replace(
        model,
        config=replace(
            model.config, time_parametrized=True, within_limits=True, projection_steps=0
        ),
    )
    save_model(tmp_path / "b.h5", both)
    assert load_model(tmp_path / "b.h5").config == both.config
    save_model(
        tmp_path / "w.h5",
        replace(model, config=replace(model.config, time_parametrized="often")),
    )
    with is_refused(DatasetError):
        load_model(tmp_path / "w.h5")


def test_a_loaded_model_has_its_via_points(model, tmp_path):
    configurations = tuple(
        map(tuple, np.random.default_rng(0).uniform(-1, 1, (2, 6)).tolist())
    )
    with_configurations = replace(
        model, config=replace(model.config, via_points=configurations)
    )
    save_model(tmp_path / "c.h5", with_configurations)
    assert load_model(tmp_path / "c.h5").config == with_configurations.config
    save_model(
        tmp_path / "w.h5",
        replace(model, config=replace(model.config, via_points=((0.1, 0.2),))),
    )
    with is_refused(DatasetError):
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


def test_any_changed_bit_raises_an_error(model, tmp_path):
    save_model(tmp_path / "m.h5", model)
    whole = (tmp_path / "m.h5").read_bytes()
    used = [
        *range(80),
        *np.random.default_rng(0).integers(512, len(whole), 60).tolist(),
    ]
    for place in used:
        data = bytearray(whole)
        data[place] ^= 1 << (place % 8)
        (tmp_path / "m.h5").write_bytes(data)
        with pytest.raises(DatasetError, match=r"m\.h5"):
            load_model(tmp_path / "m.h5")


@pytest.mark.parametrize("size", [0, 40, 512, 5000, -1])
def test_a_truncated_model_raises_an_error(model, tmp_path, size):
    save_model(tmp_path / "m.h5", model)
    whole = (tmp_path / "m.h5").read_bytes()
    (tmp_path / "m.h5").write_bytes(whole[:size])
    with is_refused(DatasetError):
        load_model(tmp_path / "m.h5")


@pytest.mark.parametrize("place", [3, 9, 20, 40, 200])
def test_a_model_with_a_changed_first_block_is_reported_as_damaged(
    model, tmp_path, place
):
    save_model(tmp_path / "m.h5", model)
    data = bytearray((tmp_path / "m.h5").read_bytes())
    data[place] ^= 0x10 if place != 9 else 0x02  # "mmdel"
    (tmp_path / "m.h5").write_bytes(data)
    with is_refused(DatasetError):
        load_model(tmp_path / "m.h5")


def test_missing_files_and_files_of_other_kinds_are_named(tmp_path, tiny):
    with is_refused(UsageError, argument="name_or_path"):
        load_model(tmp_path / "none.h5")
    shard = next(tiny("airhockey-hit").rglob("*.h5"))
    with is_refused(UsageError, argument="name_or_path"):
        load_model(shard)
    other = tmp_path / "other.h5"
    other.write_bytes(
        encode_with_checksum(
            Content({}, {"a": "b"}), kind="cnpgen-checkpoint", version=1
        )
    )
    with is_refused(UsageError, argument="name_or_path"):
        load_model(other)


@pytest.mark.parametrize(("version", "remedy"), [(99, "upgrade"), (1, "make it again")])
def test_other_format_versions_are_named(tmp_path, version, remedy):
    path = tmp_path / "other.h5"
    path.write_bytes(
        encode_with_checksum(
            Content({}, {}), kind=model_file.MODEL_KIND, version=version
        )
    )
    with pytest.raises(
        DatasetError,
        match=rf"format version {version}, this cnpgen reads version 2.*{remedy}",
    ):
        load_model(path)


@pytest.mark.parametrize(
    "change", ["fewer joints", "unknown features", "no description"]
)
def test_inconsistent_content_with_a_valid_checksum_raises_an_error(
    model, tmp_path, change
):
    content = model_file.model_content(model)
    arrays, texts = dict(content.arrays), dict(content.texts)
    if change == "fewer joints":
        arrays["path_output_weight"] = arrays["path_output_weight"][:, :50]
    elif change == "unknown features":
        texts["description"] = texts["description"].replace("sin_cos", "colours")
    else:
        del texts["description"]
    path = tmp_path / "odd.h5"
    path.write_bytes(
        encode_with_checksum(
            Content(arrays, texts), kind=model_file.MODEL_KIND, version=2
        )
    )
    with is_refused(DatasetError):
        load_model(path)


def described(part, **values):
    def apply(arrays, texts):
        description = json.loads(texts["description"])
        (description[part] if part else description).update(values)
        texts["description"] = json.dumps(description)

    return apply


FORGERIES = {
    "as many steps as never end": (
        described("config", projection_steps=10**18), "there are at most 20 steps"),
    "unknown zeros": (described("", zero_conditions=["../../x"]), "unknown boundary conditions ../../x"),
    "zeros that cannot be": (
        described("", zero_conditions=["start_q"]), "start_q: only velocities and accelerations are zero"),
    "an infinite scale": (described("config", path_scale="inf"), "is invalid"),
    "layers without end": (described("architecture", layers=10**30), "layers must be a whole"),
    "many layers": (described("architecture", layers=10**9), "1000000000 layers cannot be in"),
    "a wide layer": (described("architecture", hidden=10**9), "must have shape"),
    "no layer": (described("architecture", layers=0), "layers of a network must be at least 1, got 0"),
    "other inputs": (described("architecture", inputs=3), "inputs, path outputs and rate"),
    "a text for a number": (described("architecture", hidden="16"), "hidden must be a whole"),
    "another key": (described("config", more=1), "unexpected keyword argument 'more'"),
    "an acceleration that it leaves free": (
        described("", features=[*STATES[:4], "goal_ddq", "sin_cos", "tips", "expected_time"]),
        "its outputs leave goal accelerations free"),
    "no features": (described("", features=[]), "inputs, path outputs and rate outputs"),
    "a layer that is missing": (lambda arrays, texts: arrays.pop("trunk_1_bias"), "it has no 'trunk_1_bias'"),
    "another mean": (lambda arrays, texts: arrays.update(feature_mean=np.zeros(3)), "feature_mean must have shape"),
    "training that is a list": (lambda arrays, texts: texts.update(training="[1]"), "the document must be a table"),
    "a dataset that is a number": (
        lambda arrays, texts: texts.update(training='{"dataset": 1}'), "dataset must be a table, got 1"),
    "deep training": (lambda arrays, texts: texts.update(training="[" * 10**5), "nested tables and lists"),
    "no problem": (lambda arrays, texts: texts.update(problem_recipe="{}"), "problem_recipe is not that of a problem"),
    "no text": (lambda arrays, texts: arrays.update(log=np.array([255], np.uint8)), "one of its texts is not UTF-8"),
}  # fmt: skip


@pytest.mark.parametrize("forgery", FORGERIES)
def test_the_description_of_a_model_is_checked_against_its_arrays(
    model, tmp_path, forgery
):
    forge, message = FORGERIES[forgery]
    content = model_file.model_content(model)
    arrays, texts = dict(content.arrays), dict(content.texts)
    texts.pop("log") if forgery == "no text" else None
    forge(arrays, texts)
    path = tmp_path / "forged.h5"
    path.write_bytes(
        encode_with_checksum(
            Content(arrays, texts), kind=model_file.MODEL_KIND, version=2
        )
    )
    started = time.process_time()
    with pytest.raises(DatasetError, match=rf"forged\.h5 .*{message}"):
        load_model(path)
    assert time.process_time() - started < 2


def test_any_changed_bit_of_the_first_block_raises_an_error(model, tmp_path):
    save_model(tmp_path / "m.h5", model)
    whole = (tmp_path / "m.h5").read_bytes()
    for place in range(0, 512, 7):
        data = bytearray(whole)
        data[place] ^= 1 << (place % 8)
        (tmp_path / "m.h5").write_bytes(data)
        with pytest.raises(DatasetError, match=r"m\.h5"):
            load_model(tmp_path / "m.h5")


def test_an_empty_text_and_a_scalar_are_restored(tmp_path):
    path = tmp_path / "x.h5"
    path.write_bytes(
        encode_with_checksum(
            Content({"a": np.array(1.5)}, {"t": ""}), kind="cnpgen-thing", version=1
        )
    )
    found = read_with_checksum(path, kind="cnpgen-thing", version=1)
    assert found.texts == {"t": ""}
    assert found.arrays["a"] == 1.5


def test_shipped_models_are_found_by_name_and_others_by_path(tmp_path, monkeypatch):
    monkeypatch.setattr(
        model_file,
        "shipped_models",
        lambda: {"airhockey-hit": Path("/somewhere/airhockey-hit.h5")},
    )
    assert find_model("airhockey-hit") == Path("/somewhere/airhockey-hit.h5")
    (tmp_path / "mine").touch()
    assert find_model(tmp_path / "mine") == tmp_path / "mine"
    with is_refused(UsageError, argument="name_or_path"):
        find_model("mine.h5")
    with is_refused(UsageError, argument="name_or_path"):
        find_model("airhockey-hot")


@pytest.mark.parametrize(
    "path", model_file.shipped_models().values(), ids=lambda path: path.stem
)
def test_every_shipped_model_is_small_intact_and_documented(path):
    assert path.stat().st_size <= 3e6
    model = load_model(path)
    assert model.training["command"].startswith("cnpgen train")
    assert model.training["score"]["plans"] >= 1000
    assert model.log.count("\n") > 50


def test_a_forged_header_raises_a_cnpgen_error(tmp_path):
    (tmp_path / "m.h5").write_bytes(
        b"cnpgen-model 2\nsha256 " + b"0" * 64 + b"\n" + bytes(600)
    )
    with pytest.raises(CnpgenError):
        load_model(tmp_path / "m.h5")
