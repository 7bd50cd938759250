"""A few runs that are killed and go on; ``python -m tests.faults --kills 200`` has more."""

from pathlib import Path

import pytest

from tests.faults.kills import KINDS, kill


@pytest.mark.extended  # tests/make/test_interrupted.py has single kills at chosen moments
@pytest.mark.skipif(not Path("/proc/self/task").is_dir(), reason="needs /proc")
@pytest.mark.parametrize("kind", KINDS)
def test_killed_runs_go_on_and_make_what_an_uncut_one_makes(kind):
    killed = kill(2, seed=1, kinds=(kind,))
    assert killed.findings == []
    assert killed.struck >= 2
