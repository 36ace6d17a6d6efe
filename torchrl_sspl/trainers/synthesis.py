r"""The phases on frozen latents: data, dynamics, what can be kept, barrier and policy, fine-tuning on the condition.

In each round: :class:`Gather` encodes transitions, :class:`FitDynamics` fits the latent dynamics to them,
:class:`TeachPolicy` (teacher "value") teaches the policy the values of its actions, :class:`FitSets` regresses barrier
and policy onto the largest robust invariant set of the cloud of latents (or the margin that the taught policy keeps),
:class:`SteerPolicy` and :class:`FineTune` train on the condition
:math:`B(z) \le 0 \Rightarrow B(d(z, \pi(z)) + e) + m \le 0` under the observed errors e. Checks follow.
"""

from __future__ import annotations

import copy
import math
from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
import torch
from scipy.ndimage import distance_transform_edt
from tensordict import TensorDict
from torch import Tensor, nn
from torch.nn import functional as F

from torchrl_sspl.certification.conditions import closed_loop, find_counterexamples
from torchrl_sspl.configs.schema import SynthesisConfig
from torchrl_sspl.direction import charted, lifted, within
from torchrl_sspl.functional import safe_hinge
from torchrl_sspl.modules.networks import mlp
from torchrl_sspl.modules.observer import corrected, gain_matrix
from torchrl_sspl.objectives import ActionValueLoss, ConsistencyLoss, CounterexampleLoss, SynthesisLoss, TargetLoss
from torchrl_sspl.objectives.base import LatentBatch
from torchrl_sspl.objectives.counterexample import worst_error
from torchrl_sspl.sets import SAFE, UNSAFE
from torchrl_sspl.trainers.phases import InnerLoop, Phase, Workspace, action_grid
from torchrl_sspl.viability import ViabilityKernel, viability_kernel
from torchrl_sspl.viability.cloud import (
    barrier_targets,
    nearby_residuals,
    nearest_distance,
    normal_projectors,
    reach_times,
    robust_invariant_set,
    safety_values,
    signed_margin,
    value_targets,
)
from torchrl_sspl.viability.grid import Grid

_KNOWN_WITHIN = 0.06  # distance from the data beyond which a way back is not looked for
_VALUE_SCALE = 0.05  # distance of latents in which values of actions are measured
_SPREADS = (1.0, 0.75, 0.5, 0.25, 0.0)  # shares of the errors that are tolerated, the first that keeps S
_KEPT_OF_SAFE = 0.9
_SEARCH_EVERY = 250  # steps between two searches for counterexamples
_ROOM = 1.25  # of what is to be tolerated, that the invariant set of the data tolerates
_GRID_ROOM = 4.0  # ... that the one on a grid tolerates
_SPARE = 0.004  # barrier value by which counterexamples have to be refuted, for what a proof does not resolve
_WEIGHT, _LEAST_WEIGHT = 2.0, 20.0  # of counterexamples
_MEMORY = 9  # nodes of the grid per entry that no picture shows
_TURNS = 24  # ... around a direction
_SEPARATE = 8000  # steps in which U is told from the rest: a border that is not sharp costs volume
_UNSAFE_FIRST = 3.0  # how much more a picture of U counts there
_SLOPE = 0.9  # of the targets on a grid, of the barrier's Lipschitz constant
_NEAR_ZERO = 0.06  # of these targets, those that a batch has as many of as of all
_DEPTH = 0.25  # barrier value up to which the targets on a grid go
_POOL = 8192  # counterexamples that are kept
_STARTS = 2048  # latents from which they are climbed to
_UNROLLED = 24  # steps through the observer
_NEAR = 0.2  # barrier value up to which further rounds look at transitions of the policy


