"""What every test leaves behind is cleared away: they pass in any order."""

from __future__ import annotations

import random
import sys
from collections.abc import Iterator

import pytest


def pytest_addoption(parser: pytest.Parser) -> None:
    parser.addoption("--shuffle", type=int, metavar="SEED", help="run the files, and the tests of each, in a random order")


@pytest.hookimpl(trylast=True)
def pytest_collection_modifyitems(config: pytest.Config, items: list[pytest.Item]) -> None:
    seed = config.getoption("--shuffle")
    if seed is None:
        return
    # Files stay whole, or what a file builds once would be built again for every test.
    files: dict[str, list[pytest.Item]] = {}
    for item in items:
        files.setdefault(item.nodeid.partition("::")[0], []).append(item)
    chance, parts = random.Random(seed), list(files.values())
    chance.shuffle(parts)
    for part in parts:
        chance.shuffle(part)
    items[:] = [item for part in parts for item in part]


@pytest.fixture(autouse=True)
def _modules_of_a_test_are_its_own(tmp_path_factory: pytest.TempPathFactory) -> Iterator[None]:
    """Forgets modules that were imported from the directory of a test; the next one may have others of the same name."""
    before = set(sys.modules)  # to ask every module for its file takes ten times as long
    yield
    own = str(tmp_path_factory.getbasetemp())
    for name in set(sys.modules) - before:
        if str(getattr(sys.modules[name], "__file__", None) or "").startswith(own):
            del sys.modules[name]
