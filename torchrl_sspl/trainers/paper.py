r"""The paper's training as printed: one joint loss, a slow target :math:`\theta^-`, margins estimated as it goes."""

from __future__ import annotations

from typing import Any

import torch
from torch import nn

from torchrl_sspl.data import TransitionStore, collect_rollouts
from torchrl_sspl.functional import covering_radius, dynamics_error, dynamics_margin, safety_margin
from torchrl_sspl.lipschitz.lmi import LMIBarrier
from torchrl_sspl.modules import make_rollout_policy
from torchrl_sspl.modules.agent import Agent
from torchrl_sspl.objectives import SSPLLoss
from torchrl_sspl.trainers.pipeline import Check, SafePolicyTraining, TrainingResult


class PaperTraining(SafePolicyTraining):
    r"""Algorithm 1 with the losses as printed, for comparison.

    Warm start on :math:`L_{SaLaD}`, then in every iteration: margins :math:`\psi = L_B \bar\epsilon` and
    :math:`\eta = L_B \delta` from the data at hand, steps on :math:`\lambda_1 L_{syn} + \lambda_2 L_{SaLaD} +
    \lambda_3 L_\pi` with :math:`\theta^-` by moving average, a step on :math:`L_M` after each, and rollouts of the policy.

    Args:
        config: everything that determines the run (preset "paper").
        make_env: ``(batch_size: list[int], seed: int) -> SafetyEnv``.
        resume: continue from the checkpoint in ``config.out_dir`` if there is one.

    Source: paper Algorithm 1; deviations: means in place of sums, the LMI step never leaves the cone, a fixed number of
    iterations (the printed stop rule, a total loss of zero, is never met with a policy term).
    """

    def __init__(self, *arguments: Any, **options: Any) -> None:
        super().__init__(*arguments, **options)
        self._feasible_state = {k: v.clone() for k, v in self.warm_barrier.state_dict().items()}

    def _new_barrier(self) -> nn.Module:  # type: ignore[override]
        net = self.config.network
        return LMIBarrier(net.latent_dim, tuple(net.barrier_hidden), net.lipschitz_bound)

    def phases(self) -> list[tuple[str, int]]:
        """Warm start, then the iterations."""
        return [("represent", 0), *(("joint", k) for k in range(self.config.synthesis.rounds))]

    def _size(self, name: str) -> int:
        return self.config.synthesis.tune_steps if name == "joint" else super()._size(name)

    def _device_of(self, phase: str) -> torch.device | str:
        """Every phase works on pixels."""
        return self.device

    def _after_step(self) -> None:
        """The separate step on L_M; both it and the step before are pulled back into the cone where they would leave it."""
        barrier = self.warm_barrier
        # Feasible at the start, after every step, and so in every checkpoint.
        before = {k: self._feasible_state[k].to(v.device) for k, v in barrier.state_dict().items()}
        barrier.backtracking_step(before)  # type: ignore[operator]
        loss = barrier.loss() * 1e-3  # type: ignore[operator]
        gradients = torch.autograd.grad(loss, list(barrier.parameters()), allow_unused=True)
        before = {k: v.clone() for k, v in barrier.state_dict().items()}
        with torch.no_grad():
            for p, g in zip(barrier.parameters(), gradients, strict=True):
                if g is not None:
                    p.sub_(self.config.synthesis.lr * g.to(p.dtype))
        barrier.backtracking_step(before)  # type: ignore[operator]
        self._feasible_state = {k: v.clone() for k, v in barrier.state_dict().items()}

    def _phase_joint(self, number: int) -> None:
        """One iteration of the while loop of Algorithm 1."""
        s, rep = self.config.synthesis, self.config.representation
        stores = self._labelled_stores()
        folder = self.out_dir / f"rollouts_{number}"
        if (folder / "store").exists():
            rollouts = TransitionStore.from_folder(folder / "store")
        else:
            policy = make_rollout_policy(self.encoder, self.policy)
            rollouts = collect_rollouts(
                self._env_for(), policy, s.rollout_transitions, seed=self.config.seed + 1000 * (number + 1), steps=20,
                policy_device=self.device, env_device="cpu", storing_device="cpu",
            )
            folder.mkdir(exist_ok=True)
            rollouts.dumps(folder / "store")
        stores["any"] = rollouts
        psi, eta, delta, radius = self._margins(rollouts)
        loss = SSPLLoss(
            self.encoder, self.warm_dynamics, self.warm_barrier, self.policy,
            preset="paper", reduction="mean", policy_coeff=s.deviation_coeff,
            safety_margin=psi, dynamics_margin=eta,
            consistency_coeff=rep.consistency_coeff,
        ).to(self.device)
        self._log({"step": 0, "safety_margin": psi, "dynamics_margin": eta, "dynamics_error": delta, "covering_radius": radius})
        networks: dict[nn.Module, float] = dict.fromkeys(
            (self.encoder, self.warm_dynamics, self.warm_barrier, self.policy), s.lr
        )

        self._loop(
            s.tune_steps, networks, lambda: loss(self._mixed_batch(stores)), clip=rep.clip_norm, delayed=loss
        )
        self.checks.append(
            Check(number, 0.0, 0, 0, 0, 0, 0.0, 0.0, False, f"the paper's schedule has no held-out check (eta {eta:.3f}, psi {psi:.3f})")
        )

    @torch.no_grad()
    def _margins(self, store: TransitionStore) -> tuple[float, float, float, float]:
        """psi and eta as the paper prints them: on the training samples themselves."""
        bound = self.config.network.lipschitz_bound
        data = self._encode_store(store)
        predicted = self.warm_dynamics(data["latent"].to(self.device), data["action"].to(self.device)).cpu()
        error = dynamics_error(predicted, data["next_latent"]).max()
        half = len(data["latent"]) // 2
        radius = covering_radius(data["latent"][:half], data["latent"][half:])
        psi = safety_margin(bound, radius, mode="paper").q1
        return psi, dynamics_margin(bound, float(error)), float(error), radius

    def _agent(self, level: float) -> Agent:
        self.barrier, self.dynamics = self.warm_barrier, self.warm_dynamics
        return super()._agent(level)

    def _description(self) -> dict[str, Any]:
        body = super()._description()
        body["networks"]["dynamics"]["arguments"]["hidden"] = [128, 128]
        return body

    def _result(self) -> TrainingResult:
        result = super()._result()
        result.stop_reason = f"{self.config.synthesis.rounds} iterations; the printed stop rule was not met"
        return result
