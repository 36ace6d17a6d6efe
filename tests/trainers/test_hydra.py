"""Hydra: groups, overrides, what a wrong key is told, and that nothing else needs it."""

from __future__ import annotations

import dataclasses
import subprocess
import sys
from pathlib import Path

import pytest

from torchrl_sspl.errors import ConfigError, MissingDependencyError
from torchrl_sspl.trainers import hydra_store
from torchrl_sspl.trainers.config import TrainingConfig, make_config
from torchrl_sspl.trainers.experiment_config import ExperimentConfig, TrainerConfig, experiment_config

pytest.importorskip("hydra", reason="needs the extra hydra")
ROOT = Path(__file__).parents[2]


def test_the_default_composition_is_the_default_configuration():
    assert hydra_store.compose() == ExperimentConfig()


def test_overrides_reach_their_place_and_nothing_else():
    config = hydra_store.compose(["env=pendulum", "trainer.total_frames=2000", "network.policy_hidden=[8,8]"])
    expected = ExperimentConfig()
    expected.trainer.total_frames, expected.network.policy_hidden = 2000, [8, 8]
    assert config == expected
    assert config == experiment_config(["trainer.total_frames=2000", "network.policy_hidden=[8,8]"])


@pytest.mark.parametrize(("group", "choice"), [(g, c) for g, choices in hydra_store.GROUPS.items() for c in choices])
def test_every_choice_of_every_group_composes(group, choice):
    assert getattr(hydra_store.compose([f"{group}={choice}"]), group) == hydra_store.GROUPS[group][choice]


def test_composing_does_not_change_the_choices():
    config = hydra_store.compose(["trainer=sspl", "trainer.total_frames=1"])
    config.network.policy_hidden.append(5)
    assert hydra_store.compose() == ExperimentConfig()
    assert hydra_store.GROUPS["trainer"]["sspl"] == TrainerConfig()


def test_rounds_are_the_presets_and_take_seed_and_folder_from_the_top():
    config = hydra_store.compose(["trainer=rounds_smoke", "trainer.synthesis.rounds=3", "seed=4", "out_dir=runs/x"])
    assert isinstance(config.trainer, TrainingConfig)
    assert config.trainer == make_config(["preset=smoke", "synthesis.rounds=3", "seed=4", "out_dir=runs/x"])


def test_what_the_rounds_would_ignore_is_refused():
    with pytest.raises(ConfigError, match=r"no setting of loss with trainer=rounds.*trainer=sspl"):
        hydra_store.compose(["trainer=rounds", "loss.safety_margin=1"])
    with pytest.raises(ConfigError, match=r"no setting of network with trainer=rounds.*trainer\.network"):
        hydra_store.compose(["trainer=rounds", "network.latent_dim=4"])


@pytest.mark.parametrize(
    ("override", "said"),
    [
        ("trainer.totl_frames=1", r"received 'trainer\.totl_frames'.*did you mean trainer\.total_frames.*valid keys: .*collector\.backend"),
        ("sed=1", r"did you mean seed"),
        ("env=pendulm", "expected env to be one of pendulum, dubins, gymnasium, received 'pendulm'"),
        ("trainer=ssp", "expected trainer to be one of sspl, rounds"),
        ("seed=one", "'one'.*Integer"),
        ("trainer.progress=perhaps", "perhaps"),
        ("network.policy_hidden=[8,x]", "'x'"),
        ("seed", "key=value"),
        ("collector.backend=threads", "collector.backend to be one of sync, process, ray"),
        ("collector.workers=2", "collector.workers=1 with collector.backend=sync"),
        ("trainer.autocast=int8", "trainer.autocast to be one of none, bfloat16, float16"),
        ("loss.preset=loud", "loss.preset to be sound or paper"),
        ("collector.envs=7", "multiple of workers x envs = 7"),
    ],
)
def test_wrong_keys_choices_and_values_are_named(override, said):
    with pytest.raises(ConfigError, match=said):
        hydra_store.compose([override])


def test_fields_of_a_choice_are_valid_with_that_choice_only():
    assert hydra_store.compose(["env=gymnasium", "env.make=Acrobot-v1"]).env.make == "Acrobot-v1"
    with pytest.raises(ConfigError, match=r"valid keys: .*env\.max_torque"):
        hydra_store.compose(["env.make=Acrobot-v1"])


def test_every_field_of_every_choice_is_documented():
    for group, choices in hydra_store.GROUPS.items():
        for choice in choices:
            bare = [key for key, _, _, meaning in hydra_store.fields({group: choice}) if not meaning]
            assert not bare, f"{group}={choice}: without a meaning: {bare}"


def test_help_shows_every_key_and_choice():
    text = hydra_store.help_text(["env=gymnasium"])
    for key, *_ in hydra_store.fields({"env": "gymnasium"}):
        assert f"  {key} " in text
    assert "trainer=sspl | rounds" in text


def test_a_main_function_of_your_own_gets_the_same_configuration(tmp_path):
    script = tmp_path / "main.py"
    script.write_text(
        "import hydra\n"
        "from torchrl_sspl.trainers.hydra_store import register, to_config\n"
        "register()\n"
        "@hydra.main(config_name='sspl', config_path=None, version_base='1.3')\n"
        "def main(node):\n"
        "    config = to_config(node)\n"
        "    print(type(config).__name__, config.trainer.total_frames, config.logger.kind)\n"
        "main()\n"
    )
    words = [sys.executable, str(script), "trainer.total_frames=7", "logger=tensorboard", f"hydra.run.dir={tmp_path}/h"]
    done = subprocess.run(words, capture_output=True, text=True, cwd=tmp_path, check=False)
    assert done.stdout.split() == ["ExperimentConfig", "7", "tensorboard"], done.stderr


def test_without_hydra_the_extra_is_named_and_the_rest_works(monkeypatch):
    for name in ("hydra", "hydra.core", "hydra.core.config_store", "omegaconf"):
        monkeypatch.setitem(sys.modules, name, None)
    with pytest.raises(MissingDependencyError, match=r"torchrl-sspl\[hydra\]"):
        hydra_store.compose(["seed=1"])
    assert experiment_config(["seed=1"]).seed == 1
    assert "trainer.total_frames" in hydra_store.help_text()


def test_importing_the_configurations_does_not_load_hydra():
    code = "import sys, torchrl_sspl.trainers.hydra_store, torchrl_sspl.cli; print([m for m in sys.modules if m == 'hydra'])"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True, cwd=ROOT)
    baseline = "import sys, torchrl, torchrl.collectors; print([m for m in sys.modules if m == 'hydra'])"
    upstream = subprocess.run([sys.executable, "-c", baseline], capture_output=True, text=True, check=True)
    assert done.stdout == "[]\n" or done.stdout == upstream.stdout


def test_dataclasses_are_plain():
    assert dataclasses.is_dataclass(ExperimentConfig)
    assert ExperimentConfig().to_dict()["trainer"]["total_frames"] == TrainerConfig().total_frames
