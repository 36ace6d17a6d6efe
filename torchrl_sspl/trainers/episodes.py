"""Measurements of a frozen agent on fresh episodes of an environment that is known only by being run."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, fields
from typing import Any

import torch
from tensordict import TensorDictBase
from torch import Tensor
from torchrl.envs import EnvBase
from tqdm import tqdm

from torchrl_sspl.lipschitz import lipschitz_lower
from torchrl_sspl.modules.agent import Agent
from torchrl_sspl.sets import SAFE, UNSAFE
from torchrl_sspl.trainers.evaluation import Evaluation, Measurement, _quantiles, share
from torchrl_sspl.trainers.experiment_config import EpisodesConfig

MakeEnv = Callable[..., EnvBase]
Act = Callable[[Tensor], Tensor]


@dataclass
class Episodes:
    """Episodes side by side; what lies behind an episode's end is not ``alive``.

    Attributes:
        latent: ``(T + 1, n, p)`` latents of the observations.
        barrier: ``(T + 1, n)`` their barrier values.
        region: ``(T + 1, n)`` labels of the true states.
        alive: ``(T + 1, n)`` whether the observation belongs to the episode.
        prediction_error: ``(T, n)`` distance of predicted from observed next latent.
        film: ``(T + 1, 3, H, W)`` uint8 frames of the first episode, up to its end.
    """

    latent: Tensor
    barrier: Tensor
    region: Tensor
    alive: Tensor
    prediction_error: Tensor
    film: Tensor

    def joined(self, others: Episodes) -> Episodes:
        """These episodes and others of the same length, with the film of these."""
        names = [f.name for f in fields(self) if f.name != "film"]
        return Episodes(**{k: torch.cat([getattr(self, k), getattr(others, k)], 1) for k in names}, film=self.film)


@torch.no_grad()
def run_episodes(
    agent: Agent, env: EnvBase, n: int, horizon: int, act: Act | None = None, *, label: str | None = None
) -> Episodes:
    """Episodes from the environment's own resets.

    Args:
        agent: frozen agent.
        env: environment of batch size ``[k]`` with ``"pixels"`` and ``"region"``.
        n: number of episodes, at most k of them at a time.
        horizon: steps per episode.
        act: latents ``(k, p)`` -> actions ``(k, m)``; by default the agent's policy.
        label: title of a progress bar; none without.

    Returns:
        Latents, barrier values, labels and prediction errors.

    Source: none.
    """
    act = act or agent.policy
    device = next(agent.encoder.parameters()).device
    parts: list[tuple[Tensor, ...]] = []
    film: list[Tensor] = []
    count = 0
    bar = tqdm(total=n, desc=label, unit="episode", leave=False, disable=label is None)
    while count < n:
        data = env.reset()
        alive = torch.ones(env.batch_size[0], dtype=torch.bool)
        rows: list[tuple[Tensor, ...]] = []
        latent = agent.encode(data["pixels"].to(device))
        states = [(latent, agent.barrier(latent)[:, 0], data["region"][:, 0], alive)]
        if not parts:
            film = [data["pixels"][0, 3:]]
        for _ in range(horizon):
            action = act(latent)
            stepped, data = env.step_and_maybe_reset(data.set("action", action.to(env.device)))
            following: TensorDictBase = stepped["next"]
            predicted = agent.dynamics(latent, action)
            seen = agent.encode(following["pixels"].to(device))
            rows.append(((predicted - seen).norm(dim=-1),))
            states.append((seen, agent.barrier(seen)[:, 0], following["region"][:, 0], alive.clone()))
            if not parts and alive[0]:
                film.append(following["pixels"][0, 3:])
            alive = alive & ~following["done"][:, 0].cpu()
            if not alive.any():
                break
            ended = following["done"][:, 0]
            latent = seen.clone()
            if ended.any():  # reset already; what follows does not count
                latent[ended.to(device)] = agent.encode(data["pixels"][ended].to(device))
        columns = [torch.stack(c).cpu() for c in zip(*states, strict=True)]
        errors = torch.stack([r[0] for r in rows]).cpu()
        missing = horizon + 1 - len(columns[0])
        if missing:
            columns = [torch.cat([c, c[-1:].expand(missing, *c.shape[1:])]) for c in columns]
            columns[3][-missing:] = False
            errors = torch.cat([errors, errors[-1:].expand(missing, -1)])
        parts.append((*columns, errors))
        count += env.batch_size[0]
        bar.update(env.batch_size[0])
    bar.close()
    latents, barrier, region, kept, error = (torch.cat(c, 1)[:, :n] for c in zip(*parts, strict=True))
    return Episodes(latents, barrier, region, kept, error, torch.stack(film).cpu())


def random_actions(env: EnvBase, seed: int) -> Act:
    """Latents -> uniform actions within the bounds of the environment, whatever the latents."""
    space = env.action_spec_unbatched.space
    low, high = space.low.cpu(), space.high.cpu()
    generator = torch.Generator().manual_seed(seed)

    def act(latent: Tensor) -> Tensor:
        unit = torch.rand(len(latent), len(low), generator=generator)
        return (low + unit * (high - low)).to(latent.device)

    return act


@torch.no_grad()
def separating_level(episodes: Sequence[Episodes], guard: float, reserve: float = 0.0) -> float:
    r"""Level c for which :math:`\{B \le c\}` holds no labelled unsafe observation, and keeps away from others like these.

    .. math:: c = \min\bigl(0,\; u - g,\; \max(-r, \tfrac{s + u}{2})\bigr), \qquad u = \min_U B, \quad s = \max_S B

    Args:
        episodes: held-out episodes.
        guard: g, distance that observations of U keep from the level.
        reserve: r, what one step from :math:`\{B \le 0\}` leaves below zero, so that levels down to -r are kept as
            zero is. Within it the level is lowered to the middle between U and S, where that leaves all of S inside.

    Returns:
        The level: lowered, never raised; zero where no observation of U was seen.

    Source: none.
    """
    unsafe, safe = (torch.cat([e.barrier[(e.region == code) & e.alive] for e in episodes]) for code in (UNSAFE, SAFE))
    if not len(unsafe):
        return 0.0
    nearest = float(unsafe.min())
    between = (nearest + float(safe.max())) / 2 if len(safe) else 0.0
    return min(0.0, nearest - guard, max(-reserve, between))


def evaluate_episodes(
    agent: Agent, make_env: MakeEnv, config: EpisodesConfig | None = None, *, progress: bool = False
) -> Evaluation:
    r"""Measures a frozen agent on fresh episodes; each share counts independent episodes.

    Args:
        agent: frozen agent.
        make_env: ``(batch_size=[k], seed=...) -> environment`` with ``"pixels"`` and ``"region"``.
        config: sizes and seed.
        progress: show progress bars.

    Returns:
        Shares of episodes with exact 95 % bounds, prediction errors, Lipschitz constants; what figures need is in
        ``arrays``. A share of which nothing was seen has no value.

    Source: none; the paper judges by states of a known system, see ``evaluate``.
    """
    config = config or EpisodesConfig()
    env = make_env(batch_size=[config.envs], seed=config.seed)
    try:
        label, random = "evaluation" if progress else None, random_actions(env, config.seed + 1)
        own = run_episodes(agent, env, config.episodes, config.horizon, label=label)
        chance = run_episodes(agent, env, config.episodes, config.horizon, random, label=label)
    finally:
        env.close()
    out = Evaluation()
    barrier, region, alive = (
        torch.cat([getattr(own, k), getattr(chance, k)], 1) for k in ("barrier", "region", "alive")
    )
    inside = (barrier <= 0) & alive
    for name, code, wrong in (("unsafe_called_safe", UNSAFE, inside), ("safe_called_unsafe", SAFE, ~inside)):
        labelled = (region == code) & alive
        shown = labelled.any(0)
        events = (labelled & wrong).any(0)
        label = "U" if code == UNSAFE else "S"
        out.add(share(name, int(events.sum()), int(shown.sum()), f"episodes with an observation of {label}"))
        n = int(labelled.sum())
        value = float((labelled & wrong).sum()) / n if n else None
        out.add(Measurement(f"{name}_of_frames", value, "share", n, note=f"observations of {label}, not independent"))
    touches = ((own.region == UNSAFE) & own.alive).any(0)
    starts = own.barrier[0] <= 0
    out.add(share("starts_inside", int(starts.sum()), len(starts), "resets with B <= 0"))
    longest = int(own.alive.sum(0).max()) - 1  # the environment may end them before config.horizon
    note = f"episodes of at most {longest} steps from B <= 0 under the policy"
    leaves = ((own.barrier > 0) & own.alive).any(0)
    out.add(share("touch_unsafe", int((touches & starts).sum()), int(starts.sum()), note))
    out.add(share("leave", int((leaves & starts).sum()), int(starts.sum()), note))
    out.add(share("policy_touch_unsafe", int(touches.sum()), len(touches), "all episodes under the policy"))
    random_touches = ((chance.region == UNSAFE) & chance.alive).any(0)
    out.add(share("random_touch_unsafe", int(random_touches.sum()), len(random_touches), "episodes under random actions"))
    for name, episodes in (("on_policy_error", own), ("random_action_error", chance)):
        _quantiles(out, name, episodes.prediction_error[episodes.alive[1:]], "latent", "error of a step")
    bound = agent.lipschitz_bound
    generator = torch.Generator().manual_seed(config.seed)
    lower = lipschitz_lower(agent.barrier, -1.0, 1.0, n=20000, generator=generator)
    out.add(Measurement("lipschitz_certified", bound, "barrier / latent", note="bound of the barrier"))
    out.add(Measurement("lipschitz_sampled", lower, "barrier / latent", 20000, note="largest gradient or secant found"))
    out.arrays.update(own=own, chance=chance)
    return out


def logged(evaluation: Evaluation) -> dict[str, Any]:
    """The figures of an evaluation that are logged, under their documented names."""
    names = ("unsafe_called_safe", "safe_called_unsafe", "starts_inside", "touch_unsafe", "leave", "random_touch_unsafe")
    # A fixed set of names: what was not seen is not a number.
    values = {f"eval_{n}": evaluation[n] for n in names}
    return {name: float("nan") if value is None else value for name, value in values.items()}
