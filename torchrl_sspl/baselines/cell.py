"""One cell of the table: a method, a task, a budget and a seed; fitted, scored, and written as one JSON."""

from __future__ import annotations

import functools
import io
import itertools
import json
import tempfile
import time
from collections.abc import Sequence
from dataclasses import asdict, dataclass, field, replace
from hashlib import sha256
from pathlib import Path
from typing import Any

import numpy as np
import torch
import yaml
from filelock import FileLock

from torchrl_sspl.baselines import tuning
from torchrl_sspl.baselines.base import BUDGETS, EARLIER, POOL, SCHEMA, SafetyMethod
from torchrl_sspl.baselines.data import Recording, record
from torchrl_sspl.baselines.pictures import Album
from torchrl_sspl.baselines.registry import changed, kind_of, make
from torchrl_sspl.baselines.scoring import ScoreConfig, score, sizes_of
from torchrl_sspl.configs.reader import ENVS, EnvFactory, compose, parse
from torchrl_sspl.envs.base import SafetyEnv
from torchrl_sspl.errors import ConfigError, OutputError
from torchrl_sspl.files import RunDirectory, write
from torchrl_sspl.modules.agent import WEIGHTS_FILE, agent_directory
from torchrl_sspl.seeds import spawn
from torchrl_sspl.viability.grid import ViabilityKernel, viability_kernel

ROW_FILE, CLAIMS_FILE, TRIALS_FILE = "row.json", "claims.npz", "trials.json"
STAYS = "rows and trials that are done stay; the same command goes on from there"
_OWN = ("env", "budget", "seed", "out_dir", "trials")


@dataclass(frozen=True)
class Cell:
    """What determines a row.

    Attributes:
        method: name in ``METHODS``.
        env: name of a system of this library, such as ``"pendulum"`` or ``"dubins"``, or a file of your own.
        budget: name in ``BUDGETS``.
        seed: of data, weights and batches.
        options: ``key=value`` changes of the method's configuration.
        score: sizes of the measurements.
        out_dir: where the row is written; "": below ``root``.
        trials: of the tuning, by which options are chosen first, see :mod:`~torchrl_sspl.baselines.tuning`; 0: none.
        root: directory of all rows of a table.

    Source: none.
    """

    method: str
    env: str = "pendulum"
    budget: str = "small"
    seed: int = 0
    options: tuple[str, ...] = ()
    score: ScoreConfig = field(default_factory=ScoreConfig)
    out_dir: str = ""
    trials: int = 0
    root: str = "runs/baselines"

    @classmethod
    def of(cls, method: str, words: Sequence[str] = ()) -> Cell:
        """A cell of ``key=value`` words; those that are none of the cell's and not ``score.*`` are the method's.

        Raises ConfigError for a word, a method, a budget or a value that is not valid.

        Example:
            >>> cell = Cell.of("hocbf", ["env=pendulum", "k=2.0", "score.episodes=10"])
            >>> cell.options, cell.score.episodes, cell.directory.as_posix()
            (('k=2.0',), 10, 'runs/baselines/pendulum/none/hocbf-k-2.0/0')
        """
        given = parse(list(words))
        scores = [f"{k.partition('.')[2]}={v}" for k, v in given.items() if k.startswith("score.")]
        own = {k: v for k, v in given.items() if k in _OWN}
        options = tuple(f"{k}={v}" for k, v in given.items() if k not in _OWN and not k.startswith("score."))
        kind = kind_of(method)
        make(method, options)  # an option that is not valid is named before anything is done
        if own.get("budget", "small") not in BUDGETS:
            raise ConfigError(f"expected budget to be one of {', '.join(BUDGETS)}, received '{own['budget']}'")
        for number in ("seed", "trials"):
            if not own.get(number, "0").isdecimal() or int(own.get(number, "0")) >= 2**62:
                raise ConfigError(f"expected {number} to be an integer in [0, 2^62), received '{own[number]}'")
        if int(own.get("trials", 0)) and int(own.get("seed", 0)) == tuning.SEED:
            raise ConfigError(f"expected another seed than {tuning.SEED} with trials, which are made with that one, received it")
        sizes: Any = changed(ScoreConfig, scores, "expected score.*")
        sizes.check()
        budget = own.get("budget", "small") if kind.learns else "none"
        trials = int(own.get("trials", 0)) if kind.learns and not trained_before(options) else 0
        return cls(method, own.get("env", "pendulum"), budget, int(own.get("seed", 0)), options, sizes, own.get("out_dir", ""), trials)

    @property
    def directory(self) -> Path:
        """Where the row lies: ``out_dir``, or one that names what determines it."""
        name = "-".join([self.method, *(o.replace("=", "-").replace("/", "_") for o in self.options), *([f"trials-{self.trials}"] if self.trials else [])])
        return Path(self.out_dir or f"{self.root}/{folder_of(self.env)}/{self.budget}/{name}/{self.seed}")

    def describe(self) -> dict[str, Any]:
        """Plain values that determine the row; where it lies is not among them."""
        body = asdict(self)
        for where in ("out_dir", "root"):
            body.pop(where)
        if not self.trials:
            body.pop("trials")
        body["options"] = list(self.options)
        if system := hash_of(self.env):
            body["system"] = system
        for agent in (o.removeprefix("agent=") for o in self.options if o.startswith("agent=")):
            body["weights"] = sha256((agent_directory(agent) / WEIGHTS_FILE).read_bytes()).hexdigest()
        return body

    def environment(self) -> SafetyEnv:
        """The system; a ConfigError if there is none of that name, or its dynamics are not known."""
        env = EnvFactory(compose([f"env={self.env}"]).env)(batch_size=[256], seed=self.seed)
        if not isinstance(env, SafetyEnv) or env.known_twin() is not env:
            raise ConfigError(f"env: expected a system whose true kernel is known, such as pendulum or dubins, received '{self.env}'")
        return env


