"""What perfect perception reaches: the published shapes of these filters, on coarse grids."""

from __future__ import annotations

import math

import pytest
import torch

from torchrl_sspl.baselines import BUDGETS, ScoreConfig, make, score, scoring
from torchrl_sspl.baselines.ceilings import collision_cone
from torchrl_sspl.baselines.scoring import adversarial, barrier_on, calibrated_level, harmless, well_inside
from torchrl_sspl.envs import DubinsEnv, GymnasiumPixels, PendulumEnv
from torchrl_sspl.errors import ConfigError
from torchrl_sspl.evaluation import simulate
from torchrl_sspl.viability import viability_kernel


@pytest.fixture(scope="module")
def pendulum():
    env = PendulumEnv()
    return env, viability_kernel(env, resolution=121)


@pytest.fixture(scope="module")
def dubins():
    env = DubinsEnv()
    return env, viability_kernel(env, resolution=(41, 41, 36))


def fitted(name, env, *options):
    method = make(name, options)
    method.fit(None, env, BUDGETS["tiny"], 0)
    return method


def measured(system, name, *options, grid=101, horizon=80, episodes=150):
    env, kernel = system
    method = make(name, options)
    if name == "kernel":
        method.kernel = kernel
    method.fit(None, env, BUDGETS["tiny"], 0)
    sizes = ScoreConfig(episodes=episodes, horizon=horizon, grid=grid, frames=2)
    return score(method, env, sizes, kernel=kernel)


def test_the_depth_barrier_with_published_constants_is_safe_and_holds_half_of_the_kernel(pendulum):
    found = measured(pendulum, "depth")
    # Area of the diamond |angle| + |speed| <= pi/2 - 0.1 over that of the kernel.
    area = 2 * (math.pi / 2 - 0.1) ** 2
    of_kernel = pendulum[1].volume_fraction * math.pi * 3.0
    assert found["claimed_over_kernel"] == pytest.approx(area / of_kernel, abs=0.03)
    assert found["false_safe"] == 0.0
    assert found["claimed_harmless_enter"] == found["claimed_adversarial_enter"] == 0.0
    assert found["claimed_harmless_infeasible"] == 0.0


@pytest.mark.slow
def test_a_lighter_weight_of_the_speed_claims_more_and_fails(pendulum):
    found = measured(pendulum, "depth", "beta=0.5")
    assert found["claimed_over_kernel"] == pytest.approx(0.824, abs=0.03)
    assert found["claimed_harmless_enter"] > 0.8
    gentle = measured(pendulum, "depth", "beta=0.5", "alpha=0.9")
    assert gentle["claimed_harmless_enter"] < 0.1


@pytest.mark.slow
def test_the_margin_of_the_box_claims_everything_and_keeps_nothing(pendulum):
    found = measured(pendulum, "box_margin", grid=201)
    assert found["claimed_over_kernel"] == 1.0
    assert found["false_safe"] == pytest.approx(0.162, abs=0.03)
    assert found["unsafe_called_safe"] == 0.0
    assert found["claimed_harmless_enter"] > 0.95


def test_the_ellipsoid_calls_nothing_safe_falsely_and_is_kept(pendulum):
    found = measured(pendulum, "lqr")
    assert found["claimed_over_kernel"] == pytest.approx(0.231, abs=0.03)
    assert found["false_safe"] == 0.0
    assert found["claimed_harmless_enter"] == found["claimed_adversarial_enter"] == 0.0


@pytest.mark.slow
def test_noise_on_the_state_breaks_a_perfect_filter(pendulum):
    assert 0.005 < measured(pendulum, "depth", "noise=[0.007,0.016]", grid=41, horizon=200, episodes=300)["claimed_harmless_enter"] < 0.2
    assert measured(pendulum, "depth", "noise=[0.02,0.1]", grid=41, horizon=200, episodes=50)["claimed_harmless_enter"] > 0.9


@pytest.mark.parametrize("system", ["pendulum", pytest.param("dubins", marks=pytest.mark.slow)])
def test_the_true_kernel_claims_itself_and_keeps_it(system, request):
    given = request.getfixturevalue(system)
    found = measured(given, "kernel", grid=61 if system == "pendulum" else 21)
    assert found["claimed_over_kernel"] == 1.0
    assert found["false_safe"] == found["unsafe_called_safe"] == 0.0
    assert found["common_harmless_enter"] == found["common_adversarial_enter"] == 0.0
    env, kernel = given
    states = env.state_space.sample(500, torch.Generator().manual_seed(0))
    method = make("kernel")
    method.kernel = kernel
    method.fit(None, env, BUDGETS["tiny"], 0)
    assert torch.equal(method.claims(states), kernel.contains(states))


@pytest.mark.slow
def test_the_cone_is_conservative_and_the_turning_circle_is_not(dubins):
    cone, circle = (measured(dubins, name, grid=31) for name in ("cone", "turning_circle"))
    assert cone["claimed_over_kernel"] == pytest.approx(0.753, abs=0.04)
    assert circle["claimed_over_kernel"] == pytest.approx(0.96, abs=0.03)
    for found in (cone, circle):
        assert found["false_safe"] <= 0.02  # the kernel's grid is coarse
        assert found["claimed_harmless_enter"] <= 0.01
        assert found["claimed_adversarial_enter"] <= 0.01


