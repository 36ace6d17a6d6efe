r"""Phases that follow the joint training, as one hook of a TorchRL trainer, each resumable at any step.

A phase is a small object with a name, a size and ``run(work)``. What the phases share is the :class:`Workspace`; its
:class:`InnerLoop` is the one optimiser loop on frozen tensors. :class:`Phases` runs them in order, in any trainer.
"""

from __future__ import annotations

import copy
import json
import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch
from torch import Tensor, nn
from torchrl.trainers import Trainer, TrainerHookBase

from torchrl_sspl.certification.certificate import weights_digest
from torchrl_sspl.configs.schema import SynthesisConfig
from torchrl_sspl.direction import direction_of
from torchrl_sspl.errors import CheckpointError, ConfigError
from torchrl_sspl.files import append
from torchrl_sspl.journal import journal
from torchrl_sspl.modules.agent import Agent
from torchrl_sspl.modules.choosing import ChoosingPolicy
from torchrl_sspl.modules.observer import completed, filtered, gain_matrix
from torchrl_sspl.trainers.loggers import METRICS, log_scalars
from torchrl_sspl.trainers.progress import WORDS, Progress, round_line
from torchrl_sspl.trainers.source import Source

LOG_FILE = "log.jsonl"
_MOST_ACTIONS = 729  # in the grid that is tried at every latent
_PLAIN = ("kept_share", "logged_round", "level", "warnings", "skip")  # of a workspace's state, what JSON can write


def action_grid(action_scale: Sequence[float], per_dimension: int) -> Tensor:
    """``(k, m)``, a regular grid of actions up to a scale per dimension, coarser where many would make it too large.

    Raises ConfigError if the action has too many dimensions. Source: none.
    """
    m = len(action_scale)
    k = max(2, min(per_dimension, int(_MOST_ACTIONS ** (1 / m) + 1e-6)))
    if k**m > 8 * _MOST_ACTIONS:
        raise ConfigError(
            f"expected at most {int(math.log2(8 * _MOST_ACTIONS))} action dimensions, received {m}: a grid of actions is "
            "tried at every latent; with synthesis.enabled=false there is the joint training alone"
        )
    axes = [torch.linspace(-scale, scale, k) for scale in action_scale]
    return torch.cartesian_prod(*axes).reshape(-1, m)


