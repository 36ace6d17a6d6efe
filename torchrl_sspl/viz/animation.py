"""Films: an episode beside what happens without protection, the true state in its plane, and the barrier over time."""

from __future__ import annotations

import dataclasses
import importlib.util
import itertools
import math
import warnings
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from torchrl_sspl.errors import ConfigError, ShapeError
from torchrl_sspl.viz.plane import (
    BARRIER_COLOUR,
    KERNEL_COLOUR,
    PATH_COLOURS,
    SAFE_FILL,
    Plane,
    array,
    full_grid,
    new_figure,
    require,
)  # fmt: skip

WIDTH, HEIGHT = 768, 432  # pixels of a film; even, as the video codec wants them
VIEW = 228  # pixels of a picture for people, height and width
_HOLD = 1.0  # s, for which the last picture of a scene stays
_ALONE, _MAIN = "#7a7f87", PATH_COLOURS[0]  # what is shown beside the agent, and the agent
_KINDS = {"good": "#15803d", "fair": "#b45309", "bad": "#b91c1c"}
_COLOURS = 96  # of a gif


@dataclass
class Take:
    """One episode as it is filmed, K pictures.

    Args:
        name: what acts.
        pictures: K pictures for people, uint8 ``(H, W, 3)``; drawn when they are asked for.
        said: K pairs: what is known at a picture, and whether it is "good", "fair" or "bad" news.
        states: ``(K, dim)`` true states; None where they are not known.
        values: ``(K,)`` barrier values, or whatever is shown over time.
        seen: ``(K, h, w, 3)`` uint8 what the agent sees; None where the pictures are that.

    Source: none.
    """

    name: str
    pictures: Iterable[Any]
    said: Sequence[tuple[str, str]]
    states: Any = None
    values: Any = None
    seen: Any = None


@dataclass
class Scene:
    """A title, and one or two takes from the same start, the agent's last; levels of its own in place of the film's. Source: none."""

    title: str
    takes: list[Take]
    levels: tuple[Any, dict[str, Any]] | None = None


def animate(
    scenes: Iterable[Scene], path: str | Path, *, plane: Plane | None = None, levels: tuple[Any, dict[str, Any]] | None = None,
    value_name: str = "B", fps: int = 25,
) -> Path:  # fmt: skip
    """Film of scenes, one after the other; beside an mp4 a picture with the ending .jpg, which is shown before it begins.

    Args:
        scenes: what is shown.
        path: the file to write, ``.mp4`` or ``.gif``.
        plane: the coordinates shown, with S, U and the obstacle; None: no plane.
        levels: grid states ``(n, dim)`` and, by name, values ``(n,)`` of which the zero level is drawn: ``"B"``, ``"kernel"``.
            Coordinates that the plane does not show are those of the agent at the moment.
        value_name: of the values over time, with unit.
        fps: pictures per second.

    Returns the film: without ``imageio-ffmpeg`` an mp4 becomes a gif, with a warning. Raises ShapeError, NonFiniteError or
    ConfigError for another argument or file name. Source: paper Section V, figures "sspl_pend" and "traj_sspl_gr"; deviation:
    they move, B and its zero level are shown, and what happens without protection.

    Example:
        >>> take = Take("policy", [np.zeros((8, 8, 3), np.uint8)] * 2, [("inside", "good")] * 2, values=[-0.2, -0.1])
        >>> animate([Scene("Demo", [take])], "film.gif").name
        'film.gif'
    """
    path = Path(path)
    if path.suffix not in (".mp4", ".gif"):
        raise ConfigError(f"path: expected a file name that ends in .mp4 or .gif, received '{path.name}'.")
    if path.suffix == ".mp4" and importlib.util.find_spec("imageio_ffmpeg") is None:
        warnings.warn("imageio-ffmpeg is not installed; the film becomes a gif.", stacklevel=2)
        path = path.with_suffix(".gif")
    images = itertools.chain.from_iterable(_Drawing(scene, plane, scene.levels or levels, value_name, fps).images() for scene in scenes)
    path.parent.mkdir(parents=True, exist_ok=True)
    if path.suffix == ".mp4":
        _write_mp4(path, _with_poster(images, path.with_suffix(".jpg"), fps), fps)
    else:
        _write_gif(path, images, fps)
    return path


