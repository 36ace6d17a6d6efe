"""Pictures that methods are asked about: drawn once, and as another camera would show them."""

from __future__ import annotations

from types import SimpleNamespace

import pytest
import torch
from torch.nn import functional as F

from torchrl_sspl.baselines import make, scoring
from torchrl_sspl.baselines.data import pooled
from torchrl_sspl.baselines.pictures import Album, recoloured, shifts
from torchrl_sspl.baselines.scoring import barrier_on
from torchrl_sspl.envs import CMUDubinsEnv, CMUTwoDiscsEnv, DubinsEnv, PendulumEnv
from torchrl_sspl.envs.quadruped.camera import RenderError
from torchrl_sspl.evaluation.measurements import Evaluation


@pytest.mark.parametrize("side", [64, 128, 256, 96, 40])
def test_averages_are_those_of_torch_to_the_bit(side):
    pixels = torch.randint(0, 256, (70, 6, side, side), dtype=torch.uint8, generator=torch.Generator().manual_seed(0))
    assert torch.equal(pooled(pixels), F.adaptive_avg_pool2d(pixels.float(), 32).round().to(torch.uint8))


def test_halves_go_to_the_even_number():
    block = torch.tensor([[0, 0], [1, 1], [2, 3], [3, 2]], dtype=torch.uint8)  # of 2 x 2: 0.5 and 2.5
    tall = torch.cat([block[:2], block[2:]], 1).repeat(1, 16).repeat(32, 1)[None, None]
    assert pooled(tall)[0, 0, 0, :2].tolist() == [0, 2]


def test_an_album_draws_once_and_gives_what_the_environment_shows():
    env = PendulumEnv()
    state = env.state_space.sample(700, torch.Generator().manual_seed(0))
    album = Album(env)
    first = torch.cat(list(album(state)))
    assert torch.equal(first, pooled(env.observe(state)))
    assert torch.equal(torch.cat(list(album(state))), first)
    assert album.drawn == 700
    assert torch.equal(torch.cat(list(album(state, size=None))), env.observe(state))
    assert not torch.equal(torch.cat(list(album(state, "background"))), first)
    tight = Album(env, limit=1 << 20)  # 170 observations of 32 x 32
    for _ in range(2):
        assert torch.equal(torch.cat(list(tight(state))), first)
    assert tight.drawn == 1400


def test_what_has_not_been_asked_for_the_longest_time_is_drawn_again():
    env = PendulumEnv()
    a, b, c = (torch.full((100, 2), v) for v in (0.0, 0.1, 0.2))
    album = Album(env, limit=2 * 100 * 6 * 32 * 32)
    for state in (a, b, a, c, a, b):
        list(album(state))
    assert album.drawn == 400  # b again


@pytest.mark.parametrize("env", [PendulumEnv(), DubinsEnv()], ids=["pendulum", "dubins"])
def test_other_colours_change_what_they_name_and_nothing_else(env):
    state = env.state_space.sample(20, torch.Generator().manual_seed(0))
    own, of = env.draw(state).int(), shifts(env)
    white = (own == 255).all(1)
    cyan = of["background"](state).int()
    assert (cyan.permute(0, 2, 3, 1)[white] == torch.tensor([0, 255, 255])).all()
    changed = of["object"](state).int() != own
    assert not changed.any(1)[white].any()
    colour = torch.tensor([204, 77, 77] if env.state_dim == 2 else [216, 38, 38])[:, None, None]
    named = (own - colour).abs().amax(1) == 0
    assert named.any()
    assert changed.any(1)[named].all()
    dark, bright = of["dark"](state).float(), of["bright"](state).float()
    assert (dark - 0.85 * own).abs().max() <= 0.5
    assert (bright - (1.15 * own).clamp(0, 255)).abs().max() <= 0.5


