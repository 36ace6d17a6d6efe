"""Configurations: overrides, presets, and what is said about a wrong key or value."""

from __future__ import annotations

import dataclasses
import json

import pytest

from torchrl_sspl.errors import ConfigError
from torchrl_sspl.trainers.config import PRESETS, TrainingConfig, make_config


def test_overrides_reach_their_place_and_nothing_else():
    config, plain = make_config(["seed=3", "synthesis.rounds=2", "network.policy_hidden=[16, 8]"]), make_config()
    assert (config.seed, config.synthesis.rounds, config.network.policy_hidden) == (3, 2, [16, 8])
    plain.seed, plain.synthesis.rounds, plain.network.policy_hidden = 3, 2, [16, 8]
    assert config == plain


@pytest.mark.parametrize(
    ("text", "value"),
    [
        ("seed=1e3", 1000),
        ("progress=false", False),
        ("progress=True", True),
        ("progress=0", False),
        ("representation.lr=1e-4", 1e-4),
        ("representation.lr=1", 1.0),
        ("out_dir=runs/a=b", "runs/a=b"),
        (" seed = 4 ", 4),
    ],
)
def test_strings_become_the_declared_type(text, value):
    config = make_config([text])
    for name in text.partition("=")[0].strip().split("."):
        config = getattr(config, name)
    assert config == value
    assert type(config) is type(value)


def test_last_override_wins_and_overrides_win_over_defaults():
    assert make_config(["seed=1", "seed=2"], seed=5).seed == 2
    assert make_config(seed=5).seed == 5
    assert make_config(**{"synthesis.rounds": 7}).synthesis.rounds == 7


def test_default_preset_is_sound():
    assert make_config() == make_config(["preset=sound"]) == make_config(preset="sound")
    assert make_config().preset == "sound"


@pytest.mark.parametrize("preset", PRESETS)
def test_overrides_win_over_the_preset(preset):
    config = make_config(["representation.steps=7", f"preset={preset}"])
    assert config.preset == preset
    assert config.representation.steps == 7


def test_paper_preset_is_the_printed_losses():
    config = make_config(["preset=paper"])
    assert config.representation.consistency_target == "target"
    assert config.representation.inverse_coeff == config.representation.saturation_coeff == 0.0
    assert config.representation.variance_coeff == 0.0
    assert config.synthesis != make_config().synthesis


def test_smoke_preset_is_small():
    smoke, full = make_config(["preset=smoke"]), make_config()
    assert smoke.data.transitions * 10 < full.data.transitions
    assert smoke.representation.steps * 10 < full.representation.steps
    assert smoke.evaluation.rollouts * 10 < full.evaluation.rollouts


def test_configurations_share_no_lists():
    one, two = make_config(), make_config()
    one.network.policy_hidden.append(3)
    assert one.network.policy_hidden != two.network.policy_hidden


@pytest.mark.parametrize(
    ("key", "meant"),
    [
        ("synthesis.round", "synthesis.rounds"),
        ("sead", "seed"),
        ("network.latent_dims", "network.latent_dim"),
        ("representation.learning_rate", "valid keys"),
    ],
)
def test_unknown_key_suggests_the_right_one(key, meant):
    with pytest.raises(ConfigError, match=rf"received '{key}'.*{meant}"):
        make_config([f"{key}=1"])
    if meant != "valid keys":
        with pytest.raises(ConfigError, match=rf"did you mean .*\b{meant}\b"):
            make_config(**{key: 1})


@pytest.mark.parametrize(
    ("text", "kind"),
    [
        ("seed=one", "int"),
        ("seed=1.5", "int"),
        ("seed=nan", "int"),
        ("seed=inf", "int"),
        ("seed=", "int"),
        ("representation.lr=fast", "float"),
        ("progress=perhaps", "bool"),
        ("network.policy_hidden=[16,x]", "list"),
        ("network.policy_hidden=16", "list"),
        ("network.policy_hidden=[16.5]", "list"),
    ],
)
def test_values_of_the_wrong_type_are_named(text, kind):
    key = text.partition("=")[0]
    with pytest.raises(ConfigError, match=rf"expected {key} to be of type {kind}"):
        make_config([text])


@pytest.mark.parametrize("value", [None, [1], {"a": 1}])
def test_values_from_code_of_the_wrong_type_are_named(value):
    with pytest.raises(ConfigError, match="seed"):
        make_config(seed=value)


@pytest.mark.parametrize("text", ["seed", "=3", "", "--seed 3"])
def test_arguments_that_are_not_key_value_are_refused(text):
    with pytest.raises(ConfigError, match="key=value"):
        make_config([text])


@pytest.mark.parametrize("preset", ["", "sond", "Paper"])
def test_unknown_preset_lists_the_presets(preset):
    with pytest.raises(ConfigError, match=f"sound, paper, smoke, received '{preset}'"):
        make_config([f"preset={preset}"])


@pytest.mark.parametrize("preset", PRESETS)
def test_round_trip_through_json(preset, tmp_path):
    config = make_config([f"preset={preset}", "seed=11", "network.barrier_hidden=[8]", "representation.lr=1e-4"])
    config.save(tmp_path / "config.json")
    again = TrainingConfig.load(tmp_path / "config.json")
    assert again == config
    assert json.loads((tmp_path / "config.json").read_text()) == config.to_dict()


def test_file_with_an_unknown_key_is_refused():
    values = make_config().to_dict()
    values["synthesis"]["round"] = 3
    with pytest.raises(ConfigError, match=r"synthesis\.round'.*synthesis\.rounds"):
        TrainingConfig.from_dict(values)


@pytest.mark.parametrize("text", [None, "", "{", "[]", "3"])
def test_unreadable_file_is_named(text, tmp_path):
    path = tmp_path / "config.json"
    if text is not None:
        path.write_text(text)
    with pytest.raises(ConfigError, match=r"config\.json"):
        TrainingConfig.load(path)


def test_every_field_is_documented():
    def check(config) -> None:
        for item in dataclasses.fields(config):
            texts = [kind.__doc__ or "" for kind in type(config).__mro__]
            assert any(f"    {item.name}: " in text for text in texts), f"{type(config).__name__}.{item.name}"
            if dataclasses.is_dataclass(getattr(config, item.name)):
                check(getattr(config, item.name))

    check(make_config())
