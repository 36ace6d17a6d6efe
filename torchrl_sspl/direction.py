r"""Two entries of a latent that hold a direction: a point on a circle, so that an angle has no jump."""

from __future__ import annotations

import math
from typing import NamedTuple

import torch
from torch import Tensor


class Direction(NamedTuple):
    r"""Entries ``first`` and ``first + 1`` of latents lie on a circle around zero; the others in [-1, 1].

    .. math:: z = (y, \; r \cos \tfrac{\varphi}{r}, \; r \sin \tfrac{\varphi}{r}, \; a), \qquad \varphi \in [-\pi r, \pi r]

    The *chart* :math:`(y, \varphi, a)` of a latent has one entry less, and measures along the circle: no two latents are farther apart
    than their charts are. Source: none.

    Attributes:
        first: of the two entries.
        radius: r in (0, 1], latent units.

    Example:
        >>> turn = Direction(1, 0.5)
        >>> latent = turn.lift(torch.tensor([[0.2, 0.0, 0.3]]))
        >>> latent.tolist()[0], turn.chart(latent).tolist()[0]  # doctest: +ELLIPSIS
        ([0.200..., 0.5, 0.0, 0.300...], [0.200..., 0.0, 0.300...])
    """

    first: int
    radius: float

    def lift(self, chart: Tensor) -> Tensor:
        """Latents ``(*batch, p)`` of charts ``(*batch, p - 1)``."""
        angle = chart[..., self.first : self.first + 1] / self.radius
        return torch.cat(
            [chart[..., : self.first], self.radius * angle.cos(), self.radius * angle.sin(), chart[..., self.first + 1 :]], -1
        )

    def chart(self, latent: Tensor) -> Tensor:
        """Charts ``(*batch, p - 1)`` of latents ``(*batch, p)``, which need not lie on the circle."""
        cos, sin = latent[..., self.first], latent[..., self.first + 1]
        along = self.radius * torch.atan2(sin, cos)
        return torch.cat([latent[..., : self.first], along[..., None], latent[..., self.first + 2 :]], -1)

    def onto(self, latent: Tensor) -> Tensor:
        """The nearest latents whose two entries lie on the circle, ``(*batch, p)``; the others stay as they are."""
        pair = latent[..., self.first : self.first + 2]
        length = pair.norm(dim=-1, keepdim=True)
        # The middle of the circle is as far from one direction as from any other.
        known = torch.where(length > 1e-12, pair, torch.ones_like(pair))
        found = self.radius * known / known.norm(dim=-1, keepdim=True)
        return torch.cat([latent[..., : self.first], found, latent[..., self.first + 2 :]], -1)

    def turn(self, latent: Tensor, by: Tensor) -> Tensor:
        """The two entries ``(*batch, 2)`` of latents, moved along the circle by a length ``(*batch, 1)``."""
        cos, sin = (by / self.radius).cos(), (by / self.radius).sin()
        x, y = latent[..., self.first, None], latent[..., self.first + 1, None]
        return torch.cat([x * cos - y * sin, x * sin + y * cos], -1)

    def shortened(self, error: float) -> float:
        r"""Length of a step from the circle after which the nearest point of it is at most ``error`` away,
        :math:`\delta \sqrt{1 - (\delta / 2 r)^2}`."""
        return error * math.sqrt(max(0.0, 1.0 - (0.5 * error / self.radius) ** 2))


def within(latent: Tensor, direction: Direction | None) -> Tensor:
    """The nearest latents of the domain, ``(*batch, p)``: in [-1, 1], and on the circle where there is one. Source: none.

    Example:
        >>> within(torch.tensor([3.0, 0.3, 0.4]), Direction(1, 1.0)).round(decimals=3)
        tensor([1.0000, 0.6000, 0.8000])
    """
    clamped = latent.clamp(-1.0, 1.0)
    return clamped if direction is None else direction.onto(clamped)


def lifted(chart: Tensor, direction: Direction | None) -> Tensor:
    """Latents of charts; where there is no direction they are their own. Source: none."""
    return chart if direction is None else direction.lift(chart)


def charted(latent: Tensor, direction: Direction | None) -> Tensor:
    """Charts of latents, likewise. Source: none."""
    return latent if direction is None else direction.chart(latent)


def direction_of(dynamics: object) -> Direction | None:
    """The direction that the latents of dynamics hold; None where they hold none, or the module does not say."""
    return getattr(dynamics, "direction", None)


__all__ = ["Direction", "charted", "direction_of", "lifted", "within"]
