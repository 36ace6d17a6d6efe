"""Losses on the policy's actions themselves: near a user's policy, and near those of the step before."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import torch
from tensordict import TensorDict, TensorDictBase
from tensordict.nn import TensorDictModuleBase, dispatch
from torch import Tensor, nn

from torchrl_sspl.errors import ConfigError
from torchrl_sspl.functional import policy_deviation
from torchrl_sspl.modules.salad import written
from torchrl_sspl.objectives.base import LatentBatch, LatentLoss, _clean, _meant, set_action_scale, trained_action


class PolicyDeviationLoss(LatentLoss):
    r"""Keeps the policy near a user's policy, which may be unsafe.

    .. math:: L_\pi = \operatorname{mean}_{D} \| \pi(z) - \pi_{user}(o) \|_2

    Output: ``loss_policy_deviation``. Source: paper eq. (13).

    Args:
        encoder: observation -> latent ``(*batch, p)``; ``None`` if the batches hold ``"latent"``.
        policy: latent -> action ``(*batch, action_dim)`` in physical units.
        user_policy: ``None`` for the zero action (the paper's pendulum), ``"data"`` to read ``"user_action"`` from the
            batch, or a module that is run without gradient and stays outside the parameters of the loss, but is moved and
            cast with it: a TensorDict module on the batch that writes ``"action"``, or one entry alone, a plain network on
            the observation (on the latent without encoder).
        detach: ``("encoder",)`` keeps the gradient of this loss out of the encoder.
        **shared: ``reduction``; see :class:`LatentLoss`, for errors too.

    Example:
        >>> from torchrl_sspl.modules import Policy
        >>> data = TensorDict(latent=torch.zeros(4, 2), user_action=torch.zeros(4, 1), batch_size=4)
        >>> PolicyDeviationLoss(None, Policy(2, 1), user_policy="data")(data)["loss_policy_deviation"].shape
        torch.Size([])
    """

    def __init__(
        self,
        encoder: nn.Module | None,
        policy: nn.Module,
        *,
        user_policy: nn.Module | str | None = None,
        detach: tuple[str, ...] = ("encoder",),
        **shared: Any,
    ) -> None:
        if user_policy is not None and user_policy != "data" and not isinstance(user_policy, nn.Module):
            raise ConfigError(
                f"expected user_policy to be None (zero action), 'data' or a module, received {user_policy!r}"
            )
        if isinstance(detach, str) or not set(detach) <= {"encoder", "dynamics"}:  # SSPLLoss has both
            raise ConfigError(f"expected detach to be () or ('encoder',), received {detach!r}")
        super().__init__(encoder=encoder, policy=policy, **shared)
        self.detach = tuple(detach)
        # Outside the module registry: it is not trained, and a target updater must not see it.
        self.__dict__["user_policy"] = user_policy
        if user_policy == "data":
            self._needs.add("user_action")
        elif isinstance(user_policy, TensorDictModuleBase):
            self._written["user_policy"] = written(user_policy, self.tensor_keys.action)
        self.out_keys.append("loss_policy_deviation")

    def _apply(self, fn: Any) -> PolicyDeviationLoss:
        if isinstance(user := self.__dict__["user_policy"], nn.Module):  # torch finds only what is registered
            user._apply(fn)
        return super()._apply(fn)

    def _set_in_keys(self) -> None:
        super()._set_in_keys()
        if isinstance(user := self.__dict__["user_policy"], TensorDictModuleBase):
            self.in_keys += [key for key in user.in_keys if key not in self.in_keys]

    def _read(self, tensordict: TensorDictBase) -> LatentBatch:
        batch = super()._read(tensordict)
        user = self.__dict__["user_policy"]
        if user is None:
            return batch
        if user == "data":
            action = self._get(tensordict, self.tensor_keys.user_action, "user_action")
        else:
            with torch.no_grad():
                if isinstance(user, TensorDictModuleBase):
                    read = {key: self._get(tensordict, key, "observation") for key in user.in_keys}
                    action = user(TensorDict(read, tensordict.batch_size)).get(_meant(self, "user_policy", user))
                else:
                    action = user(self._get(tensordict, self.in_keys[0], "observation"))
        batch.user_action = _clean(action.detach(), batch.valid)
        return batch

    def _deviation_terms(self, batch: LatentBatch) -> dict[str, Tensor]:
        latent = batch.latent.detach() if "encoder" in self.detach else batch.latent
        action = trained_action(self, latent)
        user = torch.zeros_like(action) if batch.user_action is None else batch.user_action
        return {"loss_policy_deviation": self._reduce(policy_deviation(action, user), batch)}

    @dispatch
    def forward(self, tensordict: TensorDictBase) -> TensorDict:
        """The loss on a batch of observations (or frames, or latents); the batch is not changed."""
        return self._pack(self._deviation_terms(self._read(tensordict)), tensordict)


class ActionChangeLoss(LatentLoss):
    r"""Keeps the policy's action near its action at the next step.

    .. math:: L = \operatorname{mean} \| (\pi(d(z, \pi(z))) - \pi(z)) / s \|_2

    The norm is not squared: many small changes, which shake an actuator at rest, count as much as one large change, which safety may need. The
    successor is held still, so that the policy is not led to where it acts alike.

    Output: ``loss_action_change``. Source: none.

    Args:
        dynamics: (latent, action) -> next latent ``(*batch, p)``; held still.
        policy: latent -> action ``(*batch, action_dim)`` in physical units.
        action_scale: s, a number or one per dimension of the action, physical units.
        **shared: ``reduction``; see :class:`LatentLoss`, for errors too.

    Example:
        >>> from torchrl_sspl.modules import LatentDynamics, Policy
        >>> loss = ActionChangeLoss(LatentDynamics(2, 1), Policy(2, 1))
        >>> loss(TensorDict(latent=torch.rand(8, 2), batch_size=8))["loss_action_change"].shape
        torch.Size([])
    """

    def __init__(
        self, dynamics: nn.Module, policy: nn.Module, *, action_scale: float | Sequence[float] = 1.0, **shared: Any
    ) -> None:
        super().__init__(dynamics=dynamics, policy=policy, **shared)
        set_action_scale(self, action_scale)
        self.out_keys.append("loss_action_change")

    @dispatch
    def forward(self, tensordict: TensorDictBase) -> TensorDict:
        """The loss on a batch of latents; the batch is not changed."""
        batch = self._read(tensordict)
        action = trained_action(self, batch.latent)
        after = self._run("dynamics", batch.latent, action, params="frozen").detach()
        change = (trained_action(self, after) - action) / self.action_scale
        return self._pack({"loss_action_change": self._reduce(change.norm(dim=-1, keepdim=True), batch)}, tensordict)
