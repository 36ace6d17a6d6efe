"""The benchmark of few labels, at a size of seconds."""

from __future__ import annotations

import csv
import json
import runpy
import sys
from pathlib import Path
from types import SimpleNamespace

import pytest
from tiny import TINY_PHASES

from torchrl_sspl.baselines import Needs, ScoreConfig
from torchrl_sspl.baselines.cell import SCHEMA
from torchrl_sspl.envs import PendulumEnv
from torchrl_sspl.errors import ConfigError, OutputError
from torchrl_sspl.evaluation.measurements import Evaluation, share
from torchrl_sspl.experiments.run import Experiment
from torchrl_sspl.trainers.phases import Check

BENCHMARK = Path(__file__).parents[2] / "benchmarks" / "few_labels.py"
SIZES = ["score.episodes=4", "score.horizon=3", "score.grid=11", "score.kernel_grid=31", "score.frames=1", "score.shifted=0"]
SHORT = [
    *TINY_PHASES, "trainer.optim_steps_per_batch=4", "synthesis.tighten_steps=0", "synthesis.check_episodes=20", "synthesis.check_horizon=3",
    "trainer.checkpoint_seconds=-1", "evaluation.certificate_seconds=0.1",
]  # fmt: skip


def start(monkeypatch, *words: str) -> None:
    monkeypatch.setattr(sys, "argv", ["few_labels.py", *words])
    runpy.run_path(str(BENCHMARK), run_name="__main__")


@pytest.mark.parametrize("labels", [["20"], pytest.param(["20", "all"], marks=pytest.mark.slow)], ids=",".join)
def test_every_point_is_measured_once_and_says_how_many_labels_it_had(tmp_path, monkeypatch, capsys, labels):
    words = [f"labels={','.join(labels)}", "transitions=1280", "wrong=0.05", "seed=0", f"out={tmp_path}", *SIZES, *SHORT]

    def run(*more: str) -> str:
        start(monkeypatch, *words, *more)
        return capsys.readouterr().out

    assert "| 20 | 20 |" not in run("run=false")
    printed = run()
    assert "| pendulum | 20 | 20 | 0 | 1280 | 0.05 | 0 |" in printed
    check = json.loads((tmp_path / "points.json").read_text())[0]["checks"][0]
    assert f"| 0.05 | 0 | {check['reason'] or check['level']} |" in printed
    found = json.loads((tmp_path / "points.json").read_text())
    assert [row["labels"] for row in found] == labels
    assert "all" not in labels or found[1]["needs"]["safe_labels"] > 100
    before = [path.stat().st_mtime_ns for path in sorted(tmp_path.rglob("point.json"))]
    assert run() == printed
    assert run("run=false") == printed
    with pytest.raises(ConfigError, match=r"score: expected .*'grid': 11.*received .*'grid': 12"):
        run("score.grid=12")
    assert [path.stat().st_mtime_ns for path in sorted(tmp_path.rglob("point.json"))] == before


def point(
    out: Path, labels: str, transitions: int, volume: float | None, *, passed: bool, wrong: float = 0.0, options: tuple[str, ...] = (), starts: tuple[float, ...] = (0.6, 0.15, 0.25)
) -> None:
    path = out / f"{labels}-{transitions}-{wrong}-{len(options)}-{starts[0]}" / "point.json"
    path.parent.mkdir(parents=True)
    counts = {"safe_labels": 100, "unsafe_labels": 100, "neither_labels": 0}
    others = {"false_safe": {"value": None}, "unsafe_called_safe": {"value": 0.1}, "claimed_harmless_enter": {"value": None}, "common_harmless_enter": {"value": 0.0}}
    path.write_text(json.dumps({
        "schema": SCHEMA, "env": "pendulum", "labels": labels, "transitions": transitions, "wrong": wrong, "seed": 0, "options": options, "starts": starts,
        "passed": float(passed), "needs": counts, "measurements": {"claimed_over_kernel": {"value": volume}, **others},
    }))  # fmt: skip


