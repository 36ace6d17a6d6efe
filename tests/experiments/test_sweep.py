"""Many runs of one command: which, where, what happens when one fails or all are interrupted, and the table over them."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
import threading
import time
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import pytest

from torchrl_sspl.configs import compose
from torchrl_sspl.envs.system import Requirement
from torchrl_sspl.errors import CheckpointError, ConfigError, OutputError
from torchrl_sspl.evaluation.measurements import Evaluation
from torchrl_sspl.evaluation.outcome import Outcome, write_metrics
from torchrl_sspl.experiments.sweep import Task, _shown, expand, plan, sweep
from torchrl_sspl.viz import compare as page

# What a training leaves behind, in a tenth of a second; seed 13 fails.
STUB = """
import json, sys, time
from dataclasses import asdict
from pathlib import Path
from torchrl_sspl.configs import compose
config = compose(sys.argv[1:])
out = Path(config.out_dir)
with (out / "calls.txt").open("a") as file:
    file.write("x")
if config.seed == 13:
    sys.exit("no luck")
if config.seed == 99 and not (out / "state").exists():
    try:
        (out / "ready").write_text("")
        time.sleep(300)
    except KeyboardInterrupt:
        (out / "state").write_text("saved")
        sys.exit(130)
value = config.seed / 100 + config.synthesis.margin
body = config.to_dict()
body.pop("out_dir")
row = {"name": "leave", "label": "episodes that leave", "sense": "<=", "must": 0.1, "aim": 0.0}
metrics = {"schema": 1, "seed": config.seed, "training_seconds": 60.0, "stop_reason": "all phases are done",
           "requirements": [row], "verdicts": {"episodes that leave": "must" if value <= 0.1 else "missed by 1"},
           "measurements": {"own": {"leave": {"value": value, "unit": "share", "n": 100}, "volume": {"value": 0.8, "unit": "ratio"}}},
           "config": body}
