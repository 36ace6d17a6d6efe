"""The frozen result of a training: encoder, barrier, policy and latent dynamics in one object."""

from __future__ import annotations

import copy
import inspect
import json
import math
import sys
import warnings
from collections.abc import Callable
from pathlib import Path
from typing import Any

import torch
from safetensors import SafetensorError
from safetensors.torch import load_file
from safetensors.torch import save as as_bytes
from torch import Tensor, nn

from torchrl_sspl.certification.certificate import weights_digest
from torchrl_sspl.configs.reader import resolve
from torchrl_sspl.devices import usable_device
from torchrl_sspl.errors import CheckpointError, ConfigError
from torchrl_sspl.files import write
from torchrl_sspl.lipschitz import prove_lipschitz
from torchrl_sspl.modules.choosing import ChoosingPolicy
from torchrl_sspl.modules.contrast import ContrastEncoder
from torchrl_sspl.modules.controller import Controller
from torchrl_sspl.modules.export import export, picture_of
from torchrl_sspl.modules.moments import (
    BearingEncoder,
    MomentEncoder,
    TurnedBearingEncoder,
)
from torchrl_sspl.modules.networks import FrameEncoder, LatentDynamics, Policy, mlp
from torchrl_sspl.modules.observer import gain_matrix
from torchrl_sspl.modules.shapes import ShapeBearingEncoder, ShapeEncoder, ShapePlaceEncoder

WEIGHTS_FILE = "agent.safetensors"
DESCRIPTION_FILE = "agent.json"
FORMAT_VERSION = 1
_CLAIMS = frozenset({"lipschitz", "tolerated_error"})  # what a description says was proved
_HELD = 9  # values of what a memory may hold, per entry


def mlp_barrier(latent_dim: int, hidden: list[int]) -> nn.Sequential:
    """Plain ReLU network ``(*batch, latent_dim) -> (*batch, 1)``: what is deployed of a barrier. Source: none.

    Example:
        >>> mlp_barrier(3, [8])(torch.zeros(5, 3)).shape
        torch.Size([5, 1])
    """
    return mlp((latent_dim, *hidden, 1))


def _check_error(error: Any) -> None:
    if type(error) not in (int, float) or not 0.0 <= error < math.inf:
        raise ConfigError(f"expected a tolerated error that is finite and not negative, received {str(error)[:40]!r}")


#: Networks that an agent on disk may name; extend it before loading an agent with networks of your own.
ENCODERS: dict[str, type[nn.Module]] = {
    "FrameEncoder": FrameEncoder, "ContrastEncoder": ContrastEncoder, "MomentEncoder": MomentEncoder, "ShapeEncoder": ShapeEncoder,
    "ShapeBearingEncoder": ShapeBearingEncoder, "ShapePlaceEncoder": ShapePlaceEncoder, "BearingEncoder": BearingEncoder,
    "TurnedBearingEncoder": TurnedBearingEncoder,
}  # fmt: skip
DYNAMICS: dict[str, type[nn.Module]] = {"LatentDynamics": LatentDynamics}
POLICIES: dict[str, type[nn.Module]] = {"ChoosingPolicy": ChoosingPolicy, "Policy": Policy}


