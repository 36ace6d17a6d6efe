"""Mutants of values on grids and on clouds, and of the systems that they are of."""

from __future__ import annotations

CLOUD, CLOUDS = "torchrl_sspl/viability/cloud.py", "tests/viability/test_cloud.py"
GRID, KNOWN, LOOP, BASE = (f"torchrl_sspl/{name}.py" for name in ("viability/grid", "evaluation/known", "evaluation/simulation", "envs/base"))
CONVERGED = "tests/viability/test_grid.py::test_a_kernel_that_has_not_converged_says_so"
MOVED = "tests/envs/test_system.py::test_a_moved_system_keeps_its_states_and_makes_its_pictures_anew"

MUTANTS = [
    (GRID, "iterations, seconds, change, change <= tolerance)", "iterations, seconds, change)", CONVERGED),
    (KNOWN, "if run.kernel.converged or name == names[2]:", "if True:", "tests/evaluation/test_known.py::test_what_is_safe_falsely_is_not_measured_against_a_kernel_that_is_too_large"),
    (LOOP, "events = {name: bool(info.get(entry)) for name, entry in EVENTS.items()}", "events = dict.fromkeys(EVENTS, False)", "tests/evaluation/test_simulation.py::test_what_happens_in_a_reset_belongs_to_the_episode"),
    (BASE, "                self.__dict__.pop(name, None)\n", "                pass\n", MOVED),
    (CLOUD, "return weight * (1.0 - (off @ tilt[..., None])[..., 0])", "return weight", CLOUDS),
    (CLOUD, "weight * (1.0 - (off @ tilt", "weight * (1.0 + (off @ tilt", CLOUDS),
    (CLOUD, "    off = off - centre[:, None]\n", "", CLOUDS),
    (CLOUD, ".clamp(around.amin(-1), around.amax(-1))", "", CLOUDS),
    (CLOUD, "_RIDGE = 0.01", "_RIDGE = 1.0", CLOUDS),
    (CLOUD, "per_action = _mixed(value, index, weight).amin(-1)", "per_action = _mixed(value, index, weight).mean(-1)", CLOUDS),
    (CLOUD, "best = torch.minimum(margin, per_action.amax(1))", "best = per_action.amax(1)", CLOUDS),
    (CLOUD, "lipschitz_bound * (distance - tube_radius)", "lipschitz_bound * distance", CLOUDS),
]
