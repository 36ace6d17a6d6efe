"""What is malformed costs a typed error, little time, and leaves no file: agents, calibrations, recordings, checkpoints, environments.

Words of the command line are in ``test_cli.py``, values of a configuration in ``configs/test_reader.py``, certificates in
``certification/test_malformed.py``.
"""

from __future__ import annotations

import gc
import json
import math
import shutil
import time
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

import gymnasium
import pytest
import torch
from safetensors.torch import load_file, save_file
from torchrl.data import Bounded, Categorical, Unbounded
from trainers.test_trainer import build

import torchrl_sspl as sspl
from torchrl_sspl.configs import compose
from torchrl_sspl.data import TransitionStore, collect_random
from torchrl_sspl.envs import DubinsEnv, PixelPendulumEnv
from torchrl_sspl.errors import SSPLError
from torchrl_sspl.experiments.run import Experiment
from torchrl_sspl.runtime import Calibration
from torchrl_sspl.runtime.monitor import SIGNALS
from torchrl_sspl.sets import Box
from torchrl_sspl.viz.live import watch

pytestmark = pytest.mark.filterwarnings("ignore::FutureWarning", "ignore::DeprecationWarning")
SHIPPED = Path(sspl.__file__).parent / "agents" / "pendulum"
SECONDS = 5.0


def contents(folder: Path) -> dict[str, bytes]:
    return {str(p.relative_to(folder)): p.read_bytes() if p.is_file() else b"" for p in folder.rglob("*")}


def refused(read: Callable[[], Any], folder: Path) -> None:
    before, began = contents(folder), time.process_time()
    with pytest.raises(SSPLError) as caught:
        read()
    assert time.process_time() - began < SECONDS
    assert 20 < len(str(caught.value)) < 1000
    assert contents(folder) == before


# ---------------------------------------------------------------------- files of an agent
def text(name: str, content: str | bytes) -> Callable[[Path], Any]:
    return lambda folder: (folder / name).write_bytes(content if isinstance(content, bytes) else content.encode())


def cut(name: str, share: float) -> Callable[[Path], Any]:
    return lambda folder: (folder / name).write_bytes((data := (folder / name).read_bytes())[: int(len(data) * share)])


def directory(name: str) -> Callable[[Path], Any]:
    return lambda folder: ((folder / name).unlink(), (folder / name).mkdir())


def entry(*keys: str, value: Any) -> Callable[[Path], None]:
    """Another value at a place in the description; ``...`` removes it."""

    def edit(folder: Path) -> None:
        body = at = json.loads((folder / "agent.json").read_text())
        for key in keys[:-1]:
            at = at[key]
        if value is ...:
            del at[keys[-1]]
        else:
            at[keys[-1]] = value
        (folder / "agent.json").write_text(json.dumps(body))

    return edit


def weights(file: str, change: Callable[[dict[str, torch.Tensor]], Any]) -> Callable[[Path], None]:
    def edit(folder: Path) -> None:
        state = load_file(folder / file)
        change(state)
        save_file(state, folder / file)

    return edit


AGENTS: dict[str, Callable[[Path], Any]] = {
    "description of bytes": text("agent.json", b"\xff\xfe\x00"),
    "description nested": text("agent.json", "[" * 100_000),
    "description a directory": directory("agent.json"),
    "description half": cut("agent.json", 0.5),
    "weights a directory": directory("agent.safetensors"),
    "weights half": cut("agent.safetensors", 0.5),
    "weights a header of exabytes": text("agent.safetensors", b"\xff" * 64),
    "weights a pickle": text("agent.safetensors", b"\x80\x04\x95\x10\x00\x00\x00\x00\x00\x00\x00\x8c\x02os\x94"),
    "bound text": entry("lipschitz_bound", value="large"),
    "bound a list": entry("lipschitz_bound", value=[2.0]),
    "bound null": entry("lipschitz_bound", value=None),
    "bound NaN": entry("lipschitz_bound", value=math.nan),
    "bound infinite": entry("lipschitz_bound", value=math.inf),
    "bound negative": entry("lipschitz_bound", value=-2.0),
    "bound zero": entry("lipschitz_bound", value=0.0),
    "error NaN": entry("tolerated_error", value=math.nan),
    "error negative": entry("tolerated_error", value=-0.1),
    "error text": entry("tolerated_error", value="0.1"),
    "error a flag": entry("tolerated_error", value=True),
    "networks a list": entry("networks", value=[]),
    "no policy": entry("networks", "policy", value=...),
    "encoder null": entry("networks", "encoder", value=None),
    "encoder text": entry("networks", "encoder", value="FrameEncoder"),
    "class a number": entry("networks", "policy", "class", value=3),
    "class a list": entry("networks", "policy", "class", value=["Policy"]),
    "class a function": entry("networks", "policy", "class", value="math:sqrt"),
    "class of a module that is none": entry("networks", "policy", "class", value="nowhere:Net"),
    "class without a name": entry("networks", "policy", "class", value="math:"),
    "arguments a list": entry("networks", "policy", "arguments", value=[1]),
    "latent_dim of the barrier text": entry("networks", "barrier", "latent_dim", value="3"),
    "latent_dim of the barrier a thousand million": entry("networks", "barrier", "latent_dim", value=10**9),
    "latent_dim of the barrier negative": entry("networks", "barrier", "latent_dim", value=-3),
    "hidden a number": entry("networks", "barrier", "hidden", value=96),
    "hidden of thousands of millions": entry("networks", "barrier", "hidden", value=[10**10, 10**10]),
    "hidden empty": entry("networks", "barrier", "hidden", value=[]),
    "a key too many": entry("networks", "barrier", "depth", value=3),
    "weights integers": weights("agent.safetensors", lambda s: s.update({k: v.int() for k, v in s.items()})),
    "gain of another size": weights("agent.safetensors", lambda s: s.update(gain=torch.eye(5))),
    "gain NaN": weights("agent.safetensors", lambda s: s.update(gain=torch.full((3, 3), math.nan))),
}  # fmt: skip


