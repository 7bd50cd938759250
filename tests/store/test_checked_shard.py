"""Every reader of shards refuses a modified shard, whose checksums are correct."""

import shutil
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pytest

from cnpgen.errors import CnpgenError, DatasetError
from cnpgen.loader.batch_options import BatchOptions
from cnpgen.loader.load import load_dataset
from cnpgen.make.extend import extend_dataset
from cnpgen.make.generation_options import GenerationOptions
from cnpgen.make.make_dataset import make_dataset
from cnpgen.make.merge import merge_datasets
from cnpgen.planner.plan_requests import read_rows
from cnpgen.plans.boundary_problems import load_boundary_problems
from cnpgen.store.checked_shard import Shard, check_values, read_checked
from cnpgen.store.dataset_spec import ShardTask, load_dataset_spec, shards
from cnpgen.store.reader import open_dataset
from cnpgen.store.shard_record import load_record
from cnpgen.validate.validate_dataset import validate_dataset
from tests.conftest import tiny_recipe
from tests.examples.forged_shards import edit
from tests.examples.models import boundary_of_columns, untrained_model
from tests.refusals import is_refused

FILE = "train/shard-00001.h5"
ROWS = slice(250, 500)  # of this shard in the split
FIELDS = ("start_q", "goal_q", "hit_speed", "sample_id")

Change = Callable[[h5py.File], None]


def with_values(name: str, change: Callable[[np.ndarray], Any]) -> Change:
    """Replace a field by other values, of any shape and type."""

    def replace_values(file: h5py.File) -> None:
        attributes, values = dict(file[name].attrs), change(file[name][()])
        del file[name]
        file.create_dataset(name, data=values).attrs.update(attributes)

    return replace_values


def with_all_values(change: Callable[[np.ndarray], Any]) -> Change:
    def replace_all(file: h5py.File) -> None:
        for name in list(file):
            with_values(name, change)(file)

    return replace_all


def with_attribute(name: str, value: Any) -> Change:
    return lambda file: file.attrs.__setitem__(name, value)


def put(place: Any, value: float) -> Callable[[np.ndarray], np.ndarray]:
    def change(values: np.ndarray) -> np.ndarray:
        values[place] = value
        return values

    return change


SHAPES: dict[str, Callable[[np.ndarray], Any]] = {
    "one row more": lambda values: np.concatenate([values, values[-1:]]),
    "one row less": lambda values: values[:-1],
    "no rows": lambda values: values[:0],
    "one dimension more": lambda values: values[..., None],
    "a number": lambda values: values.reshape(-1)[0],
    "another type": lambda values: values.astype(
        "f4" if values.dtype.kind == "f" else "f8"
    ),
    "integers of 32 bits": lambda values: values.astype("i4"),
}
CHANGES: dict[str, Change] = {
    **{
        f"{name}: {shape}": with_values(name, change)
        for name in FIELDS
        for shape, change in SHAPES.items()
    },
    **{
        f"all: {shape}": with_all_values(SHAPES[shape])
        for shape in ("one row more", "one row less")
    },
    "start_q: one column less": with_values("start_q", lambda values: values[:, :-1]),
    "start_q: transposed": with_values("start_q", lambda values: values.T),
    "start_q: nan": with_values("start_q", put((3, 2), np.nan)),
    "goal_q: inf": with_values("goal_q", put((249, 0), -np.inf)),
    "hit_speed: nan": with_values("hit_speed", put(0, np.nan)),
    "goal_q: missing": lambda file: file.__delitem__("goal_q"),
    "sample_id: reversed": with_values("sample_id", lambda values: values[::-1]),
    "sample_id: repeated": with_values("sample_id", put(7, 250)),
    "sample_id: from 0 on": with_values("sample_id", lambda values: values - values[0]),
    "sample_id: negative": with_values("sample_id", lambda values: -values),
    "rows: more": with_attribute("rows", 251),
    "first_sample_id: another": with_attribute("first_sample_id", 0),
    "specification_key: another": with_attribute("specification_key", 5),
}


