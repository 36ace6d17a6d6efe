"""The closed loop: the same numbers as a plain one, ends of episodes, memory, and whatever acts."""

from __future__ import annotations

import math

import pytest
import torch
from evaluation.systems import Counter, Predictor, World, lane, lane_agent, straight_ahead
from tensordict import TensorDict
from torch import nn

from torchrl_sspl.direction import direction_of, within
from torchrl_sspl.envs import DubinsEnv, PendulumEnv
from torchrl_sspl.errors import ConfigError, ShapeError
from torchrl_sspl.evaluation.controllers import AgentController, Camera, Decision, RandomController, as_controller
from torchrl_sspl.evaluation.simulation import Episodes, simulate
from torchrl_sspl.modules.agent import load
from torchrl_sspl.modules.observer import completed, corrected, held
from torchrl_sspl.sets import SAFE, UNSAFE

pytestmark = pytest.mark.filterwarnings("ignore::FutureWarning", "ignore::DeprecationWarning")
COLUMNS = ("states", "actions", "barrier", "prediction_error", "barrier_error")


@torch.no_grad()
def plain_loop(agent, env, start, horizon):
    """States, actions, barrier values and errors of the same episodes, step by step, all frames drawn as they come."""
    frames, head, turns = agent.encoder.frames, agent.encoder.head, direction_of(agent.dynamics)
    before, now = frames(env.draw(env.previous_state(start))), frames(env.draw(start))
    state, latent = start, within(head(before, now), turns)
    rows = [[start], [], [agent.barrier(latent)[:, 0]], [], []]
    for _ in range(horizon):
        action = agent.policy(latent)
        promised, moved = agent.dynamics(latent, action), env.wrap(env.dynamics(state, action))
        stays = ~env.state_space.contains(state) if env.exit_region == SAFE else torch.zeros(len(state), dtype=torch.bool)
        state = torch.where(stays[:, None], state, moved)
        gone = ~env.state_space.contains(state) if env.exit_region == SAFE else stays
        before, now = now, now.clone()
        if not gone.all():
            now[~gone] = frames(env.draw(state[~gone]))
            latent = latent.clone()
            seen = completed(head(before[~gone], now[~gone]), promised[~gone], agent.gain)
            seen = corrected(promised[~gone], seen, agent.gain, turns)[0]
            latent[~gone] = held(agent.barrier, promised[~gone], seen, agent.held_error, turns)[0]
        value = agent.barrier(latent)[:, 0]
        found = (state, action, value, (promised - latent).norm(dim=-1), value - agent.barrier(promised)[:, 0])
        fill = (None, None, -1.0, 0.0, 0.0)
        for row, x, v in zip(rows, found, fill, strict=True):
            row.append(x if v is None else torch.where(gone, v, x))
    return [torch.stack(row) for row in rows]


def test_what_changes_actions_sees_the_latents_of_all_and_its_own_are_taken():
    seen = []

    def less(latent, action):
        seen.append((latent, action))
        return action / 2

    env, agent = PendulumEnv(), load("pendulum")
    start = env.sample_states(4, torch.Generator().manual_seed(0), region=env.safe_set)
    run = simulate(AgentController(agent, change=less), env, start=start, horizon=3)
    for t, (latent, action) in enumerate(seen):
        assert torch.equal(latent, run.latent[t])
        assert torch.equal(action, agent.policy(latent))
        assert torch.equal(run.actions[t], action / 2)
    assert len(seen) == 3


@pytest.mark.parametrize(("name", "env"), [("pendulum", PendulumEnv(seed=0)), ("quadruped", DubinsEnv(seed=0))], ids=lambda x: str(x)[:9])
def test_rollouts_are_those_of_a_plain_loop_bit_for_bit(name, env):
    agent, start = load(name), env.sample_states(40, torch.Generator().manual_seed(1))
    found = simulate(agent, env, start=start, horizon=25)
    for column, expected in zip(COLUMNS, plain_loop(agent, env, start, 25), strict=True):
        assert torch.equal(getattr(found, column), expected), column
    assert torch.equal(found.region, torch.stack([env.region(x)[:, 0] for x in found.states]))


