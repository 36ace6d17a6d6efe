"""The one configuration tree: a documented dataclass for every section. Presets are the files beside this one."""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass, field
from typing import Any

from torchrl_sspl.errors import ConfigError

BACKENDS = ("sync", "process", "ray")
PRESETS = ("sound", "paper", "smoke")
_CHOICES = {
    "collector.backend": BACKENDS,
    "network.barrier": ("sandwich", "lmi"),
    "optim.schedule": ("cosine", "constant"),
    "loss.preset": ("sound", "paper"),
    "trainer.autocast": ("none", "bfloat16", "float16"),
    "synthesis.teacher": ("clearance", "value"),
    "logger.kind": ("csv", "wandb", "tensorboard", "none"),
}


@dataclass
class NetworkConfig:
    """Encoder, latent dynamics, barrier and policy.

    Attributes:
        latent_dim: size p of the latent.
        lipschitz_bound: Lipschitz bound L_B of the barrier.
        barrier: "sandwich" (Lipschitz by construction) or "lmi" (the paper's, with a loss and a step of its own).
        barrier_hidden: widths of the barrier's hidden layers.
        dynamics_hidden: widths of the latent dynamics' hidden layers.
        policy_hidden: widths of the policy's hidden layers.
        encoder: name of an encoder of the library ("FrameEncoder": convolutions, "MomentEncoder": centres of colours before a
            background), or "package.module:Class" of your own, called with those of latent_dim, image_size, pool_to and
            velocity_gain that it takes.
        pool_to: frames are averaged to this height and width before the first layer, in pixels.
        velocity_gain: factor on the difference of the two frames' features.
    """

    latent_dim: int = 3
    lipschitz_bound: float = 2.0
    barrier: str = "sandwich"
    barrier_hidden: list[int] = field(default_factory=lambda: [64, 64, 64])
    dynamics_hidden: list[int] = field(default_factory=lambda: [64, 64])
    policy_hidden: list[int] = field(default_factory=lambda: [32, 32])
    encoder: str = "FrameEncoder"
    pool_to: int = 32
    velocity_gain: float = 4.0


@dataclass
class LossConfig:
    """The total loss; null leaves an option as its preset has it.

    Attributes:
        preset: "sound" or "paper" (the losses as printed).
        safety_margin: margin of the hinges on S and U.
        safe_coeff: weight of the hinge on S.
        unsafe_coeff: weight of the hinge on U.
        dynamics_margin: margin of the invariance condition.
        consistency_coeff: weight of the latent consistency.
        inverse_dynamics_coeff: weight of reading the action from two latents.
        variance_coeff: weight of the standard deviation that every latent dimension should reach.
        covariance_coeff: weight against latent dimensions that tell the same.
        saturation_coeff: weight of the penalty on latents that stick to their walls.
        saturation_limit: size from which a latent counts as saturated.
        synthesis_coeff: weight of the invariance condition.
        policy_coeff: weight of the deviation from the user's policy.
        growth_coeff: weight of growth where the successor is inside.
        descent_coeff: weight of the policy's descent on the barrier.
        off_manifold_coeff: weight of the condition on uniform latents.
        worst_coeff: extra weight of the worst rows.
        successor: networks that value the successor, "online" or "target".
        reduction: "mean" or "sum" over the batch.
    """

    preset: str = "sound"
    safety_margin: float | None = None
    safe_coeff: float | None = None
    unsafe_coeff: float | None = None
    dynamics_margin: float | None = None
    consistency_coeff: float | None = None
    inverse_dynamics_coeff: float | None = None
    variance_coeff: float | None = None
    covariance_coeff: float | None = None
    saturation_coeff: float | None = None
    saturation_limit: float | None = None
    synthesis_coeff: float | None = None
    policy_coeff: float | None = None
    growth_coeff: float | None = None
    descent_coeff: float | None = None
    off_manifold_coeff: float | None = None
    worst_coeff: float | None = None
    successor: str | None = None
    reduction: str | None = None


