"""Archives of NumPy and files of HDF5 as tables: ``t``, ``q`` and so on, or those of each exported plan."""

import re
from collections.abc import Iterator, Mapping
from dataclasses import replace
from pathlib import Path

import numpy as np

from cnpgen.addons.trajectories.load_options import LoadOptions
from cnpgen.addons.trajectories.table_units import plain
from cnpgen.addons.trajectories.trajectory_table import TrajectoryTable, Values
from cnpgen.documents import Names
from cnpgen.errors import UsageError
from cnpgen.plans.format import PHASE_COLUMN
from cnpgen.plans.stated_units import UNIT_ATTRIBUTES
from cnpgen.robots.parameter_ranges import PARAMETER_UNITS
from cnpgen.store.files.archives import ArchiveError, read_arrays
from cnpgen.store.files.hdf5 import open_hdf5

JOINT_NAMES = "joint_names"  # array of an archive, dataset or attribute of HDF5
MAX_ARCHIVE_BYTES = 1 << 29  # of the arrays of an archive as floats
# of an array of one plan in an archive of cnpgen
_PART_OF_ARCHIVE = re.compile(
    rf"(.+?)_(t|{PHASE_COLUMN}|q|dq|ddq|jerk|{'|'.join(PARAMETER_UNITS)})"
)
# Of cnpgen: arrays of its archives beside those of each plan.
_HELD_ARRAYS = {"held_joint_names", "held_joint_positions"}
_OF_ALL_PLANS = {"plan", "sample_id"}


def read_npz(path: Path, _: LoadOptions) -> Iterator[TrajectoryTable]:
    """Yield the trajectories of an archive; raise UsageError if it is damaged."""
    try:
        arrays = read_arrays(path, max_bytes=MAX_ARCHIVE_BYTES)
    except ArchiveError as error:
        raise UsageError(
            f"{path} is not an archive of NumPy arrays, or is damaged: {error}"
        ) from error
    names = tuple(map(str, arrays.pop(JOINT_NAMES, np.array([], np.str_)).ravel()))
    held = {}
    if arrays.keys() >= _HELD_ARRAYS:
        joints, positions = (arrays.pop(name).ravel() for name in sorted(_HELD_ARRAYS))
        held = dict(zip(map(str, joints), positions.astype(float), strict=False))
    for table in _split(path, arrays, names):
        yield replace(table, held_joints=held)


def read_hdf5_tables(path: Path, _: LoadOptions) -> Iterator[TrajectoryTable]:
    """Yield the trajectories of datasets; attributes give the names of joints and the units."""
    with open_hdf5(path) as file:
        columns = file.columns(without=(JOINT_NAMES,))
        holders = [file.attributes, *(each.attributes for each in columns.values())]
        stated = [each.texts(JOINT_NAMES) for each in holders if JOINT_NAMES in each]
        unused = [*(set(file.names()) - set(file))]
        if JOINT_NAMES in file.names():
            stated.append(file.texts(JOINT_NAMES))
            of_names = file.attributes_of(JOINT_NAMES)
            unused += [f"attribute {name} of {JOINT_NAMES}" for name in of_names]
        if len(set(stated)) > 1:
            raise UsageError(
                f"{path}: {JOINT_NAMES} differ: {', '.join(stated[0])} and {', '.join(stated[-1])}"
            )
        names = stated[0] if stated else ()
        arrays = {name: column.read() for name, column in columns.items()}
        units = dict[str, str]()
        unused += [f"attribute {name}" for name in file.attributes]
        for name, column in columns.items():
            for attribute in column.attributes:
                if attribute in UNIT_ATTRIBUTES:
                    (units[name],) = column.attributes.texts(attribute)
                elif attribute != JOINT_NAMES:
                    unused.append(f"attribute {attribute} of {name}")
    known = {f"attribute {JOINT_NAMES}", JOINT_NAMES}
    unused = [name for name in unused if name not in known]
    for table in _split(path, with_units(arrays, units), names):
        yield replace(table, unused=(*table.unused, *sorted(unused)))


def _split(
    path: Path, arrays: dict[str, Values], names: Names
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
    read = {f"{label}_{name}" for label, columns in parts.items() for name in columns}
    unused = tuple(name for name in arrays if name not in read | _OF_ALL_PLANS)
    for label, columns in parts.items():
        yield TrajectoryTable(f"{path}: {label}", columns, names, unused=unused)


def with_units(
    columns: dict[str, Values], units: Mapping[str, str]
) -> dict[str, Values]:
    """Add the units that a file states beside its columns to their names."""
    known = {name: unit for name, unit in units.items() if unit and plain(name) == name}
    return {
        f"{name} [{known[name]}]" if name in known else name: values
        for name, values in columns.items()
    }