def test_the_robot_keeps_its_colours_beside_another_obstacle():
    env = DubinsEnv()
    state = torch.tensor([[1.4, 0.9, 0.3], [-1.0, 1.2, 2.0]])
    far = env.draw(torch.tensor([[-1.7, -1.7, 0.0]]))
    robot = (env.draw(state) != far).any(1) & (far == 255).all(1)
    assert robot.any()
    moved = (shifts(env)["object"](state).int() - env.draw(state).int()).abs().amax(1)[robot]
    assert moved.max() <= 8


def test_gymnasiums_pictures_are_nearly_those_of_the_environment():
    pytest.importorskip("pygame")
    env = PendulumEnv()
    state = env.state_space.sample(20, torch.Generator().manual_seed(0))
    assert 0 < (shifts(env)["renderer"](state).int() - env.draw(state).int()).abs().max() < 30


@pytest.mark.pybullet
def test_pybullets_pictures_are_nearly_those_of_the_car():
    pytest.importorskip("pybullet")
    env = DubinsEnv()
    state = env.state_space.sample(10, torch.Generator().manual_seed(0))
    gap = (shifts(env)["renderer"](state).int() - env.draw(state).int()).abs().float()
    assert 0 < gap.mean() < 1.0


def test_other_colours_of_cmus_picture_are_those_that_it_draws_itself():
    env = CMUDubinsEnv([1], image_size=64)
    state, of = env.state_space.sample(30, torch.Generator().manual_seed(0)), shifts(env)
    for name, colours in (("background", {"background": (0.0, 1.0, 1.0)}), ("object", {"obstacle_colour": (1.0, 0.0, 1.0)})):
        drawn = CMUDubinsEnv([1], image_size=64, **colours).draw(state).int()
        assert (of[name](state).int() - drawn).abs().max() <= 1
        assert (env.draw(state).int() - drawn).abs().max() > 200
    assert set(of) == {"dark", "bright", "background", "object"}


@pytest.mark.parametrize("other", [{"arena_half_size": 2.5}, {"obstacle_half_size": 0.2}, {"obstacle_centre": (0.3, 0.0)}], ids=str)
def test_a_car_in_another_world_is_not_shown_in_the_usual_one(other):
    assert set(shifts(DubinsEnv([1], **other))) == set(shifts(DubinsEnv([1]))) - {"renderer"} == {"dark", "bright", "background", "object"}


def test_pictures_that_cannot_be_drawn_are_missing(monkeypatch):
    def fails(*of):
        raise RenderError("camera: expected the robot in the frame")

    monkeypatch.setattr(scoring, "shifts", lambda env: {"renderer": fails})
    env = PendulumEnv([1])
    monkeypatch.setattr(scoring, "barrier_on", fails)
    kernel = SimpleNamespace(contains=lambda state: torch.ones(len(state), dtype=torch.bool), grid=SimpleNamespace(step=[0.1, 0.1]))
    it = scoring._Score(make("imitation"), env, kernel, scoring.ScoreConfig(episodes=2, horizon=1, shifted=2), Evaluation(), None, scoring.nominals(env))
    scoring._shifted(it)
    monkeypatch.setattr(scoring, "paths", fails)
    scoring._shifted_loops(it)
    found = it.out.to_dict().values()
    assert len(found) == 4
    assert all(m["value"] is None and "in the frame" in m["note"] for m in found)


def test_of_another_system_only_the_brightness_changes():
    assert set(shifts(CMUTwoDiscsEnv())) == set(shifts(DubinsEnv(obstacle_shape="disc"))) == {"dark", "bright"}


def test_a_method_on_states_looks_at_no_picture():
    env = PendulumEnv()
    method = make("hocbf")
    method.fit(None, env, None, 0)
    album = Album(env)
    assert barrier_on(method, env, torch.zeros(3, 2), album) is not None
    assert album.drawn == 0


def test_a_mixture_with_a_colour_changes_as_much_as_it_is_mixed():
    half = torch.tensor([229, 166, 166], dtype=torch.uint8)[None, :, None, None]
    assert recoloured(half, (255, 255, 255), (0, 255, 255), 178).flatten().tolist() == [102, 166, 166]