def folder_of(env: str) -> str:
    """A system's name, or its file's, as a folder below another one: without the steps up of a path. Source: none.

    Example:
        >>> folder_of("pendulum"), folder_of("../mine/car.yaml")
        ('pendulum', 'up/mine/car.yaml')
    """
    path = Path(env)
    return "/".join("up" if part == ".." else part for part in path.parts if part != path.anchor)


def hash_of(env: str) -> str:
    """A hash of what a file of your own says of a system, 16 digits; "" of a system of this library, which the schema tells.

    Raises ConfigError if there is no such system. Source: none.

    Example:
        >>> hash_of("pendulum")
        ''
    """
    if env in ENVS:
        return ""
    compose([f"env={env}"])  # names what is not valid
    return sha256(json.dumps(yaml.safe_load(Path(env).read_text()), sort_keys=True, default=str).encode()).hexdigest()[:16]


def trained_before(options: Sequence[str]) -> bool:
    """Whether options give an agent that is scored as it is. Source: none.

    Example:
        >>> trained_before(["agent=pendulum"]), trained_before(["filter=true"])
        (True, False)
    """
    return any(option.startswith("agent=") for option in options)


def stored(cell: Cell, *, any_score: bool = False) -> dict[str, Any] | None:
    """The row of a cell, if it has been written, of an agent with the same weights; OutputError if the directory holds another one, or one of another version.

    With ``any_score`` the sizes of its measurement do not matter. Source: none.

    Example:
        >>> stored(Cell.of("lqr", ["out_dir=runs/nowhere"])) is None
        True
    """
    path = cell.directory / ROW_FILE
    if not path.is_file():
        return None
    row = of_this_version(_read(path, "a row"), path)
    found, now = row.get("cell") or {}, cell.describe()
    if found.get("weights") != now.get("weights") and {**found, "weights": None, "score": None} == {**now, "weights": None, "score": None}:
        return None
    if found.get("system") != now.get("system") and {**found, "system": now.get("system")} == now:
        raise OutputError(f"expected the row of '{cell.env}' as it is in '{path}', found that of an earlier content of the file; remove it, or choose another out_dir")
    if {**found, "score": None} != {**now, "score": None} or not (any_score or found["score"] == now["score"]):
        raise OutputError(f"expected the row of {now} in '{path}', found that of {row.get('cell')}; remove it, or choose another out_dir for one row")
    return row


def of_this_version(body: dict[str, Any], path: Path) -> dict[str, Any]:
    """What a file of a row or of trials holds; OutputError if it was measured by a version with other recordings or encoders. Source: none.

    Example:
        >>> of_this_version({"schema": SCHEMA, "trials": []}, Path("trials.json"))["trials"]
        []
    """
    if body.get("schema") != SCHEMA:
        raise OutputError(
            f"expected measurements of schema {SCHEMA} in '{path}', found those of schema {body.get('schema')}, of another version of this library, "
            "whose recordings or encoders may differ; remove the file, or move it elsewhere to keep it, and what is missing is measured again"
        )
    return body


