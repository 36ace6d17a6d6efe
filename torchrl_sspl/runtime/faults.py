"""Faults of a camera, for trying a monitor: what is captured, step by step, in place of what is there."""

from __future__ import annotations

import io
import math
from collections.abc import Callable
from typing import Any

import torch
from torch import Tensor
from torch.nn import functional as F

from torchrl_sspl.errors import ConfigError

_PART = 32  # frames that are floating point at a time

#: By name, three strengths of what the fault takes as its number: harmless, plain, severe.
FAULTS: dict[str, tuple[float, float, float]] = {
    "dark": (0.85, 0.4, 0.0),  # factor
    "bright": (1.15, 1.6, 3.0),  # factor
    "colour": (0.1, 0.5, 1.0),  # share of the way to exchanged red and blue
    "noise": (12.0, 40.0, 100.0),  # standard deviation, grey levels
    "salt": (0.005, 0.05, 0.3),  # share of pixels
    "blur": (3.0, 7.0, 15.0),  # width, pixels of 64
    "compressed": (60.0, 15.0, 2.0),  # JPEG quality
    "shifted": (1.0, 5.0, 16.0),  # pixels of 64
    "rotated": (1.0, 10.0, 45.0),  # degrees
    "covered": (0.1, 0.3, 0.6),  # share of the width, a square that stays
    "crossed": (0.1, 0.25, 0.5),  # share of the width, a bar that moves
    "doubled": (0.1, 0.5, 1.0),  # opacity of a mirrored second scene
    "frozen": (3.0, 20.0, math.inf),  # steps
    "repeated": (2.0, 4.0, 10.0),  # each frame is shown so often
    "dropped": (0.02, 0.2, 0.6),  # share of black frames
    "delayed": (1.0, 3.0, 8.0),  # steps
}


class CameraFault:
    """A camera with a fault from some step on: ``(pixels, t) -> pixels``, for n episodes side by side.

    A camera captures each frame once: the pictures that are returned are the frames captured at t-1 and t. Source: none.

    Args:
        name: one of :data:`FAULTS`.
        strength: its number.
        onset: first step with the fault.
        seed: of what is random.
        noise: standard deviation of the camera's own noise, grey levels, from the first step on.

    Raises:
        ConfigError: for another name, or a noise that is negative or not finite.

    Example:
        >>> fault = CameraFault("dark", 0.0, onset=1)
        >>> clean = torch.full((1, 6, 8, 8), 200, dtype=torch.uint8)
        >>> [int(fault(clean, t)[0, 5].amax()) for t in (0, 1, 2)]
        [200, 0, 0]
    """

    def __init__(self, name: str, strength: float, *, onset: int = 10, seed: int = 0, noise: float = 0.0) -> None:
        if name not in FAULTS:
            raise ConfigError(f"expected one of the faults {', '.join(FAULTS)}, received {name!r}")
        if not 0.0 <= noise < math.inf:
            raise ConfigError(f"expected a finite noise >= 0, received {noise}")
        self.name, self.strength, self.onset, self.noise = name, float(strength), onset, noise
        self.generator = torch.Generator().manual_seed(seed)
        self.history: list[Tensor] = []  # frames as they were, since the onset
        self.captured: Tensor | None = None

    def __call__(self, pixels: Tensor, t: int) -> Tensor:
        """Pictures ``(n, 6, H, W)`` uint8 of step t, as this camera captures them; t = 0 begins anew."""
        if t == 0 or self.captured is None or len(self.captured) != len(pixels):
            self.captured, self.history = self._own(pixels[:, :3]), []
        frame, before = self._own(pixels[:, 3:]), self.captured
        if t >= self.onset:
            if self.name in _IN_TIME:  # the others remember nothing, however long they run
                self.history.append(frame)
            frame = _IN_TIME[self.name](self, t - self.onset) if self.name in _IN_TIME else self._changed(frame, t)
        self.captured = frame
        return torch.cat([before, frame], 1)

    def _own(self, frame: Tensor) -> Tensor:
        """A frame with the camera's own noise."""
        if not self.noise:
            return frame
        return self._made(_noise, frame, self.noise, 0)

    def _changed(self, frame: Tensor, t: int) -> Tensor:
        """A frame changed by itself."""
        return self._made(_OF_A_FRAME[self.name], frame, self.strength, t)

    def _made(self, change: Callable[[Tensor, float, torch.Generator, int], Tensor], frames: Tensor, strength: float, t: int) -> Tensor:
        """Changed frames; of a few at a time, which stay in the cache."""
        parts = (change(part.float(), strength, self.generator, t) for part in frames.split(_PART))
        return torch.cat([part.round_().clamp_(0, 255).to(torch.uint8) for part in parts])


