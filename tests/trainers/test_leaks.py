"""Long runs do not grow, and what a run has begun ends with it, after an exception too."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time
import uuid
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path

import pytest
from tiny import SAVED, TINY

import torchrl_sspl as sspl
from torchrl_sspl.configs.schema import EvaluationConfig
from torchrl_sspl.envs import DubinsEnv
from torchrl_sspl.errors import ConfigError
from torchrl_sspl.evaluation.physics import evaluate_physics
from torchrl_sspl.experiments.film import Film

pytestmark = pytest.mark.skipif(not sys.platform.startswith("linux"), reason="reads /proc")

LEAKS = Path(__file__).parents[2] / "benchmarks" / "leaks.py"


@pytest.mark.slow
def test_memory_after_10_000_batches_is_that_after_1_000():
    done = subprocess.run([sys.executable, str(LEAKS), "10000"], capture_output=True, text=True)
    assert done.returncode == 0, done.stdout + done.stderr[-2000:]
    assert done.stdout.count("batches") == 2


RUN = """
import multiprocessing.util, os, signal, sys, warnings
warnings.simplefilter("ignore")
from torchrl_sspl.configs import compose
from torchrl_sspl.experiments.run import Experiment

def interrupt():
    if sys.argv[1] == "killed":
        os.kill(os.getpid(), signal.SIGKILL)
    if sys.argv[1] == "Control-C":
        os.killpg(0, signal.SIGINT)
    if sys.argv[1] == "an exception":
        raise RuntimeError("on purpose")

if __name__ == "__main__":
    experiment = Experiment(compose(sys.argv[2:]))
    print("sockets in", multiprocessing.util.get_temp_dir(), flush=True)
    experiment.trainer.register_op("post_steps", interrupt)
    if sys.argv[1] != "never begun":
        experiment.train()
