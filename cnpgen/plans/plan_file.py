"""Plan files: HDF5 with one dataset per field, and the whole problem in its attributes.

Readers check names, shapes and types, not values.
"""

from __future__ import annotations

import io
import os
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from cnpgen.arrays import AnyArray, Columns, Integers
from cnpgen.errors import DatasetError, RecipeError, UsageError, nearest
from cnpgen.plans.format import (
    ATTRIBUTES,
    CONDITIONS,
    FLOATS,
    FORMAT,
    INTEGERS,
    JOINT_NAMES,
    KNOWN,
    NOTES,
    PLAN_FILE_VERSION,
    REQUIRED,
    SI_UNITS,
    PlanStatus,
    plan_fields,
    refuse_misspelt,
    refuse_other_joints,
    report_unused,
    stated_joints,
)
from cnpgen.plans.plans import Plans, make_plans
from cnpgen.plans.stated_units import refuse_other_units
from cnpgen.plans.tips import correct_tips
from cnpgen.problems.problem import Problem
from cnpgen.problems.problem_file import load_problem
from cnpgen.problems.problem_record import (
    ProblemRecord,
    as_record,
    extrapolated_record,
    record_problem,
)
from cnpgen.schema.argument_types import checked_arguments
from cnpgen.store.dataset_spec import StoredProblem
from cnpgen.store.files.atomic import write_file
from cnpgen.store.files.checksum_file import (
    HEADER_BYTES,
    verify_checksum,
    with_checksum,
)
from cnpgen.store.files.hdf5 import Column, Hdf5, create_hdf5, open_hdf5
from cnpgen.store.files.kind import PLANS
from cnpgen.store.paths import ANY_HDF5, file_kind, require_file
from cnpgen.store.shard import field_attributes
from cnpgen.trajectory.boundary import Boundary


@checked_arguments
def load_plans(
    path: str | Path,
    *,
    problem: Problem | StoredProblem | str | Path | None = None,
    extrapolate: bool = False,
) -> Plans:
    """Read plans from a file of cnpgen or of other software.

    Names, shapes and types must be correct. Values are not checked; the verdict judges
    every plan later. The checksum of files of cnpgen is verified; other files have
    none, and ``has_checksum`` of the plans is False.

    Args:
        path: Path of the file.
        problem: Required problem: a problem, a record, or the name or path of a
            problem, pipeline or dataset. Its tolerances replace those in the file.
        extrapolate: Whether parameters may be outside of their ranges. The problem of
            the plans then has wider ranges, and a name that ends with "-extrapolated".

    Raises:
        UsageError: The file does not exist or is of another kind.
        DatasetError: The file is damaged, incomplete, or of another problem.
        RecipeError: ``problem`` has errors, or a required plug-in is not installed.
        MachineError: The file cannot be read.
    """
    path = Path(path)
    wanted = None if problem is None else as_record(problem)
    of_dataset = "'cnpgen solve' and 'cnpgen plan' make plans for its rows"
    require_file(
        path, "a file of plans", kinds=(PLANS, ANY_HDF5), of_dataset=of_dataset
    )
    has_checksum = verify_checksum(path, kind=FORMAT, version=PLAN_FILE_VERSION)
    with open_hdf5(path) as file:
        attributes = file.attributes.some((*ATTRIBUTES, *NOTES))
        _check_format(path, attributes)
        columns = _columns(path, file)
        joints = {} if has_checksum else stated_joints(file)
        if not has_checksum:
            # Files of cnpgen have the names and units of the format; others may have
            # misspelled optional ones.
            refuse_misspelt(path, columns, CONDITIONS)
            refuse_other_units(file, SI_UNITS)
            read = *ATTRIBUTES, *NOTES, JOINT_NAMES
            report_unused(path, file, read, columns)
    record = agreed_problem(
        path,
        stored_problem(path, attributes, required=wanted is None),
        wanted,
        content="plans",
        command="evaluate",
        parameters=columns.get("parameters", ()) if extrapolate else None,
    )
    refuse_other_joints(path, joints, record.joint_names)
    with errors_of_file(path):
        plans = _assembled(path, record, columns, attributes)
    return correct_tips(replace(plans, has_checksum=has_checksum), where=f"{path}: ")


