"""The one configuration tree: a documented dataclass for every section. Presets are the files beside this one."""

# ruff: noqa: RUF009  (an option is a field, not a value)

from __future__ import annotations

import dataclasses
import operator
from dataclasses import dataclass, field
from typing import Any

from torchrl_sspl.errors import ConfigError

BACKENDS = ("sync", "process", "ray")
RESIDUALS = 64  # observed errors nearby from which those of a latent are taken
LARGEST_SEED = 2**64 - 1  # that torch takes
LOWEST_LEVEL = -0.2  # to which held-out checks may shift the barrier
MOST_NEAR_DRAWS = 10  # of rollouts in a round; the next seed is that of the rim of U
PRESETS = ("sound", "paper", "quick", "smoke")
_CHOICES = {
    "collector.backend": BACKENDS,
    "network.barrier": ("sandwich", "lmi"),
    "optim.schedule": ("cosine", "constant"),
    "loss.preset": ("sound", "paper"),
    "trainer.autocast": ("none", "bfloat16", "float16"),
    "synthesis.teacher": ("clearance", "value"),
    "logger.kind": ("csv", "wandb", "tensorboard", "none"),
}

#: Values that would fail only when everything before them is trained.
_LEAST = {
    0: "seed evaluation.seed evaluation.walk_seed evaluation.episodes evaluation.walks evaluation.renderer_episodes evaluation.grid "
    "evaluation.kernel_grid evaluation.certificate_episodes evaluation.certificate_seconds synthesis.steady_steps synthesis.dynamics_steps "
    "synthesis.teach_steps synthesis.fit_steps synthesis.steer_steps synthesis.tune_steps synthesis.tighten_steps synthesis.dynamics_outlier "
    "synthesis.tolerated_error synthesis.rollout_transitions synthesis.rim_transitions synthesis.counterexamples synthesis.choices synthesis.retries "
    "synthesis.guard synthesis.leave_share synthesis.safe_share synthesis.cover_share synthesis.return_share synthesis.margin synthesis.unsafe_margin "
    "synthesis.unsafe_weight synthesis.exploration synthesis.residual_spread synthesis.teach_spread synthesis.recovery_coeff synthesis.change_coeff "
    "synthesis.choice_margin synthesis.lr optim.lr optim.weight_decay",
    1: "network.latent_dim evaluation.horizon evaluation.envs synthesis.episode_steps synthesis.transitions synthesis.residuals synthesis.actions "
    "synthesis.rim_draws synthesis.near_draws synthesis.check_episodes synthesis.check_horizon network.dynamics_hidden network.policy_hidden buffer.batch "
    "trainer.optim_steps_per_batch trainer.keep_checkpoints",
    4: "synthesis.turns synthesis.batch",
}
_ABOVE = {0: "network.lipschitz_bound synthesis.band evaluation.walk_seconds trainer.clip_norm"}
_MOST = {
    1: "synthesis.leave_share synthesis.safe_share synthesis.cover_share synthesis.return_share",
    MOST_NEAR_DRAWS: "synthesis.near_draws",
    RESIDUALS: "synthesis.residuals",
    LARGEST_SEED: "seed evaluation.seed evaluation.walk_seed",
}


def _option(default: Any, meaning: str) -> Any:
    """A field with its meaning and its default: a value, a list that is copied, or what makes a section."""
    if callable(default) or isinstance(default, list):
        make = default if callable(default) else default.copy
        return field(default_factory=make, metadata={"meaning": meaning})
    return field(default=default, metadata={"meaning": meaning})


