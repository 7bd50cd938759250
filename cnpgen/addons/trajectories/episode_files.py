"""Episodes of recorded data: folders of LeRobot v3, HDF5 files of robomimic and Minari, and folders of CSV files."""

import os
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from cnpgen.addons.trajectories.lerobot_tables import (
    LEROBOT_ACTION,
    LEROBOT_INFO,
    LEROBOT_STATE,
    described,
    episodes_of,
    feature_names,
    read_description,
)
from cnpgen.addons.trajectories.parquet_tables import read_parquet
from cnpgen.addons.trajectories.table_units import plain, stated_factor
from cnpgen.addons.trajectories.trajectory_tables import read_trajectory_tables
from cnpgen.arrays import Array, Integers
from cnpgen.documents import Names
from cnpgen.errors import DatasetError, UsageError, counted, listed
from cnpgen.store.files.documents import parse_json
from cnpgen.store.files.hdf5 import open_nested_hdf5
from cnpgen.store.files.kind import HDF5_SUFFIXES

MEASURED = "measured states"  # in messages
ROBOMIMIC_KEY = "obs/robot0_joint_pos"
NOMINAL_TOLERANCE = 1e-3  # of a period, of times that are a grid
TIME_COLUMNS = ("t", "time", "timestamp", "time_from_start")
_HAS_TIMES = "is for data without times, {} has some"
LEROBOT_HOME = "HF_LEROBOT_HOME"


@dataclass(frozen=True, eq=False)
class Episode:
    """One recorded episode.

    Attributes:
        name: Number or name of the episode.
        t: Times [s], shape (K,).
        state: Measured values, shape (K, w).
        action: Commanded values, shape (K, v), or None.
        names: Names of the measured values.
        frame: Index of every frame, shape (K,).
        length: Number of frames that the description states, or None.
        has_units: Whether columns stated their units: their values are in SI units.
    """

    name: str
    t: Array
    state: Array
    action: Array | None
    names: Names
    frame: Integers
    length: int | None = None
    has_units: bool = False

    @property
    def is_nominal(self) -> bool:
        """Whether the times are a grid, such as frame index / fps: no clock was recorded."""
        steps = np.diff(self.t)
        if not len(steps) or not np.isfinite(steps).all():
            return True
        period = float(np.median(steps))
        return bool((np.abs(steps - period) <= NOMINAL_TOLERANCE * abs(period)).all())


@dataclass(frozen=True, eq=False)
class Recording:
    """Episodes of a path, and what its description states.

    Attributes:
        episodes: The episodes.
        robot: Type of the robot; empty if not stated. kind: "lerobot", "hdf5" or "csv".
    """

    episodes: tuple[Episode, ...]
    robot: str
    kind: str


def read_recording(
    path: str, *, key: str | None = None, rate: float | None = None
) -> Recording:
    """Read all episodes of a path, or of USER/NAME in LeRobot's home.

    Args:
        path: Folder or file.
        key: Name of the positions in an HDF5 file.
        rate: Frames per second [Hz] of a file without times.

    Raises:
        UsageError: The path is missing, damaged or of an unknown format.
    """
    folder = Path(path)
    if not folder.exists():
        home = os.environ.get(LEROBOT_HOME, "~/.cache/huggingface/lerobot")
        folder = Path(home).expanduser() / path
    if not folder.exists():
        text = f"{path} is not there, neither as a path nor in {folder.parent}"
        raise UsageError(text, concerns="path")
    if (folder / LEROBOT_INFO).is_file():
        if rate is not None:
            raise UsageError(_HAS_TIMES.format(folder), argument="rate")
        return _read_lerobot(folder)
    if folder.is_file() and folder.suffix.lower() in HDF5_SUFFIXES:
        return _read_hdf5(folder, key, rate)
    return _read_tables(folder, rate)


def _read_lerobot(folder: Path) -> Recording:
    """Read a dataset of LeRobot v3."""
    info = read_description(folder, MEASURED)
    features = info["features"]
    with described(folder, MEASURED):
        names = tuple(feature_names(features[LEROBOT_STATE], "{}"))
        widths = {"timestamp": 1, "episode_index": 1, "frame_index": 1}
        widths[LEROBOT_STATE] = len(names)
        if LEROBOT_ACTION in features:
            widths[LEROBOT_ACTION] = len(feature_names(features[LEROBOT_ACTION]))
    lengths = _stated_lengths(folder)
    episodes = [
        Episode(
            f"{index:g}",
            columns["timestamp"][:, 0],
            columns[LEROBOT_STATE],
            columns.get(LEROBOT_ACTION),
            names,
            columns["frame_index"][:, 0].astype(np.int64),
            lengths.get(int(index)),
        )
        for _, index, columns in episodes_of(folder, widths)
    ]
    if not episodes:
        raise UsageError(f"{folder} holds no episodes", concerns="path")
    return Recording(tuple(episodes), str(info.get("robot_type") or ""), "lerobot")


