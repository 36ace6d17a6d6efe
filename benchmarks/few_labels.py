"""Few labels: how large and how wrong the set is over the number of labelled pictures, of unlabelled transitions, of wrong labels.

Run: python benchmarks/few_labels.py [env=pendulum] [labels=100,300,1000,all] [transitions=20000] [wrong=0,0.01,0.05] [seed=0,1,2] [out=runs/few_labels]
     [starts=[0.6,0.15,0.25]] [run=false] [score.KEY=VALUE ...] [KEY=VALUE of the training ...]
     python benchmarks/few_labels.py figure [out=runs/few_labels]

Every point is a training of its own, one round without rollouts with the settings of the table's small budget
(``torchrl_sspl.baselines.sspl.settings`` says where these differ from the recommended ones); a point that has been measured is read.
Of ``transitions``, recorded under random actions with 15 % of the episodes starting in S and 25 % in U, at most ``labels`` of each
kind are labelled, those that come first (with ``labels.share=0.1`` each with that chance, until there are as many); the rest is unlabelled, but for ``labels.choose=400`` of it that are chosen on latents. ``starts=[0,0.5,0.5]`` with
``collector.max_frames_per_traj=1`` records nothing without a label. The level of the set is placed by held-out episodes with labels of their
own (``synthesis.check_episodes``), which are not counted. Prints a table in Markdown and writes ``points.json``; ``figure`` draws all points that there are,
over the number of labels and over that of the transitions, in ``few_labels.png``.
"""

from __future__ import annotations

import itertools
import json
import statistics
import sys
from collections.abc import Callable
from dataclasses import asdict, dataclass
from hashlib import sha256
from pathlib import Path
from typing import Any

import numpy as np
import torch

from torchrl_sspl.baselines import Budget, ScoreConfig, make, score
from torchrl_sspl.baselines.cell import Cell
from torchrl_sspl.baselines.sspl import SSPL
from torchrl_sspl.configs.reader import parse
from torchrl_sspl.errors import ConfigError
from torchrl_sspl.files import RunDirectory, write
from torchrl_sspl.viz.plane import PATH_COLOURS, new_figure

LISTS = {"labels": "100,300,1000,all", "transitions": "20000", "wrong": "0", "seed": "0,1,2"}
STARTS = "[0.6,0.15,0.25]"  # shares of the episodes: anywhere or outside U, in S, in U
COLUMNS = (
    ("volume / kernel", "claimed_over_kernel"), ("false-safe", "false_safe"), ("U called safe", "unsafe_called_safe"),
    ("claimed, enter U", "claimed_harmless_enter"), ("common, enter U", "common_harmless_enter"),
)  # fmt: skip


@dataclass(frozen=True)
class Point:
    """What determines one training."""

    env: str
    labels: str  # of each kind at most, or "all"
    transitions: int
    wrong: float
    seed: int
    options: tuple[str, ...]
    starts: tuple[float, ...] = tuple(json.loads(STARTS))

    @property
    def path(self) -> Path:
        """File of the point, below the directory of all."""
        name = f"{self.labels}-labels-{self.transitions}-transitions-{self.wrong}-wrong"
        other = [*self.options, *([] if self.starts == Point.starts else [str(self.starts)])]
        if other:
            name += f"-{sha256(' '.join(other).encode()).hexdigest()[:8]}"
        return Path(self.env) / name / str(self.seed) / "point.json"

    def measure(self, path: Path, sizes: ScoreConfig) -> dict[str, Any]:
        """Train and score, or read what has been measured with the same sizes."""
        with RunDirectory(path.parent).held() as directory:
            if path.is_file():
                row = json.loads(path.read_text())
                if row.get("score") != asdict(sizes):
                    raise ConfigError(f"score: expected {row.get('score')}, with which '{path}' was measured, received {asdict(sizes)}; give the same, or remove the point")
                return row
            few = [] if self.labels == "all" else [f"labels.safe={self.labels}", f"labels.unsafe={self.labels}"]
            method = make("sspl", [f"overrides={json.dumps([f'labels.wrong={self.wrong}', *few, *self.options])}"])
            assert isinstance(method, SSPL)
            method.directory, env = directory, Cell("kernel", self.env, seed=self.seed).environment()
            method.fit(None, env, Budget("few", *(round(share * self.transitions) for share in self.starts)), self.seed)
            found = score(method, env, sizes)
            row = asdict(self) | {
                "score": asdict(sizes), "passed": method.notes["passed"], "checks": [asdict(check) for check in method.checks],
                "needs": asdict(method.needs), "measurements": found.to_dict(),
            }  # fmt: skip
            write(path, json.dumps(row, indent=1) + "\n")
            return row


def table(rows: list[dict[str, Any]]) -> str:
    """One line for each point: means over the seeds, worst in brackets."""
    head = ["env", "labels of S", "labels of U", "of neither", "transitions", "wrong", "seeds", "level, or what the checks found", *(c for c, _ in COLUMNS)]
    lines = [f"| {' | '.join(head)} |", f"| {' | '.join(['---'] * len(head))} |"]

    def of(row: dict[str, Any]) -> tuple[Any, ...]:
        return row["env"], row["labels"], row["transitions"], row["wrong"], tuple(row["options"]), tuple(row["starts"])

    for _, several in itertools.groupby(rows, key=of):
        found = list(several)
        first, cells = found[0], []
        for _, name in COLUMNS:
            values = [v for r in found if (v := r["measurements"][name]["value"]) is not None]
            worst = (min if name == "claimed_over_kernel" else max)(values, default=0.0)
            mean = f"{100 * sum(values) / len(values):.1f} %" if values else "-"
            cells.append(mean if len(values) < 2 else f"{mean} ({100 * worst:.1f} %)")
        needs = [str(first["needs"][k]) for k in ("safe_labels", "unsafe_labels", "neither_labels", "transitions")]
        seeds, checks = ", ".join(str(r["seed"]) for r in found), "; ".join(f"{c['level']:g}" if c["passed"] else c["reason"] for r in found for c in r["checks"])
        lines.append(f"| {' | '.join([first['env'], *needs, str(first['wrong']), seeds, checks, *cells])} |")
    return "\n".join(lines)


