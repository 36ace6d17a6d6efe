"""Training of a safe agent: Algorithm 1 of the paper on two time scales, with exact resume.

The representation comes first. Then encoder and latents stand still, so that the model error and the cover of the
latent space stand still with them, and dynamics, barrier and policy are trained on latents alone, in rounds of
rollouts, refit, synthesis and fine-tuning. Every round ends with checks on held-out data; the largest set that has
passed them is what the training returns.
"""

from __future__ import annotations

import copy
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any

import torch
from tensordict import TensorDict
from torch import Tensor, nn

from torchrl_sspl.data import TransitionStore, collect_random, collect_rollouts
from torchrl_sspl.devices import usable_device
from torchrl_sspl.envs.base import SafetyEnv
from torchrl_sspl.errors import ConfigError
from torchrl_sspl.lipschitz import SandwichBarrier, prove_lipschitz
from torchrl_sspl.modules import FrameEncoder, InverseDynamics, LatentDynamics, Policy, make_rollout_policy
from torchrl_sspl.modules.agent import ENCODERS, Agent
from torchrl_sspl.objectives import SaLaDLoss
from torchrl_sspl.sets import Region
from torchrl_sspl.trainers.config import TrainingConfig
from torchrl_sspl.trainers.encoding import encode_transitions
from torchrl_sspl.trainers.evaluation import encode_states, rollout
from torchrl_sspl.trainers.latents import LatentTraining

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


class SafePolicyTraining(LatentTraining):
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
        # What the parts below and a checkpoint refer to comes before the latter is read.
        self.config, self.make_env = config, make_env
        self.env = make_env([1], config.seed)
        self.device = usable_device(config.device)
        self.best: dict[str, Any] | None = None
        self.checks: list[Check] = []
        sizes: dict[str, Any] = {"latent_dim": config.network.latent_dim, "action_dim": self.env.action_dim}
        limit = self.env.max_action
        with torch.random.fork_rng():
            torch.manual_seed(config.seed)
            self.encoder = self._new_encoder()
            self.warm_dynamics = LatentDynamics(hidden=(128, 128), action_scale=limit, **sizes)
            self.warm_barrier = self._new_barrier()
            self.inverse = InverseDynamics(action_scale=limit, **sizes)
            networks = {
                "encoder": self.encoder,
                "warm_dynamics": self.warm_dynamics,
                "warm_barrier": self.warm_barrier,
                "inverse": self.inverse,
                "dynamics": LatentDynamics(hidden=config.network.dynamics_hidden, action_scale=limit, **sizes),
                "barrier": self._new_barrier(),
                "policy": Policy(hidden=config.network.policy_hidden, action_scale=limit, **sizes),
            }
        super().__init__(config, networks, action_scale=[limit] * self.env.action_dim, resume=resume)
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

    def _new_barrier(self) -> SandwichBarrier:
        net = self.config.network
        return SandwichBarrier(net.latent_dim, tuple(net.barrier_hidden), net.lipschitz_bound)

    # ------------------------------------------------------------------ schedule

    def phases(self) -> list[tuple[str, int]]:
        """Names of the phases in order, with the round that each belongs to."""
        names = ["gather", *self._latent_phases(), "check"]
        return [("represent", 0), *((name, k) for k in range(self.config.synthesis.rounds) for name in names)]

    def run(self) -> TrainingResult:
        """Train, or continue to train, to the end.

        Returns:
            The agent of the best round, with the checks of all.
        """
        self.train_phases()
        return self._result()

    def _size(self, name: str) -> int:
        return self.config.representation.steps if name == "represent" else super()._size(name)

    def _device_of(self, phase: str) -> torch.device | str:
        return self.device if phase == "represent" else super()._device_of(phase)

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

    def _encode_store(self, store: TransitionStore) -> dict[str, Tensor]:
        device = next(self.encoder.parameters()).device
        return encode_transitions(lambda batch: self.encoder.sequence(batch["frames"].to(device)).unbind(1), store)

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

    def _more_state(self) -> dict[str, Any]:
        return {"best": self.best, "checks": [vars(c) for c in self.checks]}

    def _restore_more(self, body: dict[str, Any]) -> None:
        self.best, self.checks = body["best"], [Check(**c) for c in body["checks"]]


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
