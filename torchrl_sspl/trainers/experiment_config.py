"""Configuration of an experiment on TorchRL's trainer: one documented dataclass per part."""

from __future__ import annotations

import dataclasses
import importlib
import os
import sys
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

from torchrl_sspl.errors import ConfigError
from torchrl_sspl.trainers.config import LatentConfig, NetworkConfig, _assign

SCHEDULES = ("cosine", "constant")
BACKENDS = ("sync", "process", "ray")
_RANDOM_FRAMES = 12_800
AUTOCAST = ("none", "bfloat16", "float16")


@dataclass
class PendulumEnvConfig:
    """The inverted pendulum of the paper's first case study.

    Attributes:
        _target_: what is built.
        image_size: height and width of the frames, in pixels.
        integrator: "semi_implicit" or "explicit".
        max_torque: largest torque, in N m.
        horizon: steps after which an episode is truncated.
    """

    _target_: str = "torchrl_sspl.envs.PendulumEnv"
    image_size: int = 64
    integrator: str = "semi_implicit"
    max_torque: float = 10.0
    horizon: int | None = None


@dataclass
class DubinsEnvConfig:
    """A Dubins car seen from above.

    Attributes:
        _target_: what is built.
        image_size: height and width of the frames, in pixels.
        horizon: steps after which an episode is truncated.
    """

    _target_: str = "torchrl_sspl.envs.DubinsEnv"
    image_size: int = 64
    horizon: int | None = None


@dataclass
class GymnasiumEnvConfig:
    """An environment of gymnasium, seen through its own pictures.

    Attributes:
        _target_: what is built.
        make: "package.module:function" that makes the environment, with render_mode="rgb_array"; or an id of gymnasium.
        safe: "package.module:function" of (observation, info), true in S.
        unsafe: "package.module:function" of (observation, info), true in U.
        image_size: height and width of the frames, in pixels.
        horizon: steps after which an episode is truncated.
        action_repeat: steps of gymnasium per step, all with the same action, of a discrete one with a mixture of neighbours.
        ignore_termination: let episodes go on where gymnasium ends them, up to the horizon.
    """

    _target_: str = "torchrl_sspl.trainers.experiment_config.gymnasium_env"
    make: str = "CartPole-v1"
    safe: str = ""
    unsafe: str = ""
    image_size: int = 64
    horizon: int | None = 50
    action_repeat: int = 1
    ignore_termination: bool = False


@dataclass
class ModelConfig(NetworkConfig):
    """Sizes of the networks; see ``NetworkConfig`` for the inherited ones.

    Attributes:
        latent_dim: size p of the latent.
        lipschitz_bound: Lipschitz bound L_B of the barrier.
        barrier_hidden: widths of the barrier's hidden layers.
        dynamics_hidden: widths of the latent dynamics' hidden layers.
        policy_hidden: widths of the policy's hidden layers.
        pool_to: frames are averaged to this height and width before the first convolution (pixels).
        velocity_gain: factor on the difference of the two frames' features.
        encoder: "package.module:Class" of an encoder (latent_dim) -> module from pixels to latent; "" is FrameEncoder.
    """

    encoder: str = ""


@dataclass
class LossConfig:
    """The total loss; ``None`` leaves an option as the preset has it.

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
        synthesis_coeff: weight of the invariance condition.
        growth_coeff: weight of growth where the successor is inside.
        descent_coeff: weight of the policy's descent on the barrier.
        off_manifold_coeff: weight of the condition on uniform latents.
        successor: networks that value the successor, "online" or "target".
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
    synthesis_coeff: float | None = None
    growth_coeff: float | None = None
    descent_coeff: float | None = None
    off_manifold_coeff: float | None = None
    successor: str | None = None


@dataclass
class CollectorConfig:
    """Where transitions come from.

    Attributes:
        backend: "sync" (this process), "process" (others on this machine) or "ray" (a cluster).
        workers: collectors; more than one needs "process" or "ray".
        envs: environments per collector, stepped together.
        frames_per_batch: transitions per batch, over all collectors.
        init_random_frames: transitions under random actions before learning starts; "none" is half of
            trainer.total_frames, 12800 at most.
        max_frames_per_traj: steps after which an episode is cut, so that many start; "none" leaves that to the environment.
        exploration: standard deviation of the noise on the policy's actions, as a share of the largest action.
        random_share: share of the environments that act at random all the time.
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
    """The optimiser (Adam).

    Attributes:
        lr: learning rate, the largest one where it changes.
        schedule: "cosine" (rises over the first tenth of the steps, falls to zero until the last) or "constant".
        weight_decay: weight decay.
        target_tau: step of the delayed networks, where the loss has any.
    """

    lr: float = 3e-3
    schedule: str = "cosine"
    weight_decay: float = 0.0
    target_tau: float = 0.01


