"""The transition store: frames once, stratified samples, exact saving, bounded memory."""

from __future__ import annotations

import pytest
import torch
from tensordict import TensorDict
from torchrl.data.replay_buffers.samplers import PrioritizedSampler

from torchrl_sspl.data import RegionSampler, TransitionStore
from torchrl_sspl.errors import CheckpointError, ConfigError, DTypeError, EmptyRegionError, ShapeError
from torchrl_sspl.sets import SAFE, UNLABELLED, UNSAFE


def episode(steps: int, seed: int = 0, *, grey: bool = False, size: int = 6) -> TensorDict:
    """One episode whose every frame is different, with the step number as action."""
    generator = torch.Generator().manual_seed(seed)
    video = torch.randint(256, (steps + 2, 3, size, size), generator=generator, dtype=torch.uint8)
    if grey:
        video[:, 2] = video[:, 1]
    pixels = torch.cat([video[:-1], video[1:]], dim=1)
    number = torch.arange(steps)[:, None]
    return TensorDict(
        {
            "pixels": pixels[:-1],
            "action": number.float(),
            "region": number % 3,
            "state": number.float() + torch.tensor([0.0, 0.5]),
            "next": {
                "pixels": pixels[1:],
                "region": (number + 1) % 3,
                "terminated": number == steps - 1,
                "state": number.float() + torch.tensor([1.0, 1.5]),
            },
        },
        batch_size=[steps],
    )


@pytest.mark.parametrize("grey", [True, False])
def test_what_goes_in_comes_out_bit_for_bit(grey):
    data = episode(10, grey=grey)
    store = TransitionStore(20, pixel_views=True, keep_state=True)
    store.extend(data)
    out = store.get(slice(None))
    for key in ("pixels", ("next", "pixels"), "action", "region", ("next", "region"), ("next", "terminated")):
        assert torch.equal(out[key], data[key]), key
        assert out[key].dtype == data[key].dtype
    assert torch.equal(out["info", "state"], data["state"])
    assert torch.equal(out["info", "next_state"], data["next", "state"])
    assert torch.equal(out["frames"][:, 0], data["pixels"][:, :3])
    assert torch.equal(out["frames"][:, 2], data["next", "pixels"][:, 3:])


def test_every_frame_is_stored_once():
    store = TransitionStore(100)
    store.extend(episode(10))
    assert store.n_frames == 12
    store.extend(torch.stack([episode(7, seed=1), episode(7, seed=2)]))
    assert store.n_frames == 12 + 2 * 9
    store.extend(episode(1, seed=3))
    assert store.n_frames == 12 + 2 * 9 + 3


def test_observations_share_the_memory_of_the_frames():
    store = TransitionStore(10, pixel_views=True)
    store.extend(episode(10))
    batch = store.sample(4)
    start = batch["frames"].data_ptr()
    assert batch["pixels"].data_ptr() == start
    assert batch["next", "pixels"].data_ptr() == start + 3 * 6 * 6


def test_frames_with_equal_channels_take_two_thirds_until_one_does_not():
    grey, colour = TransitionStore(2000), TransitionStore(2000)
    grey.extend(episode(200, grey=True, size=32))
    colour.extend(episode(200, size=32))
    assert grey.memory_bytes < 0.7 * colour.memory_bytes
    before = grey.get(slice(None))["frames"]
    grey.extend(episode(5, seed=1, size=32))
    assert torch.equal(grey.get(slice(0, 200))["frames"], before)
    assert torch.equal(grey.get(slice(200, 205))["frames"][:, 2], episode(5, seed=1, size=32)["next", "pixels"][:, 3:])


def test_a_full_store_drops_the_oldest_and_reuses_their_memory():
    store = TransitionStore(12, pixel_views=True)
    for k in range(9):
        store.extend(episode(5, seed=k))
        if k == 3:
            memory = store.memory_bytes
    assert len(store) == 12
    assert store.memory_bytes == memory
    held = store.get(slice(None))
    newest = torch.cat([episode(5, seed=k) for k in (6, 7, 8)])[-12:]
    order = (45 - 12 + torch.arange(12)) % 12
    assert torch.equal(held["pixels"][order], newest["pixels"])
    assert torch.equal(held["next", "pixels"][order], newest["next", "pixels"])
    assert store.n_frames <= 12 + 2 * 3


