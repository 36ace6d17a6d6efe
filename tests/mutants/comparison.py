"""Mutants of the comparison: what trials share and are worth, and how many transitions this library's own row takes."""

from __future__ import annotations

BASE, TUNING = "torchrl_sspl/baselines/base.py", "torchrl_sspl/baselines/tuning.py"
CELL, TABLE, SCORING = (f"torchrl_sspl/baselines/{name}.py" for name in ("cell", "table", "scoring"))
LATENT, VISION = "torchrl_sspl/baselines/latent_cbf.py", "torchrl_sspl/baselines/vision_cbf.py"

SYNTHESIS, OWN = "torchrl_sspl/trainers/synthesis.py", "torchrl_sspl/baselines/sspl.py"

TRIED, LEARNT, SHOWN = (f"tests/baselines/test_{name}.py" for name in ("tuning", "rivals", "table"))

MUTANTS = [
    (BASE, "        torch.set_rng_state(state)\n", "", TRIED),
    (BASE, "        if key not in self.stages:\n", "        if True:\n", TRIED),
    (LATENT, '("latent", "gain", "autoencoder_steps", "inverse_dynamics")', '("latent", "autoencoder_steps", "inverse_dynamics")', TRIED),
    (VISION, '("steps", "batch", "adversarial", "plain")', '("steps", "batch", "plain")', TRIED),
    (TUNING, "LOST = 10.0", "LOST = 0.1", TRIED),
    (TUNING, 'found[k]["merit"], -k)', 'found[k]["merit"], k)', TRIED),
    (TUNING, "-math.inf if found[k]", "math.inf if found[k]", TRIED),
    (TUNING, "if k not in named", "if True", TRIED),
    (CELL, "minutes | {\"fit_cpu\": used / 60} | _of_trials(trials)", "minutes | {\"fit_cpu\": used / 60}", TRIED),
    (TABLE, "            os._exit(128 + error.number)  #", "            pass  #", SHOWN),
    (TABLE, "            child.terminate()", "            pass", SHOWN),
    (TABLE, "    except Exception as error:", "    except SSPLError as error:", SHOWN),
    (SCORING, "    if not len(check):", "    if False:", "tests/baselines/test_ceilings.py"),
    (SYNTHESIS, "range(s.near_draws)", "range(10)", LEARNT),
    (OWN, '"synthesis.near_draws=1", ', "", LEARNT),
    (OWN, "- rollouts) // s.rim_draws", "- rollouts)", LEARNT),
]
