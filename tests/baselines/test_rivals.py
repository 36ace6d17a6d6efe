"""Every method that learns: on a tiny recording, and what is particular to each."""

from __future__ import annotations

import math
from pathlib import Path

import pytest
import torch
from tiny import TINY as TINY_RUN

from torchrl_sspl.baselines import BUDGETS, METHODS, Budget, ScoreConfig, make, record, score
from torchrl_sspl.baselines.base import nearest_admissible
from torchrl_sspl.baselines.cell import Cell, run_cell
from torchrl_sspl.baselines.data import pooled
from torchrl_sspl.baselines.imitation import KernelExpert
from torchrl_sspl.baselines.latent_cbf import BoundedAutoencoder, ControlAffine
from torchrl_sspl.baselines.nerf_cbf import NeRFCBF, Scene
from torchrl_sspl.baselines.neural_cbf import QuadraticBarrier
from torchrl_sspl.baselines.perception import Coordinates, Perception, encoder_for, fresh_error, perception_error
from torchrl_sspl.baselines.registry import kind_of
from torchrl_sspl.baselines.scoring import adversarial, harmless, nominals, well_inside
from torchrl_sspl.baselines.sspl import BUDGET_FILE, settings
from torchrl_sspl.baselines.vision_cbf import Geometry
from torchrl_sspl.configs import compose, reader
from torchrl_sspl.data import collect_random
from torchrl_sspl.envs import CMUDubinsEnv, CMUTwoDiscsEnv, DubinsEnv, PendulumEnv
from torchrl_sspl.errors import ConfigError, ShapeError
from torchrl_sspl.evaluation import simulate
from torchrl_sspl.evaluation.measurements import Evaluation
from torchrl_sspl.experiments import Experiment
from torchrl_sspl.modules.agent import load
from torchrl_sspl.viability import viability_kernel

TINY = {
    "imitation": ["steps=6"],
    "nerf_cbf": ["steps=6"],
    "vision_cbf": ["steps=4", "batch=16"],
    "neural_cbf": ["perception_steps=4", "steps=6", "batch=32"],
    "latent_cbf": ["autoencoder_steps=4", "steps=6"],
    "latent_safe": ["world_steps=4", "margin_steps=6", "steps=6", "batch=32"],
    "smooth_latent": ["world_steps=4", "margin_steps=6", "steps=6", "batch=32"],
}
SIZES = ScoreConfig(episodes=6, horizon=4, grid=9, frames=2, shifted=20)


@pytest.fixture(scope="module")
def systems():
    pendulum, car = PendulumEnv([16]), DubinsEnv([16])
    kernels = viability_kernel(pendulum, resolution=61), viability_kernel(car, resolution=(31, 31, 24))
    return {
        "pendulum": (pendulum, kernels[0], record(pendulum, BUDGETS["tiny"], 0)),
        "dubins": (car, kernels[1], record(car, BUDGETS["tiny"], 0)),
    }


@pytest.mark.parametrize("task", ["pendulum", pytest.param("dubins", marks=pytest.mark.slow)])
@pytest.mark.parametrize("name", TINY)
def test_every_method_learns_acts_and_is_scored(name, task, systems):
    env, kernel, data = systems[task]
    method = make(name, TINY[name])
    if name == "imitation":
        method.expert = KernelExpert(env, kernel)
    torch.manual_seed(0)
    method.fit(data, env, BUDGETS["tiny"], 0)
    state = env.sample_states(5)
    seen = state if method.reads == "state" else env.observe(state)
    action, none = method.act(seen, torch.zeros(5, 1))
    assert action.shape == (5, 1)
    assert none.shape == (5,)
    assert none.dtype == torch.bool
    assert (action.abs() <= env.max_action + 1e-5).all()
    claims = method.claims(seen)
    assert (claims is None) == (name == "imitation")
    assert method.needs.transitions == len(data)
    found = score(method, env, SIZES, kernel=kernel)
    assert found["common_harmless_enter"] is not None
    assert found["latency_p99"] > 0
    if method.reads == "pixels":  # without a claim there are episodes to ask
        assert ("shifted_dark_common_harmless_enter" in found.to_dict()) == (claims is None)
        assert ("shifted_dark_claimed_over_kernel" in found.to_dict()) == (claims is not None)


