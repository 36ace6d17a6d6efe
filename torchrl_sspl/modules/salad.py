"""SaLaD: the world model of encoder, latent dynamics and barrier, as a TensorDict module."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from tensordict import NestedKey
from tensordict.nn import TensorDictModule, TensorDictModuleBase, TensorDictSequential
from torch import Tensor, nn

from torchrl_sspl.errors import ConfigError
from torchrl_sspl.modules.networks import FrameEncoder, LatentDynamics


def as_tensordict_module(
    module: nn.Module, in_keys: Sequence[NestedKey], out_keys: Sequence[NestedKey]
) -> TensorDictModuleBase:
    """Gives a plain network its keys; a TensorDict module keeps its own. Source: none.

    Args:
        module: a network on tensors, or a TensorDict module.
        in_keys, out_keys: keys that a plain network reads and writes.

    Raises:
        ConfigError: if ``module`` is not a module, or is a TensorDict module with another number of keys.

    Example:
        >>> as_tensordict_module(nn.Linear(2, 1), ["latent"], ["barrier"]).out_keys
        ['barrier']
    """
    if not isinstance(module, nn.Module):
        raise ConfigError(
            f"expected a torch.nn.Module or a TensorDictModule from {list(in_keys)} to {list(out_keys)}, "
            f"received {type(module).__name__}"
        )
    if not isinstance(module, TensorDictModuleBase):
        return TensorDictModule(module, in_keys=list(in_keys), out_keys=list(out_keys))
    swapped = set(module.in_keys) == set(in_keys) and list(module.in_keys) != list(in_keys)
    if len(module.in_keys) != len(in_keys) or len(module.out_keys) < len(out_keys) or swapped:
        raise ConfigError(
            f"expected a module with keys like {list(in_keys)} -> {list(out_keys)}, in this order, received "
            f"{list(module.in_keys)} -> {list(module.out_keys)}"
        )
    for key in out_keys:
        written(module, key)
    return module


def written(module: TensorDictModuleBase, key: NestedKey) -> NestedKey:
    """Which of its entries a TensorDict module gives for a key: that key, or the only one that it writes.

    Raises ConfigError if it writes several entries and none of that name. Source: none.

    Example:
        >>> written(TensorDictModule(nn.Linear(2, 1), ["z"], ["b"]), "barrier")
        'b'
    """
    if key in module.out_keys:
        return key
    if len(module.out_keys) == 1:
        return module.out_keys[0]
    raise ConfigError(
        f"expected a module that writes {key!r}, or one entry alone, received one that writes {list(module.out_keys)}; give what is meant that "
        "name, or select it (selected_out_keys)"
    )


class SaLaD(TensorDictSequential):
    r"""Safety-based latent dynamics: encoder, latent dynamics and barrier in one world model.

    .. math:: z_t = E(o_t), \qquad \hat z_{t+1} = d(z_t, u_t), \qquad b_t = B(z_t)

    Any of the three can be a plain network or a TensorDict module; plain ones get the keys ``"pixels"``,
    ``"action"``, ``"latent"``, ``("next", "latent")`` and ``"barrier"``. The safe side is :math:`B \le 0`.
    What is no module is a ConfigError. Source: paper section III-A.

    Args:
        encoder: observation -> latent ``(*batch, p)``.
        dynamics: (latent, action) -> next latent ``(*batch, p)``.
        barrier: latent -> barrier value ``(*batch, 1)``.

    Example:
        >>> import torch
        >>> from tensordict import TensorDict
        >>> data = TensorDict(pixels=torch.zeros(6, 32, 32, dtype=torch.uint8), action=torch.zeros(1))
        >>> SaLaD(FrameEncoder(2), LatentDynamics(2, 1), nn.Linear(2, 1))(data)["next", "latent"].shape
        torch.Size([2])
    """

    def __init__(self, encoder: nn.Module, dynamics: nn.Module, barrier: nn.Module) -> None:
        super().__init__(
            as_tensordict_module(encoder, ["pixels"], ["latent"]),
            as_tensordict_module(dynamics, ["latent", "action"], [("next", "latent")]),
            as_tensordict_module(barrier, ["latent"], ["barrier"]),
        )

    @classmethod
    def from_sizes(
        cls,
        latent_dim: int,
        action_dim: int,
        *,
        action_scale: float | Sequence[float] | Tensor = 1.0,
        lipschitz_bound: float = 2.0,
        image_size: int | Sequence[int] | None = None,
        **encoder_options: Any,
    ) -> SaLaD:
        """World model with the default networks: frame encoder, residual dynamics, sandwich barrier. Source: none.

        Args:
            latent_dim, action_dim: sizes of latent and action; a ConfigError if one is not valid.
            action_scale: largest action in physical units.
            lipschitz_bound: Lipschitz bound of the barrier.
            image_size: height and width of the frames; ``None`` accepts any.
            **encoder_options: further arguments of :class:`FrameEncoder`.

        Example:
            >>> SaLaD.from_sizes(latent_dim=2, action_dim=1, action_scale=10.0).out_keys
            ['latent', ('next', 'latent'), 'barrier']
        """
        from torchrl_sspl.lipschitz import SandwichBarrier

        return cls(
            FrameEncoder(latent_dim, image_size, **encoder_options),
            LatentDynamics(latent_dim, action_dim, action_scale=action_scale),
            SandwichBarrier(latent_dim, lipschitz_bound=lipschitz_bound),
        )

    @property
    def encoder(self) -> TensorDictModuleBase:
        """The encoder as a TensorDict module."""
        return self.module[0]

    @property
    def dynamics(self) -> TensorDictModuleBase:
        """The latent dynamics as a TensorDict module."""
        return self.module[1]

    @property
    def barrier(self) -> TensorDictModuleBase:
        """The barrier as a TensorDict module."""
        return self.module[2]


def make_rollout_policy(encoder: nn.Module, policy: nn.Module) -> TensorDictSequential:
    """Policy from ``"pixels"`` to ``"action"`` for collectors and rollouts, sharing the parameters of both networks.

    Only the action is written: the latent would be stored with every frame, and be stale as soon as the encoder moves.
    What is no module is a ConfigError. Source: none.

    Args:
        encoder: observation -> latent, or the :class:`SaLaD` that holds it; with a
            :class:`~torchrl_sspl.modules.LatentObserver` put :class:`~torchrl_sspl.modules.Predict` behind the policy.
        policy: latent -> action.

    Example:
        >>> from torchrl_sspl.modules import Policy
        >>> make_rollout_policy(FrameEncoder(2), Policy(2, 1)).out_keys
        ['action']
    """
    network = encoder.encoder if isinstance(encoder, SaLaD) else encoder
    encode = as_tensordict_module(network, ["pixels"], ["latent"])
    act = as_tensordict_module(policy, [written(encode, "latent")], ["action"])
    return TensorDictSequential(encode, act, selected_out_keys=list(act.out_keys))
