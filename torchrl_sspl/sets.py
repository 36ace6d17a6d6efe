"""Sets of states in state units, and the labels that they give."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor

from torchrl_sspl.errors import ConfigError, EmptyRegionError, NonFiniteError, OverlapError, ShapeError

UNLABELLED, SAFE, UNSAFE = 0, 1, 2

_ATTEMPTS = 1000  # rejection rounds after which a difference counts as empty


class Region:
    """A set of states: membership and samples.

    Subclass it for sets of your own: give ``dim``, :meth:`contains` and :meth:`sample`.

    Attributes:
        dim: number of state components.

    Source: paper Section II (the sets S and U).

    Example:
        >>> class Disc(Region):
        ...     dim = 2
        ...     def contains(self, state):
        ...         return state.norm(dim=-1) <= 1.0
        ...     def sample(self, n, generator=None, device=None):
        ...         x = torch.randn(n, 2, generator=generator, device=device)
        ...         return x / x.norm(dim=-1, keepdim=True) * torch.rand(n, 1, generator=generator, device=device).sqrt()
        >>> (Box([-2, -2], [2, 2]) - Disc()).contains(torch.tensor([[0.0, 0.5], [0.0, 1.5]]))
        tensor([False,  True])
    """

    dim: int

    def contains(self, state: Tensor) -> Tensor:
        """Whether states ``(*batch, dim)``, state units, belong to the set: bool ``(*batch,)``.

        Raises ShapeError if the last dimension is not ``dim``; NonFiniteError if a state is NaN.

        Example:
            >>> Box([0.0], [1.0]).contains(torch.tensor([[0.0], [1.0], [1.1]]))
            tensor([ True,  True, False])
        """
        raise NotImplementedError

    def sample(self, n: int, generator: torch.Generator | None = None, device: torch.device | str | None = None) -> Tensor:
        """``n`` random states of the set, ``(n, dim)``, float32, state units, on a device, as is the generator.

        Raises EmptyRegionError if no state is found.

        Example:
            >>> Box([0.0], [1.0]).sample(3, torch.Generator().manual_seed(0)).shape
            torch.Size([3, 1])
        """
        raise NotImplementedError

    def shuffled(self, n: int, generator: torch.Generator | None = None, device: torch.device | str | None = None) -> Tensor:
        """Samples as of :meth:`sample`, in such an order that the first of them are samples, too."""
        return self.sample(n, generator, device)

    def __sub__(self, other: Region) -> Difference:
        return Difference(self, other)

    def __or__(self, other: Region) -> Union:
        return Union(self, other)


class Box(Region):
    r"""Closed box :math:`\prod_i [l_i, h_i]`; periodic components are compared on the circle.

    Args:
        low: lower corner.
        high: upper corner, larger in every component.
        period: period of every component, None or 0 where there is none.

    Raises ConfigError if the corners are not finite and in order, or a period is negative or of another length.
    Source: none.

    Example:
        >>> from math import pi
        >>> circle = Box([-pi], [pi], period=[2 * pi])
        >>> circle.contains(torch.tensor([[-pi], [pi], [3 * pi], [100.0]]))
        tensor([True, True, True, True])
    """

    def __init__(self, low: Sequence[float], high: Sequence[float], period: Sequence[float | None] | None = None) -> None:
        self.low, self.high = torch.as_tensor(low, dtype=torch.float32), torch.as_tensor(high, dtype=torch.float32)
        finite = bool(self.low.isfinite().all() & self.high.isfinite().all())
        if self.low.ndim != 1 or self.low.shape != self.high.shape or not finite or not bool((self.low < self.high).all()):
            raise ConfigError(f"expected low < high, finite and of equal length, received {low} and {high}")
        self.dim = len(self.low)
        periods = [float(p or 0.0) for p in (period if period is not None else [0.0] * self.dim)]
        if len(periods) != self.dim or not all(0.0 <= p < float("inf") for p in periods):
            raise ConfigError(f"expected one period >= 0 (or None) for each of {self.dim} components, received {period}")
        self.period = torch.tensor(periods)

    def contains(self, state: Tensor) -> Tensor:
        """Whether states lie in the box, borders included."""
        _check_states(state, self.dim)
        low, high, period = (t.to(state) for t in (self.low, self.high, self.period))
        inside = (state >= low) & (state <= high)
        # On the circle: how far the state lies above the lower corner. A whole turn less one rounding error is the
        # lower corner itself, and so is a state that equals it up to float32.
        turn = torch.where(period > 0, period, 1.0)
        above = torch.remainder(state - low, turn)
        rounding = 4e-7 * (turn + state.abs())
        around = (above <= high - low + rounding) | (above >= turn - rounding)
        return torch.where(period > 0, around, inside).all(-1)

    def sample(self, n: int, generator: torch.Generator | None = None, device: torch.device | str | None = None) -> Tensor:
        """Uniform states of the box."""
        u = torch.rand(n, self.dim, generator=generator, device=device)
        return self.low.to(u) + u * (self.high - self.low).to(u)

    def grid(self, n: int | Sequence[int]) -> Tensor:
        """Regular grid over the box, corners included, n points per component: one number, or one for each.

        Returns ``(prod(n), dim)``, float32, last component fastest. Raises ConfigError if the number of sizes is not
        ``dim``, or one is below 1. Source: none.

        Example:
            >>> Box([0.0, 0.0], [1.0, 2.0]).grid(2).tolist()
            [[0.0, 0.0], [0.0, 2.0], [1.0, 0.0], [1.0, 2.0]]
        """
        sizes = [n] * self.dim if isinstance(n, int) else list(n)
        if len(sizes) != self.dim or min(sizes) < 1:
            raise ConfigError(f"expected {self.dim} sizes >= 1, received {sizes}; pass one number or one per component")
        axes = [torch.linspace(float(a), float(b), k) for a, b, k in zip(self.low, self.high, sizes, strict=True)]
        return torch.stack(torch.meshgrid(*axes, indexing="ij"), -1).reshape(-1, self.dim)


class Difference(Region):
    r"""States of one set that are not in another of the same dimension, :math:`A \setminus B`; also ``a - b``.

    Raises ShapeError if the dimensions differ. Source: paper Section V (unsafe: the space without a box).

    Example:
        >>> ring = Difference(Box([-2.0], [2.0]), Box([-1.0], [1.0]))
        >>> ring.contains(torch.tensor([[0.0], [1.5], [3.0]]))
        tensor([False,  True, False])
    """

    def __init__(self, a: Region, b: Region) -> None:
        self.a, self.b, self.dim = a, b, _common_dim(a, b)

    def contains(self, state: Tensor) -> Tensor:
        """Whether states are in A and not in B."""
        return self.a.contains(state) & ~self.b.contains(state)

    def sample(self, n: int, generator: torch.Generator | None = None, device: torch.device | str | None = None) -> Tensor:
        """Samples of A without those in B; raises EmptyRegionError if (almost) every sample of A is in B."""
        parts, found = [], 0
        for _ in range(_ATTEMPTS):
            x = self.a.shuffled(max(2 * n, 64), generator, device)
            x = x[~self.b.contains(x)]
            parts.append(x)
            found += len(x)
            if found >= n:
                return torch.cat(parts)[:n]
        raise EmptyRegionError(
            f"expected a difference with positive volume, received {found} states in {_ATTEMPTS} attempts to draw {n}; "
            "make the first set larger or the second smaller"
        )


class Union(Region):
    r"""States of any of several sets of the same dimension, :math:`\bigcup_i A_i`; also ``a | b``.

    Raises ConfigError if there are none; ShapeError if the dimensions differ. Source: none.

    Example:
        >>> (Box([0.0], [1.0]) | Box([2.0], [3.0])).contains(torch.tensor([[0.5], [1.5], [2.5]]))
        tensor([ True, False,  True])
    """

    def __init__(self, *parts: Region) -> None:
        if not parts:
            raise ConfigError("expected at least one set to unite, received none; pass the sets as arguments")
        self.parts, self.dim = parts, _common_dim(*parts)

    @property
    def low(self) -> Tensor:
        """Lower corner ``(dim,)`` of the box around all parts, of parts that have one."""
        return torch.stack([part.low for part in self.parts]).amin(0)  # type: ignore[attr-defined]

    @property
    def high(self) -> Tensor:
        """Upper corner ``(dim,)``, likewise."""
        return torch.stack([part.high for part in self.parts]).amax(0)  # type: ignore[attr-defined]

    def contains(self, state: Tensor) -> Tensor:
        """Whether states are in any of the sets."""
        return torch.stack([p.contains(state) for p in self.parts]).any(0)

    def sample(self, n: int, generator: torch.Generator | None = None, device: torch.device | str | None = None) -> Tensor:
        """Samples in equal shares from the parts, whatever their size, grouped by part: uniform where these are as large and apart."""
        return self._by_part(torch.randint(len(self.parts), (n,), generator=generator, device=device), generator, device)

    def shuffled(self, n: int, generator: torch.Generator | None = None, device: torch.device | str | None = None) -> Tensor:
        """Samples as of :meth:`sample`, not grouped."""
        return _permuted(self.sample(n, generator, device), generator)

    def _by_part(self, which: Tensor, generator: torch.Generator | None, device: torch.device | str | None) -> Tensor:
        return torch.cat([p.sample(int((which == k).sum()), generator, device) for k, p in enumerate(self.parts)])


class Mixture(Union):
    """Union of regions from which states are drawn in given shares, not negative and not all zero.

    ``grouped``: whether samples come part by part. Raises ConfigError if the shares do not fit the parts. Source: none.

    Example:
        >>> mixture = Mixture([Box([-1.0], [0.0]), Box([1.0], [2.0])], [1, 3])
        >>> 0.7 < float((mixture.sample(400, torch.Generator().manual_seed(0)) > 0).float().mean()) < 0.8
        True
    """

    def __init__(self, parts: Sequence[Region], shares: Sequence[float], *, grouped: bool = True) -> None:
        if len(parts) != len(shares) or min(shares, default=-1) < 0 or not sum(shares) > 0:
            raise ConfigError(f"shares: expected one share >= 0 for each of {len(parts)} regions, received {list(shares)}.")
        kept = [(part, float(share)) for part, share in zip(parts, shares, strict=True) if share > 0]
        super().__init__(*(part for part, _ in kept))
        self.shares, self.grouped = torch.tensor([share for _, share in kept]), grouped

    def sample(self, n: int, generator: torch.Generator | None = None, device: torch.device | str | None = None) -> Tensor:
        """Samples in the given shares."""
        which = torch.multinomial(self.shares.to(device or "cpu"), n, True, generator=generator) if n else torch.zeros(0)
        found = self._by_part(which, generator, device)
        return found if self.grouped else _permuted(found, generator)


def label(state: Tensor, safe: Region, unsafe: Region) -> Tensor:
    """Region codes of states ``(*batch, dim)``: 0 unlabelled, 1 safe, 2 unsafe (which wins where both claim a state).

    Returns int64 ``(*batch, 1)``. Raises ShapeError if the last dimension is not that of the sets; NonFiniteError if a
    state is NaN. Source: paper Section III (the labelled data).

    Example:
        >>> label(torch.tensor([[0.5], [1.5], [2.5]]), Box([0.0], [1.0]), Box([2.0], [3.0])).flatten()
        tensor([1, 0, 2])
    """
    codes = torch.where(safe.contains(state), SAFE, UNLABELLED)
    return torch.where(unsafe.contains(state), UNSAFE, codes).unsqueeze(-1)


def check_disjoint(safe: Region, unsafe: Region, n: int = 4096) -> None:
    """Raises if one of n samples of one set belongs to the other: a check by samples, not a proof.

    Raises OverlapError if the sets share a sample; EmptyRegionError if a set has (almost) no volume. Source: none.

    Example:
        >>> check_disjoint(Box([0.0], [1.0]), Box([2.0], [3.0]))
    """
    generator = torch.Generator().manual_seed(0)
    shared = int(unsafe.contains(safe.sample(n, generator)).sum()), int(safe.contains(unsafe.sample(n, generator)).sum())
    if any(shared):
        raise OverlapError(
            f"expected disjoint safe and unsafe sets, received {shared[0]} of {n} safe samples in the unsafe set and "
            f"{shared[1]} of {n} unsafe samples in the safe set; change one of them"
        )


def _permuted(states: Tensor, generator: torch.Generator | None) -> Tensor:
    return states[torch.randperm(len(states), generator=generator, device=states.device)]


def _check_states(state: Tensor, dim: int) -> None:
    if state.ndim < 1 or state.shape[-1] != dim:
        raise ShapeError(
            f"expected states of shape (*batch, {dim}), received {tuple(state.shape)}; the last dimension holds the state"
        )
    if bool(state.isnan().any()):
        raise NonFiniteError(
            f"expected states without NaN, received {int(state.isnan().sum())} of {state.numel()} values NaN; check the "
            "dynamics or the action that led there"
        )


def _common_dim(*parts: Region) -> int:
    if len({p.dim for p in parts}) > 1:
        raise ShapeError(f"expected sets of one dimension, received dimensions {[p.dim for p in parts]}")
    return parts[0].dim
