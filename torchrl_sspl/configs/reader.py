"""The one reader of configurations: presets are files, changes are ``key=value``; OmegaConf parses and checks types."""

from __future__ import annotations

import collections.abc
import dataclasses
import difflib
import importlib
import inspect
import json
import math
import operator
import os
import re
import sys
import types
from collections.abc import Callable, Iterator, Mapping, Sequence
from functools import cache
from pathlib import Path
from typing import Any, Union, get_args, get_origin, get_type_hints

import yaml
from omegaconf import OmegaConf
from omegaconf.errors import OmegaConfBaseException

from torchrl_sspl.configs.schema import _CHOICES, PRESETS, Config
from torchrl_sspl.errors import ConfigError, MissingDependencyError
from torchrl_sspl.files import write

FOLDER = Path(__file__).parent
#: Systems with recommended settings: the files of the folder "env".
ENVS = tuple(sorted(p.stem for p in (FOLDER / "env").glob("*.yaml") if "." not in p.stem))
_SHORT = {"logger": "logger.kind", "loss": "loss.preset"}
_GIVEN = ("batch_size", "seed", "device", "self")  # arguments of an environment that the trainer sets
_NOTHING = ("none", "null")
_TOP = get_type_hints(Config)
_HINTS = {section: get_type_hints(kind) for section, kind in _TOP.items() if dataclasses.is_dataclass(kind)}


def compose(overrides: Sequence[str] = (), **defaults: Any) -> Config:
    """Configuration of a system and a preset with changes.

    The dataclasses' defaults <- ``env/<env>.yaml`` <- ``preset/<preset>.yaml`` <- ``env/<env>.<preset>.yaml`` where it
    exists <- ``defaults`` <- ``overrides``. A file of your own may name its preset (``preset: quick``).

    Args:
        overrides: strings such as ``"env=pendulum"``, ``"seed=3"`` or ``"network.policy_hidden=[32,32]"``; ``env=`` also
            takes the path of a file of your own. ``logger=wandb`` is short for ``logger.kind=wandb``, ``loss=paper``
            for ``loss.preset=paper``; ``null`` and ``none`` are the same.
        **defaults: values of the caller (nested keys with a dot need ``**{"a.b": v}``).

    Returns the configuration, checked. Without ``env=`` its ``env`` is empty: for a system that is given in code.
    Raises ConfigError if an override is not ``key=value``, a key is unknown (the nearest valid ones are named), or a
    value has the wrong type or does not go with the others. Source: none.

    Example:
        >>> config = compose(["env=pendulum", "seed=3", "synthesis.rounds=1"], out_dir="runs/a")
        >>> config.seed, config.synthesis.rounds, config.out_dir, config.env["image_size"]
        (3, 1, 'runs/a', 64)
    """
    given = {**_flat(defaults), **parse(overrides)}
    env = given.pop("env", None)
    own = {} if env is None else _file(_env_file(env))
    preset = given.pop("preset", own.get("preset", "sound"))
    if preset not in PRESETS:
        raise ConfigError(f"expected preset to be one of {', '.join(PRESETS)}, received '{preset}'")
    layers: list[Mapping[str, Any]] = [own, _file(FOLDER / "preset" / f"{preset}.yaml")]
    if (both := FOLDER / "env" / f"{env}.{preset}.yaml").is_file():
        layers.append(_file(both))
    return _build([*layers, {"preset": preset}, given], free=len(layers))


