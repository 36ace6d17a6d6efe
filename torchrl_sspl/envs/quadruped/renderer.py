"""Frames of the robot in given poses by PyBullet's own renderer: the reference for the compositor."""

from __future__ import annotations

import torch
from torch import Tensor

from torchrl_sspl.envs.quadruped.camera import TopCamera
from torchrl_sspl.envs.quadruped.robot import WalkingRobot
from torchrl_sspl.envs.quadruped.sprites import load_sprites, posture_at
from torchrl_sspl.envs.quadruped.world import add_obstacle, connect
from torchrl_sspl.errors import ShapeError


class BulletRenderer:
    """Draws robots beside a square obstacle, at rest in the postures of a steady gait, one after the other, 2 ms each.

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
