"""Phases on frozen latents: they resume exactly, can be left out or added to, and keep only what passed."""

from __future__ import annotations

import json
import math
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
import torch
from tensordict import TensorDict
from tiny import SAVED, TINY
from torch import nn

import torchrl_sspl.journal as journal_module
from torchrl_sspl.configs import compose
from torchrl_sspl.configs.schema import SynthesisConfig
from torchrl_sspl.errors import CheckpointError, ConfigError
from torchrl_sspl.experiments.run import Experiment
from torchrl_sspl.journal import Entry
from torchrl_sspl.modules.agent import Agent
from torchrl_sspl.modules.choosing import ChoosingPolicy
from torchrl_sspl.trainers import (
    Check,
    CheckRound,
    InnerLoop,
    Phase,
    Phases,
    Retry,
    Settle,
    Workspace,
    synthesis,
    synthesis_phases,
    targets,
)
from torchrl_sspl.trainers.phases import action_grid
from torchrl_sspl.trainers.targets import _grid_targets, _inside, _signed_distance, observed_errors
from torchrl_sspl.viability import viability_kernel
from torchrl_sspl.viability.grid import Grid

pytestmark = pytest.mark.filterwarnings("ignore::FutureWarning", "ignore::DeprecationWarning", "ignore:init_random_frames")


def experiment(path: Path, *overrides: str) -> Experiment:
    return Experiment(compose([*TINY, *overrides, f"out_dir={path}"]))


class Killed(Exception):
    pass


def resumed(path: Path, *overrides: str) -> Experiment:
    """What goes on from the newest checkpoint, and, since nobody reads them, writes none."""
    found = experiment(path, *overrides, SAVED)
    found.trainer._save_trainer = lambda: None  # type: ignore[method-assign]
    return found


def killed_after(found: Experiment, checkpoints: int) -> None:
    """Lets a training die right after its n-th checkpoint, as a killed process would; those before are not written."""
    left, save = [checkpoints], found.trainer._save_trainer

    def save_and_die() -> None:
        left[0] -= 1
        if left[0] == 0:
            save()
            raise Killed

    found.trainer._save_trainer = save_and_die  # type: ignore[method-assign]
    with pytest.raises(Killed):
        found.train()


def assert_same(one: nn.Module, other: nn.Module) -> None:
    expected = other.state_dict()
    for name, value in one.state_dict().items():
        assert torch.equal(value, expected[name]), name


EVERY_STEP = "trainer.checkpoint_seconds=0"


@pytest.fixture(scope="module")
def uninterrupted(tmp_path_factory):
    found = experiment(tmp_path_factory.mktemp("whole"), SAVED)
    return found, found.train()


@pytest.mark.parametrize("checkpoints", [21, *[pytest.param(k, marks=pytest.mark.slow) for k in (1, 2, 3, 4, 8, 13, 27)]])
def test_a_killed_training_continues_bit_for_bit(tmp_path, uninterrupted, checkpoints):
    whole, expected = uninterrupted
    killed_after(experiment(tmp_path, EVERY_STEP), checkpoints)
    again = resumed(tmp_path)
    assert_same(again.train(), expected)
    assert again.trainer.resumed
    assert again.work.checks == whole.work.checks
    assert again.work.level == whole.work.level
    assert again.work.source.budget == whole.work.source.budget
    assert (tmp_path / "log.jsonl").read_text() == (whole.directory / "log.jsonl").read_text()


@pytest.mark.slow
@pytest.mark.parametrize("results", [1, 2, 3, 4, 6, 8, 11, 16, 20])
def test_what_a_phase_without_steps_had_found_is_not_found_again(tmp_path, uninterrupted, monkeypatch, results):
    """Transitions, latents, episodes and proofs: killed when one of them is written, a training goes on from there, bit for bit."""
    whole, expected = uninterrupted
    monkeypatch.setattr(journal_module, "_SHORT", 0.0)
    monkeypatch.setattr(journal_module, "_EVERY", 0.0)
    save, read, left, taken = Entry.save, Entry.saved, [results], []

    def save_and_die(self, value, *, complete=False):
        save(self, value, complete=complete)
        left[0] -= 1
        if left[0] == 0:
            raise Killed

    def counted(self):
        taken.append(read(self) is not None)
        return read(self)

    monkeypatch.setattr(Entry, "save", save_and_die)
    with pytest.raises(Killed):
        experiment(tmp_path, EVERY_STEP).train()
    monkeypatch.setattr(Entry, "saved", counted)
    again = experiment(tmp_path, SAVED)
    assert_same(again.train(), expected)
    assert any(taken)
    assert again.work.checks == whole.work.checks
    assert again.work.source.budget == whole.work.source.budget
    assert (tmp_path / "log.jsonl").read_text() == (whole.directory / "log.jsonl").read_text()
    assert not (tmp_path / journal_module.FOLDER).exists()


