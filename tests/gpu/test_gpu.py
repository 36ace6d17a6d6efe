"""On a GPU: the same numbers as on the CPU, training with all options, environments and evaluation on the device.

Without a GPU ``test_simulated_cuda.py`` runs these on a simulated one.
"""

from __future__ import annotations

import copy
import dataclasses
from pathlib import Path

import pytest
import torch
from conformance.cases import CASES, Case
from plain import small_agent
from tensordict import TensorDict
from tiny import SAVED, SINGLE, TINY, TINY_PHASES
from torchrl.collectors import Collector
from torchrl.data import LazyTensorStorage, TensorDictReplayBuffer
from torchrl.objectives import SoftUpdate

from torchrl_sspl import certify, evaluate, load
from torchrl_sspl.certification import Budget
from torchrl_sspl.configs import EvaluationConfig, compose
from torchrl_sspl.data import TransitionStore, collect_random
from torchrl_sspl.envs import CMUDubinsEnv, CMUTwoDiscsEnv, DubinsEnv, PendulumEnv
from torchrl_sspl.evaluation import certify_on_episodes, evaluate_episodes, simulate
from torchrl_sspl.evaluation.known import encode_states, latency
from torchrl_sspl.experiments.run import Experiment
from torchrl_sspl.lipschitz import (
    LMIBarrier,
    SandwichBarrier,
    lipschitz_lower,
    lipschitz_upper,
    prove_lipschitz,
    solve_multipliers,
)
from torchrl_sspl.modules import FrameEncoder, InverseDynamics, LatentDynamics, Policy, SaLaD, make_rollout_policy
from torchrl_sspl.modules.agent import Agent
from torchrl_sspl.objectives import SSPLLoss
from torchrl_sspl.runtime import Calibration, Monitor, Shield, calibrate

pytestmark = [
    pytest.mark.gpu,
    pytest.mark.skipif(not torch.cuda.is_available(), reason="needs a CUDA device"),
    pytest.mark.filterwarnings("ignore::FutureWarning", "ignore::DeprecationWarning", "ignore::UserWarning"),
]
JOINT = [
    "env=pendulum", *TINY_PHASES, "trainer.total_frames=512", "trainer.optim_steps_per_batch=4", "trainer.warm_start_steps=4",
    "trainer.checkpoint_seconds=-1", "trainer.restarts=0", "collector.frames_per_batch=256", "collector.envs=64",
    "collector.init_random_frames=256", "collector.random_share=0.5", "buffer.batch=64", "env.image_size=32",
    "evaluation.episodes=8", "evaluation.horizon=4", "evaluation.grid=7", "evaluation.kernel_grid=31",
    "evaluation.renderer_episodes=0", "synthesis.enabled=false",
]  # fmt: skip


@pytest.mark.parametrize("kind", [PendulumEnv, DubinsEnv, CMUDubinsEnv, CMUTwoDiscsEnv])
def test_an_environment_that_is_moved_goes_on_on_the_device(kind):
    env = kind(batch_size=[2], seed=0)
    shown = env.reset()
    moved = env.to("cuda")
    assert moved is env
    assert env.device.type == "cuda"
    stayed = TensorDict({"state": shown["state"].cuda()}, [2], device="cuda")
    again = env.reset(stayed, set_state=True)
    assert (again["pixels"].cpu().int() - shown["pixels"].int()).abs().float().mean() < 1.0
    after = env.rollout(3, break_when_any_done=False)
    assert after["next", "pixels"].is_cuda
    assert after["next", "state"].is_cuda


def make_loss() -> SSPLLoss:
    torch.manual_seed(0)
    networks = (FrameEncoder(3), LatentDynamics(3, 1, (32,), 10.0), SandwichBarrier(3, (16,)), Policy(3, 1, (16,), 10.0))
    # Random numbers differ between devices: no term that draws any.
    return SSPLLoss(*networks, inverse_dynamics=InverseDynamics(3, 1, action_scale=10.0), off_manifold_coeff=0.0)


