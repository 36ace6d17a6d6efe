"""Experiments: exploration, episodes and what is counted on them, the level of the set, and going on after a stop."""

from __future__ import annotations

import json
import shutil
from functools import partial
from types import SimpleNamespace

import gymnasium
import numpy as np
import pytest
import torch
from gymnasium import spaces
from tensordict import TensorDict
from tiny import TINY_EXPERIMENT
from torch import nn

from torchrl_sspl.certification import Certificate, Layer, Reason, Statement
from torchrl_sspl.cli import evaluate_agent
from torchrl_sspl.envs.gymnasium import GymnasiumPixels
from torchrl_sspl.errors import CheckpointError, ConfigError
from torchrl_sspl.modules.agent import Agent, mlp_barrier
from torchrl_sspl.sets import SAFE, UNLABELLED, UNSAFE
from torchrl_sspl.trainers import certify as certify_module
from torchrl_sspl.trainers import certify_on_episodes
from torchrl_sspl.trainers.description import describe, differences
from torchrl_sspl.trainers.episodes import Episodes, evaluate_episodes, run_episodes, separating_level
from torchrl_sspl.trainers.experiment import Experiment, ExploringPolicy, run_experiment
from torchrl_sspl.trainers.experiment_config import EpisodesConfig, experiment_config
from torchrl_sspl.trainers.guidance import advice
from torchrl_sspl.trainers.hooks import RestartHook
from torchrl_sspl.trainers.latents import LatentTraining
from torchrl_sspl.trainers.stepper import SSPLStepper

pytestmark = pytest.mark.filterwarnings("ignore::FutureWarning", "ignore::DeprecationWarning")


class Lane(gymnasium.Env):
    """A point at 0..15 moves by the action; beyond 12 the episode ends."""

    render_mode = "rgb_array"
    observation_space = spaces.Box(0, 20, (1,), np.float64)
    action_space = spaces.Box(-3.0, 3.0, (1,), np.float32)

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.x = float(self.np_random.integers(1, (options or {}).get("below", 9)))
        return np.array([self.x]), {}

    def step(self, action):
        self.x = float(np.clip(self.x + float(action[0]), 0, 15))
        return np.array([self.x]), 0.0, self.x > 12, False, {}

    def render(self):
        picture = np.zeros((16, 16, 3), np.uint8)
        picture[:, round(self.x)] = 255
        return picture


def lane(batch_size=(4,), seed=0, make=Lane, **options) -> GymnasiumPixels:
    sets = {"safe": lambda state, info: state[0] < 3, "unsafe": lambda state, info: state[0] > 10}
    return GymnasiumPixels(make, batch_size=batch_size, seed=seed, image_size=16, **(sets | options))


class Where(nn.Module):
    """Latent (x, 0) / 16, read from the second frame."""

    def __init__(self) -> None:
        super().__init__()
        self.scale = nn.Parameter(torch.ones(1))

    def forward(self, pixels: torch.Tensor) -> torch.Tensor:
        x = pixels[..., 3, 0, :].float().argmax(-1, keepdim=True) / 16
        return torch.cat([self.scale * x, torch.zeros_like(x)], -1)


class Move(nn.Module):
    def forward(self, latent: torch.Tensor, action: torch.Tensor) -> torch.Tensor:
        return latent + torch.cat([action, torch.zeros_like(action)], -1) / 16


class Push(nn.Module):
    def __init__(self, by: float) -> None:
        super().__init__()
        self.by = by

    def forward(self, latent: torch.Tensor) -> torch.Tensor:
        return torch.full_like(latent[..., :1], self.by)


def agent(by: float, border: float = 9.4) -> Agent:
    """B = (x - border) / 16, and a policy that always moves by the same."""
    barrier = mlp_barrier(2, [])
    with torch.no_grad():
        barrier[0].weight.copy_(torch.tensor([[1.0, 0.0]]))
        barrier[0].bias.fill_(-border / 16)
    return Agent(Where(), Move(), barrier, Push(by), 2.0)