class Agent(nn.Module):
    r"""A frozen safe agent: :math:`z = E(o)`, :math:`B(z)`, :math:`u = \pi(z)`, :math:`z^+ = d(z, u)`.

    The networks are copies, in evaluation mode, and take no gradient; those that are given stay as they are
    (TensorDictModules are unwrapped). ``barrier``, ``policy`` and ``dynamics`` are
    modules and are called as such; :meth:`controller` runs them behind the observer. Source: paper Section IV (the
    trained networks); deviation: the latent observer, see :class:`~torchrl_sspl.modules.observer.LatentObserver`.

    Args:
        encoder: pixels ``(*batch, 6, H, W)`` uint8 -> latent ``(*batch, p)`` in [-1, 1].
        dynamics: latent ``(*batch, p)``, action ``(*batch, m)`` in physical units -> next latent ``(*batch, p)``.
        barrier: latent ``(*batch, p)`` -> ``(*batch, 1)``; at most zero means safe.
        policy: latent ``(*batch, p)`` -> action ``(*batch, m)`` in physical units (N m, rad/s); a
            :class:`~torchrl_sspl.modules.ChoosingPolicy` chooses by this agent's dynamics and barrier.
        lipschitz_bound: Lipschitz constant of ``barrier`` with respect to the Euclidean norm, as claimed; whether it was proved is in
            ``description["lipschitz"]``, and ``sspl verify`` proves it anew.
        description: how to build the networks again, and whatever else should travel with the agent;
            ``"tolerated_error"`` is the error below which its proof applies at run time, ``"proof_of"`` the digest of the weights of which
            that and ``"lipschitz"`` were proved: of others nothing is.
        gain: K of the latent observer, a number or ``(p, p)``; 1: the latent is what is seen.

    Raises ConfigError for a barrier in training, or a gain or a tolerated error that is not valid.

    Example:
        >>> agent = Agent(FrameEncoder(2, 32), LatentDynamics(2, 1), mlp_barrier(2, [8]), Policy(2, 1), 2.0)
        >>> latent = agent.encode(torch.zeros(4, 6, 32, 32, dtype=torch.uint8))
        >>> agent.barrier(latent).shape, agent.dynamics(latent, agent.policy(latent)).shape
        (torch.Size([4, 1]), torch.Size([4, 2]))
    """

    gain: Tensor

    def __init__(
        self,
        encoder: nn.Module,
        dynamics: nn.Module,
        barrier: nn.Module,
        policy: nn.Module,
        lipschitz_bound: float,
        description: dict[str, Any] | None = None,
        gain: float | Tensor = 1.0,
    ) -> None:
        super().__init__()
        # Copies: a training that goes on does not notice, and does not change what is deployed.
        nets = (copy.deepcopy(getattr(net, "module", net)) for net in (encoder, dynamics, barrier, policy))
        self.encoder, self.dynamics, self.barrier, self.policy = nets
        if not isinstance(self.barrier, nn.Sequential) or not hasattr(self.barrier[0], "in_features"):
            raise ConfigError(
                f"expected a plain barrier (a Sequential that begins with a Linear), received {type(self.barrier).__name__}; "
                "Agent.from_networks(...) and Agent.from_loss(loss) collapse it and prove its Lipschitz bound"
            )
        if isinstance(self.policy, ChoosingPolicy):
            self.policy.bind(self.dynamics, self.barrier)
        self.lipschitz_bound = float(lipschitz_bound)
        if not 0.0 < self.lipschitz_bound < math.inf:
            raise ConfigError(f"expected a Lipschitz bound that is finite and above zero, received {lipschitz_bound}")
        self.description: dict[str, Any] = dict(description or {})
        first: Any = self.barrier[0]
        self.register_buffer("gain", gain_matrix(gain, self.latent_dim).to(first.weight.dtype))
        _check_error(self.description.get("tolerated_error", 0.0))
        self.eval()
        self.requires_grad_(False)
        self._tie()

    @classmethod
    def from_networks(
        cls,
        encoder: nn.Module,
        dynamics: nn.Module,
        barrier: nn.Module,
        policy: nn.Module,
        *,
        level: float = 0.0,
        gain: float | Tensor = 1.0,
        choices: Tensor | None = None,
        choice_margin: float = 0.0,
        description: dict[str, Any] | None = None,
    ) -> Agent:
        """A frozen copy, on the CPU, of networks in training; the barrier collapsed to a plain one, its bound proved.

        Args:
            encoder, dynamics, policy: networks, which stay as they are; TensorDictModules are unwrapped.
            barrier: a Lipschitz barrier of this library.
            level: {B <= level} becomes {B <= 0}.
            gain: K of the latent observer.
            choices: table of actions ``(K, m)``, physical units: the policy becomes a
                :class:`~torchrl_sspl.modules.ChoosingPolicy` of the deployed barrier, with this ``choice_margin``.
            description: whatever should travel with the agent.

        Source: none.

        Example:
            >>> from torchrl_sspl.lipschitz import SandwichBarrier
            >>> nets = FrameEncoder(2, 32), LatentDynamics(2, 1), SandwichBarrier(2, (8,), 1.5), Policy(2, 1)
            >>> Agent.from_networks(*nets).lipschitz_bound
            1.5
        """
        nets = [copy.deepcopy(getattr(net, "module", net)).cpu() for net in (encoder, dynamics, barrier, policy)]
        deployed, bound = nets[2].collapse(), float(nets[2].lipschitz_bound)  # type: ignore[arg-type, operator]
        with torch.no_grad():
            deployed[-1].bias.sub_(level)
        if choices is not None:
            nets[3] = ChoosingPolicy(nets[3], choices, choice_margin)
        witness = [m.tolist() for m in nets[2].multipliers()]  # type: ignore[operator]
        proof = prove_lipschitz(deployed, bound, multipliers=[torch.tensor(m) for m in witness])
        hidden = [layer.out_features for layer in deployed if isinstance(layer, nn.Linear)][:-1]
        latent_dim = int(nets[1].latent_dim)  # type: ignore[arg-type]
        named = {"encoder": nets[0], "dynamics": nets[1], "policy": nets[3]}
        networks: dict[str, Any] = {k: _describe(net, latent_dim) for k, net in named.items()}
        body = {**(description or {}), "networks": networks | {"barrier": {"latent_dim": latent_dim, "hidden": hidden}}}
        body["lipschitz"] = {"proved": proof.proved, "reason": proof.reason, "multipliers": witness}
        before = body.pop("proof_of", None)
        agent = cls(nets[0], nets[1], deployed, nets[3], bound, body, gain)
        if before not in (None, agent.description["proof_of"]):  # the description of another agent
            agent.description.pop("tolerated_error", None)
        return agent

    @classmethod
    def from_loss(cls, loss: Any, **options: Any) -> Agent:
        """A frozen copy of the networks of an ``SSPLLoss``; options as for :meth:`from_networks`."""
        return cls.from_networks(loss.encoder, loss.dynamics, loss.barrier, loss.actor_network, **options)

    @torch.no_grad()
    def encode(self, pixels: Tensor) -> Tensor:
        """Latent ``(*batch, p)`` in [-1, 1] of pixels ``(*batch, 6, H, W)`` uint8: RGB of frames t-1 and t."""
        return self.encoder(pixels)

    @torch.no_grad()
    def act(self, pixels: Tensor) -> tuple[Tensor, Tensor]:
        """Action ``(*batch, m)`` in physical units and barrier value ``(*batch, 1)``; pixels as for :meth:`encode`."""
        latent = self.encode(pixels)
        return self.policy(latent), self.barrier(latent)

    @torch.no_grad()
    def least_barrier(self, latent: Tensor) -> Tensor:
        """Smallest barrier value ``(n,)`` of what is seen ``(n, p)``, whatever the memory holds beside it.

        Entries that no picture shows (those that K leaves to the memory) take values on a grid; without any it is B(z).
        """
        hidden = (~(self.gain != 0).any(0)).nonzero()[:, 0]
        if not len(hidden):
            return self.barrier(latent)[:, 0]
        held = torch.linspace(-1.0, 1.0, _HELD, device=latent.device)
        held = torch.cartesian_prod(*[held] * len(hidden)).reshape(-1, len(hidden))
        tried = latent.expand(len(held), *latent.shape).clone()
        tried[..., hidden] = held[:, None]
        return self.barrier(tried)[..., 0].amin(0)

    def controller(self, batch_size: int = 1, **options: Any) -> Controller:
        """What runs on n systems side by side: with a memory of its own, and the premise of the proof watched; options and errors are
        those of :class:`~torchrl_sspl.modules.Controller`.

        Example:
            >>> load("pendulum").controller(batch_size=3).batch_size
            3
        """
        return Controller(self, batch_size, **options)

    def export(self, path: str | Path, **options: Any) -> Path:
        """Write one step for a machine without this library: ``.onnx``, or ``.pt2`` for ``torch.export.load``; returns the path.

        Options, inputs, outputs and errors are those of ``torchrl_sspl.modules.export``.
        """
        return export(self, path, **options)

    @property
    def tolerated_error(self) -> float:
        """Error per step, latent units, up to which the proof applies at run time; 0 where nothing is proved of these weights.

        Set it to what :func:`~torchrl_sspl.evaluation.certify.premise` finds; a ConfigError for what is negative or not finite.
        """
        return 0.0 if self.of_other_weights else float(self.description.get("tolerated_error", 0.0))

    @tolerated_error.setter
    def tolerated_error(self, error: float) -> None:
        _check_error(error)
        if self.of_other_weights:
            self.description["lipschitz"] = {**self.description.get("lipschitz", {}), "proved": False, "reason": "proved of other weights"}
        self.description |= {"tolerated_error": error, "proof_of": self._proof_digest()}

    @property
    def lipschitz_proved(self) -> bool:
        """Whether ``lipschitz_bound`` was proved of these weights, as the description says; ``sspl verify`` proves it anew."""
        said = self.description.get("lipschitz")
        return isinstance(said, dict) and said.get("proved") is True and not self.of_other_weights

    @property
    def of_other_weights(self) -> bool:
        """Whether what the description says was proved is about weights, or a gain, that these are not, or no longer; looked at anew each time."""
        return bool(_CLAIMS & self.description.keys()) and self.description.get("proof_of") not in (None, self._proof_digest())

    def _proof_digest(self) -> str:
        """Digest of what proofs are about: all but the encoder, as numbers of whatever type."""
        state = {name: value.double() for name, value in self.state_dict().items() if not name.startswith("encoder.")}
        return weights_digest(state | {"lipschitz_bound": torch.tensor(self.lipschitz_bound, dtype=torch.float64)})

    def _tie(self) -> None:
        """Where the description does not say of which weights something was proved, it is these."""
        if _CLAIMS & self.description.keys():
            self.description.setdefault("proof_of", self._proof_digest())

    @property
    def held_error(self) -> float:
        """What corrections of the memory are cut to where they would leave the set: the tolerated error; 0 where K = I."""
        remembers = not torch.equal(self.gain.cpu(), torch.eye(self.latent_dim))
        return self.tolerated_error if remembers else 0.0

    @property
    def latent_dim(self) -> int:
        """Size of the latent."""
        return int(self.barrier[0].in_features)  # type: ignore[index, union-attr]

    def save(self, path: str | Path) -> Path:
        """Write ``agent.safetensors`` and ``agent.json`` into a directory, which is created if necessary and returned.

        Raises:
            ConfigError: if the agent has no description of its networks, or its barrier is none of linear layers and ReLU, as which it would
                be read, or a network of your own would be another one when it is built again.
            OutputError: if it cannot be written.
        """
        if "networks" not in self.description:
            raise ConfigError(
                "expected description['networks'] (class names and arguments of encoder, dynamics, barrier and policy),"
                " received none; build the agent with a description to save it"
            )
        read = mlp_barrier(**self.description["networks"]["barrier"])
        if [type(layer) for layer in read] != [type(layer) for layer in self.barrier.modules() if layer is not self.barrier]:
            raise ConfigError(
                f"expected a barrier like {read}, as which its description would be read, received {self.barrier}; what is proved of one says "
                "nothing of the other: train it with ReLU, or keep the agent in your own code"
            )
        _read_as_written(self)
        path = Path(path)
        write(path / WEIGHTS_FILE, as_bytes({k: v.contiguous() for k, v in self.state_dict().items()}))
        body = {"format": FORMAT_VERSION, "lipschitz_bound": self.lipschitz_bound, **self.description}
        write(path / DESCRIPTION_FILE, json.dumps(body, indent=1, sort_keys=True) + "\n")
        return path

    @classmethod
    def load(cls, path: str | Path, device: torch.device | str = "cpu", *, trust: bool = True) -> Agent:
        """Read an agent from a directory that :meth:`save` has written, to a device.

        ``trust``: import networks of your own, which the agent names, too; that runs code: trust whom the agent comes from.

        Raises:
            CheckpointError: if a file is missing, unreadable, of another format, does not fit the networks, or names a network that is
                not to be trusted, or none.
            ConfigError: if this machine has no such device.
        """
        path, device = Path(path), usable_device(device)
        for name in (DESCRIPTION_FILE, WEIGHTS_FILE):
            if not (path / name).is_file():
                raise CheckpointError(
                    f"expected {name} in the agent directory '{path}', found none; give a run directory or the name of "
                    "a shipped agent"
                )
        try:
            body = json.loads((path / DESCRIPTION_FILE).read_text())
            if body.pop("format", None) != FORMAT_VERSION:
                raise CheckpointError(
                    f"expected agent format {FORMAT_VERSION} in '{path}'; the agent was written by another version of "
                    "the library, train it again or load it with that version"
                )
            bound, nets = float(body.pop("lipschitz_bound")), body["networks"]
            kinds = (ENCODERS, "encoder"), (DYNAMICS, "dynamics"), (POLICIES, "policy")
            encoder, dynamics, policy = (_build(role, registry, nets[role], trust) for registry, role in kinds)
            told = "proof_of" in body
            agent = cls(encoder, dynamics, mlp_barrier(**nets["barrier"]), policy, bound, body)
            weights = load_file(path / WEIGHTS_FILE)
            if any(w.dtype == torch.float64 for w in weights.values()):
                agent.double()  # weights are never rounded
            agent.load_state_dict({"gain": agent.gain} | weights)  # without one, it has no observer
            gain_matrix(agent.gain, agent.latent_dim)
        except CheckpointError:
            raise
        except (ValueError, KeyError, TypeError, AttributeError, RuntimeError, OSError, SafetensorError) as error:
            raise CheckpointError(
                f"expected a readable agent in '{path}', received {type(error).__name__}: {str(error)[:200]}; restore "
                "the files or train again"
            ) from error
        for name, value in agent.state_dict().items():
            if not torch.isfinite(value).all():
                raise CheckpointError(
                    f"expected finite weights in '{path}', received NaN or infinity in '{name}'; restore the files"
                )
        if not told:
            agent.description.pop("proof_of", None)  # of the weights that it was built with
        agent._tie()
        if agent.of_other_weights:
            warnings.warn(
                f"'{path}' says what was proved of other weights, so that it counts as not proved; set agent.tolerated_error = premise(agent), "
                "save the agent and certify it", stacklevel=2,
            )  # fmt: skip
        return agent.to(device)