@pytest.mark.slow
def test_targets_are_not_computed_again_in_the_middle_of_their_fit(tmp_path, uninterrupted, monkeypatch):
    whole, expected = uninterrupted
    monkeypatch.setattr(journal_module, "_SHORT", 0.0)
    killed, computed, compute = experiment(tmp_path, EVERY_STEP), [], targets._targets
    save = killed.trainer._save_trainer

    def save_and_die() -> None:
        if killed.work.where.get("phase") == "fit" and killed.work.loop.step == 3:  # the barrier has moved
            save()
            raise Killed

    def counted(work, number):
        computed.append((work.where["phase"], number))
        return compute(work, number)

    killed.trainer._save_trainer = save_and_die  # type: ignore[method-assign]
    monkeypatch.setattr(targets, "_targets", counted)
    with pytest.raises(Killed):
        killed.train()
    assert computed == [("fit", 0)]
    assert_same(resumed(tmp_path).train(), expected)
    assert computed.count(("fit", 0)) == 1
    assert (tmp_path / "log.jsonl").read_text() == (whole.directory / "log.jsonl").read_text()


@pytest.mark.parametrize("checkpoints", [pytest.param(3, marks=pytest.mark.slow), 15])
def test_what_was_logged_after_the_last_checkpoint_is_not_logged_twice(tmp_path, uninterrupted, checkpoints):
    found = experiment(tmp_path, EVERY_STEP)
    left, save, log = [checkpoints], found.trainer._save_trainer, tmp_path / "log.jsonl"

    def die_in_place_of_saving() -> None:
        left[0] -= 1
        if left[0] == 0:
            log.write_text(log.read_text() + '{"phase": "half a li')
            raise Killed
        if left[0] == 1:
            save()

    found.trainer._save_trainer = die_in_place_of_saving  # type: ignore[method-assign]
    with pytest.raises(Killed):
        found.train()
    resumed(tmp_path).train()
    assert log.read_text() == (uninterrupted[0].directory / "log.jsonl").read_text()


@pytest.mark.slow  # on the grid below a policy is taught first, too, and chooses
def test_a_policy_that_is_taught_first_continues_bit_for_bit_too(tmp_path):
    value = "synthesis.teacher=value"
    expected = experiment(tmp_path / "whole", value).train()
    killed_after(experiment(tmp_path / "killed", value, EVERY_STEP), 14)
    assert_same(resumed(tmp_path / "killed", value).train(), expected)


@pytest.mark.slow
def test_a_policy_that_chooses_continues_bit_for_bit_too(tmp_path):
    chooses = ("synthesis.choices=3", "synthesis.gain=0.5", "synthesis.tolerated_error=0.01", "synthesis.tighten_steps=4")
    expected = experiment(tmp_path / "whole", *chooses).train()
    assert isinstance(expected.policy, ChoosingPolicy)
    assert expected.policy.actions.flatten().tolist() == [-10.0, 0.0, 10.0]
    killed_after(experiment(tmp_path / "killed", *chooses, EVERY_STEP), 14)
    assert_same(resumed(tmp_path / "killed", *chooses).train(), expected)


