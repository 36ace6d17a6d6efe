"""[V] in the files of other verifiers: the same function, the same question."""

from __future__ import annotations

import re
import sys

import pytest
import torch
from torch import nn

from torchrl_sspl import load
from torchrl_sspl.certification import closed_loop, export_vnnlib
from torchrl_sspl.errors import ConfigError, MissingDependencyError
from torchrl_sspl.modules import LatentDynamics, Policy


def system(activation: type[nn.Module] = nn.ReLU, dtype: torch.dtype = torch.float32, **options):
    torch.manual_seed(0)
    barrier = nn.Sequential(nn.Linear(3, 8, dtype=dtype), activation(), nn.Linear(8, 1, dtype=dtype))
    parts = (net.to(dtype) for net in (LatentDynamics(3, 1, (8,), 2.0), Policy(3, 1, (8,), 2.0)))
    return closed_loop(barrier, *parts, latent_dim=3, lipschitz_bound=9.0, **options)


def values(path, points):
    run = pytest.importorskip("onnx.reference").ReferenceEvaluator(str(path))
    return torch.stack([torch.from_numpy(run.run(None, {"X": z[None].float().numpy()})[0][0]) for z in points])


@pytest.mark.parametrize("which", ["small", "pendulum"])
def test_the_network_is_the_closed_loop(which, tmp_path):
    pytest.importorskip("onnx")
    agent = load("pendulum")
    parts = (getattr(net, "module", net) for net in (agent.barrier, agent.dynamics, agent.policy))
    loop = system() if which == "small" else closed_loop(*parts, latent_dim=3, lipschitz_bound=2.0)
    points = torch.rand(50, 3) * 2 - 1
    expected = torch.cat([loop.barrier(points), loop.looped(points)], -1).float()
    network, _ = export_vnnlib(loop, tmp_path)
    torch.testing.assert_close(values(network, points), expected, atol=2e-5, rtol=1e-4)


def test_the_property_asks_for_a_counterexample_in_the_domain(tmp_path):
    pytest.importorskip("onnx")
    low = torch.tensor([-0.1, -1.0, -2.0], dtype=torch.float64)
    _, path = export_vnnlib(system(low=low, high=3.0), tmp_path, level=-0.125)
    found = re.findall(r"\(assert \(([<>]=) (\w+) (\S+)\)\)", path.read_text())
    wanted = {(">=", f"X_{i}"): v for i, v in enumerate(low.tolist())} | {("<=", f"X_{i}"): 3.0 for i in range(3)}
    wanted |= {("<=", "Y_0"): -0.125, (">=", "Y_1"): -0.125}
    assert {(op, name): float(value) for op, name, value in found} == wanted


def test_what_others_cannot_read_is_refused(tmp_path, monkeypatch):
    pytest.importorskip("onnx")
    with pytest.raises(ConfigError, match="expected ReLU and clamps, received"):
        export_vnnlib(system(nn.Softplus), tmp_path)
    with pytest.raises(ConfigError, match="float32 holds exactly"):
        export_vnnlib(system(dtype=torch.float64), tmp_path)
    monkeypatch.setitem(sys.modules, "onnx", None)
    with pytest.raises(MissingDependencyError, match="pip install onnx"):
        export_vnnlib(system(), tmp_path)