class _Elsewhere(nn.Module):
    """An encoder that stays on its device, for callers whose tensors lie in host memory."""

    def __init__(self, encoder: nn.Module, device: torch.device) -> None:
        super().__init__()
        self.encoder, self.device = encoder, device
        for name in ("frames", "head"):  # the halves of a frame encoder
            if hasattr(encoder, name):
                setattr(self, name, self._moved(getattr(encoder, name)))

    def _moved(self, function: Callable[..., Tensor]) -> Callable[..., Tensor]:
        return lambda *tensors: function(*(t.to(self.device) for t in tensors)).cpu()

    def forward(self, pixels: Tensor) -> Tensor:
        return self.encoder(pixels.to(self.device)).cpu()


def on_host(agent: Agent) -> Agent:
    """The agent for measurements, which draw states and count in host memory; itself if it is there already.

    The encoder, in which the time goes, stays on its device and takes and gives tensors of the host; the small networks
    are copied to the host.
    """
    device = next(agent.barrier.parameters()).device
    if device.type == "cpu":
        return agent
    dynamics, barrier, policy = (copy.deepcopy(net).cpu() for net in (agent.dynamics, agent.barrier, agent.policy))
    encoder, gain = _Elsewhere(agent.encoder, device), agent.gain.cpu()
    return Agent(encoder, dynamics, barrier, policy, agent.lipschitz_bound, agent.description, gain)


