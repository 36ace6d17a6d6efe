"""One way from a configuration to a report: environment, networks, loss and trainer, then evaluation and certificate.

``Experiment.__init__`` builds everything in the order in which it is used; ``Experiment.run`` does everything in the
order in which it happens.
"""

from __future__ import annotations

import json
import math
import shutil
from collections.abc import Callable
from dataclasses import replace
from functools import partial, wraps
from typing import Any

import torch
from torch import nn
from torchrl.envs import EnvBase
from torchrl.objectives import SoftUpdate
from torchrl.trainers import LRSchedulerHook
from tqdm import tqdm

from torchrl_sspl.certification.branch_and_bound import Budget
from torchrl_sspl.certification.certificate import Certificate, weights_digest
from torchrl_sspl.configs.reader import EnvFactory, compose, parse
from torchrl_sspl.configs.schema import Config, LabelsConfig
from torchrl_sspl.data import Augmentation, Labels, TransitionStore
from torchrl_sspl.data.collect import ExploringPolicy, RandomActions, make_collector
from torchrl_sspl.devices import usable_device
from torchrl_sspl.envs.base import LARGEST_ACTION, SafetyEnv
from torchrl_sspl.errors import CheckpointError, ConfigError, EmptyRegionError, MissingDependencyError, OutputError
from torchrl_sspl.evaluation.beside import CERTIFICATE_FILE, certificate_beside
from torchrl_sspl.evaluation.certify import certify, certify_on_episodes, premise
from torchrl_sspl.evaluation.episodes import evaluate_episodes, logged
from torchrl_sspl.evaluation.known import evaluate
from torchrl_sspl.evaluation.measurements import Evaluation, Measurement
from torchrl_sspl.evaluation.outcome import Outcome, write_metrics
from torchrl_sspl.evaluation.physics import evaluate_physics
from torchrl_sspl.experiments.description import CODE_FILE, changed_code, code_of, describe, differences, keep_code
from torchrl_sspl.experiments.own_systems import advice, check_encoder, check_factory
from torchrl_sspl.files import RunDirectory, write
from torchrl_sspl.interrupts import interruptible
from torchrl_sspl.journal import FOLDER, journal
from torchrl_sspl.lipschitz import LMIBarrier, SandwichBarrier
from torchrl_sspl.modules import LatentDynamics, Policy, make_rollout_policy
from torchrl_sspl.modules.agent import Agent, agent_directory, build_encoder, call_with, load
from torchrl_sspl.objectives import LipschitzLoss, SSPLLoss
from torchrl_sspl.seeds import spawn
from torchrl_sspl.trainers.hooks import MarginHook, RestartHook
from torchrl_sspl.trainers.loggers import close_logger, log_figure, log_scalars, log_video, make_logger
from torchrl_sspl.trainers.phases import Phase, Phases, Workspace, action_grid
from torchrl_sspl.trainers.selection import CheckRound, PlaceLevel
from torchrl_sspl.trainers.source import Source, TrainingStarts
from torchrl_sspl.trainers.synthesis import synthesis_phases
from torchrl_sspl.trainers.trainer import SSPLTrainer

MakeEnv = Callable[..., EnvBase]
CONFIG_FILE = "config.json"


def agent_phases(config: Config, *, known: bool) -> list[Phase]:
    """The phases of a configuration: those of every round, each ended by its checks where the sets are known.

    Returns the phases in order; with ``synthesis.enabled=false``, or the losses as printed, the placing of the level
    alone. Source: paper Algorithm 1; deviation: two time scales.
    """
    s, e = config.synthesis, config.evaluation
    if config.loss.preset == "paper":
        return []  # as printed
    phases = synthesis_phases(s, check=CheckRound if known else None) if s.enabled else []
    if e.calibrate and not known:
        if e.episodes < 1:
            raise ConfigError(
                f"expected evaluation.episodes >= 1, whose pictures place the zero level, received {e.episodes}; evaluation.calibrate=false leaves it"
            )
        number, progress = s.rounds - 1 if s.enabled else 0, config.trainer.progress
        phases.append(PlaceLevel(number, episodes=e.episodes, horizon=e.horizon, envs=e.envs, progress=progress))
    return phases


