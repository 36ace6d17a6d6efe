"""Your own system: a simulator that the library does not know, S and U as predicates on its info, and your own encoder.

python examples/bring_your_own_env.py [key=value ...]     needs: pip install 'torchrl-sspl[viz,examples]'
"""

import sys
from functools import partial

import gym_pusht  # noqa: F401  registers the environment
import gymnasium
import torch
from torch import nn

from torchrl_sspl.envs import GymnasiumPixels
from torchrl_sspl.experiments.run import run_experiment


def make():  # what it renders also shows the action, as a cross; what it observes does not
    return gymnasium.make("gym_pusht/PushT-v0", obs_type="pixels")


def off_centre(info):  # the pusher's larger distance from the middle of the table, in its 512 units
    return abs(info["pos_agent"] - 256).max()


class Encoder(nn.Module):  # where things are: eight points of attention in both frames, and how they moved
    def __init__(self, latent_dim):
        super().__init__()
        sizes = ((3, 16, 2), (16, 16, 1), (16, 8, 1))
        see = [layer for a, b, stride in sizes for layer in (nn.Conv2d(a, b, 3, stride, 1), nn.SiLU())]
        self.see = nn.Sequential(nn.AvgPool2d(2), *see[:-1], nn.Flatten(2))
        self.register_buffer("places", torch.cartesian_prod(*2 * [torch.linspace(-1, 1, 12)]))
        self.head = nn.Sequential(nn.Linear(32, 128), nn.SiLU(), nn.Linear(128, latent_dim), nn.Tanh())

    def forward(self, pixels):
        frames = pixels.unflatten(-3, (2, 3))
        attention = (4 * self.see(frames.flatten(0, -4).float() / 127.5 - 1)).softmax(-1)
        points = (attention @ self.places).flatten(1).unflatten(0, frames.shape[:-3])
        return self.head(torch.cat([points[..., 1, :], 4 * (points[..., 1, :] - points[..., 0, :])], -1))


my_env = partial(
    GymnasiumPixels,
    make,
    safe=lambda picture, info: off_centre(info) < 80,
    unsafe=lambda picture, info: off_centre(info) > 180,
    reset_options=lambda random: {"reset_to_state": [*random.uniform(30, 482, 2), *random.uniform(180, 332, 2), 0.8]},
    settle=False,  # the pusher starts at rest
    image_size=48,
    horizon=20,
)

if __name__ == "__main__":
    names = {"title": "Pusher on a table", "out_dir": "runs/push"}
    outcome = run_experiment(my_env, sys.argv[1:], encoder=Encoder, **names)
    print(outcome.summary(), f"\nreport: {outcome.report}")
