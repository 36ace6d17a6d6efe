"""The report says of every system what was measured of it, from its evaluation and ``env.system`` alone."""

from __future__ import annotations

import json
import re
from functools import partial
from types import SimpleNamespace

import pytest
import torch

pytest.importorskip("matplotlib")

from torchrl_sspl.configs.schema import Config, EvaluationConfig
from torchrl_sspl.envs import DubinsEnv, PendulumEnv
from torchrl_sspl.envs.dubins import YAW_LAG
from torchrl_sspl.evaluation.controllers import as_controller
from torchrl_sspl.evaluation.episodes import evaluate_episodes
from torchrl_sspl.evaluation.known import evaluate
from torchrl_sspl.evaluation.measurements import Evaluation
from torchrl_sspl.evaluation.outcome import Outcome
from torchrl_sspl.evaluation.simulation import Episodes, simulate
from torchrl_sspl.experiments.report import draw_figures, write_run_report
from torchrl_sspl.lipschitz import SandwichBarrier
from torchrl_sspl.modules import FrameEncoder, LatentDynamics, Policy
from torchrl_sspl.modules.agent import Agent
from torchrl_sspl.viability import viability_kernel

pytestmark = pytest.mark.filterwarnings("ignore:imageio-ffmpeg")
SIZES = EvaluationConfig(episodes=10, horizon=6, grid=15, envs=4)
LOG = [
    {"phase": "joint", "round": 0, "step": 10, "loss_safe": 0.5},
    {"phase": "check", "round": 0, "step": 20, "size": 0.4, "returned": 0.9, "passed": True},
]


def outcome_of(tmp_path, agent, env, evaluations, **more) -> Outcome:
    (tmp_path / "log.jsonl").write_text("".join(json.dumps(row) + "\n" for row in LOG))
    config = Config(out_dir=str(tmp_path), env={"_target_": "some.system"}, evaluation=SIZES)
    return Outcome(tmp_path, agent, config, None if env is None else env.system, evaluations, **more)


def page_of(outcome: Outcome) -> str:
    assert outcome.report == outcome.directory / "report.html"
    page = outcome.report.read_text()
    assert str(outcome.directory) not in page
    assert "<script" not in page
    return re.sub(r'src="data:[^"]*"', "", page)


@pytest.fixture(scope="module")
def pendulum():
    """A tiny pendulum and an untrained agent with half of the states in its set."""
    torch.manual_seed(0)
    env = PendulumEnv(seed=0, image_size=16)
    nets = FrameEncoder(3, pool_to=8), LatentDynamics(3, 1, (8,), 10.0), SandwichBarrier(3, (8, 8)), Policy(3, 1, (8,), 10.0)
    with torch.no_grad():
        level = float(nets[2](nets[0](env.observe(env.sample_states(500)))).median())
    agent, kernel = Agent.from_networks(*nets, level=level), viability_kernel(env, resolution=41)
    return agent, env, kernel, evaluate(agent, env, SIZES, kernel=kernel)


def test_the_pendulum_is_judged_on_own_frames_and_on_gymnasiums(pendulum, tmp_path):
    agent, env, _, found = pendulum
    outcome = outcome_of(
        tmp_path, agent, env, {"own": found, "gymnasium": found}, seconds=61.4, stop_reason="it was good enough",
        budget={"transitions": 16000, "labels of S": 3000, "labels of U": 4000, "resets": 7000},
        checks=[{"round": 0, "size": 0.5, "passed": True}], warnings=["the set is small"], advice=["more data"],
    )  # fmt: skip
    figures = write_run_report(outcome, env)
    names = ["State plane", "Latent space", "From the safe set", "Back from U", "What the agent sees", "Training"]
    assert list(figures) == names
    assert {p.name for p in (tmp_path / "figures").glob("*.png")} == {f"{n.lower().replace(' ', '_')}.png" for n in names}
    page = page_of(outcome)
    assert "<h1>Inverted pendulum from pixels</h1>" in page
    for text in (
        "volume of {B &lt;= 0} over the true kernel", "volume of {B &lt;= 0} over the true kernel (gymnasium frames)",
        "gymnasium frames: volume_over_kernel", "16,000 transitions, 3,000 labels of S, 4,000 labels of U, 7,000 resets",
        "Training took 61 s; it was good enough.", "Warning: the set is small.", "To try: more data.",
        "Held-out checks of every round", "The same start twice, on the true dynamics", "evaluation.horizon",
    ):  # fmt: skip
        assert text in page, text
    assert "out_dir" not in page
    assert list((tmp_path / "figures").glob("episode.*"))


def walked(n: int, steps: int = 4, size: int = 16) -> Episodes:
    """Walks that go straight on; the second hits something, the first is on film."""
    states = torch.tensor([[[-1.5 + 0.1 * t, 0.2 * k, 0.0] for k in range(n)] for t in range(steps + 1)])
    alive = torch.ones(steps + 1, n, dtype=torch.bool)
    events = {name: torch.zeros(n, dtype=torch.bool) for name in ("hit", "entered", "fallen", "left")}
    events["hit"][1:2], events["left"][:1] = True, True
    frames = torch.zeros(steps + 1, 1, 3, size, size, dtype=torch.uint8)
    region = torch.zeros(steps + 1, n, dtype=torch.int64)
    return Episodes(torch.zeros(steps, n, 1), region, alive, states, torch.zeros(steps + 1, n), frames=frames, events=events)


