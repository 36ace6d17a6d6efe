"""The command ``sspl``: train, evaluate, verify."""

from __future__ import annotations

import argparse
import dataclasses
import json
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from torchrl_sspl.errors import CheckpointError, ConfigError, SSPLError

TRAIN = """sspl train [group=choice ...] [key=value ...]

Trains, evaluates on fresh data and writes metrics.json, report.html and the agent into out_dir. Started again with
the same out_dir it continues where it was interrupted.

  trainer=sspl            SSPLTrainer: any environment, collectors in other processes or on Ray (the default)
  trainer=rounds          two time scales, in rounds, for systems whose dynamics are known; what the shipped agent is from
  trainer=rounds_paper    the paper's losses and schedule as printed

Examples:
  sspl train env=pendulum trainer.total_frames=64000
  sspl train env=pendulum trainer=rounds out_dir=runs/pendulum
  sspl train env=gymnasium env.make=my_system:make env.safe=my_system:safe env.unsafe=my_system:unsafe
"""


def main(arguments: Sequence[str] | None = None) -> int:
    """Run a command.

    Args:
        arguments: words after ``sspl``; by default those of the command line.

    Returns:
        0; 1 if a verification fails; 2 for a wrong argument, with the reason on standard error.

    Source: none.

    Example:
        >>> main(["--version"])
        torchrl_sspl 0.1.0
        0
    """
    words = list(sys.argv[1:] if arguments is None else arguments)
    commands = {"train": train, "evaluate": evaluate, "verify": verify}
    if words[:1] == ["--version"]:
        from torchrl_sspl import __version__

        print(f"torchrl_sspl {__version__}")
        return 0
    if not words or words[0] in ("-h", "--help"):
        print(_usage())
        return 0 if words else 2
    if words[0] not in commands:
        print(f"expected a command, one of {', '.join(commands)}, received '{words[0]}'\n\n{_usage()}", file=sys.stderr)
        return 2
    try:
        return commands[words[0]](words[1:])
    except SSPLError as error:
        print(f"{type(error).__name__}: {error}", file=sys.stderr)
        return 2


def _usage() -> str:
    return (
        "sspl COMMAND ...\n\n"
        "  train     train an agent, evaluate it and write its report; `sspl train --help` lists every field\n"
        "  evaluate  measure an agent again, on fresh data\n"
        "  verify    check the certificates of an agent again"
    )


def train(words: list[str]) -> int:
    """``sspl train``: compose a configuration, train, evaluate and report.

    Args:
        words: overrides, or ``--help``.

    Returns:
        0.

    Raises:
        ConfigError: if a key or a value is not valid.
        MissingDependencyError: if Hydra is not installed.

    Source: paper, Algorithm 1.
    """
    from torchrl_sspl.trainers import hydra_store

    if any(word in ("-h", "--help") for word in words):
        print(TRAIN + "\n" + hydra_store.help_text(words))
        return 0
    config = hydra_store.compose(words)
    from torchrl_sspl.trainers.config import TrainingConfig

    if isinstance(config.trainer, TrainingConfig):
        return _train_rounds(config)
    from torchrl_sspl.trainers.experiment import Experiment

    outcome = Experiment(config, title=f"{type(config.env).__name__.removesuffix('EnvConfig')} from pixels").run()
    print(outcome.summary())
    print(f"report: {outcome.report}")
    return 0


def _train_rounds(config: Any) -> int:
    from torchrl_sspl.envs.base import SafetyEnv
    from torchrl_sspl.trainers.experiment_config import EnvFactory
    from torchrl_sspl.trainers.loggers import close_logger, make_logger
    from torchrl_sspl.trainers.requirements import PENDULUM
    from torchrl_sspl.trainers.run import run

    factory = EnvFactory(config.env)

    def make(batch_size: list[int], seed: int) -> Any:
        return factory(batch_size=batch_size, seed=seed)

    env = make([1], 0)
    if not isinstance(env, SafetyEnv):
        raise ConfigError(
            f"expected an environment whose dynamics are known with trainer=rounds, received {type(env).__name__}; "
            "choose trainer=sspl"
        )
    own: dict[str, Any] = {}
    if type(env).__name__ == "PendulumEnv":
        own = {
            "requirements": PENDULUM,
            "axes": ("angle [rad]", "angular velocity [rad/s]"),
            "action": "torque [N m]",
            "foreign": lambda env: lambda state: env.observe_gymnasium(state)[:, 3:],
        }
    logger = make_logger(
        config.logger.kind, config.logger.kind, config.trainer.out_dir, project=getattr(config.logger, "project", "torchrl-sspl")
    )
    outcome = run(config.trainer, make, title=f"{type(env).__name__} from pixels", logger=logger, **own)
    close_logger(logger)
    print(outcome.summary() if own else f"training: {outcome.training.stop_reason}")
    print(f"report: {outcome.report}")
    return 0


