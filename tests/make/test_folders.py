"""The folder of a dataset: what is somebody else's is never touched, what costs nothing gives way."""

import errno
import os
import shutil
import subprocess
import sys
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

import cnpgen
from cnpgen.cli.main import main
from cnpgen.errors import DatasetError, MachineError, RecipeError, UsageError
from cnpgen.make.make_dataset import make_dataset
from cnpgen.pipelines.prepared import PreparedPipeline
from cnpgen.store.dataset_spec import load_dataset_spec
from cnpgen.validate.validate_dataset import validate_dataset
from tests.conftest import TINY_SHARD, some, tiny_recipe
from tests.examples.tiny_datasets import digests, flip, make_tiny, snapshot
from tests.refusals import is_refused


@pytest.fixture
def folder(tiny: Callable[[str], Path], tmp_path: Path) -> Path:
    """A copy of a finished dataset."""
    return Path(shutil.copytree(tiny("airhockey-hit"), tmp_path / "out"))


CHANGES = {
    "seed": {"seed": 1},
    "dtype": {"dtype": "float32"},
    "backend": {"backend": "numpy"},
    "shard_size": {"shard_size": 100},
}


@pytest.mark.parametrize("what", CHANGES)
def test_another_dataset_in_the_folder_is_refused_and_not_touched(folder, what):
    if CHANGES[what] == {"backend": load_dataset_spec(folder).backend}:
        pytest.skip("this is the only backend here")
    before = snapshot(folder)
    words = what.replace("_", " ")
    with pytest.raises(
        UsageError, match=f"holds another dataset .*{words} .* instead of .*force=True"
    ):
        make_tiny(folder, **CHANGES[what])
    assert snapshot(folder) == before


def test_another_recipe_in_the_folder_is_refused_and_not_touched(folder):
    before = snapshot(folder)
    with is_refused(UsageError, argument="out"):
        make_tiny(folder, "heavy-object")
    changed = tiny_recipe("airhockey-hit")
    stages = changed.pipeline.stage
    changed = replace(
        changed, pipeline=replace(changed.pipeline, stage=(*stages, stages[-1]))
    )
    with is_refused(UsageError, argument="out"):
        make_dataset(changed, folder, workers=1, shard_size=TINY_SHARD)
    assert snapshot(folder) == before


def test_a_corrected_title_is_the_same_dataset(folder):
    before = snapshot(folder)
    changed = tiny_recipe("airhockey-hit")
    problem = replace(changed.pipeline.problem, title="other words")
    changed = replace(
        changed, pipeline=replace(changed.pipeline, title="corrected", problem=problem)
    )
    made = make_dataset(changed, folder, workers=1)
    assert (made.made, made.complete) == (0, True)
    assert snapshot(folder) == before


@pytest.mark.parametrize("rows", [1320, 330])
def test_another_size_is_refused_with_what_can_be_done(folder, rows):
    before = snapshot(folder)
    with pytest.raises(UsageError) as caught:
        make_dataset(tiny_recipe("airhockey-hit"), folder, n=rows, workers=1)
    text = str(caught.value)
    assert (
        "holds this dataset with 660 rows (train 600, validation 60), not with" in text
    )
    assert (
        f"{rows:,} rows (train {rows * 10 // 11:,}, validation {rows // 11:,})" in text
    )
    extend = (
        "extend_dataset or 'cnpgen extend' adds the rows, or " if rows > 660 else ""
    )
    assert (
        f"the common rows are the same: {extend}choose another out=, or replace it with force=True"
        in text
    )
    assert snapshot(folder) == before


def test_force_replaces_another_dataset(folder):
    made = make_tiny(folder, "airhockey-replan", force=True, shard_size=400)
    assert made.complete
    assert validate_dataset(folder).ok
    assert sorted(digests(folder)) == [
        "train/shard-00000.h5",
        "train/shard-00001.h5",
        "validation/shard-00000.h5",
    ]


# --- specifications without shards ----------------------------------------------------------------------------------


