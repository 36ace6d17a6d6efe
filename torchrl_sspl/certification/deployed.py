"""Whether the modules that are deployed compute what is proved: values at many points, against the graph.

That they have the structure of the graph is checked when it is built
(:func:`~torchrl_sspl.lipschitz.network.check_module`). Here their values are compared with it, in the dtype and on the
device on which they are deployed; the two may differ by what rounding can do at that point, and by nothing else.
"""

from __future__ import annotations

import itertools

import torch
from torch import Tensor, nn

from torchrl_sspl.certification.floating import UNITS, rounding_bound
from torchrl_sspl.certification.loop import ClosedLoop
from torchrl_sspl.errors import SSPLError, StructureError

POINTS = 1000
_CORNERS = 256


def deployed_dtype(*modules: nn.Module) -> torch.dtype:
    """The one dtype of all weights, float32 or float64, else ``StructureError``.

    Example:
        >>> deployed_dtype(nn.Linear(1, 1), nn.Linear(1, 1))
        torch.float32
    """
    found = {t.dtype for m in modules for t in itertools.chain(m.parameters(), m.buffers())}
    if len(found) != 1 or not found <= set(UNITS):
        names = sorted(map(str, found))
        raise StructureError(f"expected networks of torch.float32 or of torch.float64, received {names}", "WRONG_DTYPE")
    return found.pop()


@torch.no_grad()
def check_deployed(
    system: ClosedLoop, barrier: nn.Module, dynamics: nn.Module, policy: nn.Module, *, n: int = POINTS, seed: int = 0
) -> int:
    """Compares the modules with the closed loop that was built from them, at random points, corners and the centre.

    The modules are those of :func:`~.loop.closed_loop`, with the ``collapse()`` of a barrier that has one.
    Of a policy that chooses each action's successor is compared, and which of them it takes.
    Returns the number of all points; ``StructureError`` if values differ by more than rounding allows, a module changes
    its input, or the dtypes are not one of float32 and float64.

    Example:
        >>> from torchrl_sspl.certification import closed_loop
        >>> parts = nn.Sequential(nn.Linear(1, 1)), nn.Sequential(nn.Linear(2, 1)), nn.Sequential(nn.Linear(1, 1))
        >>> check_deployed(closed_loop(*parts, latent_dim=1, lipschitz_bound=9.0), *parts, n=10)
        13
    """
    if type(barrier) is not nn.Sequential:
        raise StructureError(
            f"expected the barrier that is deployed as an nn.Sequential, received {type(barrier).__name__}; pass its collapse()"
        )
    dtype = deployed_dtype(barrier, dynamics, policy)
    device = next(itertools.chain(barrier.parameters())).device
    point = _points(system, n, seed).to(dtype).double().clamp(system.low, system.high)
    given: Tensor = system.latent(point).to(device, dtype)

    def step(z: Tensor) -> Tensor:
        after = [dynamics(torch.cat([z, u], -1)) if type(dynamics) is nn.Sequential else dynamics(z, u) for u in _actions(system, policy, z)]
        return torch.cat(after, -1) if system.chooses else after[0]

    for name, graph, function in (("barrier", system.barrier, barrier), ("d(z, pi(z))", system.step, step)):
        first, second = (rounding_bound(graph, point, point, unit, refined=True)[-1] for unit in (UNITS[dtype], 2.0**-53))
        exact = graph(point)
        for rows in _batches(len(point)):
            z = given[rows].clone()
            try:
                value = function(z)
            except (SSPLError, RuntimeError, ValueError, TypeError, IndexError) as error:
                raise StructureError(f"expected the {name} to be computable, received {error}", "VALUES_DIFFER") from error
            if value.shape != exact[rows].shape or value.dtype != dtype or not torch.equal(z, given[rows]):
                raise StructureError(
                    f"expected the {name} of shape {tuple(exact[rows].shape)} and {dtype}, its input unchanged, received "
                    f"{tuple(value.shape)} and {value.dtype}",
                    "VALUES_DIFFER",
                )
            gap = (value.double().cpu() - exact[rows]).abs()
            if not bool((gap <= (first + second)[rows]).all()):
                raise StructureError(
                    f"expected the deployed {name} to be what is proved up to rounding, received values that differ by "
                    f"{float(gap.max()):.3g}; deploy the networks that are certified",
                    "VALUES_DIFFER",
                )
    if system.chooses:
        _check_choice(system, policy, point, given, UNITS[dtype])
    return len(point)


def _batches(n: int) -> tuple[slice, ...]:
    """All points in one batch, and some alone: the sums may be taken in another order, and nothing may remember the batch."""
    return (slice(None), *(slice(k, k + 1) for k in range(0, n, max(1, n // 8))))


def _actions(system: ClosedLoop, policy: nn.Module, z: Tensor) -> list[Tensor]:
    """What the policy does at latents ``(n, p)``, or the actions among which it chooses, its own first; each ``(n, m)``."""
    if not system.chooses:
        return [policy(z)]
    own: Tensor = policy.policy(z)  # type: ignore[operator]
    return [own, *(action.expand_as(own) for action in policy.actions)]  # type: ignore[union-attr]


def _check_choice(system: ClosedLoop, policy: nn.Module, point: Tensor, given: Tensor, unit: float) -> None:
    """Refuses a policy that takes another action than it says, beyond what rounding decides."""
    first, second = (rounding_bound(system.looped, point, point, u, refined=True)[-1] for u in (unit, 2.0**-53))
    value, off = system.looped(point), first + second
    low, high = value - off, value + off
    may = low <= high[:, 1:].amin(1, keepdim=True)  # of the table: none is surely better
    may &= high[:, :1] > system.accepted
    may[:, 0] = low[:, 0] <= system.accepted
    for rows in _batches(len(point)):
        z = given[rows].clone()
        try:
            taken, tried = policy(z), torch.stack(_actions(system, policy, given[rows]), 1)
        except (SSPLError, RuntimeError, ValueError, TypeError, IndexError) as error:
            raise StructureError(f"expected the policy to be computable, received {error}", "VALUES_DIFFER") from error
        same = taken.shape == tried[:, 0].shape and taken.dtype == tried.dtype and torch.equal(z, given[rows])
        if not same or not bool((((taken[:, None] == tried).all(2)).cpu() & may[rows]).any(1).all()):
            raise StructureError(
                f"expected one of the policy's actions {tuple(tried[:, 0].shape)}: its own where B is at most {system.accepted:g} after it, "
                "else the best of the table, received another; deploy the policy that is certified",
                "VALUES_DIFFER",
            )


def _points(system: ClosedLoop, n: int, seed: int) -> Tensor:
    """Random points, corners (some of them where they are many), the centre."""
    generator = torch.Generator().manual_seed(seed)
    p, span = system.latent_dim, system.high - system.low
    share = [torch.rand(n, p, generator=generator, dtype=torch.float64), torch.full((1, p), 0.5, dtype=torch.float64)]
    if 2**p <= _CORNERS:
        share.append(torch.cartesian_prod(*[torch.tensor([0.0, 1.0], dtype=torch.float64)] * p).reshape(-1, p))
    else:
        share.append(torch.randint(0, 2, (_CORNERS, p), generator=generator).double())
    return system.low + span * torch.cat(share)