@pytest.fixture
def agent(tmp_path):
    return shutil.copytree(SHIPPED, tmp_path / "agent")


@pytest.mark.parametrize("name", AGENTS)
def test_a_malformed_agent(name, agent, tmp_path):
    AGENTS[name](agent)
    refused(lambda: sspl.load(agent), tmp_path)


def about(**change: Any) -> Callable[[Path], None]:
    """Other metadata of a calibration; ``...`` removes an entry."""

    def edit(folder: Path) -> None:
        from safetensors import safe_open

        with safe_open(folder / "monitor.safetensors", "pt") as file:
            known = dict(file.metadata())
        state = load_file(folder / "monitor.safetensors")
        known |= {k: json.dumps(v) for k, v in change.items() if v is not ...}
        save_file(state, folder / "monitor.safetensors", {k: v for k, v in known.items() if change.get(k) is not ...})

    return edit


CALIBRATIONS: dict[str, Callable[[Path], Any]] = {
    "half": cut("monitor.safetensors", 0.5),
    "a directory": directory("monitor.safetensors"),
    "without metadata": weights("monitor.safetensors", lambda s: None),
    "without limits": about(limits=...),
    "limits a list": about(limits=[1, 2]),
    "limits of one number": about(limits={"still": 1.0}),
    "limits of text": about(limits={"still": ["low", "high"]}),
    "limits of other signals": about(limits={"smell": [0.0, 1.0]}),
    "limits NaN": about(limits={name: [math.nan, math.nan] for name in SIGNALS}),
    "episodes text": about(episodes="many"),
    "episodes negative": about(episodes=-1),
    "of other weights": about(weights="0" * 64),
    "of another size": weights("monitor.safetensors", lambda s: s.update({k: v[:1].clone() for k, v in s.items()})),
}  # fmt: skip


@pytest.mark.parametrize("name", CALIBRATIONS)
def test_a_malformed_calibration(name, agent, tmp_path):
    CALIBRATIONS[name](agent)
    known = sspl.load("pendulum")
    refused(lambda: Calibration.load(agent, known), tmp_path)


# ---------------------------------------------------------------------- recordings
@pytest.fixture(scope="module")
def recorded(tmp_path_factory):
    folder = tmp_path_factory.mktemp("recorded")
    collect_random(PixelPendulumEnv(batch_size=[4], image_size=16, seed=0), 40, seed=0).dumps(folder)
    return folder


def meta(**change: Any) -> Callable[[Path], None]:
    def edit(folder: Path) -> None:
        from safetensors import safe_open

        with safe_open(folder / STORE, "pt") as file:
            known = json.loads(file.metadata()["store"])
        body = {k: v for k, v in (known | change).items() if v is not ...}
        save_file(load_file(folder / STORE), folder / STORE, {"store": json.dumps(body)})

    return edit


def columns(change: Callable[[dict[str, torch.Tensor]], Any]) -> Callable[[Path], None]:
    def edit(folder: Path) -> None:
        from safetensors import safe_open

        with safe_open(folder / STORE, "pt") as file:
            known = dict(file.metadata())
        state = load_file(folder / STORE)
        change(state)
        save_file({k: v.contiguous() for k, v in state.items()}, folder / STORE, known)

    return edit