@dataclass
class CollectorConfig:
    """Where transitions come from.

    Attributes:
        backend: "sync" (this process), "process" (others on this machine) or "ray" (a cluster).
        workers: collectors; more than one needs "process" or "ray".
        envs: environments per collector, stepped together.
        frames_per_batch: transitions per batch, over all collectors.
        init_random_frames: transitions under random actions before learning starts; null is half of trainer.total_frames,
            12800 at most.
        max_frames_per_traj: steps after which an episode is cut, so that many start; null leaves that to the environment.
        exploration: standard deviation of the noise on the policy's actions, as a share of the largest action.
        random_share: share of the environments that act at random all the time; 1: the policy does not act.
        starts: shares of the episodes that start anywhere, outside U, in S and in U, where the environment knows its sets;
            others start as their resets say.
        ray_address: address of a running Ray cluster; "" starts a local one.
    """

    backend: str = "sync"
    workers: int = 1
    envs: int = 16
    frames_per_batch: int = 1280
    init_random_frames: int | None = None
    max_frames_per_traj: int | None = 10
    exploration: float = 0.1
    random_share: float = 0.5
    starts: list[float] = field(default_factory=lambda: [0.5, 0.0, 0.5, 0.0])
    ray_address: str = ""


@dataclass
class BufferConfig:
    """The store of transitions, every frame once.

    Attributes:
        capacity: transitions.
        batch: transitions per optimiser step.
        safe: share of a batch that starts in S.
        unsafe: share of a batch that starts in U.
    """

    capacity: int = 100_000
    batch: int = 128
    safe: float = 0.2
    unsafe: float = 0.2


@dataclass
class OptimConfig:
    """The optimiser of the joint training (Adam).

    Attributes:
        lr: learning rate, the largest one where it changes.
        schedule: "cosine" (rises over the first tenth of the steps, falls to zero until the last) or "constant".
        weight_decay: weight decay.
        target_tau: step of the delayed networks theta^-, where the loss has any.
    """

    lr: float = 3e-3
    schedule: str = "cosine"
    weight_decay: float = 0.0
    target_tau: float = 0.01


@dataclass
class TrainerConfig:
    """The joint training on pictures: SSPLLoss in TorchRL's loop.

    Attributes:
        total_frames: transitions to collect.
        optim_steps_per_batch: optimiser steps per collected batch.
        warm_start_steps: of these, the first on the world model alone; -1: all of them, policy and barrier are left to the
            phases on frozen latents.
        warm_start_error: share of S and U on the wrong side of the barrier, summed, down to which the world model alone goes
            on being trained; null goes by the steps alone.
        restarts: fresh starts with other initial weights, at most, where after warm_start_steps that share exceeds
            warm_start_error and no longer falls; 0 for none. Without a warm start there is nothing to judge by, and none happens.
        margins: re-estimate both margins before the steps of every batch, as the paper does.
        clip_norm: bound on the norm of the gradient.
        checkpoint_seconds: seconds between checkpoints, in every phase; negative for none.
        keep_checkpoints: checkpoints that are kept.
        evaluate_every: batches between evaluations that are logged; 0 for none before the end.
        autocast: mixed precision, "none", "bfloat16" or "float16".
        compile: compile the loss with torch.compile.
        progress: show progress bars.
    """

    total_frames: int = 25_600
    optim_steps_per_batch: int = 400
    warm_start_steps: int = 1200
    warm_start_error: float | None = 0.05
    restarts: int = 2
    margins: bool = False
    clip_norm: float = 5.0
    checkpoint_seconds: float = 30.0
    keep_checkpoints: int = 2
    evaluate_every: int = 0
    autocast: str = "none"
    compile: bool = False
    progress: bool = True


