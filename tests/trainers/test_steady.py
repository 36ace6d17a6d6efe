"""The encoder is taught that changes of a picture do not matter, on pictures that stay as they are; U keeps away from what is left."""

from __future__ import annotations

import copy

import pytest
import torch
from test_phases import EVERY_STEP, assert_same, experiment, killed_after, resumed

from torchrl_sspl import journal
from torchrl_sspl.configs import compose
from torchrl_sspl.configs.schema import SynthesisConfig
from torchrl_sspl.data import Augmentation, TransitionStore, collect_random
from torchrl_sspl.envs import PendulumEnv
from torchrl_sspl.errors import ConfigError
from torchrl_sspl.lipschitz import SandwichBarrier
from torchrl_sspl.modules import FrameEncoder, LatentDynamics, Policy
from torchrl_sspl.trainers import (
    KeepChanges,
    Phases,
    Source,
    SteadyEncoder,
    Workspace,
    steady,
    synthesis,
    synthesis_phases,
)

pytestmark = pytest.mark.filterwarnings("ignore::FutureWarning", "ignore::DeprecationWarning", "ignore:init_random_frames")
STEADY = ["augmentation.share=1.0", "synthesis.steady_steps=4"]


def make(batch_size=(16,), seed=0) -> PendulumEnv:
    return PendulumEnv(batch_size=batch_size, seed=seed, image_size=32)


def workspace(*, stored: bool = True, changes: Augmentation | None = None, encoder=None, **settings) -> Workspace:
    torch.manual_seed(0)
    encoder = encoder or FrameEncoder(2, pool_to=16)
    store = TransitionStore(400, pixel_views=True)
    if stored:
        collect_random(make(), 400, seed=0, steps=4, store=store)
    source = Source(make, encoder, store=store, seed=0, changes=changes)
    nets = LatentDynamics(2, 1, (8,), 10.0), SandwichBarrier(2, (8,)), Policy(2, 1, (8,), 10.0)
    return Workspace(encoder, *nets, config=SynthesisConfig(**settings), source=source)


@torch.no_grad()
def moved(encoder, other, frames, changed) -> float:
    """Root mean square distance of what one encoder makes of changed frames from what another makes of unchanged ones."""
    return float((encoder(changed) - other(frames)).square().mean().sqrt())


@pytest.mark.slow
def test_changes_move_latents_less_afterwards_and_unchanged_pictures_are_seen_as_before():
    changes = Augmentation(share=1.0, noise=60.0, brightness=0.0, shift=0.0)
    work = workspace(changes=changes, steady_steps=150)
    before = copy.deepcopy(work.encoder)
    Phases([SteadyEncoder(0), KeepChanges(0)], work).run()
    fresh = collect_random(make(seed=9), 200, seed=9, steps=4)
    frames = fresh.get(torch.arange(200))["frames"][:, :2]
    changed = steady._changed(work, frames, 77).flatten(1, 2)
    frames = frames.flatten(1, 2)
    left, usual = moved(work.encoder, before, frames, changed), moved(before, before, frames, changed)
    assert left < 0.6 * usual
    assert moved(work.encoder, before, frames, frames) < left
    assert work.changes.shape == (400, 2)
    assert float(work.changes.square().mean().sqrt()) == pytest.approx(moved(work.encoder, work.encoder, frames, changed), rel=0.3)


def test_both_frames_of_a_picture_are_of_one_camera():
    frames = torch.full((6, 2, 3, 8, 8), 100, dtype=torch.uint8)
    changed = steady._changed(workspace(changes=Augmentation(share=1.0, noise=0.0)), frames, 3)
    assert torch.equal(changed[:, 0], changed[:, 1])
    assert len({int(v) for v in changed[:, 0, 0, 0, 0]}) > 1


