"""What is particular to a system lies in its environment."""

from __future__ import annotations

import sys
from types import SimpleNamespace

import pytest
import torch

from torchrl_sspl.envs import (
    CMUDubinsEnv,
    CMUTwoDiscsEnv,
    DubinsEnv,
    GymnasiumRenderer,
    PendulumEnv,
    Requirement,
    System,
)
from torchrl_sspl.envs.dubins import YAW_LAG
from torchrl_sspl.errors import ConfigError, MissingDependencyError


def measured(**values):
    return SimpleNamespace(measurements={k: SimpleNamespace(value=v) for k, v in values.items()})


@pytest.mark.parametrize(
    ("value", "sense", "verdict"),
    [(0.1, "<=", "aim"), (0.3, "<=", "must"), (0.6, "<=", "missed by 0.2"), (0.6, ">=", "aim"), (0.1, ">=", "missed by 0.1"),
     (None, "<=", "not measured")],
)  # fmt: skip
def test_verdicts(value, sense, verdict):
    must, aim = (0.4, 0.2) if sense == "<=" else (0.2, 0.4)
    assert Requirement("x", "share", sense, must, aim).verdict(measured(x=value)) == verdict


def test_a_direction_that_is_not_in_the_plane_is_refused():
    with pytest.raises(ConfigError, match=r"System 'Puck': expected action_direction of two numbers.* received \(0\.0, 0\.0, 1\.0, 1\.0\)"):
        System("Puck", ("x", "y", "vx", "vy"), "force", action_direction=(0.0, 0.0, 1.0, 1.0))


def test_a_requirement_of_which_nothing_was_said_is_not_measured():
    assert Requirement("x", "share", "<=", 0.0, 0.0).verdict(measured()) == "not measured"


@pytest.mark.parametrize("env", [PendulumEnv(), DubinsEnv(image_size=32), DubinsEnv(image_size=32, yaw_lag=YAW_LAG), CMUTwoDiscsEnv(image_size=32)])
def test_a_system_names_every_coordinate_and_sizes_every_grid(env):
    system = env.system
    assert len(system.state_names) == env.state_dim
    for sizes in (system.state_grid, system.kernel_grid, system.unsafe_grid):
        assert sizes is None or isinstance(sizes, int) or len(sizes) == env.state_dim
    assert system.requirements
    assert len({r.name for r in system.requirements}) == len(system.requirements)


def test_a_system_that_says_nothing_has_plain_names():
    class Plain(PendulumEnv):
        system = PendulumEnv.__mro__[1].system

    assert Plain().system == System("Plain from pixels", ("x0", "x1"), "action")
    assert Plain().system.requirements == ()
    assert Plain().known_twin().physics() is None


def test_gymnasium_is_the_pendulums_second_renderer():
    pytest.importorskip("pygame")
    env = PendulumEnv(seed=0)
    states = env.sample_states(6)
    assert torch.equal(env.renderers()["gymnasium"](states), GymnasiumRenderer(64)(states[:, 0]))


def test_the_twin_of_a_car_that_turns_late_turns_at_once():
    late = DubinsEnv([3], 1.5, image_size=32, speed=0.8, yaw_lag=YAW_LAG, obstacle_shape="disc", obstacle_centre=(0.1, 0.2))
    twin = late.known_twin()
    assert (twin.yaw_lag, twin.state_dim, twin.batch_size) == (None, 3, late.batch_size)
    assert twin.known_twin() is twin
    states = late.sample_states(50)
    assert torch.equal(late.region(states), twin.region(states[:, :3]))
    assert torch.equal(late.draw(states), twin.draw(states[:, :3]))
    assert (twin.max_action, twin.speed) == (1.5, 0.8)
    assert late.system.notes != twin.system.notes


def test_without_its_simulator_full_physics_says_what_is_missing(monkeypatch):
    monkeypatch.setitem(sys.modules, "pybullet", None)
    with pytest.raises(MissingDependencyError, match="pip install"):
        DubinsEnv(image_size=32).physics()


@pytest.mark.pybullet
def test_full_physics_has_the_regions_and_actions_of_the_car():
    pytest.importorskip("pybullet")
    car = DubinsEnv([1], 1.5, image_size=32, safe_half_size=1.4, unsafe_half_size=0.6)
    world = car.physics()()
    try:
        assert world.action_space.high.item() == 1.5
        for pose in ((1.45, 0.0, 0.0), (0.55, 0.0, 0.0), (1.0, 0.0, 0.0)):
            _, info = world.reset(options={"pose": list(pose)})
            region = car.region(torch.as_tensor(info["pose"], dtype=torch.float32)[None]).item()
            assert (info["safe"], info["unsafe"]) == (region == 1, region == 2)
    finally:
        world.close()


@pytest.mark.parametrize("kind", [PendulumEnv, DubinsEnv, CMUDubinsEnv, CMUTwoDiscsEnv])
def test_a_moved_system_keeps_its_states_and_makes_its_pictures_anew(kind):
    env = kind(batch_size=[2], seed=0)
    shown = env.reset()
    held = {k: v for k, v in vars(env).items() if k in ("_renderer", "_compositor", "_picture")}
    assert env.to("cpu:0") is env  # TorchRL takes it for another device than "cpu"
    assert not any(vars(env).get(k) is v for k, v in held.items())
    assert torch.equal(env._state, shown["state"])
    again = env.reset(shown.select("state"), set_state=True)
    assert torch.equal(again["pixels"], shown["pixels"])
    with pytest.raises(ConfigError, match="device: expected a device"):
        env.to("cuda:99")


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: PendulumEnv(batch_size="a"), r"batch_size: expected \[n\].* received 'a'"),
        (lambda: PendulumEnv(batch_size=3.5), "batch_size: expected .* received 3.5"),
        (lambda: PendulumEnv(seed="a"), "seed: expected an integer or None, received 'a'"),
        (lambda: DubinsEnv(yaw_lag=3), "yaw_lag: expected two finite numbers .* received 3"),
        (lambda: DubinsEnv(yaw_lag=("a", 1)), "yaw_lag: expected two finite numbers"),
        (lambda: DubinsEnv(obstacle_centre="ab"), r"obstacle_centre: expected \(x, y\).* received 'ab'"),
        (lambda: CMUDubinsEnv(background=3), r"background: expected red, green and blue in \[0, 1\], received 3"),
        (lambda: CMUDubinsEnv(dot_area="a"), "dot_area: expected a finite number >= 0, received 'a'"),
        (lambda: CMUDubinsEnv(image_size=8), "image_size: expected an integer >= 32"),
        (lambda: PendulumEnv(image_size=8), "image_size: expected an integer >= 16"),
    ],
)
def test_a_system_that_cannot_be_is_named_at_once(make, message):
    with pytest.raises(ConfigError, match=message):
        make()