def _noise(x: Tensor, s: float, g: torch.Generator, t: int) -> Tensor:
    return x + s * torch.randn(x.shape, generator=g)


def _salt(x: Tensor, s: float, g: torch.Generator, t: int) -> Tensor:
    value = 255.0 * (torch.rand(x[:, :1].shape, generator=g) < 0.5)
    return torch.where(torch.rand(x[:, :1].shape, generator=g) < s, value, x)


def _blur(x: Tensor, s: float, g: torch.Generator, t: int) -> Tensor:
    k = max(1, round(s * x.shape[-1] / 64)) // 2 * 2 + 1
    return F.avg_pool2d(F.pad(x, (k // 2,) * 4, mode="replicate"), k, 1)


def _colour(x: Tensor, s: float, g: torch.Generator, t: int) -> Tensor:
    return torch.lerp(x, x.flip(1), s)


def _moved(x: Tensor, angle: float, shift: float) -> Tensor:
    """Rotated by degrees and shifted by pixels of 64; the border goes on."""
    c, s, by = math.cos(math.radians(angle)), math.sin(math.radians(angle)), 2 * shift / 64
    grid = F.affine_grid(torch.tensor([[c, -s, by], [s, c, by]]).expand(len(x), 2, 3), list(x.shape), align_corners=False)
    return F.grid_sample(x, grid, padding_mode="border", align_corners=False)


def _covered(x: Tensor, s: float, g: torch.Generator, t: int) -> Tensor:
    h, w = x.shape[-2:]
    made = x.clone()
    made[..., int(h * (1 - s) / 2) : int(h * (1 + s) / 2), int(w * (1 - s) / 2) : int(w * (1 + s) / 2)] = 90.0
    return made


def _crossed(x: Tensor, s: float, g: torch.Generator, t: int) -> Tensor:
    w, made = x.shape[-1], x.clone()
    left = int(w * ((0.03 * t) % 1.0))
    made[..., left : left + max(1, int(s * w))] = 90.0
    return made


def _compressed(x: Tensor, s: float, g: torch.Generator, t: int) -> Tensor:
    from PIL import Image

    rows = []
    for frame in x.to(torch.uint8).permute(0, 2, 3, 1).numpy():
        file = io.BytesIO()
        Image.fromarray(frame).save(file, "JPEG", quality=max(1, int(s)))
        rows.append(torch.tensor(list(Image.open(file).convert("RGB").tobytes()), dtype=torch.float32))
    return torch.stack(rows).reshape(len(x), *x.shape[2:], 3).permute(0, 3, 1, 2)


_OF_A_FRAME: dict[str, Callable[[Tensor, float, torch.Generator, int], Tensor]] = {
    "dark": lambda x, s, g, t: s * x,
    "bright": lambda x, s, g, t: s * x,
    "colour": _colour,
    "noise": _noise,
    "salt": _salt,
    "blur": _blur,
    "compressed": _compressed,
    "shifted": lambda x, s, g, t: _moved(x, 0.0, s),
    "rotated": lambda x, s, g, t: _moved(x, s, 0.0),
    "covered": _covered,
    "crossed": _crossed,
    "doubled": lambda x, s, g, t: torch.lerp(x, torch.minimum(x, x.flip(-1)), s),
}


def _dropped(camera: CameraFault, k: int) -> Tensor:
    lost = torch.rand(len(camera.history[-1]), 1, 1, 1, generator=camera.generator) < camera.strength
    return torch.where(lost, torch.zeros_like(camera.history[-1]), camera.history[-1])


#: Those that show frames of another time: (camera, steps since the onset) -> frame.
_IN_TIME: dict[str, Callable[[Any, int], Tensor]] = {
    "frozen": lambda camera, k: camera.history[0 if k < camera.strength else -1],
    "repeated": lambda camera, k: camera.history[k - k % int(camera.strength)],
    "delayed": lambda camera, k: camera.history[max(0, k - int(camera.strength))],
    "dropped": _dropped,
}

__all__ = ["FAULTS", "CameraFault"]