def parse(overrides: Sequence[str]) -> dict[str, str]:
    """Values, as text, by key of ``key=value`` strings; the last one wins.

    Raises ConfigError if ``overrides`` is not a list of such strings. Source: none.

    Example:
        >>> parse(["seed=3", "logger=none"])
        {'seed': '3', 'logger.kind': 'none'}
    """
    if isinstance(overrides, (str, bytes, Mapping)) or not all(isinstance(item, str) for item in overrides):
        raise ConfigError(
            f"overrides: expected a list of key=value strings such as ['seed=1'], received {overrides!r:.60} "
            f"({type(overrides).__name__})"
        )
    pairs: dict[str, str] = {}
    for item in overrides:
        key, sign, value = (part.strip() for part in item.partition("="))
        if key[:1] in ("+", "~"):
            raise _unknown(key, valid_keys(Config()), "keys cannot be added or removed, only changed: key=value")
        if not sign or not key or key.startswith("-"):
            raise ConfigError(f"expected an argument of the form key=value, received '{item}'; e.g. seed=1 out_dir=runs/a")
        pairs[_SHORT.get(key, key)] = value
    return pairs


def from_dict(values: Mapping[str, Any]) -> Config:
    """Checked configuration from a nested dictionary of all values, or of those that differ from the defaults.

    Raises ConfigError if a key is unknown or a value has the wrong type. Source: none.

    Example:
        >>> from_dict({"network": {"latent_dim": 4}}).network.latent_dim
        4
    """
    if not isinstance(values, Mapping):
        raise ConfigError(f"expected an object of settings, received a {type(values).__name__}")
    return _build([_flat(values)], free=1)


def _build(layers: Sequence[Mapping[str, Any]], free: int) -> Config:
    """The layers on top of each other; the environment of the first ``free`` ones, files, is taken as it is."""
    node = OmegaConf.structured(Config)
    for number, layer in enumerate(layers):
        own = number >= free and any(key.startswith("env.") for key in layer)
        if own and "env._target_" in layer:  # decides which other keys there are
            _set(node, "env._target_", layer["env._target_"], str)
            takes = {"_target_": str, **_parameters(node.env)}  # what a file says and the other target does not take goes
            OmegaConf.update(node, "env", {k: v for k, v in node.env.items() if k in takes or "**" in takes}, merge=False)
        env = OmegaConf.to_container(node.env)
        for key, value in layer.items():
            if key.startswith("env.") and not own:
                OmegaConf.update(node, key, value, merge=False)
            else:
                _set(node, key, value, _kind_of(key, env))
        if own:
            _check_env(OmegaConf.to_container(node.env))
    try:
        config = OmegaConf.to_object(node)
    except OmegaConfBaseException as error:
        text = str(error).splitlines()[0]
        raise ConfigError(f"expected {error.full_key} to be a value, or ${{key}} of one, received: {text}") from error
    assert isinstance(config, Config)
    return config.check()


def _set(node: Any, key: str, given: Any, kind: Any) -> None:
    """Assign a value of the declared type; text is parsed as YAML where no text is wanted."""
    if kind is None:
        raise _unknown(key, valid_keys(OmegaConf.to_object(node)))  # type: ignore[arg-type]
    try:
        value = OmegaConf.to_container(OmegaConf.structured(_cell(kind)(_read(key, given, kind))))["value"]  # type: ignore[index, call-overload]
        if isinstance(value, float) and math.isnan(value):
            raise ValueError("not a number")
        OmegaConf.update(node, key, value, merge=False)
    except (OmegaConfBaseException, yaml.YAMLError, ValueError, AssertionError, TypeError) as error:
        several = isinstance(given, str) and "," in given and get_origin(_plain(kind)[0]) is not list
        more = "; `sspl train --multirun` runs each of several values" if several else ""
        raise ConfigError(f"expected {key} to be {_name(kind)}, received {given!r:.80}{more}") from error


@cache
def _cell(kind: Any) -> Any:
    """Class that holds one value of a kind, made once: there are few kinds and many values."""
    return dataclasses.make_dataclass("Cell", [("value", kind)])


