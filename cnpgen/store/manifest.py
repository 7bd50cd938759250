"""The manifest of a dataset.

It is written last, so it exists only for a complete dataset.
"""

import hashlib
import os
import time
from collections.abc import Iterable
from contextlib import suppress
from datetime import UTC, datetime
from pathlib import Path
from typing import cast

from cnpgen.documents import JsonObject
from cnpgen.errors import DatasetError, UsageError
from cnpgen.store.dataset_document import DatasetDocument
from cnpgen.store.dataset_spec import DatasetSpec, shards
from cnpgen.store.dataset_summary import (
    DatasetSummary,
    stats_document,
    summarize_dataset,
)
from cnpgen.store.field import Field
from cnpgen.store.files.atomic import file_sha256, write_file
from cnpgen.store.files.document_structure import ANY_KEY, TEXT, WHOLE, check_structure
from cnpgen.store.files.documents import load_document, plain, save_document
from cnpgen.store.files.leftovers import remove_all_temporary
from cnpgen.store.layout import DESCRIPTIONS, MANIFEST, SPECIFICATION, STATS, WORK

MANIFEST_FORMAT = "cnpgen-dataset"
MANIFEST_VERSION = 2
# Files with their size and sha256 beside the shards.
LISTED = SPECIFICATION, STATS, *DESCRIPTIONS
_FILE_STRUCTURE = {"bytes": WHOLE, "sha256": TEXT}
_SHARD_STRUCTURE = {
    **dict.fromkeys(("file", "sha256"), TEXT),
    **dict.fromkeys(("rows", "first_sample_id", "bytes"), WHOLE),
    "sidecar": {"file": TEXT, "sha256": TEXT},
}
MANIFEST_STRUCTURE = {
    "fingerprint": TEXT,
    "specification_fingerprint": TEXT,
    "splits": {ANY_KEY: {"rows": WHOLE, "shards": [_SHARD_STRUCTURE]}},
    "files": dict.fromkeys((SPECIFICATION, STATS), _FILE_STRUCTURE),
}


def finalize(
    folder: Path,
    spec: DatasetSpec,
    *,
    notes: str = "",
    documents: Iterable[DatasetDocument] = (),
) -> JsonObject:
    """Summarize the shards of a dataset: write statistics, descriptions and, last, the manifest.

    The same shards give the same files, so several processes may do it at the same
    time. ``notes`` is Markdown for the ``documents`` that describe the dataset. Errors
    are those of ``summarize_dataset`` and ``source_date``.
    """
    summary = summarize_dataset(folder, spec)
    created = _created(summary)
    # Without a manifest the dataset counts as unfinished while its documents are
    # replaced.
    (folder / MANIFEST).unlink(missing_ok=True)
    save_document(folder / STATS, stats_document(summary))
    for document in documents:
        text = document.render(
            summary, created=created, folder=_name(folder), notes=notes
        )
        write_file(folder / document.file, text)
    # Last: the manifest contains the sha256 of all other documents.
    manifest = _manifest(folder, summary, created=created)
    save_document(folder / MANIFEST, manifest)
    remove_all_temporary(folder / WORK)
    # Other files in it are kept.
    with suppress(OSError):
        (folder / WORK).rmdir()
    return cast(JsonObject, plain(manifest))


def _name(folder: Path) -> str:
    """Return the name of a folder as text.

    Bytes that are not UTF-8 are replaced by question marks.
    """
    return os.fsencode(folder.resolve().name).decode(errors="replace")


def load_manifest(folder: Path) -> JsonObject:
    """Read ``manifest.json``.

    Raise DatasetError if it is missing, damaged or of another format version.
    """
    manifest = load_document(
        folder / MANIFEST,
        MANIFEST_FORMAT,
        version=MANIFEST_VERSION,
        structure=MANIFEST_STRUCTURE,
    )
    described = {
        name: _FILE_STRUCTURE for name in DESCRIPTIONS if name in manifest["files"]
    }
    try:
        check_structure(manifest["files"], described)
    except ValueError as error:
        raise DatasetError(f"{folder / MANIFEST} is damaged: files.{error}") from error
    return manifest


def shard_entries(manifest: JsonObject) -> dict[str, JsonObject]:
    """Return the entries of the shards of all splits, by file."""
    return {
        entry["file"]: entry
        for split in manifest.get("splits", {}).values()
        for entry in split["shards"]
    }


def lists_shards_of(manifest: JsonObject, spec: DatasetSpec) -> bool:
    """Return whether a manifest lists exactly the shards of a specification, in order.

    Only these file names are opened: no path in a manifest can lead outside the folder
        of the dataset.
    """
    if manifest["splits"].keys() != spec.splits.keys():
        return False
    listed = [
        (
            split,
            entry["file"],
            entry["sidecar"]["file"],
            entry["first_sample_id"],
            entry["rows"],
        )
        for split in spec.splits
        for entry in manifest["splits"][split]["shards"]
    ]
    return listed == [
        (task.split, task.file, task.sidecar, task.first_row, task.rows)
        for task in shards(spec)
    ]


