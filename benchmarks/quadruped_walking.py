"""How well the walking controller tracks, whether it falls, how fast it runs, and how far the robot is from Dubins.

    python benchmarks/quadruped_walking.py [episodes]

Everything in one process, on one thread; times are processor times.
"""

from __future__ import annotations

import sys
import time
from collections.abc import Callable

import numpy as np

from torchrl_sspl.envs.quadruped.gait import PERIOD
from torchrl_sspl.envs.quadruped.kinematics import wrap_angle
from torchrl_sspl.envs.quadruped.robot import Snapshot, WalkingRobot
from torchrl_sspl.envs.quadruped.world import connect

INTERVAL = 0.1  # s, between commands
Commands = Callable[[np.random.Generator, float], float]


def tracking(robot: WalkingRobot, start: Snapshot, yaw_rate: float, seconds: float = 5.0) -> tuple[float, float]:
    """Largest errors of cycle-averaged forward speed (m/s) and yaw rate (rad/s) after 1.5 s."""
    robot.place(start, 0.0, 0.0, 0.0)
    headings, speeds = [], []
    for _ in range(round(seconds / robot.dt)):
        robot.step([1.0, 0.0, yaw_rate])
        headings.append(robot.pose[2])
        speeds.append(float(robot.measured.velocity @ robot.measured.rotation[:, 0]))
    cycle, settled = round(PERIOD / robot.dt), round(1.5 / robot.dt)
    heading = np.unwrap(headings)
    rates = (heading[cycle:] - heading[:-cycle]) / (cycle * robot.dt)
    averages = np.convolve(speeds, np.ones(cycle) / cycle, "valid")
    return float(np.abs(averages[settled:] - 1.0).max()), float(np.abs(rates[settled:] - yaw_rate).max())


def episode(
    robot: WalkingRobot, start: Snapshot, commands: Commands, rng: np.random.Generator, seconds: float
) -> tuple[np.ndarray, bool]:
    """Rows (command, the one before, dx, dy, d heading in the frame of the step's start); whether it fell."""
    robot.place(start, 0.0, 0.0, rng.uniform(-np.pi, np.pi))
    rows, last = [], 0.0
    for _ in range(round(seconds / INTERVAL)):
        command, pose = commands(rng, last), robot.pose
        for _ in range(round(INTERVAL / robot.dt)):
            robot.step([1.0, 0.0, command])
        if robot.fallen:
            return np.array(rows), True
        moved = robot.pose - pose
        cos, sin = np.cos(pose[2]), np.sin(pose[2])
        ahead, aside = cos * moved[0] + sin * moved[1], cos * moved[1] - sin * moved[0]
        rows.append([command, last, ahead, aside, wrap_angle(moved[2])])
        last = command
    return np.array(rows), False


def report(name: str, rows: np.ndarray, falls: int, episodes: int) -> None:
    """Print falls, the mismatch with the Dubins step, and the regression of the change of heading."""
    command, last, ahead, aside, turned = rows.T
    gap = np.hypot(ahead - INTERVAL, aside)
    late = np.abs(turned - command * INTERVAL)
    print(f"{name}: falls {falls}/{episodes}, {len(rows)} steps")
    for label, values, unit in (("position", 1e3 * gap, "mm"), ("heading", late, "rad")):
        print(
            f"  {label} against Dubins, mean / p95 / max: {values.mean():.3f} / {np.percentile(values, 95):.3f} / "
            f"{values.max():.3f} {unit}"
        )
    # d heading = (dt - lag) command + lag last: the lag in s that fits best, and both coefficients free.
    change = command - last
    if change.any():
        lag = float(change @ (command * INTERVAL - turned) / (change @ change))
        rest = turned - command * INTERVAL + lag * change
        free, *_ = np.linalg.lstsq(np.stack([command, last], axis=1), turned, rcond=None)
        print(
            f"  yaw lag {lag:.4f} s, residual sd {rest.std():.4f}, max {np.abs(rest).max():.4f} rad; "
            f"free coefficients {free[0]:.4f}, {free[1]:.4f} s"
        )


def main() -> None:
    """Measure and print."""
    episodes = int(sys.argv[1]) if len(sys.argv) > 1 else 10
    robot = WalkingRobot(connect())
    gait = robot.steady_gait()
    worst = [0.0, 0.0]
    for yaw_rate in (0.0, 1.0, 2.0, 3.0, -1.0, -2.0, -3.0):
        speed, rate = tracking(robot, gait[0], yaw_rate)
        worst = [max(worst[0], speed), max(worst[1], rate)]
        print(f"yaw rate {yaw_rate:+.0f} rad/s: largest cycle-averaged errors {speed:.4f} m/s, {rate:.4f} rad/s", flush=True)
    print(f"all: {worst[0]:.4f} m/s, {worst[1]:.4f} rad/s")
    kinds: dict[str, Commands] = {
        "straight": lambda rng, last: 0.0,
        "uniform +-2": lambda rng, last: rng.uniform(-2.0, 2.0),
        "bang-bang +-2": lambda rng, last: rng.choice([-2.0, 2.0]),
        "bang-bang +-2 held .5 s on average": lambda rng, last: rng.choice([-2.0, 2.0]) if rng.random() < 0.2 else last,
    }
    rng = np.random.default_rng(0)
    start, simulated = time.process_time(), 0.0
    for name, commands in kinds.items():
        n = episodes if "+-" in name else max(1, episodes // 10)
        parts, falls = [], 0
        for _ in range(n):
            rows, fell = episode(robot, gait[rng.integers(len(gait))], commands, rng, 8.0)
            parts.append(rows)
            falls += fell
            simulated += len(rows) * INTERVAL
        report(name, np.concatenate(parts), falls, n)
        print(f"  so far {simulated / (time.process_time() - start):.2f} x real time", flush=True)
    print(f"quadratic programs: {robot.controller.mpc.solves}, not solved: {robot.controller.mpc.failures}")


if __name__ == "__main__":
    main()