def test_each_frame_is_drawn_and_encoded_once(monkeypatch):
    env, agent, drawn, encoded = PendulumEnv(seed=0), load("pendulum"), [], []
    draw, frames = env.draw, agent.encoder.frames
    monkeypatch.setattr(agent.encoder, "frames", lambda x: encoded.append(len(x)) or frames(x))
    start = env.sample_states(3)
    simulate(agent, env, start=start, horizon=5, draw=lambda x: drawn.append(len(x)) or draw(x))
    assert sum(drawn) == sum(encoded) == 3 * 7


def test_encoders_without_halves_see_the_same_pictures():
    class Whole(nn.Module):
        def __init__(self, encoder):
            super().__init__()
            self.encoder, self.seen = encoder, []

        def forward(self, pixels):
            self.seen.append(pixels)
            return self.encoder(pixels)

    env, agent = DubinsEnv(seed=0, image_size=64), straight_ahead()
    agent.encoder = Whole(agent.encoder)
    start, drawn = torch.tensor([[1.75, 0.0, 0.0], [-1.0, 0.0, 0.0]]), []
    found = simulate(agent, env, start=start, horizon=4, draw=lambda x: drawn.append(len(x)) or env.draw(x))
    assert sum(drawn) == 2 * 2 + 2 + 2 + 1 + 1  # the first leaves in the third step
    assert torch.equal(agent.encoder.seen[1], env.observe(found.states[1], found.states[0]))
    assert torch.equal(agent.encoder.seen[3], env.observe(found.states[3, 1:], found.states[2, 1:]))


def test_who_leaves_an_arena_safely_is_not_alive_behind_its_end():
    env = DubinsEnv(seed=0, image_size=64)
    found = simulate(straight_ahead(0.3), env, start=torch.tensor([[1.75, 0.0, 0.0], [-1.0, 0.0, 0.0]]), horizon=6)
    assert found.alive[:, 0].tolist() == [True] * 4 + [False] * 3  # 1.75, 1.85, 1.95, 2.05 m
    assert found.alive[:, 1].all()
    assert found.events["left"].tolist() == [True, False]
    assert torch.equal(found.states[3, 0], found.states[6, 0])
    assert (found.barrier[:, 0] == torch.tensor([0.3] * 3 + [-1.0] * 4)).all()
    assert (found.prediction_error[2:, 0] == 0).all()
    assert (found.region[3:, 0] == SAFE).all()


def test_who_leaves_where_that_is_unsafe_goes_on():
    env = PendulumEnv(seed=0, image_size=32)
    found = simulate(lambda pixels: torch.full((len(pixels),), 2.0), env, start=torch.tensor([[0.5, 3.4]]), horizon=20)
    assert found.events["left"].all()
    assert found.alive.all()
    assert (found.region[1:] == UNSAFE).any()
    assert not torch.equal(found.states[-1], found.states[-2])


def test_episodes_end_where_the_system_ends_them():
    found = simulate(lane_agent(3.0), lane((3,)), episodes=5, horizon=8, film=1)
    assert found.barrier.shape == (9, 5)
    assert found.frames.shape == (9, 1, 3, 16, 16)
    x = found.latent[..., 0] * 16
    for k in range(5):
        life = int(found.alive[:, k].sum())
        assert found.alive[:life, k].all()
        assert not found.alive[life:, k].any()
        path = x[:life, k]
        assert torch.equal(path, found.states[:life, k, 0])
        assert (path.diff() <= 3.0).all()
        assert (path[:-1] <= 12).all()
        assert path[-1] > 12


