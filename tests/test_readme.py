"""The code in the README runs."""

from __future__ import annotations

import re
from pathlib import Path

import pytest

import torchrl_sspl

README, PACKAGE = Path(__file__).parents[1] / "README.md", Path(torchrl_sspl.__file__).parent
BLOCKS = re.findall(r"```python\n(.*?)```", README.read_text(), flags=re.DOTALL)


@pytest.mark.parametrize("block", BLOCKS, ids=range(len(BLOCKS)))
def test_readme_code_runs(block):
    exec(compile(block, str(README), "exec"), {})


def test_readme_has_code():
    assert len(BLOCKS) >= 2


def test_links_of_the_readme_exist():
    for target in re.findall(r"\]\((?!http)([^)#]+)\)", README.read_text()):
        root = PACKAGE if target.startswith(PACKAGE.name) else README  # the package may be that of a wheel
        assert (root.parent / target).exists(), target


def test_the_readme_is_short():
    text = README.read_text()
    assert len(text.splitlines()) <= 150
    assert len(text.split()) <= 1200


def test_the_film_on_top_is_small_enough_for_a_page():
    first = re.search(r"!\[[^\]]*\]\(([^)]+)\)", README.read_text())[1]
    assert first.endswith(".gif")
    assert (README.parent / first).stat().st_size <= 3_000_000