@dataclass
class ExperimentSynthesisConfig(LatentConfig):
    """What follows the joint training: dynamics, policy and barrier once more, on latents of the collected transitions
    that stand still; see ``LatentConfig`` for the inherited settings.

    Attributes:
        enabled: whether it does; never with loss.preset=paper, which trains as printed.
        transitions: transitions that are encoded: all that start in S or U, at most half of them, and others at random.
    """

    enabled: bool = True
    transitions: int = 40_000
    teacher: str = "value"
    actions: int = 7
    dynamics_steps: int = 1500
    teach_steps: int = 1500
    fit_steps: int = 1500
    steer_steps: int = 300
    tune_steps: int = 3000
    margin: float = 0.1
    counterexamples: int = 256
    batch: int = 512


@dataclass
class TrainerConfig:
    """The training loop.

    Attributes:
        total_frames: transitions to collect.
        optim_steps_per_batch: optimiser steps per collected batch.
        warm_start_steps: of these, the first on the world model alone.
        warm_start_error: share of S and U on the wrong side of the barrier, summed, down to which the world model alone goes
            on being trained; "none" goes by the steps alone.
        restarts: fresh starts with other initial weights, at most, where after warm_start_steps that share exceeds
            warm_start_error and no longer falls; 0 for none. Without a warm start there is nothing to judge by, and none happens.
        clip_norm: bound on the norm of the gradient.
        checkpoint_every: transitions between checkpoints; negative for none.
        keep_checkpoints: checkpoints that are kept.
        evaluate_every: batches between evaluations that are logged; 0 for none before the end.
        autocast: mixed precision, "none", "bfloat16" or "float16".
        compile: compile the loss with torch.compile.
        progress: show a progress bar.
    """

    total_frames: int = 25_600
    optim_steps_per_batch: int = 400
    warm_start_steps: int = 1200
    warm_start_error: float | None = 0.05
    restarts: int = 2
    clip_norm: float = 5.0
    checkpoint_every: int = 12_800
    keep_checkpoints: int = 2
    evaluate_every: int = 0
    autocast: str = "none"
    compile: bool = False
    progress: bool = True


@dataclass
class CSVConfig:
    """Metrics as csv files, figures as png, films as gif, in ``<out_dir>/csv``.

    Attributes:
        kind: logger.
    """

    kind: str = "csv"


@dataclass
class WandbConfig:
    """Weights and Biases; on disk only where there is no key or no network.

    Attributes:
        kind: logger.
        project: project of the run.
    """

    kind: str = "wandb"
    project: str = "torchrl-sspl"


@dataclass
class TensorboardConfig:
    """TensorBoard, in ``<out_dir>/tensorboard``.

    Attributes:
        kind: logger.
    """

    kind: str = "tensorboard"


@dataclass
class NoLoggerConfig:
    """Nothing is logged; the report is written all the same.

    Attributes:
        kind: logger.
    """

    kind: str = "none"


