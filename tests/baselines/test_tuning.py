"""Trials: what is drawn, what a method is worth, that the choice is made once and recorded."""

from __future__ import annotations

import json

import pytest
import torch

from torchrl_sspl.baselines import BUDGETS, make, record
from torchrl_sspl.baselines.cell import SCHEMA, TRIALS_FILE, Cell, run_cell
from torchrl_sspl.baselines.registry import METHODS, kind_of
from torchrl_sspl.baselines.tuning import SEED, draws, merit, search
from torchrl_sspl.envs import PendulumEnv
from torchrl_sspl.errors import ConfigError, OutputError

SMALL = ["budget=tiny", "score.episodes=6", "score.horizon=4", "score.grid=11", "score.kernel_grid=31", "score.frames=1", "score.shifted=0"]


@pytest.mark.parametrize("name", [n for n in METHODS if kind_of(n).learns])
def test_every_method_that_learns_has_as_many_valid_trials(name):
    found = draws(name, 4)
    assert found[0] == ()  # the defaults
    assert len(set(found)) == 4
    for words in found:
        make(name, words)
    assert draws(name, 4) == found
    assert draws(name, 4, seed=1) != found or len(kind_of(name).space) == 1


def test_the_second_trial_has_the_published_options_where_the_defaults_are_others():
    assert draws("latent_safe", 8)[1] == ("discount=0.9999", "tau=0.005", "batch=512", "layers=3")
    assert draws("smooth_latent", 2, named=["tau", "batch", "layers"])[1] == ("discount=0.9999",)
    assert draws("neural_cbf", 2)[1] != ()


def test_what_does_nothing_on_a_system_is_not_drawn(tmp_path):
    assert kind_of("vision_cbf").idle(PendulumEnv()) == ()
    row = run_cell(Cell.of("vision_cbf", ["env=dubins", "trials=4", f"out_dir={tmp_path}", "steps=1", "batch=4", *SMALL]))
    assert not any(word.startswith("k=") for trial in row["tuning"]["trials"] for word in trial["options"])


def test_a_claim_that_is_not_kept_is_worth_less_than_none():
    env = PendulumEnv()

    class Claims(type(make("lqr"))):
        share = 1.0

        def h(self, state):
            return torch.where(state[:, 0].abs() < self.share, -1.0, 1.0)

        def act(self, seen, nominal):
            return torch.zeros_like(nominal), torch.zeros(len(seen), dtype=torch.bool)

    method = Claims()
    method.fit(None, env, BUDGETS["tiny"], 0)
    assert merit(method, env, states=40, horizon=40) < -1.0  # it falls from nearly everywhere
    method.share = -1.0
    assert merit(method, env, states=40, horizon=40) == 0.0
    lqr = make("lqr")
    lqr.fit(None, env, BUDGETS["tiny"], 0)
    # An ellipsoid of 23 % of the kernel, which is 18 % of a state space of which 73 % are U.
    assert merit(lqr, env, states=400, horizon=40) == pytest.approx(0.23 * 0.18 / 0.214, abs=0.06)


def test_the_offset_shrinks_claim_and_filter_alike():
    env = PendulumEnv()
    plain, less = make("hocbf"), make("hocbf")
    for method in (plain, less):
        method.fit(None, env, BUDGETS["tiny"], 0)
    less.offset = 0.5
    state = env.state_space.sample(200, torch.Generator().manual_seed(0))
    assert torch.allclose(less.barrier(state), plain.barrier(state) + 0.5)
    tried = plain.candidates(torch.zeros(200, 1))
    assert torch.allclose(less.after(state, tried), plain.after(state, tried) + 0.5)
    assert torch.allclose(less.limit(state), plain.limit(state) + less.alpha * 0.5)


def test_the_first_of_the_best_is_chosen():
    options = [(), ("a=1",), ("a=2",)]
    assert search(lambda words: 0.0, options)[0] == ()
    assert search(lambda words: -1.0 if not words else 2.0, options)[0] == ("a=1",)


def test_options_with_which_nothing_can_be_fitted_are_not_chosen():
    def trial(words):
        if words == ("a=1",):
            raise ConfigError("expected finite losses")
        return -1.0

    chosen, found = search(trial, [("a=1",), ("a=2",)])
    assert chosen == ("a=2",)
    assert found[0]["merit"] is None
    assert found[0]["error"] == "ConfigError: expected finite losses"
    assert search(trial, [("a=1",), ("a=2",)], json.loads(json.dumps(found)))[0] == ("a=2",)


def test_options_that_name_the_row_are_not_drawn():
    assert any("form=" in word for words in draws("nerf_cbf", 8) for word in words)
    assert not any("form=" in word for words in draws("nerf_cbf", 8, named=["form"]) for word in words)
    assert Cell.of("sspl", ["agent=pendulum", "trials=8"]).trials == 0


def test_trials_that_have_been_made_are_not_made_again():
    made, kept = [], []

    def trial(words):
        made.append(words)
        return float(len(made))

    options = [(), ("a=1",), ("a=2",)]
    with pytest.raises(KeyboardInterrupt):
        search(trial, options, keep=lambda found: kept.append([*found]) if len(kept) < 2 else (_ for _ in ()).throw(KeyboardInterrupt))
    assert made == options
    chosen, found = search(trial, options, kept[-1])
    assert made == [*options, ("a=2",)]
    assert chosen == ("a=2",)
    assert [t["merit"] for t in found] == [1.0, 2.0, 4.0]


