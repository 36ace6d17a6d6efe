"""What all losses share: networks with delayed copies, latents of a batch, masks, reductions."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from functools import lru_cache
from typing import TYPE_CHECKING, Any
from weakref import WeakKeyDictionary

import torch
from tensordict import NestedKey, TensorDict, TensorDictBase, TensorDictParams
from tensordict.nn import TensorDictModule, TensorDictModuleBase
from tensordict.utils import unravel_key
from torch import Tensor, nn
from torch.compiler import is_compiling
from torchrl.objectives import LossModule

from torchrl_sspl.errors import ConfigError, DTypeError, ShapeError
from torchrl_sspl.modules.salad import as_tensordict_module, written

_REDUCTIONS = ("none", "mean", "sum")
_ABSENT: Any = None
_Leaf = tuple[dict[str, Any], str, Tensor]
_LEAVES: WeakKeyDictionary[LossModule, dict[str, list[_Leaf]]] = WeakKeyDictionary()


@dataclass
class LatentBatch:
    r"""A batch as the terms of the losses see it; what no active term needs may be missing.

    Attributes:
        latent: ``(*batch, p)`` online latent :math:`E_\theta(o_t)`.
        next_latent: ``(*batch, p)`` online :math:`E_\theta(o_{t+1})`.
        target_latent: ``(*batch, p)`` delayed :math:`E_{\theta^-}(o_t)`, no gradient.
        target_next_latent: ``(*batch, p)`` delayed :math:`E_{\theta^-}(o_{t+1})`, no gradient.
        action: ``(*batch, action_dim)`` in physical units.
        region: ``(*batch, 1)`` int64 region codes.
        user_action: ``(*batch, action_dim)`` action of the user's policy, or ``None`` for zero.
        valid: ``(*batch, 1)`` bool, rows that count, or ``None`` for all.
        weights: ``(*batch, 1)`` priority weights, or ``None``.
        residual: ``(*batch, p)`` error of the dynamics to add to predicted successors, or ``None``.
    """

    latent: Tensor
    next_latent: Tensor = _ABSENT
    target_latent: Tensor = _ABSENT
    target_next_latent: Tensor = _ABSENT
    action: Tensor = _ABSENT
    region: Tensor = _ABSENT
    user_action: Tensor | None = None
    valid: Tensor | None = None
    weights: Tensor | None = None
    residual: Tensor | None = None

    @property
    def shape(self) -> torch.Size:
        """Batch shape."""
        return self.latent.shape[:-1]


def _next(key: NestedKey) -> NestedKey:
    """The key of the same entry one step later."""
    return unravel_key(("next", key))


def _batch_last(tensor: Tensor, batch: torch.Size) -> Tensor:
    """``(*batch,)`` or ``(*batch, 1)`` -> ``(*batch, 1)``."""
    return tensor.unsqueeze(-1) if tensor.shape == batch else tensor


def _leaves(loss: LossModule, name: str, network: nn.Module) -> list[_Leaf]:
    """Where a network keeps its parameters and buffers, and what the loss has for them: mostly the very same."""
    known = _LEAVES.get(loss)
    if known is None or "_cache_leaves" not in loss.__dict__:  # TorchRL forgets what begins so when a loss is cast
        known, loss.__dict__["_cache_leaves"] = _LEAVES.setdefault(loss, {}), True
        known.clear()
    if name not in known:
        known[name] = []
        for key, value in getattr(loss, f"{name}_params").items(True, True):
            *path, leaf = (key,) if isinstance(key, str) else key
            owner = network.get_submodule(".".join(path))
            known[name].append((owner._parameters if leaf in owner._parameters else owner._buffers, leaf, value))
    return known[name]


def _forget(loss: Any, *_: Any) -> None:
    loss._erase_cache()


def _check_raised(loss: Any, name: str, value: Any) -> None:
    """A ConfigError for a weight whose term was left out and that is raised: it would change, and nothing else."""
    if name in loss.__dict__.get("_left_out", ()) and isinstance(value, (int, float, Tensor)) and (raised := float(value)) > 0:
        raise ConfigError(
            f"expected {name} > 0 when {type(loss).__name__} is made, if it is to be raised later, received 0 then and {raised:g} now: its term is not "
            f"computed. Make the loss with {name}={raised:g} and set it to 0 until it is wanted"
        )


def _check_loaded(loss: LossModule, state: dict[str, Any], prefix: str, *_: Any) -> None:
    for name in loss.__dict__.get("_left_out", ()):
        _check_raised(loss, name, state.get(prefix + name))


def _check_written(loss: LatentLoss) -> None:
    """As :func:`_check_raised`, of weights that were written into in place, ``loss.growth_coeff.copy_(0.5)``, since the last look."""
    held = [getattr(loss, name) for name in loss.__dict__.get("_left_out", ())]
    now = [(id(value), None if value.is_inference() else value._version) for value in held]
    if now != loss.__dict__.get("_looked_at"):
        for name, value in zip(loss.__dict__.get("_left_out", ()), held, strict=True):
            _check_raised(loss, name, value)
        loss.__dict__["_looked_at"] = now


def _meant(loss: LatentLoss, name: str, network: Any) -> NestedKey:
    """Which of the entries that a network writes is meant."""
    action = loss.tensor_keys.action  # its name may have been changed since
    return action if name in ("actor_network", "user_policy") and action in network.out_keys else loss._written[name]


def _called(name: str, network: Any, inputs: tuple[Tensor, ...], method: str | None, key: NestedKey) -> Tensor:
    """What a network gives, of several things the one with a key; a ShapeError if it is a barrier of another shape."""
    if method is not None:
        return getattr(network.module, method)(*inputs)
    output = network.module(*inputs) if type(network) is TensorDictModule else network(*inputs)
    if isinstance(output, tuple):
        output = output[network.out_keys.index(key)]
    if name == "barrier" and output.shape != (expected := (*inputs[0].shape[:-1], 1)):
        raise ShapeError(
            f"expected a barrier with one value for each latent, {expected}, received {tuple(output.shape)}; let it keep its last dimension of size 1"
        )
    return output


@lru_cache(maxsize=64)
def _worst_rows(fraction: float, rows: int, dtype: torch.dtype) -> int:
    """How many of all rows are the worst."""
    return int((fraction * torch.tensor(rows, dtype=dtype)).ceil().clamp_min(1.0))


def _same(held: Tensor | None, value: Tensor) -> bool:
    """Whether a network holds a parameter, or a buffer of the same memory."""
    return held is value or (held is not None and not value.requires_grad and held.data_ptr() == value.data_ptr())


def _valid(tensordict: TensorDictBase, masks: Iterable[NestedKey]) -> Tensor | None:
    """Rows ``(*batch, 1)`` that count by every mask that a batch holds, or ``None`` for all."""
    valid = None
    for key in masks:
        mask = tensordict.get(key, None)
        if mask is not None:
            mask = _batch_last(mask, tensordict.batch_size).bool()
            valid = mask if valid is None else valid & mask
    return valid


def _clean(value: Any, valid: Tensor | None) -> Any:
    """Zero in the rows that do not count: a masked NaN behind a network still poisons its gradients."""
    if value is None or valid is None or not value.is_floating_point():
        return value
    shape = valid.shape[:-1] + (1,) * (value.ndim - valid.ndim + 1)
    return torch.where(valid.reshape(shape), value, 0.0)


def trained_action(loss: LatentLoss, latent: Tensor) -> Tensor:
    """Actions of the policy in training; one that gets no gradient is a ConfigError."""
    action = loss._run("actor_network", latent)
    if action.requires_grad or not torch.is_grad_enabled() or is_compiling():
        return action
    if any(p.requires_grad for p in loss.actor_network_params.parameters()):
        raise ConfigError(
            "expected an actor whose actions carry a gradient to its weights, received one without (an argmax, or samples of a "
            "discrete distribution); give it a deterministic or reparameterised one: actions pass through the dynamics"
        )
    return action


def set_action_scale(loss: LatentLoss, action_scale: float | Sequence[float]) -> None:
    """Gives a loss the buffer ``action_scale``; a ConfigError for what is none."""
    scale = torch.as_tensor(action_scale, dtype=torch.get_default_dtype())
    if scale.ndim > 1 or not bool(((scale > 0) & scale.isfinite()).all()):
        raise ConfigError(f"expected action_scale > 0, a number or one per dimension, received {action_scale!r}")
    # Not in the state: it belongs to the environment.
    loss.register_buffer("action_scale", scale, persistent=False)


class LatentLoss(LossModule):
    r"""Base of the losses on latents; not used on its own.

    It keeps every network functional (parameters in ``<network>_params``, delayed copies :math:`\theta^-` in
    ``target_<network>_params`` where a term needs them), encodes batches, and reduces terms.

    Observations reach the networks in one of three forms:

    * the batch holds ``"frames"`` ``(*batch, 3, 3, H, W)``, frames t-1, t and t+1, and the encoder has
      a method ``sequence``: each frame is encoded once;
    * else ``"pixels"`` and ``("next", "pixels")`` are encoded;
    * without an encoder ``"latent"`` and ``("next", "latent")`` are read.

    Reductions treat a batch statistic as if every row had it, so that ``"sum"`` is always the number
    of counted rows times ``"mean"``. Rows that ``loss_mask_key`` marks invalid may hold NaN.

    Args:
        encoder: observation -> latent, or ``None`` if the batches hold latents.
        dynamics: (latent, action) -> next latent.
        barrier: latent -> barrier value.
        policy: latent -> action.
        delayed: names of the networks of which a delayed copy is kept for a target-network updater.
        safety_margin: :math:`\psi \ge 0`, in units of the barrier.
        dynamics_margin: :math:`\eta \ge 0`, in units of the barrier.
        worst_coeff: weight of the mean over the worst rows, added to the mean over all (0 is off).
        worst_fraction: share of rows that count as the worst.
        reduction: ``"none"``, ``"mean"`` or ``"sum"``; ``None`` is ``"mean"``.

    Raises:
        ConfigError: if an option is not valid; of a batch, if it lacks an entry.
        ShapeError: if action or region of a batch have the wrong shape.
        DTypeError: if the region codes of a batch are not int64.
    """

    @dataclass
    class _AcceptedKeys:
        """Keys that can be changed with ``set_keys``.

        Attributes:
            observation: observation that the encoder reads.
            frames: three successive frames, read in place of two observations where present.
            latent: latent, read where there is no encoder.
            action: action in physical units.
            region: region code, 0 unlabelled, 1 safe, 2 unsafe.
            user_action: action of the user's policy, in physical units.
            priority_weight: weights of prioritised sampling.
            residual: error of the dynamics to add to predicted successors, read where present.
        """

        observation: NestedKey = "pixels"
        frames: NestedKey = "frames"
        latent: NestedKey = "latent"
        action: NestedKey = "action"
        region: NestedKey = "region"
        user_action: NestedKey = "user_action"
        priority_weight: NestedKey = "priority_weight"
        residual: NestedKey = "residual"

    tensor_keys: _AcceptedKeys
    default_keys = _AcceptedKeys
    _schedulable_buffers = frozenset({"safety_margin", "dynamics_margin", "worst_coeff"})
    _reads: tuple[str, ...] = ()  # further keys
    _optional: frozenset[str] = frozenset({"worst_coeff"})  # weights whose terms are not computed where they are zero at first

    encoder: TensorDictModuleBase | None
    encoder_params: TensorDictParams
    target_encoder_params: TensorDictParams
    dynamics: TensorDictModuleBase
    dynamics_params: TensorDictParams
    target_dynamics_params: TensorDictParams
    barrier: TensorDictModuleBase
    barrier_params: TensorDictParams
    target_barrier_params: TensorDictParams
    actor_network: TensorDictModuleBase
    actor_network_params: TensorDictParams
    target_actor_network_params: TensorDictParams

    if TYPE_CHECKING:  # coefficients are buffers

        def __getattr__(self, name: str) -> Any: ...

    def __init__(
        self,
        *,
        encoder: nn.Module | None = None,
        dynamics: nn.Module | None = None,
        barrier: nn.Module | None = None,
        policy: nn.Module | None = None,
        delayed: Iterable[str] = (),
        safety_margin: float = 0.05,
        dynamics_margin: float = 0.0,
        worst_coeff: float = 0.0,
        worst_fraction: float = 0.05,
        reduction: str | None = None,
        **unknown: object,
    ) -> None:
        if unknown:
            raise ConfigError(
                f"expected options of {type(self).__name__} among {self.options()}, received {sorted(unknown)}"
            )
        super().__init__()
        self.register_load_state_dict_pre_hook(_check_loaded)
        self.register_load_state_dict_post_hook(_forget)
        self._in_keys: list[NestedKey] | None = None
        self._networks_used: list[str] = []
        self._written: dict[str, NestedKey] = {}  # of which entry of a network is meant
        self._needs: set[str] = set()
        self._active: set[str] = set()
        self.out_keys: list[str] = []
        self.reduction = "mean" if reduction is None else reduction
        if self.reduction not in _REDUCTIONS:
            raise ConfigError(f"expected reduction to be one of {_REDUCTIONS}, received {reduction!r}")
        if not 0.0 < worst_fraction <= 1.0:
            raise ConfigError(f"expected worst_fraction in (0, 1], received {worst_fraction}; for instance 0.05")
        self._coefficients(safety_margin=safety_margin, dynamics_margin=dynamics_margin, worst_coeff=worst_coeff)
        self.worst_fraction = float(worst_fraction)
        scales = [getattr(getattr(m, "module", m), "action_scale", None) for m in (dynamics, policy)]
        if all(isinstance(s, Tensor) for s in scales) and not torch.equal(*scales):  # type: ignore[arg-type]
            raise ConfigError(
                "expected one action_scale in dynamics and policy, received {} and {}; give both the largest action in "
                "physical units".format(*(s.tolist() for s in scales))  # type: ignore[union-attr]
            )
        keys = self.tensor_keys
        if encoder is not None:
            self._add("encoder", encoder, [keys.observation], [keys.latent], delayed)
            self.set_keys(observation=self.encoder.in_keys[0])  # type: ignore[union-attr]
        else:
            self.encoder = None
        if dynamics is not None:
            self._add("dynamics", dynamics, [keys.latent, keys.action], [_next(keys.latent)], delayed)
        if barrier is not None:
            self._add("barrier", barrier, [keys.latent], ["barrier"], delayed)
        if policy is not None:
            # TorchRL's trainers and weight synchronisation look for this name.
            self._add("actor_network", policy, [keys.latent], [keys.action], delayed)

    def __setattr__(self, name: str, value: Any) -> None:
        _check_raised(self, name, value)
        super().__setattr__(name, value)

    @classmethod
    def options(cls) -> list[str]:
        """Names of all keyword options of the loss, those of its bases included."""
        names: set[str] = set()
        for base in cls.__mro__:
            if issubclass(base, LatentLoss) and "__init__" in base.__dict__:
                names |= set(base.__init__.__kwdefaults__ or {})
        return sorted(names - {"delayed"})

    def _coefficients(self, **values: float) -> None:
        for name, value in values.items():
            if isinstance(value, bool) or not isinstance(value, (int, float)) or not 0.0 <= value < float("inf"):
                raise ConfigError(f"expected {name} to be a finite number >= 0, received {value!r}")
            self.register_coeff_buffer(name, float(value))
            if value > 0.0:
                self._active.add(name)
            elif any(name in base.__dict__.get("_optional", ()) for base in type(self).__mro__):
                self.__dict__.setdefault("_left_out", set()).add(name)

    def _add(
        self, name: str, module: nn.Module, reads: list[NestedKey], writes: list[NestedKey], delayed: Iterable[str] = ()
    ) -> None:
        network = as_tensordict_module(module, reads, writes)
        self._written[name] = written(network, writes[0])
        self.convert_to_functional(network, name, create_target_params=name in set(delayed))
        self._networks_used.append(name)

    def _forward_value_estimator_keys(self, **kwargs: object) -> None:
        self._in_keys = None

    def _set_in_keys(self) -> None:
        keys = self.tensor_keys
        source = keys.latent if self.encoder is None else keys.observation
        wanted = [
            (source, True),
            (keys.action, "action" in self._needs),
            (keys.region, "region" in self._needs),
            (_next(source), {"next_latent", "target_next_latent"} & self._needs),
            (keys.frames, self.encoder is not None),
            (keys.user_action, "user_action" in self._needs),
            (keys.residual, "residual" in self._needs),
            (keys.priority_weight, self.use_prioritized_weights),
        ]
        self._in_keys = [key for key, read in wanted if read] + [getattr(keys, name) for name in self._reads]

    @property
    def in_keys(self) -> list[NestedKey]:  # type: ignore[override]
        """Keys that the loss reads; frames, residual and weights are optional."""
        if self._in_keys is None:
            self._set_in_keys()
        assert self._in_keys is not None
        return self._in_keys

    @in_keys.setter
    def in_keys(self, keys: list[NestedKey]) -> None:
        self._in_keys = keys

    def select_out_keys(self, *out_keys: NestedKey) -> LatentLoss:
        """Restricts the output to some of its entries."""
        unknown = set(out_keys) - set(self.out_keys_source)
        if unknown:
            raise ConfigError(f"expected keys among {list(self.out_keys_source)}, received {sorted(unknown)}")
        # TensorDict's own selection takes a batch without optional entries for a keyword call, and fails.
        self._out_keys_apparent = list(out_keys)
        return self

    def reset_out_keys(self) -> LatentLoss:
        """Gives all entries of the output again."""
        self._out_keys_apparent = list(self.out_keys_source)  # there is no hook of TensorDict's to take away
        return self

    def _run(self, name: str, *inputs: Tensor, params: str = "online", method: str | None = None) -> Tensor:
        """Runs a network with ``online``, ``target`` or ``frozen`` (online, detached) parameters."""
        network = getattr(self, name)
        key = _meant(self, name, network)
        if params != "target" and not is_compiling():
            leaves = _leaves(self, name, network)
            if all(_same(where.get(leaf), value) for where, leaf, value in leaves):  # nothing has to be put into it
                if params == "online":
                    return _called(name, network, inputs, method, key)
                learnt = [found for found in leaves if found[2].requires_grad]
                try:
                    for where, leaf, value in learnt:
                        where[leaf] = value.data
                    return _called(name, network, inputs, method, key)
                finally:
                    for where, leaf, value in learnt:
                        where[leaf] = value
        values = getattr(self, f"target_{name}_params" if params == "target" else f"{name}_params")
        values = values.data if params == "frozen" else values
        # preserve_module_state=False keeps delayed copies from becoming trainable; the context manager
        # of to_module would leave the copies in the module, which is also the rollout policy, if the
        # body raised.
        swapped = values.to_module(network, preserve_module_state=False)
        try:
            return _called(name, network, inputs, method, key)
        finally:
            swapped.to_module(network, preserve_module_state=False, return_swap=False)

    def _get(self, tensordict: TensorDictBase, key: NestedKey, field: str) -> Tensor:
        value = tensordict.get(key, None)
        if value is None:
            if key == self.tensor_keys.observation and self.tensor_keys.frames in tensordict.keys(True, True):
                raise ConfigError(
                    f"expected the batch of {type(self).__name__} to hold {key!r}, received {self.tensor_keys.frames!r}, which only an encoder with a method "
                    "sequence reads; TransitionStore(capacity, pixel_views=True) hands out both, or give your encoder that method"
                )
            raise ConfigError(
                f"expected the batch of {type(self).__name__} to hold {key!r}, received the entries "
                f"{sorted(map(str, tensordict.keys(True, True)))}; collect it, or name yours with "
                f"set_keys({field}=...)"
            )
        return value

    def _counted(self, tensordict: TensorDictBase, key: NestedKey, field: str, batch: LatentBatch) -> Tensor:
        """An entry, zero in the rows that do not count."""
        return _clean(self._get(tensordict, key, field), batch.valid)

    def _encode(
        self, tensordict: TensorDictBase, valid: Tensor | None, now: bool, after: bool, params: str
    ) -> list[Tensor]:
        """Latents of the observation (``now``) and of the next one (``after``), those that are asked for."""
        keys = self.tensor_keys
        key, field = (keys.latent, "latent") if self.encoder is None else (keys.observation, "observation")
        if self.encoder is not None and hasattr(getattr(self.encoder, "module", None), "sequence"):
            frames = _clean(tensordict.get(keys.frames, None), valid)
            if frames is not None:
                used = frames.narrow(-4, 0 if now else 1, 3 if now and after else 2)
                return list(self._run("encoder", used, params=params, method="sequence").unbind(-2))
        wanted = [key] * now + [_next(key)] * after
        observed = [_clean(self._get(tensordict, key, field), valid) for key in wanted]
        if self.encoder is None:
            return observed if params == "online" else [latent.detach() for latent in observed]
        if len(observed) == 1:
            return [self._run("encoder", observed[0], params=params)]
        return list(self._run("encoder", torch.stack(observed), params=params).unbind(0))

    def _read(self, tensordict: TensorDictBase) -> LatentBatch:
        """Latents, action, labels and masks of a batch, as far as the active terms need them."""
        keys, needs = self.tensor_keys, self._needs
        if not is_compiling():
            _check_written(self)
        valid = _valid(tensordict, self._loss_mask_keys())
        latents = self._encode(tensordict, valid, True, "next_latent" in needs, "online")
        batch = LatentBatch(latents[0], valid=valid)
        if "residual" in needs:
            batch.residual = _clean(tensordict.get(keys.residual, None), valid)
        if "next_latent" in needs:
            batch.next_latent = latents[1]
        now, after = "target_latent" in needs, "target_next_latent" in needs
        if now or after:
            with torch.no_grad():
                latents = self._encode(tensordict, valid, now, after, "target")
            batch.target_latent = latents[0] if now else batch.target_latent
            batch.target_next_latent = latents[-1] if after else batch.target_next_latent
        if "action" in self._needs:
            batch.action = self._counted(tensordict, keys.action, "action", batch)
            if batch.action.shape[:-1] != batch.shape:
                raise ShapeError(
                    f"expected {keys.action!r} of shape (*{tuple(batch.shape)}, action_dim), received "
                    f"{tuple(batch.action.shape)}; a scalar action keeps its last dimension of size 1"
                )
            if not batch.action.is_floating_point() or (batch.action.dtype == torch.float64 and batch.latent.dtype != torch.float64):
                raise DTypeError(
                    f"expected {keys.action!r} of a dtype that the networks take, such as {torch.get_default_dtype()}, received {batch.action.dtype}; "
                    "convert it, for instance with DoubleToFloat in the environment"
                )
        if "region" in self._needs:
            batch.region = self._get(tensordict, keys.region, "region")
            if batch.region.dtype != torch.int64:
                raise DTypeError(
                    f"expected {keys.region!r} of dtype torch.int64 (0 unlabelled, 1 safe, 2 unsafe), "
                    f"received {batch.region.dtype}; use sets.label"
                )
            if not is_compiling() and batch.region.device.type == "cpu" and ((batch.region < 0) | (batch.region > 2)).any():
                codes = sorted({*batch.region.flatten().tolist()} - {0, 1, 2})
                raise ConfigError(f"expected region codes 0 unlabelled, 1 safe, 2 unsafe, received {codes[:5]}; use sets.label")
            if batch.region.shape != (*batch.shape, 1):
                raise ShapeError(
                    f"expected {keys.region!r} of shape {(*batch.shape, 1)}, received "
                    f"{tuple(batch.region.shape)}; use sets.label"
                )
        if self.use_prioritized_weights:
            weights = tensordict.get(keys.priority_weight, None)
            batch.weights = None if weights is None else _batch_last(weights, batch.shape)
        return batch

    @torch.no_grad()
    def latents(self, tensordict: TensorDictBase) -> tuple[Tensor, Tensor]:
        """Online latents ``(*batch, p)`` of the two steps of a batch of transitions, without gradient."""
        now, after = self._encode(tensordict, None, True, True, "online")
        return now, after

    @torch.no_grad()
    def predict(self, latent: Tensor, action: Tensor) -> Tensor:
        """Next latent ``(*batch, p)`` by the online dynamics, of an action in physical units, without gradient."""
        return self._run("dynamics", latent, action)

    def _reduce(self, value: Tensor, batch: LatentBatch, mask: Tensor | None = None, *, worst: bool = False) -> Tensor:
        """Reduces ``(*batch, 1)``; ``mask`` picks rows, ``worst`` adds the mean over the worst of them."""
        if batch.valid is not None:
            mask = batch.valid if mask is None else mask & batch.valid
        if mask is not None:
            value = torch.where(mask, value, 0.0)
        if worst and "worst_coeff" in self._active:
            # As a weight per row, so that every reduction and every mask sees the same term.
            flat = value.detach().flatten()
            order = flat.argsort(descending=True)
            if mask is None and not is_compiling():  # the number of rows is known
                rows, worst_rows = flat.numel(), _worst_rows(self.worst_fraction, flat.numel(), flat.dtype)
                weight = (1.0 + self.worst_coeff * rows / worst_rows).to(flat.dtype)
                value = value * torch.ones_like(flat).index_fill_(0, order[:worst_rows], weight).reshape(value.shape)
            else:
                counted = torch.ones_like(flat).sum() if mask is None else mask.sum()
                most = (self.worst_fraction * counted).ceil().clamp_min(1.0)
                place = torch.arange(flat.numel(), device=flat.device)
                rank = torch.empty_like(place).scatter(0, order, place)
                among = (rank < most).reshape(value.shape)
                value = value * torch.where(among, 1.0 + self.worst_coeff * counted / most, 1.0)
        weights = batch.weights
        if weights is not None:
            value = value * weights
        if self.reduction == "none":
            return value.squeeze(-1)
        if self.reduction == "sum":
            return value.sum()
        if weights is not None:
            total = (weights if mask is None else torch.where(mask, weights, 0.0)).sum()
            return value.sum() / total.clamp_min(torch.finfo(value.dtype).tiny)
        return value.mean() if mask is None else value.sum() / mask.sum().clamp_min(1)

    def _pack(self, terms: dict[str, Tensor], tensordict: TensorDictBase) -> TensorDict:
        output = TensorDict({key: terms[key] for key in self.out_keys}, batch_size=[])
        self._clear_weakrefs(
            tensordict,
            output,
            *(f"{prefix}{name}_params" for name in self._networks_used for prefix in ("", "target_")),
        )
        return output
