"""Planning requests: shards, plan files and files of boundary conditions are checked against the model's problem."""

import shutil
from collections.abc import Callable
from pathlib import Path

import h5py
import numpy as np
import pytest

from cnpgen.cli.main import main
from cnpgen.errors import DatasetError, UsageError
from cnpgen.loader.load import load_dataset
from cnpgen.planner.model import Model
from cnpgen.planner.plan_requests import read_file, read_rows
from cnpgen.plans.plan_file import load_plans
from cnpgen.training.data import open_training_data
from tests.conftest import columns_of
from tests.examples.example_robots import needs_robots
from tests.examples.models import boundary_of_columns, untrained_model
from tests.refusals import is_refused

Tiny = Callable[[str], Path]


@pytest.fixture(scope="module")
def model(tiny: Tiny) -> Model:
    """A model of the replanning problems with recorded stages."""
    folder = tiny("airhockey-replan")
    dataset = open_training_data(folder).describe()
    training = {"dataset": dataset, "stages": load_dataset(folder).spec.stages}
    return untrained_model(
        "airhockey", boundary_of_columns(columns_of(folder), 20), training=training
    )


def write(path: Path, joints: int = 6, **attributes: str) -> Path:
    with h5py.File(path, "w") as file:
        file["start_q"], file["goal_q"] = np.zeros((2, joints)), np.ones((2, joints))
        file.attrs.update(attributes)
    return path


def shard(folder: Path) -> Path:
    return folder / "train" / "shard-00000.h5"


def test_a_shard_is_the_rows_of_its_dataset(tiny, model):
    rows = read_rows(tiny("airhockey-replan"), model, split="train", n=250)
    found = read_file(shard(tiny("airhockey-replan")), model)
    np.testing.assert_array_equal(found.sample_id, rows.sample_id)
    np.testing.assert_array_equal(found.boundary.start_ddq, rows.boundary.start_ddq)
    assert found.columns.keys() == rows.columns.keys()


def test_a_shard_is_rejected_like_its_dataset(tiny, model):
    with is_refused(DatasetError, argument="other"):
        read_file(shard(tiny("airhockey-hit")), model)
    assert (
        len(read_file(shard(tiny("airhockey-hit")), model, other=True).sample_id) == 250
    )
    for other in (False, True):
        with is_refused(DatasetError):
            read_file(shard(tiny("heavy-object")), model, other=other)


def test_a_shard_without_its_dataset_is_identified_by_the_digest_of_its_recipe(
    tiny, tmp_path, model
):
    mine, hit = (
        shutil.copy(shard(tiny(name)), tmp_path / name)
        for name in ("airhockey-replan", "airhockey-hit")
    )
    assert len(read_file(Path(mine), model).sample_id) == 250
    with is_refused(DatasetError, argument="other"):
        read_file(Path(hit), model)
    assert len(read_file(Path(hit), model, other=True).sample_id) == 250


def test_a_file_of_another_problem_is_rejected(tmp_path, model):
    with is_refused(DatasetError):
        read_file(write(tmp_path / "a.h5", problem="heavy-object"), model)
    with is_refused(DatasetError):
        read_file(write(tmp_path / "b.h5", problem="airhokey"), model)
    with is_refused(DatasetError):
        read_file(write(tmp_path / "c.h5", problem_sha256="0" * 64), model)
    text = {
        "problem_recipe": "{}",
        "problem_urdf": "",
        "problem_sha256": model.problem.comparable_sha256,
    }
    with is_refused(DatasetError):
        read_file(write(tmp_path / "d.h5", **text), model)
    assert (
        len(read_file(write(tmp_path / "e.h5", problem="airhockey"), model).sample_id)
        == 2
    )
    assert len(read_file(write(tmp_path / "f.h5"), model).sample_id) == 2


def test_prescribed_goal_accelerations_raise_an_error(tmp_path, model):
    path = write(tmp_path / "a.h5", problem="airhockey")
    with h5py.File(path, "a") as file:
        file["goal_ddq"] = np.full((2, 6), 3.0)
    with is_refused(DatasetError):
        read_file(path, model)


def test_other_is_rejected_for_files_that_do_not_record_their_recipe(tmp_path, model):
    with is_refused(UsageError, argument="other"):
        read_file(write(tmp_path / "a.h5"), model, other=True)


def test_sample_ids_that_are_not_integers_raise_an_error(tmp_path, model):
    path = write(tmp_path / "a.h5")
    with h5py.File(path, "a") as file:
        file["sample_id"] = np.array([0.5, 1.0])
    with is_refused(DatasetError):
        read_file(path, model)


@needs_robots
@pytest.mark.slow
def test_a_shipped_model_plans_for_the_recipe_of_its_name(tmp_path: Path) -> None:
    out = str(tmp_path / "plans.h5")
    assert main(["plan", "panda-scenes", "--n", "2", "-o", out]) == 0
    assert len(load_plans(out)) == 2
