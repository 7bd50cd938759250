"""Running make_dataset again: what is sound is kept, what is damaged is noticed and made again."""

import shutil
import warnings
from collections.abc import Callable
from pathlib import Path

import pytest

from cnpgen.make import make_dataset as making
from cnpgen.make.generation_options import GenerationOptions
from cnpgen.make.make_dataset import make_dataset
from cnpgen.store.dataset_spec import load_dataset_spec, shards
from cnpgen.store.layout import MANIFEST
from cnpgen.store.manifest import load_manifest
from cnpgen.validate.validate_dataset import validate_dataset
from tests.conftest import some, tiny_recipe
from tests.examples.tiny_datasets import digests, flip, make_tiny, snapshot

DOCUMENTS = ("manifest.json", "stats.json", "README.md", "croissant.json")


@pytest.fixture
def folder(tiny: Callable[[str], Path], tmp_path: Path) -> Path:
    """A copy of a finished dataset of four shards."""
    return Path(shutil.copytree(tiny("airhockey-hit"), tmp_path / "airhockey-hit"))


def test_a_finished_dataset_is_left_as_it_is(folder):
    before = snapshot(folder)
    times = {path: path.stat().st_mtime_ns for path in folder.rglob("*")}
    made = make_tiny(folder)
    assert (made.made, made.complete, made.repaired) == (0, True, ())
    assert snapshot(folder) == before
    assert {path: path.stat().st_mtime_ns for path in folder.rglob("*")} == times


@pytest.mark.parametrize("where", some([0.0, 0.4, 1.0], 1, "slow"))
@pytest.mark.parametrize(
    "name", ["train/shard-00001.h5", "validation/shard-00000.json"]
)
def test_a_flipped_bit_in_a_shard_or_its_record_is_noticed_and_made_good(
    tiny, folder, name, where
):
    flip(folder / name, where)
    with pytest.warns(
        RuntimeWarning,
        match=f"a shard is damaged and is made again: .*{Path(name).stem}",
    ):
        made = make_tiny(folder)
    assert made.made == (250 if "train" in name else 60)
    assert (made.complete, made.repaired) == (True, (name.replace(".json", ".h5"),))
    assert digests(folder) == digests(tiny("airhockey-hit"))
    assert validate_dataset(folder).ok


@pytest.mark.filterwarnings("ignore:.*(made|written) again:RuntimeWarning")
@pytest.mark.parametrize(
    "name", some(["manifest.json", "stats.json", "train/shard-00000.json"], 1, "slow")
)
def test_a_document_of_brackets_is_made_good(tiny, folder, name):
    (folder / name).write_text("[" * 200_000)
    assert make_tiny(folder).complete
    assert digests(folder) == digests(tiny("airhockey-hit"))
    assert validate_dataset(folder).ok


@pytest.mark.parametrize("size", some([100, 0, 5000], 1, "slow"))
def test_a_truncated_shard_is_noticed_and_made_good(tiny, folder, size):
    path = folder / "train" / "shard-00000.h5"
    path.write_bytes(path.read_bytes()[:size])
    with pytest.warns(
        RuntimeWarning,
        match=f"shard-00000.h5 is not the recorded file: it has {size} bytes",
    ):
        make_tiny(folder)
    assert digests(folder) == digests(tiny("airhockey-hit"))


def test_several_damaged_shards_are_one_line(tiny, folder):
    for task in shards(load_dataset_spec(folder))[1:]:
        flip(folder / task.file)
    with pytest.warns(
        RuntimeWarning,
        match=r"^3 shards are damaged and are made again: .*shard-00001.h5 was changed",
    ):
        made = make_tiny(folder)
    assert (made.made, len(made.repaired)) == (410, 3)
    assert digests(folder) == digests(tiny("airhockey-hit"))


def test_lost_files_are_made_again(tiny, folder):
    (folder / "train" / "shard-00001.h5").unlink()
    (folder / "train" / "shard-00002.json").unlink()
    (folder / "validation" / "shard-00000.json").write_text("{")
    with pytest.warns(RuntimeWarning, match="^3 shards are damaged"):
        made = make_tiny(folder)
    assert (made.made, made.complete) == (410, True)
    assert digests(folder) == digests(tiny("airhockey-hit"))
    assert validate_dataset(folder).ok


@pytest.mark.parametrize(
    "lost", [[".json"], [".h5"], [".json", ".h5"]], ids=["record", "rows", "both"]
)
def test_a_shard_lost_from_a_finished_dataset_is_named_and_the_dataset_unfinished_until_it_is_there(
    tiny, folder, lost
):
    for ending in lost:
        (folder / "train" / f"shard-00001{ending}").unlink()
    has_checksum: list[tuple[str, bool]] = []
    with pytest.warns(
        RuntimeWarning,
        match=r"^a shard is damaged and is made again: .*shard-00001\.(json|h5) is",
    ):
        made = make_tiny(
            folder,
            begin=lambda step, *_: has_checksum.append(
                (step, (folder / MANIFEST).exists())
            ),
        )
    assert has_checksum == [("checking", True), ("making", False)]
    assert (made.made, made.complete, made.repaired) == (
        250,
        True,
        ("train/shard-00001.h5",),
    )
    assert digests(folder) == digests(tiny("airhockey-hit"))