def test_who_claims_nothing_acts_on_shifted_pictures(systems):
    env, kernel, _ = systems["pendulum"]
    corners = []

    class Watchful(kind_of("imitation")):
        """Remembers the colour of the background."""

        def __init__(self):
            super().__init__(None)

        def act(self, seen, nominal):
            corners.append(tuple(seen[0, 3:, 0, 0].tolist()))
            return nominal, torch.zeros(len(seen), dtype=torch.bool)

    found = score(Watchful(), env, ScoreConfig(episodes=4, horizon=3, grid=9, frames=2, shifted=20), kernel=kernel)
    assert {(255, 255, 255), (217, 217, 217), (0, 255, 255)} <= {*corners}  # as it is, dark, cyan
    assert corners.count((0, 255, 255)) == 3
    assert found["shifted_background_common_harmless_enter"] is not None


def test_a_system_without_an_adversary_is_scored_under_the_harmless_policy(systems, monkeypatch):
    assert list(nominals(CMUTwoDiscsEnv())) == ["harmless"]
    monkeypatch.setattr("torchrl_sspl.baselines.scoring.nominals", lambda env: {"harmless": harmless(env)})
    env, kernel, _ = systems["pendulum"]
    method = make("hocbf")
    method.fit(None, env, BUDGETS["tiny"], 0)
    found = score(method, env, SIZES, kernel=kernel)
    assert found["common_harmless_enter"] == 0.0
    assert found["calibrated_claimed_over_kernel"] > 0.5
    assert found["common_adversarial_enter"] is None
    assert "no adversarial nominal policy" in found.measurements["common_adversarial_enter"].note


def test_every_method_is_in_the_list_and_learns_or_not():
    assert {name for name in METHODS if kind_of(name).learns} == {*TINY, "sspl"}
    assert all(kind_of(name).name == name for name in METHODS)


@pytest.mark.parametrize("name", ["latent_cbf", "smooth_latent"])
def test_the_same_seed_learns_the_same(name, systems):
    env, _, data = systems["pendulum"]
    seen, values = env.observe(torch.tensor([[0.3, 0.5]])), []
    for _ in range(2):
        torch.manual_seed(3)
        method = make(name, TINY[name])
        method.fit(data, env, BUDGETS["tiny"], 3)
        values.append(method.barrier(seen))
    assert torch.equal(*values)


@pytest.mark.slow
def test_the_shipped_agent_is_a_row_with_its_memory(systems):
    env, kernel, _ = systems["pendulum"]
    for options in (["agent=pendulum"], ["agent=pendulum", "filter=true"]):
        method = make("sspl", options)
        method.fit(None, env, BUDGETS["tiny"], 0)
        found = score(method, env, ScoreConfig(episodes=20, horizon=10, grid=41, frames=2, shifted=20), kernel=kernel)
        assert found["claimed_over_kernel"] > 0.5
        assert found["false_safe"] < 0.05
        assert found["claimed_harmless_enter"] == 0.0
    assert method.needs.transitions == 84_000
    acts = method.controller(adversarial(env))
    run = simulate(acts, env, start=torch.zeros(2, 2), horizon=5)
    assert acts.deviation > 0
    assert torch.allclose(run.actions[0], torch.tensor(10.0))  # upright there is room: the adversary's own action
    assert acts.infeasible == 0
    simulate(acts, env, start=torch.tensor([[0.0, 0.0], [1.5, 1.5]]), horizon=5)
    assert acts.infeasible == 5  # no action keeps a set that has been left, in one of two episodes
    assert method.needs.held_out_labels is None  # its training did not count them


def test_what_an_agent_does_not_say_of_its_data_is_not_counted(systems, tmp_path):
    load("pendulum").save(tmp_path / "run" / "agent")
    method = make("sspl", [f"agent={tmp_path / 'run' / 'agent'}"])
    method.fit(None, systems["pendulum"][0], BUDGETS["tiny"], 0)
    assert method.needs.transitions is method.needs.safe_labels is method.needs.held_out_steps is None
    (tmp_path / "run" / BUDGET_FILE).write_text('{"transitions": 640, "labels of S": 7}')  # of a row of the table
    method.fit(None, systems["pendulum"][0], BUDGETS["tiny"], 0)
    assert (method.needs.transitions, method.needs.safe_labels, method.needs.unsafe_labels) == (640, 7, 0)


def test_a_training_needs_a_directory(systems):
    with pytest.raises(ConfigError, match="expected a directory"):
        make("sspl").fit(None, systems["pendulum"][0], BUDGETS["tiny"], 0)


