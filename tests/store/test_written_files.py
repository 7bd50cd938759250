"""The list of written files: own files are replaced and removed, others are refused by name."""

import os
import subprocess
import sys
from pathlib import Path

import pytest

from cnpgen.errors import UsageError
from cnpgen.store.files.leftovers import temporary_name
from cnpgen.store.files.written_files import LIST, claim_files, record_files
from tests.refusals import is_refused


def write(folder: Path, names: list[str], *, force: bool = False) -> None:
    """Write files as a command does."""
    claim_files(folder, names, force=force)
    for name in names:
        (folder / name).parent.mkdir(exist_ok=True)
        (folder / name).write_text(f"content of {name}")
    record_files(folder, names)


def present(folder: Path) -> set[str]:
    """The files of a folder but the list."""
    files = (path for path in folder.rglob("*") if path.is_file())
    return {path.relative_to(folder).as_posix() for path in files} - {LIST}


def test_files_of_an_earlier_call_are_replaced_or_removed(tmp_path: Path) -> None:
    write(tmp_path, ["a/1.csv", "a/2.csv", "card.md"])
    write(tmp_path, ["b/1.csv", "card.md"])
    assert present(tmp_path) == {"b/1.csv", "card.md"}
    assert not (tmp_path / "a").exists()


def test_files_of_other_origin_are_refused_by_name_and_kept_by_force(
    tmp_path: Path,
) -> None:
    (tmp_path / ".env").write_text("KEY")
    with is_refused(UsageError, argument="force"):
        write(tmp_path, ["card.md"])
    assert present(tmp_path) == {".env"}
    write(tmp_path, ["card.md"], force=True)
    assert present(tmp_path) == {".env", "card.md"}


def test_an_edited_file_is_refused_and_an_interrupted_call_continues(
    tmp_path: Path,
) -> None:
    claim_files(tmp_path, ["card.md", "1.csv"])
    (tmp_path / "card.md").write_text("half")  # then the process was killed
    write(tmp_path, ["card.md", "1.csv"])
    (tmp_path / "card.md").write_text("edited")
    with is_refused(UsageError, argument="force"):
        write(tmp_path, ["1.csv"])
    assert (tmp_path / "card.md").read_text() == "edited"


@pytest.mark.parametrize(
    "text", ["", "{", "[]", '{"format": "cnpgen-files"}', '{"format": 1, "files": 2}']
)
def test_a_damaged_list_owns_nothing(tmp_path: Path, text: str) -> None:
    (tmp_path / LIST).write_text(text)
    (tmp_path / "1.csv").write_text("1")
    with is_refused(UsageError, argument="force"):
        write(tmp_path, ["1.csv"])


def test_a_list_never_leads_out_of_the_folder(tmp_path: Path) -> None:
    outside, folder = tmp_path / "outside.txt", tmp_path / "folder"
    outside.write_text("kept")
    folder.mkdir()
    listing = f'{{"format": "cnpgen-files", "files": {{"../outside.txt": "", "{outside}": ""}}}}'
    (folder / LIST).write_text(listing)
    write(folder, ["1.csv"])
    assert outside.read_text() == "kept"


def test_temporary_files_of_a_killed_call_are_removed(tmp_path: Path) -> None:
    with subprocess.Popen([sys.executable, "-c", ""]) as gone:
        gone.wait()
    names = ["a/1.csv", "card.md"]
    claim_files(tmp_path, names)  # then the process was killed
    (tmp_path / "a").mkdir()
    for name in names:
        half = temporary_name(Path(name).name).replace(
            f"-{os.getpid()}.", f"-{gone.pid}."
        )
        (tmp_path / name).with_name(half).write_text("half")
    write(tmp_path, names)
    assert present(tmp_path) == set(names)
