"""Parts of this library in TorchRL's own trainer, collectors and buffers, and in loops that somebody else has written."""

from __future__ import annotations

from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
import torch
from tensordict import TensorDict
from torch import Tensor, nn
from torchrl.checkpoint import Checkpoint
from torchrl.collectors import Collector
from torchrl.objectives import SoftUpdate
from torchrl.trainers import ReplayBufferTrainer, Trainer

from torchrl_sspl.data import RandomActions, TransitionStore
from torchrl_sspl.data.store import continues
from torchrl_sspl.envs import PendulumEnv
from torchrl_sspl.errors import CheckpointError, ConfigError, ShapeError
from torchrl_sspl.modules import Policy, SaLaD, make_rollout_policy
from torchrl_sspl.objectives import SSPLLoss
from torchrl_sspl.sets import SAFE, UNSAFE
from torchrl_sspl.trainers import Phase, Phases, SSPLTrainer, Workspace
from torchrl_sspl.trainers.hooks import FitEncoderHook, SeedHook
from torchrl_sspl.trainers.stepper import SSPLStepper

pytestmark = pytest.mark.filterwarnings("ignore::FutureWarning", "ignore::DeprecationWarning")


def parts() -> tuple[PendulumEnv, SaLaD, Policy, SSPLLoss]:
    torch.manual_seed(0)
    env = PendulumEnv(batch_size=[4], image_size=16, seed=0)
    env.initial_set = env.safe_set | env.unsafe_set
    salad = SaLaD.from_sizes(2, 1, action_scale=env.max_action, pool_to=8)
    policy = Policy(2, 1, action_scale=env.max_action)
    return env, salad, policy, SSPLLoss(*salad, policy)


def collector(env: PendulumEnv, policy: Any, **options: Any) -> Collector:
    return Collector(env, policy, frames_per_batch=64, total_frames=128, auto_register_policy_transforms=False, **options)


def trainer(acts: Any, loss: SSPLLoss) -> SSPLTrainer:
    return SSPLTrainer(
        collector=acts, total_frames=128, loss_module=loss, optimizer=torch.optim.Adam(loss.parameters(), 1e-3), optim_steps_per_batch=2,
        replay_buffer=TransitionStore(256).replay_buffer(16), progress_bar=False,
    )  # fmt: skip


class Sets(Phase):
    """Gives every weight of the policy a value, or dies before."""

    def __init__(self, number: int, *, dies: bool = False, name: str = "sets") -> None:
        super().__init__(number)
        self.dies, self.name = dies, name

    def run(self, work: Workspace) -> None:
        if self.dies:
            raise KeyboardInterrupt
        for weight in work.policy.parameters():
            weight.data.fill_(0.125 + self.number)


def of_torchrl(path: Path, *, dies: bool) -> tuple[Trainer, Phases, Policy]:
    env, salad, policy, loss = parts()
    made = Trainer(
        collector=collector(env, make_rollout_policy(salad, policy)), total_frames=128, frame_skip=1, loss_module=loss, optim_steps_per_batch=2,
        optimizer=torch.optim.Adam(loss.parameters(), 1e-3), progress_bar=False, save_trainer_file=path, checkpoint=Checkpoint(),
    )  # fmt: skip
    ReplayBufferTrainer(TransitionStore(256).replay_buffer(16), flatten_tensordicts=True).register(made)
    phases = Phases([Sets(0), Sets(1, dies=dies)], Workspace(*salad, policy))
    phases.register(made)
    return made, phases, policy


def test_torchrls_own_trainer_goes_on_in_the_phase_in_which_it_was_interrupted(tmp_path):
    first, phases, _ = of_torchrl(tmp_path / "kept", dies=True)
    with pytest.raises(KeyboardInterrupt):
        first.train()
    assert phases.done == 1
    again, phases, policy = of_torchrl(tmp_path / "kept", dies=False)
    again.load_from_file(tmp_path / "kept")
    again.train()
    assert phases.finished
    assert all(bool((weight == 1.125).all()) for weight in policy.parameters())