class _Drawing:
    """A scene on a figure; what does not move is drawn once."""

    def __init__(self, scene: Scene, plane: Plane | None, levels: Any, value_name: str, fps: int) -> None:
        if not 1 <= len(scene.takes) <= 2:
            raise ShapeError(f"scene '{scene.title}': expected one or two takes, received {len(scene.takes)}.")
        self.takes, self.fps, self.plane = [_checked(take, plane) for take in scene.takes], fps, plane
        self.length = max(len(take.said) for take in self.takes)
        self.figure = new_figure(WIDTH / 80, HEIGHT / 80)
        self.figure.set_layout_engine("none")
        self.figure.set_dpi(80)
        self.figure.text(12 / WIDTH, 1 - 20 / HEIGHT, scene.title, fontsize=min(13.0, 1000.0 / max(1, len(scene.title))), fontweight="bold", va="center")  # the time stands to its right
        self.moving: list[tuple[Any, Any]] = []  # axes (None: the figure) and artist, in the order in which they are drawn
        self.clock = self._text(None, 1 - 12 / WIDTH, 1 - 20 / HEIGHT, ha="right", va="center", fontsize=11)
        slots = len(self.takes) + (plane is not None)
        edges = [(WIDTH - slots * VIEW) / (slots + 1) * (k + 1) + k * VIEW for k in range(slots)] if slots < 3 else [10, 246, 532]
        self.views = [self._view(take, edge, colour) for take, edge, colour in zip(self.takes, edges, self._colours(), strict=False)]
        if plane is not None:
            self._draw_plane(plane, levels, edges[-1])
        self._draw_values(value_name)

    def _colours(self) -> list[str]:
        return [_ALONE, _MAIN][-len(self.takes) :]

    def _axes(self, x: float, y: float, width: float, height: float) -> Any:
        return self.figure.add_axes((x / WIDTH, y / HEIGHT, width / WIDTH, height / HEIGHT))

    def _artist(self, axes: Any, artist: Any) -> Any:
        artist.set_animated(True)
        self.moving.append((axes, artist))
        return artist

    def _text(self, axes: Any, x: float, y: float, **style: Any) -> Any:
        return self._artist(axes, (axes or self.figure).text(x, y, "", **({"transform": axes.transAxes} if axes else {}), **style))

    def _view(self, take: Take, x: float, colour: str) -> tuple[Any, Any, Any]:
        axes = self._axes(x, 144, VIEW, VIEW)
        axes.set(xticks=[], yticks=[])
        axes.set_title(take.name, fontsize=10.5, color=colour, fontweight="bold", pad=4)
        blank = np.full((VIEW, VIEW, 3), 255, np.uint8)
        image = self._artist(axes, axes.imshow(blank, interpolation="antialiased", extent=(0, 1, 0, 1)))
        box = {"boxstyle": "round,pad=0.3", "facecolor": "white", "alpha": 0.92, "linewidth": 1.2}
        for spine in axes.spines.values():
            self._artist(axes, spine)
        said = self._text(axes, 0.03, 0.04, fontsize=10, fontweight="bold", ha="left", va="bottom", bbox=box)
        return axes, image, said

    def _draw_plane(self, plane: Plane, levels: Any, x: float) -> None:
        axes = self._axes(x, 170, 206 if len(self.takes) > 1 else VIEW, 206)
        plane.draw(axes, cover=self.takes[-1].states[:, list(plane.coords)])
        axes.tick_params(labelsize=8.5)
        axes.xaxis.label.set_size(9)
        axes.yaxis.label.set_size(9)
        axes.yaxis.labelpad = 1
        self.levels = [] if levels is None else [_Level(plane, levels[0], name, value) for name, value in levels[1].items()]
        for level in self.levels:
            level.lines = self._artist(axes, level.collection())
            axes.add_collection(level.lines)
        turns = plane.dim >= 3 and math.isclose(plane.period[2], 2 * math.pi, rel_tol=1e-4)
        units = [name.partition("[")[2] for name in plane.names]
        self.headings = turns and bool(units[0]) and units[0] == units[1]
        where = "" if not plane.hidden else " at this heading" if self.headings and plane.dim == 3 else " in its plane"
        axes.set_title(f"true state; line: B = 0{where}", fontsize=10.5, pad=4)
        self.tracks = []
        for colour in self._colours():
            (track,) = axes.plot([], [], color=colour, linewidth=1.8)
            (dot,) = axes.plot([], [], "o", color=colour, markersize=8, markeredgecolor="white")
            arrow = axes.quiver([0], [0], [0], [0], color=colour, scale=7.5, width=0.016, headwidth=3.6, zorder=6)
            self.tracks.append(tuple(self._artist(axes, a) for a in (track, arrow, dot)))

    def _draw_values(self, name: str) -> None:
        values = [take.values for take in self.takes if take.values is not None]
        self.curves: list[Any] = []
        left = 58
        if self.takes[-1].seen is not None:
            seen = self._axes(12, 8, 104, 104)
            seen.set(xticks=[], yticks=[])
            seen.set_title("what the policy sees", fontsize=9, pad=3)
            self.seen = self._artist(seen, seen.imshow(self.takes[-1].seen[0], interpolation="nearest"))
            for spine in seen.spines.values():
                self._artist(seen, spine)
            left = 182
        if not values:
            return
        axes = self._axes(left, 36, WIDTH - left - 16, 76)
        low, high = min(0.0, *(v.min() for v in values)), max(0.0, *(v.max() for v in values))
        room = 0.12 * (high - low) + 1e-3
        axes.set(xlim=(0, max(1, self.length - 1) / self.fps), ylim=(low - room, high + room))
        if name == "B":
            axes.axhspan(low - room, 0, color=SAFE_FILL, linewidth=0)
        axes.axhline(0, color=BARRIER_COLOUR, linewidth=1.0)
        axes.set_xlabel("time [s]", fontsize=9, labelpad=1)
        axes.set_ylabel(name, fontsize=9)
        axes.set_title("barrier B: inside the set while it is at most 0" if name == "B" else name, fontsize=9, pad=3)
        axes.tick_params(labelsize=8.5)
        for colour in self._colours():
            (curve,) = axes.plot([], [], color=colour, linewidth=1.8)
            (now,) = axes.plot([], [], "o", color=colour, markersize=6)
            self.curves.append((self._artist(axes, curve), self._artist(axes, now)))

    def images(self) -> Iterator[np.ndarray]:
        """RGB pictures of the scene; the last one stays for a moment."""
        canvas: Any = self.figure.canvas
        canvas.draw()
        still = canvas.copy_from_bbox(self.figure.bbox)
        streams = [_scaled(take.pictures) for take in self.takes]
        for k in range(self.length):
            self._turn_to(k, streams)
            canvas.restore_region(still)
            for axes, artist in self.moving:
                (axes or self.figure).draw_artist(artist)
            picture = np.asarray(canvas.buffer_rgba())[..., :3].copy()
            yield picture
        yield from itertools.repeat(picture, round(_HOLD * self.fps))

    def _turn_to(self, k: int, streams: list[Iterator[np.ndarray]]) -> None:
        """Give every artist what it shows in picture k; a take that is over stays as it ended."""
        self.clock.set_text(f"{k / self.fps:.1f} s")
        for take, stream, (axes, image, said) in zip(self.takes, streams, self.views, strict=True):
            if k < len(take.said):
                image.set_data(next(stream))
                text, kind = take.said[k]
                said.set(text=text, color=_KINDS[kind])
                said.get_bbox_patch().set_edgecolor(_KINDS[kind])
        main = self.takes[-1]
        last = min(k, len(main.said) - 1)
        if main.seen is not None:
            self.seen.set_data(main.seen[last])
        if self.plane is not None:
            self._move(k, self.plane)
            for level in self.levels:
                level.turn_to(main.states[last])
        for take, curve in zip(self.takes, self.curves, strict=False):
            end = min(k, len(take.said) - 1)
            if take.values is not None:
                curve[0].set_data(np.arange(end + 1) / self.fps, take.values[: end + 1])
                curve[1].set_data([end / self.fps], take.values[end : end + 1])

    def _move(self, k: int, plane: Plane) -> None:
        for take, (track, arrow, dot) in zip(self.takes, self.tracks, strict=True):
            points = take.states[: k + 1][:, list(plane.coords)]
            track.set_data(*plane.unwrap_breaks(points).T)
            dot.set_data(points[-1:, 0], points[-1:, 1])
            if self.headings:
                heading = take.states[min(k, len(take.said) - 1), 2]
                arrow.set_offsets(points[-1:])
                arrow.set_UVC([math.cos(heading)], [math.sin(heading)])


