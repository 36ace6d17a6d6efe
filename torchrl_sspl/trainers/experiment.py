"""One experiment on TorchRL's trainer: any environment with pixels and labels, from configuration to report."""

from __future__ import annotations

import copy
import json
import math
import time
from collections.abc import Callable
from dataclasses import dataclass, field, fields, replace
from functools import partial
from pathlib import Path
from typing import Any

import torch
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModuleBase
from torch import Tensor, nn
from torchrl.envs import EnvBase
from torchrl.objectives import SoftUpdate
from torchrl.trainers import LRSchedulerHook
from tqdm import tqdm

from torchrl_sspl.certification.branch_and_bound import Budget
from torchrl_sspl.certification.certificate import Certificate
from torchrl_sspl.data import TransitionStore
from torchrl_sspl.data.collect import make_collector
from torchrl_sspl.devices import usable_device
from torchrl_sspl.envs.base import SafetyEnv
from torchrl_sspl.errors import CheckpointError, ConfigError, EmptyRegionError, MissingDependencyError
from torchrl_sspl.lipschitz import SandwichBarrier, prove_lipschitz
from torchrl_sspl.modules import FrameEncoder, LatentDynamics, Policy, make_rollout_policy
from torchrl_sspl.modules.agent import Agent
from torchrl_sspl.objectives import SSPLLoss
from torchrl_sspl.sets import UNLABELLED, UNSAFE
from torchrl_sspl.trainers.certify import CERTIFICATE_FILE, certify, certify_on_episodes
from torchrl_sspl.trainers.config import LatentConfig, SynthesisConfig, TrainingConfig
from torchrl_sspl.trainers.description import describe, differences
from torchrl_sspl.trainers.encoding import encode_transitions
from torchrl_sspl.trainers.episodes import evaluate_episodes, logged, random_actions, run_episodes, separating_level
from torchrl_sspl.trainers.evaluation import Evaluation
from torchrl_sspl.trainers.experiment_config import EnvFactory, ExperimentConfig, resolve
from torchrl_sspl.trainers.guidance import advice, check_encoder, check_factory, make_encoder
from torchrl_sspl.trainers.hooks import RestartHook
from torchrl_sspl.trainers.latents import LatentTraining
from torchrl_sspl.trainers.loggers import close_logger, log_figure, log_scalars, log_video, make_logger
from torchrl_sspl.trainers.torchrl_trainer import SSPLTrainer

MakeEnv = Callable[..., EnvBase]
SUMMARY = (
    ("unsafe_called_safe", "episodes with an observation of U at B <= 0"),
    ("safe_called_unsafe", "episodes with an observation of S at B > 0"),
    ("starts_inside", "resets with B <= 0"),
    ("touch_unsafe", "episodes from B <= 0 that touch U, under the policy"),
    ("leave", "episodes from B <= 0 that leave it, under the policy"),
    ("policy_touch_unsafe", "episodes that touch U, under the policy, wherever they start"),
    ("random_touch_unsafe", "episodes that touch U, under random actions"),
)


