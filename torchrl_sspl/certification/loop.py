r"""The closed loop :math:`z^+ = d(z, \pi(z))` of frozen networks, in the form in which bounds propagate through it.

Modules are known by their exact types, and refused where what is deployed may be something else. Latents that hold a direction are
functions of their charts, and a policy that chooses has one output for its own action and one for each of its table (Theorem H in
``docs/theory.md``).
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any, cast

import torch
from torch import Tensor, nn

from torchrl_sspl.certification.branch_and_bound import SLACK, Problem
from torchrl_sspl.certification.floating import largest_rounding, more_than, rounding_bound
from torchrl_sspl.certification.graph import Affine, Graph
from torchrl_sspl.direction import Direction, direction_of, lifted, within
from torchrl_sspl.errors import ConfigError, StructureError
from torchrl_sspl.lipschitz import lipschitz_upper
from torchrl_sspl.lipschitz.layers import FORMS, clamp, sine
from torchrl_sspl.lipschitz.network import check_module, flat_layers

_SCALES = (1e-10, 1e10)
#: How often more it counts by how much a policy that chooses accepts its own action than by how much the set is kept: any number
#: is sound; the larger it is, the less is lost near the border of acceptance.
_SHARPNESS = 16.0


@dataclass(frozen=True)
class ClosedLoop:
    r"""Frozen networks in the form in which bounds propagate through them; made by :func:`closed_loop`.

    Attributes:
        barrier: B, ``(n, p) -> (n, 1)``. Of latents that hold a direction, this and all below are functions of their charts
            ``(n, p - 1)``, and the domain is that of the charts.
        step: :math:`d(z, \pi(z))`, ``(n, p) -> (n, p)``; of a policy that chooses, for its own action and each of the table,
            ``(n, (1 + K) p)``.
        looped: :math:`B(d(z, \pi(z)))`, ``(n, p) -> (n, 1)``; of a policy that chooses ``(n, 1 + K)``.
        inner: numbers of the steps of ``looped`` that hold :math:`d(z, \pi(z))`, one for each output.
        lipschitz_bound: proved Lipschitz constant of B.
        low: lower corner of the domain, ``(p,)`` float64.
        high: upper corner, ``(p,)`` float64.
        accepted: :math:`-m` of a policy that chooses: what B may be after its own action; :math:`-\infty` of any other.
    """

    barrier: Graph
    step: Graph
    looped: Graph
    inner: tuple[int, ...]
    lipschitz_bound: float
    low: Tensor
    high: Tensor
    accepted: float = -math.inf
    direction: Direction | None = None
    behind: Graph | None = None  # B of latents, where they hold a direction

    def latent(self, point: Tensor) -> Tensor:
        """Latents ``(*batch, p)`` of points of the domain."""
        return lifted(point, self.direction)

    @property
    def latent_dim(self) -> int:
        """Size of the latent, or of its chart."""
        return self.barrier.input_dim

    @property
    def chooses(self) -> bool:
        """Whether the policy chooses."""
        return len(self.inner) > 1

    def problem(
        self,
        *,
        level: float | None,
        weight: tuple[float, ...] = (0.0,),
        constant: tuple[float, ...] = (0.0,),
        error: float = 0.0,
        lost: float = 0.0,
    ) -> Problem:
        r"""Maximum of :math:`\min_k B(d(z, \pi(z)) + e) - b_k B(z) + c_k + \lambda` where B is at most a level, if one is given,
        over all e up to an error that stay in the domain; :math:`\lambda` is what an evaluation of :math:`B(d(z, \pi(z)))` may be off.

        Of a policy that chooses, with sharpness :math:`\sigma`, it is what is left where its own action is not accepted:

        .. math:: \min \{ \sigma (B(d(z, \pi(z))) + m + \lambda), \; \min_k B(d(z, a_k)) + c + 3 \lambda + L_B \delta \}

        If this is at most zero, or a number below, then so is the second part wherever the first is above zero. Which of the
        table is chosen is decided without the error, so that the error counts by the Lipschitz constant.
        """
        # An infinite constant would turn the cheap tests into comparisons with infinity and NaN.
        known = self.lipschitz_bound if math.isfinite(self.lipschitz_bound) else None
        if self.chooses:
            if any(weight) or len(weight) > 1:
                raise ConfigError("expected the condition R3 of a policy that chooses, received one that weighs B(z); see decide_invariance")
            n = len(self.inner)
            kept = constant[0] + 3.0 * lost + self.lost_by(error)
            constant = (_SHARPNESS * (lost - self.accepted), *[kept] * (n - 1))
            rows, weight, error = torch.diag(torch.tensor([_SHARPNESS] + [1.0] * (n - 1), dtype=torch.float64)), (0.0,) * n, 0.0
        else:
            rows, constant = torch.ones(len(weight), 1, dtype=torch.float64), tuple(c + lost for c in constant)
        b, c = (torch.tensor(v, dtype=torch.float64) for v in (weight, constant))
        of: dict[str, Any] = {"level": level, "lipschitz": known, "inner": self.inner, "error": error, "behind": self.behind}
        if self.direction is not None:
            of["within"] = partial(within, direction=self.direction)
        return Problem(self.low, self.high, self.looped, rows, self.barrier, b, c, **of)

    def lost_by(self, error: float) -> float:
        """What B may rise by with an error, latent units, by the Lipschitz constant; barrier units, rounded up."""
        return more_than(self.lipschitz_bound * error) if error else 0.0

    def rounding(self, unit: float, *, level: float = math.inf, boxes: int = 16384) -> tuple[float, float]:
        """What an evaluation with a unit roundoff is off at most: of B, anywhere, and of d(z, pi(z)) (Euclidean norm), wherever the
        computed B is at most a level."""
        of_barrier = largest_rounding(self.barrier, self.low, self.high, unit, boxes=boxes)
        where = None if math.isinf(level) else (self.barrier, level + of_barrier + SLACK)
        step = largest_rounding(self.step, self.low, self.high, unit, boxes=boxes, vectors=len(self.inner), where=where)
        return of_barrier, step


def closed_loop(
    barrier: nn.Module,
    dynamics: nn.Module,
    policy: nn.Module,
    *,
    latent_dim: int,
    lipschitz_bound: float,
    low: float | Tensor = -1.0,
    high: float | Tensor = 1.0,
) -> ClosedLoop:
    r"""The closed loop of frozen networks.

    .. math:: u = s \operatorname{clamp}(\operatorname{net}_\pi(z), -1, 1), \qquad
        z^+ = \operatorname{clamp}(z + \operatorname{net}_d(z, u / s), -1, 1)

    Modules are known by their exact types (:mod:`torchrl_sspl.lipschitz.layers`), and whatever might stand between
    their weights and what they compute is refused.

    Args:
        barrier: ``nn.Sequential`` of linear layers and activations (or one with ``collapse()``), p inputs, 1 output.
        dynamics: module in the form above (``modules.LatentDynamics``), or a plain ``nn.Sequential`` of ``(z, u)``,
            p + m inputs and p outputs, taken as it is. Either takes the action in physical units.
        policy: module in the form above (``modules.Policy``), or a plain ``nn.Sequential``, p inputs and m outputs.
            Either gives the action in physical units. Or a ``modules.ChoosingPolicy`` of such a policy, bound to this barrier and
            to these dynamics, which are of the form above.
        latent_dim: p.
        lipschitz_bound: proved Lipschitz constant of the barrier (``math.inf`` where none is known).
        low: lower corner of the domain, a number or ``(p,)``.
        high: upper corner.

    Raises:
        StructureError: if a module may compute something else than it says, or an action scale differs or is not valid.
        ConfigError: if the domain is empty.
        ShapeError: if the networks do not fit each other.
        NonFiniteError: if a weight is NaN or infinite.

    Source: paper eq. (8)-(9), composed; deviation: none.

    Example:
        >>> plant = nn.Sequential(nn.Linear(3, 2, bias=False))  # z+ = z / 2, whatever the action is
        >>> nn.utils.vector_to_parameters(torch.tensor([0.5, 0.0, 0.0, 0.0, 0.5, 0.0]), plant.parameters())
        >>> barrier, policy = nn.Sequential(nn.Linear(2, 1)), nn.Sequential(nn.Linear(2, 1))
        >>> closed_loop(barrier, plant, policy, latent_dim=2, lipschitz_bound=math.inf).step(torch.ones(1, 2)).tolist()
        [[0.5, 0.5]]
    """
    corners = [torch.as_tensor(c, dtype=torch.float64).cpu().expand(latent_dim).clone() for c in (low, high)]
    if not bool((corners[0] < corners[1]).all()) or not all(bool(c.isfinite().all()) for c in corners):
        raise ConfigError(f"expected finite low < high in every dimension, received {corners[0].tolist()}, {corners[1].tolist()}")
    if not lipschitz_bound > 0:
        raise ConfigError(f"expected a positive Lipschitz bound of the barrier, received {lipschitz_bound}")
    chooses = FORMS.get(type(policy)) == "choosing"
    if chooses:
        _check_choice(policy, dynamics, barrier, corners)
    direction = direction_of(dynamics) if FORMS.get(type(dynamics)) == "residual" else None
    behind = Graph(latent_dim)
    behind.network(0, barrier)
    if direction is not None:
        corners = _chart_of(direction, corners)
    of_chart = latent_dim if direction is None else latent_dim - 1
    alone, step, looped = Graph(of_chart), Graph(of_chart), Graph(of_chart)
    alone.network(_append_latent(alone, 0, direction), barrier)
    found, inner = (_append_steps(graph, dynamics, policy, direction) for graph in (step, looped))
    sizes = {step.sizes[k] for k in found}
    if alone.output_dim != 1 or sizes != {latent_dim}:
        raise ConfigError(
            f"expected a barrier of one output and dynamics of {latent_dim}, received {alone.output_dim} and {sorted(sizes)}"
        )
    step.side_by_side(found)
    reads = inner
    if not any(isinstance(step, Affine) for step in behind.steps[1:2]):  # an error moves what linear layers read, and activations would miss it
        reads = [looped.linear([k], [torch.eye(latent_dim)], roundings=0) for k in inner]
    looped.side_by_side([looped.network(k, barrier) for k in reads])
    accepted = -float(cast(Tensor, policy.margin)) if chooses else -math.inf
    turns: dict[str, Any] = {} if direction is None else {"direction": direction, "behind": behind}
    return ClosedLoop(alone, step, looped, tuple(inner), float(lipschitz_bound), corners[0], corners[1], accepted, **turns)


def _chart_of(direction: Direction, corners: Sequence[Tensor]) -> list[Tensor]:
    """Corners of the charts of the whole domain; a part of it is a ConfigError."""
    if bool((corners[0] != -1.0).any() | (corners[1] != 1.0).any()):
        raise ConfigError("expected the whole domain [-1, 1]^p of latents that hold a direction, received a part of it")
    around = math.pi * direction.radius * (1.0 + 1e-12)
    return [torch.cat([c[: direction.first], c.new_tensor([s * around]), c[direction.first + 2 :]]) for s, c in zip((-1.0, 1.0), corners, strict=True)]


def _append_latent(graph: Graph, chart: int, direction: Direction | None, clamped: int | None = None) -> int:
    """Appends the latent of a chart, the entries beside the direction from another step where one is given; itself where there is none."""
    if direction is None:
        return chart
    n, k, r = graph.sizes[chart], direction.first, direction.radius
    eye, at = torch.eye(n, dtype=torch.float64), torch.tensor([0.5 * math.pi, 0.0], dtype=torch.float64)
    waves = graph.apply(graph.linear([chart], [eye[k].expand(2, n) / r], at), sine())  # cosine and sine
    others = torch.zeros(n + 1, n, dtype=torch.float64)
    others[:k, :k], others[k + 2 :, k + 1 :] = eye[:k, :k], eye[k + 1 :, k + 1 :]
    pair = torch.zeros(n + 1, 2, dtype=torch.float64)
    pair[k : k + 2] = r * torch.eye(2, dtype=torch.float64)
    return graph.linear([chart if clamped is None else clamped, waves], [others, pair])


def _check_choice(policy: nn.Module, dynamics: nn.Module, barrier: nn.Module, corners: Sequence[Tensor]) -> None:
    """Refuses a policy that chooses by something else than what is proved, or in another way."""
    check_module(policy)
    loop = vars(policy).get("loop")
    if type(loop) is not tuple or len(loop) != 2 or loop[0] is not dynamics or loop[1] is not barrier:
        raise StructureError(
            "expected a policy that chooses by the dynamics and the barrier that are proved, received one that is "
            f"{'not bound' if loop is None else 'bound to others'}; bind(dynamics, barrier), which an Agent does by itself",
            "CHOOSES_BY_OTHERS",
        )
    parts = [policy._buffers.get(name) for name in ("actions", "margin")]
    if any(t is None for t in parts) or cast(Tensor, parts[0]).ndim != 2 or cast(Tensor, parts[1]).ndim:
        raise StructureError("expected a policy that chooses from a table of actions (K, m) with one margin, buffers both")
    if FORMS.get(type(dynamics)) != "residual" or bool((corners[0] > -1.0).any() | (corners[1] < 1.0).any()):
        raise StructureError(
            "expected dynamics of the form 'residual' (modules.LatentDynamics) in a domain that holds [-1, 1]: a policy that chooses "
            f"asks B of every successor, received {type(dynamics).__name__} and {corners[0].tolist()}, {corners[1].tolist()}"
        )


def _append_steps(graph: Graph, dynamics: nn.Module, policy: nn.Module, direction: Direction | None) -> list[int]:
    """Appends d(z, pi(z)), or what a policy that chooses compares: d(z, .) of its own action, then of those of its table."""
    chooses = FORMS.get(type(policy)) == "choosing"
    latent = _append_latent(graph, 0, direction)
    own, scale = _append_policy(graph, latent, cast(nn.Module, policy.policy) if chooses else policy)
    actions = [own]
    for action in cast(Tensor, policy.actions).detach().double().cpu() if chooses else ():
        if len(action) != graph.sizes[own]:
            raise StructureError(f"expected a table of {graph.sizes[own]} entries per action, received {len(action)}")
        # A step of its own: in the bias of the next one, terms that cancel would seem to round off nothing.
        still = torch.zeros(len(action), graph.input_dim)
        actions.append(graph.linear([0], [still], action if scale is None else action / scale))
    return [_append_dynamics(graph, latent, dynamics, action, scale, direction) for action in actions]


def _append_policy(graph: Graph, latent: int, policy: nn.Module) -> tuple[int, Tensor | None]:
    """Appends the policy; the result times the scale (where there is one) is the action in physical units."""
    net, scale = _taken_apart(policy, "policy", "bounded")
    if scale is None:
        return graph.interface(graph.layers(latent, net)), None
    action = graph.interface(graph.apply(graph.layers(latent, net), clamp()))
    return action, _checked_scale(scale, graph.sizes[action])


def _append_dynamics(
    graph: Graph, latent: int, dynamics: nn.Module, action: int, scale: Tensor | None, direction: Direction | None
) -> int:
    """Appends the dynamics, whose action is a step times the policy's scale."""
    layers, own = _taken_apart(dynamics, "dynamics", "residual")
    p, m = graph.sizes[latent], graph.sizes[action]
    own = None if own is None else _checked_scale(own, m)
    if scale is not None and own is not None and not torch.equal(scale, own):
        raise StructureError(f"expected one action scale in dynamics and policy, received {scale.tolist()} and {own.tolist()}")
    if (scale is None) != (own is None):  # each module has its own unit: what is deployed multiplies or divides
        factor = scale if own is None else 1.0 / cast(Tensor, own)
        action = graph.interface(graph.linear([action], [torch.diag(cast(Tensor, factor))], roundings=2))
    if not layers or not isinstance(layers[0], nn.Linear):
        raise StructureError(f"expected the dynamics to start with a linear layer, received {[type(x).__name__ for x in layers[:1]]}")
    first, last = layers[0], layers[-1]
    weights = [first.weight[:, :p], first.weight[:, p:]]
    # Of one scale in both modules nothing is left but the rounding of a product and a quotient.
    hidden = graph.linear([latent, action], weights, first.bias, roundings=0 if own is None else 3)
    if own is None:
        return graph.interface(graph.layers(hidden, layers[1:]))
    if len(layers) == 1 or not isinstance(last, nn.Linear):
        raise StructureError("expected the dynamics' network to start and end with different linear layers")
    hidden = graph.layers(hidden, layers[1:-1])
    p = graph.input_dim  # a network that turns a direction moves the chart
    eye, rest = torch.eye(p), p - last.out_features
    if getattr(dynamics, "remembers", False) and rest == m:  # the action of this step, divided by its scale
        pads = [nn.functional.pad(t, (0, 0, 0, rest)) for t in (eye[:-rest], last.weight)]
        bias = nn.functional.pad(last.bias, (0, rest)) if last.bias is not None else None
        moved = graph.linear([0, hidden, action], [*pads, eye[:, -rest:]], bias, roundings=3)
    else:
        moved = graph.linear([0, hidden], [eye, last.weight], last.bias, roundings=1)
    if direction is None:
        return graph.interface(graph.apply(moved, clamp()))
    moved = graph.interface(moved)
    return graph.interface(_append_latent(graph, moved, direction, graph.apply(moved, clamp())))