@pytest.mark.parametrize("name", ["latent_cbf", "latent_safe", "smooth_latent"])
def test_methods_of_one_action_refuse_systems_of_several(name, monkeypatch):
    env = PendulumEnv([1])
    monkeypatch.setattr(env, "action_dim", 2)
    with pytest.raises(ConfigError, match=f"{name}: expected a system of one action.* received PixelPendulumEnv with 2"):
        make(name).fit(None, env, BUDGETS["tiny"], 0)


def test_a_system_without_a_time_step_is_refused_and_so_is_a_level_above_zero():
    env = PendulumEnv([1])
    del env.dt
    with pytest.raises(ConfigError, match=r"latent_cbf: expected .* attribute dt is the time step .* and dt=None; set dt"):
        make("latent_cbf").fit(None, env, BUDGETS["tiny"], 0)
    with pytest.raises(ConfigError, match=r"sspl: expected level <= 0, of the filter, received 0\.1"):
        Cell.of("sspl", ["filter=true", "level=0.1"])


def test_larger_pictures_are_taken_as_they_are_or_refused():
    env, budget = CMUTwoDiscsEnv([16]), Budget("try", 60, 8, 8)
    data = record(env, budget, 0, size=64)
    method = make("imitation", ["steps=2"])
    method.expert = lambda state: torch.zeros(len(state), 1)
    method.fit(data, env, budget, 0)
    seen = env.observe(env.sample_states(3))
    assert torch.equal(method.act(seen, torch.zeros(3, 1))[0], method.network(pooled(seen, 64)))
    assert not torch.equal(method.act(seen, torch.zeros(3, 1))[0], method.network(pooled(seen, 32)))
    with pytest.raises(ConfigError, match="latent_cbf: expected pictures of 32 x 32, received 64 x 64"):
        make("latent_cbf").fit(data, env, budget, 0)


def test_the_imitator_is_told_about_what_it_visits(systems):
    env, kernel, _ = systems["pendulum"]
    budget = Budget("try", 40, 8, 8, rollouts=24)
    method = make("imitation", ["steps=6", "rounds=2"])
    method.expert = KernelExpert(env, kernel)
    method.fit(record(env, budget, 0), env, budget, 0)
    assert method.needs.transitions == method.needs.expert_actions == budget.total
    assert method.needs.rollouts == 24


def test_its_own_training_takes_the_budget_and_no_rollouts(tmp_path, systems):
    steps = ",".join(f"synthesis.{name}_steps=4" for name in ("dynamics", "teach", "fit", "steer", "tune"))
    sizes = f"overrides=[preset=smoke,{steps},synthesis.check_episodes=20,trainer.optim_steps_per_batch=2,env.image_size=32]"
    method = make("sspl", [sizes])
    method.directory, method.env_name = tmp_path, "pendulum"
    env = PendulumEnv([4], image_size=32)
    method.fit(None, env, BUDGETS["tiny"], 0)
    assert method.needs.transitions == 1280  # one batch
    assert method.needs.rollouts == 0
    assert (tmp_path / "run" / "agent" / "agent.json").is_file()
    assert method.act(env.observe(torch.zeros(2, 2)), torch.zeros(2, 1))[0].shape == (2, 1)


def test_a_training_that_goes_on_counts_the_cpu_time_of_all_its_processes(tmp_path, monkeypatch):
    """And its ledger what its store holds, where no phase has counted that."""
    clock, stops = [0.0], [True, False]

    class Half(Experiment):
        def train(self, **options):
            clock[0] += 60.0
            if stops.pop(0):
                raise KeyboardInterrupt
            collect_random(self.env, 24, seed=0, store=self.store)
            return self.agent()

    monkeypatch.setattr("torchrl_sspl.baselines.sspl.Experiment", Half)
    monkeypatch.setattr("time.process_time", lambda: clock[0])
    for name, found in (("_kernel", None), ("_album", None), ("score", Evaluation())):
        monkeypatch.setattr(f"torchrl_sspl.baselines.cell.{name}", lambda *of, found=found, **more: found)
    cell = Cell.of("sspl", ["budget=tiny", "overrides=[synthesis.enabled=false]", f"out_dir={tmp_path / 'row'}"])
    with pytest.raises(KeyboardInterrupt):
        run_cell(cell)
    row = run_cell(cell)
    assert row["minutes"]["fit_cpu"] == 2.0
    assert row["needs"]["transitions"] == 24