class Gather(Phase):
    """Encoded transitions: those of the joint training and random actions in the first round, the policy's own afterwards.

    A memory drifts along the paths that a policy takes, not along random ones: behind an observer the first round adds
    episodes of the policy of the joint training, too. Where the environment knows its sets, further rounds add transitions of the exploring policy that start in the set
    or near it, and of many that start in U those whose pictures the present barrier puts lowest: the rim of U is where
    a set goes wrong first. Elsewhere they add episodes of the exploring policy from the environment's own resets.
    Source: paper Algorithm 1 (rollouts join D); deviation: which of them are kept is decided by their pictures.
    """

    name = "gather"

    def run(self, work: Workspace) -> None:
        s, source = work.config, work.source
        if source is None:
            return  # they were given
        if self.number == 0:
            stored = source.stored(s.transitions)
            missing = s.transitions - (0 if stored is None else len(stored["seen"]))
            parts = [] if stored is None else [stored]
            if missing > 0 and (source.known or stored is None):
                parts.append(source.random(missing, 0))
            if s.grid and source.known and s.rim_transitions:  # what lies between pictures of U has to be known, too
                parts.append(source.random(s.rim_transitions, 5, region=source.env.unsafe_set, steps=1))
            if work.observing and source.known:
                parts.append(self._rollouts(work, 15, gain_matrix(1.0, work.latent_dim, work.seen_dim)))
        else:
            parts = [work.latents, self._near_the_set(work)]
            if source.known and s.rim_transitions:
                parts.append(_rim_of_unsafe(work, 20 * self.number + 10))
        parts = [work.filtered(part) for part in parts]
        work.latents = {k: torch.cat([p[k] for p in parts]) for k in parts[0]}
        work.cache.clear()
        unsafe = work.unsafe()
        if not bool(unsafe.any()) or bool(unsafe.all()):
            work.warnings.append(
                f"policy and barrier are those of the joint training: {int(unsafe.sum())} of {len(unsafe)} transitions start in "
                "U, and what follows needs both kinds"
            )
            work.skip = True

    def _near_the_set(self, work: Workspace) -> dict[str, Tensor]:
        s, source = work.config, work.source
        found: list[dict[str, Tensor]] = []
        count = 0
        for attempt in range(10):
            part = self._rollouts(work, 20 * self.number + attempt, work.gain)
            with torch.no_grad():
                near = work.barrier(work.filtered(part)["latent"])[:, 0] < _NEAR
            # What goes on after a transition that is left out would begin a new episode there.
            part["continues"] &= torch.cat([near[:1], near[:-1]])
            found.append({k: v[near] for k, v in part.items()})
            count += int(near.sum())
            if count >= s.rollout_transitions or not source.known:
                break
        return {k: torch.cat([f[k] for f in found])[: s.rollout_transitions] for k in found[0]}

    @staticmethod
    def _rollouts(work: Workspace, index: int, gain: Tensor) -> dict[str, Tensor]:
        """Transitions of the exploring policy, behind an observer of a gain where the agent will have one."""
        s, source = work.config, work.source
        region = source.outside_unsafe if source.known else None
        memory: dict[str, Any] = {"dynamics": work.dynamics, "gain": gain} if work.observing else {}
        return source.under(work.acting, s.rollout_transitions, index, exploration=s.exploration, region=region, **memory)


@torch.no_grad()
def _rim_of_unsafe(work: Workspace, index: int) -> dict[str, Tensor]:
    """Of many transitions that start in U, those whose pictures the present barrier puts lowest."""
    s, source = work.config, work.source
    drawn = source.random(s.rim_draws * s.rim_transitions, index, region=source.env.unsafe_set, steps=1)
    lowest = work.barrier(drawn["seen"])[:, 0].topk(s.rim_transitions, largest=False).indices
    return {k: v[lowest] for k, v in drawn.items()}


class _Training(Phase):
    """Takes ``<name>_steps`` of the configuration; where it refits, half of them in further rounds."""

    refits = True

    def size(self, work: Workspace) -> int:
        steps = getattr(work.config, f"{self.name}_steps")
        return steps // 2 if self.refits and self.number else steps