READERS: dict[str, Callable[[Path], Any]] = {
    "arrays": lambda folder: load_dataset(folder).arrays("train", fields=FIELDS)[
        "start_q"
    ][ROWS],
    "without sha256": lambda folder: load_dataset(folder, verify=False).arrays(
        "train", fields=FIELDS
    )["start_q"][ROWS],
    "batches": lambda folder: np.concatenate(
        [
            batch["start_q"]
            for batch in load_dataset(folder).batches(
                50, normalize=False, dtype="f8", options=BatchOptions(shuffle=False)
            )
        ]
    )[ROWS],
    "a row": lambda folder: np.array(
        [load_dataset(folder)["train"][row]["start_q"] for row in range(250, 500)]
    ),
    "boundary problems": lambda folder: (
        load_boundary_problems(folder, start=250, n=250).boundary.start_q
    ),
    "a shard": lambda folder: load_boundary_problems(folder / FILE).boundary.start_q,
    "requests": lambda folder: read_rows(
        folder, model_of(folder), split="train", other=True
    ).boundary.start_q[ROWS],
    "store": lambda folder: open_dataset(folder).read("train", start=250, stop=500)[
        "start_q"
    ],
}


def model_of(folder: Path) -> Any:
    columns = open_dataset(folder).read("train", stop=20)
    return untrained_model("airhockey", boundary_of_columns(columns, 20))


@pytest.fixture(scope="module")
def original(tiny: Callable[[str], Path]) -> np.ndarray:
    return open_dataset(tiny("airhockey-hit")).read("train", start=250, stop=500)[
        "start_q"
    ]


def test_every_reader_returns_the_rows_of_the_shard(
    damaged: Path, original: np.ndarray
) -> None:
    for read in READERS.values():
        assert np.array_equal(read(damaged), original)


@pytest.mark.parametrize("change", CHANGES)
def test_every_reader_refuses_a_modified_shard(damaged: Path, change: str) -> None:
    """The digests of the shard, its record and the manifest are those of the modified shard."""
    edit(damaged, FILE, CHANGES[change])
    for read in READERS.values():
        with pytest.raises(CnpgenError):
            read(damaged)
    assert FILE in {finding.file for finding in validate_dataset(damaged).findings}


@pytest.mark.parametrize(
    "change", ["start_q: one row more", "goal_q: inf", "sample_id: repeated"]
)
def test_merge_refuses_a_modified_shard(tmp_path: Path, change: str) -> None:
    parts = [
        make_dataset(
            tiny_recipe("airhockey-hit"),
            tmp_path / f"part{k}",
            shard_size=250,
            workers=1,
            options=GenerationOptions(part=(k, 2)),
        ).folder
        for k in range(2)
    ]
    name = next(part for part in parts if (part / FILE).exists())
    edit_unfinished(name, CHANGES[change])
    with is_refused(DatasetError):
        merge_datasets(parts, tmp_path / "out")


def edit_unfinished(folder: Path, change: Change) -> None:
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("tests.examples.forged_shards.finalize", lambda *_: None)
        edit(folder, FILE, change)


@pytest.mark.parametrize("change", ["goal_q: inf", "sample_id: repeated"])
def test_extend_makes_a_modified_shard_again(
    damaged: Path, original: np.ndarray, change: str
) -> None:
    edit(damaged, FILE, CHANGES[change])
    with pytest.warns(
        RuntimeWarning, match=r"a shard is damaged and is made again: .*shard-00001"
    ):
        extend_dataset(damaged, 700, workers=1)
    assert validate_dataset(damaged).ok
    assert np.array_equal(
        open_dataset(damaged).read("train", start=250, stop=500)["start_q"], original
    )


def test_a_sum_that_overflows_is_not_taken_for_infinity(damaged: Path) -> None:
    spec = load_dataset_spec(damaged)
    task = next(task for task in shards(spec) if task.file == FILE)
    shard = Shard(damaged, spec, task)
    check_values(shard, {"start_q": np.full((250, 6), 1e308)})
    with is_refused(DatasetError):
        check_values(shard, {"start_q": put((9, 5), np.nan)(np.zeros((250, 6)))})


