"""The command ``sspl``: train, evaluate, verify, compare, watch, calibrate, export."""

from __future__ import annotations

import argparse
import json
import math
import os
import shlex
import sys
from collections.abc import Sequence
from contextlib import nullcontext
from pathlib import Path
from typing import Any

from torchrl_sspl.errors import CheckpointError, ConfigError, SSPLError
from torchrl_sspl.files import write
from torchrl_sspl.interrupts import interruptible

_USAGE = """sspl COMMAND ...

  train     train an agent, evaluate it and write its report; `sspl train --help` lists every field
  evaluate  measure an agent again, on fresh data
  verify    check the certificates of an agent again
  compare   a page with several runs side by side
  watch     see an agent at work (picture, barrier, verdict, interventions), or a training while it runs
  calibrate limits of the monitor's signals, from clean episodes of an agent's system
  export    one step of an agent as .onnx or .pt2"""
_TRAIN = """sspl train env=NAME [key=value ...] [--multirun [--launcher local|ray] [--jobs N]] [--cfg job]

Trains, evaluates on fresh data and writes metrics.json, report.html and the agent into out_dir. Run it again with the
same out_dir to resume it.

  env={envs}, or a .yaml file of your own, or env._target_=package.module:Env
  preset={presets}
  -m, --multirun    every combination of values that are separated by commas, each in its own process
  --launcher ray    on a Ray cluster; --jobs N: runs at a time
  --cfg job         print the configuration, train nothing

Examples:
  sspl train env=pendulum
  sspl train env=quadruped preset=smoke out_dir=runs/try
  sspl train env=gymnasium env.make=my_system:make env.safe=my_system:safe env.unsafe=my_system:unsafe
  sspl train --multirun env=pendulum seed=0,1,2 synthesis.margin=.05,.1

key, meaning (type, value):
"""
_INSTEAD = {
    "--config-name": "env=NAME or env=FILE.yaml", "-cn": "env=NAME or env=FILE.yaml", "--config-path": "env=FILE.yaml",
    "-cp": "env=FILE.yaml", "--config-dir": "env=FILE.yaml", "-cd": "env=FILE.yaml", "--resolve": "--cfg job",
    "--package": "--cfg job", "--info": "--cfg job", "-c": "--cfg job", "-j": "--jobs N", "--resume": "the same out_dir",
}  # fmt: skip


def main(arguments: Sequence[str] | None = None) -> int:
    """Run a command: the words after ``sspl``, by default those of the command line.

    Returns 0; 1 if a verification or a run of several fails; 2 for a wrong argument, with the reason on standard error.
    Source: none.

    Example:
        >>> main(["--version"])
        torchrl_sspl 0.1.0
        0
    """
    words = list(sys.argv[1:] if arguments is None else arguments)
    commands = {
        "train": _train, "evaluate": _evaluate, "verify": _verify, "compare": _compare, "watch": _watch, "calibrate": _calibrate,
        "export": _export,
    }  # fmt: skip
    if words[:1] == ["--version"]:
        from torchrl_sspl import __version__

        print(f"torchrl_sspl {__version__}")
        return 0
    if not words or words[0] in ("-h", "--help"):
        print(_USAGE)
        return 0 if words else 2
    if words[0] not in commands:
        print(f"expected a command, one of {', '.join(commands)}, received '{words[0]}'\n\n{_USAGE}", file=sys.stderr)
        return 2
    try:
        with nullcontext() if words[0] == "watch" else interruptible():  # an interrupt is how a view is closed
            return commands[words[0]](words[1:])
    except SSPLError as error:
        print(f"{type(error).__name__}: {error}", file=sys.stderr)
        return 2


def _train(words: list[str]) -> int:
    """Compose a configuration, train, evaluate and report; or many of them."""
    overrides, options = _options(words)
    if options.keys() & {"--launcher", "--jobs"} and "--multirun" not in options:
        raise ConfigError("expected --multirun with --launcher or --jobs, received none; one run needs neither")
    if "--help" in options:
        print(_help(overrides))
        return 0
    if "--multirun" in options:
        return _multirun(overrides, options)
    from torchrl_sspl.configs.reader import EnvFactory, compose

    config = compose(overrides)
    if "--cfg" in options:
        from omegaconf import OmegaConf

        print(OmegaConf.to_yaml(OmegaConf.create(config.to_dict())), end="")
        return 0
    EnvFactory(config.env)  # a system that is not there is named before anything is built
    from torchrl_sspl.experiments.run import Experiment

    outcome = Experiment(config).run()
    print(outcome.summary())
    print(f"report: {outcome.report}")
    return 0


