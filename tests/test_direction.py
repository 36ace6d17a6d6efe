"""Latents that hold a direction: circle and chart, dynamics that turn it, observer, agent, and the proof on charts."""

from __future__ import annotations

import math

import pytest
import torch
from torch import nn

from torchrl_sspl.certification import closed_loop
from torchrl_sspl.certification.conditions import decide_invariance, find_counterexamples, largest_error, tolerates
from torchrl_sspl.certification.deployed import check_deployed
from torchrl_sspl.certification.propagation import Enclosure
from torchrl_sspl.direction import Direction, direction_of, within
from torchrl_sspl.errors import ConfigError, StructureError
from torchrl_sspl.lipschitz import SandwichBarrier
from torchrl_sspl.lipschitz.layers import sine
from torchrl_sspl.modules import ChoosingPolicy, LatentDynamics, LatentObserver, Policy, TurnedBearingEncoder
from torchrl_sspl.modules.agent import Agent
from torchrl_sspl.modules.observer import corrected, held

TURN = Direction(2, 0.3)
G = lambda seed=0: torch.Generator().manual_seed(seed)  # noqa: E731


def _parts(chooses: bool = False, seed: int = 0) -> tuple[nn.Module, nn.Module, nn.Module]:
    with torch.random.fork_rng():
        torch.manual_seed(seed)
        dynamics = LatentDynamics(5, 1, (16, 16), 2.0, remembers=True, turn_radius=0.3)
        policy: nn.Module = Policy(5, 1, (16,), 2.0)
        barrier = SandwichBarrier(5, (16, 16), 1.5).collapse()
    if chooses:
        policy = ChoosingPolicy(policy, torch.tensor([[-2.0], [0.0], [2.0]]), 0.03).bind(dynamics, barrier)
    return barrier.requires_grad_(False), dynamics.requires_grad_(False), policy.requires_grad_(False)


def _loop(chooses: bool = False, seed: int = 0):
    return closed_loop(*_parts(chooses, seed), latent_dim=5, lipschitz_bound=1.5)


def _charts(n: int, seed: int = 0) -> torch.Tensor:
    chart = torch.rand(n, 4, generator=G(seed), dtype=torch.float64) * 2 - 1
    chart[:, 2] *= math.pi * 0.3
    return chart


class TestCircle:
    def test_chart_and_latent_are_each_others_inverse(self):
        chart = _charts(1000)
        latent = TURN.lift(chart)
        torch.testing.assert_close(TURN.chart(latent), chart)
        torch.testing.assert_close(latent[:, 2:4].norm(dim=1), torch.full((1000,), 0.3, dtype=torch.float64))

    def test_latents_are_never_farther_apart_than_their_charts(self):
        a, b = TURN.lift(_charts(5000)), TURN.lift(_charts(5000, 1))
        assert bool(((a - b).norm(dim=1) <= (_charts(5000) - _charts(5000, 1)).norm(dim=1) + 1e-12).all())

    def test_onto_is_the_nearest_point_of_the_circle(self):
        latent = torch.randn(200, 5, generator=G())
        around = torch.linspace(-math.pi, math.pi, 721)
        circle = 0.3 * torch.stack([around.cos(), around.sin()], 1)
        nearest = torch.cdist(latent[:, 2:4], circle).amin(1)
        moved = (TURN.onto(latent) - latent).norm(dim=1)
        assert bool((moved <= nearest + 1e-6).all())
        assert TURN.onto(torch.zeros(1, 5))[0, 2:4].norm() == pytest.approx(0.3)  # from the middle: some point of it

    def test_turning_keeps_the_circle_and_adds_lengths(self):
        latent = TURN.lift(_charts(100))
        by = torch.randn(100, 1, generator=G(), dtype=torch.float64)
        chart = _charts(100)
        chart[:, 2:3] += by
        torch.testing.assert_close(TURN.turn(latent, by), TURN.lift(chart)[:, 2:4])

    @pytest.mark.parametrize("error", [1e-3, 0.05, 0.29])
    def test_what_is_shortened_ends_no_farther_than_the_error(self, error):
        prior = TURN.lift(_charts(5000))
        way = torch.randn(5000, 5, generator=G(), dtype=torch.float64)
        step = TURN.shortened(error) * way / way.norm(dim=1, keepdim=True)
        assert float((TURN.onto(prior + step) - prior).norm(dim=1).max()) <= error * (1 + 1e-9)
        tangent = torch.zeros(1, 5, dtype=torch.float64)
        tangent[0, 3] = error  # not shortened it would be farther, along the circle's chord
        start = TURN.lift(torch.zeros(1, 4, dtype=torch.float64))
        assert float((TURN.onto(start + 1.0 * tangent) - start).norm()) < error or error < 0.3

    def test_none_is_the_box(self):
        assert within(torch.tensor([2.0, 0.1]), None).tolist() == [1.0, pytest.approx(0.1)]
        assert direction_of(nn.Linear(1, 1)) is None


