"""Overrides that make a training last seconds."""

from __future__ import annotations

TINY = [
    "preset=smoke", "progress=false", "checkpoint_seconds=0",
    "data.transitions=64", "data.safe=16", "data.unsafe=16", "representation.steps=3", "representation.batch=24",
    "synthesis.rounds=2", "synthesis.transitions=240", "synthesis.rollout_transitions=24", "synthesis.mined_unsafe=16",
    "synthesis.dynamics_steps=4", "synthesis.fit_steps=4", "synthesis.steer_steps=3", "synthesis.tune_steps=3",
    "synthesis.check_episodes=8", "synthesis.check_horizon=2", "synthesis.batch=32", "synthesis.residuals=2", "synthesis.counterexamples=8",
    "network.barrier_hidden=[8,8]", "network.dynamics_hidden=[8]", "network.policy_hidden=[8]",
]


# Of an experiment: what follows the joint training, and the certificate.
TINY_EXPERIMENT = [
    "trainer.restarts=0", "evaluation.certificate_episodes=4", "evaluation.certificate_seconds=2",
    "synthesis.dynamics_steps=4", "synthesis.teach_steps=4", "synthesis.fit_steps=4", "synthesis.steer_steps=3",
    "synthesis.tune_steps=3", "synthesis.batch=32", "synthesis.residuals=2", "synthesis.actions=3",
]  # fmt: skip
