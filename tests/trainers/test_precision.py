"""Options of the training step on the CPU: mixed precision and compilation change how, not what, is learned."""

from __future__ import annotations

import pytest
import torch
from tiny import TINY_PHASES

from torchrl_sspl.configs import compose
from torchrl_sspl.experiments.run import Experiment

pytestmark = pytest.mark.filterwarnings("ignore::FutureWarning", "ignore::DeprecationWarning", "ignore::UserWarning")
TINY = [
    *TINY_PHASES, "env=pendulum", "trainer.total_frames=192", "trainer.optim_steps_per_batch=6", "trainer.warm_start_steps=4",
    "trainer.checkpoint_seconds=-1", "collector.frames_per_batch=64", "collector.envs=32", "collector.init_random_frames=64",
    "buffer.batch=32", "env.image_size=16", "network.pool_to=16", "synthesis.enabled=false",
]  # fmt: skip


def train(folder, *options: str) -> Experiment:
    experiment = Experiment(compose([*TINY, *options, f"out_dir={folder}"]))
    experiment.train()
    return experiment


def last(experiment: Experiment) -> float:
    return float(experiment.trainer._log_dict["loss_consistency"][-1])


def test_mixed_precision_keeps_float32_weights_and_about_the_same_loss(tmp_path):
    plain, mixed = train(tmp_path / "plain"), train(tmp_path / "mixed", "trainer.autocast=bfloat16")
    assert {p.dtype for p in mixed.loss.parameters()} == {torch.float32}
    assert last(mixed) != last(plain)  # it was on
    assert last(mixed) == pytest.approx(last(plain), rel=0.5)


@pytest.mark.slow
def test_compiled_training_ends_with_about_the_same_loss(tmp_path):
    plain, compiled = train(tmp_path / "plain"), train(tmp_path / "compiled", "trainer.compile=true")
    assert compiled.loss._compiled_call_impl is not None
    assert last(compiled) == pytest.approx(last(plain), rel=0.05)
