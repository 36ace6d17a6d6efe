"""The film on the front page: a shipped agent, and the same starts without protection.

    python examples/film.py [quadruped|pendulum] [FILE]

writes FILE, an mp4 or a gif (default: docs/images/quadruped.gif). Of the quadruped, which walks in full physics, an mp4 shows
all scenes at 25 pictures a second, a gif the last one at 10. The report of every run begins with such a film of its agent.
"""

import sys

import torchrl_sspl as sspl
from torchrl_sspl.envs import DubinsEnv, PendulumEnv
from torchrl_sspl.experiments.film import Film
from torchrl_sspl.viz import Plane, animate


def main(name: str = "quadruped", path: str = "") -> None:
    """Film a shipped agent."""
    path = path or f"docs/images/{name}.gif"
    short = path.endswith(".gif")
    env = DubinsEnv() if name == "quadruped" else PendulumEnv()
    openings = env.system.openings
    make = env.physics()
    film = Film(sspl.load(name), env, fps=10 if short else 25, world=make and make(), seconds=10.0 if make else 5.0)
    if short:
        openings = openings[-1:] if make else openings[:2]
    plane = Plane.of(env, env.system.state_names[:2])
    found = animate(film.scenes(openings), path, plane=plane, levels=film.levels({}), fps=film.rate)
    film.close()
    print(f"{found}: {found.stat().st_size / 1e6:.1f} MB")


if __name__ == "__main__":
    main(*sys.argv[1:])
