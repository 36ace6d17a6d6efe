"""The camera above the arena, for PyBullet and for pictures that are drawn without it."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from numpy.typing import NDArray

from torchrl_sspl.errors import ConfigError, SSPLError

CAMERA_HEIGHT = 20.0
"""In m. A far camera stands for a parallel projection, which PyBullet's software renderer draws blank."""
HALF_VIEW = 2.4
"""What the frame shows of the ground in each direction from its middle, in m."""
SUPERSAMPLE = 2
"""Frames are drawn this many times larger and area-averaged."""

_LIGHT: dict[str, Any] = {
    # From above: brightness then depends on the tilt of a surface alone, not on where the robot heads.
    "lightDirection": [0.0, 0.0, 1.0],
    "lightColor": [1.0, 1.0, 1.0],
    "lightAmbientCoeff": 0.6,
    "lightDiffuseCoeff": 0.4,
    "lightSpecularCoeff": 0.0,
    "shadow": 0,
}


class RenderError(SSPLError, RuntimeError):
    """A frame does not show what it must show."""


class TopCamera:
    """Frames of a PyBullet world from far above, x to the right and y up.

    Args:
        client: PyBullet client.
        image_size: height and width of the frames, in pixels.
        half_view: distance from the middle of the frame to its edge, on the ground, in m.
        centre: what lies in the middle of the frame, (x, y) in m.
        height: of the camera, in m.
        supersample: how many times larger a frame is drawn before it is area-averaged.

    Raises:
        ConfigError: the image size is not at least 8.

    Source: paper, Section IV-B (top view of the x-y plane, 128 x 128 RGB). Deviation: none.
    """

    def __init__(
        self,
        client: Any,
        image_size: int = 128,
        *,
        half_view: float = HALF_VIEW,
        centre: tuple[float, float] = (0.0, 0.0),
        height: float = CAMERA_HEIGHT,
        supersample: int = SUPERSAMPLE,
    ) -> None:
        if not isinstance(image_size, int) or image_size < 8:
            raise ConfigError(f"image_size: expected an integer >= 8, received {image_size!r}.")
        self.client, self.image_size, self.supersample, self._height = client, image_size, supersample, height
        x, y = centre
        self._view = client.computeViewMatrix([x, y, height], [x, y, 0.0], [0.0, 1.0, 0.0])
        angle = 2 * math.degrees(math.atan(half_view / height))
        self._projection = client.computeProjectionMatrixFOV(angle, 1.0, 0.75 * height, 1.25 * height)

    def capture(self, robot: int | None = None) -> NDArray[np.uint8]:
        """Draw a frame.

        Args:
            robot: body that must be seen; None: nothing needs to.

        Returns:
            uint8 ``(image_size, image_size, 3)``.

        Raises:
            RenderError: the robot is not in the frame.
        """
        size = self.image_size * self.supersample
        colours, bodies = self.raw(size)
        if robot is not None and not (bodies == robot).any():
            raise RenderError(
                "camera: expected the robot in the frame, received a frame without it; it has left the view, or the "
                "renderer drew nothing."
            )
        if self.supersample == 1:
            return colours
        parts = colours.reshape(self.image_size, self.supersample, self.image_size, self.supersample, 3)
        total = parts.sum((1, 3), dtype=np.uint16)
        area = self.supersample**2
        return ((total + area // 2) // area).astype(np.uint8)

    def raw(self, size: int) -> tuple[NDArray[np.uint8], NDArray[np.int32]]:
        """Colours uint8 ``(size, size, 3)`` and body numbers ``(size, size)`` as the renderer draws them."""
        client = self.client
        _, _, colours, _, bodies = client.getCameraImage(
            size, size, self._view, self._projection, renderer=client.ER_TINY_RENDERER, **_LIGHT
        )
        colours = np.asarray(colours, dtype=np.uint8).reshape(size, size, 4)[..., :3]
        return colours, np.asarray(bodies, dtype=np.int32).reshape(size, size)

    def depth(self, size: int) -> NDArray[np.float64]:
        """Height above the ground of what each pixel shows, ``(size, size)`` in m; far below where it is nothing."""
        client = self.client
        near, far = 0.75 * self._height, 1.25 * self._height
        depth = client.getCameraImage(
            size, size, self._view, self._projection, renderer=client.ER_TINY_RENDERER, **_LIGHT
        )[3]
        depth = np.asarray(depth, dtype=np.float64).reshape(size, size)
        return self._height - far * near / (far - (far - near) * depth)


__all__ = ["CAMERA_HEIGHT", "HALF_VIEW", "SUPERSAMPLE", "RenderError", "TopCamera"]