def make_batch(n: int = 64) -> TensorDict:
    g = torch.Generator().manual_seed(0)
    return TensorDict(
        frames=torch.randint(256, (n, 3, 3, 32, 32), dtype=torch.uint8, generator=g),
        action=torch.rand(n, 1, generator=g) * 20 - 10,
        region=torch.arange(n)[:, None] % 3,
        batch_size=n,
    )


def total(terms: TensorDict) -> torch.Tensor:
    return sum(value for key, value in terms.items() if key.startswith("loss_"))


def test_loss_and_gradients_are_those_of_the_cpu():
    here, data = make_loss(), make_batch()
    there = copy.deepcopy(here).cuda()
    first, second = here(data), there(data.cuda())
    for key, value in first.items():
        torch.testing.assert_close(value, second[key].cpu(), rtol=1e-3, atol=1e-4)
    total(first).backward()
    total(second).backward()
    for one, other in zip(here.parameters(), there.parameters(), strict=True):
        if one.grad is not None:
            torch.testing.assert_close(one.grad, other.grad.cpu(), rtol=1e-2, atol=1e-3)


@pytest.mark.parametrize("case", CASES, ids=lambda case: case.name)
def test_every_loss_stays_on_the_gpu(case: Case):
    loss = case.build().cuda()
    terms = loss(case.data().cuda())
    assert all(value.is_cuda and value.isfinite().all() for value in terms.values())
    total(terms).backward()
    assert all(p.grad.is_cuda for p in loss.parameters() if p.grad is not None)


def test_loss_trains_in_a_loop_of_ones_own():
    env = PendulumEnv(batch_size=[16], image_size=32, horizon=5, device="cuda")
    salad = SaLaD.from_sizes(latent_dim=3, action_dim=1, action_scale=env.max_action)
    policy = Policy(latent_dim=3, action_dim=1, action_scale=env.max_action)
    loss = SSPLLoss(*salad, policy, successor="target").cuda()
    updater, optimizer = SoftUpdate(loss, tau=0.05), torch.optim.Adam(loss.parameters(), 1e-3)
    buffer = TensorDictReplayBuffer(storage=LazyTensorStorage(512, device="cuda"), batch_size=32)
    frames = {"frames_per_batch": 160, "total_frames": 320, "auto_register_policy_transforms": False}
    before = copy.deepcopy(loss.state_dict())
    for data in Collector(env, make_rollout_policy(salad, policy).cuda(), **frames):
        buffer.extend(data.reshape(-1))
        optimizer.zero_grad()
        total(loss(buffer.sample())).backward()
        optimizer.step()
        updater.step()
    after = loss.state_dict()
    moved = [key for key, value in before.items() if not torch.equal(value, after[key])]
    assert any("target" in key for key in moved)
    assert any("target" not in key for key in moved)


@pytest.mark.slow
def test_compiled_loss_is_the_eager_one():
    loss, data = make_loss().cuda(), make_batch().cuda()
    compiled = torch.compile(loss, fullgraph=True)(data)
    for key, value in loss(data).items():
        torch.testing.assert_close(value, compiled[key], rtol=1e-3, atol=1e-4)


def test_mixed_precision_stays_near():
    loss, data = make_loss().cuda(), make_batch().cuda()
    with torch.autocast("cuda", dtype=torch.bfloat16):
        mixed = loss(data)
    assert abs(float(total(mixed)) / float(total(loss(data))) - 1.0) < 0.1


@pytest.mark.slow
def test_experiments_run_on_the_gpu_and_return_an_agent_on_the_cpu(tmp_path):
    outcome = Experiment(compose([*JOINT, "device=cuda", f"out_dir={tmp_path}"])).run()
    assert all(not p.is_cuda for p in outcome.agent.parameters())
    assert outcome.evaluation["volume_over_kernel"] is not None