def test_prediction_errors_compare_with_what_was_seen():
    found = simulate(lane_agent(1.0), lane((4,)), episodes=4, horizon=3)
    assert found.prediction_error[found.alive[1:]].max() < 1e-5
    assert found.barrier_error[found.alive[1:]].abs().max() < 1e-5
    off = lane_agent(1.0)
    off.dynamics = nn.Identity()
    off.dynamics.forward = lambda latent, action: latent
    wrong = simulate(off, lane((4,)), episodes=4, horizon=3)
    assert wrong.prediction_error[wrong.alive[1:]] == pytest.approx(1 / 16)
    assert wrong.barrier_error[wrong.alive[1:]] == pytest.approx(1 / 16)


def test_a_controller_with_memory_is_reset_where_an_episode_ends():
    acts = Counter(3)
    found = simulate(acts, lane((3,)), episodes=3, horizon=9)
    # Where the first of the three ends, only its memory goes.
    assert acts.resets[0] is None
    assert len(acts.resets) > 1
    for k in range(3):
        life = int(found.alive[:, k].sum()) - 1
        assert found.actions[:life, k, 0].tolist() == list(range(1, life + 1))
    again = [rows for rows in acts.resets[1:] if rows is not None]
    assert all(0 < len(rows) < 3 for rows in again)
    # Two batches: everything is forgotten between them.
    acts = Counter(2)
    simulate(acts, lane((2,), horizon=2), episodes=4, horizon=5)
    assert acts.resets.count(None) == 2


def test_memory_belongs_to_rows_also_where_some_have_left():
    acts = Counter(2)
    env = DubinsEnv(seed=0, image_size=32)
    found = simulate(acts, env, start=torch.tensor([[1.95, 0.0, 0.0], [-1.0, 0.0, 0.0]]), horizon=4)
    assert found.actions[:, :, 0].T.tolist() == [[1.0, 1.0, 1.0, 1.0], [1.0, 2.0, 3.0, 4.0]]


def test_anything_that_acts_gives_the_same_episodes():
    env, start = PendulumEnv(seed=0, image_size=32), torch.tensor([[0.3, 0.1], [-0.2, 0.4]])

    class WithAct:
        def act(self, pixels):
            return torch.full((len(pixels), 1), 0.7), torch.full((len(pixels), 1), -0.5)

    class OfTorchRL(nn.Module):
        in_keys, out_keys = ("pixels",), ("action",)

        def forward(self, td):
            return td.set("action", torch.full((len(td["pixels"]), 1), 0.7))

    policies = {
        "function": lambda pixels: torch.full((len(pixels),), 0.7),
        "on states": as_controller(lambda state: torch.full((len(state), 1), 0.7), reads="state"),
        "predict": Predictor(0.7),
        "its method": Predictor(0.7).predict,
        "act": WithAct(),
        "TorchRL": OfTorchRL(),
    }
    found = {name: simulate(acts, env, start=start, horizon=4) for name, acts in policies.items()}
    for name, episodes in found.items():
        assert torch.equal(episodes.states, found["function"].states), name
        assert (episodes.actions == 0.7).all()
        assert (episodes.barrier is not None) == (name == "act")
        assert episodes.latent is episodes.prediction_error is None
    assert (found["act"].barrier == -0.5).all()
    assert isinstance(as_controller(load("pendulum")), AgentController)


@pytest.mark.parametrize(
    ("acts", "error"),
    [
        (3, ConfigError),
        (lambda pixels: None, ConfigError),
        (lambda pixels: (torch.zeros(2), "memory"), ConfigError),
        (lambda pixels: torch.zeros(5), ShapeError),
        (lambda pixels: (torch.zeros(2), torch.zeros(3)), ShapeError),
        (as_controller(lambda x: x, reads="smell"), ConfigError),
    ],
    ids=["number", "nothing", "memory", "actions", "barrier", "reads"],
)
def test_what_does_not_act_is_named(acts, error):
    with pytest.raises(error, match="controller"):
        simulate(acts, PendulumEnv(seed=0, image_size=32), start=torch.zeros(2, 2), horizon=1)


