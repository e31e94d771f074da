"""Signals that end a program: one KeyboardInterrupt whichever comes, none while something is made safe."""

from __future__ import annotations

import signal
import threading

import pytest

from hw.signals import ENDING, interruptible, uninterrupted

NUMBERS = pytest.mark.parametrize("number", sorted(ENDING), ids=lambda n: signal.Signals(n).name)


@NUMBERS
def test_the_first_signal_interrupts_and_no_other_does(number: signal.Signals) -> None:
    before = {n: signal.getsignal(n) for n in ENDING}
    with interruptible() as interruption:
        with pytest.raises(KeyboardInterrupt):
            signal.raise_signal(number)
        assert interruption.stopped
        for another in ENDING:
            signal.raise_signal(another)
    assert {n: signal.getsignal(n) for n in ENDING} == before


@NUMBERS
def test_a_signal_in_an_uninterrupted_block_counts_at_its_end(number: signal.Signals) -> None:
    done = []
    with interruptible() as interruption:
        with pytest.raises(KeyboardInterrupt), uninterrupted():  # noqa: PT012 - raised by the end of the block
            for _ in range(3):
                signal.raise_signal(number)
            with uninterrupted():
                signal.raise_signal(number)
            assert not interruption.stopped
            done.append(True)
        assert interruption.stopped and done
        with uninterrupted():  # and after the first none does
            signal.raise_signal(number)


def test_what_is_ignored_stays_ignored() -> None:
    """nohup."""
    before = signal.signal(signal.SIGHUP, signal.SIG_IGN)
    try:
        with interruptible() as interruption, uninterrupted():
            signal.raise_signal(signal.SIGHUP)
        assert not interruption.stopped and signal.getsignal(signal.SIGHUP) == signal.SIG_IGN
    finally:
        signal.signal(signal.SIGHUP, before)


def test_another_thread_changes_no_handler() -> None:
    seen = []

    def look() -> None:
        with interruptible(), uninterrupted():
            seen.append({n: signal.getsignal(n) for n in ENDING})

    before = {n: signal.getsignal(n) for n in ENDING}
    thread = threading.Thread(target=look)
    thread.start()
    thread.join()
    assert seen == [before]
