"""Mutants of what losses take of networks and batches, and of what a store keeps."""

from __future__ import annotations

BASE, SALAD, STORE = "torchrl_sspl/objectives/base.py", "torchrl_sspl/modules/salad.py", "torchrl_sspl/data/store.py"
LOSSES, STORED = "tests/objectives/test_what_is_given.py", "tests/data/test_store.py"

HOOKS, STEPPER, PHASES = "torchrl_sspl/trainers/hooks.py", "torchrl_sspl/trainers/stepper.py", "torchrl_sspl/trainers/phases.py"
TRAINER, SSPL, LOOPS = "torchrl_sspl/trainers/trainer.py", "torchrl_sspl/objectives/sspl.py", "tests/trainers/test_own_loops.py"

MUTANTS = [
    (HOOKS, "delayed.get(name).data.copy_(value)", "pass", LOOPS),
    (HOOKS, 'if first or getattr(self.collector, "reset_at_each_iter", True):', "if True:", LOOPS),
    (HOOKS, 'if first or getattr(self.collector, "reset_at_each_iter", True):', "if first:", LOOPS),
    (PHASES, '        trainer.register_op("shutdown", self)', "        None", LOOPS),
    (PHASES, "if before and before != now:", "if False:", LOOPS),
    (PHASES, 'int(state["done"]) + bool(state["begun"])', 'int(state["done"])', LOOPS),
    (STEPPER, "            if there:", "            if True:", LOOPS),
    (STEPPER, 'terms["safe_error"], terms["unsafe_error"]', 'terms["unsafe_error"], terms["safe_error"]', LOOPS),
    (STORE, "super().extend(without_padding(tensordicts).reshape(-1), **options)", "super().extend(tensordicts.reshape(-1), **options)", LOOPS),
    (STORE, "super().extend(without_padding(tensordicts).reshape(-1), **options)", "super().extend(without_padding(tensordicts), **options)", LOOPS),
    (STORE, "torch.Size(())).numel() != 1:", "torch.Size(())).numel() > 9:", LOOPS),
    (TRAINER, "if has and not wanted <= has:", "if False:", LOOPS),
    (TRAINER, "return bool(has)", "return True", LOOPS),
    (BASE, "            _check_written(self)\n", "            pass\n", LOOPS),
    (BASE, "if now != loss.__dict__.get(", "if None is loss.__dict__.get(", LOOPS),
    (SSPL, 'if self.reduction == "none" else ()', 'if False else ()', LOOPS),
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
