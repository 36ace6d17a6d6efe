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

TRIED, LEARNT, SHOWN, CELLS = (f"tests/baselines/test_{name}.py" for name in ("tuning", "rivals", "table", "cells"))
SLOW = "a slow test notices: test_a_signal_ends_the_processes_too"

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
    (TABLE, "            os._exit(128 + error.number)  #", "            pass  #", f"{SHOWN}::test_a_signal_ends_the_command_and_what_is_done_stays", SLOW),
    (TABLE, "            child.terminate()", "            pass", f"{SHOWN}::test_a_signal_ends_the_command_and_what_is_done_stays", SLOW),
    (TABLE, "    except Exception as error:", "    except SSPLError as error:", f"{SHOWN}::test_an_error_of_any_kind_is_named_in_its_row_and_the_others_go_on"),
    (SCORING, "    if not len(check):", "    if False:", "tests/baselines/test_ceilings.py"),
    (SYNTHESIS, "range(s.near_draws)", "range(10)", LEARNT),
    (OWN, '"synthesis.near_draws=1", ', "", LEARNT),
    (OWN, "- rollouts) // s.rim_draws", "- rollouts)", LEARNT),
    (OWN, "*settings(self.env_name, budget)", "*settings('pendulum', budget)", f"{LEARNT}::test_its_own_training_is_of_the_system_that_is_scored"),
    (OWN, "steps = usual.trainer.optim_steps_per_batch * learning", "steps = usual.trainer.optim_steps_per_batch", f"{LEARNT}::test_this_librarys_own_row_takes_as_many_steps_as_recommended_whatever_the_budget"),
    (OWN, 'for how in ("labels", "chosen labels")) for name', 'for how in ("labels",)) for name', LEARNT),
    (CELL, "    if of != asked and {**of", "    if False and {**of", TRIED),
    (TABLE, "if more := first.get", "if False and first.get", f"{SHOWN}::test_several_seeds_are_a_mean_and_the_worst"),
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
    (CELL, ' and {**found, "weights": None, "score": None} == {**now, "weights": None, "score": None}:', ":", f"{CELLS}::test_the_row_of_an_agent_is_no_other_row_and_is_not_overwritten_by_one"),
    (CELL, "cell.budget, seed, method.side or POOL) if method.learns", "cell.budget, seed, POOL) if method.learns", f"{CELLS}::test_a_method_learns_from_and_is_shown_pictures_of_the_size_that_it_is_given"),
    (SCORING, "(state, shift, size=method.side):", "(state, shift):", f"{CELLS}::test_a_method_learns_from_and_is_shown_pictures_of_the_size_that_it_is_given"),
    (SCORING, "pooled(frame(state), side))", "pooled(frame(state)))", f"{CELLS}::test_a_method_learns_from_and_is_shown_pictures_of_the_size_that_it_is_given"),
    (OWN, 'if told.get("schema") != SCHEMA:', "if False:", f"{CELLS}::test_a_training_of_another_version_is_not_gone_on_with"),
    (TABLE, "if found.setdefault(cell.directory, cell) != cell:", "found[cell.directory] = cell\n            if False:", f"{SHOWN}::test_words_that_are_not_valid_are_refused"),
]