def _read(key: str, given: Any, kind: Any) -> Any:
    plain, optional = _plain(kind)
    nothing = given is None or (isinstance(given, str) and given.strip().lower() in _NOTHING)
    if nothing and "none" in _CHOICES.get(key, ()):
        return "none"
    if nothing and (optional or plain is Any):
        return None
    if plain is str:
        if nothing:
            raise ValueError("nothing")
        text = os.fspath(given) if isinstance(given, os.PathLike) else given
        return text[1:-1] if isinstance(text, str) and re.fullmatch(r"(['\"]).*\1", text) else text
    value = given
    if isinstance(given, str):
        value = OmegaConf.to_container(OmegaConf.from_dotlist([f"value={given.strip()}"]))["value"]  # type: ignore[index, call-overload]
        if value is None and plain is not Any:
            raise ValueError("empty")
        value = "" if value is None else value
    if isinstance(value, tuple):
        value = list(value)
    if plain is int and isinstance(value, float) and value.is_integer():
        value = int(value)
    if plain is bool and not isinstance(value, (bool, str)) and value not in (0, 1):
        raise ValueError("not a truth value")
    return value


def _plain(kind: Any) -> tuple[Any, bool]:
    """A type without None, and whether None was among its choices."""
    if get_origin(kind) in (Union, types.UnionType):
        rest = [k for k in get_args(kind) if k is not type(None)]
        return (rest[0] if len(rest) == 1 else Any), len(rest) < len(get_args(kind))
    return kind, False


def _name(kind: Any) -> str:
    plain, optional = _plain(kind)
    words = {int: "an integer", float: "a number", bool: "true or false", str: "text"}
    text = words.get(plain) or (f"a list of {words.get(get_args(plain)[0], 'values')}" if get_origin(plain) is list else "a value")
    return text.replace("of a number", "of numbers").replace("of an integer", "of integers") + (" or null" if optional else "")


def _kind_of(key: str, env: Any) -> Any:
    """Declared type of a key; None where there is no such key."""
    section, _, name = key.partition(".")
    if section == "env" and name:
        if name == "_target_" or "_target_" not in env:
            return str if name == "_target_" else Any
        return _parameters(env).get(name.partition(".")[0], (Any,))[0]
    if section in _HINTS:
        return _HINTS[section].get(name)
    return _TOP.get(key) if key != "env" else None


def _unknown(key: str, valid: Sequence[str], more: str = "") -> ConfigError:
    bare = key.lstrip("+~").partition("=")[0]

    def likeness(other: str) -> float:
        pairs = ((bare, other), (bare.rpartition(".")[2], other.rpartition(".")[2]))
        return sum(difflib.SequenceMatcher(None, *pair).ratio() for pair in pairs)

    inside = [k for k in valid if k.startswith(f"{bare}.")]  # a section where one of its keys is meant
    nearest = inside[:5] or sorted(valid, key=likeness, reverse=True)[:5]
    tail = f"; {more}" if more else ""
    if bare.startswith("env.") and not any(k.startswith("env.") and k != "env._target_" for k in valid):
        tail += f"; choose a system first: env={'|'.join(ENVS)}, or env._target_=package.module:Env"
    return ConfigError(f"expected a valid key, received '{key}'; the nearest are {', '.join(nearest)}{tail}")


def _flat(values: Mapping[str, Any]) -> dict[str, Any]:
    """Nested sections as keys with a dot; what stands in ``env`` is not taken apart further."""
    flat: dict[str, Any] = {}
    for key, value in values.items():
        if isinstance(value, Mapping) and (key == "env" or key in _HINTS):
            flat |= {f"{key}.{name}": v for name, v in value.items()}
        else:
            flat[_SHORT.get(key, key)] = value
    return flat


def _env_file(env: Any) -> Path:
    if isinstance(env, str) and env in ENVS:
        return FOLDER / "env" / f"{env}.yaml"
    if isinstance(env, (str, os.PathLike)) and Path(env).suffix in (".yaml", ".yml") and Path(env).is_file():
        return Path(env)
    raise ConfigError(f"expected env to be one of {', '.join(ENVS)}, or an existing .yaml file, received '{env}'")


