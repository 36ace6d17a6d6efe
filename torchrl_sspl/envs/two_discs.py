"""The Dubins car between two discs on which a latent control barrier function reports its filter (Nakamura et al., L4DC 2026)."""

from __future__ import annotations

import math
from collections.abc import Sequence
from functools import cached_property, partial

import torch
from torch import Tensor

from torchrl_sspl.envs.base import SafetyEnv, check_tensor, wrapped
from torchrl_sspl.envs.cmu_dubins import Stays
from torchrl_sspl.envs.dubins import Disc, ThereAndBack
from torchrl_sspl.envs.system import Opening, Requirement, System
from torchrl_sspl.errors import ConfigError
from torchrl_sspl.sets import SAFE, Box, Region, Union

ARENA, SPEED, STEP, YAW_RATE = 1.5, 1.0, 0.05, 2.0
DISCS, RADIUS = ((0.25, 0.65), (0.25, -0.65)), 0.5
GOAL, GOAL_SPREAD, GOAL_RADIUS, REACHED = 1.3, 0.6, 0.05, 0.2
_SCALE = 4  # pixels that are drawn for each of the picture
_LOBES = 3  # of the Lanczos kernel
_TIP, _HALF = 10 / 128, 3 / 128  # length and half width of the car, of the frame
_LINE = 0.4  # of the larger pixels, by which what is drawn covers more than its outline
_AT_ONCE = 64  # frames
_REQUIREMENTS = (
    Requirement("volume_over_kernel", "volume of {B <= 0} over the true kernel", ">=", 0.80, 0.95),
    Requirement("unsafe_called_safe", "grid of U with B <= 0", "<=", 0.0, 0.0),
    Requirement("safe_rollouts_touch_unsafe", "episodes from {B <= 0} that enter U", "<=", 0.001, 0.0),
)


