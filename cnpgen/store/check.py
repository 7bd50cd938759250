"""The shallow check of a dataset: every file is there, whole, and what the blueprint says; no row is computed again."""

from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from cnpgen.errors import DatasetError
from cnpgen.store.blueprint import Blueprint, ShardTask, load_blueprint, shard_attributes, shards
from cnpgen.store.field import Field
from cnpgen.store.files.atomic import file_sha256
from cnpgen.store.intact import AGAIN, OUTSIDE, leads_outside
from cnpgen.store.layout import CARD, CROISSANT, MANIFEST, PLAN, STATS, WORK
from cnpgen.store.manifest import data_fingerprint, lists_shards_of, load_manifest
from cnpgen.store.record import load_record
from cnpgen.store.shard import (
    FORMAT,
    FORMAT_VERSION,
    StoredField,
    field_attributes,
    read_attributes,
    read_schema,
    storage_dtype,
)
from cnpgen.store.summary import summarise, unfinished

_LISTED = (PLAN, STATS, CARD, CROISSANT)
_NOTHING = "(nothing)"

MAKE_AGAIN = f"{AGAIN}: it makes what is damaged or missing and keeps the rest"
REPLACE = (
    "nothing else says what the dataset was to be: make it anew with make_dataset(..., force=True) or"
    " 'cnpgen make-dataset --force'"
)
DELETE = f"delete such a shard and the .json beside it, then {AGAIN}"
COPY = "copy the dataset so that links become files: cp -rL"
REMOVE = "move elsewhere what is not part of the dataset"


@dataclass(frozen=True)
class Finding:
    """Something that is not as it should be.

    Attributes:
        file: Path relative to the dataset's folder.
        problem: What is wrong with it.
        note: Whether it is only worth knowing: the dataset is good nevertheless.
        advice: What to do about it.
    """

    file: str
    problem: str
    note: bool = False
    advice: str = ""

    def __str__(self) -> str:
        return f"{self.file}: {self.problem}"


def check_dataset(folder: Path) -> list[Finding]:
    """Check the files of a dataset against its manifest, its sidecars and its blueprint.

    Args:
        folder: The dataset's folder.

    Returns:
        What is wrong, by file; nothing if all is well. A dataset without manifest is checked as far as it goes.

    Raises:
        MachineError: The system would not let us read something.
    """
    try:
        blueprint = load_blueprint(folder)
    except DatasetError as error:
        return [Finding(PLAN, _reason(error, folder / PLAN), advice=REPLACE)]
    findings, manifest = _check_manifest(folder, blueprint)
    entries, finished = _shard_entries(manifest), (folder / MANIFEST).exists()
    for task in shards(blueprint):
        entry = entries.get(task.file)
        if finished or (folder / task.sidecar).exists():
            findings += check_shard(folder, blueprint, task, entry)
    return findings + list(_extras(folder, blueprint))


def check_documents(folder: Path, blueprint: Blueprint) -> list[Finding]:
    """Check what sums up a finished dataset: the manifest, the files it lists and the sidecars; no shard is read.

    Args:
        folder: The dataset's folder.
        blueprint: Its blueprint.

    Raises:
        MachineError: The system would not let us read something.
    """
    findings, manifest = _check_manifest(folder, blueprint)
    for entry in _shard_entries(manifest).values():
        findings += _check_digest(folder, entry["sidecar"]["file"], entry["sidecar"]["sha256"])
    return findings


def _reason(error: DatasetError, path: Path) -> str:
    """Return an error's message without the file, which the caller names."""
    return str(error).removeprefix(f"{path} ").removeprefix(f"{path}: ")


def _check_manifest(folder: Path, blueprint: Blueprint) -> tuple[list[Finding], dict[str, Any]]:
    """Check the manifest and the files it lists; return it empty if it cannot be relied upon."""
    if not (folder / MANIFEST).exists():
        summary = summarise(folder, blueprint, allow_incomplete=True)
        return [Finding(MANIFEST, f"is missing: the dataset is {unfinished(summary)}", advice=MAKE_AGAIN)], {}
    try:
        manifest = load_manifest(folder)
    except DatasetError as error:
        return [Finding(MANIFEST, _reason(error, folder / MANIFEST), advice=MAKE_AGAIN)], {}
    if manifest["plan_fingerprint"] != blueprint.fingerprint:
        return [Finding(MANIFEST, "is of another blueprint than plan.json", advice=MAKE_AGAIN)], {}
    if not lists_shards_of(manifest, blueprint):
        return [Finding(MANIFEST, "lists other shards than plan.json", advice=MAKE_AGAIN)], {}
    entries, findings = _shard_entries(manifest), []
    if data_fingerprint((file, entry["sha256"]) for file, entry in entries.items()) != manifest["fingerprint"]:
        findings.append(Finding(MANIFEST, "its fingerprint is not that of the shards it lists", advice=MAKE_AGAIN))
    for name in _LISTED:
        entry = manifest["files"][name]
        findings += _check_file(folder, name, entry["bytes"], entry["sha256"])
    return findings, manifest


def _shard_entries(manifest: dict[str, Any]) -> dict[str, dict[str, Any]]:
    return {entry["file"]: entry for split in manifest.get("splits", {}).values() for entry in split["shards"]}


def _check_digest(folder: Path, name: str, sha256: str) -> list[Finding]:
    """Compare a file with its recorded digest."""
    if not (folder / name).is_file():
        return [Finding(name, "is missing", advice=MAKE_AGAIN)]
    if file_sha256(folder / name) != sha256:
        return [Finding(name, "was changed: its sha256 is not the recorded one", advice=MAKE_AGAIN)]
    return []