def test_episodes_end_where_the_system_ends_them():
    episodes = run_episodes(agent(3.0), lane((3,)), 5, horizon=8)
    assert episodes.barrier.shape == (9, 5)
    x = episodes.latent[..., 0] * 16
    for k in range(5):
        life = int(episodes.alive[:, k].sum())
        assert episodes.alive[:life, k].all()
        path = x[:life, k]
        assert torch.allclose(path.diff().clamp_max(3.0), path.diff())
        assert (path[:-1] <= 12).all()
        assert path[-1] > 12
    assert len(episodes.film) == int(episodes.alive[:, 0].sum())


def test_prediction_errors_compare_with_what_was_seen():
    episodes = run_episodes(agent(1.0), lane((4,)), 4, horizon=3)
    assert episodes.prediction_error[episodes.alive[1:]].max() < 1e-5
    off = agent(1.0)
    off.dynamics = nn.Identity()
    off.dynamics.forward = lambda latent, action: latent
    wrong = run_episodes(off, lane((4,)), 4, horizon=3)
    assert wrong.prediction_error[wrong.alive[1:]] == pytest.approx(1 / 16)


@pytest.mark.parametrize(
    ("border", "drawn"),
    [
        pytest.param(8.9, [40], id="all starts inside"),
        pytest.param(2.4, [40] + 8 * [10], id="a quarter of them"),
        pytest.param(-1.0, [40], id="none"),
    ],
)
def test_certificates_draw_until_enough_episodes_count(border, drawn, monkeypatch):
    asked, at_random = [], []

    def counted(agent, env, n, horizon, act=None, **options):
        (asked if act is None else at_random).append(n)
        return run_episodes(agent, env, n, horizon, act, **options)

    monkeypatch.setattr(certify_module, "run_episodes", counted)
    certificate = certify_on_episodes(agent(0.0, border), lane, level=0.0, episodes=40, horizon=3, envs=20)
    assert asked == drawn
    assert sum(at_random) == 120  # three steps seldom lead into U
    measured = certificate.layers["statistical"]
    if border < 0:
        assert Reason.NOT_MEASURED in measured.reasons
    else:
        assert measured["episodes"].n == pytest.approx(sum(drawn) * (1.0 if border > 8 else 0.25), rel=0.5)


def test_joined_episodes_are_both():
    first, second = (run_episodes(agent(1.0), lane((4,), seed), 4, horizon=3) for seed in (0, 1))
    both = first.joined(second)
    assert both.alive.shape == (4, 8)
    assert torch.equal(both.latent[:, 4:], second.latent)
    assert torch.equal(both.film, first.film)


def test_measurements_count_episodes():
    sizes = EpisodesConfig(episodes=10, envs=5, horizon=8)
    away = evaluate_episodes(agent(3.0), lane, sizes)
    assert away["touch_unsafe"] == away["leave"] == 1.0  # every episode drives to the end
    assert away.measurements["touch_unsafe"].n == 10
    still = evaluate_episodes(agent(0.0), lane, sizes)
    assert still["touch_unsafe"] == still["leave"] == 0.0
    assert still["unsafe_called_safe"] in (None, 0.0)  # pictures show whole numbers, so the border lies at 9.5
    loose = evaluate_episodes(agent(3.0, border=11.5), lane, sizes)
    assert loose["unsafe_called_safe"] > 0.0
    tight = evaluate_episodes(agent(3.0, border=0.5), lane, sizes)
    assert tight["starts_inside"] == 0.0
    assert tight["touch_unsafe"] is None
    assert tight["safe_called_unsafe"] == 1.0


