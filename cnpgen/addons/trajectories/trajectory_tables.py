"""Files of sampled trajectories as tables: CSV, JSON, YAML, NPZ, HDF5, Parquet, and messages of ROS and MoveIt."""

import json
import re
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np

from cnpgen.addons.trajectories.message_tables import (
    MESSAGE_TIME,
    is_joint_state,
    table_of_states,
    tables_of_document,
)
from cnpgen.addons.trajectories.text_tables import (
    TEXT_SUFFIXES,
    read_text_table,
    text_array,
)
from cnpgen.addons.trajectories.trajectory_table import TrajectoryTable, Values
from cnpgen.errors import CnpgenError, DatasetError, UsageError, either, requires_extra
from cnpgen.plans.format import JOINT_NAMES_KEY, PHASE_COLUMN, PLAN_COLUMN
from cnpgen.problems.scenes.yaml_document import read_yaml
from cnpgen.robots.parameter_ranges import PARAMETER_UNITS
from cnpgen.store.files.archives import ArchiveError, read_arrays
from cnpgen.store.files.atomic import machine_error, read_file
from cnpgen.store.files.documents import parse_json
from cnpgen.store.files.hdf5 import open_hdf5
from cnpgen.store.files.kind import HDF5_SUFFIXES, is_hdf5, kind_of_content
from cnpgen.store.files.size_limits import (
    MAX_TABLE_BYTES,
    MAX_TEXT_ARRAY_BYTES,
    MAX_TEXT_TABLE_BYTES,
)
from cnpgen.store.layout import SPECIFICATION
from cnpgen.store.paths import require_path
from cnpgen.store.scene_table import OBSTACLE_POSES

JOINT_NAMES = "joint_names"  # array of an archive, dataset or attribute of HDF5
MAX_ARCHIVE_BYTES = 1 << 29  # of the arrays of an archive as floats
MAX_PARQUET_VALUES = (
    25_000_000  # of a table: they take up to 50 bytes each while it is read
)
MAX_UNPACKED_BYTES = 1 << 30  # of the columns of Parquet
MAX_FEATURE_WIDTH = 10_000  # values of a feature of LeRobot
HELD_JOINTS_FILE = "held_joints.yaml"  # beside exported plans; it holds no trajectory
LEROBOT_INFO = "meta/info.json"  # in a folder of LeRobot
LEROBOT_ENVIRONMENT = "observation.environment_state"
# of an array of one plan in an archive of cnpgen
_PART_OF_ARCHIVE = re.compile(
    rf"(.+?)_(t|{PHASE_COLUMN}|q|dq|ddq|jerk|{'|'.join(PARAMETER_UNITS)})"
)
_POSE_NAME = re.compile(rf"{OBSTACLE_POSES}(_[0-9]+)?")  # a value of LeRobot


def read_trajectory_tables(
    path: Path, *, separator: str | None = None
) -> list[TrajectoryTable]:
    """Read all trajectories of a file, or of all files of a folder in the order of their names.

    The separator of columns in text files is found by default.

    Raises:
        UsageError: The file does not exist, is damaged or of an unknown format; the
            message names the place.
        MissingExtraError: The format needs a package that is not installed.
        MachineError: The file cannot be read.
    """
    if (path / LEROBOT_INFO).is_file():
        return list(_read_lerobot(path))
    if path.is_dir():
        files = [file for file in sorted(path.iterdir()) if is_trajectory_file(file)]
        if not files:
            raise UsageError(
                f"{path} has no files of trajectories, expected {either(sorted(_READERS))}"
            )
        return [
            table
            for file in files
            for table in read_trajectory_tables(file, separator=separator)
        ]
    if not path.exists():
        raise UsageError(
            f"{path} is not there, expected a file of trajectories or a folder of them"
        )
    suffix = path.suffix.lower()
    read = _READERS.get(suffix)
    if read is None:
        raise UsageError(
            f"{path} has an unknown format, expected {either(sorted(_READERS))}"
        )
    try:
        if suffix in TEXT_SUFFIXES:
            return [read_text_table(path, separator)]
        return list(read(path))
    except OSError as error:
        raise machine_error("read", path, error) from error
    except DatasetError as error:
        raise UsageError(str(error)) from error


