"""auto_LiRPA beside our own bounds: the shipped [V] decided with its bounds alone, and both on random networks.

Run: python benchmarks/lirpa.py SOURCE [agent=pendulum] [seconds=3600] [networks=200] [turned=0]

SOURCE is a checkout of https://github.com/Verified-Intelligence/auto_LiRPA (its release 0.3 does not import with the
torch of today; `pip install appdirs graphviz`). [V] is read from the ONNX file of `export_vnnlib`. A box of the latent
domain is settled when auto_LiRPA's CROWN bounds say that B > 0 on all of it, or that B of the successor is below 0 on all of it; every
other one is cut in two across its longest side. A centre that is a real counterexample ends the search. Nothing of
`torchrl_sspl.certification` but the export takes part. `turned=1` turns the sign of the policy round, of which [V] has to be refuted.
"""

from __future__ import annotations

import sys
import tempfile
import time
import types
import warnings
from typing import Any

import numpy as np
import onnx
import torch
from onnx import numpy_helper
from torch import Tensor, nn
from tqdm import tqdm

from torchrl_sspl import load
from torchrl_sspl.certification import closed_loop, export_vnnlib
from torchrl_sspl.certification.graph import Graph
from torchrl_sspl.certification.propagation import Enclosure

BATCH = 256


class FromOnnx(nn.Module):
    """The network of an exported file."""

    def __init__(self, path: str) -> None:
        super().__init__()
        graph = onnx.load(path).graph
        self.nodes = list(graph.node)
        matrices = {node.input[1] for node in self.nodes if node.op_type == "MatMul"}
        for constant in graph.initializer:
            value = torch.tensor(numpy_helper.to_array(constant))
            # What is added comes without the dimension of the batch, as auto_LiRPA wants it.
            self.register_buffer(constant.name, value if constant.name in matrices else value[0])

    def forward(self, x: Tensor) -> Tensor:
        """B of latents ``(n, p)``, then of their successors."""
        values = {"X": x, **dict(self.named_buffers())}
        for node in self.nodes:
            given = [values[name] for name in node.input]
            if node.op_type == "MatMul":
                found = given[0] @ given[1]
            elif node.op_type == "Add":
                found = given[0] + given[1]
            elif node.op_type == "Relu":
                found = torch.relu(given[0])
            else:
                found = torch.cat(given, 1)
            values[node.output[0]] = found
        return values["Y"]


def bounded(lirpa: Any, network: nn.Module, size: int) -> Any:
    """``(low, high) -> (lower, upper)`` of a network on boxes, by auto_LiRPA's CROWN."""
    module = lirpa.BoundedModule(network, torch.zeros(1, size))

    def bounds(low: Tensor, high: Tensor) -> tuple[Tensor, Tensor]:
        box = lirpa.PerturbationLpNorm(norm=float("inf"), x_L=low, x_U=high)
        with torch.no_grad():
            return module.compute_bounds(x=(lirpa.BoundedTensor((low + high) / 2, box),), method="CROWN")

    return bounds


