"""Pictures of the walking robot for people: a second world with meshes, seen by a camera that follows."""

from __future__ import annotations

import math
import os
import pickle
import subprocess
import sys
import threading
import weakref
from collections.abc import Iterable, Iterator, Sequence
from contextlib import suppress
from queue import SimpleQueue
from typing import Any, BinaryIO

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import uniform_filter

from torchrl_sspl.envs.quadruped.camera import RenderError
from torchrl_sspl.envs.quadruped.controller import Measurement
from torchrl_sspl.envs.quadruped.robot import WalkingRobot
from torchrl_sspl.envs.quadruped.world import add_obstacle, connect

Colour = tuple[int, int, int]
Area = tuple[str, float, Sequence[float], Colour]
_BEHIND, _HEIGHT, _AHEAD, _FOV = 1.55, 1.05, 0.55, 48.0  # m behind and above the robot, m ahead where it looks, degrees
_FOLLOW, _ASIDE = 0.8, 0.3  # s, in which the camera turns after the robot; rad, by which it stands aside
_SKY, _GRID, _OUTSIDE = (np.array(c, np.float32) for c in ((233, 239, 245), (190, 197, 204), (226, 229, 233)))
_FAR_AWAY = 12.0  # m, where the ground has faded into the sky
_TEXEL, _BLUR = 0.01, (3, 7)  # m, of the picture of the ground; texels over which it is averaged far away
_TILE, _LINE = 0.5, 0.012  # m, between the lines on the ground, and half of their width
_LIMBS = {"hip": (0.95, 0.55, 0.12, 1.0), "upper": (0.24, 0.26, 0.30, 1.0), "lower": (0.24, 0.26, 0.30, 1.0)}
_TRUNK = (0.62, 0.64, 0.68, 1.0)
_LIGHT: dict[str, Any] = {
    "lightDirection": [0.4, -0.9, 2.0], "lightAmbientCoeff": 0.62, "lightDiffuseCoeff": 0.42, "lightSpecularCoeff": 0.08, "shadow": 0,
}  # fmt: skip


