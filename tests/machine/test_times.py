"""Times: what was preparing, computing and waiting, and together all that has passed."""

import time

import pytest

from cnpgen.machine.times import NO_TIME, Stopwatch, Times


def busy(seconds: float) -> None:
    """Use the processor for so long."""
    end = time.process_time() + seconds
    while time.process_time() < end:
        pass


def test_what_passes_is_compiling_computing_or_waiting() -> None:
    begun, watch = time.perf_counter(), Stopwatch()
    time.sleep(0.1)
    watch.prepared()
    busy(0.1)
    time.sleep(0.2)
    watch.computed_here()
    times = watch.times()
    passed = time.perf_counter() - begun
    assert times.preparing >= 0.1
    assert 0.1 <= times.computing < 0.2
    assert times.waiting >= 0.2
    assert times.passed == pytest.approx(passed, abs=0.05)


def test_processes_that_share_the_work_compute_side_by_side() -> None:
    watch = Stopwatch()
    watch.prepared()
    for seconds in (3.0, 5.0):
        watch.computing += seconds / 2
    assert watch.times().computing == 4.0
    assert watch.times().waiting == 0.0


def test_times_are_said_in_words_and_in_json() -> None:
    times = Times(preparing=170.12345, computing=7.6, waiting=0.5)
    assert (
        str(times)
        == "178.2 s (170.1 s preparing and compiling, 7.6 s computing, 0.5 s waiting)"
    )
    assert times.rounded() == {"preparing": 170.123, "computing": 7.6, "waiting": 0.5}
    assert NO_TIME.passed == 0.0
