"""Cost per update of the trainer over bare loops with the same mathematics, in every phase.

Run: python benchmarks/trainer_overhead.py [phase ...] [batch=192] [image_size=64] [latents=1024] [rows=4000] [repeats=8] [steps=60]

Joint training: `SSPLTrainer` on pictures, a tenth of the steps, against a loop that samples from the same replay buffer.
Phases on frozen latents: what a phase gives to the one inner loop, with progress bar and the look at the clock for checkpoints,
against a loop without any LossModule or TensorDict on the same tensors. Both sides have the same networks, draws, optimiser and
schedule, and take turns; the figure is the ratio of the medians of the CPU time on one thread. `difference` is that of the
gradients of the first update, relative to their norm: the mathematics are the same. With repeats=0 it is all that is found.
"""

from __future__ import annotations

import contextlib
import inspect
import io
import math
import statistics
import sys
import time
import warnings
from collections.abc import Callable, Sequence
from functools import partial
from types import SimpleNamespace
from typing import Any

import torch
from loss_overhead import bare_sound, bare_world_model, networks
from torch import Tensor, nn
from torchrl.collectors import Collector

from torchrl_sspl.configs import SynthesisConfig
from torchrl_sspl.data import collect_random
from torchrl_sspl.envs import PendulumEnv
from torchrl_sspl.lipschitz import SandwichBarrier
from torchrl_sspl.modules import LatentDynamics, Policy, make_rollout_policy
from torchrl_sspl.objectives import SSPLLoss
from torchrl_sspl.sets import SAFE, UNSAFE
from torchrl_sspl.trainers import (
    FineTune,
    FitDynamics,
    FitSets,
    InnerLoop,
    Phases,
    SSPLTrainer,
    SteerPolicy,
    TeachPolicy,
    Tighten,
    Workspace,
)
from torchrl_sspl.trainers.progress import Progress
from torchrl_sspl.trainers.targets import off_manifold, targets

CLIP = 5.0
Update = Callable[[], Tensor]
Side = tuple[Callable[[int], None], list[nn.Parameter]]  # takes so many updates of these


def _bar() -> Any:
    return Progress(10**6, 0, file=io.StringIO())


# ---------------------------------------------------------------------- joint training


def joint(whole: bool, batch: int, image_size: int) -> tuple[Side, Side]:
    """The trainer's updates and the bare ones, of the whole loss or of the world model alone."""
    env = PendulumEnv(batch_size=[32], image_size=image_size, horizon=5, seed=0)
    env.initial_set = env.safe_set | env.state_space
    buffer = collect_random(env, 4096, seed=0, steps=5).replay_buffer(batch)
    ours, theirs = networks(), networks()
    loss = SSPLLoss(*ours[:4], inverse_dynamics=ours[4])
    collector = Collector(
        env, make_rollout_policy(ours[0], ours[3]), frames_per_batch=64, total_frames=64, auto_register_policy_transforms=False
    )
    trainer = SSPLTrainer(
        collector=collector, total_frames=64, loss_module=loss, optimizer=torch.optim.Adam(loss.parameters(), 1e-3),
        replay_buffer=buffer, optim_steps_per_batch=1, warm_start_steps=0 if whole else -1, clip_norm=CLIP,
    )  # fmt: skip
    collector.shutdown()
    trainer._bar = _bar()
    parameters = [p for net in theirs for p in net.parameters()]
    bare, optimizer = (bare_sound if whole else bare_world_model)(theirs), torch.optim.Adam(parameters, 1e-3)

    def with_trainer(steps: int) -> None:
        trainer.optim_steps_per_batch = steps
        trainer.optim_steps(None)

    def by_hand(steps: int) -> None:
        for _ in range(steps):
            optimizer.zero_grad()
            bare(buffer.sample()).backward()
            nn.utils.clip_grad_norm_(parameters, CLIP)
            optimizer.step()

    mine = [p for net in ours for p in net.parameters()]
    return (with_trainer, mine), (by_hand, parameters)


# ---------------------------------------------------------------------- phases on frozen latents


class _Caught(Exception):
    pass


class Catching(InnerLoop):
    """Keeps what a phase asks for first, in place of doing it."""

    asked: tuple[dict[nn.Module, float], Callable[[], Any]] | None = None

    def __call__(self, steps: int, networks: dict[nn.Module, float], loss: Callable[[], Any]) -> None:
        if self.asked is None:
            self.asked = networks, loss
            raise _Caught
        super().__call__(steps, networks, loss)


