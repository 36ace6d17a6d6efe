"""Training on latents that stand still: dynamics, policy and barrier of a frozen encoder, with exact resume."""

from __future__ import annotations

import copy
import json
import math
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import torch
from tensordict import TensorDict
from torch import Tensor, nn
from torchrl.objectives import SoftUpdate
from tqdm import tqdm

from torchrl_sspl.certification.conditions import closed_loop, find_counterexamples
from torchrl_sspl.errors import CheckpointError, ConfigError
from torchrl_sspl.objectives import ActionValueLoss, SynthesisLoss, TargetLoss
from torchrl_sspl.objectives.latent_viability import (
    barrier_targets,
    nearby_residuals,
    nearest_distance,
    normal_projectors,
    reach_times,
    robust_invariant_set,
    safety_values,
    signed_margin,
    value_targets,
)
from torchrl_sspl.sets import SAFE, UNSAFE
from torchrl_sspl.trainers.config import TrainingConfig
from torchrl_sspl.trainers.loggers import METRICS, log_scalars

CHECKPOINT_FILE = "checkpoint.pt"
_KNOWN_WITHIN = 0.06  # distance from the data beyond which a way back is not looked for
_VALUE_SCALE = 0.05  # distance of latents in which values of actions are measured
_SPREADS = (1.0, 0.75, 0.5, 0.25, 0.0)  # shares of the errors that are tolerated, the first that keeps S
_KEPT_OF_SAFE = 0.9
_MOST_ACTIONS = 729  # in the grid that is tried at every latent
_SEARCH_EVERY = 250  # steps between two searches for counterexamples


