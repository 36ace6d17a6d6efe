"""Experiments: exploration, fresh starts, the data of the phases, mistakes and advice, and going on after a stop."""

from __future__ import annotations

import importlib
import json
import sys
from functools import partial
from types import SimpleNamespace

import numpy as np
import pytest
import torch
from evaluation.systems import Lane, Where, lane
from gymnasium import spaces
from tensordict import TensorDict
from tiny import SAVED, TINY_PHASES
from torch import nn
from torchrl.data import Bounded

from torchrl_sspl.certification import Certificate, Layer, Statement
from torchrl_sspl.cli import evaluate_agent
from torchrl_sspl.configs import compose
from torchrl_sspl.data.collect import ExploringPolicy
from torchrl_sspl.envs.gymnasium import GymnasiumPixels
from torchrl_sspl.errors import CheckpointError, ConfigError, OutputError
from torchrl_sspl.experiments.description import describe, differences
from torchrl_sspl.experiments.own_systems import advice
from torchrl_sspl.experiments.run import Experiment, run_experiment
from torchrl_sspl.modules import FrameEncoder
from torchrl_sspl.modules.agent import agent_directory, load
from torchrl_sspl.sets import UNLABELLED
from torchrl_sspl.trainers.hooks import RestartHook
from torchrl_sspl.trainers.stepper import SSPLStepper

pytestmark = pytest.mark.filterwarnings("ignore::FutureWarning", "ignore::DeprecationWarning")


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
    "trainer.optim_steps_per_batch=2", "trainer.warm_start_steps=1", "trainer.checkpoint_seconds=0", "trainer.restarts=0",
    "collector.frames_per_batch=64", "collector.envs=8", "collector.init_random_frames=64", "network.pool_to=8",
    "buffer.batch=16", "evaluation.episodes=4", "evaluation.envs=4", "evaluation.horizon=4", *TINY_PHASES,
]  # fmt: skip


UNSAVED = "trainer.checkpoint_seconds=-1"  # where nothing goes on


def everywhere(batch_size, seed, below=13) -> GymnasiumPixels:
    return lane(batch_size, seed, reset_options={"below": below})


def build(folder, *more: str) -> Experiment:
    return Experiment(compose([*SMALL, *more, f"out_dir={folder}"]), everywhere)


class Stopped(Exception):
    pass


@pytest.mark.parametrize("restarts", [pytest.param(0, marks=pytest.mark.slow), 1])
def test_a_stopped_experiment_goes_on_to_the_same_agent(restarts, tmp_path):
    words = ["trainer.total_frames=256", f"trainer.restarts={restarts}"]
    straight = build(tmp_path / "straight", *words, UNSAVED).train()
    first = build(tmp_path / "stopped", *words)

    def stop_in_third_batch(batch):
        if first.trainer.collected_frames > 128:
            raise Stopped
        return batch

    first.trainer.register_op("batch_process", stop_in_third_batch)
    with pytest.raises(Stopped):
        first.train()
    # To save after every step takes far longer than to train: one checkpoint inside a phase is enough to go on from.
    second = build(tmp_path / "stopped", *words, SAVED)
    save = second.trainer.save_trainer

    def stop_in_tune(force_save=False):
        inside = second.work.where["phase"] == "tune"
        save(force_save or inside)
        if inside:
            raise Stopped

    second.trainer.save_trainer = stop_in_tune
    with pytest.raises(Stopped):
        second.train()
    assert second.trainer.collected_frames == 256
    third = build(tmp_path / "stopped", *words, SAVED)
    weights = third.train().state_dict()
    assert third.trainer.optimization_stepper.count == 2 * (4 - restarts)  # the fresh start forgets the first batch's steps
    for name, value in straight.state_dict().items():
        assert torch.equal(value, weights[name]), name


def nothing() -> SimpleNamespace:
    return SimpleNamespace(measurements={})


