"""Systems that the library has never seen: few lines, and a run from the simulator to the report."""

from __future__ import annotations

import ast
import importlib.util
import json
import sys
from functools import partial
from pathlib import Path

import pytest
import torch
from tiny import TINY_PHASES

from torchrl_sspl.configs import EvaluationConfig, compose
from torchrl_sspl.errors import CheckpointError, EmptyRegionError
from torchrl_sspl.evaluation import evaluate_episodes, verify_run
from torchrl_sspl.experiments.run import Experiment, run_experiment
from torchrl_sspl.modules.agent import load

pytestmark = pytest.mark.filterwarnings("ignore::FutureWarning", "ignore::DeprecationWarning")
EXAMPLES = Path(__file__).parents[2] / "examples"
FILES = ["bring_your_own_env.py", "bring_your_own_cartpole.py"]
TINY = [
    *TINY_PHASES, "logger=csv", "trainer.total_frames=160", "trainer.optim_steps_per_batch=3", "trainer.warm_start_steps=3",
    "trainer.checkpoint_seconds=-1", "trainer.restarts=0", "collector.frames_per_batch=80", "collector.envs=4",
    "collector.init_random_frames=80", "buffer.batch=16", "evaluation.episodes=6", "evaluation.envs=3", "evaluation.horizon=6",
]  # fmt: skip


@pytest.fixture
def example(monkeypatch):
    """Imports an example by its name, as its folder would."""
    return lambda name: imported(name, monkeypatch)


def imported(name: str, monkeypatch):
    if name == "bring_your_own_env.py":
        pytest.importorskip("gym_pusht", reason="needs the extra examples")
    spec = importlib.util.spec_from_file_location(name.removesuffix(".py"), EXAMPLES / name)
    module = importlib.util.module_from_spec(spec)
    monkeypatch.setitem(sys.modules, spec.name, module)
    spec.loader.exec_module(module)
    return module


@pytest.mark.parametrize("name", FILES)
def test_the_example_is_at_most_forty_lines(name):
    source = (EXAMPLES / name).read_text()
    docstring = ast.parse(source).body[0]
    lines = [line.strip() for line in source.splitlines()[docstring.end_lineno :]]
    assert sum(bool(line) and not line.startswith("#") for line in lines) <= 40


@pytest.mark.slow
@pytest.mark.parametrize("name", FILES)
def test_from_the_simulator_to_the_report(name, example, tmp_path, monkeypatch):
    module = example(name)
    encoder = getattr(module, "Encoder", None)
    outcome = run_experiment(module.my_env, TINY, encoder=encoder, title="Tiny", out_dir=str(tmp_path))
    measured = json.loads((tmp_path / "metrics.json").read_text())["measurements"]["own"]
    assert measured["random_touch_unsafe"]["n"] == measured["starts_inside"]["n"] == 6
    page = outcome.report.read_text()
    assert "Tiny" in page
    assert "data:video/mp4" in page
    assert "exact arithmetic on the deployed weights" in page
    assert "Do the weights keep the set?" in page
    assert "Do fresh episodes keep the set?" in page
    assert "episodes from B &lt;= 0 that touch U" in page or "touch_unsafe" in page
    for name in ("csv/scalars/loss_unsafe.csv", "csv/scalars/eval_touch_unsafe.csv", "csv/videos"):
        assert (tmp_path / name).exists()
    agent = load(tmp_path)  # an encoder of its own too: the agent names it by its import path
    again = evaluate_episodes(agent, module.my_env, EvaluationConfig(episodes=6, envs=3, horizon=6))
    for name in ("starts_inside", "policy_touch_unsafe", "random_touch_unsafe"):
        assert again[name] == outcome.evaluation[name]
    assert verify_run(tmp_path, env=module.my_env, trust=name == "bring_your_own_env.py") == 0
    assert set(outcome.certificate.layers) == {"deterministic", "statistical", "run-time", "paper"}
    if encoder is not None:
        assert agent.description["networks"]["encoder"]["class"] == "bring_your_own_env:Encoder"
        monkeypatch.delitem(sys.modules, "bring_your_own_env")
        with pytest.raises(CheckpointError, match="run from the folder that holds the module"):
            load(tmp_path)


def test_an_encoder_of_a_program_is_found_in_its_folder(program, tmp_path, monkeypatch):
    """Who runs the example as a program has its class in ``__main__``; the agent names the file."""
    pytest.importorskip("gym_pusht", reason="needs the extra examples")
    words = [*TINY, "synthesis.enabled=false", "evaluation.calibrate=false", f"out_dir={tmp_path}"]
    assert program("bring_your_own_env.py", *words) == 0
    monkeypatch.chdir(EXAMPLES)
    agent = load(tmp_path)
    assert agent.encode(torch.zeros(2, 6, 48, 48, dtype=torch.uint8)).shape == (2, 3)
    sys.modules.pop("bring_your_own_env", None)


def test_the_program_of_the_page_is_one():
    page = (EXAMPLES.parent / "docs" / "bring_your_own.md").read_text()
    names: dict = {"__name__": "page"}
    exec(page.split("```python\n")[1].split("```")[0], names)
    env = names["my_env"](batch_size=[1], seed=0)
    assert env.reset()["pixels"].shape == (1, 6, 64, 64)
    env.close()


@pytest.mark.slow  # as of every run that stops and goes on
def test_the_same_seed_gives_the_same_agent(example, tmp_path):
    module = example("bring_your_own_cartpole.py")
    agents = [Experiment(compose([*TINY, f"out_dir={tmp_path / k}"]), module.my_env).train() for k in "ab"]
    first, second = (agent.state_dict() for agent in agents)
    assert all((first[name] == second[name]).all() for name in first)


def test_a_set_that_is_never_seen_is_named(example, tmp_path):
    module = example("bring_your_own_cartpole.py")
    never = partial(module.my_env, unsafe=lambda state, info: False)
    with pytest.raises(EmptyRegionError, match=r"unsafe transitions.*reset_options.*buffer\.unsafe"):
        run_experiment(never, TINY, out_dir=str(tmp_path))