@pytest.mark.slow
def test_the_car_is_shown_by_heading_and_its_walks_from_its_own_description(tmp_path):
    env = DubinsEnv(image_size=32, yaw_lag=YAW_LAG, seed=0)  # trained on a car that turns late, evaluated on its twin
    twin, found = env.known_twin(), Evaluation()
    states = twin.state_space.grid((11, 11, 9))
    agent = SimpleNamespace(barrier=lambda z: 1.2 - z[:, :2].norm(dim=-1, keepdim=True))
    barrier = 1.2 - states[:, :2].norm(dim=-1)
    ahead = simulate(lambda pixels: torch.zeros(len(pixels)), twin, start=twin.sample_states(4, region=twin.safe_set), horizon=5)
    ways = {"trajectories": ahead.states, "actions": ahead.actions, "traces": torch.zeros(6, 4)}
    found.arrays.update(states=states, barrier=barrier, latent=states / 4, viability=-barrier, walks=walked(3), **ways)
    outcome = outcome_of(tmp_path, agent, env, {"own": found})
    figures = write_run_report(outcome, env, title="My car")
    assert list(figures) == [
        "State plane", "Latent space", "From the safe set", "Walks in full physics", "What the agent sees", "Training",
    ]  # fmt: skip
    assert [ax.get_title() for ax in figures["State plane"].axes[:2]] == ["heading 0°", "heading 45°"]
    assert "went wrong (1)" in [t.get_text() for t in figures["Walks in full physics"].legends[0].get_texts()]
    page = page_of(outcome)
    assert "<h1>My car</h1>" in page
    assert "those of a car that turns at once" in page
    assert "The closest call in full physics" in page
    assert "walks from S that fall" in page  # not measured, and said so
    assert "not measured" in page


@pytest.mark.slow
def test_a_system_known_by_being_run_only_is_shown_by_its_episodes(pendulum, tmp_path):
    agent = pendulum[0]
    found = evaluate_episodes(agent, partial(PendulumEnv, image_size=16), SIZES)
    outcome = outcome_of(tmp_path, agent, None, {"own": found})
    figures = write_run_report(outcome, None)
    assert list(figures) == ["Latent space", "Barrier along episodes", "Training"]
    page = page_of(outcome)
    assert "<h1>Safe policy from pixels</h1>" in page
    for text in ("No model of the environment is known", "Measured, without a certificate", "resets with B &lt;= 0"):
        assert text in page
    assert list((tmp_path / "figures").glob("episode.*"))


@pytest.mark.slow
def test_what_acts_without_a_barrier_gets_a_report_of_what_can_be_measured(pendulum, tmp_path):
    _, env, kernel, _ = pendulum

    def stop(state):
        return -20.0 * state[:, 0] - 5.0 * state[:, 1]

    acts = as_controller(stop, reads="state")
    outcome = outcome_of(tmp_path, acts, env, {"own": evaluate(acts, env, SIZES, kernel=kernel)})
    figures = write_run_report(outcome, env)
    assert list(figures) == ["Back from U", "What the agent sees", "Training"]
    assert len(figures["Back from U"].axes) == 2  # path and action, no barrier
    page = page_of(outcome)
    assert "not measured" in page
    assert "Nothing is claimed as proved." in page
    tiny = partial(PendulumEnv, image_size=16)
    bare = outcome_of(tmp_path, acts, None, {"own": evaluate_episodes(lambda p: torch.zeros(len(p)), tiny, SIZES)})
    assert list(draw_figures(bare, None)) == ["Training"]


@pytest.mark.slow
def test_without_a_training_there_are_no_curves_and_no_claims(pendulum, tmp_path):
    agent, env, _, found = pendulum
    outcome = outcome_of(tmp_path, agent, env, {"own": found})
    (tmp_path / "log.jsonl").unlink()
    assert "Training" not in write_run_report(outcome, env)
    page = page_of(outcome)
    assert "Training took" not in page
    assert "What it took:" not in page
    assert "barrier is 2-Lipschitz on all of its domain" in page  # the agent's own proof


def test_a_state_of_one_coordinate_has_no_plane_and_a_report(tmp_path):
    from torchrl_sspl.experiments.report import _of_states

    arrays = {"states": torch.zeros(3, 1), "recovery": torch.zeros(4, 2, 1)}
    env = SimpleNamespace(
        known_twin=lambda: SimpleNamespace(state_dim=1, dt=0.1), system=PendulumEnv().system, safe_set=None,
        state_space=None, unsafe_set=None, sample_states=lambda *a, **k: torch.zeros(2, 2), observe=PendulumEnv().observe,
    )  # fmt: skip
    assert list(_of_states(arrays, None, env)) == ["What the agent sees"]