STORE = "transitions.safetensors"
RECORDINGS: dict[str, Callable[[Path], Any]] = {
    "half": cut(STORE, 0.5),
    "empty": text(STORE, b""),
    "a directory": directory(STORE),
    "without metadata": lambda folder: save_file(load_file(folder / STORE), folder / STORE),
    "metadata no JSON": lambda folder: save_file(load_file(folder / STORE), folder / STORE, {"store": "{"}),
    "metadata a list": lambda folder: save_file(load_file(folder / STORE), folder / STORE, {"store": "[]"}),
    "without a capacity": meta(capacity=...),
    "capacity negative": meta(capacity=-1),
    "capacity zero": meta(capacity=0),
    "capacity text": meta(capacity="large"),
    "more than its capacity": meta(capacity=3),
    "length text": meta(len="40"),
    "length negative": meta(len=-40),
    "length of more than there is": meta(len=41),
    "length of less than there is": meta(len=39),
    "cursor text": meta(cursor="0"),
    "without frames": columns(lambda s: s.pop("frames")),
    "without actions": columns(lambda s: s.pop("action")),
    "without regions": columns(lambda s: s.pop("region")),
    "without triples": columns(lambda s: s.pop("triple")),
    "frames of floats": columns(lambda s: s.update(frames=s["frames"].float())),
    "frames without colours": columns(lambda s: s.update(frames=s["frames"][:, 0])),
    "triples beyond the frames": columns(lambda s: s.update(triple=s["triple"] + 10**6)),
    "triples negative": columns(lambda s: s.update(triple=s["triple"] - 10**6)),
    "triples of floats": columns(lambda s: s.update(triple=s["triple"].float())),
    "actions that are not finite": columns(lambda s: s["action"].fill_(math.nan)),
    "regions of no set": columns(lambda s: s.update(region=s["region"] * 0 + 9)),
    "columns of different lengths": columns(lambda s: s.update(action=s["action"][:7])),
}  # fmt: skip


@pytest.mark.parametrize("name", RECORDINGS)
def test_a_malformed_recording(name, recorded, tmp_path):
    folder = shutil.copytree(recorded, tmp_path / "recorded")
    RECORDINGS[name](folder)
    refused(lambda: TransitionStore.from_folder(folder), tmp_path)


FILMS: dict[str, bytes] = {"empty": b"", "text": b"no film", "zeros": bytes(10_000), "a header alone": b"\x00\x00\x00\x20ftypisom" + bytes(20)}


@pytest.mark.filterwarnings("ignore::ResourceWarning", "ignore::pytest.PytestUnraisableExceptionWarning")  # pipes of imageio-ffmpeg
@pytest.mark.parametrize("name", FILMS)
def test_a_malformed_film(name, tmp_path):
    pytest.importorskip("imageio_ffmpeg")
    (tmp_path / "film.mp4").write_bytes(FILMS[name])
    refused(lambda: watch("pendulum", video=tmp_path / "film.mp4", port=0, steps=1), tmp_path)
    gc.collect()


# ---------------------------------------------------------------------- checkpoints
@pytest.fixture(scope="module")
def checkpoints(tmp_path_factory):
    folder = tmp_path_factory.mktemp("checkpoints")
    build(folder, batches=2).train()
    return folder