def test_targets_on_a_grid_are_the_distance_to_what_is_kept_under_errors(tmp_path, monkeypatch):
    """On a line the obstacle lies at |x| < 0.1, and z moves by up to 0.2."""
    asked = {}
    monkeypatch.setattr(targets, "viability_kernel", lambda *a, **k: asked.update(k) or viability_kernel(*a, **k))

    class Line(nn.Module):
        latent_dim, action_scale = 1, torch.ones(1)

        def forward(self, latent, action):
            return (latent + 0.2 * action).clamp(-1, 1)

    work = experiment(tmp_path, "synthesis.choices=2", "synthesis.grid=401", "synthesis.teacher=value", "synthesis.tolerated_error=0.02", "synthesis.guard=0.0").work
    work.networks["dynamics"] = Line()
    work.originals["dynamics"], work.teacher_policy, work.seen_dim = Line(), lambda z: torch.zeros(len(z), 1), None
    z = torch.linspace(-1, 1, 401)[:, None]
    queries = torch.tensor([[0.0], [0.09], [0.13], [0.5], [-0.5]])
    target, member, action, _, said = _grid_targets(work, z, z[:, 0].abs() < 0.1, queries)
    assert member.tolist() == [False, False, True, True, True]
    assert target[0] == pytest.approx(0.9 * work.lipschitz_bound * 0.1, abs=0.02)  # distance to what is kept
    assert target[3] == target[4] == -0.25
    assert action.shape == (401, 1)
    assert 0.9 < said["inside_of_allowed"] <= 1.0
    assert asked["errors"].flatten().tolist() == pytest.approx([-0.08, 0.0, 0.08])  # four times what is to be tolerated
    assert asked["actions"].tolist() == [[-1.0], [1.0]]


def test_distances_on_a_grid_do_not_depend_on_its_cells():
    """A disc in two entries of three; the third has far fewer nodes."""
    grid = Grid([-1.0] * 3, [1.0] * 3, [81, 81, 9])
    inside = (grid.nodes()[:, :2].norm(dim=1) < 0.5).reshape(grid.shape).numpy()
    queries = torch.rand(2000, 3, generator=torch.Generator().manual_seed(0)) * 2 - 1
    true = queries[:, :2].norm(dim=1) - 0.5
    near = true.abs() < 0.3
    assert float((_signed_distance(grid, inside, queries) - true)[near].abs().max()) < 0.03  # of cells of .025 and .25
    for fill in (True, False):
        assert (_signed_distance(grid, np.full(grid.shape, fill), queries) == (-math.inf if fill else math.inf)).all()


def test_a_finer_grid_does_not_fill_up_the_valley_between_left_and_right():
    """Where one moves away from a ridge on which nothing is kept, values on either side of it are the same."""
    ridge = 0.025  # between two nodes of the coarse grid

    def margin(x):
        return (x[:, 0] - ridge).abs() - 0.015

    def step(x, u):
        return x

    system = {"margin": margin, "actions": torch.zeros(1, 1), "errors": None}
    found = viability_kernel(step, low=[-1.0], high=[1.0], resolution=41, exit_is_safe=True, **system)
    fine = Grid([-1.0], [1.0], [401])
    on_ridge = (fine.nodes()[:, 0] - ridge).abs() < 0.012
    assert not _inside(found, fine, step, **system)[on_ridge.numpy()].any()
    assert (found.interpolate(fine.nodes()) > 0.0)[on_ridge].any()


def test_counterexamples_that_no_sample_hits_are_climbed_to():
    """A peak of the next barrier value beside the samples, in the set; and one outside, which is none."""
    g, peaks = torch.Generator().manual_seed(0), torch.tensor([[-0.5, 0.3], [0.6, 0.6]])

    def step(z, u):
        height = (-((z[:, None] - peaks) / 0.15).square().sum(-1)).exp().amax(1, keepdim=True)
        return torch.cat([height, z[:, 1:]], 1)

    work = SimpleNamespace(barrier=lambda z: z[:, :1], dynamics=step, acting=lambda z: z[:, :1], direction=None, loop=InnerLoop(0))
    start = peaks[:1] + 0.2 * torch.nn.functional.normalize(torch.randn(50, 2, generator=g), dim=1)
    found = synthesis.Settle._ascend(work, start)
    assert float(step(start, None)[:, 0].max()) < 0.2
    assert float(step(found, None)[:, 0].max()) > 0.8
    assert float(found[:, 0].max()) <= 0.02


def test_tightening_climbs_to_what_samples_miss():
    """The next barrier value is a cone, above zero in a millionth of the domain."""
    peak = torch.tensor([-0.5, 0.3, -0.2])

    def step(z, u):
        return torch.cat([0.005 - (z - peak).norm(dim=1, keepdim=True), z[:, 1:]], 1)

    work = SimpleNamespace(
        barrier=lambda z: z[:, :1], dynamics=step, acting=lambda z: z[:, :1], direction=None, loop=InnerLoop(0), latent_dim=3, seen_dim=None,
        counterexamples=torch.zeros(0, 3), lipschitz_bound=1.0, config=SynthesisConfig(),
    )  # fmt: skip
    found = synthesis.Tighten._search(synthesis.Tighten(), work, torch.zeros(100, 3))
    assert float(step(found, None)[:, 0].max()) > 0.004


