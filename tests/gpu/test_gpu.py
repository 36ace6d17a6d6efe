"""On a GPU: the same numbers as on the CPU, training with all options, environments and evaluation on the device."""

from __future__ import annotations

import copy

import pytest
import torch
from tensordict import TensorDict
from tiny import TINY as SMOKE
from tiny import TINY_EXPERIMENT

from torchrl_sspl.data import TransitionStore, collect_random
from torchrl_sspl.envs import PendulumEnv
from torchrl_sspl.lipschitz import SandwichBarrier
from torchrl_sspl.modules import FrameEncoder, InverseDynamics, LatentDynamics, Policy
from torchrl_sspl.objectives import SSPLLoss
from torchrl_sspl.trainers.config import make_config
from torchrl_sspl.trainers.episodes import evaluate_episodes
from torchrl_sspl.trainers.experiment import Experiment
from torchrl_sspl.trainers.experiment_config import EnvFactory, EpisodesConfig, experiment_config
from torchrl_sspl.trainers.pipeline import SafePolicyTraining

pytestmark = [
    pytest.mark.gpu,
    pytest.mark.skipif(not torch.cuda.is_available(), reason="needs a CUDA device"),
    pytest.mark.filterwarnings("ignore::FutureWarning", "ignore::DeprecationWarning", "ignore::UserWarning"),
]
TINY = [
    "trainer.total_frames=512", "trainer.optim_steps_per_batch=4", "trainer.warm_start_steps=4", "trainer.progress=false",
    "trainer.checkpoint_every=-1", "collector.frames_per_batch=256", "collector.envs=64", "collector.init_random_frames=256",
    "buffer.batch=64", "env.image_size=32", "evaluation.episodes=8", "evaluation.envs=8", "evaluation.horizon=4",
    *TINY_EXPERIMENT,
]  # fmt: skip


def make_loss() -> SSPLLoss:
    torch.manual_seed(0)
    networks = (FrameEncoder(3), LatentDynamics(3, 1, (32,), 10.0), SandwichBarrier(3, (16,)), Policy(3, 1, (16,), 10.0))
    # Random numbers differ between devices: no term that draws any.
    return SSPLLoss(*networks, inverse_dynamics=InverseDynamics(3, 1, action_scale=10.0), off_manifold_coeff=0.0)


def make_batch(n: int = 64) -> TensorDict:
    g = torch.Generator().manual_seed(0)
    return TensorDict(
        frames=torch.randint(256, (n, 3, 3, 32, 32), dtype=torch.uint8, generator=g),
        action=torch.rand(n, 1, generator=g) * 20 - 10,
        region=torch.arange(n)[:, None] % 3,
        batch_size=n,
    )


def total(terms: TensorDict) -> torch.Tensor:
    return sum(value for key, value in terms.items() if key.startswith("loss_"))


def test_loss_and_gradients_are_those_of_the_cpu():
    here, data = make_loss(), make_batch()
    there = copy.deepcopy(here).cuda()
    first, second = here(data), there(data.cuda())
    for key, value in first.items():
        torch.testing.assert_close(value, second[key].cpu(), rtol=1e-3, atol=1e-4)
    total(first).backward()
    total(second).backward()
    for one, other in zip(here.parameters(), there.parameters(), strict=True):
        if one.grad is not None:
            torch.testing.assert_close(one.grad, other.grad.cpu(), rtol=1e-2, atol=1e-3)


def test_compiled_loss_is_the_eager_one():
    loss, data = make_loss().cuda(), make_batch().cuda()
    compiled = torch.compile(loss, fullgraph=True)(data)
    for key, value in loss(data).items():
        torch.testing.assert_close(value, compiled[key], rtol=1e-3, atol=1e-4)


def test_mixed_precision_stays_near():
    loss, data = make_loss().cuda(), make_batch().cuda()
    with torch.autocast("cuda", dtype=torch.bfloat16):
        mixed = loss(data)
    assert abs(float(total(mixed)) / float(total(loss(data))) - 1.0) < 0.1


@pytest.mark.parametrize("options", [[], ["trainer.autocast=bfloat16"], ["trainer.compile=true"]], ids=["plain", "mixed", "compile"])
def test_experiments_train_on_the_gpu_and_return_an_agent_on_the_cpu(options, tmp_path):
    experiment = Experiment(experiment_config([*TINY, *options, "device=cuda", f"out_dir={tmp_path}"]))
    outcome = experiment.run()
    assert all(p.is_cuda for p in experiment.loss.parameters())
    assert all(torch.isfinite(p).all() for p in experiment.loss.parameters())
    assert all(not p.is_cuda for p in outcome.agent.parameters())
    assert outcome.evaluation["starts_inside"] is not None


def test_rounds_warm_up_on_the_gpu(tmp_path):
    devices = []

    class Watched(SafePolicyTraining):
        def _mixed_batch(self, stores):
            batch = super()._mixed_batch(stores)
            devices.append(batch["frames"].device.type)
            return batch

    config = make_config([*SMOKE, "device=cuda", f"out_dir={tmp_path}"])
    result = Watched(config, lambda n, seed: PendulumEnv(batch_size=n, seed=seed)).run()
    assert set(devices) == {"cuda"}
    assert all(not p.is_cuda for p in result.agent.parameters())


def test_environment_on_the_gpu_draws_what_it_draws_on_the_cpu():
    state = torch.tensor([[0.3, -0.5], [2.0, 1.0]])
    here, there = PendulumEnv(batch_size=[2], seed=0), PendulumEnv(batch_size=[2], seed=0, device="cuda")
    difference = here.observe(state).int() - there.observe(state.cuda()).cpu().int()
    assert difference.abs().max() <= 1
    assert there.rollout(3, break_when_any_done=False)["pixels"].is_cuda


def test_collected_data_lie_in_host_memory_and_batches_on_the_gpu():
    store = collect_random(PendulumEnv(batch_size=[16], image_size=32, device="cuda"), 64, seed=0)
    assert isinstance(store, TransitionStore)
    assert store.get(slice(None))["frames"].device.type == "cpu"
    assert store.sample(8).to("cuda")["frames"].is_cuda


def test_agents_are_evaluated_on_the_gpu(tmp_path):
    config = experiment_config([*TINY, f"out_dir={tmp_path}"])
    agent = Experiment(config).train()
    sizes = EpisodesConfig(episodes=8, envs=8, horizon=4)
    here = evaluate_episodes(agent, EnvFactory(config.env), sizes)
    there = evaluate_episodes(agent.cuda(), EnvFactory(config.env), sizes)
    assert abs(here["on_policy_error_mean"] - there["on_policy_error_mean"]) < 1e-2
