"""The paper's first case study: a safe policy for the inverted pendulum, from two 64 x 64 RGB frames.

    python examples/inverted_pendulum.py [key=value ...]

trains, evaluates on fresh data and writes metrics.json, figures/, report.html and the agent into out_dir. Useful keys:
seed=0, out_dir=runs/pendulum, preset=sound|paper|smoke; a wrong key lists all of them. Started again with the same
out_dir it continues where it was interrupted.
"""

from __future__ import annotations

import sys

from torchrl_sspl.envs import PendulumEnv
from torchrl_sspl.errors import SSPLError
from torchrl_sspl.trainers.config import make_config
from torchrl_sspl.trainers.requirements import PENDULUM
from torchrl_sspl.trainers.run import run


def main(arguments: list[str]) -> int:
    try:
        config = make_config(arguments, out_dir="runs/pendulum")
        outcome = run(
            config,
            lambda batch_size, seed: PendulumEnv(batch_size=batch_size, seed=seed),
            title="Inverted pendulum from pixels",
            requirements=PENDULUM,
            foreign=lambda env: lambda state: env.observe_gymnasium(state)[:, 3:],
            axes=("angle [rad]", "angular velocity [rad/s]"),
            action="torque [N m]",
        )
    except SSPLError as error:
        print(f"{type(error).__name__}: {error}", file=sys.stderr)
        return 2
    print(outcome.summary())
    print(f"report: {outcome.report}")
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