@pytest.mark.parametrize(
    "options",
    [
        pytest.param([], id="plain", marks=pytest.mark.slow),  # the phases below train in float32
        pytest.param(["trainer.autocast=bfloat16"], id="mixed"),
        pytest.param(["trainer.compile=true"], id="compile", marks=pytest.mark.slow),
    ],
)
def test_experiments_train_on_the_gpu(options, tmp_path):
    experiment = Experiment(compose([*JOINT, *options, "device=cuda", f"out_dir={tmp_path}"]))
    experiment.train()
    assert experiment.trainer.collected_frames == 512
    assert all(p.is_cuda for p in experiment.loss.parameters())
    assert all(torch.isfinite(p).all() for p in experiment.loss.parameters())


@pytest.fixture
def deterministic(monkeypatch):
    """Kernels that add in a fixed order: without, the encoders of two runs with one seed differed on a GPU."""
    monkeypatch.setenv("CUBLAS_WORKSPACE_CONFIG", ":4096:8")
    torch.use_deterministic_algorithms(True, warn_only=True)
    yield
    torch.use_deterministic_algorithms(False)


def saving_experiment(directory: Path, device: str) -> Experiment:
    return Experiment(compose([*JOINT, "trainer.checkpoint_seconds=0", f"device={device}", f"out_dir={directory}"]))


def interrupt(experiment: Experiment) -> None:
    """Train until the second batch is about to be learnt from."""
    updates, batches = experiment.trainer.optim_steps, []

    def once(batch: TensorDict) -> None:
        batches.append(batch)
        if len(batches) == 2:
            raise InterruptedError
        updates(batch)

    experiment.trainer.optim_steps = once
    experiment.train()


@pytest.mark.slow
def test_interrupted_experiment_goes_on_as_if_nothing_had_happened(deterministic, tmp_path):
    whole = saving_experiment(tmp_path / "whole", "cuda")
    whole.train()
    with pytest.raises(InterruptedError):
        interrupt(saving_experiment(tmp_path / "broken", "cuda"))
    resumed = saving_experiment(tmp_path / "broken", "cuda")
    resumed.train()
    found = resumed.loss.state_dict()
    for key, value in whole.loss.state_dict().items():
        if isinstance(value, torch.Tensor):
            torch.testing.assert_close(value, found[key], msg=key)


ROUND = ["gather", "dynamics", "fit", "steer", "tune", "tighten", "check"]
AS_PRINTED = ["loss.preset=paper", "loss.reduction=mean", "network.barrier=lmi", "trainer.margins=true"]


@pytest.mark.parametrize(
    ("words", "phases"),
    [
        pytest.param([], 2 * ROUND, marks=pytest.mark.slow),  # the next has all phases of one round
        (["synthesis.teacher=value", "synthesis.rounds=1"], [*ROUND[:2], "teach", *ROUND[2:]]),
        (AS_PRINTED, []),
    ],
    ids=["rounds", "taught", "as-printed"],
)
def test_all_phases_learn_from_pixels_on_the_gpu(words, phases, tmp_path):
    experiment = Experiment(compose([*TINY, *words, "device=cuda", f"out_dir={tmp_path}"]))
    devices, stepper = [], experiment.trainer.optimization_stepper
    step = stepper.step

    def watched(trainer, batch):
        devices.append(batch["frames"].device.type)
        return step(trainer, batch)

    stepper.step = watched
    agent = experiment.train()
    assert set(devices) == {"cuda"}
    assert all(p.is_cuda for p in experiment.loss.parameters())
    assert all(not p.is_cuda for p in agent.parameters())
    assert [phase.name for phase in experiment.phases.phases] == phases
    assert experiment.phases.finished