class TestDynamics:
    def test_turns_on_the_circle_and_remembers_the_action(self):
        _, dynamics, _ = _parts()
        latent = TURN.lift(_charts(64)).float()
        after = dynamics(latent, torch.full((64, 1), 1.0))
        torch.testing.assert_close(after[:, 2:4].norm(dim=1), torch.full((64,), 0.3))
        torch.testing.assert_close(after[:, 4], torch.full((64,), 0.5))
        assert dynamics.moving_dim == 3
        assert direction_of(dynamics) == TURN

    @pytest.mark.parametrize("radius", [-0.1, 1.5, math.nan])
    def test_a_radius_that_is_none_is_refused(self, radius):
        with pytest.raises(ConfigError, match="turn_radius"):
            LatentDynamics(5, 1, turn_radius=radius)

    def test_needs_two_entries(self):
        with pytest.raises(ConfigError, match="two entries"):
            LatentDynamics(2, 1, remembers=True, turn_radius=0.3)


class TestObserver:
    def test_the_posterior_lies_on_the_circle(self):
        prior, seen = TURN.lift(_charts(50)).float(), TURN.lift(_charts(50, 1)).float()
        latent, innovation = corrected(prior, seen, torch.diag(torch.tensor([0.3, 0.3, 0.3, 0.3, 0.0])), TURN)
        torch.testing.assert_close(latent[:, 2:4].norm(dim=1), torch.full((50,), 0.3))
        torch.testing.assert_close(innovation, seen - prior)

    @pytest.mark.parametrize("error", [0.05, 0.25])
    def test_what_is_held_stays_within_the_error(self, error):
        chart = _charts(4000, 1)
        chart[:, [0, 1, 3]] = _charts(4000)[:, [0, 1, 3]]  # a turn alone: what leaves the circle most
        prior, latent = TURN.lift(_charts(4000)), TURN.lift(chart)
        border = lambda z: (z - prior).norm(dim=-1, keepdim=True) - 1e-9  # noqa: E731, nothing but the prior is inside
        kept, cut = held(border, prior, latent, error, TURN)
        assert int(cut.sum()) > 2000
        assert float((kept - prior).norm(dim=1)[cut].max()) <= error + 1e-12
        torch.testing.assert_close(TURN.onto(kept), kept)

    def test_module(self):
        encoder = TurnedBearingEncoder(5, 32, pool_to=16)
        observer = LatentObserver(encoder, torch.diag(torch.tensor([0.3, 0.3, 0.3, 0.3, 0.0])), 5, direction=TURN)
        from tensordict import TensorDict

        pixels = torch.randint(256, (4, 6, 32, 32), generator=G(), dtype=torch.uint8)
        prior, begins = TURN.lift(_charts(4)).float(), torch.zeros(4, 1, dtype=torch.bool)
        latent = observer(TensorDict(pixels=pixels, prior=prior, is_init=begins, batch_size=[4]))["latent"]
        torch.testing.assert_close(latent[:, 2:4].norm(dim=1), torch.full((4,), 0.3))


