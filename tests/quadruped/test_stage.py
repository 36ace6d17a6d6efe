"""Pictures of the walking robot for people: drawn in a process of its own, they are the very same."""

from __future__ import annotations

import numpy as np
import pytest

pytest.importorskip("pybullet")

from torchrl_sspl.envs.quadruped.camera import RenderError
from torchrl_sspl.envs.quadruped.env import QuadrupedEnv
from torchrl_sspl.envs.quadruped.stage import Stage, StageProcess
from torchrl_sspl.errors import ConfigError

pytestmark = pytest.mark.pybullet


@pytest.fixture(scope="module")
def bodies():
    env = QuadrupedEnv(image_size=16)
    try:
        env.reset(seed=0, options={"pose": [-1.6, 0.1, 0.0]})
        env.step([1.0])
        return env.motion[::10]
    finally:
        env.close()


@pytest.mark.slow
def test_another_process_draws_the_same_pictures_of_every_job_in_whatever_order_they_are_asked_for(bodies):
    options = {"obstacle_half_size": 0.2, "areas": [("square", 2.0, (0.0, 0.0), (10, 20, 30))]}
    here, there = Stage(48, **options), StageProcess(48, **options)
    first, second = there.follow(bodies, 0.02), there.follow(bodies[::-1], 0.02)
    for drawn, job in ((second, bodies[::-1]), (first, bodies)):
        assert [np.array_equal(*pair) for pair in zip(drawn, here.follow(job, 0.02), strict=True)] == [True] * len(bodies)
    here.close()
    there.close()
    with pytest.raises(RenderError, match="received a closed one"):
        there.follow(bodies, 0.02)


@pytest.mark.slow
def test_what_goes_wrong_in_the_other_process_is_raised_where_the_pictures_are_asked_for(bodies):
    wrong = StageProcess(48, obstacle_shape="heart")
    with pytest.raises(ConfigError, match="heart"):
        next(wrong.follow(bodies, 0.02))
    wrong.close()
    killed = StageProcess(48)
    next(killed.follow(bodies, 0.02))
    killed._process.kill()
    killed._process.wait()
    with pytest.raises(RenderError, match="the end of the process"):
        next(killed.follow(bodies, 0.02))
    killed.close()


def test_a_disc_is_painted_as_a_disc():
    made = QuadrupedEnv(image_size=16, obstacle_shape="disc")
    areas = {}
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("torchrl_sspl.envs.quadruped.env.StageProcess", lambda size, **options: areas.update(options))
        made.stage(16, {"S": (1, 1, 1), "U": (255, 0, 0), "buffer": (2, 2, 2)})
    made.close()
    stage = Stage(16, areas=areas["areas"])
    at = [round((v + stage._half) / 0.01) for v in (0.43, 0.62)]  # off the lines on the ground
    stage.close()
    ground = stage._ground[0]
    assert (ground[at[0], at[0]] == (255, 0, 0)).all()
    assert (ground[at[1], at[1]] == (2, 2, 2)).all()  # .88 m from the middle of a disc of .7 m