def test_phases_that_have_begun_cannot_be_exchanged():
    def made(*names: str) -> Phases:
        _, salad, policy, _ = parts()
        return Phases([Sets(k, name=name) for k, name in enumerate(names)], Workspace(*salad, policy))

    state = made("a", "b", "c").state_dict() | {"done": 1, "begun": True, "work": None}
    for names in (("a", "x", "c"), ("x", "b", "c"), ("a",)):
        with pytest.raises(CheckpointError, match="phases"):
            made(*names).load_state_dict(state)
    for names in (("a", "b", "c"), ("a", "b", "x"), ("a", "b")):  # what comes later may be others
        found = made(*names)
        found.work.load_state_dict = lambda work: None
        found.load_state_dict(state)
        assert found.done == 1


class Fitted(nn.Module):
    """Mean grey less the one of all frames, which the weights do not know."""

    def __init__(self) -> None:
        super().__init__()
        self.weight = nn.Parameter(torch.ones(2))
        self.register_buffer("mean", torch.zeros(()))

    def fit(self, frames: Tensor) -> None:
        self.mean.copy_(frames.float().mean() / 255)

    def forward(self, pixels: Tensor) -> Tensor:
        return torch.tanh((pixels.float().mean((-3, -2, -1)) / 255 - self.mean)[..., None] * self.weight)


def test_delayed_encoders_have_the_statistics_that_were_fitted():
    env, salad, policy, _ = parts()
    encoder, (_, dynamics, barrier) = Fitted(), salad
    loss = SSPLLoss(encoder, dynamics, barrier, policy, successor="target")
    updater, pixels = SoftUpdate(loss, tau=0.5), env.reset()["pixels"]
    store = TransitionStore(8)
    store.extend(TensorDict({"pixels": pixels, "next": {"pixels": pixels.roll(3, 1)}, "action": torch.zeros(4, 1), "region": torch.zeros(4, 1, dtype=torch.int64)}, [4]))
    hook = FitEncoderHook(SimpleNamespace(loss_module=loss, optimization_stepper=SimpleNamespace(count=0)), encoder, store)
    hook()
    assert float(encoder.mean) > 0.3
    assert torch.equal(loss._run("encoder", pixels), loss._run("encoder", pixels, params="target"))
    updater.step()
    assert torch.equal(loss._run("encoder", pixels), loss._run("encoder", pixels, params="target"))


@pytest.mark.parametrize(("resets", "seeds"), [(True, 3), (False, 1)])
def test_environments_are_seeded_again_where_they_are_reset_as_well(resets, seeds):
    given: list[int] = []
    hook = SeedHook(SimpleNamespace(set_seed=given.append, reset_at_each_iter=resets))
    hook.setup()
    hook()
    hook()
    assert len(given) == seeds


def test_a_set_that_is_not_there_is_not_told_apart():
    stepper = SSPLStepper(torch.optim.Adam([nn.Parameter(torch.zeros(1))]), warm_start_error=0.05)
    loss = SimpleNamespace(tensor_keys=SimpleNamespace(region="region"))
    right = {"safe_error": torch.tensor(0.0), "unsafe_error": torch.tensor(0.0)}
    wrong = right | {"unsafe_error": torch.tensor(1.0)}
    for _ in range(400):
        stepper._look(loss, TensorDict(region=torch.full((4, 1), SAFE)), right)
    assert stepper.unseparated
    assert stepper.mislabelled == pytest.approx(1.0, abs=1e-3)
    for _ in range(400):
        stepper._look(loss, TensorDict(region=torch.tensor([[SAFE], [UNSAFE]])), wrong)
    assert stepper.mislabelled == pytest.approx(1.0, abs=1e-3)
    for _ in range(400):
        stepper._look(loss, TensorDict(region=torch.full((4, 1), UNSAFE)), right)
    assert not stepper.unseparated


