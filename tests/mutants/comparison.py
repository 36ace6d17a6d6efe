"""Mutants of the comparison: what trials share and are worth, and how many transitions this library's own row takes."""

from __future__ import annotations

BASE, TUNING = "torchrl_sspl/baselines/base.py", "torchrl_sspl/baselines/tuning.py"
LATENT, VISION = "torchrl_sspl/baselines/latent_cbf.py", "torchrl_sspl/baselines/vision_cbf.py"

SYNTHESIS, OWN = "torchrl_sspl/trainers/synthesis.py", "torchrl_sspl/baselines/sspl.py"

TRIED, LEARNT = "tests/baselines/test_tuning.py", "tests/baselines/test_rivals.py"

MUTANTS = [
    (BASE, "        torch.set_rng_state(state)\n", "", TRIED),
    (BASE, "        if key not in self.stages:\n", "        if True:\n", TRIED),
    (LATENT, '("latent", "gain", "autoencoder_steps", "inverse_dynamics")', '("latent", "autoencoder_steps", "inverse_dynamics")', TRIED),
    (VISION, '("steps", "batch", "adversarial", "plain")', '("steps", "batch", "plain")', TRIED),
    (TUNING, "LOST = 10.0", "LOST = 0.1", TRIED),
    (TUNING, 'key=lambda k: (found[k]["merit"], -k)', 'key=lambda k: (found[k]["merit"], k)', TRIED),
    (SYNTHESIS, "range(s.near_draws)", "range(10)", LEARNT),
    (OWN, '"synthesis.near_draws=1", ', "", LEARNT),
    (OWN, "- rollouts) // s.rim_draws", "- rollouts)", LEARNT),
]
