"""Measurements against the true kernel: of agents, of rivals with a barrier of their own, of bare policies."""

from __future__ import annotations

import ast
import json
from dataclasses import replace
from functools import cache
from pathlib import Path

import pytest
import torch
from evaluation.systems import Predictor, straight_ahead
from plain import small_agent

import torchrl_sspl.evaluation
from torchrl_sspl.configs.schema import EvaluationConfig
from torchrl_sspl.envs import DubinsEnv, PendulumEnv
from torchrl_sspl.envs.dubins import YAW_LAG
from torchrl_sspl.evaluation.controllers import as_controller
from torchrl_sspl.evaluation.known import _Run, barrier_of, encode_states, evaluate, latency, states_where
from torchrl_sspl.evaluation.measurements import Evaluation, lipschitz, quantiles, share
from torchrl_sspl.lipschitz import lipschitz_lower
from torchrl_sspl.modules.agent import load
from torchrl_sspl.sets import Box
from torchrl_sspl.viability import viability_kernel

SMALL = EvaluationConfig(episodes=20, horizon=5, grid=11, kernel_grid=31)
BARRIER = ("unsafe_called_safe", "safe_called_unsafe", "volume_over_kernel", "false_safe", "false_safe_of_doomed",
           "worst_safe_barrier", "worst_unsafe_barrier", "barrier_depth", "safe_rollouts_touch_unsafe", "safe_rollouts_leave",
           "worst_next_barrier")  # fmt: skip


def pendulum() -> PendulumEnv:
    return PendulumEnv(seed=0, image_size=16)


@cache
def kernel():
    return viability_kernel(pendulum(), resolution=31)


@cache
def of_small_agent() -> Evaluation:
    return evaluate(small_agent(), pendulum(), SMALL, kernel=kernel())


class Rival:
    """Reads states; its barrier is the true kernel's value with its sign turned, its action pushes upright."""

    reads = "state"

    def __init__(self, value):
        self.value = value

    def act(self, state):
        return (-4 * state[:, :1] - 2 * state[:, 1:2]).clamp(-2, 2), self.value(state)


def test_a_bare_policy_gets_all_that_needs_no_barrier():
    found = evaluate(lambda pixels: torch.zeros(len(pixels)), pendulum(), SMALL, kernel=kernel())
    for name in BARRIER:
        assert found[name] is None, name
    assert found.measurements["labelled_safe_rollouts_touch_unsafe"].n == 4
    assert found.measurements["unsafe_rollouts_return"].n == 4
    assert "no barrier" in found.measurements["unsafe_rollouts_return"].note
    assert found["latency_p99"] > 0
    assert found.arrays["viability"].shape == (121,)
    assert not any(name.startswith(("lipschitz", "random_action")) for name in found.measurements)


def test_policies_of_other_libraries_are_measured_by_the_same_call():
    config, ours = EvaluationConfig(episodes=10, horizon=40, grid=11), lambda pixels: torch.full((len(pixels),), 2.0)
    theirs = Predictor(2.0)
    found = [evaluate(p, pendulum(), config, kernel=kernel()) for p in (ours, theirs, theirs.predict)]
    names = [n for n in found[0].measurements if n != "latency_p99"]
    for other in found[1:]:
        assert {n: other[n] for n in names} == {n: found[0][n] for n in names}
    assert found[0]["labelled_safe_rollouts_touch_unsafe"] == 1.0  # 2 N m turn it over


def test_a_rival_with_a_barrier_of_its_own_is_measured_on_it():
    true = kernel()
    found = evaluate(Rival(lambda x: -true.interpolate(x)), pendulum(), SMALL, kernel=true)
    assert found["volume_over_kernel"] == 1.0
    assert found["false_safe"] == found["unsafe_called_safe"] == found["safe_called_unsafe"] == 0.0
    assert found.measurements["safe_rollouts_touch_unsafe"].n == 20
    assert "on_policy_error_max" not in found.measurements
    nobody = evaluate(Rival(lambda x: torch.ones(len(x))), pendulum(), SMALL, kernel=true)
    assert nobody["volume_over_kernel"] == 0.0
    assert nobody["safe_called_unsafe"] == 1.0
    assert nobody["safe_rollouts_leave"] is None
    assert nobody.measurements["safe_rollouts_leave"].note == "{B<=0} is empty"


