"""The report of a run, of whatever system: figures that apply to what was measured, a film, and one page."""

from __future__ import annotations

import contextlib
import math
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import torch

from torchrl_sspl.envs.base import SafetyEnv
from torchrl_sspl.envs.system import Opening
from torchrl_sspl.errors import CheckpointError
from torchrl_sspl.evaluation.outcome import Outcome
from torchrl_sspl.evaluation.simulation import Episodes
from torchrl_sspl.experiments.film import Film, take_of
from torchrl_sspl.sets import SAFE, UNSAFE
from torchrl_sspl.viz.animation import Scene, animate
from torchrl_sspl.viz.certificate import certificate_section
from torchrl_sspl.viz.curves import training_curves
from torchrl_sspl.viz.figures import frames, latent_space, state_plane, trajectories
from torchrl_sspl.viz.plane import Plane, new_figure
from torchrl_sspl.viz.report import requirement_rows, write_report
from torchrl_sspl.viz.slices import slices, walks
from torchrl_sspl.viz.verdict import first_screen

REPORT_FILE = "report.html"
_SHOWN = 40  # episodes whose barrier is drawn
_POINTS = 20_000  # latents of a grid that are looked at
_FILM_SECONDS, _WALK_SECONDS = 5.0, 8.0  # of the longest scene of a film, on the true dynamics and in full physics
_CAPTION = (
    "The same start twice, {}: in grey without protection (no action at all, or a policy that knows nothing of safety), in blue the "
    "learned policy, or that other policy behind the safety filter. The black line in the plane is B = 0."
)
_ASSUMED = (
    "The environment, its pictures and its resets stay as they were during the evaluation.",
    "The labels of S and U are right.",
    "Episodes are independent; observations within one are not, and carry no bound.",
)
_UNKNOWN = (
    "No model of the environment is known: every figure counts fresh episodes from its own resets. Nothing is said about "
    "states that these do not reach."
)


def write_run_report(outcome: Outcome, env: SafetyEnv | None, *, title: str | None = None) -> dict[str, Any]:
    """Draw the figures and the film of a run, and write ``report.html`` with all of them; sets ``outcome.report``.

    What is drawn follows from what was measured and from ``env.system``: nothing here knows a system by name. The
    system is as it was trained on; None where it is known by being run only.

    Returns matplotlib figures by title; they are in ``figures/`` of the run too. Raises MissingDependencyError if
    matplotlib is not installed. Source: paper Section V (figures); deviation: the true kernel, measurements and
    verdicts are added.
    """
    folder = Path(outcome.directory) / "figures"
    folder.mkdir(parents=True, exist_ok=True)
    figures, shown = draw_figures(outcome, env), {}
    for name, figure in figures.items():
        path = folder / f"{name.lower().replace(' ', '_')}.png"
        figure.savefig(path, dpi=160)  # the page shows the file: a figure is drawn once
        shown[name] = path, str(figure.get_label() or "")
    film, caption = _film(outcome, env, folder)
    requirements = () if env is None else env.system.requirements
    rows: list[Any] = []
    measurements: dict[str, Any] = {}
    for name, evaluation in outcome.evaluations.items():
        own = name == "own"
        found = requirement_rows([r for r in requirements if own or r.name in evaluation.measurements], evaluation)
        rows += [(row[0] if own else f"{row[0]} ({name} frames)", *row[1:]) for row in found]
        measurements |= {k if own else f"{name} frames: {k}": m for k, m in evaluation.measurements.items()}
    config = {k: v for k, v in outcome.config.to_dict().items() if k != "out_dir" and v not in (None, {})}
    certificate, lines = outcome.certificate, _proved(outcome)
    measured = () if rows else outcome.measured()
    first = first_screen(certificate, rows, trained=outcome.seconds is not None, measured=measured, proved=lines)
    outcome.report = write_report(
        Path(outcome.directory) / REPORT_FILE,
        title=title or ("Safe policy from pixels" if env is None else env.system.title),
        summary=rows,
        measurements=measurements,
        figures=shown,
        config=config,
        checks=outcome.checks,
        video=film,
        video_caption=caption,
        notes="\n\n".join(_notes(outcome, env)),
        headline=(first.headline, first.kind, first.more),
        measured=first.measured,
        proved=first.proved,
        assumed=_ASSUMED if env is None else None,
        kernel=env is not None,
        certificate=None if certificate is None else certificate_section(certificate),
    )
    return figures


def draw_figures(outcome: Outcome, env: SafetyEnv | None) -> dict[str, Any]:
    """Figures of everything that an evaluation has left.

    Args:
        outcome: of the run.
        env: the system, as it was trained on; None where it is known by being run only.

    Returns matplotlib figures by title. Raises MissingDependencyError if matplotlib is not installed. Source: paper
    Section V; deviation: see the figures.
    """
    arrays, barrier = outcome.evaluations["own"].arrays, getattr(outcome.agent, "barrier", None)
    figures = _of_episodes(arrays, barrier) if env is None else _of_states(arrays, barrier, env)
    log = Path(outcome.directory) / "log.jsonl"
    if log.is_file():
        with contextlib.suppress(CheckpointError):  # nothing was trained, or not long enough for a line
            figures["Training"] = training_curves(log)
    return figures