def workspace(latents: int, rows: int, **settings: Any) -> Workspace:
    """Networks of the pendulum's size and latents on a curved surface, with a system that is easy to keep."""
    torch.manual_seed(0)
    nets = LatentDynamics(3, 1, (96, 96), 10.0), SandwichBarrier(3, (96, 96, 96), 2.0), Policy(3, 1, (48, 48), 10.0)
    config = SynthesisConfig(batch=latents, actions=11, teacher="clearance", residual_spread=0.0, counterexamples=0, **settings)
    work = Workspace(nn.Identity(), *nets, config=config)
    place, action = torch.rand(rows, 2) * 1.6 - 0.8, torch.rand(rows, 1) * 20 - 10

    def lift(x: Tensor) -> Tensor:
        return torch.cat([x, 0.3 * x.square().sum(-1, keepdim=True)], -1)

    with torch.no_grad():  # half of the data inside
        work.barrier.bias[-1].sub_(work.barrier(lift(place)).median())
    after = (0.95 * place + 0.02 * torch.cat([action, -action], -1)).clamp(-0.9, 0.9)
    far = place.norm(dim=-1, keepdim=True)
    region = torch.where(far > 0.7, UNSAFE, torch.where(far < 0.2, SAFE, 0))
    work.latents = {"latent": lift(place), "next_latent": lift(after), "action": action, "region": region}
    return work