def test_without_success_it_starts_again_with_other_weights_and_says_so(tmp_path):
    words = ["trainer.total_frames=320", "trainer.restarts=2", "optim.lr=0.0", "synthesis.enabled=false", UNSAVED]
    experiment = build(tmp_path, *words, "network.encoder=ContrastEncoder")
    starts, fitted = [], []
    experiment.trainer.register_op("post_steps", lambda: starts.append(next(experiment.encoder.parameters()).sum().item()))
    experiment.trainer.register_op("post_steps", lambda: fitted.append(bool((experiment.encoder.trunk[0].background == -1).any())))  # 1 before
    experiment.train()
    assert all(fitted)  # what an encoder knows of the frames is not lost with its weights
    assert experiment.trainer.optimization_stepper.count == 2 * 3  # batches 1, 2, 3 to 5
    assert (len(starts), len(set(starts))) == (5, 3)
    assert any("did not tell S from U" in text for text in experiment._warnings(nothing()))
    # The same with labels that the first weights tell apart: none of it happens.
    content = build(tmp_path / "content", *words, "trainer.warm_start_error=2.5")
    content.train()
    assert content.trainer.optimization_stepper.count == 2 * 5
    assert not any("did not tell S from U" in text for text in content._warnings(nothing()))
    # A barrier that never learnt leaves no set: the level that excludes U excludes every reset, and this is said too.
    assert any("no held-out reset lies in the set" in text for text in content._warnings(nothing()))


def test_a_start_that_still_improves_is_not_given_up():
    class Loss(nn.Module):
        def __init__(self, value: float) -> None:
            super().__init__()
            self.weight = nn.Parameter(torch.tensor(value))
            self.register_buffer("safety_margin", torch.tensor(value))
            self.register_buffer("dynamics_margin", torch.tensor(value))

    stepper = SSPLStepper(torch.optim.Adam([nn.Parameter(torch.zeros(1))]), warm_start_error=0.05)
    trainer = SimpleNamespace(optimization_stepper=stepper, loss_module=Loss(0.0), fit_encoder=None)
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
        stepper.count, stepper._errors = count, [0.0, mislabelled]
        hook()
        assert hook.restarts == restarts
    stepper.count, stepper._errors, hook.restarts = 200, [0.0, 0.04], 0
    hook()
    assert hook.restarts == 0  # told apart
    assert trainer.loss_module.weight.item() == 2.0
    assert trainer.loss_module.safety_margin.item() == trainer.loss_module.dynamics_margin.item() == 0.0
    with pytest.raises(ConfigError, match="after >= 1"):
        RestartHook(trainer, lambda attempt: None, after=0, most=1)


@pytest.mark.parametrize("never", ["safe", "unsafe"])
def test_a_set_that_is_never_seen(never, tmp_path):
    sets = {"safe": lambda state, info: state[0] < 3, "unsafe": lambda state, info: state[0] > 10}
    sets[never] = lambda state, info: False

    def env(batch_size, seed):
        return GymnasiumPixels(Lane, batch_size=batch_size, seed=seed, image_size=16, reset_options={"below": 13}, **sets)

    words = [*SMALL, f"buffer.{never}=0", "trainer.total_frames=128", UNSAVED, f"out_dir={tmp_path}"]
    experiment = Experiment(compose(words), env)
    experiment.train()
    assert ("0 of 128 transitions start in U" in "".join(experiment.work.warnings)) == (never == "unsafe")
    assert experiment.work.skip == (never == "unsafe")


def test_of_many_transitions_those_of_the_sets_come_first(tmp_path):
    experiment = build(tmp_path, "trainer.total_frames=256", UNSAVED)
    experiment.train()
    source, region = experiment.work.source, experiment.store.region
    few = source.stored(100)["region"][:, 0]
    assert len(few) == 100
    assert int((few != UNLABELLED).sum()) >= min(50, int((region != UNLABELLED).sum())) > 10
    assert torch.equal(source.stored(1000)["region"][:, 0], region)


