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
from typing import Any

import torch
from tensordict import TensorDict
from torch import Tensor, nn
from torch.nn import functional as F

from torchrl_sspl.certification.conditions import find_counterexamples
from torchrl_sspl.certification.loop import closed_loop
from torchrl_sspl.configs.schema import MOST_NEAR_DRAWS, SynthesisConfig
from torchrl_sspl.direction import within
from torchrl_sspl.modules.observer import corrected, gain_matrix
from torchrl_sspl.objectives import (
    ActionChangeLoss,
    ActionValueLoss,
    ConsistencyLoss,
    CounterexampleLoss,
    SynthesisLoss,
    TargetLoss,
)
from torchrl_sspl.objectives.base import LatentBatch
from torchrl_sspl.objectives.counterexample import worst_error
from torchrl_sspl.seeds import spawn
from torchrl_sspl.sets import SAFE, UNSAFE
from torchrl_sspl.trainers.asking import tell_of_others
from torchrl_sspl.trainers.phases import Phase, Workspace, action_grid
from torchrl_sspl.trainers.steady import KeepChanges, SteadyEncoder
from torchrl_sspl.trainers.targets import observed_errors, off_manifold, remembered, successors, targets, uniform
from torchrl_sspl.viability.cloud import (
    reach_times,
    safety_values,
    signed_margin,
)

_VALUE_SCALE = 0.05  # distance of latents in which values of actions are measured
_SEARCH_EVERY = 250  # steps between two searches for counterexamples
_SPARE = 0.004  # barrier value by which counterexamples have to be refuted, for what a proof does not resolve
_WEIGHT, _LEAST_WEIGHT = 4.0, 40.0  # of counterexamples
_NEAR_ZERO = 0.06  # of the targets on a grid, those that a batch has as many of as of all
_POOL = 8192  # counterexamples that are kept
_LOOK_EVERY = 25  # steps between two searches where hardly any are left
_STARTS = 1024  # latents from which they are climbed to
_BESIDE = 0.05  # barrier value up to which these may lie outside the set
_INSIDE = 0.02  # ... up to which what lies outside counts as a counterexample, too
_NEARLY = 0.01  # ... below zero from which on a successor is nearly one
_UNROLLED = 24  # steps through the observer
_NEAR = 0.2  # barrier value up to which further rounds look at transitions of the policy


class Gather(Phase):
    """Encoded transitions: those of the joint training and random actions in the first round, the policy's own afterwards.

    A memory drifts along the paths that a policy takes, not along random ones: behind an observer the first round adds
    episodes of the policy as the joint training leaves it, too. Where the environment knows its sets, further rounds add
    transitions of the exploring policy that start in the set or near it, and of many that start in U those whose pictures the
    present barrier puts lowest: the rim of U is where a set goes wrong first. Elsewhere they add episodes of the exploring
    policy from the environment's own resets.
    Source: paper Algorithm 1 (rollouts join D); deviation: which of them are kept is decided by their pictures.
    """

    name = "gather"

    def __init__(self, number: int = 0) -> None:
        super().__init__(number)
        self.pictures = number == 0

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
                parts.append(_rim_of_unsafe(work, 20 * self.number + MOST_NEAR_DRAWS))
        parts = [work.filtered(part) for part in parts]
        work.latents = {k: torch.cat([p[k] for p in parts]) for k in parts[0]}
        if source.labels is not None and source.labels.tells:
            tell_of_others(work, self.number)
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
        for attempt in range(s.near_draws):
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


class Retry(Phase):
    """Barrier and policy of fresh weights, where no round has passed its checks; else nothing more is done.

    A fit may stay on a plateau, and a fine-tuning may end a little beside what the checks ask for; both hang on the first weights.
    Data and dynamics stay as they are. Source: none.
    """

    name = "retry"

    def run(self, work: Workspace) -> None:
        work.skip = work.skip or work.best is not None
        if work.skip:
            return
        with torch.random.fork_rng():
            torch.manual_seed(spawn(work.seed, "retries", self.number))
            for net in (work.barrier, work.policy):
                for module in net.modules():
                    if hasattr(module, "reset_parameters"):
                        module.reset_parameters()
        work.cache.clear()