class Stage:
    """A robot with its meshes and an obstacle, on a ground on which areas are drawn; nothing moves by itself.

    Args:
        size: height and width of the pictures.
        obstacle_shape, obstacle_half_size, obstacle_centre: as of ``QuadrupedEnv``, in m.
        areas: on the ground, the largest first: "square" or "disc", half size or radius in m, centre (x, y) in m, colour.

    Raises MissingDependencyError without PyBullet, its data or its meshes. Source: none (the paper shows pictures of the
    robot).

    Example:
        >>> stage = Stage(256)  # doctest: +SKIP
        >>> pictures = list(stage.follow(env.motion, 0.002))  # doctest: +SKIP
    """

    def __init__(
        self,
        size: int = 256,
        *,
        obstacle_shape: str = "square",
        obstacle_half_size: float = 0.3,
        obstacle_centre: Sequence[float] = (0.0, 0.0),
        areas: Sequence[Area] = (),
    ) -> None:
        self.size = size
        self._client = connect()
        self._robot = WalkingRobot(self._client, meshes=True)
        add_obstacle(self._client, obstacle_shape, obstacle_half_size, obstacle_centre)
        for link in range(-1, self._client.getNumJoints(self._robot.body_id)):
            name = "trunk" if link < 0 else self._client.getJointInfo(self._robot.body_id, link)[1].decode()
            colour = next((c for part, c in _LIMBS.items() if f"_{part}_" in name), _TRUNK)
            self._client.changeVisualShape(self._robot.body_id, link, rgbaColor=colour)
        self._projection = self._client.computeProjectionMatrixFOV(_FOV, 1.0, 0.05, 30.0)
        self._half = _FAR_AWAY / 2 + max((half for _, half, *_ in areas), default=0.0)
        self._ground = self._paint(areas)
        self._forward, self._left, self._fade = self._rays()
        far = np.hypot(self._forward, self._left)
        self._blur = (far > 2.5).astype(np.intp) + (far > 5.0)

    def follow(self, bodies: Iterable[Measurement], dt: float) -> Iterator[NDArray[np.uint8]]:
        """Pictures uint8 ``(size, size, 3)`` of a robot, by a camera that turns after it; ``dt`` in s between them."""
        turned: float | None = None
        for body in bodies:
            heading = float(body.roll_pitch_yaw[2])
            turned = heading if turned is None else turned + min(1.0, dt / _FOLLOW) * math.remainder(heading - turned, 2 * math.pi)
            yield self.picture(body, turned - _ASIDE)

    def picture(self, body: Measurement, direction: float) -> NDArray[np.uint8]:
        """A picture uint8 ``(size, size, 3)`` in a direction in rad."""
        self._robot.pose_as(body)
        x, y = body.position[:2]
        c, s = math.cos(direction), math.sin(direction)
        eye = [x - _BEHIND * c, y - _BEHIND * s, _HEIGHT]
        view = self._client.computeViewMatrix(eye, [x + _AHEAD * c, y + _AHEAD * s, 0.0], [0.0, 0.0, 1.0])
        n = 2 * self.size  # drawn twice as large, and averaged
        renderer = self._client.ER_TINY_RENDERER
        _, _, colours, _, bodies = self._client.getCameraImage(n, n, view, self._projection, renderer=renderer, **_LIGHT)
        seen = (np.asarray(bodies, np.int32).reshape(n, n) >= 0)[..., None].astype(np.uint16)
        drawn = np.asarray(colours, np.uint8).reshape(n, n, 4)[..., :3] * seen
        covered, drawn = (v[::2, ::2] + v[1::2, ::2] + v[::2, 1::2] + v[1::2, 1::2] for v in (seen, drawn))
        image = drawn / np.float32(4) + (1 - covered / np.float32(4)) * self._background(eye[0], eye[1], direction, body)
        return (image + 0.5).astype(np.uint8)

    def close(self) -> None:
        """End the second world; may be called more than once."""
        if self._client is not None:
            self._client.disconnect()
            self._client = None

    def _rays(self) -> tuple[NDArray, NDArray, NDArray]:
        """Where the ground is that a pixel shows, m ahead and to the left of the camera, and how much it fades away.

        Height and inclination of the camera never change, so neither do these.
        """
        down = math.atan2(_HEIGHT, _BEHIND + _AHEAD)
        across = (2 * (np.arange(self.size) + 0.5) / self.size - 1) * math.tan(math.radians(_FOV) / 2)
        ahead = math.cos(down) - across * math.sin(down)  # by row; below the middle of the picture across is positive
        fall = math.sin(down) + across * math.cos(down)
        distance = np.where(fall > 1e-3, _HEIGHT / np.maximum(fall, 1e-3), 1e3)[:, None]
        fade = np.clip(distance / _FAR_AWAY, 0.0, 1.0) ** 2
        return (ahead[:, None] * distance).astype(np.float32), (-across * distance).astype(np.float32), fade[..., None].astype(np.float32)

    def _background(self, x: float, y: float, direction: float, body: Measurement) -> NDArray[np.float32]:
        """The ground with the shade of the robot, and the sky."""
        c, s = math.cos(direction), math.sin(direction)
        east, north = x + c * self._forward - s * self._left, y + s * self._forward + c * self._left
        n = self._ground.shape[1]
        column, row = (((v + self._half) / _TEXEL).astype(np.int32).clip(0, n - 1) for v in (east, north))
        heading = float(body.roll_pitch_yaw[2])
        dx, dy = east - np.float32(body.position[0]), north - np.float32(body.position[1])
        along = math.cos(heading) * dx + math.sin(heading) * dy
        aside = math.cos(heading) * dy - math.sin(heading) * dx
        shade = 1.0 - 0.35 * np.clip(1.0 - (along / 0.36) ** 2 - (aside / 0.22) ** 2, 0.0, 1.0)
        lit = self._ground[self._blur, row, column] * shade[..., None]
        return lit + self._fade * (_SKY - lit)

    def _paint(self, areas: Sequence[Area]) -> NDArray[np.uint8]:
        """The ground from above, row 0 in the south; sharp, and blurred twice for what is far away."""
        n = round(2 * self._half / _TEXEL)
        at = (np.arange(n) + 0.5) * _TEXEL - self._half
        ground = np.full((n, n, 3), _OUTSIDE, np.float32)
        arena = np.ones((n, n), bool)  # nothing reaches beyond the first one
        for k, (shape, half, centre, colour) in enumerate(areas):
            east, north = np.abs(at - centre[0])[None], np.abs(at - centre[1])[:, None]
            inside = (np.hypot(east, north) if shape == "disc" else np.maximum(east, north)) <= half
            arena = inside if k == 0 else arena
            ground[inside & arena] = colour
        line = np.abs((at + _TILE / 2) % _TILE - _TILE / 2) <= _LINE
        for part in (line, (slice(None), line)):
            ground[part] += 0.6 * (_GRID - ground[part])
        return np.stack([ground, *(uniform_filter(ground, (k, k, 1)) for k in _BLUR)]).astype(np.uint8)


