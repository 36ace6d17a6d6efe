"""Loggers of a run: which there are, what they are given, and the names of all metrics."""

from __future__ import annotations

import io
import os
import socket
import sys
import warnings
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from types import MappingProxyType
from typing import Any

import numpy as np
from torch import Tensor
from torchrl.record.loggers.csv import CSVLogger

from torchrl_sspl.errors import ConfigError, DTypeError, MissingDependencyError, ShapeError

LOGGERS = ("csv", "wandb", "tensorboard", "none")

#: Every metric that training and evaluation log, and what it is. The set does not grow during a run.
METRICS: Mapping[str, str] = MappingProxyType(
    {
        # Terms of the losses, weighted as they are summed.
        "loss_safe": "hinge on labelled safe observations: B above -margin",
        "loss_unsafe": "hinge on labelled unsafe observations: B below margin",
        "loss_consistency": "squared distance of the predicted from the observed next latent",
        "loss_inverse_dynamics": "error of the action read from two successive latents",
        "loss_variance": "hinge on the standard deviation of every latent coordinate",
        "loss_covariance": "squared covariances of latent coordinates",
        "loss_saturation": "encoder outputs deep in the tanh",
        "loss_synthesis": "violation of the invariance condition on observed latents",
        "loss_off_manifold": "the same on latents drawn uniformly from the cube",
        "loss_growth": "barrier values of latents whose successor is inside by the margin",
        "loss_descent": "barrier value of the successor, as the policy alone can lower it",
        "loss_policy_deviation": "distance of the policy's from the user's action",
        "loss_lipschitz": "-log det of the matrix that certifies the Lipschitz bound",
        "loss_target": "distance of the barrier from its targets",
        "loss_policy_target": "distance of the policy from its targets",
        "loss_action_value": "value that the policy's action misses, against the best one",
        # What the losses measure on their batches.
        "dynamics_error": "mean distance of predicted from observed next latent, on the batch",
        "dynamics_error_max": "largest of these distances",
        "safe_error": "share of labelled safe rows with B > 0, on the batch",
        "unsafe_error": "share of labelled unsafe rows with B <= 0, on the batch",
        "latent_std": "smallest standard deviation of a latent coordinate",
        "violation_max": "largest violation of the condition, on the batch",
        "violation_share": "share of rows that violate the condition",
        "inside_share": "share of rows with B <= 0",
        "eigenvalue_min": "smallest eigenvalue of the matrix that certifies the Lipschitz bound",
        # The optimisation.
        "grad_norm": "norm of the gradient before clipping",
        "warm_start": "1 while the world model alone is trained",
        "restarts": "fresh starts so far, because S and U were not told apart",
        "optim_steps": "optimiser steps so far",
        "lipschitz_share": "share of the last Lipschitz step that was kept",
        # Margins, estimated from the buffer.
        "covering_radius": "radius within which one half of a sample covers the other (latent units)",
        "dynamics_error_sample": "chosen quantile of the latent prediction error on the sample",
        "safety_margin": "margin psi in force",
        "dynamics_margin": "margin eta in force",
        # Rounds of the two-time-scale training.
        "inside_of_allowed": "share of encoded data inside the robust invariant set",
        "sweeps": "sweeps until that set no longer changed",
        "level": "shift of the barrier with which a round's checks passed",
        "unsafe_inside": "held-out observations of U with B <= 0 (a number)",
        "safe_outside": "held-out observations of S with B > 0 (a number)",
        "started": "held-out episodes that started in {B <= 0} (a number)",
        "left": "of these, those that left it (a number)",
        "touched": "held-out episodes that touched U (a number)",
        "returned": "share of held-out episodes from U that ended inside",
        "size": "share of held-out unlabelled observations with B <= 0",
        "tolerated": "error per step that the set is proved to tolerate (latent units; 0 where that was not asked for)",
        "covered": "share of held-out episodes to which the proof applies",
        "passed": "1 if the round passed its checks",
        # Evaluation of a frozen agent on fresh episodes of an environment without a known model.
        "eval_unsafe_called_safe": "share of fresh episodes with an observation of U at B <= 0",
        "eval_safe_called_unsafe": "share of fresh episodes with an observation of S at B > 0",
        "eval_starts_inside": "share of fresh starts with B <= 0",
        "eval_touch_unsafe": "share of episodes from B <= 0 under the policy that touch U",
        "eval_leave": "share of episodes from B <= 0 under the policy that leave it",
        "eval_random_touch_unsafe": "share of episodes under random actions that touch U",
    }
)