class _Training(Phase):
    """Takes ``<name>_steps`` of the configuration; where it refits, half of them in further rounds."""

    refits = True

    def again(self, work: Workspace) -> bool:
        """Whether the networks have learnt what they are to learn in an earlier round."""
        return 0 < self.number < work.config.rounds

    def size(self, work: Workspace) -> int:
        steps = getattr(work.config, f"{self.name}_steps")
        return steps // 2 if self.refits and self.again(work) else steps


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
        loss = ConsistencyLoss(
            work.dynamics, unsafe_weight=s.unsafe_weight, outlier=s.dynamics_outlier or None, worst_coeff=0.2, worst_fraction=0.05
        )

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
        work.teacher_policy = copy.deepcopy(work.policy).requires_grad_(False)


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
        rates = {work.barrier: 2e-3 if self.again(work) else 5e-3, work.policy: 3e-3}
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
        of_unsafe = self._target(work).select_out_keys("loss_unsafe")
        depth = table["barrier_target"][:, 0]
        calm = (depth < 0.5 * depth.min().clamp_max(0.0)).nonzero()[:, 0]  # nearer to the border safety needs the action
        change = ActionChangeLoss(work.dynamics, work.policy, action_scale=work.action_scale)
        # What the sets hold counts more than its share of the data; S may be empty.
        shares = ((unsafe, s.batch // 2), (unsafe[nearest], s.batch // 2), (safe, s.batch // 4))
        pick, acting = work.loop.pick, work.acting

        def step() -> TensorDict:
            drawn = [pick(len(table), s.batch)]
            drawn += [rows[pick(len(rows), n)] for rows, n in shares if len(rows)]
            asked = rim[pick(len(rim), 3 * s.batch // 2)]
            if s.tolerated_error > 0:  # the worst of them
                with torch.no_grad():
                    after = work.dynamics(asked["latent"], acting(asked["latent"]))
                error = worst_error(work.barrier, after, s.tolerated_error)
            else:
                error = asked["residual"][torch.arange(len(asked)), pick(s.residuals, len(asked))]
            asked = asked.exclude("residual").set("residual", error)
            if s.counterexamples:
                asked = self._with_counterexamples(work, asked)
            terms = condition(asked)
            terms.update(target(table[torch.cat(drawn)]))
            if len(work.changes):
                near = table[unsafe[nearest][pick(len(nearest), s.batch // 2)]]
                terms["loss_unsafe"] += of_unsafe(near.set("latent", _as_changed(work, near["latent"])))["loss_unsafe"]
            terms.update(self.more(work, rim["latent"]))
            if s.change_coeff > 0 and len(calm):
                steady = change(table[calm[pick(len(calm), s.batch)]])
                terms["loss_action_change"] = s.change_coeff * steady["loss_action_change"]
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

    They are looked for near the data, in the whole domain and around those found before, anew every hundred steps; and climbed to from
    the most promising of these. Source: none (counterexample-guided synthesis); the paper asks the condition of its samples alone.
    """

    name = "tighten"
    samples, beside, penalty = 60_000, _INSIDE, 0.0  # drawn; barrier value up to which climbs begin, and what lying outside costs them

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
        rows = self._worst_first(work)
        terms = self._loss(TensorDict(latent=rows, batch_size=[len(rows)]))
        return {k: _WEIGHT * v if k.startswith("loss") else v for k, v in terms.items()}

    @staticmethod
    def _worst_first(work: Workspace) -> Tensor:
        """A batch of the counterexamples, the worst more often: a few real ones are not lost among thousands of near ones."""
        known = len(work.counterexamples)
        return work.counterexamples[work.loop.pick(known, work.config.batch).square() // known]

    @torch.no_grad()
    def _search(self, work: Workspace, rim: Tensor) -> Tensor:
        """The worst latents of the set, up to as many as are kept; those that are nearly counterexamples count, too."""
        z = self._drawn(work, rim, self.samples)
        here = work.barrier(z)[:, 0]
        z, here = z[here <= self.beside], here[here <= self.beside]
        if not len(z):
            return z
        after = work.dynamics(z, work.acting(z))
        value = work.barrier(after)[:, 0]
        possible = (value > self._least(work)) & (here <= _INSIDE)
        return self._climbed(work, z, after, possible, value - self.penalty * here.clamp_min(0.0))

    @staticmethod
    def _drawn(work: Workspace, rim: Tensor, samples: int) -> Tensor:
        """Latents near the data, anywhere, and around those that were counterexamples."""
        g, p, old = work.loop.generator, work.latent_dim, work.counterexamples
        near = rim[work.loop.pick(len(rim), samples)] + 0.04 * torch.randn(samples, p, generator=g)
        points = [near, uniform(work, samples, g)]
        if len(old):
            points += [old, old[work.loop.pick(len(old), samples // 2)] + 0.01 * torch.randn(samples // 2, p, generator=g)]
        return within(torch.cat(points), work.direction)

    @staticmethod
    def _least(work: Workspace) -> float:
        """Barrier value after a step below which no error makes a counterexample, or nearly one."""
        return -_NEARLY - _SPARE - work.lipschitz_bound * work.config.tolerated_error

    @staticmethod
    def _worst(work: Workspace, z: Tensor, after: Tensor) -> Tensor:
        """Those of latents with their successors that end highest under the worst error."""
        value = work.barrier(after + worst_error(work.barrier, after, work.config.tolerated_error))[:, 0] + _SPARE
        worst = value.topk(min(_POOL, len(value)))
        return z[worst.indices[worst.values > -_NEARLY]]

    def _climbed(self, work: Workspace, z: Tensor, after: Tensor, possible: Tensor, promise: Tensor) -> Tensor:
        """The worst of those that are possible, and of what is climbed to from those that promise most."""
        top = self._ascend(work, z[promise.topk(min(_STARTS, len(z))).indices])
        return self._worst(work, torch.cat([z[possible], top]), torch.cat([after[possible], work.dynamics(top, work.acting(top))]))

    @staticmethod
    def _ascend(work: Workspace, latent: Tensor, restarts: int = 3, steps: int = 24) -> Tensor:
        """The best latents of the set that are climbed to from ``(n, p)``: samples alone miss narrow peaks, and so does one climb
        with steps that shrink. Each climbs on its own, so that not all end on the same peak."""
        best, highest = latent, torch.full((len(latent),), -math.inf)
        for attempt in range(restarts):
            z = best if attempt == 0 else within(best + 0.005 * torch.randn(best.shape, generator=work.loop.generator), work.direction)
            for k in range(steps):
                with torch.enable_grad():
                    at = z.detach().requires_grad_()
                    here = work.barrier(at)[:, 0]
                    value = work.barrier(work.dynamics(at, work.acting(at).detach()))[:, 0] - 20.0 * here.clamp_min(0.0)
                    (slope,) = torch.autograd.grad(value.sum(), at)
                z = within(z + 0.03 * 0.85**k * slope / slope.norm(dim=1, keepdim=True).clamp_min(1e-9), work.direction)
            value = work.barrier(work.dynamics(z, work.acting(z)))[:, 0].masked_fill(work.barrier(z)[:, 0] > _SPARE, -math.inf)
            better = value > highest
            best, highest = torch.where(better[:, None], z, best), torch.where(better, value, highest)
        return best[highest > -math.inf]


class Settle(Tighten):
    """The smallest change after which no counterexample is found; for targets on a grid, which are nearly kept as they are fitted.

    Of the pictures of U those count that the barrier puts lowest, whatever action the memory holds, of S those that it puts highest.
    Climbs begin beside the set, too: where it ends in a cusp, more samples lie there than in it. Source: none (counterexample-guided
    synthesis).
    """

    samples, beside, penalty = 30_000, _BESIDE, 3.0

    def run(self, work: Workspace) -> None:
        s, pick = work.config, work.loop.pick
        if work.loop.step == 0:
            work.counterexamples = torch.zeros(0, work.latent_dim)
        self._loss = CounterexampleLoss(
            work.dynamics, work.barrier, work.acting, mode="least", depth=_SPARE, dynamics_margin=_SPARE, error=s.tolerated_error,
            worst_coeff=1.0, worst_fraction=0.01,
        )  # fmt: skip
        table, rim = targets(work, self.number)
        unsafe, safe = ((table["region"][:, 0] == code).nonzero()[:, 0] for code in (UNSAFE, SAFE))
        target = self._target(work, safe_coeff=0.0)  # S may reach to the border of what can be kept: hardly any margin is asked there
        of_safe = TargetLoss(work.barrier, work.policy, safety_margin=_SPARE, safe_coeff=_LEAST_WEIGHT).select_out_keys("loss_safe")

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
            if work.loop.step % _LOOK_EVERY == 0:  # those that are known are gone after a few steps, others have come up
                work.counterexamples = self._search(work, rim["latent"])
            asked = [rim["latent"][pick(len(rim), s.batch)]]
            if len(work.counterexamples):
                asked.append(self._worst_first(work))
            latent = torch.cat(asked)
            terms = dict(self._loss(TensorDict(latent=latent, batch_size=[len(latent)])).items())
            terms["loss_counterexample"] = _LEAST_WEIGHT * terms["loss_counterexample"]
            drawn = [table[pick(len(table), s.batch)], worst(unsafe, s.batch // 2, False)]
            terms |= dict(target(torch.cat(drawn)).items())
            if len(safe) and not s.safe_share:
                terms |= dict(of_safe(worst(safe, s.batch // 4, True)).items())
            return terms

        work.loop(self.size(work), self.rates(work), step)


def _as_changed(work: Workspace, latent: Tensor) -> Tensor:
    """Latents ``(n, p)`` moved by what changes of pictures were seen to do."""
    return within(latent + work.changes[work.loop.pick(len(work.changes), len(latent))], work.direction)


def synthesis_phases(config: SynthesisConfig, *, check: Callable[[int], Phase] | None = None) -> list[Phase]:
    """The phases of every round, and of those on the same data that follow where none has passed its checks.

    Args:
        config: gives the number of rounds and the teacher.
        check: ``round -> phase`` that ends every round, such as :class:`CheckRound`; ``None``: nothing is checked.

    Returns the phases in order; leave some out, or put your own between them. Source: paper Algorithm 1.

    Example:
        >>> [phase.name for phase in synthesis_phases(SynthesisConfig())]
        ['gather', 'dynamics', 'teach', 'fit', 'steer', 'tune']
    """
    teach = [TeachPolicy] if config.teacher == "value" else []
    tighten = [Settle if config.grid else Tighten] if config.tighten_steps and (config.grid or config.tolerated_error > 0) else []
    steady = [SteadyEncoder(0), KeepChanges(0)] if config.steady_steps else []
    after = tighten if config.grid else [SteerPolicy, FineTune, *tighten]
    sets: list[Any] = [*teach, FitSets, *after, *([check] if check else [])]
    rounds = [kind(k) for k in range(config.rounds) for kind in (Gather, FitDynamics, *sets)]
    retries = [kind(config.rounds + k) for k in range(config.retries if check else 0) for kind in (Retry, *sets)]
    return [*steady, *rounds, *retries]


def _pieces(continues: Tensor) -> Tensor:
    """Rows ``(n, k)`` of pieces of episodes of at most so many transitions, filled up with -1 behind their end."""
    rows = torch.arange(len(continues))
    begins = torch.where(continues, 0, rows).cummax(0).values
    first = rows[(rows - begins) % _UNROLLED == 0]
    piece = first[:, None] + torch.arange(_UNROLLED)
    ends = torch.cat([first[1:], torch.tensor([len(continues)])])
    return torch.where(piece < ends[:, None], piece, -1)


__all__ = ["FineTune", "FitDynamics", "FitSets", "Gather", "Retry", "Settle", "SteerPolicy", "TeachPolicy", "Tighten", "synthesis_phases"]