@pytest.mark.slow
def test_interrupted_phases_go_on_as_if_nothing_had_happened_on_the_gpu(deterministic, tmp_path):
    words = [*SINGLE, SAVED, "device=cuda"]
    whole = Experiment(compose([*SINGLE, "device=cuda", f"out_dir={tmp_path / 'whole'}"])).train()
    broken = Experiment(compose([*words, f"out_dir={tmp_path / 'broken'}"]))
    save = broken.trainer.save_trainer

    def stop_in_steer(force_save=False):
        if broken.work.where["phase"] == "steer":
            save(force_save=True)
            raise InterruptedError

    broken.trainer.save_trainer = stop_in_steer
    with pytest.raises(InterruptedError):
        broken.train()
    resumed = Experiment(compose([*words, f"out_dir={tmp_path / 'broken'}"]))
    found = resumed.train().state_dict()
    assert resumed.trainer.resumed
    for key, value in whole.state_dict().items():
        torch.testing.assert_close(value, found[key], msg=key)


def test_moment_encoder_is_fitted_on_the_gpu(tmp_path):
    words = [w for w in TINY if w not in ("env=pendulum", "env.image_size=32", "network.pool_to=16")]
    words += ["env=dubins", "env.image_size=64", "network.pool_to=32", "synthesis.rounds=1", "device=cuda", f"out_dir={tmp_path}"]
    experiment = Experiment(compose(words))
    assert type(experiment.encoder).__name__ == "MomentEncoder"
    assert all(not p.is_cuda for p in experiment.train().parameters())
    assert experiment.phases.finished


def test_environment_on_the_gpu_draws_what_it_draws_on_the_cpu():
    state = torch.tensor([[0.3, -0.5], [2.0, 1.0]])
    here, there = PendulumEnv(batch_size=[2], seed=0), PendulumEnv(batch_size=[2], seed=0, device="cuda")
    difference = here.observe(state).int() - there.observe(state.cuda()).cpu().int()
    assert difference.abs().max() <= 1
    assert there.rollout(3, break_when_any_done=False)["pixels"].is_cuda


def test_collected_data_lie_in_host_memory_and_batches_on_the_gpu():
    store = collect_random(PendulumEnv(batch_size=[16], image_size=32, device="cuda"), 64, seed=0)
    assert isinstance(store, TransitionStore)
    assert store.get(slice(None))["frames"].device.type == "cpu"
    assert store.sample(8).to("cuda")["frames"].is_cuda


def small_env(batch_size=(1,), seed: int = 0) -> PendulumEnv:
    return PendulumEnv(batch_size=batch_size, seed=seed, image_size=32)


def test_agents_are_evaluated_on_the_gpu():
    agent, sizes = small_agent(32, 10.0), EvaluationConfig(episodes=8, envs=8, horizon=4)
    here = evaluate_episodes(agent, small_env, sizes)
    there = evaluate_episodes(agent.cuda(), small_env, sizes)
    assert here["on_policy_error_mean"] > 0.1
    assert abs(here["on_policy_error_mean"] - there["on_policy_error_mean"]) < 1e-2


@pytest.fixture(scope="module")
def pair() -> tuple[Agent, Agent]:
    """A shipped agent on the CPU and on the GPU."""
    return load("pendulum"), load("pendulum", "cuda")


@pytest.mark.slow
def test_measurements_on_the_true_system_are_those_of_the_cpu(pair):
    env = PendulumEnv(batch_size=[1])
    states = env.sample_states(100, torch.Generator().manual_seed(0))
    torch.testing.assert_close(*(encode_states(agent, env, states) for agent in pair), rtol=1e-3, atol=1e-3)
    here, there = (simulate(agent, env, start=states, horizon=3) for agent in pair)
    compared = [f.name for f in dataclasses.fields(here) if isinstance(getattr(here, f.name), torch.Tensor)]
    assert {"actions", "states", "barrier", "latent", "prediction_error", "barrier_error"} <= set(compared)
    for name in compared:
        torch.testing.assert_close(getattr(here, name), getattr(there, name), rtol=1e-2, atol=1e-2)
    found = evaluate(pair[1], env, EvaluationConfig(grid=11, kernel_grid=31, episodes=10, horizon=3))
    assert found["volume_over_kernel"] > 0
    assert pair[1].barrier[0].weight.is_cuda, "the caller's agent is left where it is"