def test_more_data_than_capacity_keeps_the_last():
    store = TransitionStore(4)
    data = episode(11)
    store.extend(data)
    assert sorted(store.get(slice(None))["action"].flatten().tolist()) == [7.0, 8.0, 9.0, 10.0]


def test_the_bank_grows_over_several_blocks(monkeypatch):
    monkeypatch.setattr("torchrl_sspl.data.store._BLOCK", 16)
    store = TransitionStore(100, pixel_views=True)
    data = torch.cat([episode(30, seed=k) for k in range(3)])
    store.extend(data)
    assert len(store._bank._blocks) == 6
    index = torch.tensor([0, 89, 45, 16, 29, 30])
    assert torch.equal(store.get(index)["pixels"], data["pixels"][index])


def test_a_million_pendulum_transitions_fit_into_13_gigabytes():
    from torchrl_sspl.data import collect_random
    from torchrl_sspl.envs import PendulumEnv

    store = collect_random(PendulumEnv(batch_size=[32], seed=0), 1500, seed=0)
    frames = store.n_frames / len(store)
    columns = sum(c.numel() * c.element_size() for c in store._columns.values()) / len(store)
    per_frame = store._bank._blocks[0][0].numel() + 4 + 8
    assert 1e6 * (frames * per_frame + columns) < 13e9
    assert store.memory_bytes < 13e3 * len(store)


def test_stratified_samples_have_the_shares_asked_for():
    store = TransitionStore(100)
    store.extend(episode(100))
    batch = store.sample(400, torch.Generator().manual_seed(0), safe=0.5, unsafe=0.5)
    assert (batch["region"] == SAFE).sum() == 200
    assert (batch["region"] == UNSAFE).sum() == 200
    plain = store.sample(3000, torch.Generator().manual_seed(0))["region"].flatten().bincount() / 3000
    assert (plain - 1 / 3).abs().max() < 0.05


def test_samples_repeat_with_the_generator():
    store = TransitionStore(50)
    store.extend(episode(50))
    first, again, other = (store.sample(20, torch.Generator().manual_seed(s))["action"] for s in (1, 1, 2))
    assert torch.equal(first, again)
    assert not torch.equal(first, other)


def test_indices_follow_what_is_written():
    store = TransitionStore(30)
    store.extend(episode(10))
    assert len(store.indices(UNLABELLED)) == 4
    store.extend(episode(10, seed=1))
    assert len(store.indices(UNLABELLED)) == 8
    assert len(store.indices()) == 20


def test_the_replay_buffer_goes_on_behind_what_the_store_holds():
    store = TransitionStore(50)
    store.extend(episode(20))
    buffer = store.replay_buffer(40, safe=0.25, unsafe=0.25)
    buffer.extend(episode(10, seed=1))
    assert len(buffer) == len(store) == 30
    batch = buffer.sample()
    assert batch["frames"].shape == (40, 3, 3, 6, 6)
    assert (batch["region"] == SAFE).sum() >= 10
    assert "index" in batch.keys()  # noqa: SIM118
    store.extend(episode(5, seed=2))
    assert torch.equal(store.get(slice(30, 35))["action"], episode(5)["action"])


def test_the_replay_buffer_repeats_with_its_generator():
    def draw(seed):
        store = TransitionStore(50)
        store.extend(episode(50))
        buffer = store.replay_buffer(16, generator=torch.Generator().manual_seed(seed))
        return buffer.sample()["action"]

    assert torch.equal(draw(0), draw(0))
    assert not torch.equal(draw(0), draw(1))


