r"""Imitation learning: pictures to the actions of an expert that knows state and dynamics.

Faithful: regression onto the expert's actions, and DAgger's relabelling of what the learner visits, with the expert's share
falling as 1/2^i (Pan et al., RSS 2018). Stand-in: the expert is ours, see :class:`KernelExpert`; the network is this
library's encoder with a policy of the size of ours. It claims no safe set, as published.
"""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass
from typing import Any, ClassVar

import numpy as np
import torch
from scipy.ndimage import distance_transform_edt
from tensordict import TensorDictBase
from torch import Tensor, nn

from torchrl_sspl.baselines.base import Budget, Needs, SafetyMethod
from torchrl_sspl.baselines.data import Recording, of_store, pooled
from torchrl_sspl.baselines.perception import encoder_for, train
from torchrl_sspl.data import collect_rollouts
from torchrl_sspl.envs.base import SafetyEnv
from torchrl_sspl.modules import Policy
from torchrl_sspl.seeds import spawn
from torchrl_sspl.viability.grid import ViabilityKernel, viability_kernel

_STEPS = 12  # of an episode of the learner
_LAZY = 1e-3  # price of the largest action, in units of the clearance


class KernelExpert:
    r"""Steers to where the border of the true kernel is farthest: the one-step greedy action on its clearance.

    .. math:: u^* = \arg\max_u \; c(f(x, u)) - \varepsilon |u| / u_{max}

    with c the distance to the complement of the kernel in the units of a turn and of the box (negative outside). Of left and
    right it prefers left, so that nobody has to imitate a coin. Source: none.

    Args:
        env: the system, whose exact dynamics are used.
        kernel: its true kernel; computed if not given.
        actions: how many are tried.

    Example:
        >>> from torchrl_sspl.envs import PendulumEnv
        >>> env = PendulumEnv()
        >>> expert = KernelExpert(env, viability_kernel(env, resolution=61))
        >>> expert(torch.tensor([[0.5, 0.8]])) < 0
        tensor([[True]])
    """

    def __init__(self, env: SafetyEnv, kernel: ViabilityKernel | None = None, actions: int = 21) -> None:
        self.env = env
        self.kernel = kernel or viability_kernel(env, resolution=env.system.kernel_grid)
        self.actions = torch.linspace(-env.max_action, env.max_action, actions)
        grid = self.kernel.grid
        # Lengths in shares of the box; a turn counts as half of it, as a heading of one radian moves a car little at first.
        unit = [s / (h - l) for s, l, h in zip(grid.step, grid.low, grid.high, strict=True)]
        inside = (self.kernel.value > 0).numpy()
        turns = [(n, n) if p else (0, 0) for n, p in zip(grid.shape, grid.period, strict=True)]
        tiled = np.pad(inside, turns, mode="wrap")
        far = distance_transform_edt(tiled, sampling=unit) - distance_transform_edt(~tiled, sampling=unit)
        middle = tuple(slice(a, a + n) for (a, _), n in zip(turns, grid.shape, strict=True))
        self.clearance = dataclasses.replace(self.kernel, value=torch.from_numpy(far[middle]).float())

    @torch.no_grad()
    def __call__(self, state: Tensor) -> Tensor:
        """Actions ``(n, 1)`` of true states ``(n, s)``."""
        n, k = len(state), len(self.actions)
        after = self.env.dynamics(state.repeat_interleave(k, 0), self.actions.repeat(n)[:, None])
        value = self.clearance.interpolate(self.env.wrap(after)).clamp(-10, 10).reshape(n, k)
        share = self.actions / self.env.max_action
        best = (value - _LAZY * share.abs() + 1e-5 * (share > 0)).argmax(1)
        return self.actions[best][:, None]


@dataclass
class ImitationConfig:
    """Options of imitation learning."""

    steps: int = 2000  # of the optimiser, in all
    rounds: int = 3  # of DAgger, if the budget has rollouts


class Imitation(SafetyMethod):
    r"""Imitation learning (behaviour cloning, DAgger): an expert's action for every picture, no safe set.

    .. math:: L = \mathbb{E}\, \lVert \pi(o) - u^*(x) \rVert^2 / u_{max}^2

    Source: Osa et al. 2018 (arXiv 1811.06711); Pan et al., *Imitation learning for agile autonomous driving*, IJRR 2020.
    """

    name = "imitation"
    Config: ClassVar[type | None] = ImitationConfig
    space: ClassVar[dict[str, tuple[Any, ...]]] = {"steps": (2000, 4000, 6000)}
    expert: KernelExpert | None = None

    def fit(self, data: Recording, env: SafetyEnv, budget: Budget, seed: int) -> None:
        """Learn from the expert's actions; see :meth:`SafetyMethod.fit`."""
        self.env, self.scale = env, env.max_action
        expert = self.expert or KernelExpert(env)
        encoder = encoder_for(env, 8 if env.state_dim == 2 else 6, data, whole=True)
        head = Policy(encoder.latent_dim, env.action_dim, (48, 48), env.max_action)
        self.network = nn.Sequential(encoder, head)
        rounds = self.config.rounds if budget.rollouts else 0
        # Of the random part of the recording the learner leaves out what it will collect itself.
        part = data
        if rounds:
            kept = torch.cat([torch.arange(budget.transitions), torch.arange(budget.transitions + budget.rollouts, len(data))])
            part = Recording(**{f.name: getattr(data, f.name)[kept] for f in dataclasses.fields(data)})
        seen, wanted = part.pixels, expert(part.state)
        for k in range(rounds + 1):
            if k:
                visited = self._visit(expert, budget.rollouts // rounds, 0.5**k, spawn(seed, "exploration", k))
                seen, wanted = torch.cat([seen, visited.pixels]), torch.cat([wanted, expert(visited.state)])

            def loss(rows: Tensor, seen: Tensor = seen, wanted: Tensor = wanted) -> dict[str, Tensor]:
                return {"loss": ((self.network(seen[rows]) - wanted[rows]) / self.scale).square().mean()}

            loop = train(seed + k, max(1, self.config.steps // (rounds + 1)), {self.network: 3e-3}, loss, len(seen))
        self.network.eval()
        self.notes["loss"] = float(loop.loss or 0.0)
        self.needs = Needs(
            transitions=len(seen), expert_actions=len(seen), rollouts=budget.rollouts if rounds else 0, claimed="nothing"
        )

    def _visit(self, expert: KernelExpert, n: int, share: float, seed: int) -> Recording:
        """Transitions under the learner, in some episodes under the expert."""
        generator = torch.Generator().manual_seed(seed)

        def policy(rows: TensorDictBase) -> TensorDictBase:
            with torch.no_grad():
                own, best = self._own(rows["pixels"]), expert(rows["state"])
            mixed = torch.rand(len(own), 1, generator=generator) < share
            return rows.set("action", torch.where(mixed, best, own))

        return of_store(collect_rollouts(self.env, policy, n, seed=seed, steps=_STEPS, keep_state=True))

    def barrier(self, seen: Tensor) -> Tensor | None:
        """It claims nothing."""
        return None

    @torch.no_grad()
    def act(self, seen: Tensor, nominal: Tensor) -> tuple[Tensor, Tensor]:
        """The learner's own action, whatever is wanted."""
        return self._own(seen), torch.zeros(len(seen), dtype=torch.bool)

    def _own(self, pixels: Tensor) -> Tensor:
        encoder: Any = self.network[0]
        return self.network(pooled(pixels, encoder.pool_to[0]))


__all__ = ["Imitation", "KernelExpert"]