def _options(words: Sequence[str]) -> tuple[list[str], dict[str, str]]:
    """Overrides, and options with their values."""
    short = {"-m": "--multirun", "-h": "--help"}
    overrides, options, rest = [], {}, list(words)
    while rest:
        word = rest.pop(0)
        name, sign, value = word.partition("=")
        name = short.get(name, name)
        if name in ("--multirun", "--help") and not sign:
            options[name] = ""
        elif name in ("--launcher", "--jobs", "--cfg"):
            if not sign and (not rest or rest[0].startswith("-")):
                raise ConfigError(f"expected a value after {name}, received none; `sspl train --help` shows them")
            options[name] = value if sign else rest.pop(0)
        elif word.startswith("-"):
            key = _INSTEAD.get(name) or f"{name.lstrip('-').replace('-', '_')}={value or (rest or ['VALUE'])[0]}"
            raise ConfigError(
                f"expected key=value, --multirun, --launcher, --jobs, --cfg job or --help, received '{word}'; use {key}"
            )
        else:
            overrides.append(word)
    if options.get("--cfg", "job") != "job":
        raise ConfigError(f"expected --cfg job, received --cfg {options['--cfg']}; there is no other configuration than the job's")
    return overrides, options


def _help(overrides: Sequence[str]) -> str:
    from torchrl_sspl.configs.reader import ENVS, compose, fields
    from torchrl_sspl.configs.schema import PRESETS

    rows = list(fields(compose(overrides)))
    width = max(len(key) for key, *_ in rows) + 2
    lines = [f"  {key:<{width}} {meaning} ({kind}, {'null' if value is None else value})" for key, kind, value, meaning in rows]
    return _TRAIN.format(envs="|".join(ENVS), presets="|".join(PRESETS)) + "\n".join(lines)


def _multirun(overrides: Sequence[str], options: dict[str, str]) -> int:
    from torchrl_sspl.experiments import sweep

    jobs = options.get("--jobs")
    if jobs is not None and not jobs.isdigit():
        raise ConfigError(f"expected --jobs to be an integer >= 1, received '{jobs}'")
    if "--cfg" in options:
        for task in sweep.plan(overrides)[1]:
            print(f"sspl train {shlex.join(task.words)}")
        return 0
    out = sweep.sweep(overrides, launcher=options.get("--launcher", "local"), jobs=None if jobs is None else int(jobs))
    print(out.summary())
    return out.exit_code


def _evaluate(words: list[str]) -> int:
    """Measure an agent on fresh data."""
    parser = argparse.ArgumentParser(prog="sspl evaluate", description="Measure an agent on fresh data.", allow_abbrev=False)
    parser.add_argument("agent", help="name of a shipped agent, such as pendulum, or a run directory")
    parser.add_argument("overrides", nargs="*", metavar="key=value", help="fields of the evaluation, such as seed=7")
    parser.add_argument("--json", metavar="FILE", help="also write the measurements to this file")
    parser.add_argument("--device", default="cpu", help="device of the networks")
    options = parser.parse_intermixed_args(words)
    from torchrl_sspl.evaluation.outcome import finite

    result = evaluate_agent(options.agent, options.overrides, device=options.device)
    for name, m in result.measurements.items():
        value = "not measured" if m.value is None else f"{m.value:.6g}"
        size = "" if m.n is None else f"  n={m.n}"
        bounds = "" if m.lower is None or m.upper is None else f"  95 % bounds {m.lower:.3g} to {m.upper:.3g}"
        print(f"{name:<32} {value:>12} {m.unit}{size}{bounds}")
    if options.json:
        write(options.json, json.dumps(finite(result.to_dict()), indent=1, sort_keys=True, allow_nan=False) + "\n")
    return 0


#: Options of the evaluation at the end of a run.
_OF_A_RUN = ("walks", "walk_seconds", "walk_seed", "renderer_episodes", "certificate_episodes", "certificate_seconds", "calibrate")


