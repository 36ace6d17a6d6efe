"""Sets of states in state units, and the labels that they give."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor

from torchrl_sspl.errors import ConfigError, EmptyRegionError, OverlapError, ShapeError

UNLABELLED, SAFE, UNSAFE = 0, 1, 2


class Region:
    """A set of states: membership and uniform samples."""

    dim: int

    def contains(self, state: Tensor) -> Tensor:
        raise NotImplementedError

    def sample(self, n: int, generator: torch.Generator | None = None, device=None) -> Tensor:
        raise NotImplementedError

    def __sub__(self, other: Region) -> Difference:
        return Difference(self, other)

    def __or__(self, other: Region) -> Union:
        return Union(self, other)


class Box(Region):
    def __init__(self, low: Sequence[float], high: Sequence[float], period: Sequence[float | None] | None = None) -> None:
        self.low, self.high = torch.as_tensor(low, dtype=torch.float32), torch.as_tensor(high, dtype=torch.float32)
        if self.low.shape != self.high.shape or not bool((self.low < self.high).all()):
            raise ConfigError(f"expected low < high of equal length, received {list(low)} and {list(high)}")
        self.dim = len(self.low)
        self.period = torch.tensor([float(p or 0.0) for p in (period or [0.0] * self.dim)])

    def _wrap(self, state: Tensor) -> Tensor:
        p = self.period.to(state)
        safe = torch.where(p > 0, p, 1.0)
        return torch.where(p > 0, torch.remainder(state + safe / 2, safe) - safe / 2, state)

    def contains(self, state: Tensor) -> Tensor:
        if state.shape[-1] != self.dim:
            raise ShapeError(f"expected states of shape (*batch, {self.dim}), received {tuple(state.shape)}")
        x = self._wrap(state)
        return ((x >= self.low.to(x)) & (x <= self.high.to(x))).all(-1)

    def sample(self, n: int, generator: torch.Generator | None = None, device=None) -> Tensor:
        u = torch.rand(n, self.dim, generator=generator, device=device)
        return self.low.to(u) + u * (self.high - self.low).to(u)

    def grid(self, n: int | Sequence[int]) -> Tensor:
        sizes = [n] * self.dim if isinstance(n, int) else list(n)
        axes = [torch.linspace(float(a), float(b), k) for a, b, k in zip(self.low, self.high, sizes, strict=True)]
        return torch.stack(torch.meshgrid(*axes, indexing="ij"), -1).reshape(-1, self.dim)


class Difference(Region):
    def __init__(self, a: Region, b: Region) -> None:
        self.a, self.b, self.dim = a, b, a.dim

    def contains(self, state: Tensor) -> Tensor:
        return self.a.contains(state) & ~self.b.contains(state)

    def sample(self, n: int, generator: torch.Generator | None = None, device=None) -> Tensor:
        parts, found = [], 0
        for _ in range(1000):
            x = self.a.sample(max(2 * n, 64), generator, device)
            x = x[~self.b.contains(x)]
            parts.append(x)
            found += len(x)
            if found >= n:
                return torch.cat(parts)[:n]
        raise EmptyRegionError("expected a difference with positive volume, received (almost) nothing; check the sets")


class Union(Region):
    def __init__(self, *parts: Region) -> None:
        self.parts, self.dim = parts, parts[0].dim

    def contains(self, state: Tensor) -> Tensor:
        return torch.stack([p.contains(state) for p in self.parts]).any(0)

    def sample(self, n: int, generator: torch.Generator | None = None, device=None) -> Tensor:
        which = torch.randint(len(self.parts), (n,), generator=generator, device=device)
        return torch.cat([p.sample(int((which == k).sum()), generator, device) for k, p in enumerate(self.parts)])


def label(state: Tensor, safe: Region, unsafe: Region) -> Tensor:
    codes = torch.where(safe.contains(state), SAFE, UNLABELLED)
    return torch.where(unsafe.contains(state), UNSAFE, codes).unsqueeze(-1)


def check_disjoint(safe: Region, unsafe: Region, n: int = 4096) -> None:
    g = torch.Generator().manual_seed(0)
    if bool(unsafe.contains(safe.sample(n, g)).any()) or bool(safe.contains(unsafe.sample(n, g)).any()):
        raise OverlapError("expected disjoint safe and unsafe sets, received sets that share states; change one of them")
