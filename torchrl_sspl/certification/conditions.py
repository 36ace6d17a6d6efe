r"""The conditions of a barrier certificate, decided for frozen networks on the whole latent domain.

All are about the closed loop :math:`z^+ = d(z, \pi(z))` on a box that the encoder cannot leave. Each is proved, refuted
with a counterexample, or undecided with what remains. Of a policy that chooses, what it would do is bounded for each action
beside what it accepts (Theorem H in ``docs/theory.md``).
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import Any, cast

import torch
from torch import Tensor, nn

from torchrl_sspl.certification.branch_and_bound import SLACK, Budget, Outcome, Problem, maximise
from torchrl_sspl.certification.floating import largest_rounding, rounding_bound
from torchrl_sspl.certification.graph import Apply, Graph
from torchrl_sspl.direction import Direction, direction_of, lifted, within
from torchrl_sspl.errors import ConfigError, StructureError
from torchrl_sspl.lipschitz import lipschitz_upper
from torchrl_sspl.lipschitz.layers import FORMS, Activation, clamp, sine
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
        return _above(self.lipschitz_bound * error) if error else 0.0

    def rounding(self, unit: float, *, boxes: int = 8192) -> tuple[float, float]:
        """What an evaluation with a unit roundoff is off at most, anywhere: of B, and of d(z, pi(z)) (Euclidean norm)."""
        step = largest_rounding(self.step, self.low, self.high, unit, boxes=boxes, vectors=len(self.inner))
        return largest_rounding(self.barrier, self.low, self.high, unit, boxes=boxes), step


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
    looped.side_by_side([looped.network(k, barrier) for k in inner])
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


def decide_invariance(
    system: ClosedLoop,
    *,
    condition: str = "R3",
    level: float = 0.0,
    margin: float = 0.0,
    decay: float = 0.0,
    decrement: float = 0.0,
    floor: float = 0.0,
    budget: Budget | None = None,
    confirm: Callable[[Tensor], bool] | None = None,
    progress: bool = False,
) -> Outcome:
    r"""Decides [V]: the set :math:`\{B \le s\}` is kept, with a margin.

    .. math:: B(z) \le s \;\Rightarrow\; \begin{cases}
        B(d(z, \pi(z))) + m \le s & \text{R3} \\
        B(d(z, \pi(z))) + m \le (1 - \alpha) B(z) & \text{R1} \\
        B(d(z, \pi(z))) + m \le \max(B(z) - \gamma, -c) & \text{R2} \end{cases}

    Args:
        system: the closed loop.
        condition: "R3", "R1" or "R2"; of a policy that chooses R3 alone.
        level: s, barrier units.
        margin: m, barrier units.
        decay: :math:`\alpha \in [0, 1]` of R1.
        decrement: :math:`\gamma \ge 0` of R2, barrier units.
        floor: c of R2, barrier units.
        budget: when to give up.
        confirm: whether a point ``(p,)`` is a counterexample for the deployed networks too.
        progress: show a progress bar.

    Returns:
        The outcome; ``upper`` bounds left side minus right side. Of a policy that accepts its own actions at more than
        :math:`s - m` it is undecided at best.

    Raises:
        ConfigError: if the condition is unknown or not one for this policy, or a parameter is out of range.

    Source: paper eq. (5); deviation: on the set instead of everywhere, on the whole latent domain instead of samples.

    Example:
        >>> plant = nn.Sequential(nn.Linear(2, 1, bias=False))  # z+ = z / 2, and B(z) = z
        >>> nn.utils.vector_to_parameters(torch.tensor([0.5, 0.0]), plant.parameters())
        >>> loop = closed_loop(nn.Identity(), plant, nn.Sequential(nn.Linear(1, 1)), latent_dim=1, lipschitz_bound=1.0)
        >>> [decide_invariance(loop, level=0.5, margin=m).status for m in (0.2, 0.3)]
        ['proved', 'refuted']
    """
    terms: dict[str, dict[str, Any]] = {
        "R3": dict(constant=(margin - level,)),
        "R1": dict(weight=(1.0 - decay,), constant=(margin,)),
        "R2": dict(weight=(1.0, 0.0), constant=(margin + decrement, margin + floor)),
    }
    if condition not in terms:
        raise ConfigError(f"expected condition to be one of {', '.join(terms)}, received {condition!r}")
    if not 0.0 <= decay <= 1.0 or decrement < 0.0 or not math.isfinite(level + margin + floor):
        raise ConfigError(
            f"expected 0 <= decay <= 1, decrement >= 0 and finite level, margin and floor, received decay={decay}, "
            f"decrement={decrement}, level={level}, margin={margin}, floor={floor}"
        )
    how: dict[str, Any] = {"threshold": 0.0, "budget": budget, "confirm": confirm, "progress": progress}
    if condition == "R3":
        return largest_next(system, level=level, constant=margin - level, **how)
    return maximise(system.problem(level=level, **terms[condition]), **how)


def largest_next(
    system: ClosedLoop, *, level: float, constant: float, error: float = 0.0, lost: float = 0.0, threshold: float | None = None, **how: Any
) -> Outcome:
    r"""Largest :math:`B(d(z, \pi(z)) + e) + c` where B is at most a level, or a decision about it (:func:`.branch_and_bound.maximise`).

    A policy that chooses accepts its own action wherever B is computed to be at most :math:`-m` after it; that counts, too, as
    :math:`-m + c + 2 \lambda + L_B \delta`.

    Args:
        system: the closed loop.
        level: s, barrier units.
        constant: c.
        error: :math:`\delta \ge \lVert e \rVert`, latent units.
        lost: :math:`\lambda`, what an evaluation of :math:`B(d(z, \pi(z)))` may be off, barrier units.
        threshold: value to prove.
        **how: of ``maximise``.

    Source: none.

    Example:
        >>> plant = nn.Sequential(nn.Linear(2, 1, bias=False))  # z+ = z / 2, and B(z) = z
        >>> nn.utils.vector_to_parameters(torch.tensor([0.5, 0.0]), plant.parameters())
        >>> loop = closed_loop(nn.Identity(), plant, nn.Sequential(nn.Linear(1, 1)), latent_dim=1, lipschitz_bound=1.0)
        >>> 0.25 <= largest_next(loop, level=0.5, constant=0.0).upper < 0.252
        True
    """
    own = math.fsum((system.accepted, constant, 2.0 * lost, system.lost_by(error)))
    found = maximise(system.problem(level=level, constant=(constant,), error=error, lost=lost), threshold=threshold, **how)
    kept = found.status != "proved" or threshold is None or own <= threshold
    return replace(found, status=found.status if kept else "undecided", upper=max(found.upper, own))


@dataclass(frozen=True)
class LargestError:
    """How large a latent error the invariance tolerates; errors in latent units."""

    delta: float  # proved: for errors up to this the set is kept; negative: it is not kept even without any
    refuted_above: float  # above this there is a counterexample, of the Lipschitz argument, not of the system
    outcome: Outcome  # the search behind it


def largest_error(
    system: ClosedLoop, *, level: float = 0.0, tolerance: float = 1e-3, budget: Budget | None = None, progress: bool = False
) -> LargestError:
    r"""Largest error of the latent dynamics for which :math:`\{B \le s\}` is kept, from both sides.

    .. math:: \delta^* = - \frac{1}{L_B} \max_{B(z) \le s} \left( B(d(z, \pi(z))) - s \right)

    Args:
        system: the closed loop, with a finite Lipschitz bound.
        level: s, barrier units.
        tolerance: distance of the two sides of the maximum at which the search ends, barrier units.
        budget: when to give up.
        progress: show a progress bar.

    Source: none (the paper estimates the error and asks for the margin; here the margin is computed).

    Example:
        >>> plant = nn.Sequential(nn.Linear(2, 1, bias=False))  # z+ = z / 2, and B(z) = z
        >>> nn.utils.vector_to_parameters(torch.tensor([0.5, 0.0]), plant.parameters())
        >>> loop = closed_loop(nn.Identity(), plant, nn.Sequential(nn.Linear(1, 1)), latent_dim=1, lipschitz_bound=1.0)
        >>> abs(largest_error(loop, level=0.5).delta - 0.25) < 2e-3
        True
    """
    if not math.isfinite(system.lipschitz_bound):
        raise ConfigError("expected a finite Lipschitz bound of the barrier, received infinity; prove one first")
    found = largest_next(system, level=level, constant=-level, tolerance=tolerance, budget=budget, progress=progress)
    # What decides, decides by more than the slack.
    proved = _below(-(found.upper + SLACK) / system.lipschitz_bound)
    most = max(found.lower, system.accepted - level)  # errors count by the Lipschitz constant where an action is accepted, too
    return LargestError(proved, (SLACK - most) / system.lipschitz_bound, found)


def _below(value: float) -> float:
    """Less than what the last operations, exactly carried out, would give."""
    return value - 4.0 * math.ulp(value)


def _above(value: float) -> float:
    """More than what the last operations, exactly carried out, would give."""
    return value + 4.0 * math.ulp(value)


def tolerates(
    system: ClosedLoop,
    error: float,
    *,
    level: float = 0.0,
    barrier_rounding: float = 0.0,
    step_rounding: float = 0.0,
    every_way: bool = True,
    budget: Budget | None = None,
) -> Outcome:
    r"""Decides whether :math:`\{B \le s\}` is kept whatever error of a size is added, by its own bounds in every direction.

    .. math:: B(z) \le s + \epsilon_B, \; \lVert e \rVert \le \delta \;\Rightarrow\;
        B(d(z, \pi(z)) + e) + L_B \epsilon_d + \epsilon_B \le s

    :func:`largest_error` asks the same through the Lipschitz constant, as if the barrier rose by it everywhere and in every
    direction at once. So does this of a policy that chooses, which does not know the error when it does; what is rounded off
    counts more often then (Theorem H in ``docs/theory.md``).

    Args:
        system: the closed loop, with a finite Lipschitz bound.
        error: :math:`\delta`, latent units.
        level: s, barrier units.
        barrier_rounding, step_rounding: :math:`\epsilon_B` and :math:`\epsilon_d` of the computed networks.
        every_way: whether errors count by bounds in every direction; False: by the Lipschitz constant.
        budget: when to give up.

    Source: none.

    Example:
        >>> plant = nn.Sequential(nn.Linear(2, 1, bias=False))  # z+ = z / 2, and B(z) = z
        >>> nn.utils.vector_to_parameters(torch.tensor([0.5, 0.0]), plant.parameters())
        >>> loop = closed_loop(nn.Identity(), plant, nn.Sequential(nn.Linear(1, 1)), latent_dim=1, lipschitz_bound=9.0)
        >>> [tolerates(loop, error, level=0.5).status for error in (0.24, 0.26)]
        ['proved', 'refuted']
    """
    lost = system.lipschitz_bound * step_rounding + barrier_rounding if step_rounding + barrier_rounding > 0 else 0.0
    inside = level + barrier_rounding + (SLACK if barrier_rounding else 0.0)
    constant = -level if every_way else system.lost_by(error) - level
    return largest_next(
        system, level=inside, constant=constant, error=error if every_way else 0.0, lost=lost, threshold=0.0, budget=budget
    )


@dataclass(frozen=True)
class ComputedError:
    """How large a latent error the numbers that are computed tolerate."""

    delta: float  # proved for the computed barrier and step, latent units; at most zero: not kept even without errors
    barrier_rounding: float  # what the computed barrier is off at most, anywhere, barrier units
    step_rounding: float  # the same of the computed d(z, pi(z)), Euclidean norm, latent units


def computed_error(
    system: ClosedLoop,
    known: LargestError,
    *,
    level: float = 0.0,
    unit: float = 2.0**-24,
    tolerance: float = 1e-3,
    budget: Budget | None = None,
    boxes: int = 8192,
) -> ComputedError:
    r"""Largest error for which :math:`\{\hat B \le s\}` is kept by the networks as they are computed.

    .. math:: \delta = - \frac{1}{L_B} \left( \max_{B(z) \le s + \epsilon_B} (B(d(z, \pi(z))) - s) + \epsilon_B \right)
        - \epsilon_d

    with :math:`\epsilon_B \ge |\hat B - B|` and :math:`\epsilon_d \ge \|\hat d(z, \hat\pi(z)) - d(z, \pi(z))\|` on the
    whole domain, bounded on so many boxes for this unit roundoff; ``known`` is the error in real arithmetic.

    A policy that chooses does so by what is computed. With :math:`\lambda = \epsilon_B + L_B \epsilon_d` it is the largest
    :math:`\delta` for which

    .. math:: L_B \delta + 2 \lambda - m \le s, \qquad B(z) \le s + \epsilon_B, \; B(d(z, \pi(z))) > -m - \lambda \;\Rightarrow\;
        \min_k B(d(z, a_k)) + 3 \lambda + L_B \delta \le s

    as :math:`\lambda` is lost once where an action is accepted or not, twice where two of the table are compared, and once more
    after the step (Theorem H in ``docs/theory.md``).
    """
    lipschitz = system.lipschitz_bound
    of_barrier, of_step = system.rounding(unit, boxes=boxes)
    if not math.isfinite(of_barrier + of_step):
        return ComputedError(-math.inf, of_barrier, of_step)
    lost = of_step + of_barrier / lipschitz
    delta = known.delta - lost  # what it could be at most
    if delta > 0.0:
        how: dict[str, Any] = {"tolerance": tolerance, "budget": budget}
        if system.chooses:  # what is lost decides which action is taken
            how["lost"], lost = _above(lost * lipschitz), 0.0
        found = largest_next(system, level=level + of_barrier + SLACK, constant=-level, **how)
        delta = -(found.upper + SLACK) / lipschitz - lost
    return ComputedError(_below(_below(delta)), of_barrier, of_step)


def decide_domain(system: ClosedLoop, *, budget: Budget | None = None) -> Outcome:
    r"""Decides whether :math:`d(z, \pi(z))` stays in the latent domain; a clamp to the domain proves it at once.

    Args:
        system: the closed loop.
        budget: when to give up.

    Source: none (the paper's latent space is unbounded).

    Example:
        >>> plant = nn.Sequential(nn.Linear(2, 1, bias=False))  # z+ = 3 z / 2
        >>> nn.utils.vector_to_parameters(torch.tensor([1.5, 0.0]), plant.parameters())
        >>> loop = closed_loop(nn.Identity(), plant, nn.Sequential(nn.Linear(1, 1)), latent_dim=1, lipschitz_bound=1.0)
        >>> decide_domain(loop).status
        'refuted'
    """
    last = system.step.steps[-1]
    if system.chooses or system.direction is not None or (isinstance(last, Apply) and _within(last.activation, system)):  # of those that choose it was demanded
        return Outcome("proved", 0.0, -math.inf, None, 0, 0.0, 0.0, 0)
    p = system.latent_dim
    eye, low, high = torch.eye(p, dtype=torch.float64), system.low, system.high
    rows, constant = torch.cat([eye, -eye]), torch.cat([-high, low])
    problem = Problem(low, high, system.step, rows, system.barrier, torch.zeros_like(constant), constant, combine="max")
    return maximise(problem, threshold=0.0, budget=budget)


def _within(activation: Activation, system: ClosedLoop) -> bool:
    ends = torch.tensor([-math.inf, math.inf], dtype=torch.float64)
    below, above = (float(v) for v in activation.value(ends))
    return bool((system.low <= below).all()) and bool((system.high >= above).all())


@dataclass(frozen=True)
class Vacuity:
    r"""Whether a statement about :math:`\{B \le s\}` says anything; points are ``(p,)``."""

    status: str  # "neither" (both points exist), "empty" (proved), "everything" (proved) or "undecided"
    inside: Tensor | None  # a point with B below s
    outside: Tensor | None  # a point with B above s


def decide_vacuity(system: ClosedLoop, *, level: float = 0.0, budget: Budget | None = None) -> Vacuity:
    r"""Decides whether :math:`\{B \le s\}` is empty, everything, or neither.

    Args:
        system: the closed loop.
        level: s, barrier units.
        budget: when to give up.

    Source: none; a barrier that is negative everywhere meets the paper's third condition without saying anything.

    Example:
        >>> plant, policy = nn.Sequential(nn.Linear(2, 1)), nn.Sequential(nn.Linear(1, 1))
        >>> loop = closed_loop(nn.Identity(), plant, policy, latent_dim=1, lipschitz_bound=1.0)
        >>> decide_vacuity(loop, level=-2.0).status
        'empty'
    """
    zero = torch.zeros(1, dtype=torch.float64)

    def side(sign: float) -> tuple[bool, Tensor | None]:
        """Whether sign (B - s) can be positive, with a point; None and True: not decided."""
        rows = torch.full((1, 1), sign, dtype=torch.float64)
        problem = Problem(system.low, system.high, system.barrier, rows, system.barrier, zero, zero - sign * level)
        found = maximise(problem, threshold=0.0, budget=budget)
        return found.status != "proved", found.witness if found.status == "refuted" else None

    may_lie_inside, inside = side(-1.0)
    may_lie_outside, outside = side(1.0)
    if not may_lie_inside:
        return Vacuity("empty", None, outside)
    if not may_lie_outside:
        return Vacuity("everything", inside, None)
    return Vacuity("neither" if inside is not None and outside is not None else "undecided", inside, outside)


def search_level(
    system: ClosedLoop, *, levels: Sequence[float], margin: float = 0.0, budget: Budget | None = None
) -> tuple[float, Outcome] | None:
    r"""The first of several levels for which :math:`\{B \le s\}` is kept (R3), with its outcome.

    Args:
        system: the closed loop.
        levels: s in the order in which they are tried, all at most zero (else ``ConfigError``); usually descending.
        margin: m, barrier units.
        budget: when to give up on one level.

    Returns:
        Level and outcome, or None if none is proved; an empty set is none.

    Source: none.

    Example:
        >>> plant = nn.Sequential(nn.Linear(2, 1, bias=False))  # z+ = 2 z, and B(z) = z
        >>> nn.utils.vector_to_parameters(torch.tensor([2.0, 0.0]), plant.parameters())
        >>> loop = closed_loop(nn.Identity(), plant, nn.Sequential(nn.Linear(1, 1)), latent_dim=1, lipschitz_bound=1.0)
        >>> search_level(loop, levels=[0.0, -0.1], margin=0.05)[0]
        -0.1
    """
    if any(level > 0 for level in levels):
        raise ConfigError(f"expected levels of at most zero, received {list(levels)}; above zero a set may touch U")
    for level in levels:
        outcome = decide_invariance(system, level=level, margin=margin, budget=budget)
        if outcome.status == "proved":
            # Nothing is easier to keep than nothing.
            return None if decide_vacuity(system, level=level, budget=budget).status == "empty" else (level, outcome)
    return None


def evaluation_rounding(system: ClosedLoop, *, unit: float = 2.0**-53, per_axis: int = 4) -> float:
    r"""How far an evaluation of :math:`B(d(z, \pi(z)))` with a unit roundoff can be from the exact one, barrier units.

    With the unit of float64 it has to lie far below the slack by which bounds decide. With that of float32 it is a
    worst case that real evaluations come nowhere near. The domain is bounded in ``per_axis`` pieces per dimension.
    """
    corners = zip(system.low, system.high, strict=True)
    edges = [torch.linspace(float(a), float(b), per_axis + 1, dtype=torch.float64) for a, b in corners]
    ends = ([e[:-1] for e in edges], [e[1:] for e in edges])
    parts = zip(*(torch.cartesian_prod(*e).reshape(-1, system.latent_dim).split(512) for e in ends), strict=True)
    factor = _SHARPNESS if system.chooses else 1.0
    return factor * max(float(rounding_bound(system.looped, a, b, unit)[-1].max()) for a, b in parts)


def closed_loop_lipschitz(dynamics: nn.Module, policy: nn.Module) -> float:
    r"""Certified Lipschitz constant of :math:`z \mapsto d(z, \pi(z))`, the one that paper Theorem 1 leaves out.

    .. math:: L_{cl} \le 1 + L_{net_d} \sqrt{1 + L_{net_\pi}^2}

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
    return (1.0 + loop * math.sqrt(1.0 + gain * gain)) * (1.0 + 1e-12)


def find_counterexamples(
    system: ClosedLoop,
    n: int,
    *,
    level: float = 0.0,
    margin: float = 0.0,
    samples: int = 50_000,
    generator: torch.Generator | None = None,
) -> Tensor:
    r"""Points of the domain at which the invariance fails, for training on them.

    .. math:: B(z) \le s, \qquad B(d(z, \pi(z))) + m > s

    Args:
        system: the closed loop.
        n: largest number of points.
        level: s, barrier units.
        margin: m, barrier units.
        samples: uniform samples, of which the worst are improved by gradient steps.
        generator: source of randomness.

    Returns:
        ``(k, p)`` float32, the worst first, ``k <= n``; empty if none was found.

    Source: none (counterexample-guided training).

    Example:
        >>> plant = nn.Sequential(nn.Linear(2, 1, bias=False))  # z+ = 3 z / 2, and B(z) = z
        >>> nn.utils.vector_to_parameters(torch.tensor([1.5, 0.0]), plant.parameters())
        >>> loop = closed_loop(nn.Identity(), plant, nn.Sequential(nn.Linear(1, 1)), latent_dim=1, lipschitz_bound=1.0)
        >>> bool((find_counterexamples(loop, 10, level=0.5) > 0.33).all())
        True
    """
    problem = system.problem(level=level, constant=(margin - level,))
    span = system.high - system.low
    points = system.low + span * torch.rand(samples, len(span), generator=generator, dtype=torch.float64)
    with torch.no_grad():
        points = points[problem.feasible(system.barrier(points)[:, 0])]
        if not len(points):
            return system.latent(torch.zeros(0, system.latent_dim))
        value = problem.evaluate(points)[0]
        worst = points[value.topk(min(n, len(points))).indices]
        steps = 0.02 * span * torch.randn(4, *worst.shape, generator=generator, dtype=torch.float64)
        near = torch.minimum(torch.maximum(worst + steps, system.low), system.high).flatten(0, 1)
        points = torch.cat([worst, near])
        value, barrier = problem.evaluate(points)
        bad = points[problem.feasible(barrier) & (value > 0)]
        order = problem.evaluate(bad)[0].argsort(descending=True) if len(bad) else torch.zeros(0, dtype=torch.int64)
    return system.latent(bad[order][:n]).float()