def evaluate(words: list[str]) -> int:
    """``sspl evaluate``: measure an agent on fresh data.

    Args:
        words: name of a shipped agent or a run directory, and ``key=value`` for the fields of its evaluation.

    Returns:
        0.

    Raises:
        CheckpointError: if there is no such agent, or its environment is not known.
        ConfigError: if a key or a value is not valid.

    Source: none.
    """
    parser = argparse.ArgumentParser(prog="sspl evaluate", description="Measure an agent on fresh data.")
    parser.add_argument("agent", help="name of a shipped agent, such as pendulum, or a run directory")
    parser.add_argument("overrides", nargs="*", metavar="key=value", help="fields of the evaluation, such as seed=7")
    parser.add_argument("--json", metavar="FILE", help="write the measurements there too")
    parser.add_argument("--device", default="cpu", help="device of the networks")
    options = parser.parse_args(words)
    result = evaluate_agent(options.agent, options.overrides, device=options.device)
    for name, m in result.measurements.items():
        value = "not measured" if m.value is None else f"{m.value:.6g}"
        size = "" if m.n is None else f"  n={m.n}"
        bounds = "" if m.lower is None or m.upper is None else f"  95 % bounds {m.lower:.3g} to {m.upper:.3g}"
        print(f"{name:<32} {value:>12} {m.unit}{size}{bounds}")
    if options.json:
        Path(options.json).write_text(json.dumps(result.to_dict(), indent=1, sort_keys=True) + "\n")
    return 0


def evaluate_agent(name_or_path: str, overrides: Sequence[str] = (), *, device: str = "cpu") -> Any:
    """Measure a shipped agent or the agent of a run directory on its own environment.

    Args:
        name_or_path: as for ``torchrl_sspl.load``.
        overrides: ``key=value`` for the fields of the evaluation: ``EvaluationConfig`` for agents of the rounds,
            ``EpisodesConfig`` for those of ``SSPLTrainer``.
        device: device of the networks.

    Returns:
        The measurements.

    Raises:
        CheckpointError: if there is no such agent, or its environment is not known.
        ConfigError: if a key or a value is not valid.

    Source: none.
    """
    from torchrl_sspl.modules.agent import DESCRIPTION_FILE, ENCODERS, agent_directory, load
    from torchrl_sspl.trainers.config import EvaluationConfig, _assign
    from torchrl_sspl.trainers.experiment_config import EnvFactory, EpisodesConfig, resolve

    directory = agent_directory(name_or_path)
    try:
        body = json.loads((directory / DESCRIPTION_FILE).read_text())
    except json.JSONDecodeError as error:
        raise CheckpointError(f"expected a readable {DESCRIPTION_FILE} in '{directory}', received {error}") from error
    experiment = body.get("experiment")
    own_encoder = ((experiment or {}).get("network") or {}).get("encoder")
    if own_encoder:
        ENCODERS[body["networks"]["encoder"]["class"]] = resolve(own_encoder)
    agent = load(directory, device)
    values: dict[str, str] = {}
    for item in overrides:
        key, sign, value = item.partition("=")
        if not sign:
            raise ConfigError(f"expected an argument of the form key=value, received '{item}'; e.g. seed=7")
        values[key] = value
    config: Any = EpisodesConfig(**experiment["evaluation"]) if experiment else EvaluationConfig()
    if not experiment and body.get("training", {}).get("evaluation"):
        known = {f.name for f in dataclasses.fields(EvaluationConfig)}  # another version may have had others
        config = EvaluationConfig(**{k: v for k, v in body["training"]["evaluation"].items() if k in known})
    for key, value in values.items():
        _assign(config, key, value)
    if experiment:
        from torchrl_sspl.trainers.episodes import evaluate_episodes

        if "_target_" not in (experiment.get("env") or {}):
            raise CheckpointError(
                f"expected the agent in '{directory}' to name its environment, found none: it was given in code; call "
                "evaluate_episodes(agent, make_env) there"
            )
        return evaluate_episodes(agent, EnvFactory(experiment["env"]), config)
    from torchrl_sspl.envs import DubinsEnv, PendulumEnv
    from torchrl_sspl.trainers.evaluation import evaluate as measure
    from torchrl_sspl.trainers.quadruped import evaluate_dubins

    measures = {"PendulumEnv": (PendulumEnv, measure), "DubinsEnv": (DubinsEnv, evaluate_dubins)}
    named = body.get("environment", "PendulumEnv")
    if named not in measures:
        raise CheckpointError(
            f"expected the agent in '{directory}' to be trained on one of {', '.join(measures)}, found '{named}'; "
            "call evaluate(agent, env) in your own code"
        )
    make, judge = measures[named]
    env = make(batch_size=[1], seed=config.seed)
    return judge(agent, env, config, progress=sys.stderr.isatty())


def verify(words: list[str]) -> int:
    """``sspl verify``: check the certificates of an agent again.

    Args:
        words: name of a shipped agent or a run directory.

    Returns:
        0 if everything that is claimed holds, else 1.

    Raises:
        CheckpointError: if there is no such agent.

    Source: none.
    """
    parser = argparse.ArgumentParser(prog="sspl verify", description="Check the certificates of an agent again.")
    parser.add_argument("agent", help="name of a shipped agent, such as pendulum, or a run directory")
    options = parser.parse_args(words)
    from torchrl_sspl.trainers.certify import verify_run

    return int(verify_run(options.agent))


if __name__ == "__main__":
    sys.exit(main())
