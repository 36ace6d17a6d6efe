"""Hooks of the TorchRL trainer: margins, seeds, statistics of the encoder, fresh starts, clock, log, evaluation."""

from __future__ import annotations

import json
import math
import os
import time
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import torch
from tensordict import TensorDictBase
from torch import Tensor
from torchrl.data import ReplayBuffer
from torchrl.trainers import Trainer, TrainerHookBase

from torchrl_sspl.errors import ConfigError
from torchrl_sspl.files import append
from torchrl_sspl.functional import covering_radius, dynamics_error, dynamics_margin, safety_margin
from torchrl_sspl.objectives import SSPLLoss

MARGINS = ("safety_margin", "dynamics_margin")


class _Hook(TrainerHookBase):
    """Where a hook acts, as stage -> method, under which name it is registered, and which attributes are its state."""

    name = ""
    stages: Mapping[str, str] = {}
    kept: tuple[str, ...] = ()

    def state_dict(self) -> dict[str, Any]:
        """What a checkpoint holds."""
        return {key: getattr(self, key) for key in self.kept}

    def load_state_dict(self, state_dict: dict[str, Any]) -> None:
        """Restores what ``state_dict`` returned."""
        for key in self.kept:
            setattr(self, key, type(getattr(self, key))(state_dict[key]))

    def register(self, trainer: Trainer, name: str | None = None) -> None:
        """Attaches the hook to the trainer."""
        for stage, method in self.stages.items():
            trainer.register_op(stage, self if method == "__call__" else getattr(self, method))
        trainer.register_module(name or self.name, self)


class MarginHook(_Hook):
    r"""Re-estimates the margins before the steps of every collected batch.

    .. math:: \psi \leftarrow L_B \bar\epsilon, \qquad \eta \leftarrow L_B \delta

    with the covering radius :math:`\bar\epsilon` of one half of a sample of latents by the other, and :math:`\delta`
    the chosen quantile of the latent prediction error on the sample.

    Args:
        loss: the loss whose buffers are set.
        replay_buffer: where the sample comes from.
        lipschitz_bound: :math:`L_B`.
        update: which margins are set; the others are estimated and logged only.
        samples: transitions in the sample.
        quantile: quantile of both estimates, 1 for the maximum (paper).
        maximum: largest margin that is set, units of the barrier; early estimates can exceed all that a barrier can
            satisfy.

    Raises ConfigError if an argument is not valid. Source: paper, Algorithm 1, with eq. (6) and (11).

    Example:
        >>> from torchrl_sspl.data import TransitionStore
        >>> MarginHook(None, TransitionStore(8).replay_buffer(4), lipschitz_bound=2.0).update
        ('safety_margin', 'dynamics_margin')
    """

    name, stages, kept = "margins", {"pre_optim_steps": "__call__", "post_steps_log": "log"}, ("last",)

    def __init__(
        self,
        loss: SSPLLoss,
        replay_buffer: ReplayBuffer,
        *,
        lipschitz_bound: float,
        update: tuple[str, ...] = MARGINS,
        samples: int = 512,
        quantile: float = 1.0,
        maximum: float = float("inf"),
    ) -> None:
        if isinstance(update, str) or not set(update) <= set(MARGINS):
            raise ConfigError(f"expected update among {MARGINS}, received {update!r}")
        if samples < 4 or not 0.0 < quantile <= 1.0 or not lipschitz_bound > 0.0 or not maximum > 0.0:
            raise ConfigError(
                f"expected samples >= 4, quantile in (0, 1], lipschitz_bound > 0 and maximum > 0, received {samples}, "
                f"{quantile}, {lipschitz_bound} and {maximum}"
            )
        self.loss, self.replay_buffer, self.update = loss, replay_buffer, tuple(update)
        self.lipschitz_bound, self.samples = float(lipschitz_bound), samples
        self.quantile, self.maximum = float(quantile), float(maximum)
        self.last: dict[str, float] = {}

    @torch.no_grad()
    def __call__(self) -> None:
        """Estimates and sets the margins."""
        parts: list[tuple[Tensor, ...]] = []
        missing = self.samples
        while missing > 0:
            batch = self.replay_buffer.sample().to(next(self.loss.parameters()).device)
            action = batch.get(self.loss.tensor_keys.action)
            parts.append((*self.loss.latents(batch), action))
            missing -= len(action)
        latent, after, action = (torch.cat(part)[: self.samples] for part in zip(*parts, strict=True))
        half = len(latent) // 2
        radius = covering_radius(latent[:half], latent[half:], quantile=self.quantile)
        error = dynamics_error(self.loss.predict(latent, action), after)
        delta = float(error.quantile(self.quantile))
        estimate = {
            "safety_margin": safety_margin(self.lipschitz_bound, radius, mode="paper").q1,
            "dynamics_margin": dynamics_margin(self.lipschitz_bound, delta),
        }
        for name in self.update:
            setattr(self.loss, name, min(estimate[name], self.maximum))
        self.last = {
            "covering_radius": radius,
            "dynamics_error_sample": delta,
            "safety_margin": float(self.loss.safety_margin),
            "dynamics_margin": float(self.loss.dynamics_margin),
        }

    def log(self, batch: TensorDictBase | None) -> dict[str, Any] | None:
        """Radius, error and margins in force."""
        return {**self.last, "log_pbar": False} if self.last else None


