"""For main functions of your own under Hydra: the same schema and files in its ConfigStore. Nothing else needs Hydra."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

from omegaconf import OmegaConf
from omegaconf.errors import OmegaConfBaseException

from torchrl_sspl.configs.reader import FOLDER, from_dict
from torchrl_sspl.configs.schema import _CHOICES, Config
from torchrl_sspl.errors import ConfigError, MissingDependencyError

CONFIG_NAME = "sspl"


@dataclass
class HydraConfig(Config):
    """The configuration with a list of files in their order, as Hydra wants it; see ``Config``."""

    defaults: list[Any] = field(
        default_factory=lambda: [
            "_self_", {"env": "none"}, {"preset": "sound"}, {"optional both": "${env}.${preset}"},
            {"loss": "as_preset"}, {"logger": "csv"},
        ]
    )  # fmt: skip


def register() -> None:
    """Put the configuration into Hydra's ConfigStore: ``sspl``, with the groups env, preset, loss and logger.

    Raises MissingDependencyError if Hydra is not installed. Source: none.
    """
    try:
        from hydra.core.config_store import ConfigStore
    except ImportError as error:
        raise MissingDependencyError("expected Hydra, found none; run `pip install 'torchrl-sspl[hydra]'`, or call compose()") from error
    store = ConfigStore.instance()
    store.store(name=CONFIG_NAME, node=HydraConfig)
    store.store(group="env", name="none", node={}, package="_global_")
    for path in sorted((FOLDER / "env").glob("*.yaml")):
        group = "both" if "." in path.stem else "env"
        store.store(group=group, name=path.stem, node=OmegaConf.load(path), package="_global_")
    for path in sorted((FOLDER / "preset").glob("*.yaml")):
        node = OmegaConf.merge({"preset": path.stem}, OmegaConf.load(path))
        store.store(group="preset", name=path.stem, node=node, package="_global_")
    store.store(group="loss", name="as_preset", node={})
    for section, key in (("loss", "preset"), ("logger", "kind")):
        for name in _CHOICES[f"{section}.{key}"]:
            store.store(group=section, name=name, node={key: name})


def to_config(node: Any) -> Config:
    """The configuration that Hydra hands to a main function, checked, as dataclasses.

    Raises ConfigError if a key is unknown, or values do not go together. Source: none.
    """
    try:
        values = OmegaConf.to_container(node, resolve=True)
    except OmegaConfBaseException as error:
        raise ConfigError(f"expected values that can be read, received: {str(error).splitlines()[0]}") from error
    return from_dict(values)  # type: ignore[arg-type]


__all__ = ["CONFIG_NAME", "register", "to_config"]
