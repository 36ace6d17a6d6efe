"""Figures, film and report of the quadruped: the plane from above, heading by heading, and the robot that walks."""

from __future__ import annotations

import importlib.util
import math
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import torch

from torchrl_sspl.certification.certificate import Certificate
from torchrl_sspl.errors import ConfigError
from torchrl_sspl.viz.animation import _images, _write_gif, _write_mp4
from torchrl_sspl.viz.certificate import certificate_section, proved_lines
from torchrl_sspl.viz.figures import _line, frames, latent_space, training_curves, trajectories
from torchrl_sspl.viz.plane import (
    BARRIER_COLOUR,
    KERNEL_COLOUR,
    PATH_COLOURS,
    Plane,
    array,
    new_figure,
    require,
    zero_level,
)
from torchrl_sspl.viz.report import requirement_rows, write_report

AXES = ("x [m]", "y [m]")
_RATE = "yaw rate [rad/s]"


def headings_figure(
    plane: Plane, states: Any, barrier: Any, viability: Any | None = None, headings: Sequence[float] | None = None
) -> Any:
    """The plane from above for several headings: S, U, the buffer, the line B = 0 and the true kernel's border.

    Args:
        plane: x and y of the states (x, y, heading), with S and U.
        states: ``(n, 3)`` all nodes of a regular grid (m, m, rad).
        barrier: ``(n,)`` barrier value of what is seen of each state.
        viability: ``(n,)`` value of the true kernel, positive inside; None: not drawn.
        headings: in rad; the nearest of the grid is shown. Default: eight of them.

    Returns:
        The figure; its label is a caption.

    Raises:
        ShapeError, NonFiniteError: the states are not a full grid, or a value does not fit them.
        MissingDependencyError: matplotlib is not installed.

    Source: paper Section V, figure "traj_sspl_gr"; deviation: the level of B and the true kernel are added.

    Example:
        >>> from torchrl_sspl.sets import Box
        >>> space = Box([-2.0, -2.0, -3.14], [2.0, 2.0, 3.14])
        >>> states = space.grid([9, 9, 4])
        >>> plane = Plane(("x", "y"), space.low.tolist(), space.high.tolist())
        >>> len(headings_figure(plane, states, 1.0 - states[:, :2].norm(dim=-1), headings=[0.0, 1.0]).axes)
        2
    """
    shown = [k * math.pi / 4 for k in range(8)] if headings is None else [float(h) for h in headings]
    columns = min(4, len(shown))
    rows = math.ceil(len(shown) / columns)
    caption = (
        "Where a robot with the given heading (arrow) is called safe: outside the black line, on which B = 0. "
        "Green: S, red: U, white: the buffer without labels."
    )
    if viability is not None:
        caption += " Blue, dashed: border of the true viability kernel."
    figure = new_figure(3.1 * columns, 3.2 * rows + 0.4, caption)
    values = {"barrier": barrier}
    if viability is not None:
        # Beyond the arena the value is infinite; a contour needs numbers.
        values["viability"] = -torch.as_tensor(viability).clamp(-10.0, 10.0)
    for k, heading in enumerate(shown):
        ax = figure.add_subplot(rows, columns, k + 1)
        wrapped = math.remainder(heading, 2 * math.pi)
        cut = Plane(
            plane.names, plane.low, plane.high, plane.period, plane.safe_set, plane.unsafe_set, (0, 1), {2: wrapped}
        )
        cut.draw(ax, resolution=200)
        x, y, table = cut.grid(states, values)
        zero_level(ax, x, y, table["barrier"], colors=BARRIER_COLOUR, linewidths=1.6)
        if viability is not None:
            zero_level(ax, x, y, table["viability"], colors=KERNEL_COLOUR, linewidths=1.3, linestyles="--")
        style = {"width": 0.06, "head_width": 0.22, "color": "#444444", "length_includes_head": True}
        ax.arrow(-0.3 * math.cos(wrapped), -0.3 * math.sin(wrapped), 0.6 * math.cos(wrapped), 0.6 * math.sin(wrapped), **style)
        ax.set(title=f"heading {math.degrees(wrapped):.0f}\u00b0", aspect="equal")
        ax.label_outer()
    handles = [*plane.set_handles(), _line(BARRIER_COLOUR, "B = 0")]
    if viability is not None:
        handles.append(_line(KERNEL_COLOUR, "true kernel", "--"))
    figure.legend(handles=handles, loc="outside lower center", ncols=len(handles), frameon=False)
    return figure