@dataclass
class EpisodesConfig:
    """Evaluation of the frozen agent on fresh episodes; no model of the environment is needed.

    Attributes:
        episodes: episodes under the policy, as many under random actions, and as many to place the zero level.
        horizon: steps per episode.
        envs: environments stepped together.
        seed: seed of the evaluation's own random numbers.
        calibrate: shift the barrier so that it separates held-out S and U before anything is measured.
        guard: distance that held-out observations of U keep from the zero level (units of the barrier).
        certificate_episodes: further episodes from the set, and further ones that show U, behind what the certificate
            measures; for these up to three times as many are drawn (0: it says only what the weights prove).
        certificate_seconds: after which each search for a proof gives up.
    """

    episodes: int = 200
    horizon: int = 50
    envs: int = 20
    seed: int = 20260101
    calibrate: bool = True
    guard: float = 0.02
    certificate_episodes: int = 1000
    certificate_seconds: float = 60.0


@dataclass
class ExperimentConfig:
    """Everything that determines an experiment; written beside its results.

    Attributes:
        env: environment; group "env".
        network: networks.
        loss: total loss; group "loss".
        collector: where transitions come from.
        buffer: store of transitions.
        optim: optimiser.
        trainer: training loop; group "trainer".
        synthesis: training on latents that stand still, after the loop.
        logger: logger; group "logger".
        evaluation: evaluation on fresh episodes.
        seed: seed of data, initial weights and batches.
        device: device of networks and batches, such as "cpu" or "cuda".
        out_dir: directory of the run.
    """

    env: Any = field(default_factory=PendulumEnvConfig)
    network: ModelConfig = field(
        default_factory=lambda: ModelConfig(barrier_hidden=[64, 64, 64], dynamics_hidden=[64, 64], policy_hidden=[32, 32])
    )
    loss: LossConfig = field(default_factory=LossConfig)
    collector: CollectorConfig = field(default_factory=CollectorConfig)
    buffer: BufferConfig = field(default_factory=BufferConfig)
    optim: OptimConfig = field(default_factory=OptimConfig)
    trainer: Any = field(default_factory=TrainerConfig)
    synthesis: ExperimentSynthesisConfig = field(default_factory=ExperimentSynthesisConfig)
    logger: Any = field(default_factory=CSVConfig)
    evaluation: EpisodesConfig = field(default_factory=EpisodesConfig)
    seed: int = 0
    device: str = "cpu"
    out_dir: str = "runs/experiment"

    def to_dict(self) -> dict[str, Any]:
        """Nested dictionary of plain values."""
        return dataclasses.asdict(self)

    def random_frames(self) -> int:
        """Transitions under random actions before learning starts."""
        given: int | None = self.collector.init_random_frames
        return min(_RANDOM_FRAMES, self.trainer.total_frames // 2) if given is None else given

    def check(self) -> ExperimentConfig:
        """The configuration itself, after a look at values that do not go together.

        Raises:
            ConfigError: if one is not valid; the message names it.
        """
        c = self.collector
        if c.backend not in BACKENDS:
            raise ConfigError(f"expected collector.backend to be one of {', '.join(BACKENDS)}, received '{c.backend}'")
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
        if isinstance(self.trainer, TrainerConfig) and self.trainer.autocast not in AUTOCAST:
            raise ConfigError(
                f"expected trainer.autocast to be one of {', '.join(AUTOCAST)}, received '{self.trainer.autocast}'"
            )
        if isinstance(self.trainer, TrainerConfig) and self.random_frames() > self.trainer.total_frames:
            raise ConfigError(
                f"expected collector.init_random_frames of at most trainer.total_frames={self.trainer.total_frames}, received "
                f"{c.init_random_frames}: nothing would be learnt"
            )
        if self.optim.schedule not in SCHEDULES:
            raise ConfigError(
                f"expected optim.schedule to be one of {', '.join(SCHEDULES)}, received '{self.optim.schedule}'"
            )
        self.synthesis.check()
        if self.loss.preset not in ("sound", "paper"):
            raise ConfigError(f"expected loss.preset to be sound or paper, received '{self.loss.preset}'")
        return self


def experiment_config(overrides: Sequence[str] = (), **defaults: Any) -> ExperimentConfig:
    """Configuration of an experiment with ``key=value`` overrides; needs no Hydra.

    Args:
        overrides: strings such as ``"trainer.total_frames=2000"``; lists are written ``[32,32]``.
        **defaults: values that replace the defaults (nested keys with a dot need ``**{"a.b": v}``).

    Returns:
        The configuration.

    Raises:
        ConfigError: if an override is not ``key=value``, a key is unknown (the valid ones are listed), or a value
            has the wrong type or does not go with the others.

    Source: none.

    Example:
        >>> experiment_config(["trainer.total_frames=2000", "collector.envs=4"]).trainer.total_frames
        2000
    """
    if isinstance(overrides, (str, Mapping)):
        raise ConfigError(
            f"overrides: expected a list of key=value strings such as ['seed=1'], received a {type(overrides).__name__}"
        )
    config = ExperimentConfig()
    values = dict(defaults)
    for item in overrides:
        key, sign, value = item.partition("=")
        if not sign or not key:
            raise ConfigError(f"expected an argument of the form key=value, received '{item}'; e.g. seed=1")
        values[key.strip()] = value.strip()
    for key, value in values.items():
        _assign(config, key, value)  # type: ignore[arg-type]
    return config.check()


def resolve(path: str) -> Any:
    """What an import path names.

    Args:
        path: ``"package.module:name"`` or ``"package.module.name"``; the working directory is searched too.

    Returns:
        The object.

    Raises:
        ConfigError: if there is no such module, or no such name in it.

    Source: none.

    Example:
        >>> resolve("torchrl_sspl.sets:SAFE")
        1
    """
    module, sign, name = path.partition(":")
    if not sign:
        module, _, name = path.rpartition(".")
    sys.path.append(os.getcwd())
    try:
        return getattr(importlib.import_module(module), name)
    except (ImportError, ValueError, AttributeError) as error:
        raise ConfigError(
            f"expected an import path like package.module:name, received '{path}' ({type(error).__name__}: {error}); "
            "run from the folder that holds the module, or install it"
        ) from error
    finally:
        sys.path.remove(os.getcwd())


class EnvFactory:
    """Makes environments of a configuration, here or in another process.

    Args:
        config: one of the environment dataclasses: its ``_target_`` is called with its other fields.

    Raises:
        ConfigError: if the target cannot be imported.

    Source: none.

    Example:
        >>> EnvFactory(PendulumEnvConfig(image_size=32))(batch_size=[2], seed=0).reset()["pixels"].shape
        torch.Size([2, 6, 32, 32])
    """

    def __init__(self, config: Any) -> None:
        self.options = dict(config) if isinstance(config, dict) else dataclasses.asdict(config)
        self.target = self.options.pop("_target_")
        resolve(self.target)

    def __call__(self, batch_size: Sequence[int], seed: int | None = None) -> Any:
        """An environment of ``batch_size`` systems."""
        return resolve(self.target)(batch_size=list(batch_size), seed=seed, **self.options)


def gymnasium_env(make: str, safe: str, unsafe: str, **options: Any) -> Any:
    """Environment of gymnasium whose parts are named by import paths.

    Args:
        make: ``"package.module:function"`` of no argument, or an id of gymnasium.
        safe, unsafe: ``"package.module:function"`` of (observation, info).
        **options: further arguments of ``GymnasiumPixels``.

    Returns:
        The environment.

    Raises:
        ConfigError: if a predicate is missing or a path cannot be imported.

    Source: none.
    """
    from torchrl_sspl.envs.gymnasium import GymnasiumPixels

    for name, path in (("safe", safe), ("unsafe", unsafe)):
        if not path:
            raise ConfigError(
                f"expected env.{name} to name a predicate of (observation, info), received none; "
                f"for instance env.{name}=my_system:{name}"
            )
    return GymnasiumPixels(_Make(make), safe=resolve(safe), unsafe=resolve(unsafe), **options)


class _Make:
    def __init__(self, path: str) -> None:
        self.path = path

    def __call__(self) -> Any:
        if ":" in self.path and self.path.partition(":")[2].isidentifier():
            return resolve(self.path)()
        import gymnasium

        return gymnasium.make(self.path, render_mode="rgb_array")
