"""The manifest of a dataset: written last, so that its existence means that the dataset is complete."""

import hashlib
import os
import time
from collections.abc import Iterable
from contextlib import suppress
from datetime import UTC, datetime
from pathlib import Path
from typing import Any, cast

from cnpgen.errors import DatasetError, UsageError
from cnpgen.store.blueprint import Blueprint, shards
from cnpgen.store.card import card_text
from cnpgen.store.croissant import croissant_document
from cnpgen.store.field import Field
from cnpgen.store.files.atomic import file_sha256, write_file
from cnpgen.store.files.documents import load_document, plain, render, save_document
from cnpgen.store.files.forms import EVERY, TEXT, WHOLE
from cnpgen.store.files.leftovers import sweep_all
from cnpgen.store.layout import CARD, CROISSANT, MANIFEST, PLAN, STATS, WORK
from cnpgen.store.summary import Summary, stats_document, summarise

FORMAT = "cnpgen-dataset"
FORMAT_VERSION = 1
_SHARD = {
    **dict.fromkeys(("file", "sha256"), TEXT),
    **dict.fromkeys(("rows", "first_sample_id", "bytes"), WHOLE),
    "sidecar": {"file": TEXT, "sha256": TEXT},
}
FORM = {
    "fingerprint": TEXT,
    "plan_fingerprint": TEXT,
    "splits": {EVERY: {"rows": WHOLE, "shards": [_SHARD]}},
    "files": {name: {"bytes": WHOLE, "sha256": TEXT} for name in (PLAN, STATS, CARD, CROISSANT)},
}


def finalize(folder: Path, blueprint: Blueprint, *, notes: str = "") -> dict[str, Any]:
    """Sum up the shards of a dataset: statistics, card, Croissant and, last, the manifest.

    The same shards give the same files; processes that find all shards made may do it at once.

    Args:
        folder: The dataset's folder.
        blueprint: Its blueprint.
        notes: Text about the dataset to include in its card, Markdown.

    Returns:
        The manifest.

    Raises:
        DatasetError: Shards are missing, damaged or of another blueprint; the message says which.
        UsageError: SOURCE_DATE_EPOCH is no time.
        MachineError: The disk is full, read-only or otherwise unwilling.
    """
    summary = summarise(folder, blueprint)
    created = _created(summary)
    (folder / MANIFEST).unlink(missing_ok=True)
    save_document(folder / STATS, stats_document(summary))
    write_file(folder / CARD, card_text(summary, folder=_name(folder), notes=notes))
    croissant = plain(croissant_document(summary, created=created))
    write_file(folder / CROISSANT, render(croissant) + "\n")
    manifest = _manifest(folder, summary, created=created)
    save_document(folder / MANIFEST, manifest)
    _remove_work(folder / WORK)
    return cast(dict[str, Any], plain(manifest))


def _name(folder: Path) -> str:
    """Return the name of a folder as text; bytes in it that are not UTF-8 become question marks."""
    return os.fsencode(folder.resolve().name).decode(errors="replace")


def _remove_work(work: Path) -> None:
    """Remove the folder for temporary files: every shard is committed, so nobody needs it; foreign files are kept."""
    sweep_all(work)
    with suppress(OSError):
        work.rmdir()


def load_manifest(folder: Path) -> dict[str, Any]:
    """Read ``manifest.json``.

    Raises:
        DatasetError: It is missing (the dataset is unfinished), damaged or written by a newer cnpgen.
        MachineError: The system would not let us read it.
    """
    return load_document(folder / MANIFEST, FORMAT, version=FORMAT_VERSION, form=FORM)


def lists_shards_of(manifest: dict[str, Any], blueprint: Blueprint) -> bool:
    """Whether a manifest lists the shards of a blueprint, in order, under their names, and nothing else.

    Only names that the blueprint gives are opened: no path in a manifest leads out of the dataset's folder.
    """
    found = {split: [_place(entry) for entry in content["shards"]] for split, content in manifest["splits"].items()}
    wanted: dict[str, list[tuple[str, str, int, int]]] = {split: [] for split in blueprint.splits}
    for task in shards(blueprint):
        wanted[task.split].append((task.file, task.sidecar, task.first_row, task.rows))
    return found == wanted


def _place(entry: dict[str, Any]) -> tuple[str, str, int, int]:
    return entry["file"], entry["sidecar"]["file"], entry["first_sample_id"], entry["rows"]


def source_date() -> datetime | None:
    """Return the time that the environment variable SOURCE_DATE_EPOCH wants datasets to be made at, if it is set.

    Raises:
        UsageError: It is no time.
    """
    epoch = os.environ.get("SOURCE_DATE_EPOCH", "")
    try:
        return datetime.fromtimestamp(int(epoch), UTC) if epoch else None
    except (ValueError, OverflowError, OSError) as error:
        raise UsageError(f"SOURCE_DATE_EPOCH must be whole seconds since 1970, got {epoch!r}: unset it") from error