@contextmanager
def errors_of_file(path: Path) -> Iterator[None]:
    """Raise UsageErrors about the content of a file as DatasetErrors that name it."""
    try:
        yield
    except UsageError as error:
        field = f"{error.argument} " if error.is_predicate else ""
        raise DatasetError(
            f"{path}: {field}{error.args[0]}", remedies=error.remedies
        ) from error


def _columns(path: Path, file: Hdf5) -> Columns:
    """Read the datasets of a file."""
    columns = {name: _read(path, name, item) for name, item in file.columns().items()}
    missing = [
        name + nearest(name, columns.keys() - KNOWN)
        for name in REQUIRED
        if name not in columns
    ]
    if missing:
        raise DatasetError(
            f"{path} lacks {', '.join(missing)}: plans need {', '.join(REQUIRED)}"
        )
    if "status" in columns:
        named = file["status"].attributes.some(("flag_values", "flag_meanings"))
        columns["status"] = _statuses(path, columns["status"], named)
    return columns


def _read(path: Path, name: str, dataset: Column) -> AnyArray:
    """Read a dataset in its required type."""
    what, kinds = (
        ("integers", "iu")
        if name in INTEGERS
        else ("floats", "f")
        if name in FLOATS
        else ("numbers", "fiu")
    )
    if dataset.dtype.kind not in kinds:
        raise DatasetError(f"{path}: {name} must hold {what}, got {dataset.dtype}")
    values = dataset.read()
    if name not in INTEGERS:
        return np.asarray(values, np.float64)
    # Unsigned integers of 64 bits may exceed int64.
    if values.size and values.max() > np.iinfo(np.int64).max:
        raise DatasetError(
            f"{path}: {name} must hold integers below 2^63, got {values.max()}"
        )
    return np.asarray(values, np.int64)


def _check_format(path: Path, attributes: Mapping[str, Any]) -> None:
    """Raise DatasetError for files of another kind."""
    if "format" in attributes and _text(path, attributes, "format") != FORMAT:
        raise DatasetError(
            f"{path} is a {_text(path, attributes, 'format')} file, not one of plans ({FORMAT})"
        )
    version = _number(path, attributes, "format_version", PLAN_FILE_VERSION)
    if version > PLAN_FILE_VERSION:
        raise DatasetError(
            f"{path} has format version {version}, this cnpgen reads {PLAN_FILE_VERSION}: upgrade cnpgen"
        )


def _text(path: Path, attributes: Mapping[str, Any], name: str) -> str:
    value = attributes[name]
    if isinstance(value, bytes):
        try:
            return value.decode()
        except UnicodeDecodeError as error:
            raise DatasetError(
                f"{path} is damaged: its attribute {name!r} is no text"
            ) from error
    if not isinstance(value, str):
        raise DatasetError(
            f"{path}: the attribute {name!r} must be a text, got {value!r}"
        )
    return value


def _number(path: Path, attributes: Mapping[str, Any], name: str, default: int) -> int:
    value = attributes.get(name, default)
    if np.ndim(value) or not np.issubdtype(np.asarray(value).dtype, np.integer):
        raise DatasetError(
            f"{path}: the attribute {name!r} must be an integer, got {value!r}"
        )
    return int(value)


def agreed_problem(
    path: Path,
    stored: ProblemRecord | None,
    wanted: ProblemRecord | None,
    *,
    content: str,
    command: str,
    parameters: ArrayLike | None = None,
) -> ProblemRecord:
    """Return the problem of a file: the required one if it is consistent, or the file's own.

    The ranges of both are widened by parameters that may be outside of them.
    Content and command, which has the option ``--problem``, are for messages:
    DatasetError for another problem, and UsageError without one.
    """
    if parameters is not None:
        stored, wanted = (
            record and extrapolated_record(record, parameters)
            for record in (stored, wanted)
        )
    # The problem of the file decides; one that the caller names must have comparable
    # plans.
    found = stored or wanted
    if found is None:
        help_ = f"set its attribute 'problem' to a name or a file, or pass {{problem}} ('cnpgen {command}' takes it)"
        raise UsageError(
            f"{path} does not name its problem: {help_}", remedies={"problem": None}
        )
    if wanted is not None and found.comparable_sha256 != wanted.comparable_sha256:
        where = ", ".join(found.differences(wanted)[:4])
        raise DatasetError(
            f"{path} has {content} of problem {found.name!r}, not of {wanted.name!r}: they differ in {where}"
        )
    return wanted or found


