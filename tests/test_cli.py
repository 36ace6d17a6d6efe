"""The command: what it prints, what it refuses without a trace, and that a run goes from words to report."""

from __future__ import annotations

import json
import shlex
import subprocess
import sys
import time
import types
from pathlib import Path

import pytest
import yaml
from analytic import line_agent

import torchrl_sspl
from torchrl_sspl import cli
from torchrl_sspl.configs import compose
from torchrl_sspl.configs.reader import ENVS, fields, from_dict
from torchrl_sspl.errors import ConfigError
from torchrl_sspl.modules.agent import load

pytestmark = pytest.mark.filterwarnings("ignore::FutureWarning", "ignore::DeprecationWarning")
#: A run of a few seconds, on top of preset=smoke.
TINY = [
    "preset=smoke", "trainer.progress=false", "trainer.checkpoint_seconds=-1", "env.image_size=16", "network.pool_to=8", "network.barrier_hidden=[8]",
    "network.policy_hidden=[8]", "network.dynamics_hidden=[8]", "collector.frames_per_batch=64", "collector.init_random_frames=64",
    "trainer.total_frames=128", "trainer.optim_steps_per_batch=3", "buffer.batch=16", "synthesis.rounds=1", "synthesis.transitions=128",
    "synthesis.dynamics_steps=4", "synthesis.fit_steps=4", "synthesis.steer_steps=3", "synthesis.tune_steps=3", "synthesis.teach_steps=4",
    "synthesis.batch=32", "synthesis.residuals=2", "synthesis.actions=3", "synthesis.check_episodes=8", "synthesis.check_horizon=2",
    "evaluation.episodes=4", "evaluation.horizon=3", "evaluation.grid=9", "evaluation.kernel_grid=31",
    "evaluation.certificate_episodes=4", "evaluation.certificate_seconds=1",
]  # fmt: skip


def test_usage_version_and_unknown_commands(capsys):
    assert cli.main(["--version"]) == 0
    assert torchrl_sspl.__version__ in capsys.readouterr().out
    assert cli.main(["--help"]) == 0
    shown = capsys.readouterr().out
    assert all(word in shown for word in ("train", "evaluate", "verify", "compare", "watch", "calibrate", "export"))
    assert cli.main([]) == 2
    assert cli.main(["trian"]) == 2
    assert "one of train, evaluate, verify, compare, watch, calibrate, export, received 'trian'" in capsys.readouterr().err


def test_python_m_is_the_same_command():
    done = subprocess.run([sys.executable, "-m", "torchrl_sspl", "--version"], capture_output=True, text=True, check=True)
    assert done.stdout == f"torchrl_sspl {torchrl_sspl.__version__}\n"


@pytest.mark.parametrize("env", [None, *ENVS])
def test_help_of_train_lists_every_field(env, capsys, monkeypatch):
    monkeypatch.setitem(sys.modules, "hydra", None)
    words = [f"env={env}"] if env else []
    assert cli.main(["train", *words, "--help"]) == 0
    shown = capsys.readouterr().out
    for key, _, _, meaning in fields(compose(words)):
        assert f"  {key} " in shown
        assert meaning in shown
    assert all(choice in shown for choice in ENVS)


