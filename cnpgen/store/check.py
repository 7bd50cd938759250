"""Shallow check of a dataset: every file exists, is undamaged and fits the specification. No sample is recomputed."""

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path

import numpy as np

from cnpgen.documents import JsonObject
from cnpgen.errors import DatasetError
from cnpgen.store.checked_shard import Shard, read_rows
from cnpgen.store.dataset_spec import (
    DatasetSpec,
    ShardTask,
    load_dataset_spec,
    shard_attributes,
    shards,
)
from cnpgen.store.dataset_summary import summarize_dataset, unfinished
from cnpgen.store.field import Field
from cnpgen.store.files.atomic import file_sha256
from cnpgen.store.intact import (
    COPY_HINT,
    OUTSIDE,
    RERUN_HINT,
    leads_outside,
    outside_links,
)
from cnpgen.store.layout import CROISSANT, MANIFEST, SPECIFICATION, WORK
from cnpgen.store.manifest import (
    LISTED,
    data_fingerprint,
    lists_shards_of,
    load_manifest,
    shard_entries,
)
from cnpgen.store.scene_table import SCENE_ARRAYS, scene_attributes
from cnpgen.store.shard import (
    SHARD_FORMAT,
    SHARD_VERSION,
    StoredField,
    field_attributes,
    read_attributes,
    read_schema,
    storage_dtype,
)
from cnpgen.store.shard_record import load_record

_MISSING = "(missing)"

REMAKE_HINT = f"{RERUN_HINT}: it replaces damaged or missing files and keeps the others"
REPLACE_HINT = (
    "without its specification the dataset cannot be repaired: make it again with make_dataset(..., force=True) or"
    " 'cnpgen make-dataset --force'"
)
DELETE_HINT = f"delete the shard and its .json file, then {RERUN_HINT}"
REMOVE_HINT = "move files that are not part of the dataset to another folder"


@dataclass(frozen=True)
class Finding:
    """A problem that a check of a dataset found.

    Attributes:
        file: Path relative to the folder of the dataset.
        problem: Description of the problem.
        note: True for a remark: the dataset is valid nevertheless.
        hint: How to solve the problem.
    """

    file: str
    problem: str
    note: bool = False
    hint: str = ""

    def __str__(self) -> str:
        return f"{self.file}: {self.problem}"


def check_dataset(folder: Path) -> list[Finding]:
    """Return the findings about the files of a dataset, its manifest, sidecars and specification.

    Of a dataset without manifest, the existing shards are checked.
    """
    links = [Finding(name, OUTSIDE, hint=COPY_HINT) for name in outside_links(folder)]
    try:
        spec = load_dataset_spec(folder)
    except DatasetError as error:
        return [
            *links,
            Finding(
                SPECIFICATION, _reason(error, folder / SPECIFICATION), hint=REPLACE_HINT
            ),
        ]
    findings, manifest = _check_manifest(folder, spec)
    findings = links + findings
    # Without a manifest only shards with a sidecar count: others are still to be made.
    entries = shard_entries(manifest)
    finished = (folder / MANIFEST).exists()
    for task in shards(spec):
        entry = entries.get(task.file)
        if finished or (folder / task.sidecar).exists():
            findings += check_shard(folder, spec, task, entry)
    return findings + list(_extras(folder, spec))


def check_documents(folder: Path, spec: DatasetSpec) -> list[Finding]:
    """Check the documents of a finished dataset: the manifest, the files it lists and the sidecars, but no shard."""
    findings, manifest = _check_manifest(folder, spec)
    for entry in shard_entries(manifest).values():
        findings += _check_file(
            folder, entry["sidecar"]["file"], entry["sidecar"]["sha256"]
        )
    return findings


def _reason(error: DatasetError, path: Path) -> str:
    """Return the message of an error without the name of the file."""
    return str(error).removeprefix(f"{path} ").removeprefix(f"{path}: ")


