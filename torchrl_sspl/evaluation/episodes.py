"""Measurements on fresh episodes of an environment that is known only by being run."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import torch

from torchrl_sspl.configs.schema import EvaluationConfig
from torchrl_sspl.evaluation.controllers import AgentController, RandomController, as_controller
from torchrl_sspl.evaluation.measurements import Evaluation, MakeEnv, Measurement, lipschitz, quantiles
from torchrl_sspl.evaluation.simulation import Episodes, simulate
from torchrl_sspl.sets import SAFE, UNSAFE

_CALLED = {"unsafe_called_safe": UNSAFE, "safe_called_unsafe": SAFE}


@torch.no_grad()
def separating_level(episodes: Sequence[Episodes], guard: float, reserve: float = 0.0) -> float:
    r"""Level c for which :math:`\{B \le c\}` holds no labelled unsafe observation, and keeps away from its like.

    .. math:: c = \min\bigl(0,\; u - g,\; \max(-r, \tfrac{s + u}{2})\bigr), \qquad u = \min_U B, \quad s = \max_S B

    It lowers, never raises; it is zero where no observation of U was seen. Source: none.

    Args:
        episodes: held-out episodes, with a barrier.
        guard: g, distance that observations of U keep from the level.
        reserve: r, what one step from :math:`\{B \le 0\}` leaves below zero, so that levels down to -r are kept as
            zero is. Within it the level is lowered to the middle between U and S, where that leaves all of S inside.
    """
    judged = [(e, e.barrier) for e in episodes if e.barrier is not None]
    unsafe, safe = (torch.cat([b[(e.region == code) & e.alive] for e, b in judged]) for code in (UNSAFE, SAFE))
    if not len(unsafe):
        return 0.0
    nearest = float(unsafe.min())
    between = (nearest + float(safe.max())) / 2 if len(safe) else 0.0
    return min(0.0, nearest - guard, max(-reserve, between))


def evaluate_episodes(
    agent: Any, make_env: MakeEnv, config: EvaluationConfig | None = None, *, progress: bool = False
) -> Evaluation:
    """Measures an agent, or anything else that acts, on fresh episodes; each share counts independent episodes.

    Args:
        agent: frozen agent, or what ``as_controller`` takes; what needs a barrier is not measured without one.
        make_env: ``(batch_size=[k], seed=...) -> environment`` with ``"pixels"`` and ``"region"``.
        config: sizes and seed.
        progress: show progress bars.

    Returns:
        Shares of episodes with exact 95 % bounds, prediction errors, Lipschitz constants; what figures need is in
        ``arrays`` (the first episode of ``"own"`` with its frames). A share of which nothing was seen has no value.

    Source: none; the paper judges by states of a known system, see ``evaluate``.

    Example:
        >>> from torchrl_sspl.envs import PendulumEnv
        >>> sizes = EvaluationConfig(episodes=4, envs=4, horizon=3)
        >>> found = evaluate_episodes(lambda pixels: torch.zeros(len(pixels)), PendulumEnv, sizes)
        >>> found.measurements["policy_touch_unsafe"].n, found["leave"]
        (4, None)
    """
    config, acts = config or EvaluationConfig(), as_controller(agent)
    env = make_env(batch_size=[config.envs], seed=config.seed)
    try:
        random: Any = RandomController.within(env, config.seed + 1)
        if isinstance(acts, AgentController):
            random = AgentController(acts.agent, driver=random)
        sizes: dict[str, Any] = {"episodes": config.episodes, "horizon": config.horizon}
        label = "evaluation" if progress else None
        own, chance = simulate(acts, env, **sizes, film=1, label=label), simulate(random, env, **sizes, label=label)
    finally:
        env.close()
    out = Evaluation()
    touches, random_touches = (((e.region == UNSAFE) & e.alive).any(0) for e in (own, chance))
    out.count("policy_touch_unsafe", touches, "all episodes under the policy")
    out.count("random_touch_unsafe", random_touches, "episodes under random actions")
    if own.barrier is None:
        out.missing("starts_inside", "touch_unsafe", "leave", *_CALLED, *(f"{name}_of_frames" for name in _CALLED))
    else:
        _labels(out, own if chance.barrier is None else own.joined(chance))
        _from_the_set(out, own, touches)
    for name, episodes in (("on_policy_error", own), ("random_action_error", chance)):
        error = None if episodes.prediction_error is None else episodes.prediction_error[episodes.alive[1:]]
        quantiles(out, name, error, "latent", "error of a step")
    if isinstance(acts, AgentController):
        lipschitz(out, acts.agent, torch.Generator().manual_seed(config.seed))
    out.arrays.update(own=own, chance=chance)
    return out


def _labels(out: Evaluation, episodes: Episodes) -> None:
    """How often the barrier errs about a labelled observation, by episodes and by observations."""
    inside = episodes.barrier <= 0
    # By what was remembered, or by the picture alone, as certificates count; NaN is an error of either kind.
    looks_safe = ~(episodes.barrier > 0) if episodes.seen is None else ~((episodes.barrier > 0) & (episodes.seen > 0))
    for name, code in _CALLED.items():
        labelled, wrong = (episodes.region == code) & episodes.alive, looks_safe if code == UNSAFE else ~inside
        label, n = "U" if code == UNSAFE else "S", int(labelled.sum())
        events, shown = (labelled & wrong).any(0), labelled.any(0)
        out.count(name, events, f"episodes with an observation of {label}", shown)
        value = float((labelled & wrong).sum()) / n if n else None
        out.add(Measurement(f"{name}_of_frames", value, "share", n, note=f"observations of {label}, not independent"))


def _from_the_set(out: Evaluation, own: Episodes, touches: torch.Tensor) -> None:
    """What happens to episodes that start with B <= 0."""
    starts, leaves = own.barrier[0] <= 0, (~(own.barrier <= 0) & own.alive).any(0)
    longest = int(own.alive.sum(0).max()) - 1  # the environment may end them before the horizon
    note = f"episodes of at most {longest} steps from B <= 0 under the policy"
    out.count("starts_inside", starts, "resets with B <= 0")
    out.count("touch_unsafe", touches & starts, note, starts)
    out.count("leave", leaves & starts, note, starts)


def logged(evaluation: Evaluation) -> dict[str, Any]:
    """The figures of an evaluation that are logged, under their documented names."""
    names = (*_CALLED, "starts_inside", "touch_unsafe", "leave", "random_touch_unsafe")
    # A fixed set of names: what was not seen is not a number.
    values = {f"eval_{n}": evaluation[n] if n in evaluation.measurements else None for n in names}
    return {name: float("nan") if value is None else value for name, value in values.items()}