def test_a_shard_whose_record_was_not_written_before_a_run_ended_is_made_without_a_warning(
    tiny, folder
):
    for name in (MANIFEST, "train/shard-00001.json"):
        (folder / name).unlink()
    made = make_tiny(folder)  # warnings are errors
    assert (made.made, made.complete, made.repaired) == (250, True, ())
    assert digests(folder) == digests(tiny("airhockey-hit"))


@pytest.mark.parametrize("action", ["flip", "cut", "empty", "delete"])
@pytest.mark.parametrize("name", some(DOCUMENTS, 1, "slow"))
def test_a_damaged_document_is_noticed_and_written_again(tiny, folder, name, action):
    path = folder / name
    if action == "flip":
        flip(path)
    elif action == "delete":
        path.unlink()
    else:
        path.write_bytes(path.read_bytes()[: 100 if action == "cut" else 0])
    with warnings.catch_warnings(record=True) as said:
        warnings.simplefilter("always")
        made = make_tiny(folder)
    unfinished = (
        name == MANIFEST and action == "delete"
    )  # what was begun and not finished is no damage
    assert [
        str(item.message).startswith(f"written again: {name}: ") for item in said
    ] == [True] * (not unfinished)
    assert (made.made, made.complete, made.repaired) == (0, True, (name,))
    assert snapshot(folder) == snapshot(tiny("airhockey-hit"))


def test_a_manifest_that_knows_other_sidecars_is_written_again(tmp_path, folder):
    make_tiny(tmp_path / "other")  # the same rows, but other working times
    for name in ("train/shard-00000.json", "validation/shard-00000.json"):
        shutil.copy(tmp_path / "other" / name, folder / name)
    assert not validate_dataset(folder).ok
    with pytest.warns(
        RuntimeWarning, match=r"written again: train/shard-00000.json: was changed"
    ):
        make_tiny(folder)
    assert validate_dataset(folder).ok


def test_a_dataset_with_a_damaged_shard_is_unfinished_until_it_is_made_good(
    folder, monkeypatch
):
    flip(folder / "train" / "shard-00000.h5")

    def killed(*_arguments: object) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr("cnpgen.make.make_dataset.make_shards", killed)
    with (
        pytest.warns(RuntimeWarning, match="damaged"),
        pytest.raises(KeyboardInterrupt),
    ):
        make_tiny(folder)
    assert not (folder / MANIFEST).exists()
    assert not list(folder.glob("train/shard-00000.*"))


def test_a_part_looks_after_its_own_shards(folder):
    for name in ("train/shard-00000.h5", "validation/shard-00000.h5"):
        flip(folder / name)
    with pytest.warns(RuntimeWarning, match=r"a shard is damaged .*train.shard-00000"):
        first = make_tiny(folder, part=(0, 2))
    assert first.repaired == ("train/shard-00000.h5",)
    with pytest.warns(
        RuntimeWarning, match=r"a shard is damaged .*validation.shard-00000"
    ):
        make_tiny(folder, part=(1, 2))
    assert validate_dataset(folder).ok


def test_whoever_watches_is_told_of_the_comparison_and_then_of_the_making(folder):
    flip(folder / "train" / "shard-00002.h5")
    begun, seen = [], []
    with pytest.warns(RuntimeWarning, match="damaged"):
        make_tiny(
            folder, begin=lambda *x: begun.append(x), progress=lambda *x: seen.append(x)
        )
    assert begun == [("checking", folder, 660, 0), ("making", folder, 660, 560)]
    assert [rows for rows, _ in seen] == [250, 250, 100, 60, 100]
    assert [sampling is None for _, sampling in seen] == [True] * 4 + [False]


def test_shards_are_compared_by_several_threads_and_an_interruption_cancels_the_rest(
    folder, monkeypatch
):
    spec = load_dataset_spec(folder)
    tasks = shards(spec) * 200
    compared = []
    check = making.check_committed
    monkeypatch.setattr(
        making, "check_committed", lambda *x: (compared.append(x), check(*x))[1]
    )

    def interrupt(*_: object) -> None:
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        making.find_damaged(folder, spec, tasks, progress=interrupt)
    assert 1 <= len(compared) < len(tasks)


@pytest.mark.slow
def test_shard_size_and_backend_of_an_unfinished_dataset_are_kept(tmp_path):
    recipe = tiny_recipe("airhockey-hit")
    make_dataset(
        recipe,
        tmp_path,
        shard_size=77,
        workers=1,
        options=GenerationOptions(backend="numpy", part=(0, 2)),
    )
    made = make_dataset(recipe, tmp_path, workers=1)
    assert made.complete
    assert (made.spec.shard_size, made.spec.backend) == (77, "numpy")
    assert load_manifest(tmp_path)["shard_size"] == 77