class ExploringPolicy(TensorDictModuleBase):
    """Rollout policy that explores: noise on its actions, and random actions in some of the environments.

    Whole episodes are random or follow the policy: what the policy leads to, such as standing still, is not seen when
    every other action is random.

    Args:
        policy: pixels -> ``"action"``.
        low, high: bounds of the action ``(action_dim,)``.
        exploration: standard deviation of the noise, as a share of the half range.
        random_share: share of the environments with uniformly random actions; of a single one, share of the steps.

    Source: none.
    """

    low: torch.Tensor
    high: torch.Tensor

    def __init__(
        self, policy: nn.Module, low: torch.Tensor, high: torch.Tensor, exploration: float, random_share: float
    ) -> None:
        super().__init__()
        self.in_keys, self.out_keys = ["pixels"], ["action"]
        self.policy, self.exploration, self.random_share = policy, exploration, random_share
        self.register_buffer("low", low.clone())
        self.register_buffer("high", high.clone())

    @torch.no_grad()
    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Write ``"action"`` ``(*batch, action_dim)``."""
        action = self.policy(tensordict.select("pixels"))["action"]
        half = (self.high - self.low) / 2
        noisy = action + self.exploration * half * torch.randn_like(action)
        uniform = self.low + (self.high - self.low) * torch.rand_like(action)
        n = action.shape[0] if action.ndim > 1 else 1
        if n > 1:
            swap = (torch.arange(n, device=action.device) < round(self.random_share * n)).reshape(-1, *[1] * (action.ndim - 1))
        else:
            swap = torch.rand_like(action[..., :1]) < self.random_share
        return tensordict.set("action", torch.where(swap, uniform, noisy.clamp(self.low, self.high)))


class TrainingStarts:
    """Environments for training: where the sets are known, half of the episodes start in S.

    Args:
        make_env: ``(batch_size=[n], seed=...) -> environment``.
        batch_size: ``[n]``.

    Source: none.
    """

    def __init__(self, make_env: MakeEnv, batch_size: list[int]) -> None:
        self.make_env, self.batch_size = make_env, batch_size

    def __call__(self, seed: int | None = None) -> EnvBase:
        """An environment; others than those of this library start as they always do."""
        env = self.make_env(batch_size=self.batch_size, seed=seed)
        if isinstance(env, SafetyEnv):
            env.initial_set = env.safe_set | env.initial_set
        return env


@dataclass
class ExperimentOutcome:
    """What an experiment produced.

    Attributes:
        directory: where everything lies.
        agent: the frozen agent.
        evaluation: measurements on fresh episodes.
        certificate: what is proved and what was measured; also in ``agent/certificate.json``.
        seconds: wall-clock time of the training, since it was resumed if it was.
        report: the page, or None where matplotlib is missing.
        warnings: what went wrong, and what to do about it.
        advice: what to try where it is not certified.
    """

    directory: Path
    agent: Agent
    evaluation: Evaluation
    certificate: Certificate
    seconds: float
    report: Path | None
    warnings: list[str] = field(default_factory=list)
    advice: list[str] = field(default_factory=list)

    def measured(self) -> list[str]:
        """The main measurements as sentences, with counts and exact 95 % bounds."""
        lines = []
        for name, label in SUMMARY:
            m = self.evaluation.measurements[name]
            value = "not measured" if m.value is None else f"{m.value:.2%} ({m.events} of {m.n})"
            bounds = "" if m.lower is None or m.upper is None else f", 95 % bounds {m.lower:.2%} to {m.upper:.2%}"
            lines.append(f"{label}: {value}{bounds}")
        return lines

    def summary(self) -> str:
        """The main measurements, the certificate's verdicts and warnings as text."""
        lines = self.measured()
        lines += [f"certificate, {layer.name} layer: {layer.verdict}" for layer in self.certificate.layers.values()]
        lines.append(f"training: {self.seconds:.0f} s")
        lines += [f"warning: {text}" for text in self.warnings] + [f"to try: {text}" for text in self.advice]
        return "\n".join(lines)


