"""Kills or interrupts a training at random moments of all its phases, resumes it, and compares it with one that nobody touched.

Run: python benchmarks/resume.py env=pendulum [kills=20] [signal=KILL] [runs=1] [kill_seed=0] [folder=runs/resume] [fast=true] [key=value ...]

`signal=INT` and `signal=TERM` have to end it with code 130 or 143, no traceback, and one line that says where the state is.
The kills are spread over `runs` trainings, each compared at its end, bit for bit: weights, log, held-out checks and budget.
Every phase is struck once before one is struck twice. `key=value` go to the training, which is that of `preset=smoke`;
`fast=false kills=0` tells how far checkpoints lie apart with the settings that a run has by default.
Exits with 1 if anything differs.
"""

from __future__ import annotations

import itertools
import json
import os
import random
import re
import shutil
import signal
import subprocess
import sys
import threading
import time
from dataclasses import dataclass, field
from pathlib import Path

FAST = [
    "preset=smoke", "logger=none", "trainer.progress=true", "trainer.checkpoint_seconds=0.2", "env.image_size=64",
    "evaluation.episodes=4", "evaluation.horizon=2", "evaluation.renderer_episodes=0", "evaluation.walks=0",
    "evaluation.certificate_episodes=0", "evaluation.certificate_seconds=1",
]  # fmt: skip
BAR = re.compile(r"(?P<phase>[a-z][\w :]*?) +\d+%\|[^|]*\| *(?P<step>\d+)/\d+ steps")  # one bar: the steps are those of all phases


@dataclass
class Seen:
    """What the progress bar of a training has shown.

    Attributes:
        times: when each step of each phase was first seen, in s since the start.
        resumed: whether it began at a checkpoint.
        text: all of it.
    """

    times: dict[tuple[str, int], float] = field(default_factory=dict)
    resumed: bool = False
    text: str = ""

    @property
    def phases(self) -> list[str]:
        """In the order in which they came."""
        return list(dict.fromkeys(phase for phase, _ in self.times))

    @property
    def now(self) -> tuple[str, int]:
        """Phase and step."""
        return next(reversed(self.times), ("start", 0))


class Training:
    """A training in a process of its own, its progress bar watched."""

    def __init__(self, words: list[str], folder: Path) -> None:
        environment = os.environ | {"TQDM_MININTERVAL": "0.02", "PYTHONUNBUFFERED": "1", "PYTHONWARNINGS": "ignore"}
        command = [sys.executable, "-m", "torchrl_sspl", "train", *words, f"out_dir={folder}"]
        self.began, self.seen = time.monotonic(), Seen()
        self.process = subprocess.Popen(
            command, stdout=subprocess.DEVNULL, stderr=subprocess.PIPE, env=environment,
            preexec_fn=lambda: signal.signal(signal.SIGINT, signal.SIG_DFL),  # in the background of a shell it is ignored
        )  # fmt: skip
        self.saved = [time.time()]  # when it began, and when each checkpoint or result was written
        self._reader = threading.Thread(target=self._read, daemon=True)
        self._reader.start()
        threading.Thread(target=self._watch, args=(folder,), daemon=True).start()

    def _read(self) -> None:
        assert self.process.stderr is not None
        while part := os.read(self.process.stderr.fileno(), 65536).decode(errors="replace"):
            self.seen.text = (self.seen.text + part)[-200_000:]
            self.seen.resumed |= "resumed" in part
            for found in BAR.finditer(part):
                self.seen.times.setdefault((found["phase"], int(found["step"])), time.monotonic() - self.began)

    def _watch(self, folder: Path) -> None:
        while self.process.poll() is None:
            kept = [*folder.glob("checkpoints/*"), *folder.glob("unfinished/**/*.pt")]
            found = [at for at in (_written(path) for path in kept) if at > self.saved[-1]]
            self.saved += sorted(found)[-1:]
            time.sleep(0.1)

    @property
    def at_risk(self) -> float:
        """Longest time in which nothing was written, from the beginning to the end of the process, in s: what a kill can cost."""
        return max((b - a for a, b in itertools.pairwise(self.saved)), default=float("nan"))

    def finish(self) -> Seen:
        """Wait for its end."""
        code = self.process.wait()
        self.saved.append(time.time())
        self._reader.join()
        if code:
            raise SystemExit(f"the training ended with code {code}:\n{self.seen.text[-3000:]}")
        return self.seen

    def kill_at(self, phases: list[str], phase: str, step: int, delay: float, number: signal.Signals) -> bool:
        """Send it a signal a while after a step of a phase is reached; whether it was still running."""
        place = phases.index(phase), step
        while self.process.poll() is None:
            at, k = self.seen.now
            if at in phases and (phases.index(at), k) >= place:
                time.sleep(delay)
                break
            time.sleep(0.002)
        running = self.process.poll() is None
        if running:
            os.kill(self.process.pid, number)
        self.process.wait()
        self._reader.join()
        return running

    def wrong(self, number: signal.Signals, folder: Path) -> str:
        """What is wrong with its end by a signal; SIGKILL cannot be answered."""
        if number == signal.SIGKILL:
            return ""
        said = re.findall(r"^interrupted by .*$", self.seen.text, re.MULTILINE)
        if self.process.returncode == 128 + number and "Traceback" not in self.seen.text and len(said) == 1 and str(folder) in said[0]:
            return ""
        return f"; WRONG END: code {self.process.returncode}, said {said}, then {self.seen.text[-1500:]!r}"