def _file(path: Path) -> dict[str, Any]:
    try:
        values = OmegaConf.to_container(OmegaConf.load(path))
    except (OSError, yaml.YAMLError, UnicodeDecodeError, OmegaConfBaseException) as error:
        raise ConfigError(f"expected a readable configuration at '{path}', received {' '.join(str(error).split())}") from error
    if not isinstance(values, Mapping):
        raise ConfigError(f"expected an object of settings at '{path}', received a {type(values).__name__}")
    return _flat({str(k): v for k, v in values.items()})


def save(config: Config, path: str | Path) -> Path:
    """Write a configuration, as YAML or JSON by the ending of the file, which is replaced in one step and returned."""
    path = Path(path)
    body = config.to_dict()
    text = json.dumps(body, indent=1) + "\n" if path.suffix == ".json" else OmegaConf.to_yaml(OmegaConf.create(body))
    return write(path, text)


def load(path: str | Path) -> Config:
    """Read and check a configuration that :func:`save` has written.

    Raises ConfigError if the file cannot be read, a key is unknown or a value has
    the wrong type. Source: none.

    Example:
        >>> import tempfile
        >>> with tempfile.NamedTemporaryFile(suffix=".json") as file:
        ...     load(save(compose(["seed=3"]), file.name)).seed
        3
    """
    return from_dict(_file(Path(path)))


def change(config: Config, overrides: Sequence[str]) -> Config:
    """Another configuration with ``key=value`` changes, checked as :func:`compose` does. Source: none.

    Example:
        >>> change(compose(["seed=3"]), ["evaluation.episodes=5"]).evaluation.episodes
        5
    """
    return _build([_flat(config.to_dict()), parse(overrides)], free=1)


def valid_keys(config: Config) -> list[str]:
    """All keys of a configuration, such as ``"network.latent_dim"``, those of its environment by what that takes."""
    keys = [*(name for name in _TOP if name not in _HINTS and name != "env"), "env._target_"]
    keys += [f"{section}.{name}" for section, hints in _HINTS.items() for name in hints]
    try:
        own: Mapping[str, Any] = _parameters(config.env) if "_target_" in config.env else {}
    except ConfigError:
        own = {}
    return keys + [f"env.{name}" for name in {**config.env, **own} if name not in ("_target_", "**")]


def fields(config: Config | None = None) -> Iterator[tuple[str, str, Any, str]]:
    """Key, type, value and meaning of every field; without a configuration, of no system. Source: none.

    Example:
        >>> next(fields())[:3]
        ('preset', 'str', 'sound')
    """
    config = config or Config()
    for item in dataclasses.fields(config):
        value = getattr(config, item.name)
        if item.name == "env":
            takes = {"_target_": (str, None), **(_parameters(value) if "_target_" in value else {})}
            texts = attribute_texts(resolve(value["_target_"])) if "_target_" in value else {}
            texts["_target_"] = "import path of what is built, called with the other keys, batch_size and seed."
            for name in dict.fromkeys([*takes, *value]):
                kind, default = takes.get(name, (type(value.get(name)), None))
                if name != "**":
                    yield f"env.{name}", _hint(kind), value.get(name, default), texts.get(name, "")
        elif dataclasses.is_dataclass(value):
            for inner in dataclasses.fields(value):
                yield f"{item.name}.{inner.name}", _hint(inner.type), getattr(value, inner.name), inner.metadata["meaning"]
        else:
            yield item.name, _hint(item.type), value, item.metadata["meaning"]


def _hint(kind: Any) -> str:
    return kind if isinstance(kind, str) else kind.__name__ if isinstance(kind, type) and not get_args(kind) else str(kind)


def attribute_texts(kind: Any) -> dict[str, str]:
    """Meaning of attributes or arguments by name, from the section "Attributes" or "Args" of a docstring."""
    texts: dict[str, str] = {}
    section = re.split(r"^(?:Attributes|Args):\n", inspect.getdoc(kind) or "", maxsplit=1, flags=re.MULTILINE)
    names: list[str] = []
    for line in section[-1].splitlines() if len(section) > 1 else ():
        if match := re.match(r" {4}(\w+(?:, \w+)*)(?: \([^)]*\))?: (.*)", line):
            names = match[1].split(", ")
            texts |= dict.fromkeys(names, match[2].strip())
        elif names and line.startswith(" " * 8):
            texts |= {name: f"{texts[name]} {line.strip()}" for name in names}
        elif line.strip():
            break
    return texts