def stored_problem(
    path: Path, attributes: Mapping[str, Any], *, required: bool = True
) -> ProblemRecord | None:
    """Return the problem named by the attributes of a file; None if they name none.

    A problem in another folder, which is not opened, is an error if it is required,
    otherwise ignored.

    Raises:
        DatasetError: The named problem is damaged, cannot be found or is in another
            folder than the file.
    """
    if "problem_recipe" in attributes:
        return _stored_record(path, attributes)
    if "problem" not in attributes:
        return None
    name = _text(path, attributes, "problem")
    # A file from another place must not make this process read any path that it names.
    if not _is_beside(path, name):
        if not required:
            return None
        raise DatasetError(
            f"{path}: the attribute 'problem' names {name!r:.200}, which is not in the folder of the file or below:"
            " pass {problem} to use this file",
            remedies={"problem": None},
        )
    try:
        record = record_problem(load_problem(name, relative_to=path.parent))
    except RecipeError as error:
        raise DatasetError(f"{path}: the attribute 'problem': {error}") from error
    if (
        "problem_sha256" in attributes
        and _text(path, attributes, "problem_sha256") != record.comparable_sha256
    ):
        ours = record.comparable_sha256
        raise DatasetError(
            f"{path} is of another {name!r}: its problem_sha256 is not this one's, {ours}"
        )
    return record


def _is_beside(path: Path, problem: str) -> bool:
    """Return whether a problem is a name, or a path in the folder of the file that names it, links resolved."""
    try:
        folder = os.path.realpath(path.parent)
        file = os.path.realpath(path.parent / problem)
    except ValueError:  # a zero byte
        return False
    is_name = not {"/", os.sep} & set(problem) and not os.path.isfile(file)  # noqa: PTH113 - as in find_file
    return is_name or Path(file).is_relative_to(folder)


def _stored_record(path: Path, attributes: Mapping[str, Any]) -> ProblemRecord:
    """Return the problem stored as text in the file."""
    missing = [
        name for name in ("problem_urdf", "problem_sha256") if name not in attributes
    ]
    if missing:
        raise DatasetError(
            f"{path} has an attribute 'problem_recipe' but no {' and no '.join(missing)}"
        )
    record = ProblemRecord(
        _text(path, attributes, "problem_recipe"),
        _text(path, attributes, "problem_urdf"),
    )
    try:
        same = (
            record.comparable_sha256 == _text(path, attributes, "problem_sha256")
            # The trajectory is parsed here, so that an invalid one is reported as
            # damage of the file.
            and record.trajectory.degree > 0
        )
    except RecipeError as error:
        raise DatasetError(f"{path} is damaged: its {error}") from error
    if not same:
        raise DatasetError(
            f"{path} is damaged: its problem was changed after it was written"
        )
    return record


def _assembled(
    path: Path,
    record: ProblemRecord,
    columns: Columns,
    attributes: Mapping[str, Any],
) -> Plans:
    """Build the plans from the contents of the file."""
    boundary = [columns.pop(name, None) for name in CONDITIONS]
    points = columns.pop("path_control_points")
    # Redundant; r determines it.
    duration = columns.pop("duration", None)
    plans = make_plans(
        record,
        Boundary(*boundary),  # type: ignore[arg-type]
        path_control_points=points,
        rate_control_points=columns.pop("rate_control_points"),
        degree=_number(path, attributes, "degree", record.trajectory.degree),
        sample_id=columns.pop("sample_id", None),
        status=columns.pop("status", None),
        columns=columns,
        # The verdict reports them.
        allow_large_angles=True,
    )
    if duration is not None and duration.shape != (len(plans),):
        raise UsageError(
            f"must have shape {(len(plans),)}, got {duration.shape}",
            argument="duration",
        )
    source, options = (
        _text(path, attributes, name) if name in attributes else "" for name in NOTES
    )
    return replace(plans, source=source, refined_with=options)


