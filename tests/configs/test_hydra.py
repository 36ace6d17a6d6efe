"""Main functions under Hydra get the same configuration as ``compose`` gives."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest

from torchrl_sspl.configs import compose, load
from torchrl_sspl.configs.reader import ENVS
from torchrl_sspl.configs.schema import PRESETS
from torchrl_sspl.errors import ConfigError, MissingDependencyError

ROOT = Path(__file__).parents[2]


@pytest.fixture
def by_hydra():
    hydra = pytest.importorskip("hydra", reason="needs the extra hydra")
    from torchrl_sspl.configs.hydra import CONFIG_NAME, register, to_config

    register()

    def made(*overrides):
        with hydra.initialize(config_path=None, version_base="1.3"):
            return to_config(hydra.compose(CONFIG_NAME, overrides=list(overrides)))

    return made


@pytest.mark.parametrize("env", [None, *ENVS])
@pytest.mark.parametrize("preset", [PRESETS[0], *(pytest.param(preset, marks=pytest.mark.slow) for preset in PRESETS[1:])])
def test_the_same_words_give_the_same_configuration(by_hydra, env, preset):
    words = [*([f"env={env}"] if env else []), f"preset={preset}", "seed=3", "network.policy_hidden=[8,8]", "logger=wandb"]
    assert by_hydra(*words) == compose(words)


def test_groups_of_one_key(by_hydra):
    assert by_hydra("loss=paper").loss.preset == "paper"
    assert by_hydra("env=pendulum", "env.image_size=32").env["image_size"] == 32


def test_values_that_do_not_go_together_are_named(by_hydra):
    with pytest.raises(ConfigError, match=r"collector\.workers=1 with collector\.backend=sync"):
        by_hydra("collector.workers=2")
    with pytest.raises(ConfigError, match=r"received 'network\.foo'"):
        by_hydra("+network.foo=3")


def test_a_main_function_of_your_own(tmp_path):
    pytest.importorskip("hydra", reason="needs the extra hydra")
    script = tmp_path / "main.py"
    script.write_text(
        "import hydra\n"
        "from torchrl_sspl.configs import save\n"
        "from torchrl_sspl.configs.hydra import register, to_config\n"
        "register()\n"
        "@hydra.main(config_name='sspl', config_path=None, version_base='1.3')\n"
        f"def main(node):\n    save(to_config(node), '{tmp_path}/seen.yaml')\n"
        "main()\n"
    )
    words = ["env=dubins", "preset=smoke", "trainer.total_frames=2000", "logger=tensorboard"]
    command = [sys.executable, str(script), *words, f"hydra.run.dir={tmp_path}/h"]
    done = subprocess.run(command, capture_output=True, text=True, cwd=tmp_path, check=False)
    assert done.returncode == 0, done.stderr
    assert load(tmp_path / "seen.yaml") == compose(words)


def test_without_hydra_the_extra_is_named(monkeypatch):
    from torchrl_sspl.configs.hydra import register

    for name in ("hydra", "hydra.core", "hydra.core.config_store"):
        monkeypatch.setitem(sys.modules, name, None)
    with pytest.raises(MissingDependencyError, match=r"torchrl-sspl\[hydra\]"):
        register()


def test_nothing_else_loads_hydra():
    code = "import sys, torchrl_sspl.configs, torchrl_sspl.configs.hydra, torchrl_sspl.cli; print('hydra' in sys.modules)"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True, cwd=ROOT)
    assert done.stdout == "False\n"