def _stated_lengths(folder: Path) -> dict[int, int]:
    """Return the stated numbers of frames by episode."""
    found: dict[int, int] = {}
    for file in sorted(folder.glob("meta/episodes/*/*.parquet")):
        table = read_parquet(file)
        if {"episode_index", "length"} <= set(table.column_names):
            columns = (
                table.column(name).to_pylist() for name in ("episode_index", "length")
            )
            found |= dict(zip(*columns, strict=True))
    return found


def _read_hdf5(path: Path, key: str | None, rate: float | None) -> Recording:
    """Read the episodes of robomimic, ``data/demo_0/obs/...``, or Minari, ``episode_0/observations``."""
    try:
        with open_nested_hdf5(path) as file:
            robomimic = "data" in file
            root = file["data"] if robomimic else file
            key = key or (ROBOMIMIC_KEY if robomimic else "observations")
            if rate is None and robomimic:
                rate = _control_rate(root.attrs.get("env_args", "{}"))
            if rate is None:
                raise UsageError(
                    f"{path} has no times: state {{rate}}", remedies={"rate": 30}
                )
            episodes = tuple(_hdf5_episodes(path, root, key, rate))
    except (DatasetError, KeyError) as error:
        text = f"{path} is not a file of episodes, or is damaged: {error!s:.200}"
        raise UsageError(text, concerns="path") from error
    if not episodes:
        raise UsageError(f"{path} holds no episodes", concerns="path")
    return Recording(episodes, "", "hdf5")


def _hdf5_episodes(path: Path, root: Any, key: str, rate: float) -> Iterator[Episode]:
    """Yield the episodes of a group in the order of their numbers."""
    groups = [name for name in root if hasattr(root[name], "keys")]
    for name in sorted(groups, key=lambda text: (len(text), text)):
        group = root[name]
        if key not in group or not hasattr(group[key], "shape"):
            found: list[str] = []
            group.visititems(
                lambda item, value, found=found: (
                    found.append(item) if hasattr(value, "shape") else None
                )
            )
            text = f"{path}: {name} has no array {key!r}, only {listed(found, 12)}"
            raise UsageError(f"{text}: state {{key}}", remedies={"key": found[:1]})
        state = np.asarray(group[key], float)
        if state.ndim != 2:
            text = f"{path}: {name}/{key} must have two dimensions, got {state.shape}"
            raise UsageError(text, concerns="path")
        frame = np.arange(len(state))
        names = tuple(map(str, range(state.shape[1])))
        yield Episode(name, frame / rate, state, None, names, frame)


def _control_rate(text: str | bytes) -> float | None:
    """Return the control frequency that robomimic's description of the environment states [Hz]."""
    try:
        plain = text.decode() if isinstance(text, bytes) else text
        found = parse_json(plain)["env_kwargs"]["control_freq"]
        return float(found) if float(found) > 0 else None
    except (ValueError, KeyError, TypeError):
        return None


def _read_tables(path: Path, rate: float | None) -> Recording:
    """Read one episode of each table, such as the CSV files of a folder."""
    episodes = []
    for table in read_trajectory_tables(path):
        columns = dict[str, Array]()
        has_units = False
        for name, values in table.columns.items():
            if values.ndim == 1 and values.dtype.kind in "biuf":
                stated = stated_factor(name)
                if stated is not None and not stated[0]:
                    text = f"{table.place}: {name!r} has an unknown unit"
                    raise UsageError(text, concerns="path")
                has_units |= stated is not None and stated[0] in {"rad", "m"}
                columns[joint_name(name)] = values * (
                    1.0 if stated is None else stated[1]
                )
        times = [name for name in columns if name.lower() in TIME_COLUMNS]
        names = tuple(name for name in columns if name not in times)
        if not names:
            raise UsageError(
                f"{table.place} has no columns of numbers", concerns="path"
            )
        state = np.stack([columns[name] for name in names], axis=1)
        frame = np.arange(len(state))
        if not times and rate is None:
            text = f"{table.place} has no times: state {{rate}}"
            raise UsageError(text, remedies={"rate": 30})
        if times and rate is not None:
            raise UsageError(_HAS_TIMES.format(table.place), argument="rate")
        t = columns[times[0]] if times else frame / (rate or 1.0)
        name = Path(table.place).name
        episode = Episode(name, t, state, None, names, frame, has_units=has_units)
        episodes.append(episode)
    return Recording(tuple(episodes), "", "csv")


def joint_name(column: str) -> str:
    """Return the joint of a column of positions, such as "q joint_1 [rad]"; other names without their unit."""
    return plain(column).removeprefix("q ")


def chosen(recording: Recording, episodes: Sequence[int] | None) -> tuple[Episode, ...]:
    """Return the episodes of some numbers, all by default; raise UsageError for a missing one."""
    if episodes is None:
        return recording.episodes
    by_name = {episode.name: episode for episode in recording.episodes}
    numbered = dict(enumerate(recording.episodes))
    found = [by_name.get(str(k)) or numbered.get(k) for k in episodes]
    missing = [k for k, episode in zip(episodes, found, strict=True) if episode is None]
    if missing:
        text = f"there is no episode {missing[0]}: {counted(len(recording.episodes), 'episode')}, numbered from 0"
        raise UsageError(text, concerns="episodes")
    return tuple(episode for episode in found if episode is not None)
