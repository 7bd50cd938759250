"""Publication of datasets: a repository for the Hugging Face Hub, with a card, a Parquet view and the dataset itself.

```
README.md                        the card
picture.png                      histograms and positions of the samples, on the card
croissant.json                   the Parquet view for ML catalogues, with a record set for each split
parquet/train/00000.parquet      a table per shard, for the viewer, polars and DuckDB
hdf5/                            the dataset without its croissant.json: cnpgen validate hdf5
```
"""

import json
import os
import re
import shutil
from pathlib import Path
from typing import Any

from cnpgen.addons.hub.card import PARQUET, card_notes, card_text
from cnpgen.addons.hub.croissant import SplitFile, croissant_of_tables
from cnpgen.addons.hub.downloads import HDF5
from cnpgen.errors import MachineError, UsageError, requires_extra
from cnpgen.loader.load import load_dataset
from cnpgen.plans.formats import fixed_lists, write_parquet
from cnpgen.schema.argument_types import checked_arguments
from cnpgen.store.dataset_plot import plot_dataset
from cnpgen.store.dataset_spec import DatasetSpec, ShardTask, shards
from cnpgen.store.dataset_summary import summarize_dataset
from cnpgen.store.files.atomic import check_writable, file_sha256, write_file
from cnpgen.store.files.documents import render
from cnpgen.store.files.written_files import claim_files, record_files
from cnpgen.store.inspection import inspect_dataset
from cnpgen.store.layout import CARD, CROISSANT, DOCUMENTS
from cnpgen.store.manifest import load_manifest
from cnpgen.store.shard import read_shard
from cnpgen.store.shard_record import load_record

HUB = "https://huggingface.co"
REPOSITORY = re.compile(r"[A-Za-z0-9][\w.-]{0,95}/[A-Za-z0-9][\w.-]{0,95}")
PICTURE = "picture.png"
SOURCE_KEY = b"cnpgen.sha256"  # metadata of a table: the sha256 of its shard


@checked_arguments
def publish_dataset(
    folder: str | Path,
    to: str,
    *,
    out: str | Path,
    private: bool = False,
    dry_run: bool = False,
    force: bool = False,
) -> str:
    """Write the repository of a dataset and upload it; a second call continues an interrupted one.

    Only files that this function wrote are uploaded. Tables and shards of an earlier
    state of the dataset are removed, from the folder and from the hub.

    Args:
        folder: Folder of a finished dataset.
        to: Repository on the Hugging Face Hub, "USER/NAME".
        out: Folder of the repository on this machine.
        private: Whether a new repository is private.
        dry_run: Whether to write the folder only.
        force: Whether the folder may have other files: they are kept, not uploaded, and
            replaced if they have the name of a written one.

    Returns:
        Address of the repository; empty if it was not uploaded.

    Raises:
        UsageError: The repository has no valid name or is inside the dataset, its
            folder has files of other origin, or the dataset has no license.
        DatasetError: The dataset is unfinished or damaged.
        MissingExtraError: pyarrow, matplotlib or huggingface_hub is not installed.
        MachineError: The folder cannot be written, or the upload failed.
    """
    if not REPOSITORY.fullmatch(to):
        raise UsageError(
            f"must be the name of a repository, USER/NAME, got {to!r:.200}",
            argument="to",
        )
    source = Path(folder)
    target = Path(out)
    # A repository inside of the dataset would be a part of what it publishes.
    if target.resolve().is_relative_to(source.resolve()):
        raise UsageError(
            f"must be a folder outside the dataset {source}, got {target}",
            argument="out",
        )
    if target.exists() and not target.is_dir():
        raise UsageError(f"must be a folder, {target} is a file", argument="out")
    check_writable(target)
    spec = load_dataset(source).spec
    if not spec.license:
        raise UsageError(
            f"{source} has no license: add license = \"...\" to its recipe, then run 'cnpgen make-dataset' on it again,"
            " which keeps the samples"
        )
    files = write_repository(source, spec, target, repository=to, force=force)
    return "" if dry_run else upload_files(target, files, to, private=private)


