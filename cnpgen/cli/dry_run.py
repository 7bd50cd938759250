"""Output of ``make-dataset --dry-run``: the specification of a dataset and the state of its folder."""

from pathlib import Path
from typing import Any

from cnpgen.cli.terminal import table
from cnpgen.errors import DatasetError, UsageError
from cnpgen.make.recipe import DatasetRecipe, load_notes
from cnpgen.make.resolve_spec import dataset_folder, resolve
from cnpgen.store.dataset_spec import DatasetSpec, shards
from cnpgen.store.layout import MANIFEST
from cnpgen.store.shard import storage_dtype
from cnpgen.store.shard_record import pending
from cnpgen.store.workspace import (
    Workspace,
    check_clearable,
    find_workspace,
    started_spec,
)

# Bytes: what the HDF5 file and the sidecar of a shard take beside the rows.

SHARD_OVERHEAD = 41_000
DOCUMENTS = 90_000  # bytes: specification.json, manifest, card and statistics


def spec_text(
    recipe: DatasetRecipe, out: str | None, *, force: bool, **settings: Any
) -> str:
    """Resolve the specification of a dataset by ``resolve`` without making anything, and describe it."""
    load_notes(recipe)
    workspace = find_workspace(dataset_folder(recipe, out))
    spec = resolve(recipe, workspace, **settings, force=force).spec
    files = shards(spec)
    splits = [f"{split} {rows:,}" for split, rows in spec.splits.items()]
    counts = [
        f"{split} {sum(task.split == split for task in files)}" for split in spec.splits
    ]
    size = (
        sum(spec.splits.values()) * row_bytes(spec)
        + len(files) * SHARD_OVERHEAD
        + DOCUMENTS
    )
    facts = [
        ("folder", workspace.folder),
        ("state", folder_state(workspace, spec, force=force)),
        ("rows", f"{sum(spec.splits.values()):,}: {', '.join(splits)}"),
        (
            "shards",
            f"{len(files)} of at most {spec.shard_size:,} rows: {', '.join(counts)}",
        ),
        ("size", f"about {size_text(size)}, {row_bytes(spec)} bytes per row"),
        ("seed", str(spec.seed)),
        ("backend", spec.backend),
        ("dtype", spec.dtype),
        ("recipe", f"sha256 {spec.recipe_sha256}"),
    ]
    fields = [("field", "columns", "unit", "what")]
    fields += [
        (item.name, str(item.width or "-"), item.unit, item.long_name)
        for item in spec.fields
    ]
    head = f"{spec.name} {spec.version}"
    return "\n".join(
        [head, *table(facts, indent="  "), "", *table(fields, indent="  ", right=(1,))]
    )


def row_bytes(spec: DatasetSpec) -> int:
    """Return the size of a row in bytes."""
    return sum(
        # A field of width 0 has one number per row.
        max(field.width, 1) * storage_dtype(field, spec.dtype).itemsize
        for field in spec.fields
    )


def folder_state(workspace: Workspace, spec: DatasetSpec, *, force: bool) -> str:
    """Describe the content of the folder and the effect of making the dataset."""
    if workspace.content == "nothing":
        return "new"
    if workspace.content != "a dataset":
        return "holds something else: would be refused"
    if force:
        return _replacement(workspace)
    return _refusal(workspace, spec) or _progress(workspace.folder, spec)


def _replacement(workspace: Workspace) -> str:
    """Describe whether --force would replace the dataset in a folder."""
    try:
        check_clearable(workspace)
    except UsageError as error:
        return f"would be refused: it {str(error).removeprefix(f'{workspace.folder} ')}"
    return "holds a dataset, which would be replaced"


def _refusal(workspace: Workspace, spec: DatasetSpec) -> str:
    """Describe why another dataset in the folder would be refused.

    Empty if it is the same one.
    """
    try:
        begun = started_spec(workspace, spec)
    except UsageError:
        return "holds another dataset: would be refused without --force"
    except DatasetError:
        return "holds a dataset with a damaged specification.json: would be refused without --force"
    return (
        ""
        if begun is not None
        else "holds a specification.json without shards: would be replaced"
    )


def _progress(folder: Path, spec: DatasetSpec) -> str:
    """Describe the progress of a dataset."""
    todo = len(pending(folder, spec))
    count = len(shards(spec))
    if todo == 0 and (folder / MANIFEST).is_file():
        return "already complete"
    return f"{count - todo} of {count} shards exist: would resume"


def size_text(number: int) -> str:
    """Write a number of bytes: ``"6.7 MB"``."""
    value = float(number)
    units = ["bytes", "kB", "MB", "GB", "TB"]
    # Units are decimal: 1 kB = 1000 bytes.
    while value >= 1000 and len(units) > 1:
        value = value / 1000
        units = units[1:]
    return f"{value:.3g} {units[0]}" if units[0] != "bytes" else f"{number} bytes"