def test_steppers_of_an_earlier_version_go_on():
    stepper = SSPLStepper(torch.optim.Adam([nn.Parameter(torch.zeros(1))]), warm_start_error=0.05)
    state = {k: v for k, v in stepper.state_dict().items() if k != "errors"} | {"mislabelled": 0.5}
    stepper.load_state_dict(state)
    assert stepper.mislabelled == 0.5


def padded() -> TensorDict:
    """Two trajectories of TorchRL's, seven steps and four."""
    video = torch.randint(255, (2, 9, 3, 8, 8), dtype=torch.uint8)
    pixels = torch.cat([video[:, :-1], video[:, 1:]], 2)
    data = TensorDict({
        "pixels": pixels[:, :-1].clone(), "next": {"pixels": pixels[:, 1:]}, "action": torch.zeros(2, 7, 1),
        "region": torch.ones(2, 7, 1, dtype=torch.int64), ("collector", "mask"): torch.arange(7) < torch.tensor([[7], [4]]),
    }, [2, 7])  # fmt: skip
    data[1, 4:] = data[1, 4:].apply(torch.zeros_like)
    return data


@pytest.mark.parametrize("flat", [True, False])
def test_padding_is_no_transition_in_a_buffer_either(flat):
    store = TransitionStore(64)
    buffer = store.replay_buffer(4, safe=0, unsafe=0)
    buffer.extend(padded().reshape(-1) if flat else padded())
    assert len(store) == 11
    assert store.n_frames == 9 + 6
    assert (store.region == SAFE).all()


def test_a_collector_that_fills_a_buffer_by_itself():
    env, salad, policy, _ = parts()
    store = TransitionStore(256)
    for _ in collector(env, make_rollout_policy(salad, policy), replay_buffer=store.replay_buffer(16)):
        pass
    assert len(store) == 128
    assert float(continues(store, torch.arange(128)).float().mean()) > 0.9
    steps = collector(env, make_rollout_policy(salad, policy), replay_buffer=store.replay_buffer(16), extend_buffer=False)
    with pytest.raises(ShapeError, match=r"one transition at a time, received \(4,\)"):
        next(iter(steps))


def test_a_collector_acts_by_the_weights_of_the_loss_by_none_or_is_refused():
    env, _, _, loss = parts()
    found = trainer(collector(env, RandomActions(env, 0), reset_at_each_iter=True), loss)
    found.train()
    assert found.collected_frames == 128
    env, salad, _, loss = parts()
    other = make_rollout_policy(salad, nn.Sequential(nn.Linear(2, 1)))
    with pytest.raises(ConfigError, match="rollout_policy"):
        trainer(collector(env, other, reset_at_each_iter=True), loss)


def test_a_weight_of_a_term_that_was_left_out_cannot_be_written_either():
    _, salad, policy, _ = parts()
    loss = SSPLLoss(*salad, policy, growth_coeff=0.0)
    batch = TensorDict({
        "pixels": torch.zeros(4, 6, 16, 16, dtype=torch.uint8), "next": {"pixels": torch.zeros(4, 6, 16, 16, dtype=torch.uint8)},
        "action": torch.zeros(4, 1), "region": torch.ones(4, 1, dtype=torch.int64),
    }, [4])  # fmt: skip
    loss(batch)
    loss.growth_coeff.copy_(0.5)
    with pytest.raises(ConfigError, match="growth_coeff > 0 when SSPLLoss is made"):
        loss(batch)
    loss.growth_coeff.zero_()
    loss(batch)


def test_terms_of_the_warm_start_have_the_shapes_of_all():
    _, salad, policy, _ = parts()
    loss = SSPLLoss(*salad, policy, reduction="none")
    pixels = torch.zeros(4, 6, 16, 16, dtype=torch.uint8)
    batch = TensorDict({"pixels": pixels, "next": {"pixels": pixels}, "action": torch.zeros(4, 1), "region": torch.ones(4, 1, dtype=torch.int64)}, [4])
    whole, warm = loss(batch), loss.world_model(batch)
    assert {k: v.shape for k, v in whole.items()} == {k: v.shape for k, v in warm.items()}
