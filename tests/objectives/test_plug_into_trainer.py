"""The loss in TorchRL's own Trainer and in a loop of one's own learns to tell S from U."""

from __future__ import annotations

import importlib.util
from pathlib import Path

import pytest

EXAMPLE = Path(__file__).parents[2] / "examples" / "plug_into_trainer.py"


# TorchRL announces changes of its own trainer and collector.
@pytest.mark.filterwarnings("ignore::FutureWarning", "ignore::DeprecationWarning")
@pytest.mark.parametrize("loop", [False, True], ids=["trainer", "loop"])
def test_stock_trainer_and_own_loop_separate_safe_from_unsafe(loop: bool) -> None:
    spec = importlib.util.spec_from_file_location("plug_into_trainer", EXAMPLE)
    assert spec is not None
    assert spec.loader is not None
    example = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(example)
    result = example.main(loop=loop)
    assert result["last_loss"] < 0.6 * result["first_loss"]
    assert result["safe_error"] <= 0.02
    assert result["unsafe_error"] <= 0.05


def test_example_stays_under_sixty_lines() -> None:
    assert len(EXAMPLE.read_text().splitlines()) < 60