def test_its_own_training_is_of_the_system_that_is_scored(tmp_path, monkeypatch):
    seen = []
    own = tmp_path / "strong.yaml"
    own.write_text((Path(reader.__file__).parent / "env" / "pendulum.yaml").read_text().replace("max_torque: 10.0", "max_torque: 4.0"))

    def stop(config):
        seen.append(config.env)
        raise KeyboardInterrupt

    monkeypatch.setattr("torchrl_sspl.baselines.sspl.Experiment", stop)
    for env in ("pendulum", str(own)):
        with pytest.raises(KeyboardInterrupt):
            run_cell(Cell.of("sspl", [f"env={env}", f"out_dir={tmp_path / 'row'}", "budget=tiny"]))
    assert [config["max_torque"] for config in seen] == [10.0, 4.0]


@pytest.mark.parametrize("task", ["pendulum", "dubins"])
def test_the_expert_keeps_the_common_set(task, systems):
    env, kernel, _ = systems[task]
    expert = KernelExpert(env, kernel)
    start = env.state_space.sample(3000, torch.Generator().manual_seed(0))
    start = start[well_inside(kernel, start)]
    run = simulate(_States(expert), env, start=start, horizon=60)
    entered = (env.unsafe_set.contains(run.states) & run.alive).any(0).float().mean()
    assert entered < 0.02  # of a coarse kernel
    idle = simulate(_States(harmless(env)), env, start=start, horizon=60)
    assert entered < 0.2 * (env.unsafe_set.contains(idle.states) & idle.alive).any(0).float().mean()


class _States:
    reads = "state"

    def __init__(self, function):
        self.act = function


@pytest.mark.parametrize("env", [PendulumEnv(), DubinsEnv()], ids=["pendulum", "dubins"])
def test_coordinates_and_geometry_tell_the_state(env):
    state = env.wrap(env.sample_states(200, torch.Generator().manual_seed(0)))
    at, of = Coordinates(env), Geometry(env)
    assert at.features(state).abs().max() <= 0.9 + 1e-5
    assert torch.allclose(at.state(at.features(state)), state, atol=1e-4)
    told = of.state(of.draw(state, env.previous_state(state)))
    error = perception_error(told, state, env)
    assert max(v for k, v in error.items() if k.endswith("q99")) < 0.12
    with pytest.raises(ConfigError, match="without a yaw lag"):
        Coordinates(DubinsEnv(yaw_lag=(0.05, 0.05)))


@pytest.mark.parametrize("env", [PendulumEnv(), DubinsEnv(), CMUDubinsEnv()], ids=["pendulum", "dubins", "cmu"])
def test_the_geometry_lies_where_the_picture_shows_it(env):
    state = torch.tensor([[0.6, 0.0]]) if env.state_dim == 2 else torch.tensor([[0.9, -0.7, 0.4]])
    of, empty = Geometry(env), env.draw(state.clone().fill_(math.pi if env.state_dim == 2 else -1.0))
    changed = (pooled(env.draw(state)).float() - pooled(empty).float()).abs().sum(1)[0]
    x, y = of.place(state)[0]
    i, j = round(float((y + 1) / 2 * 32 - 0.5)), round(float((x + 1) / 2 * 32 - 0.5))
    assert changed[max(0, i - 1) : i + 2, max(0, j - 1) : j + 2].max() > 60
    if env.state_dim > 2:
        assert Scene(env, torch.ones(3)).view == env.half_view


def test_the_encoder_of_a_car_of_one_colour_tells_its_heading():
    env = CMUDubinsEnv([16])
    data = record(env, Budget("try", 100, 0, 0), 1)
    seen = pooled(env.observe(torch.tensor([[0.8, 0.7, heading] for heading in (0.0, 1.5, 3.0, -1.5)])))
    for whole, size in ((False, 2), (True, 6)):
        told = encoder_for(env, 6, data, whole=whole)(seen).detach()
        assert told.shape == (4, size)
        assert torch.pdist(told).min() > 0.3


def test_the_state_is_learnt_from_pictures(systems):
    env = PendulumEnv([16])
    data = record(env, Budget("try", 400, 0, 0), 1)
    torch.manual_seed(0)
    few, more = (Perception(env, data, n, 0) for n in (2, 60))
    told = [perception_error(eyes.at.state(eyes.encoder(data.pixels).detach()), data.state, env)["x0_q50"] for eyes in (few, more)]
    assert told[1] < 0.5 * told[0]


