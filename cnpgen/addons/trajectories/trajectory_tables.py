"""Files of sampled trajectories as tables: the reader of every suffix, and folders of files."""

from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path

from cnpgen.addons.trajectories.array_tables import read_hdf5_tables, read_npz
from cnpgen.addons.trajectories.bag_tables import (
    BAG_SUFFIXES,
    is_bag_folder,
    read_bag,
)
from cnpgen.addons.trajectories.lerobot_tables import LEROBOT_INFO, read_lerobot
from cnpgen.addons.trajectories.load_options import DEFAULT_OPTIONS, LoadOptions
from cnpgen.addons.trajectories.message_tables import (
    is_joint_state,
    tables_of_document,
)
from cnpgen.addons.trajectories.parquet_tables import read_parquet_tables
from cnpgen.addons.trajectories.text_tables import TEXT_SUFFIXES, read_text_table
from cnpgen.addons.trajectories.trajectory_table import TrajectoryTable
from cnpgen.errors import CnpgenError, DatasetError, UsageError, either
from cnpgen.problems.scenes.yaml_document import read_yaml
from cnpgen.store.files.atomic import machine_error, read_file
from cnpgen.store.files.documents import parse_json
from cnpgen.store.files.hdf5 import open_hdf5
from cnpgen.store.files.kind import HDF5_SUFFIXES, is_hdf5, kind_of_content
from cnpgen.store.files.size_limits import (
    MAX_JSON_PARTS,
    MAX_TABLE_BYTES,
    MAX_TEXT_TABLE_BYTES,
)
from cnpgen.store.layout import SPECIFICATION
from cnpgen.store.paths import require_path

HELD_JOINTS_FILE = "held_joints.yaml"  # beside exported plans; it holds no trajectory


def read_trajectory_tables(
    path: Path, options: LoadOptions = DEFAULT_OPTIONS
) -> list[TrajectoryTable]:
    """Read all trajectories of a file, or of all files of a folder in the order of their names.

    Raises:
        UsageError: The file does not exist, is damaged or of an unknown format; the
            message names the place.
        MissingExtraError: The format needs a package that is not installed.
        MachineError: The file cannot be read.
    """
    if (path / LEROBOT_INFO).is_file():
        return list(read_lerobot(path))
    if path.is_dir() and is_bag_folder(path):
        return list(read_bag(path, options))
    if path.is_dir():
        files = [file for file in sorted(path.iterdir()) if is_trajectory_file(file)]
        if not files:
            raise UsageError(
                f"{path} has no files of trajectories, expected {either(sorted(_READERS))}"
            )
        held = _held_joints(path / HELD_JOINTS_FILE)
        return [
            replace(table, held_joints=held or table.held_joints)
            for file in files
            for table in read_trajectory_tables(file, options)
        ]
    if not path.exists():
        raise UsageError(
            f"{path} is not there, expected a file of trajectories or a folder of them"
        )
    suffix = path.suffix.lower()
    if options.separator is not None and suffix in _READERS.keys() - {*TEXT_SUFFIXES}:
        raise UsageError(f"is for text files, got {path}", argument="separator")
    read = _READERS.get(suffix)
    if read is None:
        raise UsageError(
            f"{path} has an unknown format, expected {either(sorted(_READERS))}"
        )
    try:
        return list(read(path, options))
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
    suffix = path.suffix.lower()
    tables = sorted(_READERS.keys() - {*HDF5_SUFFIXES})
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


def _read_text(path: Path, options: LoadOptions) -> Iterator[TrajectoryTable]:
    yield read_text_table(path, options.separator)


def _held_joints(path: Path) -> dict[str, float]:
    """Read the positions of joints that are not planned beside exported plans; empty without the file."""
    if not path.is_file():
        return {}
    content = read_file(path, max_bytes=MAX_TABLE_BYTES)
    try:
        # Bytes that are no UTF-8 raise a ValueError, too.
        lines = content.decode().splitlines()
        pairs = [line.rsplit(":", 1) for line in lines if line.strip()]
        return {parse_json(name): float(value) for name, value in pairs}
    except ValueError as error:
        raise UsageError(
            f"{path} must have lines of a joint and its position"
        ) from error


def _read_json(path: Path, options: LoadOptions) -> Iterator[TrajectoryTable]:
    content = read_file(path, max_bytes=MAX_TEXT_TABLE_BYTES)
    # Before they take memory; those in texts count, too.
    if (count := content.count(b"{") + content.count(b"[")) > MAX_JSON_PARTS:
        raise UsageError(
            f"{path} has {count:,} lists and objects, expected at most"
            f" {MAX_JSON_PARTS:,}: write NPZ or Parquet"
        )
    try:
        document = parse_json(content.decode())
    except ValueError as error:
        raise UsageError(f"{path} is not JSON: {error}") from error
    yield from tables_of_document(document, str(path), options.allow_unused)


def _read_yaml(path: Path, options: LoadOptions) -> Iterator[TrajectoryTable]:
    documents = read_yaml(path, numbers=True)
    states = [document for document in documents if document is not None]
    if states and is_joint_state(states[0]):
        # A stream of states is one trajectory.
        yield from tables_of_document(states, str(path), options.allow_unused)
        return
    for index, document in enumerate(documents):
        if document is not None:
            # Topics echoed by ROS end with an empty document.
            yield from tables_of_document(
                document,
                f"{path}: document {index}" if len(documents) > 2 else str(path),
                options.allow_unused,
            )


_READERS: dict[str, Callable[[Path, LoadOptions], Iterator[TrajectoryTable]]] = {
    **dict.fromkeys(TEXT_SUFFIXES, _read_text),
    **dict.fromkeys(BAG_SUFFIXES, read_bag),
    ".h5": read_hdf5_tables,
    ".hdf5": read_hdf5_tables,
    ".json": _read_json,
    ".npz": read_npz,
    ".parquet": read_parquet_tables,
    ".yaml": _read_yaml,
    ".yml": _read_yaml,
}
