"""A certificate that holds, for all who change something about it."""

from __future__ import annotations

from pathlib import Path

import pytest
from analytic import Line, line_agent

from torchrl_sspl.evaluation.certify import certify


@pytest.fixture(scope="session")
def issued(tmp_path_factory) -> Path:
    """An agent whose closed loop is known, with a certificate of two blocks of episodes."""
    directory = tmp_path_factory.mktemp("issued")
    agent = line_agent()
    agent.save(directory)
    certify(agent, Line(), name="line", episodes=300, horizon=4, acceptable=0.02).save(directory / "certificate.json")
    return directory