def walks_figure(plane: Plane, walks: Sequence[Any], *, limit: int = 60, caption: str = "") -> Any:
    """Paths of the robot that walked in full physics, in the plane from above.

    Args:
        plane: x and y of the states (x, y, heading).
        walks: each with ``poses`` ``(T + 1, 3)`` and the flags ``entered``, ``hit`` and ``fallen``.
        limit: paths drawn at most; those that went wrong first.
        caption: what is shown.

    Returns:
        The figure; its label is a caption.

    Raises:
        ConfigError: there is no walk.
        MissingDependencyError: matplotlib is not installed.

    Source: paper Section V, figure "traj_sspl_gr"; deviation: the paths of all episodes, not of a few.

    Example:
        >>> from types import SimpleNamespace
        >>> walk = SimpleNamespace(poses=torch.zeros(3, 3), entered=False, hit=False, fallen=False)
        >>> plane = Plane(("x", "y"), [-2, -2, -3], [2, 2, 3])
        >>> walks_figure(plane, [walk]).axes[0].get_xlabel()
        'x'
    """
    if not walks:
        raise ConfigError("walks: expected at least one, received none; set the number of episodes above 0.")
    wrong = [w for w in walks if w.entered or w.hit or w.fallen]
    good = [w for w in walks if not (w.entered or w.hit or w.fallen)]
    room = max(0, limit - len(wrong))
    # Evenly over all of them: walks from S come first, then those from {B <= 0}.
    spread = min(room, len(good))
    drawn = wrong[:limit] + [good[k * len(good) // spread] for k in range(spread)]
    figure = new_figure(5.6, 5.6, caption or f"{len(drawn)} of {len(walks)} walks in full physics; dots: where they start.")
    ax = figure.add_subplot()
    points = np.concatenate([array("poses", w.poses, (None, 3))[:, :2] for w in drawn])
    plane.draw(ax, cover=points)
    for k, w in enumerate(drawn):
        path = array("poses", w.poses, (None, 3))[:, :2]
        colour = "#c8372d" if w.entered or w.hit or w.fallen else PATH_COLOURS[k % len(PATH_COLOURS)]
        ax.plot(*path.T, color=colour, linewidth=1.0)
        ax.plot(*path[0], "o", color=colour, markersize=4, markeredgecolor="white")
    ax.set_aspect("equal")
    handles = [*plane.set_handles(), _line("#c8372d", f"went wrong ({len(wrong)})")]
    figure.legend(handles=handles, loc="outside lower center", ncols=3, frameon=False)
    return figure


def film_of_walk(
    walk: Any,
    path: str | Path,
    *,
    plane: Plane,
    background: tuple[Any, Any] | None = None,
    fps: int = 10,
    title: str = "",
) -> Path:
    """Film of the robot that walks: what the camera shows, its path, and the barrier value B(z_t) below.

    Args:
        walk: with ``poses``, ``actions``, ``barrier`` and ``frames`` ``(T + 1, 3, H, W)`` uint8.
        path: file to write, ``.mp4`` or ``.gif``.
        plane: x and y of the states (x, y, heading).
        background: grid states and their barrier values, of which the zero level is drawn: the outermost of all
            headings.
        fps: pictures per second; ten are real time.
        title: what is shown.

    Returns:
        The file written; a gif where ``imageio-ffmpeg`` is not installed.

    Raises:
        ConfigError: the walk has no frames, or the file name ends in something else.
        MissingDependencyError: matplotlib is not installed.

    Source: paper Section V (the quadruped in PyBullet); deviation: it moves, and B is shown.
    """
    path = Path(path)
    if walk.frames is None:
        raise ConfigError("walk: expected frames, received none; walk with keep_frames=True.")
    if path.suffix not in (".mp4", ".gif"):
        raise ConfigError(f"path: expected a file name that ends in .mp4 or .gif, received '{path.name}'.")
    if path.suffix == ".mp4" and importlib.util.find_spec("imageio_ffmpeg") is None:
        path = path.with_suffix(".gif")
    require("matplotlib")
    actions = torch.as_tensor(walk.actions)[:, 0].numpy()
    episode = (
        array("poses", walk.poses, (None, 3))[:, :2],
        torch.as_tensor(walk.frames).permute(0, 2, 3, 1).numpy(),
        array("barrier", walk.barrier, (None,)),
        np.append(actions, actions[-1] if len(actions) else 0.0),
    )
    path.parent.mkdir(parents=True, exist_ok=True)
    images = _images(episode, plane, background, _RATE, title)
    (_write_mp4 if path.suffix == ".mp4" else _write_gif)(path, images, fps)
    return path


def write_quadruped_report(
    directory: str | Path,
    agent: Any,
    env: Any,
    evaluation: Any,
    walks: Sequence[Any],
    *,
    requirements: Sequence[Any],
    config: dict[str, Any],
    checks: Sequence[Any] = (),
    film: Any | None = None,
    notes: str = "",
    certificate: Certificate | None = None,
) -> Path:
    """Draw all figures and the film, and write ``report.html``.

    Args:
        directory: where everything goes.
        agent: frozen agent.
        env: the Dubins car: pictures and regions.
        evaluation: measurements and arrays; without arrays only the walks are drawn.
        walks: walks in full physics; may be empty.
        requirements: table that the evaluation is judged by.
        config: everything that determined the run.
        checks: held-out checks of the training.
        film: a walk with frames; None: no film.
        notes: text.
        certificate: of the agent; None: the proof of the Lipschitz bound alone is shown.

    Returns:
        The page.

    Raises:
        MissingDependencyError: matplotlib is not installed.

    Source: paper Section V (figures); deviation: the true kernel, measurements and verdicts are added.
    """
    directory = Path(directory)
    folder = directory / "figures"
    folder.mkdir(parents=True, exist_ok=True)
    arrays, plane = evaluation.arrays, Plane.of(env, AXES)
    figures: dict[str, Any] = {}
    background = None
    if "states" in arrays:
        background = (arrays["states"], arrays["barrier"])
        figures["Plane by heading"] = headings_figure(plane, *background, arrays["viability"])
        some = slice(None, None, max(1, len(arrays["states"]) // 20000))
        region = env.region(arrays["states"][some])
        figures["Latent space"] = latent_space(arrays["latent"][some], region, agent.barrier)
    if "trajectories" in arrays:
        there = env.state_space.contains(arrays["trajectories"]).sum(0)  # steps up to the end of the arena
        longest = there.argsort(descending=True)[: max(1, len(there) // 2)]
        # The last step seen leads out of the arena, where nothing has a barrier value.
        figures["Dubins episodes"] = trajectories(
            plane,
            arrays["trajectories"][:, longest],
            arrays["torques"][:, longest],
            arrays["traces"][:, longest],
            action_name=_RATE,
            dt=env.dt,
            lengths=there[longest] - 1,
            caption="Episodes of the Dubins car that start in {B <= 0}, of the longer half; they end where the arena does.",
        )
    if walks:
        figures["Walks in full physics"] = walks_figure(plane, walks)
    generator = torch.Generator().manual_seed(0)
    shown = torch.cat([env.sample_states(2, generator, region=r) for r in (env.safe_set, env.unsafe_set)])
    figures["Top view"] = frames(env, shown)
    if (directory / "log.jsonl").is_file():
        figures["Training"] = training_curves(directory / "log.jsonl")
    for name, figure in figures.items():
        figure.savefig(folder / f"{name.lower().replace(' ', '_')}.png", dpi=130)
    video = None
    if film is not None:
        video = film_of_walk(
            film, folder / "walk.mp4", plane=plane, background=background, title="The robot walks; B(z) below"
        )
    text = [
        notes,
        "The certificate and the training are about the Dubins car that turns as late as the walking robot does; the true "
        "kernel, and the Dubins episodes in the table, are those of the car that turns at once. What the robot does in "
        "full physics is measured by its walks. In full physics position and heading alone do not determine the next "
        "step; the lag enters as an error that the set tolerates.",
    ]
    bound = f"The deployed float32 barrier is {agent.lipschitz_bound:g}-Lipschitz on all of its domain (exact integer arithmetic)."
    proved = [bound] if agent.description.get("lipschitz", {}).get("proved") else []
    return write_report(
        directory / "report.html",
        title="Quadruped: an obstacle, from pixels",
        summary=list(requirement_rows(requirements, evaluation)),
        measurements=evaluation.measurements,
        figures=figures,
        config=config,
        checks=checks,
        video=video,
        notes="\n\n".join(t for t in text if t),
        proved=proved if certificate is None else proved_lines(certificate),
        certificate=None if certificate is None else certificate_section(certificate),
    )


__all__ = ["film_of_walk", "headings_figure", "walks_figure", "write_quadruped_report"]
