"""Overrides that make a run last seconds."""

from __future__ import annotations

#: The phases on frozen latents, the networks and the certificate.
TINY_PHASES = [
    "trainer.progress=false", "logger=none", "evaluation.certificate_episodes=4", "evaluation.certificate_seconds=2",
    "synthesis.dynamics_steps=4", "synthesis.teach_steps=4", "synthesis.fit_steps=4", "synthesis.steer_steps=3",
    "synthesis.tune_steps=3", "synthesis.batch=32", "synthesis.residuals=2", "synthesis.actions=3",
    "network.barrier_hidden=[8,8]", "network.dynamics_hidden=[8]", "network.policy_hidden=[8]",
]  # fmt: skip

#: A main job, all phases of two rounds. Its checkpoints would take half of its time: what goes on after one asks for SAVED.
TINY = [
    "env=pendulum", "preset=smoke", "trainer.checkpoint_seconds=-1", *TINY_PHASES, "env.image_size=32", "network.pool_to=16",
    "collector.frames_per_batch=64", "collector.init_random_frames=64", "trainer.total_frames=192",
    "trainer.optim_steps_per_batch=3", "buffer.batch=24", "synthesis.transitions=240", "synthesis.rollout_transitions=24",
    "synthesis.rim_transitions=16", "synthesis.rim_draws=2", "synthesis.check_episodes=8", "synthesis.check_horizon=2",
    "synthesis.counterexamples=8",
]  # fmt: skip

#: The same in one round.
SINGLE = [*TINY, "synthesis.rounds=1"]

#: Checkpoints between the phases, and none inside them.
SAVED = "trainer.checkpoint_seconds=3600"
