"""Signals: the state is saved, one line says where, the exit code is the signal's, and nothing else is touched."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time

import pytest

from torchrl_sspl import interrupts
from torchrl_sspl.interrupts import Interrupted, end_if_pending, interruptible, pending, saving


@pytest.fixture(autouse=True)
def _python_takes_the_signals():
    """Whatever the tests were started by: in the background of a shell SIGINT is ignored."""
    before = [signal.signal(n, h) for n, h in ((signal.SIGINT, signal.default_int_handler), (signal.SIGTERM, signal.SIG_DFL))]
    yield
    for number, handler in zip((signal.SIGINT, signal.SIGTERM), before, strict=True):
        signal.signal(number, handler)


def test_a_signal_that_is_ignored_stays_so():
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    with interruptible():
        signal.raise_signal(signal.SIGINT)
        assert not pending()


@pytest.mark.parametrize(("number", "code"), [(signal.SIGINT, 130), (signal.SIGTERM, 143)])
def test_a_signal_ends_with_its_code_and_one_line(capsys, number, code):
    with pytest.raises(Interrupted) as ended, interruptible(lambda: "all is in a.pt"):
        signal.raise_signal(number)
    assert ended.value.code == code
    assert capsys.readouterr().err == f"\ninterrupted by {signal.Signals(number).name}; all is in a.pt\n"


def test_a_program_that_catches_keyboard_interrupt_catches_it():
    with pytest.raises(KeyboardInterrupt), interruptible():
        signal.raise_signal(signal.SIGINT)


def test_it_waits_for_the_state_to_be_saved_and_not_longer():
    done = []

    def work():
        with interruptible(), saving():
            signal.raise_signal(signal.SIGTERM)
            done.append(pending())
            end_if_pending()
            done.append("never")

    with pytest.raises(Interrupted):
        work()
    assert done == [True]


def test_a_signal_ends_what_follows_where_nobody_asked_meanwhile():
    done = []

    def work():
        with interruptible():
            with saving():
                signal.raise_signal(signal.SIGTERM)
                done.append("saved")
            done.append("never")

    with pytest.raises(Interrupted):
        work()
    assert done == ["saved"]


def test_nothing_waits_any_more_once_all_is_saved():
    done = []

    def work():
        with interruptible():
            with saving():
                done.append("saved")
            signal.raise_signal(signal.SIGTERM)
            done.append("never")

    with pytest.raises(Interrupted):
        work()
    assert done == ["saved"]


def test_a_second_signal_does_not_wait():
    done = []

    def work():
        with interruptible(), saving():
            signal.raise_signal(signal.SIGTERM)
            done.append(1)
            signal.raise_signal(signal.SIGINT)
            done.append(2)

    with pytest.raises(Interrupted):
        work()
    assert done == [1]


def test_where_nobody_saves_in_time_it_ends_all_the_same(monkeypatch):
    monkeypatch.setattr(interrupts, "PATIENCE", 0.2)
    begun = time.monotonic()

    def work():
        with interruptible(), saving():
            signal.raise_signal(signal.SIGTERM)
            time.sleep(20)

    with pytest.raises(Interrupted):
        work()
    assert time.monotonic() - begun < 10


def test_what_fails_before_its_state_is_saved_is_not_ended_once_more_later(monkeypatch):
    monkeypatch.setattr(interrupts, "PATIENCE", 0.3)

    def work():
        with interruptible(), saving():
            signal.raise_signal(signal.SIGINT)
            raise OSError("full")

    with pytest.raises(OSError, match="full"):
        work()
    time.sleep(0.6)  # else a KeyboardInterrupt comes here


def test_handlers_are_those_from_before_afterwards_and_a_programs_own_are_kept():
    def own(number, frame):
        seen.append(number)

    seen: list[int] = []
    before = signal.signal(signal.SIGTERM, own)
    try:
        with interruptible(), saving():
            signal.raise_signal(signal.SIGTERM)
            assert not pending()
        assert seen == [signal.SIGTERM]
        assert signal.getsignal(signal.SIGTERM) is own
        assert signal.getsignal(signal.SIGINT) is signal.default_int_handler
    finally:
        signal.signal(signal.SIGTERM, before)


@pytest.mark.skipif(not hasattr(os, "fork"), reason="no fork here")
def test_a_forked_worker_dies_of_the_signal_itself():
    code = """
import os, signal, time
from torchrl_sspl.interrupts import interruptible
with interruptible():
    child = os.fork()
    if child == 0:
        time.sleep(30)
    time.sleep(0.3)
    os.kill(child, signal.SIGTERM)
    print(os.waitstatus_to_exitcode(os.waitpid(child, 0)[1]))
"""
    out = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, timeout=60)
    assert (out.stdout.strip(), out.stderr) == ("-15", "")


def test_where_sdl_took_the_signal_it_is_ours_again():
    code = """
import os, signal
os.environ["SDL_VIDEODRIVER"] = "dummy"
import pygame
pygame.init(); pygame.display.set_mode((8, 8))
from torchrl_sspl.interrupts import interruptible
with interruptible(lambda: "saved"):
    signal.raise_signal(signal.SIGTERM)
    print("still here")
"""
    out = subprocess.run([sys.executable, "-W", "ignore", "-c", code], capture_output=True, text=True, timeout=60)
    assert out.returncode == 143
    assert "still here" not in out.stdout
    assert out.stderr.endswith("interrupted by SIGTERM; saved\n")