def test_the_worst_counterexamples_come_first():
    """Seventeen real ones among 8,192 that are nearly such were lost in uniform batches."""
    work = SimpleNamespace(counterexamples=torch.arange(8192.0)[:, None], config=SynthesisConfig(), loop=InnerLoop(0))
    drawn = torch.cat([synthesis.Tighten._worst_first(work) for _ in range(20)])[:, 0]
    assert float((drawn < 17).float().mean()) > 10 * 17 / 8192


def test_targets_on_a_grid_are_settled_in_place_of_a_fine_tuning():
    kinds = [type(phase) for phase in synthesis_phases(SynthesisConfig(grid=9, tolerated_error=0.01))]
    assert kinds[-1] is Settle
    assert not {synthesis.FineTune, synthesis.SteerPolicy, synthesis.Tighten} & set(kinds)
    as_fitted = synthesis_phases(SynthesisConfig(grid=9, tolerated_error=0.01, tighten_steps=0))
    assert [type(phase) for phase in as_fitted] == kinds[:-1]


@pytest.mark.parametrize(("encoder", "p"), [("BearingEncoder", 3), ("TurnedBearingEncoder", 5)])
@pytest.mark.slow
def test_a_grid_with_a_memory_of_actions_trains_and_resumes(tmp_path, encoder, p):
    car = ("env=dubins", f"network.encoder={encoder}", f"network.latent_dim={p}", "network.remember_action=true", "synthesis.gain=0.3",
           "synthesis.choices=3", "synthesis.grid=9", "synthesis.tolerated_error=0.01", "synthesis.tighten_steps=4", "synthesis.teacher=value", "synthesis.rounds=1")  # fmt: skip
    expected = experiment(tmp_path / "whole", *car).train()
    killed_after(experiment(tmp_path / "killed", *car, EVERY_STEP), 14)
    assert_same(resumed(tmp_path / "killed", *car).train(), expected)


@pytest.mark.parametrize("encoder", ["BearingEncoder", pytest.param("ShapeBearingEncoder", marks=pytest.mark.slow)])
def test_a_grid_of_latents_that_a_picture_shows_whole_trains(tmp_path, encoder):
    car = ("env=cmu", "env.image_size=32", f"network.encoder={encoder}", "network.latent_dim=2", "network.remember_action=false",
           "synthesis.choices=3", "synthesis.grid=9", "synthesis.tolerated_error=0.01", "synthesis.tighten_steps=4", "synthesis.teacher=value")  # fmt: skip
    found = experiment(tmp_path, *car)
    assert found.train().latent_dim == 2
    assert found.work.seen_dim is None


def test_a_memory_of_actions_needs_an_encoder_that_leaves_room_for_it(tmp_path):
    with pytest.raises(ConfigError, match="fills 2 of latent_dim=3"):
        experiment(tmp_path, "network.latent_dim=3", "network.remember_action=true")
    with pytest.raises(ConfigError, match="BearingEncoder, which fills 2"):
        experiment(tmp_path, "network.latent_dim=3", "network.encoder=BearingEncoder")


def test_inside_the_phases_checkpoints_hold_no_pictures(tmp_path):
    killed_after(experiment(tmp_path, EVERY_STEP), 12)
    newest = max((tmp_path / "checkpoints").iterdir(), key=lambda path: path.name)
    held = json.loads(next(newest.glob("*.json")).read_text())["components"]
    assert "loss_module" in held
    assert "replay_buffer" not in held


@pytest.mark.slow
def test_another_seed_gives_another_agent(tmp_path, uninterrupted):
    other = experiment(tmp_path, "seed=1").train()
    with pytest.raises(AssertionError):
        assert_same(other, uninterrupted[1])


def test_a_checkpoint_of_other_settings_is_refused(uninterrupted):
    path, margin = uninterrupted[0].directory, uninterrupted[0].config.synthesis.margin
    with pytest.raises(CheckpointError, match=rf"synthesis\.margin: {margin}, now 0\.07"):
        experiment(path, "synthesis.margin=0.07", SAVED).train()
    assert experiment(path, "trainer.progress=false", "evaluation.seed=3", SAVED).train() is not None  # these may change


