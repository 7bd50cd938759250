"""A few runs that are killed and resumed; for more run ``python -m tests.faults --kills 200``."""

from pathlib import Path

import pytest

from tests.faults.kills import KINDS, kill


@pytest.mark.extended  # tests/make/test_interrupted.py has single kills at chosen times
@pytest.mark.skipif(not Path("/proc/self/task").is_dir(), reason="needs /proc")
@pytest.mark.parametrize("kind", KINDS)
def test_killed_and_resumed_runs_give_the_result_of_an_uninterrupted_run(kind):
    if kind == "publish":
        pytest.importorskip("pyarrow")
        pytest.importorskip("matplotlib")
    killed = kill(2, seed=1, kinds=(kind,))
    assert killed.findings == []
    assert killed.n_signals >= 2
