"""Layers with weights that are given."""

from __future__ import annotations

from typing import Any

import torch
from torch import nn


def linear(weight: Any, bias: Any = None) -> nn.Linear:
    """A frozen layer; no bias is one of zeros."""
    weight = torch.as_tensor(weight, dtype=torch.float32)
    layer = nn.Linear(weight.shape[1], weight.shape[0])
    layer.weight.data.copy_(weight)
    layer.bias.data.copy_(torch.zeros(len(weight)) if bias is None else torch.as_tensor(bias, dtype=torch.float32))
    return layer.requires_grad_(False)
