"""Frames of the robot in given poses by PyBullet's own renderer: the reference for the compositor."""

from __future__ import annotations

import torch
from torch import Tensor

from torchrl_sspl.envs.quadruped.camera import TopCamera
from torchrl_sspl.envs.quadruped.robot import WalkingRobot
from torchrl_sspl.envs.quadruped.sprites import load_sprites
from torchrl_sspl.envs.quadruped.world import add_obstacle, connect
from torchrl_sspl.errors import ShapeError


class BulletRenderer:
    """Draws robots at rest in the postures of a steady gait, one after the other, about 2 ms each.

    Args:
        image_size: height and width of the frames, in pixels.
        obstacle_shape: "square" or "disc"; None: no obstacle.
        obstacle_half_size: half of its edge, or its radius, in m.
        obstacle_centre: (x, y) in m.

    Raises:
        MissingDependencyError: PyBullet is not installed.
        ConfigError: a parameter is not valid.

    Source: paper, Section IV-B (frames from PyBullet). Deviation: none.
    """

    def __init__(
        self,
        image_size: int = 128,
        *,
        obstacle_shape: str | None = "square",
        obstacle_half_size: float = 0.3,
        obstacle_centre: tuple[float, float] = (0.0, 0.0),
    ) -> None:
        self._client = connect()
        self._robot = WalkingRobot(self._client)
        if obstacle_shape is not None:
            add_obstacle(self._client, obstacle_shape, obstacle_half_size, obstacle_centre)
        self._camera = TopCamera(self._client, image_size)
        self._sprites = load_sprites()

    def __call__(self, pose: Tensor, phase: Tensor | None = None) -> Tensor:
        """Draw frames of poses ``(n, 3)`` (m, m, rad) at gait phases ``(n,)``, uint8 ``(n, 3, H, W)``.

        Raises:
            ShapeError: the poses are not ``(n, 3)``.
            RenderError: a robot is not in the frame.
        """
        if pose.ndim != 2 or pose.shape[1] != 3:
            raise ShapeError(f"pose: expected shape (n, 3), received {tuple(pose.shape)}.")
        phases = torch.zeros(len(pose)) if phase is None else phase
        n = len(self._sprites.postures)
        frames = []
        for (x, y, heading), k in zip(pose.tolist(), torch.round(phases * n).long().tolist(), strict=True):
            self._robot.pose_as(self._sprites.posture(k % n, x, y, heading))
            frames.append(torch.from_numpy(self._camera.capture(self._robot.body_id)))
        return torch.stack(frames).permute(0, 3, 1, 2).contiguous()


__all__ = ["BulletRenderer"]
