"""The same path for gymnasium's CartPole: discrete actions, S and U as predicates on the state, the default encoder.

python examples/bring_your_own_cartpole.py [key=value ...]     needs: pip install 'torchrl-sspl[viz]'
"""

import sys
from functools import partial

import gymnasium
import numpy as np

from torchrl_sspl.envs import GymnasiumPixels
from torchrl_sspl.experiments.run import run_experiment


class OnTheCart(gymnasium.Wrapper):  # the camera rides on the cart: pole and rate fill the picture
    def render(self):
        left = round(220 + 125 * self.unwrapped.state[0])  # 125 pixels a metre
        return np.roll(self.env.render(), -left, axis=1)[160:320, :160]


def make():
    cart = gymnasium.make("CartPole-v1", render_mode="rgb_array")
    cart.unwrapped.kinematics_integrator = "semi-implicit"  # a push shows in the next picture, not in the one after it
    cart.unwrapped.tau = 0.01  # s; four steps to left or right make five pushes between full left and full right
    return OnTheCart(cart)


my_env = partial(
    GymnasiumPixels,
    make,
    safe=lambda state, info: abs(state[2]) < 0.03 and abs(state[3]) < 0.3,  # pole angle in rad, rate in rad/s
    unsafe=lambda state, info: abs(state[2]) > 0.15,
    reset_options={"low": -0.12, "high": 0.12},
    action_repeat=4,  # 0.04 s between two pictures
    image_size=64,
    horizon=40,
)

if __name__ == "__main__":
    outcome = run_experiment(my_env, sys.argv[1:], title="CartPole from pixels", out_dir="runs/cartpole")
    print(outcome.summary(), f"\nreport: {outcome.report}")