def hopeless(monkeypatch) -> None:
    """Let no draw be accepted."""
    run = PreparedPipeline._sample_batch

    def rejected(self, random, size):
        candidates = run(self, random, size)
        candidates.stage = "test"
        candidates.reject(np.zeros(len(candidates.alive), bool), "hopeless")
        return candidates

    monkeypatch.setattr(PreparedPipeline, "_sample_batch", rejected)


@pytest.mark.slow
def test_a_recipe_that_accepts_nothing_does_not_block_the_folder_for_the_corrected_one(
    tmp_path, monkeypatch
):
    hopeless(monkeypatch)
    with is_refused(RecipeError):
        make_tiny(tmp_path / "out", seed=1, shard_size=77)
    monkeypatch.undo()
    assert (tmp_path / "out" / "specification.json").is_file()
    assert make_tiny(tmp_path / "out", seed=2).complete
    assert load_dataset_spec(tmp_path / "out").seed == 2
    assert validate_dataset(tmp_path / "out").ok


@pytest.mark.parametrize("content", some(["cut", "flipped"], 1, "slow"))
def test_a_damaged_specification_without_rows_is_replaced(tmp_path, content):
    folder = tmp_path / "out"
    make_tiny(folder, part=(0, 9))
    assert not digests(folder)
    path = folder / "specification.json"
    if content == "cut":
        path.write_bytes(path.read_bytes()[:200])
    else:
        flip(path)
    assert make_tiny(folder).complete
    assert validate_dataset(folder).ok


@pytest.mark.parametrize("content", some([b"", b"{", b"garbage", None], 2, "slow"))
def test_a_damaged_specification_with_rows_is_refused_unless_forced(folder, content):
    if content is None:
        flip(folder / "specification.json")
    else:
        (folder / "specification.json").write_bytes(content)
    before = snapshot(folder)
    with is_refused(DatasetError, argument="force"):
        make_tiny(folder)
    assert snapshot(folder) == before
    assert make_tiny(folder, force=True).complete
    assert validate_dataset(folder).ok


def test_force_works_where_the_specification_is_damaged_and_a_record_or_all_documents_are_lost(
    folder,
):
    (folder / "specification.json").write_bytes(b"")
    for name in (
        "manifest.json",
        "stats.json",
        "README.md",
        "croissant.json",
        "validation/shard-00000.json",
    ):
        (folder / name).unlink()
    assert make_tiny(folder, force=True).complete
    assert validate_dataset(folder).ok


def test_force_works_where_the_specification_is_lost(folder):
    (folder / "specification.json").unlink()
    with is_refused(DatasetError, argument="force"):
        make_tiny(folder)
    assert make_tiny(folder, force=True).complete
    assert validate_dataset(folder).ok


# --- what is somebody else's ------------------------------------------------------------------------------------------


@pytest.mark.parametrize("force", [False, True])
@pytest.mark.parametrize("spec", [None, "", "{}", '{"terraform": 1}'])
def test_a_folder_that_is_no_dataset_is_refused_and_not_touched(tmp_path, force, spec):
    (tmp_path / "thesis.tex").write_text("years of work")
    (tmp_path / "README.md").write_text("mine")
    (tmp_path / "train").mkdir()
    (tmp_path / "train" / "shard-00000.h5").write_text("somebody else's")
    (tmp_path / "train" / "shard-00000.json").write_text('{"weights": 3}')
    if spec is not None:
        (tmp_path / "specification.json").write_text(spec)
    before = snapshot(tmp_path)
    with is_refused(UsageError, argument="out"):
        make_tiny(tmp_path, force=force)
    assert snapshot(tmp_path) == before


def test_no_other_path_hides_the_content_of_a_folder(tmp_path):
    (tmp_path / "mine").mkdir()
    (tmp_path / "mine" / "README.md").write_text("mine")
    with is_refused(UsageError, argument="out"):
        make_tiny(tmp_path / "missing" / ".." / "mine")
    assert snapshot(tmp_path) == {"mine/README.md": b"mine"}


@pytest.mark.parametrize(
    "name",
    ["train/notes.txt", "thesis.tex", "train/shard-1.h5", "train/shard-00000.h5.bak"],
)
def test_force_does_not_delete_a_dataset_with_foreign_files(folder, name):
    (folder / name).write_text("mine")
    before = snapshot(folder)
    with is_refused(UsageError):
        make_tiny(folder, seed=3, force=True)
    assert snapshot(folder) == before


