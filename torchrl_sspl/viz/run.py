"""The report of a run: its figures, film and page."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

import torch

from torchrl_sspl.envs.base import SafetyEnv
from torchrl_sspl.viz.animation import animate
from torchrl_sspl.viz.certificate import certificate_section, proved_lines
from torchrl_sspl.viz.figures import frames, latent_space, state_plane, training_curves, trajectories
from torchrl_sspl.viz.plane import Plane
from torchrl_sspl.viz.report import requirement_rows, write_report

if TYPE_CHECKING:  # trainers build on this module, not the other way round
    from torchrl_sspl.trainers.config import TrainingConfig
    from torchrl_sspl.trainers.run import RunOutcome


def write_run_report(
    outcome: RunOutcome,
    config: TrainingConfig,
    env: SafetyEnv,
    *,
    title: str,
    axes: tuple[str, str],
    action: str,
) -> Path:
    """Draw the figures and the film of a run, and write ``report.html`` with all of them.

    Args:
        outcome: training and evaluation.
        config: configuration of the run.
        env: gives pictures and regions.
        title: title of the page.
        axes: names and units of the two state coordinates shown.
        action: name and unit of the action.

    Returns:
        The page.

    Raises:
        MissingDependencyError: if matplotlib is not installed.

    Source: paper Section V (figures); deviation: the true kernel, measurements and verdicts are added.
    """
    directory = outcome.directory
    folder = directory / "figures"
    folder.mkdir(parents=True, exist_ok=True)
    arrays, agent = outcome.evaluation.arrays, outcome.training.agent
    plane = Plane.of(env, axes)
    background = (arrays["states"], arrays["barrier"])
    region = env.region(arrays["states"])
    figures: dict[str, Any] = {
        "State plane": state_plane(plane, arrays["states"], arrays["barrier"], viable=arrays["viability"]),
        "Latent space": latent_space(arrays["latent"], region, agent.barrier),
    }
    # A positive action pushes the last coordinate shown where the state is a position and its speed.
    push: dict[str, Any] = dict(
        background=background, action_name=action, action_direction=(0.0, 1.0), dt=getattr(env, "dt", None)
    )
    if "trajectories" in arrays:
        figures["From the safe set"] = trajectories(
            plane,
            arrays["trajectories"],
            arrays["torques"],
            arrays["traces"],
            caption="Episodes that start in {B <= 0}.",
            **push,
        )
    figures["Back from U"] = trajectories(
        plane,
        arrays["recovery"],
        arrays["recovery_torques"],
        arrays["recovery_traces"],
        caption="Episodes that start in U.",
        **push,
    )
    generator = torch.Generator().manual_seed(config.evaluation.seed)
    shown = torch.cat(
        [env.sample_states(2, generator, region=r) for r in (env.safe_set, env.state_space, env.unsafe_set)]
    )
    figures["What the agent sees"] = frames(env, shown)
    figures["Training"] = training_curves(directory / "log.jsonl")
    for name, figure in figures.items():
        figure.savefig(folder / f"{name.lower().replace(' ', '_')}.png", dpi=130)
    start = arrays["recovery"][0, :1]
    video = animate(
        agent,
        env,
        start,
        min(config.evaluation.horizon, 120),
        folder / "episode.mp4",
        plane=plane,
        background=background,
        action_name=action,
        title="From U back into the safe set",
    )
    rows = list(requirement_rows(outcome.requirements, outcome.evaluation))
    measurements = dict(outcome.evaluation.measurements)
    if outcome.foreign is not None:
        rows += [
            (f"{row[0]} (foreign frames)", *row[1:])
            for row in requirement_rows(outcome.requirements, outcome.foreign)
        ]
        measurements |= {f"foreign frames: {k}": v for k, v in outcome.foreign.measurements.items()}
    notes = [f"Training took {outcome.training.seconds:.0f} s. Why it ended: {outcome.training.stop_reason}."]
    return write_report(
        directory / "report.html",
        title=title,
        summary=rows,
        measurements=measurements,
        figures=figures,
        config=config.to_dict(),
        checks=outcome.training.checks,
        video=video,
        notes="\n\n".join(notes),
        proved=proved_lines(outcome.certificate),
        certificate=certificate_section(outcome.certificate),
    )
