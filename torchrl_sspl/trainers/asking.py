"""Which pictures are worth a label, and what a few labels say of all the others."""

from __future__ import annotations

import itertools
import math

import torch
from torch import Tensor, nn
from torch.nn import functional as F

from torchrl_sspl.errors import EmptyRegionError
from torchrl_sspl.seeds import spawn
from torchrl_sspl.sets import SAFE, UNLABELLED, UNSAFE
from torchrl_sspl.trainers.phases import InnerLoop, Workspace
from torchrl_sspl.viability.cloud import nearest_distance

_ROUNDS = 20  # in which labels are asked for; what they say of the others is computed anew in each
_DOUBT = 0.3  # value of f up to which the border of U may be near
_CAUTION = 0.1  # below zero from which on a latent counts as of U
_SMOOTHING = 0.1  # of f, latent units: the border does not turn to every single label
_AGAINST = 0.9  # value of what the other labels say beyond which one is wrong that says the opposite
_ENOUGH = 20  # labels of either kind from which on this is asked
_MOST, _AROUND = 2000, 64  # labels that are interpolated all at once, and of more the nearest ones
_NETWORKS, _WIDTH = 5, 64  # whose mean says what is of U, and their hidden units
_BATCH, _LR, _LR_SHARE = 2048, 3e-3, 3e-2  # with which they are trained, and the share of labels beside them
_LIKELY = -4.0  # log-odds from which on a latent counts as of U: a chance of 2 %


@torch.no_grad()
def choose_and_spread(seen: Tensor, told: Tensor, answer: Tensor, count: int) -> tuple[Tensor, Tensor]:
    r"""Labels for the latents of which a few labels tell least, and what labels say of all latents that have none.

    .. math:: f(z) = c - \sum_j w_j \lVert z - z_j \rVert, \qquad
        i^\star = \arg\max_i \; \min_j \lVert z_i - z_j \rVert \, e^{-(f(z_i) / 0.3)^2}, \qquad z_i \text{ counts as of U if } f(z_i) > -0.1

    where f interpolates 1 at the latents :math:`z_j` that are told to be of U, and -1 at those that are told not to be: asked for is what may
    lie on the border of U and far from what is known. Unlike labels of S and U alone, an answer can be *neither*: without it nobody
    knows where U ends. A label that all others contradict, :math:`f_{-j}(z_j)` beyond 0.9 on the other side where f is interpolated without it, counts as
    wrong and is not used. Source: none (uncertainty sampling, spread out by distances); the paper takes its labels at random.

    Args:
        seen: ``(n, p)`` latents of single pictures.
        told: ``(n,)`` bool, whose label is known.
        answer: ``(n,)`` codes of ``sets``; read only where a label is known or asked for.
        count: labels that are asked for, or all where there are fewer without one.

    Returns ``(n,)`` codes, in which only labels say S, and of which labels are known now, wrong ones among them, bool. Raises EmptyRegionError where nothing
    is told to be of U, or nothing not to be.

    Example:
        >>> z = torch.linspace(-1, 1, 201)[:, None]
        >>> answer = torch.where(z[:, 0] > 0.305, 2, 0)
        >>> told = torch.zeros(201, dtype=torch.bool).index_fill(0, torch.tensor([0, 200]), True)
        >>> region, told = choose_and_spread(z, told, answer, 8)
        >>> int((region != answer).sum()), int(told.sum())
        (0, 10)
    """
    told, unsafe = told.clone(), answer == UNSAFE
    sides = int((told & unsafe).sum()), int((told & ~unsafe).sum())
    if 0 in sides:
        raise EmptyRegionError(
            f"expected labels of U and of what is not of U, received {sides[0]} and {sides[1]}; record more of what is "
            "missing (collector.starts, trainer.total_frames), or raise labels.unsafe and labels.safe"
        )
    for part in torch.arange(count).chunk(_ROUNDS):
        doubt = (-(_interpolated(seen, told, unsafe) / _DOUBT).square()).exp()
        far = nearest_distance(seen, seen[told])
        for _ in range(len(part)):
            row = (doubt * far).masked_fill(told, -1.0).argmax()
            told[row] = True
            far = torch.minimum(far, (seen - seen[row]).norm(dim=1))
    used = told & ~_contradicted(seen, told, unsafe)
    spread = torch.where(_interpolated(seen, used, unsafe) > -_CAUTION, UNSAFE, UNLABELLED)
    return torch.where(used, answer, spread), told


