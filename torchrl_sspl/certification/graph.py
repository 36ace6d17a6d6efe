r"""Composed networks as a list of two kinds of steps: sums of linear maps, and activations.

A step may take the output of any earlier one, so that skip connections (:math:`z + f(z, \pi(z))`) stay what they are.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

import torch
from torch import Tensor, nn

from torchrl_sspl.errors import NonFiniteError, ShapeError
from torchrl_sspl.lipschitz.layers import Activation, activation_of
from torchrl_sspl.lipschitz.network import flat_layers


@dataclass(frozen=True)
class Affine:
    r"""Step :math:`\sum_k W_k x_k + b`, float64."""

    sources: tuple[int, ...]  # numbers of the steps whose outputs x_k are taken
    weights: tuple[Tensor, ...]  # W_k, each (out, in_k)
    bias: Tensor  # (out,)
    roundings: int = 0  # of the deployed evaluation, beside those of the products and the sums


@dataclass(frozen=True)
class Apply:
    """Step that applies an activation to every entry."""

    source: int
    activation: Activation


@dataclass
class Graph:
    """Function of a vector, as steps; step 0 is the input, the last step is the output.

    Weights are taken in float64, which float32 weights fit in exactly. Methods that append a step return its number.

    Example:
        >>> graph = Graph(2)
        >>> hidden = graph.network(0, nn.Sequential(nn.Linear(2, 8), nn.ReLU(), nn.Linear(8, 2)))
        >>> _ = graph.linear([0, hidden], [torch.eye(2), torch.eye(2)])  # z + f(z)
        >>> graph(torch.zeros(5, 2)).shape
        torch.Size([5, 2])
    """

    input_dim: int
    steps: list[Affine | Apply | None] = field(default_factory=lambda: [None])
    sizes: list[int] = field(default_factory=list)
    activated: set[int] = field(default_factory=set)  # steps to which an activation is applied
    interfaces: set[int] = field(default_factory=set)  # steps of few numbers, at which bounds are made tight
    last_use: dict[int, list[int]] = field(default_factory=dict)  # step -> steps that are needed for it last

    def __post_init__(self) -> None:
        self.sizes = [self.input_dim]

    @property
    def output_dim(self) -> int:
        """Size of the last step."""
        return self.sizes[-1]

    def linear(
        self, sources: Sequence[int], weights: Sequence[Tensor], bias: Tensor | None = None, *, roundings: int = 0
    ) -> int:
        """Appends a sum of linear maps ``(out, in)`` of earlier steps, and a bias ``(out,)`` or none.

        The roundings are those of the deployed evaluation, beside those of the products and the sums.
        """
        matrices = tuple(w.detach().double().cpu() for w in weights)
        out = matrices[0].shape[0]
        offset = torch.zeros(out, dtype=torch.float64) if bias is None else bias.detach().double().cpu()
        for source, matrix in zip(sources, matrices, strict=True):
            if matrix.shape != (out, self.sizes[source]) or offset.shape != (out,):
                raise ShapeError(
                    f"expected weights of shape ({out}, {self.sizes[source]}) and a bias of {out}, received "
                    f"{tuple(matrix.shape)} and {tuple(offset.shape)}; the networks do not fit each other"
                )
        if not all(bool(t.isfinite().all()) for t in (*matrices, offset)):
            raise NonFiniteError("expected finite weights, received NaN or infinity; the network cannot be certified")
        return self._append(Affine(tuple(sources), matrices, offset, roundings), out, sources)

    def side_by_side(self, sources: Sequence[int]) -> int:
        """Appends the outputs of several steps as one vector, where there are several."""
        if len(sources) == 1:
            return sources[0]
        sizes = [self.sizes[k] for k in sources]
        return self.linear(sources, list(torch.eye(sum(sizes)).split(sizes, 1)))

    def apply(self, source: int, activation: Activation) -> int:
        """Appends an activation of an earlier step."""
        self.activated.add(source)
        return self._append(Apply(source, activation), self.sizes[source], [source])

    def interface(self, step: int) -> int:
        """Marks a step of few numbers, at which bound propagation makes its bounds tight; returns its number."""
        self.interfaces.add(step)
        return step

    def undecided(self, step: int, low: Tensor, high: Tensor) -> Tensor:
        """Entries of a step on which its activations are not linear between two bounds, ``(n, size)`` bool."""
        result = torch.zeros_like(low, dtype=torch.bool)
        for later in self.steps[step:]:
            if isinstance(later, Apply) and later.source == step:
                if later.activation.curvature:
                    return torch.ones_like(result)
                for knot in later.activation.knots:
                    result |= (low < knot) & (high > knot)
        return result

    def _append(self, step: Affine | Apply, size: int, sources: Sequence[int]) -> int:
        self.steps.append(step)
        self.sizes.append(size)
        number = len(self.steps) - 1
        for used in self.last_use.values():
            used[:] = [s for s in used if s not in sources]
        self.last_use[number] = list(sources)
        return number

    def network(self, source: int, network: nn.Module) -> int:
        """Appends the layers of a plain network (:func:`~torchrl_sspl.lipschitz.network.flat_layers`) after a step."""
        return self.layers(source, flat_layers(network))

    def layers(self, source: int, layers: Sequence[nn.Module]) -> int:
        """Appends layers that were looked at, as :meth:`network`."""
        for layer in layers:
            if isinstance(layer, nn.Linear):
                source = self.linear([source], [layer.weight], layer.bias)
            else:
                source = self.apply(source, activation_of(layer))
        return source

    def values(self, point: Tensor) -> list[Tensor]:
        """Outputs of all steps at points ``(n, input_dim)``, each ``(n, size)``."""
        if point.ndim != 2 or point.shape[1] != self.input_dim:
            raise ShapeError(f"expected points of shape (n, {self.input_dim}), received {tuple(point.shape)}")
        values = [point.double()]
        for step in self.steps[1:]:
            if isinstance(step, Apply):
                values.append(step.activation.value(values[step.source]))
            elif isinstance(step, Affine):
                first, *rest = zip(step.sources, step.weights, strict=True)
                total = torch.addmm(step.bias, values[first[0]], first[1].mT)
                for source, weight in rest:
                    total = total.addmm(values[source], weight.mT)
                values.append(total)
        return values

    def __call__(self, point: Tensor) -> Tensor:
        """Value of the function at points, ``(n, input_dim) -> (n, output_dim)``."""
        return self.values(point)[-1]