def test_force_does_not_follow_a_link_out_of_the_folder(folder, tmp_path):
    shutil.move(folder / "train", tmp_path / "precious")
    (folder / "train").symlink_to(tmp_path / "precious")
    with is_refused(UsageError):
        make_tiny(folder, seed=3, force=True)
    assert len(list((tmp_path / "precious").iterdir())) == 6


def test_a_deletion_that_is_cut_off_leaves_what_force_can_delete(folder, monkeypatch):
    unlink, calls = Path.unlink, []

    def refuse(self: Path, missing_ok: bool = False) -> None:
        calls.append(self)
        if len(calls) == 4:
            raise OSError(errno.EIO, os.strerror(errno.EIO))
        unlink(self, missing_ok=missing_ok)

    monkeypatch.setattr(Path, "unlink", refuse)
    with is_refused(MachineError):
        make_tiny(folder, seed=3, force=True)
    monkeypatch.undo()
    assert not (folder / "manifest.json").exists()
    assert make_tiny(folder, seed=3, force=True).complete
    assert validate_dataset(folder).ok


# --- places where nothing can be made ---------------------------------------------------------------------------------


def refused(capsys, out: str) -> tuple[int, str]:
    """Try to make a dataset in a place; return the exit code and the only line."""
    code = main(
        [
            "make-dataset",
            "airhockey-hit",
            "--n",
            "100",
            "--workers",
            "1",
            "--quiet",
            "--out",
            out,
        ]
    )
    said = capsys.readouterr()
    (line,) = said.err.splitlines()
    assert said.out == ""
    assert line.startswith("cnpgen: error: ")
    return code, line


def test_a_place_where_no_folder_can_be_is_one_line_with_what_to_do(tmp_path, capsys):
    (tmp_path / "file").write_text("mine")
    expected = {
        "": (
            2,
            "the argument after '--out' is empty: is it an unset variable of the shell?",
        ),
        str(tmp_path / "file"): (
            2,
            "file is a file, not a folder; choose another --out",
        ),
        str(tmp_path / "file" / "below" / "it"): (
            2,
            "file is a file, not a folder; choose another --out",
        ),
        str(tmp_path / ("x" * 300)): (3, "File name too long; choose a shorter name"),
    }
    for out, (code, text) in expected.items():
        found, line = refused(capsys, out)
        assert (found, text in line) == (code, True), line
    assert (tmp_path / "file").read_text() == "mine"
    assert [path.name for path in tmp_path.iterdir()] == ["file"]


@pytest.mark.skipif(not Path("/proc/self").exists(), reason="needs /proc")
def test_a_place_that_the_system_does_not_give_is_a_machine_error(capsys):
    code, line = refused(capsys, "/proc/x")
    assert code == 3
    assert "cannot " in line
    assert "/proc/x: " in line
    assert "; choose " in line


@pytest.mark.usefixtures("file_permissions")
def test_a_read_only_folder_is_a_machine_error_before_any_work_is_done(
    tmp_path, capsys, monkeypatch
):
    tmp_path.chmod(0o555)
    monkeypatch.setattr("cnpgen.make.make_dataset.resolve", None)
    code, line = refused(capsys, str(tmp_path / "new"))
    assert code == 3
    assert line.endswith(
        "new: Permission denied; choose a folder that you may write to"
    )
    assert not list(tmp_path.iterdir())


@pytest.fixture
def disk(tmp_path: Path) -> Iterator[Callable[..., None]]:
    """A file system of its own in ``tmp_path / "disk"``, which can be mounted again in another way."""
    (tmp_path / "disk").mkdir()

    def mount(*options: str) -> None:
        command = [
            "mount",
            "-t",
            "tmpfs",
            "-o",
            ",".join(["size=8m", *options]),
            "tmpfs",
            str(tmp_path / "disk"),
        ]
        if (
            shutil.which("mount") is None
            or subprocess.run(command, capture_output=True, check=False).returncode
        ):
            pytest.skip("this user cannot mount a file system")

    mount()
    yield mount
    subprocess.run(["umount", str(tmp_path / "disk")], check=True)