class _Level:
    """The zero level of values on a grid, at the present values of the coordinates that are not shown."""

    def __init__(self, plane: Plane, states: Any, name: str, values: Any) -> None:
        self.colour, self.style = (BARRIER_COLOUR, "-") if name == "B" else (KERNEL_COLOUR, "--")
        self.lines: Any = None
        self.plane = plane
        self.axes, tables = full_grid(states, {"v": values}, plane.dim)
        self.level = 0.5 if tables["v"].dtype == bool else 0.0
        self.table = tables["v"].astype(float)

    def collection(self) -> Any:
        """The line, still empty."""
        lines = require("matplotlib.collections").LineCollection
        return lines([], colors=self.colour, linewidths=1.5, linestyles=self.style, zorder=2)

    def turn_to(self, state: np.ndarray) -> None:
        """Move the line to the plane through a state."""
        table = self.table
        for axis in reversed(self.plane.hidden):
            table = _between(self.axes[axis], table, axis, float(state[axis]), self.plane.period[axis])
        x, y = (self.axes[k] for k in self.plane.coords)
        contours = require("contourpy").contour_generator(x, y, self.plane.turned(table))
        self.lines.set_segments(contours.lines(self.level))


def _between(nodes: np.ndarray, table: np.ndarray, axis: int, at: float, period: float) -> np.ndarray:
    """A table at a value of one of its axes, linear between the nodes; beyond the last one constant, or periodic."""
    first, last = nodes[0], nodes[-1]
    at = first + (at - first) % period if period else min(max(at, first), last)
    k = int(np.searchsorted(nodes, at, side="right")) - 1
    here, there = table.take(k, axis), table.take((k + 1) % len(nodes), axis)
    following = nodes[k + 1] if k + 1 < len(nodes) else first + period
    return here + min((at - nodes[k]) / max(following - nodes[k], 1e-9), 1.0) * (there - here)


