"""Signals that wait: nothing is interrupted in the centre, and nothing is swallowed."""

import signal
import subprocess
import sys
import threading

import pytest

from cnpgen.machine import signals
from cnpgen.machine.signals import signals_deferred
from tests.refusals import is_refused


def receive(count: int, done: list[int | None]) -> None:
    """Receive so many signals in a block; note at its end which one waits."""
    with signals_deferred() as waiting:
        for _ in range(count):
            signal.raise_signal(signal.SIGINT)
        done.append(waiting.number)


def test_a_signal_takes_its_effect_at_the_end_of_the_block():
    done: list[int | None] = []
    with pytest.raises(KeyboardInterrupt):
        receive(1, done)
    assert done == [signal.SIGINT]
    assert signal.getsignal(signal.SIGINT) is signal.default_int_handler


def test_the_echo_of_a_signal_waits_too_and_a_later_one_does_not(monkeypatch):
    done: list[int | None] = []
    with pytest.raises(KeyboardInterrupt):
        receive(3, done)
    assert done == [signal.SIGINT]
    monkeypatch.setattr(signals, "MIN_REPEAT_INTERVAL_S", 0.0)
    with pytest.raises(KeyboardInterrupt):
        receive(2, done)
    assert len(done) == 1  # the end of the block was not reached


def test_handlers_are_as_before_where_no_signal_came_or_the_block_failed():
    before = {
        number: signal.getsignal(number) for number in (signal.SIGINT, signal.SIGTERM)
    }
    with signals_deferred() as waiting:
        assert waiting.number is None
    with is_refused(ValueError), signals_deferred():
        raise ValueError("of the block")
    assert {number: signal.getsignal(number) for number in before} == before


def test_a_handler_that_only_takes_notes_lets_the_run_go_on():
    seen, before = [], signal.getsignal(signal.SIGTERM)
    signal.signal(signal.SIGTERM, lambda number, _: seen.append(number))
    try:
        with signals_deferred():
            signal.raise_signal(signal.SIGTERM)
            assert seen == []
    finally:
        signal.signal(signal.SIGTERM, before)
    assert seen == [signal.SIGTERM]


def test_other_threads_may_train_too():
    found = []

    def work() -> None:
        with signals_deferred() as waiting:
            found.append(waiting.number)

    thread = threading.Thread(target=work)
    thread.start()
    thread.join()
    assert found == [None]


def test_a_block_that_fails_swallows_no_signal():
    def fail() -> None:
        with signals_deferred():
            signal.raise_signal(signal.SIGINT)
            raise ZeroDivisionError

    with pytest.raises(KeyboardInterrupt) as caught:
        fail()
    assert isinstance(caught.value.__context__, ZeroDivisionError)


def test_a_block_within_a_block_waits_for_the_outer_one_too():
    steps: list[str] = []

    def both() -> None:
        with signals_deferred() as outer:
            with signals_deferred() as inner:
                signal.raise_signal(signal.SIGINT)
                steps.append(f"inner {inner.came}, outer {outer.came}")
            steps.append(f"outer {outer.came}")

    with pytest.raises(KeyboardInterrupt):
        both()
    assert steps == ["inner True, outer False", "outer True"]


def test_a_process_without_handlers_of_its_own_ends_by_the_signal_and_after_the_block():
    code = """
import signal
from cnpgen.machine.signals import signals_deferred
with signals_deferred():
    signal.raise_signal(signal.SIGTERM)
    print("to the end", flush=True)
print("not reached")
"""
    done = subprocess.run(
        [sys.executable, "-c", code], capture_output=True, text=True, check=False
    )
    assert (done.returncode, done.stdout, done.stderr) == (
        -signal.SIGTERM,
        "to the end\n",
        "",
    )