# fmt: off  (an option and its meaning are read together)
@dataclass
class NetworkConfig:
    """Encoder, latent dynamics, barrier and policy."""

    latent_dim: int = _option(3, "size p of the latent.")
    lipschitz_bound: float = _option(2.0, "Lipschitz bound L_B of the barrier.")
    barrier: str = _option("sandwich", '"sandwich" (Lipschitz by construction) or "lmi" (as in the paper, with a loss '
        'and a step of its own).')
    barrier_hidden: list[int] = _option([64, 64, 64], "widths of the barrier's hidden layers.")
    dynamics_hidden: list[int] = _option([64, 64], "widths of the latent dynamics' hidden layers.")
    policy_hidden: list[int] = _option([32, 32], "widths of the policy's hidden layers.")
    encoder: str = _option("FrameEncoder", 'name of an encoder of the library ("FrameEncoder": convolutions, '
        '"ContrastEncoder": convolutions on what differs from the background, "MomentEncoder": centres of colours before a background, "ShapeEncoder": place and direction of one thing of one '
        'colour, "BearingEncoder": where the thing that stands still lies, seen from the one that moves, "TurnedBearingEncoder": and its orientation, "ShapeBearingEncoder": the same as BearingEncoder for what moves in one colour, "ShapePlaceEncoder": where that is and heads), or "package.module:Class" of your own, called with '
        'those of latent_dim, image_size, pool_to and velocity_gain that it takes.')
    pool_to: int = _option(32, "frames are averaged to this height and width before the first layer, in pixels.")
    velocity_gain: float = _option(4.0, "factor on the difference of the two frames' features.")
    remember_action: bool = _option(False, "whether the last entries of the latent are the last action, for systems that act "
        "with a delay; for encoders that leave these entries to the memory (BearingEncoder).")


@dataclass
class LossConfig:
    """The total loss; null leaves an option as its preset has it."""

    preset: str = _option("sound", '"sound" or "paper" (the losses as printed).')
    safety_margin: float | None = _option(None, "margin of the hinges on S and U.")
    safe_coeff: float | None = _option(None, "weight of the hinge on S.")
    unsafe_coeff: float | None = _option(None, "weight of the hinge on U.")
    dynamics_margin: float | None = _option(None, "margin of the invariance condition.")
    consistency_coeff: float | None = _option(None, "weight of the latent consistency.")
    inverse_dynamics_coeff: float | None = _option(None, "weight of reading the action from two latents.")
    variance_coeff: float | None = _option(None, "weight of the standard deviation that every latent dimension should "
        "reach.")
    covariance_coeff: float | None = _option(None, "weight of the penalty on correlated latent dimensions.")
    saturation_coeff: float | None = _option(None, "weight of the penalty on saturated latents.")
    saturation_limit: float | None = _option(None, "size from which a latent counts as saturated.")
    synthesis_coeff: float | None = _option(None, "weight of the invariance condition.")
    policy_coeff: float | None = _option(None, "weight of the deviation from the user's policy.")
    growth_coeff: float | None = _option(None, "weight of growth where the successor is inside.")
    descent_coeff: float | None = _option(None, "weight of the policy's descent on the barrier.")
    off_manifold_coeff: float | None = _option(None, "weight of the condition on uniform latents.")
    worst_coeff: float | None = _option(None, "extra weight of the worst rows.")
    successor: str | None = _option(None, 'networks that value the successor, "online" or "target".')
    reduction: str | None = _option(None, '"mean" or "sum" over the batch.')


@dataclass
class CollectorConfig:
    """Where transitions come from."""

    backend: str = _option("sync", '"sync" (this process), "process" (others on this machine) or "ray" (a cluster).')
    workers: int = _option(1, 'collectors; more than one needs "process" or "ray".')
    envs: int = _option(16, "environments per collector, stepped together.")
    frames_per_batch: int = _option(1280, "transitions per batch, over all collectors.")
    init_random_frames: int | None = _option(None, "transitions under random actions before learning starts; null is "
        "half of trainer.total_frames, 12800 at most.")
    max_frames_per_traj: int | None = _option(10, "steps after which an episode is cut, so that many start; null "
        "leaves that to the environment.")
    exploration: float = _option(0.1, "standard deviation of the noise on the policy's actions, as a share of the "
        "largest action.")
    random_share: float = _option(0.5, "share of the environments that act at random all the time; 1: the policy does "
        "not act.")
    starts: list[float] = _option([0.5, 0.0, 0.5, 0.0], "shares of the episodes that start anywhere, outside U, in S "
        "and in U, where the environment knows its sets; others start with their own resets.")
    ray_address: str = _option("", 'address of a running Ray cluster; "" starts a local one.')


@dataclass
class BufferConfig:
    """The store of transitions, every frame once."""

    capacity: int = _option(100_000, "transitions.")
    batch: int = _option(128, "transitions per optimiser step.")
    safe: float = _option(0.2, "share of a batch that starts in S.")
    unsafe: float = _option(0.2, "share of a batch that starts in U.")