def worst(values: Tensor, coefficient: float, share: float) -> Tensor:
    """Mean, and so much of the mean over the worst share of the rows."""
    count = max(1, -int(-share * len(values) // 1))
    return values.mean() + coefficient * values.flatten().topk(count)[0].mean()


def bare_dynamics(work: Workspace, asked: dict[str, Any]) -> Update:
    s, data, (tube, base) = work.config, work.latents, off_manifold(work, work.latents["latent"], 1.3 * work.config.tube_radius, 0)
    latent, action, after, unsafe = data["latent"], data["action"], data["next_latent"], data["region"] == UNSAFE
    on, off, pick, dynamics = 2 * s.batch // 6, s.batch // 6, work.loop.pick, work.dynamics

    def update() -> Tensor:
        a, c = pick(len(latent), on), pick(len(tube), off)
        z, index = torch.cat([latent[a], tube[c]]), torch.cat([a, base[c]])
        error = (dynamics(z, action[index]) - after[index]).square().sum(-1, keepdim=True)
        return worst(torch.where(unsafe[index], s.unsafe_weight * error, error), 0.2, 0.05)

    return update


def bare_teach(work: Workspace, asked: dict[str, Any]) -> Update:
    s, pick, policy = work.config, work.loop.pick, work.policy
    latent, value, k = asked["z"], asked["value"], asked["value"].shape[1]

    def update() -> Tensor:
        rows = pick(len(latent), s.batch)
        table = value[rows]
        place = (policy(latent[rows]) / 10.0 + 1) / 2 * (k - 1)
        low = place.detach().floor().clamp(0, k - 2)
        share, index = (place - low).clamp(0.0, 1.0), low.long()
        found = (1 - share) * table.gather(-1, index) + share * table.gather(-1, index + 1)
        return worst((table.amax(-1, keepdim=True) - found) / 0.05, 0.3, 0.05)

    return update


def bare_fit(work: Workspace, asked: dict[str, Any]) -> Update:
    s, pick, barrier, policy, table = work.config, work.loop.pick, work.barrier, work.policy, targets(work, 0)[0]
    columns = [table[k] for k in ("latent", "barrier_target", "inside", "action_target", "action_weight")]

    def update() -> Tensor:
        rows = pick(len(table), s.batch)
        z, target, inside, wanted, weight = (column[rows] for column in columns)
        value = barrier(z)
        residual = torch.where(inside, value - target, (target - value).clamp_min(0.0)).square()
        follow = weight * ((policy(z) - wanted) / 10.0).square()
        return worst(((-target.abs() / 0.1).exp() + 0.1) * residual, 0.3, 0.05) + follow.mean()

    return update


def still(network: nn.Module, *inputs: Tensor) -> Tensor:
    """What a network gives, its weights held still."""
    for p in network.parameters():
        p.requires_grad_(False)
    found = network(*inputs)
    for p in network.parameters():
        p.requires_grad_(True)
    return found


def steepest(barrier: nn.Module, z: Tensor, size: float) -> Tensor:
    """The errors of a size that raise the barrier most."""
    at = z.detach().requires_grad_()
    (slope,) = torch.autograd.grad(still(barrier, at).sum(), at)
    return size * slope / slope.norm(dim=-1, keepdim=True).clamp_min(1e-9)


def bare_tune(work: Workspace, asked: dict[str, Any], *, steer: bool = False) -> Update:
    s, pick, barrier, policy, dynamics = work.config, work.loop.pick, work.barrier, work.policy, work.dynamics
    names = ("latent", "barrier_target", "inside", "action_target", "action_weight", "region")
    columns, rim, shares = [asked["table"][k] for k in names], asked["rim"], asked["shares"]
    origins, residuals, n = rim["latent"], rim["residual"], len(columns[0])
    margin = (2 if steer else 1) * s.margin

    def update() -> Tensor:
        drawn = torch.cat([pick(n, s.batch), *(rows[pick(len(rows), k)] for rows, k in shares if len(rows))])
        asked_rows = pick(len(rim), 3 * s.batch // 2)
        z = origins[asked_rows]
        if s.tolerated_error:
            with torch.no_grad():
                after = dynamics(z, policy(z))
            error = steepest(barrier, after, s.tolerated_error)
        else:
            error = residuals[asked_rows][torch.arange(len(asked_rows)), pick(s.residuals, len(asked_rows))]
        origin = torch.stack([z, torch.rand_like(z) * 2.0 - 1.0])
        successor = (still(dynamics, origin, policy(origin)) + torch.stack([error, torch.zeros_like(error)])).clamp(-1.0, 1.0)
        now, then = barrier(torch.stack([origin, successor])).unbind(0)
        violation = (then + margin).clamp_min(0.0) * (s.band - now).clamp_min(0.0) / s.band
        total = worst(violation[0], 1.0, 0.02) + worst(violation[1], 1.0, 0.02)
        z, target, inside, wanted, weight, region = (column[drawn] for column in columns)
        value, action = barrier(z), policy(z)
        residual = torch.where(inside, 2.0 * (value - target).square(), (target.clamp_max(s.band) - value).clamp_min(0.0).square())
        total = total + worst(((-target.abs() / 0.2).exp() + 0.1) * residual, 1.0, 0.02)
        total = total + s.recovery_coeff * (weight * ((action - wanted) / 10.0).square()).mean()
        safe, unsafe = (value + s.unsafe_margin).clamp_min(0)[region == SAFE], (s.unsafe_margin - value).clamp_min(0)[region == UNSAFE]
        return total + worst(safe, 1.0, 0.02) + 10.0 * worst(unsafe, 1.0, 0.02)

    return update


def bare_steer(work: Workspace, asked: dict[str, Any]) -> Update:
    return bare_tune(work, asked, steer=True)


def bare_tighten(work: Workspace, asked: dict[str, Any]) -> Update:
    s, barrier, policy, dynamics, loop = work.config, work.barrier, work.policy, work.dynamics, work.loop
    tune, rim, phase, found = bare_tune(work, asked), asked["rim"]["latent"], asked["self"], torch.zeros(0)

    def update() -> Tensor:
        nonlocal found
        total = tune()
        if loop.step % 100 == 0:  # the search is no mathematics of a loss: both sides make the same
            found = work.counterexamples = phase._search(work, rim)
            assert len(found), "nothing to train on"
        z = found[loop.pick(len(found), s.batch).square() // len(found)]
        after = still(dynamics, z, policy(z))
        after = after + steepest(barrier, after, s.tolerated_error)
        violation, short = (still(barrier, after) + 0.004).clamp_min(0.0), (0.01 - barrier(z)).clamp_min(0.0)
        given_up = violation.detach().clamp_max(0.05) / 0.05 * short
        return total + 4.0 * (worst(given_up, 0.3, 0.02) + (0.3 * violation * (short.detach() > 0.0)).mean())

    return update


JOINT = {"world-model": False, "whole-loss": True}
FROZEN: dict[str, tuple[Any, Any]] = {
    "dynamics": (FitDynamics, bare_dynamics),
    "teach": (TeachPolicy, bare_teach),
    "fit": (FitSets, bare_fit),
    "steer": (SteerPolicy, bare_steer),
    "tune": (FineTune, bare_tune),
    "tighten": (Tighten, bare_tighten),
}
SETTINGS: dict[str, dict[str, Any]] = {"tighten": {"tolerated_error": 0.006}}


def frozen(name: str, latents: int, rows: int) -> tuple[Side, Side]:
    """The inner loop's updates of a phase and the bare ones."""
    sides = []
    kind, bare = FROZEN[name]
    for hand in (False, True):
        work = workspace(latents, rows, **SETTINGS.get(name, {}))
        phase, loop = kind(0), Catching(0)
        work.loop = loop
        with contextlib.suppress(_Caught):
            phase.run(work)
        assert loop.asked is not None
        rates, step = loop.asked
        if hand:
            tensors = inspect.getclosurevars(step).nonlocals
            run = partial(by_hand, bare(work, tensors), loop, rates)
        else:
            phases = Phases([phase], work)
            phases.trainer, phases.bar = SimpleNamespace(save_trainer=partial(SSPLTrainer.save_trainer, _Clock())), _bar()
            loop.tick = phases._tick
            run = partial(in_loop, loop, rates, step)
        sides.append((run, [p for net in rates for p in net.parameters()]))
    return sides[0], sides[1]


class _Clock:
    """What ``SSPLTrainer.save_trainer`` looks at when it is not yet time."""

    checkpoint_seconds, _saved_at = float("inf"), 0.0

    def _has_checkpoint_destination(self) -> bool:
        return True


def in_loop(loop: InnerLoop, rates: dict[nn.Module, float], step: Callable[[], Any], steps: int) -> None:
    loop.restart()
    loop.generator.manual_seed(0)
    loop(steps, rates, step)


def by_hand(update: Update, loop: InnerLoop, rates: dict[nn.Module, float], steps: int) -> None:
    loop.generator.manual_seed(0)
    adam = torch.optim.Adam([{"params": list(net.parameters()), "lr": lr} for net, lr in rates.items()])
    cycle = torch.optim.lr_scheduler.OneCycleLR(adam, list(rates.values()), total_steps=max(steps, 2), pct_start=0.1)
    torch.manual_seed(int(torch.randint(2**31, (1,), generator=loop.generator)))
    for loop.step in range(steps):
        value = update()
        adam.zero_grad()
        value.backward()
        adam.step()
        cycle.step()


# ---------------------------------------------------------------------- all of them


def main(
    names: Sequence[str] = (),
    *,
    batch: int = 192,
    image_size: int = 64,
    latents: int = 1024,
    rows: int = 4000,
    repeats: int = 8,
    steps: int = 60,
) -> dict[str, dict[str, float]]:
    """Milliseconds of both sides, their ratio, and the difference of their weights, by phase."""
    threads = torch.get_num_threads()
    torch.set_num_threads(1)
    found = {}
    try:
        for name in names or (*JOINT, *FROZEN):
            sides = frozen(name, latents, rows) if name in FROZEN else joint(JOINT[name], batch, image_size)
            # Updates on pictures are long: the sides take turns after each, so that both meet the same moments of the machine.
            found[name] = measure(sides, *((repeats, steps) if name in FROZEN else (repeats * max(1, steps // 10), 1)))
    finally:
        torch.set_num_threads(threads)
    return found


def measure(sides: tuple[Side, Side], repeats: int, steps: int) -> dict[str, float]:
    times: tuple[list[float], list[float]] = [], []
    # One update of which the gradients are compared, and a round to warm up.
    for repeat in range(-2, repeats or -1):
        for side in (0, 1) if repeat % 2 else (1, 0):
            torch.manual_seed(repeat + 2)
            start = time.process_time()
            sides[side][0](1 if repeat == -2 else steps)
            times[side].append((time.process_time() - start) / steps)
        if repeat == -2:
            pairs = [(a.grad, b.grad) for a, b in zip(sides[0][1], sides[1][1], strict=True)]
            assert all((a is None) == (b is None) for a, b in pairs), "one side trains what the other does not"
            mine, hand = (torch.cat([pair[k].flatten() for pair in pairs if pair[0] is not None]) for k in (0, 1))
            difference = float((mine - hand).norm() / hand.norm())
    ours, bare = (statistics.median(side[2:] or [math.nan]) for side in times)
    return {"trainer_ms": 1e3 * ours, "bare_ms": 1e3 * bare, "ratio": ours / bare, "difference": difference}


if __name__ == "__main__":
    warnings.simplefilter("ignore")
    options = dict(word.split("=") for word in sys.argv[1:] if "=" in word)
    table = main([w for w in sys.argv[1:] if "=" not in w], **{key: int(value) for key, value in options.items()})
    print(f"{'phase':<14}{'trainer [ms]':>14}{'bare [ms]':>12}{'ratio':>8}{'difference':>14}")
    for phase, row in table.items():
        print(f"{phase:<14}{row['trainer_ms']:>14.3f}{row['bare_ms']:>12.3f}{row['ratio']:>8.3f}{row['difference']:>14.1e}")