def test_a_finished_dataset_on_read_only_storage_is_left_as_it_is(
    tmp_path, disk, capsys
):
    out = str(tmp_path / "disk" / "out")
    command = [
        "make-dataset",
        "airhockey-hit",
        "--n",
        "100",
        "--workers",
        "1",
        "--out",
        out,
    ]
    assert main(command) == 0
    disk("remount", "ro")
    before = snapshot(Path(out))
    capsys.readouterr()
    assert main(command) == 0
    assert "already complete" in capsys.readouterr().err
    for other in (out + "2", str(tmp_path / "disk" / "a" / "b")):
        code, line = refused(capsys, other)
        assert code == 3
        assert (
            line
            == f"cnpgen: error: cannot write {other}: Read-only file system; choose another folder"
        )
    assert snapshot(Path(out)) == before


def test_a_folder_that_is_deleted_while_the_dataset_is_made_is_said_to_be_that(
    tmp_path,
):
    out = tmp_path / "out"
    with is_refused(MachineError):
        make_tiny(out, progress=lambda *_: shutil.rmtree(out))
    assert not out.exists()
    with is_refused(MachineError):
        make_tiny(out, progress=lambda *_: (out / "specification.json").unlink())


@pytest.mark.slow
@pytest.mark.skipif(sys.platform != "linux", reason="file names are Unicode here")
def test_a_folder_whose_name_is_not_utf_8_is_like_any_other(tiny, tmp_path):
    out = tmp_path / os.fsdecode(b"d\xff")
    assert make_tiny(out).complete
    assert digests(out) == digests(tiny("airhockey-hit"))
    assert validate_dataset(out, deep=True).ok
    assert make_tiny(out).made == 0
    assert 'load_dataset("./d\ufffd")' in (out / "README.md").read_text(
        encoding="utf-8"
    )
    command = [
        sys.executable,
        "-m",
        "cnpgen",
        "make-dataset",
        "airhockey-hit",
        "--n",
        "50",
        "-o",
        "e\udcff",
    ]
    done = subprocess.run(command, cwd=tmp_path, capture_output=True, check=False)
    assert (done.returncode, done.stdout) == (0, b"e\\udcff\n"), done.stderr
    assert cnpgen.load_dataset(tmp_path / os.fsdecode(b"e\xff")).arrays("train")


WRONG = {
    "n": ({"n": 0}, "n must be an integer from 1 to 1000000000000, got 0"),
    "negative n": ({"n": -5}, "n must be an integer from 1 to 1000000000000, got -5"),
    "seed": (
        {"seed": -1},
        "seed must be an integer from 0 to 9223372036854775807, got -1",
    ),
    "shard size": ({"shard_size": 0}, "shard_size must be an integer from 1 on, got 0"),
    "dtype": (
        {"dtype": "float16"},
        "dtype must be 'float64' or 'float32', got 'float16'",
    ),
    "backend": ({"backend": "cuda"}, "backend 'cuda' does not exist"),
    "workers": ({"workers": 0}, "workers must be an integer from 1 on, got 0"),
    "part outside the last": (
        {"part": (2, 2)},
        "part must be K/M with 0 <= K < M, got 2/2|--force would delete",
    ),
    "part of nothing": ({"part": (0, 0)}, "part must be K/M|--force would delete"),
}


@pytest.mark.parametrize("force", [False, True])
@pytest.mark.parametrize("what", WRONG)
def test_arguments_that_make_no_sense_are_refused_before_anything_is_touched(
    folder, what, force
):
    before = snapshot(folder)
    options, text = WRONG[what]
    with pytest.raises(UsageError, match=text):
        make_tiny(folder, force=force, **options)
    assert snapshot(folder) == before


def test_a_recipe_that_does_not_exist_is_a_recipe_error(tmp_path):
    with is_refused(RecipeError, argument="recipe"):
        make_dataset("airhockey-replay", tmp_path / "out")
    assert not (tmp_path / "out").exists()