class _CSVLogger(CSVLogger):
    """TorchRL's, which keeps all that it has written in memory and in every checkpoint; this one keeps the newest."""

    def log_scalar(self, name: str, value: float, step: int | None = None) -> None:
        """Logs a scalar."""
        super().log_scalar(name, value, step)
        if step is not None:  # else it is counted by what is kept
            del self.experiment.scalars[name][:-1]


def make_logger(
    kind: str = "csv", name: str = "run", directory: str | Path = "runs", *, project: str = "torchrl-sspl"
) -> Any:
    """A TorchRL logger of a kind in :data:`LOGGERS` that works wherever it is started; ``None`` for ``"none"``.

    wandb writes to disk only, to be uploaded with ``wandb sync``, where there is no key or its server cannot be
    reached; ``WANDB_MODE``, if set, decides instead. Raises ConfigError if the kind is unknown; MissingDependencyError
    if its package is not installed. Source: none.
    """
    if kind not in LOGGERS:
        raise ConfigError(f"expected logger to be one of {', '.join(LOGGERS)}, received '{kind}'")
    directory = Path(directory)
    if kind == "none":
        return None
    if kind == "csv":
        return _CSVLogger(exp_name=name, log_dir=str(directory))
    if kind == "tensorboard":
        _need("tensorboard", "tensorboard")
        from torchrl.record.loggers.tensorboard import TensorboardLogger

        return TensorboardLogger(exp_name=name, log_dir=str(directory))
    _need("wandb", "wandb")
    from torchrl.record.loggers.wandb import WandbLogger

    offline = wandb_offline()
    with _unchanged("WANDB_MODE"):
        directory.mkdir(parents=True, exist_ok=True)
        return WandbLogger(
            exp_name=name, offline=offline, log_dir=str(directory), project=project, log_env_packages=False
        )


def wandb_offline() -> bool:
    """Whether a wandb run has to stay on disk: ``WANDB_MODE`` says so, or there is no key, or no way to its server."""
    mode = os.environ.get("WANDB_MODE", "").lower()
    if mode:
        return mode in ("offline", "dryrun", "disabled")
    server = os.environ.get("WANDB_BASE_URL", "https://api.wandb.ai").split("//")[-1].split("/")[0]
    host, _, port = server.partition(":")
    if not (os.environ.get("WANDB_API_KEY") or _stored_key(host)):
        return True
    try:
        socket.create_connection((host, int(port or 443)), timeout=3).close()
    except (OSError, ValueError):
        return True
    return False


def _stored_key(host: str) -> str | None:
    """Key that ``wandb login`` has left in the netrc file."""
    import netrc

    path = Path(os.environ.get("NETRC", "~/.netrc")).expanduser()
    try:
        found = netrc.netrc(str(path)).authenticators(host)
    except (OSError, netrc.NetrcParseError):
        return None
    return None if found is None else found[2]


def log_scalars(logger: Any, values: Mapping[str, Any], step: int) -> None:
    """Give a logger, if any, the metrics of a step (frames or optimiser steps) in one row; its failure is a warning.

    Raises ConfigError if a name is not in :data:`METRICS`. Source: none.
    """
    unknown = sorted(set(values) - set(METRICS))
    if unknown:
        raise ConfigError(f"expected names of METRICS, received {unknown}; add and document them first")
    if logger is None:
        return
    for position, (name, value) in enumerate(values.items()):
        # A run of wandb has rows, which the last value of a step ends.
        options = {} if _wandb_run(logger) is None else {"commit": position == len(values) - 1}
        with _costs_a_warning(logger, name):
            logger.log_scalar(name, float(value), step=step, **options)


def log_figure(logger: Any, name: str, figure: Any, step: int) -> Path | None:
    """Give a matplotlib figure to a TorchRL logger, as far as that kind can take one; its failure is a warning.

    A csv logger keeps a png file beside its scalars; returns the file that was written, if any. Source: none.
    """
    with _costs_a_warning(logger, f"the figure '{name}'"):
        run, experiment = _wandb_run(logger), _experiment(logger)
        if run is not None:
            import wandb
            from PIL import Image

            png = io.BytesIO()
            figure.savefig(png, format="png")  # wandb's own conversion needs pyplot
            with Image.open(png) as picture:
                run.log({name: wandb.Image(picture)})
        elif hasattr(experiment, "add_figure"):  # tensorboard
            experiment.add_figure(name, figure, global_step=step, close=False)
        elif getattr(logger, "log_dir", None) is not None:
            path = _folder(logger, "figures") / f"{name}_{step}.png"
            figure.savefig(path)
            return path
    return None