def test_what_the_features_say_linearly_is_read_out_whatever_the_encoder_has_learnt():
    env = DubinsEnv([16])
    eyes = Perception(env, record(env, Budget("try", 300, 0, 0), 1), 1, 0)
    found = fresh_error(eyes, env, n=200)
    assert max(found["x0_q50"], found["x1_q50"]) < 0.01  # m; the encoder alone is out by half a metre
    assert found["x2_q50"] < 0.1


def test_the_wanted_action_is_kept_where_its_value_is_admitted(systems):
    env = systems["pendulum"][0]
    method = make("smooth_latent")
    method.env, method.tried = env, torch.linspace(-env.max_action, env.max_action, 25)
    wanted = torch.tensor([[0.07], [-1.23]])
    for value, kept in ((0.95, True), (0.85, False)):  # of the wanted actions; of the best one 1
        q = torch.full((2, 25), value)
        q[:, 0] = 1.0
        method._q = lambda seen, q=q: q
        action, lost = method.act(torch.zeros(2), wanted)
        assert bool((action == wanted).all()) is kept
        assert not lost.any()


def test_a_discount_has_a_warm_up_or_is_annealed(systems):
    env, _, data = systems["pendulum"]
    with pytest.raises(ConfigError, match=r"latent_safe: expected warmup in \[0, 1\), received 1\.0"):
        make("latent_safe", ["warmup=1.0"]).fit(data, env, BUDGETS["tiny"], 0)
    values = {}
    for words in (["warmup=0.99"], ["discount=0.0"], []):
        torch.manual_seed(0)
        method = make("latent_safe", [*TINY["latent_safe"], *words])
        method.fit(data, env, BUDGETS["tiny"], 0)
        values[tuple(words)] = method.barrier(data.pixels)
    assert torch.equal(values["warmup=0.99",], values["discount=0.0",])  # for all of six updates
    assert not torch.equal(values["warmup=0.99",], values[()])


def test_the_field_finds_the_obstacle():
    env = DubinsEnv([16])
    data = record(env, Budget("try", 300, 0, 0), 1)
    torch.manual_seed(0)
    method: NeRFCBF = make("nerf_cbf", ["steps=150", "form=closing"])
    method.fit(data, env, BUDGETS["tiny"], 0)
    assert 0.1 < method.notes["occupied_m2"] < 1.0  # 0.36 stands there
    depth = method.depth(torch.tensor([[1.7, 0.0, 0.0], [0.0, -1.7, 0.0], [0.9, 0.0, 0.0]]))
    assert torch.allclose(depth, torch.tensor([1.0, 1.0, 0.2]), atol=0.2)
    towards, away = torch.tensor([[1.2, 0.0, math.pi]]), torch.tensor([[1.2, 0.0, 0.0]])
    assert method.h(towards) > method.h(away)


def test_forms_and_poses_that_are_not_known_are_refused():
    with pytest.raises(ConfigError, match="form=speed"):
        make("nerf_cbf", ["form=none"])
    assert make("nerf_cbf", ["pose=estimated"]).reads == "pixels"
    assert make("nerf_cbf").reads == "state"


def test_the_margin_of_the_smooth_latent_has_the_slope_that_is_asked_for(systems):
    env, _, data = systems["pendulum"]
    torch.manual_seed(0)
    method = make("smooth_latent", ["world_steps=2", "margin_steps=400", "steps=2", "batch=64", "slope=0.5"])
    method.fit(data, env, BUDGETS["tiny"], 0)
    z = method.encoder(data.pixels).detach().requires_grad_()
    (slope,) = torch.autograd.grad(method.margin(z).sum(), z)
    assert slope.norm(dim=-1).median() == pytest.approx(0.5, abs=0.2)


def test_the_value_is_never_above_the_margin_for_long(systems):
    env, _, data = systems["pendulum"]
    torch.manual_seed(0)
    method = make("latent_safe", ["world_steps=20", "margin_steps=200", "steps=300", "batch=64"])
    method.fit(data, env, BUDGETS["tiny"], 0)
    z = method.encoder(data.pixels).detach()
    over = (method.value(z).amax(1) - method.margin(z).tanh()[:, 0]).clamp_min(0)
    assert over.mean() < 0.1


