"""Many runs of one command: every combination of the values that are given, each in a process and a directory of its own.

On Ray a run is one task of Ray core, which is all it needs: a run writes its own results and takes itself up again
where it was interrupted, so Ray Tune's searchers, stopping rules, checkpoints and result files would be a second set of
what is there.
"""

from __future__ import annotations

import itertools
import json
import os
import re
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, suppress
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

from torchrl_sspl.configs.reader import EnvFactory, compose, parse
from torchrl_sspl.configs.schema import Config
from torchrl_sspl.errors import ConfigError, MissingDependencyError, OutputError
from torchrl_sspl.evaluation.outcome import without_paths
from torchrl_sspl.files import write
from torchrl_sspl.viz.compare import Row, Run, compare, read_metrics, rows_of, text_table

LAUNCHERS = ("local", "ray")
COMMAND = (sys.executable, "-m", "torchrl_sspl", "train")
OUTPUT_FILE = "output.txt"
GRACE = 60.0  # seconds that an interrupted run has to save its state


@dataclass
class Task:
    """One run of a sweep."""

    name: str  # what tells it from the others, such as "seed=1,synthesis.margin=0.05"
    config: Config
    words: list[str]  # its command line, after ``sspl train``
    status: str = "waiting"  # or "done", "done before", "interrupted", "failed (exit code n)"
    seconds: float = 0.0  # wall clock

    @property
    def directory(self) -> Path:
        """Where it lies."""
        return Path(self.config.out_dir)

    @property
    def finished(self) -> bool:
        """Whether its directory holds the metrics of this very configuration."""
        try:
            before = json.loads((self.directory / "metrics.json").read_text())["config"]
        except (OSError, ValueError, KeyError, TypeError):
            return False
        mine = json.loads(json.dumps(_shown(self.config)))
        return all(before.get(k) == v for k, v in mine.items() if k != "out_dir")


def _shown(config: Config) -> Any:
    """A configuration as ``metrics.json`` has it."""
    return without_paths({"config": config.to_dict()})["config"]


@dataclass
class Sweep:
    """What a sweep did."""

    directory: Path  # where all runs lie, with ``sweep.json`` and ``comparison.html``
    tasks: list[Task]
    rows: list[Row] = field(default_factory=list)  # of the table over them
    page: Path | None = None  # of the comparison; None where no run came to an end
    signal: int = 0  # number of the signal that ended it

    @property
    def exit_code(self) -> int:
        """0, 1 where a run failed, or 128 and the number of the signal."""
        return 128 + self.signal if self.signal else int(any(t.status.startswith("failed") for t in self.tasks))

    def summary(self) -> str:
        """The table, and what failed."""
        lines = [text_table(self.rows)] if self.rows else []
        lines += [f"{t.name}: {t.status}; see {t.directory / OUTPUT_FILE}" for t in self.tasks if not t.status.startswith("done")]
        lines += ["interrupted; the same command goes on where it was"] if self.signal else []
        return "\n".join([*lines, *([f"comparison: {self.page}"] if self.page else [])])


def expand(overrides: Sequence[str]) -> list[tuple[str, dict[str, str]]]:
    """Name and values by key of every combination of values that commas separate outside of brackets and quotes.

    Raises ConfigError if a value is empty or given twice, or ``out_dir`` has several. Source: none.

    Example:
        >>> [name for name, _ in expand(["seed=0,1", "network.policy_hidden=[8,8]", "optim.lr=.1"])]
        ['seed=0', 'seed=1']
    """
    choices = {key: _split(value) for key, value in parse(overrides).items()}
    for key, values in choices.items():
        if len(values) > 1 and ("" in values or len({*values}) < len(values) or key == "out_dir"):
            raise ConfigError(f"expected different values for {key}, separated by commas, received '{','.join(values)}'"
                              + ("; each run gets a directory in it" if key == "out_dir" else ""))  # fmt: skip
    swept = [key for key, values in choices.items() if len(values) > 1]
    runs: list[tuple[str, dict[str, str]]] = []
    for number, combination in enumerate(itertools.product(*choices.values())):
        chosen = dict(zip(choices, combination, strict=True))
        name = re.sub(r"[^\w.,=\[\]+-]", "_", ",".join(f"{key}={chosen[key]}" for key in swept)) or "run"
        unique = len(name) < 200 and all(name != other for other, _ in runs)
        runs.append((name if unique else f"{name[:190]}_{number}", chosen))
    return runs