@dataclass
class SynthesisConfig:
    """The phases on frozen latents: dynamics, policy and barrier, in rounds, each ended by held-out checks.

    Attributes:
        enabled: whether they follow the joint training; never with loss.preset=paper, which trains as printed.
        rounds: rounds of data, refit, synthesis and fine-tuning.
        transitions: encoded transitions of the first round: those of the joint training and, where the environment knows
            its sets, further ones under random actions. Of more than that, all that start in S or U, at most half of them,
            and others at random.
        rollout_transitions: transitions of the policy (with exploration) that every further round adds.
        rim_transitions: transitions that start in U that every further round adds: of rim_draws times as many those whose
            pictures the barrier puts lowest.
        rim_draws: see rim_transitions.
        exploration: standard deviation of the exploration in further rounds, as a share of the largest action.
        dynamics_steps: optimiser steps of the refit of the latent dynamics.
        unsafe_weight: weight of transitions that start in U in the refit of the dynamics; below 1 where what is seen
            there is not worth the networks' capacity (a robot before the obstacle it stands on).
        tube_radius: distance from the data up to which a latent off the manifold may belong to the safe set.
        residuals: observed errors of the dynamics per latent that the fine-tuning adds to successors.
        residual_spread: standard deviations of the local error that the invariant set of the data tolerates; with
            teacher "value" lowered by quarters where nine tenths of S could not be kept otherwise.
        actions: actions per dimension tried at every latent.
        teacher: what teaches the policy before the barrier is fitted: "clearance" (the action that ends farthest from
            what lies outside the invariant set, together with the barrier) or "value" (the action that keeps the
            largest distance from U on all that follows, before the barrier, which then learns what this very policy
            keeps; for systems in which the best action jumps, as from left to right of an obstacle).
        teach_steps: steps of the policy alone on the values of actions ("value").
        teach_spread: standard deviations of the local error that the values of actions tolerate ("value"); larger than
            residual_spread, the policy acts earlier than its set needs.
        fit_steps: steps in which barrier and policy are regressed onto their targets.
        steer_steps: steps of the policy alone on the condition, with the barrier held still.
        tune_steps: steps of the joint fine-tuning on the losses of the condition.
        margin: margin m of the condition R3, B <= 0 implies B(d(z, pi(z))) + m <= 0.
        band: barrier value up to which R3 is asked.
        batch: latents per step.
        lr: peak learning rate of the fine-tuning.
        counterexamples: latents of the whole domain at which the condition fails that each search adds to the batches of
            the fine-tuning (0: off).
        unsafe_margin: hinge margin on labelled unsafe latents.
        recovery_coeff: weight of the action that leads back, on latents outside the set.
        guard: distance that held-out observations of U keep from the zero level (units of the barrier).
        leave_share: largest share of the held-out episodes of a round that may leave the set; none may touch U.
        return_share: share of the held-out episodes from U that should end in the set; among sets that pass, one that
            reaches it is preferred to a larger one that does not.
        check_episodes: held-out episodes of a round's check, where the environment knows its sets.
        check_horizon: steps of each.
    """

    enabled: bool = True
    rounds: int = 1
    transitions: int = 40_000
    rollout_transitions: int = 20_000
    rim_transitions: int = 8_000
    rim_draws: int = 5
    exploration: float = 0.15
    dynamics_steps: int = 1500
    unsafe_weight: float = 1.0
    tube_radius: float = 0.3
    residuals: int = 16
    residual_spread: float = 1.5
    actions: int = 7
    teacher: str = "value"
    teach_steps: int = 1500
    teach_spread: float = 1.0
    fit_steps: int = 1500
    steer_steps: int = 300
    tune_steps: int = 3000
    margin: float = 0.1
    band: float = 0.1
    batch: int = 512
    lr: float = 1e-3
    counterexamples: int = 256
    unsafe_margin: float = 0.05
    recovery_coeff: float = 0.3
    guard: float = 0.02
    leave_share: float = 0.00075
    return_share: float = 0.97
    check_episodes: int = 4000
    check_horizon: int = 40


@dataclass
class EvaluationConfig:
    """Evaluation of the frozen agent on fresh data.

    Attributes:
        episodes: episodes under the policy: from {B <= 0} where the environment knows its sets (and a fifth as many each
            from S and from U; 0: nothing is measured against the true kernel), else from its resets, and as many under
            random actions and to place the zero level.
        horizon: steps per episode.
        envs: environments stepped together, of systems that are known by being run only.
        grid: states per dimension of the grid over the state space; 0: the system's own.
        kernel_grid: states per dimension of the grid of the true kernel; 0: the system's own.
        renderer_episodes: episodes on every further renderer of the system (0: not evaluated).
        walks: episodes in full physics from S, and as many from {B <= 0}, where the system has a full physics (0: none).
        walk_seconds: longest of these.
        walk_seed: seed of their starts.
        seed: seed of the evaluation's own random numbers.
        calibrate: place the zero level between held-out observations of S and U before anything is measured; where the
            environment knows its sets, the rounds' checks have placed it.
        certificate_episodes: fresh episodes from the set, and fresh observations of U, behind what the certificate
            measures (0: it says only what the weights prove).
        certificate_seconds: after which each search for a proof gives up.
    """

    episodes: int = 200
    horizon: int = 50
    envs: int = 20
    grid: int = 0
    kernel_grid: int = 0
    renderer_episodes: int = 0
    walks: int = 0
    walk_seconds: float = 8.0
    walk_seed: int = 20260102
    seed: int = 20260101
    calibrate: bool = True
    certificate_episodes: int = 1000
    certificate_seconds: float = 60.0