def figure(out: Path) -> Path:
    """Draws volume, share of U called safe and false-safe share of all points below ``out`` with right labels, two panels for each system.

    The left one has those of the number of transitions that most points have. Returns the picture.
    """
    rows = [json.loads(path.read_text()) for path in sorted(out.rglob("point.json"))]
    rows = [row for row in rows if not row["wrong"] and tuple(row["starts"]) == Point.starts]
    if not rows:
        raise ConfigError(f"figure: expected measured points below '{out}', found none; run the benchmark first")
    words = {"labels.choose": "{} labels chosen", "labels.share": "at random, a chance of {}"}
    for row in rows:
        row["labels known"] = sum(row["needs"][k] for k in ("safe_labels", "unsafe_labels", "neither_labels"))
        pairs = (o.partition("=")[::2] for o in row["options"])
        row["how"] = "".join(f", {words.get(key, f'{key}={{}}').format(value)}" for key, value in pairs)

    def labels_of(row: dict[str, Any]) -> str:
        return f"{row['labels']} labels of S and of U{row['how']}"

    systems = sorted({row["env"] for row in rows})
    drawn = new_figure(9, 2.9 * len(systems))
    for env, (left, right) in zip(systems, drawn.subplots(len(systems), 2, squeeze=False), strict=True):
        of_env = [row for row in rows if row["env"] == env]
        usual = statistics.mode(row["transitions"] for row in of_env)
        _panel(left, [row for row in of_env if row["transitions"] == usual], "labels known", "labels", lambda row: f"{row['transitions']:,} transitions{row['how']}")
        several = [row for row in of_env if len({r["transitions"] for r in of_env if labels_of(r) == labels_of(row)}) > 1]
        _panel(right, several, "transitions", "transitions", labels_of)
        left.set(xlabel="labelled pictures", ylabel="%", title=env)
        right.set(xlabel="transitions", title=env)
    drawn.suptitle("Solid, discs: volume over that of the kernel. Dashed, triangles: share of U called safe. Dotted, squares: false-safe share. Filled: held-out checks pass.", fontsize=8)
    path = out / "few_labels.png"
    drawn.savefig(path, dpi=150)
    return path


def _panel(ax: Any, rows: list[dict[str, Any]], x: str, place: str, name: Callable[[dict[str, Any]], str]) -> None:
    """One mark for each training over ``x``, and lines through the means of those that share a name and a place."""
    names, ticks = sorted({name(row) for row in rows}), set[int]()
    for colour, label in zip(itertools.cycle(PATH_COLOURS), names):
        for measure, mark, style in (("claimed_over_kernel", "o", "-"), ("unsafe_called_safe", "^", "--"), ("false_safe", "s", ":")):
            groups: dict[Any, list[tuple[float, float]]] = {}
            for row in (row for row in rows if name(row) == label and row["measurements"][measure]["value"] is not None):
                at = row[x], 100 * row["measurements"][measure]["value"]
                groups.setdefault(row[place], []).append(at)
                ax.plot(*at, mark, color=colour, markerfacecolor=colour if row["passed"] else "white", markersize=5)
            means = np.array(sorted(tuple(np.mean(of, 0)) for of in groups.values())).reshape(-1, 2)
            ax.plot(*means.T, style, color=colour, label=label if style == "-" else None)
            ticks.update(round(mean) for mean in means[:, 0])
    ax.set(xscale="log", ylim=(-3, 128), yticks=range(0, 101, 20))  # above is the legend
    shown = list[int]()
    for tick in sorted(ticks, reverse=True):
        if not shown or shown[-1] > 1.4 * tick:  # numbers that lie closer overlap
            shown.append(tick)
    ax.set_xticks(shown, [f"{tick:,}" for tick in shown], fontsize=7)
    ax.minorticks_off()
    if names:
        ax.legend(fontsize=7, loc="upper right")


def main(words: list[str]) -> None:
    """Train what is missing, print the table, write the JSON."""
    torch.set_num_threads(1)
    if words[:1] == ["figure"]:
        print(figure(Path(parse(words[1:]).get("out", "runs/few_labels"))))
        return
    given = parse(words)
    lists = [given.pop(name, usual).split(",") for name, usual in LISTS.items()]
    env, out, run = given.pop("env", "pendulum"), Path(given.pop("out", "runs/few_labels")), given.pop("run", "true") == "true"
    sizes = Cell.of("kernel", [f"{k}={given.pop(k)}" for k in [*given] if k.startswith("score.")]).score
    starts = tuple(float(v) for v in json.loads(given.pop("starts", STARTS)))
    more, rows = tuple(f"{k}={v}" for k, v in given.items()), []
    for labels, transitions, wrong, seed in itertools.product(*lists):
        one = Point(env, labels, int(transitions), float(wrong), int(seed), more, starts)
        if run or (out / one.path).is_file():
            rows.append(one.measure(out / one.path, sizes))
            print(table(rows[-1:]), file=sys.stderr, flush=True)
    print(table(rows))
    write(out / "points.json", json.dumps(rows, indent=1) + "\n")


if __name__ == "__main__":
    main(sys.argv[1:])