def write_repository(
    source: Path, spec: DatasetSpec, target: Path, *, repository: str, force: bool
) -> list[str]:
    """Write card, Parquet view and dataset; return the written files, relative to the folder.

    Finished files of an earlier call are kept, its other ones removed.
    """
    tasks = shards(spec)
    tables = [
        target / PARQUET / task.split / f"{task.index:05d}.parquet" for task in tasks
    ]
    copies = [name for task in tasks for name in (task.file, task.sidecar)]
    copies += [name for name in DOCUMENTS if name != CROISSANT]  # without record sets
    written = [path.relative_to(target).as_posix() for path in tables]
    written += [f"{HDF5}/{name}" for name in copies] + [CARD, CROISSANT, PICTURE]
    # Files of other origin are refused before anything is written.
    claim_files(target, written, force=force)
    for task, path in zip(tasks, tables, strict=True):
        _write_table(source, spec, task, path)
    for name in copies:
        link_or_copy(source / name, target / HDF5 / name)
    notes = card_notes((source / CARD).read_text(encoding="utf-8"))
    summary = summarize_dataset(source, spec)
    created = load_manifest(source)["created"]
    url = f"{HUB}/datasets/{repository}"
    plot_dataset(inspect_dataset(source), target / PICTURE)
    places = {"folder": repository, "shards": f"{HDF5}/", "picture": PICTURE}
    card = card_text(summary, created=created, notes=notes, **places)
    write_file(target / CARD, card)
    files: dict[str, list[SplitFile]] = {}
    for task, path, name in zip(tasks, tables, written, strict=False):
        files.setdefault(task.split, []).append(_split_file(path, name))
    croissant = croissant_of_tables(summary, files, created=created, url=url)
    write_file(target / CROISSANT, f"{render(croissant)}\n")
    # The next call knows the files that this one wrote.
    record_files(target, written)
    return written


def _split_file(path: Path, name: str) -> SplitFile:
    return SplitFile(name, path.stat().st_size, file_sha256(path))


def _write_table(source: Path, spec: DatasetSpec, task: ShardTask, path: Path) -> None:
    """Write the table of a shard, unless it exists and is of the same shard."""
    with requires_extra("hub", "pyarrow"):
        import pyarrow
        import pyarrow.parquet

    sha256 = load_record(source, task).sha256.encode()
    if (
        # A table states the digest of its shard, so finished tables are kept.
        path.exists()
        and (pyarrow.parquet.read_schema(path).metadata or {}).get(SOURCE_KEY) == sha256
    ):
        return
    columns = read_shard(source / task.file)
    arrays: dict[str, Any] = {}
    for field in spec.fields:
        values = columns[field.name]
        arrays[field.name] = (
            fixed_lists(values) if values.ndim == 2 else pyarrow.array(values)
        )
    schema = pyarrow.schema(
        [
            pyarrow.field(
                item.name,
                arrays[item.name].type,
                metadata={"unit": item.unit, "names": json.dumps(item.names)},
            )
            for item in spec.fields
        ],
        metadata={SOURCE_KEY: sha256},
    )
    write_parquet(path, pyarrow.table(arrays, schema=schema))


def link_or_copy(source: Path, target: Path) -> None:
    """Link or copy a file, unless the copy has the same size and is not older."""
    if target.exists():
        before = target.stat()
        now = source.stat()
        if before.st_size == now.st_size and before.st_mtime >= now.st_mtime:
            return
        target.unlink()
    target.parent.mkdir(parents=True, exist_ok=True)
    try:
        os.link(source, target)
    except OSError:  # another file system
        shutil.copy2(source, target)


def upload_files(
    folder: Path, files: list[str], repository: str, *, private: bool
) -> str:
    """Upload files of a repository's folder and return its address; a second call continues an interrupted one.

    Other tables and files of the dataset are removed from the repository on the hub.
    """
    with requires_extra("hub", "huggingface_hub"):
        import huggingface_hub

    api = huggingface_hub.HfApi(library_name="cnpgen")
    try:
        url = str(
            api.create_repo(
                repository, repo_type="dataset", private=private, exist_ok=True
            )
        )
        api.upload_folder(
            repo_id=repository,
            folder_path=folder,
            repo_type="dataset",
            allow_patterns=files,  # names without wildcards
            # Those that the folder does not contain.
            delete_patterns=[f"{part}/*" for part in (PARQUET, HDF5)],
        )
    except (
        OSError,
        ValueError,
        RuntimeError,
    ) as error:
        # The errors of huggingface_hub are OSError or ValueError.
        hint = "'hf auth login' stores a token; the same command continues an interrupted upload"
        raise MachineError(
            f"{repository} was not uploaded: {error!s:.300}; {hint}"
        ) from error
    return url
