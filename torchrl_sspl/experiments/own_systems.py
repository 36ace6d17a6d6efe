"""Experiments on own systems: mistakes are named before anything is trained, and afterwards what to try."""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor, nn
from torchrl.envs import EnvBase

from torchrl_sspl.certification.certificate import Certificate, Reason
from torchrl_sspl.configs.schema import Config
from torchrl_sspl.errors import ConfigError


def advice(certificate: Certificate | None, config: Config) -> list[str]:
    """What to try where an own system is not certified, the likeliest first: sentences without a full stop."""
    if certificate is None:
        return []
    layers = [certificate.layers[k] for k in ("deterministic", "statistical") if k in certificate.layers]
    reasons = {reason for layer in layers for reason in layer.reasons}
    net, e = config.network, config.evaluation
    lines = []
    if reasons & {Reason.NOT_INVARIANT, Reason.MARGIN_TOO_SMALL, Reason.EPISODES_LEAVE}:
        lines.append(
            "encoder and latent dynamics miss something that leads out of the set; use as many latent numbers as the state has and "
            f"the policy needs (network.latent_dim, now {net.latent_dim}), more motion between two pictures (action_repeat, a "
            f"closer camera; the default encoder averages them to network.pool_to = {net.pool_to} pixels), more data "
            f"(trainer.total_frames, now {config.trainer.total_frames}), or a U that can still be avoided from outside"
        )
    if Reason.UNSAFE_INSIDE in reasons:
        lines.append("some observations of U look like S; use more data in U (reset_options) or finer pictures (image_size, network.pool_to)")
    if Reason.TOO_FEW in reasons or Reason.NOT_MEASURED in reasons:
        lines.append(
            "too few fresh episodes start in the set or show U; use resets that do (reset_options), or more of them "
            f"(evaluation.certificate_episodes, now {e.certificate_episodes})"
        )
    if reasons & {Reason.UNDECIDED, Reason.VACUITY_UNDECIDED}:
        lines.append(f"the proof ran out of time; allow more (evaluation.certificate_seconds, now {e.certificate_seconds:g})")
    return lines


def check_factory(make_env: Any) -> None:
    """Refuse what cannot make environments. Raises ConfigError if it is an environment, or cannot be called."""
    if isinstance(make_env, EnvBase) or not callable(make_env):
        raise ConfigError(
            "make_env: expected a function (batch_size=[n], seed=...) -> environment, such as partial(GymnasiumPixels, make, "
            f"safe=..., unsafe=...), received an object of type {type(make_env).__name__}"
        )


@torch.no_grad()
def check_encoder(encoder: nn.Module, pixels: Tensor, latent_dim: int) -> None:
    """Raises ConfigError if an encoder cannot take uint8 pixels, or its latents have another shape or leave [-1, 1]."""
    mode, shape = encoder.training, tuple(pixels.shape)
    encoder.eval()
    try:
        latent = encoder(pixels)
    except Exception as error:
        raise ConfigError(
            f"encoder: expected a module that takes uint8 pixels of shape {shape}, received {type(error).__name__}: {error}; "
            "it begins with pixels.float() / 255"
        ) from error
    finally:
        encoder.train(mode)
    if latent.shape != (len(pixels), latent_dim) or not latent.is_floating_point():
        raise ConfigError(
            f"encoder: expected latents of shape (*batch, network.latent_dim={latent_dim}), received {tuple(latent.shape)} of "
            f"{latent.dtype}; the class gets latent_dim"
        )
    if not float(latent.abs().max()) <= 1.0 + 1e-6:
        raise ConfigError(
            f"encoder: expected latents in [-1, 1], received up to {float(latent.abs().max()):.3g}; end it with nn.Tanh()"
        )