def _checked(take: Take, plane: Plane | None) -> Take:
    """The take with arrays, of one length."""
    n = len(take.said)
    if n < 1:
        raise ShapeError(f"take '{take.name}': expected at least one picture, received none.")
    if plane is not None and take.states is None:
        raise ShapeError(f"take '{take.name}': expected states ({n}, {plane.dim}) for the plane, received none.")
    states = None if take.states is None else array("states", take.states, (n, None if plane is None else plane.dim))
    values = None if take.values is None else array("values", take.values, (n,))
    seen = None if take.seen is None else array("seen", take.seen, (n, None, None, 3)).astype(np.uint8)
    return dataclasses.replace(take, states=states, values=values, seen=seen)


def _scaled(pictures: Iterable[Any]) -> Iterator[np.ndarray]:
    """Pictures enlarged by a whole number, as large as they are shown or larger."""
    for picture in pictures:
        picture = np.asarray(picture, np.uint8)
        times = max(1, -(-VIEW // max(picture.shape[:2])))
        yield picture.repeat(times, 0).repeat(times, 1) if times > 1 else picture


def _with_poster(images: Iterator[np.ndarray], path: Path, fps: int) -> Iterator[np.ndarray]:
    """The images; the one after two seconds, or the last, is kept in a file."""
    poster: np.ndarray | None = None
    for k, image in enumerate(images):
        poster = image if k <= 2 * fps else poster
        yield image
    if poster is not None:
        require("PIL.Image").fromarray(poster).save(path, quality=88)


def mp4_writer(path: Path, size: tuple[int, int], fps: float, preset: str) -> Any:
    """What RGB pictures ``(height, width, 3)`` of a film are sent to; ``size``: width and height, ``preset``: of the codec."""
    # Small, and ready to play before it is read to the end.
    output = ["-crf", "24", "-preset", preset, "-movflags", "+faststart", "-threads", "1"]
    style = {"codec": "libx264", "quality": None, "macro_block_size": 2, "output_params": output}
    writer = require("imageio_ffmpeg").write_frames(str(path), size, fps=fps, **style)
    writer.send(None)
    return writer


def _write_mp4(path: Path, images: Iterator[np.ndarray], fps: int) -> None:
    first = next(images)
    writer = mp4_writer(path, (first.shape[1], first.shape[0]), fps, preset="medium")
    try:
        for image in itertools.chain([first], images):
            writer.send(np.ascontiguousarray(image))
    finally:
        writer.close()


def _write_gif(path: Path, images: Iterator[np.ndarray], fps: int) -> None:
    """One palette for all, so that what stays the same costs nothing."""
    pillow = require("PIL.Image")
    shown = [pillow.fromarray(image) for image in images]
    some = np.concatenate([np.asarray(image) for image in shown[:: max(1, len(shown) // 8)]])
    # Half for what is seen most, half for colours that are rare and far apart.
    parts = [pillow.fromarray(some).quantize(_COLOURS // 2, method=m) for m in (pillow.Quantize.MEDIANCUT, pillow.Quantize.MAXCOVERAGE)]
    palette = pillow.new("P", (1, 1))
    palette.putpalette([c for part in parts for c in (part.getpalette() or [])[: 3 * (_COLOURS // 2)]])
    pages = [image.quantize(palette=palette, dither=0) for image in shown]
    pages[0].save(path, save_all=True, append_images=pages[1:], duration=round(1000 / fps), loop=0, optimize=False)
