"""Hydra: the configurations as groups of its ConfigStore. Nothing else of the library needs Hydra."""

from __future__ import annotations

import dataclasses
import difflib
import inspect
import re
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from typing import Any

from torchrl_sspl.errors import ConfigError, MissingDependencyError
from torchrl_sspl.trainers.config import PRESETS, TrainingConfig, make_config
from torchrl_sspl.trainers.experiment_config import (
    CSVConfig,
    DubinsEnvConfig,
    ExperimentConfig,
    GymnasiumEnvConfig,
    LossConfig,
    NoLoggerConfig,
    PendulumEnvConfig,
    TensorboardConfig,
    TrainerConfig,
    WandbConfig,
)

CONFIG_NAME = "sspl"

#: Groups, and what can be chosen in each; the first choice is the default.
GROUPS: dict[str, dict[str, Any]] = {
    "env": {"pendulum": PendulumEnvConfig(), "dubins": DubinsEnvConfig(), "gymnasium": GymnasiumEnvConfig()},
    "loss": {"sound": LossConfig(), "paper": LossConfig(preset="paper")},
    "trainer": {
        "sspl": TrainerConfig(),
        **{"rounds" if p == "sound" else f"rounds_{p}": make_config([f"preset={p}"]) for p in PRESETS},
    },
    "logger": {
        "csv": CSVConfig(),
        "wandb": WandbConfig(),
        "tensorboard": TensorboardConfig(),
        "none": NoLoggerConfig(),
    },
}


@dataclass
class HydraConfig(ExperimentConfig):
    """An experiment with a list of defaults, as Hydra wants it; see ``ExperimentConfig``.

    Attributes:
        defaults: default choice of every group.
    """

    defaults: list[Any] = field(
        default_factory=lambda: [*({group: next(iter(choices))} for group, choices in GROUPS.items()), "_self_"]
    )


def register() -> None:
    """Put the configurations into Hydra's ConfigStore: ``sspl``, and the groups env, loss, trainer, logger.

    Raises:
        MissingDependencyError: if Hydra is not installed.

    Source: none.
    """
    try:
        from hydra.core.config_store import ConfigStore
        from omegaconf import MISSING
    except ImportError as error:
        raise MissingDependencyError(
            "expected Hydra, found none; run `pip install 'torchrl-sspl[hydra]'`. The examples and make_config need none."
        ) from error
    store = ConfigStore.instance()
    # The groups fill these in.
    store.store(name=CONFIG_NAME, node=HydraConfig(**dict.fromkeys(GROUPS, MISSING)))  # type: ignore[arg-type]
    for group, choices in GROUPS.items():
        for name, node in choices.items():
            store.store(group=group, name=name, node=node)


def compose(overrides: Sequence[str] = ()) -> ExperimentConfig:
    """The configuration that Hydra composes from overrides.

    Args:
        overrides: such as ``"env=pendulum"`` or ``"trainer.total_frames=2000"``, in Hydra's own language.

    Returns:
        The configuration, as dataclasses.

    Raises:
        ConfigError: if a key or a choice is unknown (the valid ones are listed), or a value does not fit.
        MissingDependencyError: if Hydra is not installed.

    Source: none.
    """
    register()
    from hydra import compose as hydra_compose
    from hydra import initialize
    from hydra.core.global_hydra import GlobalHydra
    from hydra.errors import HydraException
    from omegaconf import OmegaConf
    from omegaconf.errors import OmegaConfBaseException

    check_keys(overrides)
    try:
        if GlobalHydra.instance().is_initialized():
            node = hydra_compose(CONFIG_NAME, overrides=list(overrides))
        else:
            with initialize(config_path=None, version_base="1.3"):
                node = hydra_compose(CONFIG_NAME, overrides=list(overrides))
        return to_config(OmegaConf.to_object(node))
    except (HydraException, OmegaConfBaseException, ValueError) as error:
        if isinstance(error, ConfigError):
            raise
        cause: BaseException = error.__cause__ or error
        text = re.sub(r"\s+", " ", str(cause)).strip()
        raise ConfigError(f"expected values that fit their keys, received: {text}") from error


def to_config(node: Any) -> ExperimentConfig:
    """An ``ExperimentConfig`` from what Hydra hands to a main function.

    Args:
        node: the composed configuration, as OmegaConf node or as object.

    Returns:
        The configuration, checked.

    Raises:
        ConfigError: if values do not go together.
        MissingDependencyError: if Hydra is not installed.

    Source: none.
    """
    if not isinstance(node, ExperimentConfig):
        try:
            from omegaconf import OmegaConf
        except ImportError as error:
            raise MissingDependencyError("expected OmegaConf, found none; run `pip install 'torchrl-sspl[hydra]'`") from error
        node = OmegaConf.to_object(node)
    values = {f.name: getattr(node, f.name) for f in dataclasses.fields(ExperimentConfig)}
    config = ExperimentConfig(**values)
    if isinstance(config.trainer, TrainingConfig):
        _check_rounds(config)
    return config.check()