def _interpolated(seen: Tensor, told: Tensor, unsafe: Tensor) -> Tensor:
    """f ``(n,)`` at all latents."""
    # Imported here: scipy is a dependency, but importing the library stays light without it.
    from scipy.interpolate import RBFInterpolator

    z, near = seen.double().numpy(), None if int(told.sum()) <= _MOST else _AROUND
    f = RBFInterpolator(z[told.numpy()], torch.where(unsafe[told], 1.0, -1.0).numpy(), neighbors=near, kernel="linear", smoothing=_SMOOTHING)
    return torch.as_tensor(f(z), dtype=torch.float32)


def _contradicted(seen: Tensor, told: Tensor, unsafe: Tensor) -> Tensor:
    """``(n,)`` which labels all others contradict; of few labels nothing is said, nor of more than are interpolated all at once."""
    found, sides = torch.zeros_like(told), (int((told & unsafe).sum()), int((told & ~unsafe).sum()))
    if min(sides) >= _ENOUGH and sum(sides) <= _MOST:
        y = torch.where(unsafe[told], 1.0, -1.0).double()
        found[told] = _left_out(seen[told].double(), y) * y < -_AGAINST
    return found


def _left_out(z: Tensor, y: Tensor) -> Tensor:
    r"""f at every latent ``(n, p)`` without its own value ``(n,)``: :math:`f_{-j}(z_j) = y_j - c_j / (A^{-1})_{jj}` where :math:`A c = y`.

    A is the matrix of the interpolation, with its constant.
    """
    n = len(z)
    system = torch.ones(n + 1, n + 1, dtype=torch.float64)
    system[:n, :n] = _SMOOTHING * torch.eye(n) - torch.cdist(z, z, compute_mode="donot_use_mm_for_euclid_dist")
    system[n, n] = 0.0
    inverse = torch.linalg.inv(system)[:n, :n]
    return y - inverse @ y / inverse.diagonal()


