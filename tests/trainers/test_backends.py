"""Collectors here, in other processes and on Ray: same batches, new weights arrive, same training result."""

from __future__ import annotations

import functools
import json
import os
import sys
from pathlib import Path

import pytest
import torch
from tensordict import TensorDict
from tensordict.nn import TensorDictModule

from torchrl_sspl.configs import compose
from torchrl_sspl.data.collect import make_collector
from torchrl_sspl.envs import PendulumEnv
from torchrl_sspl.errors import ConfigError, MissingDependencyError
from torchrl_sspl.experiments.run import Experiment

pytestmark = [
    pytest.mark.filterwarnings("ignore::FutureWarning", "ignore::DeprecationWarning", "ignore::ResourceWarning"),
    # Ray and torch's processes close pipes in their own time.
    pytest.mark.filterwarnings("ignore::pytest.PytestUnraisableExceptionWarning"),
    pytest.mark.filterwarnings("ignore::UserWarning"),
]
OTHERS = [pytest.param("process", marks=pytest.mark.slow), pytest.param("ray", marks=[pytest.mark.ray, pytest.mark.slow])]
make = functools.partial(PendulumEnv, batch_size=[4], image_size=16)


class Constant(torch.nn.Module):
    def __init__(self) -> None:
        super().__init__()
        self.value = torch.nn.Parameter(torch.zeros(1))

    def forward(self, pixels: torch.Tensor) -> torch.Tensor:
        return self.value.expand(*pixels.shape[:-3], 1)


@pytest.fixture(autouse=True)
def quick_ray(request, monkeypatch):
    """Ray gives its workers a low priority, which on a busy machine is for ever."""
    if "ray" not in request.node.name:
        yield
        return
    ray = pytest.importorskip("ray", reason="needs the extra ray")
    monkeypatch.setenv("RAY_worker_niceness", "0")
    monkeypatch.setenv("PYTHONPATH", os.pathsep.join([str(Path(__file__).parent), *sys.path]))
    yield
    ray.shutdown()


def batches(backend: str, workers: int) -> list[TensorDict]:
    policy = TensorDictModule(Constant(), in_keys=["pixels"], out_keys=["action"])
    collector = make_collector(
        make, policy, backend=backend, workers=workers, frames_per_batch=32, total_frames=96, init_random_frames=32, seed=0
    )
    seen = []
    try:
        for batch in collector:
            seen.append(batch.clone())
            with torch.no_grad():
                policy.module.value.fill_(float(len(seen)))
            collector.update_policy_weights_(TensorDict.from_module(policy).data)
    finally:
        collector.shutdown()
    return seen


def check(seen: list[TensorDict]) -> None:
    assert [batch.numel() for batch in seen] == [32, 32, 32]
    assert seen[0]["action"].std() > 1.0  # random at first
    assert set(seen[1]["action"].flatten().tolist()) == {1.0}
    assert set(seen[2]["action"].flatten().tolist()) == {2.0}
    for batch in seen:
        flat = batch.reshape(-1, batch.shape[-1])  # time is last
        goes_on = ~flat["next", "done"][:, :-1, 0]
        assert goes_on.float().mean() > 0.5
        assert torch.equal(flat["next", "pixels"][:, :-1][goes_on], flat["pixels"][:, 1:][goes_on])
    starts = torch.cat([batch["state"][..., 0, :].reshape(-1, 2) for batch in seen])
    assert len(starts.unique(dim=0)) == len(starts), "workers, or batches, start in the same states"


def test_batches_and_weights_in_this_process():
    check(batches("sync", 1))


@pytest.mark.parametrize("backend", OTHERS)
def test_batches_and_weights_from_two_workers(backend):
    check(batches(backend, 2))


RUN = [
    "env=pendulum", "trainer.total_frames=3200", "trainer.optim_steps_per_batch=128", "trainer.warm_start_steps=128",
    "trainer.progress=false", "trainer.checkpoint_seconds=-1", "collector.frames_per_batch=640", "collector.envs=16",
    "collector.init_random_frames=640", "collector.max_frames_per_traj=10", "collector.random_share=0.5",
    "collector.starts=[1,0,0,0]", "env.image_size=16", "network.pool_to=16", "network.latent_dim=2", "buffer.batch=96",
    "optim.lr=3e-3", "logger=none", "evaluation.episodes=200", "evaluation.horizon=8", "evaluation.grid=41",
    "evaluation.kernel_grid=41", "evaluation.renderer_episodes=0", "evaluation.certificate_episodes=0",
    "evaluation.certificate_seconds=1",
    "optim.schedule=constant", "synthesis.enabled=false",  # the joint training is compared
]  # fmt: skip


def trained(folder: Path, backend: str, workers: int, seed: int = 0) -> dict[str, float]:
    words = [f"collector.backend={backend}", f"collector.workers={workers}", f"out_dir={folder}", f"seed={seed}"]
    experiment = Experiment(compose([*RUN, *words]))
    experiment.run()
    found = json.loads((folder / "metrics.json").read_text())["measurements"]
    rows = [json.loads(line) for line in (folder / "log.jsonl").read_text().splitlines()]
    rows = [row for row in rows if row["phase"] == "joint"]
    result = {k: sum(row[k] for row in rows[-2:]) / 2 for k in ("loss_consistency", "dynamics_error")}
    labels = [row["loss_safe"] + row["loss_unsafe"] for row in rows]
    result |= {"labels": labels[-1], "labels_first": labels[0]}
    return result | {"unsafe": found["unsafe_called_safe"]["value"], "frames": experiment.trainer.collected_frames}


@pytest.mark.slow
@pytest.mark.parametrize("backend", ["process", pytest.param("ray", marks=pytest.mark.ray)])
def test_two_workers_train_as_one_process_does(backend, tmp_path):
    # The spread of three seeds of one process is the yardstick: another number of workers sees other episodes.
    alone = [trained(tmp_path / f"alone{seed}", "sync", 1, seed) for seed in range(3)]
    other = trained(tmp_path / backend, backend, 2)
    assert other["frames"] == alone[0]["frames"] == 3200
    for name in ("loss_consistency", "dynamics_error", "labels", "unsafe"):
        values = torch.tensor([run[name] for run in alone])
        # Student's t with two degrees of freedom: 99 % of a further value of the same distribution lie within.
        radius = 9.92 * float(values.std()) * (1 + 1 / 3) ** 0.5
        assert abs(other[name] - float(values.mean())) <= radius, (name, other[name], values.tolist())
    assert other["labels"] < 0.3 * other["labels_first"]  # and something was learned


def test_what_does_not_go_together_is_refused(monkeypatch):
    policy = TensorDictModule(Constant(), in_keys=["pixels"], out_keys=["action"])
    sizes = {"frames_per_batch": 32, "total_frames": 32}
    with pytest.raises(ConfigError, match="one of sync, process, ray, received 'threads'"):
        make_collector(make, policy, backend="threads", **sizes)
    with pytest.raises(ConfigError, match="expected 1 with backend 'sync'"):
        make_collector(make, policy, workers=2, **sizes)
    with pytest.raises(ConfigError, match="multiple of the 3 workers"):
        make_collector(make, policy, backend="process", workers=3, **sizes)
    monkeypatch.setitem(sys.modules, "ray", None)
    with pytest.raises(MissingDependencyError, match=r"torchrl-sspl\[ray\]"):
        make_collector(make, policy, backend="ray", workers=2, **sizes)