def log_video(logger: Any, name: str, frames: Tensor, step: int, *, fps: int = 10) -> Path | None:
    """Give a film ``(T, 3, H, W)`` uint8 to a TorchRL logger, with no package beyond Pillow; its failure is a warning.

    A csv logger keeps a gif file beside its scalars; returns the file that was written, if any. Raises ShapeError if
    there is no frame, or the shape does not fit; DTypeError if the frames are not uint8. Source: none.
    """
    if str(frames.dtype) != "torch.uint8":
        raise DTypeError(f"frames: expected torch.uint8, received {frames.dtype}; keep pictures unconverted.")
    if frames.ndim != 4 or frames.shape[1] != 3 or not frames.shape[0]:
        raise ShapeError(f"frames: expected shape (T, 3, H, W) with T >= 1, received {tuple(frames.shape)}.")
    if logger is None:
        return None
    with _costs_a_warning(logger, f"the film '{name}'"):
        film = encode_gif(frames, fps)
        run, experiment = _wandb_run(logger), _experiment(logger)
        if run is not None:
            import wandb

            path = Path(run.dir) / f"{name}_{step}.gif"
            path.write_bytes(film)
            run.log({name: wandb.Video(str(path), format="gif")})
            return path
        if hasattr(experiment, "add_figure"):  # tensorboard
            from tensorboard.compat.proto.summary_pb2 import Summary

            height, width = frames.shape[2:]
            image = Summary.Image(height=height, width=width, colorspace=3, encoded_image_string=film)
            value = Summary.Value(tag=name, image=image)
            experiment._get_file_writer().add_summary(Summary(value=[value]), step)
        elif getattr(logger, "log_dir", None) is not None:
            path = _folder(logger, "videos") / f"{name}_{step}.gif"
            path.write_bytes(film)
            return path
    return None


def encode_gif(frames: Tensor, fps: int = 10) -> bytes:
    """Frames ``(T, 3, H, W)`` uint8 as an endless gif; raises MissingDependencyError if Pillow is not installed."""
    _need("PIL", "viz")
    from PIL import Image

    pictures = np.ascontiguousarray(frames.permute(0, 2, 3, 1).cpu().numpy())
    pages = [Image.fromarray(picture).quantize(128) for picture in pictures]
    out = io.BytesIO()
    pages[0].save(out, "GIF", save_all=True, append_images=pages[1:], duration=round(1000 / fps), loop=0)
    return out.getvalue()


def close_logger(logger: Any) -> None:
    """Write what a logger, if any, still holds, and end a wandb run. Source: none."""
    with _costs_a_warning(logger, "what it still holds"):
        run, experiment = _wandb_run(logger), _experiment(logger)
        if run is not None:
            run.finish()
        elif hasattr(experiment, "close"):
            experiment.close()
        else:
            for file in getattr(experiment, "files", {}).values():
                file.close()


def _experiment(logger: Any) -> Any:
    """What a logger writes to."""
    return getattr(logger, "experiment", None)


def _wandb_run(logger: Any) -> Any | None:
    """The same, if it has what a run of wandb has."""
    experiment = _experiment(logger)
    return experiment if hasattr(experiment, "finish") and hasattr(experiment, "log") else None


@contextmanager
def _costs_a_warning(logger: Any, what: str) -> Iterator[None]:
    """A logger that fails does not end a run: its numbers are in the run's own files too."""
    try:
        yield
    except Exception as error:
        told = f"{type(logger).__name__} did not take {what}: {type(error).__name__}: {error}"
        warnings.warn(told, stacklevel=4)


def _folder(logger: Any, kind: str) -> Path:
    folder = Path(logger.log_dir) / logger.exp_name / kind
    folder.mkdir(parents=True, exist_ok=True)
    return folder


def _need(module: str, extra: str) -> None:
    import importlib.util

    if sys.modules.get(module, ...) is None or importlib.util.find_spec(module) is None:
        raise MissingDependencyError(
            f"expected the package '{module}', found none; run `pip install 'torchrl-sspl[{extra}]'`"
        )


@contextmanager
def _unchanged(variable: str) -> Iterator[None]:
    """Leave a variable of the environment as it was; TorchRL's wandb logger sets one for good."""
    before = os.environ.get(variable)
    try:
        yield
    finally:
        if before is None:
            os.environ.pop(variable, None)
        else:
            os.environ[variable] = before
