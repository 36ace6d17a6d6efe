"""Cells: what determines a row, what is written, what is refused."""

from __future__ import annotations

import json
from dataclasses import replace

import pytest
import torch

from torchrl_sspl.baselines import make, scoring
from torchrl_sspl.baselines.__main__ import main
from torchrl_sspl.baselines.base import BUDGETS, EARLIER, Budget, Needs
from torchrl_sspl.baselines.cell import ROW_FILE, SCHEMA, TRIALS_FILE, Cell, _fit, _tuned, run_cell, stored, text
from torchrl_sspl.baselines.data import pooled, record
from torchrl_sspl.configs.reader import FOLDER
from torchrl_sspl.envs import PendulumEnv
from torchrl_sspl.errors import ConfigError, DTypeError, OutputError, ShapeError
from torchrl_sspl.modules.agent import load
from torchrl_sspl.sets import SAFE, UNSAFE

SMALL = ["score.episodes=20", "score.horizon=10", "score.grid=21", "score.kernel_grid=31", "score.frames=2"]


def test_a_row_is_written_and_read_again(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    assert main(["lqr", "env=pendulum", *SMALL]) == 0
    printed = capsys.readouterr().out
    path = tmp_path / "runs/baselines/pendulum/none/lqr/0" / ROW_FILE
    row = json.loads(path.read_text())
    assert row["measurements"]["false_safe"]["value"] == 0.0
    assert row["needs"]["dynamics"] == "exact"
    assert row["cell"]["method"] == "lqr"
    assert text(row) in printed
    before = path.stat().st_mtime_ns
    assert main(["lqr", "env=pendulum", *SMALL]) == 0
    assert path.stat().st_mtime_ns == before


def test_another_row_is_never_overwritten(tmp_path):
    where = f"out_dir={tmp_path}/row"
    run_cell(Cell.of("lqr", [where, *SMALL]))
    with pytest.raises(OutputError, match="choose another out_dir"):
        run_cell(Cell.of("hocbf", [where, *SMALL]))
    with pytest.raises(OutputError, match="choose another out_dir"):
        run_cell(Cell.of("lqr", [where, *SMALL[1:]]))


def test_the_row_of_an_agent_is_no_other_row_and_is_not_overwritten_by_one(tmp_path):
    where = f"out_dir={tmp_path}/row"
    agent = Cell.of("sspl", ["agent=pendulum", where, *SMALL])
    agent.directory.mkdir()
    for there, asked in ((Cell.of("lqr", [where, *SMALL]), agent), (agent, Cell.of("lqr", [where, *SMALL])), (agent, Cell.of("sspl", ["agent=quadruped", where, *SMALL]))):
        (agent.directory / ROW_FILE).write_text(json.dumps({"schema": SCHEMA, "cell": there.describe()}))
        with pytest.raises(OutputError, match="choose another out_dir"):
            run_cell(asked)


def test_a_row_of_an_agent_with_other_weights_is_measured_again(tmp_path):
    agent = load("pendulum")
    agent.save(tmp_path / "agent")
    cell = Cell.of("sspl", [f"agent={tmp_path / 'agent'}", f"out_dir={tmp_path}/row", *SMALL])
    cell.directory.mkdir()
    (cell.directory / ROW_FILE).write_text(json.dumps({"schema": SCHEMA, "cell": cell.describe()}))
    assert stored(cell) is not None
    agent.barrier[-1].bias.data += 1.0
    agent.save(tmp_path / "agent")
    assert stored(cell) is None


def test_a_row_of_another_version_is_not_taken(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    words = ["env=pendulum", *SMALL]
    path = Cell.of("lqr", words).directory / ROW_FILE
    body = run_cell(Cell.of("lqr", words))
    assert stored(Cell.of("lqr", words)) == body
    for schema in (SCHEMA - 1, None):
        path.write_text(json.dumps(body | {"schema": schema}))
        with pytest.raises(OutputError, match=rf"expected measurements of schema {SCHEMA} in '.*row\.json', found those of schema {schema}, of another version"):
            run_cell(Cell.of("lqr", words))
    assert main(["table", "methods=lqr", "run=false", *words]) == 0
    told = capsys.readouterr()
    assert "| lqr | none | OutputError: expected measurements of schema" in told.out
    assert "left out: expected measurements of schema" in told.err
    assert json.loads((tmp_path / "runs/baselines/rows.json").read_text()) == []
    assert "Claimed sets" not in (tmp_path / "runs/baselines/table.html").read_text()


def test_a_row_of_a_file_is_that_of_its_content(tmp_path, monkeypatch):
    folder = tmp_path / "work"
    folder.mkdir()
    monkeypatch.chdir(folder)
    usual = (FOLDER / "env" / "pendulum.yaml").read_text()
    (tmp_path / "mine.yaml").write_text(usual)
    cell = Cell.of("lqr", ["env=../mine.yaml", *SMALL])
    assert cell.directory.as_posix() == "runs/baselines/up/mine.yaml/none/lqr/0"
    row = run_cell(cell)
    (tmp_path / "mine.yaml").write_text(f"{usual}\n# of no account\n")
    assert run_cell(cell) == row
    (tmp_path / "mine.yaml").write_text(usual.replace("max_torque: 10.0", "max_torque: 4.0"))
    monkeypatch.setattr("torchrl_sspl.baselines.tuning.search", lambda trial, options, told, keep: keep([]))
    tried = replace(cell, method="latent_cbf", budget="tiny", trials=1)
    _tuned(tried)
    assert json.loads((tried.directory.parent / TRIALS_FILE).read_text())["of"]["system"] == cell.describe()["system"] != row["cell"]["system"]
    with pytest.raises(OutputError, match=r"expected the row of '\.\./mine\.yaml' as it is in '.*', found that of an earlier content of the file"):
        run_cell(cell)
    anew = run_cell(replace(cell, out_dir="anew"))
    assert anew["measurements"]["claimed_over_kernel"]["value"] != row["measurements"]["claimed_over_kernel"]["value"]
    assert "system" not in Cell.of("lqr", SMALL).describe()


@pytest.mark.parametrize(
    ("name", "words", "message"),
    [
        ("nothing", [], "expected a method"),
        ("lqr", ["budget=huge"], "expected budget to be one of tiny, small, full"),
        ("lqr", ["seed=-1"], "expected seed to be an integer"),
        ("lqr", ["seed=\u00b2"], "expected seed to be an integer"),
        ("lqr", [f"seed={2**62}"], "expected seed to be an integer"),
        ("latent_safe", ["trials=\u00b2"], "expected trials to be an integer"),
        ("lqr", [f"score.seed={2**62}"], r"score\.seed: expected an integer in"),
        ("latent_safe", ["tau=7"], r"latent_safe: expected tau in \(0, 1\], received 7.0"),
        ("latent_safe", ["discount=1.0"], r"latent_safe: expected discount in \[0, 1\), received 1.0"),
        ("latent_cbf", ["alpha=1.5"], r"latent_cbf: expected alpha in \[0, 1\), received 1.5"),
        ("nerf_cbf", ["beta=-1"], "nerf_cbf: expected beta >= 0, received -1.0"),
        ("cone", ["radius=-1"], "cone: expected radius >= 0, received -1.0"),
        ("lqr", ["gain=1"], "expected options among"),
        ("lqr", ["score.episode=1"], "expected score"),
        ("lqr", ["noise"], "key=value"),
    ],
)
def test_cells_that_are_not_valid_are_refused(name, words, message):
    with pytest.raises(ConfigError, match=message):
        Cell.of(name, words)


def test_systems_without_a_known_kernel_are_refused(capsys):
    with pytest.raises(ConfigError, match="whose true kernel is known"):
        Cell.of("lqr", ["env=quadruped"]).environment()
    assert main(["nothing"]) == 2
    assert "expected a method" in capsys.readouterr().err
    assert main(["--help"]) == 0
    assert "turning_circle" in capsys.readouterr().out


def test_a_recording_holds_what_was_asked_for():
    env = PendulumEnv([16], seed=3)
    found = record(env, Budget("try", 40, 12, 20), seed=5)
    assert len(found) == 72
    assert (found.region[40:52] == SAFE).all()
    assert (found.region[52:] == UNSAFE).all()
    assert torch.allclose(found.next_state, env.wrap(env.dynamics(found.state, found.action)), atol=1e-5)
    assert torch.equal(found.pixels[:, 3:], found.next_pixels[:, :3])
    assert torch.equal(found.pixels, pooled(env.observe(found.state)))  # the pendulum's pictures tell the state
    again = record(env, Budget("try", 40, 12, 20), seed=5)
    assert torch.equal(found.frames, again.frames)
    assert found.labels() == {"transitions": 72, "safe_labels": found.count(SAFE), "unsafe_labels": found.count(UNSAFE)}
    assert len(found.joined(again)) == 144


@pytest.mark.parametrize("n", [6, 30])
def test_as_many_episodes_place_the_level_as_were_asked_for_under_both_nominal_policies(n, monkeypatch):
    blocks, whole = [], scoring.paths

    def counted(method, env, start, nominal, horizon, draw=None):
        blocks.append((len(start), bool((nominal(torch.ones(1, 2)) != 0).any())))
        return whole(method, env, start, nominal, horizon, draw)

    monkeypatch.setattr(scoring, "paths", counted)
    env, method = PendulumEnv(), make("lqr")
    method.fit(None, env, BUDGETS["tiny"], 0)
    scoring.score(method, env, scoring.ScoreConfig(episodes=10, horizon=3, grid=21, kernel_grid=31, frames=1, check_episodes=n))
    assert blocks == [(10, False), (10, True), (n // 2, False), (n // 2, True), (10, False), (10, True)]


def test_methods_on_states_and_on_pictures_are_measured_alike(monkeypatch):
    seen = []

    def look(it):
        seen.append((it.config.episodes, it.config.horizon, it.config.check_episodes))
        raise KeyboardInterrupt

    monkeypatch.setattr(scoring, "_sets", look)
    for name in ("lqr", "latent_cbf"):
        with pytest.raises(KeyboardInterrupt):
            scoring.score(make(name), PendulumEnv(), kernel=object())
    assert seen == [(500, 200, 500)] * 2


def test_budgets_are_those_of_the_protocol():
    assert BUDGETS["small"].total == 23_000
    assert BUDGETS["full"].total == 115_000
    with pytest.raises(ConfigError, match=r"needs\.dynamics"):
        Needs(dynamics="some")
    with pytest.raises(ConfigError, match="at least one transition"):
        record(PendulumEnv([4]), Budget("none", 0, 0, 0), 0)


def test_pictures_of_another_kind_are_refused():
    with pytest.raises(DTypeError, match="uint8"):
        pooled(torch.zeros(1, 6, 32, 32))
    with pytest.raises(ShapeError, match="n, c, H, W"):
        pooled(torch.zeros(6, 32, 32, dtype=torch.uint8))


def test_a_training_on_a_system_without_recommended_settings_is_refused(tmp_path):
    with pytest.raises(ConfigError, match="sspl: expected env=pendulum or env=dubins, received CMUDubinsEnv"):
        run_cell(Cell.of("sspl", ["env=cmu", f"out_dir={tmp_path}", *SMALL]))


def test_a_method_learns_from_and_is_shown_pictures_of_the_size_that_it_is_given(monkeypatch):
    words = ["env=dubins", "budget=tiny", "world_steps=2", "margin_steps=2", "steps=2"]
    shown = []
    for pixels, side in (([], 32), (["pixels=64"], 64)):
        cell = Cell.of("latent_safe", [*words, *pixels])
        env, method = cell.environment(), make("latent_safe", cell.options)
        _fit(method, env, cell, 0)
        assert method.side == method.encoder.pool_to[0] == side
        monkeypatch.setattr(method, "barrier", lambda seen: shown.append(seen.shape[-1]))
        scoring.barrier_on(method, env, torch.zeros(2, 3))
        monkeypatch.setattr(method, "act", lambda seen, wanted: (shown.append(seen.shape[-1]), (wanted, torch.zeros(len(wanted), dtype=torch.bool)))[1])
        scoring.paths(method, env, torch.zeros(2, 3), scoring.harmless(env), 1)
    assert shown == [32, 32, 64, 64]
    assert make("latent_cbf").side == 32
    assert make("sspl").side is None
    with pytest.raises(ConfigError, match="pixels: expected at most 64, the size of the system's pictures, received 128"):
        record(PendulumEnv([8]), BUDGETS["tiny"], 0, size=128)


def test_a_training_of_another_version_is_not_gone_on_with(tmp_path):
    method = make("sspl")
    path = tmp_path / "cpu.json"
    path.write_text(json.dumps({"seconds": 3.0}))
    with pytest.raises(OutputError, match=rf"expected a training of schema {SCHEMA}.*remove that folder"), method._timed(path):
        pass
    path.unlink()
    for _ in range(2):
        with method._timed(path):
            assert json.loads(path.read_text())["schema"] == SCHEMA
    assert method.notes[EARLIER] >= 0.0
