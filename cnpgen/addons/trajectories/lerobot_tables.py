"""Episodes of a LeRobotDataset v3 as tables."""

import re
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np

from cnpgen.addons.trajectories.message_tables import MESSAGE_TIME
from cnpgen.addons.trajectories.parquet_tables import number_column, read_parquet
from cnpgen.addons.trajectories.trajectory_table import (
    MAX_RATE_DEVIATION,
    TrajectoryTable,
    Values,
)
from cnpgen.documents import JsonMapping, JsonObject
from cnpgen.errors import UsageError, nearest
from cnpgen.robots.parameter_ranges import PARAMETER_UNITS
from cnpgen.store.files.accounted import MISSPELT
from cnpgen.store.files.atomic import read_file
from cnpgen.store.files.documents import parse_json
from cnpgen.store.files.size_limits import MAX_TABLE_BYTES
from cnpgen.store.scene_table import OBSTACLE_POSES

MAX_FEATURE_WIDTH = 10_000  # values of a feature of LeRobot
LEROBOT_INFO = "meta/info.json"  # in a folder of LeRobot
DATASET = "a dataset of LeRobot"  # in messages
LEROBOT_STATE = "observation.state"
LEROBOT_ACTION = "action"
LEROBOT_ENVIRONMENT = "observation.environment_state"
_INDICES = (
    "timestamp",
    "frame_index",
    "episode_index",
    "index",
    "task_index",
)
# Keys of info.json that are read, or describe files and rows that are counted.
_INFO_KEYS = (
    *("codebase_version", "features", "fps", "data_path", "total_frames"),
    *("robot_type", "total_episodes", "total_tasks", "total_chunks", "total_videos"),
    *("chunks_size", "splits", "video_path"),
    *("data_files_size_in_mb", "video_files_size_in_mb"),
)
# Keys of a feature: the numbers are those of the table, of any type and rate.
_FEATURE_KEYS = "names", "shape", "dtype", "fps", "info", "video_info"
_POSE_NAME = re.compile(rf"{OBSTACLE_POSES}(_[0-9]+)?")  # a value of LeRobot


def read_lerobot(folder: Path) -> Iterator[TrajectoryTable]:
    """Yield the episodes of a LeRobotDataset v3: states, or actions without them, with their names."""
    info = read_description(folder)
    features = info["features"]
    with described(folder, DATASET):
        key = next(key for key in (LEROBOT_STATE, LEROBOT_ACTION) if key in features)
        names = feature_names(features[key])
        environment = features.get(LEROBOT_ENVIRONMENT)
        places = [] if environment is None else feature_names(environment)
    parameters = {name: k for k, name in enumerate(places) if name in PARAMETER_UNITS}
    scene = [k for k, name in enumerate(places) if _POSE_NAME.fullmatch(name)]
    widths = {"timestamp": 1, "episode_index": 1, key: len(names)}
    if parameters or scene:
        widths[LEROBOT_ENVIRONMENT] = len(places)
    used = {key, *_INDICES, LEROBOT_ENVIRONMENT}
    unused = [name for name in features if name not in used]
    unused += [
        f"{LEROBOT_ENVIRONMENT} {name}"
        for k, name in enumerate(places)
        if name not in parameters and k not in scene
    ]
    unused += _unknown(info, widths, folder)
    count = 0
    for of_file, episode, read in episodes_of(folder, widths):
        known = {*features, *_INDICES, *unused}
        unused += [name for name in of_file if name not in known]
        t = read["timestamp"][:, 0]
        count += len(t)
        columns: dict[str, Values] = {MESSAGE_TIME: t}
        columns |= {name: read[key][:, k] for k, name in enumerate(names)}
        around = read.get(LEROBOT_ENVIRONMENT, np.empty((len(t), 0)))
        columns |= {name: around[:, k] for name, k in parameters.items()}
        if scene:
            columns[OBSTACLE_POSES] = around[:, scene]
        place = f"{folder}: episode {episode:g}"
        columns[MESSAGE_TIME] = _frame_times(place, t, info.get("fps"))
        yield TrajectoryTable(place, columns, unused=tuple(unused))
    if (stated := info.get("total_frames", count)) != count:
        text = f"{folder} has {count:,} frames, info.json states {stated!r:.60}"
        raise UsageError(text)


@contextmanager
def described(folder: Path, what: str) -> Iterator[None]:
    """Report that a description is not that of ``what`` if it cannot be read as such."""
    try:
        yield
    except (
        AttributeError,
        ValueError,
        KeyError,
        TypeError,
        IndexError,
        StopIteration,
    ) as error:
        raise UsageError(
            f"{folder / LEROBOT_INFO} does not describe {what}: {error!r:.200}",
            concerns="path",
        ) from error