class StageProcess:
    """A :class:`Stage` in a process of its own: it draws while the caller computes something else.

    The arguments are those of ``Stage``. ``follow`` has the pictures drawn from then on, and gives the very same ones.

    Raises RenderError where the process has ended, and what ``Stage`` raises, when the first picture is asked for. Source: none.

    Example:
        >>> stage = StageProcess(256)  # doctest: +SKIP
        >>> pictures = stage.follow(env.motion, 0.002)  # doctest: +SKIP
    """

    def __init__(self, size: int = 256, **options: Any) -> None:
        self._size, self._jobs = size, SimpleQueue[Any]()
        paths = os.pathsep.join(os.path.abspath(path) for path in sys.path)
        # Not multiprocessing: its children import the caller's script again, guarded or not. A session of its own: Ctrl-C is the caller's.
        process = subprocess.Popen(
            [sys.executable, "-m", __name__], stdin=subprocess.PIPE, stdout=subprocess.PIPE, start_new_session=True,
            env=os.environ | {"PYTHONPATH": paths},
        )  # fmt: skip
        self._process, self.close = process, weakref.finalize(self, _end, process, self._jobs)
        threading.Thread(target=_receive, args=(process.stdout, self._jobs, (size, size, 3)), daemon=True).start()
        self._send({"size": size, **options})

    def follow(self, bodies: Iterable[Measurement], dt: float) -> Iterator[NDArray[np.uint8]]:
        """See ``Stage.follow``; drawing begins at once."""
        if not self.close.alive:
            raise RenderError("stage: expected one that is open, received a closed one.")
        bodies, drawn = list(bodies), SimpleQueue[Any]()
        self._jobs.put((len(bodies), drawn))
        self._send((bodies, dt))
        return (_checked(drawn.get()) for _ in bodies)

    def _send(self, job: Any) -> None:
        with suppress(OSError):  # it has ended; whoever asks for a picture is told
            pickle.dump(job, self._process.stdin)  # type: ignore[arg-type]
            self._process.stdin.flush()  # type: ignore[union-attr]


def _checked(drawn: Any) -> NDArray[np.uint8]:
    if isinstance(drawn, Exception):
        raise drawn
    return drawn  # type: ignore[no-any-return]


def _receive(pipe: BinaryIO, jobs: SimpleQueue[Any], shape: tuple[int, int, int]) -> None:
    """Hand out pictures as they come, or in place of each an error, until the jobs end."""
    error: Exception | None
    with pipe:
        try:
            error = pickle.load(pipe)
        except EOFError:
            error = RenderError("stage: expected pictures, received the end of the process that draws them.")
        for count, drawn in iter(jobs.get, None):
            for _ in range(count):
                data = b"" if error else pipe.read(math.prod(shape))
                if not error and len(data) < math.prod(shape):
                    error = RenderError("stage: expected a picture, received the end of the process that draws them.")
                drawn.put(error or np.frombuffer(data, np.uint8).reshape(shape))


def _end(process: subprocess.Popen[bytes], jobs: SimpleQueue[Any]) -> None:
    process.terminate()
    process.wait()
    jobs.put(None)
    with suppress(OSError):
        process.stdin.close()  # type: ignore[union-attr]


def _serve(read: BinaryIO, write: BinaryIO) -> None:
    """What the other process does: None or an error, then the pictures of every job."""
    try:
        stage, error = Stage(**pickle.load(read)), None
    except Exception as problem:
        stage, error = None, problem
    pickle.dump(error, write)
    write.flush()
    while stage is not None:
        try:
            bodies, dt = pickle.load(read)
        except EOFError:
            return
        for picture in stage.follow(bodies, dt):
            write.write(picture.tobytes())
        write.flush()


if __name__ == "__main__":
    pictures = os.fdopen(os.dup(1), "wb")
    os.dup2(2, 1)  # PyBullet prints a line when it is imported
    _serve(sys.stdin.buffer, pictures)