def _written(path: Path) -> float:
    """When a file was; 0 if it is gone already."""
    try:
        return path.stat().st_mtime
    except FileNotFoundError:
        return 0.0


def moments(seen: Seen, kills: int, draw: random.Random) -> list[tuple[str, int, float]]:
    """Phase, step and delay of every kill, in order: every phase once before one has two, uniform in the time of each."""
    phases = seen.phases
    chosen: list[str] = []
    while len(chosen) < kills:
        chosen += draw.sample(phases, min(len(phases), kills - len(chosen)))
    found = []
    for phase in chosen:
        steps = [(k, t) for (name, k), t in seen.times.items() if name == phase]
        rest = [t for (name, _), t in seen.times.items() if phases.index(name) > phases.index(phase)]
        first, last = steps[0][1], min(rest, default=steps[-1][1])
        at = draw.uniform(first, last)
        step, since = max((s for s in steps if s[1] <= at), key=lambda s: s[1])
        found.append((phase, step, at - since))
    return sorted(found, key=lambda moment: (phases.index(moment[0]), moment[1], moment[2]))


def differences(one: Path, other: Path) -> list[str]:
    """In what two finished runs differ."""
    found = [name for name in ("agent/agent.safetensors", "log.jsonl") if (one / name).read_bytes() != (other / name).read_bytes()]
    bodies = [json.loads((folder / "metrics.json").read_text()) for folder in (one, other)]
    return found + [name for name in ("checks", "budget", "stop_reason") if bodies[0][name] != bodies[1][name]]


def main(words: list[str]) -> int:
    """Run it."""
    own = {"kills": "20", "signal": "KILL", "runs": "1", "kill_seed": "0", "folder": "runs/resume", "fast": "true"}
    for word in list(words):
        key, _, value = word.partition("=")
        if key in own:
            own[key] = value
            words.remove(word)
    number = signal.Signals[f"SIG{own['signal'].removeprefix('SIG')}"]
    folder, kills, runs, draw = Path(own["folder"]), int(own["kills"]), int(own["runs"]), random.Random(int(own["kill_seed"]))
    systems = [w for w in words if w.startswith("env=")]
    settings = [*systems, *(FAST if own["fast"] == "true" else []), *(w for w in words if w not in systems)]
    if folder.exists():
        shutil.rmtree(folder)
    untouched = Training(settings, folder / "whole")
    whole = untouched.finish()
    print(
        f"not interrupted: {len(whole.phases)} phases ({', '.join(whole.phases)}), {max(whole.times.values()):.0f} s, "
        f"at most {untouched.at_risk:.1f} s in which nothing was written", flush=True,
    )  # fmt: skip
    plan, equal, struck, bad = moments(whole, kills, draw), 0, 0, 0
    for run in range(runs):
        place, mine = folder / f"killed{run}", plan[run::runs]
        hit = 0
        for phase, step, delay in mine:
            training = Training(settings, place)
            running = training.kill_at(whole.phases, phase, step, delay, number)
            wrong = training.wrong(number, place) if running else ""
            hit, struck, bad = hit + running, struck + running, bad + bool(wrong)
            at, k = training.seen.now
            began = "resumed" if training.seen.resumed else "from the start"
            text = f"in {at}, step {k}, {began}{wrong}" if running else f"it had ended before {phase}, step {step}"
            print(f"{number.name} {struck:>2}: {text}" if running else f"no {number.name}: {text}", flush=True)
        seen = Training(settings, place).finish()
        found = differences(folder / "whole", place)
        equal += 0 if found else hit
        print(f"run {run}: finished ({'resumed' if seen.resumed else 'from the start'}); " + (
            f"DIFFERS in {', '.join(found)}" if found else "weights, log, checks and budget are those of the uninterrupted run, bit for bit"
        ), flush=True)  # fmt: skip
    print(f"{equal} of {kills} resumed to the same end, {struck - bad} of {kills} ended as they have to")
    return int(equal != kills or struck - bad != kills)


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
