"""The Dubins car from pixels on which latent safety filters report their numbers (Nakamura, Peters, Bajcsy, RSS 2025)."""

from __future__ import annotations

import functools
import math
from collections.abc import Callable, Sequence

import gymnasium
import torch
from torch import Tensor

from torchrl_sspl.envs.base import check_positive, check_tensor, numbers
from torchrl_sspl.envs.dubins import DubinsEnv
from torchrl_sspl.envs.system import Requirement, System
from torchrl_sspl.errors import ConfigError
from torchrl_sspl.sets import Difference, Region

ARENA, FAILURE, SPEED, STEP, YAW_RATE = 1.1, 0.5, 1.0, 0.05, 1.25
_POINT = 1 / 72  # of the width of the frame, which is one inch
_LINE = 1.0 * _POINT  # width of outlines
_LINES = 4  # per row of pixels, on which the extent of the arrow is exact
_CHUNK = 128  # frames at a time
# Of all states that cannot be kept safe, 30.7 % lie outside U: 9.7 % and 3.2 % of these are less than 3 % and 1 % of all.
_REQUIREMENTS = (
    Requirement("volume_over_kernel", "volume of {B <= 0} over the true kernel (recall)", ">=", 0.95, 0.97),
    Requirement("false_safe_of_doomed", "doomed states outside U with B <= 0", "<=", 0.097, 0.032),
    Requirement("unsafe_called_safe", "grid of U with B <= 0", "<=", 0.0, 0.0),
    Requirement("safe_rollouts_touch_unsafe", "episodes from {B <= 0} that enter U", "<=", 0.001, 0.0),
    Requirement("training_minutes", "training time [min]", "<=", 20.0, 10.0),
)
Colour = Sequence[float]


class Stays(Region):
    """States (x, y, heading, ...) whose next step straight ahead ends in the square around the origin."""

    def __init__(self, half_size: float, step: float, dim: int = 3) -> None:
        self.half_size, self.step, self.dim = half_size, step, dim

    def contains(self, state: Tensor) -> Tensor:
        check_tensor("state", state, self.dim)
        after = state[..., :2] + self.step * torch.stack([state[..., 2].cos(), state[..., 2].sin()], -1)
        return after.abs().amax(-1) <= self.half_size


