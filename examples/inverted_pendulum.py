"""The paper's first case study: a safe policy for the inverted pendulum, from two 64 x 64 RGB frames.

    python examples/inverted_pendulum.py [key=value ...]

trains, evaluates on fresh data, certifies, and writes metrics.json, figures/, report.html and the agent into out_dir.
Useful keys: seed=0, out_dir=runs/pendulum, preset=sound|paper|smoke, agent=pendulum (evaluate that one, train none). All
settings are in torchrl_sspl/configs/env/pendulum.yaml. Run it again with the same out_dir to resume it.
"""

import sys

from torchrl_sspl.cli import main

if __name__ == "__main__":
    sys.exit(main(["train", "env=pendulum", *sys.argv[1:]]))