def build_encoder(name: str, **sizes: Any) -> nn.Module:
    """An encoder of the library by name, or one of your own by import path. Source: none.

    Args:
        name: key of :data:`ENCODERS`, or ``"package.module:Class"``.
        **sizes: those that the class takes are handed on: ``latent_dim``, ``image_size``, ``pool_to``, ...

    Raises:
        ConfigError: if there is no such encoder, or it needs something else.

    Example:
        >>> build_encoder("FrameEncoder", latent_dim=3, pool_to=16).latent_dim
        3
    """
    try:
        kind = ENCODERS.get(name) or resolve(name)
    except ConfigError as error:
        raise ConfigError(
            f"expected network.encoder to be one of {sorted(ENCODERS)} or package.module:Class, {error}"
        ) from error
    return call_with(kind, sizes)


def call_with(kind: Any, sizes: dict[str, Any], role: str = "encoder") -> nn.Module:
    """A class or function called with those of the sizes that it takes; a ConfigError, which names the role, if it needs something else."""
    if isinstance(kind, nn.Module) or not callable(kind):
        found = "a module; give its class," if isinstance(kind, nn.Module) else "a"
        raise ConfigError(
            f"{role}: expected a class or a function latent_dim -> module, received {found} {type(kind).__name__}"
        )
    taken = inspect.signature(kind).parameters
    if any(p.kind is p.VAR_KEYWORD for p in taken.values()) and "latent_dim" in taken:
        chosen = sizes
    elif "latent_dim" in taken:
        chosen = {k: v for k, v in sizes.items() if k in taken}
    else:  # whatever it calls it, the size of the latent comes first
        chosen = {}
    try:
        made = kind(**chosen) if chosen else kind(sizes["latent_dim"])
    except TypeError as error:
        raise ConfigError(
            f"{role}: expected a class or a function latent_dim -> module, received one that raises TypeError: {error}"
        ) from error
    if not getattr(made, "arguments", None):
        made.arguments = chosen or {"latent_dim": sizes["latent_dim"]}  # with which it is built again
    return made