class CMUDubinsEnv(DubinsEnv):
    r"""The Dubins car of CMU's latent safety filters, with their picture and the labels that their data has.

    With position (x, y), heading theta and the yaw rate u, one step is

        x' = x + v cos(theta) dt,    y' = y + v sin(theta) dt,    theta' = theta + u dt

    with v = 1 m/s, dt = 0.05 s, |u| <= 1.25 rad/s. X = [-1.1, 1.1]^2 x [-pi, pi]; U, their failure set, is the disc of
    radius 0.5 m around the origin. Their data says which frames are failures and where a trajectory ended because the
    car left; leaving is safe. So S are the states whose next step leaves X, whatever is done: the last frame before
    the border, and no more.

    The picture is theirs: the outline of the disc, an arrow along the heading and a dot, as matplotlib draws them on a
    figure of one inch (the dot on whole pixels). They show their networks the heading as well; here there is only the picture, of two
    successive steps. Output keys: see ``SafetyEnv``.

    Args:
        batch_size: ``[n]`` cars, or ``[]`` for one.
        image_size: height and width of the frames.
        arrow_scale: length that one inverse unit is drawn with: the arrow of a step v dt is ``v dt / arrow_scale`` m long.
        arrow_width: width of the arrow's shaft, as a share of the frame.
        dot_area: area of the dot in square points, 1/72 of the frame each; 0: none.
        background, obstacle_colour, car_colour: RGB in [0, 1].
        horizon, initial_set, device, seed: as for ``DubinsEnv``.

    Raises ConfigError for a size that is not positive or a colour that is none. Source: the task and the picture are
    those of Nakamura, Peters, Bajcsy, *Generalizing Safety Beyond Collision-Avoidance via Latent-Space Reachability
    Analysis*, RSS 2025, and its public code; deviation: two stacked frames in place of one frame and the heading, any
    yaw rate in [-1.25, 1.25] in place of three.

    Example:
        >>> env = CMUDubinsEnv(batch_size=[2], seed=0)
        >>> env.dynamics(torch.tensor([[1.0, 1.0, 0.0]]), torch.tensor([[1.25]]))
        tensor([[1.0500, 1.0000, 0.0625]])
        >>> env.region(torch.tensor([[1.08, 0.0, 0.0], [1.08, 0.0, 3.1], [0.3, 0.0, 0.0]])).flatten()
        tensor([1, 0, 2])
        >>> env.observe(torch.tensor([[1.0, 1.0, 0.0]])).shape
        torch.Size([1, 6, 128, 128])
    """

    def __init__(
        self,
        batch_size: Sequence[int] = (1,),
        image_size: int = 128,
        *,
        arrow_scale: float = 0.18,
        arrow_width: float = 0.1,
        dot_area: float = 20.0,
        background: Colour = (1.0, 1.0, 1.0),
        obstacle_colour: Colour = (1.0, 0.0, 0.0),
        car_colour: Colour = (0.0, 0.0, 1.0),
        horizon: int | None = None,
        initial_set: Region | None = None,
        device: torch.device | str | None = None,
        seed: int | None = None,
    ) -> None:
        check_positive(arrow_scale=arrow_scale, arrow_width=arrow_width)
        if not isinstance(dot_area, (int, float)) or not 0 <= dot_area < math.inf:
            raise ConfigError(f"dot_area: expected a finite number >= 0, received {dot_area!r}.")
        super().__init__(
            batch_size, YAW_RATE, speed=SPEED, dt=STEP, image_size=image_size, arena_half_size=ARENA,
            safe_half_size=ARENA - SPEED * STEP, unsafe_half_size=FAILURE, obstacle_half_size=FAILURE,
            obstacle_shape="disc", horizon=horizon, initial_set=initial_set, device=device, seed=seed,
        )  # fmt: skip
        self.safe_set, self.half_view = Difference(self.safe_set, Stays(ARENA, SPEED * STEP)), ARENA
        self.arrow_scale, self.arrow_width, self.dot_area = float(arrow_scale), float(arrow_width), float(dot_area)
        self.background, self.obstacle_colour = _colour("background", background), _colour("obstacle_colour", obstacle_colour)
        self.car_colour = _colour("car_colour", car_colour)
        _ = self._picture

    @functools.cached_property
    def _picture(self) -> _Picture:
        return _Picture(self)

    @property
    def system(self) -> System:
        """Place, heading, yaw rate, and what an agent has to reach."""
        return System(
            title="Dubins car from pixels, as latent safety filters see it",
            state_names=("x [m]", "y [m]", "heading [rad]"),
            action_name="yaw rate [rad/s]",
            requirements=_REQUIREMENTS,
            state_grid=(51, 51, 51),
            kernel_grid=(101, 101, 100),
            unsafe_grid=(61, 61, 36),
            notes=("A grid of 51 nodes per coordinate resolves the border of the true kernel to about 1 % of the states.",),
        )

    def known_twin(self) -> CMUDubinsEnv:
        """The car itself: its true kernel is computed."""
        return self

    def physics(self) -> Callable[[], gymnasium.Env] | None:
        """None: the benchmark has no other physics."""
        return None

    def draw(self, state: Tensor) -> Tensor:
        """RGB frames of states, ``(*batch, 3) -> uint8 (*batch, 3, H, W)``."""
        check_tensor("state", state, self.state_dim)
        flat = state.detach().reshape(-1, 3).to(self.device, torch.float32)
        frames = torch.cat([self._picture(part) for part in flat.split(_CHUNK)]) if len(flat) else self._picture.empty[:0]
        return frames.reshape(*state.shape[:-1], *frames.shape[1:])


def _colour(name: str, value: Colour) -> tuple[float, float, float]:
    colour = numbers(value)
    if len(colour) != 3 or not all(0 <= v <= 1 for v in colour):
        raise ConfigError(f"{name}: expected red, green and blue in [0, 1], received {value!r}.")
    return colour  # type: ignore[return-value]