def test_the_budget_counts_what_was_seen(tmp_path):
    experiment = build(tmp_path, "trainer.total_frames=256", UNSAVED)
    experiment.train()
    budget, region = experiment._budget(), experiment.store.region
    assert budget["transitions"] == 256
    assert budget["labels of S"] == int((region == 1).sum())
    assert budget["labels of U"] == int((region == 2).sum())
    assert 0 < budget["resets"] == (experiment.store.n_frames - 256) // 2


def test_the_budget_is_known_to_a_run_that_goes_on_without_its_pictures(tmp_path):
    words = ["trainer.total_frames=128", "synthesis.enabled=false", "evaluation.calibrate=true", "evaluation.episodes=4"]
    first = build(tmp_path, *words)
    first.train()
    again = build(tmp_path, *words)
    again.train()
    assert again._budget() == first._budget()
    assert again._budget()["transitions"] == 128


def test_a_finished_experiment_is_not_trained_again_and_another_one_is_refused(tmp_path):
    first = build(tmp_path, "trainer.total_frames=128").train().state_dict()
    again = build(tmp_path, "trainer.total_frames=128")
    weights = again.train().state_dict()
    assert again.trainer.optimization_stepper.count == 2 * 2
    assert all(torch.equal(value, weights[name]) for name, value in first.items())
    other = build(tmp_path, "trainer.total_frames=128", "network.barrier_hidden=[16]")
    with pytest.raises(CheckpointError, match=r"barrier_hidden: \[8, 8\], now \[16\]\); use another out_dir"):
        other.train()
    other.trainer.collector.shutdown()
    moved = Experiment(compose([*SMALL, "trainer.total_frames=128", f"out_dir={tmp_path}"]), partial(everywhere, below=12))
    with pytest.raises(CheckpointError, match=r"env.*now.*use another out_dir"):
        moved.train()
    moved.trainer.collector.shutdown()


def test_a_run_goes_on_with_a_logger_and_evaluations_that_it_began_without(tmp_path):
    words = ["trainer.total_frames=64", "synthesis.enabled=false"]
    build(tmp_path, *words).train()
    again = build(tmp_path, *words, "logger=csv", "trainer.evaluate_every=1")
    again._same_run()
    assert again.trainer.resume()
    again.trainer.collector.shutdown()


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


BORDERS, TABLE, ARRAY = [1.0], {"border": 1.0}, np.array([1.0])


class Near:
    def __init__(self, border):
        self.border = border

    def __call__(self, state, info):
        return abs(state[0]) < self.border

    def inside(self, state, info):
        return abs(state[0]) < self.border


def test_descriptions_follow_what_a_predicate_reads():
    def found(border):
        own = Near(border)
        reads = lambda s, i: s[0] < BORDERS[0], lambda s, i: s[0] < TABLE["border"], lambda s, i: s[0] < ARRAY[0]
        return [describe(x) for x in (*reads, own, own.inside, lambda s, i: own(s, i))]

    one = found(1.0)
    assert one == found(1.0)
    BORDERS[0] = TABLE["border"] = ARRAY[0] = 2.0
    assert not set(one) & set(found(2.0))
    assert describe(lambda x: x in {1, 2}) != describe(lambda x: x in {1, 3})
    assert describe(GymnasiumPixels) == "torchrl_sspl.envs.gymnasium.GymnasiumPixels"
    assert describe(type("A", (Near,), {"gain": 1.0})) != describe(type("A", (Near,), {"gain": 2.0}))


