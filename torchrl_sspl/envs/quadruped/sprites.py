"""Pictures of the walking robot from above, one per gait phase, drawn once by PyBullet's renderer.

``python -m torchrl_sspl.envs.quadruped.sprites [path]`` makes the file in the package.
"""

from __future__ import annotations

import functools
import io
import sys
import zipfile
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from torchrl_sspl.envs.quadruped.camera import TopCamera
from torchrl_sspl.envs.quadruped.controller import Measurement
from torchrl_sspl.envs.quadruped.gait import PERIOD
from torchrl_sspl.envs.quadruped.kinematics import rotation_z
from torchrl_sspl.envs.quadruped.robot import WalkingRobot
from torchrl_sspl.envs.quadruped.world import add_obstacle, connect
from torchrl_sspl.errors import CheckpointError, ShapeError

TEXEL = 0.0025  # m on the ground under the camera, size of a texel of a sprite
HEIGHT_UNIT = 0.002  # m, of the heights of a sprite

_SPRITE_FILE = Path(__file__).with_name("sprites.npz")
_PHASES = 36  # a divisor of 180, the time steps in a period of the gait
_SIZE = 352  # texels: 0.88 m, and the robot reaches 0.4 m from the middle of its base


@dataclass(frozen=True)
class Sprites:
    """The robot at ``n`` phases of its gait, heading along x, from straight above.

    Example:
        >>> sprites = load_sprites()
        >>> sprites.colours.shape, sprites.colours.dtype
        ((36, 352, 352, 3), dtype('uint8'))
    """

    colours: NDArray[np.uint8]  # (n, size, size, 3); row 0 is on the robot's left
    heights: NDArray[np.uint8]  # (n, size, size) in units of 2 mm; 0 where nothing of the robot is seen
    postures: NDArray[np.float32]  # (n, 22): height of the base in m, its rotation (row by row; yaw 0), joints in rad

    def save(self, path: str | Path) -> None:
        """Write an npz file whose bytes depend on the contents alone."""
        with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED, compresslevel=9) as archive:
            for name in ("colours", "heights", "postures"):
                buffer = io.BytesIO()
                np.lib.format.write_array(buffer, np.ascontiguousarray(getattr(self, name)), allow_pickle=False)
                archive.writestr(zipfile.ZipInfo(f"{name}.npy"), buffer.getvalue(), zipfile.ZIP_DEFLATED, 9)


@functools.lru_cache(maxsize=2)
def load_sprites(path: str | Path = _SPRITE_FILE) -> Sprites:
    """Read sprites, by default those of the package; CheckpointError if the file is missing or damaged."""
    try:
        with np.load(path, allow_pickle=False) as data:
            sprites = Sprites(data["colours"], data["heights"], data["postures"])
    except (OSError, KeyError, ValueError, zipfile.BadZipFile) as error:
        raise CheckpointError(
            f"sprites: expected a readable file {path}, received {error}; reinstall the package, or draw them anew: "
            "python -m torchrl_sspl.envs.quadruped.sprites"
        ) from error
    n = len(sprites.postures)
    if sprites.colours.shape != (n, *sprites.heights.shape[1:], 3) or sprites.postures.shape != (n, 22) or n < 1:
        raise CheckpointError(
            f"sprites: expected colours (n, size, size, 3), heights (n, size, size) and postures (n, 22) in {path}, "
            f"received {sprites.colours.shape}, {sprites.heights.shape}, {sprites.postures.shape}; "
            "reinstall the package."
        )
    return sprites


def posture_at(posture: NDArray[np.float32], x: float = 0.0, y: float = 0.0, heading: float = 0.0) -> Measurement:
    """Robot in a posture ``(22,)`` at (x, y) in m with a heading in rad, at rest."""
    values = posture.astype(np.float64)
    turned, joints = rotation_z(heading) @ values[1:10].reshape(3, 3), values[10:].reshape(4, 3)
    return Measurement(np.array([x, y, values[0]]), turned, np.zeros(3), np.zeros(3), joints, np.zeros((4, 3)))


def _posture_of(measured: Measurement) -> NDArray[np.float32]:
    """Height, rotation without yaw, and joints of a robot, ``(22,)``; the inverse of ``posture_at``."""
    level = rotation_z(-float(measured.roll_pitch_yaw[2])) @ measured.rotation
    return np.concatenate([measured.position[2:], level.ravel(), measured.joints.ravel()]).astype(np.float32)


def draw_sprites(client: Any) -> Sprites:
    """Walk straight ahead at 1 m/s in the empty world of a PyBullet client and draw the robot at phases of its gait."""
    robot = WalkingRobot(client)
    interval = round(PERIOD / robot.dt) // _PHASES
    postures = np.stack([_posture_of(s.measured) for s in robot.steady_gait(interval)])
    camera = TopCamera(client, _SIZE, half_view=_SIZE * TEXEL / 2, supersample=1)
    colours, heights = [], []
    for posture in postures:
        robot.pose_as(posture_at(posture))
        picture, bodies = camera.raw(_SIZE)
        seen = bodies == robot.body_id
        level = np.clip(np.round(camera.depth(_SIZE) / HEIGHT_UNIT), 1, 255)
        colours.append(np.where(seen[..., None], picture, 0).astype(np.uint8))
        heights.append(np.where(seen, level, 0).astype(np.uint8))
    return Sprites(np.stack(colours), np.stack(heights), postures)


class BulletRenderer:
    """The reference for the compositor: robots beside a square obstacle, at rest in a steady gait, about 2 ms each.

    ``image_size``: height and width of the frames, in pixels. Source: paper, Section IV-B (frames from PyBullet);
    deviation: none. Raises MissingDependencyError without PyBullet.
    """

    def __init__(self, image_size: int = 128) -> None:
        self._client = connect()
        self._robot = WalkingRobot(self._client)
        add_obstacle(self._client, "square", 0.3, (0.0, 0.0))
        self._camera = TopCamera(self._client, image_size)
        self._postures = load_sprites().postures

    def __call__(self, pose: Tensor, phase: Tensor | None = None) -> Tensor:
        """Draw poses ``(n, 3)`` (m, m, rad) at gait phases ``(n,)``, uint8 ``(n, 3, H, W)``.

        Raises ShapeError for other shapes; RenderError if a robot is not in the frame.
        """
        if pose.ndim != 2 or pose.shape[1] != 3:
            raise ShapeError(f"pose: expected shape (n, 3), received {tuple(pose.shape)}.")
        phases = torch.zeros(len(pose)) if phase is None else phase
        n = len(self._postures)
        frames = []
        for (x, y, heading), k in zip(pose.tolist(), torch.round(phases * n).long().tolist(), strict=True):
            self._robot.pose_as(posture_at(self._postures[k % n], x, y, heading))
            frames.append(torch.from_numpy(self._camera.capture(self._robot.body_id)))
        return torch.stack(frames).permute(0, 3, 1, 2).contiguous()


def _main() -> None:
    """Draw the sprites of the package."""
    path = Path(sys.argv[1]) if len(sys.argv) > 1 else _SPRITE_FILE
    draw_sprites(connect()).save(path)
    print(f"{path}: {path.stat().st_size / 1e3:.0f} kB")


if __name__ == "__main__":
    _main()