class TestEncoder:
    def test_a_quarter_turn_of_the_scene_looks_the_same(self):
        encoder = TurnedBearingEncoder(5, 64, pool_to=32)
        frames = torch.full((40, 3, 64, 64), 255, dtype=torch.uint8)
        frames[:, :, 28:36, 28:36] = 0  # the still thing
        g = G()
        for frame in frames:
            y, x = (8 + 12 * torch.randint(2, (2,), generator=g) * 3).tolist()
            frame[0, y : y + 4, x : x + 4] = 0
            frame[1:, y : y + 4, x + 4 : x + 8] = 0
        encoder.fit(frames)
        one = torch.cat([frames[:1], frames[:1]], 1)
        turned = torch.rot90(one, 1, (-2, -1))
        torch.testing.assert_close(encoder(one), encoder(turned), atol=2e-3, rtol=0.0)
        eighth = TurnedBearingEncoder(5, 64, pool_to=32, folds=1)
        eighth.load_state_dict(encoder.state_dict())
        assert float((eighth(one) - eighth(turned)).norm()) > 0.3

    @pytest.mark.parametrize("given", [dict(latent_dim=3), dict(latent_dim=5, turn_radius=0.0), dict(latent_dim=5, folds=0)])
    def test_sizes_that_are_not_valid(self, given):
        with pytest.raises(ConfigError, match="expected latent_dim >= 4"):
            TurnedBearingEncoder(**given)


class TestSine:
    def test_the_interval_holds_every_value(self):
        low = torch.rand(2000, generator=G(), dtype=torch.float64) * 20 - 10
        high = low + torch.rand(2000, generator=G(1), dtype=torch.float64) ** 3 * 8
        least, most = sine().interval(low, high)
        values = (low + torch.linspace(0, 1, 501, dtype=torch.float64)[:, None] * (high - low)).sin()
        assert bool((least <= values.amin(0)).all() and (most >= values.amax(0)).all())
        assert float((most - values.amax(0)).max()) < 1e-3
        assert float((values.amin(0) - least).max()) < 1e-3


@pytest.mark.parametrize("chooses", [False, True])
class TestProof:
    def test_the_graph_is_what_is_deployed(self, chooses):
        parts, loop = _parts(chooses), _loop(chooses)
        assert loop.latent_dim == 4
        assert check_deployed(loop, *parts, n=100) == 100 + 17

    def test_bounds_hold_everywhere(self, chooses):
        loop = _loop(chooses)
        low = loop.low + (loop.high - loop.low) * torch.rand(100, 4, generator=G(), dtype=torch.float64)
        high = torch.minimum(low + 0.3 * torch.rand(100, 1, generator=G(1), dtype=torch.float64), loop.high)
        least, most = Enclosure(loop.looped, low, high).interval()
        inside = low[:, None] + (high - low)[:, None] * torch.rand(100, 200, 4, generator=G(2), dtype=torch.float64)
        value = loop.looped(inside.flatten(0, 1)).reshape(100, 200, -1)
        assert bool((value.amin(1) >= least - 1e-9).all() and (value.amax(1) <= most + 1e-9).all())

    def test_a_counterexample_is_one_of_the_deployed_networks(self, chooses):
        barrier, dynamics, policy = _parts(chooses)
        found = decide_invariance(_loop(chooses))
        assert found.status == "refuted"
        latent = _loop(chooses).latent(found.witness[None]).float()
        assert float(barrier(latent)) <= 1e-5
        assert float(barrier(dynamics(latent, policy(latent)))) > 0

    def test_what_is_proved_holds_on_samples(self, chooses):
        """Whatever error of the proved size is added, of latents that lie on the circle before and after."""
        levels = torch.linspace(0.5, -0.5, 21).tolist()
        tried = ((seed, v) for seed in range(20) for v in levels if _loop(chooses, seed).accepted <= v)
        found = ((seed, v, largest_error(_loop(chooses, seed), level=v, tolerance=1e-2).delta) for seed, v in tried)
        seed, level, error = next(f for f in found if f[2] > 0)
        barrier, dynamics, policy = _parts(chooses, seed)
        chart = _charts(20000).float()
        latent = TURN.lift(chart)
        latent = latent[barrier(latent)[:, 0] <= level]
        assert len(latent) > 100
        after = dynamics(latent, policy(latent))
        way = torch.randn(after.shape, generator=G())
        moved = TURN.onto(after + TURN.shortened(error) * way / way.norm(dim=1, keepdim=True))
        assert float(barrier(moved).max()) <= level + 1e-5

    def test_counterexamples_are_latents(self, chooses):
        found = find_counterexamples(_loop(chooses), 8, generator=G())
        assert found.shape[1] == 5
        torch.testing.assert_close(found[:, 2:4].norm(dim=1), torch.full((len(found),), 0.3))