class CMUTwoDiscsEnv(SafetyEnv):
    r"""A Dubins car that has to get between two discs, or around them, to a goal, as CMU's latent control barrier function sees it.

    With position (x, y), heading theta, the height g of the goal and the yaw rate u, one step of dt = 0.05 s is exact to fourth order,

        x' = x + v dt / 6 (cos theta + 4 cos(theta + u dt / 2) + cos(theta + u dt)),    theta' = theta + u dt,    g' = g

    and the same of y with the sine, with v = 1 m/s and |u| <= 2 rad/s. X = [-1.5, 1.5]^2 x [-pi, pi] x [-0.6, 0.6]; U, the collisions, are
    the discs of radius 0.5 m around (0.25, 0.65) and (0.25, -0.65), with a gap of 0.3 m between them. Leaving X ends an episode, without a
    collision, and counts as safe; S are the states whose next step straight ahead ends more than 2.5 mm outside X, by which a yaw rate can
    bend it at most: some of those whose next step leaves X, whatever is done. The goal lies at (1.3, g); it is drawn, stays where it is,
    and has no part in what is safe. :meth:`reached` says whether a car is there.

    The picture is theirs: filled discs, a dot for the goal and a comet for the car, drawn at four times the size and
    reduced by the Lanczos kernel in two passes, as Pillow does. They show their networks the heading as well; here there is only the
    picture, of two successive steps. Output keys: see ``SafetyEnv``.

    Args:
        batch_size: ``[n]`` cars, or ``[]`` for one.
        image_size: height and width of the frames.
        horizon, initial_set, device, seed: as for ``SafetyEnv``.

    Raises ConfigError for a size of pictures that is not a positive integer. Source: the task and the picture are those of the
    public code of Nakamura et al., L4DC 2026 (arXiv 2511.18606); deviation: two stacked frames in place of one frame and the heading.

    Example:
        >>> env = CMUTwoDiscsEnv(batch_size=[2], seed=0)
        >>> env.dynamics(torch.tensor([[0.0, 0.0, 0.0, 0.3]]), torch.tensor([[0.0]]))
        tensor([[0.0500, 0.0000, 0.0000, 0.3000]])
        >>> env.region(torch.tensor([[0.25, 0.2, 0.0, 0.0], [0.25, 0.0, 0.0, 0.0], [1.49, 0.0, 0.0, 0.0]])).flatten()
        tensor([2, 0, 1])
        >>> env.observe(torch.tensor([[0.0, 0.0, 0.0, 0.3]])).shape
        torch.Size([1, 6, 128, 128])
    """

    dt = STEP

    def __init__(
        self,
        batch_size: Sequence[int] = (1,),
        image_size: int = 128,
        *,
        horizon: int | None = None,
        initial_set: Region | None = None,
        device: torch.device | str | None = None,
        seed: int | None = None,
    ) -> None:
        if not isinstance(image_size, int) or image_size < 1:
            raise ConfigError(f"image_size: expected an integer >= 1, received {image_size!r}.")
        rest = Box([-math.pi, -GOAL_SPREAD], [math.pi, GOAL_SPREAD], period=[2 * math.pi, 0.0])
        low, high, period = [-ARENA, -ARENA, -math.pi, -GOAL_SPREAD], [ARENA, ARENA, math.pi, GOAL_SPREAD], [0.0, 0.0, 2 * math.pi, 0.0]
        space = Box(low, high, period=period)
        step = SPEED * STEP
        swerve = step * STEP * YAW_RATE / 2  # by which the shift of a step differs from one straight ahead, at most
        super().__init__(
            state_dim=4, action_dim=1, max_action=YAW_RATE,
            safe_set=space - Stays(ARENA + swerve, step, dim=4), unsafe_set=Union(*(Disc(centre, RADIUS, rest) for centre in DISCS)),
            state_space=space, exit_region=SAFE, initial_set=initial_set,
            batch_size=batch_size, image_size=image_size, horizon=horizon, device=device, seed=seed,
        )  # fmt: skip

    @property
    def system(self) -> System:
        """Place, heading, height of the goal, yaw rate, and what an agent has to reach."""
        return System(
            title="Dubins car between two discs, as latent safety filters see it",
            state_names=("x [m]", "y [m]", "heading [rad]", "height of the goal [m]"),
            action_name="yaw rate [rad/s]",
            requirements=_REQUIREMENTS,
            state_grid=(61, 61, 37, 3),
            kernel_grid=(101, 101, 72, 2),
            unsafe_grid=(61, 61, 36, 3),
            openings=tuple(
                Opening(title, (*start, goal), partial(ThereAndBack, [(GOAL, goal)], YAW_RATE))
                for title, start, goal in (
                    ("A goal behind the upper disc", (-1.2, 0.65, 0.0), 0.5),
                    ("A goal behind the gap", (-1.2, -0.25, 0.0), 0.0),
                    ("Between disc and border", (-1.2, -1.0, 0.0), -0.6),
                )
            ),
            notes=("The gap between the discs is 0.3 m wide: on the grid of the true kernel ten nodes.",),
        )

    @staticmethod
    def reached(state: Tensor) -> Tensor:
        """Whether cars ``(*batch, 4)`` are within 0.2 m of their goals, ``(*batch,)``."""
        check_tensor("state", state, 4)
        return (state[..., 0] - GOAL).hypot(state[..., 1] - state[..., 3]) <= REACHED

    def dynamics(self, state: Tensor, action: Tensor) -> Tensor:
        """Next state ``(*batch, 4)`` by the formula in the class docstring, not wrapped; the yaw rate ``(*batch, 1)`` is clamped."""
        check_tensor("state", state, self.state_dim)
        turn = STEP * self.clamp_action(action)
        heading = state[..., 2:3] + turn * torch.tensor([0.0, 0.5, 1.0], device=state.device)
        weight = torch.tensor([1.0, 4.0, 1.0], device=state.device) / 6
        moved = SPEED * STEP * torch.stack([heading.cos() @ weight, heading.sin() @ weight], -1)
        return torch.cat([state[..., :2] + moved, heading[..., 2:], state[..., 3:]], -1)

    def wrap(self, state: Tensor) -> Tensor:
        """State with its heading in [-pi, pi), same shape."""
        heading = wrapped(state[..., 2:3])
        return torch.cat([state[..., :2], heading, state[..., 3:]], -1)

    def previous_state(self, state: Tensor) -> Tensor:
        """State one step earlier of a car that was driving straight on, same shape."""
        check_tensor("state", state, self.state_dim)
        heading = state[..., 2:3]
        before = state[..., :2] - SPEED * STEP * torch.cat([heading.cos(), heading.sin()], -1)
        return torch.cat([before, state[..., 2:]], -1)

    def draw(self, state: Tensor) -> Tensor:
        """RGB frames of states, ``(*batch, 4) -> uint8 (*batch, 3, H, W)``."""
        check_tensor("state", state, self.state_dim)
        flat = state.reshape(-1, 4)
        parts = [self._picture(part) for part in flat.split(_AT_ONCE)]
        size = self.image_size
        frames = torch.cat(parts) if parts else torch.zeros(0, 3, size, size, dtype=torch.uint8, device=state.device)
        return frames.reshape(*state.shape[:-1], 3, size, size)

    @cached_property
    def _picture(self) -> _Picture:
        return _Picture(self.image_size, self.device)


