r"""One step of an agent as a file that runs without this library: ONNX, or a programme of ``torch.export``."""

from __future__ import annotations

import copy
import io
import json
import warnings
from collections.abc import Mapping, Sequence
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import torch
from torch import Tensor, nn

from torchrl_sspl.certification.certificate import weights_digest
from torchrl_sspl.errors import CertificationError, ConfigError, MissingDependencyError, SSPLError
from torchrl_sspl.files import write
from torchrl_sspl.modules.choosing import ChoosingPolicy
from torchrl_sspl.modules.controller import correction, meets_premise
from torchrl_sspl.modules.networks import as_pair

INPUTS = ("pixels", "latent", "action", "begins")
OUTPUTS = ("next_action", "barrier", "seen_barrier", "innovation", "met", "next_latent")
_SIZE = 64  # of the pictures of an encoder that takes any size
_TOLERANCE = 1e-4  # of what comes out, each relative to its range


class DeployedStep(nn.Module):
    r"""An agent's step as a function without a memory of its own; what it has to remember goes in and comes out.

    .. math:: (o_t, \hat z_{t-1}, u_{t-1}, \text{begins}) \mapsto
        (u_t, B(\hat z_t), B(E(o_t)), \lVert i_t \rVert, \text{met}, \hat z_t)

    The action that goes in is the one that was really taken, in physical units; with ``begins`` neither it nor the latent
    counts. ``met`` says whether this step meets the premise of the proof; the proof applies as long as every step since the
    beginning did (Theorem F in ``docs/theory.md``). Source: none.

    Args:
        agent: frozen agent.

    Example:
        >>> from torchrl_sspl.modules.agent import load
        >>> step = DeployedStep(load("pendulum"))
        >>> frames, begins = torch.zeros(2, 6, 64, 64, dtype=torch.uint8), torch.ones(2, dtype=torch.bool)
        >>> [tuple(t.shape) for t in step(frames, torch.zeros(2, 3), torch.zeros(2, 1), begins)]
        [(2, 1), (2,), (2,), (2,), (2,), (2, 3)]
    """

    def __init__(self, agent: Any) -> None:
        super().__init__()
        self.agent = agent
        # As numbers: nothing may be decided by tensors where a graph is traced.
        self.proved = SimpleNamespace(tolerated_error=agent.tolerated_error, held_error=agent.held_error)

    def forward(self, pixels: Tensor, latent: Tensor, action: Tensor, begins: Tensor) -> tuple[Tensor, ...]:
        """The step, for pixels ``(n, 6, H, W)`` uint8, latent ``(n, p)``, action ``(n, m)`` and begins ``(n,)`` bool."""
        agent = self.agent
        seen = agent.encoder(pixels)
        prior = torch.where(begins[:, None], seen, agent.dynamics(latent, action))
        now, innovation, _, seen = correction(agent, self.proved.held_error, seen, prior)
        barrier, of_seen = agent.barrier(now)[:, 0], agent.barrier(seen)[:, 0]
        met = meets_premise(self.proved, barrier, of_seen, (now - prior).norm(dim=-1))
        return agent.policy(now), barrier, of_seen, innovation.norm(dim=-1), met, now