def is_trajectory_file(path: Path) -> bool:
    """Return whether a file has a suffix of trajectories."""
    return path.suffix.lower() in _READERS and path.name != HELD_JOINTS_FILE


def holds_trajectories(path: Path) -> bool:
    """Return whether a path holds sampled trajectories, not plans: by its suffix, HDF5 files by their content.

    Raises:
        UsageError: The path does not exist, or is a file of neither.
        MachineError: It cannot be read.
    """
    require_path(path, "a file of plans or sampled trajectories")
    if (path / LEROBOT_INFO).is_file():
        return True
    if path.is_dir():
        return not (path / SPECIFICATION).exists() and any(
            is_trajectory_file(file) for file in path.iterdir()
        )
    suffix, tables = path.suffix.lower(), sorted(_READERS.keys() - {*HDF5_SUFFIXES})
    if suffix in tables:
        return True
    if suffix not in HDF5_SUFFIXES:
        if path.is_file() and not is_hdf5(path):
            kind = kind_of_content(path) or "of an unknown kind"
            expected = f"a plan file, .h5, or sampled trajectories, {either(tables)}"
            raise UsageError(f"{path} is {kind}, expected {expected}")
        return False
    try:
        with open_hdf5(path) as file:
            return "path_control_points" not in file and bool(
                {"q", "positions"} & set(file)
            )
    except CnpgenError:
        return False


def _read_text(path: Path) -> Iterator[TrajectoryTable]:
    yield read_text_table(path, None)


def _read_npz(path: Path) -> Iterator[TrajectoryTable]:
    try:
        arrays = read_arrays(path, max_bytes=MAX_ARCHIVE_BYTES)
    except ArchiveError as error:
        raise UsageError(
            f"{path} is not an archive of NumPy arrays, or is damaged: {error}"
        ) from error
    names = tuple(map(str, arrays.pop(JOINT_NAMES, np.array([], np.str_)).ravel()))
    yield from _split(path, arrays, names)


def _read_hdf5(path: Path) -> Iterator[TrajectoryTable]:
    with open_hdf5(path) as file:
        names: tuple[str, ...] = ()
        if JOINT_NAMES in file.attributes:
            names = file.attributes.texts(JOINT_NAMES)
        if JOINT_NAMES in file.names():
            others = file.texts(JOINT_NAMES)
            if names and others != names:
                raise UsageError(
                    f"{path}: the attribute {JOINT_NAMES} names {', '.join(names)}, the dataset {', '.join(others)}"
                )
            names = others
        arrays = {
            name: column.read()
            for name, column in file.columns(without=(JOINT_NAMES,)).items()
        }
    yield from _split(path, arrays, names)


def _split(
    path: Path, arrays: dict[str, Values], names: tuple[str, ...]
) -> Iterator[TrajectoryTable]:
    """Yield the trajectories of an archive: ``plan_00000_t`` and so on, or ``t`` and ``q`` of all."""
    parts: dict[str, dict[str, Values]] = {}
    # "ref_q" beside "q" is no plan "ref"
    of_plans = {} if "q" in arrays else arrays
    for name, values in of_plans.items():
        if match := _PART_OF_ARCHIVE.fullmatch(name):
            parts.setdefault(match[1], {})[match[2]] = values
    parts = {label: columns for label, columns in parts.items() if "q" in columns}
    if not parts:
        yield TrajectoryTable(str(path), arrays, names)
    for label, columns in parts.items():
        yield TrajectoryTable(f"{path}: {label}", columns, names)


