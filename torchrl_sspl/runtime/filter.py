r"""The safety filter: any policy's actions, changed where the agent's set would not surely be kept."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import Any

import torch
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModuleBase
from torch import Tensor

from torchrl_sspl.certification.floating import UNITS, largest_rounding
from torchrl_sspl.certification.loop import closed_loop
from torchrl_sspl.devices import compiled
from torchrl_sspl.direction import direction_of
from torchrl_sspl.errors import ConfigError, NonFiniteError, ShapeError
from torchrl_sspl.modules.agent import Agent
from torchrl_sspl.modules.observer import CUT, LatentObserver

MODES = ("nearest", "blend")
LEVEL = -0.12
UNPROVED_MARGIN = 0.02  # for an agent without a proof
_GRID, _MOST = 81, 729  # actions per dimension that are tried, and in all
_LINE, _ROUNDS = 16, 2  # actions that are tried on a way, and how often one of its parts is divided again


@dataclass
class Protected:
    """What the filter makes of n actions."""

    action: Tensor  # (n, m), physical units
    intervened: Tensor  # (n,) bool, whether it is another one than was wanted
    deviation: Tensor  # (n,) distance of the two, in half ranges of the action
    margin: Tensor  # (n,) barrier units by which the successor is surely inside; below zero where that is not so
    predicted: Tensor  # (n, p) the successor, to the last bit the one that was checked: what a memory has to be given


class Shield:
    r"""Lets actions through that surely keep the set, and takes near ones that do in place of the others.

    .. math::
        u' = \begin{cases} u & B(d(\hat z, u)) + \eta \le s' \text{ or } u = \pi(\hat z) \\ \arg\min_{v \in V,\; B(d(\hat z, v)) + \eta \le s'}
        \lVert (v - u) / u_{\max} \rVert & \text{else} \\ \pi(\hat z) & \text{where no } v \in V \text{ does, or } B(\hat z) > 0
        \end{cases}
        \qquad s' = \max(s, \min(B(d(\hat z, \pi(\hat z))) + \eta, 0))

    with :math:`\eta = L_B \delta + 2 \epsilon_B`, the error that the set is proved to tolerate and what the barrier's evaluation
    may round off, and V a grid over all actions together with the way from u to :math:`\pi(\hat z)`; the way from u to the nearest of
    them is then searched to 1/256 of it. That :math:`\pi(\hat z)` keeps the set is what [V] says (Theorem G in ``docs/theory.md``), so
    nothing better than it is asked for: the agent's own actions are never changed. Source: none (least-restrictive filters of
    model-based control, on latents).

    Args:
        agent: frozen agent with a tolerated error, so that [V] is proved.
        mode: ``"nearest"``, or ``"blend"``: V is the way to :math:`\pi(\hat z)` alone, which changes smoothly with u.
        level: s <= 0: actions have to keep :math:`\{B \le s\}` where the agent's own do, so that the filter acts before the border.
            A policy that is held at the border of :math:`\{B \le 0\}` meets corrections that are cut again and again, and the memory goes astray.
        margin: :math:`\eta` in place of the proved one, for an agent without a proof: then nothing is guaranteed.
        compile: as for :class:`~torchrl_sspl.modules.Controller`.

    Raises:
        ConfigError: for an agent without a proof where no margin is given, or options that are not valid.

    Example:
        >>> from torchrl_sspl.modules.agent import load
        >>> shield = Shield(load("pendulum"))
        >>> shield(torch.zeros(4, 3), torch.full((4, 1), 10.0)).action.shape
        torch.Size([4, 1])
    """

    def __init__(
        self, agent: Agent, *, mode: str = "nearest", level: float = LEVEL, margin: float | None = None, compile: bool = False
    ) -> None:
        if mode not in MODES or not level <= 0.0 or (margin is not None and not margin >= 0.0):
            raise ConfigError(
                f"expected mode in {MODES}, level <= 0 and margin >= 0 or None, received {mode!r}, {level} and {margin}"
            )
        if margin is None and not agent.tolerated_error > 0.0:
            raise ConfigError(
                "expected an agent whose set is proved to be kept (a tolerated error above 0), received one without; see what "
                f"`sspl verify` says of it, or give margin={UNPROVED_MARGIN:g} and the like: then the filter guarantees nothing"
            )
        self.agent, self.mode, self.level = agent, mode, float(level)
        self.margin = _proved_margin(agent) if margin is None else float(margin)
        self._default = margin is None
        scale = agent.policy.action_scale.flatten()  # type: ignore[operator, union-attr]
        self.scale, m = scale, len(scale)
        per_dimension = max(3, min(_GRID, int(_MOST ** (1 / m) + 1e-6)))
        axes = [torch.linspace(-float(s), float(s), per_dimension) for s in scale]
        self.grid = torch.cartesian_prod(*axes).reshape(-1, m) if per_dimension**m <= 4 * _MOST else torch.zeros(0, m)
        self._compiled = compile
        self._first = compiled(self._judged) if compile else self._judged
        self._near = compiled(self._nearest) if compile else self._nearest

    @cached_property
    def proved(self) -> bool:
        r"""Whether the agent's set is proved to be kept, and the margin is at least :math:`\eta`; looked at once."""
        return self.agent.tolerated_error > 0.0 and (self._default or self.margin >= _proved_margin(self.agent))

    @torch.no_grad()
    def __call__(self, latent: Tensor, wanted: Tensor, own: Tensor | None = None) -> Protected:
        """Actions ``(n, m)`` in place of wanted ones ``(n, m)``, in physical units, at latents ``(n, p)``.

        What lies beyond the range is clipped. ``own``: the agent's own actions at these latents, where they are known already.
        A ShapeError for another size, a NonFiniteError for NaN in actions or latents.
        """
        m = len(self.scale)
        for given in (wanted,) if own is None else (wanted, own):
            if given.shape != (len(latent), m):
                raise ShapeError(f"expected actions of shape ({len(latent)}, {m}), received {tuple(given.shape)}")
        if not bool(wanted.isfinite().all()):
            raise NonFiniteError("expected finite actions, received NaN or infinity from the policy that is to be protected")
        if not bool(latent.isfinite().all()):
            raise NonFiniteError("latent: expected finite values, received NaN or infinity; an encoder gives those of finite weights alone")
        wanted = wanted.to(latent.dtype)
        asked, own, taken, then_own, then, most, lost = self._first(latent, wanted, own)
        if bool(lost.any()):
            # A graph is for one number of rows.
            rows = torch.arange(len(lost), device=lost.device) if self._compiled else lost.nonzero()[:, 0]
            near, then_near = self._near(latent[rows], asked[rows], own[rows], then_own[rows], most[rows])
            taken[rows], then[rows] = (torch.where(lost[rows, None], a, b[rows]) for a, b in ((near, taken), (then_near, then)))
        change = (taken - wanted) / self.scale.to(wanted)
        return Protected(taken, (change != 0.0).any(1), change.norm(dim=1), self.level - self.margin - then[:, 0], then[:, 1:])

    def _judged(self, latent: Tensor, wanted: Tensor, own: Tensor | None) -> tuple[Tensor, ...]:
        """Actions asked for, the agent's own, and those of the two that are taken; what follows its own and the taken ones,
        the most that is allowed; and for which rows another action is to be found."""
        scale = self.scale.to(wanted)
        asked = wanted.clamp(-scale, scale)
        own, inside = self.agent.policy(latent) if own is None else own, self.agent.barrier(latent)[:, 0] <= 0.0
        then_own, then = self._then(latent.repeat(2, 1), torch.cat([own, asked])).chunk(2)
        most = then_own[:, 0].clamp(self.level - self.margin, -self.margin)
        keeps = inside & ((then[:, 0] <= most) | (asked == own).all(1))  # [V] speaks of the agent's own
        taken, then = torch.where(keeps[:, None], asked, own), torch.where(keeps[:, None], then, then_own)
        return asked, own, taken, then_own, then, most, inside & ~keeps

    def _then(self, latent: Tensor, action: Tensor) -> Tensor:
        """``(n, 1 + p)`` barrier values of successors, and these: they go together, as in another batch they are others in the last bits."""
        after = self.agent.dynamics(latent, action)
        return torch.cat([self.agent.barrier(after), after], 1)

    def _nearest(self, latent: Tensor, asked: Tensor, own: Tensor, then_own: Tensor, most: Tensor) -> tuple[Tensor, Tensor]:
        """The nearest actions tried that keep the set, and what follows them; the agent's own ones where none does."""
        share = torch.linspace(0.0, 1.0, _LINE + 1, device=asked.device)[1:, None]
        tried = torch.lerp(asked[:, None], own[:, None], share)
        if self.mode == "nearest" and len(self.grid):
            tried = torch.cat([tried, self.grid.to(asked).expand(len(asked), -1, -1)], 1)
        each, after = torch.arange(len(asked), device=asked.device), self._then_each(latent, tried)
        keeps = after[..., 0] <= most[:, None]
        distance = ((tried - asked[:, None]) / self.scale.to(asked)).norm(dim=-1).masked_fill(~keeps, float("inf"))
        best, found = distance.argmin(1), keeps.any(1)[:, None]
        kept, then, lost = torch.where(found, tried[each, best], own), torch.where(found, after[each, best], then_own), asked
        for _ in range(_ROUNDS):
            tried = torch.lerp(lost[:, None], kept[:, None], share)
            after = self._then_each(latent, tried)
            after[:, -1] = then  # known
            keeps = after[..., 0] <= most[:, None]
            keeps[:, -1] = True
            first = keeps.int().argmax(1)
            lost = torch.where((first > 0)[:, None], tried[each, first - 1], lost)
            kept, then = tried[each, first], after[each, first]
        return kept, then

    def _then_each(self, latent: Tensor, actions: Tensor) -> Tensor:
        """``(n, k, 1 + p)`` what follows actions ``(n, k, m)``."""
        n, k, m = actions.shape
        return self._then(latent.repeat_interleave(k, 0), actions.reshape(-1, m)).reshape(n, k, -1)


