"""The paper's second case study: a quadruped walks past an obstacle, from two 128 x 128 RGB frames seen from above.

    python examples/quadruped_obstacle.py [key=value ...]

trains on a Dubins car with the delay of the robot, evaluates on the paper's Dubins car against its true kernel and on
the robot that walks in full physics, certifies, and writes metrics.json, figures/, report.html and the agent into out_dir.
Useful keys:

    seed=0 out_dir=runs/quadruped preset=sound|paper|smoke
    agent=quadruped          evaluate a shipped agent or a run directory, train none
    evaluation.walks=200     walks in full physics from S, and as many from {B <= 0}; 0: none
    evaluation.episodes=0    nothing on the Dubins car

All settings are in torchrl_sspl/configs/env/quadruped.yaml. Run it again with the same
out_dir to resume a training.
"""

import sys

from torchrl_sspl.cli import main

if __name__ == "__main__":
    sys.exit(main(["train", "env=quadruped", *sys.argv[1:]]))
