"""The paper's second case study: a quadruped walks past an obstacle, from two 128 x 128 RGB frames seen from above.

    python examples/quadruped_obstacle.py [key=value ...]

trains on a Dubins car that turns as late as the robot, evaluates on the paper's Dubins car against its true kernel and on
the robot that walks in full physics, and writes metrics.json, figures/, report.html and the agent into out_dir. Useful keys:

    mode=train|evaluate      evaluate: no training, the agent is that of agent=
    agent=quadruped          shipped agent or run directory (mode=evaluate)
    preset=sound|paper|smoke seed=0 out_dir=runs/quadruped
    walks=200                walks in full physics from S, and as many from {B <= 0}; 0: none
    dubins=true|false        evaluate on the Dubins car too (mode=evaluate)

The settings of each preset are in quadruped_obstacle.json; a wrong key lists all that can be set. Started again with
the same out_dir a training continues where it was interrupted.
"""

from __future__ import annotations

import json
import sys
from pathlib import Path

from torchrl_sspl.envs import DubinsEnv
from torchrl_sspl.envs.dubins import YAW_LAG
from torchrl_sspl.errors import ConfigError, SSPLError
from torchrl_sspl.trainers.config import PRESETS, TrainingConfig, make_config
from torchrl_sspl.trainers.quadruped import WalkConfig
from torchrl_sspl.trainers.quadruped_run import QuadrupedRun, run_quadruped

SETTINGS = Path(__file__).with_suffix(".json")
OWN_KEYS = {"mode": "train", "agent": "", "walks": "", "dubins": "true"}


def configure(arguments: list[str]) -> tuple[TrainingConfig, QuadrupedRun]:
    """Configuration of the training, and what this example does with it."""
    own, rest = dict(OWN_KEYS), []
    for item in arguments:
        key, sign, value = item.partition("=")
        if key in own and sign:
            own[key] = value
        else:
            rest.append(item)
    preset = dict(item.partition("=")[::2] for item in rest).get("preset", "sound")
    if preset not in PRESETS:
        raise ConfigError(f"expected preset to be one of {', '.join(PRESETS)}, received '{preset}'")
    config = make_config(rest, **json.loads(SETTINGS.read_text())[preset])
    if own["mode"] not in ("train", "evaluate"):
        raise ConfigError(f"expected mode to be train or evaluate, received '{own['mode']}'")
    if own["dubins"] not in ("true", "false"):
        raise ConfigError(f"expected dubins to be true or false, received '{own['dubins']}'")
    walks = own["walks"] or ("2" if preset == "smoke" else "200")
    if not walks.isdigit():
        raise ConfigError(f"expected walks to be an integer >= 0, received '{walks}'")
    agent = own["agent"] or "quadruped" if own["mode"] == "evaluate" else None
    return config, QuadrupedRun(agent, own["dubins"] == "true", WalkConfig(episodes=int(walks)))


def turns_at_once(batch_size: list[int], seed: int) -> DubinsEnv:
    """The Dubins car of the paper, with a true kernel of three dimensions."""
    return DubinsEnv(batch_size=batch_size, seed=seed)


def turns_late(batch_size: list[int], seed: int) -> DubinsEnv:
    """The Dubins car that turns as late as the walking robot does."""
    return DubinsEnv(batch_size=batch_size, seed=seed, yaw_lag=YAW_LAG)


def main(arguments: list[str]) -> int:
    try:
        config, task = configure(arguments)
        outcome = run_quadruped(config, turns_at_once, task, make_training_env=turns_late)
    except SSPLError as error:
        print(f"{type(error).__name__}: {error}", file=sys.stderr)
        return 2
    print(outcome.summary())
    print(f"report: {outcome.report}")
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
