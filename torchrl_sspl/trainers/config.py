"""Configuration of a training: documented dataclasses, presets, and ``key=value`` overrides."""

from __future__ import annotations

import dataclasses
import difflib
import json
import types
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Union, get_args, get_origin, get_type_hints

from torchrl_sspl.errors import ConfigError

PRESETS = ("sound", "paper", "smoke")
TEACHERS = ("clearance", "value")


@dataclass
class NetworkConfig:
    """Sizes of the networks.

    Attributes:
        latent_dim: size p of the latent.
        lipschitz_bound: Lipschitz bound L_B of the barrier.
        barrier_hidden: widths of the barrier's hidden layers.
        dynamics_hidden: widths of the latent dynamics' hidden layers.
        policy_hidden: widths of the policy's hidden layers.
        pool_to: frames are averaged to this height and width before the first convolution (pixels).
        velocity_gain: factor on the difference of the two frames' features.
        encoder: "FrameEncoder" (convolutions) or "MomentEncoder" (centres of colours before a background).
    """

    latent_dim: int = 3
    lipschitz_bound: float = 2.0
    barrier_hidden: list[int] = field(default_factory=lambda: [96, 96, 96])
    dynamics_hidden: list[int] = field(default_factory=lambda: [96, 96])
    policy_hidden: list[int] = field(default_factory=lambda: [48, 48])
    pool_to: int = 32
    velocity_gain: float = 4.0
    encoder: str = "FrameEncoder"


@dataclass
class DataConfig:
    """What is observed before learning starts.

    Attributes:
        transitions: unlabelled and labelled transitions of D under random actions.
        buffer_share: share of the episodes of D that start outside U (the others start anywhere).
        safe: transitions that start in S.
        unsafe: transitions that start in U.
        episode_steps: steps of a random-action episode.
    """

    transitions: int = 16000
    buffer_share: float = 0.5
    safe: int = 3000
    unsafe: int = 4000
    episode_steps: int = 4


@dataclass
class RepresentationConfig:
    """Warm start: the SaLaD terms on random-action data.

    Attributes:
        steps: optimiser steps.
        batch: transitions per step (two thirds of D, a sixth each of S and U).
        lr: peak learning rate (one cycle).
        safety_margin: hinge margin psi while the latent takes shape; large, so that S and U move apart.
        label_coeff: weights xi_1 and xi_2 of the two hinges.
        consistency_coeff: weight xi_3 of the latent consistency.
        inverse_coeff: weight of the inverse dynamics (0: off); keeps the velocity in the latent.
        saturation_coeff: weight of the penalty on encoder outputs deep in the tanh.
        variance_coeff: weight of the standard-deviation hinge and the covariance penalty (0: off).
        consistency_target: "online" (gradient through both branches) or "target" (theta^-, as in the paper).
        target_tau: step of the moving average theta^- (used by "target").
        clip_norm: bound on the gradient's norm.
    """

    steps: int = 4000
    batch: int = 192
    lr: float = 3e-3
    safety_margin: float = 0.3
    label_coeff: float = 0.3
    consistency_coeff: float = 2.0
    inverse_coeff: float = 1.0
    saturation_coeff: float = 0.3
    variance_coeff: float = 0.5
    consistency_target: str = "online"
    target_tau: float = 0.01
    clip_norm: float = 5.0


@dataclass
class LatentConfig:
    """Dynamics, policy and barrier on latents that stand still.

    Attributes:
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
            the fine-tuning (0: off; the proof has not needed them so far).
        unsafe_margin: hinge margin on labelled unsafe latents.
        recovery_coeff: weight of the action that leads back, on latents outside the set.
    """

    dynamics_steps: int = 6000
    unsafe_weight: float = 1.0
    tube_radius: float = 0.3
    residuals: int = 16
    residual_spread: float = 1.5
    actions: int = 21
    teacher: str = "clearance"
    teach_steps: int = 4000
    teach_spread: float = 1.0
    fit_steps: int = 4000
    steer_steps: int = 1000
    tune_steps: int = 5000
    margin: float = 0.05
    band: float = 0.1
    batch: int = 1024
    lr: float = 1e-3
    counterexamples: int = 0
    unsafe_margin: float = 0.05
    recovery_coeff: float = 0.3

    def check(self) -> None:
        """Raises ``ConfigError`` if the teacher is unknown."""
        if self.teacher not in TEACHERS:
            raise ConfigError(f"expected synthesis.teacher to be one of {', '.join(TEACHERS)}, received '{self.teacher}'")


