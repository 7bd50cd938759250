"""Export format of LeRobot: plans as episodes of a LeRobotDataset v3.0, for imitation learning.

A frame has the positions and velocities as ``observation.state``, goal, task columns
and scene as ``observation.environment_state``, and the positions at the next frame as
``action``.
"""

import json
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from cnpgen.addons.trajectories.lerobot_tables import (
    LEROBOT_ACTION,
    LEROBOT_ENVIRONMENT,
    LEROBOT_INFO,
    LEROBOT_STATE,
)
from cnpgen.documents import JsonObject
from cnpgen.errors import UsageError, requires_extra
from cnpgen.plans.exporter import ExportedSet, Exporter, SampledPlan
from cnpgen.plans.formats import fixed_lists, write_parquet
from cnpgen.store.files.atomic import write_file

Values = NDArray[Any]
Episode = dict[str, Values]  # of one plan: values of the K frames, shape (K,) or (K, w)

LEROBOT_VERSION = "v3.0"
MAX_CHUNK_FILES = 1000  # in a folder
MAX_DATA_FILE_MB = 100
MAX_VIDEO_FILE_MB = 200  # there are none, but readers expect the number
DATA_PATH = "data/chunk-{chunk_index:03d}/file-{file_index:03d}.parquet"
EPISODES_PATH = "meta/episodes/chunk-000/file-000.parquet"
QUANTILES = (0.01, 0.1, 0.5, 0.9, 0.99)
_INDICES = {
    "timestamp": "float32",
    "frame_index": "int64",
    "episode_index": "int64",
    "index": "int64",
}


@dataclass(frozen=True)
class LeRobotDataset(Exporter):
    """A folder with a LeRobotDataset v3.0: one episode per plan, frames at the rate of the export.

    Plans that last less than one frame have one. ``observation.environment_state`` is
    absent if there are no values.
    """

    suffix = "-lerobot"
    single_file = True
    is_folder = True
    uses_environment = True

    def write(
        self, path: Path, plans: Iterable[SampledPlan], exported: ExportedSet
    ) -> None:
        """Write the dataset, its description last; see ``Exporter.write``."""
        with requires_extra("parquet", "pyarrow"):
            import pyarrow  # noqa: F401
        if exported.rate != round(exported.rate):
            raise UsageError(
                f"LeRobot needs a whole number of frames per second, got {exported.rate:g}",
                concerns="rate",
            )
        if (path / LEROBOT_INFO).exists():
            # An incomplete dataset has none.
            (path / LEROBOT_INFO).unlink()
        names = _names(exported)
        episodes, files = _write_frames(path, plans, exported, names)
        task = f"{exported.problem}: move to the goal"
        _write_episodes(path, episodes, files, task)
        _write_tasks(path, task)
        write_file(
            path / "meta" / "stats.json",
            json.dumps(_statistics(_joined(episodes)), indent=2),
        )
        info = _info(exported, names, [len(episode["index"]) for episode in episodes])
        write_file(path / LEROBOT_INFO, json.dumps(info, indent=2))


def _names(exported: ExportedSet) -> dict[str, list[str]]:
    """Return the names of the values of every feature."""
    joints = exported.joint_names
    environment = [
        name if values.shape[1] == 1 else f"{name}_{k}"
        for name, values in exported.environment.items()
        for k in range(values.shape[1])
    ]
    state = [*joints, *(f"{joint}_velocity" for joint in joints)]
    return {
        LEROBOT_STATE: state,
        **({LEROBOT_ENVIRONMENT: environment} if environment else {}),
        LEROBOT_ACTION: list(joints),
    }


def _write_frames(
    path: Path,
    plans: Iterable[SampledPlan],
    exported: ExportedSet,
    names: Mapping[str, list[str]],
) -> tuple[list[Episode], list[int]]:
    """Write the files of frames.

    Return the episodes and the index of the file of each.
    """
    environment = np.concatenate(
        [np.empty((len(exported.index), 0)), *exported.environment.values()], axis=1
    )
    episodes: list[Episode] = []
    files: list[int] = []
    file = size = first = begin = 0
    for number, plan in enumerate(plans):
        columns = _frames(plan, exported.rate, environment[number], number, first)
        columns = {name: columns[name] for name in (*names, *_INDICES, "task_index")}
        added = sum(values.nbytes for values in columns.values())
        if size and size + added > MAX_DATA_FILE_MB * 2**20:
            _write_file(path, episodes[begin:], file)
            begin = number
            file = file + 1
            size = 0
        episodes.append(columns)
        files.append(file)
        size = size + added
        first = first + len(columns["index"])
    _write_file(path, episodes[begin:], file)
    return episodes, files


def _joined(episodes: list[Episode]) -> Episode:
    """Return the columns of several episodes, one after the other."""
    return {
        name: np.concatenate([episode[name] for episode in episodes])
        for name in episodes[0]
    }