def test_cfg_job_prints_the_composed_configuration(capsys, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    words = ["env=quadruped", "preset=smoke", "seed=3"]
    for option in (["--cfg", "job"], ["--cfg=job"]):
        assert cli.main(["train", *words, *option]) == 0
        assert from_dict(yaml.safe_load(capsys.readouterr().out)) == compose(words)
    assert not list(tmp_path.iterdir())


MALFORMED = [
    ("+foo=3", "received '+foo'; the nearest are"),
    ("++foo=3", "received '++foo'; the nearest are"),
    ("++foo", "keys cannot be added or removed"),
    ("~foo", "received '~foo'; the nearest are"),
    ("~seed", "keys cannot be added or removed"),
    ("foo=3", "received 'foo'; the nearest are"),
    ("trainer.totl_frames=1", "the nearest are trainer.total_frames"),
    ("evaluation.rollouts=3", "evaluation.episodes"),
    ("env.sped=3", "torchrl_sspl.envs.PendulumEnv does not take it"),
    ("env.safe_set=3", "received 'env.safe_set'"),
    ("env.batch_size=[3]", "received 'env.batch_size'"),
    ("network=3", "received 'network'; the nearest are network.latent_dim"),
    ("trainer=rounds", "received 'trainer'; the nearest are trainer.total_frames"),
    ("env=pendulm", "expected env to be one of cmu, dubins, gymnasium, pendulum, quadruped, two_discs"),
    ("env=gone.yaml", "or an existing .yaml file, received 'gone.yaml'"),
    ("preset=sond", "expected preset to be one of sound, paper, quick, smoke, received 'sond'"),
    ("logger=csvv", "expected logger.kind to be one of"),
    ("loss=loud", "expected loss.preset to be one of sound, paper"),
    ("collector.backend=threads", "expected collector.backend to be one of sync, process, ray"),
    ("collector.workers=2", "expected collector.workers=1 with collector.backend=sync"),
    ("collector.envs=7", "multiple of workers x envs = 7"),
    ("collector.starts=[1,0]", "four shares"),
    ("collector.init_random_frames=1000000", "nothing would be learnt"),
    ("trainer.autocast=int8", "expected trainer.autocast to be one of none, bfloat16, float16"),
    ("synthesis.rounds=0", "expected synthesis.rounds >= 1"),
    ("synthesis.guard=-0.5", "expected synthesis.guard >= 0, received -0.5"),
    ("synthesis.safe_share=1.5", "expected synthesis.safe_share <= 1, received 1.5"),
    ("synthesis.leave_share=-1", "expected synthesis.leave_share >= 0"),
    ("synthesis.batch=2", "expected synthesis.batch >= 4"),
    ("synthesis.residuals=100", "expected synthesis.residuals <= 64"),
    ("synthesis.band=0", "expected synthesis.band > 0"),
    ("synthesis.lr=-0.1", "expected synthesis.lr >= 0"),
    ("network.lipschitz_bound=-1", "expected network.lipschitz_bound > 0"),
    ("network.latent_dim=0", "expected network.latent_dim >= 1"),
    ("evaluation.walk_seconds=-3", "expected evaluation.walk_seconds > 0"),
    ("evaluation.kernel_grid=1", "expected evaluation.kernel_grid of 0 (the system's own) or at least 2, received 1"),
    ("synthesis.teacher=me", "expected synthesis.teacher to be one of clearance, value"),
    ("network.barrier=relu", "expected network.barrier to be one of sandwich, lmi"),
    ("seed=one", "expected seed to be an integer, received 'one'"),
    ("seed=1.5", "expected seed to be an integer"),
    ("seed=nan", "expected seed to be an integer"),
    ("seed=", "expected seed to be an integer"),
    ("seed=null", "expected seed to be an integer"),
    ("seed=0,1,2", "`sspl train --multirun` runs each of several values"),
    ("seed=${foo}", "Interpolation key 'foo' not found"),
    ("optim.lr=fast", "expected optim.lr to be a number, received 'fast'"),
    ("optim.lr=.nan", "expected optim.lr to be a number"),
    ("trainer.progress=perhaps", "expected trainer.progress to be true or false"),
    ("network.policy_hidden=[16,x]", "expected network.policy_hidden to be a list of integers"),
    ("network.policy_hidden=[16", "expected network.policy_hidden to be a list of integers"),
    ("network.policy_hidden=16", "expected network.policy_hidden to be a list of integers"),
    ("env.image_size=big", "expected env.image_size to be an integer, received 'big'"),
    ("env.horizon=abc", "expected env.horizon to be an integer or null"),
    ("env._target_=nowhere:Env", "expected an import path like package.module:name, received 'nowhere:Env'"),
    ("env._target_=math:pi", "to be a class or function"),
    ("out_dir=null", "expected out_dir to be text"),
    ("seed", "expected an argument of the form key=value, received 'seed'"),
    ("=3", "expected an argument of the form key=value"),
    ("--seed=3", "received '--seed=3'; use seed=3"),
    ("--config-name=pendulum", "use env=NAME or env=FILE.yaml"),
    ("--resume", "use the same out_dir"),
    ("--jobs=3", "expected --multirun with --launcher or --jobs"),
    ("--cfg=all", "expected --cfg job"),
    ("--launcher", "expected a value after --launcher"),
]


@pytest.mark.parametrize(("word", "said"), MALFORMED, ids=[word for word, _ in MALFORMED])
def test_what_is_malformed_is_named_and_leaves_nothing(word, said, capsys, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    start = time.time()
    assert cli.main(["train", "env=pendulum", word]) == 2
    assert time.time() - start < 5
    shown = capsys.readouterr()
    assert said in shown.err
    assert len(shown.err) < 600
    assert shown.out == ""
    assert not list(tmp_path.iterdir())


def test_no_system_is_named(capsys):
    assert cli.main(["train", "seed=1"]) == 2
    assert "choose env=cmu|dubins|gymnasium|pendulum|quadruped|two_discs" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (["seed=0,,1"], "expected different values for seed"), (["seed=0,0"], "expected different values for seed"),
        (["out_dir=a,b"], "each run gets a directory in it"), (["seed=0,one"], "expected seed to be an integer, received 'one'"),
        (["seed=0,1", "--jobs=0"], "--jobs >= 1"), (["seed=0,1", "--jobs=two"], "--jobs to be an integer"),
        (["seed=0,1", "--launcher=slurm"], "--launcher to be one of local, ray"), (["+foo=1,2"], "received '+foo'"),
        (["env=pendulum,pendulm"], "received 'pendulm'"),
    ],
)  # fmt: skip
def test_a_malformed_multirun_starts_nothing(words, said, capsys, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    assert cli.main(["train", "-m", "env=pendulum", *words]) == 2
    assert said in capsys.readouterr().err
    assert not list(tmp_path.iterdir())


def test_multirun_with_cfg_shows_the_commands(capsys):
    assert cli.main(["train", "--multirun", "env=pendulum", "seed=0,1", "--cfg", "job"]) == 0
    assert capsys.readouterr().out.splitlines() == [
        f"sspl train env=pendulum seed={k} out_dir=runs/pendulum/seed={k}" for k in (0, 1)
    ]


def test_multirun_shows_commands_that_a_shell_takes(capsys):
    assert cli.main(["train", "--multirun", "env=pendulum", "seed=0,1", "out_dir=my runs", "--cfg", "job"]) == 0
    assert shlex.split(capsys.readouterr().out.splitlines()[1]) == ["sspl", "train", "env=pendulum", "seed=1", "out_dir=my runs/seed=1"]


def test_options_may_stand_between_the_words_of_an_evaluation(monkeypatch, tmp_path):
    seen = []
    monkeypatch.setattr(cli, "evaluate_agent", lambda *a, **k: (seen.append(a), types.SimpleNamespace(measurements={}, to_dict=dict))[1])
    assert cli.main(["evaluate", "pendulum", "--json", str(tmp_path / "f.json"), "episodes=5"]) == 0
    assert seen == [("pendulum", ["episodes=5"])]
    assert (tmp_path / "f.json").is_file()


def test_the_measurements_of_an_evaluation_are_json_that_every_reader_takes(monkeypatch, tmp_path):
    found = types.SimpleNamespace(measurements={}, to_dict=lambda: {"x": {"value": float("nan")}})
    monkeypatch.setattr(cli, "evaluate_agent", lambda *a, **k: found)
    assert cli.main(["evaluate", "pendulum", "--json", str(tmp_path / "f.json")]) == 0
    assert json.loads((tmp_path / "f.json").read_text()) == {"x": {"value": None}}


def stand_in(monkeypatch, name, **members):
    module = types.ModuleType(name)
    vars(module).update(members)
    monkeypatch.setitem(sys.modules, name, module)


def test_train_hands_the_configuration_to_an_experiment(monkeypatch, capsys):
    seen = []

    class Experiment:
        def __init__(self, config):
            seen.append(config)

        def run(self):
            return types.SimpleNamespace(summary=lambda: "all well", report="there.html")

    stand_in(monkeypatch, "torchrl_sspl.experiments.run", Experiment=Experiment)
    assert cli.main(["train", "env=quadruped", "seed=4"]) == 0
    assert seen == [compose(["env=quadruped", "seed=4"])]
    assert capsys.readouterr().out == "all well\nreport: there.html\n"


def agent_with(monkeypatch, env):
    body = compose([f"env={env}"]).to_dict()
    body.pop("out_dir")
    agent = types.SimpleNamespace(description={"config": body})
    monkeypatch.setattr("torchrl_sspl.modules.agent.load", lambda name, device: agent)
    return agent


def test_evaluate_where_the_dynamics_are_known(monkeypatch):
    agent, seen = agent_with(monkeypatch, "quadruped"), []
    monkeypatch.setattr("torchrl_sspl.evaluation.known.evaluate", lambda *a, **k: seen.append(a))
    cli.evaluate_agent("quadruped", ["episodes=3", "evaluation.seed=8"])
    assert seen[0][0] is agent
    assert seen[0][1].yaw_lag is None  # the car whose true kernel is known
    assert (seen[0][2].episodes, seen[0][2].seed, seen[0][2].horizon) == (3, 8, 60)


def test_evaluate_where_they_are_not(monkeypatch, tmp_path):
    agent, seen = agent_with(monkeypatch, "gymnasium"), []
    agent.description["config"]["env"] |= {"safe": "builtins:callable", "unsafe": "builtins:callable"}
    monkeypatch.setattr("torchrl_sspl.evaluation.episodes.evaluate_episodes", lambda *a, **k: seen.append(a))
    cli.evaluate_agent("cart")
    assert seen[0][1].target == "torchrl_sspl.configs.reader.gymnasium_env"


def test_agents_that_cannot_be_evaluated_are_named(tmp_path, capsys, monkeypatch):
    assert cli.main(["evaluate", "nobody"]) == 2
    assert "pendulum" in capsys.readouterr().err
    (tmp_path / "agent.json").write_text("{")
    assert cli.main(["evaluate", str(tmp_path)]) == 2
    assert "agent.safetensors" in capsys.readouterr().err
    agent = agent_with(monkeypatch, "pendulum")
    assert cli.main(["evaluate", "it", "epsodes=3"]) == 2
    assert "received 'evaluation.epsodes'; the nearest are evaluation.episodes" in capsys.readouterr().err
    agent.description["config"]["env"] = {"made by": "my.make 123"}
    assert cli.main(["evaluate", "it"]) == 2
    assert "it was given in code" in capsys.readouterr().err
    agent.description["config"] = {"rounds": 3}
    assert cli.main(["evaluate", "it"]) == 2
    assert "another version" in capsys.readouterr().err
    agent.description.clear()
    assert cli.main(["evaluate", "it"]) == 2
    assert "another version" in capsys.readouterr().err


@pytest.mark.parametrize("code", [0, 1])
def test_verify_returns_the_verdict(code, monkeypatch):
    asked = []
    stand_in(monkeypatch, "torchrl_sspl.evaluation.certify", verify_run=lambda agent, **options: asked.append(agent) or code)
    assert cli.main(["verify", "pendulum"]) == code
    assert asked == ["pendulum"]


def test_compare_writes_a_page_beside_the_runs(tmp_path, capsys):
    for k in (0, 1):
        (tmp_path / f"seed={k}").mkdir()
        body = {"schema": 1, "config": {"seed": k}, "measurements": {"own": {"leave": {"value": k / 10, "unit": "share"}}}}
        (tmp_path / f"seed={k}" / "metrics.json").write_text(json.dumps(body))
    (tmp_path / "sweep.json").write_text("{}")
    assert cli.main(["compare", *map(str, sorted(tmp_path.iterdir()))]) == 0
    assert "leave" in capsys.readouterr().out
    assert "seed=1" in (tmp_path / "comparison.html").read_text()
    assert cli.main(["compare", str(tmp_path / "gone")]) == 2
    assert "gone" in capsys.readouterr().err


@pytest.mark.slow  # the examples go the same way
def test_from_words_to_report_and_evaluated_again(tmp_path, capsys):
    pytest.importorskip("matplotlib")
    assert cli.main(["train", "env=pendulum", *TINY, f"out_dir={tmp_path}/run"]) == 0, capsys.readouterr().err
    capsys.readouterr()
    for name in ("metrics.json", "report.html", "agent/agent.json", "config.json", "log.jsonl"):
        assert (tmp_path / "run" / name).stat().st_size > 0
    again = tmp_path / "again.json"
    assert cli.main(["evaluate", str(tmp_path / "run"), "episodes=3", "seed=5", "--json", str(again)]) == 0
    assert json.loads(again.read_text())["volume_over_kernel"]["n"] > 0
    assert str(tmp_path) not in Path(tmp_path / "run" / "agent" / "agent.json").read_text()


@pytest.mark.slow
def test_gymnasium_and_an_encoder_by_import_paths(tmp_path, capsys, monkeypatch):
    pytest.importorskip("matplotlib")
    (tmp_path / "my_cart.py").write_text(
        "from torch import nn\n"
        "def safe(state, info):\n    return abs(state[2]) < 0.05\n"
        "def unsafe(state, info):\n    return abs(state[2]) > 0.1\n"
        "class Encoder(nn.Sequential):\n"
        "    def __init__(self, latent_dim):\n"
        "        super().__init__(nn.AdaptiveAvgPool2d(4), nn.Flatten(), nn.Linear(96, latent_dim), nn.Tanh())\n"
        "    def forward(self, pixels):\n"
        "        return super().forward(pixels.reshape(-1, *pixels.shape[-3:]) / 255.0).reshape(*pixels.shape[:-3], -1)\n"
    )
    monkeypatch.chdir(tmp_path)
    monkeypatch.delitem(sys.modules, "my_cart", raising=False)  # another test may have one of the same name
    env = ["env=gymnasium", "env.make=CartPole-v1", "env.safe=my_cart:safe", "env.unsafe=my_cart:unsafe"]
    more = ["network.encoder=my_cart:Encoder", "collector.envs=4", "trainer.total_frames=192", "collector.init_random_frames=128"]
    more += ["evaluation.envs=4"]
    assert cli.main(["train", *env, *TINY, *more, "out_dir=run"]) == 0, capsys.readouterr().err
    assert cli.main(["evaluate", "run", "episodes=2"]) == 0
    assert cli.main(["train", "env=gymnasium", *TINY, "out_dir=other"]) == 2
    assert "expected env.safe to name a predicate" in capsys.readouterr().err
    assert cli.main(["train", *env[:-1], "env.unsafe=my_cart:unsfe", *TINY, "out_dir=other"]) == 2
    assert "received 'my_cart:unsfe'" in capsys.readouterr().err
    assert not (tmp_path / "other").exists()


@pytest.mark.parametrize("seconds", ["nan", "-1"])
def test_a_time_that_is_none_is_a_wrong_argument_of_verify(seconds, capsys):
    assert cli.main(["verify", "pendulum", "--seconds", seconds]) == 2
    assert "expected seconds >= 0" in capsys.readouterr().err


QUICK = ["--episodes", "4", "--horizon", "3", "--pictures", "200", "--steps", "50"]


def test_calibrate_writes_limits_that_the_monitor_reads(tmp_path, capsys):
    agent = torchrl_sspl.load("pendulum")
    agent.save(tmp_path / "run")
    assert cli.main(["calibrate", str(tmp_path / "run"), *QUICK]) == 0
    shown = capsys.readouterr().out
    assert "innovation" in shown
    assert "100 % expected" in shown  # of four episodes
    assert torchrl_sspl.Monitor.load(tmp_path / "run").calibration.episodes == 4


def test_a_system_of_ones_own_is_calibrated_where_it_is_trusted(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "my_line.py").write_text("from analytic import Line, Reader\n\n\nclass Road(Line):\n    pass\n\n\nclass Eye(Reader):\n    pass\n")
    agent = line_agent(config={"env": {"_target_": "my_line:Road"}})
    agent.save("run")
    words = ["calibrate", "run", *QUICK, "--noise", "0"]
    assert cli.main(words) == 2
    assert "--trust" in capsys.readouterr().err
    assert "my_line" not in sys.modules
    assert cli.main([*words, "--trust"]) == 0
    assert torchrl_sspl.Monitor.load("run").calibration.episodes == 4
    agent.description["networks"]["encoder"]["class"] = "my_line:Eye"
    agent.save("run")
    sys.modules.pop("my_line")
    assert cli.main(words) == 2
    assert "received 'my_line:Eye', whose import runs code" in capsys.readouterr().err
    assert "my_line" not in sys.modules
    assert cli.main([*words, "--trust"]) == 0
    sys.modules.pop("my_line")
    line_agent(config={"env": {"made by": "my.make 123"}}).save("code")
    assert cli.main(["calibrate", "code", "--trust"]) == 2
    assert "given in code, call sspl.calibrate(agent, env) there" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("words", "told"),
    [
        (["calibrate", "pendulum"], "--out DIRECTORY"),
        (["calibrate", "pendulum", "--out", "x", "--episodes", "0"], "episodes, horizon"),
        (["calibrate", "pendulum", "--out", "x", *QUICK, "--noise", "inf"], "finite noise"),
        (["calibrate", "nobody"], "nobody"),
        (["export", "pendulum", "agent.bin"], ".onnx or .pt2"),
    ],
)
def test_what_cannot_be_calibrated_or_exported_is_refused(words, told, capsys):
    assert cli.main(words) == 2
    assert told in capsys.readouterr().err


def test_export_writes_the_file(tmp_path, capsys):
    assert cli.main(["export", "pendulum", str(tmp_path / "agent.pt2")]) == 0
    assert capsys.readouterr().out.strip().endswith("agent.pt2")
    assert (tmp_path / "agent.pt2").stat().st_size > 1000


@pytest.mark.parametrize("word", ["walks=200", "evaluation.renderer_episodes=3", "calibrate=false"])
def test_options_of_a_run_are_refused_where_they_would_do_nothing(word):
    with pytest.raises(ConfigError, match="belong to a run"):
        cli.evaluate_agent("pendulum", [word])


def test_an_evaluation_keeps_away_from_the_seed_of_the_training():
    with pytest.raises(ConfigError, match="with which the data of the training are drawn"):
        cli.evaluate_agent("pendulum", [f"seed={load('pendulum').description['config']['seed']}"])
    with pytest.raises(ConfigError, match=r"evaluation\.seed to be another one than seed=5"):
        compose(["env=pendulum", "seed=5", "evaluation.seed=5"]).check()