def test_the_turning_circle_is_what_the_car_drives(dubins):
    env, _ = dubins
    method = fitted("turning_circle", env)
    state = env.state_space.sample(200, torch.Generator().manual_seed(1))
    state = state[~env.unsafe_set.contains(state)]
    clear = []
    for side in (-1.0, 1.0):
        x, ok = state, torch.ones(len(state), dtype=torch.bool)
        for _ in range(63):
            x = env.dynamics(x, torch.full((len(x), 1), side * env.max_action))
            ok &= ~env.unsafe_set.contains(env.wrap(x))
        clear.append(ok)
    assert torch.equal(method.claims(state), clear[0] | clear[1])


def test_the_distance_alone_lets_a_chasing_car_in(dubins):
    found = measured(dubins, "box_margin", grid=31)
    assert found["claimed_over_kernel"] == 1.0
    assert found["claimed_adversarial_enter"] > 0.5


def test_the_cone_is_positive_within_the_circle():
    env = DubinsEnv()
    states = torch.tensor([[0.8, 0.0, 0.0], [0.95, 0.0, math.pi], [-1.2, 0.0, 0.0], [1.2, 0.0, 0.0]])
    assert (collision_cone(env, states) > 0).tolist() == [True, True, True, False]


def test_the_adversary_wants_harm_and_the_other_nothing():
    pendulum, car = PendulumEnv(), DubinsEnv()
    assert adversarial(pendulum)(torch.tensor([[0.1, 0.0], [-0.1, 0.0]])).flatten().tolist() == [10.0, -10.0]
    assert harmless(pendulum)(torch.ones(3, 2)).abs().sum() == 0
    start = torch.tensor([[-1.8, 0.5, 0.3], [1.5, -1.5, 2.0]])
    method = fitted("box_margin", car)
    ended = simulate(method.controller(adversarial(car)), car, start=start, horizon=40)
    assert car.unsafe_set.contains(ended.states).any(0).all()
    with pytest.raises(ConfigError, match="expected a pendulum or a Dubins car"):
        adversarial(GymnasiumPixels)


def test_the_controller_counts_what_it_does(pendulum):
    env, _ = pendulum
    acts = fitted("depth", env).controller(adversarial(env))
    simulate(acts, env, start=torch.zeros(7, 2), horizon=4)
    assert acts.steps == 7 * 4
    assert acts.infeasible == 0
    assert 0 < acts.deviation / acts.steps <= 20.0


def test_the_common_set_keeps_from_the_rim(pendulum):
    env, kernel = pendulum
    states = env.state_space.sample(4000, torch.Generator().manual_seed(0))
    inner, outer = well_inside(kernel, states), kernel.contains(states)
    assert (inner <= outer).all()
    assert 0.8 < inner.sum() / outer.sum() < 1.0


def test_who_claims_nothing_has_an_empty_calibrated_set(pendulum):
    env, kernel = pendulum
    method = fitted("lqr", env)
    method.barrier = lambda seen: torch.ones(len(seen))
    found = score(method, env, ScoreConfig(episodes=20, horizon=3, grid=21, frames=1), kernel=kernel)
    assert found["calibrated_claimed_over_kernel"] == found["claimed_over_kernel"] == 0.0  # it counts in a mean over seeds
    assert found.measurements["calibrated_harmless_enter"].value is None


def test_a_claim_too_small_to_place_a_level_by_has_an_empty_calibrated_set(pendulum, monkeypatch):
    env, kernel = pendulum
    starts = scoring._Score.starts
    monkeypatch.setattr(scoring._Score, "starts", lambda it, keep, index, n: starts(it, keep, index, n)[: 0 if index == 2 else n])
    found = score(fitted("lqr", env), env, ScoreConfig(episodes=20, horizon=3, grid=21, frames=1), kernel=kernel)
    assert found["claimed_over_kernel"] > 0.0
    assert found["calibrated_claimed_over_kernel"] == 0.0
    assert "no episode was found" in found.measurements["calibrated_harmless_enter"].note


def test_a_calibrated_level_never_rises_and_may_leave_nothing():
    value = torch.linspace(-1, 0, 1001)
    assert calibrated_level(value, torch.zeros(1001, dtype=torch.bool)) == 0.0
    assert calibrated_level(value, value > -0.5) == pytest.approx(-0.5, abs=0.01)
    assert calibrated_level(torch.tensor([-0.1, 0.05, 0.06]), torch.tensor([False, False, True])) == 0.0  # noise at a start
    assert calibrated_level(value, torch.ones(1001, dtype=torch.bool)) == -math.inf


@pytest.mark.parametrize(
    ("name", "env", "options", "message"),
    [
        ("cone", PendulumEnv, [], "expected a DubinsEnv, received PixelPendulumEnv"),
        ("lqr", DubinsEnv, [], "expected a PixelPendulumEnv"),
        ("depth", PendulumEnv, ["noise=[0.1]"], "expected noise of 2 numbers"),
        ("depth", PendulumEnv, ["alpha=1.5"], r"alpha in \[0, 1\)"),
    ],
)
def test_what_does_not_fit_is_refused(name, env, options, message):
    with pytest.raises(ConfigError, match=message):
        make(name, options).fit(None, env(), BUDGETS["tiny"], 0)


def test_unknown_names_and_options_are_refused():
    with pytest.raises(ConfigError, match="expected a method, one of"):
        make("nothing")
    with pytest.raises(ConfigError, match="expected options among alpha"):
        make("lqr", ["beta=1"])


def test_values_are_those_of_the_states(pendulum):
    env, _ = pendulum
    assert barrier_on(fitted("hocbf", env), env, torch.tensor([[0.0, 0.0], [0.0, 1.6]])).sign().tolist() == [-1.0, 1.0]