def test_an_unreadable_checkpoint_is_named(tmp_path):
    killed_after(experiment(tmp_path, EVERY_STEP), 2)
    for file in (tmp_path / "checkpoints").rglob("*.json"):
        if file.parent.parent.name == "components":
            file.write_text("{")
    with pytest.raises(CheckpointError, match="expected a checkpoint of this trainer"):
        experiment(tmp_path, SAVED).train()


def test_the_written_agent_is_the_returned_one(uninterrupted):
    found, agent = uninterrupted
    assert_same(Agent.load(found.directory / "agent"), agent)
    body = json.loads((found.directory / "agent" / "agent.json").read_text())
    assert body["config"]["seed"] == 0
    assert "out_dir" not in body["config"]


def test_every_line_of_the_log_names_its_phase(uninterrupted):
    rows = [json.loads(line) for line in (uninterrupted[0].directory / "log.jsonl").read_text().splitlines()]
    assert {"joint", "dynamics", "fit", "steer", "tune", "check"} <= {row["phase"] for row in rows}
    assert {row["round"] for row in rows} == {0, 1}


def test_growth_is_never_paid_for_with_invariance():
    """A larger set that fails its checks is not kept; among those that pass, one to which U returns comes first."""
    work = Workspace(nn.Identity(), *_networks())
    assert work.best is None
    kept = []
    for number, (size, returned, passed) in enumerate([(0.2, 1.0, True), (0.9, 1.0, False), (0.5, 0.1, True), (0.3, 1.0, True)]):
        check = CheckRound(number)
        found = Check(number, 0.0, 0, 0, 0, 0, returned, size, passed, "")
        check._held_out = lambda work, agent: object()  # type: ignore[assignment, method-assign, return-value]
        check._check = lambda work, held_out, level, found=found: found  # type: ignore[method-assign]
        check.run(work)
        kept.append(work.best["round"])
    assert kept == [0, 0, 0, 3]


@pytest.mark.parametrize(("good", "level", "passed"), [(1, 0.04, True), (3, 0.02, True), (99, 0.0, True), (None, 0.02, False)])
def test_a_policy_that_chooses_is_checked_at_the_level_at_which_it_runs(good, level, passed, monkeypatch):
    monkeypatch.setattr("torchrl_sspl.trainers.selection.ChoosingPolicy", nn.Module)  # any policy counts as one
    work, simulated, lowest = Workspace(nn.Identity(), *_networks()), [], 0.0 if good else 0.011
    place = work.agent(0.0).barrier(torch.zeros(1, 2)).item()

    def held_out(self, work, agent):
        simulated.append(round(place - agent.barrier(torch.zeros(1, 2)).item(), 4))
        return len(simulated) - 1  # which simulation it is; the first is that of level 0

    def check(self, work, held_out, level):
        ok = lowest <= level + 1e-6 and level < 0.041 if held_out == 0 else held_out == good
        return Check(self.number, level, 0, 0, 0, 0, 1.0, 0.5, ok, "" if ok else "no")

    monkeypatch.setattr(CheckRound, "_held_out", held_out)
    monkeypatch.setattr(CheckRound, "_check", check)
    CheckRound(0).run(work)
    found = work.checks[-1]
    assert found.passed == passed
    assert found.level == pytest.approx(level, abs=1e-6)
    assert (work.best is not None) == passed
    assert simulated == [0.0, 0.04, 0.03, 0.02, 0.01][: {1: 2, 3: 4, 99: 5, None: 4}[good]]


def test_retries_follow_the_rounds_and_learn_from_the_same_data():
    config = SynthesisConfig(rounds=2, retries=2, fit_steps=100)
    phases = synthesis_phases(config, check=CheckRound)
    assert [p.name for p in phases if p.number >= 2] == ["retry", "teach", "fit", "steer", "tune", "check"] * 2
    work = Workspace(nn.Identity(), *_networks(), config=config)
    assert [p.size(work) for p in phases if p.name == "fit"] == [100, 50, 100, 100]  # fresh weights have it all to learn
    assert not [p for p in synthesis_phases(config) if p.name == "retry"]  # nothing would say that they are needed


