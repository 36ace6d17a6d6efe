"""Your own system: a simulator that this library has never seen, S and U as predicates on its info, an own encoder.

python examples/bring_your_own_env.py [key=value ...]     needs: pip install 'torchrl-sspl[viz,examples]'
"""

import sys
from functools import partial

import gym_pusht  # noqa: F401  registers the environment
import gymnasium
from torch import nn

from torchrl_sspl.envs import GymnasiumPixels
from torchrl_sspl.trainers.experiment import run_experiment


def make():
    return gymnasium.make("gym_pusht/PushT-v0", render_mode="rgb_array", visualization_width=96, visualization_height=96)


def off_centre(info):  # the pusher's larger distance from the middle of the table, in its 512 units
    return abs(info["pos_agent"] - 256).max()


class Encoder(nn.Sequential):  # two RGB frames -> a latent in [-1, 1]
    def __init__(self, latent_dim):
        see = [nn.AvgPool2d(2), nn.Conv2d(6, 32, 3, 2), nn.ReLU(), nn.Conv2d(32, 32, 3, 2), nn.ReLU(), nn.Flatten()]
        super().__init__(*see, nn.Linear(800, 128), nn.ReLU(), nn.Linear(128, latent_dim))

    def forward(self, pixels):
        flat = pixels.reshape(-1, *pixels.shape[-3:]).float() / 127.5 - 1
        return super().forward(flat).tanh().reshape(*pixels.shape[:-3], -1)


my_env = partial(
    GymnasiumPixels,
    make,
    safe=lambda state, info: off_centre(info) < 80,
    unsafe=lambda state, info: off_centre(info) > 180,
    reset_options=lambda random: {"reset_to_state": [*random.uniform(30, 482, 2), *random.uniform(180, 332, 2), 0.8]},
    settle=False,  # the pusher starts at rest
    image_size=48,
    horizon=20,
)

if __name__ == "__main__":
    size = {"trainer.total_frames": 9600, "trainer.optim_steps_per_batch": 320, "trainer.warm_start_steps": 1500}
    names = {"title": "Pusher on a table", "out_dir": "runs/push"}
    outcome = run_experiment(my_env, sys.argv[1:], encoder=Encoder, **names, **size, **{"optim.lr": 2e-3})
    print(outcome.summary(), f"\nreport: {outcome.report}")