class InnerLoop:
    """The optimiser loop on frozen tensors that all phases share: Adam, one cycle of the learning rate, exact resume.

    The seed is that of the generator that batches are drawn with. Source: none.

    Example:
        >>> weight = nn.Linear(1, 1)
        >>> loop = InnerLoop(seed=0)
        >>> loop(100, {weight: 0.1}, lambda: {"loss_square": weight(torch.ones(1)).square().sum()})
        >>> bool(weight(torch.ones(1)).square() < 0.1)
        True
    """

    def __init__(self, seed: int) -> None:
        self.generator = torch.Generator().manual_seed(seed)
        self.step = 0
        self.tick: Callable[[], None] = lambda: None  # after every step
        self.log: Callable[[dict[str, Any]], None] = lambda row: None
        self.loss: float | None = None  # of the last row in the log, for people
        self._live: tuple[Any, Any] | None = None
        self._saved: dict[str, Any] | None = None
        self._terms: dict[str, Tensor] = {}  # of the last step

    def pick(self, n: int, size: int) -> Tensor:
        """``(size,)`` rows of n, drawn uniformly."""
        return torch.randint(n, (size,), generator=self.generator)

    def __call__(self, steps: int, networks: dict[nn.Module, float], loss: Callable[[], Any]) -> None:
        """Take the steps that are missing.

        Args:
            steps: of this phase, in all.
            networks: what is trained, with the peak learning rate of each.
            loss: draws a batch, returns terms (a TensorDict or a dictionary); those named ``loss*`` are added up.

        Raises ConfigError if a loss is not finite.
        """
        adam = torch.optim.Adam([{"params": list(m.parameters()), "lr": lr} for m, lr in networks.items()])
        # Of ten steps the rise would be one minus one: OneCycleLR divides by it.
        total = 11 if steps == 10 else max(steps, 2)
        cycle = torch.optim.lr_scheduler.OneCycleLR(adam, list(networks.values()), total_steps=total, pct_start=0.1)
        parameters = [p for m in networks for p in m.parameters()]
        bounded: list[Any] = [part for m in networks for part in m.modules() if hasattr(part, "backtracking_step")]
        if self._saved is None:
            torch.manual_seed(int(torch.randint(2**31, (1,), generator=self.generator)))
        else:
            adam.load_state_dict(self._saved["optimiser"])
            cycle.load_state_dict(self._saved["schedule"])
            torch.set_rng_state(self._saved["global_rng"])
            self._saved = None
        self._live = adam, cycle
        while self.step < steps:
            terms = loss()
            objective = sum(value for key, value in terms.items() if key.startswith("loss"))
            for p in parameters:
                p.grad = None
            objective.backward()  # type: ignore[union-attr]
            before = [{k: v.clone() for k, v in part.state_dict().items()} for part in bounded]
            adam.step()
            for part, state in zip(bounded, before, strict=True):
                part.backtracking_step(state)  # its Lipschitz bound holds inside a cone alone
            cycle.step()
            self.step += 1
            self._terms = {k: v.detach() for k, v in terms.items()}
            if self.step % 100 == 0 or self.step == steps:
                row = self._row()
                self.loss = sum(v for k, v in row.items() if k.startswith("loss"))
                self.log({"step": self.step, **row})
            self.tick()
        self._live = None

    def _row(self) -> dict[str, float]:
        """The terms of the last step as numbers; a ConfigError if one is not finite."""
        row = {k: float(v) for k, v in self._terms.items()}
        if not all(map(math.isfinite, row.values())):
            raise ConfigError(
                f"expected finite losses, received {row} in step {self.step}; lower synthesis.lr, or take another "
                "seed, in another out_dir"
            )
        return row

    def restart(self) -> None:
        """For the next phase."""
        self.step, self._live, self._saved, self.loss, self._terms = 0, None, None, None, {}

    def state_dict(self) -> dict[str, Any]:
        """Step, generators, and the optimiser's state inside a phase; a ConfigError if the last loss was not finite: that is not worth keeping."""
        state: dict[str, Any] = {"step": self.step, "generator": self.generator.get_state(), "inside": self._live is not None}
        if self._live is not None:
            self._row()
            adam, cycle = self._live
            # OneCycleLR keeps a bound method.
            schedule = {k: v for k, v in cycle.state_dict().items() if not callable(v)}
            state |= {"optimiser": adam.state_dict(), "schedule": schedule, "global_rng": torch.get_rng_state()}
        return state

    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        """Restores what ``state_dict`` returned."""
        self.step = int(state["step"])
        self.generator.set_state(state["generator"])
        self._live, self._saved = None, dict(state) if state["inside"] else None


@dataclass
class Check:
    """Held-out checks of one round: observations and episodes that were not trained on, counted."""

    round: int
    level: float  # shift of the barrier with which the checks were made; {B <= level} became {B <= 0}
    unsafe_inside: int  # observations of U inside the set
    safe_outside: int  # observations of S outside the set
    left: int  # episodes that left the set
    touched: int  # episodes that touched U
    returned: float  # share of the episodes from U that ended inside the set
    size: float  # share of the unlabelled observations inside the set
    passed: bool  # whether the set may be returned
    reason: str  # why not
    tolerated: float = 0.0  # error that the set is proved to tolerate, latent units; 0 where that was not asked for
    covered: float = 0.0  # share of the episodes to which the proof applies from the first to the last step
    started: int = 0  # episodes that started in the set, of which ``left`` is counted; 0: not recorded


