"""What a person sees while a training runs: phase, loss, volume kept so far, and how long this phase still takes."""

from __future__ import annotations

import json
import math
import time
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path
from typing import Any, TextIO

from tqdm import tqdm

from torchrl_sspl.errors import OutputError
from torchrl_sspl.files import write

#: In the directory of a run, while it is trained: where it is, for whoever looks from elsewhere.
PROGRESS_FILE = "progress.json"

#: What the phases do, in words.
WORDS = {
    "steady": "steadying the encoder", "changes": "encoding changed pictures", "gather": "encoding what was seen", "dynamics": "fitting the latent dynamics", "teach": "teaching the policy",
    "fit": "fitting safe set and policy", "steer": "steering the policy", "tune": "tuning both on the condition",
    "tighten": "training on counterexamples", "check": "checking on fresh episodes", "retry": "beginning again with fresh weights", "level": "placing the zero level",
}  # fmt: skip
_EVERY = 1.0  # seconds between looks at the loss


class Progress:
    """A bar over all optimiser steps of a training.

    The time that is left is that of the present phase, from the pace of this very phase: steps of different phases cost
    different times, so a pace of one says nothing of the next. Nothing here changes what is computed.

    Args:
        total, done: optimiser steps, of all phases and so far.
        shown: whether there is anything to see.
        resumed: whether an interrupted training goes on.
        file: where it is written; None: standard error.
        out_dir: directory whose ``progress.json`` says the same, until the end; None: nowhere.

    Source: none.

    Example:
        >>> bar = Progress(10, 0, shown=False)
        >>> bar.begin("joint training", 10, left=1)
        >>> bar.tick(lambda: 0.5)
        >>> bar.n
        1
    """

    def __init__(
        self, total: int, done: int, *, shown: bool = True, resumed: bool = False, file: TextIO | None = None,
        out_dir: Path | None = None,
    ) -> None:  # fmt: skip
        layout = "{desc} {percentage:3.0f}%|{bar}| {n_fmt}/{total_fmt} steps, {elapsed}{postfix}"
        self._bar = tqdm(total=total, initial=done, disable=not shown, bar_format=layout, dynamic_ncols=True, file=file)
        self.shown, self.n, self._note = shown, done, "resumed" if resumed else ""
        self._total, self._words, self._state = total, "", None if out_dir is None else out_dir / PROGRESS_FILE
        self.kept: float | None = None  # share of the space outside U in the set, so far
        self._seen: int | None = None  # transitions, where a phase looks for more
        self._began, self._first, self._size, self._left, self._looked = time.monotonic(), done, 0, 0, 0.0
        self.begin("starting", 0)

    def begin(self, words: str, size: int, *, taken: int = 0, left: int = 0) -> None:
        """A phase of so many steps, of which so many were taken before; so many further phases are ``left``."""
        self._began, self._first, self._size, self._left = time.monotonic(), self.n, size - taken, left
        self._words, self._seen = words, None
        self._bar.set_description_str(words, refresh=False)
        self.show()

    def tick(self, loss: Callable[[], float | None]) -> None:
        """One step; the loss is asked for once a second at most."""
        self.n += 1
        self._bar.update()
        if (self.shown or self._state) and time.monotonic() - self._looked >= _EVERY:
            self._looked = time.monotonic()
            self.show(loss() if self.shown else None)

    def saw(self, transitions: int) -> None:
        """So many so far: a phase that takes no steps takes minutes for them."""
        self._seen = transitions
        self.show()

    def beat(self) -> None:
        """Something goes on: the clock does, too."""
        if self.shown and time.monotonic() - self._looked >= _EVERY:
            self._looked = time.monotonic()
            self._bar.refresh()

    def show(self, loss: float | None = None) -> None:
        """Loss, volume and time left."""
        parts = [self._note] if self._note else []
        if loss is not None:
            parts.append(f"loss {loss:.3g}")
        if self._seen is not None:
            parts.append(f"{self._seen:,} transitions seen")
        if self.kept is not None:
            parts.append(f"safe set {self.kept:.0%} of the space outside U")
        parts.append(self.eta())
        self._bar.set_postfix_str(", ".join(p for p in parts if p), refresh=self.shown)
        if self._state is not None:
            with suppress(OutputError):  # nobody has to look
                write(self._state, json.dumps({"phase": self._words, "done": self.n, "total": self._total, "left": self.eta()}) + "\n")

    def eta(self) -> str:
        """Time that the phase still takes, "" while nothing is known of it."""
        taken, then = self.n - self._first, f", then {self._left} more" if self._left > 0 else ""
        if self._size <= 1 or taken < 1:
            return f"{self._left} phases follow" if self._left > 0 else ""
        seconds = (time.monotonic() - self._began) / taken * max(0, self._size - taken)
        return f"{spoken(seconds)} left in this phase{then}"

    def move(self, n: int) -> None:
        """To a number of steps: a phase may take fewer than its size."""
        self.n = self._bar.n = n
        self._bar.refresh()

    def say(self, line: str) -> None:
        """A line above the bar."""
        if self.shown:
            self._bar.write(line)

    def close(self) -> None:
        """The bar stays where it is."""
        self._bar.close()
        if self._state is not None:
            with suppress(OSError):
                self._state.unlink(missing_ok=True)


def spoken(seconds: float) -> str:
    """A duration for people.

    Example:
        >>> spoken(42), spoken(200), spoken(8000)
        ('42 s', '4 min', '2 h 14 min')
    """
    if seconds < 60:
        return f"{math.ceil(seconds)} s"
    minutes = math.ceil(seconds / 60)
    return f"{minutes} min" if minutes < 60 else f"{minutes // 60} h {minutes % 60} min"


def round_line(check: Any, episodes: int) -> str:
    """What the held-out checks of a round found, as a sentence.

    Example:
        >>> from types import SimpleNamespace
        >>> found = dict(round=0, size=0.62, left=1, touched=0, returned=0.98, passed=True, reason="", covered=0.0, started=3912)
        >>> round_line(SimpleNamespace(**found), 4000)
        'round 1: the safe set covers 62 % of the space outside U; of 3,912 held-out episodes 1 left it, 0 entered U; 98 % of the starts in U came back: kept'
    """
    head = f"round {check.round + 1}: "
    if not check.size:
        return f"{head}no safe set that passes was found ({check.reason or 'it is empty'})"
    started = getattr(check, "started", 0)  # logs of earlier versions do not say
    counts = f"of {f'{started:,}' if started else f'up to {episodes:,}'} held-out episodes {check.left:,} left it, {check.touched:,} entered U"
    proof = f"; the proof covers {100 * check.covered:.3g} % of them" if check.covered else ""
    verdict = "kept" if check.passed else f"not kept, because of: {check.reason}"
    back = f"{100 * check.returned:.3g} % of the starts in U came back"
    return f"{head}the safe set covers {100 * check.size:.3g} % of the space outside U; {counts}{proof}; {back}: {verdict}"


__all__ = ["PROGRESS_FILE", "WORDS", "Progress", "round_line", "spoken"]
