"""What killed processes leave: swept by their own machine, and left alone by others, whatever their clocks say."""

import os
import subprocess
import sys
from pathlib import Path

import pytest

from cnpgen.store.files import leftovers
from cnpgen.store.files.atomic import committing
from cnpgen.store.files.leftovers import sweep, sweep_all, sweep_file, temporary_name
from cnpgen.validate.dataset import validate_dataset
from tests.examples.tiny_datasets import digests, make_tiny

DEAD = """
import sys
from cnpgen.store.files.leftovers import temporary_name
print(temporary_name(sys.argv[1]), end="")
"""


def of_a_dead_process(name: str) -> str:
    """The name that a process which is no more gave to a temporary file."""
    return subprocess.run([sys.executable, "-c", DEAD, name], capture_output=True, text=True, check=True).stdout


@pytest.fixture
def elsewhere(monkeypatch):
    """Be another machine."""
    monkeypatch.setattr(leftovers, "_machine", lambda: "0123456789ab")


def test_what_dead_processes_of_this_machine_have_left_is_swept_and_nothing_else(tmp_path: Path) -> None:
    sweep(tmp_path / "nothing")
    dead, mine = of_a_dead_process("a.h5"), temporary_name("a.h5")
    kept = [mine, ".a.h5.1.2.tmp", ".x.tmp", "log.txt", dead.removesuffix(".tmp")]
    for name in (dead, *kept):
        (tmp_path / name).touch()
        os.utime(tmp_path / name, (0, 0))  # of 1970: age does not count
    sweep(tmp_path)
    assert sorted(path.name for path in tmp_path.iterdir()) == sorted(kept)
    sweep_all(tmp_path)
    assert sorted(path.name for path in tmp_path.iterdir()) == sorted([".x.tmp", "log.txt", dead.removesuffix(".tmp")])


def test_a_machine_whose_clock_is_hours_ahead_leaves_what_another_one_is_writing(tmp_path, monkeypatch) -> None:
    dead = of_a_dead_process("a.h5")
    with committing(tmp_path / "a.h5", tmp_path / "_work") as temporary:
        temporary.write_bytes(b"half")
        (tmp_path / "_work" / dead).touch()
        for name in (temporary.name, dead):
            os.utime(tmp_path / "_work" / name, (0, 0))
        with monkeypatch.context() as patch:
            patch.setattr(leftovers, "_machine", lambda: "0123456789ab")
            sweep(tmp_path / "_work")
            sweep_file(tmp_path / "_work" / "a.h5")
            assert len(list((tmp_path / "_work").iterdir())) == 2
        sweep(tmp_path / "_work")
    assert (tmp_path / "a.h5").read_bytes() == b"half"
    assert not list((tmp_path / "_work").iterdir())


@pytest.mark.slow
def test_a_second_machine_on_the_folder_of_a_dataset_does_not_disturb_the_first(tiny, tmp_path, monkeypatch) -> None:
    """Each time the first one has written a shard, the other one begins its own part of the same dataset."""
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


def test_nothing_is_swept_through_a_symbolic_link(tmp_path: Path) -> None:
    (tmp_path / "mine").mkdir()
    name = of_a_dead_process("thesis.tex")
    (tmp_path / "mine" / name).write_text("mine")
    (tmp_path / "out").mkdir()
    (tmp_path / "out" / "_work").symlink_to(tmp_path / "mine")
    assert make_tiny(tmp_path / "out").complete
    assert (tmp_path / "mine" / name).read_text() == "mine"


def test_a_name_says_machine_and_process(elsewhere) -> None:
    assert temporary_name("a.h5").startswith(f".a.h5.0123456789ab-{os.getpid()}.")