def _describe(network: nn.Module, latent_dim: int) -> dict[str, Any]:
    """Class and arguments from which a network can be built again."""
    kind = type(network)
    own, module = {**ENCODERS, **DYNAMICS, **POLICIES}.get(kind.__name__) is not kind, kind.__module__
    if module == "__main__":  # of a program: others find the class in its file
        module = Path(getattr(sys.modules[module], "__file__", None) or module).stem
    arguments = _arguments(network, latent_dim)
    arguments = {k: _describe(v, latent_dim) if isinstance(v, nn.Module) else v for k, v in arguments.items()}
    return {"class": f"{module}:{kind.__qualname__}" if own else kind.__name__, "arguments": arguments}


def _arguments(network: nn.Module, latent_dim: int) -> dict[str, Any]:
    """With what a network is built again."""
    return getattr(network, "arguments", None) or {"latent_dim": latent_dim}


@torch.no_grad()
def _read_as_written(agent: Agent) -> None:
    """A ConfigError if a network of your own would be read back as another one: with other arguments than it was made with."""
    generator = torch.Generator().manual_seed(0)
    pixels = torch.randint(256, (4, *picture_of(agent)), dtype=torch.uint8, generator=generator)
    latent = (torch.rand(4, agent.latent_dim, generator=generator) * 2 - 1).to("cpu", agent.gain.dtype)
    _built_again("encoder", agent.encoder, (pixels,), agent.latent_dim)
    _built_again("policy", agent.policy, (latent,), agent.latent_dim)
    _built_again("dynamics", agent.dynamics, (latent, copy.deepcopy(agent.policy).cpu()(latent)), agent.latent_dim)


