"""Signals that end a program: one KeyboardInterrupt whichever comes, none while something is made safe."""

from __future__ import annotations

import signal
import threading
from collections.abc import Iterator
from contextlib import contextmanager, nullcontext

import pytest

from hw.safety.signals import ENDING, interruptible, raise_if_interrupted, uninterrupted

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


BLOCKS = {"bare": nullcontext, "interruptible": interruptible}


@pytest.mark.parametrize("moment", ["before", "after"])
@pytest.mark.parametrize("at", range(1, 2 * len(ENDING) + 1))
@pytest.mark.parametrize(
    ("outer", "number"), [("bare", signal.SIGINT), *(("interruptible", number) for number in sorted(ENDING))]
)
def test_no_signal_slips_between_the_handlers(
    monkeypatch: pytest.MonkeyPatch, outer: str, number: signal.Signals, at: int, moment: str
) -> None:
    """At every single change of a handler. Expected: the block ends, is interrupted then, handlers are back."""
    before = {n: signal.getsignal(n) for n in ENDING}
    done = []
    with BLOCKS[outer]() as interruption:
        inside = {n: signal.getsignal(n) for n in ENDING}
        with pytest.raises(KeyboardInterrupt), pressed_at(monkeypatch, at, moment, number), uninterrupted():  # noqa: PT012 - all of the block
            done.append(len(done))
            done.append(len(done))
        assert done == [0, 1] and {n: signal.getsignal(n) for n in ENDING} == inside
        assert interruption is None or interruption.stopped
    assert {n: signal.getsignal(n) for n in ENDING} == before


@pytest.mark.parametrize("moment", ["before", "after"])
@pytest.mark.parametrize("at", range(1, 2 * len(ENDING) + 1))
def test_an_interruptible_block_leaves_no_handler_behind(monkeypatch: pytest.MonkeyPatch, at: int, moment: str) -> None:
    """Ctrl-C at every single change of a handler. Expected: interrupted, handlers are back, the body once or not."""
    before = {n: signal.getsignal(n) for n in ENDING}
    done = []
    with pytest.raises(KeyboardInterrupt), pressed_at(monkeypatch, at, moment, signal.SIGINT), interruptible():
        done.append(True)
    assert done == [True] * (at > len(ENDING)) and {n: signal.getsignal(n) for n in ENDING} == before
    raise_if_interrupted()


@contextmanager
def pressed_at(monkeypatch: pytest.MonkeyPatch, at: int, moment: str, number: int) -> Iterator[None]:
    """A signal before or after the `at`-th change of a handler."""
    change, changes = signal.signal, []

    def changed(which: int, handler: object) -> object:
        changes.append(which)
        if len(changes) == at and moment == "before":
            signal.raise_signal(number)
        found = change(which, handler)  # type: ignore[arg-type]
        if len(changes) == at and moment == "after":
            signal.raise_signal(number)
        return found

    with monkeypatch.context() as pressing:
        pressing.setattr("hw.safety.signals.signal.signal", changed)
        yield
        assert len(changes) >= at


class Lost:
    """Python swallows what is raised as this goes."""

    def __del__(self) -> None:
        signal.raise_signal(signal.SIGTERM)


@pytest.mark.filterwarnings("ignore::pytest.PytestUnraisableExceptionWarning")
def test_an_interruption_that_was_lost_is_heeded() -> None:
    with interruptible() as interruption:
        raise_if_interrupted()
        Lost()
        assert interruption.stopped
        with pytest.raises(KeyboardInterrupt):
            raise_if_interrupted()
        thread = threading.Thread(target=raise_if_interrupted)  # Python interrupts the main thread alone
        thread.start()
        thread.join()
    raise_if_interrupted()