def _taken_apart(module: nn.Module, name: str, form: str) -> tuple[list[nn.Module], Tensor | None]:
    """The layers of a part of the loop, and its action scale if it is of a form that has one."""
    if type(module) is nn.Sequential:
        return flat_layers(module), None
    related = any(k in FORMS or k is nn.Sequential for k in type(module).__mro__)
    if related:
        check_module(module)
    net = module._modules.get("net")
    if not related or FORMS.get(type(module)) != form or type(net) is not nn.Sequential:
        raise StructureError(
            f"expected the {name} to be an nn.Sequential, or a module of the form '{form}' with an nn.Sequential 'net' "
            f"(modules.LatentDynamics, modules.Policy, or registered by lipschitz.layers.known_form), received "
            f"{type(module).__name__}"
        )
    return flat_layers(net), cast(Tensor, getattr(module, "action_scale", None))


def _checked_scale(scale: Tensor, actions: int) -> Tensor:
    valid = isinstance(scale, Tensor) and scale.is_floating_point() and scale.shape in ((actions,), (1,))
    if not valid or not bool((scale >= _SCALES[0]).all() & (scale <= _SCALES[1]).all()):
        raise StructureError(
            f"expected {actions} positive finite action scales within {_SCALES}, where float32 loses nothing, received "
            f"{scale}; pass the largest action, in another unit if need be",
            "SCALE_INVALID",
        )
    return scale.detach().double().cpu().expand(actions)


