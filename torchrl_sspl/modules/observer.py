r"""The latent observer: a memory that believes its own prediction, and corrects it by a share of what is seen."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import torch
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModuleBase
from torch import Tensor, nn
from torchrl.data import Unbounded
from torchrl.envs import TensorDictPrimer

from torchrl_sspl.direction import Direction, direction_of, within
from torchrl_sspl.errors import ConfigError, ShapeError
from torchrl_sspl.modules.salad import as_tensordict_module, written

#: More than a correction that is cut to a length, computed in float32, is longer than that: 2^-22 an entry of up to ten, of [-1, 1].
CUT = 1e-6


def gain_matrix(gain: float | Sequence[Any] | Tensor, latent_dim: int, seen_dim: int | None = None) -> Tensor:
    """The gain K ``(p, p)`` of an observer, from a number k (K = k I) or a matrix. Source: none.

    Args:
        gain: k or K; 1 or the identity: what is seen is believed as it is.
        latent_dim: p.
        seen_dim: leading entries of the latent that pictures show; of a number k, K is zero on the others. Default: p.

    Raises:
        ConfigError: if it has another shape, or is not finite, or I - K is longer than 1 in some direction (the observer
            would move away from what it sees), or K is zero.

    Example:
        >>> gain_matrix(0.5, 2).tolist()
        [[0.5, 0.0], [0.0, 0.5]]
    """
    kept = isinstance(gain, Tensor) and gain.is_floating_point()  # a matrix of float64 is not rounded
    given = torch.as_tensor(gain, dtype=None if kept else torch.float32).detach().cpu()
    shows = torch.arange(latent_dim) < (latent_dim if seen_dim is None else seen_dim)
    matrix = given * torch.diag(shows.float()) if given.ndim == 0 else given.clone()
    if matrix.shape != (latent_dim, latent_dim) or not bool(matrix.isfinite().all()):
        raise ConfigError(
            f"expected a gain that is a finite number or a ({latent_dim}, {latent_dim}) matrix, received {tuple(given.shape)}"
        )
    left = float(torch.linalg.matrix_norm(torch.eye(latent_dim, dtype=torch.float64) - matrix.double(), ord=2))
    if left > 1.0 + 1e-6 or not bool(matrix.any()):
        raise ConfigError(
            f"expected a gain K with |I - K| <= 1 that is not zero, such as a number in (0, 1], received |I - K| = {left:.3g}"
        )
    return matrix


def completed(seen: Tensor, prior: Tensor, gain: Tensor) -> Tensor:
    """What is seen, with the entries that no picture shows as they were expected: those that no column of K reads.

    Latents ``(*batch, p)``, gain ``(p, p)``. Source: none.

    Example:
        >>> completed(torch.zeros(1, 2), torch.ones(1, 2), torch.tensor([[0.5, 0.0], [0.0, 0.0]])).tolist()
        [[0.0, 1.0]]
    """
    return torch.where((gain != 0).any(0), seen, prior)


def corrected(prior: Tensor, seen: Tensor, gain: Tensor, direction: Direction | None = None) -> tuple[Tensor, Tensor]:
    r"""Posterior and innovation of an observer.

    .. math:: i_t = E(o_t) - p_t, \qquad \hat z_t = \operatorname{clamp}(p_t + K i_t, -1, 1)

    Latents ``(*batch, p)``, gain ``(p, p)``; a direction goes back onto its circle. Source: none (the paper acts on :math:`E(o_t)`,
    which is K = I).

    Example:
        >>> corrected(torch.zeros(1, 1), torch.ones(1, 1), torch.tensor([[0.25]]))[0].tolist()
        [[0.25]]
    """
    innovation = seen - prior
    left = torch.eye(len(gain), dtype=gain.dtype, device=gain.device) - gain
    # From what is seen, not from the prior: with K = I the result is what is seen, to the last bit.
    return within(seen - innovation @ left.mT, direction), innovation


def held(
    barrier: Callable[[Tensor], Tensor], prior: Tensor, latent: Tensor, error: float, direction: Direction | None = None
) -> tuple[Tensor, Tensor]:
    r"""The corrected latent, its correction cut to a length where the whole of it would leave the set of the prior.

    .. math:: \hat z = p + \delta \frac{\hat z' - p}{\lVert \hat z' - p \rVert} \quad \text{where } B(p) \le 0 < B(\hat z')

    A set that is proved to tolerate an error :math:`\delta` at every step is then not left, whatever is seen. Source: none
    (in filtering, the projection of a constrained estimate).

    Args:
        barrier: latent ``(..., p)`` -> barrier value ``(..., 1)``, at most zero means inside; asked once, of both, ``(2, *batch, p)``.
        prior, latent: before and after the correction, ``(*batch, p)``.
        error: :math:`\delta`, latent units; 0: nothing is cut.
        direction: what is cut goes back onto its circle, and is cut so much more that it is not farther away then.

    Returns latents ``(*batch, p)`` and where something was cut ``(*batch,)``.

    Example:
        >>> held(lambda z: z - 0.5, torch.zeros(2, 1), torch.tensor([[0.4], [0.6]]), 0.1)
        (tensor([[0.4000],
                [0.1000]]), tensor([False,  True]))
    """
    if not error > 0.0:
        return latent, torch.zeros_like(latent[..., 0], dtype=torch.bool)
    moved = latent - prior
    length = moved.norm(dim=-1, keepdim=True)
    before, after = barrier(torch.stack([prior, latent]))
    leaves = (before <= 0.0) & (after > 0.0) & (length > error)
    if not torch.compiler.is_compiling() and not bool(leaves.any()):
        return latent, leaves[..., 0]
    most = error if direction is None else direction.shortened(error)
    return torch.where(leaves, within(prior + moved * (most / length), direction), latent), leaves[..., 0]


class LatentObserver(TensorDictModuleBase):
    r"""Encoder with a memory: the latent that was predicted, corrected by a share of what is seen.

    .. math::
        p_t = d(\hat z_{t-1}, u_{t-1}), \qquad i_t = E(o_t) - p_t, \qquad
        \hat z_t = \operatorname{clamp}(p_t + K i_t, -1, 1), \qquad \hat z_0 = E(o_0)

    An encoder of two frames sees a velocity badly: its error is as large as that of a disturbance at every step. Behind
    an observer only :math:`K i_t` enters the closed loop, several times smaller. K = I is the encoder alone. The
    prediction is a hidden state in TorchRL's way: it is read from ``"prior"``, forgotten where ``"is_init"``, and
    written to ``("next", "prior")`` by :class:`Predict`, once the action is known. :meth:`make_tensordict_primer` gives
    the transform of the environment that both keys need beside ``InitTracker``.

    Args:
        encoder: observation -> latent ``(*batch, p)`` in [-1, 1].
        gain: K, a number or ``(p, p)``; see :func:`gain_matrix`, for errors too.
        latent_dim: p.
        barrier, error: the set in which corrections are held, see :func:`held`; none by default.
        direction: which entries of the latent are one; none by default.

    Source: none (Luenberger's observer on a learned latent; in world models prior and posterior); the paper has K = I.

    Example:
        >>> from tensordict import TensorDict
        >>> from torchrl_sspl.modules import FrameEncoder
        >>> observer = LatentObserver(FrameEncoder(2), 0.2, 2)
        >>> pixels = torch.zeros(4, 6, 32, 32, dtype=torch.uint8)
        >>> begins = torch.zeros(4, 1, dtype=torch.bool)
        >>> data = observer(TensorDict(pixels=pixels, prior=torch.zeros(4, 2), is_init=begins, batch_size=[4]))
        >>> torch.allclose(data["latent"], 0.2 * data["innovation"])
        True
    """

    gain: Tensor

    def __init__(
        self,
        encoder: nn.Module,
        gain: float | Sequence[Any] | Tensor,
        latent_dim: int,
        barrier: nn.Module | None = None,
        error: float = 0.0,
        direction: Direction | None = None,
    ) -> None:
        super().__init__()
        self.direction = direction
        if error > 0.0 and barrier is None:
            raise ConfigError(f"expected a barrier with error={error}, received none; give the one whose set tolerates it")
        self.barrier, self.error = barrier, error
        self.encoder = as_tensordict_module(encoder, ["pixels"], ["latent"])
        self.latent_dim = latent_dim
        self.register_buffer("gain", gain_matrix(gain, latent_dim))
        self.in_keys = [*self.encoder.in_keys, "prior", "is_init"]
        self.out_keys = [written(self.encoder, "latent"), "innovation"]

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Write the latent and ``"innovation"``, both ``(*batch, p)``; where an episode begins there is none."""
        seen = self.encoder(tensordict.select(*self.encoder.in_keys))[self.out_keys[0]]
        prior, begins = tensordict["prior"], tensordict["is_init"]
        if prior.shape != seen.shape:
            raise ShapeError(f"expected a prior of shape {tuple(seen.shape)}, received {tuple(prior.shape)}; add the primer")
        expected = torch.where(begins, seen, prior)
        latent, innovation = corrected(expected, completed(seen, expected, self.gain), self.gain, self.direction)
        if self.barrier is not None:
            latent = held(self.barrier, expected, latent, self.error, self.direction)[0]
        return tensordict.set(self.out_keys[0], latent).set("innovation", innovation)

    def make_tensordict_primer(self) -> TensorDictPrimer:
        """The transform that gives an environment the key ``"prior"``; TorchRL's collectors look for it."""
        return TensorDictPrimer(prior=Unbounded((self.latent_dim,)), expand_specs=True)


class Predict(TensorDictModuleBase):
    """Writes the observer's next prior, ``("next", "prior")``, from latent and action. Source: none.

    Args:
        dynamics: (latent ``(*batch, p)``, action ``(*batch, m)``) -> next latent ``(*batch, p)``.

    Example:
        >>> from torchrl_sspl.modules import LatentDynamics
        >>> Predict(LatentDynamics(2, 1)).out_keys
        [('next', 'prior')]
    """

    def __init__(self, dynamics: nn.Module) -> None:
        super().__init__()
        self.dynamics = as_tensordict_module(dynamics, ["latent", "action"], [("next", "latent")])
        self.in_keys, self.out_keys = list(self.dynamics.in_keys), [("next", "prior")]
        self._after = written(self.dynamics, ("next", "latent"))

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Write ``("next", "prior")`` ``(*batch, p)``."""
        after = self.dynamics(tensordict.select(*self.in_keys))[self._after]
        return tensordict.set(("next", "prior"), after)


@torch.no_grad()
def filtered(
    dynamics: nn.Module, gain: Tensor, seen: Tensor, next_seen: Tensor, action: Tensor, continues: Tensor
) -> tuple[Tensor, Tensor]:
    r"""What an observer makes of recorded episodes: latents before and after every transition, each ``(n, p)``.

    Args:
        dynamics: (latent, action) -> next latent.
        gain: K ``(p, p)``.
        seen, next_seen: encoded observations before and after ``(n, p)``.
        action: ``(n, m)``.
        continues: ``(n,)`` bool, whether a transition goes on where the one before it ends; others begin an episode.

    Source: none.

    Example:
        >>> still = lambda latent, action: latent
        >>> seen, after = torch.zeros(2, 1), torch.ones(2, 1)
        >>> filtered(still, torch.full((1, 1), 0.5), seen, after, after, torch.tensor([False, True]))[1].tolist()
        [[0.5], [0.75]]
    """
    latent, after = seen.clone(), next_seen.clone()
    rows = (~continues).nonzero()[:, 0]
    while len(rows):
        prior = dynamics(latent[rows], action[rows])
        after[rows] = corrected(prior, completed(next_seen[rows], prior, gain), gain, direction_of(dynamics))[0]
        rows = rows[rows + 1 < len(seen)] + 1
        rows = rows[continues[rows]]
        latent[rows] = after[rows - 1]
    return latent, after


__all__ = ["LatentObserver", "Predict", "completed", "corrected", "filtered", "gain_matrix", "held"]