def _statuses(
    path: Path, stored: Integers, attributes: Mapping[str, Any]
) -> NDArray[np.uint8]:
    """Translate status values by their names in the file.

    Unknown names become UNKNOWN.
    """
    # Without names in the file, its numbers are those of PlanStatus.
    known = {int(status): status for status in PlanStatus}
    if "flag_values" in attributes and "flag_meanings" in attributes:
        names = {status.name.lower(): status for status in PlanStatus}
        words = _text(path, attributes, "flag_meanings").split()
        values = np.ravel(attributes["flag_values"]).tolist()
        known = {
            value: names.get(word, PlanStatus.UNKNOWN)
            for value, word in zip(values, words, strict=False)
        }
    found = [known.get(value, PlanStatus.UNKNOWN) for value in stored.ravel().tolist()]
    return np.array(found, np.uint8).reshape(stored.shape)


@checked_arguments
def save_plans(path: str | Path, plans: Plans) -> None:
    """Write plans to a file with a checksum, atomically; equal plans give equal bytes.

    Args:
        path: Path of the file. An existing plan file is replaced, and missing folders
            are created (unlike by commands).
        plans: Plans to write.

    Raises:
        UsageError: The path holds another file, or ``plans`` has another type, or a
            parameter outside of its range.
        MachineError: The disk is full or read-only, or a file operation failed.
    """
    import h5py

    check_replaceable(Path(path))
    # Arrays may have changed since they were checked.
    plans = replace(plans)
    buffer = io.BytesIO()
    fields = plan_fields(plans.problem.joint_names, plans.problem.prismatic_joints)
    with h5py.File(create_hdf5(buffer, userblock=HEADER_BYTES)) as file:
        for name, values in _datasets(plans).items():
            dataset = file.create_dataset(name, data=values, track_times=False)
            _write_attributes(
                dataset, field_attributes(fields[name]) if name in fields else {}
            )
        file["status"].attrs["flag_values"] = np.array(list(PlanStatus), np.uint8)
        _write_attributes(
            file["status"],
            {"flag_meanings": " ".join(status.name.lower() for status in PlanStatus)},
        )
        _write_attributes(file, _attributes(plans))
    write_file(
        Path(path),
        with_checksum(buffer.getvalue(), kind=FORMAT, version=PLAN_FILE_VERSION),
    )


def check_replaceable(path: Path) -> None:
    """Raise UsageError unless a path is free, or holds an older plan file or an empty file."""
    if path.is_dir():
        raise UsageError(
            f"{path} is a folder, expected a file for plans", concerns="path"
        )
    if not path.exists() or (path.is_file() and path.stat().st_size == 0):
        return
    kind = file_kind(path)
    if kind != PLANS:
        what = f"{kind}, not one of plans" if kind else "not a file of plans"
        raise UsageError(
            f"{path} is {what}: it is not replaced; remove it, or choose another file",
            concerns="path",
        )


def _datasets(plans: Plans) -> Columns:
    """Return the stored datasets, in order and in their stored types."""
    # Columns are sorted: the order of a mapping does not change the bytes.
    floats = plans.boundary.arrays() | dict(sorted(plans.columns.items()))
    floats |= {
        "path_control_points": plans.path_control_points,
        "rate_control_points": plans.rate_control_points,
    }
    floats["duration"] = plans.duration
    stored: Columns = {
        name: np.ascontiguousarray(values, "<f8") for name, values in floats.items()
    }
    return stored | {
        "sample_id": plans.sample_id.astype("<i8"),
        "status": plans.status.astype("u1"),
    }


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
        # HDF5 has no texts of length zero; empty values are left out.
        elif value not in {"", "[]"}:
            data = value.encode()
            item.attrs[name] = np.array(data, h5py.string_dtype("utf-8", len(data)))
