r"""This library's own method as a row: an agent trained by the library's own run, or one that has been trained before.

``agent=pendulum`` and ``agent=quadruped`` are the shipped ones, trained with a budget of their own, which is in the ledger. Without ``agent`` the run of ``env=...`` is trained with the transitions of the budget; the small one takes one round
without rollouts of its own, and so without the memory that the shipped pendulum has. Labels are fewer than the budget allows: of
episodes that start in S or U some leave it. The agent's policy acts by itself; ``filter=true`` puts its safety filter behind the nominal policy.
"""

from __future__ import annotations

import json
import time
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, ClassVar

import torch
from torch import Tensor

from torchrl_sspl.baselines.base import EARLIER, SCHEMA, Budget, Guarded, Needs, Nominal, SafetyMethod
from torchrl_sspl.configs.reader import compose
from torchrl_sspl.configs.schema import Config
from torchrl_sspl.envs import DubinsEnv, PendulumEnv
from torchrl_sspl.envs.base import SafetyEnv
from torchrl_sspl.errors import ConfigError, OutputError
from torchrl_sspl.evaluation.controllers import AgentController, Camera
from torchrl_sspl.experiments.run import Experiment
from torchrl_sspl.files import write
from torchrl_sspl.modules.agent import Agent, agent_directory, load
from torchrl_sspl.runtime.filter import LEVEL, UNPROVED_MARGIN, Shield
from torchrl_sspl.trainers.phases import Check

CPU_FILE = "cpu.json"  # of a training: s of the processor, and the schema of the version that began it
BUDGET_FILE = "budget.json"  # of a training: what was counted of its data
# As recommended before pictures were changed: the score's have no noise to be steady under, and an error of one step adds up in a memory alone.
_PLAIN = ["augmentation.share=0.0", "synthesis.steady_steps=0", "synthesis.dynamics_steps=1500", "synthesis.unsafe_margin=0.05"]
# One round has no second one that mends it: its checks may move the set farther in, as with few labels.
_ONE_ROUND = ["synthesis.rounds=1", "synthesis.lowest_level=-0.2", "synthesis.guard=0.005", "synthesis.safe_share=0.03"]