def export(agent: Any, path: str | Path, *, check: int = 256, image_size: int | Sequence[int] | None = None) -> Path:
    """Writes one step of an agent, :class:`DeployedStep`, for a machine without this library.

    The suffix says what: ``.onnx`` for onnxruntime and the like, ``.pt2`` for ``torch.export.load``. The batch is dynamic. An ONNX
    file carries the agent's sizes, its digest, its tolerated error and, where its description names a system of this library or says it,
    the time ``dt`` between two steps in s as metadata.

    Args:
        agent: frozen agent.
        path: file to write; its folder is created if necessary.
        check: number of steps on which the file is compared with the agent before this returns; 0: none. Half of their pictures are those
            of random states where the description names a system of this library; the others are noise.
        image_size: height and width of the pictures in pixels, which the file fixes; ``None``: the encoder's, 64 where it takes any.

    Returns the path. Raises ConfigError for another suffix, or another size than the encoder's; MissingDependencyError without the packages of the extra
    ``onnx``; CertificationError if the file computes something else. Source: none.

    Example:
        >>> from tempfile import mkdtemp
        >>> from torchrl_sspl.modules.agent import load
        >>> export(load("pendulum"), Path(mkdtemp()) / "agent.pt2").name
        'agent.pt2'
    """
    path = Path(path)
    if path.suffix not in (".onnx", ".pt2"):
        raise ConfigError(f"expected a file that ends in .onnx or .pt2, received '{path.name}'")
    if path.suffix == ".onnx":
        _required("onnxscript")
    step = DeployedStep(copy.deepcopy(agent)).cpu().eval()  # the caller's stays where it is
    dynamic = {name: {0: torch.export.Dim("n")} for name in INPUTS}
    step.agent.encoder.image_size = _size(agent, image_size)
    example = tuple(_steps(step.agent, 2, 0).values())
    written = io.BytesIO()
    with torch.no_grad(), warnings.catch_warnings():
        warnings.simplefilter("ignore")  # of the exporters, about themselves
        program = torch.export.export(step, example, dynamic_shapes=dynamic)
        if path.suffix == ".pt2":
            torch.export.save(program, written)
        else:
            made: Any = torch.onnx.export(program, dynamo=True, input_names=list(INPUTS), output_names=list(OUTPUTS), verbose=False)
            made.model.metadata_props.update({k: json.dumps(v) for k, v in _about(step.agent).items()})
            written.write(made.model_proto.SerializeToString())
    if check:  # before it takes the place of a file that may be right
        _compare(step, written.getvalue(), path.suffix, check)
    write(path, written.getvalue())
    return path


def _required(package: str) -> Any:
    try:
        return __import__(package)
    except ImportError as error:
        raise MissingDependencyError(
            f"writing and checking ONNX needs the package {package}: pip install 'torchrl-sspl[onnx]'; a .pt2 file needs nothing more"
        ) from error


def _about(agent: Any) -> dict[str, Any]:
    """What a machine that runs the file has to know."""
    about = {
        "pixels": list(picture_of(agent)), "latent_dim": agent.latent_dim, "tolerated_error": agent.tolerated_error,
        "action_scale": agent.policy.action_scale.flatten().tolist(), "weights": weights_digest(agent.state_dict()),  # type: ignore[operator, union-attr]
    }  # fmt: skip
    period = _period(agent)
    return about if period is None else about | {"dt": period}


def _period(agent: Any) -> float | None:
    """Time between two steps in s; None where the agent's description does not say it, and names no system of this library."""
    if isinstance(told := agent.description.get("dt"), int | float):
        return float(told)
    kind, given = _system(agent)
    period = given.get("dt")
    if period is None and kind:
        period = getattr(kind(batch_size=[1]), "dt", None)
    return float(period) if isinstance(period, (int, float)) else None


def _system(agent: Any) -> tuple[Any, dict[str, Any]]:
    """The class of the system that an agent's description names, None of one that is not of this library; and what it is made with."""
    from torchrl_sspl import envs

    config = agent.description.get("config")
    named = config.get("env") if isinstance(config, Mapping) else None
    given = dict(named) if isinstance(named, Mapping) else {}
    target = given.pop("_target_", None)
    path = target if isinstance(target, str) else f"torchrl_sspl.envs.{agent.description.get('environment')}"
    kind = getattr(envs, path.rpartition(".")[2], None) if path.startswith("torchrl_sspl.envs.") else None
    known = isinstance(kind, type) and issubclass(kind, envs.SafetyEnv) and kind is not envs.SafetyEnv
    return kind if known else None, given


def picture_of(agent: Any) -> tuple[int, int, int]:
    """Shape of the pictures that an agent takes; of an encoder that takes any size 64 x 64."""
    return 6, *_size(agent)


def _size(agent: Any, wanted: int | Sequence[int] | None = None) -> tuple[int, int]:
    """Height and width of the pictures: of the encoder, or what is wanted where it takes any."""
    told = getattr(agent.encoder, "image_size", None)
    own = as_pair(told, "image_size") if told else None
    size = own if wanted is None and own else as_pair(wanted or _SIZE, "image_size")
    if own and size != own:
        raise ConfigError(f"expected image_size={own}, the one size that the encoder takes, received {size}; leave it out")
    return size