def _read_parquet(path: Path) -> Iterator[TrajectoryTable]:
    table = read_parquet(path)
    try:
        names = tuple(
            map(
                str,
                json.loads((table.schema.metadata or {}).get(JOINT_NAMES_KEY, b"[]")),
            )
        )
    except (ValueError, TypeError, RecursionError) as error:
        raise UsageError(
            f"{path}: its names of joints are no list of texts, or are damaged: {error}"
        ) from error
    columns = {name: _parquet_column(table, name, path) for name in table.column_names}
    if names and PLAN_COLUMN in columns:
        # A table of cnpgen.
        index = columns.pop(PLAN_COLUMN)
        columns.pop("sample_id", None)
        for plan in dict.fromkeys(index.tolist()):
            rows = {name: values[index == plan] for name, values in columns.items()}
            yield TrajectoryTable(f"{path}: plan {plan}", rows, names)
        return
    yield TrajectoryTable(str(path), columns)


def read_parquet(path: Path) -> Any:
    """Read a Parquet file as a table of pyarrow.

    Raise UsageError if it is damaged or too large.
    """
    with requires_extra("parquet", "pyarrow"):
        import pyarrow
        import pyarrow.parquet
    content = read_file(path, max_bytes=MAX_TABLE_BYTES)
    try:
        file = pyarrow.parquet.ParquetFile(pyarrow.BufferReader(content))
        groups = [file.metadata.row_group(i) for i in range(file.num_row_groups)]
        parts = [group.column(i) for group in groups for i in range(group.num_columns)]
        # Values that repeat take no space in the file, so values are counted.
        size = sum(part.num_values for part in parts)
        size = max(size, file.metadata.num_rows * file.metadata.num_columns)
        n_bytes = sum(part.total_uncompressed_size for part in parts)
        if size <= MAX_PARQUET_VALUES and n_bytes <= MAX_UNPACKED_BYTES:
            return _parquet_table(pyarrow, content, file.schema)
    except (
        pyarrow.ArrowException,
        OSError,
        ValueError,
    ) as error:
        # Damaged headers; texts that are not UTF-8.
        raise UsageError(
            f"{path} is not a Parquet file, or is damaged: {error}"
        ) from error
    raise UsageError(
        f"{path} holds {size:,} values in {n_bytes:,} bytes, expected at most"
        f" {MAX_PARQUET_VALUES:,} in {MAX_UNPACKED_BYTES:,}"
    )


def _parquet_table(pyarrow: Any, content: bytes, schema: Any) -> Any:
    """Read a table whose texts stay in dictionaries, so that repeated long ones take no space.

    Raises:
        ValueError: A column of texts would be too large as an array.
    """
    columns = [schema.column(i) for i in range(len(schema))]
    texts = [part.path for part in columns if part.physical_type == "BYTE_ARRAY"]
    table = pyarrow.parquet.ParquetFile(
        pyarrow.BufferReader(content), read_dictionary=texts
    ).read()
    for name in table.column_names:
        chunks = table.column(name).chunks
        if texts and any(map(pyarrow.types.is_nested, [table.column(name).type])):
            chunks = [chunk.flatten() for chunk in chunks]
        for chunk in chunks:
            if not pyarrow.types.is_dictionary(chunk.type):
                continue
            longest = max(
                (len(text) for text in chunk.dictionary.to_pylist() if text), default=0
            )
            if len(chunk) * longest > MAX_TEXT_ARRAY_BYTES:
                raise ValueError(
                    f"column {name!r}: {len(chunk):,} texts of {longest:,}"
                )
    return table


def _parquet_column(table: Any, name: str, path: Path) -> Values:
    """Return a column of numbers, lists of equal lengths, or texts as an array."""
    values = table.column(name).to_pylist()
    if values and all(isinstance(value, str) for value in values):
        return text_array(values)
    try:
        return np.array(values)
    except ValueError as error:
        raise UsageError(
            f"{path}: column {name!r}: its rows have different lengths"
        ) from error


def _number_column(table: Any, name: str, path: Path, width: int) -> Values:
    """Return a column of numbers, or of lists of them, shape (rows, width)."""
    values = _parquet_column(table, name, path)
    try:
        return values.astype(float).reshape(table.num_rows, width)
    except (TypeError, ValueError) as error:
        text = f"{width} numbers" if width > 1 else "a number"
        raise UsageError(f"{path}: column {name!r}: expected {text} per row") from error