def _read(path: Path, what: str) -> dict[str, Any]:
    try:
        return json.loads(path.read_text())
    except ValueError as error:
        raise OutputError(f"expected {what} in '{path}', received what cannot be read: {error}; remove it") from error


@functools.lru_cache(maxsize=1)
def _recorded(env: str, system: str, budget: str, seed: int, size: int) -> Recording:
    """One recording serves all methods of a system, a budget, a seed and a size of the pictures; ``system`` is the hash of its file."""
    return record(Cell("kernel", env, seed=seed).environment(), BUDGETS[budget], seed, size=size)


@functools.lru_cache(maxsize=2)
def _kernel(env: str, system: str, nodes: int) -> ViabilityKernel:
    """One true kernel serves all methods of a system."""
    made = Cell("kernel", env).environment()
    return viability_kernel(made, resolution=sizes_of(made.system.kernel_grid, nodes))


@functools.lru_cache(maxsize=1)
def _album(env: str, system: str) -> Album:
    """Pictures that all methods of a system are asked about."""
    return Album(Cell("kernel", env).environment())


def _data(method: SafetyMethod, cell: Cell, seed: int) -> Recording | None:
    """What the method of a cell learns from, with the data of a seed; None if it takes no recording."""
    return _recorded(cell.env, hash_of(cell.env), cell.budget, seed, method.side or POOL) if method.learns and method.records else None


def _fit(method: SafetyMethod, env: SafetyEnv, cell: Cell, seed: int) -> None:
    """The method of a cell learns from the data of a seed."""
    data = _data(method, cell, seed)
    with torch.random.fork_rng():
        torch.manual_seed(spawn(seed, "weights"))
        method.fit(data, env, BUDGETS.get(cell.budget, BUDGETS["tiny"]), seed)


def _tuned(cell: Cell) -> tuple[Sequence[str], list[dict[str, Any]]]:
    """Options that trials have chosen, and the trials; they are the same for all scored seeds, and each is made once."""
    path = (cell.directory if cell.out_dir else cell.directory.parent) / TRIALS_FILE
    horizon = cell.score.horizon or 60
    asked = {
        "method": cell.method, "env": cell.env, "budget": cell.budget, "options": list(cell.options), "trials": cell.trials, "horizon": horizon,
    } | ({"system": system} if (system := hash_of(cell.env)) else {})  # fmt: skip
    env, stages = replace(cell, seed=tuning.SEED).environment(), dict[tuple[str, ...], Any]()
    # An option that names the row is not drawn, nor is one that does nothing here.
    named = [*(option.partition("=")[0] for option in cell.options), *kind_of(cell.method).idle(env)]
    options = tuning.draws(cell.method, cell.trials, named=named)

    def trial(words: Sequence[str]) -> float:
        method = make(cell.method, [*cell.options, *words])
        with tempfile.TemporaryDirectory() as where:
            method.directory, method.env_name, method.stages = Path(where), cell.env, stages
            _fit(method, env, cell, tuning.SEED)
            return tuning.merit(method, env, horizon=horizon)

    path.parent.mkdir(parents=True, exist_ok=True)
    with FileLock(path.with_name(f".{TRIALS_FILE}.lock")):  # another seed waits for them
        return tuning.search(trial, options, _told(path, asked, options), lambda so_far: write(path, json.dumps({"schema": SCHEMA, "of": asked, "trials": so_far}, indent=1) + "\n"))


def _told(path: Path, asked: dict[str, Any], options: Sequence[Sequence[str]]) -> list[dict[str, Any]]:
    """The trials that an earlier call has made, as far as they are those of these options: a space may have changed since.

    An OutputError if they were made in episodes of another length, or by another version: rows of one method would carry different options.
    """
    if not path.is_file():
        return []
    found = of_this_version(_read(path, "trials"), path)
    of, horizon = found.get("of") or {}, asked["horizon"]
    if of != asked and {**of, "horizon": horizon} == asked:
        raise OutputError(f"expected trials in episodes of {horizon} steps in '{path}', found those of {of['horizon']}; give score.horizon={of['horizon']}, or remove the file")
    pairs = zip(found["trials"], options, strict=False) if of == asked else ()
    return [trial for trial, _ in itertools.takewhile(lambda pair: pair[0]["options"] == list(pair[1]), pairs)]