def _proved_margin(agent: Agent) -> float:
    r""":math:`L_B (\delta + \kappa) + 2 \epsilon_B`; :math:`\kappa`: by how much a correction that float32 cuts to :math:`\delta` may be longer."""
    system = closed_loop(
        agent.barrier, agent.dynamics, agent.policy, latent_dim=agent.latent_dim, lipschitz_bound=agent.lipschitz_bound
    )
    unit = UNITS[next(agent.barrier.parameters()).dtype]
    rounding = largest_rounding(system.barrier, system.low, system.high, unit)
    return agent.lipschitz_bound * (agent.tolerated_error + CUT) + 2.0 * rounding


class SafetyFilter(TensorDictModuleBase):
    r"""Behind any TorchRL policy: reads its ``"action"``, writes one that keeps the agent's set; see :class:`Shield`.

    The agent's memory is a hidden state in TorchRL's way, as for :class:`~torchrl_sspl.modules.LatentObserver`: the environment
    needs ``InitTracker`` and the transform of :meth:`make_tensordict_primer`. Written are ``"action"``, ``"intervened"``
    ``(*batch, 1)`` bool, ``"deviation"`` and ``"safety_margin"`` ``(*batch, 1)``, ``"latent"``, ``"innovation"`` and
    ``("next", "prior")``. Source: none.

    Args:
        agent: frozen agent.
        **options: of :class:`Shield`; errors too.

    Example:
        >>> from tensordict.nn import TensorDictModule, TensorDictSequential
        >>> from torchrl.envs import Compose, InitTracker, TransformedEnv
        >>> from torchrl_sspl.envs import PendulumEnv
        >>> from torchrl_sspl.modules.agent import load
        >>> protect = SafetyFilter(load("pendulum"))
        >>> pushes = TensorDictModule(lambda pixels: torch.full((len(pixels), 1), 10.0), ["pixels"], ["action"])
        >>> env = PendulumEnv(batch_size=[2], seed=0)
        >>> env.initial_set = env.safe_set
        >>> env = TransformedEnv(env, Compose(InitTracker(), protect.make_tensordict_primer()))
        >>> bool((env.rollout(20, TensorDictSequential(pushes, protect))["next", "region"] == 2).any())
        False
    """

    def __init__(self, agent: Agent, **options: Any) -> None:
        super().__init__()
        self.agent, self.shield = agent, Shield(agent, **options)
        self.observer = LatentObserver(agent.encoder, agent.gain, agent.latent_dim, agent.barrier, agent.held_error, direction_of(agent.dynamics))
        self.in_keys = [*self.observer.in_keys, "action"]
        self.out_keys: list[Any] = [
            *self.observer.out_keys, "action", "intervened", "deviation", "safety_margin", ("next", "prior"),
        ]  # fmt: skip

    @torch.no_grad()
    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Replace ``"action"`` ``(*batch, m)``, and say what was done."""
        batch = tensordict.batch_size
        try:
            known, wanted = tensordict.select(*self.observer.in_keys), tensordict["action"]
        except KeyError as error:
            missing = [str(key) for key in (*self.observer.in_keys, "action") if key not in tensordict.keys(True)]
            raise ConfigError(
                f"SafetyFilter: expected {missing} in the TensorDict, received none; in an environment append make_tensordict_primer() (and InitTracker), "
                "which give 'prior' and 'is_init'; for single pictures take Monitor and Shield"
            ) from error
        seen = self.observer(known)
        latent = seen["latent"]
        rows = latent.reshape(-1, latent.shape[-1])
        made = self.shield(rows, wanted.reshape(-1, wanted.shape[-1]))
        found = {
            "latent": latent, "innovation": seen["innovation"], "action": made.action, "intervened": made.intervened[:, None],
            "deviation": made.deviation[:, None], "safety_margin": made.margin[:, None], ("next", "prior"): made.predicted,
        }  # fmt: skip
        for key, value in found.items():
            tensordict.set(key, value.reshape(*batch, value.shape[-1]))
        return tensordict

    def make_tensordict_primer(self) -> Any:
        """The transform that gives an environment the key ``"prior"``."""
        return self.observer.make_tensordict_primer()


__all__ = ["Protected", "SafetyFilter", "Shield"]