def test_the_level_keeps_held_out_observations_of_U_outside():
    def episodes(barrier, region, alive=None):
        value = torch.tensor(barrier)[:, None]
        kept = torch.ones_like(value, dtype=torch.bool) if alive is None else torch.tensor(alive)[:, None]
        codes = torch.tensor(region)[:, None]
        return Episodes(value[..., None], value, codes, kept, value[1:], torch.zeros(1))

    assert separating_level([episodes([-0.3, 0.5], [SAFE, UNSAFE])], 0.02) == 0.0  # never raised
    assert separating_level([episodes([-0.3, -0.1], [SAFE, UNSAFE])], 0.02) == pytest.approx(-0.12)
    assert separating_level([episodes([-0.3, -0.1], [SAFE, UNSAFE], [True, False])], 0.02) == 0.0
    assert separating_level([episodes([-0.3, -0.1], [SAFE, UNLABELLED])], 0.02) == 0.0
    # With a reserve: to the middle between S and U, no lower than the reserve unless U asks for it, and not for nothing.
    for safe, unsafe, level in ((-0.2, 0.1, -0.05), (-0.4, 0.1, -0.1), (-0.4, -0.2, -0.22), (0.1, 0.2, 0.0), (0.1, 0.01, -0.01)):
        assert separating_level([episodes([safe, unsafe], [SAFE, UNSAFE])], 0.02, 0.1) == pytest.approx(level)


def test_exploration_is_random_in_its_share_of_the_environments():
    policy = nn.Identity()
    policy.forward = lambda td: td.set("action", torch.zeros(*td.shape, 1))
    explore = ExploringPolicy(policy, torch.tensor([-2.0]), torch.tensor([2.0]), exploration=0.0, random_share=0.5)
    actions = torch.stack([explore(TensorDict(pixels=torch.zeros(4, 1), batch_size=4))["action"] for _ in range(50)])
    assert (actions[:, 2:] == 0).all()
    assert actions[:, :2].std() > 0.8
    assert actions.abs().max() <= 2.0
    noisy = ExploringPolicy(policy, torch.tensor([-2.0]), torch.tensor([2.0]), exploration=0.1, random_share=0.0)
    actions = torch.stack([noisy(TensorDict(pixels=torch.zeros(4, 1), batch_size=4))["action"] for _ in range(200)])
    assert actions.std() == pytest.approx(0.2, rel=0.2)
    alone = ExploringPolicy(policy, torch.tensor([-2.0]), torch.tensor([2.0]), exploration=0.0, random_share=0.5)
    actions = torch.stack([alone(TensorDict(pixels=torch.zeros(1, 1), batch_size=1))["action"] for _ in range(200)])
    assert (actions == 0).float().mean() == pytest.approx(0.5, abs=0.15)


SMALL = [
    "trainer.optim_steps_per_batch=2", "trainer.warm_start_steps=1", "trainer.progress=false", "trainer.checkpoint_every=0",
    "collector.frames_per_batch=64", "collector.envs=8", "collector.init_random_frames=64", "network.pool_to=8",
    "network.barrier_hidden=[8]", "network.policy_hidden=[8]", "network.dynamics_hidden=[8]", "buffer.batch=16",
    "evaluation.episodes=4", "evaluation.envs=4", "evaluation.horizon=4",
    *TINY_EXPERIMENT,
]  # fmt: skip


def everywhere(batch_size, seed, below=13) -> GymnasiumPixels:
    return lane(batch_size, seed, reset_options={"below": below})


def build(folder, *more: str) -> Experiment:
    return Experiment(experiment_config([*SMALL, *more, f"out_dir={folder}"], **{"logger.kind": "none"}), everywhere)


class Stopped(Exception):
    pass


@pytest.mark.parametrize("restarts", [0, 1])
def test_a_stopped_experiment_goes_on_to_the_same_agent(restarts, tmp_path, monkeypatch):
    words = ["trainer.total_frames=256", f"trainer.restarts={restarts}"]
    straight = build(tmp_path / "straight", *words).train()
    first = build(tmp_path / "stopped", *words)

    def stop_in_third_batch(batch):
        if first.trainer.collected_frames > 128:
            raise Stopped
        return batch

    first.trainer.register_op("batch_process", stop_in_third_batch)
    with pytest.raises(Stopped):
        first.train()
    second = build(tmp_path / "stopped", *words)

    def stop_in_tune(training):
        if training.phases()[training.phase][0] == "tune":
            raise Stopped

    with monkeypatch.context() as patch:
        patch.setattr(LatentTraining, "_after_step", stop_in_tune)
        with pytest.raises(Stopped):
            second.train()
    assert second.trainer.collected_frames == 256
    third = build(tmp_path / "stopped", *words)
    weights = third.train().state_dict()
    assert third.trainer.optimization_stepper.count == 2 * (4 - restarts)  # the fresh start forgets the first batch's steps
    for name, value in straight.state_dict().items():
        assert torch.equal(value, weights[name]), name