def check_shard(
    folder: Path, blueprint: Blueprint, task: ShardTask, entry: dict[str, Any] | None = None
) -> list[Finding]:
    """Check one shard and its sidecar.

    Args:
        folder: The dataset's folder.
        blueprint: Its blueprint.
        task: Which shard.
        entry: What the manifest says about it, if there is one.

    Returns:
        What is wrong.

    Raises:
        MachineError: The system would not let us read it.
    """
    path = folder / task.file
    findings, expected = _check_sidecar(folder, blueprint, task, entry)
    if not path.is_file():
        return [*findings, Finding(task.file, "is missing", advice=MAKE_AGAIN)]
    if outside := [name for name in (task.file, task.sidecar) if leads_outside(folder / name)]:
        return [*findings, *(Finding(name, OUTSIDE, advice=COPY) for name in outside)]
    if expected is None:  # nobody knows what the file should be, and findings says why
        return findings
    damage = _check_file(folder, task.file, *expected)
    if damage and not _is_of_another_blueprint(path, blueprint.of(task)):
        return findings + damage  # what HDF5 makes of a damaged file tells nothing, and may take forever
    content = check_content(folder, blueprint, task)
    if findings or damage:  # then make-dataset notices by itself that the shard is not the one that it made
        content = [replace(finding, advice=MAKE_AGAIN) for finding in content]
    return findings + damage + content


def _check_file(folder: Path, name: str, size: int, sha256: str) -> list[Finding]:
    """Compare a file with its recorded size and digest."""
    path = folder / name
    if path.is_file() and (found := path.stat().st_size) != size:
        return [Finding(name, f"has {found} bytes instead of {size}", advice=MAKE_AGAIN)]
    return _check_digest(folder, name, sha256)


def _is_of_another_blueprint(path: Path, blueprint: Blueprint) -> bool:
    """Whether a shard that is not the recorded one is a sound shard of another blueprint."""
    try:
        return read_attributes(path, ["plan_key"])["plan_key"] != blueprint.key
    except DatasetError:
        return False


def _check_sidecar(
    folder: Path, blueprint: Blueprint, task: ShardTask, entry: dict[str, Any] | None
) -> tuple[list[Finding], tuple[int, str] | None]:
    """Check a sidecar; return also the size and digest that the shard should have, as far as somebody knows."""
    expected = None if entry is None else (entry["bytes"], entry["sha256"])
    try:
        record = load_record(folder, task)
    except DatasetError as error:
        return [Finding(task.sidecar, _reason(error, folder / task.sidecar), advice=MAKE_AGAIN)], expected
    findings = [] if entry is None else _check_digest(folder, task.sidecar, entry["sidecar"]["sha256"])
    if record.plan_fingerprint != blueprint.of(task).fingerprint:
        text = f"belongs to another blueprint ({record.plan_fingerprint[:12]}...)"
        findings.append(Finding(task.sidecar, text, advice=MAKE_AGAIN))
    return findings, expected or (record.bytes, record.sha256)


def check_content(folder: Path, blueprint: Blueprint, task: ShardTask) -> list[Finding]:
    """Compare what a shard says about itself with the blueprint.

    Args:
        folder: The dataset's folder.
        blueprint: Its blueprint.
        task: Which shard; its file should be known to be as it was written (see :func:`read_attributes`).

    Returns:
        What is wrong: attributes, fields, shapes, types, units.
    """
    path = folder / task.file
    try:
        attributes, schema = read_attributes(path), read_schema(path)
    except DatasetError as error:
        return [Finding(task.file, _reason(error, path), advice=DELETE)]
    expected = {"format": FORMAT, "format_version": FORMAT_VERSION, **shard_attributes(blueprint, task)}
    problems = [
        f"its {name} is {attributes.get(name)!r}, plan.json says {value!r}"
        for name, value in expected.items()
        if attributes.get(name) != value
    ]
    names = {field.name for field in blueprint.fields}
    problems += [f"lacks the field {name!r}" for name in sorted(names - schema.keys())]
    problems += [f"has an unknown field {name!r}" for name in sorted(schema.keys() - names)]
    for field in blueprint.fields:
        if field.name in schema:
            problems += _check_field(field, schema[field.name], blueprint, task)
    return [Finding(task.file, problem, advice=DELETE) for problem in problems]


def _check_field(field: Field, found: StoredField, blueprint: Blueprint, task: ShardTask) -> list[str]:
    """Compare what a shard says about a field with the blueprint."""
    shape = (task.rows, field.width) if field.width else (task.rows,)
    dtype = storage_dtype(field, blueprint.dtype)
    problems = []
    if found.shape != shape or found.dtype != dtype:
        problems.append(f"field {field.name!r} is {found.dtype} of shape {found.shape}, not {dtype} of shape {shape}")
    expected = field_attributes(field)
    pairs = {
        name: (found.attributes.get(name, _NOTHING), expected.get(name, _NOTHING))
        for name in expected | found.attributes
    }
    return problems + [
        f"field {field.name!r} has {name} {has!r}, plan.json says {planned!r}"
        for name, (has, planned) in pairs.items()
        if not np.array_equal(has, planned)
    ]


def _extras(folder: Path, blueprint: Blueprint) -> Iterator[Finding]:
    """Name what does not belong to the dataset, a foreign folder as a whole."""
    known = {PLAN, MANIFEST, *_LISTED, WORK, *blueprint.splits}
    for task in shards(blueprint):
        known |= {task.file, task.sidecar}
    for parent in [folder, *(folder / split for split in blueprint.splits)]:
        for item in sorted(parent.iterdir()) if parent.is_dir() else ():
            name = item.relative_to(folder).as_posix()
            if name not in known:
                loaded = parent != folder and item.suffix == ".h5"
                text = "is not part of the dataset" + (", but loaders would read it" if loaded else "")
                yield Finding(name, text, note=not loaded, advice=REMOVE)
