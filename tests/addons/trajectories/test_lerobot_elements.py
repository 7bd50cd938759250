"""Elements of LeRobot datasets that are changed, dropped or misspelt are refused or listed."""

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from cnpgen.errors import UsageError
from cnpgen.trajectories import LoadedTrajectories, load_trajectories
from tests.addons.trajectories.test_table_columns import BACKWARDS, Q, T

STATE = "observation.state"
JOINTS = BACKWARDS[::-1]


def load(
    folder: Path,
    change_info: Callable[[dict[str, Any]], Any] = lambda _: None,
    change_columns: Callable[[dict[str, Any]], Any] = lambda _: None,
) -> LoadedTrajectories:
    """Write a dataset with one episode, with changes of its description or of its columns, and load it."""
    pyarrow = pytest.importorskip("pyarrow")
    parquet = pytest.importorskip("pyarrow.parquet")
    scalar = {"dtype": "float32", "shape": [1], "names": None}
    info = {
        "codebase_version": "v3.0",
        "robot_type": "iiwa",
        "total_episodes": 1,
        "total_frames": len(T),
        "fps": 1 / float(np.median(np.diff(T))),
        "data_path": "data/chunk-{chunk_index:03d}/file-{file_index:03d}.parquet",
        "features": {
            STATE: {"dtype": "float32", "shape": [len(JOINTS)], "names": JOINTS},
            "timestamp": scalar,
            "episode_index": scalar,
        },
    }
    columns = {STATE: list(Q), "timestamp": T, "episode_index": np.zeros(len(T), int)}
    change_info(info)
    change_columns(columns)
    for name in ("meta", "data/chunk-000"):
        (folder / name).mkdir(parents=True)
    (folder / "meta" / "info.json").write_text(json.dumps(info))
    table = pyarrow.table(
        {name: pyarrow.array(list(values)) for name, values in columns.items()}
    )
    parquet.write_table(table, folder / "data" / "chunk-000" / "file-000.parquet")
    return load_trajectories(folder, "airhockey")


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda i: i.update(total_frames=7), "frames, info.json states 7"),
        (lambda i: i.update(data_path="other/{}"), "data_path must begin with data/"),
        (
            lambda i: i.update(total_frame=i.pop("total_frames")),
            "unknown key 'total_frame' .did you mean 'total_frames'",
        ),
        (lambda i: i.update(units="deg"), "attribute units of info.json"),
        (
            lambda i: i["features"].update(timestamp=0.5),
            "timestamp must be an object with keys, got 0.5",
        ),
        (
            lambda i: i["features"][STATE].update(shape=[1e999]),
            "a feature has inf values",
        ),
        (lambda i: i["features"][STATE].update(shape=[10**12]), "a feature has 10"),
        (
            lambda i: i["features"][STATE].update(unit="deg"),
            f"attribute unit of {STATE}",
        ),
        (lambda i: i["features"][STATE].update(scale=2), f"attribute scale of {STATE}"),
        (
            lambda i: i["features"]["timestamp"].update(unit="ms"),
            "attribute unit of timestamp",
        ),
        (
            lambda i: i["features"][STATE].update(
                name=i["features"][STATE].pop("names")
            ),
            "unknown key 'name' .did you mean 'names'",
        ),
        (lambda i: i["features"][STATE].update(names=BACKWARDS[1:]), "has the names"),
        (lambda i: i["features"][STATE].update(names="joints"), "has the names"),
        (
            lambda i: i["features"][STATE].update(names={"a": JOINTS, "b": BACKWARDS}),
            "does not describe a dataset",
        ),
        (lambda i: i["features"][STATE].update(shape=[6, 2]), "does not describe"),
    ],
)
def test_elements_that_contradict_the_data_are_refused(
    tmp_path: Path, change: Callable[[Any], Any], message: str
) -> None:
    with pytest.raises(UsageError, match=message):
        load(tmp_path, change)


@pytest.mark.parametrize("delay", [0.0, 1e-4])
def test_times_of_frames_have_no_rounding_to_float32(
    tmp_path: Path, delay: float
) -> None:
    late = np.where(np.arange(len(T)) == 40, T + delay, T).astype(np.float32)
    loaded = load(tmp_path, change_columns=lambda c: c.update(timestamp=late))
    (trajectory,) = loaded.trajectories
    frames = np.arange(len(T)) / 100
    # Times beside the frames are read as they are.
    expected = late.astype(float) if delay else frames
    assert np.abs(trajectory.t - expected).max() < 1e-15


def test_what_is_not_read_is_listed(tmp_path: Path) -> None:
    assert load(tmp_path / "a").ignored == ()
    found = load(
        tmp_path / "b",
        lambda info: info.update(source="arm 3"),
        lambda columns: columns.update(velocities=T),
    )
    assert found.ignored == ("attribute source of info.json", "velocities")
