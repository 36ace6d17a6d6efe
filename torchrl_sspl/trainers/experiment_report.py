"""Figures and page of an experiment on an environment without a known model."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

import torch

from torchrl_sspl.sets import UNSAFE
from torchrl_sspl.trainers.loggers import encode_gif

if TYPE_CHECKING:
    from torchrl_sspl.certification.certificate import Certificate
    from torchrl_sspl.trainers.experiment import Experiment, ExperimentOutcome

_SHOWN = 40
_FILM_SIZE = 240  # pixels


def draw(experiment: Experiment, outcome: ExperimentOutcome) -> dict[str, Any]:
    """Figures of an experiment: latent space, barrier along episodes, losses.

    Args:
        experiment: gives the log of the training.
        outcome: gives agent and evaluation.

    Returns:
        Matplotlib figures by title.

    Raises:
        MissingDependencyError: matplotlib is not installed.

    Source: none.
    """
    from torchrl_sspl.viz.curves import training_curves
    from torchrl_sspl.viz.figures import latent_space
    from torchrl_sspl.viz.plane import new_figure

    own, chance = outcome.evaluation.arrays["own"], outcome.evaluation.arrays["chance"]
    alive = torch.cat([own.alive, chance.alive], 1)
    latent = torch.cat([own.latent, chance.latent], 1)[alive]
    region = torch.cat([own.region, chance.region], 1)[alive]
    figures: dict[str, Any] = {}
    if latent.shape[1] >= 2:
        figures["Latent space"] = latent_space(latent, region, outcome.agent.barrier)
    figure = new_figure(8, 3.6, "Barrier value along fresh episodes; a dot marks an observation of U.")
    for k, (name, episodes) in enumerate((("under the policy", own), ("under random actions", chance))):
        axes = figure.add_subplot(1, 2, k + 1)
        value = torch.where(episodes.alive, episodes.barrier, float("nan"))[:, :_SHOWN]
        axes.plot(value, color="C0", linewidth=0.7, alpha=0.5)
        step, episode = ((episodes.region == UNSAFE) & episodes.alive)[:, :_SHOWN].nonzero(as_tuple=True)
        axes.plot(step, value[step, episode], ".", color="C3", markersize=3)
        axes.axhline(0, color="black", linewidth=1)
        axes.set(title=name, xlabel="step", ylabel="B")
    figures["Barrier along episodes"] = figure
    history = {k: v for k, v in experiment.trainer._log_dict.items() if k.startswith("loss_") and len(v)}
    if history:
        figure = new_figure(8, 4, "Terms of the loss, one value per collected batch.")
        axes = figure.add_subplot()
        for name, values in sorted(history.items()):
            axes.plot([max(float(v), 1e-6) for v in values], label=name.removeprefix("loss_"), linewidth=1)
        axes.set(xlabel="batch", ylabel="loss", yscale="log")
        axes.legend(fontsize=7, ncols=2, frameon=False)
        figures["Training"] = figure
    if experiment.synthesis_dir is not None:
        figures["Training on latents"] = training_curves(experiment.synthesis_dir / "log.jsonl")
    return figures


def _headline(certificate: Certificate) -> tuple[str, str]:
    """What the certificate says, in a line."""
    for name in ("deterministic", "statistical"):
        layer = certificate.layers.get(name)
        if layer is not None and not layer.holds:
            return f"{name.capitalize()} layer {layer.verdict}", "bad"
    measured = "statistical" in certificate.layers
    return ("Certified: proved and measured", "good") if measured else ("Proved, and not measured", "fair")


def write(experiment: Experiment, outcome: ExperimentOutcome, figures: dict[str, Any]) -> Path:
    """Write ``report.html`` of an experiment.

    Args:
        experiment: gives title and configuration.
        outcome: gives agent and evaluation.
        figures: what :func:`draw` has returned.

    Returns:
        The page.

    Raises:
        MissingDependencyError: matplotlib is not installed.

    Source: none.
    """
    from torchrl_sspl.viz.certificate import certificate_section, proved_lines
    from torchrl_sspl.viz.report import write_report

    film = outcome.directory / "episode.gif"
    frames = outcome.evaluation.arrays["own"].film
    larger = max(1, _FILM_SIZE // frames.shape[-1])  # what the agent sees may be tiny
    film.write_bytes(encode_gif(frames.repeat_interleave(larger, -1).repeat_interleave(larger, -2)))
    notes = [
        *(f"Warning: {text}." for text in outcome.warnings),
        *(f"To try: {text}." for text in outcome.advice),
        f"Training took {outcome.seconds:.0f} s{' since it was resumed' if experiment.resumed else ''}.",
        "No model of the environment is known: every figure counts fresh episodes from its own resets. Nothing is said "
        "about states that these do not reach.",
    ]
    config = experiment.config.to_dict()
    return write_report(
        outcome.directory / "report.html",
        title=experiment.title,
        measurements=outcome.evaluation.measurements,
        figures=figures,
        config={k: v for k, v in config.items() if v not in (None, {})},
        video=film,
        video_caption="One episode, as the agent sees it.",
        notes="\n\n".join(notes),
        headline=_headline(outcome.certificate),
        measured=outcome.measured(),
        proved=proved_lines(outcome.certificate),
        certificate=certificate_section(outcome.certificate),
        assumed=[
            "The environment, its pictures and its resets stay as they were during the evaluation.",
            "Episodes are independent; observations within one are not, and carry no bound.",
        ],
    )