@dataclass
class SynthesisConfig(LatentConfig):
    """Barrier, policy and dynamics in rounds (Algorithm 1); see ``LatentConfig`` for the inherited settings.

    Attributes:
        rounds: rounds of rollouts, refit, synthesis and fine-tuning; the first uses random-action data alone.
        transitions: encoded random-action transitions.
        rollout_transitions: transitions of the policy (with exploration) that every further round adds.
        mined_unsafe: transitions from the rim of U, where the barrier is lowest, that every further round adds.
        exploration: standard deviation of the exploration, as a share of the largest action.
        deviation_coeff: weight lambda_3 of the deviation from the user's policy (preset "paper").
        guard: barrier value by which every held-out observation of U has to lie outside the set.
        leave_share: largest share of the held-out episodes that may leave the set; none may touch U.
        return_share: share of the held-out episodes from U that should end in the set; among sets that pass, one that
            reaches it is preferred to a larger one that does not.
        check_episodes: held-out episodes of a round's check.
        check_horizon: steps of each.
    """

    rounds: int = 2
    transitions: int = 40000
    rollout_transitions: int = 20000
    mined_unsafe: int = 8000
    exploration: float = 0.15
    deviation_coeff: float = 0.01
    guard: float = 0.02
    leave_share: float = 0.00075
    return_share: float = 0.97
    check_episodes: int = 4000
    check_horizon: int = 40


@dataclass
class EvaluationConfig:
    """Size of the evaluation of the frozen agent on fresh data.

    Attributes:
        grid: states per dimension of the grid over the state space.
        kernel_grid: states per dimension of the grid on which the true kernel is computed.
        rollouts: episodes started in the safe set, and as many in S and U (a fifth each).
        horizon: steps per episode.
        certificate_episodes: fresh episodes, and fresh observations of U, behind the certificate's statistical layer.
        gymnasium_rollouts: episodes on gymnasium's own frames (0: not evaluated).
        seed: seed of the evaluation's own random numbers.
    """

    grid: int = 201
    kernel_grid: int = 301
    rollouts: int = 10000
    horizon: int = 200
    certificate_episodes: int = 3000
    gymnasium_rollouts: int = 1000
    seed: int = 20260101


@dataclass
class TrainingConfig:
    """Everything that determines a run; written beside its results.

    Attributes:
        preset: "sound" (two time scales, condition R3), "paper" (the paper's losses and schedule as printed) or
            "smoke" (seconds, for tests).
        seed: seed of data, initial weights and batches.
        out_dir: directory of the run.
        device: device of what works on pixels: the warm start and, with the preset "paper", the joint training; what
            follows stays on the CPU.
        checkpoint_seconds: seconds between checkpoints.
        progress: show progress bars.
        network: sizes of the networks.
        data: data collected before learning starts.
        representation: warm start.
        synthesis: rounds of Algorithm 1.
        evaluation: evaluation of the frozen agent.
    """

    preset: str = "sound"
    seed: int = 0
    out_dir: str = "runs/pendulum"
    device: str = "cpu"
    checkpoint_seconds: float = 30.0
    progress: bool = True
    network: NetworkConfig = field(default_factory=NetworkConfig)
    data: DataConfig = field(default_factory=DataConfig)
    representation: RepresentationConfig = field(default_factory=RepresentationConfig)
    synthesis: SynthesisConfig = field(default_factory=SynthesisConfig)
    evaluation: EvaluationConfig = field(default_factory=EvaluationConfig)

    def to_dict(self) -> dict[str, Any]:
        """Nested dictionary of plain values."""
        return dataclasses.asdict(self)

    def save(self, path: str | Path) -> None:
        """Write the configuration as JSON."""
        Path(path).write_text(json.dumps(self.to_dict(), indent=1, sort_keys=True) + "\n")

    @classmethod
    def from_dict(cls, values: dict[str, Any]) -> TrainingConfig:
        """Configuration from a nested dictionary; unknown keys and wrong types raise ``ConfigError``."""
        config = cls()
        for key, value in _flatten(values).items():
            _assign(config, key, value)
        return config

    @classmethod
    def load(cls, path: str | Path) -> TrainingConfig:
        """Read a configuration that :meth:`save` has written."""
        try:
            values = json.loads(Path(path).read_text())
        except (OSError, json.JSONDecodeError) as error:
            raise ConfigError(f"expected a readable configuration at '{path}', received {error}") from error
        if not isinstance(values, dict):
            raise ConfigError(f"expected an object of settings at '{path}', received a {type(values).__name__}")
        return cls.from_dict(values)