def test_the_figure_shows_every_training_and_which_of_them_pass(tmp_path, monkeypatch, capsys):
    point(tmp_path, "100", 20_000, 0.5, passed=True)
    point(tmp_path, "all", 20_000, 0.7, passed=False)
    point(tmp_path, "100", 2_000, None, passed=False)
    point(tmp_path, "100", 20_000, 0.9, passed=True, wrong=0.01)
    point(tmp_path, "100", 20_000, 0.8, passed=True, options=("labels.choose=40",))
    point(tmp_path, "100", 20_000, 0.6, passed=True, options=("labels.choose=40", "synthesis.guard=0.02"))
    figure = runpy.run_path(str(BENCHMARK))["figure"]
    monkeypatch.setattr("matplotlib.figure.Figure.savefig", lambda self, path, **look: drawn.append(self))
    drawn: list = []
    figure(tmp_path)
    left, right = drawn[0].axes
    marks = [line for line in left.lines if line.get_marker() == "o"]
    assert sorted(line.get_ydata()[0] for line in marks) == [50.0, 60.0, 70.0, 80.0]  # a wrong label makes another figure
    assert {line.get_ydata()[0] for line in marks if line.get_markerfacecolor() == "white"} == {70.0}
    assert {line.get_ydata()[0] for line in left.lines if line.get_marker() == "^"} == {10.0}
    named = [text.get_text() for text in left.get_legend().get_texts()]
    assert named == ["20,000 transitions", "20,000 transitions, 40 labels chosen", "20,000 transitions, 40 labels chosen, synthesis.guard=0.02"]
    # Those of which 40 labels are chosen have one number of transitions.
    assert [text.get_text() for text in right.get_legend().get_texts()] == ["100 labels of S and of U"]


def test_the_data_beside_the_figure_draws_it_again_and_takes_what_is_measured_later(tmp_path):
    figure = runpy.run_path(str(BENCHMARK))["figure"]
    first, second = tmp_path / "first", tmp_path / "second"
    point(first, "100", 20_000, 1 / 3, passed=True, options=("labels.choose=40", "x=[1,2]"))
    point(first, "all", 640, None, passed=False, starts=(0.0, 0.5, 0.5))
    picture = figure(first).read_bytes()
    data = (first / "few_labels.csv").read_text()
    assert data.splitlines()[1:] == [
        'pendulum,100,20000,0.0,0,"labels.choose=40 x=[1,2]",1,200,0.333333,,0.1,,0.0',
        'pendulum,all,640,0.0,0,"starts=[0.0,0.5,0.5]",0,200,,,0.1,,0.0',
    ]
    second.mkdir()
    (second / "few_labels.csv").write_text(data)
    assert figure(second).read_bytes() == picture
    assert (second / "few_labels.csv").read_text() == data
    point(second, "100", 20_000, 0.5, passed=False, options=("labels.choose=40", "x=[1,2]"))
    point(second, "all", 20_000, 0.75, passed=True)
    point(second, "1000", 20_000, 0.25, passed=True)
    figure(second)
    assert (second / "few_labels.csv").read_text().splitlines()[1:] == [
        "pendulum,1000,20000,0.0,0,,1,200,0.25,,0.1,,0.0",
        "pendulum,all,20000,0.0,0,,1,200,0.75,,0.1,,0.0",
        'pendulum,100,20000,0.0,0,"labels.choose=40 x=[1,2]",0,200,0.5,,0.1,,0.0',
        'pendulum,all,640,0.0,0,"starts=[0.0,0.5,0.5]",0,200,,,0.1,,0.0',
    ]