class _Picture:
    """Frames of cars, drawn at ``_SCALE`` times their size and reduced; lengths are in the larger pixels, rows count downwards."""

    def __init__(self, size: int, device: torch.device | None) -> None:
        self.size, self.device, self._fine = size, device, size * _SCALE
        self._per_metre = self._fine / (2 * ARENA)
        self._reduce = _lanczos(size).to(device)
        self._red = torch.zeros(self._fine, self._fine, dtype=torch.bool, device=device)
        for place in DISCS:
            self._red |= self._disc(self._pixel(torch.tensor([place], device=device)), RADIUS, self._fine)[0]
        nothing = torch.zeros(1, self._fine, self._fine, dtype=torch.bool, device=device)
        self._empty = self._reduced(self._coloured(nothing, nothing, self._red[None]), self._reduce, self._reduce)[0]
        self._window = min(size, 2 * (math.ceil((_TIP + _HALF) / 2 * size) + _LOBES + 1))
        self._goals()

    def _goals(self) -> None:
        """Strips of the frame with the goal, of all whole pixels at which it lies."""
        column, low = self._pixel(torch.tensor([[GOAL, -GOAL_SPREAD]], device=self.device))[0].tolist()
        _, self._first = self._pixel(torch.tensor([[GOAL, GOAL_SPREAD]], device=self.device))[0].long().tolist()
        rows = torch.arange(self._first, low + 1, device=self.device)
        reach = math.ceil(GOAL_RADIUS * self._per_metre / _SCALE) + _LOBES + 1
        self._strip = slice(max(0, int(column) // _SCALE - reach), min(self.size, int(column) // _SCALE + reach + 1))
        columns = slice(max(0, (self._strip.start - _LOBES) * _SCALE), (self._strip.stop + _LOBES) * _SCALE)
        parts = []
        for some in rows.split(_AT_ONCE):
            goal = self._disc(torch.stack([torch.full_like(some, int(column)), some], -1), GOAL_RADIUS, self._fine)[..., columns]
            fine = self._coloured(torch.zeros_like(goal), goal, self._red[:, columns])
            parts.append(self._reduced(fine, self._reduce, self._reduce[self._strip, columns]))
        self._with_goal = torch.cat(parts)

    @staticmethod
    def _coloured(car: Tensor, goal: Tensor, red: Tensor) -> Tensor:
        """Larger pictures ``(n, 3, h, w)`` in [0, 255] of what every pixel shows, ``(n, h, w)`` bool: a blue car, a green goal, red discs, white."""
        plain = ~(red | goal | car)
        return torch.stack([~(goal | car) * 255.0, plain * 255.0 + (goal & ~car) * 128.0, (plain | car) * 255.0], 1)

    def _pixel(self, place: Tensor) -> Tensor:
        """Whole pixels ``(n, 2)``, column and row, of places ``(n, 2)`` in m."""
        return (torch.stack([place[:, 0] + ARENA, ARENA - place[:, 1]], -1) * self._per_metre).trunc()

    def _disc(self, centre: Tensor, radius: float, side: int) -> Tensor:
        """Pixels ``(n, side, side)`` of discs of a radius in m around pixels ``(n, 2)``; Pillow's box of them has whole corners."""
        low, high = math.floor(-radius * self._per_metre), math.floor(radius * self._per_metre)
        off = torch.arange(side, device=self.device) - (low + high) / 2 - centre[..., None]
        square = off.square()
        return square[:, 0, None, :] <= (((high - low + 1) / 2) ** 2 - square[:, 1])[:, :, None]

    def _comet(self, centre: Tensor, ahead: Tensor, side: int) -> Tensor:
        """Pixels ``(n, side, side)`` of cars at pixels ``(n, 2)``: a triangle with whole corners ahead, half a disc behind."""
        half, tip = _HALF * self._fine, _TIP * self._fine
        aside = torch.stack([-ahead[:, 1], ahead[:, 0]], -1)
        corner = (torch.stack([tip * ahead, half * aside, -half * aside], 1) + centre[:, None]).trunc() - centre[:, None]
        across, down = (torch.arange(side, device=self.device) - centre[..., None]).unbind(1)
        edge = corner.roll(-1, 1) - corner
        outwards = torch.stack([edge[..., 1], -edge[..., 0]], -1)
        outwards = outwards / outwards.norm(dim=-1, keepdim=True)
        most = (outwards * corner).sum(-1) + _LINE
        comet = torch.ones((), dtype=torch.bool, device=self.device)
        for k in range(3):
            comet = comet & ((outwards[:, k, :1] * across)[:, None, :] <= (most[:, k, None] - outwards[:, k, 1:] * down)[:, :, None])
        behind = (ahead[:, :1] * across)[:, None, :] <= (_LINE - ahead[:, 1:] * down)[:, :, None]
        disc = across.square()[:, None, :] <= ((half + _LINE) ** 2 - down.square())[:, :, None]
        return comet | (behind & disc)

    def __call__(self, state: Tensor) -> Tensor:
        """Frames uint8 ``(n, 3, size, size)`` of states ``(n, 4)``."""
        size, window, side = self.size, self._window, (self._window + 2 * _LOBES) * _SCALE
        goal = self._pixel(torch.stack([torch.full_like(state[:, 3], GOAL), state[:, 3]], -1))
        frames = self._empty.expand(len(state), -1, -1, -1).clone()
        frames[..., self._strip] = self._with_goal[(goal[:, 1].long() - self._first).clamp(0, len(self._with_goal) - 1)]
        car = self._pixel(state[:, :2])
        ahead = torch.stack([state[:, 2].cos(), -state[:, 2].sin()], -1)
        middle = (car + (_TIP - _HALF) / 2 * self._fine * ahead) / _SCALE
        corner = (middle - window / 2).round().clamp(0, size - window).long()
        begin, steps = (corner - _LOBES) * _SCALE, torch.arange(side, device=self.device)
        inside = (begin[..., None] + steps).clamp(0, self._fine - 1)
        red = self._red[inside[:, 1, :, None], inside[:, 0, None, :]]
        shown = torch.zeros_like(red)
        near = ((goal - begin - side / 2).abs().amax(1) < side).nonzero()[:, 0]
        shown[near] = self._disc((goal - begin)[near], GOAL_RADIUS, side)
        fine = self._coloured(self._comet(car - begin, ahead, side), shown, red)
        index = corner[..., None] + torch.arange(window, device=self.device)
        drawn = self._reduced(fine, self._rows(index[:, 1], begin[:, 1], side), self._rows(index[:, 0], begin[:, 0], side))
        flat = (index[:, 1, :, None] * size + index[:, 0, None, :]).flatten(1)[:, None].expand(-1, 3, -1)
        frames.flatten(2).scatter_(2, flat, drawn.flatten(2))
        return frames

    def _rows(self, row: Tensor, begin: Tensor, side: int) -> Tensor:
        """Weights ``(n, window, side)`` of pixels of a picture in the larger ones from ``begin`` on."""
        column = begin[:, None] + torch.arange(side, device=self.device)
        weight = self._reduce[row[:, :, None], column.clamp(0, self._fine - 1)[:, None, :]]
        return weight * ((column >= 0) & (column < self._fine))[:, None, :]

    @staticmethod
    def _reduced(fine: Tensor, rows: Tensor, columns: Tensor) -> Tensor:
        """Pictures uint8 of larger ones ``(n, 3, H, W)``: along rows first, then along columns, whole grey levels after each."""
        wide = _levels(fine @ columns.mT.unsqueeze(-3))
        return _levels(rows.unsqueeze(-3) @ wide).to(torch.uint8)


def _levels(value: Tensor) -> Tensor:
    return (value + 0.5).floor().clamp(0, 255)


def _lanczos(size: int) -> Tensor:
    """Weights ``(size, _SCALE size)`` of the Lanczos kernel that reduces a row of pixels."""
    fine = torch.arange(size * _SCALE, dtype=torch.float64) + 0.5
    off = (fine - (torch.arange(size, dtype=torch.float64)[:, None] + 0.5) * _SCALE) / _SCALE
    weight = torch.where(off.abs() < _LOBES, torch.sinc(off) * torch.sinc(off / _LOBES), 0.0)
    return (weight / weight.sum(1, keepdim=True)).float()


__all__ = ["ARENA", "DISCS", "GOAL", "RADIUS", "CMUTwoDiscsEnv"]
