"""Cost of `SSPLLoss` over the same mathematics in bare PyTorch: forward, backward and optimiser step.

Run: python benchmarks/loss_overhead.py [batch=192] [image_size=64] [repeats=15] [preset=sound]
Both sides have the same networks, batch and optimiser and take turns; the figure is the ratio of the medians.
"""

from __future__ import annotations

import copy
import statistics
import sys
import time
from collections.abc import Callable

import torch
from tensordict import TensorDict
from torch import Tensor, nn
from torchrl.objectives import SoftUpdate

from torchrl_sspl.modules import InverseDynamics, Policy, SaLaD
from torchrl_sspl.objectives import SSPLLoss


def networks() -> list[nn.Module]:
    """Encoder, dynamics, barrier, policy and inverse dynamics, the same on every call."""
    torch.manual_seed(0)
    salad = SaLaD.from_sizes(latent_dim=3, action_dim=1, action_scale=10.0)
    policy, inverse = Policy(3, 1, action_scale=10.0), InverseDynamics(3, 1, action_scale=10.0)
    return [salad.encoder.module, salad.dynamics.module, salad.barrier.module, policy, inverse]


def data(batch: int, image_size: int) -> TensorDict:
    generator = torch.Generator().manual_seed(0)
    frames = torch.randint(
        0, 256, (batch, 3, 3, image_size, image_size), dtype=torch.uint8, generator=generator
    )
    action = 20 * torch.rand(batch, 1, generator=generator) - 10
    region = torch.randint(0, 3, (batch, 1), generator=generator)
    return TensorDict(frames=frames, action=action, region=region, batch_size=batch)