def _built_again(role: str, network: nn.Module, inputs: tuple[Tensor, ...], latent_dim: int) -> None:
    """A ConfigError if a network of your own, built from its arguments, would not compute the same; one that does not take the inputs is not asked."""
    arguments = _arguments(network, latent_dim)
    for value in arguments.values():
        if isinstance(value, nn.Module):
            _built_again(role, value, inputs, latent_dim)
    if type(network) in {**ENCODERS, **DYNAMICS, **POLICIES}.values():
        return
    mine, how = copy.deepcopy(network).cpu().eval(), f"set self.arguments = {{...}} in {type(network).__name__}.__init__, by name all that it was called with"
    with torch.random.fork_rng(devices=[]), torch.no_grad():  # saving draws no random numbers
        try:
            again = call_with(type(network), copy.deepcopy(arguments), role).eval().to(next(mine.parameters(), torch.zeros(())).dtype)
            again.load_state_dict(mine.state_dict())
        except (ConfigError, RuntimeError) as error:
            raise ConfigError(f"{role}: expected a network that can be built again from {arguments}, received one that cannot: {error}; {how}") from error
        try:
            found = []
            for net in (mine, again):
                torch.manual_seed(0)  # of a network that draws
                found.append(net(*inputs))
        except (RuntimeError, TypeError, ValueError):  # pictures of another size, or a part that takes something else
            return
    one, other = found
    if not torch.allclose(one, other, equal_nan=True):
        off = {k: (v, vars(again).get(k)) for k, v in vars(mine).items() if isinstance(v, int | float | str) and v != vars(again).get(k)}
        raise ConfigError(f"{role}: expected a network that computes the same when it is built again from {arguments}, received one that does not (it has and would have: {off}); {how}")