def test_without_success_it_starts_again_with_other_weights_and_says_so(tmp_path):
    words = ["trainer.total_frames=320", "trainer.restarts=2", "optim.lr=0.0", "synthesis.enabled=false"]
    experiment = build(tmp_path, *words)
    starts = []
    experiment.trainer.register_op("post_steps", lambda: starts.append(next(experiment.encoder.parameters()).sum().item()))
    experiment.train()
    assert experiment.trainer.optimization_stepper.count == 2 * 3  # batches 1, 2, 3 to 5
    assert (len(starts), len(set(starts))) == (5, 3)
    assert any("did not tell S from U" in text for text in experiment.warnings)
    # The same with labels that the first weights tell apart: none of it happens.
    content = build(tmp_path / "content", *words, "trainer.warm_start_error=2.5")
    content.train()
    assert content.trainer.optimization_stepper.count == 2 * 5
    assert not any("did not tell S from U" in text for text in content.warnings)
    # A barrier that never learnt leaves no set: the level that excludes U excludes every reset, and this is said too.
    assert any("no held-out reset lies in the set" in text for text in content.warnings)


def test_a_start_that_still_improves_is_not_given_up():
    class Loss(nn.Module):
        def __init__(self, value: float) -> None:
            super().__init__()
            self.weight = nn.Parameter(torch.tensor(value))
            self.register_buffer("safety_margin", torch.tensor(value))
            self.register_buffer("dynamics_margin", torch.tensor(value))

    stepper = SSPLStepper(torch.optim.Adam([nn.Parameter(torch.zeros(1))]), warm_start_error=0.05)
    trainer = SimpleNamespace(optimization_stepper=stepper, loss_module=Loss(0.0))
    hook = RestartHook(trainer, lambda attempt: Loss(float(attempt)), after=100, most=2)
    for count, mislabelled, restarts in (
        (0, 2.0, 0),  # nothing was done yet
        (50, 1.9, 0),  # no better, but early
        (100, 0.9, 0),  # better
        (150, 0.5, 0),
        (200, 0.45, 1),  # no longer
        (100, 0.5, 2),  # the second start no better than the first one was
        (100, 0.5, 2),  # twice is all
    ):
        stepper.count, stepper.mislabelled = count, mislabelled
        hook()
        assert hook.restarts == restarts
    stepper.count, stepper.mislabelled, hook.restarts = 200, 0.04, 0
    hook()
    assert hook.restarts == 0  # told apart
    assert trainer.loss_module.weight.item() == 2.0
    assert trainer.loss_module.safety_margin.item() == trainer.loss_module.dynamics_margin.item() == 0.0
    with pytest.raises(ConfigError, match="after >= 1"):
        RestartHook(trainer, lambda attempt: None, after=0, most=1)


def test_what_follows_the_joint_training_starts_anew_on_other_latents(tmp_path):
    build(tmp_path, "trainer.total_frames=128").train()
    longer = build(tmp_path, "trainer.total_frames=256", "optim.schedule=constant")
    longer.train()
    latents = torch.load(tmp_path / "synthesis" / "checkpoint.pt", weights_only=True)["latents"]
    assert len(latents["latent"]) == 256
    assert (tmp_path / "synthesis" / "log.jsonl").read_text().count('"phase": "teach"') == 1
    changed = build(tmp_path, "trainer.total_frames=256", "optim.schedule=constant", "synthesis.margin=0.2")
    with pytest.raises(ConfigError, match="another one"):
        changed.train()
    # An encoder trained anew in the same folder has other latents: what was trained on the old ones is not used.
    shutil.rmtree(tmp_path / "checkpoints")
    other = build(tmp_path, "trainer.total_frames=256", "seed=1")
    agent = other.train()
    seen = other.store.get(torch.arange(256))["frames"][:, :2].flatten(1, 2)
    latents = torch.load(tmp_path / "synthesis" / "checkpoint.pt", weights_only=True)["latents"]
    assert torch.equal(agent.encode(seen), latents["latent"])


