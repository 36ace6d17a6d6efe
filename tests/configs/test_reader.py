"""The one reader: layers, types, what is said about a wrong key or value, files, and environments by import path."""

from __future__ import annotations

import dataclasses
import json
import os
import pickle
import subprocess
import sys

import pytest
import yaml

from torchrl_sspl.configs import Config, EnvFactory, compose, load, reader, save
from torchrl_sspl.configs.reader import (
    ENVS,
    attribute_texts,
    change,
    fields,
    from_dict,
    gymnasium_env,
    resolve,
    valid_keys,
)
from torchrl_sspl.configs.schema import PRESETS
from torchrl_sspl.errors import ConfigError, MissingDependencyError


def value_at(config, key):
    for name in key.split("."):
        config = config[name] if isinstance(config, dict) else getattr(config, name)
    return config


# ---------------------------------------------------------------------- layers


def test_without_a_system_the_defaults_are_those_of_the_dataclasses():
    assert compose() == Config()
    assert compose(["preset=sound"]) == compose(preset="sound") == Config()


def test_overrides_reach_their_place_and_nothing_else():
    config, plain = compose(["seed=3", "synthesis.rounds=2", "network.policy_hidden=[16, 8]"]), Config()
    plain.seed, plain.synthesis.rounds, plain.network.policy_hidden = 3, 2, [16, 8]
    assert config == plain


def test_each_layer_wins_over_the_one_before(tmp_path, monkeypatch):
    (tmp_path / "env").mkdir()
    (tmp_path / "preset").mkdir()
    numbers = {"env/toy.yaml": "12345", "preset/smoke.yaml": "2345", "env/toy.smoke.yaml": "345", "preset/sound.yaml": ""}
    keys = {"1": "seed", "2": "network.pool_to", "3": "synthesis.rounds", "4": "synthesis.batch", "5": "buffer.batch"}
    for name, digits in numbers.items():
        body = {}
        for digit in digits:
            section, _, key = keys[digit].rpartition(".")
            body.setdefault(section, {})[key] = int(f"{len(digits)}{digit}") if section else None
            if not section:
                body.update({key: int(f"{len(digits)}{digit}")})
        body.pop("", None)
        (tmp_path / name).write_text(yaml.safe_dump(body))
    monkeypatch.setattr(reader, "FOLDER", tmp_path)
    monkeypatch.setattr(reader, "ENVS", ("toy",))
    config = compose(["env=toy", "preset=smoke", "buffer.batch=7"], **{"synthesis.batch": 8, "buffer.batch": 9})
    assert [value_at(config, k) for k in keys.values()] == [51, 42, 33, 8, 7]
    assert compose(["env=toy"]).network.pool_to == 52


@pytest.mark.parametrize("env", ENVS)
@pytest.mark.parametrize("preset", PRESETS)
def test_every_system_composes_with_every_preset(env, preset):
    config = compose([f"env={env}", f"preset={preset}"])
    assert config.preset == preset
    assert config.env["_target_"].startswith("torchrl_sspl.")
    assert EnvFactory(config.env).target == config.env["_target_"]
    assert config == compose([f"preset={preset}", f"env={env}"])


def test_presets_mean_what_they_say():
    sound, paper, _, smoke = (compose(["env=quadruped", f"preset={p}"]) for p in PRESETS)
    assert (paper.loss.preset, paper.network.barrier, paper.trainer.margins, paper.synthesis.enabled) == ("paper", "lmi", True, False)
    assert paper.loss.variance_coeff is paper.loss.covariance_coeff is paper.loss.saturation_limit is None
    assert paper.network.encoder == "FrameEncoder"
    assert (sound.network.latent_dim, paper.network.latent_dim) == (5, 4)
    assert (paper.network.remember_action, paper.synthesis.choices, paper.synthesis.grid) == (False, 0, 0)
    assert compose(["env=pendulum", "preset=paper"]).network.latent_dim == 2
    assert compose(["env=pendulum"]).network.encoder == "ContrastEncoder"
    assert compose(["env=pendulum", "preset=paper"]).network.encoder == "FrameEncoder"
    own, quick = compose([]), compose(["preset=quick"])  # for systems of one's own
    assert smoke.trainer.total_frames < quick.trainer.total_frames < own.trainer.total_frames
    assert quick.evaluation.certificate_episodes >= 368  # of so many, none is at most 1 % with 97.5 % confidence
    assert smoke.trainer.total_frames * 10 <= sound.trainer.total_frames
    assert smoke.synthesis.transitions * 10 <= sound.synthesis.transitions
    assert smoke.evaluation.episodes * 10 < sound.evaluation.episodes
    assert smoke.evaluation.walks == 2


