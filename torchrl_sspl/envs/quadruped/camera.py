"""The camera above the arena, for PyBullet and for pictures that are drawn without it."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from numpy.typing import NDArray

from torchrl_sspl.errors import ConfigError, SSPLError

# In m. A far camera stands for a parallel projection, which PyBullet's software renderer draws blank.
CAMERA_HEIGHT = 20.0
HALF_VIEW = 2.4  # m, what the frame shows of the ground in each direction from its middle
SUPERSAMPLE = 2  # frames are drawn this many times larger and area-averaged
_NEAR, _FAR = 0.75 * CAMERA_HEIGHT, 1.25 * CAMERA_HEIGHT

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
    """Frames of a PyBullet world from far above, x to the right and y up, ``image_size`` pixels high and wide.

    ``half_view``: distance from the middle of the frame to its edge, on the ground, in m; ``centre``: what lies in the
    middle, (x, y) in m; ``supersample``: how many times larger a frame is drawn before it is area-averaged. Raises
    ConfigError unless the image size is at least 8. Source: paper, Section IV-B (top view of the x-y plane, 128 x 128
    RGB); deviation: none.
    """

    def __init__(
        self,
        client: Any,
        image_size: int = 128,
        *,
        half_view: float = HALF_VIEW,
        centre: tuple[float, float] = (0.0, 0.0),
        supersample: int = SUPERSAMPLE,
    ) -> None:
        if not isinstance(image_size, int) or image_size < 8:
            raise ConfigError(f"image_size: expected an integer >= 8, received {image_size!r}.")
        self.client, self.image_size, self.supersample = client, image_size, supersample
        x, y = centre
        self._view = client.computeViewMatrix([x, y, CAMERA_HEIGHT], [x, y, 0.0], [0.0, 1.0, 0.0])
        angle = 2 * math.degrees(math.atan(half_view / CAMERA_HEIGHT))
        self._projection = client.computeProjectionMatrixFOV(angle, 1.0, _NEAR, _FAR)

    def capture(self, robot: int | None = None) -> NDArray[np.uint8]:
        """Draw a frame, uint8 ``(image_size, image_size, 3)``; RenderError unless body ``robot`` is seen in it."""
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
        _, _, colours, _, bodies = self._image(size)
        colours = np.asarray(colours, dtype=np.uint8).reshape(size, size, 4)[..., :3]
        return colours, np.asarray(bodies, dtype=np.int32).reshape(size, size)

    def depth(self, size: int) -> NDArray[np.float64]:
        """Height above the ground of what each pixel shows, ``(size, size)`` in m; far below where it is nothing."""
        depth = np.asarray(self._image(size)[3], dtype=np.float64).reshape(size, size)
        return CAMERA_HEIGHT - _FAR * _NEAR / (_FAR - (_FAR - _NEAR) * depth)

    def _image(self, size: int) -> Any:
        renderer = self.client.ER_TINY_RENDERER
        return self.client.getCameraImage(size, size, self._view, self._projection, renderer=renderer, **_LIGHT)
