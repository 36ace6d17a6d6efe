"""The page on extensions: every section is one file, and what it promises happens when that file is used."""

from __future__ import annotations

import json
import re
import runpy
import sys
from pathlib import Path
from typing import Any

import pytest
import torch
from tensordict import TensorDict
from tiny import TINY
from torch import nn

from torchrl_sspl import cli, configs
from torchrl_sspl.lipschitz.layers import LAYERS

ROOT = Path(__file__).parents[1]
if not (ROOT / "docs").is_dir():
    pytest.skip("needs a checkout", allow_module_level=True)
pytestmark = pytest.mark.filterwarnings("ignore::FutureWarning", "ignore::DeprecationWarning", "ignore:init_random_frames")
BILL = {
    "my_encoder.py": "an encoder", "my_system.py": "a system", "my_loss.py": "a loss term", "my_layer.py": "a layer that the proofs know",
    "my_rival.py": "a method to compare with", "my_phase.py": "a phase",
}  # fmt: skip
FAST = ["evaluation.kernel_grid=31", "evaluation.renderer_episodes=0"]


def sections() -> dict[str, str]:
    """Parts of the page by title."""
    parts = re.split(r"^## (.*)$", (ROOT / "docs" / "extend.md").read_text(), flags=re.MULTILINE)
    return dict(zip(parts[1::2], parts[2::2], strict=True))


def programs() -> dict[str, str]:
    """The files of the page by name; what a section shows besides belongs to its file."""
    found = {}
    for text in sections().values():
        blocks = re.findall(r"^```python\n(.*?)^```", text, flags=re.DOTALL | re.MULTILINE)
        names = [re.match(r"# (\w+\.py)\n", block) for block in blocks]
        assert sum(name is not None for name in names) <= 1, "more than one file in a section"
        found |= {name[1]: "\n".join(blocks) for name in names if name}
    return found


@pytest.fixture
def use(tmp_path, monkeypatch):
    """``use(name)`` runs a file of the page in a folder of its own, trainings at tiny size; what it has defined."""
    (tmp_path / "here").mkdir()
    monkeypatch.chdir(tmp_path / "here")
    compose = configs.compose
    monkeypatch.setattr(configs, "compose", lambda words: compose([*words, *TINY, *FAST]))
    layers, state = dict(LAYERS), torch.get_rng_state()

    def run(name: str) -> dict[str, Any]:
        Path(name).write_text(programs()[name])
        return runpy.run_path(name)

    yield run
    LAYERS.clear()
    LAYERS.update(layers)
    torch.set_rng_state(state)
    for name in BILL:
        sys.modules.pop(name.removesuffix(".py"), None)


def test_every_extension_is_one_file():
    assert set(programs()) == set(BILL)
    page = (ROOT / "docs" / "extend.md").read_text()
    for name in BILL.values():
        assert f"| {name} | 1 |" in page


@pytest.mark.slow
def test_an_encoder_is_trained_and_measured_by_two_commands(use, tmp_path, capsys):
    assert nn.Module in use("my_encoder.py")["Small"].__mro__
    commands = [line.split() for line in sections()["Your own encoder"].split("```sh\n")[1].split("```")[0].splitlines()]
    train, evaluate = [words[1:] for words in commands]
    assert cli.main([*train[:2], *TINY, *train[2:], *FAST]) == 0
    described = json.loads(Path("runs/small/agent/agent.json").read_text())["networks"]["encoder"]
    assert described == {"class": "my_encoder:Small", "arguments": {"latent_dim": 3, "pool_to": 16}}
    sys.modules.pop("my_encoder")  # the next command is another process
    assert cli.main([*evaluate, "episodes=4", "horizon=2", "grid=5", "kernel_grid=31"]) == 0
    assert "volume_over_kernel" in capsys.readouterr().out


