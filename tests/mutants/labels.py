"""Mutants of what few labels are asked for and say."""

from __future__ import annotations

ASKING, ASKED = "torchrl_sspl/trainers/asking.py", "tests/trainers/test_asking.py"
STORE, SOURCE = "torchrl_sspl/data/store.py", "torchrl_sspl/trainers/source.py"
LABELS, DATA = "torchrl_sspl/data/labels.py", "tests/data/test_labels.py"

MUTANTS = [
    (ASKING, "_DOUBT = 0.3", "_DOUBT = 30.0", ASKED),
    (ASKING, "_CAUTION = 0.1", "_CAUTION = -0.3", ASKED),
    (ASKING, "_SMOOTHING = 0.1", "_SMOOTHING = 100.0", ASKED),
    (ASKING, "_MOST, _AROUND = 2000, 64", "_MOST, _AROUND = 2000, 1", ASKED),
    (ASKING, ".masked_fill(told, -1.0)", "", ASKED),
    (ASKING, "            far = torch.minimum(far, (seen - seen[row]).norm(dim=1))\n", "", ASKED),
    (ASKING, "return torch.where(used, answer, spread), told", "return spread, told", ASKED),
    (ASKING, "used = told & ~_contradicted(seen, told, unsafe)", "used = told", ASKED),
    (ASKING, "* y < -_AGAINST", "* y > -_AGAINST", ASKED),
    (ASKING, "return y - inverse @ y / inverse.diagonal()", "return y - inverse @ y", ASKED),
    (ASKING, "    told, unsafe = told.clone(), answer", "    told, unsafe = told, answer", ASKED),
    (ASKING, "0 if number else source.labels.choose", "source.labels.choose", ASKED),
    (ASKING, "        source.count_labels(answer[known", "        (answer[known", ASKED),
    (ASKING, "if asked < count:", "if False:", ASKED),
    (ASKING, "z, code = seen[drawn], region[drawn]", "z, code = seen, region", ASKED),
    (ASKING, "_LIKELY = -4.0", "_LIKELY = 3.0", ASKED),
    (ASKING, "torch.where((region == UNLABELLED) & likely, UNSAFE", "torch.where(likely, UNSAFE", ASKED),
    (ASKING, "-share[0].sigmoid() * f.sigmoid()", "-f.sigmoid()", ASKED),
    (ASKING, "torch.where(told, data[\"region\"][:, 0], UNLABELLED)", "data[\"region\"][:, 0]", ASKED),
    (LABELS, "generator=draw) >= self.share", "generator=draw) < self.share", DATA),
    (LABELS, "return self.share < 1.0 and not self.choose", "return self.share < 1.0", DATA),
    (LABELS, "(given or {}).get(code, 0) > most", "0 > most", DATA),
    (LABELS, "(given or {}).get(UNSAFE, 0) < most", "0 < most", DATA),
    (LABELS, " - mine.long()", "", DATA),
    (STORE, "self.given[code] += int(", "self.given[code] = int(", DATA),
    (STORE, "meta.get(\"given\", held)", "held", DATA),
    (STORE, "        self.recorded += n\n", "        self.recorded = self._len\n", DATA),
    (STORE, "before = self.recorded % _INDICES", "before = int(index[0])", DATA),
    (SOURCE, "\"chosen labels of S\"", "\"labels of S\"", DATA),
]