def _steps(agent: Any, n: int, seed: int) -> dict[str, Tensor]:
    """Random steps, by the name of the input."""
    g = torch.Generator().manual_seed(seed)
    scale = agent.policy.action_scale.flatten().cpu()  # type: ignore[operator, union-attr]
    return {
        "pixels": torch.randint(256, (n, *picture_of(agent)), generator=g, dtype=torch.uint8),
        "latent": torch.rand(n, agent.latent_dim, generator=g) * 2 - 1,
        "action": (torch.rand(n, len(scale), generator=g) * 2 - 1) * scale,
        "begins": torch.rand(n, generator=g) < 0.5,
    }


def _drawn(agent: Any, n: int, seed: int) -> Tensor | None:
    """Pictures ``(n, 6, H, W)`` of random states, drawn by the system that the agent's description names; None where it names none of this
    library, or one with other pictures."""
    kind, given = _system(agent)
    try:
        env = kind(**given | {"batch_size": [1], "seed": seed}) if kind else None
    except (SSPLError, TypeError, ValueError):  # a description may say anything
        env = None
    if env is None or n < 1 or tuple(env.observation_spec["pixels"].shape[1:]) != picture_of(agent):
        return None
    state = env.sample_states(n, torch.Generator().manual_seed(seed))
    return torch.cat([env.draw(env.previous_state(state)), env.draw(state)], 1)


def _tied(agent: Any, wanted: dict[str, Tensor], found: dict[str, Tensor], spread: float) -> Tensor:
    """Steps ``(n,)`` on which a policy that chooses may do either, for all that rounding decides."""
    values = [agent.barrier(agent.dynamics(wanted["next_latent"], k["next_action"]))[:, 0] for k in (wanted, found)]
    tied = (values[0] - values[1]).abs() <= _TOLERANCE * max(spread, 1e-6)
    differ = (wanted["next_action"] != found["next_action"]).any(1)
    return tied & differ & isinstance(agent.policy, ChoosingPolicy)


@torch.no_grad()
def _compare(step: DeployedStep, file: bytes, suffix: str, n: int) -> None:
    """A CertificationError if the file does not compute what the agent does."""
    given, shown = _steps(step.agent, n, 1), _drawn(step.agent, n // 2, 1)
    if shown is not None:  # noise lies outside of every set
        given["pixels"][: len(shown)] = shown
    wanted = dict(zip(OUTPUTS, step(**given), strict=True))
    if suffix == ".pt2":
        found = dict(zip(OUTPUTS, torch.export.load(io.BytesIO(file)).module()(*given.values()), strict=True))
    else:
        runtime = _required("onnxruntime")
        session = runtime.InferenceSession(file, providers=["CPUExecutionProvider"])
        made = session.run(list(OUTPUTS), {k: v.numpy() for k, v in given.items()})
        found = {k: torch.from_numpy(v) for k, v in zip(OUTPUTS, made, strict=True)}
    scale = step.agent.policy.action_scale.flatten().cpu()  # type: ignore[operator, union-attr]
    spread = float(wanted["barrier"].max() - wanted["barrier"].min())
    apart = ((found["next_action"] - wanted["next_action"]) / (2 * scale)).abs()
    ranges = {"barrier": spread, "seen_barrier": spread, "innovation": 2.0, "next_latent": 2.0}
    off = {name: float((found[name] - wanted[name]).abs().max()) / max(size, 1e-6) for name, size in ranges.items()}
    off["action"] = float(apart.masked_fill(_tied(step.agent, wanted, found, spread)[:, None], 0.0).max())
    # The premise compares the barrier with zero: near it rounding decides.
    clear = torch.stack([wanted["barrier"], wanted["seen_barrier"]]).abs().amin(0) > _TOLERANCE * max(spread, 1e-6)
    off["met"] = float(((found["met"] != wanted["met"]) & clear).float().mean())
    if not all(v <= _TOLERANCE for v in off.values()):
        raise CertificationError(
            f"expected the exported file to compute what the agent computes, to {_TOLERANCE:g} of its range, received differences of "
            f"{off}; export with another version of torch or onnxscript"
        )


__all__ = ["DeployedStep", "export"]