@dataclass
class AugmentationConfig:
    """Changes of the pictures that should not matter, one camera for each episode of the training."""

    share: float = _option(0.0, "chance of each of them in an episode (0: off).")
    noise: float = _option(12.0, "largest standard deviation of noise, grey levels of 255.")
    brightness: float = _option(0.15, "largest change of the brightness, as a share of it.")
    shift: float = _option(1.0, "largest shift of the camera along each axis, pixels of 64.")


@dataclass
class LabelsConfig:
    """Which of the labels that the environment gives are used in the training; held-out checks have their own."""

    safe: int | None = _option(None, "labels of S at most, those that come first; everything else is unlabelled; null: all.")
    unsafe: int | None = _option(None, "the same of U.")
    wrong: float = _option(0.0, "chance that a label is the other one.")
    share: float = _option(1.0, "chance that a picture of S or of U has a label; below 1 labels are spread over more of the data, and, without choose, say which "
        "pictures without one count as of U.")
    choose: int = _option(0, "further pictures that are labelled, of S, of U or of neither: those of which the latents tell least.")


@dataclass
class OptimConfig:
    """The optimiser of the joint training (Adam)."""

    lr: float = _option(3e-3, "learning rate, the largest one where it changes.")
    schedule: str = _option("cosine", '"cosine" (rises over the first tenth of the steps, falls to zero until the '
        'last) or "constant".')
    weight_decay: float = _option(0.0, "weight decay.")
    target_tau: float = _option(0.01, "step of the delayed networks theta^-, where the loss has any.")


@dataclass
class TrainerConfig:
    """The joint training on pictures: SSPLLoss in TorchRL's loop."""

    total_frames: int = _option(25_600, "transitions to collect.")
    optim_steps_per_batch: int = _option(400, "optimiser steps per collected batch.")
    warm_start_steps: int = _option(1200, "of these, the first on the world model alone; -1: all of them, policy and "
        "barrier are left to the phases on frozen latents.")
    warm_start_error: float | None = _option(0.05, "share of S and U on the wrong side of the barrier, summed, down "
        "to which only the world model is trained; null: only warm_start_steps counts.")
    restarts: int = _option(2, "fresh starts with other initial weights, at most, where after warm_start_steps that "
        "share exceeds warm_start_error and no longer falls; 0 for none. Without a warm start there is nothing to "
        "judge by, and none happens.")
    margins: bool = _option(False, "re-estimate both margins before the steps of every batch, as the paper does.")
    clip_norm: float = _option(5.0, "bound on the norm of the gradient.")
    checkpoint_seconds: float = _option(30.0, "seconds between checkpoints, in every phase; negative for none.")
    keep_checkpoints: int = _option(2, "checkpoints that are kept.")
    evaluate_every: int = _option(0, "batches between evaluations that are logged; 0 for none before the end.")
    autocast: str = _option("none", 'mixed precision, "none", "bfloat16" or "float16".')
    compile: bool = _option(False, "compile the loss with torch.compile.")
    progress: bool = _option(True, "show progress bars.")


