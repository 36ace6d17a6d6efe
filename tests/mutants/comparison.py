"""Mutants of the comparison: what trials share and are worth, what rivals see, what this library's own row is given, and how its policy is checked."""

from __future__ import annotations

BASE, TUNING = "torchrl_sspl/baselines/base.py", "torchrl_sspl/baselines/tuning.py"
CELL, TABLE, SCORING = (f"torchrl_sspl/baselines/{name}.py" for name in ("cell", "table", "scoring"))
LATENT, VISION = "torchrl_sspl/baselines/latent_cbf.py", "torchrl_sspl/baselines/vision_cbf.py"

PERCEPTION, NERF, PAGE = (f"torchrl_sspl/baselines/{name}.py" for name in ("perception", "nerf_cbf", "page"))
SMOOTH, SAFE = "torchrl_sspl/baselines/smooth_latent.py", "torchrl_sspl/baselines/latent_safe.py"
CHOSEN = "tests/trainers/test_phases.py::test_a_policy_that_chooses_is_checked_at_the_level_at_which_it_runs"
JUDGED = "tests/trainers/test_selection.py"
SELECTION, AGENT = "torchrl_sspl/trainers/selection.py", "torchrl_sspl/modules/agent.py"
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
    (TUNING, "space.items() if k not in named", "space.items() if True", TRIED),
    (TUNING, "published.items() if k not in named", "published.items() if True", TRIED),
    (TUNING, "[(), published] if published", "[()] if published", TRIED),
    (CELL, "minutes | {\"fit_cpu\": used / 60} | _of_trials(trials)", "minutes | {\"fit_cpu\": used / 60}", TRIED),
    (TABLE, "            os._exit(128 + error.number)  #", "            pass  #", SHOWN),
    (TABLE, "            child.terminate()", "            pass", SHOWN),
    (TABLE, "    except Exception as error:", "    except SSPLError as error:", SHOWN),
    (SCORING, "    if not len(check):", "    if False:", "tests/baselines/test_ceilings.py"),
    (SYNTHESIS, "range(s.near_draws)", "range(10)", LEARNT),
    (OWN, '"synthesis.near_draws=1", ', "", LEARNT),
    (OWN, "- rollouts) // s.rim_draws", "- rollouts)", LEARNT),
    (OWN, "*settings(self.env_name, budget)", "*settings('pendulum', budget)", f"{LEARNT}::test_its_own_training_is_of_the_system_that_is_scored"),
    (OWN, "steps = usual.trainer.optim_steps_per_batch * learning", "steps = usual.trainer.optim_steps_per_batch", f"{LEARNT}::test_this_librarys_own_row_takes_as_many_steps_as_recommended_whatever_the_budget"),
    (OWN, 'for how in ("labels", "chosen labels")) for name', 'for how in ("labels",)) for name', LEARNT),
    (CELL, "    if of != asked and {**of", "    if False and {**of", TRIED),
    (TABLE, "if more := first.get", "if False and first.get", SHOWN),
    (PERCEPTION, "if isinstance(env, CMUDubinsEnv):", "if False:", f"{LEARNT}::test_the_encoder_of_a_car_of_one_colour_tells_its_heading"),
    (PERCEPTION, "ShapeEncoder(max(size, 4), pool_to=side) if whole else ", "", f"{LEARNT}::test_the_encoder_of_a_car_of_one_colour_tells_its_heading"),
    (PERCEPTION, "seen.flatten(1), torch.ones", "torch.ones", f"{LEARNT}::test_what_the_features_say_linearly_is_read_out_whatever_the_encoder_has_learnt"),
    (SMOOTH, "torch.cat([nominal[:, None], self.tried", "torch.cat([self.tried[None, :1, None].expand(len(q), -1, 1), self.tried", f"{LEARNT}::test_the_wanted_action_is_kept_where_its_value_is_admitted"),
    (SMOOTH, "self.value_of(q, nominal)[:, None]", "q[:, :1]", f"{LEARNT}::test_the_wanted_action_is_kept_where_its_value_is_admitted"),
    (SAFE, "c.discount * (share >= c.warmup) if c.warmup", "c.discount if c.warmup", f"{LEARNT}::test_a_discount_has_a_warm_up_or_is_annealed"),
    (VISION, '() if isinstance(env, PixelPendulumEnv) else ("k",)', "()", f"{TRIED}::test_what_does_nothing_on_a_system_is_not_drawn"),
    (SCORING, "else min(0.0, float(barrier[order[last]]))", "else float(barrier[order[last]])", "tests/baselines/test_ceilings.py"),
    (OWN, "if (folder.parent / BUDGET_FILE).is_file():", "if False:", f"{LEARNT}::test_what_an_agent_does_not_say_of_its_data_is_not_counted"),
    (OWN, "    if counted is None:\n", "    counted = counted or {}\n    if False:\n", f"{LEARNT}::test_what_an_agent_does_not_say_of_its_data_is_not_counted"),
    (NERF, "self.view = env.half_view", "self.view = 1.2 * env.arena_half_size", LEARNT),
    (VISION, "        view = self.env.half_view\n", "        view = 1.2 * self.env.arena_half_size\n", LEARNT),
    (PAGE, "Path(env).stem", "env", f"{SHOWN}::test_a_page_has_systems_of_more_coordinates_and_systems_of_a_file"),
    (SELECTION, "if isinstance(agent.policy, ChoosingPolicy) else", "if False else", CHOSEN),
    (SELECTION, "work.agent(check.level)", "work.agent(0.0)", CHOSEN),
    (SELECTION, "        check.level = level\n", "", CHOSEN),
    (SELECTION, "started=started)", "started=0)", JUDGED),
    (SELECTION, "max(1, len(run) // _STARTED)", "0", JUDGED),
    (AGENT, "if name not in registry and not trust:", "if False:", "tests/modules/test_agent.py"),
    (AGENT, "if not (isinstance(kind, type) and issubclass(kind, nn.Module)):", "if False:", "tests/modules/test_agent.py"),
    (AGENT, "        _read_as_written(self)\n", "", "tests/modules/test_agent.py"),
    (AGENT, "    if not torch.allclose(one, other, equal_nan=True):", "    if False:", "tests/modules/test_agent.py"),
    (AGENT, "        if isinstance(value, nn.Module):\n            _built", "        if False:\n            _built", "tests/modules/test_agent.py"),
    (AGENT, "                agent.double()", "                pass", "tests/modules/test_agent.py"),
]
