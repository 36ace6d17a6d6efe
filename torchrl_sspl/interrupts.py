"""SIGINT and SIGTERM: a training saves its state, says where, and ends."""

from __future__ import annotations

import math
import os
import signal
import sys
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from types import FrameType
from typing import Any

SIGNALS = (signal.SIGINT, signal.SIGTERM)
PATIENCE = 15.0
"""Seconds after a signal in which the next point where the state can be saved has to come."""


class Interrupted(SystemExit, KeyboardInterrupt):
    """What a signal has ended; the process exits with 128 and the number of the signal, without a traceback.

    A program that catches KeyboardInterrupt catches it. Source: none.

    Example:
        >>> Interrupted(15).code
        143
    """

    def __init__(self, number: int) -> None:
        super().__init__(128 + number)
        self.number = number


class _Watch:
    """Signals that were received, and whether somebody is going to save the state soon."""

    def __init__(self, say: Callable[[], str]) -> None:
        self.say, self.received, self.saving, self.process = say, 0, False, os.getpid()
        self.timer: threading.Timer | None = None

    def __call__(self, number: int, frame: FrameType | None) -> None:
        if os.getpid() != self.process:  # a forked worker has nothing to save
            signal.signal(number, signal.SIG_DFL)
            os.kill(os.getpid(), number)
        again, self.received = bool(self.received), number
        if again or not self.saving:
            self.end()
        # The next point where the state can be saved may be far: then the last checkpoint has to do.
        self.timer = threading.Timer(PATIENCE, os.kill, (self.process, number))
        self.timer.daemon = True
        self.timer.start()

    def end(self) -> None:
        if self.timer is not None:
            self.timer.cancel()
        print(f"\ninterrupted by {signal.Signals(self.received).name}; {self.say()}", file=sys.stderr, flush=True)
        raise Interrupted(self.received)


_watch: _Watch | None = None


@contextmanager
def interruptible(say: Callable[[], str] = lambda: "nothing was to be saved") -> Iterator[None]:
    """Inside, SIGINT and SIGTERM end what runs with an :class:`Interrupted` and one line that ends with ``say()``.

    Handlers that a program has set itself, and signals that it ignores, are left alone; those of libraries in C (SDL takes
    SIGTERM) are not. Inside another one only ``say`` changes; in another thread than the main one nothing happens.
    Source: none.

    Example:
        >>> with interruptible():
        ...     print(pending())
        False
    """
    global _watch
    if _watch is not None:
        outer, _watch.say = _watch.say, say
        try:
            yield
        finally:
            _watch.say = outer
        return
    if threading.current_thread() is not threading.main_thread():
        yield
        return
    before = {number: signal.getsignal(number) for number in SIGNALS}
    ours = [number for number, handler in before.items() if handler in (signal.SIG_DFL, signal.default_int_handler, None)]
    _watch = _Watch(say)
    try:
        for number in ours:
            signal.signal(number, _watch)
        yield
    finally:
        if _watch.timer is not None:  # what it was to end has failed of itself: it would end what comes afterwards
            _watch.timer.cancel()
        _watch = None
        for number in ours:
            default = signal.default_int_handler if number == signal.SIGINT else signal.SIG_DFL
            signal.signal(number, default if before[number] is None else before[number])


@contextmanager
def saving() -> Iterator[None]:
    """Inside, a signal waits for the next :func:`end_if_pending`, which comes within steps; a second one does not."""
    watch = _watch
    if watch is None or watch.saving:
        yield
        return
    watch.saving = True
    try:
        yield
    finally:
        watch.saving = False
    end_if_pending()


def pending() -> bool:
    """Whether a signal waits for the state to be saved."""
    return _watch is not None and bool(_watch.received)


def end_if_pending() -> None:
    """Ends with :class:`Interrupted` if a signal was received; call it when the state is saved."""
    if _watch is not None and _watch.received:
        _watch.end()


class TimeUp(Exception):
    """The time for something is over. Source: none."""


@contextmanager
def time_limit(seconds: float) -> Iterator[None]:
    """Raises TimeUp in the block after a while, where it can be interrupted (in the main thread, not on Windows). Source: none.

    Example:
        >>> with time_limit(60.0):
        ...     1 + 1
        2
    """
    usable = hasattr(signal, "setitimer") and threading.current_thread() is threading.main_thread()
    if not usable or not math.isfinite(seconds):
        yield
        return

    def over(*_: Any) -> None:
        raise TimeUp

    before = signal.signal(signal.SIGALRM, over)
    signal.setitimer(signal.ITIMER_REAL, max(seconds, 1e-3))
    try:
        yield
    finally:
        signal.setitimer(signal.ITIMER_REAL, 0.0)
        signal.signal(signal.SIGALRM, before)


__all__ = ["Interrupted", "TimeUp", "end_if_pending", "interruptible", "pending", "saving", "time_limit"]