class TestRefused:
    def test_dynamics_of_another_radius(self):
        barrier, dynamics, policy = _parts()
        loop = _loop()
        dynamics.direction = Direction(2, 0.25)
        with pytest.raises(StructureError, match="differ"):
            check_deployed(loop, barrier, dynamics, policy, n=50)

    def test_a_direction_at_other_entries(self):
        barrier, dynamics, policy = _parts()
        loop = _loop()
        dynamics.direction = Direction(1, 0.3)
        with pytest.raises(StructureError):
            check_deployed(loop, barrier, dynamics, policy, n=50)

    def test_a_part_of_the_domain(self):
        with pytest.raises(ConfigError, match="whole domain"):
            closed_loop(*_parts(), latent_dim=5, lipschitz_bound=1.5, low=-0.5)

    def test_an_error_on_the_circle_counts(self):
        """What is tolerated is an error of the latent, along the circle too: with B = |angle| no error is left at the border."""
        barrier = nn.Sequential(nn.Linear(5, 1))
        nn.utils.vector_to_parameters(torch.tensor([0.0, 0.0, 0.0, 1.0, 0.0, 0.0]), barrier.parameters())  # r sin <= 0
        dynamics, policy = LatentDynamics(5, 1, (4,), 2.0, remembers=True, turn_radius=0.3), Policy(5, 1, (4,), 2.0)
        for q in (*dynamics.net.parameters(), *policy.net.parameters()):
            q.data.zero_()  # nothing moves
        loop = closed_loop(barrier, dynamics, policy, latent_dim=5, lipschitz_bound=1.0)
        assert tolerates(loop, 0.01, level=0.1).status == "refuted"
        assert decide_invariance(loop, level=0.1, margin=-1e-4).status == "proved"


def test_an_agent_comes_back_as_it_was(tmp_path):
    barrier = SandwichBarrier(5, (16, 16), 1.5)
    _, dynamics, policy = _parts()
    gain = torch.diag(torch.tensor([0.3, 0.3, 0.3, 0.3, 0.0]))
    agent = Agent.from_networks(TurnedBearingEncoder(5, 32, pool_to=16), dynamics, barrier, policy, gain=gain)
    agent.save(tmp_path / "agent")
    again = Agent.load(tmp_path / "agent")
    assert direction_of(again.dynamics) == TURN
    pixels = torch.randint(256, (4, 6, 32, 32), generator=G(), dtype=torch.uint8)
    first, second = agent.controller(4), again.controller(4)
    for _ in range(3):
        a, b = first.step(pixels), second.step(pixels)
    torch.testing.assert_close(a.latent, b.latent)
    torch.testing.assert_close(a.latent[:, 2:4].norm(dim=1), torch.full((4,), 0.3))
    for _ in range(200):  # nothing is seen: predictions of predictions stay on the circle
        blind = first.step(None)
    torch.testing.assert_close(blind.latent[:, 2:4].norm(dim=1), torch.full((4,), 0.3), rtol=1e-6, atol=0.0)
    agent.export(tmp_path / "agent.pt2", check=16)
