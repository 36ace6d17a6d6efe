"""Mutants of values on clouds of latents."""

from __future__ import annotations

CLOUD, CLOUDS = "torchrl_sspl/viability/cloud.py", "tests/viability/test_cloud.py"

MUTANTS = [
    (CLOUD, "return weight * (1.0 - (off @ tilt[..., None])[..., 0])", "return weight", CLOUDS),
    (CLOUD, "weight * (1.0 - (off @ tilt", "weight * (1.0 + (off @ tilt", CLOUDS),
    (CLOUD, "    off = off - centre[:, None]\n", "", CLOUDS),
    (CLOUD, ".clamp(around.amin(-1), around.amax(-1))", "", CLOUDS),
    (CLOUD, "_RIDGE = 0.01", "_RIDGE = 1.0", CLOUDS),
    (CLOUD, "per_action = _mixed(value, index, weight).amin(-1)", "per_action = _mixed(value, index, weight).mean(-1)", CLOUDS),
    (CLOUD, "best = torch.minimum(margin, per_action.amax(1))", "best = per_action.amax(1)", CLOUDS),
    (CLOUD, "lipschitz_bound * (distance - tube_radius)", "lipschitz_bound * distance", CLOUDS),
]
