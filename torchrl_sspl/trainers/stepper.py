"""One training step: the total loss, then the separate step of the Lipschitz loss."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager, nullcontext
from typing import Any

import torch
from tensordict import TensorDict, TensorDictBase
from torch import Tensor, nn
from torchrl.trainers import OptimizationStepper, Trainer

from torchrl_sspl.errors import ConfigError
from torchrl_sspl.objectives import LipschitzLoss
from torchrl_sspl.sets import SAFE, UNSAFE


@contextmanager
def _without_worst(loss: nn.Module) -> Iterator[None]:
    """The worst rows do not count extra: their mean is least for a barrier that is zero everywhere."""
    kept = loss.worst_coeff
    loss.worst_coeff = torch.zeros_like(kept)  # type: ignore[arg-type]
    try:
        yield
    finally:
        loss.worst_coeff = kept


class SSPLStepper(OptimizationStepper):
    r"""Steps of Algorithm 1: on the total loss, then on :math:`L_M` where the barrier needs it.

    During the warm start only the terms of :math:`L_{SaLaD}` count. What follows it asks for a barrier that is low
    where the successor is inside: begun before the latents tell S from U, it would pull both below zero for good. With
    a :class:`~torchrl_sspl.objectives.LipschitzLoss` both steps are followed by a backtracking that keeps the barrier
    inside the cone in which its bound is certified.

    Args:
        optimizer: optimiser of the total loss.
        warm_start_steps: steps on the world model alone; -1: all of them.
        warm_start_error: the warm start goes on until S and U are told apart: until the running mean of ``safe_error``
            + ``unsafe_error`` (each over about fifty steps that have some of its set) is at most this. Until then the worst rows do not count extra.
            ``None`` goes by the number of steps alone.
        lipschitz_loss: :math:`L_M`, for an ``LMIBarrier``; ``None`` for barriers that are Lipschitz by construction.
        lipschitz_optimizer: optimiser of :math:`L_M`; needed with ``lipschitz_loss``.
        autocast: dtype of mixed precision, such as ``torch.bfloat16``; ``None`` for none.

    ``step`` returns the detached terms and metrics of the losses, ``grad_norm``, ``warm_start`` (1 during it) and, with
    ``lipschitz_loss``, ``lipschitz_share`` (of the last :math:`L_M` step that was kept). The keys do not vary.
    Raises ConfigError if only one of ``lipschitz_loss`` and ``lipschitz_optimizer`` is given, the number of steps is
    negative, or the error is not positive. Source: paper, Algorithm 1; deviation: the steps never leave the cone.

    Example:
        >>> weight = nn.Parameter(torch.zeros(1))
        >>> SSPLStepper(torch.optim.SGD([weight], 0.1), warm_start_steps=10).state_dict()["count"]
        0
    """

    def __init__(
        self,
        optimizer: torch.optim.Optimizer,
        *,
        warm_start_steps: int = 0,
        warm_start_error: float | None = None,
        lipschitz_loss: LipschitzLoss | None = None,
        lipschitz_optimizer: torch.optim.Optimizer | None = None,
        autocast: torch.dtype | None = None,
    ) -> None:
        if (lipschitz_loss is None) != (lipschitz_optimizer is None):
            raise ConfigError(
                "expected lipschitz_loss and lipschitz_optimizer together, received one of them; give both for an "
                "LMIBarrier, none for a sandwich barrier"
            )
        if warm_start_steps < -1:
            raise ConfigError(f"expected warm_start_steps >= 0, or -1 for all steps, received {warm_start_steps}")
        if warm_start_error is not None and not warm_start_error > 0:
            raise ConfigError(f"expected warm_start_error > 0 or None, received {warm_start_error}")
        self.optimizer, self.lipschitz_optimizer, self.lipschitz_loss = optimizer, lipschitz_optimizer, lipschitz_loss
        self.warm_start_steps, self.warm_start_error = warm_start_steps, warm_start_error
        self.autocast, self.count = autocast, 0
        self._errors = [1.0, 1.0]  # running means, of S and of U
        self.begin_batch()

    def begin_batch(self) -> None:
        """Steps on what was collected last, and the sums of their terms, begin at zero."""
        self.inside, self.sums = 0, {}  # type: tuple[int, dict[str, Tensor]]

    @property
    def mean(self) -> dict[str, Tensor]:
        """The terms, averaged over the steps on what was collected last."""
        return {key: value / self.inside for key, value in self.sums.items()}

    @property
    def mislabelled(self) -> float:
        """Running mean of the two errors; both are 1 at worst."""
        return sum(self._errors)

    @property
    def unseparated(self) -> bool:
        """Whether S and U are yet to be told apart."""
        return self.warm_start_error is not None and self.mislabelled > self.warm_start_error

    def restart(self) -> None:
        """Begins the warm start again, for fresh weights: counter and moments of the optimisers are forgotten."""
        self.count, self._errors = 0, [1.0, 1.0]
        for optimizer in (self.optimizer, self.lipschitz_optimizer):
            if optimizer is not None:
                optimizer.state.clear()

    def step(self, trainer: Trainer, sub_batch: TensorDictBase) -> TensorDictBase:
        """Detached scalars of one step on a batch of transitions; the trainer gives loss module and clipping."""
        unseparated = self.unseparated
        warm = unseparated or self.count < self.warm_start_steps or self.warm_start_steps < 0
        self.count += 1
        device = self.optimizer.param_groups[0]["params"][0].device.type
        eased = _without_worst(trainer.loss_module) if unseparated else nullcontext()
        with eased, torch.autocast(device, dtype=self.autocast, enabled=self.autocast is not None):
            terms = trainer.compute_loss(sub_batch, method="world_model" if warm else None)
            total: Tensor = sum(v for k, v in terms.items() if k.startswith("loss_"))  # type: ignore[assignment]
        self.optimizer.zero_grad()
        total.backward()
        norm = self._clip(trainer)
        before = self._barrier_state()
        self.optimizer.step()
        self._backtrack(before)
        if unseparated:  # only now: a GPU is waited for here
            self._look(trainer.loss_module, sub_batch, terms)
        extra = {"grad_norm": norm.detach(), "warm_start": torch.tensor(float(warm)), **self._lipschitz_step()}
        told = {**dict(terms.detach().items()), **extra}
        self.sums = {key: self.sums[key] + value if self.sums else value for key, value in told.items()}
        self.inside += 1
        return TensorDict(told, batch_size=[])

    def _look(self, loss: Any, batch: TensorDictBase, terms: TensorDictBase) -> None:
        """The errors of a batch, of those sets that it holds: where there is nothing, nothing is wrong."""
        region = batch[loss.tensor_keys.region]
        held = torch.stack([(region == code).any() for code in (SAFE, UNSAFE)]).to(terms["safe_error"])
        for k, (there, error) in enumerate(torch.stack([held, torch.stack([terms["safe_error"], terms["unsafe_error"]])], 1).tolist()):  # waits once
            if there:
                self._errors[k] += 0.02 * (error - self._errors[k])

    def _clip(self, trainer: Trainer) -> Tensor:
        parameters = [p for group in self.optimizer.param_groups for p in group["params"] if p.grad is not None]
        limit = trainer.clip_norm
        if limit is not None and not trainer.clip_grad_norm:
            nn.utils.clip_grad_value_(parameters, limit)
            limit = None
        return nn.utils.clip_grad_norm_(parameters, float("inf") if limit is None else limit)

    def _barrier(self) -> Any:
        assert self.lipschitz_loss is not None
        network = self.lipschitz_loss.barrier
        return getattr(network, "module", network)

    def _barrier_state(self) -> dict[str, Tensor]:
        if self.lipschitz_loss is None:
            return {}
        return {name: value.clone() for name, value in self._barrier().state_dict().items()}

    def _backtrack(self, before: dict[str, Tensor]) -> float:
        return self._barrier().backtracking_step(before) if before else 1.0

    def _lipschitz_step(self) -> dict[str, Tensor]:
        if self.lipschitz_loss is None or self.lipschitz_optimizer is None:
            return {}
        terms = self.lipschitz_loss(TensorDict(batch_size=[]))
        self.lipschitz_optimizer.zero_grad()
        terms["loss_lipschitz"].backward()
        before = self._barrier_state()
        self.lipschitz_optimizer.step()
        share = self._backtrack(before)
        return {**dict(terms.detach().items()), "lipschitz_share": torch.tensor(share)}

    def state_dict(self) -> dict[str, Any]:
        """Counters, progress of the warm start, sums of the terms, and both optimisers."""
        state: dict[str, Any] = {"count": self.count, "errors": list(self._errors), "optimizer": self.optimizer.state_dict()}
        state |= {"inside": self.inside, "sums": dict(self.sums)}
        if self.lipschitz_optimizer is not None:
            state["lipschitz_optimizer"] = self.lipschitz_optimizer.state_dict()
        return state

    def load_state_dict(self, state_dict: dict[str, Any]) -> None:
        """Restores what ``state_dict`` returned."""
        self.count = int(state_dict["count"])
        self._errors = list(state_dict.get("errors") or [float(state_dict["mislabelled"]) / 2] * 2)  # one number in earlier versions
        self.inside, self.sums = int(state_dict.get("inside", 0)), dict(state_dict.get("sums", {}))
        self.optimizer.load_state_dict(state_dict["optimizer"])
        if self.lipschitz_optimizer is not None:
            self.lipschitz_optimizer.load_state_dict(state_dict["lipschitz_optimizer"])