def evaluate_agent(name_or_path: str, overrides: Sequence[str] = (), *, device: str = "cpu") -> Any:
    """Measurements of a shipped agent or the agent of a run directory on its own environment.

    Overrides are ``key=value`` for the fields of ``EvaluationConfig`` but those of walks, other renderers, level and certificate. Raises CheckpointError if there is no such
    agent, or its environment is not known; ConfigError if a key or a value is not valid. Source: none.
    """
    from torchrl_sspl.configs.reader import EnvFactory, change, from_dict
    from torchrl_sspl.envs.base import SafetyEnv
    from torchrl_sspl.evaluation.episodes import evaluate_episodes
    from torchrl_sspl.evaluation.known import evaluate as evaluate_known
    from torchrl_sspl.modules.agent import load

    for word in overrides:
        key = word.partition("=")[0].removeprefix("evaluation.")
        if key in _OF_A_RUN:
            raise ConfigError(
                f"expected options of what is measured here, received '{key}': walks, other renderers, level and certificate belong to a run; "
                "an example measures them, too: make quadruped ARGS='agent=quadruped evaluation.walks=20 out_dir=runs/walks'"
            )
    agent = load(name_or_path, device)
    trained = agent.description.get("config", {})
    if "env" in trained and "_target_" not in trained["env"]:
        raise CheckpointError(
            f"expected the agent '{name_or_path}' to name its environment, found none: it was given in code; call "
            "evaluate_episodes(agent, make_env) there"
        )
    try:
        config = from_dict(agent.description["config"])
    except (KeyError, ConfigError) as error:
        raise CheckpointError(
            f"expected the agent '{name_or_path}' to hold the configuration of its training, received {type(error).__name__}: "
            f"{error}; it was made by another version of the library, or by code: call evaluate(agent, env, config) there"
        ) from error
    config = change(config, [w if w.startswith("evaluation.") else f"evaluation.{w}" for w in overrides])
    make_env = EnvFactory(config.env)
    env = make_env(batch_size=[1], seed=config.evaluation.seed)
    if isinstance(env, SafetyEnv):
        return evaluate_known(agent, env.known_twin(), config.evaluation, progress=sys.stderr.isatty())
    env.close()
    return evaluate_episodes(agent, make_env, config.evaluation)


def _verify(words: list[str]) -> int:
    """Check the certificates of an agent again.

    0 if everything was found again, 1 if something is claimed that is not so, 3 if there is no certificate or the file is
    none, 4 if the agent cannot be read, 5 if the time was too short, 6 if --measure could measure nothing.
    """
    parser = argparse.ArgumentParser(prog="sspl verify", description="Check the certificates of an agent again.")
    parser.add_argument("agent", help="name of a shipped agent, such as pendulum, or a run directory")
    parser.add_argument("--measure", action="store_true", help="measure all episodes again, on the system that the agent names")
    parser.add_argument("--trust", action="store_true", help="run code of its own that the agent names: networks, a system")
    parser.add_argument("--seconds", type=float, default=900.0, help="time limit, without --measure (default: 900)")
    options = parser.parse_args(words)
    from torchrl_sspl.evaluation.certify import verify_run

    return int(verify_run(options.agent, measure=options.measure or None, trust=options.trust, seconds=options.seconds))


def _compare(words: list[str]) -> int:
    """Write a page that shows runs side by side, and print their table."""
    parser = argparse.ArgumentParser(prog="sspl compare", description="Runs side by side, on one page.")
    parser.add_argument("runs", nargs="+", metavar="RUN", help="directories of runs; other files are ignored")
    parser.add_argument("--out", metavar="FILE", help="the page; default: comparison.html beside the runs")
    options = parser.parse_intermixed_args(words)
    from torchrl_sspl.viz import compare as page

    runs = page.read_runs([run for run in options.runs if not Path(run).is_file()])
    beside = os.path.commonpath([str(run.directory.resolve().parent) for run in runs] or ["."])
    path = page.compare(runs, options.out or Path(beside) / "comparison.html")
    print(page.text_table(page.rows_of(runs)))
    print(f"comparison: {path}")
    return 0


def _watch(words: list[str]) -> int:
    """Show an agent at work, or a training, on a page that is served from this machine."""
    text = "See an agent at work, or a training while it runs, on a page served from this machine."
    parser = argparse.ArgumentParser(prog="sspl watch", description=text)
    text = "name of a shipped agent, such as pendulum, or a run directory: shows its agent if that is calibrated, else its training"
    parser.add_argument("agent", help=text)
    parser.add_argument("--env", help="a system as in `sspl train env=...`, or physics: its own system in full physics; default: its own system")
    parser.add_argument("--video", metavar="FILE", help="a film instead of a system")
    parser.add_argument("--policy", choices=("own", "random"), default="own", help="the policy that acts (default: own)")
    parser.add_argument("--filter", action="store_true", help="put the safety filter behind the policy")
    parser.add_argument("--record", metavar="FILE.mp4", help="write a film of what is shown")
    parser.add_argument("--host", default="127.0.0.1", help="address of the page; other machines can see it if this is not 127.0.0.1")
    parser.add_argument("--port", type=int, default=8000, help="port of the page, 0: any free one (default: 8000)")
    parser.add_argument("--steps", type=int, help="end after so many steps (of a training: changes); default: never, until Ctrl-C")
    parser.add_argument("--fps", type=float, help="steps per second; default: those of the system or the film")
    parser.add_argument("--noise", type=float, default=1.0, help="noise of the system's camera, grey levels (default: 1)")
    parser.add_argument("--seed", type=int, default=0, help="random seed")
    given = parser.parse_args(words)
    from torchrl_sspl.viz.live import watch

    counts = watch(
        given.agent, env=given.env, video=given.video, policy=given.policy, protect=given.filter, record=given.record,
        host=given.host, port=given.port, steps=given.steps, fps=given.fps, noise=given.noise, seed=given.seed,
        ready=lambda address: print(f"{address}  (Ctrl-C ends it)", flush=True),
    )  # fmt: skip
    print("  ".join(f"{name} {value}" for name, value in counts.items()))
    return 0