@pytest.mark.slow
def test_another_predicate_behind_the_same_path_or_another_encoder_is_refused(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    sets = "from evaluation.systems import Lane as make\nBORDER = [{}]\ndef safe(o, i): return o[0] < 3\ndef unsafe(o, i): return o[0] >= BORDER[0]\n"
    words = ["env=gymnasium", *(f"env.{k}=my_sets:{k}" for k in ("make", "safe", "unsafe")), "env.image_size=16", *SMALL]
    words += ["synthesis.enabled=false", "trainer.total_frames=64", "out_dir=run"]

    def experiment(border, encoder=None):
        monkeypatch.delitem(sys.modules, "my_sets", raising=False)
        (tmp_path / "my_sets.py").write_text(sets.format(border))
        importlib.invalidate_caches()
        return Experiment(compose(words), encoder=encoder)

    experiment(5.0).train()
    seen = lambda latent_dim: FrameEncoder(latent_dim, pool_to=8)  # noqa: E731
    for changes, message in (((5.25,), "env.unsafe: my_sets.unsafe .*, now my_sets"), ((5.0, seen), "encoder: None, now .*lambda")):
        other = experiment(*changes)
        with pytest.raises(CheckpointError, match=message):
            other.train()
        other.trainer.collector.shutdown()
    again = experiment(5.0)
    again.train()
    assert again.trainer.resumed


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
        ({"overrides": "seed=1"}, r"overrides: expected a list of key=value strings .*, received .* \(str\)"),
        ({"overrides": {"seed": 1}}, r"overrides: expected a list of key=value strings .*, received .* \(dict\)"),
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
        return advice(Certificate("a", "w", "c", 0.0, layers), compose())

    assert said("", "") == []
    (line,) = said("NOT_INVARIANT", "EPISODES_LEAVE")
    assert "network.latent_dim, now 3" in line
    assert "network.pool_to = 32" in line
    assert "certificate_episodes, now 1000" in said("", "TOO_FEW")[0]
    assert len(said("UNDECIDED", "UNSAFE_INSIDE")) == 2


@pytest.mark.slow
def test_an_agent_of_a_system_in_code_is_not_measured_on_another(tmp_path):
    build(tmp_path, "trainer.total_frames=128").train()
    with pytest.raises(CheckpointError, match="it was given in code; call evaluate_episodes"):
        evaluate_agent(str(tmp_path))


class Eye(FrameEncoder):
    def __init__(self, latent_dim, image_size=64):
        super().__init__(latent_dim, pool_to=8)
        self.told = image_size


@pytest.mark.parametrize(("wide", "told"), [(16, 16), (8, [16, 8])])
def test_encoders_are_told_the_size_of_the_pictures_of_any_system(wide, told, tmp_path, monkeypatch):
    probe = Experiment._probe

    def narrow(experiment):
        env, pixels = probe(experiment)
        return env, pixels[..., :wide]

    monkeypatch.setattr(Experiment, "_probe", narrow)
    made = Experiment(compose([*SMALL, UNSAVED, f"out_dir={tmp_path}"]), everywhere, encoder=Eye)
    assert made.encoder.told == told


class ManyActions(Lane):
    action_space = spaces.Box(-1.0, 1.0, (14,), np.float32)


def uncentred(batch_size, seed):
    env = lane(batch_size=batch_size, seed=seed)
    env.action_spec = Bounded(0.0, 2.0, (*batch_size, 1))
    return env


def test_what_would_fail_after_hours_is_refused_at_once(tmp_path):
    with pytest.raises(ConfigError, match=r"between -a and a .* received bounds \[0.0\] and \[2.0\]"):
        Experiment(compose([*SMALL, f"out_dir={tmp_path}"]), uncentred)
    with pytest.raises(ConfigError, match=r"evaluation\.episodes >= 1, whose pictures place the zero level"):
        Experiment(compose([*SMALL, "evaluation.episodes=0", "evaluation.calibrate=true", f"out_dir={tmp_path}"]), lane)
    many = partial(lane, make=ManyActions)
    with pytest.raises(ConfigError, match="at most 12 action dimensions, received 14"):
        Experiment(compose([*SMALL, f"out_dir={tmp_path}"]), many)


def test_environments_without_labels_are_refused(tmp_path):
    from torchrl_sspl.envs import PendulumEnv

    def unlabelled(batch_size, seed):
        env = PendulumEnv(batch_size=batch_size, seed=seed, image_size=16)
        del env.observation_spec["region"]
        return env

    with pytest.raises(ConfigError, match=r"keys pixels and region, found no \['region'\]"):
        Experiment(compose([*SMALL, f"out_dir={tmp_path}"]), unlabelled)


@pytest.mark.slow
def test_a_run_without_checkpoints_is_not_mixed_with_one_that_has_them(tmp_path):
    words = ["trainer.total_frames=64", "synthesis.enabled=false", "evaluation.calibrate=false", f"out_dir={tmp_path}"]
    Experiment(compose([*SMALL, *words]), lane).train()
    other = ["seed=1", UNSAVED]
    with pytest.raises(CheckpointError, match="seed: 0, now 1"):
        Experiment(compose([*SMALL, *words, *other]), lane).train()
    Experiment(compose([*SMALL, *words, *other]), lane).train(resume=False)
    assert not list((tmp_path / "checkpoints").glob("*"))


def test_a_run_that_begins_anew_does_not_append_to_the_numbers_of_another(tmp_path, monkeypatch):
    old = [tmp_path / "log.jsonl", tmp_path / "csv" / "scalars" / "grad_norm.csv"]
    old[1].parent.mkdir(parents=True)
    for path in old:
        path.write_text("of another run")
    experiment = Experiment(compose([*SMALL, "logger=csv", UNSAVED, f"out_dir={tmp_path}"]), lane)
    monkeypatch.setattr(experiment.trainer, "train", lambda: 1 / 0)
    with pytest.raises(ZeroDivisionError):
        experiment.train()
    assert not any(path.exists() for path in old)


def test_an_agent_is_not_measured_in_the_folder_of_a_run_that_was_trained(tmp_path):
    (tmp_path / "agent").mkdir()
    experiment = Experiment(compose(["env=pendulum", "agent=pendulum", "logger=none", f"out_dir={tmp_path}"]))
    with pytest.raises(OutputError, match="holds a run that was trained; give another out_dir"):
        experiment.run()


def test_a_certificate_of_other_weights_is_not_shown(tmp_path):
    agent = load("pendulum")
    with torch.no_grad():
        agent.policy.net[-1].weight.neg_()
    agent.save(tmp_path / "other")
    (tmp_path / "other" / "certificate.json").write_bytes((agent_directory("pendulum") / "certificate.json").read_bytes())
    words = ["env=pendulum", f"agent={tmp_path / 'other'}", "logger=none", f"out_dir={tmp_path / 'run'}", "evaluation.episodes=0", "evaluation.grid=5", "evaluation.kernel_grid=21"]
    with pytest.warns(UserWarning, match="proved of other weights"):
        outcome = Experiment(compose(words)).run()
    assert outcome.certificate is None
    assert "the weights are not those that were certified" in " ".join(outcome.warnings)


@pytest.mark.slow
def test_nothing_is_measured_where_that_is_asked_for(tmp_path):
    words = ["trainer.total_frames=64", "synthesis.enabled=false", "evaluation.calibrate=false", "evaluation.episodes=0", UNSAVED, f"out_dir={tmp_path}"]
    outcome = Experiment(compose([*SMALL, *words]), lane).run()
    assert "policy_touch_unsafe" not in outcome.evaluation.measurements
    assert (tmp_path / "metrics.json").is_file()
    assert (tmp_path / "report.html").is_file()


def test_a_run_whose_simulator_is_missing_is_evaluated_without_it(tmp_path, monkeypatch, capsys):
    monkeypatch.setitem(sys.modules, "pybullet", None)
    words = ["env=quadruped", "preset=smoke", "evaluation.episodes=0", "evaluation.renderer_episodes=0", "evaluation.walks=2", f"out_dir={tmp_path}/run"]
    found = Experiment(compose(words)).evaluate(load("quadruped"))
    assert found["own"].measurements == {}
    assert "not evaluated in full physics: full physics: expected the simulator" in capsys.readouterr().out