"""


def named(mark: str) -> list[int]:
    """Processes that inherited a mark in their environment."""
    found = []
    for path in Path("/proc").glob("[0-9]*"):
        with suppress(OSError):  # it has just ended, or belongs to somebody else
            found += [int(path.name)] if mark.encode() in (path / "environ").read_bytes() else []
    return found


def worked(processes: list[int]) -> float:
    """Seconds that processes have had on a processor, all together."""
    ticks = 0
    for process in processes:
        with suppress(OSError):
            ticks += sum(map(int, Path(f"/proc/{process}/stat").read_text().rpartition(")")[2].split()[11:13]))
    return ticks / os.sysconf("SC_CLK_TCK")


def waited(processes: list[int]) -> dict[str, float]:
    """Seconds that each thread of processes has waited for a processor."""
    found = {}
    for process in processes:
        for path in Path(f"/proc/{process}/task").glob("*/schedstat"):
            with suppress(OSError):
                found[path.parent.name] = int(path.read_text().split()[1]) / 1e9
    return found


def ends(running: Callable[[], list[int]], patience: float = 60.0, least: float = 0.3, limit: float = 1800.0) -> bool:
    """Waits until nothing runs; False if all wait for nothing: that they do is told by their work, not by the clock.

    Beside other programs an exit of seconds takes minutes. Who only looks from time to time whether it may go on works less than
    ``least`` seconds in ``patience``, and seldom waits for a processor: whoever has work does so most of the time.
    """
    began = since = time.monotonic()
    names = running()
    work, before = worked(names), waited(names)
    while names:
        time.sleep(0.2)
        now, names, past = time.monotonic(), running(), names
        if names != past or worked(names) > work + least:
            since, work, before = now, worked(names), waited(names)
        if now - since > patience:
            if max((t - before.get(k, 0.0) for k, t in waited(names).items()), default=0.0) < patience / 2:
                return False
            since, work, before = now, worked(names), waited(names)
        if now - began > limit:
            return False
    return True


@pytest.mark.slow
@pytest.mark.parametrize("end", ["an exception", "never begun", "Control-C", "the end", "killed"])
def test_collector_processes_and_temporary_files_are_gone_with_the_run(tmp_path, end):
    # In a folder with so long a name no socket can be made: workers would lose the first batch, and the trainer wait for it.
    mark, folder, script = uuid.uuid4().hex, tmp_path / "temporary".ljust(80, "-"), tmp_path / "run.py"
    folder.mkdir()
    script.write_text(RUN)
    words = [*TINY, SAVED, "collector.backend=process", "collector.workers=2", "synthesis.enabled=false", f"out_dir={tmp_path / 'run'}"]
    environment = {**os.environ, "OMP_NUM_THREADS": "1", "MARK": mark, "TMPDIR": str(folder)}
    environment["TORCHINDUCTOR_CACHE_DIR"] = str(tmp_path / "kept")  # which is to stay
    # What it prints goes to a file: with a pipe one would wait for whoever has it still open.
    with (tmp_path / "said").open("w") as said:
        run = subprocess.Popen(
            [sys.executable, "-X", "faulthandler", str(script), end, *words], stdout=said, stderr=said, env=environment, start_new_session=True,
            preexec_fn=lambda: signal.signal(signal.SIGINT, signal.SIG_DFL),  # in the background of a shell it is ignored
        )  # fmt: skip
        ended = ends(lambda: [] if run.poll() is not None else sorted(named(mark))) and ends(lambda: sorted(named(mark)))
    left = named(mark)
    for process in left:
        os.kill(process, signal.SIGABRT)  # says where it hangs
    code, text = run.wait(), (tmp_path / "said").read_text()
    assert ended, text[-6000:]
    assert not left
    assert code == {"an exception": 1, "Control-C": 130, "killed": -9}.get(end, 0), text[-3000:]
    if end == "Control-C":
        assert (text.count("resumes from there"), "Traceback" in text) == (1, False), text[-3000:]
    assert end == "killed" or not list(folder.iterdir())
    assert end == "killed" or not Path(text.partition("sockets in ")[2].partition("\n")[0]).exists()


@pytest.mark.parametrize(("does", "ended"), [("time.sleep(0.5)", True), ("sum(range(3 * 10**7))", True), ("time.sleep(60)", False)])
def test_a_run_that_waits_for_nothing_is_told_from_a_slow_one(does, ended):
    run = subprocess.Popen([sys.executable, "-c", f"import time; {does}"])
    try:
        assert ends(lambda: [] if run.poll() is not None else [run.pid], patience=10.0 if ended else 3.0, least=0.02) == ended
    finally:
        run.kill()
        run.wait()


def test_a_run_that_gets_no_processor_does_not_hang(monkeypatch):
    monkeypatch.setattr("test_leaks.waited", lambda processes: dict.fromkeys(map(str, processes), time.monotonic()))
    run = subprocess.Popen([sys.executable, "-c", "import time; time.sleep(3)"])
    try:
        assert ends(lambda: [] if run.poll() is not None else [run.pid], patience=1.0)
    finally:
        run.kill()
        run.wait()


@pytest.mark.slow
@pytest.mark.pybullet
def test_simulators_end_with_what_began_them(tmp_path):
    pybullet = pytest.importorskip("pybullet")
    from torchrl_sspl.envs.quadruped.env import QuadrupedEnv

    def connected() -> int:
        return sum(pybullet.getConnectionInfo(k)["isConnected"] for k in range(64))

    def fail(pixels):
        raise RuntimeError("on purpose")

    before, env = connected(), DubinsEnv(seed=0)
    with pytest.raises(ConfigError):
        QuadrupedEnv(obstacle_shape="star")
    world = env.physics()()
    film = Film(sspl.load("quadruped"), env, world=world, seconds=0.3)
    shapes = [next(iter(take.pictures)).shape for take in film.scene(env.system.openings[0], seed=0).takes]
    assert len(shapes) == 2
    assert connected() == before + 1
    config = EvaluationConfig(walks=1, walk_seconds=0.2)
    evaluate_physics(film.agent, env, config)
    with pytest.raises(RuntimeError, match="on purpose"):
        evaluate_physics(fail, env, config)
    assert connected() == before + 1
    world.close()
    assert connected() == before