def _check_manifest(
    folder: Path, spec: DatasetSpec
) -> tuple[list[Finding], JsonObject]:
    """Check the manifest and the files it lists.

    Return also the manifest, empty if it is not valid.
    """
    finding = partial(Finding, MANIFEST, hint=REMAKE_HINT)
    if not (folder / MANIFEST).exists():
        summary = summarize_dataset(folder, spec, allow_incomplete=True)
        return [finding(f"is missing: the dataset is {unfinished(summary)}")], {}
    try:
        manifest = load_manifest(folder)
    except DatasetError as error:
        return [finding(_reason(error, folder / MANIFEST))], {}
    if manifest["specification_fingerprint"] != spec.fingerprint:
        return [finding(f"is of another specification than {SPECIFICATION}")], {}
    if not lists_shards_of(manifest, spec):
        return [finding(f"lists other shards than {SPECIFICATION}")], {}
    entries = shard_entries(manifest).items()
    findings = []
    # The manifest may be intact by its own checksum and still list shards of another
    # run.
    listed = data_fingerprint((file, entry["sha256"]) for file, entry in entries)
    if listed != manifest["fingerprint"]:
        findings.append(finding("its fingerprint is not that of the shards it lists"))
    # Descriptions are listed only if an add-on wrote them.
    for name in (name for name in LISTED if name in manifest["files"]):
        entry = manifest["files"][name]
        if name == CROISSANT and not (folder / name).exists():
            findings.append(
                Finding(
                    name,
                    "is missing, as in published datasets",
                    note=True,
                    hint=REMAKE_HINT,
                )
            )
        else:
            findings += _check_file(folder, name, entry["sha256"], entry["bytes"])
    return findings, manifest


def _check_file(
    folder: Path, name: str, sha256: str, size: int | None = None
) -> list[Finding]:
    """Compare a file with its recorded sha256 and its size, if that is recorded."""
    path = folder / name
    if not path.is_file():
        return [Finding(name, "is missing", hint=REMAKE_HINT)]
    # The size is compared first, since the sha256 needs the whole file.
    if size is not None and (actual := path.stat().st_size) != size:
        return [
            Finding(name, f"has {actual} bytes instead of {size}", hint=REMAKE_HINT)
        ]
    if file_sha256(path) != sha256:
        return [
            Finding(
                name,
                "was changed: its sha256 is not the recorded one",
                hint=REMAKE_HINT,
            )
        ]
    return []


def check_shard(
    folder: Path,
    spec: DatasetSpec,
    task: ShardTask,
    entry: JsonObject | None = None,
) -> list[Finding]:
    """Check one shard and its sidecar.

    ``entry`` is the entry of the shard in the manifest, None without a manifest.
    """
    path = folder / task.file
    findings, expected = _check_sidecar(folder, spec, task, entry)
    if not path.is_file():
        return [*findings, Finding(task.file, "is missing", hint=REMAKE_HINT)]
    if outside := [
        name for name in (task.file, task.sidecar) if leads_outside(folder / name)
    ]:
        return [
            *findings,
            *(Finding(name, OUTSIDE, hint=COPY_HINT) for name in outside),
        ]
    if expected is None:
        # Neither manifest nor sidecar is valid, which is a finding already.
        return findings
    damage = _check_file(folder, task.file, *expected)
    if damage and not _is_of_another_spec(path, spec.version_with(task)):
        # HDF5 may hang on a damaged file
        return findings + damage
    content = check_content(folder, spec, task)
    if findings or damage:
        # Make-dataset detects and replaces such a shard.
        content = [replace(finding, hint=REMAKE_HINT) for finding in content]
    return findings + damage + content


def _is_of_another_spec(path: Path, spec: DatasetSpec) -> bool:
    """Return whether a shard that is not the recorded one is an intact shard of another specification."""
    try:
        return (
            read_attributes(path, ["specification_key"])["specification_key"]
            != spec.key
        )
    except DatasetError:
        return False


def _check_sidecar(
    folder: Path, spec: DatasetSpec, task: ShardTask, entry: JsonObject | None
) -> tuple[list[Finding], tuple[str, int] | None]:
    """Check a sidecar; return also the recorded sha256 and size of the shard, or None if neither record is valid."""
    expected = None if entry is None else (entry["sha256"], entry["bytes"])
    try:
        record = load_record(folder, task)
    except DatasetError as error:
        return [
            Finding(
                task.sidecar, _reason(error, folder / task.sidecar), hint=REMAKE_HINT
            )
        ], expected
    findings = (
        []
        if entry is None
        else _check_file(folder, task.sidecar, entry["sidecar"]["sha256"])
    )
    if record.specification_fingerprint != spec.version_with(task).fingerprint:
        findings.append(
            Finding(
                task.sidecar,
                f"belongs to another specification ({record.specification_fingerprint[:12]}...)",
                hint=REMAKE_HINT,
            )
        )
    return findings, expected or (record.sha256, record.bytes)


