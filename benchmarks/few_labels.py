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
over the number of labels and over that of the transitions, in ``few_labels.png``, and writes them into ``few_labels.csv``: with ``out=docs/images`` it draws the documentation's.

``env=quadruped`` is a run as of ``sspl train``, of ``transitions`` a fifth that start anywhere in U, by known resets and without a label, and a fifth of its own policy, with a second attempt where the
first does not pass. It is scored on the paper's car, from its claimed set alone; of ``score.*`` it takes ``episodes``, ``horizon``, ``grid`` and ``kernel_grid``.
"""

from __future__ import annotations

import csv
import io
import itertools
import json
import statistics
import sys
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass
from hashlib import sha256
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import torch

from torchrl_sspl.baselines import Budget, Needs, ScoreConfig, make, score
from torchrl_sspl.baselines.cell import SCHEMA, Cell, folder_of, hash_of, of_this_version
from torchrl_sspl.baselines.sspl import SSPL, needs_of, recorded_first
from torchrl_sspl.configs.reader import compose, parse
from torchrl_sspl.errors import ConfigError
from torchrl_sspl.evaluation.measurements import Measurement
from torchrl_sspl.experiments.run import Experiment
from torchrl_sspl.files import RunDirectory, write
from torchrl_sspl.trainers.phases import Check
from torchrl_sspl.viz.plane import PATH_COLOURS, new_figure

#: Of the quadruped's runs: as few labels are used on the other systems, and nothing is proved.
QUADRUPED = (
    "synthesis.lowest_level=-0.2", "synthesis.guard=0.005", "synthesis.safe_share=0.03", "synthesis.cover_share=0", "synthesis.retries=1",
    "evaluation.episodes=2000", "evaluation.walks=0", "evaluation.certificate_episodes=0", "evaluation.certificate_seconds=0",
)  # fmt: skip
LISTS = {"labels": "100,300,1000,all", "transitions": "20000", "wrong": "0", "seed": "0,1,2"}
DATA = "few_labels.csv"
STARTS = "[0.6,0.15,0.25]"  # shares of the episodes: anywhere or outside U, in S, in U
COLUMNS = (
    ("volume / kernel", "claimed_over_kernel"), ("false-safe", "false_safe"), ("U called safe", "unsafe_called_safe"),
    ("claimed, enter U", "claimed_harmless_enter"), ("common, enter U", "common_harmless_enter"),
)  # fmt: skip
Measured = tuple[Sequence[Check], Needs, dict[str, Any]]


class Line(NamedTuple):
    """A point as a line of the data; the first six say which one it is."""

    env: str
    labels: str  # that come first, of each kind at most, or "all"
    transitions: int  # asked for
    wrong: float
    seed: int
    options: str
    passed: int
    labelled: int  # of S, of U and of neither, in all
    claimed_over_kernel: float | None
    false_safe: float | None
    unsafe_called_safe: float | None
    claimed_harmless_enter: float | None
    common_harmless_enter: float | None

    @classmethod
    def read(cls, row: dict[str, str]) -> Line:
        """A line of what :func:`figure` has written."""
        kinds = (str, str, int, float, int, str, int, int)
        shares = [float(row[name]) if row[name] else None for _, name in COLUMNS]
        return cls(*(kind(row[name]) for kind, name in zip(kinds, cls._fields[:8], strict=True)), *shares)

    @property
    def how(self) -> str:
        """Options in words, as a legend needs them."""
        words = {"labels.choose": "{} labels chosen", "labels.share": "at random, a chance of {}"}
        pairs = (option.partition("=")[::2] for option in self.options.split())
        return "".join(f", {words.get(key, f'{key}={{}}').format(value)}" for key, value in pairs)


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
        return Path(folder_of(self.env)) / name / str(self.seed) / "point.json"

    def measure(self, path: Path, sizes: ScoreConfig) -> dict[str, Any]:
        """Train and score, or read what has been measured with the same sizes."""
        system = hash_of(self.env)
        with RunDirectory(path.parent).held() as directory:
            if path.is_file():
                row = of_this_version(json.loads(path.read_text()), path)
                if row.get("score") != asdict(sizes):
                    raise ConfigError(f"score: expected {row.get('score')}, with which '{path}' was measured, received {asdict(sizes)}; give the same, or remove the point")
                if row.get("system", "") != system:
                    raise ConfigError(f"env: expected '{self.env}' as it was when '{path}' was measured, received another content; remove the point, or give another out=")
                return row
            few = [] if self.labels == "all" else [f"labels.safe={self.labels}", f"labels.unsafe={self.labels}"]
            words = [f"labels.wrong={self.wrong}", *few, *self.options]
            checks, needs, found = (self._run if self.env == "quadruped" else self._row)(words, directory, sizes)
            row = {"schema": SCHEMA} | asdict(self) | {
                "score": asdict(sizes), "passed": float(any(check.passed for check in checks)), "checks": [asdict(check) for check in checks],
                "needs": asdict(needs), "measurements": found,
            }  # fmt: skip
            if system:
                row["system"] = system
            write(path, json.dumps(row, indent=1) + "\n")
            return row

    def _row(self, words: list[str], directory: Path, sizes: ScoreConfig) -> Measured:
        """Trained and scored as a row of the comparison."""
        method = make("sspl", [f"overrides={json.dumps(words)}"])
        assert isinstance(method, SSPL)
        method.directory, method.env_name, env = directory, self.env, Cell("kernel", self.env, seed=self.seed).environment()
        method.fit(None, env, Budget("few", *(round(share * self.transitions) for share in self.starts)), self.seed)
        return method.checks, method.needs, score(method, env, sizes).to_dict()

    def _run(self, words: list[str], directory: Path, sizes: ScoreConfig) -> Measured:
        """A run that scores itself, on the paper's car: what turns late behind an observer is no row of the comparison."""
        usual = compose([f"env={self.env}"])
        first, rim, own = (round(share * self.transitions) for share in (0.6, 0.2, 0.2))
        plan = [f"env={self.env}", f"seed={self.seed}", f"out_dir={directory / 'run'}", "logger=none", "trainer.progress=false", *QUADRUPED]
        plan += [f"synthesis.transitions={first}", f"synthesis.rim_transitions={rim}", f"synthesis.rollout_transitions={own}"]
        batch = usual.collector.frames_per_batch
        if first < usual.trainer.total_frames:
            plan += recorded_first(usual, -(-first // batch) * batch)
        plan += [f"evaluation.{name}={size}" for name in ("episodes", "horizon", "grid", "kernel_grid") if (size := getattr(sizes, name))]
        outcome = Experiment(compose([*plan, *words])).run()
        own_frames = outcome.evaluation.to_dict()
        names = {"claimed_over_kernel": "volume_over_kernel", "claimed_harmless_enter": "safe_rollouts_touch_unsafe", "false_safe": "false_safe", "unsafe_called_safe": "unsafe_called_safe"}
        measured = {name: own_frames[theirs] for name, theirs in names.items()} | {"common_harmless_enter": asdict(Measurement("common_harmless_enter", None, "share", note="not measured"))}
        return outcome.checks, needs_of(outcome.budget), measured


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


def line_of(row: dict[str, Any]) -> Line:
    """What figure and data tell of a measured point."""
    options = [*row["options"], *([] if tuple(row["starts"]) == Point.starts else [f"starts={list(row['starts'])}".replace(" ", "")])]
    known = sum(row["needs"][k] for k in ("safe_labels", "unsafe_labels", "neither_labels"))
    measured = [_rounded(row["measurements"][name]["value"]) for _, name in COLUMNS]
    return Line(row["env"], str(row["labels"]), row["transitions"], row["wrong"], row["seed"], " ".join(options), int(row["passed"]), known, *measured)


def _rounded(share: float | None) -> float | None:
    return None if share is None else round(share, 6)


def gathered(out: Path) -> list[Line]:
    """A line for every point below ``out``, measured there or in the data that is there; what is measured counts first."""
    lines = list[Line]()
    if (out / DATA).is_file():
        lines += [Line.read(row) for row in csv.DictReader((out / DATA).read_text().splitlines())]
    lines += [line_of(of_this_version(json.loads(path.read_text()), path)) for path in sorted(out.rglob("point.json"))]
    return sorted({line[:6]: line for line in lines}.values(), key=lambda line: (line.env, line.wrong, line.options, line.transitions, line.labels == "all", line.labels.zfill(9), line.seed))


def figure(out: Path) -> Path:
    """Draws volume, share of U called safe and false-safe share of all points below ``out`` with right labels, two panels for each system.

    The left one has those of the number of transitions that most points have. Writes a line for every point into ``few_labels.csv`` beside the
    picture, and reads what is there: it draws the same without the points. Returns the picture.
    """
    lines = gathered(out)
    text = io.StringIO()
    csv.writer(text, lineterminator="\n").writerows([Line._fields, *lines])
    lines = [line for line in lines if not line.wrong and "starts=" not in line.options]
    if not lines:
        raise ConfigError(f"figure: expected measured points below '{out}', found none; run the benchmark first")
    write(out / DATA, text.getvalue())

    def labels_of(line: Line) -> str:
        return f"{line.labels} labels of S and of U{line.how}"

    systems = sorted({line.env for line in lines})
    drawn = new_figure(9, 2.9 * len(systems))
    for env, (left, right) in zip(systems, drawn.subplots(len(systems), 2, squeeze=False), strict=True):
        of_env = [line for line in lines if line.env == env]
        usual = statistics.mode(line.transitions for line in of_env)
        _panel(left, [line for line in of_env if line.transitions == usual], "labelled", "labels", lambda line: f"{line.transitions:,} transitions{line.how}")
        several = [line for line in of_env if len({r.transitions for r in of_env if labels_of(r) == labels_of(line)}) > 1]
        _panel(right, several, "transitions", "transitions", labels_of)
        left.set(xlabel="labelled pictures", ylabel="%", title=env)
        right.set(xlabel="transitions", title=env)
        right.set_visible(bool(several))
    drawn.suptitle("Solid, discs: volume over that of the kernel. Dashed, triangles: share of U called safe. Dotted, squares: false-safe share. Filled: held-out checks pass.", fontsize=8)
    path = out / "few_labels.png"
    drawn.savefig(path, dpi=150)
    return path


def _panel(ax: Any, lines: list[Line], x: str, place: str, name: Callable[[Line], str]) -> None:
    """One mark for each training over ``x``, and lines through the means of those that share a name and a place."""
    names, ticks = sorted({name(line) for line in lines}), set[int]()
    for colour, label in zip(itertools.cycle(PATH_COLOURS), names):
        for measure, mark, style in (("claimed_over_kernel", "o", "-"), ("unsafe_called_safe", "^", "--"), ("false_safe", "s", ":")):
            groups: dict[Any, list[tuple[float, float]]] = {}
            for line in (line for line in lines if name(line) == label and getattr(line, measure) is not None):
                at = getattr(line, x), 100 * getattr(line, measure)
                groups.setdefault(getattr(line, place), []).append(at)
                ax.plot(*at, mark, color=colour, markerfacecolor=colour if line.passed else "white", markersize=5)
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
    if env == "quadruped" and starts != Point.starts:
        raise ConfigError(f"starts: expected none with env=quadruped, whose episodes start as recommended (collector.starts), received {list(starts)}")
    for labels, transitions, wrong, seed in itertools.product(*lists):
        one = Point(env, labels, int(transitions), float(wrong), int(seed), more, starts)
        if run or (out / one.path).is_file():
            rows.append(one.measure(out / one.path, sizes))
            print(table(rows[-1:]), file=sys.stderr, flush=True)
    print(table(rows))
    write(out / "points.json", json.dumps(rows, indent=1) + "\n")


if __name__ == "__main__":
    main(sys.argv[1:])