def make_config(overrides: Sequence[str] = (), **defaults: Any) -> TrainingConfig:
    """Configuration of a preset with ``key=value`` overrides.

    Args:
        overrides: strings such as ``"seed=3"`` or ``"synthesis.rounds=2"``; lists are written ``[32,32]``.
        **defaults: values that replace the preset's (nested keys with a dot need ``**{"a.b": v}``).

    Returns:
        The configuration.

    Raises:
        ConfigError: if an override is not ``key=value``, a key is unknown (the valid ones are listed), or a value
            has the wrong type.

    Source: none.

    Example:
        >>> make_config(["seed=3", "synthesis.rounds=2", "network.policy_hidden=[16,16]"]).synthesis.rounds
        2
    """
    pairs: dict[str, str] = {}
    for item in overrides:
        key, sign, value = item.partition("=")
        if not sign or not key:
            raise ConfigError(
                f"expected an argument of the form key=value, received '{item}'; e.g. seed=1 out_dir=runs/a"
            )
        pairs[key.strip()] = value.strip()
    preset = pairs.get("preset", str(defaults.get("preset", "sound")))
    if preset not in PRESETS:
        raise ConfigError(f"expected preset to be one of {', '.join(PRESETS)}, received '{preset}'")
    config = TrainingConfig(preset=preset)
    _apply_preset(config)
    for key, value in {**defaults, **pairs}.items():
        _assign(config, key, value)
    return config


def _apply_preset(config: TrainingConfig) -> None:
    if config.preset == "paper":
        # The losses as printed: target network, small margins, no extra term; see docs/deviations.md.
        config.network.latent_dim = 2
        rep = config.representation
        rep.consistency_target, rep.inverse_coeff, rep.saturation_coeff = "target", 0.0, 0.0
        rep.safety_margin, rep.consistency_coeff, rep.lr = 0.05, 1.0, 1e-3
        rep.label_coeff, rep.variance_coeff = 1.0, 0.0
        config.synthesis.rounds, config.synthesis.tune_steps, config.synthesis.rollout_transitions = 6, 300, 6000
    if config.preset == "smoke":
        config.data = DataConfig(transitions=600, safe=150, unsafe=200)
        config.representation.steps, config.representation.batch = 30, 48
        config.synthesis = SynthesisConfig(
            rounds=2,
            transitions=800,
            rollout_transitions=200,
            dynamics_steps=60,
            fit_steps=60,
            steer_steps=20,
            tune_steps=40,
            actions=5,
            batch=128,
            residual_spread=0.0,
            check_episodes=40,
            check_horizon=5,
        )
        config.evaluation = EvaluationConfig(grid=21, kernel_grid=101, rollouts=40, horizon=20, certificate_episodes=60, gymnasium_rollouts=0)


def _flatten(values: dict[str, Any], prefix: str = "") -> dict[str, Any]:
    flat: dict[str, Any] = {}
    for key, value in values.items():
        if isinstance(value, dict):
            flat.update(_flatten(value, f"{prefix}{key}."))
        else:
            flat[prefix + key] = value
    return flat


def _valid_keys(config: Any, prefix: str = "") -> list[str]:
    keys: list[str] = []
    for item in dataclasses.fields(config):
        value = getattr(config, item.name)
        keys += _valid_keys(value, f"{prefix}{item.name}.") if dataclasses.is_dataclass(value) else [prefix + item.name]
    return keys


def _assign(config: TrainingConfig, key: str, value: Any) -> None:
    valid = _valid_keys(config)
    if key not in valid:
        close = difflib.get_close_matches(key, valid, n=3)
        hint = f"did you mean {' or '.join(close)}? " if close else ""
        raise ConfigError(f"expected a valid key, received '{key}'; {hint}valid keys: {', '.join(valid)}")
    target: Any = config
    *parents, name = key.split(".")
    for parent in parents:
        target = getattr(target, parent)
    setattr(target, name, _convert(key, value, get_type_hints(type(target))[name]))


def _convert(key: str, value: Any, kind: Any) -> Any:
    """Value of the declared type, from a string or from JSON."""
    if get_origin(kind) in (Union, types.UnionType):
        if value is None or value == "none":
            return None
        kind = next(k for k in get_args(kind) if k is not type(None))
    try:
        if get_origin(kind) is list:
            items = json.loads(value) if isinstance(value, str) else list(value)
            return [_convert(key, item, get_args(kind)[0]) for item in items]
        if kind is bool:
            if isinstance(value, bool):
                return value
            return {"true": True, "1": True, "false": False, "0": False}[str(value).lower()]
        if kind is int:
            number = float(value)
            if number != int(number):
                raise ValueError(value)
            return int(number)
        return kind(value)
    except (ValueError, KeyError, TypeError, OverflowError) as error:
        name = getattr(kind, "__name__", str(kind))
        raise ConfigError(f"expected {key} to be of type {name}, received '{value}'") from error