def test_a_system_of_your_own_is_a_file(tmp_path):
    path = tmp_path / "slow.yaml"
    path.write_text("env: {_target_: torchrl_sspl.envs.DubinsEnv, speed: 0.5}\nnetwork: {latent_dim: 5}\n")
    config = compose([f"env={path}", "env.dt=.2"])
    assert config.env == {"_target_": "torchrl_sspl.envs.DubinsEnv", "speed": 0.5, "dt": 0.2}
    assert config.network.latent_dim == 5
    path.write_text("preset: quick\nenv: {_target_: torchrl_sspl.envs.DubinsEnv}\n")
    assert compose([f"env={path}"]) == compose([f"env={path}", "preset=quick"])
    assert compose([f"env={path}", "preset=smoke"]).preset == "smoke"
    path.write_text("network: {latent_dims: 5}\n")
    with pytest.raises(ConfigError, match=r"received 'network\.latent_dims'; the nearest are network\.latent_dim,"):
        compose([f"env={path}"])
    path.write_text("network: {latent_dim")
    with pytest.raises(ConfigError, match=r"slow\.yaml"):
        compose([f"env={path}"])


def test_last_override_wins_and_overrides_win_over_the_caller():
    assert compose(["seed=1", "seed=2"], seed=5).seed == 2
    assert compose(seed=5).seed == 5
    assert compose(["out_dir=runs/b"], out_dir="runs/a").out_dir == "runs/b"
    assert compose(["env=pendulum"], out_dir="runs/a").out_dir == "runs/a"
    assert compose(**{"synthesis.rounds": 7}).synthesis.rounds == 7
    assert compose(synthesis={"rounds": 7}).synthesis.rounds == 7
    assert compose(env="pendulum").env["image_size"] == 64


def test_configurations_share_no_lists():
    one, two = compose(["env=quadruped"]), compose(["env=quadruped"])
    one.network.policy_hidden.append(3)
    one.env["yaw_lag"].append(3)
    assert one.network.policy_hidden != two.network.policy_hidden
    assert one.env != two.env


# ---------------------------------------------------------------------- values


@pytest.mark.parametrize(
    ("text", "key", "value"),
    [
        ("seed=1e3", "seed", 1000),
        (" seed = 4 ", "seed", 4),
        ("trainer.progress=false", "trainer.progress", False),
        ("trainer.progress=True", "trainer.progress", True),
        ("trainer.progress=0", "trainer.progress", False),
        ("optim.lr=1e-4", "optim.lr", 1e-4),
        ("optim.lr=.5", "optim.lr", 0.5),
        ("optim.lr=1", "optim.lr", 1.0),
        ("out_dir=runs/a=b", "out_dir", "runs/a=b"),
        ("out_dir='runs/a b: c'", "out_dir", "runs/a b: c"),
        ("out_dir=runs/${seed}", "out_dir", "runs/0"),
        ("collector.init_random_frames=none", "collector.init_random_frames", None),
        ("collector.init_random_frames=null", "collector.init_random_frames", None),
        ("loss.safety_margin=None", "loss.safety_margin", None),
        ("logger=none", "logger.kind", "none"),
        ("logger=null", "logger.kind", "none"),
        ("logger=wandb", "logger.kind", "wandb"),
        ("trainer.autocast=null", "trainer.autocast", "none"),
        ("loss=paper", "loss.preset", "paper"),
        ("collector.starts=[1,0,0,0]", "collector.starts", [1.0, 0.0, 0.0, 0.0]),
        ("network.policy_hidden=[32,32]", "network.policy_hidden", [32, 32]),
    ],
)
def test_text_becomes_the_declared_type(text, key, value):
    found = value_at(compose([text]), key)
    assert found == value
    assert type(found) is type(value)


def test_values_of_the_environment_have_the_types_that_it_takes():
    config = compose(["env=quadruped", "env.yaw_lag=null", "env.speed=1", "env.obstacle_shape=disc", "env.horizon=5"])
    assert config.env["yaw_lag"] is None
    assert (type(config.env["speed"]), config.env["obstacle_shape"], config.env["horizon"]) == (float, "disc", 5)


