"""The table: which cells, what stands in it, what is not measured again."""

from __future__ import annotations

import csv
import json
import os
import signal
import subprocess
import sys
import time
from contextlib import suppress
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

import torchrl_sspl
from torchrl_sspl.baselines import BUDGETS, make
from torchrl_sspl.baselines.__main__ import main
from torchrl_sspl.baselines.cell import CLAIMS_FILE, ROW_FILE, Cell, run_cell
from torchrl_sspl.baselines.page import claims, failures, page
from torchrl_sspl.baselines.registry import METHODS, kind_of
from torchrl_sspl.baselines.table import _MEASURED, _SHIFTS, DEFAULTS, TICKS, _on_shift, _value, cells, markdown, table
from torchrl_sspl.errors import ConfigError
from torchrl_sspl.interrupts import Interrupted

DOCS = Path(__file__).parents[2] / "docs"
SMALL = ["score.episodes=10", "score.horizon=5", "score.grid=21", "score.kernel_grid=31", "score.frames=2"]


def test_the_default_table_has_every_method_on_every_system():
    asked = cells(["budget=small,full", "seed=0,1,2"])
    for env, names in DEFAULTS.items():
        learnt = {c.method for c in asked if c.env == env and kind_of(c.method).learns}
        assert learnt == {name for name in METHODS if kind_of(name).learns}
        assert {c.method for c in asked if c.env == env} == {n.split(":")[0] for n in names}
    one = [c for c in asked if c.env == "dubins" and c.method == "latent_cbf"]
    assert {(c.budget, c.seed) for c in one} == {(b, s) for b in ("small", "full") for s in (0, 1, 2)}
    assert len([c for c in asked if c.env == "dubins" and c.method == "cone"]) == 1  # no budget and no seed
    assert set(TICKS) <= set(METHODS)
    assert {len(t) for t in TICKS.values()} == {6}


def test_options_of_a_method_may_hold_commas():
    found = cells(["methods=depth:noise=[0.1,0.2]:beta=0.5,lqr", "env=pendulum"])
    assert [(c.method, c.options) for c in found] == [("depth", ("noise=[0.1,0.2]", "beta=0.5")), ("lqr", ())]


