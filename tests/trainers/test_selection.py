"""What a round is judged by: held-out observations and episodes, the level, and which networks are kept."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import pytest
import torch
from torch import Tensor, nn

from torchrl_sspl.configs import SynthesisConfig
from torchrl_sspl.data import Augmentation
from torchrl_sspl.envs import PendulumEnv
from torchrl_sspl.evaluation import Episodes
from torchrl_sspl.lipschitz import SandwichBarrier
from torchrl_sspl.modules import FrameEncoder, LatentDynamics, Policy
from torchrl_sspl.sets import UNSAFE
from torchrl_sspl.trainers import CheckRound, PlaceLevel, Source, Workspace
from torchrl_sspl.trainers.selection import _HeldOut

CONFIG = SynthesisConfig(check_episodes=6, check_horizon=2, guard=0.02, leave_share=0.0, return_share=0.5)


def make(batch_size=(1,), seed=0) -> PendulumEnv:
    return PendulumEnv(batch_size=batch_size, seed=seed, image_size=16)


def workspace(config: SynthesisConfig = CONFIG, **options: Any) -> Workspace:
    torch.manual_seed(0)
    encoder = FrameEncoder(2, pool_to=8, channels=(4,), hidden=8)
    nets = LatentDynamics(2, 1, (8,), 10.0), SandwichBarrier(2, (8,)), Policy(2, 1, (8,), 10.0)
    return Workspace(encoder, *nets, config=config, source=Source(make, encoder, seed=0), **options)


def episodes(barrier: list[list[float]], region: list[list[int]] | None = None) -> Episodes:
    """Rows are episodes; time is first in what comes out."""
    values = torch.tensor(barrier).T
    codes = torch.zeros_like(values, dtype=torch.int64) if region is None else torch.tensor(region).T
    return Episodes(torch.zeros(len(values) - 1, values.shape[1], 1), codes, torch.ones_like(codes, dtype=torch.bool), barrier=values)


def held_out(**parts: Any) -> _HeldOut:
    """A set that passes, and what a test changes of it."""
    usual: dict[str, Any] = {
        "unsafe": torch.full((8,), 0.5),
        "safe": torch.full((8,), -0.5),
        "anywhere": torch.tensor([-0.4, -0.3, 0.3, 0.4]),
        "episodes": episodes([[-0.4, -0.4, -0.3], [-0.3, -0.2, -0.2]]),
        "back": episodes([[0.5, 0.2, -0.1], [0.5, 0.4, 0.3]], [[2, 0, 0], [2, 2, 0]]),
    }
    usual |= {"drift": torch.zeros(len(parts.get("episodes") or usual["episodes"])), "largest_innovation": 0.1}
    return _HeldOut(**(usual | parts))


def check(found: _HeldOut, level: float = 0.0, **config: float):
    return CheckRound(1)._check(workspace(replace(CONFIG, **config)), found, level)


def test_a_good_set_passes_and_is_measured():
    found = check(held_out())
    assert found.passed
    assert found.reason == ""
    assert (found.unsafe_inside, found.safe_outside, found.left, found.touched) == (0, 0, 0, 0)
    assert (found.started, found.size) == (2, 0.5)
    assert found.returned == 0.5


INSIDE = [-0.3, -0.2, -0.2]


def values(n: int, **changed: float) -> Tensor:
    value = torch.full((n,), changed["usual"])
    value[3] = changed["one"]
    return value


@pytest.mark.parametrize(
    ("parts", "reason"),
    [
        ({"unsafe": values(8, usual=0.5, one=0.015)}, "unsafe inside 1"),  # less than the guard above the level
        ({"unsafe": values(8, usual=0.5, one=0.025)}, ""),
        ({"safe": values(8, usual=-0.5, one=0.01)}, "safe outside 1"),
        ({"episodes": episodes([[-0.4, 0.1, -0.3], [-0.3, -0.2, -0.2]])}, "left 1"),  # and coming back does not help
        ({"episodes": episodes([[0.1, 0.2, 0.3], [-0.3, -0.2, -0.2]])}, ""),  # it did not start inside
        ({"episodes": episodes([[-0.4, -0.4, -0.3]], [[0, 0, UNSAFE]])}, "touched U 1"),
        ({"episodes": episodes([[0.3, -0.1, 0.2], INSIDE], [[0, 0, UNSAFE], [0, 0, 0]])}, "touched U 1"),  # it was inside on the way
        ({"episodes": episodes([[0.3, 0.2, -0.1], INSIDE], [[0, UNSAFE, 0], [0, 0, 0]])}, ""),  # U came first: a return
        ({"episodes": episodes([[0.3, 0.2, -0.1]])}, "0 of 1 episodes start in the set, too few to tell"),
        ({"episodes": episodes([[0.3, 0.2, 0.1]] * 39 + [INSIDE])}, "1 of 40 episodes start in the set, too few to tell"),
        ({"episodes": episodes([[0.3, 0.2, 0.1]] * 38 + [INSIDE] * 2)}, ""),
        ({"anywhere": torch.tensor([0.3, 0.4]), "episodes": episodes([[0.3, 0.3, 0.3]])}, None),  # nothing is in it
    ],
)
def test_faults_are_named(parts, reason):
    found = check(held_out(**parts))
    assert found.passed == (reason == "")
    assert found.reason == (reason or "")


def test_a_share_of_the_pictures_of_s_may_lie_outside_and_none_of_u_inside():
    found = held_out(safe=values(8, usual=-0.5, one=0.01))
    assert not check(found, safe_share=0.12).passed
    assert check(found, safe_share=0.125).passed
    assert check(found, safe_share=0.125).safe_outside == 1  # and is counted
    assert not check(held_out(unsafe=values(8, usual=0.5, one=0.015)), safe_share=1.0).passed


def test_a_share_of_the_episodes_may_leave_and_none_may_touch():
    leaving = episodes([[-0.4, -0.4, 0.1], *[[-0.4, -0.4, -0.4]] * 9])
    assert not check(held_out(episodes=leaving), leave_share=0.09).passed
    assert check(held_out(episodes=leaving), leave_share=0.1).passed
    touching = episodes([[-0.4, -0.4, -0.4]] * 10, [[0, 0, UNSAFE], *[[0, 0, 0]] * 9])
    assert not check(held_out(episodes=touching), leave_share=1.0).passed


def judged(found: _HeldOut | None, work: Workspace | None = None) -> Workspace:
    work = work or workspace()
    phase = CheckRound(len(work.checks))
    phase._held_out = lambda work, agent: found  # type: ignore[method-assign]
    phase.run(work)
    return work


def test_the_level_is_the_highest_that_passes():
    work = judged(held_out(unsafe=values(8, usual=0.5, one=0.052)))  # with the guard of 0.02 levels up to 0.03 pass
    assert work.checks[0].passed
    assert work.checks[0].level == pytest.approx(0.03, abs=1e-6)
    assert work.best["level"] == work.checks[0].level
    lower = judged(held_out(unsafe=values(8, usual=0.5, one=-0.02)))
    assert lower.checks[0].level == pytest.approx(-0.045, abs=1e-6)
    # Farther down the condition that was trained says nothing: with a margin of 0.1 the level stays above -0.06.
    low = held_out(unsafe=values(8, usual=0.5, one=-0.1))
    assert not judged(low).checks[0].passed
    allowed = judged(low, workspace(replace(CONFIG, lowest_level=-0.2))).checks[0]  # where episodes are to tell
    assert allowed.passed
    assert allowed.level == pytest.approx(-0.125, abs=1e-6)


def test_where_no_level_passes_the_reason_says_what_is_missed_at_zero_and_at_the_lowest_level():
    mixed = held_out(unsafe=values(8, usual=0.5, one=-0.5), safe=torch.tensor([-0.5, -0.03, 0.2]))
    work = judged(mixed)
    assert not work.checks[0].passed
    assert work.checks[0].level == 0.0
    assert work.checks[0].reason == "unsafe inside 1, safe outside 1; at level -0.06: unsafe inside 1, safe outside 2"
    assert work.best is None
    assert work.level == 0.0
    lower, zero = (judged(mixed, workspace(replace(CONFIG, lowest_level=level))).checks[0].reason for level in (-0.2, 0.0))
    assert lower.endswith("; at level -0.2: unsafe inside 1, safe outside 2")
    assert zero == "unsafe inside 1, safe outside 1"
    nothing = held_out(anywhere=torch.tensor([0.05, 0.07]), episodes=episodes([[0.05, 0.05], [0.07, 0.07]]), back=episodes([[0.5, 0.4]]))
    small = judged(replace(nothing, unsafe=torch.full((8,), 0.01))).checks[0]
    assert small.reason == "unsafe inside 8; at level -0.06: the set is empty"


def test_an_empty_set_is_called_so():
    work = judged(None)
    assert (work.checks[0].passed, work.checks[0].reason, work.checks[0].size) == (False, "the set is empty", 0.0)


def test_pictures_are_encoded_once_for_all_levels(monkeypatch):
    work, phase, drawn = workspace(), CheckRound(0), []
    draw = type(work.source.env).draw
    monkeypatch.setattr(type(work.source.env), "draw", lambda self, state: drawn.append(len(state)) or draw(self, state))
    first = phase._pictures(work, work.agent(0.0))
    count = len(drawn)
    assert phase._pictures(work, work.agent(0.05)) is first
    assert len(drawn) == count > 0


def test_labels_that_the_checks_read_are_counted():
    work, phase, seen = workspace(), CheckRound(0), []
    for times in (1, 2):  # a second level has episodes of its own, and the same pictures
        found = phase._held_out(work, work.agent(0.5))
        seen += [found.episodes, found.back]
        assert work.source.budget["held-out pictures with a label"] == 8 * 6 + 6
        assert work.source.budget["held-out steps with a label"] == sum(int(run.alive.sum()) for run in seen) > 2 * times
    assert work.source.budget["transitions"] == 0  # nothing is learnt from them


def test_where_training_changes_its_pictures_those_of_u_are_held_out_changed_too():
    plain, changed = workspace(), workspace()
    changed.source.changes = Augmentation(share=1.0, noise=40.0)
    one, other = (CheckRound(0)._pictures(work, work.agent(0.0)) for work in (plain, changed))
    assert one.changed is None
    assert torch.equal(other.unsafe, one.unsafe)
    assert torch.equal(other.safe, one.safe)
    assert len(other.changed) == len(one.unsafe)
    assert (other.changed != one.unsafe).any(1).all()
    agent = changed.agent(0.5)
    found = CheckRound(0)._held_out(changed, agent)
    assert torch.equal(found.changed, agent.least_barrier(other.changed))


def test_changes_that_change_nothing_are_not_looked_at():
    source = workspace().source
    for share, looked_at in ((0.0, False), (0.1, True)):
        found = Source(source.make_env, source.encoder, seed=0, changes=Augmentation(share=share))
        assert (found.changes is not None) == looked_at


def test_no_changed_picture_of_u_lies_inside_or_less_than_the_guard_above():
    for one, reason in ((-0.1, "unsafe inside as changed 1"), (0.02, "unsafe inside as changed 1"), (0.021, "")):
        found = check(held_out(changed=values(100_000, usual=0.5, one=one)))
        assert found.reason == reason
        assert found.unsafe_inside == 0
    assert judged(held_out(changed=values(8, usual=0.5, one=0.052))).checks[0].level == pytest.approx(0.03, abs=1e-6)


def test_the_best_networks_come_back_with_their_level():
    work = judged(held_out())
    best = {k: v.clone() for k, v in work.networks.state_dict().items()}
    with torch.no_grad():
        for value in work.networks.parameters():
            value.add_(0.1)
    judged(held_out(anywhere=torch.tensor([-0.4, 0.3, 0.3, 0.4])), work)  # it passes, and is smaller
    assert [c.passed for c in work.checks] == [True, True]
    assert work.best["round"] == 0
    work.finish()
    for name, value in best.items():
        assert torch.equal(value, work.networks.state_dict()[name]), name
    for name, net in work.originals.items():
        for key, value in net.state_dict().items():
            assert torch.equal(value, work.networks[name].state_dict()[key])
    assert work.level == work.checks[0].level


def test_what_is_held_out_is_fresh_uniform_and_the_same_every_time(monkeypatch):
    work, phase = workspace(), CheckRound(1)
    regions: list[Tensor] = []
    sample = PendulumEnv.sample_states

    def watched(self, n, generator=None, *, region=None):
        states = sample(self, n, generator, region=region)
        regions.append(self.region(states))
        return states

    monkeypatch.setattr(PendulumEnv, "sample_states", watched)
    first = phase._held_out(work, work.agent(0.0))
    again = phase._held_out(work, work.agent(0.0))
    other = CheckRound(2)._held_out(work, work.agent(0.0))
    assert first is not None
    assert again is not None
    assert other is not None
    assert torch.equal(first.unsafe, again.unsafe)
    assert not torch.equal(first.unsafe, other.unsafe)
    assert (len(first.unsafe), len(first.safe), len(first.anywhere)) == (48, 6, 18)
    assert (regions[0] == UNSAFE).all()
    assert (regions[1] == 1).all()
    assert (regions[2] != UNSAFE).all()
    assert bool((first.episodes.barrier[0] <= 0.08 + 1e-6).all())
    assert len(first.episodes.actions) == 2
    assert len(first.back.actions) == 80  # ways back are longer


def test_the_level_of_a_system_that_is_only_run_is_placed_and_logged(tmp_path):
    def placed(number: int, seed: int = 0) -> Workspace:
        work = workspace(seed=seed, out_dir=tmp_path)
        phase = PlaceLevel(number, episodes=6, horizon=3, envs=3)
        phase.run(work)
        return work

    first = placed(0)
    assert first.level == placed(0).level
    assert isinstance(first.level, float)
    assert (tmp_path / "log.jsonl").read_text().count('"level"') == 2
    # Of an encoder that was never trained no set without U is left, and that is said.
    assert first.level < 0.0
    assert any("held-out" in text for text in first.warnings) or bool((first.agent().barrier(torch.zeros(1, 2)) <= 0).any())


def test_an_identity_can_be_a_workspaces_encoder():
    nets = LatentDynamics(2, 1, (8,)), SandwichBarrier(2, (8,)), Policy(2, 1, (8,))
    assert Workspace(nn.Identity(), *nets).latent_dim == 2
