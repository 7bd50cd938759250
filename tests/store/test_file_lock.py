"""Locks of output files: a second process is refused, a lock of a dead process is not."""

import subprocess
import sys
from pathlib import Path

import pytest

from cnpgen.errors import MachineError, UsageError
from cnpgen.store.files.file_lock import output_lock
from tests.refusals import is_refused

pytestmark = pytest.mark.skipif(sys.platform == "win32", reason="there are no locks")

HOLD = """
import sys
from pathlib import Path
from cnpgen.store.files.file_lock import output_lock
with output_lock(Path("out.h5"), Path(sys.argv[1])):
    print("locked", flush=True)
    sys.stdin.read()
"""


def test_a_second_process_is_refused_until_the_first_has_ended(tmp_path: Path) -> None:
    lock = tmp_path / "out.lock"
    command = [sys.executable, "-c", HOLD, str(lock)]
    with subprocess.Popen(
        command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True
    ) as process:
        assert process.stdout is not None
        assert process.stdout.readline() == "locked\n"
        refused = pytest.raises(
            UsageError, match=r"^another process is writing .*out\.h5: wait for it"
        )
        with refused, output_lock(tmp_path / "out.h5", lock):
            pass
        process.kill()
    assert lock.exists()
    with output_lock(tmp_path / "out.h5", lock):
        assert lock.exists()
    assert not lock.exists()


def test_an_error_of_the_block_is_raised_unchanged(tmp_path: Path) -> None:
    with (
        pytest.raises(FileNotFoundError),
        output_lock(tmp_path / "out.h5", tmp_path / "out.lock"),
    ):
        raise FileNotFoundError("of the block")
    assert not list(tmp_path.iterdir())


def test_a_folder_that_cannot_be_written_is_named(tmp_path: Path) -> None:
    with (
        is_refused(MachineError),
        output_lock(tmp_path / "out.h5", tmp_path / "no" / "out.lock"),
    ):
        pass