class Experiment:
    """Environment, networks, loss, collector, store, trainer and logger of a configuration.

    Args:
        config: everything that determines the run.
        make_env: ``(batch_size=[n], seed=...) -> environment`` with keys ``"pixels"`` and ``"region"``; by default
            what ``config.env`` describes.
        encoder: ``(latent_dim) -> module`` from pixels ``(*batch, 6, H, W)`` uint8 to latents in [-1, 1]; by default
            what ``config.network`` describes.
        title: title of the report.

    Raises:
        ConfigError: if values of the configuration do not go together, or the environment lacks labels.

    Source: paper, Algorithm 1, on TorchRL's trainer.
    """

    def __init__(
        self,
        config: ExperimentConfig,
        make_env: MakeEnv | None = None,
        *,
        encoder: Callable[[int], nn.Module] | None = None,
        title: str = "Safe policy from pixels",
    ) -> None:
        config.check()
        if make_env is not None:
            check_factory(make_env)
            config = replace(config, env=describe(make_env))
        self.config, self.title = config, title
        self.make_env = EnvFactory(config.env) if make_env is None else make_env
        self.directory = Path(config.out_dir)
        self.directory.mkdir(parents=True, exist_ok=True)
        self.device = usable_device(config.device)
        try:
            env = self.make_env(batch_size=[1], seed=config.seed)
        except TypeError as error:
            raise ConfigError(
                f"make_env: expected a function (batch_size=[n], seed=...) -> environment, such as partial(GymnasiumPixels, "
                f"make, safe=..., unsafe=...), received one that raises TypeError: {error}"
            ) from error
        missing = {"pixels", "region"} - set(env.observation_spec.keys())
        if missing:
            raise ConfigError(f"expected an environment with the keys pixels and region, found no {sorted(missing)}")
        space = env.action_spec_unbatched.space
        self._low, self._high = space.low.cpu().float(), space.high.cpu().float()
        pixels = env.reset()["pixels"].cpu()
        env.close()
        torch.manual_seed(config.seed)
        scale = (self._high - self._low) / 2
        self._given = encoder or (resolve(config.network.encoder) if config.network.encoder else None)
        self._sizes = {"latent_dim": config.network.latent_dim, "action_dim": len(scale), "action_scale": scale.tolist()}
        self.encoder, self.dynamics, self.barrier, self.policy = self._networks()
        if self._given is not None:
            check_encoder(self.encoder, pixels.to(self.device), config.network.latent_dim)
        self.description = self._describe()
        self.loss = self._loss(self.encoder, self.dynamics, self.barrier, self.policy)
        self.logger = make_logger(
            config.logger.kind, config.logger.kind, self.directory, **_project(config.logger)
        )
        self.trainer = self._make_trainer()
        self.warnings: list[str] = []
        self.synthesis_dir: Path | None = None  # log and checkpoint of what follows the joint training
        self.seconds, self.resumed = 0.0, False

    def _networks(self) -> tuple[nn.Module, LatentDynamics, SandwichBarrier, Policy]:
        net = self.config.network
        if self._given is None:
            encoder: nn.Module = FrameEncoder(net.latent_dim, pool_to=net.pool_to, velocity_gain=net.velocity_gain)
        else:
            encoder = make_encoder(self._given, net.latent_dim)
        dynamics = LatentDynamics(hidden=net.dynamics_hidden, **self._sizes)
        policy = Policy(hidden=net.policy_hidden, **self._sizes)
        barrier = SandwichBarrier(net.latent_dim, tuple(net.barrier_hidden), net.lipschitz_bound)
        return encoder.to(self.device), dynamics.to(self.device), barrier.to(self.device), policy.to(self.device)

    def _describe(self) -> dict[str, Any]:
        """What an agent's file says: which networks to build before their weights are loaded."""
        net, name = self.config.network, getattr(self._given, "__name__", type(self.encoder).__name__)
        arguments: dict[str, Any] = {"latent_dim": net.latent_dim}
        if self._given is None:
            arguments |= {"pool_to": net.pool_to, "velocity_gain": net.velocity_gain}
        return {
            "networks": {
                "encoder": {"class": name, "arguments": arguments},
                "dynamics": {"class": "LatentDynamics", "arguments": {**self._sizes, "hidden": list(net.dynamics_hidden)}},
                "policy": {"class": "Policy", "arguments": {**self._sizes, "hidden": list(net.policy_hidden)}},
                "barrier": {"latent_dim": net.latent_dim, "hidden": list(net.barrier_hidden)},
            },
            "experiment": self.config.to_dict(),
        }

    def _loss(self, *networks: nn.Module) -> SSPLLoss:
        options = {k: v for k, v in vars(self.config.loss).items() if v is not None}
        return SSPLLoss(*networks, **options).to(self.device)

    def _fresh(self, attempt: int) -> SSPLLoss:
        with torch.random.fork_rng():
            torch.manual_seed(self.config.seed + 1000 * attempt)
            return self._loss(*self._networks())

    def _make_trainer(self) -> SSPLTrainer:
        config, t, c = self.config, self.config.trainer, self.config.collector
        if t.compile:
            self.loss.compile()
        assert self.loss.encoder is not None
        rollout_policy = ExploringPolicy(
            make_rollout_policy(self.loss.encoder, self.loss.actor_network),
            self._low, self._high, c.exploration, c.random_share,
        ).to(self.device)  # fmt: skip
        collector = make_collector(
            TrainingStarts(self.make_env, [c.envs]),
            rollout_policy,
            backend=c.backend,
            workers=c.workers,
            frames_per_batch=c.frames_per_batch,
            total_frames=t.total_frames,
            init_random_frames=config.random_frames(),
            max_frames_per_traj=c.max_frames_per_traj,
            policy_device=self.device,
            ray_address=c.ray_address,
            seed=config.seed,
        )
        # An encoder without ``sequence`` reads observations; the store hands out views of its frames then.
        self.store = TransitionStore(config.buffer.capacity, pixel_views=not hasattr(self.encoder, "sequence"))
        buffer = self.store.replay_buffer(config.buffer.batch, safe=config.buffer.safe, unsafe=config.buffer.unsafe)
        delayed = any(name.startswith("target_") for name, _ in self.loss.named_children())
        optimizer = torch.optim.Adam(self.loss.parameters(), config.optim.lr, weight_decay=config.optim.weight_decay)
        trainer = SSPLTrainer(
            collector=collector,
            total_frames=t.total_frames,
            loss_module=self.loss,
            optimizer=optimizer,
            replay_buffer=buffer,
            optim_steps_per_batch=t.optim_steps_per_batch,
            warm_start_steps=t.warm_start_steps,
            warm_start_error=t.warm_start_error,
            target_net_updater=SoftUpdate(self.loss, tau=config.optim.target_tau) if delayed else None,
            rollout_policy=rollout_policy,
            evaluate=self._evaluate_during if t.evaluate_every else None,
            evaluate_every=max(1, t.evaluate_every),
            checkpoint_dir=self.directory / "checkpoints" if t.checkpoint_every >= 0 else None,
            checkpoint_every=max(0, t.checkpoint_every),
            keep_checkpoints=t.keep_checkpoints,
            autocast=None if t.autocast == "none" else getattr(torch, t.autocast),
            clip_norm=t.clip_norm,
            logger=self.logger,
            log_interval=0,
            progress_bar=t.progress,
        )
        if t.restarts and t.warm_start_error is not None and t.warm_start_steps:
            RestartHook(trainer, self._fresh, after=t.warm_start_steps, most=t.restarts).register(trainer)
        if config.optim.schedule == "cosine":
            batches, random = (math.ceil(n / c.frames_per_batch) for n in (t.total_frames, config.random_frames()))
            steps = max(1, batches - max(random, 1) + 1) * t.optim_steps_per_batch
            schedule = torch.optim.lr_scheduler.LambdaLR(optimizer, partial(_cosine, steps))
            LRSchedulerHook(schedule, interval="optim").register(trainer)
        return trainer

    def _evaluate_during(self, trainer: SSPLTrainer) -> dict[str, Any]:
        return logged(evaluate_episodes(self.agent().to(self.device), self.make_env, self.config.evaluation))

    def agent(self, level: float = 0.0) -> Agent:
        """A frozen copy of the present networks, the barrier collapsed to a plain network and shifted.

        Args:
            level: {B <= level} becomes {B <= 0}.

        Returns:
            The agent, with the proof of its Lipschitz bound in its description.

        Source: none.
        """
        parts = [copy.deepcopy(m).cpu() for m in (self.encoder, self.dynamics, self.barrier, self.policy)]
        barrier = parts[2].collapse()  # type: ignore[operator]
        with torch.no_grad():
            barrier[-1].bias.sub_(level)
        witness = [m.tolist() for m in parts[2].multipliers()]  # type: ignore[operator]
        bound = self.config.network.lipschitz_bound
        agent = Agent(parts[0], parts[1], barrier, parts[3], bound, self.description)
        proof = prove_lipschitz(agent.barrier, bound, multipliers=[torch.tensor(m) for m in witness])
        agent.description["lipschitz"] = {"proved": proof.proved, "reason": proof.reason, "multipliers": witness}
        return agent

    def train(self, *, resume: bool = True) -> Agent:
        """Train, or go on from the last checkpoint.

        Args:
            resume: continue from a checkpoint in the directory, if there is one.

        Returns:
            The agent, its zero level placed on held-out episodes.

        Source: paper, Algorithm 1.
        """
        began = time.monotonic()
        self._claim(resume)
        if resume and self.trainer.checkpoint_rotation is not None:
            self.resumed = self.trainer.resume()
        if self.trainer.collected_frames < self.config.trainer.total_frames:
            try:
                self.trainer.train()
            except EmptyRegionError as error:
                raise EmptyRegionError(
                    f"{error} Before the first optimiser step both sets have to be seen: raise "
                    "collector.init_random_frames, start episodes there (reset_options of the environment), let them go on "
                    "where gymnasium ends them (ignore_termination), or lower buffer.safe or buffer.unsafe to 0."
                ) from error
        else:
            self.trainer.collector.shutdown()
        self._synthesise(resume=resume and self.trainer.checkpoint_rotation is not None)
        agent = self.agent(self._level())
        agent.save(self.directory / "agent")
        self.seconds = time.monotonic() - began
        return agent

    def _claim(self, resume: bool) -> None:
        """Writes down what the directory is for; one with checkpoints of something else is refused."""
        file, now = self.directory / "config.json", json.loads(json.dumps(self.config.to_dict()))
        rotation = self.trainer.checkpoint_rotation
        if resume and rotation is not None and rotation.latest() is not None and file.is_file():
            then = json.loads(file.read_text())
            found = [d for key in ("env", "network") for d in differences(then.get(key), now[key], key)]
            if found:
                raise CheckpointError(
                    f"expected the system and the networks of the run in '{self.directory}', received others ("
                    f"{'; '.join(found[:5])}); use another out_dir, or delete the folder to start again"
                )
        file.write_text(json.dumps(now, indent=1) + "\n")

    def _synthesise(self, *, resume: bool) -> None:
        """Dynamics, policy and barrier once more, on latents that stand still: what moves under them no longer does."""
        config, s = self.config, self.config.synthesis
        self.warnings = []
        if self.trainer.optimization_stepper.blind:
            self.warnings.append(
                "the joint training did not tell S from U: what they differ in may be too small in the pictures (image_size, "
                "network.pool_to) or too rare in the data (trainer.total_frames, reset_options), or the latent is filled with "
                "other things that move (network.latent_dim)"
            )
        if not s.enabled or config.loss.preset == "paper":
            return
        index = self._transitions(s.transitions)
        latents = encode_transitions(lambda batch: self.loss.latents(batch.to(self.device)), self.store, index)
        unsafe = int((latents["region"] == UNSAFE).sum())
        if unsafe in (0, len(index)):
            self.warnings.append(
                f"policy and barrier are those of the joint training: {unsafe} of {len(index)} transitions start in U, and "
                "what follows needs both kinds"
            )
            return
        self.synthesis_dir = self.directory / "synthesis"
        settings = TrainingConfig(
            seed=config.seed,
            out_dir=str(self.synthesis_dir),
            progress=config.trainer.progress,
            network=config.network,
            synthesis=SynthesisConfig(**{f.name: getattr(s, f.name) for f in fields(LatentConfig)}),
        )
        networks = {name: copy.deepcopy(getattr(self, name)).cpu() for name in ("dynamics", "barrier", "policy")}
        scale = ((self._high - self._low) / 2).tolist()
        training = LatentTraining(settings, networks, action_scale=scale, latents=latents, resume=resume)
        training.train_phases()
        if training.kept_share == 0.0:
            self.warnings.append(
                "no safe set was found: the errors of the latent dynamics are larger than what the actions can correct. "
                "What the policy needs may not show in two pictures (action_repeat, image_size, network.pool_to), the latent "
                "may be too small (network.latent_dim), or more data is needed (trainer.total_frames)"
            )
        for name, network in networks.items():
            getattr(self, name).load_state_dict(network.state_dict())

    def _transitions(self, most: int) -> Tensor:
        """Which transitions are encoded: of more than ``most``, those of S and U first, up to half, the rest at random."""
        n = len(self.store)
        if n <= most:
            return torch.arange(n)
        generator = torch.Generator().manual_seed(self.config.seed)
        mixed = torch.randperm(n, generator=generator)
        first = mixed[self.store.region[mixed] != UNLABELLED][: most // 2]
        rest = mixed[~torch.isin(mixed, first)][: most - len(first)]
        return torch.cat([first, rest])

    def _level(self) -> float:
        e = self.config.evaluation
        if not e.calibrate:
            return 0.0
        seed, label = e.seed + 1000, "zero level" if self.config.trainer.progress else None
        env = self.make_env(batch_size=[e.envs], seed=seed)
        try:
            agent = self.agent().to(self.device)
            held_out = [
                run_episodes(agent, env, e.episodes, e.horizon, label=label),
                run_episodes(agent, env, e.episodes, e.horizon, random_actions(env, seed + 1), label=label),
            ]
        finally:
            env.close()
        level = separating_level(held_out, e.guard, self.config.synthesis.margin if self.synthesis_dir else 0.0)
        if level < 0.0 and not bool((held_out[0].barrier[0] <= level).any()):
            self.warnings.append(
                f"no held-out reset lies in the set: its level was lowered to {level:.3g} to leave out every held-out observation "
                "of U. Some of these look like S to the encoder: collect more data (trainer.total_frames), above all in U "
                "(reset_options), show more of the motion (image_size), or try another seed"
            )
        return level

    def _certificate(self, agent: Agent) -> Certificate:
        e, name = self.config.evaluation, self.directory.name
        budget = Budget(seconds=e.certificate_seconds)
        if e.certificate_episodes:
            certificate = certify_on_episodes(
                agent,
                self.make_env,
                name=name,
                episodes=e.certificate_episodes,
                horizon=e.horizon,
                envs=e.envs,
                seed=e.seed + 2000,
                used_seeds=(self.config.seed, e.seed, e.seed + 1, e.seed + 1000, e.seed + 1001),
                budget=budget,
                progress=self.config.trainer.progress,
            )
        else:
            certificate = certify(agent, None, name=name, budget=budget)
        certificate.save(self.directory / "agent" / CERTIFICATE_FILE)
        return certificate

    def run(self, *, resume: bool = True) -> ExperimentOutcome:
        """Train, evaluate on fresh episodes, certify, and report; everything lands in ``config.out_dir``.

        Args:
            resume: continue from a checkpoint in the directory, if there is one.

        Returns:
            The outcome; ``metrics.json``, ``report.html`` and ``agent/`` are on disk.

        Source: none.
        """
        agent = self.train(resume=resume)
        there = copy.deepcopy(agent).to(self.device)
        evaluation = evaluate_episodes(
            there, self.make_env, self.config.evaluation, progress=self.config.trainer.progress
        )
        certificate = self._certificate(there)
        outcome = ExperimentOutcome(self.directory, agent, evaluation, certificate, self.seconds, None, self.warnings)
        outcome.advice = advice(certificate, self.config)
        policy, chance = (evaluation.measurements[f"{k}_touch_unsafe"] for k in ("policy", "random"))
        if policy.lower is not None and chance.value is not None and policy.value > chance.value > 0.0:  # type: ignore[operator]
            self.warnings.append(
                f"over all episodes the policy touches U more often ({policy.value:.0%}) than random actions do ({chance.value:.0%})"
            )
        body = {"seed": self.config.seed, "training_seconds": self.seconds, "measurements": evaluation.to_dict(),
                "lipschitz": {k: v for k, v in agent.description["lipschitz"].items() if k != "multipliers"},
                "config": self.config.to_dict()}  # fmt: skip
        (self.directory / "metrics.json").write_text(json.dumps(body, indent=1, sort_keys=True) + "\n")
        frames = self.trainer.collected_frames
        log_scalars(self.logger, logged(evaluation), frames)
        try:
            from torchrl_sspl.trainers.experiment_report import draw, write

            figures = draw(self, outcome)
            for name, figure in figures.items():
                log_figure(self.logger, name.lower().replace(" ", "_"), figure, frames)
            log_video(self.logger, "episode", evaluation.arrays["own"].film, frames)
            outcome.report = write(self, outcome, figures)
        except MissingDependencyError as error:
            tqdm.write(f"no figures and no report: {error}")
        close_logger(self.logger)
        return outcome


def run_experiment(
    make_env: MakeEnv, overrides: Any = (), *, encoder: Callable[[int], nn.Module] | None = None,
    title: str = "Safe policy from pixels", **defaults: Any,
) -> ExperimentOutcome:  # fmt: skip
    """Train, evaluate and report for an environment of your own, in one call.

    Args:
        make_env: ``(batch_size=[n], seed=...) -> environment`` with keys ``"pixels"`` and ``"region"``, such as
            ``partial(GymnasiumPixels, make, safe=..., unsafe=...)``.
        overrides: ``key=value`` strings for the configuration.
        encoder: ``(latent_dim) -> module`` from pixels to latents; by default ``FrameEncoder``.
        title: title of the report.
        **defaults: values in place of the defaults (nested keys with a dot need ``**{"a.b": v}``).

    Returns:
        The outcome: agent, evaluation, report.

    Raises:
        ConfigError: if a key or a value is not valid.

    Source: paper, Algorithm 1.
    """
    from torchrl_sspl.trainers.experiment_config import experiment_config

    config = experiment_config(overrides, **defaults)
    ignored = sorted({k.partition("=")[0] for k in (*overrides, *defaults) if k.partition("=")[0].split(".")[0] == "env"})
    if ignored:
        raise ConfigError(
            f"expected no setting of env where the environment is given in code, received {', '.join(ignored)}; set it there, "
            "for example in partial(GymnasiumPixels, ..., image_size=64)"
        )
    return Experiment(config, make_env, encoder=encoder, title=title).run()


def _cosine(steps: int, step: int) -> float:
    """Share of the learning rate in a step: up over a tenth of them, down to zero over the rest."""
    done = min(1.0, step / steps)
    return max(done / 0.1, 0.04) if done < 0.1 else 0.5 * (1 + math.cos(math.pi * (done - 0.1) / 0.9))


def _project(logger: Any) -> dict[str, str]:
    return {"project": logger.project} if hasattr(logger, "project") else {}