def test_no_number_is_an_error_of_either_kind():
    found = evaluate(Rival(lambda x: torch.where(x[:, 1] > 0, torch.nan, -1.0)), pendulum(), SMALL, kernel=kernel())
    assert found["unsafe_called_safe"] == 1.0
    assert min(found[name] for name in ("safe_called_unsafe", "safe_rollouts_leave")) > 0.1
    assert found["volume_over_kernel"] < 0.7


def test_the_sets_are_counted_on_the_grid():
    true, env = kernel(), pendulum()
    found = evaluate(Rival(lambda x: x[:, 0].abs() - 1.2), env, SMALL, kernel=true)
    x = env.state_space.grid(11)
    inside, viable, unsafe = x[:, 0].abs() <= 1.2, true.contains(x), env.unsafe_set.contains(x)
    m = found.measurements
    assert (m["volume_over_kernel"].events, m["volume_over_kernel"].n) == (int((inside & viable).sum()), int(viable.sum()))
    assert (m["false_safe"].events, m["false_safe"].n) == (int((inside & ~viable).sum()), int(inside.sum()))
    assert (m["unsafe_called_safe"].events, m["unsafe_called_safe"].n) == (int((inside & unsafe).sum()), int(unsafe.sum()))
    assert m["false_safe_of_doomed"].n == int((~unsafe & ~viable).sum())
    assert found["worst_unsafe_barrier"] == pytest.approx(1.2 - float(x[unsafe][:, 0].abs().min()))
    assert found["barrier_depth"] == pytest.approx(1.2)


def test_an_agent_gets_everything():
    found = of_small_agent()
    assert set(BARRIER) <= set(found.measurements)
    for name in ("covering_radius_q99", "random_action_error_max", "safety_margin", "q3_with_margin", "lipschitz_ratio"):
        assert found[name] is not None
    assert found.arrays["latent"].shape == (121, 3)


def test_random_numbers_are_drawn_in_the_order_of_the_published_tables():
    agent, env, found, n = small_agent(), pendulum(), of_small_agent(), 25 * SMALL.episodes
    generator = torch.Generator().manual_seed(SMALL.seed)
    value = agent.barrier(encode_states(agent, env, env.safe_set.sample(2 * n, generator=generator)))
    assert found["worst_safe_barrier"] == float(value.max())
    assert found["lipschitz_sampled"] == lipschitz_lower(agent.barrier, -1.0, 1.0, n=20000, generator=generator)
    start = env.sample_states(n, generator=generator)
    action = (2 * torch.rand(n, 1, generator=generator) - 1) * env.max_action
    z, after = (encode_states(agent, env, x) for x in (start, env.wrap(env.dynamics(start, action))))
    assert found["random_action_error_mean"] == pytest.approx(float((agent.dynamics(z, action) - after).norm(dim=-1).mean()), 1e-3)


@pytest.mark.parametrize(("episodes", "samples"), [(1, 25), (199, 4975), (200, 5000), (10_000, 5000)])
def test_measurements_of_single_states_have_5000_samples_unless_few_episodes_are_asked_for(episodes, samples):
    run = _Run(*[None] * 3, EvaluationConfig(episodes=episodes), *[None] * 6)
    assert run.samples == samples


def test_unsafe_states_have_a_grid_of_their_own_where_the_system_says_so():
    rival = Rival(lambda x: x[:, 0])
    found = evaluate(rival, DubinsEnv(seed=0, image_size=32), EvaluationConfig(episodes=5, horizon=2, grid=7, kernel_grid=11))
    m = found.measurements["unsafe_called_safe"]
    assert (m.n, m.events) == (7 * 7 * 4, 4 * 7 * 4)  # x = -0.7 ... 0 of seven
    assert found["worst_unsafe_barrier"] == pytest.approx(0.7)
    disc = DubinsEnv(seed=0, image_size=32, obstacle_shape="disc", obstacle_centre=[0.3, 0.0])
    found = evaluate(rival, disc, EvaluationConfig(episodes=5, horizon=2, grid=7, kernel_grid=11))
    assert 0 < found.measurements["unsafe_called_safe"].n < 7 * 7 * 4
    assert found["worst_unsafe_barrier"] == pytest.approx(0.4, abs=1e-6)


