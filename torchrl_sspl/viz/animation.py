"""Animation of one episode: what the agent sees, where the true state is, and what the barrier says."""

from __future__ import annotations

import importlib.util
import warnings
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from torchrl_sspl.errors import ConfigError, ShapeError
from torchrl_sspl.modules.agent import Agent, hosted
from torchrl_sspl.viz.plane import BARRIER_COLOUR, PATH_COLOURS, Plane, array, new_figure, require, zero_level

_WIDTH, _HEIGHT, _DPI = 9.6, 5.4, 80  # 768 x 432 pixels: even, as the video codec wants them


@torch.no_grad()
def animate(
    agent: Any,
    env: Any,
    start: Tensor,
    steps: int,
    path: str | Path,
    *,
    plane: Plane | None = None,
    background: tuple[Any, Any] | None = None,
    action_name: str = "action",
    fps: int = 20,
    title: str = "",
) -> Path:
    """Film of one closed-loop episode: the frame seen, the path in the state plane, the barrier value below.

    Args:
        agent: has ``act(pixels (1, 6, H, W)) -> action (1, m), barrier (1, 1)``.
        env: has ``observe``, ``dynamics``, ``wrap``; and the regions, if no plane is given.
        start: ``(state_dim,)`` or ``(1, state_dim)`` first state.
        steps: number of steps.
        path: the file to write, ``.mp4`` or ``.gif``.
        plane: the coordinates shown; default: the first two of the environment's state.
        background: grid states ``(k, dim)`` and their barrier values ``(k,)``, of which the zero level is drawn.
        action_name: name and unit of the action.
        fps: pictures per second.
        title: what is shown.

    Returns:
        The file written. Without ``imageio-ffmpeg`` a film that was to be an mp4 becomes a gif, with a warning.

    Raises:
        ShapeError, ConfigError: the start, the number of steps or the file name is not what was expected.
        MissingDependencyError: matplotlib is not installed.

    Source: paper Section V, figure "sspl_pend"; deviation: it moves.
    """
    path = Path(path)
    if path.suffix not in (".mp4", ".gif"):
        raise ConfigError(f"path: expected a file name that ends in .mp4 or .gif, received '{path.name}'.")
    if not isinstance(steps, int) or steps < 1:
        raise ConfigError(f"steps: expected an integer >= 1, received {steps!r}.")
    plane = plane or Plane.of(env)
    first = torch.as_tensor(start, dtype=torch.float32)
    if first.shape == (1, plane.dim):
        first = first[0]
    if first.shape != (plane.dim,):
        raise ShapeError(f"start: expected shape ({plane.dim},), received {tuple(first.shape)}.")
    array("start", first, (plane.dim,))
    if path.suffix == ".mp4" and importlib.util.find_spec("imageio_ffmpeg") is None:
        warnings.warn("imageio-ffmpeg is not installed; the film becomes a gif.", stacklevel=2)
        path = path.with_suffix(".gif")

    agent = hosted(agent) if isinstance(agent, Agent) else agent
    state, previous = env.wrap(first[None]), None
    states, pictures, values, actions = [], [], [], []
    for _ in range(steps + 1):
        pixels = env.observe(state, previous)
        action, barrier = agent.act(pixels)
        states.append(state[0].cpu().numpy())
        pictures.append(pixels[0, 3:].permute(1, 2, 0).cpu().numpy())
        values.append(float(barrier))
        actions.append(action[0].cpu().numpy())
        previous, state = state, env.wrap(env.dynamics(state, action))
    episode = (
        np.stack(states)[:, list(plane.coords)],
        np.stack(pictures),
        np.array(values),
        np.stack(actions)[:, 0],
    )
    images = _images(episode, plane, background, action_name, title)
    path.parent.mkdir(parents=True, exist_ok=True)
    (_write_mp4 if path.suffix == ".mp4" else _write_gif)(path, images, fps)
    return path


