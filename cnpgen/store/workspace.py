"""The folder in which a dataset is made: its current content, and whether it can be continued or replaced."""

import re
import shutil
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

from cnpgen.errors import DatasetError, MachineError, UsageError, counted
from cnpgen.store.dataset_spec import (
    INFORMATIONAL,
    DatasetSpec,
    load_dataset_spec,
    to_json,
    write_dataset_spec,
)
from cnpgen.store.files.atomic import check_writable, machine_errors, read_file
from cnpgen.store.files.documents import Difference, differences
from cnpgen.store.files.leftovers import remove_leftovers
from cnpgen.store.intact import COPY_HINT, OUTSIDE, outside_links
from cnpgen.store.layout import (
    CARD,
    CROISSANT,
    MANIFEST,
    OLD_SPECIFICATION,
    SPECIFICATION,
    STATS,
    WORK,
)

_SUMMARIES = (MANIFEST, STATS, CROISSANT, CARD)
_SHARD = re.compile(r"shard-\d{5,}\.(h5|json)")
_FORMAT_KEY = re.compile(rb'\{\s*"format": "cnpgen-')


@dataclass(frozen=True)
class Workspace:
    """The content of a folder for a dataset, possibly unfinished or damaged.

    Other processes may change it later.
    """

    folder: Path  # the folder
    existing: Path  # the folder, or its nearest existing parent
    # A file is in place of the folder.
    content: Literal["nothing", "a dataset", "a file", "something else"]
    has_shards: bool = False  # whether there are shards or sidecars
    # The specification in it; None where there is none that can be read.
    spec: DatasetSpec | None = None
    damage: str = ""  # reason why the specification cannot be read; empty if it can


def find_workspace(folder: Path) -> Workspace:
    """Inspect the folder for a new dataset."""
    with machine_errors("write to", folder):
        above = [folder.absolute(), *folder.absolute().parents]
        existing = next(path for path in above if path.exists())
        if not existing.is_dir():
            return Workspace(folder, existing, "a file")
        # A missing folder, or one with temporary files only.
        if existing != above[0] or all(item.name == WORK for item in folder.iterdir()):
            return Workspace(folder, existing, "nothing")
    if not is_dataset(folder):
        return Workspace(folder, existing, "something else")
    has_shards = any(_shard_files(folder))
    try:
        return Workspace(
            folder, existing, "a dataset", has_shards, load_dataset_spec(folder)
        )
    except DatasetError as error:
        return Workspace(folder, existing, "a dataset", has_shards, damage=str(error))


def check_place(workspace: Workspace) -> None:
    """Raise UsageError if no dataset can be made in a folder, before any computation.

    The folder of a finished dataset need not be writable.
    """
    if workspace.content == "a file":
        raise _other_folder(f"{workspace.existing} is a file, not a folder")
    if workspace.content == "something else":
        raise _other_folder(
            f"{workspace.folder} is not empty and not a dataset of cnpgen"
        )
    splits = () if workspace.spec is None else tuple(workspace.spec.splits)
    if workspace.content == "a dataset" and (
        outside := outside_links(workspace.folder, (WORK, *splits))
    ):
        raise UsageError(f"{workspace.folder / outside[0]} {OUTSIDE}; {COPY_HINT}")
    # A finished dataset may be read-only: it is only checked.
    if (workspace.folder / MANIFEST).is_file():
        return
    check_writable(workspace.folder)


def started_spec(workspace: Workspace, wanted: DatasetSpec) -> DatasetSpec | None:
    """Return the specification in a folder if it equals the wanted one, or None if the folder has no shards.

    The returned specification may have been written by another version of cnpgen.
    Shards of another specification raise UsageError, those of a damaged one
    DatasetError.
    """
    existing = workspace.spec
    if existing is not None and existing.fingerprint == wanted.fingerprint:
        return existing
    if not workspace.has_shards:
        return None
    if existing is None:
        raise DatasetError(
            f"{workspace.damage}; {{force}} replaces the whole dataset",
            remedies={"force": True},
        )
    raise UsageError(
        f"{workspace.folder} {_describe_conflict(existing, wanted)}",
        remedies={"out": None, "force": True},
    )


def open_workspace(
    folder: Path, spec: DatasetSpec, *, force: bool = False
) -> DatasetSpec:
    """Create the folder with its specification, or check that it already contains the same specification.

    The folder is inspected again, because another process may have started the dataset
    while kernels were compiled. A specification without shards is replaced; ``force``
    deletes an existing dataset. Errors are those of ``check_place`` and
    ``started_spec``.
    """
    workspace = find_workspace(folder)
    check_place(workspace)
    workspace = _cleared(workspace) if force else workspace
    begun = started_spec(workspace, spec)
    if begun is None:
        with machine_errors("write to", folder):
            folder.mkdir(parents=True, exist_ok=True)
            # Summaries of a dataset without shards belong to another one.
            for name in _SUMMARIES:
                (folder / name).unlink(missing_ok=True)
        write_dataset_spec(folder, spec)
    remove_leftovers(folder / WORK)
    return begun or spec