(out / "metrics.json").write_text(json.dumps(metrics))
lines = [{"phase": "fit", "round": r, "step": s, "loss_safe": 1 / s} for r in (0, 1) for s in (1, 5, 10)]
(out / "log.jsonl").write_text("".join(json.dumps(line) + chr(10) for line in lines))
(out / "figures").mkdir(exist_ok=True)
(out / "figures" / "state_plane.png").write_bytes(b"picture")
"""


@pytest.fixture
def command(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "stub.py").write_text(STUB)
    return sys.executable, str(tmp_path / "stub.py")


def calls(directory: Path) -> int:
    return len((directory / "calls.txt").read_text())


# ---------------------------------------------------------------------- which runs


def test_every_combination_once():
    runs = expand(["env=pendulum", "seed=0,1", "synthesis.margin=.05,.1", "network.policy_hidden=[8,8],[16]"])
    assert len(runs) == 8
    assert runs[0] == (
        "seed=0,synthesis.margin=.05,network.policy_hidden=[8,8]",
        {"env": "pendulum", "seed": "0", "synthesis.margin": ".05", "network.policy_hidden": "[8,8]"},
    )
    assert len({name for name, _ in runs}) == 8


def test_brackets_and_quotes_protect_commas():
    assert [chosen for _, chosen in expand(["logger.project='a,b'", "env.size=[1,2]", "env.x={a: 1, b: 2}"])] == [
        {"logger.project": "'a,b'", "env.size": "[1,2]", "env.x": "{a: 1, b: 2}"}
    ]


def test_names_are_names_of_folders():
    runs = expand(["env=a/b.yaml,a_b.yaml,../c.yaml", "network.encoder=my:A,my:B"])
    assert all(Path(name).name == name for name, _ in runs)
    assert len({name for name, _ in runs}) == 6
    assert all(len(name) < 220 for name, _ in expand([f"out.{'x' * 300}=1,2"]))


@pytest.mark.parametrize("word", ["seed=0,,1", "seed=0,0", "out_dir=a,b", "seed=0,"])
def test_values_that_are_no_choice(word):
    with pytest.raises(ConfigError, match="expected different values for"):
        expand([word])


def test_each_run_has_a_directory_in_that_of_the_sweep():
    directory, tasks = plan(["env=pendulum", "seed=0,1"])
    assert directory == Path("runs/pendulum")
    assert [t.config.out_dir for t in tasks] == ["runs/pendulum/seed=0", "runs/pendulum/seed=1"]
    assert all(compose(t.words) == t.config for t in tasks)
    assert plan(["env=pendulum,dubins"])[0] == Path("runs/sweep")
    assert plan(["env=pendulum,dubins", "out_dir=here"])[0] == Path("here")


def test_a_directory_that_names_values_of_its_runs_is_used():
    directory, tasks = plan(["env=pendulum", "seed=0,1", "out_dir=/data/${seed}/x"])
    assert directory == Path("/data")
    assert [t.config.out_dir for t in tasks] == ["/data/0/x/seed=0", "/data/1/x/seed=1"]


# ---------------------------------------------------------------------- running them


def test_runs_end_with_one_table_and_one_page(command, capfd):
    out = sweep(["env=dubins", "seed=0,5", "synthesis.margin=.05,.1", "out_dir=many"], jobs=2, command=command)
    assert out.exit_code == 0
    assert {t.status for t in out.tasks} == {"done"}
    rows = {r.setting: r for r in out.rows if r.name == "leave"}
    assert set(rows) == {"synthesis.margin=0.05", "synthesis.margin=0.1"}
    small, large = rows["synthesis.margin=0.05"], rows["synthesis.margin=0.1"]
    assert small.mean == pytest.approx(0.075)
    assert small.worst == pytest.approx(0.1)
    assert (small.must, small.verdict, large.verdict[:6]) == ("<= 10 %", "must", "missed")
    assert small.values == pytest.approx({"seed=0,synthesis.margin=.05": 0.05, "seed=5,synthesis.margin=.05": 0.1})
    text = out.summary()
    assert "episodes that leave  <= 10 %  7.5 %  10 %   must" in text
    body = json.loads(Path("many/sweep.json").read_text())
    assert [r["status"] for r in body["runs"]] == ["done"] * 4
    assert body["table"][0]["label"] == "episodes that leave"
    assert str(Path.cwd()) not in json.dumps(body)
    html = Path("many/comparison.html").read_text()
    assert html.count("data:image/png;base64,cGljdHVyZQ==") == 4
    assert html.count("<polyline") == 4
    assert "<script" not in html
    assert "http" not in html.replace("http-equiv", "")


def test_a_run_that_fails_does_not_stop_the_others(command):
    out = sweep(["env=dubins", "seed=13,0,1", "out_dir=many"], jobs=1, command=command)
    assert [t.status for t in out.tasks] == ["failed (exit code 1)", "done", "done"]
    assert out.exit_code == 1
    assert "no luck" in Path("many/seed=13/output.txt").read_text()
    assert "seed=13: failed (exit code 1); see many/seed=13/output.txt" in out.summary()
    row = next(r for r in out.rows if r.name == "leave")
    assert row.values == pytest.approx({"seed=13": None, "seed=0": 0.03, "seed=1": 0.04})
    assert row.verdict == "not measured"  # nobody knows about the third
    assert "not finished" in Path("many/comparison.html").read_text()


def test_all_of_them_fail(command):
    out = sweep(["env=dubins", "seed=13", "out_dir=many"], command=command)
    assert (out.page, out.rows, out.exit_code) == (None, [], 1)


def test_what_is_finished_is_not_run_again(command):
    words = ["env=dubins", "seed=0,13", "out_dir=many"]
    sweep(words, command=command)
    out = sweep(words, command=command)
    assert [t.status for t in out.tasks] == ["done before", "failed (exit code 1)"]
    assert (calls(Path("many/seed=0")), calls(Path("many/seed=13"))) == (1, 2)
    out = sweep([*words, "evaluation.episodes=3"], command=command)  # not the same any more
    assert out.tasks[0].status == "done"
    assert calls(Path("many/seed=0")) == 2


def test_agents_of_one_name_in_two_folders_are_two_settings(tmp_path):
    config = compose(["env=pendulum", f"agent={tmp_path}/x/best", f"out_dir={tmp_path}/run"])
    tasks = [Task(folder, replace(config, agent=f"{tmp_path}/{folder}/best"), []) for folder in ("x", "y")]
    agent = SimpleNamespace(description={}, lipschitz_proved=False)
    write_metrics(Outcome(tmp_path / "run", agent, config, None, {"own": Evaluation()}))
    assert [task.finished for task in tasks] == [True, False]
    text = (tmp_path / "run" / "metrics.json").read_text()
    assert '"agent": "best-' in text
    assert str(tmp_path) not in text
    runs = [page.Run(t.name, tmp_path, {"config": _shown(t.config)}) for t in tasks]
    assert page.differing(runs) == ["agent"]


def test_a_directory_that_cannot_be_made_is_named(command):
    Path("afile").write_text("")
    with pytest.raises(OutputError, match="received 'afile/x': Not a directory; choose another out_dir"):
        sweep(["env=pendulum", "seed=0,1", "out_dir=afile/x"], command=command)


def test_one_job_at_a_time(command):
    Path("stub.py").write_text("import sys, time\nprint(time.time()); time.sleep(.3); print(time.time())")
    sweep(["env=dubins", "seed=0,1,2", "out_dir=many"], jobs=1, command=command)
    times = [tuple(map(float, Path(f"many/seed={k}/output.txt").read_text().split())) for k in range(3)]
    assert all(first[1] <= second[0] for first, second in zip(times, times[1:], strict=False))


def test_every_run_has_one_thread(command):
    Path("stub.py").write_text("import os\nprint(os.environ['OMP_NUM_THREADS'])")
    sweep(["env=dubins", "out_dir=many"], command=command)
    assert Path("many/run/output.txt").read_text() == "1\n"


@pytest.mark.parametrize(
    ("number", "launcher"),
    [pytest.param(signal.SIGINT, "local", marks=pytest.mark.slow), (signal.SIGTERM, "local"), pytest.param(signal.SIGINT, "ray", marks=pytest.mark.ray)],
)
def test_a_signal_stops_the_runs_and_the_same_command_goes_on(command, number, launcher):
    if launcher == "ray":
        pytest.importorskip("ray")
    Path("stub.py").write_text(STUB.replace("import json", "import signal; signal.signal(15, signal.default_int_handler); import json"))
    words = ["env=dubins", "seed=99,0,1", "out_dir=many"]
    code = f"import sys; from torchrl_sspl.experiments.sweep import sweep; out = sweep({words}, launcher='{launcher}', jobs=1, command={command}); print(out.summary()); sys.exit(out.exit_code)"
    process = subprocess.Popen([sys.executable, "-c", code], stdout=subprocess.PIPE, text=True)
    while not Path("many/seed=99/ready").exists() and process.poll() is None:
        time.sleep(0.05)
    time.sleep(0.2)
    process.send_signal(number)
    shown, _ = process.communicate(timeout=120)
    assert process.returncode == 128 + number
    assert "the same command goes on where it was" in shown
    assert Path("many/seed=99/state").read_text() == "saved"
    assert not Path("many/seed=0/calls.txt").exists()
    assert [r["status"] for r in json.loads(Path("many/sweep.json").read_text())["runs"]] == ["interrupted", "waiting", "waiting"]
    out = sweep(words, command=command)
    assert [t.status for t in out.tasks] == ["done"] * 3


def test_a_run_that_ignores_the_signal_is_ended(command, monkeypatch):
    monkeypatch.setattr("torchrl_sspl.experiments.sweep.GRACE", 0.5)
    Path("stub.py").write_text("import signal, time\nsignal.signal(2, signal.SIG_IGN); print('up', flush=True); time.sleep(60)")

    def interrupt():
        while not Path("many/run/output.txt").exists() or not Path("many/run/output.txt").read_text():
            time.sleep(0.05)
        os.kill(os.getpid(), signal.SIGINT)

    threading.Thread(target=interrupt, daemon=True).start()
    start = time.time()
    out = sweep(["env=dubins", "out_dir=many"], command=command)
    assert time.time() - start < 30
    assert (out.tasks[0].status, out.exit_code) == ("interrupted", 130)


def test_handlers_of_signals_are_put_back(command):
    before = signal.getsignal(signal.SIGINT)
    sweep(["env=dubins", "out_dir=many"], command=command)
    assert signal.getsignal(signal.SIGINT) is before


@pytest.mark.ray
def test_on_ray(command):
    ray = pytest.importorskip("ray")
    try:
        out = sweep(["env=dubins", "seed=13,0,1", "out_dir=many"], launcher="ray", command=command)
    finally:
        ray.shutdown()
    assert [t.status for t in out.tasks] == ["failed (exit code 1)", "done", "done"]
    assert out.page.is_file()


@pytest.mark.slow
def test_real_runs(tmp_path, capsys):
    from test_cli import TINY

    from torchrl_sspl import cli

    words = ["train", "--multirun", "env=pendulum", *TINY, "seed=0,1", f"out_dir={tmp_path}/many", "--jobs", "2"]
    assert cli.main(words) == 0, capsys.readouterr().out
    shown = capsys.readouterr().out
    assert "volume of {B <= 0} over the true kernel" in shown
    assert "state" in (tmp_path / "many" / "comparison.html").read_text()
    assert cli.main(words) == 0
    assert [r["status"] for r in json.loads((tmp_path / "many/sweep.json").read_text())["runs"]] == ["done before"] * 2


# ---------------------------------------------------------------------- the table


def run(name, value, must=0.1, evaluation="own", **config):
    required = vars(Requirement("leave", "leaves", "<=", must, 0.0))
    measured = {evaluation: {"leave": {"value": value, "unit": "share"}}}
    return page.Run(name, Path(name), {"config": {"seed": 0, **config}, "requirements": [required], "measurements": measured})


def test_worst_goes_by_the_sense_of_the_requirement():
    runs = [run("a", 0.02), run("b", 0.05)]
    assert page.rows_of(runs)[0].worst == 0.05
    for one in runs:
        one.metrics["requirements"][0].update(sense=">=", must=0.03, aim=1.0)
    row = page.rows_of(runs)[0]
    assert (row.worst, row.verdict) == (0.02, "missed by 1 %")


def test_what_was_required_and_not_measured_has_a_row():
    one = run("a", None)
    one.metrics["measurements"] = {"own": {}}
    row = page.rows_of([one])[0]
    assert (row.verdict, row.mean, row.values) == ("not measured", None, {"a": None})


def test_evaluations_are_told_apart():
    one = run("a", 0.02)
    one.metrics["measurements"]["gymnasium"] = {"leave": {"value": 0.3, "unit": "share"}}
    assert [(r.label, r.verdict) for r in page.rows_of([one])] == [("leaves (own)", "must"), ("leaves (gymnasium)", "missed by 20 %")]


def test_settings_tell_groups_apart_but_not_seeds_or_folders():
    runs = [run("a", 0.1, seed=0, out_dir="x", optim={"lr": 1}), run("b", 0.2, seed=1, out_dir="y", optim={"lr": 2})]
    assert page.differing(runs) == ["optim.lr"]
    assert [r.setting for r in page.rows_of(runs)] == ["optim.lr=1", "optim.lr=2"]
    assert [len(r.values) for r in page.rows_of(runs)] == [1, 1]


def test_many_differences_are_counted():
    runs = [run("a", 0.1, optim=dict.fromkeys("uvwxyz", 1)), run("b", 0.2, optim=dict.fromkeys("uvwxyz", 2))]
    assert [r.setting for r in page.rows_of(runs)] == ["a (6 settings differ)", "b (6 settings differ)"]


def test_requirements_come_from_the_system_where_the_numbers_do_not_name_them():
    one = run("a", 0.02)
    del one.metrics["requirements"]
    one.metrics["config"]["env"] = compose(["env=pendulum"]).env
    one.metrics["measurements"]["own"] = {"volume_over_kernel": {"value": 0.6, "unit": "ratio"}}
    row = next(r for r in page.rows_of([one]) if r.name == "volume_over_kernel")
    assert (row.must, row.verdict) == (">= 0.5", "must")


@pytest.mark.parametrize(
    ("value", "upper", "said"),
    [
        (0.0, 0.05, "must reached"), (0.0, 0.2, "of 1: 1 with too few episodes"), (0.3, 0.4, "of 1: 1 missed"), (None, None, "of 1: 1 not measured"),
    ],
)  # fmt: skip
def test_a_run_is_green_only_where_the_bounds_reach_and_nothing_is_missing(tmp_path, value, upper, said):
    one = run("a", value)
    one.metrics["measurements"]["own"]["leave"] |= {"lower": 0.0, "upper": upper}
    overview = page.compare([one], tmp_path / "page.html").read_text().split("</section>")[0]
    assert said in overview.replace("&nbsp;", " ")
    assert ("badge good" in overview) == (said == "must reached")


def test_a_page_of_hostile_names_is_harmless(tmp_path):
    one = run("<script>alert(1)</script>", 0.02, optim={"lr": "<b>"})
    html = page.compare([one, run("b", 0.1)], tmp_path / "page.html", title="<i>").read_text()
    assert "<script" not in html
    assert "&lt;b&gt;" in html
    assert not list(tmp_path.glob("*.part"))


def test_what_is_no_run_is_named(tmp_path):
    with pytest.raises(CheckpointError, match="gone"):
        page.compare([tmp_path / "gone"], tmp_path / "page.html")
    (tmp_path / "empty").mkdir()
    with pytest.raises(CheckpointError, match="at least one run"):
        page.compare([tmp_path / "empty"], tmp_path / "page.html")
    (tmp_path / "empty" / "metrics.json").write_text("{")
    with pytest.raises(CheckpointError, match=r"metrics\.json"):
        page.compare([tmp_path / "empty"], tmp_path / "page.html")
    assert not (tmp_path / "page.html").exists()