def test_layers_of_the_autoencoder_are_bounded_and_the_dynamics_are_affine():
    net = BoundedAutoencoder(8, 4.0)
    for _ in range(50):  # power iterations
        net(torch.zeros(1, 6, 32, 32, dtype=torch.uint8))
    weight = net.encoder[-1].weight
    assert torch.linalg.matrix_norm(weight, 2) <= 1.01
    step, z = ControlAffine(4, 1, 0.05, 10.0), torch.randn(3, 4)
    at = [step(z, torch.full((3, 1), u)) for u in (-10.0, 0.0, 10.0)]
    assert torch.allclose(at[2] - at[1], at[1] - at[0], atol=1e-6)


@pytest.mark.parametrize("system", ["pendulum", "dubins"])
def test_this_librarys_own_row_takes_as_many_steps_as_recommended_whatever_the_budget(system, tmp_path):
    quiet = ["logger=none", "trainer.progress=false"]
    usual = Experiment(compose([f"env={system}", f"out_dir={tmp_path}/usual", *quiet])).trainer._joint_steps()
    for name in ("small", "full"):
        run = Experiment(compose([*settings(system, BUDGETS[name]), f"out_dir={tmp_path}/{name}", *quiet]))
        assert run.trainer._joint_steps() == usual
        assert run.config.trainer.total_frames <= BUDGETS[name].total + run.config.collector.frames_per_batch


@pytest.mark.parametrize("budget", [BUDGETS["full"], Budget("try", 20_000, 3_000, 4_000, rollouts=9_000)], ids=["full", "less"])
@pytest.mark.parametrize("system", ["pendulum", "dubins"])
def test_this_librarys_own_row_takes_no_more_transitions_than_the_budget_has(system, budget):
    config = compose(settings(system, budget))
    taken, rollouts = taken_at_most(config)
    assert 0 < rollouts <= budget.rollouts
    assert budget.total - budget.rollouts <= taken <= budget.total


def taken_at_most(config) -> tuple[int, int]:
    """Transitions of a training without a grid, and those of them that its rounds ask for."""
    s, further = config.synthesis, config.synthesis.rounds - 1
    rollouts = s.rollout_transitions * (s.near_draws * further + (s.gain < 1.0)) + s.rim_draws * s.rim_transitions * further
    return max(s.transitions, config.trainer.total_frames) + rollouts, rollouts


@pytest.mark.parametrize("draws", [1, pytest.param(3, marks=pytest.mark.slow)])
def test_a_training_whose_rollouts_all_end_far_from_the_set_takes_what_is_asked_for(draws, tmp_path, monkeypatch):
    monkeypatch.setattr("torchrl_sspl.trainers.synthesis._NEAR", -math.inf)
    run = Experiment(compose([*TINY_RUN, f"synthesis.near_draws={draws}", f"out_dir={tmp_path}"]))
    run.train()
    assert run.work.source.budget["transitions"] == taken_at_most(run.config)[0]


def test_a_heavier_hinge_is_another_barrier(systems):
    env, _, data = systems["pendulum"]
    found = []
    for hinge in (1.0, 100.0):
        torch.manual_seed(0)
        method = make("latent_cbf", [*TINY["latent_cbf"], f"hinge={hinge}"])
        method.fit(data, env, BUDGETS["tiny"], 0)
        found.append(method.notes["barrier_loss"])
    assert found[1] > 10 * found[0]


def test_the_quadratic_barrier_falls_from_the_origin():
    net = QuadraticBarrier(torch.tensor([1.0, 2.0]))
    x = torch.randn(50, 2)
    assert (net(x) <= net(torch.zeros(1, 2))).all()


def test_the_nearest_admissible_action_is_taken_and_the_best_where_there_is_none():
    tried = torch.tensor([-1.0, 0.0, 1.0])[None, :, None].expand(3, 3, 1)
    value = torch.tensor([[0.0, 0.0, 0.0], [-1.0, 1.0, -2.0], [3.0, 2.0, 1.0]])
    wanted = torch.tensor([[0.2], [-0.1], [0.0]])
    action, none = nearest_admissible(tried, value, torch.zeros(3), wanted)
    assert action.flatten().tolist() == [0.0, -1.0, 1.0]
    assert none.tolist() == [False, False, True]
    with pytest.raises(ShapeError, match=r"expected \(n, k, m\)"):
        nearest_admissible(tried, value[:2], torch.zeros(3), wanted)
