"""Writer of plan files: HDF5 with one dataset per field, and the whole problem in its attributes."""

import io
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from cnpgen.errors import UsageError
from cnpgen.plans.format import FORMAT, NOTES, PLAN_FILE_VERSION, plan_fields
from cnpgen.plans.plans import Plans
from cnpgen.plans.status import PlanStatus
from cnpgen.schema.argument_types import checked_arguments
from cnpgen.store.files.atomic import write_file
from cnpgen.store.files.checksum_file import HEADER_BYTES, with_checksum
from cnpgen.store.files.hdf5 import create_hdf5
from cnpgen.store.files.kind import PLANS
from cnpgen.store.paths import file_kind
from cnpgen.store.shard import field_attributes


@checked_arguments
def save_plans(path: str | Path, plans: Plans) -> None:
    """Write plans to a file with a checksum, atomically; equal plans give equal bytes.

    Args:
        path: Path of the file. An existing plan file is replaced, and missing folders are created (unlike by commands).
        plans: Plans to write.

    Raises:
        UsageError: The path holds another file, or ``plans`` has another type.
        MachineError: The disk is full or read-only, or a file operation failed.
    """
    import h5py

    check_replaceable(Path(path))
    buffer = io.BytesIO()
    fields = plan_fields(plans.problem.joint_names, plans.problem.sliding_joints)
    with h5py.File(create_hdf5(buffer, userblock=HEADER_BYTES)) as file:
        for name, values in _datasets(plans).items():
            dataset = file.create_dataset(name, data=values, track_times=False)
            _write_attributes(dataset, field_attributes(fields[name]) if name in fields else {})
        file["status"].attrs["flag_values"] = np.array(list(PlanStatus), np.uint8)
        _write_attributes(file["status"], {"flag_meanings": " ".join(status.name.lower() for status in PlanStatus)})
        _write_attributes(file, _attributes(plans))
    write_file(Path(path), with_checksum(buffer.getvalue(), kind=FORMAT, version=PLAN_FILE_VERSION))


def check_replaceable(path: Path) -> None:
    """Check that a path is free, or holds an older plan file or an empty file.

    Raises:
        UsageError: The path holds another file.
    """
    if path.is_dir():
        raise UsageError(f"{path} is a folder, expected a file for plans", concerns="path")
    if not path.exists() or (path.is_file() and path.stat().st_size == 0):
        return
    kind = file_kind(path)
    if kind != PLANS:
        what = f"{kind}, not one of plans" if kind else "not a file of plans"
        raise UsageError(f"{path} is {what}: it is not replaced; remove it, or choose another file", concerns="path")


def _datasets(plans: Plans) -> dict[str, NDArray[Any]]:
    """Return the stored datasets, in order and in their stored types."""
    floats = plans.boundary.arrays() | dict(sorted(plans.columns.items()))
    floats |= {"path_control_points": plans.path_control_points, "rate_control_points": plans.rate_control_points}
    floats["duration"] = plans.duration
    stored: dict[str, NDArray[Any]] = {name: np.ascontiguousarray(values, "<f8") for name, values in floats.items()}
    return stored | {"sample_id": plans.sample_id.astype("<i8"), "status": plans.status.astype("u1")}


def _attributes(plans: Plans) -> dict[str, str | int]:
    record = plans.problem
    return {
        "format": FORMAT,
        "format_version": PLAN_FILE_VERSION,
        "degree": plans.degree,
        "problem": record.name,
        "problem_recipe": record.recipe,
        "problem_urdf": record.urdf,
        "problem_sha256": record.comparable_sha256,
        **{name: getattr(plans, name) for name in NOTES},
    }


def _write_attributes(item: Any, attributes: Mapping[str, Any]) -> None:
    """Write attributes; use texts of fixed length, since variable length can make HDF5 hang on damaged files."""
    import h5py

    for name, value in attributes.items():
        if not isinstance(value, str):
            item.attrs[name] = value
        elif value not in {"", "[]"}:
            data = value.encode()
            item.attrs[name] = np.array(data, h5py.string_dtype("utf-8", len(data)))