def worst(values: Tensor, coefficient: float = 0.3, share: float = 0.05) -> Tensor:
    count = max(1, -int(-share * len(values) // 1))
    return values.mean() + coefficient * values.topk(count)[0].mean()


def frozen(module: nn.Module, *inputs: Tensor) -> Tensor:
    """The module with gradient to its inputs only."""
    for parameter in module.parameters():
        parameter.requires_grad_(False)
    output = module(*inputs)
    for parameter in module.parameters():
        parameter.requires_grad_(True)
    return output


def bare_world_model(nets: list[nn.Module]) -> Callable[[TensorDict], Tensor]:
    """The terms of `SSPLLoss(preset="sound").world_model`, written out."""
    terms = _world_model(nets)
    return lambda batch: terms(batch)[0]


def _world_model(nets: list[nn.Module]) -> Callable[[TensorDict], tuple[Tensor, Tensor]]:
    encoder, dynamics, barrier, _, inverse = nets

    def loss(batch: TensorDict) -> tuple[Tensor, Tensor]:
        action, region = batch["action"], batch["region"]
        latent, after = encoder.sequence(batch["frames"]).unbind(-2)
        level = barrier(latent)
        hinge_safe = (level + 0.3).clamp_min(0)[region == 1]
        hinge_unsafe = (0.3 - level).clamp_min(0)[region == 2]
        error = (dynamics(latent, action) - after).square().sum(-1)
        gap = (inverse(latent, after) - action) / 10.0
        depth = latent.abs().clamp_max(1 - 1e-6).atanh()
        total = 0.3 * (worst(hinge_safe) + worst(hinge_unsafe)) + 2.0 * worst(error) + gap.square().mean()
        covariance = latent.T.cov(correction=0)
        spread = covariance.diagonal()
        total = total + 0.5 * (0.5 - (spread + 1e-8).sqrt()).clamp_min(0).mean()
        total = total + 0.5 * (covariance.square().sum() - spread.square().sum()) / len(covariance)
        return total + 0.3 * (depth - 1.4722).clamp_min(0).square().mean(), latent

    return loss


def bare_sound(nets: list[nn.Module]) -> Callable[[TensorDict], Tensor]:
    """The terms of `SSPLLoss(preset="sound")`, written out."""
    _, dynamics, barrier, policy, _ = nets
    world_model = _world_model(nets)

    def loss(batch: TensorDict) -> Tensor:
        total, latent = world_model(batch)
        region, still = batch["region"], latent.detach()
        origin = torch.stack([still, torch.rand_like(still) * 2 - 1])
        successor = frozen(dynamics, origin, policy(origin))
        now, then = barrier(torch.stack([origin, successor])).unbind(0)
        violation = then.clamp_min(0) * (0.1 - now).clamp_min(0) / 0.1
        synthesis = worst(violation[0].flatten()) + 0.1 * worst(violation[1].flatten())
        backed = (then[0].detach() <= 0) & (region != 2)
        synthesis = synthesis + 0.1 * torch.where(backed, (now[0] + 0.3).clamp_min(0), 0.0).mean()
        weight = (-now[0].detach().clamp_min(0) / 0.2).exp()
        synthesis = synthesis + 0.1 * (weight * frozen(barrier, frozen(dynamics, still, policy(still)))).mean()
        return total + 0.3 * synthesis

    return loss


def bare_paper(nets: list[nn.Module]) -> Callable[[TensorDict], Tensor]:
    """The terms of `SSPLLoss(preset="paper")`, written out."""
    encoder, dynamics, barrier, policy, _ = nets
    slow_encoder, slow_barrier = copy.deepcopy(encoder), copy.deepcopy(barrier)
    for parameter in (*slow_encoder.parameters(), *slow_barrier.parameters()):
        parameter.requires_grad_(False)

    def loss(batch: TensorDict) -> Tensor:
        frames, action, region = batch["frames"], batch["action"], batch["region"]
        latent = encoder.sequence(frames[:, :2]).squeeze(-2)
        with torch.no_grad():
            slow, slow_after = slow_encoder.sequence(frames).unbind(-2)
        level = barrier(latent)
        total = (level + 0.05).clamp_min(0)[region == 1].sum() + (0.05 - level).clamp_min(0)[
            region == 2
        ].sum()
        total = total + (dynamics(latent, action) - slow_after).square().sum()
        chosen = policy(latent)
        total = total + (slow_barrier(dynamics(slow, chosen)) - barrier(latent) + 0.05).clamp_min(0).sum()
        return total + chosen.norm(dim=-1).sum()

    return loss


def main(
    batch: int = 192, image_size: int = 64, repeats: int = 15, preset: str = "sound"
) -> dict[str, float]:
    observed = data(batch, image_size)
    ours, theirs = networks(), networks()
    options = {"inverse_dynamics": ours[4]} if preset == "sound" else {}
    module = SSPLLoss(*ours[:4], preset=preset, **options)
    if preset == "paper":
        SoftUpdate(module, tau=0.05)
    bare = {"sound": bare_sound, "paper": bare_paper}[preset](theirs)

    def wrapped(inputs: TensorDict) -> Tensor:
        return sum(value for key, value in module(inputs).items() if key.startswith("loss_"))  # type: ignore

    optimizers = [
        torch.optim.Adam([p for net in nets for p in net.parameters()], 1e-3) for nets in (ours, theirs)
    ]
    times: list[list[float]] = [[], []]
    values = [0.0, 0.0]
    for repeat in range(repeats + 2):
        for side, function in enumerate((wrapped, bare)):
            torch.manual_seed(repeat)
            start = time.perf_counter()
            value = function(observed)
            optimizers[side].zero_grad()
            value.backward()
            optimizers[side].step()
            if repeat >= 2:  # the first rounds warm up
                times[side].append(time.perf_counter() - start)
            elif repeat == 0:
                values[side] = float(value.detach())
    wrapped_s, bare_s = (statistics.median(side) for side in times)
    return {
        "loss_module_ms": 1e3 * wrapped_s,
        "bare_ms": 1e3 * bare_s,
        "ratio": wrapped_s / bare_s,
        "difference_of_losses": abs(values[0] - values[1]),
    }


if __name__ == "__main__":
    given = dict(item.split("=") for item in sys.argv[1:])
    preset = given.pop("preset", "sound")
    print(main(preset=preset, **{key: int(value) for key, value in given.items()}))