def test_the_table_of_the_documentation_is_that_of_its_data():
    docs = BENCHMARK.parents[1] / "docs"
    lines = list(csv.DictReader((docs / "images" / "few_labels.csv").read_text().splitlines()))
    table = (docs / "comparison.md").read_text().partition("| system | first | chosen | transitions | wrong | checks passed |")[2].partition("\n\n")[0]
    rows = [[cell.strip() for cell in row.strip("|").split("|")] for row in table.splitlines()[2:]]
    assert len(rows) > 15
    for system, first, chosen, transitions, wrong, passed, *shares in rows:
        options = {"400": "labels.choose=400", "-": "labels.share=0.1" if "at random" in first else ""}[chosen]
        point = {
            "env": {"Dubins car": "dubins"}.get(system, system), "labels": first.partition(",")[0], "transitions": transitions.replace(",", ""), "wrong": f"{float(wrong)}",
            "options": options if transitions != "640" else "collector.max_frames_per_traj=1 starts=[0.0,0.5,0.5]",
        }  # fmt: skip
        found = [line for line in lines if point.items() <= line.items()]
        assert [line["seed"] for line in found] == [str(seed) for seed in range(len(found))]
        assert passed == f"{sum(int(line['passed']) for line in found)} of {len(found)}", point
        names = ("claimed_over_kernel", "false_safe", "unsafe_called_safe", "claimed_harmless_enter", "common_harmless_enter")
        for name, cell in zip(names, shares, strict=True):
            if cell == "-":
                assert {line[name] for line in found} == {""}
                continue
            scale = 100 if name != "claimed_harmless_enter" else 2000 if system == "quadruped" else 200
            measured = [scale * float(line[name]) for line in found]
            shown = cell.split(", ")
            assert [float(value) for value in shown] == pytest.approx(measured, abs=0.051), (point, name)


def test_a_figure_of_nothing_is_refused(tmp_path):
    with pytest.raises(ConfigError, match="expected measured points"):
        runpy.run_path(str(BENCHMARK))["figure"](tmp_path)


def test_the_quadruped_is_a_run_with_settings_of_its_own(tmp_path, monkeypatch, capsys):
    asked = []

    def run(self: Experiment) -> SimpleNamespace:
        asked.append(self.config)
        names = ("volume_over_kernel", "safe_rollouts_touch_unsafe", "false_safe", "unsafe_called_safe")
        evaluation = Evaluation({name: share(name, k, 10) for k, name in enumerate(names)})
        return SimpleNamespace(checks=[Check(0, 0.0, 0, 0, 0, 0, 1.0, 0.5, True, "")], budget={"labels of S": 20}, evaluation=evaluation)

    monkeypatch.setattr(Experiment, "run", run)
    words = ["env=quadruped", "labels=20", "labels.choose=20", "transitions=640", "seed=3", f"out={tmp_path}", *SIZES, "env.image_size=32", "network.pool_to=16"]
    start(monkeypatch, *words)
    (config,), printed = asked, capsys.readouterr().out
    s = config.synthesis
    assert (s.transitions, s.rim_transitions, s.rollout_transitions, s.cover_share, s.retries, s.lowest_level) == (384, 128, 128, 0.0, 1, -0.2)
    assert (config.labels.safe, config.labels.choose, config.seed, config.evaluation.episodes, config.evaluation.grid) == (20, 20, 3, 4, 11)
    assert printed.splitlines()[-1].endswith("| 3 | 0 | 0.0 % | 20.0 % | 30.0 % | 10.0 % | - |")
    start(monkeypatch, *words)
    assert capsys.readouterr().out == printed
    assert len(asked) == 1  # a point that has been measured is read
    with pytest.raises(ConfigError, match="starts: expected none with env=quadruped"):
        start(monkeypatch, *words, "starts=[0,0.5,0.5]")


