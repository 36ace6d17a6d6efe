"""Pictures that methods are asked about: drawn once for all of them, and as another camera would show them."""

from __future__ import annotations

import functools
from collections import OrderedDict
from collections.abc import Callable, Sequence
from hashlib import sha256
from typing import Any

import torch
from torch import Tensor

from torchrl_sspl.baselines.data import POOL, pooled
from torchrl_sspl.envs.base import SafetyEnv
from torchrl_sspl.envs.cmu_dubins import CMUDubinsEnv
from torchrl_sspl.envs.dubins import DubinsEnv
from torchrl_sspl.envs.pendulum import PixelPendulumEnv
from torchrl_sspl.envs.quadruped.camera import HALF_VIEW
from torchrl_sspl.evaluation.measurements import Draw
from torchrl_sspl.runtime.faults import CameraFault

_WHITE, _CYAN, _MAGENTA, _BLUE = (255, 255, 255), (0, 255, 255), (255, 0, 255), (77, 77, 204)
_ROD, _OBSTACLE = (204, 77, 77), (216, 38, 38)
#: Half a rod before white is half white: the largest difference of their colours.
_BLEND = 178
_NEAR = 60  # of the obstacle's colour; whatever is on the robot is farther
_HALF_SIDE, _MIDDLE = 0.3, (0.0, 0.0)  # m, of the obstacle in PyBullet's world
_ROWS = 500  # pictures at a time


def recoloured(frames: Tensor, old: tuple[int, int, int], new: tuple[int, int, int], reach: float) -> Tensor:
    r"""Frames uint8 ``(n, 3, H, W)`` in which one colour is another one, and what is mixed with it as much as it is mixed.

    .. math:: x' = x + w\,(c_{new} - c_{old}), \qquad w = [1 - \max_k |x_k - c_{old,k}| / r]_+

    with the reach r in grey levels. Source: none.

    Example:
        >>> recoloured(torch.full((1, 3, 1, 1), 255, dtype=torch.uint8), (255, 255, 255), (0, 255, 255), 100).flatten().tolist()
        [0, 255, 255]
    """
    a, b = (torch.tensor(c, dtype=torch.float32)[:, None, None] for c in (old, new))
    parts = []
    for part in frames.split(64):
        x = part.float()
        weight = (1 - (x - a).abs().amax(1, keepdim=True) / reach).clamp_min(0)
        parts.append((x + weight * (b - a)).round().clamp(0, 255).to(torch.uint8))
    return torch.cat(parts)


def shifts(env: SafetyEnv) -> dict[str, Draw]:
    """Other pictures of a system by name, states ``(n, s)`` -> frames uint8 ``(n, 3, H, W)``.

    ``dark`` and ``bright``: a camera of 0.85 and 1.15 times the brightness. Of the pendulum and the Dubins cars with one obstacle also
    ``background``: cyan in place of white, and ``object``: the rod blue, the obstacle magenta; ``renderer``: gymnasium's own of the
    pendulum, PyBullet's of the car with a square obstacle, where that and the view have their default sizes. Source: none; colours as in LatentSafe's own shifts.

    Example:
        >>> sorted(shifts(PixelPendulumEnv()))
        ['background', 'bright', 'dark', 'object', 'renderer']
    """
    def faulty(name: str, strength: float) -> Draw:
        def draw(state: Tensor) -> Tensor:
            frame = env.draw(state)
            return CameraFault(name, strength, onset=0)(torch.cat([frame, frame], 1), 0)[:, 3:]

        return draw

    found = {"dark": faulty("dark", 0.85), "bright": faulty("bright", 1.15)}
    white, blend = _WHITE, _BLEND
    if isinstance(env, PixelPendulumEnv):
        found["renderer"] = env.renderers()["gymnasium"]
        old, new, reach = _ROD, _BLUE, _BLEND
    elif isinstance(env, CMUDubinsEnv):  # of pure colours
        white, old = _grey_levels(env.background), _grey_levels(env.obstacle_colour)
        new, reach, blend = _MAGENTA, 255, 255
    elif isinstance(env, DubinsEnv) and env.obstacle_shape == "square" and env.yaw_lag is None:
        if (env.half_view, env.obstacle_half_size, tuple(env.obstacle_centre)) == (HALF_VIEW, _HALF_SIDE, _MIDDLE):  # of the one world that there is
            found["renderer"] = functools.partial(_bullet, env)
        old, new, reach = _OBSTACLE, _MAGENTA, _NEAR
    else:
        return found
    return found | {
        "background": lambda state: recoloured(env.draw(state), white, _CYAN, blend),
        "object": lambda state: recoloured(env.draw(state), old, new, reach),
    }


def _grey_levels(colour: Sequence[float]) -> tuple[int, int, int]:
    red, green, blue = (round(255 * c) for c in colour)
    return red, green, blue


def _bullet(env: Any, state: Tensor) -> Tensor:
    return _bullet_renderer(env.image_size)(state[:, :3], env.gait_phase(state))


@functools.lru_cache(maxsize=2)
def _bullet_renderer(size: int) -> Callable[[Tensor, Tensor], Tensor]:
    """One world of PyBullet, made when it is first asked for; it takes the system's default sizes."""
    from torchrl_sspl.envs.quadruped.sprites import BulletRenderer

    return BulletRenderer(size)


class Album:
    """Observations of a system, two frames each, that several methods are asked about: kept when they have been drawn.

    Args:
        env: the system.
        limit: bytes of pictures that are kept; what is larger, or has not been asked for the longest time, is drawn again.

    Example:
        >>> album, state = Album(PixelPendulumEnv()), torch.zeros(3, 2)
        >>> [part.shape for part in album(state)], album.drawn
        ([torch.Size([3, 6, 32, 32])], 3)
        >>> [len(part) for part in album(state)], album.drawn
        ([3], 3)
    """

    def __init__(self, env: SafetyEnv, limit: int = 512 << 20) -> None:
        self.env, self.limit, self.drawn = env, limit, 0
        self._kept: OrderedDict[tuple[str, int | None, bytes], list[Tensor]] = OrderedDict()

    def __call__(self, state: Tensor, shift: str = "", *, size: int | None = POOL) -> Any:
        """Observations uint8 ``(k, 6, H, W)`` of states ``(n, s)``, some at a time, averaged to a ``size``; None: as they are."""
        key = (shift, size, sha256(state.contiguous().numpy().tobytes()).digest())
        if key in self._kept:
            self._kept.move_to_end(key)
            yield from self._kept[key]
            return
        kept: list[Tensor] = []
        held = 0
        for part in state.split(_ROWS):
            seen = self._draw(part, shift, size)
            held += seen.nbytes
            kept = [*kept, seen] if held <= self.limit else []
            yield seen
        if held <= self.limit:
            self._kept[key] = kept
            while sum(t.nbytes for parts in self._kept.values() for t in parts) > self.limit:
                self._kept.popitem(last=False)

    def _draw(self, state: Tensor, shift: str, size: int | None) -> Tensor:
        draw = shifts(self.env)[shift] if shift else self.env.draw
        self.drawn += len(state)
        frames = [draw(x) for x in (self.env.previous_state(state), state)]
        return torch.cat(frames if size is None else [pooled(f, size) for f in frames], 1)


__all__ = ["Album", "recoloured", "shifts"]