@pytest.mark.parametrize(
    "value", [None, [1], {"a": 1}, "x", 1.5, float("nan"), True, object()], ids=lambda v: type(v).__name__
)
def test_values_from_code_of_the_wrong_type_are_named(value):
    with pytest.raises(ConfigError, match="expected seed to be an integer, received"):
        compose(seed=value)


@pytest.mark.parametrize("overrides", ["seed=1", {"seed": 1}, b"seed=1", [1], [None]])
def test_anything_but_a_list_of_strings_is_refused(overrides):
    with pytest.raises(ConfigError, match="expected a list of key=value strings"):
        compose(overrides)


@pytest.mark.parametrize("key", ["foo", "+foo", "++foo=3", "~foo", "synthesis.round", "representation.lr", "env", "network"])
def test_a_wrong_key_names_five(key):
    with pytest.raises(ConfigError, match="expected") as caught:
        compose([f"{key}=3" if "=" not in key else key])
    if key != "env":
        named = str(caught.value).partition("the nearest are ")[2].partition(";")[0].split(", ")
        assert len(named) == 5
        assert set(named) <= set(valid_keys(Config()))


@pytest.mark.parametrize(
    ("key", "meant"),
    [
        ("synthesis.round", "synthesis.rounds"), ("sead", "seed"), ("network.latent_dims", "network.latent_dim"),
        ("lr", "optim.lr"), ("total_frames", "trainer.total_frames"), ("representation.lr", "synthesis.lr"),
        ("evaluation.rollouts", "evaluation.episodes"), ("env.imagesize", "env.image_size"),
    ],
)  # fmt: skip
def test_what_was_meant_is_among_them(key, meant):
    with pytest.raises(ConfigError, match=rf"nearest are .*\b{meant}\b"):
        compose(["env=pendulum", f"{key}=1"])


def test_every_valid_key_is_valid():
    config = compose(["env=pendulum"])
    values = {key: value_at(config, key) for key in valid_keys(config) if not key.startswith("env.")}
    assert len(values) > 100
    assert compose(["env=pendulum"], **values) == config


# ---------------------------------------------------------------------- files


@pytest.mark.parametrize("ending", ["json", "yaml"])
@pytest.mark.parametrize("preset", PRESETS)
def test_round_trip_through_a_file(preset, ending, tmp_path):
    config = compose(["env=quadruped", f"preset={preset}", "seed=11", "network.barrier_hidden=[8]", "optim.lr=1e-4"])
    path = save(config, tmp_path / f"config.{ending}")
    assert load(path) == config
    assert [p.name for p in tmp_path.iterdir()] == [path.name]
    assert (json.loads if ending == "json" else yaml.safe_load)(path.read_text()) == config.to_dict()


def test_a_file_with_an_unknown_key_is_refused():
    values = compose().to_dict()
    values["synthesis"]["round"] = 3
    with pytest.raises(ConfigError, match=r"received 'synthesis\.round'.*synthesis\.rounds"):
        from_dict(values)


def test_a_system_that_was_given_in_code_is_read_as_it_is():
    values = compose().to_dict()
    values["env"] = {"made by": "my.make abc123", "safe": {"arguments": [1, None]}}
    assert from_dict(values).env == values["env"]


@pytest.mark.parametrize("text", [None, "{", "[]", "3", "\x00"])
def test_an_unreadable_file_is_named(text, tmp_path):
    path = tmp_path / "config.json"
    if text is not None:
        path.write_text(text)
    with pytest.raises(ConfigError, match=r"config\.json"):
        load(path)


def test_a_change_leaves_the_first_as_it_is():
    config = compose(["env=pendulum"])
    assert change(config, ["evaluation.seed=7"]).evaluation.seed == 7
    assert config == compose(["env=pendulum"])


# ---------------------------------------------------------------------- fields and their meaning


@pytest.mark.parametrize("env", ENVS)
def test_every_field_has_a_meaning(env):
    rows = list(fields(compose([f"env={env}"])))
    bare = [key for key, _, _, meaning in rows if not meaning]
    assert not bare
    assert {key for key, *_ in rows} == set(valid_keys(compose([f"env={env}"])))


def test_texts_of_several_names_and_lines():
    def make(a, b, c):
        """Sentence.

        Args:
            a, b: both of
                these.
            c: this.

        Returns:
            nothing.
        """

    assert attribute_texts(make) == {"a": "both of these.", "b": "both of these.", "c": "this."}


