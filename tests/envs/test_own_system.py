"""A system with known dynamics is one file: that of docs/extend.md, taken as it stands there."""

from __future__ import annotations

import re
from pathlib import Path

import pytest
import torch

from torchrl_sspl.configs.schema import Config, EvaluationConfig
from torchrl_sspl.evaluation.controllers import as_controller
from torchrl_sspl.evaluation.known import evaluate
from torchrl_sspl.evaluation.outcome import Outcome, write_metrics
from torchrl_sspl.evaluation.simulation import simulate
from torchrl_sspl.lipschitz import SandwichBarrier
from torchrl_sspl.modules import FrameEncoder, LatentDynamics, Policy
from torchrl_sspl.modules.agent import Agent
from torchrl_sspl.viability import viability_kernel

PAGE = Path(__file__).parents[2] / "docs" / "extend.md"
SIZES = EvaluationConfig(episodes=30, horizon=20)


@pytest.fixture(scope="module")
def source():
    if not PAGE.is_file():
        pytest.skip("needs a checkout")
    return next(code for code in re.findall(r"^```python\n(.*?)^```", PAGE.read_text(), re.DOTALL | re.MULTILINE) if "CartEnv(" in code)


@pytest.fixture(scope="module")
def env(source):
    names = {}
    exec(source, names)
    return names["CartEnv"](seed=0)


@pytest.fixture(scope="module")
def kernel(env):
    return viability_kernel(env, resolution=env.system.kernel_grid)


def test_it_takes_less_than_60_lines_with_its_picture(source):
    assert source.count("\n") < 60
    assert len(re.findall(r"^class ", source, re.MULTILINE)) == 1


def test_its_kernel_is_what_braking_allows(env, kernel):
    # At speed v > 0 the cart stops within v^2 / 2 u_max and, in steps of dt, half a step more or less.
    speed = torch.linspace(0.0, 1.0, 11)
    edge = 0.8 - speed.square() / 2
    reach = 0.5 * speed * env.dt + 0.06  # half a step, and a cell of the grid and its neighbour
    assert kernel.contains(torch.stack([edge - reach, speed], -1)[:-1]).all()
    assert not kernel.contains(torch.stack([edge + reach, speed], -1)).any()


def test_pictures_show_place_and_speed(env):
    pixels = env.observe(torch.tensor([[0.0, 0.0], [0.0, 0.8], [0.5, 0.0]]))
    assert pixels.shape == (3, 6, 32, 32)
    assert torch.equal(pixels[0, :3], pixels[0, 3:])
    assert torch.equal(pixels[0, 3:], pixels[1, 3:])
    assert not torch.equal(pixels[0, :3], pixels[1, :3])
    assert not torch.equal(pixels[0], pixels[2])
    assert env.rollout(3)["pixels"].shape == (1, 3, 6, 32, 32)


def brake(state):
    """A controller with a barrier: how far it runs on while it brakes, less 0.1 m of reserve."""
    place, speed = state[:, :1], state[:, 1:]
    ahead = place + speed * speed.abs() / 2
    return -10 * (place + speed), (ahead.abs() - 0.6).maximum(place.abs() - 0.7)


def test_the_closed_loop_runs_on_its_dynamics(env):
    start = torch.tensor([[0.5, 0.4], [-0.3, 0.0]])
    episodes = simulate(as_controller(brake, reads="state"), env, start=start, horizon=30, film=1)
    first = env.dynamics(start, episodes.actions[0])
    assert torch.equal(episodes.states[1], first)
    assert torch.equal(episodes.frames[:, 0], env.draw(episodes.states[:, 0]))
    assert (episodes.region != 2).all()


def small_agent(env) -> Agent:
    """Untrained, with half of the states in its set."""
    torch.manual_seed(0)
    nets = FrameEncoder(2, pool_to=8), LatentDynamics(2, 1, (8,)), SandwichBarrier(2, (8, 8)), Policy(2, 1, (8,))
    with torch.no_grad():
        level = float(nets[2](nets[0](env.observe(env.sample_states(500)))).median())
    return Agent.from_networks(*nets, level=level)


@pytest.mark.filterwarnings("ignore:imageio-ffmpeg")
@pytest.mark.parametrize("what", ["agent", pytest.param("controller", marks=pytest.mark.slow)])
def test_evaluation_metrics_and_report_take_it_as_any_other(env, kernel, what, tmp_path):
    pytest.importorskip("matplotlib")
    from torchrl_sspl.experiments.report import write_run_report

    acts = small_agent(env) if what == "agent" else as_controller(brake, reads="state")
    found = evaluate(acts, env, SIZES, kernel=kernel)
    if what == "controller":
        assert found["false_safe"] == found["unsafe_called_safe"] == found["safe_called_unsafe"] == 0.0
        assert found["safe_rollouts_leave"] == found["safe_rollouts_touch_unsafe"] == 0.0
        assert 0.5 < found["volume_over_kernel"] < 1.0
    outcome = Outcome(tmp_path, acts, Config(out_dir=str(tmp_path), evaluation=SIZES), env.system, {"own": found})
    figures = write_run_report(outcome, env)
    assert {"State plane", "From the safe set", "Back from U", "What the agent sees"} <= set(figures)
    assert figures["State plane"].axes[0].get_xlabel() == "place [m]"
    assert figures["Back from U"].axes[-1].get_ylabel() == "force [N]"
    page = outcome.report.read_text()
    assert "Cart between two walls, from pixels" in page
    assert "{B &lt;= 0} outside the true kernel" in page
    if what == "agent":
        assert outcome.rows()[0][-1] in write_metrics(outcome).read_text()
