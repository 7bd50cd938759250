"""Inspection of complete and unfinished datasets: specification and sidecars agree with the rows."""

import builtins
import dataclasses
import json
import shutil
from pathlib import Path

import numpy as np
import pytest

from cnpgen.errors import DatasetError, MachineError, UsageError
from cnpgen.make.make_dataset import make_dataset
from cnpgen.store.dataset_plot import MIN_CANDIDATES_PER_CELL, plot_dataset
from cnpgen.store.inspection import inspect_dataset
from cnpgen.store.reader import open_dataset
from cnpgen.store.sampling_statistics import DensityMap, SamplingStatistics
from tests.conftest import some
from tests.refusals import is_refused


@pytest.fixture(scope="session")
def hits(tmp_path_factory):
    folder = tmp_path_factory.mktemp("inspection") / "hits"
    make_dataset("airhockey-hit", folder, n=200, workers=1)
    return folder


@pytest.fixture
def unfinished(hits, tmp_path):
    folder = tmp_path / "unfinished"
    shutil.copytree(hits, folder)
    (folder / "manifest.json").unlink()
    (folder / "validation" / "shard-00000.json").unlink()
    return folder


def test_rows_and_state_of_a_complete_dataset(hits):
    found = inspect_dataset(str(hits))
    assert found.complete
    assert found.state == "complete"
    assert found.rows == {"train": 182, "validation": 18}
    assert found.bytes == sum(
        path.stat().st_size for path in hits.rglob("*") if path.is_file()
    )
    assert found.seconds > 0


def test_other_files_in_the_folder_are_not_counted_in_the_size(hits, tmp_path):
    folder = tmp_path / "hits"
    shutil.copytree(hits, folder)
    for name in ("movie.mp4", "train/notes.txt", "_work/.shard-00000.h5.tmp"):
        (folder / name).parent.mkdir(exist_ok=True)
        (folder / name).write_bytes(bytes(1000))
    assert inspect_dataset(folder).bytes == inspect_dataset(hits).bytes


def test_statistics_are_those_of_the_rows(hits):
    found, dataset = inspect_dataset(hits), open_dataset(hits)
    rows = np.concatenate(
        [dataset.read(split)["goal_q"] for split in ("train", "validation")]
    )
    np.testing.assert_array_equal(found.statistics["goal_q"].minimum, rows.min(axis=0))
    np.testing.assert_allclose(
        found.statistics["goal_q"].mean, rows.mean(axis=0), rtol=1e-12
    )


def test_the_inspection_is_frozen(hits):
    with pytest.raises(dataclasses.FrozenInstanceError):
        inspect_dataset(hits).bytes = 0


def test_the_json_contains_the_whole_inspection(hits):
    found = inspect_dataset(hits)
    content = json.loads(json.dumps(found.to_dict(), allow_nan=False))
    assert content["complete"] is True
    assert content["rows"]["train"] == {"planned": 182, "stored": 182}
    assert [item["name"] for item in content["fields"]] == [
        field.name for field in found.spec.fields
    ]
    assert len(content["fields"][0]["mean"]) == 6
    assert content["seed"] == str(found.spec.seed)
    assert content["environments"][0]["numpy"] == np.__version__
    density = content["densities"]["goal_xyz"]
    assert np.sum(density["candidates"]) == content["yield"]["tried"]
    assert np.sum(density["accepted"]) == content["yield"]["accepted"] == 200


def test_the_remaining_fraction_decreases_to_the_acceptance_in_pipeline_order(hits):
    found = inspect_dataset(hits).to_dict()["yield"]
    left = [1.0, *(step["left"] for step in found["rejections"])]
    assert left == sorted(left, reverse=True)
    assert left[-1] == pytest.approx(found["acceptance"])
    assert found["rejections"][0]["reason"] == "too close together"


def test_the_inspection_of_an_unfinished_dataset_reports_its_progress(unfinished):
    found = inspect_dataset(unfinished)
    assert not found.complete
    assert found.state.startswith("unfinished: 1 of 2 shards")
    assert found.rows == {"train": 182, "validation": 0}
    assert found.to_dict()["rows"]["validation"] == {"planned": 18, "stored": 0}


def test_a_dataset_without_any_shard_has_no_statistics(unfinished):
    (unfinished / "train" / "shard-00000.json").unlink()
    found = inspect_dataset(unfinished)
    assert found.statistics == {}
    assert "min" not in found.to_dict()["fields"][0]
    assert found.to_dict()["yield"]["acceptance"] == 0


def test_a_complete_dataset_that_lost_a_shard_is_damaged(hits, tmp_path):
    shutil.copytree(hits, tmp_path / "damaged")
    (tmp_path / "damaged" / "train" / "shard-00000.h5").unlink()
    found = inspect_dataset(tmp_path / "damaged")
    assert not found.complete
    assert found.state.startswith("damaged: 1 of 2 shards")


@pytest.mark.parametrize("content", [b"", b"{}", None])
@pytest.mark.parametrize("name", ["manifest.json", "stats.json"])
def test_a_changed_document_is_reported_as_damage(hits, tmp_path, name, content):
    folder = Path(shutil.copytree(hits, tmp_path / "damaged"))
    written = (folder / name).read_bytes()
    (folder / name).write_bytes(
        written.replace(b'"train"', b'"trian"') if content is None else content
    )
    found = inspect_dataset(folder)
    assert not found.complete
    assert found.state.startswith(f"damaged: {name}: ")
    assert found.state.endswith("; for details run 'cnpgen validate'")
    assert found.to_dict()["damage"][0].startswith(f"{name}: ")
    assert found.rows == {"train": 182, "validation": 18}