def _images(
    episode: tuple[np.ndarray, ...],
    plane: Plane,
    background: tuple[Any, Any] | None,
    action_name: str,
    title: str,
) -> Iterator[np.ndarray]:
    """RGB pictures of the film; what does not move is drawn once."""
    points, pictures, values, actions = episode
    figure = new_figure(_WIDTH, _HEIGHT)
    figure.set_dpi(_DPI)
    grid = figure.add_gridspec(2, 2, width_ratios=(1, 1.35), height_ratios=(2.4, 1))
    seen, where, below = (figure.add_subplot(grid[k]) for k in ((0, 0), (0, 1), (1, slice(None))))
    if title:
        figure.suptitle(title, fontsize=11)
    seen.set(xticks=[], yticks=[], title="seen by the agent", frame_on=False)
    plane.draw(where, cover=points)
    where.set_title("true state")
    if background is not None:
        x, y, table = plane.grid(background[0], {"barrier": background[1]})
        zero_level(where, x, y, table["barrier"], colors=BARRIER_COLOUR, linewidths=1.6)
    low, high = min(values.min(), 0.0), max(values.max(), 0.0)
    room = 0.08 * (high - low) + 1e-3
    steps = np.arange(len(values))
    below.axhspan(low - room, 0, color="#cdeccd", linewidth=0)
    below.axhline(0, color=BARRIER_COLOUR, linewidth=1.0)
    below.set(xlim=(0, max(1, len(values) - 1)), ylim=(low - room, high + room), ylabel="B(z)", xlabel="step")

    image = seen.imshow(pictures[0], interpolation="nearest", animated=True)
    (track,) = where.plot([], [], color=PATH_COLOURS[0], linewidth=1.6, animated=True)
    (dot,) = where.plot([], [], "o", color=PATH_COLOURS[1], markersize=8, markeredgecolor="white", animated=True)
    (curve,) = below.plot([], [], color=PATH_COLOURS[0], linewidth=1.6, animated=True)
    (now,) = below.plot([], [], "o", color=PATH_COLOURS[1], markersize=6, animated=True)
    text = below.text(0.995, 0.93, "", transform=below.transAxes, ha="right", va="top", fontsize=9, animated=True)
    figure.canvas.draw()
    figure.set_layout_engine("none")
    still = figure.canvas.copy_from_bbox(figure.bbox)  # type: ignore[attr-defined]
    for t in steps:
        figure.canvas.restore_region(still)  # type: ignore[attr-defined]
        image.set_data(pictures[t])
        track.set_data(*plane.unwrap_breaks(points[: t + 1]).T)
        dot.set_data(points[t, :1], points[t, 1:])
        curve.set_data(steps[: t + 1], values[: t + 1])
        now.set_data(steps[t : t + 1], values[t : t + 1])
        text.set_text(f"B = {values[t]:+.3f}   {action_name}: {actions[t]:+.2f}")
        for axes, artists in ((seen, (image,)), (where, (track, dot)), (below, (curve, now, text))):
            for artist in artists:
                axes.draw_artist(artist)
        yield np.asarray(figure.canvas.buffer_rgba())[..., :3].copy()  # type: ignore[attr-defined]


def _write_mp4(path: Path, images: Iterator[np.ndarray], fps: int) -> None:
    ffmpeg = require("imageio_ffmpeg")
    first = next(images)
    writer = ffmpeg.write_frames(
        str(path),
        (first.shape[1], first.shape[0]),
        fps=fps,
        codec="libx264",
        quality=None,
        macro_block_size=2,
        # Small, and ready to play before it is read to the end.
        output_params=["-crf", "24", "-preset", "medium", "-movflags", "+faststart", "-threads", "1"],
    )
    writer.send(None)
    try:
        writer.send(np.ascontiguousarray(first))
        for image in images:
            writer.send(np.ascontiguousarray(image))
    finally:
        writer.close()


def _write_gif(path: Path, images: Iterator[np.ndarray], fps: int) -> None:
    pillow = require("PIL.Image")
    pages = [pillow.fromarray(image).quantize(64) for image in images]
    pages[0].save(path, save_all=True, append_images=pages[1:], duration=round(1000 / fps), loop=0, optimize=True)