def _build(role: str, registry: dict[str, type[nn.Module]], spec: dict[str, Any], trust: bool) -> nn.Module:
    name = spec["class"]
    if name not in registry and ":" not in name:
        raise CheckpointError(
            f"expected one of the networks {sorted(registry)}, received '{name}'; name a network of your own as "
            "package.module:Class, or add it to the registries of torchrl_sspl.modules.agent before loading"
        )
    if name not in registry and not trust:
        raise CheckpointError(
            f"expected networks of this library, received '{name}', whose import runs code; if you trust whom the agent comes from, say so (trust)"
        )
    nested = {k: _build(role, registry, v, trust) for k, v in spec["arguments"].items() if isinstance(v, dict) and "class" in v}
    arguments = spec["arguments"] | nested
    try:
        if name in registry:
            return registry[name](**arguments)
        kind = resolve(name)
        if not (isinstance(kind, type) and issubclass(kind, nn.Module)):
            raise CheckpointError(f"expected a class of networks (nn.Module), received '{name}', which is none")
        return call_with(kind, arguments, role)
    except ConfigError as error:
        raise CheckpointError(f"the network '{name}' cannot be built: {error}") from error


def load(name_or_path: str | Path, device: torch.device | str = "cpu") -> Agent:
    """The shipped agent of a name (``"pendulum"``), or that of a run directory; errors as for :meth:`Agent.load`."""
    return Agent.load(agent_directory(name_or_path), device)


def agent_directory(name_or_path: str | Path) -> Path:
    """Directory in which the files of an agent lie: of a shipped one by name, or below a directory.

    If there is none, or a shipped agent and a folder here have the same name, it is a CheckpointError. Source: none.
    """
    shipped = Path(__file__).resolve().parent.parent / "agents"
    candidates = [Path(name_or_path), Path(name_or_path) / "agent"]
    found = [d for d in candidates if (d / DESCRIPTION_FILE).is_file()]
    if isinstance(name_or_path, str) and name_or_path.isidentifier():
        named = shipped / name_or_path
        if (named / DESCRIPTION_FILE).is_file() and found and not found[0].samefile(named):
            raise CheckpointError(
                f"'{name_or_path}' is a shipped agent and a folder here: give ./{name_or_path} for the folder, or "
                "start elsewhere"
            )
        found += [named] if (named / DESCRIPTION_FILE).is_file() else []
    if found:
        return found[0]
    names = sorted(p.name for p in shipped.iterdir() if (p / DESCRIPTION_FILE).is_file()) if shipped.is_dir() else []
    raise CheckpointError(
        f"expected the name of a shipped agent ({', '.join(names) or 'none is shipped'}) or a run directory with "
        f"{DESCRIPTION_FILE}, received '{name_or_path}'"
    )