def test_it_has_to_be_said_what_is_run():
    env, acts = lane((2,)), lambda pixels: torch.zeros(len(pixels))
    for wrong in ({"horizon": 0, "episodes": 2}, {"horizon": 2}, {"horizon": 2, "start": torch.zeros(2, 1)}):
        with pytest.raises(ConfigError, match="simulate"):
            simulate(acts, env, **wrong)


def test_an_agent_watches_while_another_drives():
    env = lane((4,), horizon=6)
    watched = simulate(AgentController(lane_agent(0.0), driver=lambda pixels: torch.full((len(pixels),), 2.0)), env, episodes=4, horizon=6)
    assert (watched.actions == 2.0).all()
    assert watched.prediction_error[watched.alive[1:]].max() < 1e-5  # predictions are about the actions taken
    assert torch.allclose(watched.barrier, (watched.latent[..., 0] * 16 - 9.4) / 16)


def test_random_actions_depend_on_the_number_of_steps_only():
    low, high = torch.tensor([-3.0]), torch.tensor([3.0])
    fills = RandomController(low, high, 5)
    many = torch.cat([fills.step(torch.zeros(100, 1)).action for _ in range(20)])
    assert many.min() < -2.9
    assert many.max() > 2.9
    # Two batches of five steps take ten draws of three rows: no more where episodes end on the way.
    right = torch.zeros(1)
    found = simulate(RandomController(right, high, 5), lane((3,), seed=3), episodes=6, horizon=5)
    assert not found.alive[-1, :3].all()
    assert found.alive[-1, :3].any()
    generator = torch.Generator().manual_seed(5)
    drawn = torch.stack([3.0 * torch.rand(3, 1, generator=generator) for _ in range(10)])
    taken = torch.cat([found.actions[:, :3], found.actions[:, 3:]])
    lived = torch.cat([found.alive[:-1, :3], found.alive[:-1, 3:]])
    assert torch.equal(taken[lived], drawn[lived])


def test_joined_episodes_are_both_and_selected_ones_a_part():
    first, second = (simulate(lane_agent(1.0), lane((4,), seed), episodes=4, horizon=3, film=1) for seed in (0, 1))
    both = first.joined(second)
    assert both.alive.shape == (4, 8)
    assert torch.equal(both.latent[:, 4:], second.latent)
    assert torch.equal(both.frames, first.frames)
    part = both.select(torch.tensor([5, 0]))
    assert torch.equal(part.barrier, both.barrier[:, [5, 0]])
    assert part.frames is None
    assert len(both.select(both.barrier[0] > 9)) == 0
    bare = Episodes(first.actions, first.region, first.alive, events={"left": first.alive[0]})
    assert first.joined(bare).barrier is None


def test_many_episodes_of_a_bare_policy_are_drawn_in_parts():
    env, sizes = PendulumEnv(seed=0, image_size=16), []

    def acts(pixels):
        sizes.append(len(pixels))
        return torch.zeros(len(pixels))

    found = simulate(acts, env, start=env.sample_states(2100), horizon=1, film=1050)
    assert max(sizes) == 1000
    assert len(found) == 2100
    assert found.frames.shape[1] == 1050


def test_a_walk_ends_where_the_arena_does():
    found = simulate(straight_ahead(), World(), start=torch.tensor([[1.75, 0.0, 0.0]]), horizon=20, film=1)
    assert {name: bool(e) for name, e in found.events.items()} == {"entered": False, "hit": False, "fallen": False, "left": True}
    assert int(found.alive.sum()) == 4
    assert found.alive.shape == (21, 1)
    assert found.frames.dtype == torch.uint8
    assert found.states.dtype == torch.float32
    assert found.region[3, 0] != UNSAFE


def test_a_walk_through_the_middle_enters_and_goes_on():
    found = simulate(straight_ahead(), World(), start=torch.tensor([[-1.5, 0.0, 0.0]]), horizon=12)
    assert found.events["entered"].all()
    assert not found.events["left"].any()
    assert found.alive.all()
    assert (found.region[-1] == UNSAFE).all()


