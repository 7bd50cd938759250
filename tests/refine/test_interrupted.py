"""Refinement interrupted by a killed worker or a full disk: finished plans are kept, and the next run resumes."""

import errno
import os
import signal
import subprocess
import sys
from pathlib import Path

import pytest

from cnpgen.cli.main import main
from cnpgen.errors import MachineError
from cnpgen.make.draw_boundary_problems import draw_boundary_problems
from cnpgen.plans import load_plans, save_plans
from cnpgen.plans.plans import Plans
from cnpgen.refine.refine_plans import refine_plans
from tests.cli.test_interruption import descendants
from tests.conftest import some
from tests.refine.test_refine_plans import same
from tests.refusals import is_refused

N = 14
linux = pytest.mark.skipif(not Path("/proc/self/task").is_dir(), reason="needs /proc")


@pytest.fixture(scope="module")
def problems() -> Plans:
    return draw_boundary_problems("airhockey-hit", N, seed=6)


@pytest.fixture(scope="module")
def solved(problems: Plans) -> Plans:
    return refine_plans(problems, workers=1).plans


def kill_workers(_plans: int, _valid: int) -> None:
    names = {
        pid: Path(f"/proc/{pid}/cmdline").read_text()
        for pid in descendants(os.getpid())
    }
    for pid, name in names.items():
        if "popen_loky" in name:
            os.kill(pid, signal.SIGKILL)


@pytest.mark.slow
@linux
def test_plans_finished_before_a_worker_was_killed_are_not_made_again(
    problems: Plans, solved: Plans, tmp_path: Path
) -> None:
    journal, begun = tmp_path / "journal", []
    with is_refused(MachineError):
        refine_plans(problems, workers=2, journal=journal, progress=kill_workers)
    found = refine_plans(
        problems,
        workers=1,
        journal=journal,
        begin=lambda *numbers: begun.append(numbers),
    )
    ((total, there),) = begun
    assert total == N
    assert 1 <= there < N
    assert same(found.plans, solved)


@pytest.mark.parametrize("number", some([errno.ENOSPC, errno.EDQUOT], 1, "slow"))
def test_a_full_disk_is_reported_with_a_remedy_and_earlier_plans_count(
    problems: Plans,
    solved: Plans,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    number: int,
) -> None:
    journal, flush, calls, begun = tmp_path / "journal", os.fsync, [], []

    def full(descriptor: int) -> None:
        calls.append(descriptor)
        if len(calls) > 5:
            raise OSError(number, os.strerror(number))
        flush(descriptor)

    monkeypatch.setattr(os, "fsync", full)
    with is_refused(MachineError):
        refine_plans(problems, workers=1, journal=journal)
    monkeypatch.undo()
    found = refine_plans(
        problems,
        workers=1,
        journal=journal,
        begin=lambda *numbers: begun.append(numbers),
    )
    assert begun[0][1] >= 4
    assert same(found.plans, solved)


LIMITED = """
import resource, sys
from cnpgen.cli.main import main

if __name__ == "__main__":
    resource.setrlimit(resource.RLIMIT_FSIZE, (int(sys.argv[1]), resource.RLIM_INFINITY))
    sys.exit(main(sys.argv[2:]))
"""


@pytest.mark.slow
@linux
@pytest.mark.parametrize(("limit", "workers"), [(12_000, "2"), (41_000, "1")])
def test_a_file_that_cannot_grow_is_reported_in_one_line_and_the_same_command_resumes(
    problems: Plans, solved: Plans, tmp_path: Path, limit: int, workers: str
) -> None:
    """The smaller limit stops the journal within a plan, the larger one the plan file at the end."""
    given, out = tmp_path / "problems.h5", tmp_path / "out.h5"
    save_plans(given, problems)
    words = ["refine", str(given), "-o", str(out), "--workers", workers]
    command = [sys.executable, "-c", LIMITED, str(limit), *words]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    assert (done.returncode, done.stdout) == (3, "")
    checked, begun, error = done.stderr.splitlines()
    assert checked == f"{given}: the file's checksum is right"
    assert begun == f"refining {given}: {N} plans"
    file = "out.h5.part" if limit < 20_000 else "out.h5"
    assert error.startswith(
        f"cnpgen: error: cannot write {tmp_path / file}: File too large; "
    )
    assert sorted(path.name for path in tmp_path.iterdir()) == [
        "out.h5.part",
        "problems.h5",
    ]
    assert main([*words, "--quiet"]) == 0
    assert same(load_plans(out), solved)
    assert sorted(path.name for path in tmp_path.iterdir()) == [
        ".out.h5.request",
        "out.h5",
        "problems.h5",
    ]