class _Picture:
    """Frames of a car, from shares of covered pixels; lengths are in pixels, rows count downwards."""

    def __init__(self, env: CMUDubinsEnv) -> None:
        self.size, self.device = env.image_size, env.device
        self._per_metre = self.size / (2 * ARENA)
        self._car = self._tint(env.car_colour)
        ring = _disc(self.size, (self.size / 2, self.size / 2), FAILURE * self._per_metre + self.size * _LINE / 2)
        ring -= _disc(self.size, (self.size / 2, self.size / 2), FAILURE * self._per_metre - self.size * _LINE / 2)
        self.empty = _blend(self._tint(env.background), self._tint(env.obstacle_colour), ring.to(self.device))[None]
        # An arrow shorter than five widths of its shaft is drawn smaller as a whole: its head begins at its tail.
        length, width = SPEED * STEP / env.arrow_scale * self._per_metre, env.arrow_width * self.size
        shrink = min(1.0, length / (5 * width))
        tip, shaft, head = length, width * shrink / 2, 1.5 * width * shrink
        neck, back = length - 4.5 * width * shrink, length - 5 * width * shrink
        # The outline is a triangle without two notches at its back, and the shaft.
        self._whole = self._corners([(back, -head), (tip, 0.0), (back, head)])
        self._notches = [self._corners([(back, s * head), (back, 0.0), (neck, 0.0), (neck, s * shaft)][:: int(s)]) for s in (1.0, -1.0)]
        self._tail = self._corners([(0.0, -shaft), (neck, -shaft), (neck, shaft), (0.0, shaft)])
        radius = (math.sqrt(env.dot_area) / 2 + 0.5) * _POINT * self.size if env.dot_area else 0.0
        side = 2 * (math.ceil(radius) + 1) + 1
        # A dot is drawn once and put on whole pixels.
        self._dot = _disc(side, (side / 2, side / 2), radius).to(self.device)
        reach = max(math.hypot(back, head), tip, side / 2) + 1
        self._window = min(self.size, 2 * math.ceil(reach) + 2)

    def _tint(self, colour: Sequence[float]) -> Tensor:
        return torch.tensor(colour, device=self.device)[:, None, None] * 255.0

    def _corners(self, points: list[tuple[float, float]]) -> Tensor:
        return torch.tensor(points, device=self.device)

    def __call__(self, state: Tensor) -> Tensor:
        """Frames uint8 ``(n, 3, size, size)`` of states ``(n, 3)``."""
        size, window = self.size, self._window
        place = torch.stack([state[:, 0], -state[:, 1]], -1) * self._per_metre + size / 2
        corner = (place - window / 2).round().clamp(0, size - window).long()
        covered = self._arrow(place - corner, state[:, 2])
        covered = 1 - (1 - covered) * (1 - self._dots(place, corner))
        pixels = torch.arange(window, device=self.device)
        index = (corner[:, 1, None] + pixels)[:, :, None] * size + (corner[:, 0, None] + pixels)[:, None, :]
        index = index.flatten(1)[:, None].expand(-1, 3, -1)
        frames = self.empty.expand(len(state), 3, size, size).flatten(2)
        drawn = _blend(frames.gather(2, index).float().unflatten(-1, (window, window)), self._car, covered[:, None])
        return frames.clone().scatter_(2, index, drawn.flatten(2)).unflatten(-1, (size, size))

    def _dots(self, place: Tensor, corner: Tensor) -> Tensor:
        """Shares ``(n, window, window)`` covered by the dots."""
        side, window = len(self._dot), self._window
        first = (place + 0.5).floor().long() - side // 2 - corner
        steps = torch.arange(window, device=self.device)
        column, row = steps - first[:, :1], steps - first[:, 1:]
        inside = ((column >= 0) & (column < side))[:, None, :] & ((row >= 0) & (row < side))[:, :, None]
        value = self._dot[row.clamp(0, side - 1)[:, :, None], column.clamp(0, side - 1)[:, None, :]]
        return value * inside

    def _arrow(self, place: Tensor, heading: Tensor) -> Tensor:
        """Shares ``(n, window, window)`` covered by the arrows of cars at ``(n, 2)``."""
        covered = self._polygon(self._whole, place, heading)
        for notch in self._notches:
            covered = covered - self._polygon(notch, place, heading)
        if float(self._tail[1, 0]) > 0:
            covered = covered + self._polygon(self._tail, place, heading)
        return covered.clamp(0, 1)

    def _polygon(self, corners: Tensor, place: Tensor, heading: Tensor) -> Tensor:
        """Shares of pixels that a convex polygon covers: exact along rows, ``_LINES`` rows per pixel."""
        ahead = torch.stack([heading.cos(), -heading.sin()], -1)[:, None]
        aside = torch.stack([heading.sin(), heading.cos()], -1)[:, None]
        point = place[:, None] + corners[:, :1] * ahead - corners[:, 1:] * aside
        edge = point.roll(-1, 1) - point
        height = (torch.arange(self._window * _LINES, device=self.device) + 0.5) / _LINES
        # Where a row crosses the line of an edge; an edge that goes up bounds the polygon on one side, one that goes down on the other.
        slope = torch.where(edge[..., 1].abs() < 1e-4, 1e-4, edge[..., 1])
        share = (height - point[..., 1:]) / slope[..., None]
        met = (share >= 0) & (share <= 1)
        cross = point[..., :1] + share * edge[..., :1]
        left = torch.where(met, cross, math.inf).amin(1)
        right = torch.where(met, cross, -math.inf).amax(1)
        column = torch.arange(self._window, device=self.device)
        extent = torch.minimum(right[..., None], column + 1).sub_(torch.maximum(left[..., None], column)).clamp_(0, 1)
        return extent.unflatten(1, (self._window, _LINES)).mean(2)


def _blend(below: Tensor, above: Tensor, share: Tensor) -> Tensor:
    return (below + (above - below) * share).round().clamp(0, 255).to(torch.uint8)


def _disc(size: int, centre: tuple[float, float], radius: float, samples: int = 16) -> Tensor:
    """Shares of pixels ``(size, size)`` that a disc covers."""
    fine = (torch.arange(size * samples) + 0.5) / samples
    inside = (fine[:, None] - centre[1]).square() + (fine - centre[0]).square() <= radius**2
    return inside.float().unflatten(1, (size, samples)).mean(2).unflatten(0, (size, samples)).mean(1)
