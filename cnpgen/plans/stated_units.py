"""Attributes of datasets that say what their numbers mean: units, scales and offsets."""

from collections.abc import Mapping

from cnpgen.errors import DatasetError
from cnpgen.schema.units import UNITS
from cnpgen.store.files.hdf5 import Hdf5
from cnpgen.store.joint_units import SLIDING_UNITS

UNIT_ATTRIBUTES = "unit", "units"  # of a dataset of HDF5 or a field of Parquet
SCALE_ATTRIBUTES = "scale", "scale_factor", "offset", "add_offset"


def refuse_other_units(file: Hdf5, units: Mapping[str, str]) -> None:
    """Refuse datasets whose attributes state a unit that is not the SI unit, a scale or an offset.

    Files of plans and problems of other software are read in SI units, as they are.

    Args:
        file: An open file.
        units: Dataset -> its SI unit, for joints that of revolute ones; datasets that
            the file lacks are skipped. An empty unit stands for any SI unit.

    Raises:
        DatasetError: A dataset has such an attribute.
    """
    for name, expected in units.items():
        if name not in file:
            continue
        attributes = file[name].attributes
        for key in attributes:
            if key in SCALE_ATTRIBUTES:
                _refuse(file, name, key, "a scale", expected)
            if key in UNIT_ATTRIBUTES:
                # One unit for all columns, or one for each, separated by commas.
                stated = ",".join(attributes.texts(key)).split(",")
                for unit in filter(None, map(str.strip, stated)):
                    if not _is_si(unit, expected):
                        _refuse(file, name, key, repr(unit), expected)


def _is_si(unit: str, expected: str) -> bool:
    """Return whether a unit is the expected SI unit, also for sliding joints."""
    si, factor = UNITS.get(unit, ("", 0))
    wanted = {expected, SLIDING_UNITS.get(expected, expected)} if expected else {si}
    return unit in wanted or (si in wanted and factor == 1)


def _refuse(file: Hdf5, name: str, key: str, value: str, expected: str) -> None:
    raise DatasetError(
        f"{file.path}: the attribute {key!r} of {name} states {value}:"
        f" convert the numbers to {expected or 'SI units'} and remove it"
    )