@pytest.mark.parametrize(
    ("acts", "env", "where"),
    [
        (lambda pixels: torch.zeros(len(pixels), 1), PendulumEnv(image_size=16), {"start": torch.tensor([[0.1, 0.0], [2.5, 0.0]])}),
        (lane_agent(3.0), lane((1,)), {"episodes": 2}),
        (straight_ahead(), World(), {"start": torch.tensor([[-1.5, 0.0, 0.0]])}),
    ],
)
def test_who_watches_is_told_of_every_observation_and_may_end_it(acts, env, where):
    told = []
    found = simulate(acts, env, horizon=4, watch=lambda decision, region: told.append((decision, region.tolist())), **where)
    episodes = [found] if len(told[0][1]) == len(found) else [found.select([k]) for k in range(len(found))]
    assert [region for _, region in told] == [row for e in episodes for row, alive in zip(e.region.tolist(), e.alive, strict=True) if alive.any()]
    assert all(isinstance(decision, Decision) for decision, _ in told)

    def stop(*_):
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        simulate(acts, env, horizon=4, watch=stop, **where)


@pytest.mark.parametrize(("fault", "event"), [("contact", "hit"), ("fallen", "fallen")])
def test_contacts_and_falls_are_kept(fault, event):
    found = simulate(straight_ahead(), World(**{fault: 2}), start=torch.tensor([[-1.5, 1.8, 0.0]]), horizon=6)
    assert found.events[event].all()
    assert int(found.alive.sum()) - 1 == (2 if fault == "fallen" else 6)


def test_walks_have_seeds_that_count_on_and_a_memory_that_does_not():
    world, acts = World(), Counter(1)
    starts = torch.tensor([[1.9, 0.0, 0.0], [1.8, 0.0, 0.0], [-1.0, 1.0, math.pi]])
    found = simulate(acts, world, start=starts, horizon=3, seed=7)
    assert world.seeds == [7, 8, 9]
    assert acts.resets == [None] * 3
    assert (found.actions[0] == 1).all()


def test_a_camera_draws_the_states_it_is_turned_to():
    env = PendulumEnv(seed=0, image_size=16)
    x = env.sample_states(3)
    camera = Camera(env.draw, x, env.previous_state(x))
    first = torch.cat(list(camera.pixels()))
    assert torch.equal(first, env.observe(x))
    y = env.wrap(env.dynamics(x, torch.ones(3, 1)))
    camera.move(y[1:], torch.tensor([1, 2]))
    assert torch.equal(torch.cat(list(camera.pixels())), env.observe(y[1:], x[1:]))


def test_decisions_are_put_into_rows():
    all_three, one = Decision(torch.zeros(3, 1), torch.zeros(3)), Decision(None, torch.ones(1))
    put = all_three.put(torch.tensor([1]), one)
    assert put.barrier.tolist() == [0, 1, 0]
    assert torch.equal(put.action, all_three.action)
    assert put.latent is None


def test_tensordict_policies_see_the_key_they_read():
    class OnState(nn.Module):
        in_keys, out_keys = ("state",), ("action",)

        def forward(self, td: TensorDict) -> TensorDict:
            return td.set("action", -td["state"][:, 1:])

    found = simulate(OnState(), PendulumEnv(seed=0, image_size=16), start=torch.tensor([[0.0, 0.5]]), horizon=1)
    assert found.actions.item() == -0.5


def test_what_happens_in_a_reset_belongs_to_the_episode():
    class Bumped(World):
        def reset(self, *, seed=None, options=None):
            observation, info = super().reset(seed=seed, options=options)
            return observation, info | {"contact": True}

    def still(pixels):
        return torch.zeros(len(pixels), 1)

    found = simulate(still, Bumped(), start=torch.tensor([[-1.8, -1.8, 0.0]]), horizon=2)
    assert bool(found.events["hit"])
    assert not bool(simulate(still, World(), start=torch.tensor([[-1.8, -1.8, 0.0]]), horizon=2).events["hit"])