def _alone(method: Callable[..., Any]) -> Any:
    """No other process writes to the directory meanwhile, and a signal says what it leaves behind."""

    @wraps(method)
    def wrapped(self: Experiment, **options: Any) -> Any:
        say = f"what is saved stays in {self.directory}; the same command resumes from there"
        with self._claim.held(), interruptible(lambda: say), journal(self.directory, "run"):
            return method(self, **options)

    return wrapped


class Experiment:
    """Environment, networks, loss, collector, store, trainer, phases and logger of a configuration.

    Args:
        config: everything that determines the run.
        make_env: ``(batch_size=[n], seed=...) -> environment`` with keys ``"pixels"`` and ``"region"``; by default
            what ``config.env`` describes.
        encoder: ``(latent_dim) -> module`` from pixels ``(*batch, 6, H, W)`` uint8 to latents in [-1, 1]; by default
            what ``config.network`` describes.
        title: title of the report; by default the system's.

    Raises ConfigError if values of the configuration do not go together, or the environment lacks labels.
    Source: paper, Algorithm 1, on TorchRL's trainer.
    """

    def __init__(
        self,
        config: Config,
        make_env: MakeEnv | None = None,
        *,
        encoder: Callable[[int], nn.Module] | None = None,
        title: str | None = None,
    ) -> None:
        config.check()
        if make_env is not None:
            check_factory(make_env)
            config = replace(config, env=describe(make_env))
        self.config = config
        self.make_env = EnvFactory(config.env) if make_env is None else make_env
        self.device = usable_device(config.device)
        self.env, pixels = self._probe()
        self.known = isinstance(self.env, SafetyEnv)
        self.title = title or (self.env.system.title if self.known else "Safe policy from pixels")  # type: ignore[union-attr]
        self._given_encoder = encoder
        height, width = pixels.shape[-2:]
        self._image_size = height if height == width else [height, width]
        torch.manual_seed(config.seed)
        self.encoder, self.dynamics, self.barrier, self.policy = self._networks()
        check_encoder(self.encoder, pixels.to(self.device), config.network.latent_dim)
        pictures = config.trainer.total_frames * pixels.numel() // 2  # bytes: the store holds every frame once
        keeps = 0 if config.trainer.checkpoint_seconds < 0 or config.agent else config.trainer.keep_checkpoints + 1
        self._claim = RunDirectory(config.out_dir, needs=pictures * keeps)
        self.directory = self._claim.path
        self.loss = self._loss(self.encoder, self.dynamics, self.barrier, self.policy)
        self.logger = make_logger(config.logger.kind, config.logger.kind, self.directory, project=config.logger.project)
        # An encoder without ``sequence`` reads observations; the store hands out views of its frames then.
        self.changes = Augmentation(**vars(config.augmentation), seed=config.seed) if config.augmentation.share else None
        steadies = any(phase.name == "steady" for phase in agent_phases(config, known=self.known))
        self.augmentation = None if steadies else self.changes  # of the data
        self.labels = Labels(**vars(config.labels), seed=config.seed) if config.labels != LabelsConfig() else None
        self.store = TransitionStore(
            config.buffer.capacity, pixel_views=not hasattr(self.encoder, "sequence"), augmentation=self.augmentation, labels=self.labels
        )
        self.work = self._workspace()
        self.phases = Phases(agent_phases(config, known=self.known), self.work)
        self.trainer = self._make_trainer()

    def _probe(self) -> tuple[EnvBase, torch.Tensor]:
        """One environment of the system, and a look at what it shows."""
        try:
            env = self.make_env(batch_size=[1], seed=self.config.seed)
        except TypeError as error:
            raise ConfigError(
                f"make_env: expected a function (batch_size=[n], seed=...) -> environment, such as partial(GymnasiumPixels, "
                f"make, safe=..., unsafe=...), received one that raises TypeError: {error}"
            ) from error
        if not isinstance(env, EnvBase) or env.batch_size != torch.Size([1]):
            received = f"one of size {list(env.batch_size)}" if isinstance(env, EnvBase) else type(env).__name__
            raise ConfigError(f"make_env: expected an environment of TorchRL of the batch size asked for, [1], received {received}")
        missing = {"pixels", "region"} - set(env.observation_spec.keys())
        if missing:
            raise ConfigError(f"expected an environment with the keys pixels and region, found no {sorted(missing)}")
        space: Any = env.action_spec_unbatched.space
        if not hasattr(space, "low"):
            raise ConfigError(
                f"expected actions with bounds, received {type(env.action_spec).__name__}; GymnasiumPixels makes such of discrete ones"
            )
        self._low, self._high = space.low.cpu().float(), space.high.cpu().float()
        if not torch.allclose(self._low, -self._high) or not bool(((self._high > 0.0) & (self._high < LARGEST_ACTION)).all()):
            raise ConfigError(
                f"expected actions between -a and a for some finite a > 0, received bounds {self._low.tolist()} and {self._high.tolist()}; move their "
                "middle to zero in a transform of the environment, as GymnasiumPixels does"
            )
        if self.config.synthesis.enabled:
            action_grid(self._high.flatten().tolist(), self.config.synthesis.choices or self.config.synthesis.actions)
        pixels = env.reset()["pixels"].cpu()
        if not isinstance(env, SafetyEnv):
            env.close()
        return env, pixels

    def _networks(self) -> tuple[nn.Module, nn.Module, nn.Module, nn.Module]:
        net = self.config.network
        scale = self._high.tolist()
        options: dict[str, Any] = {"latent_dim": net.latent_dim, "pool_to": net.pool_to, "velocity_gain": net.velocity_gain}
        options["image_size"] = self._image_size
        given = self._given_encoder
        encoder = build_encoder(net.encoder, **options) if given is None else call_with(given, options)
        turns = getattr(encoder, "turn_radius", 0.0)
        dynamics = LatentDynamics(net.latent_dim, len(scale), net.dynamics_hidden, scale, net.remember_action, turns)
        seen, shown = getattr(encoder, "seen_dim", net.latent_dim), net.latent_dim - len(scale) * net.remember_action
        if seen != shown:
            raise ConfigError(
                f"expected an encoder that fills {shown} of latent_dim={net.latent_dim} entries with "
                f"network.remember_action={net.remember_action}, received {type(encoder).__name__}, which fills {seen}"
            )
        policy = Policy(net.latent_dim, len(scale), net.policy_hidden, scale)
        kind = LMIBarrier if net.barrier == "lmi" else SandwichBarrier
        barrier = kind(net.latent_dim, tuple(net.barrier_hidden), net.lipschitz_bound)
        return tuple(m.to(self.device) for m in (encoder, dynamics, barrier, policy))  # type: ignore[return-value]

    def _loss(self, *networks: nn.Module) -> SSPLLoss:
        options: dict[str, Any] = {k: v for k, v in vars(self.config.loss).items() if v is not None}
        return SSPLLoss(*networks, **options).to(self.device)

    def _fresh(self, attempt: int) -> SSPLLoss:
        """A loss like the trainer's with other initial weights."""
        with torch.random.fork_rng():
            torch.manual_seed(spawn(self.config.seed, "weights", attempt))
            return self._loss(*self._networks())

    def _workspace(self) -> Workspace:
        c, seed = self.config.collector, self.config.seed
        source = Source(
            self.make_env, self.encoder, store=self.store, starts=c.starts,
            steps=self.config.synthesis.episode_steps or c.max_frames_per_traj,
            envs=256 if self.known else c.envs, seed=seed, augmentation=self.augmentation, changes=self.changes, labels=self.labels,
        )  # fmt: skip
        body = self.config.to_dict()
        body.pop("out_dir")
        description = {"config": body, "seeds": self.seeds(), "environment": describe(self.make_env)}
        if isinstance(period := getattr(self.env, "dt", None), int | float):
            description["dt"] = float(period)
        nets = self.encoder, self.dynamics, self.barrier, self.policy
        work = Workspace(
            *nets, config=self.config.synthesis, source=source, seed=seed, out_dir=self.directory, description=description
        )
        work.logger = self.logger
        return work

    def seeds(self) -> list[int]:
        """Every seed from which anything of the agent was drawn; certificates keep away from them."""
        config = self.config
        return [config.seed, config.evaluation.seed, config.evaluation.walk_seed]

    def _make_trainer(self) -> SSPLTrainer:
        config, t = self.config, self.config.trainer
        if t.compile:
            self.loss.compile()
            self.loss.world_model = torch.compile(self.loss.world_model)  # type: ignore[method-assign]
        rollout_policy = self._rollout_policy()
        buffer = self.store.replay_buffer(config.buffer.batch, safe=config.buffer.safe, unsafe=config.buffer.unsafe)
        delayed = any(name.startswith("target_") for name, _ in self.loss.named_children())
        optimizer = torch.optim.Adam(self.loss.parameters(), config.optim.lr, weight_decay=config.optim.weight_decay)
        lipschitz: dict[str, Any] = {}
        if isinstance(self.barrier, LMIBarrier):
            lipschitz["lipschitz_loss"] = LipschitzLoss(self.barrier)
            lipschitz["lipschitz_optimizer"] = torch.optim.Adam(self.barrier.parameters(), config.optim.lr)
        bound = config.network.lipschitz_bound
        trainer = SSPLTrainer(
            collector=self._collector(rollout_policy),
            total_frames=t.total_frames,
            loss_module=self.loss,
            optimizer=optimizer,
            replay_buffer=buffer,
            optim_steps_per_batch=t.optim_steps_per_batch,
            warm_start_steps=t.warm_start_steps,
            warm_start_error=t.warm_start_error,
            target_net_updater=SoftUpdate(self.loss, tau=config.optim.target_tau) if delayed else None,
            rollout_policy=rollout_policy,
            margins=MarginHook(self.loss, buffer, lipschitz_bound=bound) if t.margins else None,
            evaluate=self._evaluate_during if t.evaluate_every else None,
            evaluate_every=max(1, t.evaluate_every),
            checkpoint_dir=self.directory / "checkpoints" if t.checkpoint_seconds >= 0 else None,
            checkpoint_seconds=t.checkpoint_seconds,
            keep_checkpoints=t.keep_checkpoints,
            autocast=None if t.autocast == "none" else getattr(torch, t.autocast),
            phases=self.phases,
            out_dir=self.directory,
            progress_bar=t.progress,
            clip_norm=t.clip_norm,
            logger=self.logger,
            log_interval=0,
            **lipschitz,
        )
        if t.restarts and t.warm_start_error is not None and t.warm_start_steps > 0:
            RestartHook(trainer, self._fresh, after=t.warm_start_steps, most=t.restarts).register(trainer)
        if config.optim.schedule == "cosine":
            schedule = torch.optim.lr_scheduler.LambdaLR(optimizer, partial(_cosine, trainer._joint_steps()))
            LRSchedulerHook(schedule, interval="optim").register(trainer)
        return trainer

    def _rollout_policy(self) -> Any:
        c = self.config.collector
        if c.random_share >= 1.0:  # nothing is asked of the policy
            return RandomActions(self.env, spawn(self.config.seed, "exploration"))
        assert self.loss.encoder is not None
        acting = make_rollout_policy(self.loss.encoder, self.loss.actor_network)
        return ExploringPolicy(acting, self._low, self._high, c.exploration, c.random_share).to(self.device)

    def _collector(self, policy: Any) -> Any:
        c = self.config.collector
        return make_collector(
            TrainingStarts(self.make_env, [c.envs], c.starts, grouped=not 0.0 < c.random_share < 1.0), policy, backend=c.backend, workers=c.workers,
            frames_per_batch=c.frames_per_batch, total_frames=self.config.trainer.total_frames,
            init_random_frames=self.config.random_frames(), max_frames_per_traj=c.max_frames_per_traj,
            policy_device=self.device, ray_address=c.ray_address, seed=self.config.seed,
        )  # fmt: skip

    def _evaluate_during(self, trainer: SSPLTrainer) -> dict[str, Any]:
        return logged(evaluate_episodes(self.agent().to(self.device), self.make_env, self.config.evaluation))

    def agent(self) -> Agent:
        """A frozen copy of the present networks, their level placed where the phases have put it."""
        nets = self.encoder, self.dynamics, self.barrier, self.policy
        return Agent.from_networks(*nets, level=self.work.level, description=self.work.description, **self.work.acts())

    @_alone
    def train(self, *, resume: bool = True) -> Agent:
        """Train, or go on from the last checkpoint in the directory if ``resume``.

        Returns the agent; it is in ``agent/`` too. Raises CheckpointError if the directory holds a run of another
        system, other networks or other settings; OutputError if another process writes there; EmptyRegionError if S or
        U never occurs in the data. SIGINT and SIGTERM save the state and end the process. Source: paper, Algorithm 1.
        """
        rotation = self.trainer.checkpoint_rotation
        latest = rotation.latest() if rotation is not None else None
        if resume and rotation is None and any((self.directory / "checkpoints").glob("*")):
            self._same_run()  # else what goes on later would be the other one
        for half in (self.directory / "checkpoints").glob(".*"):  # of a killed run
            shutil.rmtree(half, ignore_errors=True)
        if resume and latest is not None:
            self._same_run()
            self.trainer.resume()
        else:
            shutil.rmtree(self.directory / FOLDER, ignore_errors=True)
            for path in () if rotation is None else rotation.checkpoints():
                rotation._remove_atomically(path)
            if not resume:
                shutil.rmtree(self.directory / "checkpoints", ignore_errors=True)
            for told in (self.directory / "log.jsonl", *(self.directory / "csv" / "scalars").glob("*.csv")):  # they are appended to
                told.unlink(missing_ok=True)
        write(self.directory / CONFIG_FILE, json.dumps(self.config.to_dict(), indent=1, sort_keys=True) + "\n")
        try:
            if not (self.trainer.resumed and (self.directory / CODE_FILE).is_file()):
                keep_code(self.directory, code_of(self.config, self._given_encoder))
            self.trainer.train()
        except EmptyRegionError as error:
            if self.phases.begun:
                raise
            few = "" if self.labels is None else "give labels of both (labels.safe, labels.unsafe, labels.share), "
            raise EmptyRegionError(
                f"{error} Before the first optimiser step both sets have to be seen: {few}raise "
                "collector.init_random_frames, start episodes there (reset_options of the environment), let them go on "
                "where gymnasium ends them (ignore_termination), or lower buffer.safe or buffer.unsafe to 0."
            ) from error
        agent = self.agent()
        agent.description["stop_reason"] = self.stop_reason()
        with journal(self.directory, "premise", weights_digest(agent.state_dict())):
            agent.tolerated_error = premise(agent, budget=Budget(seconds=self.config.evaluation.certificate_seconds))
        agent.save(self.directory / "agent")
        return agent

    def _same_run(self) -> None:
        """A checkpoint of something else is refused."""
        file = self.directory / CONFIG_FILE
        if not file.is_file():
            return
        then, now = json.loads(file.read_text()), json.loads(json.dumps(self.config.to_dict()))
        for part in (then, now):
            for key in ("out_dir", "device", "evaluation", "logger"):
                part.pop(key, None)
            for key in ("progress", "checkpoint_seconds", "keep_checkpoints", "evaluate_every"):
                part.get("trainer", {}).pop(key, None)
        found = differences(then, now) + changed_code(self.directory, code_of(self.config, self._given_encoder))
        if found:
            raise CheckpointError(
                f"expected the system, the networks and the settings of the run in '{self.directory}', received others ("
                f"{'; '.join(found[:5])}); use another out_dir, or delete the folder to start again"
            )

    def stop_reason(self) -> str:
        """Why the training ended."""
        checks = self.work.checks
        if self.work.best is not None:
            return f"round {self.work.best['round'] + 1} has the largest set that passed the held-out checks"
        if checks:
            return "no round passed the held-out checks: " + "; ".join(f"round {c.round + 1}: {c.reason}" for c in checks)
        if self.config.loss.preset == "paper":
            return "all transitions are collected; the printed stop rule, a total loss of zero, was not met"
        return "all phases are done"

    def evaluate(self, agent: Agent) -> dict[str, Evaluation]:
        """All measurements of a frozen agent on fresh data: ``"own"``, and those of every further renderer."""
        e, progress = self.config.evaluation, self.config.trainer.progress
        if not self.known:
            return {"own": evaluate_episodes(agent, self.make_env, e, progress=progress) if e.episodes else Evaluation()}
        twin = self.env.known_twin()  # type: ignore[operator]
        found = {"own": evaluate(agent, twin, e, progress=progress) if e.episodes else Evaluation()}
        for name, draw in twin.renderers().items() if e.renderer_episodes else ():
            try:
                draw(twin.sample_states(1))
                found[name] = evaluate(agent, twin, e, draw=draw, episodes=e.renderer_episodes, progress=progress)
            except MissingDependencyError as error:
                tqdm.write(f"not evaluated on the frames of {name}: {error}")
        try:
            if e.walks and twin.physics() is not None:
                walks, self.walks = evaluate_physics(agent, twin, e, progress=progress)
                found["own"].measurements |= walks.measurements
                found["own"].arrays |= walks.arrays
        except MissingDependencyError as error:
            tqdm.write(f"not evaluated in full physics: {error}")
        return found

    def certify(self, agent: Agent) -> Certificate:
        """Issue the certificate of a frozen agent, and keep it beside the agent."""
        e, progress = self.config.evaluation, self.config.trainer.progress
        budget, name = Budget(seconds=e.certificate_seconds), self.directory.name
        if self.known or not e.certificate_episodes:
            certificate = certify(
                agent, self.env if self.known and e.certificate_episodes else None, name=name,
                episodes=e.certificate_episodes, horizon=e.horizon, budget=budget, progress=progress,
            )  # fmt: skip
        else:
            certificate = certify_on_episodes(
                agent, self.make_env, name=name, episodes=e.certificate_episodes, horizon=e.horizon, envs=e.envs,
                budget=budget, progress=progress,
            )  # fmt: skip
        certificate.save(self.directory / "agent" / CERTIFICATE_FILE)
        return certificate

    @_alone
    def run(self, *, resume: bool = True) -> Outcome:
        """Train (or load ``config.agent``), evaluate on fresh data, certify, and report.

        With ``resume`` a training goes on from a checkpoint in ``config.out_dir``, if there is one. There
        ``metrics.json``, ``report.html`` and ``agent/`` land. Raises OutputError if another process writes there, or if a
        run that was trained is there and ``config.agent`` is to be measured.
        Source: none.
        """
        trained = not self.config.agent
        if not trained and (self.directory / "agent").is_dir():
            raise OutputError(f"expected an out_dir for measurements alone, received '{self.directory}', which holds a run that was trained; give another out_dir")
        agent = (self.train(resume=resume) if trained else load(self.config.agent)).to(self.device)
        seconds = self.trainer.clock.seconds  # before anything is measured
        certificate: Certificate | None = None
        with journal(self.directory, "evaluation", weights_digest(agent.state_dict()), self.config.to_dict()):
            evaluations = self.evaluate(agent)
            if trained:
                evaluations["own"].add(Measurement("training_minutes", seconds / 60, "min", note="wall clock, data included"))
                certificate = self.certify(agent)
        if not trained:
            self.trainer.collector.shutdown()
            certificate, why = certificate_beside(agent_directory(self.config.agent), agent)
            self.work.warnings += [why] if why else []
        outcome = Outcome(
            directory=self.directory,
            agent=agent.cpu(),
            config=self.config,
            system=self.env.system if self.known else None,  # type: ignore[arg-type]
            evaluations=evaluations,
            certificate=certificate,
            seconds=seconds if trained else None,
            checks=self.work.checks,
            stop_reason=self.stop_reason() if trained else agent.description.get("stop_reason", "trained before"),
            budget=self._budget() if trained else {},
            warnings=self._warnings(evaluations["own"]),
            advice=advice(certificate, self.config) if trained else [],
        )
        return finish(self, outcome)

    def _budget(self) -> dict[str, int]:
        self.work.source.count_stored()
        return dict(self.work.source.budget)

    def _warnings(self, evaluation: Evaluation) -> list[str]:
        lines = list(self.work.warnings)
        if not self.config.agent and self.trainer.optimization_stepper.unseparated:
            lines.append(
                "the joint training did not tell S from U: what they differ in may be too small in the pictures (image_size, "
                "network.pool_to) or too rare in the data (trainer.total_frames, reset_options), or the latent is filled with "
                "other things that move (network.latent_dim)"
            )
        if self.work.kept_share == 0.0:
            lines.append(
                "no safe set was found: the errors of the latent dynamics are larger than what the actions can correct. "
                "What the policy needs may not show in two pictures (action_repeat, image_size, network.pool_to), the latent "
                "may be too small (network.latent_dim), or more data is needed (trainer.total_frames)"
            )
        policy, chance = (evaluation.measurements.get(f"{k}_touch_unsafe") for k in ("policy", "random"))
        if policy and chance and policy.lower is not None and chance.value and policy.value > chance.value:  # type: ignore[operator]
            lines.append(
                f"over all episodes the policy touches U more often ({policy.value:.0%}) than random actions do ({chance.value:.0%})"
            )
        return lines


