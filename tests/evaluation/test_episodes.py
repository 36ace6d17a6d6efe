"""Measurements on episodes of systems that are known by being run only."""

from __future__ import annotations

from functools import partial

import pytest
import torch
from analytic import Line, line_agent
from evaluation.systems import Predictor, lane, lane_agent

from torchrl_sspl.configs.schema import EvaluationConfig
from torchrl_sspl.evaluation.controllers import AgentController, RandomController
from torchrl_sspl.evaluation.episodes import evaluate_episodes, logged, separating_level
from torchrl_sspl.evaluation.simulation import Episodes, simulate
from torchrl_sspl.modules.observer import gain_matrix
from torchrl_sspl.sets import SAFE, UNLABELLED, UNSAFE

pytestmark = pytest.mark.filterwarnings("ignore::FutureWarning", "ignore::DeprecationWarning")
SIZES = EvaluationConfig(episodes=10, envs=5, horizon=8)


def test_measurements_count_episodes():
    away = evaluate_episodes(lane_agent(3.0), lane, SIZES)
    assert away["touch_unsafe"] == away["leave"] == 1.0  # every episode drives to the end
    assert away.measurements["touch_unsafe"].n == 10
    still = evaluate_episodes(lane_agent(0.0), lane, SIZES)
    assert still["touch_unsafe"] == still["leave"] == 0.0
    assert still["unsafe_called_safe"] in (None, 0.0)  # pictures show whole numbers, so the border lies at 9.5
    loose = evaluate_episodes(lane_agent(3.0, border=11.5), lane, SIZES)
    assert loose["unsafe_called_safe"] > 0.0
    tight = evaluate_episodes(lane_agent(3.0, border=0.5), lane, SIZES)
    assert tight["starts_inside"] == 0.0
    assert tight["touch_unsafe"] is None
    assert tight["safe_called_unsafe"] == 1.0


def test_the_random_episodes_are_those_that_follow_on_the_same_environment():
    found, env = evaluate_episodes(lane_agent(1.0), lane, SIZES), lane([5], SIZES.seed)
    own = simulate(lane_agent(1.0), env, episodes=10, horizon=8)
    chance = simulate(AgentController(lane_agent(1.0), RandomController.within(env, SIZES.seed + 1)), env, episodes=10, horizon=8)
    for name, episodes in (("own", own), ("chance", chance)):
        for column in ("barrier", "actions", "alive", "region", "prediction_error"):
            assert torch.equal(getattr(found.arrays[name], column), getattr(episodes, column)), (name, column)
    assert found.arrays["own"].frames.shape[1] == 1


def test_policies_without_a_barrier_are_measured_by_the_same_call():
    found = {name: evaluate_episodes(p, lane, SIZES) for name, p in (
        ("function", lambda pixels: torch.full((len(pixels),), 3.0)),
        ("predict", Predictor(3.0)),
        ("agent", lane_agent(3.0)),
    )}  # fmt: skip
    for name in ("policy_touch_unsafe", "random_touch_unsafe"):
        assert found["function"][name] == found["predict"][name] == found["agent"][name] is not None
    for name in ("touch_unsafe", "leave", "starts_inside", "unsafe_called_safe", "on_policy_error_max"):
        assert found["function"][name] is None, name
        assert found["agent"][name] is not None, name
    assert "lipschitz_sampled" not in found["function"].measurements
    assert logged(found["function"])["eval_leave"] != logged(found["function"])["eval_leave"]  # not a number
    assert set(logged(found["function"])) == set(logged(found["agent"]))


def test_the_level_keeps_held_out_observations_of_U_outside():
    def episodes(barrier, region, alive=None):
        value = torch.tensor(barrier)[:, None]
        kept = torch.ones_like(value, dtype=torch.bool) if alive is None else torch.tensor(alive)[:, None]
        return Episodes(value[1:, :, None], torch.tensor(region)[:, None], kept, barrier=value)

    assert separating_level([episodes([-0.3, 0.5], [SAFE, UNSAFE])], 0.02) == 0.0  # never raised
    assert separating_level([episodes([-0.3, -0.1], [SAFE, UNSAFE])], 0.02) == pytest.approx(-0.12)
    assert separating_level([episodes([-0.3, -0.1], [SAFE, UNSAFE], [True, False])], 0.02) == 0.0
    assert separating_level([episodes([-0.3, -0.1], [SAFE, UNLABELLED])], 0.02) == 0.0
    # With a reserve: to the middle between S and U, no lower than the reserve unless U asks for it, and not for nothing.
    for safe, unsafe, level in ((-0.2, 0.1, -0.05), (-0.4, 0.1, -0.1), (-0.4, -0.2, -0.22), (0.1, 0.2, 0.0), (0.1, 0.01, -0.01)):
        assert separating_level([episodes([safe, unsafe], [SAFE, UNSAFE])], 0.02, 0.1) == pytest.approx(level)


def test_an_agent_in_float64_is_measured_as_in_float32():
    sizes = EvaluationConfig(episodes=4, envs=4, horizon=3)
    one, two = (evaluate_episodes(agent, Line, sizes) for agent in (line_agent(), line_agent().double()))
    assert two["starts_inside"] == one["starts_inside"]
    assert two["unsafe_called_safe"] == one["unsafe_called_safe"]


def test_a_picture_of_u_that_looks_safe_counts_although_the_memory_knows_better():
    agent = line_agent()
    agent.gain = gain_matrix(0.1, 2)  # what is remembered counts more than the picture
    # At the end of the line the camera shows the middle; the memory knows where the way to it led.
    env = partial(Line, shown=lambda x: torch.where(x.abs() > 0.999, 0.0, x))
    found = evaluate_episodes(agent, env, EvaluationConfig(episodes=50, envs=50, horizon=4))
    own, chance = found.arrays["own"], found.arrays["chance"]
    both = own.joined(chance)
    unsafe = (both.region == UNSAFE) & both.alive
    events = (unsafe & ((both.barrier <= 0) | (both.seen <= 0))).any(0)
    assert int(events.sum()) > int((unsafe & (both.barrier <= 0)).any(0).sum())
    assert found["unsafe_called_safe"] == pytest.approx(float(events[unsafe.any(0)].float().mean()))