def resolve(path: str) -> Any:
    """What ``"package.module:name"`` or ``"package.module.name"`` names; the working directory is searched too.

    Raises ConfigError if there is no such module, or no such name in it. Source: none.

    Example:
        >>> resolve("torchrl_sspl.sets:SAFE")
        1
    """
    module, sign, name = str(path).partition(":")
    if not sign:
        module, _, name = str(path).rpartition(".")
    here = os.getcwd()
    sys.path.append(here)
    try:
        return operator.attrgetter(name)(importlib.import_module(module))
    except (ImportError, ValueError, AttributeError, SyntaxError) as error:
        raise ConfigError(
            f"expected an import path like package.module:name, received '{path}' ({type(error).__name__}: {error}); "
            "run from the folder that holds the module, or install it"
        ) from error
    finally:
        del sys.path[-1 - sys.path[::-1].index(here)]  # the last one: it may have been there before


def _parameters(env: Mapping[str, Any]) -> dict[str, tuple[Any, Any]]:
    """Type and default of what an environment's ``_target_`` takes, by name; "**" where it takes anything."""
    target = resolve(env["_target_"])
    called = target.__init__ if inspect.isclass(target) else target
    try:
        signature = inspect.signature(called)
    except (TypeError, ValueError) as error:
        raise ConfigError(f"expected env._target_ to be a class or function, received '{env['_target_']}'") from error
    try:
        hints = get_type_hints(called)
    except Exception:  # an annotation that only a type checker can read
        hints = {}
    kinds: dict[str, tuple[Any, Any]] = {}
    for name, p in signature.parameters.items():
        if p.kind is p.VAR_KEYWORD:
            kinds["**"] = (Any, None)
        elif p.kind is not p.VAR_POSITIONAL:
            kinds[name] = (_writable(hints.get(name, Any)), None if p.default is p.empty else p.default)
    missing = [name for name in ("batch_size", "seed") if name not in kinds and "**" not in kinds]
    if missing:
        raise ConfigError(
            f"expected env._target_ to take batch_size and seed, received '{env['_target_']}', which takes no {' and '.join(missing)}"
        )
    return {name: pair for name, pair in kinds.items() if name not in _GIVEN and pair[0] is not None}


def _writable(hint: Any) -> Any:
    """The type as OmegaConf checks it; Any where it cannot, None where no file can hold such a value."""
    plain, optional = _plain(hint)
    if get_origin(plain) in (list, tuple, collections.abc.Sequence):
        inner = next((k for k in get_args(plain) if k in (int, float, bool, str)), Any)
        plain = list[inner]  # type: ignore[valid-type]
    elif inspect.isclass(plain) and plain not in (int, float, bool, str):
        return Any if plain.__module__ in ("builtins", "pathlib", "collections.abc", "typing") else None
    elif plain not in (int, float, bool, str):
        return Any
    return plain | None if optional else plain


def _check_env(env: Any) -> None:
    """Refuse arguments that the environment does not take."""
    takes = _parameters(env) if "_target_" in env else {}
    for name in env:
        if name != "_target_" and name not in takes and "**" not in takes:
            target = env.get("_target_")
            valid = valid_keys(Config(env={"_target_": target} if target else {}))
            raise _unknown(f"env.{name}", valid, f"{target} does not take it" if target else "")