@pytest.mark.parametrize("never", ["safe", "unsafe"])
def test_a_set_that_is_never_seen(never, tmp_path):
    sets = {"safe": lambda state, info: state[0] < 3, "unsafe": lambda state, info: state[0] > 10}
    sets[never] = lambda state, info: False

    def env(batch_size, seed):
        return GymnasiumPixels(Lane, batch_size=batch_size, seed=seed, image_size=16, reset_options={"below": 13}, **sets)

    words = [*SMALL, f"buffer.{never}=0", "trainer.total_frames=128", f"out_dir={tmp_path}"]
    experiment = Experiment(experiment_config(words, **{"logger.kind": "none"}), env)
    experiment.train()
    assert ("0 of 128 transitions start in U" in "".join(experiment.warnings)) == (never == "unsafe")
    assert (experiment.synthesis_dir is None) == (never == "unsafe")


def test_of_many_transitions_those_of_the_sets_come_first(tmp_path):
    experiment = build(tmp_path, "trainer.total_frames=256")
    experiment.train()
    region = experiment.store.region
    few = experiment._transitions(100)
    assert len(few) == len(set(few.tolist())) == 100
    labelled = int((region != UNLABELLED).sum())
    assert int((region[few] != UNLABELLED).sum()) >= min(50, labelled) > 10
    assert experiment._transitions(1000).tolist() == list(range(256))


def test_a_finished_experiment_is_not_trained_again_and_another_one_is_refused(tmp_path):
    first = build(tmp_path, "trainer.total_frames=128").train().state_dict()
    again = build(tmp_path, "trainer.total_frames=128")
    weights = again.train().state_dict()
    assert again.trainer.optimization_stepper.count == 2 * 2
    assert all(torch.equal(value, weights[name]) for name, value in first.items())
    other = build(tmp_path, "trainer.total_frames=128", "network.barrier_hidden=[16]")
    with pytest.raises(CheckpointError, match=r"barrier_hidden: \[8\], now \[16\]\); use another out_dir"):
        other.train()
    other.trainer.collector.shutdown()
    config = experiment_config([*SMALL, "trainer.total_frames=128", f"out_dir={tmp_path}"], **{"logger.kind": "none"})
    moved = Experiment(config, partial(everywhere, below=12))
    with pytest.raises(CheckpointError, match=r"env.*now.*use another out_dir"):
        moved.train()
    moved.trainer.collector.shutdown()


LIMIT = 1.0


def near(state, info):
    return abs(state[0]) < LIMIT