def source_date() -> datetime | None:
    """Return the time in the variable SOURCE_DATE_EPOCH, or None if it is not set.

    Another value raises UsageError.
    """
    epoch = os.environ.get("SOURCE_DATE_EPOCH", "")
    try:
        return datetime.fromtimestamp(int(epoch), UTC) if epoch else None
    except (ValueError, OverflowError, OSError) as error:
        raise UsageError(
            f"SOURCE_DATE_EPOCH must be whole seconds since 1970, got {epoch!r}: unset it"
        ) from error


def _created(summary: DatasetSummary) -> str:
    """Return the start time of the last shard, or SOURCE_DATE_EPOCH, in UTC to the second.

    It does not depend on when the dataset is finished, so finishing it twice gives the
    same files.
    """
    fixed = source_date()
    try:
        started = [
            datetime.fromisoformat(record.started)
            for _, record in summary.records
            if record.started
        ]
        # Records, not the clock: finalizing again gives the same bytes.
        last = max((instant.timestamp() for instant in started), default=time.time())
        instant = datetime.fromtimestamp(int(last), UTC) if fixed is None else fixed
        return instant.strftime("%Y-%m-%dT%H:%M:%SZ")
    except (ValueError, OverflowError, OSError) as error:
        raise DatasetError(
            "the creation time of the dataset is unknown: the record of a shard has no valid start "
            f"time ({error})"
        ) from error


def _manifest(folder: Path, summary: DatasetSummary, *, created: str) -> JsonObject:
    """Build the manifest; the files that it lists must exist."""
    spec = summary.spec
    return {
        "format": MANIFEST_FORMAT,
        "format_version": MANIFEST_VERSION,
        **{name: getattr(spec, name) for name in ("name", "version", "title")},
        "created": created,
        "license": spec.license,
        "fingerprint": data_fingerprint(
            (item.file, item.sha256) for _, item in summary.records
        ),
        "specification_fingerprint": spec.fingerprint,
        **_origin(summary),
        "features": {field.name: _feature(field, spec) for field in spec.fields},
        "yield": summary.sampling.yield_json(),
        "verification": dict(summary.sampling.verification),
        "splits": {split: _split(folder, summary, split) for split in spec.splits},
        "stats": STATS,
        "files": {
            name: {
                "bytes": (folder / name).stat().st_size,
                "sha256": file_sha256(folder / name),
            }
            for name in LISTED
            if (folder / name).exists()
        },
    }


def data_fingerprint(files: Iterable[tuple[str, str]]) -> str:
    """Compute the fingerprint of the samples from path and sha256 of every shard.

    ``sha256sum */shard-*.h5 | sha256sum`` prints it in the dataset folder.
    """
    # The format of sha256sum, whose lines can be checked by hand.
    lines = "".join(f"{sha256}  {file}\n" for file, sha256 in sorted(files))
    return hashlib.sha256(lines.encode()).hexdigest()


def _origin(summary: DatasetSummary) -> JsonObject:
    """Describe the origin of the samples.

    "environments" are all combinations of versions that made shards.
    """
    spec = summary.spec
    pipeline = spec.recipe.get("pipeline")
    return {
        "pipeline": pipeline.get("name", "")
        if isinstance(pipeline, dict)
        else pipeline,
        **{name: getattr(spec, name) for name in ("recipe_sha256", "recipe")},
        "seed": str(spec.seed),
        **{
            name: getattr(spec, name)
            for name in ("generator", "backend", "dtype", "block_rows", "shard_size")
        },
        **{name: getattr(spec, name) for name in ("robot", "versions")},
        "environments": summary.environments,
        "seconds": summary.seconds,
    }


def _feature(field: Field, spec: DatasetSpec) -> JsonObject:
    """Describe a field with the keys of LeRobot's ``info.json``, and its unit, which LeRobot does not have."""
    return {
        "dtype": spec.dtype if field.dtype == "float" else field.dtype,
        "shape": [field.width] if field.width else [],
        "names": field.names,
        "units": field.unit,
        **{
            name: getattr(field, name)
            for name in ("long_name", "role", "frame", "valid_min", "valid_max")
        },
    }


def _split(folder: Path, summary: DatasetSummary, split: str) -> JsonObject:
    """List the shards of a split."""
    entries = [
        {
            **{
                name: getattr(record, name)
                for name in ("file", "rows", "first_sample_id", "bytes", "sha256")
            },
            "sidecar": {
                "file": task.sidecar,
                "sha256": file_sha256(folder / task.sidecar),
            },
        }
        for task, record in summary.of_split(split)
    ]
    sampling = summary.sampling_by_split[split]
    return {
        "rows": summary.spec.splits[split],
        "yield": sampling.yield_json(),
        "shards": entries,
    }
