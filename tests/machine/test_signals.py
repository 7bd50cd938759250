"""Signals that wait: nothing is interrupted in the middle, and nothing is swallowed."""

import signal
import threading

import pytest

from cnpgen.machine import signals
from cnpgen.machine.signals import signals_wait


def receive(count: int, done: list[int | None]) -> None:
    """Receive so many signals in a block; note at its end which one waits."""
    with signals_wait() as waiting:
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
    monkeypatch.setattr(signals, "ECHO_SECONDS", 0.0)
    with pytest.raises(KeyboardInterrupt):
        receive(2, done)
    assert len(done) == 1  # the end of the block was not reached


def test_handlers_are_as_before_where_no_signal_came_or_the_block_failed():
    before = {number: signal.getsignal(number) for number in (signal.SIGINT, signal.SIGTERM)}
    with signals_wait() as waiting:
        assert waiting.number is None
    with pytest.raises(ValueError, match="of the block"), signals_wait():
        raise ValueError("of the block")
    assert {number: signal.getsignal(number) for number in before} == before


def test_a_handler_that_only_takes_notes_lets_the_run_go_on():
    seen, before = [], signal.getsignal(signal.SIGTERM)
    signal.signal(signal.SIGTERM, lambda number, _: seen.append(number))
    try:
        with signals_wait():
            signal.raise_signal(signal.SIGTERM)
            assert seen == []
    finally:
        signal.signal(signal.SIGTERM, before)
    assert seen == [signal.SIGTERM]


def test_other_threads_may_train_too():
    found = []

    def work() -> None:
        with signals_wait() as waiting:
            found.append(waiting.number)

    thread = threading.Thread(target=work)
    thread.start()
    thread.join()
    assert found == [None]