def infer_unsafe(seen: Tensor, region: Tensor, drawn: Tensor, *, steps: int = 1500, seed: int = 0) -> Tensor:
    r"""Which latents without a label are probably of U, where some of those of U are labelled, at random.

    .. math:: \max_{c, f} \; \sum_{z \in U} \log c \, \sigma(f(z)) + \sum_{z \in S} \log (1 - \sigma(f(z)))
        + \sum_{z \in D} \log (1 - c \, \sigma(f(z))), \qquad z \text{ counts as of U if } f(z) > -4

    where c is the share of U that is labelled, which comes out, too: where labels of U are as frequent as that, all is of U, and where there are
    none among many pictures, nothing is. f is the mean of five small networks. That labels are as frequent everywhere in U is assumed
    (labels at random are; those that come first are of few episodes). Source: Elkan and Noto, *Learning classifiers from only positive and unlabeled
    data*, KDD 2008; deviation: their c is an average over labels, here it is fitted with f, and labels of S are used. The paper counts what has no label as neither.

    Args:
        seen: ``(n, p)`` latents of single pictures.
        region: ``(n,)`` codes of ``sets``, as labelled.
        drawn: ``(n,)`` bool, which were recorded while there were labels of U left; f is learnt from these alone.
        steps: of the optimiser; with fewer, more counts as of U.
        seed: of the networks' initial weights and batches.

    Returns ``(n,)`` codes, in which only labels say S. Raises EmptyRegionError where nothing of ``drawn`` is labelled U, or nothing is without a label.

    Example:
        >>> z = torch.rand(4000, 1, generator=torch.Generator().manual_seed(0))
        >>> labelled = (z[:, 0] > 0.7) & (torch.arange(4000) < 600)  # one in seven of U
        >>> found = infer_unsafe(z, 2 * labelled, torch.ones(4000, dtype=torch.bool), steps=300)
        >>> int(((z[:, 0] > 0.7) & (found != 2)).sum()), int(((z[:, 0] < 0.6) & (found == 2)).sum())
        (0, 0)
    """
    z, code = seen[drawn], region[drawn]
    unsafe, safe = code == UNSAFE, code == SAFE
    if not bool(unsafe.any()) or not bool((code == UNLABELLED).any()):
        raise EmptyRegionError(
            f"expected labels of U and latents without a label, received {int(unsafe.sum())} and {int((code == UNLABELLED).sum())}; raise labels.unsafe, "
            "or set labels.share=1"
        )
    mean, scale = z.mean(0), z.std(0).clamp_min(1e-6)
    loop = InnerLoop(seed)
    with torch.random.fork_rng():
        torch.manual_seed(seed)
        networks = _Several([z.shape[1], _WIDTH, _WIDTH, 1])
        # From below, since it cannot be less than the share of all latents: from above, f would be low everywhere before it came down.
        share = nn.ParameterList([torch.full((_NETWORKS, 1), math.log(float(unsafe.float().mean())))])

        def step() -> dict[str, Tensor]:
            rows = loop.pick(len(z), _BATCH)
            f = networks((z[rows] - mean) / scale)
            known, neither = F.logsigmoid(share[0]) + F.logsigmoid(f), torch.log1p(-share[0].sigmoid() * f.sigmoid() * (1 - 1e-6))
            likelihood = torch.where(unsafe[rows], known, torch.where(safe[rows], F.logsigmoid(-f), neither))
            return {"loss_likelihood": -likelihood.mean(1).sum()}

        loop(steps, {networks: _LR, share: _LR_SHARE}, step)
    with torch.no_grad():
        likely = torch.cat([networks((part - mean) / scale).mean(0) > _LIKELY for part in seen.split(1 << 15)])
    return torch.where((region == UNLABELLED) & likely, UNSAFE, region)


def tell_of_others(work: Workspace, number: int) -> None:
    """What labels say of pictures that have none, in ``work.latents["region"]``; where they are chosen, the first round asks for them. Source: none."""
    data, source = work.latents, work.source
    seen, told = data["seen"][:, : work.seen_dim], data["told"][:, 0]
    if source.labels.choose:
        answer, count = data["answer"][:, 0], 0 if number else source.labels.choose
        region, known = choose_and_spread(seen, told, answer, count)
        asked = int((known & ~told).sum())
        if asked < count:
            work.warnings.append(f"all pictures have labels: {asked:,} had none, and labels.choose asked for {count:,}")
        source.count_labels(answer[known & ~told])
        data["told"] = known[:, None]
    else:
        drawn, region = data["drawn"][:, 0], torch.where(told, data["region"][:, 0], UNLABELLED)
        both = all(bool((region[drawn] == code).any()) for code in (UNSAFE, UNLABELLED))
        if both:
            region = infer_unsafe(seen, region, drawn, seed=spawn(work.seed, "inferred labels"))
    data["region"] = region[:, None]


class _Several(nn.Module):
    """Networks of the same sizes, side by side: ``(n, p) -> (networks, n)``."""

    def __init__(self, sizes: list[int]) -> None:
        super().__init__()
        pairs = list(itertools.pairwise(sizes))
        self.weights = nn.ParameterList((2 * torch.rand(_NETWORKS, m, n) - 1) / math.sqrt(m) for m, n in pairs)
        self.biases = nn.ParameterList((2 * torch.rand(_NETWORKS, 1, n) - 1) / math.sqrt(m) for m, n in pairs)

    def forward(self, x: Tensor) -> Tensor:
        h = x.expand(_NETWORKS, -1, -1)
        for k, (weight, bias) in enumerate(zip(self.weights, self.biases, strict=True)):
            h = torch.baddbmm(bias, F.silu(h) if k else h, weight)
        return h[..., 0]


__all__ = ["choose_and_spread", "infer_unsafe"]