def _calibrate(words: list[str]) -> int:
    """Write the limits of the monitor's signals next to an agent."""
    parser = argparse.ArgumentParser(prog="sspl calibrate", description="Limits of the monitor's signals, from clean episodes.")
    parser.add_argument("agent", help="run directory, or name of a shipped agent")
    parser.add_argument("--out", metavar="DIRECTORY", help="where to write; default: the run directory")
    parser.add_argument("--episodes", type=int, default=1000, help="episodes for the limits; the more, the fewer false alarms (default: 1000)")
    parser.add_argument("--horizon", type=int, default=200, help="steps per episode (default: 200)")
    parser.add_argument("--pictures", type=int, default=20_000, help="pictures for the model of clean pictures (default: 20000)")
    parser.add_argument("--steps", type=int, default=3000, help="steps of the model's fit (default: 3000)")
    parser.add_argument("--noise", type=float, default=1.0, help="noise of the camera, grey levels (default: 1)")
    parser.add_argument("--seed", type=int, default=0, help="random seed")
    parser.add_argument("--trust", action="store_true", help="run code of its own that the agent names: networks, a system")
    given = parser.parse_args(words)
    from torchrl_sspl.evaluation.blocks import described_system
    from torchrl_sspl.modules.agent import Agent, agent_directory
    from torchrl_sspl.runtime import calibrate

    if min(given.episodes, given.horizon, given.pictures, given.steps) < 1 or not 0.0 <= given.noise < math.inf:
        raise ConfigError(
            f"expected episodes, horizon, pictures and steps >= 1 and a finite noise >= 0, received {given.episodes}, {given.horizon}, "
            f"{given.pictures}, {given.steps} and {given.noise}"
        )
    directory = agent_directory(given.agent)
    if given.out is None and directory.resolve().is_relative_to(Path(__file__).resolve().parent):
        raise ConfigError(f"expected --out DIRECTORY with a shipped agent, received none; '{given.agent}' has its own calibration")
    agent = Agent.load(directory, trust=given.trust)
    factory = described_system(agent.description, trust=given.trust)
    if factory is None:
        more = "run in the folder that holds its module" if given.trust else "one of your own (env._target_=module:Env) needs --trust, which runs its code"
        raise ConfigError(
            f"expected an agent that names a system that can be built here, received another one; {more}; if it was given in code, call "
            "sspl.calibrate(agent, env) there"
        )
    found = calibrate(
        agent, factory(batch_size=[1], seed=given.seed), episodes=given.episodes, horizon=given.horizon, pictures=given.pictures, steps=given.steps, noise=given.noise,
        seed=given.seed, progress=sys.stderr.isatty(),
    )  # fmt: skip
    for name, (low, high) in found.limits.items():
        print(f"{name:<12} {low:.4g} to {high:.4g}")
    print(f"clean episodes with an alarm: at most {100 * found.false_alarms:.3g} % expected\n{found.save(given.out or directory)}")
    return 0


def _export(words: list[str]) -> int:
    """Write one step of an agent for a machine without this library."""
    parser = argparse.ArgumentParser(prog="sspl export", description="One step of an agent, for a machine without this library.")
    parser.add_argument("agent", help="name of a shipped agent, such as pendulum, or a run directory")
    parser.add_argument("file", help="what to write: FILE.onnx or FILE.pt2")
    parser.add_argument("--image-size", type=int, nargs=2, metavar=("HEIGHT", "WIDTH"), help="of the pictures, for an encoder that takes any size")
    given = parser.parse_args(words)
    from torchrl_sspl.modules.agent import load

    print(load(given.agent).export(given.file, image_size=given.image_size))
    return 0
