"""Seeds of one run never coincide, whatever they are for."""

from __future__ import annotations

import pytest
import torch

from torchrl_sspl.errors import ConfigError
from torchrl_sspl.seeds import PURPOSES, drawn_for, spawn, used_before


@pytest.mark.parametrize("seed", [0, 1, 20260707, 2**40 + 3])
def test_no_two_purposes_of_a_run_share_a_seed(seed):
    indices = [*range(500), 2**24 - 1]
    seeds = {spawn(seed, purpose, k) for purpose in PURPOSES for k in indices}
    assert len(seeds) == len(PURPOSES) * len(indices)
    assert all(0 <= s < 2**32 for s in seeds)


def test_runs_with_neighbouring_seeds_start_elsewhere():
    assert len({spawn(seed, purpose) for seed in range(300) for purpose in PURPOSES}) == 300 * len(PURPOSES)


def test_purposes_keep_their_numbers():
    assert len(set(PURPOSES.values())) == len(PURPOSES)
    assert max(PURPOSES.values()) < 2**8  # with 2^24 indices each they fill 32 bits
    assert (spawn(0, "data"), spawn(0, "certificate"), spawn(7, "certificate", 3)) == (1560050338, 3028009000, 3795738181)


def test_what_a_generator_forgets_of_a_seed_is_no_difference():
    def drawn(seed: int) -> torch.Tensor:
        return torch.rand(4, generator=torch.Generator().manual_seed(seed))

    assert torch.equal(drawn(5), drawn(5 + 2**32))
    assert used_before(5, [5 + 2**32])
    assert not used_before(5, [])


@pytest.mark.parametrize(("seed", "purpose", "index"), [(0, "luck", 0), (0, "data", 2**24), (0, "data", -1), (-1, "data", 0)])
def test_what_is_not_registered_is_refused(seed, purpose, index):
    with pytest.raises(ConfigError):
        spawn(seed, purpose, index)


def test_the_purpose_of_a_seed_is_found():
    for root in (0, 7, 2**40 + 3):
        for purpose in PURPOSES:
            assert {drawn_for(spawn(root, purpose, k), root) for k in (0, 1, 4095)} == {purpose}
            assert drawn_for(spawn(root, purpose, 4096), root) == ""
    assert {drawn_for(spawn(1, purpose), root) for purpose in PURPOSES for root in (2, -1)} == {""}