@dataclass
class LoggerConfig:
    """Where numbers, figures and films go, beside the report.

    Attributes:
        kind: "csv" (files in <out_dir>/csv), "wandb" (on disk only without a key or a network), "tensorboard" or "none".
        project: project of the run (wandb).
    """

    kind: str = "csv"
    project: str = "torchrl-sspl"


@dataclass
class Config:
    """Everything that determines a run; written beside its results.

    Attributes:
        preset: "sound" (what the library stands for), "paper" (losses and schedule as printed) or "smoke" (seconds, for
            tests); a file each.
        env: what is built: an import path ``_target_`` and its arguments.
        network: networks.
        loss: the total loss.
        collector: where transitions come from.
        buffer: store of transitions.
        optim: optimiser of the joint training.
        trainer: joint training.
        synthesis: phases on frozen latents.
        evaluation: evaluation of the frozen agent.
        logger: where numbers go.
        agent: shipped agent, or run directory, that is evaluated in place of one that is trained; "": train.
        seed: seed of data, initial weights and batches.
        device: device of what works on pictures, such as "cpu" or "cuda"; the phases on latents stay on the CPU.
        out_dir: directory of the run.
    """

    preset: str = "sound"
    env: dict[str, Any] = field(default_factory=dict)
    network: NetworkConfig = field(default_factory=NetworkConfig)
    loss: LossConfig = field(default_factory=LossConfig)
    collector: CollectorConfig = field(default_factory=CollectorConfig)
    buffer: BufferConfig = field(default_factory=BufferConfig)
    optim: OptimConfig = field(default_factory=OptimConfig)
    trainer: TrainerConfig = field(default_factory=TrainerConfig)
    synthesis: SynthesisConfig = field(default_factory=SynthesisConfig)
    evaluation: EvaluationConfig = field(default_factory=EvaluationConfig)
    logger: LoggerConfig = field(default_factory=LoggerConfig)
    agent: str = ""
    seed: int = 0
    device: str = "cpu"
    out_dir: str = "runs/experiment"

    def to_dict(self) -> dict[str, Any]:
        """Nested dictionary of plain values."""
        return dataclasses.asdict(self)

    def random_frames(self) -> int:
        """Transitions under random actions before learning starts."""
        given = self.collector.init_random_frames
        return min(12_800, self.trainer.total_frames // 2) if given is None else given

    def check(self) -> Config:
        """The configuration itself, after a look at values that do not go together.

        Raises ConfigError if one is not valid; the message names it.
        """
        for key, choices in _CHOICES.items():
            section, name = key.split(".")
            found = getattr(getattr(self, section), name)
            if found not in choices:
                raise ConfigError(f"expected {key} to be one of {', '.join(choices)}, received '{found}'")
        c = self.collector
        if c.backend == "sync" and c.workers != 1:
            raise ConfigError(
                f"expected collector.workers=1 with collector.backend=sync, received {c.workers}; "
                "choose collector.backend=process or ray"
            )
        for name, value in (("workers", c.workers), ("envs", c.envs), ("frames_per_batch", c.frames_per_batch)):
            if value < 1:
                raise ConfigError(f"expected collector.{name} >= 1, received {value}")
        if c.frames_per_batch % (c.workers * c.envs):
            raise ConfigError(
                f"expected collector.frames_per_batch to be a multiple of workers x envs = {c.workers * c.envs}, "
                f"received {c.frames_per_batch}"
            )
        if len(c.starts) != 4 or min(c.starts) < 0 or not sum(c.starts) > 0:
            raise ConfigError(
                f"expected collector.starts to be four shares (anywhere, outside U, S, U), received {c.starts}; e.g. [1,0,0,0]"
            )
        if self.random_frames() > self.trainer.total_frames:
            raise ConfigError(
                f"expected collector.init_random_frames of at most trainer.total_frames={self.trainer.total_frames}, received "
                f"{c.init_random_frames}: nothing would be learnt"
            )
        if self.synthesis.rounds < 1:
            raise ConfigError(f"expected synthesis.rounds >= 1, received {self.synthesis.rounds}; synthesis.enabled=false for none")
        return self


__all__ = [
    "BufferConfig",
    "CollectorConfig",
    "Config",
    "EvaluationConfig",
    "LoggerConfig",
    "LossConfig",
    "NetworkConfig",
    "OptimConfig",
    "PRESETS",
    "SynthesisConfig",
    "TrainerConfig",
]
