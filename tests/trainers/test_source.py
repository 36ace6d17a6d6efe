"""Where the phases get transitions from: starts, latents, seeds, exploration, and the budget."""

from __future__ import annotations

import pytest
import torch
from torch import nn

from torchrl_sspl.data import collect_random
from torchrl_sspl.envs import PendulumEnv
from torchrl_sspl.modules import FrameEncoder, Policy
from torchrl_sspl.sets import SAFE, UNSAFE, Mixture
from torchrl_sspl.trainers import Source, source, starts_of
from torchrl_sspl.trainers.source import TrainingStarts


def make(batch_size=(1,), seed=0) -> PendulumEnv:
    return PendulumEnv(batch_size=batch_size, seed=seed, image_size=16)


class Plain(nn.Module):
    """An encoder that reads observations, not frames."""

    def __init__(self, inner: nn.Module) -> None:
        super().__init__()
        self.inner = inner

    def forward(self, pixels: torch.Tensor) -> torch.Tensor:
        return self.inner(pixels)


@pytest.fixture
def encoder() -> FrameEncoder:
    torch.manual_seed(0)
    return FrameEncoder(2, pool_to=8, channels=(4, 8), hidden=16)


def build(encoder: nn.Module, **options) -> Source:
    return Source(make, encoder, **({"envs": 8, "seed": 3} | options))


def same(one: dict, other: dict) -> bool:
    return one.keys() == other.keys() and all(torch.equal(v, other[k]) for k, v in one.items())


@pytest.mark.parametrize(
    ("shares", "seen", "unseen"),
    [([0, 0, 1, 0], {SAFE}, {0, UNSAFE}), ([0, 0, 0, 1], {UNSAFE}, {0, SAFE}), ([0, 1, 0, 0], {0, SAFE}, {UNSAFE})],
)
def test_episodes_start_where_the_shares_say(encoder, shares, seen, unseen):
    found = set(build(encoder, starts=shares, steps=1).random(96, 0)["region"].flatten().tolist())
    assert found == seen
    assert not found & unseen


def test_a_region_given_goes_before_the_shares(encoder):
    found = build(encoder, starts=[0, 0, 1, 0], steps=1)
    assert (found.random(32, 0, region=make().unsafe_set)["region"] == UNSAFE).all()


@pytest.mark.parametrize("grouped", [True, False])
def test_rows_that_act_otherwise_start_as_the_others_do(grouped):
    env = TrainingStarts(make, [400], [0.0, 0.0, 0.5, 0.5], grouped=grouped)(seed=1)
    unsafe = env.unsafe_set.contains(env.sample_states(400, torch.Generator().manual_seed(0))).float()
    first, last = float(unsafe[:200].mean()), float(unsafe[200:].mean())
    assert (first < 0.1 and last > 0.9) if grouped else (abs(first - 0.5) < 0.1 and abs(last - 0.5) < 0.1)


def test_training_starts_in_shares_and_other_environments_as_they_do(encoder):
    env = TrainingStarts(make, [4], [0.25, 0.25, 0.25, 0.25])(seed=1)
    assert isinstance(env.initial_set, Mixture)
    assert env.batch_size == (4,)

    class Other:
        initial_set = "untouched"

    assert TrainingStarts(lambda batch_size, seed: Other(), [4], [1, 0, 0, 0])(seed=0).initial_set == "untouched"
    drawn = starts_of(make(), [0, 0, 1, 1]).sample(400, torch.Generator().manual_seed(0))
    labels = make().region(drawn)
    assert float((labels == UNSAFE).float().mean()) == pytest.approx(0.5, abs=0.1)
    assert not (labels == 0).any()


def test_latents_are_the_encoders_whether_it_reads_frames_or_observations(encoder):
    by_frames, by_pixels = build(encoder).random(40, 0), build(Plain(encoder)).random(40, 0)
    for key, value in by_frames.items():
        torch.testing.assert_close(value, by_pixels[key], rtol=1e-4, atol=1e-5)
    # Within an episode (of two steps from S: none ends earlier) what follows is where the next transition begins.
    pairs = build(encoder, steps=2).random(64, 1, region=make().safe_set)
    now, after = (pairs[k].reshape(8, -1, 2, 2) for k in ("seen", "next_seen"))
    found = (now[:, :, 1] - after[:, :, 0]).abs().amax(-1) < 1e-4
    assert found.float().mean() > 0.9


