"""List of the files that a command wrote into a folder, so that a later call replaces or removes only these.

The list is a hidden file of the folder. Small files are listed with their sha256: a
card that was edited since counts as a file of the user.
"""

import json
from collections.abc import Iterable, Iterator
from contextlib import suppress
from pathlib import Path

from cnpgen.errors import UsageError
from cnpgen.store.files.atomic import file_sha256, machine_errors, write_file
from cnpgen.store.files.leftovers import remove_leftovers

LIST = ".cnpgen-files"
FORMAT = "cnpgen-files"
MAX_HASHED_BYTES = 1 << 20  # larger files are compared by name only
MAX_NAMED = 5  # files in a message


def claim_files(
    folder: Path, names: Iterable[str], *, pattern: str = "**/*", force: bool = False
) -> None:
    """List files that will be written into a folder, and remove those that an earlier call wrote and this one does not.

    Args:
        folder: The folder, which is created.
        names: Files to be written, relative to the folder.
        pattern: Glob pattern of the files that the folder must not mix: all by default.
        force: Whether files of other origin are kept, and replaced if they are named.

    Raises:
        UsageError: There are matching files of other origin; they are named.
        MachineError: A file cannot be written or removed.
    """
    planned = set(names)
    earlier = _listed(folder)
    # A file that the user edited is the user's.
    own = {name for name in earlier if _is_unchanged(folder / name, earlier[name])}
    if not force:
        _refuse_others(folder, pattern, planned, own)
    with machine_errors("write", folder):
        folder.mkdir(parents=True, exist_ok=True)
        for name in own - planned:
            (folder / name).unlink(missing_ok=True)
            # Other files are in it.
            with suppress(OSError):
                (folder / name).parent.rmdir()
        for parent in {(folder / name).parent for name in planned}:
            remove_leftovers(parent)
    # Before the first file is written: an interrupted call can be continued.
    _write_list(folder, dict.fromkeys(sorted(planned), ""))


def record_files(folder: Path, names: Iterable[str]) -> None:
    """List the files that were written into a folder, with the sha256 of the small ones."""
    _write_list(folder, {name: _hash(folder / name) for name in sorted(set(names))})


def _refuse_others(
    folder: Path, pattern: str, planned: set[str], own: set[str]
) -> None:
    """Raise UsageError for matching and planned files that exist and are not own ones."""
    present = {
        *_files(folder, pattern),
        *filter(lambda name: (folder / name).exists(), planned),
    }
    others = present - own
    if not others:
        return
    named = ", ".join(sorted(others)[:MAX_NAMED])
    more = len(others) - MAX_NAMED
    raise UsageError(
        f"{folder} has files that this command did not write, or that were edited"
        f" since: {named}{f' and {more} more' if more > 0 else ''}; choose another"
        " folder, or {force}, which replaces files of the same name and keeps the others",
        remedies={"force": True},
    )


def _files(folder: Path, pattern: str) -> Iterator[str]:
    """Yield the files of a folder that match a pattern, relative to it; links are not followed."""
    for path in folder.glob(pattern):
        name = path.relative_to(folder).as_posix()
        is_list = name == LIST or (path.name.startswith(".") and path.suffix == ".tmp")
        if not is_list and (path.is_symlink() or path.is_file()):
            yield name


def _listed(folder: Path) -> dict[str, str]:
    """Return the files of an earlier list, name -> sha256 or empty; none if there is no valid list."""
    try:
        document = json.loads((folder / LIST).read_text(encoding="utf-8"))
        files = document["files"] if document["format"] == FORMAT else {}
        return {
            str(name): str(value)
            for name, value in files.items()
            # An edited list must not name files outside the folder, which would be
            # deleted.
            if not Path(name).is_absolute() and ".." not in Path(name).parts
        }
    except (OSError, ValueError, TypeError, KeyError, AttributeError):
        return {}


def _is_unchanged(path: Path, sha256: str) -> bool:
    """Return whether a listed file is as it was written, as far as is known."""
    return not path.is_symlink() and (not sha256 or _hash(path) in {sha256, ""})


def _hash(path: Path) -> str:
    """Return the sha256 of a small file, empty for others and missing ones."""
    if not path.is_file() or path.stat().st_size > MAX_HASHED_BYTES:
        return ""
    return file_sha256(path)


def _write_list(folder: Path, files: dict[str, str]) -> None:
    text = json.dumps({"format": FORMAT, "format_version": 1, "files": files}, indent=1)
    write_file(folder / LIST, text + "\n")
