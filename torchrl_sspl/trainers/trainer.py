"""TorchRL's trainer for the whole method: the joint training on pictures, then the phases on frozen latents."""

from __future__ import annotations

import json
import math
import os
import time
from collections import defaultdict, deque
from collections.abc import Callable, Mapping
from contextlib import suppress
from functools import partial
from pathlib import Path
from typing import Any

import torch
from tensordict import TensorDict
from tensordict.nn import TensorDictModuleBase
from torchrl.checkpoint import Checkpoint, CheckpointRotation, GlobalRNGState
from torchrl.data import ReplayBuffer
from torchrl.objectives import SoftUpdate, TargetNetUpdater
from torchrl.trainers import ReplayBufferTrainer, TargetNetUpdaterHook, Trainer, UpdateWeights

from torchrl_sspl.errors import CheckpointError, ConfigError, OutputError, SSPLError
from torchrl_sspl.interrupts import Interrupted, end_if_pending, interruptible, pending, saving
from torchrl_sspl.modules import make_rollout_policy
from torchrl_sspl.objectives import LipschitzLoss, SSPLLoss
from torchrl_sspl.trainers.hooks import ClockHook, EveryHook, FitEncoderHook, LogHook, MarginHook, SeedHook
from torchrl_sspl.trainers.loggers import log_figure
from torchrl_sspl.trainers.phases import LOG_FILE, Phases
from torchrl_sspl.trainers.progress import Progress
from torchrl_sspl.trainers.stepper import SSPLStepper

Call = Callable[["SSPLTrainer"], Mapping[str, Any]]
_PICTURES = ("replay_buffer", "trainer_module.replay_buffer")  # components that hold pictures
_ADDED = ("logger", "trainer_module.evaluate")  # components that a run may get when it goes on


class _RNGState(GlobalRNGState):
    """Random numbers of the process; a run that began on a GPU may go on without one."""

    def load_state_dict(self, state_dict: Mapping[str, Any]) -> None:
        lacking = set() if torch.cuda.is_available() else {"torch_cuda"}
        super().load_state_dict({k: v for k, v in state_dict.items() if k not in lacking})


def _check_sizes(checkpoint: Path) -> None:
    """A ValueError for a file that is not as long as its tensor: upstream fills it up with zeros, and goes on with them."""
    for about in checkpoint.rglob("meta.json"):
        for name, value in json.loads(about.read_text()).items():
            if isinstance(value, dict) and "dtype" in value:
                size = math.prod(value["shape"]) * getattr(torch, value["dtype"].removeprefix("torch.")).itemsize
                if not size:  # an empty tensor has no file
                    continue
                found = (about.parent / f"{name}.memmap").stat().st_size
                if found != size:
                    raise ValueError(f"{found} bytes in place of {size} in {about.parent.relative_to(checkpoint) / name}.memmap")


def _takes(collector: Any, policy: TensorDictModuleBase) -> bool:
    """Whether a collector's policy is to be given the weights of this one; a ConfigError if it is another one with weights of its own."""
    acts = getattr(collector, "policy", None)
    if not isinstance(acts, torch.nn.Module):  # in other processes
        return True
    has, wanted = ({name for name, _ in net.named_parameters()} for net in (acts, policy))
    if has and not wanted <= has:
        raise ConfigError(
            f"expected a collector whose policy has the parameters of rollout_policy, received one that lacks {sorted(wanted - has)[:3]}; give it as "
            "rollout_policy=..., or let the collector act by make_rollout_policy(salad, policy)"
        )
    return bool(has)  # random actions have none