@dataclass
class SynthesisConfig:
    """The phases on frozen latents: dynamics, policy and barrier, in rounds, each ended by held-out checks."""

    enabled: bool = _option(True, "whether they follow the joint training; never with loss.preset=paper, which trains "
        "as printed.")
    rounds: int = _option(1, "rounds of data, refit, synthesis and fine-tuning.")
    retries: int = _option(0, "further attempts at barrier and policy with fresh weights, on the same data and dynamics, where no round has passed its "
        "checks and the environment knows its sets; each is checked on held-out pictures and episodes of its own.")
    gain: float = _option(1.0, "gain k of the latent observer: the latent is the prediction, moved by this share towards "
        "what is seen; 1: only what is seen.")
    episode_steps: int | None = _option(None, "longest episode of the transitions collected for these phases; null is "
        "collector.max_frames_per_traj. An observer learns from episodes, not from single steps.")
    transitions: int = _option(40_000, "encoded transitions of the first round: those of the joint training and, "
        "where the environment knows its sets, further ones under random actions. Of more than that, all that start "
        "in S or U, at most half of them, and others at random.")
    rollout_transitions: int = _option(20_000, "transitions of the policy (with exploration) that every further round "
        "adds: those near the set, of near_draws times as many at most.")
    near_draws: int = _option(10, "see rollout_transitions; at most 10, and 1 bounds what a training takes by what is asked for.")
    rim_transitions: int = _option(8_000, "transitions that start in U that every further round adds: of rim_draws "
        "times as many those whose pictures the barrier puts lowest. With a grid the first round adds as many, anywhere in U.")
    rim_draws: int = _option(5, "see rim_transitions.")
    exploration: float = _option(0.15, "standard deviation of the exploration in further rounds, as a share of the "
        "largest action.")
    steady_steps: int = _option(0, "steps of the encoder alone, before all others, after which pictures changed as in augmentation show "
        "what unchanged ones do; the data stay unchanged then, and the fine-tuning keeps U away from the set by what the changes still do (which targets on a grid leave out). "
        "0: augmentation changes the data.")
    dynamics_steps: int = _option(1500, "optimiser steps of the refit of the latent dynamics.")
    unsafe_weight: float = _option(1.0, "weight of transitions that start in U in the refit of the dynamics; below 1 "
        "where the pictures there are not worth the networks' capacity (a robot in front of the obstacle that it stands on).")
    dynamics_outlier: float = _option(0.0, "error of the dynamics, latent units, beyond which it counts in proportion in their refit, no longer squared, "
        "where some pictures show less than the state (a robot cut by the border of the frame). 0: never.")
    tube_radius: float = _option(0.3, "distance from the data up to which a latent off the manifold may belong to the "
        "safe set.")
    grid: int = _option(0, "nodes per entry that pictures show of a grid over the latent domain, on which the barrier's targets are found "
        "by dynamic programming, under four times tolerated_error and with the actions of choices; for latents that the data fill. 0: the "
        "targets are found on the cloud of the data.")
    turns: int = _option(32, "nodes of that grid around a direction, where the latent holds one.")
    tolerated_error: float = _option(0.0, "error per step that the set is meant to be proved to tolerate, latent units: the "
        "invariant set of the data keeps a quarter more, the fine-tuning requires the condition under the worst error of this size, and "
        "then the training uses counterexamples of the proof. 0: residual_spread counts, and the proof is not considered.")
    residuals: int = _option(16, "observed errors of the dynamics per latent that the fine-tuning adds to successors, at most 64.")
    residual_spread: float = _option(1.5, 'standard deviations of the local error that the invariant set of the data '
        'tolerates; with teacher "value" lowered by quarters where nine tenths of S could not be kept otherwise.')
    actions: int = _option(7, "actions per dimension tried at every latent.")
    choices: int = _option(0, "actions per dimension from which the policy chooses, by the barrier of the predicted next latent, "
        "where its own action would not keep the set; 0: it does not choose.")
    choice_margin: float = _option(0.02, "its own action is taken only if it leads at least this far below zero.")
    teacher: str = _option("value", 'what teaches the policy before the barrier is fitted: "clearance" (the action '
        'that ends farthest from what lies outside the invariant set, together with the barrier) or "value" (the '
        'action that keeps the largest distance from U on all that follows, before the barrier, which then learns '
        'what this very policy keeps; for systems in which the best action jumps, as from left to right of an '
        'obstacle).')
    teach_steps: int = _option(1500, 'steps of the policy alone on the values of actions ("value").')
    teach_spread: float = _option(1.0, 'standard deviations of the local error that the values of actions tolerate '
        '("value"); larger than residual_spread, the policy acts earlier than its set needs.')
    fit_steps: int = _option(1500, "steps in which barrier and policy are regressed onto their targets.")
    steer_steps: int = _option(300, "steps of the policy alone on the condition, with the barrier held still.")
    tune_steps: int = _option(3000, "steps of the joint fine-tuning on the losses of the condition.")
    tighten_steps: int = _option(2000, "steps on counterexamples of the proof, where tolerated_error or grid is positive.")
    margin: float = _option(0.1, "margin m of the condition R3, B <= 0 implies B(d(z, pi(z))) + m <= 0.")
    band: float = _option(0.1, "barrier value up to which R3 is asked.")
    batch: int = _option(512, "latents per step, at least 4.")
    lr: float = _option(1e-3, "peak learning rate of the fine-tuning.")
    counterexamples: int = _option(256, "latents of the whole domain at which the condition fails that each search "
        "adds to the batches of the fine-tuning (0: off).")
    unsafe_margin: float = _option(0.05, "hinge margin on labelled unsafe latents.")
    recovery_coeff: float = _option(0.3, "weight of the action that leads back, on latents outside the set.")
    change_coeff: float = _option(0.0, "weight of changes of the action from step to step deep inside the set, in the fine-tuning "
        "(which targets on a grid leave out).")
    guard: float = _option(0.02, "distance that held-out observations of U keep from the zero level (units of the "
        "barrier).")
    lowest_level: float | None = _option(None, "lowest level to which the checks of a round may move the set, at least -0.2; null: -0.6 margin, below which "
        "the trained condition says nothing of a level. Few labels need a lower one: episodes have to tell then whether it is kept.")
    leave_share: float = _option(0.00075, "largest share of the held-out episodes of a round that may leave the set; "
        "none may touch U.")
    safe_share: float = _option(0.0, "share of the held-out pictures of S that may lie outside the set, where noise makes all of S too "
        "much to keep; above zero, the smallest change after a grid has no condition on S.")
    cover_share: float = _option(0.0, "share of the held-out episodes to which the proof has to apply from the first step "
        "to the last; sets that reach it are preferred to all others. 0: no proof is tried before the end.")
    return_share: float = _option(0.97, "share of the held-out episodes from U that should end in the set; among sets "
        "that pass, one that reaches it is preferred to a larger one that does not.")
    check_episodes: int = _option(4000, "held-out episodes of a round's check, where the environment knows its sets.")
    check_horizon: int = _option(40, "steps of each.")


