"""Animation of one episode: what the agent sees, where the true state is, and what the barrier says."""

from __future__ import annotations

import importlib.util
import itertools
import warnings
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np

from torchrl_sspl.errors import ConfigError, ShapeError
from torchrl_sspl.viz.plane import BARRIER_COLOUR, PATH_COLOURS, Plane, array, new_figure, require, zero_level

_WIDTH, _HEIGHT, _DPI = 9.6, 5.4, 80  # 768 x 432 pixels: even, as the video codec wants them


def animate(
    states: Any,
    frames: Any,
    barrier: Any,
    actions: Any,
    path: str | Path,
    *,
    plane: Plane,
    background: tuple[Any, Any] | None = None,
    action_name: str = "action",
    fps: int = 20,
    title: str = "",
) -> Path:
    """Film of one closed-loop episode: the frame seen, the path in the state plane, the barrier value below.

    Args:
        states: ``(T + 1, dim)`` true states.
        frames: ``(T + 1, 3, H, W)`` uint8 what was seen of them.
        barrier: ``(T + 1,)`` barrier values; None: the action is shown below instead.
        actions: ``(T, m)``, T >= 1; the first component is shown.
        path: the file to write, ``.mp4`` or ``.gif``.
        plane: the coordinates shown.
        background: grid states ``(k, dim)`` and their barrier values ``(k,)``, of which the zero level is drawn.
        action_name: name and unit of the action.
        fps: pictures per second.
        title: what is shown.

    Returns the file written: without ``imageio-ffmpeg`` an mp4 becomes a gif, with a warning. Raises ShapeError,
    NonFiniteError or ConfigError for another argument or file name. Source: paper Section V, figures "sspl_pend" and
    "traj_sspl_gr"; deviation: they move, and B is shown.

    Example:
        >>> plane, pictures = Plane(("x", "v"), [-1, -1], [1, 1]), torch.zeros(3, 3, 8, 8, dtype=torch.uint8)
        >>> animate(torch.zeros(3, 2), pictures, torch.zeros(3), torch.zeros(2, 1), "film.gif", plane=plane).name
        'film.gif'
    """
    path = Path(path)
    if path.suffix not in (".mp4", ".gif"):
        raise ConfigError(f"path: expected a file name that ends in .mp4 or .gif, received '{path.name}'.")
    x, u = array("states", states, (None, plane.dim)), array("actions", actions, (None, None))
    if len(u) < 1 or len(x) != len(u) + 1:
        raise ShapeError(f"states and actions: expected T + 1 and T >= 1 rows, received {len(x)} and {len(u)}.")
    pictures = array("frames", frames, (len(x), 3, None, None)).astype(np.uint8).transpose(0, 2, 3, 1)
    values = None if barrier is None else array("barrier", barrier, (len(x),))
    if path.suffix == ".mp4" and importlib.util.find_spec("imageio_ffmpeg") is None:
        warnings.warn("imageio-ffmpeg is not installed; the film becomes a gif.", stacklevel=2)
        path = path.with_suffix(".gif")
    shown = np.append(u[:, 0], u[-1, 0])  # of the last state no action was asked
    images = _images((x[:, list(plane.coords)], pictures, values, shown), plane, background, action_name, title)
    path.parent.mkdir(parents=True, exist_ok=True)
    (_write_mp4 if path.suffix == ".mp4" else _write_gif)(path, images, fps)
    return path


def _images(
    episode: tuple[np.ndarray, np.ndarray, np.ndarray | None, np.ndarray], plane: Plane,
    background: tuple[Any, Any] | None, action_name: str, title: str,
) -> Iterator[np.ndarray]:  # fmt: skip
    """RGB pictures of the film; what does not move is drawn once."""
    points, pictures, barrier, actions = episode
    values = actions if barrier is None else barrier
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
    if barrier is not None:
        below.axhspan(low - room, 0, color="#cdeccd", linewidth=0)
    below.axhline(0, color=BARRIER_COLOUR, linewidth=1.0)
    below.set(xlim=(0, max(1, len(values) - 1)), ylim=(low - room, high + room), xlabel="step")
    below.set_ylabel("B(z)" if barrier is not None else action_name)

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
        said = "" if barrier is None else f"B = {values[t]:+.3f}   "
        text.set_text(f"{said}{action_name}: {actions[t]:+.2f}")
        for axes, artists in ((seen, (image,)), (where, (track, dot)), (below, (curve, now, text))):
            for artist in artists:
                axes.draw_artist(artist)
        yield np.asarray(figure.canvas.buffer_rgba())[..., :3].copy()  # type: ignore[attr-defined]


def _write_mp4(path: Path, images: Iterator[np.ndarray], fps: int) -> None:
    ffmpeg = require("imageio_ffmpeg")
    first = next(images)
    # Small, and ready to play before it is read to the end.
    output = ["-crf", "24", "-preset", "medium", "-movflags", "+faststart", "-threads", "1"]
    style = {"codec": "libx264", "quality": None, "macro_block_size": 2, "output_params": output}
    writer = ffmpeg.write_frames(str(path), (first.shape[1], first.shape[0]), fps=fps, **style)
    writer.send(None)
    try:
        for image in itertools.chain([first], images):
            writer.send(np.ascontiguousarray(image))
    finally:
        writer.close()


def _write_gif(path: Path, images: Iterator[np.ndarray], fps: int) -> None:
    pillow = require("PIL.Image")
    pages = [pillow.fromarray(image).quantize(64) for image in images]
    pages[0].save(path, save_all=True, append_images=pages[1:], duration=round(1000 / fps), loop=0, optimize=True)