class Workspace:
    r"""What the phases share: a frozen encoder, its latents, and the networks that are trained on them.

    The networks are copies on the CPU; when the last phase is done, their weights go back into those that were given.

    Args:
        encoder: pixels -> latent; frozen here.
        dynamics, barrier, policy: on latents; TensorDictModules are unwrapped.
        config: settings of the phases.
        source: where transitions come from; ``None`` where all latents are given by the first phase.
        seed: seed of everything that is drawn.
        out_dir: where ``log.jsonl`` is written; ``None``: nowhere.
        description: whatever should travel with the agent.

    Source: paper Algorithm 1; deviation: two time scales, the encoder stands still while the rest is trained.
    """

    def __init__(
        self,
        encoder: nn.Module,
        dynamics: nn.Module,
        barrier: nn.Module,
        policy: nn.Module,
        *,
        config: SynthesisConfig | None = None,
        source: Source | None = None,
        seed: int = 0,
        out_dir: str | Path | None = None,
        description: dict[str, Any] | None = None,
    ) -> None:
        named = {"dynamics": dynamics, "barrier": barrier, "policy": policy}
        self.originals = {k: getattr(net, "module", net) for k, net in named.items()}
        self.encoder = getattr(encoder, "module", encoder)
        self.config, self.seed = config or SynthesisConfig(), seed
        self.source: Any = source
        self.out_dir = None if out_dir is None else Path(out_dir)
        self.description = dict(description or {})
        self.loop = InnerLoop(seed)
        self.loop.log = self.log
        self.logger: Any = None  # of TorchRL
        self.logged_step = 0
        self.where: dict[str, Any] = {"phase": "", "round": 0}
        seen = getattr(self.encoder, "seen_dim", None)
        self.seen_dim: int | None = None if seen == self.latent_dim else seen  # of a picture that does not show all of a latent
        self.direction = direction_of(self.originals["dynamics"])  # which entries of the latent are one
        self.gain = gain_matrix(self.config.gain, self.latent_dim, self.seen_dim)
        self.latents: dict[str, Tensor] = {}
        self.counterexamples = torch.zeros(0, self.latent_dim)
        self.changes = torch.zeros(0, self.latent_dim)  # of latents, by changes of their pictures that do not matter
        self.teacher_policy: nn.Module | None = None  # the policy that TeachPolicy left; targets are made of it
        self.kept_share: float | None = None  # of the latents outside U, what can be kept under the observed errors
        self.logged_round: int | None = None  # of which this is in the log
        self.best: dict[str, Any] | None = None
        self.checks: list[Check] = []
        self.level = 0.0  # {B <= level} is the set
        self.warnings: list[str] = []
        self.skip = False  # nothing more can be done on these latents, or has to be
        self.cache: dict[str, Any] = {}  # what a phase can compute again
        self.begin()

    def begin(self) -> None:
        """Take the weights that the joint training has reached."""
        self.networks = nn.ModuleDict({k: copy.deepcopy(net).cpu() for k, net in self.originals.items()})

    @property
    def dynamics(self) -> Any:
        """(latent, action) -> next latent."""
        return self.networks["dynamics"]

    @property
    def barrier(self) -> Any:
        """Latent -> barrier value."""
        return self.networks["barrier"]

    @property
    def policy(self) -> Any:
        """Latent -> action."""
        return self.networks["policy"]

    @property
    def latent_dim(self) -> int:
        """Size p of the latent."""
        return int(self.originals["dynamics"].latent_dim)  # type: ignore[arg-type]

    @property
    def lipschitz_bound(self) -> float:
        """L_B of the barrier."""
        return float(self.originals["barrier"].lipschitz_bound)  # type: ignore[arg-type]

    @property
    def action_scale(self) -> list[float]:
        """Largest action per dimension, physical units."""
        return self.originals["dynamics"].action_scale.flatten().tolist()  # type: ignore[operator, union-attr]

    def unsafe(self) -> Tensor:
        """``(n,)`` whether a transition starts in U."""
        return self.latents["region"][:, 0] == 2

    @property
    def observing(self) -> bool:
        """Whether the latent observer has a memory."""
        return not torch.equal(self.gain, torch.eye(self.latent_dim))

    def filtered(self, part: dict[str, Tensor]) -> dict[str, Tensor]:
        """Transitions of a source, with what the observer makes of them by the present dynamics."""
        if not self.observing:
            return part | {"latent": part["seen"], "next_latent": part["next_seen"]}
        latent, after = filtered(self.dynamics, self.gain, *(part[k] for k in ("seen", "next_seen", "action", "continues")))
        of_latents = {"seen": latent, "next_seen": after}
        whole = {k: completed(part[k], known, self.gain) for k, known in of_latents.items()}
        return part | whole | {"latent": latent, "next_latent": after}

    def agent(self, level: float | None = None) -> Agent:
        """A frozen copy of the present networks; {B <= level} becomes {B <= 0}."""
        level, nets = self.level if level is None else level, self.networks.values()
        return Agent.from_networks(self.encoder, *nets, level=level, description=self.description, **self.acts())

    def acts(self) -> dict[str, Any]:
        """How the agent acts on its latents: the observer's gain, and what the policy chooses from."""
        s, scale = self.config, self.action_scale
        choices = action_grid(scale, s.choices) if s.choices else None
        return {"gain": self.gain, "choices": choices, "choice_margin": s.choice_margin}

    @property
    def acting(self) -> Any:
        """What acts on latents: the policy, which chooses where it is told to."""
        s = self.config
        if not s.choices:
            return self.policy
        choosing = ChoosingPolicy(self.policy, action_grid(self.action_scale, s.choices), s.choice_margin)
        choosing.bind(self.dynamics, self.barrier)
        return choosing

    def keep(self, rank: Any, number: int, level: float) -> None:
        """Remember the present networks as the best so far."""
        state = {k: v.clone() for k, v in self.networks.state_dict().items()}
        self.best = {"rank": list(rank), "round": number, "level": level, "networks": state}

    def finish(self) -> None:
        """The best networks, or the last ones where none was kept, go back to where they came from."""
        if self.best is not None:
            self.networks.load_state_dict(self.best["networks"])
            self.level = self.best["level"]
        for name, net in self.originals.items():
            net.load_state_dict(self.networks[name].state_dict())

    def log(self, row: dict[str, Any]) -> None:
        """Append a line to ``log.jsonl``, and give its numbers to the logger."""
        if self.out_dir is not None:
            append(self.out_dir / LOG_FILE, json.dumps({**self.where, **row}))
        log_scalars(self.logger, {k: v for k, v in row.items() if k in METRICS}, self.logged_step)

    def log_once(self, row: dict[str, Any]) -> None:
        """Log what is computed once a round, and again where a run goes on in the middle of one."""
        if self.logged_round != self.where["round"]:
            self.logged_round = self.where["round"]
            self.log(row)

    def state_dict(self) -> dict[str, Any]:
        """Everything that cannot be computed again."""
        plain = {key: getattr(self, key) for key in _PLAIN}
        plain["checks"] = [vars(c) for c in self.checks]
        plain["budget"] = {} if self.source is None else self.source.budget
        return {
            "networks": self.networks.state_dict(),
            "latents": dict(self.latents),
            "counterexamples": self.counterexamples,
            "changes": self.changes,
            "teacher_policy": None if self.teacher_policy is None else self.teacher_policy.state_dict(),
            "best": self.best,
            "plain": json.dumps(plain),
            "loop": self.loop.state_dict(),
        }

    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        """Restores what ``state_dict`` returned."""
        state = _own(state)
        self.networks.load_state_dict(state["networks"])
        self.latents, self.counterexamples, self.best = dict(state["latents"]), state["counterexamples"], state["best"]
        self.changes = state["changes"]
        if state["teacher_policy"] is not None:
            self.teacher_policy = copy.deepcopy(self.policy).requires_grad_(False)
            self.teacher_policy.load_state_dict(state["teacher_policy"])
        plain = json.loads(state["plain"])
        for key in _PLAIN:
            setattr(self, key, plain[key])
        self.checks = [Check(**c) for c in plain["checks"]]
        if self.source is not None:
            self.source.budget.update(plain["budget"])
        self.loop.load_state_dict(state["loop"])