def _of_states(arrays: dict[str, Any], barrier: Any, env: SafetyEnv) -> dict[str, Any]:
    """Figures of a system whose states and true kernel are known."""
    twin, system = env.known_twin(), env.system
    figures: dict[str, Any] = {}
    plane = _plane(twin) if twin.state_dim > 1 else None
    background = (arrays["states"], arrays["barrier"]) if arrays.get("barrier") is not None else None
    if background is not None:
        if plane is not None:
            figures["State plane"] = _learned_set(plane, twin, *background, arrays["viability"].clamp(-10.0, 10.0))
        some = slice(None, None, max(1, len(arrays["states"]) // _POINTS))
        if arrays.get("latent") is not None and arrays["latent"].shape[1] >= 2:
            figures["Latent space"] = latent_space(arrays["latent"][some], twin.region(arrays["states"][some]), barrier)
    # Called ``traces`` for the barrier values along ``trajectories``, and so for the ways back.
    for name, prefix, where in (("From the safe set", "", "{B <= 0}"), ("Back from U", "recovery_", "U")):
        paths = arrays.get("recovery" if prefix else "trajectories")
        if plane is None or paths is None:
            continue
        chosen, lengths = _shown_of(twin, paths)
        trace = arrays.get(f"{prefix}traces")
        figures[name] = trajectories(
            plane,
            paths[:, chosen],
            arrays[f"{prefix}actions"][:, chosen],
            None if trace is None else trace[:, chosen],
            background=background,
            action_name=system.action_name,
            action_direction=system.action_direction,
            dt=getattr(twin, "dt", None),
            lengths=lengths,
            caption=f"Episodes that start in {where}" + ("" if lengths is None else ", of the longer half") + f". {_leaving(twin)}",
        )
    episodes = arrays.get("walks")
    if plane is not None and episodes is not None and episodes.states is not None:
        wrong = torch.stack([happened for name, happened in episodes.events.items() if name != "left"]).any(0)
        text = f"walks in full physics; dots: where they start; red: those that hit, fall or enter U. {_leaving(twin)}"
        figures["Walks in full physics"] = walks(plane, episodes.states, episodes.alive, wrong, caption=text)
    generator = torch.Generator().manual_seed(0)
    regions = (env.safe_set, env.state_space, env.unsafe_set)
    states = torch.cat([env.sample_states(2, generator, region=r) for r in regions])
    figures["What the agent sees"] = frames(env, states, captions=[_named(system.state_names, s) for s in states.tolist()])
    return figures


def _leaving(twin: SafetyEnv) -> str:
    """What becomes of an episode that leaves the state space."""
    if twin.exit_region == SAFE:
        return "An episode that leaves the arena, into the grey, is over and counts as safe."
    return "Beyond the state space (grey) everything counts as U."


def _named(names: Sequence[str], state: Sequence[float]) -> str:
    """Coordinates of a state with names and units, one below the other."""
    parts = (name.partition(" [") for name in names)
    return "\n".join(f"{word} {value:+.2f} {unit.rstrip(']')}" for (word, _, unit), value in zip(parts, state, strict=True))


def _plane(twin: SafetyEnv) -> Plane:
    first, second = twin.system.state_names[:2]
    return Plane.of(twin, (first, second))


def _learned_set(plane: Plane, twin: SafetyEnv, states: Any, barrier: Any, viability: Any) -> Any:
    """The learned set and the true kernel: in the plane, for several values of a third coordinate where that is an angle."""
    if twin.state_dim != 3 or not math.isclose(plane.period[2], 2 * math.pi, rel_tol=1e-4):
        return state_plane(plane, states, barrier, viable=viability)
    units = [name.partition("[")[2] for name in plane.names]
    names = twin.system.state_names
    return slices(plane, states, barrier, viability, name=names[2], arrows=bool(units[0]) and units[0] == units[1])


def _shown_of(twin: SafetyEnv, paths: Any) -> tuple[Any, Any]:
    """Which episodes are shown, and how many steps of each: where leaving is safe, the longer half, up to the last step
    inside."""
    if twin.exit_region != SAFE:
        return slice(None), None
    inside = twin.state_space.contains(paths).sum(0)
    longest = inside.argsort(descending=True)[: max(1, len(inside) // 2)]
    return longest, inside[longest] - 1


def _of_episodes(arrays: dict[str, Any], barrier: Any) -> dict[str, Any]:
    """Figures of a system that is known by being run only."""
    if "own" not in arrays:
        return {}  # no episode was asked for
    own, chance = arrays["own"], arrays["chance"]
    figures: dict[str, Any] = {}
    both = own.joined(chance)
    if both.latent is not None and both.latent.shape[-1] >= 2:
        figures["Latent space"] = latent_space(both.latent[both.alive], both.region[both.alive], barrier)
    if both.barrier is None:
        return figures
    figure = new_figure(8, 3.6, "Barrier value along fresh episodes; a dot marks an observation of U.")
    for k, (name, episodes) in enumerate((("under the policy", own), ("under random actions", chance))):
        axes = figure.add_subplot(1, 2, k + 1)
        value = torch.where(episodes.alive, episodes.barrier, math.nan)[:, :_SHOWN]
        axes.plot(value, color="C0", linewidth=0.7, alpha=0.5)
        step, episode = ((episodes.region == UNSAFE) & episodes.alive)[:, :_SHOWN].nonzero(as_tuple=True)
        axes.plot(step, value[step, episode], ".", color="C3", markersize=3)
        axes.axhline(0, color="black", linewidth=1)
        axes.set(title=name, xlabel="time [steps]", ylabel="barrier B [latent units]")
    figures["Barrier along episodes"] = figure
    return figures


def _film(outcome: Outcome, env: SafetyEnv | None, folder: Path) -> tuple[Path | None, str]:
    """Film of a run and what it shows: in full physics where there was any, on the true dynamics, or as the agent sees it."""
    arrays, path = outcome.evaluations["own"].arrays, folder / "episode.mp4"
    if env is None and "own" not in arrays:
        return None, ""
    if env is None:
        return _recorded(arrays["own"], path, "One fresh episode"), "One fresh episode, as the agent sees it."
    twin, e = env.known_twin(), outcome.config.evaluation
    in_physics, closest = arrays.get("walks"), arrays.get("closest")
    if closest is None and in_physics is not None and in_physics.frames is not None:
        text = "The closest call in full physics"
        return _recorded(in_physics, path, text, twin), f"{text}: what the agent sees, the true state, and the barrier value."
    openings, dt = list(twin.system.openings), getattr(twin, "dt", 0.05)
    film = Film(outcome.agent, twin, seconds=min(_FILM_SECONDS, e.horizon * dt))
    if closest is not None:
        make = twin.physics()
        film.world, film.seconds = make and make(), min(_WALK_SECONDS, e.walk_seconds)
    else:
        for name, title in (("recovery", "From U back into the safe set"), ("trajectories", "From the safe set")):
            if not openings and arrays.get(name) is not None and arrays[name].shape[1]:
                openings.append(Opening(title, tuple(arrays[name][0, 0].tolist())))
        if not openings or arrays.get("trajectories") is None:
            return None, ""
    try:
        last = None
        if closest is not None and in_physics is not None:
            last = Opening(f"The closest of {len(in_physics)} measured walks", tuple(closest[0])), closest[1]
        scenes = film.scenes(openings, last)
        plane = _plane(twin) if twin.state_dim > 1 else None
        levels = film.levels(arrays) if plane else None
        path = animate(scenes, path, plane=plane, levels=levels, fps=film.rate)
    finally:
        film.close()
    caption = _CAPTION.format("in full physics" if closest is not None else "on the true dynamics")
    if twin.state_dim > 2:
        caption += " Coordinates that the plane does not show are those of the moment."
    return path, caption + (" The dashed line is the border of the true kernel." if levels and "kernel" in levels[1] else "")


def _recorded(episodes: Episodes, path: Path, title: str, twin: SafetyEnv | None = None) -> Path | None:
    """Film of the first of some episodes, from what was kept of it."""
    if episodes.frames is None:
        return None
    told = [("", "fair")] * int(episodes.alive[:, 0].sum())
    plane = _plane(twin) if twin is not None and twin.state_dim > 1 else None
    fps = max(1, round(1 / getattr(twin, "dt", 0.1)))
    return animate([Scene(title, [take_of("what the policy sees", episodes, told)])], path, plane=plane, fps=fps)


def _notes(outcome: Outcome, env: SafetyEnv | None) -> list[str]:
    lines = [f"Warning: {text}." for text in outcome.warnings] + [f"To try: {text}." for text in outcome.advice]
    if outcome.seconds is not None:
        lines.append(f"Training took {outcome.seconds:.0f} s" + (f"; {outcome.stop_reason}." if outcome.stop_reason else "."))
    if outcome.budget:
        lines.append("What it took: " + ", ".join(f"{n:,} {what}" for what, n in outcome.budget.items()) + ".")
    return [*lines, *((_UNKNOWN,) if env is None else env.system.notes)]


def _proved(outcome: Outcome) -> list[str]:
    """The agent's own proof."""
    if not getattr(outcome.agent, "lipschitz_proved", False):
        return []
    bound = f"{outcome.agent.lipschitz_bound:g}"
    return [f"The deployed float32 barrier is {bound}-Lipschitz on all of its domain (exact integer arithmetic)."]


__all__ = ["REPORT_FILE", "draw_figures", "write_run_report"]