def test_every_section_is_documented():
    def check(config):
        for item in dataclasses.fields(config):
            assert item.metadata["meaning"]
            if dataclasses.is_dataclass(getattr(config, item.name)):
                check(getattr(config, item.name))

    check(Config())


def test_more_draws_of_rollouts_than_have_seeds_of_their_own_are_refused():
    compose(["synthesis.near_draws=10"]).check()
    with pytest.raises(ConfigError, match=r"expected synthesis\.near_draws <= 10, received 11"):
        compose(["synthesis.near_draws=11"]).check()


# ---------------------------------------------------------------------- environments

MODULE = """
from typing import Any
class Free:
    def __init__(self, batch_size, seed=None, **rest): self.got = (batch_size, seed, rest)
class Own:
    def __init__(self, batch_size, seed=None, *, gain: float = 1.0, name: "str | None" = None, size: tuple[int, int] = (1, 2), odd: "Nowhere" = 0, anything=3):
        self.got = (gain, name, size, anything)
def no_seed(batch_size): pass
NUMBER = 3
"""


@pytest.fixture
def module(tmp_path, monkeypatch):
    (tmp_path / "my_systems.py").write_text(MODULE.replace('odd: "Nowhere" = 0, ', ""))
    monkeypatch.chdir(tmp_path)
    yield "my_systems"
    sys.modules.pop("my_systems", None)


def test_an_environment_of_your_own_takes_what_its_signature_takes(module):
    words = ["env._target_=my_systems:Own", "env.gain=2", "env.name=none", "env.size=[3,4]", "env.anything={a: [1]}"]
    config = compose(words)
    assert EnvFactory(config.env)([1], seed=0).got == (2.0, None, [3, 4], {"a": [1]})
    for bad, said in (
        ("env.gian=2", r"received 'env\.gian'; the nearest are env\.gain.*my_systems:Own does not take it"),
        ("env.gain=much", r"expected env\.gain to be a number, received 'much'"),
        ("env.size=3", r"expected env\.size to be a list of integers"),
        ("env.seed=3", r"received 'env\.seed'"),
    ):
        with pytest.raises(ConfigError, match=said):
            compose(["env._target_=my_systems:Own", bad])


def test_annotations_that_cannot_be_read_do_not_matter(tmp_path, monkeypatch):
    (tmp_path / "my_odd_systems.py").write_text(MODULE)
    monkeypatch.chdir(tmp_path)
    config = compose(["env._target_=my_odd_systems:Own", "env.odd=[1]", "env.gain=2"])
    assert config.env["odd"] == [1]


def test_an_environment_may_take_anything(module):
    config = compose(["env._target_=my_systems:Free", "env.a=1", "env.b=[x]"])
    assert EnvFactory(config.env)([2], seed=3).got == ([2], 3, {"a": 1, "b": ["x"]})


@pytest.mark.parametrize(
    ("target", "said"),
    [
        ("my_systems:no_seed", "takes no seed"), ("my_systems:NUMBER", "class or function"), ("my_systems:Nobody", "Nobody"),
        ("nowhere:Env", "nowhere"), ("my_systems", "import path"), ("", "expected"), ("null", "expected"),
    ],
)  # fmt: skip
def test_targets_that_are_none(module, target, said):
    with pytest.raises(ConfigError, match=said):
        compose([f"env._target_={target}"])


def test_settings_of_a_system_for_an_environment_of_your_own(module):
    config = compose(["env=pendulum", "env._target_=my_systems:Own", "env.gain=2"])
    assert config.env == {"_target_": "my_systems:Own", "gain": 2.0}
    assert config.network.barrier_hidden == [96, 96, 96]


def test_a_factory_can_be_sent_to_another_process():
    factory = pickle.loads(pickle.dumps(EnvFactory(compose(["env=dubins", "env.image_size=32"]).env)))
    env = factory(batch_size=[3], seed=1)
    assert env.reset()["pixels"].shape == (3, 6, 32, 32)


def test_a_factory_without_a_system_names_the_choices():
    with pytest.raises(ConfigError, match="choose env=cmu"):
        EnvFactory(compose().env)