class Phase:
    """One phase of a round; subclass it and give ``run``, and ``size`` where it takes optimiser steps. Source: none.

    Example:
        >>> class CountUnsafe(Phase):
        ...     name = "count"
        ...     def run(self, work):
        ...         work.log({"step": 0, "unsafe": int(work.unsafe().sum())})
        >>> CountUnsafe(1).number
        1
    """

    name = "phase"
    pictures = False  # whether it needs those of the joint training; then checkpoints hold them until it is done

    def __init__(self, number: int = 0) -> None:
        self.number = number

    def size(self, work: Workspace) -> int:
        """Optimiser steps that it takes, at least 1; for the progress bar."""
        return 1

    def run(self, work: Workspace) -> None:
        """Do it; after an interruption it is called again, with ``work.loop`` where it was."""
        raise NotImplementedError


class Phases(TrainerHookBase):
    """Runs phases on what they share, in order, when a trainer has collected all of its transitions.

    ``progress`` shows a bar. Source: paper Algorithm 1; deviation: two time scales.

    Example:
        >>> Phases([], None).state_dict()["done"]
        0
    """

    def __init__(self, phases: Sequence[Phase], work: Any, *, progress: bool = False) -> None:
        self.phases, self.work, self.progress = list(phases), work, progress
        self.done, self.resumed = 0, False
        self.weights: list[str] = []  # digests of them, as the phase began
        self.trainer: Any = None
        self.bar: Any = None  # of the trainer, where it has one for both

    @property
    def finished(self) -> bool:
        """Whether all phases are done."""
        return self.done == len(self.phases)

    @property
    def begun(self) -> bool:
        """Whether the first phase is done, or has taken a step."""
        return self.work is not None and (self.done > 0 or self.work.loop.step > 0)

    @property
    def needs_pictures(self) -> bool:
        """Whether pictures of the joint training are needed to go on."""
        return any(phase.pictures for phase in self.phases[self.done :])

    @property
    def steps(self) -> int:
        """Optimiser steps of all phases."""
        return sum(phase.size(self.work) for phase in self.phases)

    @property
    def steps_done(self) -> int:
        """Optimiser steps taken so far, over all phases."""
        before = sum(phase.size(self.work) for phase in self.phases[: self.done])
        return before + (0 if self.finished else self.work.loop.step)

    def __call__(self) -> None:
        """Runs the phases if the trainer has collected all of its transitions, or was asked to stop."""
        if self.trainer.collected_frames >= self.trainer.total_frames or self.trainer._stop_training:
            self.run()

    def run(self) -> None:
        """Run, or continue, all phases."""
        if self.finished:
            return
        work, base = self.work, 0 if self.trainer is None else self.trainer._optim_count
        if not self.resumed:
            self._save(force_save=True)  # the joint training is done
            work.begin()
        work.loop.tick = self._tick
        for net in (work.encoder, work.networks):
            net.eval()  # as in the agent: dropout would show other latents each time
        own_bar = self.bar is None
        if own_bar:
            self.bar = Progress(self.steps, self.steps_done, shown=self.progress, out_dir=work.out_dir)
        if work.source is not None:
            work.source.tell = self.bar.saw
        before = self.bar.n - self.steps_done
        rounds = 1 + max(phase.number for phase in self.phases)
        while not self.finished:
            phase = self.phases[self.done]
            work.where = {"phase": phase.name, "round": phase.number}
            work.logged_step = base + self.steps_done
            self._show(phase, rounds)
            if not work.skip:
                if work.loop.step == 0:  # what a phase computes first still counts when its steps have moved the weights
                    self.weights = [weights_digest(net.state_dict()) for net in (work.encoder, work.networks)]
                with journal(work.out_dir, f"{phase.name}-{phase.number}", *self.weights, beat=self.bar.beat):
                    phase.run(work)
            work.loop.restart()
            self.done += 1
            self.bar.move(before + self.steps_done)
            self._tell(phase)
            if self.finished:
                work.finish()
            self._save(force_save=True)  # what comes next may take long and have no steps
        if own_bar:
            self.bar.close()

    def _show(self, phase: Phase, rounds: int) -> None:
        """Which phase it is, in words."""
        words = WORDS.get(phase.name, phase.name)
        words = f"round {phase.number + 1} of {rounds}: {words}" if rounds > 1 else words
        self.bar.begin(words, phase.size(self.work), taken=self.work.loop.step, left=len(self.phases) - self.done - 1)

    def _tell(self, phase: Phase) -> None:
        """What came out of a phase, as far as people want to know."""
        work = self.work
        if phase.name == "check" and work.checks:
            self.bar.say(round_line(work.checks[-1], work.config.check_episodes))
            self.bar.kept = max([c.size for c in work.checks if c.passed], default=0.0)
        elif phase.name == "level" and not work.skip:
            self.bar.say(f"zero level placed at {work.level:.3g}, between held-out observations of U and S")

    def _tick(self) -> None:
        self.bar.tick(lambda: self.work.loop.loss)
        self.work.logged_step += 1
        self._save()

    def _save(self, **options: Any) -> None:
        if self.trainer is not None:
            self.trainer.save_trainer(**options)

    def state_dict(self) -> dict[str, Any]:
        """Which phases are done, and the workspace once the first has begun."""
        work = self.work.state_dict() if self.begun else None
        listed = [[phase.name, phase.number] for phase in self.phases]
        return {"done": self.done, "begun": self.begun, "weights": self.weights, "work": work, "phases": listed}

    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        """Restores what ``state_dict`` returned."""
        if int(state["done"]) > len(self.phases):
            raise CheckpointError(
                f"expected a checkpoint of these {len(self.phases)} phases, received one after {state['done']}; leave what adds phases (evaluation.calibrate, "
                "synthesis) as it was, or give another out_dir"
            )
        count = int(state["done"]) + bool(state["begun"])  # those that are over, and the one that goes on
        before = [tuple(phase) for phase in state.get("phases", [])[:count]]
        now = [(phase.name, phase.number) for phase in self.phases[:count]]
        if before and before != now:  # none: of an earlier version
            raise CheckpointError(
                f"expected a checkpoint of phases that begin with {now}, received one of {before}; leave those that have begun as they were, or begin "
                "again in another out_dir"
            )
        self.done, self.resumed, self.weights = int(state["done"]), bool(state["begun"]), state.get("weights", [])
        if self.resumed:
            self.work.load_state_dict(state["work"])

    def register(self, trainer: Trainer, name: str = "phases") -> None:
        self.trainer = trainer
        trainer.register_op("post_steps", self)
        trainer.register_op("shutdown", self)  # of a training that is resumed when its collector has ended
        trainer.register_op("post_steps_log", lambda batch: self())  # of a training that ended in this very stage, before its collector ends
        trainer.register_module(name, self)


def _own(value: Any) -> Any:
    """Copies of tensors that lie in a checkpoint's files."""
    if isinstance(value, Tensor):
        return torch.empty_like(value, memory_format=torch.contiguous_format).copy_(value)
    if isinstance(value, Mapping):
        return {k: _own(v) for k, v in value.items()}
    if isinstance(value, (list, tuple)):
        return type(value)(_own(v) for v in value)
    return value


__all__ = ["Check", "InnerLoop", "Phase", "Phases", "Workspace"]
