"""[V] confirmed by a verifier that is not ours: Marabou, from the ONNX and VNN-LIB files that `export_vnnlib` writes.

Run: pip install maraboupy onnxruntime, then python benchmarks/independent.py [agent=pendulum] [cells=8] [seconds=20] [share=1/1] [most=0]

The latent domain is cut into `cells` boxes per axis; in each of them Marabou is asked for a latent with B(z) <= s that is led to
B >= s. A box that it does not decide in `seconds` is cut into eight. A counterexample counts if the exported network, evaluated
by ONNX's own reference, confirms it; Marabou's answers of "sat" sometimes are none, and such a box is cut too. `share=K/N`
takes every N-th box, and `most` ends after so many: the order is drawn, so that a part is a fair sample of the whole.
"""

from __future__ import annotations

import itertools
import sys
import tempfile
import time
from typing import Any

import numpy as np
from onnx.reference import ReferenceEvaluator
from tqdm import tqdm

from torchrl_sspl import load
from torchrl_sspl.certification import closed_loop, export_vnnlib

DEEPEST = 4  # halvings of a box


def ask(network: str, low: np.ndarray, high: np.ndarray, level: float, seconds: int) -> tuple[str, np.ndarray | None]:
    """Marabou's answer in one box, and its counterexample."""
    from maraboupy import Marabou

    net = Marabou.read_onnx(network)
    latent, value = net.inputVars[0].flatten(), net.outputVars[0].flatten()
    for variable, a, b in zip(latent, low, high, strict=True):
        net.setLowerBound(variable, a)
        net.setUpperBound(variable, b)
    net.setUpperBound(value[0], level)
    net.setLowerBound(value[1], level)
    options = Marabou.createOptions(verbosity=0, timeoutInSeconds=seconds, numWorkers=1)
    answer, found, _ = net.solve(verbose=False, options=options)
    return answer, np.array([found[v] for v in latent], np.float32) if answer == "sat" else None


def main(agent: str = "pendulum", *, cells: int = 8, seconds: int = 20, share: str = "1/1", most: int = 0) -> dict[str, Any]:
    """Boxes confirmed, refuted and left undecided, and what that took."""
    loaded = load(agent)
    parts = [getattr(net, "module", net) for net in (loaded.barrier, loaded.dynamics, loaded.policy)]
    system = closed_loop(*parts, latent_dim=loaded.latent_dim, lipschitz_bound=loaded.lipschitz_bound)
    # The level has been taken off the agent's barrier: its set is {B <= 0}.
    network, _ = export_vnnlib(system, tempfile.mkdtemp())
    reference = ReferenceEvaluator(str(network))
    size, (part, parts_of) = 2.0 / cells, map(int, share.split("/"))
    corners = np.array(list(itertools.product(range(cells), repeat=loaded.latent_dim))) * size - 1.0
    order = np.random.default_rng(0).permutation(len(corners))[part - 1 :: parts_of][: most or None]
    table, start = {"boxes": len(order), "of": len(corners), "confirmed": 0, "refuted": 0, "undecided": 0, "questions": 0}, time.time()
    bar = tqdm(corners[order], unit="box")
    for corner in bar:
        todo, verdict = [(corner, size, 0)], "confirmed"
        while todo and verdict == "confirmed":
            low, width, depth = todo.pop()
            answer, found = ask(str(network), low, low + width, 0.0, seconds)
            table["questions"] += 1
            if answer == "unsat":
                continue
            now, then = reference.run(None, {"X": found[None]})[0][0] if found is not None else (1.0, -1.0)
            if now <= 0.0 <= then:
                verdict = "refuted"
            elif depth == DEEPEST:
                verdict = "undecided"
            else:
                halves = itertools.product((0.0, width / 2), repeat=len(low))
                todo += [(low + np.array(offset), width / 2, depth + 1) for offset in halves]
        table[verdict] += 1
        bar.set_postfix(table)
    return table | {"seconds": round(time.time() - start)}


if __name__ == "__main__":
    given: dict[str, Any] = dict(word.split("=") for word in sys.argv[1:])
    print(main(**{key: int(value) if value.isdigit() else value for key, value in given.items()}))
