"""Mutants of what few labels are asked for and say."""

from __future__ import annotations

ASKING, ASKED = "torchrl_sspl/trainers/asking.py", "tests/trainers/test_asking.py"

MUTANTS = [
    (ASKING, "_DOUBT = 4", "_DOUBT = 0", ASKED),
    (ASKING, "_CAUTION = 1.25", "_CAUTION = 0.8", ASKED),
    (ASKING, "to_unsafe if unsafe[row] else to_rest", "to_rest", ASKED),
    (ASKING, ".masked_fill(told, -1.0)", "", ASKED),
    (ASKING, "torch.where(told, region, answer)", "answer", ASKED),
    (ASKING, "return torch.where(told, answer, spread), told", "return spread, told", ASKED),
    (ASKING, "    told, answer = told.clone(), torch", "    told, answer = told, torch", ASKED),
    ("torchrl_sspl/trainers/synthesis.py", "count = 0 if self.number else source.labels.choose", "count = source.labels.choose", ASKED),
    ("torchrl_sspl/trainers/synthesis.py", "        source.count_labels(answer[data", "        (answer[data", ASKED),
]