def test_descriptions_tell_systems_apart(monkeypatch):
    def system(border: float, **more):
        return partial(GymnasiumPixels, Lane, safe=near, unsafe=lambda state, info: state[0] > border, **more)

    one = describe(system(2.0, image_size=32))
    assert one == describe(system(2.0, image_size=32)) == json.loads(json.dumps(one))
    assert one["made by"] == "torchrl_sspl.envs.gymnasium.GymnasiumPixels"
    assert differences(one, describe(system(2.0, image_size=48))) == ["image_size: 32, now 48"]
    assert [d.split(":")[0] for d in differences(one, describe(system(3.0, image_size=32)))] == ["unsafe"]
    monkeypatch.setitem(globals(), "LIMIT", 2.0)
    assert [d.split(":")[0] for d in differences(one, describe(system(2.0, image_size=32)))] == ["safe"]


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"make_env": lane()}, "make_env: expected a function .* received an object of type GymnasiumPixels"),
        ({"make_env": Lane}, "make_env: expected a function .* received one that raises TypeError"),
        ({"encoder": Where()}, "encoder: expected a class or a function .* received a module; give its class, Where"),
        ({"encoder": Where}, "encoder: expected a class or a function .* received one that raises TypeError"),
        ({"encoder": lambda p: nn.Flatten()}, r"shape \(\*batch, network.latent_dim=3\), received \(1, 1536\)"),
        ({"encoder": lambda p: nn.Sequential(nn.Flatten(), nn.Linear(1536, p))}, "received RuntimeError.*begins with pixels.float"),
        ({"encoder": lambda p: Scaled(p, 9.0)}, r"latents in \[-1, 1\], received up to .*nn.Tanh"),
        ({"overrides": "seed=1"}, "overrides: expected a list of key=value strings .*, received a str"),
        ({"overrides": {"seed": 1}}, "overrides: expected a list of key=value strings .*, received a dict"),
        ({"overrides": ["env.image_size=48"]}, "no setting of env .* received env.image_size; set it there"),
        ({"make_env": partial(lane, make=Lane())}, "make: expected a function that makes an environment"),
        ({"make_env": partial(lane, reset_options=lambda: {})}, "reset_options: expected a mapping, or a function"),
        ({"make_env": partial(lane, safe=lambda state: True)}, r"safe: expected a predicate \(observation, info\)"),
        ({"make_env": partial(lane, unsafe=lambda s, i: np.ones(2) > s)}, "unsafe: expected a predicate .* ValueError"),
    ],
)
def test_mistakes_are_named_before_anything_is_trained(options, message, tmp_path):
    given = {"make_env": lane, "overrides": [], **options}
    with pytest.raises(ConfigError, match=message):
        run_experiment(given.pop("make_env"), given.pop("overrides"), out_dir=str(tmp_path), **given)


class Scaled(nn.Module):
    def __init__(self, latent_dim: int, scale: float) -> None:
        super().__init__()
        self.latent_dim, self.scale = latent_dim, scale

    def forward(self, pixels: torch.Tensor) -> torch.Tensor:
        return self.scale * torch.ones(len(pixels), self.latent_dim)


def test_advice_follows_the_reasons(tmp_path):
    def said(deterministic: str, statistical: str) -> list[str]:
        rows = {"deterministic": deterministic, "statistical": statistical}
        layers = {
            name: Layer(name, [Statement("s", "s", "measured", not reason, reason=reason)]) for name, reason in rows.items()
        }
        return advice(Certificate("a", "w", "c", 0.0, layers), experiment_config())

    assert said("", "") == []
    (line,) = said("NOT_INVARIANT", "EPISODES_LEAVE")
    assert "network.latent_dim, now 3" in line
    assert "network.pool_to = 32" in line
    assert "certificate_episodes, now 1000" in said("", "TOO_FEW")[0]
    assert len(said("UNDECIDED", "UNSAFE_INSIDE")) == 2


def test_an_agent_of_a_system_in_code_is_not_measured_on_another(tmp_path):
    build(tmp_path, "trainer.total_frames=128").train()
    with pytest.raises(CheckpointError, match="it was given in code; call evaluate_episodes"):
        evaluate_agent(str(tmp_path))


def test_certificates_say_how_long_episodes_were():
    certificate = certify_on_episodes(agent(0.0), partial(lane, horizon=5), level=0.0, episodes=8, horizon=9, envs=4)
    assert certificate.layers["statistical"]["episodes"].text.startswith("episodes of 5 steps")


def test_environments_without_labels_are_refused(tmp_path):
    from torchrl_sspl.envs import PendulumEnv

    def unlabelled(batch_size, seed):
        env = PendulumEnv(batch_size=batch_size, seed=seed, image_size=16)
        del env.observation_spec["region"]
        return env

    with pytest.raises(ConfigError, match=r"keys pixels and region, found no \['region'\]"):
        Experiment(experiment_config([*SMALL, f"out_dir={tmp_path}"]), unlabelled)