class SSPLTrainer(Trainer):
    r"""Algorithm 1 on TorchRL's trainer.

    Per collected batch: store it; re-estimate the margins; ``optim_steps_per_batch`` steps on the total loss (and on
    :math:`L_M` where the barrier needs it), each followed by the target-network update; hand the new weights to the
    collector; evaluate, draw, check whether to stop; save. When all transitions are collected, the ``phases`` follow.
    With ``checkpoint_dir`` a run that was killed at any moment continues from its last complete checkpoint through
    :meth:`resume`, and on one CPU process ends with the very weights of a run that was never killed, if the collector
    resets at each iteration (``reset_at_each_iter=True``).

    Args:
        collector: TorchRL collector.
        total_frames: transitions to collect.
        loss_module: the total loss.
        optimizer: optimiser of the total loss.
        replay_buffer: where transitions go and batches come from, such as ``TransitionStore.replay_buffer``.
        optim_steps_per_batch: steps per collected batch.
        frame_skip: environment steps per transition.
        warm_start_steps: steps on the world model alone, before everything else counts; -1: all of them.
        warm_start_error: share of S and U on the wrong side down to which it goes on; ``None`` goes by the steps alone.
        target_net_updater: updater of :math:`\theta^-`, for a loss with delayed networks alone; ``None`` gives
            ``SoftUpdate(loss_module, tau=0.01)`` then.
        lipschitz_loss, lipschitz_optimizer: :math:`L_M` for an ``LMIBarrier``, and its optimiser.
        margins: re-estimates the margins; ``None`` keeps those of the loss.
        rollout_policy: policy whose weights the collector is given after every batch, by default encoder and policy of the loss; a collector
            whose policy has no weights keeps it.
        evaluate, evaluate_every: ``trainer -> mapping of floats``, logged after so many batches; the entry ``"stop"``
            (a text) ends the training.
        draw, draw_every: ``trainer -> mapping of names to figures``, given to the logger after so many batches.
        checkpoint_dir: folder of the checkpoints; ``None`` for none.
        checkpoint_seconds: seconds between checkpoints; 0 saves after every optimiser step.
        keep_checkpoints: number of checkpoints that are kept.
        autocast: dtype of mixed precision.
        phases: what follows when all transitions are collected.
        out_dir: where ``log.jsonl`` is written; ``None``: nowhere.
        progress_bar: show one bar over the joint training and the phases.
        **trainer_options: of ``torchrl.trainers.Trainer``, such as ``logger``, ``clip_norm``, ``log_interval``,
            ``seed``.

    Raises ConfigError if the loss is no ``SSPLLoss``, or arguments do not go together. Source: paper, Algorithm 1;
    deviations: see the loss and the hooks.

    Example:
        >>> from torchrl.collectors import Collector
        >>> from torchrl_sspl.data import TransitionStore
        >>> from torchrl_sspl.envs import PendulumEnv
        >>> from torchrl_sspl.modules import Policy, SaLaD
        >>> _ = torch.manual_seed(0)
        >>> env = PendulumEnv(batch_size=[4], image_size=16, seed=0)
        >>> env.initial_set = env.safe_set | env.unsafe_set
        >>> salad = SaLaD.from_sizes(2, 1, action_scale=env.max_action, pool_to=8)
        >>> policy = Policy(2, 1, action_scale=env.max_action)
        >>> loss = SSPLLoss(*salad, policy)
        >>> collector = Collector(env, make_rollout_policy(salad, policy), frames_per_batch=64, total_frames=128,
        ...                       reset_at_each_iter=True, auto_register_policy_transforms=False)
        >>> trainer = SSPLTrainer(collector=collector, total_frames=128, loss_module=loss,
        ...                       optimizer=torch.optim.Adam(loss.parameters(), 1e-3), optim_steps_per_batch=2,
        ...                       replay_buffer=TransitionStore(256).replay_buffer(16), progress_bar=False)
        >>> trainer.train()
        >>> trainer.collected_frames
        128
    """

    def __init__(
        self,
        *,
        collector: Any,
        total_frames: int,
        loss_module: SSPLLoss,
        optimizer: torch.optim.Optimizer,
        replay_buffer: ReplayBuffer,
        optim_steps_per_batch: int,
        frame_skip: int = 1,
        warm_start_steps: int = 0,
        warm_start_error: float | None = None,
        target_net_updater: TargetNetUpdater | None = None,
        lipschitz_loss: LipschitzLoss | None = None,
        lipschitz_optimizer: torch.optim.Optimizer | None = None,
        margins: MarginHook | None = None,
        rollout_policy: TensorDictModuleBase | None = None,
        evaluate: Call | None = None,
        evaluate_every: int = 1,
        draw: Call | None = None,
        draw_every: int = 1,
        checkpoint_dir: str | os.PathLike[str] | None = None,
        checkpoint_seconds: float = 30.0,
        keep_checkpoints: int = 2,
        autocast: torch.dtype | None = None,
        phases: Phases | None = None,
        out_dir: str | os.PathLike[str] | None = None,
        progress_bar: bool = True,
        **trainer_options: Any,
    ) -> None:
        target_net_updater = self._checked(loss_module, target_net_updater, trainer_options)
        stepper = SSPLStepper(
            optimizer, warm_start_steps=warm_start_steps, warm_start_error=warm_start_error, lipschitz_loss=lipschitz_loss,
            lipschitz_optimizer=lipschitz_optimizer, autocast=autocast,
        )  # fmt: skip
        if checkpoint_dir is not None:
            trainer_options |= {
                # In name order the generator comes after what might draw from it, the collector.
                "checkpoint": Checkpoint(rng=_RNGState()),
                "checkpoint_rotation": CheckpointRotation(checkpoint_dir, keep_last=keep_checkpoints),
            }
        self.checkpoint_seconds, self._saved_at = checkpoint_seconds, time.monotonic()
        super().__init__(
            collector=collector, total_frames=total_frames, frame_skip=frame_skip, loss_module=loss_module,
            optim_steps_per_batch=optim_steps_per_batch, optimization_stepper=stepper, replay_buffer=replay_buffer,
            target_net_updater=target_net_updater, progress_bar=False, **trainer_options,
        )  # fmt: skip
        self._log_dict: Any = defaultdict(partial(deque, maxlen=1))  # else all that was ever logged
        self.phases, self.clock, self.show_progress, self.resumed = phases, ClockHook(), progress_bar, False
        self._bar, self._joint = Progress(0, 0, shown=False), False
        self.fit_encoder: FitEncoderHook | None = None
        self._out_dir = None if out_dir is None else Path(out_dir)
        self._register(replay_buffer, margins, rollout_policy, None if out_dir is None else Path(out_dir) / LOG_FILE)
        if evaluate is not None:
            EveryHook(self, evaluate, every=evaluate_every).register(self, "evaluate")
        if draw is not None:
            EveryHook(self, partial(self._draw, draw), every=draw_every).register(self, "draw")
        if phases is not None:  # last: what they begin with is complete
            phases.register(self)

    @staticmethod
    def _checked(loss: SSPLLoss, updater: TargetNetUpdater | None, options: dict[str, Any]) -> TargetNetUpdater | None:
        """The target-network updater, after a look at what does not go together."""
        if not isinstance(loss, SSPLLoss):
            raise ConfigError(f"expected loss_module to be an SSPLLoss, received {type(loss).__name__}")
        if options.get("learner_backend", "local") != "local":
            raise ConfigError(
                f"expected learner_backend='local', received {options['learner_backend']!r}; TorchRL's remote learner "
                "sends collectors the weights of actor_network alone, and a policy from pixels needs those of the encoder "
                "too; put the collectors on Ray instead"
            )
        delayed = any(name.startswith("target_") for name, _ in loss.named_children())
        if updater is not None and not delayed:
            raise ConfigError(
                "expected no target_net_updater for a loss without delayed networks, received "
                f"{type(updater).__name__}; choose consistency='target' or successor='target', or leave it out"
            )
        return SoftUpdate(loss, tau=0.01) if delayed and updater is None else updater

    def _register(
        self, replay_buffer: Any, margins: MarginHook | None, rollout_policy: TensorDictModuleBase | None, log: Path | None
    ) -> None:
        """The hooks of the joint training, in the order in which they act."""
        loss, device = self.loss_module, next(self.loss_module.parameters()).device
        replay = ReplayBufferTrainer(replay_buffer, flatten_tensordicts=True, device=None if device.type == "cpu" else device)
        self.register_op("batch_process", replay.extend)
        self.register_op("process_optim_batch", replay.sample)
        self.register_module("replay_buffer", replay)
        if self.target_net_updater is not None:
            self.register_op("post_optim", TargetNetUpdaterHook(self.target_net_updater))
        if rollout_policy is None and loss.encoder is not None:
            rollout_policy = make_rollout_policy(loss.encoder, loss.actor_network)
        if rollout_policy is not None and _takes(self.collector, rollout_policy):
            weights = partial(TensorDict.from_module, rollout_policy)
            self.register_op("post_steps", UpdateWeights(self.collector, 1, policy_weights_getter=weights))
        encoder = getattr(loss.encoder, "module", None)
        store = getattr(replay_buffer, "storage", None)
        if callable(getattr(encoder, "fit", None)) and hasattr(store, "n_frames"):
            self.fit_encoder = FitEncoderHook(self, encoder, store)
            self.fit_encoder.register(self)
        if margins is not None:
            margins.register(self)
        SeedHook(self.collector).register(self)
        self.clock.register(self)
        LogHook(log).register(self)
        self.register_op("post_optim", self._tick)

    def train(self) -> None:
        """Train, or continue to train, to the end: the joint training, then the phases.

        SIGINT and SIGTERM save the state and end the process with exit code 130 or 143.
        """
        with interruptible(self._saved), saving():
            self._train()

    def _train(self) -> None:
        self.clock.start()
        self._bar = Progress(
            self._joint_steps() + (0 if self.phases is None else self.phases.steps),
            self._optim_count + (0 if self.phases is None else self.phases.steps_done),
            shown=self.show_progress, resumed=self.resumed, out_dir=self._out_dir,
        )  # fmt: skip
        self._bar.begin("collecting pictures", 0)
        self._joint = False
        if self.phases is not None:
            self.phases.bar = self._bar
        try:
            if self.optimization_stepper.inside:
                self._finish_batch()
            begun = self.phases is not None and self.phases.begun
            if self.collected_frames < self.total_frames and not self._stop_training and not begun:
                super().train()
            else:
                if self.phases is not None and not self.phases.finished:
                    self.phases.run()
                    self.save_trainer(force_save=True)
                self.collector.shutdown()
        except BaseException as error:
            with suppress(Exception):
                self.collector.shutdown()  # its processes would outlive an exception
            if not isinstance(error, Interrupted | SSPLError):
                end_if_pending()  # a signal to all processes ends the workers as well, and what waits for them fails
            raise
        finally:
            self._bar.close()

    def _finish_batch(self) -> None:
        """The steps on a collected batch that a checkpoint had cut in two, and what follows them."""
        self.optim_steps(None)
        self._post_steps_hook()
        self._post_steps_log_hook(None)
        self.save_trainer(force_save=self._stop_training)

    def optim_steps(self, batch: Any) -> None:
        """The steps on what was collected, or those that are missing; a checkpoint may lie between any two of them."""
        stepper = self.optimization_stepper
        whole = int(self.optim_steps_per_batch)  # type: ignore[has-type]
        self._last_step, self.optim_steps_per_batch = whole, whole - stepper.inside
        try:
            super().optim_steps(batch)
        finally:
            self.optim_steps_per_batch = whole
        stepper.begin_batch()

    def _pre_optim_hook(self) -> None:
        if not self.optimization_stepper.inside:  # once a batch
            super()._pre_optim_hook()

    def _post_optim_log(self, batch: Any) -> None:
        super()._post_optim_log(batch)
        if self.num_epochs == 1 and self.optimization_stepper.inside < self._last_step:
            self.save_trainer()

    def _post_optim_complete_log_hook(self, optim_steps: int, average_losses: Any) -> None:
        # Of the steps before an interruption the trainer's own mean knows nothing.
        super()._post_optim_complete_log_hook(optim_steps, TensorDict(self.optimization_stepper.mean))

    def _saved(self) -> str:
        """Where a run goes on."""
        rotation = self.checkpoint_rotation
        if rotation is None or rotation.latest() is None:
            return "nothing was saved"
        return f"the state is in {rotation.latest()}; the same command resumes from there"

    def _joint_steps(self) -> int:
        """Optimiser steps of the joint training, in all."""
        frames = max(1, int(getattr(self.collector, "requested_frames_per_batch", 0) or self.collector.frames_per_batch))
        before = -(-max(0, int(self.collector.init_random_frames or 0)) // frames)
        return max(1, -(-self.total_frames // frames) - max(before, 1) + 1) * int(self.optim_steps_per_batch or 1)

    def _tick(self) -> None:
        if not self._joint:
            self._joint, left = True, 0 if self.phases is None else len(self.phases.phases)
            self._bar.begin("joint training", self._joint_steps(), taken=self._optim_count, left=left)
        self._bar.tick(self._loss)

    def _loss(self) -> float | None:
        """Mean total of the steps on the batch that was collected last."""
        mean = self.optimization_stepper.mean
        return float(sum(v for k, v in mean.items() if k.startswith("loss_"))) if mean else None

    @staticmethod
    def _draw(draw: Call, trainer: SSPLTrainer) -> dict[str, Any]:
        for name, figure in draw(trainer).items():
            log_figure(trainer.logger, name, figure, trainer.collected_frames)
        return {}

    def save_trainer(self, force_save: bool = False) -> None:
        """Save when ``checkpoint_seconds`` have passed since the last checkpoint, when it is asked for, or at a signal."""
        if self._has_checkpoint_destination() and (
            force_save or pending() or time.monotonic() - self._saved_at >= self.checkpoint_seconds
        ):
            self._save_trainer()
            self._saved_at = time.monotonic()
        end_if_pending()

    def _save_trainer(self) -> None:
        """Write a checkpoint; inside the phases without the pictures, once these are not needed any more."""
        if self.checkpoint_rotation is None:
            return super()._save_trainer()
        checkpoint = self._sync_checkpoint_components()
        inside = self.phases is not None and self.phases.begun
        left_out = _PICTURES if inside and not self.phases.needs_pictures else ()  # type: ignore[union-attr]
        names = [name for name in checkpoint.components if name not in left_out]
        step = self.collected_frames + self._optim_count
        step += self.phases.steps_done + self.phases.done if inside else 0  # type: ignore[union-attr]
        metadata = self._checkpoint_manifest_metadata()
        try:
            self.checkpoint_rotation.save(checkpoint, step=step, components=names, metadata=metadata)
        except ConnectionError:  # of a worker that has ended
            raise
        except OSError as error:
            raise OutputError(
                f"expected to write a checkpoint to '{self.checkpoint_rotation.directory}', received {error.strerror or error}; "
                f"make room or repair it: {self._saved()}"
            ) from error
        return None

    def resume(self) -> bool:
        """Continues from the newest complete checkpoint; whether there is one.

        Raises ConfigError without a ``checkpoint_dir``; CheckpointError if the checkpoint cannot be read or does not
        fit.
        """
        rotation = self.checkpoint_rotation
        if rotation is None:
            raise ConfigError("expected a trainer with checkpoint_dir to resume, received one without; give the folder")
        latest: Path | None = rotation.latest()
        if latest is None:
            return False
        try:
            checkpoint = self._sync_checkpoint_components()
            _check_sizes(latest)
            there = set(Checkpoint.manifest(latest)["components"])
            names = [name for name in checkpoint.components if name in there or name not in (*_PICTURES, *_ADDED)]
            checkpoint.load(latest, components=names, map_location="cpu")
            self.collector.update_policy_weights_()
        except Exception as error:
            raise CheckpointError(
                f"expected a checkpoint of this trainer in '{latest}', received {type(error).__name__}: "
                f"{str(error)[:200]}; remove it to go back to the one before, or build the same networks"
            ) from error
        self.resumed = True
        return True