def test_quadrupeds_agent_answers_from_the_gpu():
    agent, env = load("quadruped", "cuda"), DubinsEnv(batch_size=[1])
    assert latency(agent, env, frames=20).value > 0
    assert encode_states(agent, env, env.sample_states(3)).device.type == "cpu"


@pytest.mark.parametrize("size", ["small", pytest.param("shipped", marks=pytest.mark.slow)])
def test_certificates_say_the_same_of_an_agent_on_the_gpu(size, request):
    shipped = size == "shipped"
    pair, env = (request.getfixturevalue("pair"), PendulumEnv) if shipped else ((small_agent(32, 10.0), small_agent(32, 10.0).cuda()), small_env)
    short = {"level": 0.0, "horizon": 5, "budget": Budget(boxes=200)}
    here, there = (certify(agent, env(batch_size=[1]), episodes=20, **short) for agent in pair)
    resets = certify_on_episodes(pair[1], env, episodes=20, envs=10, **short)
    assert here.weights == there.weights == resets.weights
    for name, layer in here.layers.items():
        assert [(s.name, s.holds) for s in layer.statements] == [(s.name, s.holds) for s in there.layers[name].statements]
    proved = [(s.name, s.holds) for s in here.layers["deterministic"].statements]
    assert proved == [(s.name, s.holds) for s in resets.layers["deterministic"].statements]


@pytest.mark.slow
def test_an_agent_on_the_gpu_is_proved(pair):
    assert certify(pair[1], None, level=0.0, budget=Budget(seconds=600.0)).layers["deterministic"].holds


@pytest.mark.parametrize("kind", [SandwichBarrier, LMIBarrier])
def test_lipschitz_constants_of_networks_on_the_gpu(kind):
    torch.manual_seed(0)
    here = kind(3, (8, 8))
    there = copy.deepcopy(here).cuda()
    plain = there.collapse() if kind is SandwichBarrier else there
    upper = lipschitz_upper(plain)
    assert upper == pytest.approx(lipschitz_upper(here.collapse() if kind is SandwichBarrier else here), rel=1e-4)
    assert 0 < lipschitz_lower(plain, -1.0, 1.0, n=1000, generator=torch.Generator().manual_seed(0)) <= upper
    multipliers = solve_multipliers(there, lipschitz_bound=there.lipschitz_bound)
    assert prove_lipschitz(plain, 1.001 * there.lipschitz_bound, multipliers=multipliers).proved


def test_figures_of_an_agent_on_the_gpu(pair):
    viz = pytest.importorskip("torchrl_sspl.viz")
    pytest.importorskip("matplotlib")
    env, agent = PendulumEnv(batch_size=[1]), pair[1]
    latent = agent.encode(env.observe(env.sample_states(50)).cuda())
    assert viz.latent_space(latent, torch.arange(50, device="cuda") % 3, agent.barrier) is not None


def test_the_monitor_and_the_filter_run_where_the_agent_is():
    here, there = load("pendulum"), load("pendulum", "cuda")
    env = PendulumEnv(batch_size=[1], seed=0)
    state = torch.tensor([[0.05, 0.0], [0.3, 0.1]])
    pixels = torch.cat([env.draw(state), env.draw(state)], 1)
    monitors = [Monitor(agent, Calibration.load("pendulum", agent), batch_size=2, period=0.1) for agent in (here, there)]
    for t, shown in enumerate((pixels, None, pixels)):
        ours, theirs = (monitor.step(shown, time=0.1 * t) for monitor in monitors)
        assert theirs.action.is_cuda
        assert ours.reasons == theirs.reasons
        assert torch.equal(ours.verdict, theirs.verdict.cpu())
        assert torch.allclose(ours.action, theirs.action.cpu(), atol=1e-3)
    made = Shield(there)(theirs.latent, torch.full((2, 1), 10.0, device="cuda"))
    monitors[1].took(made.action)
    monitors[1].reset(torch.tensor([1]))
    assert calibrate(there, env, episodes=2, horizon=2, pictures=100, steps=20).weights == monitors[1].calibration.weights