def _split(value: str) -> list[str]:
    parts, depth, quote = [""], 0, ""
    for c in value:
        quote = "" if c == quote else c if not quote and c in "'\"" else quote
        depth += 0 if quote else (c in "[{(") - (c in "]})")
        if c == "," and not depth and not quote:
            parts.append("")
        else:
            parts[-1] += c
    return [p.strip() for p in parts]


def plan(overrides: Sequence[str]) -> tuple[Path, list[Task]]:
    """Directory and runs of a sweep; every configuration is composed and checked, nothing is written.

    Raises ConfigError if one of the configurations is not valid. Source: none.
    """
    tasks: list[Task] = []
    folders = set()
    for name, chosen in expand(overrides):
        words = [f"{key}={value}" for key, value in chosen.items() if key != "out_dir"]
        config = compose(words, **({"out_dir": chosen["out_dir"]} if "out_dir" in chosen else {}))
        EnvFactory(config.env)  # raises where there is no such system
        folders.add(config.out_dir)
        tasks.append(Task(name, config, words))
    given = "out_dir" in parse(overrides)  # which may hold values of the runs, such as "/data/${seed}"
    directory = Path(os.path.commonpath(folders) if given or len(folders) == 1 else "runs/sweep")
    for task in tasks:
        task.config.out_dir = str((Path(task.config.out_dir) if given else directory) / task.name)
        task.words.append(f"out_dir={task.config.out_dir}")
    return directory, tasks


def sweep(
    overrides: Sequence[str], *, launcher: str = "local", jobs: int | None = None, command: Sequence[str] = COMMAND
) -> Sweep:
    """Train every combination, then compare.

    A run that fails does not stop the others. Runs that came to an end before are not run again, others go on where
    they were. SIGINT and SIGTERM are handed on to the runs, which save their state.

    Args:
        overrides: ``key=value`` strings, several values separated by commas: ``["seed=0,1,2",
            "synthesis.margin=.05,.1"]``.
        launcher: "local" (processes of this machine) or "ray" (tasks of a cluster whose machines share the folder; its
            address is ``collector.ray_address``).
        jobs: runs at a time; default: as many as there are cores, on Ray as many as it has room for.
        command: what is called with the words of each run.

    Returns what was done; ``sweep.json`` and ``comparison.html`` are on disk. Raises ConfigError if a configuration is
    not valid, before anything is started, OutputError if a directory cannot be made, and MissingDependencyError if Ray is
    asked for and not installed. Source: none.
    """
    if launcher not in LAUNCHERS:
        raise ConfigError(f"expected --launcher to be one of {', '.join(LAUNCHERS)}, received '{launcher}'")
    if jobs is not None and jobs < 1:
        raise ConfigError(f"expected --jobs >= 1, received {jobs}")
    directory, tasks = plan(overrides)
    cores = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
    jobs = jobs or (cores if launcher == "local" else len(tasks))
    start = _ray_starter(tasks[0].config.collector.ray_address) if launcher == "ray" else _Local
    out = Sweep(directory, tasks)
    for folder in (directory, *(task.directory for task in tasks)):
        _make(folder)
    _write(out, overrides)
    with _signals() as received:
        out.signal = _work(tasks, lambda task: start([*command, *task.words], task.directory), jobs, received)
    done = [t.status.startswith("done") for t in tasks]
    metrics = [read_metrics(t.directory) if ok else {"config": _shown(t.config)} for t, ok in zip(tasks, done, strict=True)]
    runs = [Run(t.name, t.directory, body) for t, body in zip(tasks, metrics, strict=True)]
    if any(run.finished for run in runs):
        out.rows = rows_of(runs)
        out.page = compare(runs, directory / "comparison.html", title=f"{directory.name}: {len(runs)} runs")
    _write(out, overrides)
    return out


def _make(directory: Path) -> None:
    try:
        directory.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise OutputError(
            f"expected a directory to write to, received '{directory}': {error.strerror or type(error).__name__}; choose another out_dir"
        ) from error


def _write(out: Sweep, overrides: Sequence[str]) -> None:
    from torchrl_sspl import __version__

    runs = [{"name": t.name, "overrides": t.words[:-1], "status": t.status, "seconds": round(t.seconds, 1)} for t in out.tasks]
    body = {"schema": 1, "version": __version__, "overrides": list(overrides), "runs": runs, "table": [asdict(r) for r in out.rows]}
    write(out.directory / "sweep.json", json.dumps(body, indent=1) + "\n")