def test_the_table_runs_what_is_missing_and_only_that(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    words = ["methods=lqr,cone", "env=pendulum", *SMALL]
    text = markdown(table(["run=false", *words]))
    assert text.count("not measured") == 2
    assert main(["table", *words]) == 0
    text = capsys.readouterr().out
    assert "| lqr | none |" in text
    assert "expected a DubinsEnv" in text  # a cell that fails is named, the other stands
    path = tmp_path / "runs/baselines/pendulum/none/lqr/0" / ROW_FILE
    before = path.stat().st_mtime_ns
    assert "not measured" in markdown(table(["run=false", *words]))
    assert main(["table", *words]) == 0
    assert path.stat().st_mtime_ns == before
    assert (tmp_path / "runs/baselines/table.md").is_file()
    html = (tmp_path / "runs/baselines/table.html").read_text()
    assert html.count("<h3>") == 2  # measured, and given
    assert html.count("data:image/png") == 1
    assert "expected a DubinsEnv" in html
    (axes,) = [ax for ax in claims(cells(words)).axes if ax.images]
    colours = {tuple(c) for c in axes.images[0].get_array().reshape(-1, 3).tolist()}
    assert {(76, 159, 112), (207, 214, 228), (255, 255, 255)} <= colours  # claimed, the rest of the kernel, outside
    assert "not measured" not in markdown(table(["run=false", "methods=lqr", "env=pendulum"]))  # measured with other sizes, and said so


def test_a_failure_is_filmed_from_a_start_that_is_claimed_until_it_is_in_u(tmp_path):
    sizes = ["score.episodes=10", "score.horizon=80", "score.grid=21", "score.kernel_grid=31", "score.frames=2", "env=pendulum"]
    fails, safe = (Cell.of(name, [*words, f"out_dir={tmp_path / name}", *sizes]) for name, words in (("depth", ["beta=0.5"]), ("lqr", [])))
    for cell in (fails, safe):
        run_cell(cell)
    with np.load(fails.directory / CLAIMS_FILE) as body:
        states = torch.from_numpy(body["failed_harmless"])
    env, method = fails.environment(), make("depth", ["beta=0.5"])
    method.fit(None, env, BUDGETS["tiny"], 0)
    assert states.shape == (81, 2)
    assert method.claims(states[:1]).item()
    assert env.unsafe_set.contains(states).any()
    rows = [(cell, json.loads((cell.directory / ROW_FILE).read_text())) for cell in (safe, fails)]
    assert page(rows, tmp_path / "table.html").read_text().count("data:video/mp4") == 1
    assert (tmp_path / "failures-pendulum.mp4").stat().st_size > 10_000
    assert failures([safe], tmp_path / "none.mp4") is None
    seeds = [replace(fails, out_dir=str(safe.directory)), replace(fails, seed=1)]  # of one method, of which the second failed
    assert [ax.get_title() for ax in claims(seeds).axes if ax.images] == ["depth beta=0.5\nnone, seed 0"]
    assert failures(seeds, tmp_path / "second.mp4").is_file()


def test_a_table_lies_in_the_directory_that_it_is_given(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    assert main(["table", "methods=lqr", "env=pendulum", "out_dir=other", *SMALL]) == 0
    assert {path.name for path in (tmp_path / "other").iterdir()} == {"pendulum", "rows.csv", "rows.json", "table.html", "table.md"}
    assert (tmp_path / "other/pendulum/none/lqr/0" / ROW_FILE).is_file()
    assert not (tmp_path / "runs").exists()


@pytest.mark.slow
def test_cells_side_by_side_are_those_one_after_the_other(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    words = ["methods=lqr,cone,latent_cbf:autoencoder_steps=1:steps=1", "env=pendulum", "budget=tiny", "score.shifted=0", *SMALL]
    rows = table(["jobs=2", *words])
    assert [cell.method for cell, _ in rows] == ["lqr", "cone", "latent_cbf"]
    assert "expected a DubinsEnv" in rows[1][1]
    for cell, row in rows[::2]:
        alone = run_cell(replace(cell, out_dir=f"alone/{cell.method}"))
        assert (row["notes"], row["needs"]) == (alone["notes"], alone["needs"])
        for name, measured in alone["measurements"].items():
            assert "latency" in name or row["measurements"][name]["value"] == measured["value"]
    with pytest.raises(ConfigError, match="jobs >= 1, received run=true and jobs=0"):
        table(["jobs=0", *words])


@pytest.mark.parametrize("words", [["lqr"], ["table", "methods=lqr", "env=pendulum"]])
def test_a_signal_ends_the_command_and_what_is_done_stays(words, monkeypatch, capsys, tmp_path):
    """Without a handler of its own SDL, which draws shifted pictures, would take the signal and do nothing."""
    monkeypatch.chdir(tmp_path)
    for module in ("__main__", "table"):
        monkeypatch.setattr(f"torchrl_sspl.baselines.{module}.run_cell", lambda cell: signal.raise_signal(signal.SIGTERM))
    with pytest.raises(Interrupted, match="143"):
        main(words)
    assert "interrupted by SIGTERM; rows and trials that are done stay" in capsys.readouterr().err


def test_an_error_of_any_kind_is_named_in_its_row_and_the_others_go_on(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)

    def run(cell):
        if cell.method == "cone":
            raise RuntimeError("no such memory")
        return run_cell(cell)

    monkeypatch.setattr("torchrl_sspl.baselines.table.run_cell", run)
    (_, failed), (_, row) = table(["methods=cone,lqr", "env=pendulum", *SMALL])
    assert failed == "RuntimeError: no such memory"
    assert row["measurements"]
    assert "Traceback" in capsys.readouterr().err  # what the library does not name itself can be looked up
    broken = tmp_path / "runs/baselines/pendulum/none/other/0" / ROW_FILE
    broken.parent.mkdir(parents=True)
    broken.write_text("{")
    assert main(["table", "methods=lqr", "env=pendulum", *SMALL]) == 0
    assert "left out: 'runs/baselines/pendulum/none/other/0/row.json' cannot be read" in capsys.readouterr().err
    assert len(json.loads((tmp_path / "runs/baselines/rows.json").read_text())) == 1


@pytest.mark.slow
def test_a_signal_ends_the_processes_too(tmp_path):
    code = "import sys; from torchrl_sspl.baselines.__main__ import main; sys.exit(main(sys.argv[1:]))"
    words = ["table", "methods=" + ",".join(f"lqr:alpha=0.{k}" for k in range(1, 10)), "env=pendulum", "jobs=2"]
    path = os.pathsep.join([str(Path(torchrl_sspl.__file__).parents[1]), os.environ.get("PYTHONPATH", "")])
    run = subprocess.Popen([sys.executable, "-c", code, *words, *SMALL[1:], "score.episodes=3000000"], cwd=tmp_path, env=os.environ | {"PYTHONPATH": path},
                           stderr=subprocess.PIPE, text=True, start_new_session=True)  # fmt: skip
    try:
        begun = time.monotonic()
        while not list(tmp_path.rglob(".owner.json")):
            assert time.monotonic() - begun < 240
            time.sleep(0.05)
        run.send_signal(signal.SIGTERM)
        _, told = run.communicate(timeout=60)
    finally:
        with suppress(ProcessLookupError):  # what goes on where it should not
            os.killpg(run.pid, signal.SIGKILL)
    assert run.returncode == 143
    assert "rows and trials that are done stay" in told
    assert not list(tmp_path.rglob(".owner.json"))  # none of them goes on
    assert not list(tmp_path.rglob(ROW_FILE))


def test_a_car_is_shown_at_its_middle_heading(tmp_path):
    cell = Cell.of("cone", ["env=dubins", f"out_dir={tmp_path}", "score.grid=9", *SMALL[:2], *SMALL[3:]])
    run_cell(cell)
    figure = claims([cell, replace(cell, out_dir="nowhere")])
    (axes,) = [ax for ax in figure.axes if ax.images]
    assert axes.images[0].get_array().shape == (9, 9, 3)
    assert axes.get_title() == "cone\nnone, seed 0"
    assert claims([replace(cell, out_dir="nowhere")]) is None


def test_a_page_has_systems_of_more_coordinates_and_systems_of_a_file(tmp_path, monkeypatch):
    states = torch.cartesian_prod(torch.linspace(-1, 1, 5), torch.linspace(-2, 2, 4), torch.arange(-1.0, 2.0), torch.tensor([-1.0, 0.5])).numpy()
    np.savez(tmp_path / CLAIMS_FILE, states=states, claimed=states[:, 2] == 0, viable=states[:, 3] > 0)
    cell = Cell.of("kernel", ["env=own/car.yaml", f"out_dir={tmp_path}"])
    shown = claims([cell]).axes[0].images[0].get_array()
    assert shown.shape == (4, 5, 3)
    assert len({tuple(colour) for row in shown for colour in row.tolist()}) == 1  # claimed, in the kernel
    films = []
    monkeypatch.setattr("torchrl_sspl.baselines.page.failures", lambda cells, path: films.append(path))
    row = run_cell(Cell.of("lqr", [f"out_dir={tmp_path / 'row'}", *SMALL]))
    page([(cell, row)], tmp_path / "table.html")
    assert films == [tmp_path / "failures-car.mp4"]


def test_the_page_says_what_its_data_say():
    """Rows of the page's tables are those of comparison.csv, but for what says that it was measured before there was such a file."""
    groups: dict[tuple[str, ...], list] = {}
    with (DOCS / "images" / "comparison.csv").open() as file:
        for line in csv.DictReader(file):
            measured = {name: {"value": float(value)} for name, value in line.items() if value and name not in ("env", "method", "budget", "seed")}
            groups.setdefault((line["env"], line["method"], line["budget"]), []).append({"measurements": measured})
    page_text = (DOCS / "comparison.md").read_text()

    def shown(title: str) -> list[str]:
        return page_text.partition(f"\n**{title}**\n\n")[2].partition("\n\n")[0].splitlines()[2:]

    told: dict[str, list[str]] = {}
    for (env, method, budget), rows in groups.items():
        title = f"{env}, full budget" if budget == "full" else env
        told.setdefault(title, []).append(f"| {' | '.join([method, budget, *(_value(rows, column) for column in _MEASURED)])} |")
        if budget != "full" and any(name.startswith("shifted_") for row in rows for name in row["measurements"]):
            told.setdefault(f"{env}, shifted pictures", []).append(f"| {' | '.join([method, budget, *(_on_shift(rows, shift) for shift in _SHIFTS)])} |")
    for title, lines in told.items():
        assert [line for line in lines if not any(one.startswith(line) for one in shown(title))] == [], title
        if "full" not in title:
            assert [one for one in shown(title) if not any(one.startswith(line) for line in lines)] == [], title
    assert {f"{env}{table}" for env in DEFAULTS for table in ("", ", shifted pictures")} <= told.keys()


def test_several_seeds_are_a_mean_and_the_worst():
    def row(value, proved="nothing"):
        names = ["claimed_over_kernel", "false_safe", "latency_p50", "latency_p99"]
        return {
            "cell": {"method": "latent_cbf"}, "minutes": {"fit_cpu": 2.0},
            "needs": dict.fromkeys(
                ["transitions", "safe_labels", "unsafe_labels", "states", "masks", "expert_actions", "state_at_run_time", "dynamics"], 0
            ) | {"proved": proved, "measured": "nothing", "claimed": "invariance"},
            "measurements": {n: {"value": value} for n in names},
        }  # fmt: skip

    asked = cells(["methods=latent_cbf", "env=pendulum", "seed=0,1"])
    text = markdown(list(zip(asked, [row(0.5), row(0.7)], strict=True)))
    assert "60.0 % (50.0 %) | 60.0 % (70.0 %)" in text
    assert "✗ ✗ ✗ ✗ ✓ ✗" in text
    assert "seeds" not in text
    assert "| 2.0 | nothing | nothing | invariance | ✗" in text
    tuned = row(0.5) | {"tuning": {"chosen": ["autoencoder_steps=1200", "alpha=0.5"], "needs": {"transitions": 9}}}
    assert "| ✗ ✗ ✗ ✗ ✓ ✗ | alpha=0.5 |" in markdown([(asked[0], tuned)])  # what is written out as it is by default is left out
    assert "| latent_cbf | small | 0, and 9 of trials |" in markdown([(asked[0], tuned)])
    tuned["tuning"]["chosen"] = []
    assert "| the defaults |" in markdown([(asked[0], tuned)])
    assert "| nothing or [V] | nothing |" in markdown(list(zip(asked, [row(0.5), row(0.7, "[V]")], strict=True)))  # not of every seed
    text = markdown(list(zip(asked, [row(0.5), "SolverError: no"], strict=True)))
    assert "| latent_cbf (1 of 2 seeds; SolverError: no) | small | 50.0 %" in text  # what is missing is no mean
    empty = row(0.5)
    empty["measurements"]["false_safe"] = {"value": None}
    text = markdown(list(zip(asked, [row(0.7), empty], strict=True)))
    assert "60.0 % (50.0 %) | 70.0 %, 1 of 2 seeds |" in text


def test_fewer_episodes_from_the_claimed_set_are_shown():
    def row(common, claimed):
        counts = {"common_harmless_enter": common, "claimed_harmless_enter": claimed, "latency_p50": 9, "latency_p99": 9}
        return {
            "cell": {"method": "latent_cbf"}, "minutes": {"fit_cpu": 2.0}, "needs": dict.fromkeys(["proved", "measured", "claimed"], "nothing"),
            "measurements": {name: {"value": 0.0, "n": n} for name, n in counts.items() if n is not None},
        }  # fmt: skip

    asked = cells(["methods=latent_cbf", "env=pendulum", "seed=0,1"])
    several = (((200, 200), (200, 3)), "200, 3 claimed"), (((200, 0), (200, 200)), "200"), (((200, None),) * 2, "200"), (((None, 7),) * 2, "7"), (((None, None),) * 2, "-")
    for counts, shown in several:
        text = markdown([(cell, row(*n)) for cell, n in zip(asked, counts, strict=True)])
        assert f"| 0.0 / 0.0 ms | {shown} |" in text
    for held, shown in ((3000, "200, calibrated by 3000"), (200, "200")):
        placed = row(200, 200)
        placed["measurements"]["calibrated_level"] = {"value": -0.1, "n": held}
        assert f"| 0.0 / 0.0 ms | {shown} |" in markdown([(asked[0], placed)])


def test_an_agent_that_was_trained_before_has_a_budget_of_its_own():
    asked = cells(["methods=sspl:agent=pendulum,sspl", "env=pendulum"])
    text = markdown([(cell, "not measured") for cell in asked])
    assert "| sspl agent=pendulum | its own |" in text
    assert "| sspl | small |" in text
    assert len(cells(["methods=sspl:agent=pendulum", "env=pendulum", "budget=small,full", "seed=0,1"])) == 1


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["env=cmu"], "expected env among pendulum, dubins"),
        (["method=lqr"], "expected methods="),
        (["methods=none"], "expected a method"),
        (["methods=latent_cbf", "budget=large"], "expected budget"),
        (["methods=depth:noise=[0.02,lqr"], "expected options among"),
        (["methods=latent_safe:actions=0"], "latent_safe: expected actions >= 1, received 0"),
        (["methods=imitation:rounds=-1"], "imitation: expected rounds >= 1"),
        (["methods=hocbf:k=.nan"], "hocbf: expected k to be finite, received nan"),
        (["methods=lqr", "score.grid=[1"], r"expected score\.\* among"),
        (["methods=lqr", "score.grid=-3"], r"score\.grid: expected >= 2, or 0 for the default, received -3"),
        (["methods=lqr", "score.check_episodes=-1"], r"score\.check_episodes: expected >= 0, received -1"),
        (["methods=lqr", "score.frames=0"], r"score\.frames: expected >= 1"),
        (["methods=sspl:overrides=[a/b],sspl:overrides=[a_b]"], "expected cells of folders of their own, received two"),
    ],
)
def test_words_that_are_not_valid_are_refused(words, message):
    with pytest.raises(ConfigError, match=message):
        cells(words)
