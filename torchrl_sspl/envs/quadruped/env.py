"""The walking robot among obstacles, in full physics, as a gymnasium environment."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any, ClassVar

import gymnasium
import numpy as np
from numpy.typing import NDArray

from torchrl_sspl.envs.base import check_positive
from torchrl_sspl.envs.quadruped.arena import check_arena, half_view
from torchrl_sspl.envs.quadruped.camera import TopCamera
from torchrl_sspl.envs.quadruped.controller import Measurement
from torchrl_sspl.envs.quadruped.robot import Snapshot, WalkingRobot
from torchrl_sspl.envs.quadruped.stage import StageProcess
from torchrl_sspl.envs.quadruped.world import GROUND_FRICTION, add_obstacle, connect
from torchrl_sspl.errors import ConfigError, DTypeError, NonFiniteError, ShapeError

_RENDER_SIZE = 512


class QuadrupedEnv(gymnasium.Env):
    r"""A Unitree A1 that walks at constant speed and is told its yaw rate; seen from above in two frames.

    The robot is simulated with its convex MPC in PyBullet; feet and body collide with the obstacle. An episode ends
    when the robot falls or leaves the arena, which counts as safe. Every entry of ``info`` is about the present step:

    ============= ===========================================================================================
    ``pose``      (x, y, heading) of the base [m, m, rad], float64 ``(3,)``
    ``unsafe``    the base is in U
    ``safe``      the base is in S
    ``contact``   a foot or the body has touched the obstacle during the step
    ``fallen``    the base is below 0.15 m or tilted by more than 0.8 rad
    ``left``      the base is outside the arena
    ``cost``      1 if unsafe or contact or fallen, else 0
    ============= ===========================================================================================

    Args:
        max_yaw_rate, speed, dt, image_size: bound of the action (what lies beyond is clipped), speed and step as of
            :class:`~torchrl_sspl.envs.DubinsEnv`.
        arena_half_size, safe_half_size, unsafe_half_size, obstacle_shape, obstacle_half_size, obstacle_centre: as of
            ``DubinsEnv``. Feet reach 0.35 m from the base: up to an obstacle of 0.3 m nothing touches it while the base
            is outside U.
        friction: coefficient of feet on the ground. The controller supposes no less than 0.6.
        meshes: draw the robot's meshes (thirty times slower); agents are trained on the plain shapes.
        render_mode: "rgb_array", "human" (a window) or None.

    Raises MissingDependencyError without PyBullet, its data or daqp; ConfigError for a parameter that is not valid, or
    for a window where there is no display. Source: paper, Section IV-B. Deviation: leaving the arena is defined; yaw
    rates are slew limited in the controller.

    Example:
        >>> env = QuadrupedEnv()  # doctest: +SKIP
        >>> pixels, info = env.reset(options={"pose": [-1.8, 0.0, 0.0]})  # doctest: +SKIP
        >>> pixels, reward, terminated, truncated, info = env.step(np.array([0.5]))  # doctest: +SKIP
    """

    metadata: ClassVar = {"render_modes": ["human", "rgb_array"], "render_fps": 10}  # type: ignore[misc]
    _gaits: ClassVar[dict[float, list[Snapshot]]] = {}

    def __init__(
        self,
        max_yaw_rate: float = 2.0,
        *,
        speed: float = 1.0,
        dt: float = 0.1,
        image_size: int = 128,
        arena_half_size: float = 2.0,
        safe_half_size: float = 1.5,
        unsafe_half_size: float = 0.7,
        obstacle_shape: str = "square",
        obstacle_half_size: float = 0.3,
        obstacle_centre: Sequence[float] = (0.0, 0.0),
        friction: float = GROUND_FRICTION,
        meshes: bool = False,
        render_mode: str | None = None,
    ) -> None:
        check_positive(max_yaw_rate=max_yaw_rate, speed=speed, dt=dt, friction=friction)
        centre = check_arena(
            arena_half_size=arena_half_size, safe_half_size=safe_half_size, unsafe_half_size=unsafe_half_size,
            obstacle_shape=obstacle_shape, obstacle_half_size=obstacle_half_size, obstacle_centre=obstacle_centre,
        )  # fmt: skip
        if render_mode not in (None, *self.metadata["render_modes"]):
            raise ConfigError(
                f"render_mode: expected None or one of {self.metadata['render_modes']}, received {render_mode!r}."
            )
        self.max_yaw_rate, self.speed, self.dt = float(max_yaw_rate), float(speed), float(dt)
        self.arena_half_size = arena_half_size
        self.safe_half_size, self.unsafe_half_size = safe_half_size, unsafe_half_size
        self.obstacle_shape, self.obstacle_centre = obstacle_shape, np.asarray(centre, dtype=np.float64)
        self.obstacle_half_size = obstacle_half_size
        self.render_mode = render_mode
        self._client = connect(gui=render_mode == "human")
        self._robot = WalkingRobot(self._client, meshes=meshes)
        if self.speed not in self._gaits:  # the same for every robot of the process; two seconds of simulation
            self._gaits[self.speed] = self._robot.steady_gait(speed=self.speed)
        self._gait = self._gaits[self.speed]
        self._client.changeDynamics(self._robot.ground, -1, lateralFriction=friction)
        self._obstacle = add_obstacle(self._client, obstacle_shape, obstacle_half_size, self.obstacle_centre.tolist())
        view = half_view(arena_half_size)
        self._camera = TopCamera(self._client, image_size, half_view=view)
        self._large = TopCamera(self._client, _RENDER_SIZE, half_view=view)
        self._substeps = max(1, round(dt / self._robot.dt))
        self._frames: NDArray[np.uint8] | None = None
        self._push = 0.0  # N, of the step that follows
        #: The robot after every time step of the physics (``physics_dt``, in s) in the last step, for films.
        self.motion: list[Measurement] = []
        self.physics_dt = self._robot.dt
        # The simulator remembers contacts: every episode starts from one and the same memory.
        self._robot.place(self._gait[0], 0.0, -self.safe_half_size, 0.0)
        self._walk(0.0)
        self._memory = self._client.saveState()
        self.observation_space = gymnasium.spaces.Box(0, 255, (6, image_size, image_size), np.uint8)
        self.action_space = gymnasium.spaces.Box(-self.max_yaw_rate, self.max_yaw_rate, (1,), np.float32)

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[NDArray[np.uint8], dict[str, Any]]:
        """Start: the robot walks straight ahead, in a steady gait, at a pose; frames and info as in ``step``.

        Options: "pose", (x, y, heading) [m, m, rad], default uniform in S; "phase", of the gait in [0, 1), default
        uniform. Raises ConfigError for others, and after ``close``; ShapeError, DTypeError or NonFiniteError unless the pose is three
        finite numbers and the phase one; RenderError where the camera does not see the robot.
        """
        self._open()
        super().reset(seed=seed)
        given = dict(options or {})
        pose = given.pop("pose", None)
        (phase,) = _numbers("phase", given.pop("phase", self.np_random.random()), 1)
        if given:
            raise ConfigError(f"options: expected 'pose' and 'phase', received {sorted(given)}.")
        x, y, heading = self._start() if pose is None else _numbers("pose", pose, 3)
        snapshot = self._gait[int(phase * len(self._gait)) % len(self._gait)]
        self._client.restoreState(self._memory)
        self._push = 0.0
        # The frame of one step ago is a real one: start a step earlier, and walk straight ahead.
        back = self.speed * self.dt
        self._robot.place(snapshot, x - back * math.cos(heading), y - back * math.sin(heading), heading)
        before = self._capture()
        contact = self._walk(0.0)
        self._frames = np.concatenate([before, self._capture()])
        return self._frames.copy(), self._info(contact)

    def step(self, action: Any) -> tuple[NDArray[np.uint8], float, bool, bool, dict[str, Any]]:
        """Walk for ``dt`` at a yaw rate ``(1,)`` in rad/s.

        Returns frames uint8 ``(6, H, W)``, one step ago and now, reward (minus the cost), terminated (fallen, or left
        the arena), False, info. Raises ConfigError if the episode was not started, and after ``close``; ShapeError, DTypeError or
        NonFiniteError, and nothing moves, unless the action is one finite number; SolverError if the controller found no forces many times
        in a row.
        """
        if self._frames is None:
            raise ConfigError("step: expected a reset before the first step, received none; call reset().")
        self._open()
        (rate,) = _numbers("action", action, 1)
        contact = self._walk(min(max(rate, -self.max_yaw_rate), self.max_yaw_rate))
        info = self._info(contact)
        now = self._frames[3:] if info["left"] and not self._seen() else self._capture()
        self._frames = np.concatenate([self._frames[3:], now])
        return self._frames.copy(), -info["cost"], info["fallen"] or info["left"], False, info

    def push(self, impulse: float) -> None:
        """Push the robot's base to its left by an impulse in N s, evenly during the next step; a negative one to its right.

        A NonFiniteError unless it is finite.
        """
        self._push = _numbers("impulse", impulse, 1)[0] / (self._substeps * self.physics_dt)

    def render(self) -> NDArray[np.uint8] | None:  # type: ignore[override]
        """The top view, uint8 ``(512, 512, 3)``, in render mode "rgb_array"; a window follows by itself."""
        return self._large.capture() if self.render_mode == "rgb_array" else None

    def stage(self, size: int, colours: dict[str, tuple[int, int, int]]) -> StageProcess:
        """A second world, in a process of its own, for pictures of ``motion``, ``size`` pixels high and wide; colours of "S", "U" and the
        "buffer"."""
        centre = self.obstacle_centre.tolist()
        areas = [
            ("square", self.arena_half_size, (0.0, 0.0), colours["S"]), ("square", self.safe_half_size, centre, colours["buffer"]),
            (self.obstacle_shape, self.unsafe_half_size, centre, colours["U"]),
        ]  # fmt: skip
        shape, half = self.obstacle_shape, self.obstacle_half_size
        return StageProcess(size, obstacle_shape=shape, obstacle_half_size=half, obstacle_centre=centre, areas=areas)

    def close(self) -> None:
        """End the simulation; may be called more than once."""
        if self._client is not None:
            self._client.disconnect()
            self._client = None

    def _open(self) -> None:
        if self._client is None:
            raise ConfigError("expected an environment that is open, received one after close(); make another one.")

    def _walk(self, rate: float) -> bool:
        """Simulate one step at a yaw rate; whether the obstacle was touched."""
        contact, self.motion = False, []
        for _ in range(self._substeps):
            if self._push:
                self._robot.push(self._push)
            self._robot.step([self.speed, 0.0, rate])
            self.motion.append(self._robot.measured)
            contact = contact or bool(self._client.getContactPoints(self._robot.body_id, self._obstacle))
        self._push = 0.0
        return contact

    def _start(self) -> tuple[float, float, float]:
        """A pose, uniform in S."""
        while True:
            x, y = self.np_random.uniform(-self.arena_half_size, self.arena_half_size, 2)
            if np.abs(np.array([x, y]) - self.obstacle_centre).max() >= self.safe_half_size:
                return x, y, self.np_random.uniform(-math.pi, math.pi)

    def _seen(self) -> bool:
        """Whether the robot is in the view of the camera."""
        return bool((self._camera.raw(self._camera.image_size)[1] == self._robot.body_id).any())

    def _capture(self) -> NDArray[np.uint8]:
        return np.ascontiguousarray(self._camera.capture(self._robot.body_id).transpose(2, 0, 1))

    def _info(self, contact: bool) -> dict[str, Any]:
        pose = self._robot.pose
        away = np.abs(pose[:2] - self.obstacle_centre)
        distance = float(np.hypot(*away) if self.obstacle_shape == "disc" else away.max())
        unsafe, fallen = distance <= self.unsafe_half_size, self._robot.fallen
        return {
            "pose": pose,
            "unsafe": unsafe,
            "safe": float(away.max()) >= self.safe_half_size,
            "contact": contact,
            "fallen": fallen,
            "left": bool(np.abs(pose[:2]).max() > self.arena_half_size),
            "cost": float(unsafe or contact or fallen),
        }


def _numbers(name: str, value: Any, n: int) -> list[float]:
    """n finite numbers."""
    try:
        array = np.asarray(value, dtype=np.float64).reshape(-1)
    except (TypeError, ValueError) as error:
        raise DTypeError(f"{name}: expected {n} number(s), received {value!r}.") from error
    if array.shape != (n,):
        raise ShapeError(f"{name}: expected {n} number(s), received shape {np.shape(value)}.")
    if not np.isfinite(array).all():
        raise NonFiniteError(f"{name}: expected finite numbers, received {array.tolist()}; check the policy's output.")
    return array.tolist()
