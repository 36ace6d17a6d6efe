"""Devices by name."""

from __future__ import annotations

import torch

from torchrl_sspl.errors import ConfigError


def usable_device(name: torch.device | str) -> torch.device:
    """The device of a name such as ``"cpu"``, ``"cuda"`` or ``"cuda:1"``, if this machine has it.

    Raises ConfigError if there is no such device here. Source: none.

    Example:
        >>> usable_device("cpu")
        device(type='cpu')
    """
    try:
        device = torch.device(name)
        torch.empty(1, device=device)
    except (RuntimeError, AssertionError, NotImplementedError) as error:
        reason = str(error).splitlines()[0]
        raise ConfigError(
            f"device: expected a device that this machine has, such as cpu"
            f"{', cuda' if torch.cuda.is_available() else ''}, received '{name}' ({reason}); leave device out to run on the CPU"
        ) from error
    return device


__all__ = ["usable_device"]