class SeedHook(_Hook):
    """Gives the environments a new seed, drawn from torch's generator, before every collected batch.

    A checkpoint cannot hold the inner state of an arbitrary environment. With this seed and a collector that resets at
    each iteration, what a batch holds depends on nothing else than what the checkpoint does hold. Other collectors are left alone after the
    first seed: some environments begin an episode where they are seeded, of which the collector knows nothing. Source: none.
    """

    name, stages, kept = "seeds", {"setup": "setup", "post_steps": "__call__"}, ("seed",)

    def __init__(self, collector: Any) -> None:
        self.collector, self.seed = collector, -1

    def setup(self) -> None:
        """Seeds the first batch of a run: anew, or as the interrupted run would have."""
        if self.seed < 0:
            self()
        else:
            self.collector.set_seed(self.seed)

    def __call__(self) -> None:
        """Draws and sets the seed of the next batch."""
        first, self.seed = self.seed < 0, int(torch.randint(2**31 - 1, (), dtype=torch.int64))
        if first or getattr(self.collector, "reset_at_each_iter", True):
            self.collector.set_seed(self.seed)


class FitEncoderHook(_Hook):
    """Lets an encoder take statistics of frames before the first optimiser step, and after a restart.

    It has a method ``fit(frames)``, frames uint8 ``(n, 3, H, W)``; those are spread over the whole store. Source: none.
    """

    name, stages = "fit_encoder", {"pre_optim_steps": "__call__"}

    def __init__(self, trainer: Any, encoder: Any, store: Any, *, frames: int = 2000) -> None:
        self.trainer, self.encoder, self.store, self.frames = trainer, encoder, store, frames

    def __call__(self) -> None:
        """Fits where no step has been taken since the last start."""
        if self.trainer.optimization_stepper.count == 0:
            index = torch.linspace(0, len(self.store) - 1, min(self.frames, len(self.store))).long()
            self.encoder.fit(self.store.get(index)["frames"][:, 1])
            delayed = getattr(self.trainer.loss_module, "target_encoder_params", None)
            if delayed is not None:
                for name, value in self.trainer.loss_module.encoder_params.items(True, True):
                    if not value.requires_grad:  # a target-network updater follows parameters alone
                        delayed.get(name).data.copy_(value)


class ClockHook(_Hook):
    """Counts the seconds of a training over all of its interruptions. Source: none."""

    name = "clock"

    def __init__(self) -> None:
        self._before, self._began = 0.0, time.monotonic()

    @property
    def seconds(self) -> float:
        """So far, in s."""
        return self._before + time.monotonic() - self._began

    def start(self) -> None:
        """What went before in this process does not count."""
        self._began = time.monotonic()

    def state_dict(self) -> dict[str, float]:
        return {"seconds": self.seconds}

    def load_state_dict(self, state_dict: dict[str, float]) -> None:
        self._before, self._began = float(state_dict["seconds"]), time.monotonic()


class LogHook(_Hook):
    """Appends the mean terms of every batch's steps to ``log.jsonl``, and stops at a loss that is not finite.

    What was logged after a checkpoint, also by the phases, is cut off when it is loaded: it will be logged again.

    Without a path nothing is written. Raises ConfigError when called with a loss that is NaN or infinite. Source: none.
    """

    name, stages = "log", {"post_optim_complete_log": "__call__"}

    def __init__(self, path: str | Path | None) -> None:
        self.path = None if path is None else Path(path)

    def __call__(self, step: int, terms: Any) -> None:
        """One line."""
        row = {key: float(value) for key, value in terms.items() if value.numel() == 1}
        bad = {key: value for key, value in row.items() if key.startswith("loss") and not math.isfinite(value)}
        if bad:
            raise ConfigError(
                f"expected finite losses, received {bad} after step {step}; lower optim.lr, or take another seed, in another out_dir"
            )
        if self.path is not None:
            append(self.path, json.dumps({"phase": "joint", "round": 0, "step": step, **row}))

    def state_dict(self) -> dict[str, int]:
        return {"bytes": self.path.stat().st_size if self.path is not None and self.path.is_file() else 0}

    def load_state_dict(self, state_dict: dict[str, int]) -> None:
        """Cuts the file to that length."""
        if self.path is not None and self.state_dict()["bytes"] > int(state_dict["bytes"]):
            os.truncate(self.path, int(state_dict["bytes"]))