@dataclass
class EvaluationConfig:
    """Evaluation of the frozen agent on fresh data."""

    episodes: int = _option(200, "episodes under the policy: from {B <= 0} where the environment knows its sets (and "
        "a fifth as many each from S and from U; 0: nothing is measured against the true kernel), else from its "
        "resets, and as many under random actions and to place the zero level.")
    horizon: int = _option(50, "steps per episode.")
    envs: int = _option(20, "environments stepped together, of systems that are only known by running them.")
    grid: int = _option(0, "states per dimension of the grid over the state space; 0: the system's own.")
    kernel_grid: int = _option(0, "states per dimension of the grid of the true kernel; 0: the system's own.")
    renderer_episodes: int = _option(0, "episodes on every further renderer of the system (0: not evaluated).")
    walks: int = _option(0, "episodes in full physics from S, and as many from {B <= 0}, where the system has a full "
        "physics (0: none).")
    walk_seconds: float = _option(8.0, "longest of these.")
    walk_seed: int = _option(20260102, "seed of their starts.")
    seed: int = _option(20260101, "seed of the evaluation's own random numbers.")
    calibrate: bool = _option(True, "place the zero level between held-out observations of S and U before anything is "
        "measured; where the environment knows its sets, the rounds' checks have placed it.")
    certificate_episodes: int = _option(1000, "fresh episodes from the set, and fresh observations of U, behind what "
        "the certificate measures (0: it says only what the weights prove).")
    certificate_seconds: float = _option(60.0, "after which each search for a proof gives up.")


@dataclass
class LoggerConfig:
    """Where numbers, figures and films go, beside the report."""

    kind: str = _option("csv", '"csv" (files in <out_dir>/csv), "wandb" (on disk only without a key or a network), '
        '"tensorboard" or "none".')
    project: str = _option("torchrl-sspl", "project of the run (wandb).")


