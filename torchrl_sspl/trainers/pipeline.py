"""Training of a safe agent: Algorithm 1 of the paper on two time scales, with exact resume.

The representation comes first. Then encoder and latents stand still, so that the model error and the cover of the
latent space stand still with them, and dynamics, barrier and policy are trained on latents alone, in rounds of
rollouts, refit, synthesis and fine-tuning. Every round ends with checks on held-out data; the largest set that has
passed them is what the training returns.
"""

from __future__ import annotations

import copy
import json
import time
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import torch
from tensordict import TensorDict
from torch import Tensor, nn
from torchrl.objectives import SoftUpdate
from tqdm import tqdm

from torchrl_sspl.certification.conditions import closed_loop, find_counterexamples
from torchrl_sspl.data import TransitionStore, collect_random, collect_rollouts
from torchrl_sspl.envs.base import SafetyEnv
from torchrl_sspl.errors import CheckpointError, ConfigError
from torchrl_sspl.lipschitz import SandwichBarrier, prove_lipschitz
from torchrl_sspl.modules import FrameEncoder, InverseDynamics, LatentDynamics, Policy, make_rollout_policy
from torchrl_sspl.modules.agent import ENCODERS, Agent
from torchrl_sspl.objectives import ActionValueLoss, SaLaDLoss, SynthesisLoss, TargetLoss
from torchrl_sspl.objectives.latent_viability import (
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
from torchrl_sspl.sets import SAFE, UNSAFE, Region
from torchrl_sspl.trainers.config import TrainingConfig
from torchrl_sspl.trainers.evaluation import encode_states, rollout
from torchrl_sspl.trainers.loggers import METRICS, log_scalars

CHECKPOINT_FILE = "checkpoint.pt"
TEACHERS = ("clearance", "value")
_ENCODE_CHUNK = 1000
_KNOWN_WITHIN = 0.06  # distance from the data beyond which a way back is not looked for
_VALUE_SCALE = 0.05  # distance of latents in which values of actions are measured
_SEARCH_EVERY = 250  # steps between two searches for counterexamples
_HIGHEST_LEVEL = 0.08  # to which the barrier may be shifted by the held-out checks


@dataclass
class Check:
    """Held-out checks of one round.

    Attributes:
        round: number of the round.
        level: shift of the barrier with which the checks were made; {B <= level} became {B <= 0}.
        unsafe_inside: held-out observations of U inside the set.
        safe_outside: held-out observations of S outside the set.
        left: held-out episodes that left the set.
        touched: held-out episodes that touched U.
        returned: share of held-out episodes from U that ended inside the set.
        size: share of the held-out unlabelled observations inside the set.
        passed: whether the set may be returned.
        reason: why not.
    """

    round: int
    level: float
    unsafe_inside: int
    safe_outside: int
    left: int
    touched: int
    returned: float
    size: float
    passed: bool
    reason: str


@dataclass
class TrainingResult:
    """What a training returns.

    Attributes:
        agent: the agent of the best round.
        checks: the checks of every round.
        stop_reason: why the training ended.
        seconds: wall-clock time of the training, interruptions not counted.
    """

    agent: Agent
    checks: list[Check] = field(default_factory=list)
    stop_reason: str = ""
    seconds: float = 0.0


class SafePolicyTraining:
    """Trains encoder, dynamics, barrier and policy of one environment.

    Args:
        config: everything that determines the run.
        make_env: ``(batch_size: list[int], seed: int) -> SafetyEnv``.
        resume: continue from the checkpoint in ``config.out_dir`` if there is one.

    Raises:
        ConfigError: if the preset has no two-time-scale schedule, or a checkpoint of another configuration is found.
        CheckpointError: if the checkpoint cannot be read.

    Source: paper Algorithm 1; deviations: two time scales, targets from a robust invariant set of the data, condition
    R3 in place of a decrease everywhere (see docs/deviations.md).
    """

    def __init__(
        self, config: TrainingConfig, make_env: Callable[[list[int], int], SafetyEnv], *, resume: bool = True
    ) -> None:
        self.config, self.make_env = config, make_env
        self.out_dir = Path(config.out_dir)
        self.out_dir.mkdir(parents=True, exist_ok=True)
        self.env = make_env([1], config.seed)
        self.device = torch.device(config.device)
        net = config.network
        with torch.random.fork_rng():
            torch.manual_seed(config.seed)
            self.encoder = self._new_encoder()
            self.warm_dynamics = LatentDynamics(net.latent_dim, self.env.action_dim, (128, 128), self.env.max_action)
            self.warm_barrier = self._new_barrier()
            self.inverse = InverseDynamics(net.latent_dim, self.env.action_dim, action_scale=self.env.max_action)
            self.dynamics = LatentDynamics(
                net.latent_dim, self.env.action_dim, net.dynamics_hidden, self.env.max_action
            )
            self.barrier = self._new_barrier()
            self.policy = Policy(net.latent_dim, self.env.action_dim, net.policy_hidden, self.env.max_action)
        self.networks = nn.ModuleDict(
            {
                "encoder": self.encoder,
                "warm_dynamics": self.warm_dynamics,
                "warm_barrier": self.warm_barrier,
                "inverse": self.inverse,
                "dynamics": self.dynamics,
                "barrier": self.barrier,
                "policy": self.policy,
            }
        ).to(self.device)
        self.generator = torch.Generator().manual_seed(config.seed)
        self.latents: dict[str, Tensor] = {}
        self.counterexamples = torch.zeros(0, net.latent_dim)
        self.best: dict[str, Any] | None = None
        self.checks: list[Check] = []
        self.phase, self.step, self.seconds = 0, 0, 0.0
        self._loop_state: dict[str, Any] | None = None
        self._target_round: int | None = None
        self.taught: nn.Module | None = None
        self._target_table: TensorDict
        self._rim: TensorDict
        self._last_checkpoint = time.monotonic()
        self._clock = time.monotonic()
        if resume and (self.out_dir / CHECKPOINT_FILE).is_file():
            self._restore()
        config.save(self.out_dir / "config.json")

    def _new_encoder(self) -> FrameEncoder:
        net = self.config.network
        if net.encoder not in ENCODERS:
            raise ConfigError(f"expected network.encoder to be one of {sorted(ENCODERS)}, received '{net.encoder}'")
        return ENCODERS[net.encoder](**self._encoder_arguments())  # type: ignore[return-value]

    def _encoder_arguments(self) -> dict[str, Any]:
        net = self.config.network
        return {
            "latent_dim": net.latent_dim,
            "image_size": self.env.image_size,
            "pool_to": net.pool_to,
            "velocity_gain": net.velocity_gain,
        }

    logger: Any = None  # of TorchRL; gets the numbers that go to log.jsonl

    def _new_barrier(self) -> SandwichBarrier:
        net = self.config.network
        return SandwichBarrier(net.latent_dim, tuple(net.barrier_hidden), net.lipschitz_bound)

    # ------------------------------------------------------------------ schedule

    def phases(self) -> list[tuple[str, int]]:
        """Names of the phases in order, with the round that each belongs to."""
        s = self.config.synthesis
        if s.teacher not in TEACHERS:
            raise ConfigError(f"expected synthesis.teacher to be one of {', '.join(TEACHERS)}, received '{s.teacher}'")
        names = ["gather", "dynamics", *(["teach"] if s.teacher == "value" else []), "fit", "steer", "tune", "check"]
        return [("represent", 0), *((name, k) for k in range(s.rounds) for name in names)]

    def run(self) -> TrainingResult:
        """Train, or continue to train, to the end.

        Returns:
            The agent of the best round, with the checks of all.
        """
        phases = self.phases()
        self._clock = time.monotonic()
        # One bar over all phases, in units of optimiser steps, so that its estimate of the time left means something.
        sizes = [self._size(name) for name, _ in phases]
        self._bar = tqdm(
            total=sum(sizes),
            initial=sum(sizes[: self.phase]) + self.step,
            disable=not self.config.progress,
            unit="step",
        )
        while self.phase < len(phases):
            name, number = phases[self.phase]
            self._bar.set_description(f"{name} {number}" if name != "represent" else name)
            # Pixels are the work for a GPU; what follows are small networks on latents.
            self.networks.to(self.device if name == "represent" else "cpu")
            getattr(self, f"_phase_{name}")(number)
            self._loop_state = None
            self.phase, self.step = self.phase + 1, 0
            self._checkpoint()
        self._bar.close()
        self.networks.to("cpu")
        return self._result()

    def _size(self, name: str) -> int:
        s = self.config.synthesis
        return {
            "represent": self.config.representation.steps,
            "dynamics": s.dynamics_steps,
            "teach": s.teach_steps,
            "fit": s.fit_steps,
            "steer": s.steer_steps,
            "tune": s.tune_steps,
        }.get(name, 1)

    def _loop(
        self,
        steps: int,
        optimisers: dict[nn.Module, float],
        loss: Callable[[], TensorDict],
        *,
        clip: float | None = None,
        delayed: nn.Module | None = None,
    ) -> None:
        """Optimiser steps of one phase; interrupted at any of them, it continues as if nothing had happened."""
        modules = list(optimisers)
        # theta^-, where the loss keeps it.
        updater = None if delayed is None else SoftUpdate(delayed, tau=self.config.representation.target_tau)
        adam = torch.optim.Adam([{"params": list(m.parameters()), "lr": lr} for m, lr in optimisers.items()])
        cycle = torch.optim.lr_scheduler.OneCycleLR(
            adam, [lr for lr in optimisers.values()], total_steps=max(steps, 2), pct_start=0.1
        )
        parameters = [p for m in modules for p in m.parameters()]
        if self._loop_state is not None:
            adam.load_state_dict(self._loop_state["optimiser"])
            cycle.load_state_dict(self._loop_state["schedule"])
            self.generator.set_state(self._loop_state["generator"])
            torch.set_rng_state(self._loop_state["global_rng"])
            if delayed is not None:
                delayed.load_state_dict(self._loop_state["delayed"])
        else:
            torch.manual_seed(int(torch.randint(2**31, (1,), generator=self.generator)))
        while self.step < steps:
            terms = loss()
            total = sum(value for key, value in terms.items() if key.startswith("loss"))
            for p in parameters:
                p.grad = None
            total.backward()  # type: ignore[union-attr]
            if clip is not None:
                nn.utils.clip_grad_norm_(parameters, clip)
            adam.step()
            self._after_step()
            cycle.step()
            if updater is not None:
                updater.step()
            self.step += 1
            self._bar.update()
            if self.step % 100 == 0 or self.step == steps:
                row = {k: float(v.detach()) for k, v in terms.items()}
                if not all(map(_finite, row.values())):
                    raise ConfigError(
                        f"expected finite losses, received {row} in step {self.step}; lower the learning rate, or resume "
                        "from the last checkpoint with another seed"
                    )
                self._log({"step": self.step, **row})
            if self.step < steps and time.monotonic() - self._last_checkpoint > self.config.checkpoint_seconds:
                self._loop_state = {
                    "optimiser": adam.state_dict(),
                    "schedule": cycle.state_dict(),
                    "generator": self.generator.get_state(),
                    "global_rng": torch.get_rng_state(),
                    "delayed": None if delayed is None else delayed.state_dict(),
                }
                self._checkpoint()

    def _after_step(self) -> None:
        """What follows every step of an optimiser; nothing here."""

    def _pick(self, n: int, size: int) -> Tensor:
        return torch.randint(n, (size,), generator=self.generator)

    # ------------------------------------------------------------------ phases

    def _phase_represent(self, _: int) -> None:
        """Warm start: SaLaD on random-action data, of which every frame is stored once."""
        rep = self.config.representation
        stores = self._labelled_stores()
        fit = getattr(self.encoder, "fit", None)
        if callable(fit) and self.step == 0:
            mixed = stores["any"].get(torch.arange(min(2000, len(stores["any"]))))
            fit(mixed["frames"][:, 1])
        loss = SaLaDLoss(
            self.encoder,
            self.warm_dynamics,
            self.warm_barrier,
            inverse_dynamics=self.inverse,
            consistency=rep.consistency_target,
            safety_margin=rep.safety_margin,
            safe_coeff=rep.label_coeff,
            unsafe_coeff=rep.label_coeff,
            consistency_coeff=rep.consistency_coeff,
            inverse_dynamics_coeff=rep.inverse_coeff,
            variance_coeff=rep.variance_coeff,
            covariance_coeff=rep.variance_coeff,
            saturation_coeff=rep.saturation_coeff,
            saturation_limit=0.905,
        )
        networks = dict.fromkeys((self.encoder, self.warm_dynamics, self.warm_barrier, self.inverse), rep.lr)
        delayed = loss if rep.consistency_target == "target" else None
        self._loop(rep.steps, networks, lambda: loss(self._mixed_batch(stores)), clip=rep.clip_norm, delayed=delayed)

    def _labelled_stores(self) -> dict[str, TransitionStore]:
        """Random-action data of the warm start; a function of the seed alone, so it need not be saved."""
        data, seed = self.config.data, self.config.seed
        return {
            "any": collect_random(
                self._env_for(), round(data.transitions * (1 - data.buffer_share)), seed=seed, steps=data.episode_steps
            ),
            "buffer": collect_random(
                self._env_for(),
                round(data.transitions * data.buffer_share),
                seed=seed + 1,
                steps=data.episode_steps,
                region=self._buffer_region(),
            ),
            "safe": collect_random(self._env_for(), data.safe, seed=seed + 2, steps=1, region=self.env.safe_set),
            "unsafe": collect_random(self._env_for(), data.unsafe, seed=seed + 3, steps=1, region=self.env.unsafe_set),
        }

    def _mixed_batch(self, stores: dict[str, TransitionStore]) -> TensorDict:
        """Two thirds of D, a sixth each of S and U."""
        labelled = self.config.representation.batch // 6
        mixed = self.config.representation.batch - 2 * labelled
        share = {"any": mixed // 2, "buffer": mixed - mixed // 2, "safe": labelled, "unsafe": labelled}
        batch = torch.cat([stores[k].sample(n, self.generator) for k, n in share.items()])
        return batch.to(next(self.encoder.parameters()).device)

    def _phase_gather(self, number: int) -> None:
        """Encoded transitions: random actions in the first round, the policy's own afterwards."""
        s, seed = self.config.synthesis, self.config.seed + 1000 * (number + 1)
        if number == 0:
            half = s.transitions // 2
            parts = [
                self._encoded(half, seed),
                self._encoded(s.transitions - half, seed + 1, region=self._buffer_region()),
                self._encoded(s.transitions // 10, seed + 2, region=self.env.safe_set),
                self._encoded(s.transitions // 2, seed + 3, region=self.env.unsafe_set),
            ]
        else:
            # The rim of U is where a set goes wrong first, and uniform samples of U hardly ever lie there.
            agent, generator = self._agent(0.0), torch.Generator().manual_seed(seed)
            rim = _States(self._hardest_unsafe(agent, s.mined_unsafe, generator))
            parts = [
                self.latents,
                self._near_the_set(s.rollout_transitions, seed),
                self._encoded(s.mined_unsafe, seed + 50, region=rim),
            ]
        self.latents = {k: torch.cat([p[k] for p in parts]) for k in parts[0]}

    def _near_the_set(self, n: int, seed: int) -> dict[str, Tensor]:
        """Transitions of the exploring policy that start in the set or within 0.2 of it."""
        policy = _Exploring(
            make_rollout_policy(self.encoder, self.policy),
            self.config.synthesis.exploration * self.env.max_action,
            torch.Generator().manual_seed(seed),
        )
        found: list[dict[str, Tensor]] = []
        count = 0
        for attempt in range(10):
            store = collect_rollouts(
                self._env_for(), policy, n, seed=seed + attempt, steps=4, region=self._buffer_region()
            )
            part = self._encode_store(store)
            with torch.no_grad():
                near = self.barrier(part["latent"])[:, 0] < 0.2
            found.append({k: v[near] for k, v in part.items()})
            count += int(near.sum())
            if count >= n:
                break
        return {k: torch.cat([f[k] for f in found])[:n] for k in found[0]}

    @torch.no_grad()
    def _hardest_unsafe(self, agent: Agent, n: int, generator: torch.Generator) -> Tensor:
        """States of U with the lowest barrier, found by repeated small moves from the lowest of uniform samples."""
        env = self.env
        spread = env.state_space.sample(2000, generator=generator).std(0) * 0.03
        states = env.unsafe_set.sample(4 * n, generator=generator)
        for _ in range(4):
            value = agent.barrier(encode_states(agent, env, states))[:, 0]
            states = states[value.topk(n // 2, largest=False).indices]
            moved = env.wrap(states + spread * torch.randn(states.shape, generator=generator))
            moved = moved[env.unsafe_set.contains(moved)]
            states = torch.cat([states, moved])
        return states

    def _phase_dynamics(self, number: int) -> None:
        """Dynamics on latents that stand still; off the manifold they lead back to it."""
        s, data = self.config.synthesis, self.latents
        tube, base = self._tube(data["latent"], 1.3 * s.tube_radius, number)
        on, off = 2 * s.batch // 6, s.batch // 6

        def step() -> TensorDict:
            a, c = self._pick(len(data["latent"]), on), self._pick(len(tube), off) if len(tube) else None
            z, index = data["latent"][a], a
            if c is not None:
                z, index = torch.cat([z, tube[c]]), torch.cat([a, base[c]])
            error = (self.dynamics(z, data["action"][index]) - data["next_latent"][index]).square().sum(-1)
            error = torch.where(data["region"][index, 0] == UNSAFE, s.unsafe_weight * error, error)
            return TensorDict(
                loss_consistency=error.mean() + 0.2 * error.topk(max(1, len(error) // 20)).values.mean(),
                dynamics_error_max=error.detach().max().sqrt(),
            )

        self._loop(
            s.dynamics_steps if number == 0 else s.dynamics_steps // 2,
            {self.dynamics: 3e-3 if number == 0 else 2e-3},
            step,
        )

    def _phase_teach(self, number: int) -> None:
        """The policy alone, on the values of its actions; what it then keeps is what the barrier is taught."""
        s, data = self.config.synthesis, self.latents
        g = torch.Generator().manual_seed(self.config.seed + 99_000 + number)
        z, unsafe = data["latent"], data["region"][:, 0] == UNSAFE
        actions = self._action_grid(s.actions)
        _, axes = self._errors(z, g, s.teach_spread)
        successors = self._successors(z, actions)
        value = safety_values(successors, z, signed_margin(z, unsafe), residuals=axes)
        # In U nothing can be kept any more: the soonest way out.
        times = reach_times(successors[unsafe], z[unsafe], z[~unsafe])
        value[unsafe] = -_VALUE_SCALE * times
        table = TensorDict(latent=z, action_value=value, batch_size=[len(z)])
        loss = ActionValueLoss(
            self.policy, action_scale=self.env.max_action, scale=_VALUE_SCALE, worst_coeff=0.3, worst_fraction=0.05
        )
        steps = s.teach_steps if number == 0 else s.teach_steps // 2
        self._loop(steps, {self.policy: 3e-3}, lambda: loss(table[self._pick(len(table), s.batch)]))
        self.taught = copy.deepcopy(self.policy).requires_grad_(False)

    def _phase_fit(self, number: int) -> None:
        """Barrier and policy onto the robust invariant set of the encoded data."""
        s = self.config.synthesis
        table, _ = self._targets(number)
        loss = TargetLoss(
            self.barrier, self.policy, action_scale=self.env.max_action, scale=0.1, worst_coeff=0.3, worst_fraction=0.05
        )
        first = number == 0
        self._loop(
            s.fit_steps if first else s.fit_steps // 2,
            {self.barrier: 5e-3 if first else 2e-3, self.policy: 3e-3},
            lambda: loss(table[self._pick(len(table), s.batch)]),
        )

    def _phase_steer(self, number: int) -> None:
        """The policy alone, on the condition with twice the margin."""
        self._condition_phase(
            number, self.config.synthesis.steer_steps, {self.policy: 3e-3}, 2 * self.config.synthesis.margin
        )

    def _phase_tune(self, number: int) -> None:
        """Barrier and policy together, on the condition, the labels and the targets."""
        s = self.config.synthesis
        self._condition_phase(number, s.tune_steps, {self.barrier: s.lr, self.policy: s.lr}, s.margin)

    def _condition_phase(self, number: int, steps: int, networks: dict[nn.Module, float], margin: float) -> None:
        s = self.config.synthesis
        table, rim = self._targets(number)
        unsafe = (table["region"][:, 0] == UNSAFE).nonzero()[:, 0]
        # Half of the rows of U come from its rim, the sixth that lies nearest to the set.
        nearest = table["barrier_target"][unsafe, 0].argsort()[: max(1, len(unsafe) // 6)]
        rim_of_unsafe = unsafe[nearest]
        safe = (table["region"][:, 0] == SAFE).nonzero()[:, 0]
        table = table.clone(False)
        outside_weight = table["action_weight"] * torch.where(table["inside"], 0.1, 1.0)
        table["action_weight"] = outside_weight
        synthesis = SynthesisLoss(
            None,
            self.dynamics,
            self.barrier,
            self.policy,
            mode="R3",
            dynamics_margin=margin,
            band=s.band,
            worst_coeff=1.0,
            worst_fraction=0.02,
            off_manifold_coeff=1.0,
        )
        target = TargetLoss(
            self.barrier,
            self.policy,
            action_scale=self.env.max_action,
            outside_cap=s.band,
            policy_coeff=s.recovery_coeff,
            safety_margin=s.unsafe_margin,
            inside_coeff=2.0,
            unsafe_coeff=10.0,
            safe_coeff=1.0,
            worst_coeff=1.0,
            worst_fraction=0.02,
        )

        def step() -> TensorDict:
            rows = torch.cat(
                [
                    self._pick(len(table), s.batch),
                    unsafe[self._pick(len(unsafe), s.batch // 2)],
                    rim_of_unsafe[self._pick(len(rim_of_unsafe), s.batch // 2)],
                    safe[self._pick(len(safe), s.batch // 4)],
                ]
            )
            asked = rim[self._pick(len(rim), 3 * s.batch // 2)]
            error = asked["residual"][torch.arange(len(asked)), self._pick(s.residuals, len(asked))]
            asked = asked.exclude("residual").set("residual", error)
            if s.counterexamples:
                asked = self._with_counterexamples(asked)
            terms = synthesis(asked)
            terms.update(target(table[rows]))
            return terms

        self._loop(steps, networks, step)

    def _with_counterexamples(self, asked: TensorDict) -> TensorDict:
        """Adds latents of the whole domain at which the condition fails; they are searched for again and again."""
        s, net = self.config.synthesis, self.config.network
        if self.step % _SEARCH_EVERY == 0:
            system = closed_loop(
                self.barrier,
                self.dynamics,
                self.policy,
                latent_dim=net.latent_dim,
                lipschitz_bound=net.lipschitz_bound,
            )
            found = find_counterexamples(system, s.counterexamples, margin=s.margin, generator=self.generator)
            known = found if self.step == 0 else torch.cat([found, self.counterexamples])
            self.counterexamples = known[: 8 * s.counterexamples]
        if not len(self.counterexamples):
            return asked
        latent = self.counterexamples[self._pick(len(self.counterexamples), len(asked) // 4)]
        hard = TensorDict(latent=latent, residual=torch.zeros_like(latent), batch_size=[len(latent)])
        return torch.cat([asked, hard])

    @torch.no_grad()
    def _phase_check(self, number: int) -> None:
        """Held-out checks; the level is moved to the largest set that passes them."""
        s, seed = self.config.synthesis, self.config.seed + 500_000 + 1000 * number
        generator = torch.Generator().manual_seed(seed)
        agent = self._agent(0.0)
        env, n = self.env, s.check_episodes
        hardest = self._hardest_unsafe(agent, 2 * n, generator)
        unsafe_states = torch.cat([env.sample_states(2 * n, generator, region=env.unsafe_set), hardest])
        unsafe = agent.barrier(encode_states(agent, env, unsafe_states))[:, 0]
        safe = agent.barrier(encode_states(agent, env, env.sample_states(n, generator, region=env.safe_set)))[:, 0]
        states = env.sample_states(3 * n, generator, region=self._buffer_region())
        value = agent.barrier(encode_states(agent, env, states))[:, 0]
        start = states[value <= _HIGHEST_LEVEL][:n]
        if not len(start):
            self._record(number, agent, Check(number, 0.0, 0, 0, 0, 0, 0.0, 0.0, False, "the set is empty"))
            return
        episodes = rollout(agent, env, start, s.check_horizon)
        touches = env.unsafe_set.contains(episodes.states)
        after = episodes.barrier[1:]
        late = touches.flip(0).cumsum(0).flip(0) > 0
        back = rollout(agent, env, env.sample_states(n // 4, generator, region=env.unsafe_set), 2 * s.check_horizon)

        def check(level: float) -> Check:
            bad = int((unsafe <= level + s.guard).sum())
            out = int((safe > level).sum())
            inside = episodes.barrier[0] <= level
            left = int((inside & (after > level).any(0)).sum())
            touched = int(((episodes.barrier <= level) & late).any(0).sum())
            returned = float(((back.barrier[-1] <= level) & ~env.unsafe_set.contains(back.states[-1])).float().mean())
            size = float((value <= level).float().mean())
            tolerated = s.leave_share * int(inside.sum())
            counts = (("unsafe inside", bad, 0), ("safe outside", out, 0), ("left", left, tolerated), ("touched U", touched, 0))
            faults = [f"{name} {found}" for name, found, most in counts if found > most]
            return Check(
                number, level, bad, out, left, touched, returned, size, not faults and size > 0, ", ".join(faults)
            )

        levels = torch.linspace(-0.2, _HIGHEST_LEVEL, 57).flip(0).tolist()
        chosen = next((c for level in levels if (c := check(level)).passed), check(0.0))
        self._record(number, agent, chosen)

    def _record(self, number: int, agent: Agent, check: Check) -> None:
        self.checks.append(check)
        self._log({"step": number, **{k: v for k, v in vars(check).items() if not isinstance(v, str)}})
        # Of the sets that passed, one into which starts in U return counts first, then the largest.
        rank = [check.returned >= self.config.synthesis.return_share, check.size]
        if check.passed and (self.best is None or rank >= self.best["rank"]):
            state = {k: v.clone() for k, v in agent.state_dict().items()}
            state[f"barrier.{len(agent.barrier) - 1}.bias"] -= check.level  # type: ignore[arg-type]
            witness = [m.tolist() for m in self.barrier.multipliers()]
            self.best = {"rank": rank, "round": number, "agent": state, "multipliers": witness}

    # ------------------------------------------------------------------ targets

    def _tube(self, latent: Tensor, radius: float, salt: int) -> tuple[Tensor, Tensor]:
        """Latents moved off the data manifold along its normals, and the rows that they came from."""
        g = torch.Generator().manual_seed(self.config.seed + 77_000 + salt)
        cloud = self._cloud(g)
        reference = cloud[:20000]
        normal = normal_projectors(latent, reference)
        direction = (normal @ torch.randn(*latent.shape, 1, generator=g))[..., 0]
        length = direction.norm(dim=-1, keepdim=True)
        moved = radius * torch.rand(len(latent), 1, generator=g)
        points = (latent + moved * direction / length.clamp_min(1e-6)).clamp(-1, 1)
        # Where another sheet of the manifold is nearer than the one it came from, a point says nothing.
        kept = (length[:, 0] > 1e-3) & (nearest_distance(points, cloud) > 0.85 * moved[:, 0])
        rows = kept.nonzero()[:, 0]
        return points[rows], rows

    def _cloud(self, generator: torch.Generator) -> Tensor:
        cloud = torch.cat([self.latents["latent"], self.latents["next_latent"]])
        return cloud[torch.randperm(len(cloud), generator=generator)[:80000]]

    def _targets(self, number: int) -> tuple[TensorDict, TensorDict]:
        """Latents with the targets of barrier and policy, and the latents on which the condition is asked."""
        if self._target_round == number:
            return self._target_table, self._rim
        s, data = self.config.synthesis, self.latents
        g = torch.Generator().manual_seed(self.config.seed + 88_000 + number)
        z, unsafe = data["latent"], data["region"][:, 0] == UNSAFE
        zc = z[~unsafe]
        near, axes = self._errors(zc, g, s.residual_spread)
        stray = torch.rand(60000, z.shape[1], generator=g) * 2 - 1
        tube, _ = self._tube(z, 2 * s.tube_radius, 1000 + number)
        rim, rows = self._tube(zc, 1.2 * s.tube_radius, 2000 + number)
        queries = torch.cat([z, data["next_latent"], tube, stray])
        if s.teacher == "value":
            target, member, best, weight = self._value_targets(queries, axes)
        else:
            target, member, best, weight = self._clearance_targets(queries, stray, axes, g)
        rest = len(queries) - len(z)
        self._target_table = TensorDict(
            latent=queries,
            barrier_target=target[:, None],
            inside=member[:, None],
            action_target=torch.cat([best, torch.zeros(rest, best.shape[1])]),
            action_weight=torch.cat([weight, torch.zeros(rest)])[:, None],
            region=torch.cat([data["region"], torch.zeros(rest, 1, dtype=torch.int64)]),
            batch_size=[len(queries)],
        )
        self._rim = TensorDict(
            latent=torch.cat([zc, rim]), residual=torch.cat([near, near[rows]]), batch_size=[len(zc) + len(rim)]
        )
        self._target_round = number
        return self._target_table, self._rim

    def _clearance_targets(
        self, queries: Tensor, stray: Tensor, errors: Tensor, generator: torch.Generator
    ) -> tuple[Tensor, ...]:
        """Signed distance to the robust invariant set; actions that keep the largest clearance, or lead back soonest."""
        s, data = self.config.synthesis, self.latents
        z, unsafe = data["latent"], data["region"][:, 0] == UNSAFE
        zc, actions = z[~unsafe], self._action_grid(s.actions)
        found = robust_invariant_set(self._successors(zc, actions), zc, z[unsafe], residuals=errors)
        kept = found.inside
        if not bool(kept.any()):
            # Nothing can be kept under these errors: go on with what can be kept longest, and let the held-out
            # checks say what it is worth.
            kept = found.removed == found.removed.max()
        inside = torch.zeros(len(z), dtype=torch.bool)
        inside[(~unsafe).nonzero()[:, 0]] = kept
        far = nearest_distance(stray, self._cloud(generator)) > s.tube_radius
        target, member = barrier_targets(
            queries,
            z[inside],
            torch.cat([z[~inside], stray[far]]),
            tube_radius=s.tube_radius,
            lipschitz_bound=self.config.network.lipschitz_bound,
        )
        best = torch.zeros(len(z), self.env.action_dim)
        best[inside] = torch.softmax(found.clearance[kept] / 0.01, 1) @ actions
        outer = (~inside).nonzero()[:, 0]
        times = reach_times(self._successors(z[outer], actions), z[outer], z[inside], known_within=_KNOWN_WITHIN)
        best[outer] = torch.softmax(-times / 0.1, 1) @ actions
        weight = torch.ones(len(z))
        weight[outer] = (times.min(1).values < 100).float()
        self._log({"step": 0, "inside_of_allowed": float(found.inside.float().mean()), "sweeps": found.iterations})
        return target, member, best, weight

    @torch.no_grad()
    def _value_targets(self, queries: Tensor, errors: Tensor) -> tuple[Tensor, ...]:
        """Minus the margin that the taught policy keeps, and the taught policy itself."""
        s, data = self.config.synthesis, self.latents
        assert self.taught is not None
        z, unsafe = data["latent"], data["region"][:, 0] == UNSAFE
        action = self.taught(z)
        # What looks unsafe ends there, whatever follows: no errors are needed for it.
        around = torch.zeros(len(z), *errors.shape[1:])
        around[~unsafe] = errors
        margin = signed_margin(z, unsafe)
        value = safety_values(self.dynamics(z, action)[:, None], z, margin, residuals=around)[:, 0].minimum(margin)
        target = value_targets(
            queries,
            z,
            value,
            tube_radius=s.tube_radius,
            lipschitz_bound=self.config.network.lipschitz_bound,
        )
        self._log({"step": 0, "inside_of_allowed": float((value[~unsafe] > 0).float().mean())})
        return target, target <= 0, action, torch.ones(len(z))

    def _errors(self, latent: Tensor, generator: torch.Generator, spread: float) -> tuple[Tensor, Tensor]:
        """Errors of the dynamics observed near latents: a sample of them, and their principal axis."""
        data = self.latents
        z = data["latent"]
        with torch.no_grad():
            residual = data["next_latent"] - self.dynamics(z, data["action"])
        sample = torch.randperm(len(z), generator=generator)[:30000]
        return nearby_residuals(latent, z[sample], residual[sample], count=self.config.synthesis.residuals, spread=spread)

    def _action_grid(self, per_dimension: int) -> Tensor:
        axis = torch.linspace(-self.env.max_action, self.env.max_action, per_dimension)
        return torch.cartesian_prod(*[axis] * self.env.action_dim).reshape(-1, self.env.action_dim)

    @torch.no_grad()
    def _successors(self, latent: Tensor, actions: Tensor) -> Tensor:
        k = len(actions)
        parts = [
            self.dynamics(part.repeat_interleave(k, 0), actions.repeat(len(part), 1)).reshape(len(part), k, -1)
            for part in latent.split(4096)
        ]
        return torch.cat(parts)

    # ------------------------------------------------------------------ data

    def _buffer_region(self):
        """The states that carry no "unsafe" label."""
        return self.env.state_space - self.env.unsafe_set

    def _env_for(self) -> SafetyEnv:
        return self.make_env([256], 0)

    def _encoded(self, n: int, seed: int, region=None) -> dict[str, Tensor]:
        steps = self.config.data.episode_steps
        store = collect_random(self._env_for(), n, seed=seed, steps=steps, region=region)
        return self._encode_store(store)

    @torch.no_grad()
    def _encode_store(self, store) -> dict[str, Tensor]:
        parts = []
        for index in torch.arange(len(store)).split(_ENCODE_CHUNK):
            batch = store.get(index)
            latent = self.encoder.sequence(batch["frames"])
            parts.append((latent[:, 0], batch["action"], latent[:, 1], batch["region"]))
        names = ("latent", "action", "next_latent", "region")
        return {k: torch.cat(v) for k, v in zip(names, zip(*parts, strict=True), strict=True)}

    # ------------------------------------------------------------------ agent

    def _agent(self, level: float) -> Agent:
        """A frozen copy of the present networks, the barrier collapsed to a plain network."""
        net = self.config.network
        barrier = self.barrier.collapse()
        with torch.no_grad():
            barrier[-1].bias.sub_(level)  # type: ignore[operator, union-attr]
        return Agent(
            copy.deepcopy(self.encoder),
            copy.deepcopy(self.dynamics),
            barrier,
            copy.deepcopy(self.policy),
            net.lipschitz_bound,
            self._description(),
        )

    def _description(self) -> dict[str, Any]:
        net, env = self.config.network, self.env
        sizes = {"latent_dim": net.latent_dim, "action_dim": env.action_dim, "action_scale": env.max_action}
        return {
            "networks": {
                "encoder": {"class": net.encoder, "arguments": self._encoder_arguments()},
                "dynamics": {"class": "LatentDynamics", "arguments": {**sizes, "hidden": net.dynamics_hidden}},
                "policy": {"class": "Policy", "arguments": {**sizes, "hidden": net.policy_hidden}},
                "barrier": {"latent_dim": net.latent_dim, "hidden": net.barrier_hidden},
            },
            "training": self.config.to_dict(),
            "environment": type(env).__name__,
        }

    def _result(self) -> TrainingResult:
        agent = self._agent(0.0)
        witness = [m.tolist() for m in self.barrier.multipliers()]
        if self.best is not None:
            agent.load_state_dict(self.best["agent"])
            witness = self.best["multipliers"]
            reason = f"round {self.best['round']} has the largest set that passed the held-out checks"
        else:
            reason = "no round passed the held-out checks: " + "; ".join(
                f"round {c.round}: {c.reason}" for c in self.checks
            )
        bound = self.config.network.lipschitz_bound
        proof = prove_lipschitz(agent.barrier, bound, multipliers=[torch.tensor(m) for m in witness])
        agent.description["lipschitz"] = {"proved": proof.proved, "reason": proof.reason, "multipliers": witness}
        agent.description["stop_reason"] = reason
        agent.save(self.out_dir / "agent")
        return TrainingResult(agent, self.checks, reason, self.seconds)

    # ------------------------------------------------------------------ disk

    def _log(self, row: dict[str, Any]) -> None:
        """Append a line to ``log.jsonl``."""
        phases = self.phases()
        name, number = phases[min(self.phase, len(phases) - 1)]
        with (self.out_dir / "log.jsonl").open("a") as file:
            file.write(json.dumps({"phase": name, "round": number, **row}) + "\n")
        done = sum(self._size(phase) for phase, _ in phases[: self.phase]) + self.step
        log_scalars(self.logger, {k: v for k, v in row.items() if k in METRICS}, done)

    def _checkpoint(self) -> None:
        """Write the state of the training; the old one stays until the new one is complete."""
        now = time.monotonic()
        self.seconds += now - self._clock
        self._clock = self._last_checkpoint = now
        body = {
            "config": json.dumps(self._identity(), sort_keys=True),
            "phase": self.phase,
            "step": self.step,
            "seconds": self.seconds,
            "networks": self.networks.state_dict(),
            "latents": self.latents,
            "counterexamples": self.counterexamples,
            "taught": None if self.taught is None else self.taught.state_dict(),
            "best": self.best,
            "checks": [vars(c) for c in self.checks],
            "generator": self.generator.get_state(),
            "loop": self._loop_state,
        }
        path = self.out_dir / CHECKPOINT_FILE
        torch.save(body, path.with_suffix(".tmp"))
        path.with_suffix(".tmp").replace(path)

    def _identity(self) -> dict[str, Any]:
        """What must not change between a checkpoint and its continuation."""
        values = self.config.to_dict()
        for key in ("out_dir", "progress", "checkpoint_seconds", "evaluation", "device"):
            values.pop(key)
        return values

    def _restore(self) -> None:
        path = self.out_dir / CHECKPOINT_FILE
        try:
            body = torch.load(path, weights_only=True)
        except Exception as error:
            raise CheckpointError(
                f"expected a readable checkpoint at '{path}', received {type(error).__name__}; delete it to start again"
            ) from error
        if body["config"] != json.dumps(self._identity(), sort_keys=True):
            raise ConfigError(
                f"expected the configuration of the run in '{self.out_dir}', received another one; use another out_dir, or "
                "delete the folder to start again"
            )
        self.networks.load_state_dict(body["networks"])
        self.latents, self.best = body["latents"], body["best"]
        self.counterexamples = body["counterexamples"]
        if body["taught"] is not None:
            self.taught = copy.deepcopy(self.policy).requires_grad_(False)
            self.taught.load_state_dict(body["taught"])
        self.checks = [Check(**c) for c in body["checks"]]
        self.generator.set_state(body["generator"])
        self.phase, self.step, self.seconds = body["phase"], body["step"], body["seconds"]
        self._loop_state = body["loop"]


class _States(Region):
    """A finite set of states as a region from which episodes can start."""

    def __init__(self, states: Tensor) -> None:
        self.states, self.dim = states, states.shape[1]

    def sample(self, n: int, generator: torch.Generator | None = None, device: Any = None) -> Tensor:
        return self.states[torch.randint(len(self.states), (n,), generator=generator)].to(device)


class _Exploring:
    """Rollout policy with Gaussian noise on its actions; the environment clamps them."""

    def __init__(self, policy: nn.Module, scale: float, generator: torch.Generator) -> None:
        self.policy, self.scale, self.generator = policy, scale, generator

    @torch.no_grad()
    def __call__(self, tensordict: TensorDict) -> TensorDict:
        action = self.policy(tensordict.select("pixels"))["action"]
        noise = self.scale * torch.randn(action.shape, generator=self.generator)
        return tensordict.set("action", action + noise)


def _finite(value: float) -> bool:
    return value == value and abs(value) != float("inf")
