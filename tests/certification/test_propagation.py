"""Bounds hold: sampled values of random networks on random boxes never escape them."""

from __future__ import annotations

from fractions import Fraction

import pytest
import torch
from torch import Tensor, nn

from torchrl_sspl.certification.branch_and_bound import Budget, Problem, maximise
from torchrl_sspl.certification.conditions import tolerates
from torchrl_sspl.certification.floating import rounding_bound
from torchrl_sspl.certification.graph import Graph
from torchrl_sspl.certification.half_spaces import clip, programme
from torchrl_sspl.certification.loop import closed_loop, evaluation_rounding
from torchrl_sspl.certification.propagation import Enclosure, LinearBound, interval_bounds
from torchrl_sspl.errors import ConfigError, ShapeError
from torchrl_sspl.lipschitz import layers as activations
from torchrl_sspl.lipschitz.layers import Abs, Relaxation, activation_of, clamp

KINDS = [
    nn.ReLU(), nn.LeakyReLU(0.1), nn.LeakyReLU(-0.2), nn.Hardtanh(-0.7, 0.4), nn.ReLU6(), nn.Tanh(), nn.Sigmoid(),
    nn.Softplus(2.0), nn.SiLU(), nn.GELU(), Abs(),
]  # fmt: skip
IDS = [str(k) for k in KINDS]
BOXES, SAMPLES = 60, 160


def random_graph(kind: nn.Module, generator: torch.Generator, p: int, width: int = 12) -> Graph:
    """z -> z + net(z, clamp(net'(z))), then a last network: everything that a closed loop has."""

    def layer(n_in: int, n_out: int) -> nn.Linear:
        made = nn.Linear(n_in, n_out)
        made.weight.data = 1.5 * torch.randn(n_out, n_in, generator=generator) / n_in**0.5
        made.bias.data = 0.5 * torch.randn(n_out, generator=generator)
        return made

    graph = Graph(p)
    policy = graph.network(0, nn.Sequential(layer(p, width), kind, layer(width, 1)))
    action = graph.interface(graph.apply(policy, clamp()))
    first = layer(p + 1, width)
    hidden = graph.linear([0, action], [first.weight[:, :p], first.weight[:, p:]], first.bias)
    hidden = graph.network(hidden, nn.Sequential(kind, layer(width, width), kind))
    last = layer(width, p)
    moved = graph.linear([0, hidden], [torch.eye(p), last.weight], last.bias)
    moved = graph.interface(graph.apply(moved, clamp()))
    graph.network(moved, nn.Sequential(layer(p, width), kind, layer(width, 2)))
    return graph


def random_boxes(generator: torch.Generator, p: int, n: int) -> tuple[Tensor, Tensor]:
    """Boxes of all sizes, points among them."""
    radius = 10 ** (-3.0 * torch.rand(n, 1, generator=generator)) * torch.rand(n, p, generator=generator)
    radius[:3] = 0.0
    center = 2 * torch.rand(n, p, generator=generator) - 1
    return (center - radius).double(), (center + radius).double()