def check_content(folder: Path, spec: DatasetSpec, task: ShardTask) -> list[Finding]:
    """Return the differences of attributes, fields and values of a shard from the specification.

    Verify the sha256 of the shard before, because HDF5 can hang on a damaged file.
    """
    path = folder / task.file
    try:
        attributes = read_attributes(path)
        schema = read_schema(path)
    except DatasetError as error:
        return [Finding(task.file, _reason(error, path), hint=DELETE_HINT)]
    expected = {
        "format": SHARD_FORMAT,
        "format_version": SHARD_VERSION,
        **shard_attributes(spec, task),
    }
    problems = [
        f"its {name} is {attributes.get(name)!r}, expected {value!r} by {SPECIFICATION}"
        for name, value in expected.items()
        if attributes.get(name) != value
    ]
    problems += _check_fields(schema, spec, task)
    if not problems:
        # The description is that of the specification.
        try:
            read_rows(Shard(folder, spec, task))
        except DatasetError as error:
            problems = [_reason(error, path)]
    return [Finding(task.file, problem, hint=DELETE_HINT) for problem in problems]


def _check_fields(
    schema: Mapping[str, StoredField], spec: DatasetSpec, task: ShardTask
) -> list[str]:
    """Compare the fields and the arrays of scenes in a shard with the specification."""
    # Arrays of scenes are stored beside the fields of samples.
    arrays = scene_attributes(spec.scene_families) if spec.scene_obstacles else {}
    names = {field.name for field in spec.fields}.union(
        item.name for item in SCENE_ARRAYS if spec.scene_obstacles
    )
    problems = [f"lacks the field {name!r}" for name in sorted(names - schema.keys())]
    unknown = sorted(schema.keys() - names)
    problems += [f"has an unknown field {name!r}" for name in unknown]
    for field in spec.fields:
        if field.name in schema:
            problems += _check_field(field, schema[field.name], spec, task)
    return problems + [
        f"{name} has the attributes {schema[name].attributes}, expected {expected}"
        for name, expected in arrays.items()
        if name in schema and schema[name].attributes != expected
    ]


def _check_field(
    field: Field, stored: StoredField, spec: DatasetSpec, task: ShardTask
) -> list[str]:
    """Compare the description of a field in a shard with the specification."""
    shape = field.shape(task.rows)
    dtype = storage_dtype(field, spec.dtype)
    problems = []
    if stored.shape != shape or stored.dtype != dtype:
        problems.append(
            f"field {field.name!r} is {stored.dtype} of shape {stored.shape}, not {dtype} of shape {shape}"
        )
    expected = field_attributes(field)
    pairs = {
        name: (stored.attributes.get(name, _MISSING), expected.get(name, _MISSING))
        for name in expected | stored.attributes
    }
    return problems + [
        f"field {field.name!r} has {name} {actual!r}, expected {wanted!r} by {SPECIFICATION}"
        for name, (actual, wanted) in pairs.items()
        if not np.array_equal(actual, wanted)
    ]


def _extras(folder: Path, spec: DatasetSpec) -> Iterator[Finding]:
    """Yield a finding for every file or folder that does not belong to the dataset."""
    known = {SPECIFICATION, MANIFEST, *LISTED, WORK, *spec.splits}
    for task in shards(spec):
        known |= {task.file, task.sidecar}
    for parent in [folder, *(folder / split for split in spec.splits)]:
        for item in sorted(parent.iterdir()) if parent.is_dir() else ():
            name = item.relative_to(folder).as_posix()
            if name not in known:
                # A foreign shard in the folder of a split is an error, any other file a
                # note.
                loaded = parent != folder and item.suffix == ".h5"
                text = "is not part of the dataset" + (
                    ", but loaders would read it" if loaded else ""
                )
                yield Finding(name, text, note=not loaded, hint=REMOVE_HINT)