def read_description(folder: Path, what: str = DATASET) -> JsonObject:
    """Return the description of a LeRobotDataset v3, which has ``features``."""
    with described(folder, what):
        content = read_file(folder / LEROBOT_INFO, max_bytes=MAX_TABLE_BYTES)
        info: JsonObject = parse_json(content.decode())
        version = str(info["codebase_version"])
        info["features"].keys()
    if not version.startswith("v3"):
        text = f"{folder} has LeRobot's format {version}, expected v3.0: convert it with LeRobot"
        raise UsageError(text, concerns="path")
    pattern = str(info.get("data_path", "data/"))
    if not pattern.startswith("data/"):
        text = f"{folder}: data_path must begin with data/, got {pattern!r:.60}"
        raise UsageError(text, concerns="path")
    return info


def episodes_of(
    folder: Path, widths: Mapping[str, int]
) -> Iterator[tuple[list[str], float, dict[str, Values]]]:
    """Yield the names of a file's columns, and of each episode in it the index and columns of shape (K, width)."""
    for path in sorted(folder.glob("data/*/*.parquet")):
        table = read_parquet(path)
        if missing := [name for name in widths if name not in table.column_names]:
            raise UsageError(
                f"{path}: there is no column {missing[0]!r}, only {', '.join(table.column_names)}",
                concerns="path",
            )
        columns = {
            name: number_column(table, name, path, width)
            for name, width in widths.items()
        }
        index = columns["episode_index"][:, 0]
        for episode in dict.fromkeys(index.tolist()):
            rows = index == episode
            yield (
                table.column_names,
                episode,
                {name: values[rows] for name, values in columns.items()},
            )


def _unknown(info: JsonMapping, names: Iterable[str], folder: Path) -> Iterator[str]:
    """Yield the unknown keys of a description and of the features that are read."""
    yield from _unknown_keys(info, _INFO_KEYS, "info.json", folder)
    for name in filter(info["features"].__contains__, names):
        yield from _unknown_keys(info["features"][name], _FEATURE_KEYS, name, folder)


def _unknown_keys(
    described: Any, known: Sequence[str], of: str, folder: Path
) -> list[str]:
    """Return the keys that are not read; UsageError for one that is near a missing key."""
    if not isinstance(described, dict):
        raise UsageError(
            f"{folder}: {of} must be an object with keys, got {described!r:.60}"
        )
    missing = [key for key in known if key not in described]
    unknown = [key for key in described if key not in known]
    for key in unknown:
        if hint := nearest(key, missing, similarity=MISSPELT):
            raise UsageError(f"{folder}: {of} has the unknown key {key!r}{hint}")
    return [f"attribute {key} of {of}" for key in unknown]


def _frame_times(place: str, t: Values, rate: Any) -> Values:
    """Return times without their rounding to float32, if they are multiples of the period of the frames.

    Between 1 and 2 s, the rounding is up to 6e-8 s, which at 1 rad/s is as much as the
    rounding of the positions.

    Raises:
        UsageError: The times do not agree with the frames per second that a dataset
            states.
    """
    if not isinstance(rate, int | float) or not rate > 0:
        raise UsageError(f"{place}: fps must be above 0, got {rate!r:.60}")
    steps = np.diff(t)
    if len(steps) and abs(float(np.median(steps)) * rate - 1) > MAX_RATE_DEVIATION:
        step = float(np.median(steps))
        raise UsageError(f"{place} has steps of {step:.3g} s, and its fps is {rate:g}")
    frames = np.round(t * rate) / rate
    rounding = np.spacing(np.abs(t).astype(np.float32))
    return frames if (np.abs(frames - t) <= rounding).all() else t


def feature_names(feature: Any, unnamed: str = "q{}") -> list[str]:
    """Return the names of a feature's values: a list, a list in an object, or indices.

    Args:
        feature: The description of a feature, in info.json.
        unnamed: Form of the names of values without a name.

    Raises:
        TypeError, KeyError, ValueError, IndexError: It is no feature.
    """
    (width,) = feature["shape"]
    names = feature.get("names")
    if not isinstance(width, int) or not 0 < width <= MAX_FEATURE_WIDTH:
        raise ValueError(
            f"a feature has {width!r:.60} values, expected 1 to {MAX_FEATURE_WIDTH:,}"
        )
    if isinstance(names, dict):
        # Of one kind, such as {"motors": [...]}.
        (names,) = names.values()
    if names is None:
        return [unnamed.format(k) for k in range(width)]
    if not isinstance(names, list) or len(names) != width:
        raise ValueError(f"a feature of {width} values has the names {names!r:.60}")
    return [str(name) for name in names]