def samples_of(low: Tensor, high: Tensor, n: int, generator: torch.Generator) -> Tensor:
    """Uniform points, corners among them, ``(n, boxes, p)``."""
    share = torch.rand(n, *low.shape, generator=generator, dtype=torch.float64)
    share[: n // 4] = share[: n // 4].round()
    return low + share * (high - low)


def escapes(kind: nn.Module, seed: int, p: int, tight: bool) -> tuple[int, int]:
    """Number of samples outside any of the bounds, and of samples."""
    g = torch.Generator().manual_seed(seed)
    graph = random_graph(kind, g, p)
    low, high = random_boxes(g, p, BOXES)
    points = samples_of(low, high, SAMPLES, g)
    value = graph(points.flatten(0, 1)).reshape(SAMPLES, BOXES, 2)
    box = Enclosure(graph, low, high, tight=tight)
    rows = torch.tensor([[1.0, 0.0], [-1.0, 0.0], [0.7, -1.3]], dtype=torch.float64)
    above = box.upper(rows)
    line = above.value + torch.einsum("bkp,sbp->sbk", above.slope, points - above.center)
    lower, upper = box.interval()
    first, last = interval_bounds(graph, low, high)[-1]
    slack = 1e-9
    outside = (value @ rows.mT > line + slack).any(-1)
    outside |= ((value < lower - slack) | (value > upper + slack)).any(-1)
    outside |= ((value < first - slack) | (value > last + slack)).any(-1)
    return int(outside.sum()), SAMPLES * BOXES


@pytest.mark.parametrize("kind", KINDS, ids=IDS)
def test_no_sample_escapes(kind):
    found = [escapes(kind, seed, p, tight) for seed in range(2) for p in (1, 2, 3, 4) for tight in (False, True)]
    assert sum(n for _, n in found) >= 100_000  # eleven activations: more than a million together
    assert sum(bad for bad, _ in found) == 0


def broken_relax(self, lower, upper):
    """The line above a ReLU drawn a little too low."""
    slope, offset, gap = self.parallel(lower, upper)
    return Relaxation(slope, offset - gap, slope, offset + 0.5 * gap)


def broken_parallel(self, lower, upper):
    slope = self._chord(lower, upper)
    low, high = self._offsets(slope, lower, upper)
    return slope, 0.5 * (high + low), 0.4 * (high - low)


@pytest.mark.parametrize(("name", "wrong"), [("relax", broken_relax), ("parallel", broken_parallel)])
@pytest.mark.parametrize("kind", [nn.ReLU(), nn.Tanh()], ids=["relu", "tanh"])
def test_bounds_that_are_slightly_wrong_are_noticed(monkeypatch, name, wrong, kind):
    monkeypatch.setattr(activations.Activation, name, wrong)
    assert sum(escapes(kind, seed, 2, False)[0] for seed in range(3)) > 0


@pytest.mark.parametrize("kind", KINDS, ids=IDS)
def test_lines_lie_below_and_above_their_activation(kind):
    act = activation_of(kind)
    g = torch.Generator().manual_seed(0)
    lower = 12 * torch.rand(4000, generator=g, dtype=torch.float64) - 8
    upper = lower + 10 ** (3 * torch.rand(4000, generator=g, dtype=torch.float64) - 2.5)
    x = lower + (upper - lower) * torch.linspace(0, 1, 101, dtype=torch.float64)[:, None]
    lines = act.relax(lower, upper)
    below, above = lines.lower_slope * x + lines.lower_offset, lines.upper_slope * x + lines.upper_offset
    assert bool((below <= act.value(x) + 1e-12).all())
    assert bool((above >= act.value(x) - 1e-12).all())
    low, high = act.interval(lower, upper)
    assert bool((low <= act.value(x) + 1e-12).all())
    assert bool((high >= act.value(x) - 1e-12).all())


@pytest.mark.parametrize("kind", KINDS, ids=IDS)
def test_values_are_those_of_pytorch(kind):
    x = torch.linspace(-9, 9, 1001, dtype=torch.float64)
    torch.testing.assert_close(activation_of(kind).value(x), kind(x), atol=1e-9, rtol=1e-9)


def test_small_boxes_give_bounds_that_close_in_on_the_value():
    g = torch.Generator().manual_seed(3)
    graph = random_graph(nn.Tanh(), g, 3)
    center = (2 * torch.rand(50, 3, generator=g) - 1).double()
    wide = []
    for radius in (0.1, 0.01, 0.001):
        lower, upper = Enclosure(graph, center - radius, center + radius).interval()
        wide.append(float((upper - lower).mean()))
    assert wide[1] < 0.2 * wide[0]
    assert wide[2] < 0.2 * wide[1]


def test_backward_bounds_beat_interval_arithmetic():
    g = torch.Generator().manual_seed(4)
    graph = random_graph(nn.ReLU(), g, 3)
    center = (2 * torch.rand(100, 3, generator=g) - 1).double()
    low, high = center - 0.02, center + 0.02
    box = Enclosure(graph, low, high, tight=True)
    above = box.upper(torch.eye(2, dtype=torch.float64)).upper(box.radius)
    plain = interval_bounds(graph, low, high)[-1][1]
    assert float((above - graph(center)).mean()) < 0.5 * float((plain - graph(center)).mean())


def test_rounding_bound_covers_float32_against_exact_rational_arithmetic():
    g = torch.Generator().manual_seed(5)
    net = nn.Sequential(nn.Linear(2, 8), nn.ReLU(), nn.Linear(8, 8), nn.ReLU(), nn.Linear(8, 1)).requires_grad_(False)
    for layer in net[::2]:
        layer.weight.copy_(torch.randn(layer.weight.shape, generator=g))
        layer.bias.copy_(torch.randn(layer.bias.shape, generator=g))
    graph = Graph(2)
    graph.network(0, net)
    points = 2 * torch.rand(30, 2, generator=g) - 1
    for unit, evaluate in ((2.0**-24, lambda x: net(x)), (2.0**-53, lambda x: graph(x))):
        bound = rounding_bound(graph, points.double(), points.double(), unit)[-1][:, 0]
        for i, x in enumerate(points):
            exact = _exact(net, [Fraction(v) for v in x.tolist()])
            gap = abs(Fraction(float(evaluate(x[None])[0, 0])) - exact)
            assert gap <= Fraction(float(bound[i]))
        assert float(bound.max()) < 1e5 * unit  # and is no empty promise


def _exact(net: nn.Sequential, x: list[Fraction]) -> Fraction:
    for layer in net:
        if isinstance(layer, nn.Linear):
            rows = zip(layer.weight.tolist(), layer.bias.tolist(), strict=True)
            x = [sum((Fraction(w) * v for w, v in zip(row, x, strict=True)), Fraction(b)) for row, b in rows]
        else:
            x = [max(v, Fraction(0)) for v in x]
    return x[0]


def test_linear_programme_on_boxes_is_never_below_what_sampling_finds():
    g = torch.Generator().manual_seed(6)
    n, p = 300, 3
    randn = lambda *shape: torch.randn(*shape, generator=g, dtype=torch.float64)  # noqa: E731
    objective = LinearBound(randn(n, 1, p), randn(n, 1), torch.zeros(n, p).double())
    constraint = LinearBound(randn(n, 1, p), 0.3 * randn(n, 1), torch.zeros(n, p).double())
    radius = torch.rand(n, p, generator=g, dtype=torch.float64)
    top = programme(objective, constraint, radius)[:, 0]
    z = (2 * torch.rand(2000, n, p, generator=g, dtype=torch.float64) - 1) * radius
    value = torch.einsum("np,snp->sn", objective.slope[:, 0], z) + objective.value[:, 0]
    holds = torch.einsum("np,snp->sn", constraint.slope[:, 0], z) + constraint.value[:, 0] <= 0
    best = torch.where(holds, value, -torch.inf).amax(0)
    some = holds.any(0)
    assert bool((best <= top + 1e-12)[some].all())
    assert float((top - best)[some].median()) < 0.3  # and close to it
    low, high = clip(-radius, radius, constraint)
    kept = (z >= low - 1e-12) & (z <= high + 1e-12)
    assert bool(kept.all(-1)[holds].all())  # clipping loses no point at which the constraint holds
    assert float((high - low).prod(1).sum()) < float((2 * radius).prod(1).sum())


def test_boxes_that_are_cut_twice_keep_every_point_that_meets_both_constraints():
    # As the search cuts them: both functions are written around the centre of the box that there was before, or elsewhere.
    g = torch.Generator().manual_seed(8)
    n, p = 400, 3
    randn = lambda *shape: torch.randn(*shape, generator=g, dtype=torch.float64)  # noqa: E731
    center, radius = randn(n, p), 0.1 + torch.rand(n, p, generator=g, dtype=torch.float64)
    z = center + (2 * torch.rand(2000, n, p, generator=g, dtype=torch.float64) - 1) * radius
    low, high = center - radius, center + radius
    holds, written = torch.ones(2000, n, dtype=torch.bool), center
    for away in (0.0, 1.0):
        slope, value = randn(n, p), 0.3 * randn(n)
        holds &= torch.einsum("np,snp->sn", slope, z - center) + value <= 0
        written = center + away * randn(n, p)
        moved = value + (slope * (written - center)).sum(1)
        low, high = clip(low, high, LinearBound(slope[:, None], moved[:, None], written))
    inside = ((z >= low - 1e-12) & (z <= high + 1e-12)).all(-1)
    assert bool(inside[holds].all())
    assert float((high - low).clamp_min(0.0).prod(1).sum()) < 0.8 * float((2 * radius).prod(1).sum())


def test_search_closes_in_on_the_maximum_of_a_random_network():
    g = torch.Generator().manual_seed(7)
    graph = random_graph(nn.ReLU(), g, 2)
    one, zero = torch.ones(2, dtype=torch.float64), torch.zeros(1, dtype=torch.float64)
    rows = torch.tensor([[1.0, -0.5]], dtype=torch.float64)
    found = maximise(Problem(-one, one, graph, rows, graph, zero, zero), tolerance=1e-3)
    grid = torch.cartesian_prod(*[torch.linspace(-1, 1, 801, dtype=torch.float64)] * 2)
    best = float((graph(grid) @ rows.mT).max())
    assert found.status == "proved"
    assert best <= found.upper
    assert found.upper - found.lower <= 1.1e-3
    again = maximise(Problem(-one, one, graph, rows, graph, zero, zero), tolerance=1e-3)
    assert (again.upper, again.lower, again.boxes) == (found.upper, found.lower, found.boxes)


def test_wrong_shapes_and_unknown_layers_are_refused():
    graph = Graph(2)
    graph.network(0, nn.Linear(2, 1))
    with pytest.raises(ShapeError, match="corners"):
        Enclosure(graph, torch.zeros(3, 1).double(), torch.ones(3, 1).double())
    with pytest.raises(ShapeError, match="float64"):
        Enclosure(graph, torch.zeros(3, 2), torch.ones(3, 2))
    with pytest.raises(ShapeError, match="do not fit"):
        graph.network(1, nn.Linear(3, 1))
    with pytest.raises(ConfigError, match="Softsign"):
        graph.network(0, nn.Sequential(nn.Linear(2, 2), nn.Softsign()))
    layer = nn.Linear(2, 2)
    layer.register_forward_hook(lambda *_: None)
    with pytest.raises(ConfigError, match="hooks"):
        graph.network(0, nn.Sequential(layer))
    with pytest.raises(ConfigError, match="boxes"):
        Budget(boxes=-1)


@pytest.mark.parametrize("barrier", [nn.Sequential(Abs(), nn.Linear(1, 1)), nn.Identity()])
def test_an_error_moves_what_a_barrier_reads_without_a_linear_layer_first(barrier):
    # |z| - 0.3, or z, after z+ = 0: {B <= level} tolerates errors up to 0.3.
    plant, level = nn.Sequential(nn.Linear(2, 1)), 0.0 if isinstance(barrier, nn.Sequential) else 0.3
    nn.utils.vector_to_parameters(torch.zeros(3), plant.parameters())
    if level == 0.0:
        nn.utils.vector_to_parameters(torch.tensor([1.0, -0.3]), barrier.parameters())
    loop = closed_loop(barrier, plant, nn.Sequential(nn.Linear(1, 1)), latent_dim=1, lipschitz_bound=1.0)
    assert [tolerates(loop, e, level=level, budget=Budget(boxes=2000)).status == "proved" for e in (0.29, 0.31, 0.9)] == [True, False, False]


def test_rounding_of_many_latents_is_bounded_in_fewer_pieces():
    p = 12
    plant = nn.Sequential(nn.Linear(p + 1, p))
    of = {"latent_dim": p, "lipschitz_bound": 9.0}
    system = closed_loop(nn.Sequential(nn.Linear(p, 1)), plant, nn.Sequential(nn.Linear(p, 1)), **of)
    assert 0.0 < evaluation_rounding(system) < 1e-12
