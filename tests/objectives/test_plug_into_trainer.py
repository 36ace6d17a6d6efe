"""The loss in TorchRL's own Trainer and in a loop of one's own, and what the library's phases add as a hook."""

from __future__ import annotations

import importlib.util
from pathlib import Path

import pytest

EXAMPLE = Path(__file__).parents[2] / "examples" / "plug_into_trainer.py"
# TorchRL announces changes of its own trainer and collector.
pytestmark = pytest.mark.filterwarnings("ignore::FutureWarning", "ignore::DeprecationWarning", "ignore:init_random_frames")
SMALL = [
    "env.image_size=32", "synthesis.rounds=1", "synthesis.transitions=6000", "synthesis.dynamics_steps=600",
    "synthesis.fit_steps=500", "synthesis.steer_steps=100", "synthesis.tune_steps=400", "synthesis.batch=512",
    "synthesis.actions=11", "synthesis.check_episodes=300", "synthesis.check_horizon=20", "evaluation.episodes=200",
    "evaluation.horizon=60", "evaluation.kernel_grid=61", "evaluation.grid=41",
]  # fmt: skip


@pytest.fixture(scope="module")
def example():
    spec = importlib.util.spec_from_file_location("plug_into_trainer", EXAMPLE)
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def test_a_loop_of_ones_own_separates_safe_from_unsafe(example) -> None:
    # Two sets are told apart by their pictures; no episode has to be watched for long.
    result = example.main(*SMALL, "evaluation.episodes=10", "evaluation.horizon=2", "evaluation.grid=15", "evaluation.kernel_grid=31", batches=6, updates=50, loop=True, phases=False)
    assert result["safe_called_unsafe"] <= 0.05
    assert result["unsafe_called_safe"] <= 0.05
    assert set(result) == set(example.SHOWN)


@pytest.mark.slow
def test_the_stock_trainer_followed_by_the_phases_finds_a_set_that_is_kept(example) -> None:
    result = example.main(*SMALL, batches=19, updates=200)
    assert result["safe_called_unsafe"] <= 0.05
    assert result["unsafe_called_safe"] <= 0.02
    assert result["volume_over_kernel"] >= 0.5
    assert result["safe_rollouts_touch_unsafe"] <= 0.02


def test_example_stays_short() -> None:
    assert len(EXAMPLE.read_text().splitlines()) <= 80