def _read_lerobot(folder: Path) -> Iterator[TrajectoryTable]:
    """Yield the episodes of a LeRobotDataset v3: states, or actions without them, with their names."""
    try:
        info = parse_json(
            read_file(folder / LEROBOT_INFO, max_bytes=MAX_TABLE_BYTES).decode()
        )
        features, version = info["features"], str(info["codebase_version"])
        key = next(key for key in ("observation.state", "action") if key in features)
        names = _feature_names(features[key])
        described = (
            _feature_names(features[LEROBOT_ENVIRONMENT])
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
    parameters = {
        name: k for k, name in enumerate(described) if name in PARAMETER_UNITS
    }
    scene = [k for k, name in enumerate(described) if _POSE_NAME.fullmatch(name)]
    environment_key = [LEROBOT_ENVIRONMENT] if parameters or scene else []
    for path in sorted(folder.glob("data/*/*.parquet")):
        table = read_parquet(path)
        needed = (
            "timestamp",
            "episode_index",
            key,
            *environment_key,
        )
        missing = [name for name in needed if name not in table.column_names]
        if missing:
            raise UsageError(
                f"{path}: there is no column {missing[0]!r}, only {', '.join(table.column_names)}"
            )
        widths = 1, 1, len(names), *([len(described)] if environment_key else [])
        columns_of = zip(needed, widths, strict=True)
        times, episodes, values, *environment = (
            _number_column(table, name, path, width) for name, width in columns_of
        )
        for episode in dict.fromkeys(episodes[:, 0].tolist()):
            rows = episodes[:, 0] == episode
            columns: dict[str, Values] = {MESSAGE_TIME: times[rows, 0]}
            columns |= {name: values[rows, k] for k, name in enumerate(names)}
            columns |= {name: environment[0][rows, k] for name, k in parameters.items()}
            if scene:
                columns[OBSTACLE_POSES] = environment[0][rows][:, scene]
            yield TrajectoryTable(f"{folder}: episode {episode:g}", columns)


def _feature_names(feature: Any) -> list[str]:
    """Return the names of a feature's values: a list, a list in an object, or indices.

    Raises:
        TypeError, KeyError, ValueError, IndexError: It is no feature.
    """
    width, names = (
        int(feature["shape"][0]),
        feature.get("names") if isinstance(feature, dict) else None,
    )
    if not 0 < width <= MAX_FEATURE_WIDTH:
        raise ValueError(
            f"a feature has {width} values, expected 1 to {MAX_FEATURE_WIDTH:,}"
        )
    if isinstance(names, dict):
        names = next(
            (entry for entry in names.values() if isinstance(entry, list)), None
        )
    if isinstance(names, list) and len(names) == width:
        return [str(name) for name in names]
    return [f"q{k}" for k in range(width)]


def _read_json(path: Path) -> Iterator[TrajectoryTable]:
    try:
        document = parse_json(read_file(path, max_bytes=MAX_TEXT_TABLE_BYTES).decode())
    except ValueError as error:
        raise UsageError(f"{path} is not JSON: {error}") from error
    yield from tables_of_document(document, str(path))


def _read_yaml(path: Path) -> Iterator[TrajectoryTable]:
    documents = read_yaml(path, numbers=True)
    states = [document for document in documents if document is not None]
    if states and is_joint_state(states[0]):
        yield table_of_states(states, str(path))
        return
    for index, document in enumerate(documents):
        if document is not None:
            # Topics echoed by ROS end with an empty document.
            yield from tables_of_document(
                document,
                f"{path}: document {index}" if len(documents) > 2 else str(path),
            )


_READERS: dict[str, Callable[[Path], Iterator[TrajectoryTable]]] = {
    **dict.fromkeys(TEXT_SUFFIXES, _read_text),
    ".h5": _read_hdf5,
    ".hdf5": _read_hdf5,
    ".json": _read_json,
    ".npz": _read_npz,
    ".parquet": _read_parquet,
    ".yaml": _read_yaml,
    ".yml": _read_yaml,
}