def _work(tasks: Sequence[Task], start: Callable[[Task], Any], jobs: int, received: list[int]) -> int:
    """Run what is not finished, some at a time; the signal that ended it, or 0."""
    for task in tasks:
        task.status = "done before" if task.finished else "waiting"
    waiting = [t for t in tasks if t.status == "waiting"]
    running: list[tuple[Task, Any, float]] = []
    try:
        while (waiting or running) and not received:
            while waiting and len(running) < jobs:
                task = waiting.pop(0)
                running.append((task, start(task), time.time()))
            running = [one for one in running if not _ended(*one)]
            time.sleep(0.1)
        for _, process, _ in running:
            process.stop(received[0])
        end = time.time() + GRACE
        while running and time.time() < end and len(received) < 2:  # a second signal ends the patience
            running = [one for one in running if not _ended(*one, stopped=True)]
            time.sleep(0.1)
    finally:
        for task, process, _ in running:
            process.kill()
            task.status = "interrupted"
    return received[0] if received else 0


def _ended(task: Task, process: Any, begin: float, stopped: bool = False) -> bool:
    code = process.poll()
    if code is None:
        return False
    task.seconds = time.time() - begin
    task.status = "done" if code == 0 else "interrupted" if stopped else f"failed (exit code {code})"
    print(f"{task.name}: {task.status}, {task.seconds:.0f} s", flush=True)
    return True


@contextmanager
def _signals() -> Iterator[list[int]]:
    """Numbers of the signals that arrive, in place of what they would do."""
    received: list[int] = []
    numbers = (signal.SIGINT, signal.SIGTERM) if threading.current_thread() is threading.main_thread() else ()
    before = {n: signal.signal(n, lambda number, _: received.append(number)) for n in numbers}
    try:
        yield received
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)


class _Local:
    """A run as a process of this machine, on one thread, with what it prints in a file."""

    def __init__(self, command: Sequence[str], directory: str | Path) -> None:
        Path(directory).mkdir(parents=True, exist_ok=True)
        quiet = {"OMP_NUM_THREADS": "1", "TQDM_MININTERVAL": "60", "PYTHONUNBUFFERED": "1"}
        with (Path(directory) / OUTPUT_FILE).open("a") as file:
            self.process = subprocess.Popen(
                list(command), stdin=subprocess.DEVNULL, stdout=file, stderr=subprocess.STDOUT,
                env={**os.environ, **quiet}, start_new_session=True,
            )  # fmt: skip

    def poll(self) -> int | None:
        return self.process.poll()

    def stop(self, number: int) -> None:
        with suppress(ProcessLookupError):
            self.process.send_signal(number)

    def kill(self) -> None:
        with suppress(ProcessLookupError, PermissionError):
            os.killpg(self.process.pid, signal.SIGKILL)
        self.process.wait()


def _ray_starter(address: str) -> Callable[[Sequence[str], Path], Any]:
    try:
        import ray
    except ImportError as error:
        raise MissingDependencyError("expected Ray, found none; run `pip install 'torchrl-sspl[ray]'`, or --launcher local") from error
    try:
        if not ray.is_initialized():
            ray.init(address=address or None, log_to_driver=False, include_dashboard=False)
    except Exception as error:  # Ray raises all kinds, plain Exception among them
        raise ConfigError(
            f"expected a Ray cluster at collector.ray_address='{address}' ('' starts one here), received {type(error).__name__}: {error}"
        ) from error
    remote = ray.remote(num_cpus=1, max_retries=0)(_until_end)

    class OnRay:
        def __init__(self, command: Sequence[str], directory: Path) -> None:
            self.task = remote.remote(list(command), str(directory.resolve()), os.getcwd())

        def poll(self) -> int | None:
            if not ray.wait([self.task], timeout=0)[0]:
                return None
            try:
                return int(ray.get(self.task))
            except ray.exceptions.RayError:
                return 1

        def stop(self, number: int) -> None:
            ray.cancel(self.task)

        def kill(self) -> None:
            ray.cancel(self.task, force=True)

    return OnRay


def _until_end(command: list[str], directory: str, folder: str) -> int:
    """A run on whatever machine: its exit code; cancelled, it is interrupted as by SIGINT."""
    os.chdir(folder)
    signal.signal(signal.SIGINT, signal.default_int_handler)  # Ray's workers block it, and so would what they start
    signal.pthread_sigmask(signal.SIG_UNBLOCK, [signal.SIGINT])
    process = _Local(command, directory)
    try:
        while (code := process.poll()) is None:  # Ray cannot interrupt a long wait
            time.sleep(0.1)
        return code
    except BaseException:
        process.stop(signal.SIGINT)
        try:
            process.process.wait(GRACE)
        finally:
            process.kill()
        raise


__all__ = ["LAUNCHERS", "Sweep", "Task", "expand", "plan", "sweep"]