DAMAGES: dict[str, Callable[[Path], Any]] = {
    "half": lambda path: path.write_bytes(path.read_bytes()[: path.stat().st_size // 2]),
    "empty": lambda path: path.write_bytes(b""),
    "of bytes": lambda path: path.write_bytes(b"\x00\xff" * 50),
    "gone": lambda path: path.unlink(),
    "a list": lambda path: path.write_text("[]"),
}
PARTS = (
    "*-loss_module/state/tensor_00000023.memmap", "*-loss_module/state/meta.json", "*-loss_module/state.json",
    "*optimization_stepper/state/tensor_00000001.memmap", "*-replay_buffer/storage/transitions.safetensors",
    "*-replay_buffer/writer/metadata.json", "*-rng/state/tensor_00000000.memmap",
)  # fmt: skip


@pytest.mark.parametrize("damage", DAMAGES)
@pytest.mark.parametrize("part", PARTS)
def test_a_malformed_checkpoint(part, damage, checkpoints, tmp_path):
    folder = shutil.copytree(checkpoints, tmp_path / "checkpoints")
    (file,) = folder.glob(f"*/components/{part}")
    DAMAGES[damage](file)
    trainer = build(folder, batches=2)
    try:
        refused(trainer.resume, tmp_path)
    finally:
        trainer.collector.shutdown()


# ---------------------------------------------------------------------- environments
def factory(**change: Any) -> Callable[..., Any]:
    """Makes pendulums whose class has other attributes or methods."""
    return lambda batch_size, seed: type("Changed", (PixelPendulumEnv,), change)(batch_size=batch_size, image_size=16, seed=seed)


def reset(**change: Callable[[torch.Tensor], Any]) -> Callable[..., Any]:
    """What a reset shows, changed."""

    def changed(self: Any, *args: Any, **options: Any) -> Any:
        out = PixelPendulumEnv._reset(self, *args, **options)
        for key, made in change.items():
            out[key] = made(out[key])
        return out

    return factory(_reset=changed)


def acting(spec: Any) -> Callable[..., Any]:
    def make(batch_size: list[int], seed: int) -> Any:
        env = PixelPendulumEnv(batch_size=batch_size, image_size=16, seed=seed)
        env.action_spec = spec(batch_size)
        return env

    return make


def without(key: str) -> Callable[..., Any]:
    def make(batch_size: list[int], seed: int) -> Any:
        env = PixelPendulumEnv(batch_size=batch_size, image_size=16, seed=seed)
        del env.observation_spec[key]
        return env

    return make


MAKERS: dict[str, Any] = {
    "none": lambda batch_size, seed: None,
    "a number": 3,
    "without arguments": lambda: None,
    "an environment of gymnasium": lambda batch_size, seed: gymnasium.make("CartPole-v1"),
    "without pictures": without("pixels"),
    "without labels": without("region"),
    "of another size": lambda batch_size, seed: PixelPendulumEnv(batch_size=[3], image_size=16, seed=seed),
    "actions without bounds": acting(lambda n: Unbounded(shape=(*n, 1))),
    "actions infinite": acting(lambda n: Bounded(-math.inf, math.inf, shape=(*n, 1))),
    "actions that are choices": acting(lambda n: Categorical(3, shape=(*n,))),
    "actions without room": acting(lambda n: Bounded(1.0, 1.0, shape=(*n, 1))),
    "pictures of floats": reset(pixels=lambda x: x.float() / 255),
    "pictures of one frame": reset(pixels=lambda x: x[:, :3]),
    "pictures flat": reset(pixels=lambda x: x.flatten(1)),
}  # fmt: skip


@pytest.mark.parametrize("name", MAKERS)
def test_a_malformed_environment(name, tmp_path):
    config = compose(["preset=smoke", "network.pool_to=8", "trainer.progress=false", "logger=none", f"out_dir={tmp_path / 'run'}"])
    refused(lambda: Experiment(config, MAKERS[name]), tmp_path)


SYSTEMS: dict[str, Callable[[], Any]] = {
    **{f"pendulum {k}={v!r}": partial(PixelPendulumEnv, **{k: v}) for k, v in (
        ("batch_size", [0]), ("batch_size", [-1]), ("image_size", 0), ("image_size", -8), ("integrator", "exact"),
        ("max_torque", math.nan), ("mass", 0.0), ("length", -1.0), ("dt", math.inf), ("horizon", 0), ("horizon", -1),
    )},
    "pendulum S of three coordinates": partial(PixelPendulumEnv, safe_set=Box([-1.0] * 3, [1.0] * 3)),
    "pendulum S and U the same": partial(PixelPendulumEnv, safe_set=Box([-1.0, -1.0], [1.0, 1.0]), unsafe_set=Box([-1.0, -1.0], [1.0, 1.0])),
    **{f"car {k}={v!r}": partial(DubinsEnv, **{k: v}) for k, v in (
        ("speed", math.nan), ("dt", 0.0), ("image_size", 0), ("max_yaw_rate", -2.0), ("unsafe_half_size", 9.0), ("obstacle_shape", "star"),
    )},
    "box without room": lambda: Box([1.0, 0.0], [0.0, 1.0]),
    "box of different lengths": lambda: Box([0.0], [1.0, 1.0]),
    "box NaN": lambda: Box([math.nan], [1.0]),
}  # fmt: skip


@pytest.mark.parametrize("name", SYSTEMS)
def test_a_malformed_system(name, tmp_path):
    refused(SYSTEMS[name], tmp_path)


def test_there_are_enough_of_them():
    counts = {"agents": AGENTS, "calibrations": CALIBRATIONS, "recordings": RECORDINGS, "films": FILMS, "environments": MAKERS, "systems": SYSTEMS}
    assert sum(map(len, counts.values())) + len(PARTS) * len(DAMAGES) >= 150
