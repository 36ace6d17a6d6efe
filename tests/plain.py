"""Layers with weights that are given, and an agent as it is drawn."""

from __future__ import annotations

from typing import Any

import torch
from torch import nn

from torchrl_sspl.modules import FrameEncoder, LatentDynamics, Policy
from torchrl_sspl.modules.agent import Agent


def linear(weight: Any, bias: Any = None) -> nn.Linear:
    """A frozen layer; no bias is one of zeros."""
    weight = torch.as_tensor(weight, dtype=torch.float32)
    layer = nn.Linear(weight.shape[1], weight.shape[0])
    layer.weight.data.copy_(weight)
    layer.bias.data.copy_(torch.zeros(len(weight)) if bias is None else torch.as_tensor(bias, dtype=torch.float32))
    return layer.requires_grad_(False)


def small_agent(image_size: int = 16, action_scale: float = 1.0) -> Agent:
    """An agent of three latents with networks that take no time, of fixed weights."""
    torch.manual_seed(0)
    barrier = nn.Sequential(nn.Linear(3, 8), nn.ReLU(), nn.Linear(8, 1))
    return Agent(FrameEncoder(3, image_size, pool_to=8), LatentDynamics(3, 1, (8,), action_scale), barrier, Policy(3, 1, (8,), action_scale), 2.0)
