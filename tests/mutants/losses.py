"""Mutants of what losses take of networks and batches, and of what a store keeps."""

from __future__ import annotations

BASE, SALAD, STORE = "torchrl_sspl/objectives/base.py", "torchrl_sspl/modules/salad.py", "torchrl_sspl/data/store.py"
LOSSES, STORED = "tests/objectives/test_what_is_given.py", "tests/data/test_store.py"

MUTANTS = [
    (BASE, "output[network.out_keys.index(key)]", "output[0]", LOSSES),
    (BASE, "if name == \"barrier\" and output.shape", "if False and output.shape", LOSSES),
    (BASE, "if name in loss.__dict__.get(\"_left_out\", ()) and", "if False and", LOSSES),
    (BASE, "        self.register_load_state_dict_pre_hook(_check_loaded)\n", "", LOSSES),
    (SALAD, "< len(out_keys) or swapped:", "< len(out_keys):", LOSSES),
    ("torchrl_sspl/objectives/counterexample.py", "found = torch.where(counted, found, 0.0)", "found = found * 1.0", LOSSES),
    ("torchrl_sspl/objectives/target.py", "inside = _batch_last(self._get(tensordict, keys.inside, \"inside\"), batch.shape)", "inside = self._get(tensordict, keys.inside, \"inside\")", LOSSES),
    (STORE, "        self._cursor = self._storage._cursor\n        return super().extend(data)", "        return super().extend(data)", STORED),
    (STORE, "            sampler.mark_update(index)", "            pass", STORED),
    (STORE, "v.roll(-meta[\"cursor\"], 0)", "v", STORED),
    (STORE, "            self._cursor = self._len\n", "", STORED),
    (STORE, "return data if mask is None else data[mask.reshape(data.batch_size)]", "return data", STORED),
]