def test_gymnasium_by_import_paths(tmp_path, monkeypatch):
    (tmp_path / "my_cart.py").write_text(
        "def safe(s, i): return abs(s[2]) < 0.05\ndef unsafe(s, i): return abs(s[2]) > 0.1\n"
        "def make():\n    import gymnasium\n    return gymnasium.make('CartPole-v1', render_mode='rgb_array')\n"
    )
    monkeypatch.chdir(tmp_path)
    words = ["env=gymnasium", "env.safe=my_cart:safe", "env.unsafe=my_cart:unsafe", "env.image_size=16"]
    for make in ("CartPole-v1", "my_cart:make"):
        env = EnvFactory(compose([*words, f"env.make={make}"]).env)([2], seed=0)
        assert env.reset()["pixels"].shape == (2, 6, 16, 16)
        env.close()
    with pytest.raises(ConfigError, match=r"expected env\.safe to name a predicate"):
        gymnasium_env("CartPole-v1")
    with pytest.raises(ConfigError, match="my_cart:nobody"):
        gymnasium_env("my_cart:nobody", "my_cart:safe", "my_cart:unsafe")


@pytest.mark.parametrize("name", ["CartPole-v99", "NoSuch-v1", "ALE/NoSuch-v5", "no_such_module:Env-v0"])
def test_what_gymnasium_does_not_have_is_named(name):
    with pytest.raises(ConfigError, match=f"env.make to be an id of gymnasium, .*'{name}'"):
        gymnasium_env(name, "builtins:callable", "builtins:callable")


def test_what_gymnasium_needs_is_named(monkeypatch):
    monkeypatch.setitem(sys.modules, "pygame", None)
    env = gymnasium_env("CartPole-v1", "builtins:callable", "builtins:callable", image_size=16)
    with pytest.raises(MissingDependencyError, match=r"pygame is not installed.*torchrl-sspl\[viz\]"):
        env.reset()
    monkeypatch.setitem(sys.modules, "Box2D", None)
    monkeypatch.delitem(sys.modules, "gymnasium.envs.box2d.lunar_lander", raising=False)
    monkeypatch.delitem(sys.modules, "gymnasium.envs.box2d", raising=False)
    with pytest.raises(MissingDependencyError, match=r"env.make=LunarLander-v3, found less: .*gymnasium\[box2d\]"):
        gymnasium_env("LunarLander-v3", "builtins:callable", "builtins:callable")


def test_resolve_leaves_the_path_as_it_was(monkeypatch):
    monkeypatch.setattr(sys, "path", [os.getcwd(), *sys.path])  # as `python -m` has it
    before = list(sys.path)
    assert resolve("torchrl_sspl.sets.SAFE") == resolve("torchrl_sspl.sets:SAFE") == 1
    with pytest.raises(ConfigError, match="import path"):
        resolve("nothing")
    assert sys.path == before


def test_reading_a_configuration_loads_no_environment():
    code = "import sys; from torchrl_sspl.configs import compose; compose(['env=pendulum', 'seed=1']); print('torch' in sys.modules)"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout == "False\n"


@pytest.mark.parametrize(
    ("word", "message"),
    [
        ("synthesis.grid=1", "at least 3 nodes"), ("synthesis.grid=41", "synthesis.teacher=value"),
        ("synthesis.rollout_transitions=0", "rollout_transitions >= 1 with synthesis.rounds=2"), ("evaluation.horizon=0", "evaluation.horizon >= 1"),
        ("evaluation.certificate_seconds=-1", "evaluation.certificate_seconds >= 0"), ("seed=-1", "seed >= 0"), ("synthesis.batch=0", "synthesis.batch >= 4"),
        ("synthesis.dynamics_outlier=-0.1", "synthesis.dynamics_outlier >= 0"), ("synthesis.episode_steps=-3", "synthesis.episode_steps >= 1"),
        ("synthesis.lowest_level=0.1", "between -0.2 and 0"), ("trainer.keep_checkpoints=0", "keep_checkpoints >= 1, received 0"),
        ("network.policy_hidden=[8,-3]", r"policy_hidden >= 1, received \[8, -3\]"), ("network.dynamics_hidden=[0]", "dynamics_hidden >= 1"),
        ("seed=18446744073709551616", "seed <= 18446744073709551615"), ("buffer.batch=0", "buffer.batch >= 1"), ("trainer.clip_norm=-1", "clip_norm > 0"),
        ("trainer.optim_steps_per_batch=-3", "optim_steps_per_batch >= 1"),
    ],
)  # fmt: skip
def test_what_would_fail_after_the_joint_training_is_refused_before(word, message):
    with pytest.raises(ConfigError, match=message):
        compose(["env=pendulum", "synthesis.rounds=2", word])
    assert compose(["env=pendulum", "synthesis.episode_steps=null"]).synthesis.episode_steps is None
