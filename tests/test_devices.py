"""A device or a compiler that this machine lacks is refused by name."""

from __future__ import annotations

import shutil
from functools import partial

import pytest
import torch
from tiny import TINY
from torch import nn

from torchrl_sspl import load
from torchrl_sspl.cli import main
from torchrl_sspl.configs import compose
from torchrl_sspl.devices import compiled, usable_device
from torchrl_sspl.envs import PendulumEnv
from torchrl_sspl.errors import ConfigError, MissingDependencyError
from torchrl_sspl.experiments.run import Experiment

ABSENT = f"cuda:{torch.cuda.device_count()}"


@pytest.mark.parametrize("name", [ABSENT, "nonsense"])
@pytest.mark.parametrize(
    "use",
    [
        usable_device,
        lambda name: load("pendulum", name),
        lambda name: PendulumEnv(batch_size=[1], device=name),
        lambda name: Experiment(compose([*TINY, f"device={name}", "out_dir=run"])),
        lambda name: Experiment(compose([*TINY, f"device={name}", "out_dir=run"]), PendulumEnv),
    ],
    ids=["usable_device", "load", "environment", "experiment", "experiment-of-ones-own"],
)
def test_a_device_that_is_not_there_is_refused_by_name(use, name, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    with pytest.raises(ConfigError, match=rf"expected a device that this machine has.*received '{name}'"):
        use(name)
    assert not list(tmp_path.iterdir())


def test_the_command_line_says_so_too(tmp_path, capsys):
    assert main(["train", "env=pendulum", f"device={ABSENT}", f"out_dir={tmp_path}"]) == 2
    assert main(["evaluate", "pendulum", "--device", ABSENT]) == 2
    assert capsys.readouterr().err.count(f"received '{ABSENT}'") == 2


def test_without_a_compiler_the_error_says_what_to_do(monkeypatch):
    def fails(words: str):
        def call(*_: torch.Tensor) -> torch.Tensor:
            raise RuntimeError(words)

        return lambda *_, **__: call

    monkeypatch.setattr(torch, "compile", fails("InvalidCxxCompiler: No working C++ compiler found\nand more"))
    with pytest.raises(MissingDependencyError, match="install one, or leave it out"):
        compiled(lambda x: 2 * x)(torch.ones(1))
    monkeypatch.setattr(torch, "compile", fails("shapes do not fit"))
    with pytest.raises(RuntimeError, match="shapes do not fit"):
        compiled(lambda x: 2 * x)(torch.ones(1))


@pytest.mark.skipif(shutil.which("g++") is None, reason="no C++ compiler")
@torch.no_grad()
def test_each_module_has_a_graph_of_its_own():
    x = torch.tensor([[-1.0, 2.0]])
    for answer in (nn.ReLU(), nn.Tanh(), nn.Linear(2, 2), nn.Linear(2, 2)):
        assert torch.allclose(compiled(nn.Sequential(answer).forward)(x), answer(x))


def test_beyond_the_shapes_that_graphs_are_kept_for_nothing_stops(monkeypatch):
    monkeypatch.setattr(torch, "compile", partial(torch.compile, backend="eager"))
    double = compiled(lambda x: 2 * x)
    for n in range(1, 12):
        assert torch.equal(double(torch.ones(n)), 2 * torch.ones(n))
