"""Temporary files of killed processes: removed by the same machine only, independent of clocks."""

import os
import subprocess
import sys
from pathlib import Path

import pytest

from cnpgen.store.files import leftovers
from cnpgen.store.files.atomic import committing
from cnpgen.store.files.leftovers import (
    remove_all_temporary,
    remove_leftovers,
    remove_leftovers_of,
    temporary_name,
)
from cnpgen.validate.validate_dataset import validate_dataset
from tests.examples.tiny_datasets import digests, make_tiny

DEAD = """
import sys
from cnpgen.store.files.leftovers import temporary_name
print(temporary_name(sys.argv[1]), end="")
"""


def of_a_dead_process(name: str) -> str:
    """Return the name of a temporary file of a process that has ended."""
    return subprocess.run(
        [sys.executable, "-c", DEAD, name], capture_output=True, text=True, check=True
    ).stdout


@pytest.fixture
def elsewhere(monkeypatch):
    """Simulate another machine."""
    monkeypatch.setattr(leftovers, "_machine", lambda: "0123456789ab")


def test_only_temporary_files_of_dead_processes_of_this_machine_are_removed(
    tmp_path: Path,
) -> None:
    remove_leftovers(tmp_path / "nothing")
    dead, mine = of_a_dead_process("a.h5"), temporary_name("a.h5")
    kept = [mine, ".a.h5.1.2.tmp", ".x.tmp", "log.txt", dead.removesuffix(".tmp")]
    for name in (dead, *kept):
        (tmp_path / name).touch()
        os.utime(tmp_path / name, (0, 0))  # in 1970; the age is no criterion
    remove_leftovers(tmp_path)
    assert sorted(path.name for path in tmp_path.iterdir()) == sorted(kept)
    remove_all_temporary(tmp_path)
    assert sorted(path.name for path in tmp_path.iterdir()) == sorted(
        [".x.tmp", "log.txt", dead.removesuffix(".tmp")]
    )


def test_a_machine_with_a_wrong_clock_does_not_remove_files_of_another_machine(
    tmp_path, monkeypatch
) -> None:
    dead = of_a_dead_process("a.h5")
    with committing(tmp_path / "a.h5", tmp_path / "_work") as temporary:
        temporary.write_bytes(b"half")
        (tmp_path / "_work" / dead).touch()
        for name in (temporary.name, dead):
            os.utime(tmp_path / "_work" / name, (0, 0))
        with monkeypatch.context() as patch:
            patch.setattr(leftovers, "_machine", lambda: "0123456789ab")
            remove_leftovers(tmp_path / "_work")
            remove_leftovers_of(tmp_path / "_work" / "a.h5")
            assert len(list((tmp_path / "_work").iterdir())) == 2
        remove_leftovers(tmp_path / "_work")
    assert (tmp_path / "a.h5").read_bytes() == b"half"
    assert not list((tmp_path / "_work").iterdir())


@pytest.mark.slow
def test_two_machines_work_in_the_same_folder(tiny, tmp_path, monkeypatch) -> None:
    """After the first machine has written a shard, the second one starts its part of the same dataset."""
    written, replace = [], Path.replace

    def renamed(self: Path, target: Path) -> Path:
        if target.suffix == ".h5" and not written:
            written.append(target)
            os.utime(self, (0, 0))
            with monkeypatch.context() as patch:
                patch.setattr(leftovers, "_machine", lambda: "0123456789ab")
                make_tiny(tmp_path / "out", part=(1, 2))
        return replace(self, target)

    monkeypatch.setattr(Path, "replace", renamed)
    made = make_tiny(tmp_path / "out", part=(0, 2))
    assert written
    assert made.complete or make_tiny(tmp_path / "out").complete
    assert digests(tmp_path / "out") == digests(tiny("airhockey-hit"))
    assert validate_dataset(tmp_path / "out").ok


def test_symbolic_links_to_folders_are_not_followed(tmp_path: Path) -> None:
    (tmp_path / "mine").mkdir()
    name = of_a_dead_process("thesis.tex")
    (tmp_path / "mine" / name).write_text("mine")
    (tmp_path / "out").mkdir()
    (tmp_path / "out" / "_work").symlink_to(tmp_path / "mine")
    assert make_tiny(tmp_path / "out").complete
    assert (tmp_path / "mine" / name).read_text() == "mine"


def test_the_name_of_a_temporary_file_contains_machine_and_process(elsewhere) -> None:
    assert temporary_name("a.h5").startswith(f".a.h5.0123456789ab-{os.getpid()}.")