def test_what_has_no_node_in_u_is_not_measured_rather_than_perfect():
    between = pendulum()
    between.unsafe_set = Box([1.0, 1.0], [1.15, 1.15])
    found = evaluate(small_agent(), between, SMALL, kernel=kernel())
    for name in ("unsafe_called_safe", "worst_unsafe_barrier"):
        assert found[name] is None
        assert found.measurements[name].note.endswith("of which none lies in U")
    assert found["q2_with_margin"] is None
    assert found["worst_safe_barrier"] is not None


def test_without_episodes_it_is_said_that_none_were_asked_for():
    found = evaluate(Rival(lambda x: x[:, 0].abs() - 1.2), pendulum(), SMALL, kernel=kernel(), episodes=0)
    for name in ("safe_rollouts_touch_unsafe", "safe_rollouts_leave", "worst_next_barrier"):
        assert found[name] is None
        assert found.measurements[name].note == "no episodes were asked for"
    assert found["volume_over_kernel"] > 0


def test_grids_are_the_systems_own_or_in_its_proportions():
    class Coarse(PendulumEnv):
        @property
        def system(self):
            from dataclasses import replace

            return replace(super().system, state_grid=(8, 5), kernel_grid=(31, 21))

    policy = lambda pixels: torch.zeros(len(pixels))  # noqa: E731
    own = evaluate(policy, Coarse(seed=0, image_size=16), EvaluationConfig(episodes=5, horizon=2))
    assert len(own.arrays["states"]) == 8 * 5
    scaled = evaluate(policy, Coarse(seed=0, image_size=16), EvaluationConfig(episodes=5, horizon=2, grid=16, kernel_grid=16))
    assert len(scaled.arrays["states"]) == 16 * 10


def test_a_lagging_car_is_measured_as_the_twin_whose_kernel_is_known():
    rival, config = Rival(lambda x: x[:, 0]), EvaluationConfig(episodes=10, horizon=4, grid=7, kernel_grid=11)
    late, twin = (evaluate(rival, DubinsEnv(seed=0, image_size=32, **o), config) for o in ({"yaw_lag": YAW_LAG}, {}))
    names = [n for n in twin.measurements if n != "latency_p99"]
    assert {n: late[n] for n in names} == {n: twin[n] for n in names}
    assert late.arrays["states"].shape[1] == 3


def test_barriers_of_agents_and_functions_agree():
    agent, env = small_agent(), pendulum()
    x = env.sample_states(1200)
    assert torch.allclose(barrier_of(agent, env, x), barrier_of(as_controller(agent.act), env, x), atol=1e-5)
    assert barrier_of(lambda pixels: torch.zeros(len(pixels)), env, x) is None


def test_foreign_frames_change_what_is_seen():
    env = pendulum()
    black = evaluate(small_agent(), env, SMALL, kernel=kernel(), draw=lambda x: torch.zeros(len(x), 3, 16, 16, dtype=torch.uint8))
    assert black["covering_radius_max"] == 0.0
    assert of_small_agent()["covering_radius_max"] > 0.0


def test_latency_is_a_percentile_in_milliseconds():
    found = latency(straight_ahead(), DubinsEnv(batch_size=[1], image_size=64), frames=20)
    assert found.unit == "ms"
    assert found.n == 20
    assert 0.0 < found.value < 1000.0


def test_rejection_gives_up_where_nothing_is_found():
    tried = []
    found = states_where(lambda x: tried.append(1) or x[:, 0] > 2, Box([-1.0], [1.0]), 5, torch.Generator(), draws=3)
    assert len(found) == 0
    assert len(tried) == 3


def test_quantiles_are_order_statistics():
    out = Evaluation()
    quantiles(out, "e", torch.arange(1.0, 2001.0).flip(0), "m", "")
    assert (out["e_q99"], out["e_q999"], out["e_max"], out["e_mean"]) == (1980.0, 1998.0, 2000.0, 1000.5)
    quantiles(out, "none", torch.zeros(0), "m", "")
    assert out["none_max"] is None
    assert share("s", 0, 0).value is None
    assert share("s", 0, 3000).upper == pytest.approx(1 - 0.05 ** (1 / 3000))