class RestartHook(_Hook):
    """Begins again with fresh weights where the warm start does not tell S from U.

    Joint training of encoder and barrier has poor local optima: latents that predict well and leave out what S and U
    differ in. No number of further steps leads out of them; other initial weights mostly do. The hook looks at the
    stepper before the steps of every collected batch, and begins again if the share on the wrong side of the barrier is
    no longer falling (by a fifth since the last look). The data are kept, the steps are gone.

    Args:
        trainer: the trainer; its stepper has a ``warm_start_error``.
        fresh: ``attempt -> loss`` like the trainer's, with other initial weights; attempts count from 1.
        after: optimiser steps since the last start before which it never happens.
        most: fresh starts at most.

    Raises ConfigError if a number is not positive. Source: none; the paper does not start again.
    """

    name, stages = "restarts", {"pre_optim_steps": "__call__", "post_steps_log": "log"}
    kept = ("restarts", "last")

    def __init__(self, trainer: Any, fresh: Callable[[int], SSPLLoss], *, after: int, most: int) -> None:
        if after < 1 or most < 1:
            raise ConfigError(f"expected after >= 1 steps and most >= 1 restarts, received {after} and {most}")
        self.trainer, self.fresh, self.after, self.most = trainer, fresh, after, most
        self.restarts, self.last = 0, 2.0

    @torch.no_grad()
    def __call__(self) -> None:
        """Looks, and begins again if need be."""
        stepper = self.trainer.optimization_stepper
        falling, self.last = stepper.mislabelled < 0.8 * self.last, stepper.mislabelled
        if not stepper.unseparated or falling or stepper.count < self.after or self.restarts == self.most:
            return
        self.restarts += 1
        loss = self.trainer.loss_module
        margins = {name: getattr(loss, name).clone() for name in MARGINS}
        loss.load_state_dict(self.fresh(self.restarts).state_dict())  # in place: optimiser and collector keep their hold
        for name, value in margins.items():
            getattr(loss, name).copy_(value)
        stepper.restart()
        if self.trainer.fit_encoder is not None:  # at this stage it has been asked already, and the steps that follow count
            self.trainer.fit_encoder()

    def log(self, batch: TensorDictBase | None) -> dict[str, Any]:
        """The number of fresh starts so far."""
        return {"restarts": self.restarts, "log_pbar": False}


class EveryHook(_Hook):
    """Runs something every so many collected batches, on frozen networks, and logs what it returns.

    Args:
        trainer: the trainer.
        call: ``trainer -> mapping of floats``; an entry ``"stop"``, a text that is not ``None``, ends the training.
        every: collected batches between two calls.

    Raises ConfigError if ``every`` is not positive. Source: paper, Algorithm 1 (stop rule); deviation: the printed
    rule, a total loss of zero, is never met.
    """

    name, stages, kept = "every", {"post_steps_log": "__call__"}, ("count", "stopped")

    def __init__(self, trainer: Any, call: Callable[[Any], Mapping[str, Any]], *, every: int = 1) -> None:
        if every < 1:
            raise ConfigError(f"expected every >= 1 batches, received {every}")
        self.trainer, self.call, self.every, self.count, self.stopped = trainer, call, every, 0, ""

    def __call__(self, batch: TensorDictBase | None) -> dict[str, Any] | None:
        """Counts, and runs when it is time."""
        self.count += 1
        if self.count % self.every:
            return None
        # Whatever is measured must not change what is trained.
        with torch.no_grad(), torch.random.fork_rng():
            result = dict(self.call(self.trainer))
        reason = result.pop("stop", None)
        if reason is not None:
            self.stopped = str(reason)
            self.trainer.request_stop(self.stopped)
        return {**result, "log_pbar": False} if result else None

    def load_state_dict(self, state_dict: dict[str, Any]) -> None:
        """Restores what ``state_dict`` returned; a training that was ended stays so."""
        super().load_state_dict({"stopped": "", **state_dict})  # which checkpoints of earlier versions do not hold
        if self.stopped:
            self.trainer.request_stop(self.stopped)