def test_a_retry_draws_fresh_weights_only_where_nothing_has_passed():
    seen = []
    for seed, best, number in ((0, None, 1), (0, None, 1), (0, None, 2), (1, None, 1), (0, {"rank": [1.0]}, 1)):
        work = Workspace(nn.Identity(), *_networks(), seed=seed)
        work.best, dynamics, before = best, work.dynamics.state_dict(), work.barrier(torch.ones(1, 2)).item()
        torch.manual_seed(len(seen))  # does not matter
        Retry(number).run(work)
        assert work.skip == (best is not None)
        assert all(torch.equal(v, dynamics[k]) for k, v in work.dynamics.state_dict().items())
        value, action = (net(torch.ones(1, 2)).item() for net in (work.barrier, work.policy))
        seen.append((value, action))
        assert (value != before) == (best is None)
    assert seen[0] == seen[1]
    assert len(set(seen)) == 4


@pytest.mark.slow
def test_retries_resume_exactly_and_end_when_one_passes(tmp_path, monkeypatch):
    answers = {0: False, 1: False, 2: True}

    def found(self, work, held_out, level):
        return Check(self.number, level, 0, 0, 0, 0, 1.0, 0.5, answers[self.number], "" if answers[self.number] else "no")

    monkeypatch.setattr(CheckRound, "_held_out", lambda self, work, agent: object())
    monkeypatch.setattr(CheckRound, "_check", found)
    words = ["synthesis.rounds=1", "synthesis.retries=3", "synthesis.cover_share=0"]
    whole = experiment(tmp_path / "whole", *words)
    agent = whole.train()
    assert [c.round for c in whole.work.checks] == [0, 1, 2]  # the third retry is not needed
    assert whole.work.best["round"] == 2
    rows = [json.loads(line) for line in (whole.directory / "log.jsonl").read_text().splitlines()]
    assert sum(row["phase"] == "dynamics" and row["round"] > 0 for row in rows) == 0
    tuned = next(k for k, p in enumerate(whole.phases.phases) if p.number == 2 and p.name == "tune")
    broken = experiment(tmp_path / "broken", *words, SAVED)
    save = broken.trainer.save_trainer

    def die_while_tuning(force_save: bool = False) -> None:
        if broken.phases.done == tuned and broken.work.loop.step == 2:
            save(force_save=True)
            raise Killed

    broken.trainer.save_trainer = die_while_tuning  # type: ignore[method-assign]
    with pytest.raises(Killed):
        broken.train()
    assert_same(resumed(tmp_path / "broken", *words).train(), agent)


def test_the_level_moves_the_last_bias(uninterrupted):
    work = uninterrupted[0].work
    low, high = work.agent(-0.1), work.agent(0.05)
    z = torch.zeros(1, work.latent_dim)
    assert float(low.barrier(z) - high.barrier(z)) == pytest.approx(0.15, abs=1e-6)


def _networks():
    from torchrl_sspl.lipschitz import SandwichBarrier
    from torchrl_sspl.modules import LatentDynamics, Policy

    torch.manual_seed(0)
    return LatentDynamics(2, 1, (8,)), SandwichBarrier(2, (8,)), Policy(2, 1, (8,))


@pytest.mark.slow
def test_changes_of_the_action_are_a_term_of_the_fine_tuning_where_they_are_asked_for(tmp_path):
    for coefficient, logged in ((0.0, False), (0.5, True)):
        folder = tmp_path / str(coefficient)
        experiment(folder, "synthesis.rounds=1", f"synthesis.change_coeff={coefficient}").train()
        rows = [json.loads(line) for line in (folder / "log.jsonl").read_text().splitlines()]
        tuned = [row for row in rows if row["phase"] == "tune"]
        assert tuned
        assert all(("loss_action_change" in row) == logged for row in tuned)


class Count(Phase):
    name = "count"

    def run(self, work):
        self.seen = int(work.unsafe().sum())


@pytest.mark.slow
def test_phases_can_be_left_out_and_added_to(tmp_path):
    found = experiment(tmp_path)
    found.train()
    config = compose([*TINY, "synthesis.rounds=1"]).synthesis
    counted = Count()
    phases = [phase for phase in synthesis_phases(config) if phase.name not in ("steer", "tune")]
    before = {k: v.clone() for k, v in found.barrier.state_dict().items()}
    source = found.work.source
    work = Workspace(source.encoder, found.dynamics, found.barrier, found.policy, config=config, source=source)
    run = Phases([phases[0], counted, *phases[1:]], work)
    run.run()  # without any trainer
    assert run.finished
    assert counted.seen > 0
    after = found.barrier.state_dict()
    assert any(not torch.equal(before[k], v) for k, v in after.items())  # the weights are back where they belong