def run_cell(cell: Cell) -> dict[str, Any]:
    """Record, fit, score, write; or read what an earlier call has written.

    Returns the row: ``cell``, ``needs``, ``minutes`` (``data``, ``fit`` of wall clock, ``fit_cpu`` of the processor, earlier
    processes of a training that goes on included, ``trials_cpu`` of all trials, ``score``) and ``measurements``. Raises ConfigError for a cell that is not valid, OutputError if another row lies there or another
    process is writing it. Source: none.

    Example:
        >>> row = run_cell(Cell.of("lqr", ["score.episodes=20", "score.grid=21", "score.kernel_grid=41", "score.frames=2"]))
        >>> row["measurements"]["false_safe"]["value"]
        0.0
    """
    with RunDirectory(cell.directory).held() as directory:
        if (row := stored(cell)) is not None:
            return row
        from torchrl_sspl import __version__

        env, system, determined = cell.environment(), hash_of(cell.env), cell.describe()  # before anything is changed meanwhile
        chosen, trials = _tuned(cell) if cell.trials else ((), [])
        method = make(cell.method, [*cell.options, *chosen])
        method.directory, method.env_name = directory, cell.env
        clock = [time.perf_counter()]
        _data(method, cell, cell.seed)  # its minutes are none of the fit's
        clock.append(time.perf_counter())
        used = time.process_time()
        _fit(method, env, cell, cell.seed)
        used = time.process_time() - used + method.notes.get(EARLIER, 0.0)
        clock.append(time.perf_counter())
        found = score(method, env, cell.score, kernel=_kernel(cell.env, system, cell.score.kernel_grid), album=_album(cell.env, system))
        clock.append(time.perf_counter())
        minutes = {name: (b - a) / 60 for name, a, b in zip(("data", "fit", "score"), clock, clock[1:], strict=False)}
        row = {
            "schema": SCHEMA, "version": __version__, "cell": determined, "needs": asdict(method.needs),
            "minutes": minutes | {"fit_cpu": used / 60} | _of_trials(trials), "measurements": found.to_dict(), "notes": method.notes,
        }  # fmt: skip
        if cell.trials:
            # What the choice rests on, beside the needs of the fit.
            more = {"transitions": BUDGETS[cell.budget].total, "episodes_at_most": len(trials) * tuning.STARTS}
            row["tuning"] = {"chosen": list(chosen), "trials": trials, "needs": more}
        claims = found.arrays
        if "barrier" in claims:
            packed = io.BytesIO()
            failed = {name: value for name, value in claims.items() if name.startswith("failed_")}
            np.savez_compressed(packed, states=claims["states"], claimed=claims["barrier"] <= 0.0, viable=claims["viable"], **failed)
            write(directory / CLAIMS_FILE, packed.getvalue())
        write(directory / ROW_FILE, json.dumps(row, indent=1) + "\n")
        return row


def _of_trials(trials: Sequence[dict[str, Any]]) -> dict[str, float]:
    """What trials took of the processor, where each says so."""
    return {"trials_cpu": sum(trial["cpu"] for trial in trials) / 60} if trials and all("cpu" in trial for trial in trials) else {}


def text(row: dict[str, Any]) -> str:
    """A row for people: what was measured, with bounds, and what was needed. Source: none."""
    cell = row["cell"]
    lines = [f"{cell['method']} on {cell['env']}, budget {cell['budget']}, seed {cell['seed']} {' '.join(cell['options'])}".rstrip()]
    for name, m in row["measurements"].items():
        value = "not measured" if m["value"] is None else f"{100 * m['value']:.2f} %" if m["unit"] == "share" else f"{m['value']:.4g} {m['unit']}"
        bounds = "" if m["lower"] is None or m["upper"] is None else f"  [{100 * m['lower']:.2f}, {100 * m['upper']:.2f}] of {m['n']}"
        lines.append(f"  {name:<34} {value}{bounds}")
    lines += [f"  needs {name:<28} {value}" for name, value in row["needs"].items() if value not in (0, False, None, "nothing", "none")]
    lines.append("  minutes " + ", ".join(f"{name} {value:.1f}" for name, value in row["minutes"].items()))
    return "\n".join(lines)


__all__ = ["Cell", "run_cell", "stored", "text"]