@pytest.mark.parametrize(
    ("content", "message"),
    [
        (None, "specification.json is missing"),
        (b"{", "specification.json is damaged: "),
    ],
)
def test_a_dataset_without_a_valid_specification_is_refused_with_a_hint(
    hits, tmp_path, content, message
):
    folder = Path(shutil.copytree(hits, tmp_path / "damaged"))
    (folder / "specification.json").unlink()
    if content is not None:
        (folder / "specification.json").write_bytes(content)
    with pytest.raises(
        DatasetError, match=rf"{message}.*; for a remedy run 'cnpgen validate'"
    ):
        inspect_dataset(folder)


def test_folders_without_a_dataset_are_refused(tmp_path):
    with is_refused(UsageError, argument="folder"):
        inspect_dataset(tmp_path / "nothing")
    with is_refused(UsageError, argument="folder"):
        inspect_dataset(tmp_path)
    (tmp_path / "file").write_text("")
    with is_refused(UsageError, argument="folder"):
        inspect_dataset(tmp_path / "file")


def test_constant_fields_are_left_out_of_a_plot(hits, tmp_path, monkeypatch):
    from matplotlib.figure import Figure

    figures: list[Figure] = []
    monkeypatch.setattr(Figure, "savefig", lambda self, path: figures.append(self))
    found = inspect_dataset(hits)
    assert found.statistics["start_dq"].constant.all()  # hits start at rest
    plot_dataset(found, tmp_path / "hits.png")
    titles = [axis.get_title() for axis in figures[0].subfigs[0].axes]
    assert titles == ["start_q, goal_q [rad]", "goal_dq [rad/s]"]


@pytest.mark.slow
@pytest.mark.parametrize("suffix", some(["png", "svg"]))
def test_a_dataset_is_plotted(hits, tmp_path, suffix):
    plot_dataset(inspect_dataset(hits), tmp_path / f"hits.{suffix}")
    assert (tmp_path / f"hits.{suffix}").stat().st_size > 10_000


@pytest.mark.slow
def test_an_unfinished_dataset_is_plotted(unfinished, tmp_path):
    plot_dataset(inspect_dataset(unfinished), tmp_path / "hits.png")
    assert (tmp_path / "hits.png").exists()


@pytest.mark.slow
def test_a_density_map_of_a_single_point_is_plotted(hits, tmp_path, monkeypatch):
    found = inspect_dataset(hits)
    density = DensityMap(
        (0.6, 0.6), (0.0, 0.0), np.zeros((4, 4), np.int64), np.zeros((4, 4), np.int64)
    )
    monkeypatch.setitem(
        vars(found.summary),
        "sampling",
        SamplingStatistics(tried=0, accepted=0, densities={"start_xyz": density}),
    )
    plot_dataset(found, tmp_path / "point.png")
    assert (tmp_path / "point.png").exists()


def test_a_dataset_without_rows_cannot_be_plotted(unfinished, tmp_path):
    (unfinished / "train" / "shard-00000.json").unlink()
    with is_refused(DatasetError):
        plot_dataset(inspect_dataset(unfinished), tmp_path / "hits.png")


@pytest.mark.slow
@pytest.mark.parametrize(
    ("n_candidates", "cells"), [(200, 2), (2_000, 8), (100_000, 24)]
)
def test_cells_of_a_density_map_have_enough_candidates(
    n_candidates, cells, hits, tmp_path, monkeypatch
):
    from matplotlib.figure import Figure

    random = np.random.default_rng(0)
    candidates = np.bincount(
        random.integers(0, 24 * 24, n_candidates), minlength=24 * 24
    ).reshape(24, 24)
    accepted = random.binomial(candidates, 0.5)
    accepted[:12] = 0  # none of the lower half of x
    density = DensityMap((0.0, 1.0), (0.0, 1.0), candidates, accepted)
    found = inspect_dataset(hits)
    figures: list[Figure] = []
    monkeypatch.setattr(Figure, "savefig", lambda self, path: figures.append(self))
    monkeypatch.setitem(
        vars(found.summary),
        "sampling",
        SamplingStatistics(tried=0, accepted=0, densities={"start_xyz": density}),
    )
    plot_dataset(found, tmp_path / "map.png")
    (picture,) = (
        image
        for part in figures[0].subfigs
        for axis in part.axes
        for image in axis.get_images()
    )
    share = picture.get_array().T
    assert share.shape == (cells, cells)
    assert n_candidates / cells**2 >= MIN_CANDIDATES_PER_CELL
    np.testing.assert_array_equal(share[: cells // 2].compressed(), 0)
    assert share[cells // 2 :].mean() == pytest.approx(0.5, abs=0.1)
    (legend,) = (legend for part in figures[0].subfigs for legend in part.legends)
    figures[0].draw_without_rendering()
    box = legend.get_window_extent()
    assert not any(
        box.overlaps(axis.get_window_extent())
        for part in figures[0].subfigs
        for axis in part.axes
    )


def test_missing_matplotlib_is_a_hint_and_not_a_traceback(hits, tmp_path, monkeypatch):
    original = builtins.__import__

    def without(name, *rest, **more):
        if name.startswith("matplotlib"):
            raise ModuleNotFoundError("No module named 'matplotlib'", name="matplotlib")
        return original(name, *rest, **more)

    monkeypatch.setattr(builtins, "__import__", without)
    with is_refused(MachineError):
        plot_dataset(inspect_dataset(hits), tmp_path / "hits.png")


@pytest.mark.slow
def test_a_figure_that_cannot_be_written_is_a_machine_error(hits, tmp_path):
    (tmp_path / "no").write_text("a file")
    with is_refused(MachineError):
        plot_dataset(inspect_dataset(hits), tmp_path / "no" / "such" / "folder.png")