def test_who_leaves_where_that_counts_as_u_has_entered_it():
    far = Box([1.0, -2.0], [1.1, 2.0])  # nobody comes there: whoever falls to the other side leaves before

    env = PendulumEnv(seed=0, image_size=16, unsafe_set=far)
    sizes = EvaluationConfig(episodes=20, horizon=60, grid=11, kernel_grid=31)
    found = evaluate(lambda pixels: torch.full((len(pixels), 1), -10.0), env, sizes)
    assert found["labelled_safe_rollouts_touch_unsafe"] == 1.0


@pytest.mark.slow
def test_steps_that_nobody_looked_at_are_not_counted(monkeypatch):
    """A car that has left its arena stands still, and nothing is asked of it."""

    def some_where(keep, space, n, generator, draws=60):  # of 40 states, not of 2000: their pictures take half a minute
        state = space.sample(40, generator=generator)
        return state[keep(state)][:n]

    monkeypatch.setattr("torchrl_sspl.evaluation.known.states_where", some_where)
    agent, env = load("quadruped"), DubinsEnv(seed=0, image_size=128)
    sizes = EvaluationConfig(episodes=10, horizon=60, grid=3, kernel_grid=15)
    found = evaluate(agent, env, sizes)
    steps = found.measurements["corrections_cut"].n
    assert 10 < steps < 10 * 60 / 2
    assert found.measurements["on_policy_step_error_q99"].n == steps


def test_only_what_is_drawn_has_bounds():
    found = of_small_agent().measurements
    for name in ("unsafe_called_safe", "volume_over_kernel", "q2_with_margin", "q3_with_margin"):  # nodes of a grid
        assert found[name].value is not None
        assert found[name].upper is None
    assert found["q1_with_margin"].upper is not None
    assert found["safe_called_unsafe"].upper is not None


def test_nothing_here_asks_for_the_name_of_a_type():
    for path in Path(torchrl_sspl.evaluation.__file__).parent.glob("*.py"):
        tree = ast.parse(path.read_text())
        names = {n.id for n in ast.walk(tree) if isinstance(n, ast.Name)} | {
            a.name for n in ast.walk(tree) if isinstance(n, (ast.Import, ast.ImportFrom)) for a in n.names
        }
        assert not names & {"DubinsEnv", "PendulumEnv", "QuadrupedEnv", "GymnasiumPixels"}, path.name
        for node in ast.walk(tree):
            if isinstance(node, (ast.Compare, ast.Subscript, ast.Match)):
                asked = [n for n in ast.walk(node) if isinstance(n, ast.Attribute) and n.attr in ("__name__", "__qualname__")]
                assert not asked, f"{path.name}:{node.lineno}"


def test_a_lipschitz_constant_is_certified_only_where_it_was_proved():
    agent = load("pendulum")
    for proved in (True, False, None):
        agent.description["lipschitz"] = {} if proved is None else {"proved": proved}
        out = Evaluation()
        lipschitz(out, agent, torch.Generator().manual_seed(0))
        assert out["lipschitz_certified"] == (agent.lipschitz_bound if proved else None)
        assert out["lipschitz_sampled"] <= agent.lipschitz_bound
    agent.description["lipschitz"], agent.lipschitz_bound = {"proved": True}, 1.0
    lipschitz(out, agent, torch.Generator().manual_seed(0))
    assert out["lipschitz_certified"] is None
    assert "refuted by a slope of" in out.measurements["lipschitz_certified"].note


def test_what_is_safe_falsely_is_not_measured_against_a_kernel_that_is_too_large():
    early = replace(kernel(), converged=False)
    found = evaluate(Rival(lambda x: x[:, 0].abs() - 1.2), pendulum(), SMALL, kernel=early)
    assert found["false_safe"] is found["false_safe_of_doomed"] is None
    assert "has not converged" in found.measurements["false_safe"].note
    assert found["volume_over_kernel"] > 0  # over one that is too large it is too small


def test_of_an_empty_set_there_is_no_margin_of_the_dynamics():
    agent = small_agent()
    agent.barrier[-1].bias.data.fill_(9.0)
    found = evaluate(agent, pendulum(), SMALL, kernel=kernel())
    assert found["dynamics_margin"] is found["q3_with_margin"] is None
    assert found["safety_margin"] > 0
    assert found["q2_with_margin"] is not None
    json.dumps(found.to_dict(), allow_nan=False)
