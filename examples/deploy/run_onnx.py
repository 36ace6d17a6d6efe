"""Runs an exported agent on a video, without torch and without this library: numpy, onnxruntime and imageio.

    python -c "import torchrl_sspl as sspl; sspl.load('pendulum').export('pendulum.onnx')"
    python examples/deploy/run_onnx.py pendulum.onnx run.mp4

An .mp4 needs `imageio[ffmpeg]`. With this library two lines write one that fits, of a pendulum under random actions:

    env = sspl.envs.PendulumEnv(seed=0)
    iio.imwrite("run.mp4", env.rollout(40)["pixels"][0, :, 3:].permute(0, 2, 3, 1).numpy(), fps=1 / env.dt, quality=10)

Every frame of the file is one step of the system. The action that is printed is the one the agent would take; what was really
taken is not in a film, so the memory assumes that it was taken (give `taken=` to `OnnxAgent.step` on a robot).
"""

from __future__ import annotations

import argparse
import json
from collections.abc import Iterator
from pathlib import Path

import imageio.v3 as iio
import numpy as np
import onnxruntime
from numpy.typing import NDArray


class OnnxAgent:
    """One agent with its memory, on numpy arrays."""

    def __init__(self, path: Path) -> None:
        options = onnxruntime.SessionOptions()
        options.intra_op_num_threads = 1
        self.session = onnxruntime.InferenceSession(str(path), options, providers=["CPUExecutionProvider"])
        about = {k: json.loads(v) for k, v in self.session.get_modelmeta().custom_metadata_map.items()}
        self.shape = tuple(about["pixels"])
        self.period = about.get("dt")
        self.action = np.zeros((1, len(about["action_scale"])), np.float32)
        self.latent = np.zeros((1, about["latent_dim"]), np.float32)
        self.reset()

    def reset(self) -> None:
        """Begin an episode: what was expected is forgotten."""
        self.begins, self.applies, self.before, self.time = True, True, None, None

    def step(
        self, frame: NDArray[np.uint8] | None, taken: NDArray[np.float32] | None = None, time: float | None = None
    ) -> tuple[NDArray[np.float32], str, float]:
        """Action ``(m,)``, verdict and barrier value for a frame ``(H, W, 3)``, or for None where none came.

        ``taken`` is what was really done since the last one, where it was not the action that was told; the proof says nothing of it.
        ``time`` is when the frame was taken, in s: after a gap of other than one period, as where a frame was lost, two frames do not show
        what the agent was trained on, and the proof no longer applies.
        """
        late = None not in (time, self.time, self.period) and abs(time - self.time - self.period) > 0.5 * self.period
        self.time = self.time if time is None else time
        if frame is None or late:
            self.applies, self.before, self.begins = False, None, True
        if frame is None:
            return np.zeros_like(self.action[0]), "no picture", float("nan")
        if frame.dtype != np.uint8 or frame.shape != (*self.shape[1:], 3):
            raise ValueError(f"expected a frame {(*self.shape[1:], 3)} of uint8, received {frame.shape} of {frame.dtype}")
        now, before = frame.transpose(2, 0, 1), self.before
        self.before = now
        if before is None:  # one frame does not show what moves
            return np.zeros_like(self.action[0]), "waiting for a second frame", float("nan")
        pixels = np.concatenate([before, now])[None]
        action = self.action if taken is None else np.asarray(taken, np.float32)[None]
        self.applies = self.applies and bool(np.array_equal(action, self.action) or self.begins)
        given = {"pixels": pixels, "latent": self.latent, "action": action, "begins": np.array([self.begins])}
        self.action, barrier, _, _, met, self.latent = self.session.run(None, given)
        self.begins = False
        self.applies = self.applies and bool(met[0])
        inside = float(barrier[0]) <= 0.0
        verdict = "proof applies" if self.applies else "inside, premise not met" if inside else "outside"
        return self.action[0], verdict, float(barrier[0])


def frames(path: Path, height: int, width: int) -> Iterator[NDArray[np.uint8]]:
    """Frames of a film; of another size they are refused, as resizing them is a matter of the camera's driver."""
    for frame in iio.imiter(path):
        if frame.shape[:2] != (height, width):
            raise SystemExit(f"expected frames of {height} x {width} pixels, received {frame.shape[0]} x {frame.shape[1]}")
        yield np.ascontiguousarray(frame[..., :3])


def main() -> None:
    """Prints a line for every frame."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("agent", type=Path, help="file written by agent.export")
    parser.add_argument("video", type=Path, help="film of the system, a frame per step")
    given = parser.parse_args()
    agent = OnnxAgent(given.agent)
    for k, frame in enumerate(frames(given.video, *agent.shape[1:])):
        action, verdict, barrier = agent.step(frame)
        print(f"{k:5d}  B = {barrier:+.3f}  u = {np.array2string(action, precision=2)}  {verdict}")


if __name__ == "__main__":
    main()