class EnvFactory:
    """Makes the environments of a section ``env``, an import path ``_target_`` and its arguments, here or elsewhere.

    Raises ConfigError if the target cannot be imported, or does not take these arguments. Source: none.

    Example:
        >>> EnvFactory(compose(["env=pendulum", "env.image_size=32"]).env)(batch_size=[2], seed=0).reset()["pixels"].shape
        torch.Size([2, 6, 32, 32])
    """

    def __init__(self, env: Mapping[str, Any]) -> None:
        self.options = dict(env)
        if "_target_" not in self.options:
            raise ConfigError(
                f"expected a system, received none: choose env={'|'.join(ENVS)}, or env._target_=package.module:Env"
            )
        _check_env(env)
        self.target = self.options.pop("_target_")

    def __call__(self, batch_size: Sequence[int], seed: int | None = None) -> Any:
        """An environment of ``batch_size`` systems."""
        return resolve(self.target)(batch_size=list(batch_size), seed=seed, **self.options)


def gymnasium_env(
    make: str,
    safe: str = "",
    unsafe: str = "",
    *,
    batch_size: Sequence[int] = (1,),
    image_size: int = 64,
    horizon: int | None = None,
    action_repeat: int = 1,
    settle: bool = True,
    ignore_termination: bool = False,
    reset_options: str | None = None,
    workers: int = 1,
    seed: int | None = None,
) -> Any:
    """Environment of gymnasium whose parts are named by import paths.

    Args:
        make: "package.module:function" that makes the environment, with render_mode="rgb_array"; or an id of gymnasium.
        safe: "package.module:function" of (observation, info), true in S.
        unsafe: "package.module:function" of (observation, info), true in U.
        batch_size: ``[n]`` environments.
        image_size: height and width of the frames, in pixels.
        horizon: steps after which an episode is truncated.
        action_repeat: steps of gymnasium per step, all with the same action, of a discrete one with a mixture of neighbours.
        settle: see ``GymnasiumPixels``.
        ignore_termination: let episodes go on where gymnasium ends them, up to the horizon.
        reset_options: "package.module:function" of a random generator that gives the options of a reset.
        workers: processes that step and draw the environments.
        seed: of the resets.

    Returns the environment. Raises ConfigError if a predicate is missing, a path cannot be imported or gymnasium has no such id;
    MissingDependencyError if it needs a package that is not installed. Source: none.
    """
    from torchrl_sspl.envs.gymnasium import GymnasiumPixels

    for name, path in (("safe", safe), ("unsafe", unsafe)):
        if not path:
            raise ConfigError(
                f"expected env.{name} to name a predicate of (observation, info), received none; "
                f"for instance env.{name}=my_system:{name}"
            )
    return GymnasiumPixels(
        _Make(make), safe=resolve(safe), unsafe=resolve(unsafe), batch_size=batch_size, image_size=image_size,
        horizon=horizon, reset_options=resolve(reset_options) if reset_options else None, action_repeat=action_repeat,
        settle=settle, ignore_termination=ignore_termination, workers=workers, seed=seed,
    )  # fmt: skip


class _Make:
    def __init__(self, path: str) -> None:
        self.path = path
        if self._own():
            resolve(path)

    def _own(self) -> bool:
        return ":" in self.path and self.path.partition(":")[2].isidentifier()

    def __call__(self) -> Any:
        if self._own():
            make: Callable[[], Any] = resolve(self.path)
            return make()
        import gymnasium

        try:
            return gymnasium.make(self.path, render_mode="rgb_array")
        except gymnasium.error.DependencyNotInstalled as error:
            raise MissingDependencyError(f"expected what gymnasium needs for env.make={self.path}, found less: {error}") from error
        except (gymnasium.error.Error, ModuleNotFoundError) as error:
            raise ConfigError(
                f"expected env.make to be an id of gymnasium, or package.module:function, received '{self.path}' "
                f"({type(error).__name__}: {error})"
            ) from error


__all__ = [
    "ENVS", "EnvFactory", "attribute_texts", "change", "compose", "fields", "from_dict", "gymnasium_env", "load", "parse",
    "resolve", "save", "valid_keys",
]  # fmt: skip