TRUNCATE = """
import sys
from pathlib import Path
import numpy as np
from cnpgen import BatchOptions
from cnpgen.errors import CnpgenError
import cnpgen.store.checked_shard as checked
import cnpgen.store.files.hdf5 as hdf5
from cnpgen.loader.load import load_dataset
from cnpgen.store.reader import open_dataset

folder, how = Path(sys.argv[1]), sys.argv[2]
path = folder / "train" / "shard-00001.h5"

def truncate(*_):
    import os
    os.truncate(path, 5000)

def after(module, name):
    original = getattr(module, name)
    def both(*arguments, **options):
        result = original(*arguments, **options)
        if path in arguments or any(getattr(item, "path", None) == path for item in arguments):
            truncate()
        return result
    setattr(module, name, both)

def before(module, name):
    original = getattr(module, name)
    def both(*arguments, **options):
        if arguments[0] == path:
            truncate()
        return original(*arguments, **options)
    setattr(module, name, both)

if how == "header":
    after(checked, "read_placements")
elif how == "size":
    after(hdf5, "require_possible_size")
else:
    before(hdf5, "check_heaps")
read = {
    "batches": lambda: [
        batch.table.sum()
        for batch in load_dataset(folder, verify=False).batches(50, options=BatchOptions(shuffle=False))
    ],
    "arrays": lambda: load_dataset(folder, verify=False).arrays("train"),
    "store": lambda: open_dataset(folder).read("train"),
}[sys.argv[3]]
try:
    read()
except CnpgenError as error:
    print(error)
    raise SystemExit(7)
"""


@pytest.mark.parametrize("reader", ["batches", "arrays", "store"])
@pytest.mark.parametrize("time", ["header", "size", "open"])
def test_a_shard_that_is_truncated_while_it_is_read_ends_in_an_error(
    tmp_path: Path, reader: str, time: str
) -> None:
    """The shard has 8 MB, so that a memory map of its end would be outside the file."""
    folder = made_large(tmp_path / "set")
    done = subprocess.run(
        [sys.executable, "-c", TRUNCATE, str(folder), time, reader],
        capture_output=True,
        text=True,
        check=False,
    )
    assert (done.returncode, done.stderr) == (7, ""), (
        done.returncode,
        done.stdout,
        done.stderr,
    )
    assert "shard-00001.h5" in done.stdout


def made_large(folder: Path) -> Path:
    from tests.examples.loader import make

    return make(folder, splits={"train": 120_000, "validation": 10}, shard_size=60_000)


def test_links_are_refused_by_every_reader(damaged: Path, tmp_path: Path) -> None:
    task: ShardTask = next(
        task for task in shards(load_dataset_spec(damaged)) if task.file == FILE
    )
    shutil.move(damaged / FILE, tmp_path / "elsewhere.h5")
    (damaged / FILE).symlink_to(tmp_path / "elsewhere.h5")
    for read in READERS.values():
        if read is not READERS["a shard"]:  # a file that the user names
            with is_refused(DatasetError):
                read(damaged)
    spec = load_dataset_spec(damaged)
    record = load_record(damaged, task)
    with is_refused(DatasetError):
        read_checked(Shard(damaged, spec, task, record.bytes, record.sha256))


def test_parameters_outside_of_their_ranges_are_refused_by_every_reader_and_merge(
    tmp_path: Path,
) -> None:
    folder = tmp_path / "tables"
    make_dataset("airhockey-tables", folder, n=40, workers=1)
    rows = open_dataset(folder).spec.splits["train"]
    edit(folder, "train/shard-00000.h5", with_values("parameters", put((3, 3), 1.3)))
    for read in (
        lambda: open_dataset(folder).read("train", stop=rows),
        lambda: load_boundary_problems(folder, split="train"),
        lambda: load_dataset(folder).arrays("train", fields=("parameters",)),
        lambda: merge_datasets([folder], tmp_path / "out"),
    ):
        with is_refused(CnpgenError):
            read()
    assert not validate_dataset(folder, deep=True, workers=1).ok
