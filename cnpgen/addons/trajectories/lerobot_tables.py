"""Episodes of a LeRobotDataset v3 as tables."""

import re
from collections.abc import Iterator, Mapping, Sequence
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
from cnpgen.errors import UsageError, nearest
from cnpgen.robots.parameter_ranges import PARAMETER_UNITS
from cnpgen.store.files.accounted import MISSPELT
from cnpgen.store.files.atomic import read_file
from cnpgen.store.files.documents import parse_json
from cnpgen.store.files.size_limits import MAX_TABLE_BYTES
from cnpgen.store.scene_table import OBSTACLE_POSES

MAX_FEATURE_WIDTH = 10_000  # values of a feature of LeRobot
LEROBOT_INFO = "meta/info.json"  # in a folder of LeRobot
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
    info, key, names, described = _described_dataset(folder)
    parameters = {
        name: k for k, name in enumerate(described) if name in PARAMETER_UNITS
    }
    scene = [k for k, name in enumerate(described) if _POSE_NAME.fullmatch(name)]
    widths = {"timestamp": 1, "episode_index": 1, key: len(names)}
    if parameters or scene:
        widths[LEROBOT_ENVIRONMENT] = len(described)
    read = {key, *_INDICES, *([LEROBOT_ENVIRONMENT] if described else [])}
    unused = [name for name in info["features"] if name not in read]
    unused += [
        f"{LEROBOT_ENVIRONMENT} {name}"
        for k, name in enumerate(described)
        if name not in parameters and k not in scene
    ]
    unused += _unknown_keys(info, _INFO_KEYS, "info.json", folder)
    for name in filter(info["features"].__contains__, widths):
        unused += _unknown_keys(info["features"][name], _FEATURE_KEYS, name, folder)
    count = 0
    for path in sorted(folder.glob("data/*/*.parquet")):
        table = read_parquet(path)
        known = {*info["features"], *_INDICES, *unused}
        unused += [name for name in table.column_names if name not in known]
        times, episodes, values, *environment = _number_columns(table, path, widths)
        count += len(values)
        for episode in dict.fromkeys(episodes[:, 0].tolist()):
            rows = episodes[:, 0] == episode
            columns: dict[str, Values] = {MESSAGE_TIME: times[rows, 0]}
            columns |= {name: values[rows, k] for k, name in enumerate(names)}
            columns |= {name: environment[0][rows, k] for name, k in parameters.items()}
            if scene:
                columns[OBSTACLE_POSES] = environment[0][rows][:, scene]
            place = f"{folder}: episode {episode:g}"
            columns[MESSAGE_TIME] = _frame_times(place, times[rows, 0], info.get("fps"))
            yield TrajectoryTable(place, columns, unused=tuple(unused))
    if info.get("total_frames", count) != count:
        stated = info["total_frames"]
        raise UsageError(
            f"{folder} has {count:,} frames, info.json states {stated!r:.60}"
        )


def _described_dataset(
    folder: Path,
) -> tuple[dict[str, Any], str, list[str], list[str]]:
    """Return the description of a dataset, the feature of its states, and the names of states and environment."""
    try:
        info = parse_json(
            read_file(folder / LEROBOT_INFO, max_bytes=MAX_TABLE_BYTES).decode()
        )
        features = info["features"]
        version = str(info["codebase_version"])
        key = next(key for key in ("observation.state", "action") if key in features)
        names = feature_names(features[key])
        described = (
            feature_names(features[LEROBOT_ENVIRONMENT])
            if LEROBOT_ENVIRONMENT in features
            else []
        )
    except (ValueError, KeyError, TypeError, IndexError, StopIteration) as error:
        raise UsageError(
            f"{folder / LEROBOT_INFO} does not describe a dataset of LeRobot: {error!r:.200}"
        ) from error
    if not version.startswith("v3"):
        raise UsageError(
            f"{folder} has LeRobot's format {version}, expected v3.0: convert it with LeRobot"
        )
    pattern = str(info.get("data_path", "data/"))
    if not pattern.startswith("data/"):
        raise UsageError(
            f"{folder}: data_path must begin with data/, got {pattern!r:.60}"
        )
    return info, key, names, described


def _number_columns(table: Any, path: Path, widths: Mapping[str, int]) -> list[Values]:
    """Return the columns of a file with their numbers of values, shape (K, width) each."""
    missing = [name for name in widths if name not in table.column_names]
    if missing:
        raise UsageError(
            f"{path}: there is no column {missing[0]!r}, only {', '.join(table.column_names)}"
        )
    return [number_column(table, name, path, width) for name, width in widths.items()]


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