class FitDynamics(_Training):
    """Dynamics on frozen latents, through the observer where it has a memory; off the manifold they lead back to it.

    One step ahead is not enough behind an observer: a bias b that no single step shows becomes an offset b / k of its
    latent. What is unrolled are pieces of episodes, from the latents of the last filtering.
    Source: paper eq. (8), third term; deviation: the worst errors count extra, so do latents off the manifold.
    """

    name = "dynamics"

    def run(self, work: Workspace) -> None:
        s, data = work.config, work.latents
        # A grid covers a domain that the data fill: what seems to lie beside them is a gap between samples, and leads nowhere else.
        rows = data["latent"][:0] if s.grid else data["latent"]
        tube, base = off_manifold(work, rows, 1.3 * s.tube_radius, self.number)
        on, off = (2 * s.batch // 6, s.batch // 6) if not work.observing else (s.batch // 4, s.batch)
        loss = ConsistencyLoss(work.dynamics, unsafe_weight=s.unsafe_weight, worst_coeff=0.2, worst_fraction=0.05)

        latent, after, action, region = (data[k] for k in ("latent", "next_latent", "action", "region"))
        pieces = _pieces(data["continues"]) if work.observing else None

        def step() -> dict[str, Tensor]:
            a, c = work.loop.pick(len(latent if pieces is None else pieces), on), None
            if len(tube):
                c = work.loop.pick(len(tube), off)
            z, index, target = latent[a], a, after[a]
            if pieces is not None:
                z, index = self._unrolled(work, pieces[a])
                target = data["next_seen"][index]
            if c is not None:
                z, index, target = torch.cat([z, tube[c]]), torch.cat([index, base[c]]), torch.cat([target, after[base[c]]])
            return loss.terms(LatentBatch(z, next_latent=target, action=action[index], region=region[index]))

        rate = 1e-3 if work.observing else 3e-3 if self.number == 0 else 2e-3
        work.loop(self.size(work), {work.dynamics: rate}, step)
        work.latents = work.filtered(work.latents)
        work.cache.clear()

    @staticmethod
    def _unrolled(work: Workspace, rows: Tensor) -> tuple[Tensor, Tensor]:
        """Latents along pieces of episodes ``(n, k)``, with their gradient, and which transitions these are."""
        data, z = work.latents, []
        latent = data["latent"][rows[:, 0]]
        for k in range(rows.shape[1]):
            here = rows[:, k]
            z.append(latent)
            if k + 1 < rows.shape[1]:
                latent = corrected(work.dynamics(latent, data["action"][here]), data["next_seen"][here], work.gain, work.direction)[0]
        index = rows.mT.flatten()
        kept = index >= 0
        return torch.cat(z)[kept], index[kept]


class TeachPolicy(_Training):
    """The policy alone, on the values of its actions; what it then keeps is what the barrier is taught.

    Source: none; the paper descends on the barrier.
    """

    name = "teach"

    def run(self, work: Workspace) -> None:
        s, z, unsafe = work.config, work.latents["latent"], work.unsafe()
        g = torch.Generator().manual_seed(work.seed + 99_000 + self.number)
        actions = action_grid(work.action_scale, s.actions)
        _, axes = observed_errors(work, z, g, s.teach_spread)
        following = successors(work, z, actions)
        value = safety_values(following, z, signed_margin(z, unsafe), residuals=axes)
        # In U nothing can be kept any more: the soonest way out.
        value[unsafe] = -_VALUE_SCALE * reach_times(following[unsafe], z[unsafe], z[~unsafe])
        loss = ActionValueLoss(
            work.policy, action_scale=work.action_scale, scale=_VALUE_SCALE, worst_coeff=0.3, worst_fraction=0.05
        )

        def step() -> dict[str, Tensor]:
            rows = work.loop.pick(len(z), s.batch)
            return loss.terms(LatentBatch(z[rows]), value[rows])

        work.loop(self.size(work), {work.policy: 3e-3}, step)
        work.taught = copy.deepcopy(work.policy).requires_grad_(False)


class FitSets(_Training):
    """Barrier and policy onto the robust invariant set of the encoded data.

    Targets on a grid are exact: half of a batch comes from where they are near zero, and pictures of U count, too.
    Source: none; the paper trains the barrier on the condition from the start.
    """

    name = "fit"

    def run(self, work: Workspace) -> None:
        table, _ = targets(work, self.number)
        s, g, pick = work.config, bool(work.config.grid), work.loop.pick
        loss = TargetLoss(
            work.barrier, work.policy, action_scale=work.action_scale, scale=0.1, worst_coeff=1.0 if g else 0.3,
            worst_fraction=0.02 if g else 0.05, safety_margin=s.unsafe_margin, unsafe_coeff=float(g),
        )  # fmt: skip
        rates = {work.barrier: 5e-3 if self.number == 0 else 2e-3, work.policy: 3e-3}
        shares = [(torch.arange(len(table)), s.batch)]
        if g:
            near = table["barrier_target"][:, 0].abs() < _NEAR_ZERO
            unsafe = table["region"][:, 0] == UNSAFE
            shares += [(rows.nonzero()[:, 0], n) for rows, n in ((near, s.batch), (unsafe, s.batch // 2)) if bool(rows.any())]
        work.loop(self.size(work), rates, lambda: loss(table[torch.cat([rows[pick(len(rows), n)] for rows, n in shares])]))


class FineTune(_Training):
    """Barrier and policy together, on the condition under observed errors, the labels and the targets.

    Source: paper eq. (10); deviation: condition R3 in place of a decrease everywhere.
    """

    name, refits = "tune", False

    def rates(self, work: Workspace) -> dict[nn.Module, float]:
        """What is trained, with its peak learning rate."""
        return {work.barrier: work.config.lr, work.policy: work.config.lr}

    def margin(self, config: SynthesisConfig) -> float:
        """m of the condition."""
        return config.margin

    def run(self, work: Workspace) -> None:
        s = work.config
        table, rim = targets(work, self.number)
        unsafe = (table["region"][:, 0] == UNSAFE).nonzero()[:, 0]
        # Half of the rows of U come from its rim, the sixth that lies nearest to the set.
        nearest = table["barrier_target"][unsafe, 0].argsort()[: max(1, len(unsafe) // 6)]
        safe = (table["region"][:, 0] == SAFE).nonzero()[:, 0]
        table = table.clone(False)
        table["action_weight"] = table["action_weight"] * torch.where(table["inside"], 0.1, 1.0)
        condition = SynthesisLoss(
            None, work.dynamics, work.barrier, work.acting, mode="R3", dynamics_margin=self.margin(s), band=s.band,
            worst_coeff=1.0, worst_fraction=0.02, off_manifold_coeff=1.0,
        )  # fmt: skip
        target = self._target(work)
        # What the sets hold counts more than its share of the data; S may be empty.
        shares = ((unsafe, s.batch // 2), (unsafe[nearest], s.batch // 2), (safe, s.batch // 4))
        pick = work.loop.pick

        def step() -> TensorDict:
            drawn = [pick(len(table), s.batch)]
            drawn += [rows[pick(len(rows), n)] for rows, n in shares if len(rows)]
            asked = rim[pick(len(rim), 3 * s.batch // 2)]
            if s.tolerated_error > 0:  # the worst of them
                with torch.no_grad():
                    after = work.dynamics(asked["latent"], work.policy(asked["latent"]))
                error = worst_error(work.barrier, after, s.tolerated_error)
            else:
                error = asked["residual"][torch.arange(len(asked)), pick(s.residuals, len(asked))]
            asked = asked.exclude("residual").set("residual", error)
            if s.counterexamples:
                asked = self._with_counterexamples(work, asked)
            terms = condition(asked)
            terms.update(target(table[torch.cat(drawn)]))
            terms.update(self.more(work, rim["latent"]))
            return terms

        work.loop(self.size(work), self.rates(work), step)

    def more(self, work: Workspace, rim: Tensor) -> dict[str, Tensor]:
        """Further terms of a step."""
        return {}

    def _target(self, work: Workspace, safe_coeff: float = 1.0) -> TargetLoss:
        s = work.config
        return TargetLoss(
            work.barrier, work.policy, action_scale=work.action_scale, outside_cap=s.band, policy_coeff=s.recovery_coeff,
            safety_margin=s.unsafe_margin, inside_coeff=2.0, unsafe_coeff=10.0, safe_coeff=safe_coeff, worst_coeff=1.0,
            worst_fraction=0.02,
        )  # fmt: skip

    def _with_counterexamples(self, work: Workspace, asked: TensorDict) -> TensorDict:
        """Adds latents of the whole domain at which the condition fails; they are searched for again and again."""
        s, step = work.config, work.loop.step
        if step % _SEARCH_EVERY == 0:
            nets = work.barrier, work.dynamics, work.acting
            system = closed_loop(*nets, latent_dim=work.latent_dim, lipschitz_bound=work.lipschitz_bound)
            found = find_counterexamples(system, s.counterexamples, margin=s.margin, generator=work.loop.generator)
            known = found if step == 0 else torch.cat([found, work.counterexamples])
            work.counterexamples = known[: 8 * s.counterexamples]
        if not len(work.counterexamples):
            return asked
        latent = work.counterexamples[work.loop.pick(len(work.counterexamples), len(asked) // 4)]
        hard = TensorDict(latent=latent, residual=torch.zeros_like(latent), batch_size=[len(latent)])
        return torch.cat([asked, hard])


class SteerPolicy(FineTune):
    """The policy alone, on the condition with twice the margin."""

    name = "steer"

    def rates(self, work: Workspace) -> dict[nn.Module, float]:
        return {work.policy: 3e-3}

    def margin(self, config: SynthesisConfig) -> float:
        return 2 * config.margin


class Tighten(FineTune):
    """Counterexamples of the proof go back into the fine-tuning until there are few left.

    They are looked for near the data, in the whole domain and around those found before, anew every hundred steps.
    Source: none (counterexample-guided synthesis); the paper asks the condition of its samples alone.
    """

    name = "tighten"

    def rates(self, work: Workspace) -> dict[nn.Module, float]:
        return {work.barrier: 0.5 * work.config.lr, work.policy: 0.5 * work.config.lr}

    def run(self, work: Workspace) -> None:
        if work.loop.step == 0:
            work.counterexamples = torch.zeros(0, work.latent_dim)
        self._loss = CounterexampleLoss(
            work.dynamics, work.barrier, work.acting, dynamics_margin=_SPARE, error=work.config.tolerated_error,
            worst_coeff=0.3, worst_fraction=0.02,
        )  # fmt: skip
        super().run(work)

    def more(self, work: Workspace, rim: Tensor) -> dict[str, Tensor]:
        if work.loop.step % 100 == 0:
            work.counterexamples = self._search(work, rim)
        if not len(work.counterexamples):
            return {}
        rows = work.counterexamples[work.loop.pick(len(work.counterexamples), work.config.batch)]
        terms = self._loss(TensorDict(latent=rows, batch_size=[len(rows)]))
        return {k: _WEIGHT * v if k.startswith("loss") else v for k, v in terms.items()}

    @torch.no_grad()
    def _search(self, work: Workspace, rim: Tensor, samples: int = 150_000) -> Tensor:
        """The worst latents of the set, up to as many as are kept; those that are nearly counterexamples count, too."""
        g, p, old = work.loop.generator, work.latent_dim, work.counterexamples
        near = rim[work.loop.pick(len(rim), samples)] + 0.04 * torch.randn(samples, p, generator=g)
        points = [near, uniform(work, samples, g)]
        if len(old):
            points += [old, old[work.loop.pick(len(old), samples // 2)] + 0.01 * torch.randn(samples // 2, p, generator=g)]
        z = within(torch.cat(points), work.direction)
        z = z[work.barrier(z)[:, 0] <= 0.02]
        if not len(z):
            return z
        error = work.config.tolerated_error
        after = work.dynamics(z, work.acting(z))
        value = work.barrier(after)[:, 0]
        possible = value > -0.01 - _SPARE - work.lipschitz_bound * error
        climbed = self._ascend(work, z[value.topk(min(_STARTS, len(z))).indices])
        z, after = torch.cat([z[possible], climbed]), torch.cat([after[possible], work.dynamics(climbed, work.acting(climbed))])
        value = work.barrier(after + worst_error(work.barrier, after, error))[:, 0] + _SPARE
        worst = value.topk(min(_POOL, len(value)))
        return z[worst.indices[worst.values > -0.01]]

    @staticmethod
    def _ascend(work: Workspace, latent: Tensor, restarts: int = 3, steps: int = 12) -> Tensor:
        """Latents of the set ``(n, p)`` after which the barrier is highest, climbed to from as many: samples alone miss narrow
        peaks, and so does one climb with steps that shrink."""
        best = latent
        for _ in range(restarts):
            z = best
            for k in range(steps):
                with torch.enable_grad():
                    at = z.detach().requires_grad_()
                    here = work.barrier(at)[:, 0]
                    value = work.barrier(work.dynamics(at, work.acting(at).detach()))[:, 0] - 20.0 * here.clamp_min(0.0)
                    (slope,) = torch.autograd.grad(value.sum(), at)
                z = within(z + 0.03 * 0.8**k * slope / slope.norm(dim=1, keepdim=True).clamp_min(1e-9), work.direction)
            best = torch.cat([best, z])
            after = work.barrier(work.dynamics(best, work.acting(best)))[:, 0]
            inside = work.barrier(best)[:, 0] <= _SPARE
            best = best[torch.where(inside, after, -math.inf).topk(len(latent)).indices]
        return best[work.barrier(best)[:, 0] <= 0.02]


class Settle(Tighten):
    """The smallest change after which no counterexample is found; for targets on a grid, which are nearly kept as they are fitted.

    Of the pictures of U those count that the barrier puts lowest, whatever action the memory holds, of S those that it puts highest.
    Source: none (counterexample-guided synthesis).
    """

    def run(self, work: Workspace) -> None:
        s, pick = work.config, work.loop.pick
        if work.loop.step == 0:
            work.counterexamples = torch.zeros(0, work.latent_dim)
        self._loss = CounterexampleLoss(
            work.dynamics, work.barrier, work.acting, mode="least", depth=_SPARE, dynamics_margin=_SPARE, error=s.tolerated_error,
            worst_coeff=0.3, worst_fraction=0.02,
        )  # fmt: skip
        table, rim = targets(work, self.number)
        unsafe, safe = ((table["region"][:, 0] == code).nonzero()[:, 0] for code in (UNSAFE, SAFE))
        target = self._target(work, safe_coeff=0.0)  # S may reach to the border of what can be kept: no margin is asked there

        def worst(rows: Tensor, count: int, high: bool) -> TensorDict:
            drawn = rows[pick(len(rows), 4 * s.batch)]
            latent = table["latent"][drawn]
            if work.seen_dim is not None:  # an episode that begins in S remembers nothing; U may be met with any memory
                alone = F.pad(latent[:, : work.seen_dim], (0, work.latent_dim - work.seen_dim))
                latent = alone if high else remembered(work, latent, work.loop.generator)
            with torch.no_grad():
                found = work.barrier(latent)[:, 0].topk(count, largest=high).indices
            return table[drawn[found]].set("latent", latent[found])

        def step() -> dict[str, Tensor]:
            if work.loop.step % 100 == 0:
                work.counterexamples = self._search(work, rim["latent"])
            asked = [rim["latent"][pick(len(rim), s.batch)]]
            if len(work.counterexamples):
                asked.append(work.counterexamples[pick(len(work.counterexamples), s.batch)])
            latent = torch.cat(asked)
            terms = dict(self._loss(TensorDict(latent=latent, batch_size=[len(latent)])).items())
            terms["loss_counterexample"] = _LEAST_WEIGHT * terms["loss_counterexample"]
            drawn = [table[pick(len(table), s.batch)], worst(unsafe, s.batch // 2, False)]
            terms |= dict(target(torch.cat(drawn)).items())
            if len(safe) and not s.safe_share:
                missed = safe_hinge(work.barrier(worst(safe, s.batch // 4, True)["latent"]), _SPARE)
                terms["loss_safe"] = _LEAST_WEIGHT * missed.mean()
            return terms

        work.loop(self.size(work), self.rates(work), step)


def synthesis_phases(config: SynthesisConfig, *, check: Callable[[int], Phase] | None = None) -> list[Phase]:
    """The phases of every round.

    Args:
        config: gives the number of rounds and the teacher.
        check: ``round -> phase`` that ends every round, such as :class:`CheckRound`; ``None``: nothing is checked.

    Returns the phases in order; leave some out, or put your own between them. Source: paper Algorithm 1.

    Example:
        >>> [phase.name for phase in synthesis_phases(SynthesisConfig())]
        ['gather', 'dynamics', 'teach', 'fit', 'steer', 'tune']
    """
    teach = [TeachPolicy] if config.teacher == "value" else []
    tighten = [Tighten] if config.tolerated_error > 0 else []
    after = [Settle] if config.grid else [SteerPolicy, FineTune, *tighten]
    kinds: list[Any] = [Gather, FitDynamics, *teach, FitSets, *after, *([check] if check else [])]
    return [kind(k) for k in range(config.rounds) for kind in kinds]


def _pieces(continues: Tensor) -> Tensor:
    """Rows ``(n, k)`` of pieces of episodes of at most so many transitions, filled up with -1 behind their end."""
    rows = torch.arange(len(continues))
    begins = torch.where(continues, 0, rows).cummax(0).values
    first = rows[(rows - begins) % _UNROLLED == 0]
    piece = first[:, None] + torch.arange(_UNROLLED)
    ends = torch.cat([first[1:], torch.tensor([len(continues)])])
    return torch.where(piece < ends[:, None], piece, -1)


@torch.no_grad()
def off_manifold(work: Workspace, latent: Tensor, radius: float, salt: int) -> tuple[Tensor, Tensor]:
    """Latents moved off the data manifold along its normals, and the rows that they came from."""
    g = torch.Generator().manual_seed(work.seed + 77_000 + salt)
    cloud = _cloud(work, g)
    normal = normal_projectors(latent, cloud[:20000])
    direction = (normal @ torch.randn(*latent.shape, 1, generator=g))[..., 0]
    length = direction.norm(dim=-1, keepdim=True)
    moved = radius * torch.rand(len(latent), 1, generator=g)
    points = within(latent + moved * direction / length.clamp_min(1e-6), work.direction)
    # Where another sheet of the manifold is nearer than the one it came from, a point says nothing.
    kept = (length[:, 0] > 1e-3) & (nearest_distance(points, cloud) > 0.85 * moved[:, 0])
    rows = kept.nonzero()[:, 0]
    return points[rows], rows


def uniform(work: Workspace, n: int, generator: torch.Generator) -> Tensor:
    """``(n, p)`` latents of the whole domain."""
    turns = work.direction
    z = torch.rand(n, work.latent_dim - (turns is not None), generator=generator) * 2 - 1
    if turns is not None:
        z[:, turns.first] *= math.pi * turns.radius
    z = lifted(z, turns)
    return z if work.seen_dim is None else remembered(work, z, generator)


def remembered(work: Workspace, latent: Tensor, generator: torch.Generator) -> Tensor:
    """Latents ``(n, p)`` with other actions in their memory: anywhere in the domain, or from what the policy chooses from.

    What is chosen lies on the rim of the domain, which is never drawn uniformly.
    """
    seen, n = work.seen_dim or work.latent_dim, len(latent)
    hidden = torch.rand(n, work.latent_dim - seen, generator=generator) * 2 - 1
    if work.config.choices:
        table = action_grid([1.0] * hidden.shape[1], work.config.choices)
        drawn = table[torch.randint(len(table), (n,), generator=generator)]
        hidden = torch.where(torch.rand(n, 1, generator=generator) < 0.5, drawn, hidden)
    return torch.cat([latent[:, :seen], hidden], -1)


def _cloud(work: Workspace, generator: torch.Generator) -> Tensor:
    cloud = torch.cat([work.latents["latent"], work.latents["next_latent"]])
    return cloud[torch.randperm(len(cloud), generator=generator)[:80000]]


def observed_errors(work: Workspace, latent: Tensor, generator: torch.Generator, spread: float) -> tuple[Tensor, Tensor]:
    """Errors of the dynamics observed near latents: a sample of them, and their principal axis."""
    data = work.latents
    z = data["latent"]
    with torch.no_grad():
        residual = data["next_latent"] - work.dynamics(z, data["action"])
    sample = torch.randperm(len(z), generator=generator)[:30000]
    near, axes = nearby_residuals(latent, z[sample], residual[sample], count=work.config.residuals, spread=spread)
    if work.config.tolerated_error > 0:
        # The direction is what was observed, the length what is to be tolerated, and room for what a network does not fit.
        mean, ends = axes[:, :1], axes[:, 1:] - axes[:, :1]
        length = _ROOM * work.config.tolerated_error / ends.norm(dim=-1, keepdim=True).clamp_min(1e-9)
        axes = torch.cat([mean, mean + length * ends], dim=1)
    return near, axes


@torch.no_grad()
def successors(work: Workspace, latent: Tensor, actions: Tensor) -> Tensor:
    """``(n, k, p)`` next latents under every action of a table."""
    k = len(actions)
    parts = [
        work.dynamics(part.repeat_interleave(k, 0), actions.repeat(len(part), 1)).reshape(len(part), k, -1)
        for part in latent.split(4096)
    ]
    return torch.cat(parts)


def targets(work: Workspace, number: int) -> tuple[TensorDict, TensorDict]:
    """Latents with the targets of barrier and policy, and the latents on which the condition is asked; computed once a round."""
    if "targets" not in work.cache:
        s, data = work.config, work.latents
        g = torch.Generator().manual_seed(work.seed + 88_000 + number)
        z, region = data["latent"], data["region"]
        if work.seen_dim is not None:  # a label is about a picture, whatever the memory holds beside it
            z, region = torch.cat([z, remembered(work, data["seen"], g)]), torch.cat([torch.zeros_like(region), region])
        unsafe = region[:, 0] == UNSAFE
        zc = z[~unsafe]
        near, axes = observed_errors(work, zc, g, s.residual_spread)
        stray = uniform(work, 60000, g)
        tube, _ = off_manifold(work, z, 2 * s.tube_radius, 1000 + number)
        rim, rows = off_manifold(work, zc, 1.2 * s.tube_radius, 2000 + number)
        queries = torch.cat([z, data["next_latent"], tube, stray])
        if s.grid:
            target, member, best, weight = _grid_targets(work, z, unsafe, queries)
        elif s.teacher == "value":
            target, member, best, weight = _value_targets(work, z, region, queries, axes)
        else:
            target, member, best, weight = _clearance_targets(work, z, unsafe, queries, stray, axes, g)
        rest = len(queries) - len(z)
        table = TensorDict(
            latent=queries,
            barrier_target=target[:, None],
            inside=member[:, None],
            action_target=torch.cat([best, torch.zeros(rest, best.shape[1])]),
            action_weight=torch.cat([weight, torch.zeros(rest)])[:, None],
            region=torch.cat([region, torch.zeros(rest, 1, dtype=torch.int64)]),
            batch_size=[len(queries)],
        )
        asked = TensorDict(
            latent=torch.cat([zc, rim]), residual=torch.cat([near, near[rows]]), batch_size=[len(zc) + len(rim)]
        )
        work.cache["targets"] = table, asked
    return work.cache["targets"]


def _clearance_targets(
    work: Workspace, z: Tensor, unsafe: Tensor, queries: Tensor, stray: Tensor, errors: Tensor, generator: torch.Generator
) -> tuple[Tensor, ...]:
    """Signed distance to the robust invariant set; actions that keep the largest clearance, or lead back soonest."""
    s = work.config
    zc, actions = z[~unsafe], action_grid(work.action_scale, s.actions)
    found = robust_invariant_set(successors(work, zc, actions), zc, z[unsafe], residuals=errors)
    kept = found.inside
    if not bool(kept.any()):
        # Nothing can be kept under these errors: go on with what can be kept longest, and let the held-out
        # checks say what it is worth.
        kept = found.removed == found.removed.max()
    inside = torch.zeros(len(z), dtype=torch.bool)
    inside[(~unsafe).nonzero()[:, 0]] = kept
    far = nearest_distance(stray, _cloud(work, generator)) > s.tube_radius
    outer_points = torch.cat([z[~inside], stray[far]])
    bounds = {"tube_radius": s.tube_radius, "lipschitz_bound": work.lipschitz_bound}
    target, member = barrier_targets(queries, z[inside], outer_points, **bounds)
    best = torch.zeros(len(z), len(work.action_scale))
    best[inside] = torch.softmax(found.clearance[kept] / 0.01, 1) @ actions
    outer = (~inside).nonzero()[:, 0]
    times = reach_times(successors(work, z[outer], actions), z[outer], z[inside], known_within=_KNOWN_WITHIN)
    best[outer] = torch.softmax(-times / 0.1, 1) @ actions
    weight = torch.ones(len(z))
    weight[outer] = (times.min(1).values < 100).float()
    work.kept_share = float(found.inside.float().mean())
    work.log_once({"step": 0, "inside_of_allowed": work.kept_share, "sweeps": found.iterations})
    return target, member, best, weight


@torch.no_grad()
def _grid_targets(work: Workspace, z: Tensor, unsafe: Tensor, queries: Tensor) -> tuple[Tensor, ...]:
    """Signed distance to what some action of the table keeps, whatever error is added, on a grid over the latent domain; and the
    taught policy."""
    s, taught, turns = work.config, work.taught or work.policy, work.direction
    seen, hidden = work.seen_dim or work.latent_dim, work.latent_dim - (work.seen_dim or work.latent_dim)
    looks_unsafe, room = z[unsafe][:, :seen], max(s.guard, 1.0 / (s.grid - 1))  # at least half of a cell
    low, sizes, period = [-1.0] * seen, [s.grid] * seen, [0.0] * seen
    if turns is not None:  # the grid is one of charts
        low, sizes, period = low[:-1], [*sizes[:-2], _TURNS], [0.0] * (seen - 1)
        low[-1], period[-1] = -math.pi * turns.radius, 2.0 * math.pi * turns.radius
    signs = torch.cartesian_prod(*[torch.tensor([-1.0, 0.0, 1.0])] * len(low)).reshape(-1, len(low))
    if len(low) > 2:  # the ends of the axes and the corners
        signs = signs[(signs.abs().sum(1) != 2)]
    length = signs.norm(dim=1, keepdim=True).clamp_min(1.0)
    errors = F.pad(_GRID_ROOM * s.tolerated_error * signs / length, (0, hidden))
    low, sizes, period = low + [-1.0] * hidden, sizes + [_MEMORY] * hidden, period + [0.0] * hidden
    margin = _unsafe_margin(work, z[:, :seen], unsafe) if turns is not None else lambda x: nearest_distance(x[:, :seen], looks_unsafe)
    found = viability_kernel(
        lambda x, u: charted(work.dynamics(lifted(x, turns), u), turns), low=low, high=[-v for v in low], resolution=sizes, period=period, errors=errors,
        margin=lambda x: margin(lifted(x, turns)) - room, actions=action_grid(work.action_scale, s.choices or s.actions), exit_is_safe=False,
    )  # fmt: skip
    if not bool((found.value > 0.0).any()):  # nothing can be kept under these errors; the checks will say what the rest is worth
        found = replace(found, value=found.margin)
    distance = _signed_distance(found, charted(queries, turns))
    target = (_SLOPE * work.lipschitz_bound * distance).clamp(-_DEPTH, _DEPTH)
    work.kept_share = float((found.value > 0.0).float().sum() / (found.margin > 0.0).float().sum().clamp_min(1.0))
    work.log_once({"step": 0, "inside_of_allowed": work.kept_share, "sweeps": found.iterations})
    return target, target <= 0.0, taught(z), torch.ones(len(z))


def _signed_distance(found: ViabilityKernel, queries: Tensor) -> Tensor:
    """Distance of queries ``(n, d)`` to a set on a grid, ``(n,)``, negative inside: exact at the nodes of a grid twice as fine, on which
    the values are interpolated, and interpolated between them."""
    around = [bool(p) for p in found.grid.period]
    fine = Grid(found.grid.low, found.grid.high, [2 * n - (not p) for n, p in zip(found.grid.shape, around, strict=True)], found.grid.period)
    inside = (found.interpolate(fine.nodes()) > 0.0).reshape(fine.shape).numpy()
    if inside.all() or not inside.any():
        return torch.full((len(queries),), -math.inf if inside.all() else math.inf)
    half = 0.5 * fine.step[0]  # the border lies between two nodes
    wide = [(n // 4, n // 4) if p else (0, 0) for n, p in zip(fine.shape, around, strict=True)]  # what lies behind the seam
    inside = np.pad(inside, wide, mode="wrap")
    outer, inner = (distance_transform_edt(part, sampling=fine.step) for part in (~inside, inside))
    distance = np.where(inside, half - inner, outer - half)
    distance = distance[tuple(slice(a, d - b) for (a, b), d in zip(wide, distance.shape, strict=True))]
    index, part, _ = fine.locate(queries)
    return fine.gather(fine.pad(torch.from_numpy(distance.copy()).float()), index, part)


@torch.enable_grad()
def _unsafe_margin(work: Workspace, seen: Tensor, unsafe: Tensor) -> Callable[[Tensor], Tensor]:
    """Distance to what looks unsafe, roughly, as a function of latents: a small network that tells pictures of U from others.

    In three dimensions and more, samples lie too far apart for the distance to the nearest of them.
    """
    s = work.config
    near = ~unsafe & (nearest_distance(seen, seen[unsafe]) < _DEPTH)
    rows = [part.nonzero()[:, 0] for part in (unsafe, near if bool(near.any()) else ~unsafe)]
    loop = InnerLoop(work.seed + 66_000)
    with torch.random.fork_rng():
        torch.manual_seed(work.seed + 66_001)
        net = mlp((seen.shape[1], 64, 64, 1), nn.SiLU)

        def step() -> dict[str, Tensor]:
            inner, outer = (net(seen[r[loop.pick(len(r), s.batch)]]) for r in rows)
            return {"loss_unsafe": _UNSAFE_FIRST * F.softplus(inner).mean(), "loss_rest": F.softplus(-outer).mean()}

        loop(max(_SEPARATE // 10, min(_SEPARATE, s.fit_steps)), {net: 5e-3}, step)
    net.requires_grad_(False)

    def margin(latent: Tensor) -> Tensor:
        with torch.enable_grad():
            z = latent[:, : seen.shape[1]].detach().requires_grad_()
            value = net(z)[:, 0]
            (slope,) = torch.autograd.grad(value.sum(), z)
        return (value / slope.norm(dim=1).clamp_min(1e-3)).detach().clamp(-1.0, 1.0)

    return margin


@torch.no_grad()
def _value_targets(work: Workspace, z: Tensor, region: Tensor, queries: Tensor, errors: Tensor) -> tuple[Tensor, ...]:
    """Minus the margin that the taught policy keeps, or the best of the actions to choose from; and the taught policy itself."""
    s, taught = work.config, work.taught or work.policy
    unsafe, safe = region[:, 0] == UNSAFE, region[:, 0] == SAFE
    action = taught(z)
    margin = signed_margin(z, unsafe)
    following, mean = work.dynamics(z, action)[:, None], errors[:, :1]
    if s.choices:
        following = successors(work, z, action_grid(work.action_scale, s.choices))
    for share in _SPREADS:
        # What looks unsafe ends there, whatever follows: no errors are needed for it.
        around = torch.zeros(len(z), *errors.shape[1:])
        around[~unsafe] = torch.lerp(mean, errors, share)
        value = safety_values(following, z, margin, residuals=around).amax(1).minimum(margin)
        # A set without S is worth nothing: rather tolerate less.
        if int((value[safe] > 0).sum()) >= _KEPT_OF_SAFE * int(safe.sum()):
            break
    target = value_targets(queries, z, value, tube_radius=s.tube_radius, lipschitz_bound=work.lipschitz_bound)
    work.kept_share = float((value[~unsafe] > 0).float().mean())
    work.log_once({"step": 0, "inside_of_allowed": work.kept_share, "spread": share * s.residual_spread})
    return target, target <= 0, action, torch.ones(len(z))


__all__ = [
    "FineTune", "FitDynamics", "FitSets", "Gather", "Settle", "SteerPolicy", "TeachPolicy", "Tighten", "action_grid", "synthesis_phases",
]