def decide(lirpa: Any, agent: str, seconds: float, turned: bool) -> dict[str, Any]:
    """Whether [V] holds by auto_LiRPA's bounds: share of the domain that is settled, boxes, seconds."""
    loaded = load(agent)
    parts = [getattr(net, "module", net) for net in (loaded.barrier, loaded.dynamics, loaded.policy)]
    if turned:
        layer = [m for m in parts[2].modules() if isinstance(m, nn.Linear)][-1]
        for parameter in layer.parameters():
            parameter.data.neg_()
    system = closed_loop(*parts, latent_dim=loaded.latent_dim, lipschitz_bound=loaded.lipschitz_bound)
    network, _ = export_vnnlib(system, tempfile.mkdtemp())
    net, p, start = FromOnnx(str(network)), loaded.latent_dim, time.time()
    bounds, boxes, settled = bounded(lirpa, net, p), 0, 0.0
    # Of a policy that chooses: its own action is not accepted, and none of the table keeps the set.
    least = torch.tensor([system.accepted, *[0.0] * (len(system.inner) - 1)] if system.chooses else [0.0])
    cells = torch.cartesian_prod(*[torch.arange(-1.0, 1.0, 0.25)] * p)
    todo = [(a, a + 0.25) for a in cells.split(BATCH)]
    bar = tqdm(total=1.0, unit=" of the domain")
    while todo and time.time() - start < seconds:
        low, high = todo.pop()
        value = net((low + high) / 2)
        if bool(((value[:, 0] <= 0.0) & (value[:, 1:] >= least).all(1)).any()):
            return {"verdict": "refuted", "boxes": boxes, "seconds": round(time.time() - start)}
        lower, upper = bounds(low, high)
        done = (lower[:, 0] > 0.0) | (upper[:, 1:] < least).any(1)
        boxes += len(low)
        share = float((high - low)[done].prod(1).sum()) / 2**p
        settled += share
        bar.update(share)
        low, high = low[~done], high[~done]
        if len(low):
            rows, side = torch.arange(len(low)), (high - low).argmax(1)
            middle = ((low + high) / 2)[rows, side]
            first, second = high.clone(), low.clone()
            first[rows, side], second[rows, side] = middle, middle
            todo += list(zip(torch.cat([low, second]).split(BATCH), torch.cat([first, high]).split(BATCH), strict=True))
    verdict = "undecided" if todo else "confirmed"
    return {"verdict": verdict, "settled": settled, "boxes": boxes, "seconds": round(time.time() - start)}


def compare(lirpa: Any, networks: int) -> dict[str, Any]:
    """Upper bounds of random ReLU networks on random boxes: ours over theirs, and whether a value found lies above either."""
    ratios: list[float] = []
    exceeded = {"ours": 0, "theirs": 0}
    for k in tqdm(range(networks), unit="network"):
        g = torch.Generator().manual_seed(k)
        torch.manual_seed(k)
        p, depth, width = 2 + k % 4, 1 + k % 3, (16, 48, 96)[k % 3]
        layers: list[nn.Module] = []
        for i in range(depth):
            layers += [nn.Linear(p if i == 0 else width, width), nn.ReLU()]
        net = nn.Sequential(*layers, nn.Linear(width, 1))
        middle, radius = torch.rand(8, p, generator=g) * 2 - 1, 0.02 + 0.5 * torch.rand(8, 1, generator=g)
        low, high = middle - radius, middle + radius
        theirs = bounded(lirpa, net, p)(low, high)[1][:, 0].double()
        graph = Graph(p)
        graph.network(0, net)
        ours = Enclosure(graph, low.double(), high.double(), tight=True).upper(torch.ones(1, 1, dtype=torch.float64))
        upper = ours.upper(0.5 * (high - low).double())[:, 0]
        points = low + (high - low) * torch.rand(4096, 8, p, generator=g)
        with torch.no_grad():
            value = net(points)[..., 0].double()
        found, below = value.amax(0), value.mean(0)
        exceeded["ours"] += int((found > upper + 1e-5).sum())
        exceeded["theirs"] += int((found > theirs + 1e-5).sum())
        ratios += ((upper - below) / (theirs - below)).tolist()
    spread = np.quantile(ratios, [0.01, 0.5, 0.99]).round(4).tolist()
    return {"boxes": len(ratios), "exceeded": exceeded, "width, ours over theirs (1 %, median, 99 %)": spread}


def main(source: str, *, agent: str = "pendulum", seconds: float = 3600.0, networks: int = 200, turned: int = 0) -> dict[str, Any]:
    """Both."""
    # It takes two names of numpy that are gone.
    vars(np).update(Inf=np.inf)
    sys.modules.setdefault("numpy.lib.arraysetops", types.SimpleNamespace(isin=np.isin))  # type: ignore[arg-type]
    sys.path.insert(0, source)
    warnings.simplefilter("ignore")
    import auto_LiRPA

    found = compare(auto_LiRPA, networks) if networks else {}
    return found | decide(auto_LiRPA, agent, seconds, bool(turned))


if __name__ == "__main__":
    given: dict[str, Any] = dict(word.split("=") for word in sys.argv[2:])
    print(main(sys.argv[1], **{key: int(value) if value.isdigit() else value for key, value in given.items()}))