def test_the_choice_is_made_once_for_all_seeds_and_stands_in_the_row(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(kind_of("nerf_cbf"), "space", {"beta": (0.5, 1.5), "steps": (900,)})
    words = ["steps=2", "trials=3", *SMALL]
    first = run_cell(Cell.of("nerf_cbf", ["seed=0", *words]))
    assert first["cell"]["trials"] == 3
    assert len(first["tuning"]["trials"]) == 3
    assert first["tuning"]["needs"] == {"transitions": BUDGETS["tiny"].total, "episodes_at_most": 1200}
    assert 0.0 < first["minutes"]["trials_cpu"] < 10.0
    assert first["tuning"]["chosen"] in [t["options"] for t in first["tuning"]["trials"]]
    path = tmp_path / "runs/baselines/pendulum/tiny/nerf_cbf-steps-2-trials-3" / TRIALS_FILE
    told = json.loads(path.read_text())
    told["trials"][-1]["merit"] = 1e6
    path.write_text(json.dumps(told))
    assert run_cell(Cell.of("nerf_cbf", ["seed=1", *words]))["tuning"]["chosen"] == told["trials"][-1]["options"] != []
    assert "tuning" not in run_cell(Cell.of("nerf_cbf", ["steps=2", *SMALL]))
    assert Cell.of("lqr", ["trials=8"]).trials == 0
    assert SEED not in (0, 1, 2)
    told["of"]["horizon"] = 7
    path.write_text(json.dumps(told))
    with pytest.raises(OutputError, match=r"expected trials in episodes of 4 steps in '.*', found those of 7; give score\.horizon=7"):
        run_cell(Cell.of("nerf_cbf", ["seed=2", *words]))
    assert json.loads(path.read_text()) == told
    told["of"] |= {"horizon": 4, "env": "dubins"}
    path.write_text(json.dumps(told))  # trials of something else
    monkeypatch.setattr("torchrl_sspl.baselines.tuning.search", lambda *of: (("beta=3.0",), []))
    assert run_cell(Cell.of("nerf_cbf", ["seed=2", *words]))["tuning"]["chosen"] == ["beta=3.0"]
    monkeypatch.undo()
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(kind_of("nerf_cbf"), "space", {"beta": (7.0, 8.0), "steps": (900,)})
    told["of"]["env"] = "pendulum"
    path.write_text(json.dumps(told))  # of another space: the defaults alone are the same
    trials = run_cell(Cell.of("nerf_cbf", ["seed=4", *words]))["tuning"]["trials"]
    assert sorted(t["options"] for t in trials) == [[], ["beta=7.0"], ["beta=8.0"]]
    path.write_text(json.dumps(told | {"schema": SCHEMA - 1}))
    with pytest.raises(OutputError, match=r"expected measurements of schema .* in '.*trials\.json', found those of schema"):
        run_cell(Cell.of("nerf_cbf", ["seed=3", *words]))
    path.write_text("{")
    with pytest.raises(OutputError, match=r"trials in '.*', received what cannot be read"):
        run_cell(Cell.of("nerf_cbf", ["seed=3", *words]))
    with pytest.raises(ConfigError, match=f"another seed than {SEED}"):
        Cell.of("nerf_cbf", [f"seed={SEED}", "trials=3"])
    with pytest.raises(ConfigError, match="expected trials to be an integer"):
        Cell.of("nerf_cbf", ["trials=few"])


STAGES = {
    "vision_cbf": (["steps=2", "batch=8"], "offset=0.1", "steps=3"),
    "neural_cbf": (["perception_steps=2", "steps=2"], "steps=4", "perception_steps=3"),
    "latent_cbf": (["autoencoder_steps=2", "steps=2"], "hinge=9.0", "gain=2.0"),
    "latent_safe": (["world_steps=2", "margin_steps=2", "steps=3"], "actions=5", "world_steps=3"),
    "smooth_latent": (["world_steps=2", "margin_steps=2", "steps=3"], "slope=0.5", "world_steps=3"),
}


@pytest.mark.parametrize("name", STAGES)
def test_trials_share_what_a_stage_has_learnt_and_are_the_same(name):
    env = PendulumEnv([16])
    data, seen = record(env, BUDGETS["tiny"], 0), env.observe(env.sample_states(5))
    plain, later, earlier = STAGES[name]

    def fitted(words, stages):
        method = make(name, [*plain, *words])
        method.stages = stages
        torch.manual_seed(0)
        method.fit(data, env, BUDGETS["tiny"], 0)
        return method.barrier(seen), method.notes

    shared = {}
    first = fitted([], shared)
    learnt = [*shared.values()]
    (value, notes), alone = fitted([later], shared), fitted([later], {})
    assert len(shared) == 1
    assert next(iter(shared.values())) is learnt[0]
    assert torch.equal(value, alone[0])
    assert notes == alone[1]
    assert not torch.equal(value, first[0])
    fitted([earlier], shared)
    assert len(shared) == 2


@pytest.mark.parametrize("name", STAGES)
def test_a_stage_reads_no_option_that_it_does_not_name(name):
    env, read = PendulumEnv([16]), set()

    class Config:
        def __init__(self, of):
            self.of = of

        def __getattr__(self, option):
            read.add(option)
            return getattr(self.of, option)

    method = make(name, STAGES[name][0])
    method.config, staged = Config(method.config), method.stage

    def stage(options, learn):
        def learns():
            read.clear()
            found = learn()
            assert read
            assert read <= set(options)
            return found

        return staged(options, learns)

    method.stage = stage
    method.fit(record(env, BUDGETS["tiny"], 0), env, BUDGETS["tiny"], 0)
    assert len(method.stages) == 1