@dataclass
class Config:
    """Everything that determines a run; written beside its results."""

    preset: str = _option("sound", '"sound" (the recommended one), "paper" (losses and schedule as printed), '
        '"quick" (a first verdict in minutes) or "smoke" (seconds, for tests); a file each.')
    env: dict[str, Any] = _option(dict, "what is built: an import path ``_target_`` and its arguments.")
    network: NetworkConfig = _option(NetworkConfig, "networks.")
    loss: LossConfig = _option(LossConfig, "the total loss.")
    collector: CollectorConfig = _option(CollectorConfig, "where transitions come from.")
    buffer: BufferConfig = _option(BufferConfig, "store of transitions.")
    augmentation: AugmentationConfig = _option(AugmentationConfig, "changes of the pictures.")
    labels: LabelsConfig = _option(LabelsConfig, "few labels, and wrong ones.")
    optim: OptimConfig = _option(OptimConfig, "optimiser of the joint training.")
    trainer: TrainerConfig = _option(TrainerConfig, "joint training.")
    synthesis: SynthesisConfig = _option(SynthesisConfig, "phases on frozen latents.")
    evaluation: EvaluationConfig = _option(EvaluationConfig, "evaluation of the frozen agent.")
    logger: LoggerConfig = _option(LoggerConfig, "where numbers go.")
    agent: str = _option("", 'shipped agent, or run directory, that is evaluated in place of one that is trained; "": '
        'train.')
    seed: int = _option(0, "seed of data, initial weights and batches.")
    device: str = _option("cpu", 'device of what works on pictures, such as "cpu" or "cuda"; the phases on latents '
        'stay on the CPU.')
    out_dir: str = _option("runs/experiment", "directory of the run.")

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
        if self.trainer.total_frames < 1:
            raise ConfigError(f"expected trainer.total_frames >= 1, received {self.trainer.total_frames}")
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
        if self.synthesis.enabled and self.synthesis.steady_steps > 0 and not self.augmentation.share > 0:
            raise ConfigError(
                f"expected augmentation.share > 0 with synthesis.steady_steps={self.synthesis.steady_steps}, received {self.augmentation.share}: "
                "there is nothing to be steady under; synthesis.steady_steps=0 leaves the encoder as it is"
            )
        if self.evaluation.seed == self.seed:
            raise ConfigError(f"expected evaluation.seed to be another one than seed={self.seed}, with which the data of the training are drawn; choose a fresh one")
        self._check_labels()
        if self.synthesis.rounds < 1:
            raise ConfigError(f"expected synthesis.rounds >= 1, received {self.synthesis.rounds}; synthesis.enabled=false for none")
        self._check_bounds()
        s = self.synthesis
        if s.grid and (s.grid < 3 or s.teacher != "value"):
            raise ConfigError(
                f"expected synthesis.grid=0, or at least 3 nodes and synthesis.teacher=value, whose policy the targets on a grid take "
                f"over, received grid={s.grid} and teacher={s.teacher}"
            )
        if s.lowest_level is not None and not LOWEST_LEVEL <= s.lowest_level <= 0.0:
            raise ConfigError(f"expected synthesis.lowest_level between {LOWEST_LEVEL} and 0, or null, received {s.lowest_level}")
        if s.rounds > 1 and s.rollout_transitions < 1:
            raise ConfigError(f"expected synthesis.rollout_transitions >= 1 with synthesis.rounds={s.rounds}, received {s.rollout_transitions}")
        return self

    def _check_labels(self) -> None:
        labels, kept = self.labels, self.buffer.capacity
        if labels.choose and not (self.synthesis.enabled and self.loss.preset != "paper"):
            raise ConfigError(
                f"expected labels.choose=0 without the synthesis on frozen latents (synthesis.enabled=false, or loss=paper), received {labels.choose}: "
                "pictures are chosen on its latents"
            )
        if (labels.safe, labels.unsafe) != (None, None) and kept < self.trainer.total_frames:
            raise ConfigError(
                f"expected buffer.capacity >= trainer.total_frames={self.trainer.total_frames} with limits of labels, received {kept}: what is overwritten "
                "takes its label with it, and no other one is given"
            )

    def _check_bounds(self) -> None:
        for sign, holds, bounds in ((">=", operator.ge, _LEAST), (">", operator.gt, _ABOVE), ("<=", operator.le, _MOST)):
            for bound, keys in bounds.items():
                for key in keys.split():
                    section, _, name = key.rpartition(".")
                    value = getattr(getattr(self, section) if section else self, name)
                    if not all(holds(v, bound) for v in (value if isinstance(value, list) else [value]) if v is not None):
                        raise ConfigError(f"expected {key} {sign} {bound}, received {value}")
        for key, grid in (("grid", self.evaluation.grid), ("kernel_grid", self.evaluation.kernel_grid)):
            if grid == 1:
                raise ConfigError(f"expected evaluation.{key} of 0 (the system's own) or at least 2, received 1")


__all__ = [
    "AugmentationConfig", "BufferConfig", "CollectorConfig", "Config", "EvaluationConfig", "LabelsConfig", "LoggerConfig", "LossConfig", "NetworkConfig",
    "OptimConfig", "PRESETS", "SynthesisConfig", "TrainerConfig",
]