def test_a_point_of_a_file_is_that_of_its_content(tmp_path, monkeypatch):
    own = tmp_path / "mine.yaml"
    own.write_text("env: {_target_: torchrl_sspl.envs.PendulumEnv}\n")
    made = runpy.run_path(str(BENCHMARK))
    point, path = made["Point"](str(own), "20", 640, 0.0, 0, ()), tmp_path / "point.json"
    monkeypatch.setattr(made["Point"], "_row", lambda *of: ([], Needs(), {}))
    row = point.measure(path, ScoreConfig())
    assert point.measure(path, ScoreConfig()) == json.loads(json.dumps(row))
    own.write_text("env: {_target_: torchrl_sspl.envs.PendulumEnv, max_torque: 4.0}\n")
    with pytest.raises(ConfigError, match=r"env: expected '.*mine\.yaml' as it was when '.*point\.json' was measured, received another content"):
        point.measure(path, ScoreConfig())
    assert made["Point"]("../mine.yaml", "20", 640, 0.0, 0, ()).path.parts[:2] == ("up", "mine.yaml")


def test_a_point_of_another_version_is_refused(tmp_path, monkeypatch):
    made = runpy.run_path(str(BENCHMARK))
    path = tmp_path / "point.json"
    path.write_text("{}")
    for read in (lambda: made["Point"]("pendulum", "20", 640, 0.0, 0, ()).measure(path, ScoreConfig()), lambda: made["gathered"](tmp_path)):
        with pytest.raises(OutputError, match=rf"expected measurements of schema {SCHEMA} in '.*point\.json'.*None"):
            read()


@pytest.mark.slow
def test_the_quadruped_is_a_run_that_scores_itself(tmp_path, monkeypatch, capsys):
    small = [*SHORT, "env.image_size=32", "network.pool_to=16", "synthesis.retries=0", "synthesis.grid=9", "synthesis.turns=4", "buffer.batch=24", "trainer.optim_steps_per_batch=1"]
    words = ["env=quadruped", "labels=20", "labels.choose=20", "transitions=640", "seed=0", f"out={tmp_path}", *SIZES, *small]
    start(monkeypatch, *words)
    printed = capsys.readouterr().out
    (row,) = json.loads((tmp_path / "points.json").read_text())
    assert row["needs"]["safe_labels"] + row["needs"]["unsafe_labels"] + row["needs"]["neither_labels"] <= 60
    assert row["needs"]["rollouts"] == 128
    assert row["measurements"]["claimed_over_kernel"]["name"] == "volume_over_kernel"
    assert row["measurements"]["claimed_harmless_enter"]["n"] in (0, 4)
    assert printed.splitlines()[-1].endswith("| - |")


@pytest.mark.slow
def test_without_unlabelled_pictures_every_one_has_a_label(tmp_path, monkeypatch, capsys):
    words = ["labels=all", "transitions=640", "seed=0", "starts=[0,0.5,0.5]", "collector.max_frames_per_traj=1", f"out={tmp_path}", *SIZES, *SHORT]
    start(monkeypatch, *words)
    (row,) = json.loads((tmp_path / "points.json").read_text())
    needs = row["needs"]
    assert needs["safe_labels"] + needs["unsafe_labels"] == needs["transitions"]


def test_wrong_labels_are_found_and_right_ones_used():
    measure = runpy.run_path(str(BENCHMARK.with_name("labels_on_states.py")))["measure"]
    right, wrong = (measure(PendulumEnv(), share, 0, 1500) for share in (0.0, 0.05))
    assert right["wrong"] == right["right and not used"] == 0
    assert right["missed"] == right["missed if all labels are used"]
    assert wrong["wrong and not used"] > 0.3 * wrong["wrong"] > 0
    assert wrong["right and not used"] <= 2
    assert wrong["missed"] < wrong["missed if all labels are used"]


def test_labels_that_come_first_say_more_by_how_frequent_they_are_than_alone():
    inferred = runpy.run_path(str(BENCHMARK.with_name("labels_on_states.py")))["inferred"]
    found = {name: float(share.split()[0]) for name, share in inferred(PendulumEnv(), 60, 0, 3000, 200).items()}
    assert found["missed"] < 5 < 90 < found["missed, labels alone"]
    assert found["added"] < found["added, interpolated"] + 5
    assert found["added, labels alone"] == 0