@pytest.mark.parametrize("grey", [True, False])
def test_saving_is_bit_exact_and_goes_on(tmp_path, grey):
    store = TransitionStore(12, keep_state=True)
    for k in range(3):
        store.extend(episode(7, seed=k, grey=grey))
    store.dumps(tmp_path)
    loaded = TransitionStore.from_folder(tmp_path)
    assert (loaded.max_size, len(loaded), loaded.n_frames) == (12, 12, store.n_frames)
    assert (loaded.get(slice(None)) == store.get(slice(None))).all()
    for kept in (store, loaded):
        kept.extend(episode(5, seed=9, grey=grey))
    assert (loaded.get(slice(None)) == store.get(slice(None))).all()
    assert (
        loaded.sample(9, torch.Generator().manual_seed(0)) == store.sample(9, torch.Generator().manual_seed(0))
    ).all()


def test_a_replay_buffer_can_be_saved_and_loaded(tmp_path):
    store = TransitionStore(30)
    buffer = store.replay_buffer(8, safe=0.5, unsafe=0.25)
    buffer.extend(episode(20))
    buffer.dumps(tmp_path)
    other = TransitionStore(30).replay_buffer(8)
    other.loads(tmp_path)
    assert (other.storage.get(slice(None)) == store.get(slice(None))).all()
    assert (other.sampler.safe, other.sampler.unsafe) == (0.5, 0.25)
    assert other.writer._cursor == 20


def test_a_state_dict_goes_into_a_larger_store_and_not_into_a_smaller_one():
    store = TransitionStore(10)
    store.extend(episode(10))
    larger = TransitionStore(20)
    larger.load_state_dict(store.state_dict())
    assert (larger.get(slice(None)) == store.get(slice(None))).all()
    with pytest.raises(CheckpointError, match="at most 5"):
        TransitionStore(5).load_state_dict(store.state_dict())


@pytest.mark.parametrize("through", ["store", "buffer", "files"])
def test_what_a_full_store_held_stays_in_a_larger_one(through, tmp_path):
    full = TransitionStore(10)
    full.extend(episode(14))  # steps 4 to 13 are left, of which 10 to 13 lie in front
    larger = TransitionStore(20)
    buffer = larger.replay_buffer(4)
    if through == "files":
        full.dumps(tmp_path)
        larger.loads(tmp_path)
    elif through == "buffer":
        other = full.replay_buffer(4)
        buffer.load_state_dict(other.state_dict())
    else:
        larger.load_state_dict(full.state_dict())
    held = larger.get(slice(None))
    assert held["action"].flatten().tolist() == list(range(4, 14))
    (larger if through == "store" else buffer).extend(episode(5, seed=1))
    assert len(larger) == 15
    assert (larger.get(slice(0, 10)) == held).all()
    assert larger.get(slice(10, 15))["action"].flatten().tolist() == list(range(5))


def test_a_buffer_writes_behind_what_came_into_the_store_otherwise():
    store = TransitionStore(20)
    buffer = store.replay_buffer(64, sampler=PrioritizedSampler(20, alpha=1.0, beta=1.0))
    store.extend(episode(6))
    buffer.extend(episode(4, seed=1))
    assert store.get(slice(None))["action"].flatten().tolist() == [*range(6), *range(4)]
    torch.manual_seed(0)
    assert set(buffer.sample()["index"].flatten().tolist()) == set(range(10))  # all of them can be drawn


def test_what_trajectories_are_filled_up_with_is_not_stored():
    data = torch.stack([episode(5), episode(5, seed=1)])
    mask = torch.ones(2, 5, dtype=torch.bool)
    mask[1, 3:] = False
    data["collector", "mask"] = mask
    store = TransitionStore(20)
    assert len(store.extend(data)) == 8
    assert store.get(slice(None))["action"].flatten().tolist() == [*range(5), *range(3)]


def test_actions_of_a_user_come_out_again():
    data = episode(4).set("user_action", torch.rand(4, 1)).set("residual", torch.rand(4, 3))
    store = TransitionStore(8)
    store.extend(data)
    out = store.get(slice(None))
    assert torch.equal(out["user_action"], data["user_action"])
    assert torch.equal(out["residual"], data["residual"])
    with pytest.raises(ShapeError, match="expected 'user_action', as in the transitions that it holds"):
        store.extend(episode(4))