def _frames(
    plan: SampledPlan, rate: float, environment: Values, number: int, first: int
) -> dict[str, Values]:
    """Return the columns of one episode.

    The last sample of the plan is the last action.
    """
    count = len(plan.t) - 1
    frame = np.arange(count)
    return {
        LEROBOT_STATE: np.concatenate([plan.q[:-1], plan.dq[:-1]], axis=1).astype(
            np.float32
        ),
        LEROBOT_ENVIRONMENT: np.tile(environment.astype(np.float32), (count, 1)),
        LEROBOT_ACTION: plan.q[1:].astype(np.float32),
        "timestamp": (frame / rate).astype(np.float32),
        "frame_index": frame,
        "episode_index": np.full(count, number),
        "index": first + frame,
        "task_index": np.zeros(count, np.int64),
    }


def _write_file(path: Path, episodes: list[Episode], file: int) -> None:
    """Write the frames of some episodes."""
    import pyarrow

    chunk, index = divmod(file, MAX_CHUNK_FILES)
    columns = {
        name: fixed_lists(values) if values.ndim == 2 else values
        for name, values in _joined(episodes).items()
    }
    write_parquet(
        path / DATA_PATH.format(chunk_index=chunk, file_index=index),
        pyarrow.table(columns),
    )


def _write_episodes(
    path: Path, episodes: list[Episode], files: list[int], task: str
) -> None:
    """Write the table of episodes with their statistics."""
    import pyarrow

    lengths = np.array([len(episode["index"]) for episode in episodes])
    ends = np.cumsum(lengths)
    chunks = np.divmod(files, MAX_CHUNK_FILES)
    table: JsonObject = {
        "episode_index": np.arange(len(episodes)),
        "tasks": [[task]] * len(episodes),
        "length": lengths,
        "data/chunk_index": chunks[0],
        "data/file_index": chunks[1],
        "dataset_from_index": ends - lengths,
        "dataset_to_index": ends,
        "meta/episodes/chunk_index": np.zeros(len(episodes), np.int64),
        "meta/episodes/file_index": np.zeros(len(episodes), np.int64),
    }
    statistics = [_statistics(episode) for episode in episodes]
    for name, entry in statistics[0].items():
        for key in entry:
            table[f"stats/{name}/{key}"] = [row[name][key] for row in statistics]
    write_parquet(path / EPISODES_PATH, pyarrow.table(table))


def _write_tasks(path: Path, task: str) -> None:
    """Write the table of tasks, whose index in pandas is the task's text."""
    import pyarrow

    index = "__index_level_0__"
    columns: list[JsonObject] = [
        {
            "name": "task_index",
            "field_name": "task_index",
            "pandas_type": "int64",
            "numpy_type": "int64",
        },
        {
            "name": None,
            "field_name": index,
            "pandas_type": "unicode",
            "numpy_type": "object",
        },
    ]
    described = [{**column, "metadata": None} for column in columns]
    metadata = {
        "index_columns": [index],
        "column_indexes": [],
        "columns": described,
        "pandas_version": "2.0.0",
    }
    table = pyarrow.table({"task_index": np.zeros(1, np.int64), index: [task]})
    write_parquet(
        path / "meta" / "tasks.parquet",
        table.replace_schema_metadata({"pandas": json.dumps(metadata)}),
    )


def _statistics(columns: Mapping[str, Values]) -> dict[str, dict[str, list[float]]]:
    """Return the statistics of every feature, each as a list of its values."""
    statistics = {}
    for name, values in columns.items():
        rows = values.reshape(len(values), -1).astype(float)
        entry = {
            "min": rows.min(axis=0),
            "max": rows.max(axis=0),
            "mean": rows.mean(axis=0),
            "std": rows.std(axis=0),
        }
        entry |= {
            f"q{round(100 * q):02d}": np.quantile(rows, q, axis=0) for q in QUANTILES
        }
        statistics[name] = {key: found.tolist() for key, found in entry.items()} | {
            "count": [len(rows)]
        }
    return statistics


def _info(
    exported: ExportedSet, names: Mapping[str, list[str]], lengths: list[int]
) -> JsonObject:
    """Return the description of the dataset."""
    features: JsonObject = {
        key: {"dtype": "float32", "shape": [len(values)], "names": values}
        for key, values in names.items()
    }
    indices = {**_INDICES, "task_index": "int64"}
    features |= {
        name: {"dtype": dtype, "shape": [1], "names": None}
        for name, dtype in indices.items()
    }
    return {
        "codebase_version": LEROBOT_VERSION,
        "robot_type": exported.problem,
        "total_episodes": len(lengths),
        "total_frames": sum(lengths),
        "total_tasks": 1,
        "chunks_size": MAX_CHUNK_FILES,
        "data_files_size_in_mb": MAX_DATA_FILE_MB,
        "video_files_size_in_mb": MAX_VIDEO_FILE_MB,
        "fps": round(exported.rate),
        "splits": {"train": f"0:{len(lengths)}"},
        "data_path": DATA_PATH,
        "video_path": None,
        "features": features,
    }