def test_a_layer_is_understood_by_every_proof(use):
    from torchrl_sspl.certification import closed_loop
    from torchrl_sspl.lipschitz import lipschitz_lower

    before = set(LAYERS)
    found = use("my_layer.py")
    assert set(LAYERS) - before == {nn.Softsign}
    lower = lipschitz_lower(found["mine"], -1.0, 1.0, n=2000, generator=torch.Generator().manual_seed(0))
    assert 0 < lower <= found["bound"]
    parts = found["mine"], nn.Sequential(nn.Linear(3, 2)), nn.Sequential(nn.Linear(2, 4), nn.Softsign(), nn.Linear(4, 1))
    system = closed_loop(*parts, latent_dim=2, lipschitz_bound=found["bound"])
    z = torch.rand(100, 2) * 2 - 1
    with torch.no_grad():
        torch.testing.assert_close(system.barrier(z.double()).float(), parts[0](z), rtol=1e-4, atol=1e-5)
        stepped = parts[1](torch.cat([z, parts[2](z)], -1))
        torch.testing.assert_close(system.step(z.double()).float(), stepped, rtol=1e-4, atol=1e-5)


def test_a_system_is_measured_and_its_kernel_known(use):
    found = use("my_system.py")
    assert found["found"]["labelled_safe_rollouts_touch_unsafe"] == 0.0
    assert 0.2 < found["kernel"].volume_fraction < 1.0


def test_a_loss_term_is_trained_with_the_others(use):
    from torchrl.collectors import Collector

    from torchrl_sspl.data import TransitionStore
    from torchrl_sspl.envs import PendulumEnv
    from torchrl_sspl.modules import Policy, SaLaD, make_rollout_policy
    from torchrl_sspl.trainers import SSPLTrainer

    kind = use("my_loss.py")["Gentle"]
    torch.manual_seed(0)
    env = PendulumEnv(batch_size=[4], image_size=16, seed=0)
    env.initial_set = env.safe_set | env.unsafe_set
    salad, policy = SaLaD.from_sizes(2, 1, action_scale=10.0, pool_to=8), Policy(2, 1, action_scale=10.0)
    collector = Collector(
        env, make_rollout_policy(salad, policy), frames_per_batch=64, total_frames=128, reset_at_each_iter=True,
        auto_register_policy_transforms=False,
    )  # fmt: skip
    loss = kind(*salad, policy, gentle_coeff=0.5)
    trainer = SSPLTrainer(
        collector=collector, total_frames=128, loss_module=loss, optimizer=torch.optim.Adam(loss.parameters(), 1e-3),
        replay_buffer=TransitionStore(256).replay_buffer(16), optim_steps_per_batch=2, progress_bar=False,
    )  # fmt: skip
    trainer.train()
    assert float(trainer._log_dict["loss_gentle"][-1]) > 0
    latents = torch.rand(6, 2)
    own = kind(None, loss.dynamics.module, loss.barrier.module, policy, gentle_coeff=0.5)
    following = TensorDict(latent=latents, batch_size=6)
    rows = TensorDict(
        latent=latents, action=torch.zeros(6, 1), region=torch.zeros(6, 1, dtype=torch.int64), next=following, batch_size=6
    )
    with torch.no_grad():
        assert own(rows)["loss_gentle"].item() == pytest.approx(0.5 * 0.3 * policy(latents).square().mean().item(), rel=1e-4)
        assert own.world_model(rows)["loss_gentle"].item() == 0.0


def test_a_rival_is_measured_by_the_same_call(use):
    found = use("my_rival.py")["found"]
    assert found["labelled_safe_rollouts_touch_unsafe"] == 0.0
    assert found["unsafe_rollouts_return"] >= 0.8
    for name in ("volume_over_kernel", "unsafe_called_safe"):
        assert found[name] is None


@pytest.mark.slow
def test_a_phase_takes_the_place_of_another(use):
    agent = use("my_phase.py")["agent"]
    rows = [json.loads(line) for line in Path("runs/calm/log.jsonl").read_text().splitlines()]
    assert "steer" not in {row["phase"] for row in rows}
    (calm,) = [row for row in rows if row["phase"] == "calm"]
    assert calm["round"] == 1
    assert calm["step"] == 20
    assert calm["loss_calm"] > 0
    order = list(dict.fromkeys(row["phase"] for row in rows if row["round"] == 1))
    assert order[-3:] == ["tighten", "calm", "check"]
    assert not any(p.requires_grad for p in agent.parameters())