@pytest.mark.parametrize("name", ["user_action", "residual"])
def test_an_entry_that_earlier_transitions_lack_is_refused(name):
    store = TransitionStore(8)
    store.extend(episode(4))
    with pytest.raises(ShapeError, match=f"expected no '{name}', as in the transitions that it holds, received one"):
        store.extend(episode(4).set(name, torch.ones(4, 1)))
    assert len(store) == 4
    assert name not in store.get(slice(None))


def test_unreadable_files_are_named(tmp_path):
    with pytest.raises(CheckpointError, match="cannot read"):
        TransitionStore.from_folder(tmp_path / "nowhere")
    (tmp_path / "transitions.safetensors").write_bytes(b"no tensors")
    with pytest.raises(CheckpointError, match="cannot read"):
        TransitionStore.from_folder(tmp_path)


def test_single_positions_have_no_batch_dimension():
    store = TransitionStore(10)
    store.extend(episode(10))
    assert store[3].batch_size == ()
    assert store[3]["action"].item() == 3
    assert store.contains([3, 10]).tolist() == [True, False]
    with pytest.raises(ConfigError, match="below 10"):
        store.get(10)


def test_a_mask_reads_the_rows_that_it_marks():
    store = TransitionStore(10)
    store.extend(episode(5))
    mask = torch.tensor([False, True, False, True, True])
    for given in (mask, mask.tolist(), mask.numpy()):
        assert (store.get(given) == store.get(torch.tensor([1, 3, 4]))).all()
    assert len(store.get(torch.zeros(5, dtype=torch.bool))) == 0
    for wrong in (torch.ones(10, dtype=torch.bool), mask[:, None]):
        with pytest.raises(ShapeError, match=r"expected a mask \(5,\), received"):
            store.get(wrong)


def test_the_states_are_kept_only_on_request():
    store = TransitionStore(10)
    store.extend(episode(10))
    assert "info" not in store.sample(2)
    with pytest.raises(ShapeError, match="keep_state"):
        TransitionStore(10, keep_state=True).extend(episode(10).exclude("state"))


def test_bad_data_are_named():
    store = TransitionStore(10)
    data = episode(4)
    with pytest.raises(ShapeError, match="'pixels'"):
        store.extend(data.exclude("pixels"))
    with pytest.raises(ShapeError, match="'action'"):
        store.extend(data.exclude("action"))
    with pytest.raises(DTypeError, match="float32"):
        store.extend(data.clone().set("pixels", data["pixels"].float()))
    with pytest.raises(ShapeError, match=r"\(n, 6, H, W\), received \(4, 3, 6, 6\)"):
        store.extend(data.clone().set("pixels", data["pixels"][:, :3]))
    with pytest.raises(ConfigError, match="two consecutive frames"):
        store.extend(data.clone().set(("next", "pixels"), data["pixels"]))
    with pytest.raises(ConfigError, match="capacity"):
        TransitionStore(0)
    assert len(store) == 0


def test_empty_sets_and_bad_shares_are_named():
    store = TransitionStore(10)
    with pytest.raises(EmptyRegionError, match="expected transitions"):
        store.sample(4)
    data = episode(4)
    store.extend(data.set("region", torch.zeros_like(data["region"])))
    with pytest.raises(EmptyRegionError, match="safe transitions"):
        store.sample(4, safe=0.5)
    with pytest.raises(ConfigError, match="sum <= 1"):
        store.sample(4, safe=0.7, unsafe=0.7)
    with pytest.raises(ConfigError, match="sum <= 1"):
        RegionSampler(-0.1, 0.2)


def test_prioritised_replay_draws_what_the_losses_find_hard():
    buffer = TransitionStore(100).replay_buffer(200, sampler=PrioritizedSampler(100, alpha=1.0, beta=1.0))
    buffer.extend(episode(10))
    batch = buffer.sample()
    assert batch.get("priority_weight") is not None
    hard = torch.full((200,), 1e-6)
    hard[batch["index"].flatten() == 3] = 10.0
    buffer.update_priority(batch["index"].flatten(), hard)
    drawn = buffer.sample()["action"].flatten()
    assert (drawn == 3).float().mean() > 0.9
