"""Changes of pictures that should not matter."""

from __future__ import annotations

from types import SimpleNamespace

import pytest
import torch
from tensordict import TensorDict
from tiny import SINGLE

from torchrl_sspl.configs import compose
from torchrl_sspl.data import Augmentation, TransitionStore
from torchrl_sspl.errors import ConfigError, DTypeError, ShapeError
from torchrl_sspl.evaluation import known
from torchrl_sspl.experiments import Experiment

PLAIN = torch.full((40, 3, 32, 32), 100, dtype=torch.uint8)
ALONE = torch.arange(40)


def only(kind, value):
    """All episodes are changed, in one way."""
    return Augmentation(share=1.0, **{"noise": 0.0, "brightness": 0.0, "shift": 0.0, kind: value})


def test_noise_is_new_in_every_frame_and_has_the_strengths_asked_for():
    made = only("noise", 12.0)(PLAIN.repeat(2, 1, 1, 1), ALONE.repeat(2)).float()
    spread, again = made.flatten(1).std(1).chunk(2)
    assert 9.0 < float(spread.max()) < 12.5
    assert float(spread.min()) < 3.0
    assert torch.allclose(spread, again, atol=0.5)  # a camera's noise is as strong in every frame
    assert not torch.equal(made[0], made[40])


def test_brightness_is_that_of_the_episode():
    made = only("brightness", 0.15)(PLAIN, ALONE // 2).float().mean((1, 2, 3))
    assert torch.equal(made[::2], made[1::2])
    assert 85.0 <= float(made.min()) < 90.0
    assert 110.0 < float(made.max()) <= 115.0


def test_a_shift_moves_what_is_seen_along_both_axes_by_pixels_of_64():
    frames = torch.zeros(40, 3, 32, 32, dtype=torch.uint8)
    frames[..., 15:17, 15:17] = 200
    weight = only("shift", 4.0)(frames, ALONE).float()[:, 0]
    place = torch.stack([(weight.sum(k) * torch.arange(32.0)).sum(1) / weight.sum((1, 2)) for k in (1, 2)], 1) - 15.5
    assert 1.5 < float(place.abs().max()) <= 2.05
    assert float(place.mean(0).abs().max()) < 0.5
    assert torch.unique(place.sign(), dim=0).shape[0] == 4


def test_both_frames_of_a_state_are_seen_by_one_camera(monkeypatch):
    monkeypatch.setattr(known, "on_host", lambda agent: agent)
    sees = SimpleNamespace(latent_dim=2, encode=lambda pixels: pixels.float().unflatten(1, (2, 3)).mean((2, 3, 4)))
    env = SimpleNamespace(previous_state=lambda state: state, draw=lambda state: PLAIN[: len(state)])
    before, now = known.encode_states(sees, env, torch.zeros(40, 2), augmentation=only("brightness", 0.15)).unbind(1)
    assert torch.equal(before, now)
    assert float(now.max() - now.min()) > 10.0


def test_a_share_of_the_episodes_is_changed_in_each_way():
    same = torch.cat([(Augmentation(share=0.3)(PLAIN, ALONE, k) == PLAIN).flatten(1).all(1) for k in range(20)])
    assert 0.6 * 0.7**3 < float(same.float().mean()) < 1.0 - 0.7 * 0.3 - 0.2 * 0.21  # a shift of a plain picture is none
    assert torch.equal(Augmentation(share=0.0)(PLAIN, ALONE), PLAIN)


def test_draws_differ_by_position_and_seed_alone():
    first = Augmentation(seed=1)
    assert torch.equal(first(PLAIN, ALONE), Augmentation(seed=1)(PLAIN, ALONE))
    assert not torch.equal(first(PLAIN, ALONE), first(PLAIN, ALONE, 1))
    assert not torch.equal(first(PLAIN, ALONE), Augmentation(seed=2)(PLAIN, ALONE))


def test_values_stay_within_a_byte():
    bright = torch.full((8, 3, 4, 4), 250, dtype=torch.uint8)
    made = only("brightness", 0.9)(bright, torch.arange(8))
    assert int(made.max()) == 255
    dark = only("noise", 100.0)(torch.zeros_like(bright), torch.arange(8)).float()
    assert float(dark.median()) < 60.0  # nothing below zero comes out as white


@pytest.mark.parametrize(
    "wrong", [{"share": 1.1}, {"share": -0.1}, {"noise": -1.0}, {"brightness": 1.0}, {"shift": 32.0}, {"share": float("nan")}]
)
def test_other_values_are_refused(wrong):
    with pytest.raises(ConfigError, match="augmentation: expected"):
        Augmentation(**wrong)


def test_other_tensors_are_refused():
    with pytest.raises(ShapeError, match="augmentation: expected frames"):
        Augmentation()(PLAIN, ALONE[:3])
    with pytest.raises(DTypeError, match="uint8"):
        Augmentation()(PLAIN.float(), ALONE)


def transitions(n):
    video = torch.full((n + 2, 3, 8, 8), 100, dtype=torch.uint8) + torch.arange(n + 2, dtype=torch.uint8)[:, None, None, None]
    pixels = torch.cat([video[:-1], video[1:]], 1)
    return TensorDict(
        {"pixels": pixels[:-1], "next": {"pixels": pixels[1:]}, "action": torch.zeros(n, 1), "region": torch.ones(n, 1, dtype=torch.int64)}, [n]
    )


def test_an_episode_that_is_stored_has_one_camera_and_every_frame_one_change():
    plain, store = TransitionStore(12), TransitionStore(12, augmentation=Augmentation(share=1.0))
    data = torch.cat([transitions(6), transitions(6)])
    for each in (plain, store):
        each.extend(data)
    found = store.get(torch.arange(12))["frames"]
    assert store.n_frames == plain.n_frames
    assert torch.equal(found[:5, 1:], found[1:6, :2])
    light = TransitionStore(12, augmentation=only("brightness", 0.5))
    light.extend(data)
    factor = (light.get(torch.arange(12))["frames"].float() / plain.get(torch.arange(12))["frames"]).reshape(2, -1)
    assert float((factor - factor.mean(1, keepdim=True)).abs().max()) < 0.02
    assert float(factor.mean(1).diff().abs()) > 0.05
    assert not torch.equal(found[:6], found[6:])
    assert not torch.equal(found, plain.get(torch.arange(12))["frames"])


def test_what_takes_the_place_of_others_has_a_camera_of_its_own():
    store, data = TransitionStore(6, augmentation=Augmentation(share=1.0)), transitions(6)
    seen = []
    for _ in range(2):
        store.extend(data)
        seen.append(store.get(torch.arange(6))["frames"])
    assert not torch.equal(*seen)


@pytest.mark.slow
def test_a_training_sees_changed_pictures_and_another_one_the_same(tmp_path):
    words = [*SINGLE, "synthesis.enabled=false", "evaluation.episodes=0"]

    def frames(name, *more):
        run = Experiment(compose([*words, f"out_dir={tmp_path / name}", *more]))
        run.train()
        return run.store.get(torch.arange(64))["frames"], run.work.source.random(64, 0)["seen"], run.work.source.augmentation

    plain, changed, again = frames("plain"), frames("a", "augmentation.share=1.0"), frames("b", "augmentation.share=1.0")
    assert (plain[2] is None, changed[2].share) == (True, 1.0)
    assert not torch.equal(plain[0], changed[0])
    assert torch.equal(changed[0], again[0])
    assert torch.equal(changed[1], again[1])


def test_what_is_collected_anew_is_changed_too(tmp_path):
    run = Experiment(
        compose(["env=pendulum", "preset=smoke", "logger=none", f"out_dir={tmp_path}", "augmentation.share=1.0", "trainer.progress=false"])
    )
    changed = run.work.source.random(64, 0)["seen"]
    run.work.source.augmentation = None
    assert not torch.equal(run.work.source.random(64, 0)["seen"], changed)


def test_a_share_that_is_none_is_refused_before_anything_is_computed(tmp_path):
    with pytest.raises(ConfigError, match="share"):
        Experiment(compose(["env=pendulum", "preset=smoke", f"out_dir={tmp_path}", "augmentation.share=2"]))