def _check_rounds(config: ExperimentConfig) -> None:
    """The rounds have networks, data and evaluation of their own; what they would ignore is refused."""
    rounds: TrainingConfig = config.trainer
    plain = ExperimentConfig()
    for name in ("network", "loss", "collector", "buffer", "optim", "synthesis", "evaluation"):
        if getattr(config, name) != getattr(plain, name):
            inside = f"trainer.{name}" if hasattr(rounds, name) else "trainer.representation and trainer.synthesis"
            raise ConfigError(
                f"expected no setting of {name} with trainer=rounds, received one; use {inside}, or choose trainer=sspl"
            )
    for name in ("seed", "device", "out_dir"):  # one place for both kinds of training
        if getattr(config, name) != getattr(plain, name):
            setattr(rounds, name, getattr(config, name))


def check_keys(overrides: Sequence[str]) -> None:
    """Look at the keys of overrides before Hydra does, and name the valid ones.

    Args:
        overrides: ``key=value`` strings; ``+key``, ``++key`` and ``~key`` are left to Hydra.

    Raises:
        ConfigError: if an argument is not ``key=value``, or a key or the choice of a group is unknown.

    Source: none.

    Example:
        >>> check_keys(["env=pendulum", "trainer.total_frames=2000"])
    """
    chosen = {group: next(iter(choices)) for group, choices in GROUPS.items()}
    plain: list[str] = []
    for item in overrides:
        key, sign, value = item.partition("=")
        if key.startswith(("+", "~", "hydra.")):
            continue
        if not sign or not key:
            raise ConfigError(f"expected an argument of the form key=value, received '{item}'; e.g. env=pendulum seed=1")
        if key in GROUPS:
            if value not in GROUPS[key]:
                raise ConfigError(f"expected {key} to be one of {', '.join(GROUPS[key])}, received '{value}'")
            chosen[key] = value
        else:
            plain.append(key)
    valid = [key for key, *_ in fields(chosen)]
    for key in plain:
        if key not in valid:
            close = difflib.get_close_matches(key, valid, n=3)
            hint = f"did you mean {' or '.join(close)}? " if close else ""
            raise ConfigError(f"expected a valid key, received '{key}'; {hint}valid keys: {', '.join(valid)}")


def fields(chosen: dict[str, str] | None = None) -> Iterator[tuple[str, str, Any, str]]:
    """Key, type, default and meaning of every field, for the given choice in every group.

    Args:
        chosen: choice by group; the default ones where missing.

    Yields:
        ``(key, type, default, meaning)``.

    Source: none.

    Example:
        >>> next(fields({"env": "pendulum"}))[:3]
        ('env.image_size', 'int', 64)
    """
    config = ExperimentConfig()
    for group, choices in GROUPS.items():
        setattr(config, group, choices[(chosen or {}).get(group, next(iter(choices)))])
    yield from _fields(config, "")


def _fields(config: Any, prefix: str) -> Iterator[tuple[str, str, Any, str]]:
    meaning = attribute_texts(type(config))
    for item in dataclasses.fields(config):
        value = getattr(config, item.name)
        if dataclasses.is_dataclass(value):
            yield from _fields(value, f"{prefix}{item.name}.")
        elif item.name != "_target_":
            kind = item.type if isinstance(item.type, str) else getattr(item.type, "__name__", str(item.type))
            yield prefix + item.name, kind, value, meaning.get(item.name, "")


def attribute_texts(kind: type) -> dict[str, str]:
    """Meaning of the fields of a dataclass, from the section "Attributes" of its docstring.

    Args:
        kind: documented dataclass.

    Returns:
        Text by field.

    Source: none.

    Example:
        >>> attribute_texts(LossConfig)["safety_margin"]
        'margin of the hinges on S and U.'
    """
    texts: dict[str, str] = {}
    for parent in kind.__bases__:
        texts |= attribute_texts(parent)
    _, _, section = (inspect.getdoc(kind) or "").partition("Attributes:\n")
    name = ""
    for line in section.splitlines():
        if match := re.match(r" {4}(\w+): (.*)", line):
            name = match[1]
            texts[name] = match[2].strip()
        elif name and line.startswith(" " * 8):
            texts[name] += " " + line.strip()
        elif line.strip():
            break
    return texts


def help_text(overrides: Sequence[str] = ()) -> str:
    """Groups, choices and every field with type, default and meaning.

    Args:
        overrides: choices of groups, such as ``"env=gymnasium"``; the fields shown are those of the choices.

    Returns:
        The text.

    Source: none.
    """
    chosen = {
        k: v for k, _, v in (item.partition("=") for item in overrides) if k in GROUPS and v in GROUPS[k]
    }
    lines = ["groups (the first choice is the default):"]
    lines += [f"  {group}={' | '.join(choices)}" for group, choices in GROUPS.items()]
    lines += ["", "fields:"]
    rows = list(fields(chosen))
    width = max(len(key) for key, *_ in rows) + 2
    for key, kind, value, meaning in rows:
        lines.append(f"  {key:<{width}} {meaning} ({kind}, {value!r})")
    return "\n".join(lines)
