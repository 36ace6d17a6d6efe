"""[V] in the files that other verifiers read: the closed loop as ONNX, what is to be refuted as VNN-LIB."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from torch import Tensor

from torchrl_sspl.certification.graph import Affine, Apply, Graph
from torchrl_sspl.certification.loop import ClosedLoop
from torchrl_sspl.errors import ConfigError, MissingDependencyError
from torchrl_sspl.files import write

NETWORK, PROPERTY = "invariance.onnx", "invariance.vnnlib"


def export_vnnlib(system: ClosedLoop, directory: str | Path, *, level: float = 0.0) -> tuple[Path, Path]:
    r"""Writes the refutation of [V], for a verifier that is not ours.

    .. math:: \exists z \in [l, h]: \quad B(z) \le s, \quad B(d(z, \pi(z))) \ge s

    ``unsat`` confirms [V]. Of a policy that chooses it is a latent at which its own action is not accepted, and none of the table
    keeps the set: :math:`B(d(z, \pi(z))) \ge -m` and :math:`B(d(z, a_k)) \ge s` for all k. The network gives B(z), then these
    values, in matrix products, sums and ReLU alone: a clamp is :math:`l + \operatorname{relu}(x - l) - \operatorname{relu}(x - h)`. Weights are float32.

    Args:
        system: piecewise linear networks, of :func:`closed_loop`.
        directory: where ``invariance.onnx`` and ``invariance.vnnlib`` are written.
        level: s.

    Returns the paths of network and property. Raises ConfigError for an activation that is not piecewise linear, a policy that
    accepts its own actions above this level, or weights and factors that float32 does not hold exactly, and MissingDependencyError without the package ``onnx``. Source: none.

    Example:
        >>> from tempfile import mkdtemp
        >>> from torch import nn
        >>> from torchrl_sspl.certification import closed_loop
        >>> barrier, policy, plant = [nn.Sequential(nn.Linear(i, o)) for i, o in ((2, 1), (2, 1), (3, 2))]
        >>> system = closed_loop(barrier, plant, policy, latent_dim=2, lipschitz_bound=9.0)
        >>> export_vnnlib(system, mkdtemp())[1].read_text().count("assert")
        6
    """
    try:
        import onnx
    except ImportError as error:
        raise MissingDependencyError("writing ONNX needs the package onnx: pip install onnx") from error
    if system.accepted > level:
        raise ConfigError(f"expected a policy that accepts its own actions at B <= {level:g} at most, received one that does at {system.accepted:g}")
    writer = _Writer(onnx)
    outputs = [writer.graph(graph) for graph in (system.barrier, system.looped)]
    least = [system.accepted, *[level] * (len(system.inner) - 1)] if system.chooses else [level]
    network = writer.model(outputs, system.latent_dim, 1 + len(least)).SerializeToString()
    lines = [f"(declare-const X_{i} Real)" for i in range(system.latent_dim)]
    lines += [f"(declare-const Y_{k} Real)" for k in range(1 + len(least))]
    for i, (low, high) in enumerate(zip(system.low.tolist(), system.high.tolist(), strict=True)):
        lines += [f"(assert (>= X_{i} {low:.17g}))", f"(assert (<= X_{i} {high:.17g}))"]
    lines += [f"(assert (<= Y_0 {level:.17g}))", *(f"(assert (>= Y_{k} {v:.17g}))" for k, v in enumerate(least, start=1))]
    return write(Path(directory) / NETWORK, network), write(Path(directory) / PROPERTY, "\n".join(lines) + "\n")


class _Writer:
    """Nodes and constants of one ONNX graph of the input ``X`` ``(1, p)``."""

    def __init__(self, onnx: Any) -> None:
        self.onnx = onnx
        self.nodes: list[Any] = []
        self.constants: list[Any] = []

    def node(self, kind: str, *inputs: str, **options: Any) -> str:
        name = f"n{len(self.nodes)}"
        self.nodes.append(self.onnx.helper.make_node(kind, list(inputs), [name], **options))
        return name

    def constant(self, value: Tensor | np.ndarray) -> str:
        name = f"c{len(self.constants)}"
        given = np.asarray(value, dtype=np.float64)
        array = np.ascontiguousarray(given, dtype=np.float32)
        if not np.array_equal(array, given):
            raise ConfigError("expected weights and factors that float32 holds exactly, received others: another network than the proved one would be judged")
        self.constants.append(self.onnx.numpy_helper.from_array(array, name))
        return name

    def graph(self, graph: Graph) -> str:
        """Name of the output of a function of X."""
        names = ["X"]
        for step in graph.steps[1:]:
            if isinstance(step, Affine):
                parts = [self.node("MatMul", names[k], self.constant(w.mT)) for k, w in zip(step.sources, step.weights, strict=True)]
                parts.append(self.constant(step.bias[None]))
                total = parts[0]
                for part in parts[1:]:
                    total = self.node("Add", total, part)
                names.append(total)
            elif isinstance(step, Apply):
                names.append(self.activation(step, names[step.source], graph.sizes[step.source]))
        return names[-1]

    def activation(self, step: Apply, name: str, size: int) -> str:
        kind, knots = step.activation.name, step.activation.knots
        if kind == "ReLU":
            return self.node("Relu", name)
        if not kind.startswith("Clamp"):
            raise ConfigError(f"expected ReLU and clamps, received {kind}, which VNN-LIB's verifiers do not share")
        low, high = knots
        rise, fall = (self.node("Relu", self.node("Add", name, self.constant(np.full((1, size), -k)))) for k in (low, high))
        falling = self.node("MatMul", fall, self.constant(-np.eye(size)))
        return self.node("Add", self.node("Add", rise, falling), self.constant(np.full((1, size), low)))

    def model(self, outputs: list[str], size: int, values: int) -> Any:
        helper, kind = self.onnx.helper, self.onnx.TensorProto.FLOAT
        self.nodes.append(helper.make_node("Concat", outputs, ["Y"], axis=1))
        shapes = [helper.make_tensor_value_info(n, kind, [1, k]) for n, k in (("X", size), ("Y", values))]
        graph = helper.make_graph(self.nodes, "invariance", shapes[:1], shapes[1:], self.constants)
        model = helper.make_model(graph, opset_imports=[helper.make_opsetid("", 13)])
        model.ir_version = 8  # older readers know it
        self.onnx.checker.check_model(model)
        return model
