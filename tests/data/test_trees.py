"""Drawing by priority without TorchRL's compiled extension: the same answers as its trees, and as plain sums."""

from __future__ import annotations

import copy
import pickle

import numpy as np
import pytest
import torch
from tensordict import TensorDict
from torchrl.data import LazyTensorStorage, TensorDictPrioritizedReplayBuffer
from torchrl.data.replay_buffers.samplers import prioritized

from torchrl_sspl.data.trees import Priorities, stand_in

try:
    from torchrl import _torchrl as extension
except ImportError:
    extension = None
KINDS = {("Sum", "Fp32"): np.float32, ("Min", "Fp32"): np.float32, ("Sum", "Fp64"): np.float64, ("Min", "Fp64"): np.float64}


def filled(seed: int, n: int = 50, *, least: bool = False, dtype: type = np.float32) -> Priorities:
    priorities = Priorities(n, dtype, least=least)
    priorities[np.arange(n - 5)] = np.random.default_rng(seed).uniform(0.1, 2.0, n - 5).astype(dtype)
    return priorities


@pytest.mark.parametrize("seed", range(3))
def test_sums_minima_and_places_are_those_of_a_loop(seed):
    sums, minima = filled(seed), filled(seed, least=True)
    p = [float(sums[k]) for k in range(50)]
    assert p[45:] == [0.0] * 5
    for left, right in ((0, 50), (3, 17), (44, 46), (7, 8)):
        assert sums.query(left, right) == pytest.approx(sum(p[left:right]), rel=1e-6)
        assert minima.query(left, right) == pytest.approx(min(v for v in [*p[left : min(right, 45)], 3.4e38]))
    for mass in np.linspace(0.0, sum(p) * 1.1, 40):
        total, place = 0.0, 50
        for k in range(50):
            total += p[k]
            if total >= mass:
                place = k
                break
        assert sums.scan_lower_bound(float(mass)) == place


def test_answers_are_of_the_kind_of_the_question_and_the_later_value_counts():
    priorities = Priorities(4)
    priorities[torch.tensor([0, 1, 1])] = torch.tensor([1.0, 5.0, 2.0])
    priorities[3] = 0.5
    assert priorities[1] == 2.0
    assert priorities[np.array([0, 3])].tolist() == [1.0, 0.5]
    torch.testing.assert_close(priorities[torch.tensor([1, 2])], torch.tensor([2.0, 0.0]))
    assert isinstance(priorities.scan_lower_bound(np.array([0.1])), np.ndarray)
    assert priorities.scan_lower_bound(torch.tensor([0.1, 9.0])).tolist() == [0, 4]
    assert [priorities.scan_lower_bound(mass) for mass in (0.0, 1.0, 3.0, 3.5)] == [0, 0, 1, 3], "a sum that is met is enough"
    with pytest.raises(IndexError):
        priorities[4] = 1.0
    assert [copy.deepcopy(priorities)[1], pickle.loads(pickle.dumps(priorities))[1]] == [2.0, 2.0]


@pytest.mark.skipif(extension is None, reason="TorchRL's extension does not load with this torch")
@pytest.mark.parametrize(("kind", "bits"), KINDS)
def test_answers_are_those_of_torchrls_trees(kind, bits):
    dtype, chance = KINDS[kind, bits], np.random.default_rng(0)
    here, there = Priorities(33, dtype, least=kind == "Min"), getattr(extension, f"{kind}SegmentTree{bits}")(33)
    for _ in range(20):
        index, value = chance.integers(0, 33, 8), chance.uniform(0.1, 2.0, 8).astype(dtype)
        here[index] = there[index] = value
        for left, right in ((0, 33), (2, 9), (30, 31)):
            assert here.query(left, right) == pytest.approx(there.query(left, right), rel=1e-5)
        np.testing.assert_array_equal(here[np.arange(33)], there[np.arange(33)])
    if kind == "Sum":
        mass = chance.uniform(0.0, here.query(0, 33), 500).astype(dtype)
        off = here.scan_lower_bound(mass) != there.scan_lower_bound(mass)
        assert off.mean() <= 0.01  # where a sum is rounded in another order


def test_they_stand_in_where_trees_are_missing_and_nowhere_else(monkeypatch):
    own = object()
    monkeypatch.setattr(prioritized, "SumSegmentTreeFp32", own)
    monkeypatch.setattr(prioritized, "MinSegmentTreeFp64", None)
    stand_in()
    assert prioritized.SumSegmentTreeFp32 is own
    made = prioritized.MinSegmentTreeFp64(7)
    assert (len(made), made.least, made.values.dtype) == (7, True, np.float64)


@pytest.mark.parametrize("trees", ["whatever loads", "stand-ins"])
def test_torchrls_buffer_draws_by_priority(monkeypatch, trees):
    if trees == "stand-ins":
        for kind, bits in KINDS:
            monkeypatch.setattr(prioritized, f"{kind}SegmentTree{bits}", None)
        stand_in()
    np.random.seed(0)  # noqa: NPY002 (what TorchRL draws from)
    buffer = TensorDictPrioritizedReplayBuffer(alpha=1.0, beta=1.0, storage=LazyTensorStorage(10), batch_size=400, priority_key="error")
    buffer.extend(TensorDict({"x": torch.arange(10)}, [10]))
    batch = buffer.sample()
    batch["error"] = 1.0 + 9.0 * (batch["x"] == 3)
    buffer.update_tensordict_priority(batch)
    drawn = buffer.sample()
    assert float((drawn["x"] == 3).float().mean()) == pytest.approx(10 / 19, abs=0.1)
    weight = drawn["priority_weight"]
    assert float(weight[drawn["x"] == 3].mean() / weight[drawn["x"] != 3].mean()) == pytest.approx(0.1, rel=1e-3)
    state = buffer.sampler.state_dict()
    buffer.sampler.load_state_dict(state)
    assert float((buffer.sample()["x"] == 3).float().mean()) == pytest.approx(10 / 19, abs=0.1)
