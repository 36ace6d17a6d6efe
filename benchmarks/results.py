"""The tables of docs/results.md, from the metrics.json of runs with several seeds, or what lies beside an agent.

Run: python benchmarks/results.py runs/pendulum runs/pendulum-1 runs/pendulum-2
     python benchmarks/results.py torchrl_sspl/agents/pendulum
Prints a table in Markdown: requirements first, then what else is worth a look; each column is one run or agent.
"""

from __future__ import annotations

import json
import sys
from pathlib import Path
from typing import Any

FURTHER = {
    "walks_from_safe_hit": "walks from S that hit the obstacle or enter U",
    "walks_from_set_hit": "walks from {B <= 0} that hit the obstacle",
    "walks_from_set_fall": "walks from {B <= 0} that fall",
    "walks_from_set_covered": "walks from {B <= 0} to which the proof applies from the first step to the last",
    "safe_rollouts_leave": "episodes from {B <= 0} that leave it",
    "safe_rollouts_seen_outside": "episodes from {B <= 0} in which a picture by itself has B > 0",
    "corrections_cut": "their steps at which a correction is cut",
    "safe_called_unsafe": "S with B > 0",
    "unsafe_rollouts_return": "recoverable starts in U that come back",
    "on_policy_step_error_q99": "latent consistency error, own steps, 99 %",
    "on_policy_error_max": "... largest",
    "random_action_error_q99": "latent consistency error, random actions, 99 %",
    "barrier_error_max": "B(E(o')) - B(d(z, u)), largest in an episode",
    "barrier_depth": "depth of the barrier, -min B",
    "covering_radius_max": "covering radius, sampled",
    "safety_margin": "psi* of the paper [barrier]",
    "dynamics_margin": "eta* of the paper [barrier]",
    "lipschitz_ratio": "sampled over proved Lipschitz constant",
    "training_minutes": "training time [min]",
}
CERTIFIED = {
    "Lipschitz constant": "proved Lipschitz constant",
    "invariance": "[V] proved on the whole latent domain",
    "tolerated error": "proved: error that the set tolerates",
    "float32": "the same of the float32 numbers that are computed",
    "episodes": "risk of an episode to leave, enter U or show U inside, 97.5 %",
}


def value(m: dict[str, Any] | None) -> str:
    """A measurement for people."""
    if m is None or m["value"] is None:
        return "not measured"
    if m["unit"] == "share" and m["events"] is not None:
        share = f"{100 * m['value']:.1f} %" if m["value"] >= 0.02 else f"{100 * m['value']:.2g} %"
        few = m["events"] in (0, m["n"]) or m["value"] < 0.02
        return f"{m['events']:,} of {m['n']:,}" + (f" ({share})" if few and m["events"] not in (0, m["n"]) else "") if few else share
    return f"{m['value']:.3g}"


def read(*places: Path) -> dict[str, Any]:
    """The first of these files that is there: a run's, or an agent's."""
    return json.loads(next((place for place in places if place.is_file()), places[0]).read_text())


def certificate(run: Path) -> dict[str, str]:
    """What the certificate beside the agent says: its level, what is proved, and the risk of an episode."""
    body = read(run / "agent" / "certificate.json", run / "certificate.json")
    rows = {"level s of the set {B <= s} that it is about": f"{body['level']:g}"}
    said = {s["name"]: s for layer in body["layers"].values() for s in layer["statements"]}
    for name, label in CERTIFIED.items():
        if name in said:
            s = said[name]
            told = "yes" if s["value"] is None else f"{s['value']:.3g} {s['unit']}"
            rows[label] = told if s["holds"] is not False else f"no, misses by {s['misses_by'] or float('nan'):.3g}"
    blocks = (body["record"] or {}).get("blocks", [])
    if blocks and "covered" in said and said["covered"]["value"] is not None:
        total = {k: sum(block[k] for block in blocks) for k in ("episodes", "exceeding", "steps", "uncovered")}
        rows["episodes to which the proof applies from the first step to the last"] = (
            f"{total['episodes'] - total['exceeding']:,} of {total['episodes']:,} (risk {100 * said['covered']['value']:.2g} % at most, 95 %)"
        )
        rows["steps at which its premise is met"] = f"{total['steps'] - total['uncovered']:,} of {total['steps']:,}"
    return rows


def main(runs: list[str]) -> None:
    """Print the table."""
    bodies = [read(Path(run) / "metrics.json", Path(run) / "evaluation.json") for run in runs]
    rows: dict[str, list[str]] = {}
    asked = {r["name"]: r for r in bodies[0]["requirements"]}
    for frames in sorted(bodies[0]["measurements"], key=lambda name: name != "own"):
        prefix = "" if frames == "own" else f"{frames} frames: "
        found = [b["measurements"].get(frames, {}) for b in bodies]
        for name, r in asked.items():
            if frames == "own" or name in found[0]:
                must = f"{r['sense']} {r['must']:g}"
                rows[f"{prefix}{r['label']} | {must}"] = [value(f.get(name)) for f in found]
        if frames == "own":
            for name, label in FURTHER.items():
                if name not in asked and name in found[0]:
                    rows[f"{label} | "] = [value(f.get(name)) for f in found]
    told = [certificate(Path(run)) for run in runs]
    for name in told[0]:
        rows[f"certificate, {name} | "] = [t.get(name, "-") for t in told]
    for name in bodies[0]["budget"]:
        rows[f"seen in the training: {name} | "] = [f"{b['budget'].get(name, 0):,}" for b in bodies]
    print("| Figure | must | " + " | ".join(f"seed {b['seed']}" for b in bodies) + " |")
    print("|---|---|" + "---|" * len(bodies))
    for label, cells in rows.items():
        print(f"| {label} | " + " | ".join(cells) + " |")


if __name__ == "__main__":
    main(sys.argv[1:])
