"""Mutants of the comparison's trials: what they share, and what they are worth."""

from __future__ import annotations

BASE, TUNING = "torchrl_sspl/baselines/base.py", "torchrl_sspl/baselines/tuning.py"
LATENT, VISION = "torchrl_sspl/baselines/latent_cbf.py", "torchrl_sspl/baselines/vision_cbf.py"

TRIED = "tests/baselines/test_tuning.py"

MUTANTS = [
    (BASE, "        torch.set_rng_state(state)\n", "", TRIED),
    (BASE, "        if key not in self.stages:\n", "        if True:\n", TRIED),
    (LATENT, '("latent", "gain", "autoencoder_steps", "inverse_dynamics")', '("latent", "autoencoder_steps", "inverse_dynamics")', TRIED),
    (VISION, '("steps", "batch", "adversarial", "plain")', '("steps", "batch", "plain")', TRIED),
    (TUNING, "LOST = 10.0", "LOST = 0.1", TRIED),
    (TUNING, 'key=lambda k: (found[k]["merit"], -k)', 'key=lambda k: (found[k]["merit"], k)', TRIED),
]