def test_transitions_are_those_of_the_environment_and_its_labels(encoder):
    found = build(encoder, starts=[1, 0, 0, 0], steps=None)
    drawn = found.random(40, 2, region=make().state_space, steps=4)
    env = make([8], 3)
    from torchrl_sspl.seeds import spawn

    store = collect_random(env, 40, seed=spawn(3, "rounds", 2000), steps=4, region=env.state_space)
    expected = found._encode(store, torch.arange(40))
    assert same(drawn, expected)
    assert torch.equal(drawn["action"], store.get(slice(None))["action"])


def test_the_same_seed_gives_the_same_transitions_and_another_index_others(encoder):
    assert same(build(encoder).random(24, 1), build(encoder).random(24, 1))
    assert not same(build(encoder).random(24, 1), build(encoder).random(24, 2))
    assert not same(build(encoder).random(24, 1), build(encoder, seed=4).random(24, 1))


def test_pictures_are_held_in_chunks_of_their_own_seeds_and_counted_as_they_come(encoder, monkeypatch):
    monkeypatch.setattr(source, "_CHUNK", 16)
    collecting, told = build(encoder), []
    collecting.tell = told.append
    found = collecting.random(40, 0)
    assert told == [16, 32, 40]
    assert len(found["seen"]) == len(found["region"]) == 40
    assert len(found["action"].unique()) == 40


def test_the_budget_counts_transitions_labels_and_resets(encoder):
    found = build(encoder, starts=[0.25, 0.25, 0.25, 0.25])
    assert found.budget == {
        "transitions": 0, "labels of S": 0, "labels of U": 0, "resets": 0, "transitions of rollouts": 0,
        "held-out pictures with a label": 0, "held-out steps with a label": 0,
    }  # fmt: skip
    region = torch.cat([found.random(64, 0)["region"], found.random(16, 1)["region"]])
    assert found.budget["transitions"] == 80
    assert found.budget["labels of S"] == int((region == SAFE).sum()) > 0
    assert found.budget["labels of U"] == int((region == UNSAFE).sum()) > 0
    assert 80 // 4 <= found.budget["resets"] < 80  # no episode is longer than four steps, some end earlier
    alone = build(encoder, steps=1)
    alone.random(40, 0)
    assert alone.budget["resets"] == 40


def test_a_policy_is_followed_with_noise_on_its_actions(encoder):
    policy, found = Policy(2, 1, (8,), 10.0), build(encoder)
    before = torch.get_rng_state()
    exact = found.under(policy, 40, 0, exploration=0.0)
    with torch.no_grad():
        torch.testing.assert_close(exact["action"], policy(exact["seen"]), rtol=1e-4, atol=1e-4)
    assert found.budget["transitions of rollouts"] == found.budget["transitions"] == 40
    found.random(8, 3)
    assert (found.budget["transitions of rollouts"], found.budget["transitions"]) == (40, 48)
    noisy = found.under(policy, 400, 0, exploration=0.1)
    with torch.no_grad():
        gap = noisy["action"] - policy(noisy["seen"])
    assert float(gap.std()) == pytest.approx(1.0, rel=0.15)  # a tenth of half the range of the action
    assert torch.equal(torch.get_rng_state(), before), "the training's random numbers were touched"
    assert same(noisy, found.under(policy, 400, 0, exploration=0.1))
    assert (found.under(policy, 32, 1, exploration=0.1, region=make().safe_set)["region"] == SAFE).any()


def test_without_a_store_nothing_is_stored_and_with_one_it_is_counted(encoder):
    assert build(encoder).stored(100) is None
    store = collect_random(make([8]), 80, seed=0, steps=4)
    found = build(encoder, store=store)
    kept = found.stored(1000)
    assert same(kept, found._encode(store, torch.arange(80)))
    assert found.budget["transitions"] == 80
    few = found.stored(20)
    assert len(few["seen"]) == 20
    assert same(few, build(encoder, store=store).stored(20))


def test_it_knows_whether_the_environment_knows_its_sets(encoder):
    assert build(encoder).known
    assert not Source(lambda batch_size, seed: object(), encoder).known