def settings(system: str, budget: Budget) -> list[str]:
    """``key=value`` of a training with the transitions of a budget: the recommended settings of a system, with as many steps.

    What differs: where episodes start, how much is recorded and how often it is learnt from; with rollouts, that a further round draws
    no more of them than the budget has. Without rollouts it is one round; neither a memory nor a proof of one is asked for
    (``gain``, ``tolerated_error``, ``cover_share``); the checks may lower the level further (``lowest_level``, ``guard``, ``safe_share``); and
    where the recommended pictures are changed for a memory to be steady under, they are not (``augmentation.share``, ``steady_steps``, with
    ``dynamics_steps`` and ``unsafe_margin`` that go with that).

    Source: none.

    Example:
        >>> settings("pendulum", Budget("small", 16_000, 3_000, 4_000))[1:5:3]
        ['collector.starts=[0.3478, 0.3478, 0.1304, 0.1739]', 'trainer.optim_steps_per_batch=4000']
    """
    shares = [0.5 * budget.transitions, 0.5 * budget.transitions, budget.safe, budget.unsafe]
    first, usual = budget.total - budget.rollouts, compose([f"env={system}"])
    batch, most = usual.collector.frames_per_batch, usual.trainer.total_frames
    frames = -(-first // batch) * batch
    plan = [f"env={system}", f"collector.starts={[round(s / sum(shares), 4) for s in shares]}"]
    if budget.rollouts:
        # Rollouts as recommended where the budget has them; those from U that a further round draws share the rest.
        further, s = max(1, usual.synthesis.rounds - 1), usual.synthesis
        rollouts = min(s.rollout_transitions, budget.rollouts // further)
        rim = min(s.rim_transitions, (budget.rollouts // further - rollouts) // s.rim_draws)
        return [
            *plan, f"trainer.total_frames={min(frames, most)}", f"synthesis.transitions={first}",
            f"synthesis.rollout_transitions={rollouts}", "synthesis.near_draws=1", f"synthesis.rim_transitions={rim}",
        ]  # fmt: skip
    return [
        *plan, *recorded_first(usual, frames), f"buffer.capacity={max(frames, usual.buffer.capacity)}", f"synthesis.transitions={frames}", *_ONE_ROUND, "synthesis.rollout_transitions=0", "synthesis.rim_transitions=0",
        # A memory, and what is proved of it, are learnt from rollouts.
        "synthesis.gain=1.0", "synthesis.tolerated_error=0.0", "synthesis.cover_share=0.0",
        *(_PLAIN if usual.synthesis.steady_steps else []),
    ]  # fmt: skip


def recorded_first(usual: Config, frames: int) -> list[str]:
    """``key=value`` with which everything is recorded before the first step, and as many steps are taken as with the usual settings.

    Source: none.

    Example:
        >>> recorded_first(compose(["env=quadruped"]), 640)[2]
        'trainer.optim_steps_per_batch=30'
    """
    batch = usual.collector.frames_per_batch
    learning = -(-usual.trainer.total_frames // batch) - -(-usual.random_frames() // batch) + 1
    steps = usual.trainer.optim_steps_per_batch * learning
    return [f"trainer.total_frames={frames}", f"collector.init_random_frames={frames}", f"trainer.optim_steps_per_batch={steps}"]


def needs_of(counted: Mapping[str, int] | None) -> Needs:
    """What a training was given, from the counts that it keeps of its data; None: it kept none.

    Source: none.

    Example:
        >>> needs_of({"transitions": 640, "labels of S": 100, "chosen labels of S": 7, "chosen labels of neither": 20}).safe_labels
        107
    """
    if counted is None:
        return Needs(None, None, None, None, rollouts=None, held_out_labels=None, held_out_steps=None)
    labels = {name: sum(counted.get(f"{how} of {name}", 0) for how in ("labels", "chosen labels")) for name in ("S", "U", "neither")}
    return Needs(
        transitions=counted.get("transitions", 0), safe_labels=labels["S"], unsafe_labels=labels["U"], neither_labels=labels["neither"],
        rollouts=counted.get("transitions of rollouts"),
        held_out_labels=counted.get("held-out pictures with a label"), held_out_steps=counted.get("held-out steps with a label"),
    )  # fmt: skip


@dataclass
class SSPLConfig:
    """Options of this library's own row."""

    agent: str = ""  # shipped agent or run directory; "": train
    filter: bool = False  # behind the nominal policy, in place of the agent's own policy
    level: float = LEVEL  # of the filter
    overrides: list[str] = field(default_factory=list)  # further key=value of the training


class SSPL(SafetyMethod):
    """SSPL, this library's own method: from a few labels, without states and model. Source: the paper."""

    name, records, pools = "sspl", False, False
    Config: ClassVar[type | None] = SSPLConfig
    space: ClassVar[dict[str, tuple[Any, ...]]] = {
        "overrides": ("[]", "[synthesis.residual_spread=1.0]", "[synthesis.residual_spread=2.0]", "[synthesis.margin=0.03]", "[synthesis.tune_steps=8000]"),
    }  # fmt: skip

    checks: Sequence[Check] = ()  # of its training, by round

    def __init__(self, config: Any = None) -> None:
        super().__init__(config)
        if not self.config.level <= 0.0:
            raise ConfigError(f"{self.name}: expected level <= 0, of the filter, received {self.config.level}; such as level={LEVEL}")

    def fit(self, data: Any, env: SafetyEnv, budget: Budget, seed: int) -> None:
        """Load the agent, or train one with the budget; see :meth:`SafetyMethod.fit`."""
        self.env = env
        if self.config.agent:
            self.agent = load(self.config.agent)
            counted = self._told()
        else:
            self.agent, counted = self._train(env, budget, seed)
        proved = "invariance in the learned latent dynamics" if self.agent.tolerated_error > 0 else "the barrier's Lipschitz constant"
        self.needs = replace(needs_of(counted), proved=proved, measured="level and round, on held-out episodes", claimed="invariance of {B <= 0}")
        shield = None
        if self.config.filter:
            margin = None if self.agent.tolerated_error > 0 else UNPROVED_MARGIN
            shield = Shield(self.agent, level=self.config.level, margin=margin)
        self.shield = shield

    def _told(self) -> dict[str, int] | None:
        """What an agent that was trained before says of its data; None if it says nothing."""
        folder = agent_directory(self.config.agent)
        if (folder.parent / BUDGET_FILE).is_file():  # of a row of the table
            return json.loads((folder.parent / BUDGET_FILE).read_text())
        found = folder / "evaluation.json"
        return json.loads(found.read_text()).get("budget") if found.is_file() else None

    def _train(self, env: SafetyEnv, budget: Budget, seed: int) -> tuple[Agent, dict[str, int]]:
        if self.directory is None or not self.env_name:
            raise ConfigError("sspl: expected a directory and a system for the training, received none; run it as a cell")
        if type(env) not in (PendulumEnv, DubinsEnv):
            raise ConfigError(f"sspl: expected env=pendulum or env=dubins, received {type(env).__name__}; of other systems give agent=, a run of 'sspl train'")
        plan = ["logger=none", "trainer.progress=false", "evaluation.calibrate=true", f"seed={seed}", f"out_dir={self.directory / 'run'}"]
        plan = [*settings(self.env_name, budget), *plan]
        experiment = Experiment(compose([*plan, *self.config.overrides]))
        with self._timed(experiment.directory / CPU_FILE):
            agent = experiment.train().cpu()
        self.checks = experiment.work.checks
        self.notes["passed"] = float(any(check.passed for check in self.checks))
        experiment.work.source.count_stored()  # of a training without phases nothing is counted before
        counted = dict(experiment.work.source.budget)
        write(experiment.directory / BUDGET_FILE, json.dumps(counted, indent=1) + "\n")
        return agent, counted

    @contextmanager
    def _timed(self, path: Path) -> Iterator[None]:
        """Notes the CPU time that earlier processes took of a training which goes on, and keeps that of all beside it.

        An OutputError if they were of a version with other recordings or encoders.
        """
        told = json.loads(path.read_text()) if path.is_file() else {"schema": SCHEMA, "seconds": 0.0}
        if told.get("schema") != SCHEMA:
            raise OutputError(f"expected a training of schema {SCHEMA} in '{path.parent}', found one of another version of this library; remove that folder, and it is trained anew")
        before, begun = told["seconds"], time.process_time()
        self.notes[EARLIER] = before

        def keep() -> None:
            write(path, json.dumps({"schema": SCHEMA, "seconds": before + time.process_time() - begun}) + "\n")

        keep()
        try:
            yield
        finally:
            keep()

    def barrier(self, seen: Tensor) -> Tensor | None:
        """The barrier of what is seen, without a memory."""
        return self.agent.barrier(self.agent.encode(seen))[:, 0].detach()

    def act(self, seen: Tensor, nominal: Tensor) -> tuple[Tensor, Tensor]:
        """The agent's action on one observation, without a memory; the loop has one, see :meth:`controller`."""
        latent = self.agent.encode(seen)
        if self.shield is None:
            return self.agent.policy(latent).detach(), torch.zeros(len(seen), dtype=torch.bool)
        return self.protected(latent, nominal)

    def protected(self, latent: Tensor, wanted: Tensor) -> tuple[Tensor, Tensor]:
        """What the safety filter makes of wanted actions ``(n, m)``, and where no action surely keeps the set, ``(n,)``."""
        assert self.shield is not None
        found = self.shield(latent, wanted)
        return found.action, found.margin < self.shield.level

    def controller(self, nominal: Nominal) -> Guarded:
        """The agent in a closed loop, with the memory that belongs to it."""
        return _Remembering(self, nominal)


class _Driver:
    """The nominal policy as a controller that an agent watches."""

    reads, streams = "pixels", True

    def __init__(self, nominal: Nominal) -> None:
        self.nominal = nominal

    def reset(self, rows: Tensor | None = None) -> None:
        """It has no memory."""

    def step(self, camera: Any, rows: Tensor | None = None) -> Any:
        from torchrl_sspl.evaluation.controllers import Decision

        return Decision(self.nominal(camera.state))


class _Remembering(Guarded):
    """An agent behind its observer, by itself or as a filter."""

    def __init__(self, method: SSPL, nominal: Nominal) -> None:
        super().__init__(method, nominal)
        self.lost: Tensor | None = None  # (n,) of the last step
        if method.shield is None:
            self.inner = AgentController(method.agent)
            return

        def change(latent: Tensor, wanted: Tensor) -> Tensor:
            action, self.lost = method.protected(latent, wanted)
            return action

        self.inner = AgentController(method.agent, _Driver(nominal), change)

    def reset(self, rows: Tensor | None = None) -> None:
        """Forget what belongs to all or to some of the episodes."""
        self.inner.reset(rows)

    def decide(self, camera: Camera, rows: Tensor | None, wanted: Tensor) -> tuple[Tensor, Tensor]:
        """The agent's actions; its policy has no condition that could fail, its filter does where no action keeps the set."""
        action = self.inner.step(camera, rows).action
        if self.lost is None:
            return action, torch.zeros(len(action), dtype=torch.bool)
        return action, self.lost if rows is None else self.lost[rows]


__all__ = ["SSPL"]