def test_where_U_is_never_seen_nothing_is_synthesised(tmp_path, monkeypatch):
    found = experiment(tmp_path, "synthesis.rounds=1")
    monkeypatch.setattr(type(found.work), "unsafe", lambda self: torch.zeros(len(self.latents["latent"]), dtype=torch.bool))
    found.train()
    assert any("what follows needs both kinds" in text for text in found.work.warnings)
    assert not found.work.checks


def test_a_loss_that_is_not_finite_stops_the_phase():
    layer, loop = nn.Linear(1, 1), InnerLoop(seed=0)
    with pytest.raises(ConfigError, match="expected finite losses"):
        loop(5, {layer: 1e-3}, lambda: TensorDict(loss_bad=layer.weight.sum() * float("nan")))


def test_what_a_loss_that_is_not_finite_has_made_is_not_saved():
    layer, loop, saved = nn.Linear(1, 1), InnerLoop(seed=0), []
    loop.tick = lambda: saved.append(loop.state_dict()["step"])  # a checkpoint after every step
    with pytest.raises(ConfigError, match=r"expected finite losses, received .* in step 3;"):
        loop(5, {layer: 1e-3}, lambda: TensorDict(loss_bad=layer.weight.sum() * (float("nan") if loop.step == 2 else 1.0)))
    assert saved == [1, 2]


@pytest.mark.parametrize(("dimensions", "per_dimension"), [(1, 21), (2, 21), (4, 7), (8, 7)])
def test_the_grid_of_actions_gets_coarser_with_their_dimension(dimensions, per_dimension):
    grid = action_grid([1.0] * dimensions, per_dimension)
    assert len(grid) <= 8 * 729
    assert grid.shape[1] == dimensions
    assert bool((grid.amax(0) == 1).all())


def test_too_many_dimensions_of_the_action_are_named():
    with pytest.raises(ConfigError, match="action dimensions"):
        action_grid([1.0] * 40, 2)


def test_an_unknown_teacher_is_named():
    with pytest.raises(ConfigError, match=r"synthesis\.teacher"):
        compose(["synthesis.teacher=nobody"])


def test_training_sees_no_state(uninterrupted):
    """The phases work on latents of pictures, actions and labels; the store of the joint training holds no states."""
    found = uninterrupted[0]
    assert set(found.work.latents) == {"latent", "next_latent", "action", "region", "seen", "next_seen", "continues"}
    assert ("info", "state") not in found.store.get(torch.arange(2)).keys(True)
    assert not found.store.keep_state


def test_steps_of_a_phase_keep_a_bounded_barrier_inside_its_cone():
    from torchrl_sspl.lipschitz import LMIBarrier

    torch.manual_seed(0)
    barrier, loop = LMIBarrier(1, (8, 8), 0.5), InnerLoop(0)
    ends = torch.tensor([[-1.0], [1.0]])
    loop(60, {nn.ModuleList([barrier]): 0.1}, lambda: {"loss_slope": -barrier(ends).diff(dim=0).sum()})
    assert barrier.feasible()
    assert 0.1 < float(barrier(ends).detach().diff(dim=0)) / 2 <= 0.5


@pytest.mark.parametrize(("spread", "error"), [(1.5, 0.01), (0.0, 0.01), (1.5, 0.0)])
def test_an_error_that_is_to_be_tolerated_is_tolerated_whatever_was_observed(spread, error):
    g = torch.Generator().manual_seed(0)
    z = torch.rand(200, 2, generator=g)
    data = {"latent": z, "action": z[:, :1], "next_latent": z + error * torch.randn(200, 2, generator=g)}
    config = SynthesisConfig(tolerated_error=0.05, residual_spread=spread)
    work = SimpleNamespace(latents=data, config=config, dynamics=lambda z, u: z)
    _, axes = observed_errors(work, z, g, spread)
    torch.testing.assert_close((axes[:, 1:] - axes[:, :1]).norm(dim=-1), torch.full((200, 2), 1.25 * 0.05))


def test_a_checkpoint_after_more_phases_than_there_are_is_refused():
    with pytest.raises(CheckpointError, match=r"expected a checkpoint of these 0 phases, received one after 1; .*evaluation\.calibrate"):
        Phases([], None).load_state_dict({"done": 1, "begun": False})
