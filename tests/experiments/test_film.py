"""A film shows what the agent does beside what happens without it, and says what is known at every moment."""

from __future__ import annotations

from contextlib import suppress

import numpy as np
import pytest
import torch

import torchrl_sspl as sspl
from torchrl_sspl.envs import DubinsEnv, Opening, PendulumEnv
from torchrl_sspl.evaluation.known import barrier_of
from torchrl_sspl.experiments.film import Film
from torchrl_sspl.journal import journal


def kinds(take):
    return [kind for _, kind in take.said]


@pytest.fixture(scope="module")
def pendulum():
    return Film(sspl.load("pendulum"), PendulumEnv(seed=0), seconds=2.5)


def test_what_pushes_the_pendulum_over_does_not_do_so_behind_the_filter(pendulum):
    opening = pendulum.env.system.openings[1]
    alone, protected = pendulum.scene(opening, seed=0).takes
    assert alone.said[-1] == ("in the unsafe set U", "bad")
    assert not any("proof" in text for text, _ in alone.said)  # it is about what the agent does
    assert set(kinds(protected)) == {"good"}
    assert protected.said[0][0] == "inside: the proof applies"
    assert len(protected.said) == 51
    assert torch.equal(alone.states[0], protected.states[0])
    # It stops a moment after U is entered: 1.2 s are 24 steps.
    assert len(kinds(alone)) - kinds(alone).index("bad") == 25


def test_the_policy_alone_is_shown_beside_no_action_where_there_is_no_nominal_policy(pendulum):
    alone, learned = pendulum.scene(Opening("A", (0.9, -0.9)), seed=0).takes
    assert (alone.name, learned.name) == ("without protection", "the learned policy")
    falls = pendulum.env.dynamics(torch.tensor([[0.9, -0.9]]), torch.zeros(1, 1))
    assert torch.allclose(alone.states[1], falls[0])
    assert set(kinds(learned)) == {"good"}
    assert next(iter(learned.pictures)).shape == (300, 300, 3)


def test_what_acts_without_a_barrier_has_no_filter_and_no_verdict():
    film = Film(lambda pixels: torch.zeros(len(pixels)), PendulumEnv(seed=0, image_size=16), seconds=0.2)
    assert film.levels({}) is None
    alone, policy = film.scene(Opening("A", (0.1, 0.0)), seed=0).takes
    assert alone.values is policy.values is None
    assert policy.said == [("", "fair")] * 5
    assert len(film.scene(film.env.system.openings[1], seed=0).takes) == 1


@pytest.mark.parametrize(("name", "env"), [("pendulum", PendulumEnv), ("quadruped", DubinsEnv)])
def test_who_starts_at_the_border_of_the_set_starts_inside(name, env):
    system = env(seed=0)
    (start,) = (opening.start for opening in system.system.openings if "border of the safe set" in opening.title)
    state = torch.tensor([start])
    assert -0.15 < float(barrier_of(sspl.load(name), system, state)) < 0.0
    assert not bool(system.unsafe_set.contains(state))


@pytest.mark.parametrize("k", [0, *(pytest.param(k, marks=pytest.mark.slow) for k in (1, 2, 3))])
def test_every_walk_of_the_film_enters_u_without_protection_and_goes_on_for_eight_seconds_behind_the_filter(k):
    env = DubinsEnv(seed=0)
    film = Film(sspl.load("quadruped"), env, seconds=8.0)
    alone, protected = film.scene(env.system.openings[k], seed=0).takes
    assert "bad" in kinds(alone)
    assert protected.name == "behind the safety filter"
    assert set(protected.said) == {("inside: the proof applies", "good")}
    assert len(protected.said) == round(8.0 / env.dt) + 1


def test_pictures_that_an_interrupted_report_has_drawn_are_not_drawn_again(tmp_path, monkeypatch):
    monkeypatch.setattr("torchrl_sspl.journal._SHORT", 0.0)
    drawn = []

    class Stage:
        def follow(self, bodies, dt):
            for body in bodies:
                drawn.append(body)
                yield np.full((4, 4, 3), body, np.uint8)

    film = Film(sspl.load("pendulum"), PendulumEnv(seed=0))
    film.__dict__["_stage"] = Stage()
    with suppress(KeyboardInterrupt), journal(tmp_path, "run"):
        first = [*film._drawn([1, 2, 3], "alone", torch.zeros(1))]
        next(film._drawn([4, 5], "behind the filter", torch.zeros(1)))
        raise KeyboardInterrupt
    drawn.clear()
    with journal(tmp_path, "run"):
        again = [*film._drawn([1, 2, 3], "alone", torch.zeros(1))]
        rest = [*film._drawn([4, 5], "behind the filter", torch.zeros(1))]
    assert np.array_equal(first, again)
    assert len(rest) == 2
    assert drawn == [4, 5]


@pytest.mark.slow
@pytest.mark.pybullet
def test_the_robot_hits_without_protection_and_passes_with_it_in_25_pictures_a_second():
    pytest.importorskip("pybullet")
    env = DubinsEnv(seed=0)
    film = Film(sspl.load("quadruped"), env, world=env.physics()(), seconds=3.0)
    alone, learned = film.scene(Opening("Head on", (-1.8, 0.0, 0.0)), seed=0).takes
    first, second = (picture for picture, _ in zip(learned.pictures, range(2), strict=False))
    film.close()
    assert film.rate == 25
    assert alone.said[-1] == ("hits the obstacle", "bad")
    assert learned.said[-1] == ("has left the arena: safe", "good")
    assert set(kinds(learned)) == {"good"}
    moved = (learned.states[1:, :2] - learned.states[:-1, :2]).norm(dim=-1)
    assert moved.mean() == pytest.approx(1.0 / 25, rel=0.05)  # at 1 m/s
    assert first.shape == (228, 228, 3)
    assert (first != second).any()