def _created(summary: Summary) -> str:
    """Return when the work on the last shard began, or what SOURCE_DATE_EPOCH says, in UTC to the second.

    It does not depend on when the dataset is finished: doing that twice, even at the same time, gives the same files.
    """
    wanted = source_date()
    try:
        started = [datetime.fromisoformat(record.started) for _, record in summary.records if record.started]
        last = max((moment.timestamp() for moment in started), default=time.time())
        moment = datetime.fromtimestamp(int(last), UTC) if wanted is None else wanted
        return moment.strftime("%Y-%m-%dT%H:%M:%SZ")
    except (ValueError, OverflowError, OSError) as error:
        raise DatasetError(f"cannot tell when the dataset was made: a shard's record has no start ({error})") from error


def _manifest(folder: Path, summary: Summary, *, created: str) -> dict[str, Any]:
    """Build the manifest; the files that it lists must be on the disk."""
    blueprint = summary.blueprint
    return {
        "format": FORMAT,
        "format_version": FORMAT_VERSION,
        "name": blueprint.name,
        "version": blueprint.version,
        "title": blueprint.title,
        "created": created,
        "license": blueprint.license,
        "fingerprint": data_fingerprint((item.file, item.sha256) for _, item in summary.records),
        "plan_fingerprint": blueprint.fingerprint,
        **_origin(summary),
        "features": {field.name: _feature(field, blueprint) for field in blueprint.fields},
        "yield": summary.fates.yield_json(),
        "verification": dict(summary.fates.verification),
        "splits": {split: _split(folder, summary, split) for split in blueprint.splits},
        "stats": STATS,
        "files": {name: _listed(folder / name) for name in (PLAN, STATS, CARD, CROISSANT)},
    }


def data_fingerprint(files: Iterable[tuple[str, str]]) -> str:
    """Compute the fingerprint of a dataset's rows, as ``sha256sum */shard-*.h5 | sha256sum`` in its folder does.

    Args:
        files: Path and sha256 of every shard.
    """
    lines = "".join(f"{sha256}  {file}\n" for file, sha256 in sorted(files))
    return hashlib.sha256(lines.encode()).hexdigest()


def _origin(summary: Summary) -> dict[str, Any]:
    """Say where the rows come from; "environments" are the versions that made them, more than one after an upgrade."""
    blueprint = summary.blueprint
    environments: list[dict[str, str]] = []
    for _, record in summary.records:
        if (versions := dict(record.versions)) not in environments:
            environments.append(versions)
    pipeline = blueprint.recipe.get("pipeline")
    return {
        "pipeline": pipeline.get("name", "") if isinstance(pipeline, dict) else pipeline,
        "recipe_sha256": blueprint.recipe_sha256,
        "recipe": blueprint.recipe,
        "seed": str(blueprint.seed),
        "generator": blueprint.generator,
        "backend": blueprint.backend,
        "dtype": blueprint.dtype,
        "block_rows": blueprint.block_rows,
        "shard_size": blueprint.shard_size,
        "robot": blueprint.robot,
        "versions": blueprint.versions,
        "environments": environments,
        "seconds": sum(record.seconds for _, record in summary.records),
    }


def _feature(field: Field, blueprint: Blueprint) -> dict[str, Any]:
    """Describe a field with the keys of LeRobot's ``info.json`` and the units that those lack."""
    return {
        "dtype": blueprint.dtype if field.dtype == "float" else field.dtype,
        "shape": [field.width] if field.width else [],
        "names": field.names,
        "units": field.unit,
        "long_name": field.long_name,
        "role": field.role,
        "frame": field.frame,
        "valid_min": field.valid_min,
        "valid_max": field.valid_max,
    }


def _split(folder: Path, summary: Summary, split: str) -> dict[str, Any]:
    """List the shards of a split."""
    entries = [
        {
            "file": record.file,
            "rows": record.rows,
            "first_sample_id": record.first_sample_id,
            "bytes": record.bytes,
            "sha256": record.sha256,
            "sidecar": {"file": task.sidecar, "sha256": file_sha256(folder / task.sidecar)},
        }
        for task, record in summary.of_split(split)
    ]
    fates = summary.fates_by_split[split]
    return {"rows": summary.blueprint.splits[split], "yield": fates.yield_json(), "shards": entries}


def _listed(path: Path) -> dict[str, Any]:
    return {"bytes": path.stat().st_size, "sha256": file_sha256(path)}