def finish(experiment: Experiment, outcome: Outcome) -> Outcome:
    """Write metrics and report of a run, then give figures and numbers to its logger; the outcome with its report."""
    write_metrics(outcome)
    frames = experiment.trainer.collected_frames
    figures: dict[str, Any] = {}
    try:
        from torchrl_sspl.experiments.report import write_run_report

        figures = write_run_report(outcome, experiment.env if experiment.known else None, title=experiment.title)
    except MissingDependencyError as error:
        tqdm.write(f"no figures and no report: {error}")
    own = outcome.evaluations["own"]
    log_scalars(experiment.logger, {} if experiment.known else logged(own), frames)
    for name, figure in figures.items():
        log_figure(experiment.logger, name.lower().replace(" ", "_"), figure, frames)
    episodes = own.arrays.get("own")
    if episodes is not None and episodes.frames is not None:
        log_video(experiment.logger, "episode", episodes.frames[episodes.alive[:, 0], 0], frames)
    close_logger(experiment.logger)
    return outcome


def run_experiment(
    make_env: MakeEnv,
    overrides: Any = (),
    *,
    encoder: Callable[[int], nn.Module] | None = None,
    title: str | None = None,
    **defaults: Any,
) -> Outcome:
    """Train, evaluate and report for an environment of your own, in one call.

    Args:
        make_env: ``(batch_size=[n], seed=...) -> environment`` with keys ``"pixels"`` and ``"region"``, such as
            ``partial(GymnasiumPixels, make, safe=..., unsafe=...)``.
        overrides: ``key=value`` strings for the configuration.
        encoder: ``(latent_dim) -> module`` from pixels to latents; by default ``FrameEncoder``.
        title: title of the report.
        **defaults: values in place of the defaults (nested keys with a dot need ``**{"a.b": v}``).

    Returns the outcome: agent, evaluation, certificate, report. Raises ConfigError if a key or a value is not valid.
    Source: paper, Algorithm 1.
    """
    given = sorted(k for k in {**parse(overrides), **defaults} if k.split(".")[0] == "env")
    if given:
        raise ConfigError(
            f"expected no setting of env where the environment is given in code, received {', '.join(given)}; set it there, "
            "for example in partial(GymnasiumPixels, ..., image_size=64)"
        )
    return Experiment(compose(overrides, **defaults), make_env, encoder=encoder, title=title).run()


def _cosine(steps: int, step: int) -> float:
    """Share of the learning rate in a step: up over a tenth of them, down to zero over the rest."""
    done = min(1.0, step / steps)
    return max(done / 0.1, 0.04) if done < 0.1 else 0.5 * (1 + math.cos(math.pi * (done - 0.1) / 0.9))


__all__ = ["Experiment", "agent_phases", "finish", "run_experiment"]