@pytest.mark.parametrize(
    ("options", "words"),
    [
        ({"stored": False, "changes": Augmentation()}, "stored pictures"),
        ({}, "changes of them"),
        ({"changes": Augmentation(), "encoder": FrameEncoder(2, pool_to=16).requires_grad_(False)}, "with parameters"),
    ],
)
def test_what_it_needs_is_said(options, words):
    with pytest.raises(ConfigError, match=words):
        Phases([SteadyEncoder(0)], workspace(steady_steps=2, **options)).run()


def test_a_configuration_without_changes_is_refused():
    with pytest.raises(ConfigError, match="steady_steps=5"):
        compose(["env=pendulum", "synthesis.steady_steps=5", "augmentation.share=0.0"]).check()


def test_it_comes_first_and_once():
    names = [phase.name for phase in synthesis_phases(SynthesisConfig(rounds=2, steady_steps=3))]
    assert names[:3] == ["steady", "changes", "gather"]
    assert names.count("steady") == 1


def test_u_keeps_away_from_what_changes_do():
    work = workspace(changes=Augmentation())
    work.changes = torch.tensor([[0.1, 0.0], [0.0, -0.2]])
    latent = torch.tensor([[0.0, 0.0], [0.99, 0.0]]).repeat(50, 1)
    by = synthesis._as_changed(work, latent)
    assert {tuple(round(v, 3) for v in row) for row in (by[::2] - latent[::2]).tolist()} == {(0.1, 0.0), (0.0, -0.2)}
    assert float(by.max()) == 1.0


def test_pictures_that_were_encoded_are_taken_from_the_journal(tmp_path, monkeypatch):
    work = workspace(changes=Augmentation(share=1.0))
    rows, encode, asked = torch.arange(400), work.encoder.forward, []

    def some(pixels):
        asked.append(len(pixels))
        if len(asked) == 3:
            raise KeyboardInterrupt
        return encode(pixels)

    monkeypatch.setattr(steady, "_ENCODED", 100)
    monkeypatch.setattr(journal, "_EVERY", 0.0)
    expected = steady._encoded(work, rows, 5)
    monkeypatch.setattr(work.encoder, "forward", some)
    with pytest.raises(KeyboardInterrupt), journal.journal(tmp_path, "changes"):
        steady._encoded(work, rows, 5)
    with journal.journal(tmp_path, "changes"):
        assert torch.equal(steady._encoded(work, rows, 5), expected)
    assert asked == [100] * 5  # the third one twice


@pytest.fixture(scope="module")
def uninterrupted(tmp_path_factory):
    found, asked, whole = experiment(tmp_path_factory.mktemp("whole"), *STEADY), [], synthesis._as_changed

    def seen(work, latent):
        asked.append((work.where["phase"], work.changes.shape, latent))
        return whole(work, latent)

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(synthesis, "_as_changed", seen)
        agent = found.train()
    return found, agent, asked


def test_the_fine_tuning_asks_for_u_as_changed(uninterrupted):
    found, _, asked = uninterrupted
    assert {phase for phase, _, _ in asked} >= {"steer", "tune"}
    assert {shape[0] for _, shape, _ in asked} == {len(found.store)}
    known = found.work.latents["latent"][found.work.unsafe()]
    assert all(float((known - z).norm(dim=1).min()) < 1e-6 for z in asked[-1][2])


@pytest.mark.parametrize(("checkpoints", "phase"), [pytest.param(11, "steady", marks=pytest.mark.slow), pytest.param(15, "changes", marks=pytest.mark.slow), pytest.param(16, "gather", marks=pytest.mark.slow)])
def test_it_resumes_bit_for_bit_with_the_pictures_that_are_needed(tmp_path, uninterrupted, checkpoints, phase):
    whole, expected, _ = uninterrupted
    assert whole.store.augmentation is None
    killed = experiment(tmp_path, *STEADY, EVERY_STEP)
    killed_after(killed, checkpoints)
    assert killed.work.where["phase"] == phase
    assert_same(resumed(tmp_path, *STEADY).train(), expected)
    assert (tmp_path / "log.jsonl").read_text() == (whole.directory / "log.jsonl").read_text()