def require_dataset_spec(folder: Path, spec: DatasetSpec) -> None:
    """Raise an error if another process has replaced or deleted the dataset in a folder."""
    try:
        # The fingerprint stands in the text: parsing the document for every shard is
        # not needed.
        is_unchanged = spec.fingerprint.encode() in read_file(folder / SPECIFICATION)
    except DatasetError as error:
        missing = f"its {SPECIFICATION}" if folder.is_dir() else "it"
        raise MachineError(
            f"{folder}: {missing} was deleted or moved while the dataset was made; make it again"
        ) from error
    if not is_unchanged:
        raise _other_folder(
            f"{folder} was replaced by another dataset while this one was made"
        )


def _other_folder(text: str) -> UsageError:
    return UsageError(f"{text}; choose another {{out}}", remedies={"out": None})


def is_dataset(folder: Path) -> bool:
    """Return whether a folder contains a dataset of cnpgen, possibly unfinished or damaged."""
    sidecars = (path for path in _shard_files(folder) if path.suffix == ".json")
    documents = (
        folder / name for name in (SPECIFICATION, OLD_SPECIFICATION, MANIFEST, STATS)
    )
    return any(_is_cnpgen_document(path) for path in (*documents, *sidecars))


def _is_cnpgen_document(path: Path) -> bool:
    try:
        if not path.is_file():
            # Opening a pipe would block.
            return False
        with path.open("rb") as file:
            return _FORMAT_KEY.match(file.read(64)) is not None
    except OSError:
        return False


def _shard_files(folder: Path) -> Iterator[Path]:
    """Yield the shards and sidecars in a folder, of all splits."""
    return (path for path in folder.glob("*/shard-*.*") if _SHARD.fullmatch(path.name))


def _describe_conflict(existing: DatasetSpec, wanted: DatasetSpec) -> str:
    """Explain why a dataset cannot become another one, with a hint."""
    if changed := changed_settings(existing, wanted):
        return f"holds another dataset ({changed}); choose another {{out}}, or replace it with {{force}}"
    larger = all(
        rows <= wanted.splits.get(split, 0) for split, rows in existing.splits.items()
    )
    extend = "extend_dataset or 'cnpgen extend' adds the rows, or " if larger else ""
    return (
        f"holds this dataset with {_sizes(existing)}, not with {_sizes(wanted)}; the common rows are the"
        f" same: {extend}choose another {{out}}, or replace it with {{force}}"
    )


def changed_settings(existing: DatasetSpec, wanted: DatasetSpec) -> str:
    """Describe up to three differences of two specifications, except for their sizes.

    Empty if they are equal.
    """
    same = (*INFORMATIONAL, "splits", "previous_splits")
    old, new = (
        {key: value for key, value in to_json(item).items() if key not in same}
        for item in (existing, wanted)
    )
    return "; ".join(
        [*dict.fromkeys(_setting(difference) for difference in differences(old, new))][
            :3
        ]
    )


def _setting(difference: Difference) -> str:
    """Name a setting that differs, with its values if they are short."""
    key, _, rest = difference.key.partition(".")
    if key == "recipe_sha256":
        return "another recipe"
    if rest or isinstance(difference.old, list):
        return f"another {key}"
    return f"{key.replace('_', ' ')} {difference.old} instead of {difference.new}"


def _sizes(spec: DatasetSpec) -> str:
    splits = ", ".join(f"{split} {rows:,}" for split, rows in spec.splits.items())
    return f"{counted(sum(spec.splits.values()), 'row')} ({splits})"


def _cleared(workspace: Workspace) -> Workspace:
    """Delete the dataset in a folder, and no other files: see ``check_clearable``."""
    if workspace.content != "a dataset":
        return workspace
    folder = workspace.folder
    splits = check_clearable(workspace)
    with machine_errors("delete from", folder):
        # First: a partially deleted dataset must not appear complete.
        (folder / MANIFEST).unlink(missing_ok=True)
        for split in splits:
            for path in split.iterdir():
                path.unlink()
            split.rmdir()
        shutil.rmtree(folder / WORK, ignore_errors=True)
        # Last: a partially deleted dataset must still be recognized.
        for name in (*_SUMMARIES, OLD_SPECIFICATION, SPECIFICATION):
            (folder / name).unlink(missing_ok=True)
    return Workspace(folder, workspace.existing, "nothing")


def check_clearable(workspace: Workspace) -> list[Path]:
    """Return the folders of the splits of a dataset; other files in its folder raise UsageError.

    These are the splits of the specification, or all folders with shards if the
    specification cannot be read.
    """
    folder = workspace.folder
    spec = workspace.spec
    named = sorted({path.parent for path in _shard_files(folder)})
    if spec is not None:
        # With a specification the splits are known, even those without shards.
        named = [folder / split for split in spec.splits]
    splits = [split for split in named if split.is_dir()]
    if foreign := _foreign(folder, splits):
        raise UsageError(
            f"{folder} holds {foreign.relative_to(folder)}, which is not part of the dataset: move it "
            "away first"
        )
    return splits


def _foreign(folder: Path, splits: list[Path]) -> Path | None:
    """Return the first file that is not part of the dataset, or None."""
    known = {
        *_SUMMARIES,
        OLD_SPECIFICATION,
        SPECIFICATION,
        WORK,
        *(split.name for split in splits),
    }
    candidates = [path for path in folder.iterdir() if path.name not in known]
    for split in splits:
        candidates += [
            path for path in split.iterdir() if not _SHARD.fullmatch(path.name)
        ]
        candidates += [split] if split.is_symlink() else []
    return min(candidates, default=None)
