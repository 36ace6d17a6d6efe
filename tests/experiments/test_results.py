"""The tables of the results page: of a run, and of what lies beside an agent."""

from __future__ import annotations

import runpy
import shutil
import sys
from pathlib import Path

import pytest

import torchrl_sspl

BENCHMARK = Path(__file__).parents[2] / "benchmarks" / "results.py"
AGENT = Path(torchrl_sspl.__file__).parent / "agents" / "pendulum"


def printed(monkeypatch, capsys, *runs: Path) -> str:
    monkeypatch.setattr(sys, "argv", ["results.py", *map(str, runs)])
    runpy.run_path(str(BENCHMARK), run_name="__main__")
    return capsys.readouterr().out


def test_a_run_has_the_column_of_its_agent(monkeypatch, capsys, tmp_path):
    shutil.copytree(AGENT, tmp_path / "agent")
    shutil.copy(AGENT / "evaluation.json", tmp_path / "metrics.json")
    table = printed(monkeypatch, capsys, AGENT)
    assert "| grid of U with B <= 0 | <= 0 | 0 of 31,816 |" in table
    assert "| certificate, [V] proved on the whole latent domain |  | yes |" in table
    assert printed(monkeypatch, capsys, tmp_path) == table


def test_a_folder_without_a_run_is_refused_by_the_file_that_is_missing(monkeypatch, capsys, tmp_path):
    with pytest.raises(FileNotFoundError, match=r"metrics\.json"):
        printed(monkeypatch, capsys, tmp_path)