def evaluation_rounding(system: ClosedLoop, *, unit: float = 2.0**-53, per_axis: int = 4) -> float:
    r"""How far an evaluation of :math:`B(d(z, \pi(z)))` with a unit roundoff can be from the exact one, barrier units.

    With the unit of float64 it has to lie far below the slack by which bounds decide. With that of float32 it is a
    worst case that real evaluations come nowhere near. The domain is bounded in ``per_axis`` pieces per dimension, in
    fewer where there would be more than 65,536.
    """
    while per_axis > 1 and per_axis**system.latent_dim > 65_536:
        per_axis -= 1
    corners = zip(system.low, system.high, strict=True)
    edges = [torch.linspace(float(a), float(b), per_axis + 1, dtype=torch.float64) for a, b in corners]
    ends = ([e[:-1] for e in edges], [e[1:] for e in edges])
    parts = zip(*(torch.cartesian_prod(*e).reshape(-1, system.latent_dim).split(512) for e in ends), strict=True)
    factor = _SHARPNESS if system.chooses else 1.0
    return factor * float(torch.stack([rounding_bound(system.looped, a, b, unit)[-1].max() for a, b in parts]).max())  # NaN stays NaN


def closed_loop_lipschitz(dynamics: nn.Module, policy: nn.Module) -> float:
    r"""Certified Lipschitz constant of :math:`z \mapsto d(z, \pi(z))`, the one that paper Theorem 1 leaves out.

    .. math:: L_{cl} \le 1 + L_{net_d} \sqrt{1 + L_{net_\pi}^2}

    or :math:`\sqrt{(\cdot)^2 + L_{net_\pi}^2}` of that where the dynamics remember the action.

    Dynamics and policy are of the forms "residual" and "bounded" with one action scale, else ``StructureError``; a policy that
    chooses has none.

    Example:
        >>> from torchrl_sspl.modules import LatentDynamics, Policy
        >>> closed_loop_lipschitz(LatentDynamics(2, 1), Policy(2, 1)) > 1
        True
    """
    if FORMS.get(type(policy)) == "choosing":
        raise StructureError("expected a continuous policy, received one that chooses: its closed loop has no Lipschitz constant")
    moved, scale = _taken_apart(dynamics, "dynamics", "residual")
    control, own = _taken_apart(policy, "policy", "bounded")
    if scale is None or own is None or not torch.equal(scale, own):
        raise StructureError("expected modules.LatentDynamics and modules.Policy of one action scale, received others")
    loop, gain = (float(lipschitz_upper(nn.Sequential(*layers))) for layers in (moved, control))
    seen = 1.0 + loop * math.sqrt(1.0 + gain * gain)
    return (math.hypot(seen, gain) if getattr(dynamics, "remembers", False) else seen) * (1.0 + 1e-12)