class LatentTraining:
    r"""Trains dynamics, policy and barrier on encoded transitions that stand still.

    The dynamics are fitted once more, then the policy is taught the values of its actions on the cloud of latents, the
    barrier the margin that this policy keeps (or both the largest robust invariant set; see ``synthesis.teacher``), and
    both are tuned together on the condition :math:`B(z) \le 0 \Rightarrow B(d(z, \pi(z)) + e) + m \le 0` under the observed
    errors e. Interrupted at any step, it continues as if nothing had happened.

    Args:
        config: sizes, steps, seed, folder of the checkpoints.
        networks: ``"dynamics"``, ``"barrier"`` and ``"policy"``; trained in place.
        action_scale: largest action per dimension, physical units.
        latents: ``"latent"`` and ``"next_latent"`` ``(n, p)``, ``"action"`` ``(n, m)``, ``"region"`` ``(n, 1)`` codes.
        resume: continue from the checkpoint in ``config.out_dir`` if there is one of the same latents.

    Raises:
        ConfigError: if a checkpoint of another configuration is found.
        CheckpointError: if the checkpoint cannot be read.

    Source: paper Algorithm 1; deviations: targets from the data, condition R3 in place of a decrease everywhere (see
    docs/deviations.md).
    """

    logger: Any = None  # of TorchRL; gets the numbers that go to log.jsonl

    def __init__(
        self,
        config: TrainingConfig,
        networks: dict[str, nn.Module],
        *,
        action_scale: Sequence[float],
        latents: dict[str, Tensor] | None = None,
        resume: bool = True,
    ) -> None:
        self.config, self.action_scale = config, list(action_scale)
        config.synthesis.check()
        self.out_dir = Path(config.out_dir)
        self.out_dir.mkdir(parents=True, exist_ok=True)
        self.networks = nn.ModuleDict(networks)
        self.dynamics: Any = networks["dynamics"]
        self.barrier: Any = networks["barrier"]
        self.policy: Any = networks["policy"]
        self.generator = torch.Generator().manual_seed(config.seed)
        self.latents: dict[str, Tensor] = latents or {}
        self.counterexamples = torch.zeros(0, config.network.latent_dim)
        self.phase, self.step, self.seconds = 0, 0, 0.0
        self._loop_state: dict[str, Any] | None = None
        self._target_round: int | None = None
        self.taught: nn.Module | None = None
        self.kept_share: float | None = None  # of the latents outside U, what can be kept under the observed errors
        self._target_table: TensorDict
        self._rim: TensorDict
        self._last_checkpoint = time.monotonic()
        self._clock = time.monotonic()
        if (self.out_dir / CHECKPOINT_FILE).is_file():
            if resume:
                self._restore()
            else:
                self._forget()

    # ------------------------------------------------------------------ schedule

    def phases(self) -> list[tuple[str, int]]:
        """Names of the phases in order, with the round that each belongs to."""
        return [(name, 0) for name in self._latent_phases()]

    def _latent_phases(self) -> list[str]:
        return ["dynamics", *(["teach"] if self.config.synthesis.teacher == "value" else []), "fit", "steer", "tune"]

    def train_phases(self) -> None:
        """Train, or continue to train, through all phases."""
        phases = self.phases()
        self._clock = time.monotonic()
        # One bar over all phases, in units of optimiser steps, so that its estimate of the time left means something.
        sizes = [self._size(name) for name, _ in phases]
        self._bar = tqdm(
            total=sum(sizes),
            initial=sum(sizes[: self.phase]) + self.step,
            disable=not self.config.progress,
            unit="step",
        )
        while self.phase < len(phases):
            name, number = phases[self.phase]
            self._bar.set_description(f"{name} {number}" if len({k for _, k in phases}) > 1 else name)
            self.networks.to(self._device_of(name))
            getattr(self, f"_phase_{name}")(number)
            self._loop_state = None
            self.phase, self.step = self.phase + 1, 0
            self._checkpoint()
        self._bar.close()
        self.networks.to("cpu")

    def _device_of(self, phase: str) -> torch.device | str:
        """Small networks on latents are no work for a GPU."""
        return "cpu"

    def _size(self, name: str) -> int:
        s = self.config.synthesis
        return {
            "dynamics": s.dynamics_steps,
            "teach": s.teach_steps,
            "fit": s.fit_steps,
            "steer": s.steer_steps,
            "tune": s.tune_steps,
        }.get(name, 1)

    def _loop(
        self,
        steps: int,
        optimisers: dict[nn.Module, float],
        loss: Callable[[], TensorDict],
        *,
        clip: float | None = None,
        delayed: nn.Module | None = None,
    ) -> None:
        """Optimiser steps of one phase; interrupted at any of them, it continues as if nothing had happened."""
        modules = list(optimisers)
        # theta^-, where the loss keeps it.
        updater = None if delayed is None else SoftUpdate(delayed, tau=self.config.representation.target_tau)
        adam = torch.optim.Adam([{"params": list(m.parameters()), "lr": lr} for m, lr in optimisers.items()])
        # Of ten steps the rise would be one minus one: OneCycleLR divides by it.
        total = 11 if steps == 10 else max(steps, 2)
        cycle = torch.optim.lr_scheduler.OneCycleLR(
            adam, [lr for lr in optimisers.values()], total_steps=total, pct_start=0.1
        )
        parameters = [p for m in modules for p in m.parameters()]
        if self._loop_state is not None:
            adam.load_state_dict(self._loop_state["optimiser"])
            cycle.load_state_dict(self._loop_state["schedule"])
            self.generator.set_state(self._loop_state["generator"])
            torch.set_rng_state(self._loop_state["global_rng"])
            if delayed is not None:
                delayed.load_state_dict(self._loop_state["delayed"])
        else:
            torch.manual_seed(int(torch.randint(2**31, (1,), generator=self.generator)))
        while self.step < steps:
            terms = loss()
            objective = sum(value for key, value in terms.items() if key.startswith("loss"))
            for p in parameters:
                p.grad = None
            objective.backward()  # type: ignore[union-attr]
            if clip is not None:
                nn.utils.clip_grad_norm_(parameters, clip)
            adam.step()
            self._after_step()
            cycle.step()
            if updater is not None:
                updater.step()
            self.step += 1
            self._bar.update()
            if self.step % 100 == 0 or self.step == steps:
                row = {k: float(v.detach()) for k, v in terms.items()}
                if not all(map(math.isfinite, row.values())):
                    raise ConfigError(
                        f"expected finite losses, received {row} in step {self.step}; lower the learning rate, or resume "
                        "from the last checkpoint with another seed"
                    )
                self._log({"step": self.step, **row})
            if self.step < steps and time.monotonic() - self._last_checkpoint > self.config.checkpoint_seconds:
                self._loop_state = {
                    "optimiser": adam.state_dict(),
                    "schedule": cycle.state_dict(),
                    "generator": self.generator.get_state(),
                    "global_rng": torch.get_rng_state(),
                    "delayed": None if delayed is None else delayed.state_dict(),
                }
                self._checkpoint()

    def _after_step(self) -> None:
        """What follows every step of an optimiser; nothing here."""

    def _pick(self, n: int, size: int) -> Tensor:
        return torch.randint(n, (size,), generator=self.generator)

    # ------------------------------------------------------------------ phases

    def _phase_dynamics(self, number: int) -> None:
        """Dynamics on latents that stand still; off the manifold they lead back to it."""
        s, data = self.config.synthesis, self.latents
        tube, base = self._tube(data["latent"], 1.3 * s.tube_radius, number)
        on, off = 2 * s.batch // 6, s.batch // 6

        def step() -> TensorDict:
            a, c = self._pick(len(data["latent"]), on), self._pick(len(tube), off) if len(tube) else None
            z, index = data["latent"][a], a
            if c is not None:
                z, index = torch.cat([z, tube[c]]), torch.cat([a, base[c]])
            error = (self.dynamics(z, data["action"][index]) - data["next_latent"][index]).square().sum(-1)
            error = torch.where(data["region"][index, 0] == UNSAFE, s.unsafe_weight * error, error)
            return TensorDict(
                loss_consistency=error.mean() + 0.2 * error.topk(max(1, len(error) // 20)).values.mean(),
                dynamics_error_max=error.detach().max().sqrt(),
            )

        self._loop(
            s.dynamics_steps if number == 0 else s.dynamics_steps // 2,
            {self.dynamics: 3e-3 if number == 0 else 2e-3},
            step,
        )

    def _phase_teach(self, number: int) -> None:
        """The policy alone, on the values of its actions; what it then keeps is what the barrier is taught."""
        s, data = self.config.synthesis, self.latents
        g = torch.Generator().manual_seed(self.config.seed + 99_000 + number)
        z, unsafe = data["latent"], data["region"][:, 0] == UNSAFE
        actions = _action_grid(self.action_scale, s.actions)
        _, axes = self._errors(z, g, s.teach_spread)
        successors = self._successors(z, actions)
        value = safety_values(successors, z, signed_margin(z, unsafe), residuals=axes)
        # In U nothing can be kept any more: the soonest way out.
        times = reach_times(successors[unsafe], z[unsafe], z[~unsafe])
        value[unsafe] = -_VALUE_SCALE * times
        table = TensorDict(latent=z, action_value=value, batch_size=[len(z)])
        loss = ActionValueLoss(
            self.policy, action_scale=self.action_scale, scale=_VALUE_SCALE, worst_coeff=0.3, worst_fraction=0.05
        )
        steps = s.teach_steps if number == 0 else s.teach_steps // 2
        self._loop(steps, {self.policy: 3e-3}, lambda: loss(table[self._pick(len(table), s.batch)]))
        self.taught = copy.deepcopy(self.policy).requires_grad_(False)

    def _phase_fit(self, number: int) -> None:
        """Barrier and policy onto the robust invariant set of the encoded data."""
        s = self.config.synthesis
        table, _ = self._targets(number)
        loss = TargetLoss(
            self.barrier, self.policy, action_scale=self.action_scale, scale=0.1, worst_coeff=0.3, worst_fraction=0.05
        )
        first = number == 0
        self._loop(
            s.fit_steps if first else s.fit_steps // 2,
            {self.barrier: 5e-3 if first else 2e-3, self.policy: 3e-3},
            lambda: loss(table[self._pick(len(table), s.batch)]),
        )

    def _phase_steer(self, number: int) -> None:
        """The policy alone, on the condition with twice the margin."""
        self._condition_phase(
            number, self.config.synthesis.steer_steps, {self.policy: 3e-3}, 2 * self.config.synthesis.margin
        )

    def _phase_tune(self, number: int) -> None:
        """Barrier and policy together, on the condition, the labels and the targets."""
        s = self.config.synthesis
        self._condition_phase(number, s.tune_steps, {self.barrier: s.lr, self.policy: s.lr}, s.margin)

    def _condition_phase(self, number: int, steps: int, networks: dict[nn.Module, float], margin: float) -> None:
        s = self.config.synthesis
        table, rim = self._targets(number)
        unsafe = (table["region"][:, 0] == UNSAFE).nonzero()[:, 0]
        # Half of the rows of U come from its rim, the sixth that lies nearest to the set.
        nearest = table["barrier_target"][unsafe, 0].argsort()[: max(1, len(unsafe) // 6)]
        rim_of_unsafe = unsafe[nearest]
        safe = (table["region"][:, 0] == SAFE).nonzero()[:, 0]
        table = table.clone(False)
        outside_weight = table["action_weight"] * torch.where(table["inside"], 0.1, 1.0)
        table["action_weight"] = outside_weight
        synthesis = SynthesisLoss(
            None,
            self.dynamics,
            self.barrier,
            self.policy,
            mode="R3",
            dynamics_margin=margin,
            band=s.band,
            worst_coeff=1.0,
            worst_fraction=0.02,
            off_manifold_coeff=1.0,
        )
        target = TargetLoss(
            self.barrier,
            self.policy,
            action_scale=self.action_scale,
            outside_cap=s.band,
            policy_coeff=s.recovery_coeff,
            safety_margin=s.unsafe_margin,
            inside_coeff=2.0,
            unsafe_coeff=10.0,
            safe_coeff=1.0,
            worst_coeff=1.0,
            worst_fraction=0.02,
        )

        # What the sets hold counts more than its share of the data; S may be empty.
        shares = ((unsafe, s.batch // 2), (rim_of_unsafe, s.batch // 2), (safe, s.batch // 4))

        def step() -> TensorDict:
            drawn = [self._pick(len(table), s.batch)]
            drawn += [rows[self._pick(len(rows), n)] for rows, n in shares if len(rows)]
            rows = torch.cat(drawn)
            asked = rim[self._pick(len(rim), 3 * s.batch // 2)]
            error = asked["residual"][torch.arange(len(asked)), self._pick(s.residuals, len(asked))]
            asked = asked.exclude("residual").set("residual", error)
            if s.counterexamples:
                asked = self._with_counterexamples(asked)
            terms = synthesis(asked)
            terms.update(target(table[rows]))
            return terms

        self._loop(steps, networks, step)

    def _with_counterexamples(self, asked: TensorDict) -> TensorDict:
        """Adds latents of the whole domain at which the condition fails; they are searched for again and again."""
        s, net = self.config.synthesis, self.config.network
        if self.step % _SEARCH_EVERY == 0:
            system = closed_loop(
                self.barrier,
                self.dynamics,
                self.policy,
                latent_dim=net.latent_dim,
                lipschitz_bound=net.lipschitz_bound,
            )
            found = find_counterexamples(system, s.counterexamples, margin=s.margin, generator=self.generator)
            known = found if self.step == 0 else torch.cat([found, self.counterexamples])
            self.counterexamples = known[: 8 * s.counterexamples]
        if not len(self.counterexamples):
            return asked
        latent = self.counterexamples[self._pick(len(self.counterexamples), len(asked) // 4)]
        hard = TensorDict(latent=latent, residual=torch.zeros_like(latent), batch_size=[len(latent)])
        return torch.cat([asked, hard])

    # ------------------------------------------------------------------ targets

    @torch.no_grad()
    def _tube(self, latent: Tensor, radius: float, salt: int) -> tuple[Tensor, Tensor]:
        """Latents moved off the data manifold along its normals, and the rows that they came from."""
        g = torch.Generator().manual_seed(self.config.seed + 77_000 + salt)
        cloud = self._cloud(g)
        reference = cloud[:20000]
        normal = normal_projectors(latent, reference)
        direction = (normal @ torch.randn(*latent.shape, 1, generator=g))[..., 0]
        length = direction.norm(dim=-1, keepdim=True)
        moved = radius * torch.rand(len(latent), 1, generator=g)
        points = (latent + moved * direction / length.clamp_min(1e-6)).clamp(-1, 1)
        # Where another sheet of the manifold is nearer than the one it came from, a point says nothing.
        kept = (length[:, 0] > 1e-3) & (nearest_distance(points, cloud) > 0.85 * moved[:, 0])
        rows = kept.nonzero()[:, 0]
        return points[rows], rows

    def _cloud(self, generator: torch.Generator) -> Tensor:
        cloud = torch.cat([self.latents["latent"], self.latents["next_latent"]])
        return cloud[torch.randperm(len(cloud), generator=generator)[:80000]]

    def _targets(self, number: int) -> tuple[TensorDict, TensorDict]:
        """Latents with the targets of barrier and policy, and the latents on which the condition is asked."""
        if self._target_round == number:
            return self._target_table, self._rim
        s, data = self.config.synthesis, self.latents
        g = torch.Generator().manual_seed(self.config.seed + 88_000 + number)
        z, unsafe = data["latent"], data["region"][:, 0] == UNSAFE
        zc = z[~unsafe]
        near, axes = self._errors(zc, g, s.residual_spread)
        stray = torch.rand(60000, z.shape[1], generator=g) * 2 - 1
        tube, _ = self._tube(z, 2 * s.tube_radius, 1000 + number)
        rim, rows = self._tube(zc, 1.2 * s.tube_radius, 2000 + number)
        queries = torch.cat([z, data["next_latent"], tube, stray])
        if s.teacher == "value":
            target, member, best, weight = self._value_targets(queries, axes)
        else:
            target, member, best, weight = self._clearance_targets(queries, stray, axes, g)
        rest = len(queries) - len(z)
        self._target_table = TensorDict(
            latent=queries,
            barrier_target=target[:, None],
            inside=member[:, None],
            action_target=torch.cat([best, torch.zeros(rest, best.shape[1])]),
            action_weight=torch.cat([weight, torch.zeros(rest)])[:, None],
            region=torch.cat([data["region"], torch.zeros(rest, 1, dtype=torch.int64)]),
            batch_size=[len(queries)],
        )
        self._rim = TensorDict(
            latent=torch.cat([zc, rim]), residual=torch.cat([near, near[rows]]), batch_size=[len(zc) + len(rim)]
        )
        self._target_round = number
        return self._target_table, self._rim

    def _clearance_targets(
        self, queries: Tensor, stray: Tensor, errors: Tensor, generator: torch.Generator
    ) -> tuple[Tensor, ...]:
        """Signed distance to the robust invariant set; actions that keep the largest clearance, or lead back soonest."""
        s, data = self.config.synthesis, self.latents
        z, unsafe = data["latent"], data["region"][:, 0] == UNSAFE
        zc, actions = z[~unsafe], _action_grid(self.action_scale, s.actions)
        found = robust_invariant_set(self._successors(zc, actions), zc, z[unsafe], residuals=errors)
        kept = found.inside
        if not bool(kept.any()):
            # Nothing can be kept under these errors: go on with what can be kept longest, and let the held-out
            # checks say what it is worth.
            kept = found.removed == found.removed.max()
        inside = torch.zeros(len(z), dtype=torch.bool)
        inside[(~unsafe).nonzero()[:, 0]] = kept
        far = nearest_distance(stray, self._cloud(generator)) > s.tube_radius
        target, member = barrier_targets(
            queries,
            z[inside],
            torch.cat([z[~inside], stray[far]]),
            tube_radius=s.tube_radius,
            lipschitz_bound=self.config.network.lipschitz_bound,
        )
        best = torch.zeros(len(z), len(self.action_scale))
        best[inside] = torch.softmax(found.clearance[kept] / 0.01, 1) @ actions
        outer = (~inside).nonzero()[:, 0]
        times = reach_times(self._successors(z[outer], actions), z[outer], z[inside], known_within=_KNOWN_WITHIN)
        best[outer] = torch.softmax(-times / 0.1, 1) @ actions
        weight = torch.ones(len(z))
        weight[outer] = (times.min(1).values < 100).float()
        self.kept_share = float(found.inside.float().mean())
        self._log({"step": 0, "inside_of_allowed": self.kept_share, "sweeps": found.iterations})
        return target, member, best, weight

    @torch.no_grad()
    def _value_targets(self, queries: Tensor, errors: Tensor) -> tuple[Tensor, ...]:
        """Minus the margin that the taught policy keeps, and the taught policy itself."""
        s, data = self.config.synthesis, self.latents
        assert self.taught is not None
        z, unsafe = data["latent"], data["region"][:, 0] == UNSAFE
        action = self.taught(z)
        margin = signed_margin(z, unsafe)
        successors, safe = self.dynamics(z, action)[:, None], data["region"][:, 0] == SAFE
        mean = errors[:, :1]
        for share in _SPREADS:
            # What looks unsafe ends there, whatever follows: no errors are needed for it.
            around = torch.zeros(len(z), *errors.shape[1:])
            around[~unsafe] = torch.lerp(mean, errors, share)
            value = safety_values(successors, z, margin, residuals=around)[:, 0].minimum(margin)
            # A set without S is worth nothing: rather tolerate less.
            if int((value[safe] > 0).sum()) >= _KEPT_OF_SAFE * int(safe.sum()):
                break
        target = value_targets(
            queries,
            z,
            value,
            tube_radius=s.tube_radius,
            lipschitz_bound=self.config.network.lipschitz_bound,
        )
        self.kept_share = float((value[~unsafe] > 0).float().mean())
        self._log({"step": 0, "inside_of_allowed": self.kept_share, "spread": share * self.config.synthesis.residual_spread})
        return target, target <= 0, action, torch.ones(len(z))

    def _errors(self, latent: Tensor, generator: torch.Generator, spread: float) -> tuple[Tensor, Tensor]:
        """Errors of the dynamics observed near latents: a sample of them, and their principal axis."""
        data = self.latents
        z = data["latent"]
        with torch.no_grad():
            residual = data["next_latent"] - self.dynamics(z, data["action"])
        sample = torch.randperm(len(z), generator=generator)[:30000]
        return nearby_residuals(latent, z[sample], residual[sample], count=self.config.synthesis.residuals, spread=spread)

    @torch.no_grad()
    def _successors(self, latent: Tensor, actions: Tensor) -> Tensor:
        k = len(actions)
        parts = [
            self.dynamics(part.repeat_interleave(k, 0), actions.repeat(len(part), 1)).reshape(len(part), k, -1)
            for part in latent.split(4096)
        ]
        return torch.cat(parts)

    # ------------------------------------------------------------------ disk

    def _log(self, row: dict[str, Any]) -> None:
        """Append a line to ``log.jsonl``."""
        phases = self.phases()
        name, number = phases[min(self.phase, len(phases) - 1)]
        with (self.out_dir / "log.jsonl").open("a") as file:
            file.write(json.dumps({"phase": name, "round": number, **row}) + "\n")
        done = sum(self._size(phase) for phase, _ in phases[: self.phase]) + self.step
        log_scalars(self.logger, {k: v for k, v in row.items() if k in METRICS}, done)

    def _checkpoint(self) -> None:
        """Write the state of the training; the old one stays until the new one is complete."""
        now = time.monotonic()
        self.seconds += now - self._clock
        self._clock = self._last_checkpoint = now
        body = {
            "config": json.dumps(self._identity(), sort_keys=True),
            "phase": self.phase,
            "step": self.step,
            "seconds": self.seconds,
            "networks": self.networks.state_dict(),
            "latents": self.latents,
            "counterexamples": self.counterexamples,
            "taught": None if self.taught is None else self.taught.state_dict(),
            "kept_share": self.kept_share,
            **self._more_state(),
            "generator": self.generator.get_state(),
            "loop": self._loop_state,
        }
        path = self.out_dir / CHECKPOINT_FILE
        torch.save(body, path.with_suffix(".tmp"))
        path.with_suffix(".tmp").replace(path)

    def _forget(self) -> None:
        """Start anew, whatever lies there."""
        for name in (CHECKPOINT_FILE, "log.jsonl"):
            (self.out_dir / name).unlink(missing_ok=True)

    def _more_state(self) -> dict[str, Any]:
        """What a derived training adds to its checkpoints."""
        return {}

    def _restore_more(self, body: dict[str, Any]) -> None:
        """Take back what ``_more_state`` has returned."""

    def _identity(self) -> dict[str, Any]:
        """What must not change between a checkpoint and its continuation."""
        values = self.config.to_dict()
        for key in ("out_dir", "progress", "checkpoint_seconds", "evaluation", "device"):
            values.pop(key)
        return values

    def _restore(self) -> None:
        path = self.out_dir / CHECKPOINT_FILE
        try:
            body = torch.load(path, map_location="cpu", weights_only=True)  # the run may go on elsewhere
        except Exception as error:
            raise CheckpointError(
                f"expected a readable checkpoint at '{path}', received {type(error).__name__}; delete it to start again"
            ) from error
        if self.latents and not _same(self.latents, body["latents"]):
            self._forget()  # other data, or another encoder: another training
            return
        if body["config"] != json.dumps(self._identity(), sort_keys=True):
            raise ConfigError(
                f"expected the configuration of the run in '{self.out_dir}', received another one; use another out_dir, or "
                "delete the folder to start again"
            )
        self.networks.load_state_dict(body["networks"])
        self.latents, self.kept_share = body["latents"], body["kept_share"]
        self.counterexamples = body["counterexamples"]
        if body["taught"] is not None:
            self.taught = copy.deepcopy(self.policy).requires_grad_(False)
            self.taught.load_state_dict(body["taught"])
        self._restore_more(body)
        self.generator.set_state(body["generator"])
        self.phase, self.step, self.seconds = body["phase"], body["step"], body["seconds"]
        self._loop_state = body["loop"]


def _action_grid(action_scale: Sequence[float], per_dimension: int) -> Tensor:
    """A regular grid of actions, coarser where many dimensions would make it too large."""
    m = len(action_scale)
    k = max(2, min(per_dimension, int(_MOST_ACTIONS ** (1 / m) + 1e-6)))
    if k**m > 8 * _MOST_ACTIONS:
        raise ConfigError(
            f"expected at most {int(math.log2(8 * _MOST_ACTIONS))} action dimensions, received {m}: a grid of actions is "
            "tried at every latent; set synthesis.enabled=false to keep what the joint training has found"
        )
    axes = [torch.linspace(-scale, scale, k) for scale in action_scale]
    return torch.cartesian_prod(*axes).reshape(-1, m)


def _same(one: dict[str, Tensor], other: dict[str, Tensor]) -> bool:
    return one.keys() == other.keys() and all(torch.equal(value, other[key]) for key, value in one.items())
