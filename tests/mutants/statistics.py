"""Mutants of what is measured, written and checked again: each a line, what it is changed to, and the tests that notice."""

from __future__ import annotations

RECORD, STATISTICS = "torchrl_sspl/certification/record.py", "torchrl_sspl/certification/statistics.py"
CERTIFICATE, CERTIFY = "torchrl_sspl/certification/certificate.py", "torchrl_sspl/evaluation/certify.py"
ROUNDING = "torchrl_sspl/certification/rounding.py"
SEEDS, BLOCKS = "torchrl_sspl/seeds.py", "torchrl_sspl/evaluation/blocks.py"
BOUNDS, TWINS = "tests/certification/test_statistics.py", "tests/certification/test_refusals.py"
FORGED, LOOPS = "tests/certification/test_forgeries.py", "tests/evaluation/test_certify.py"
_FILES = "tests/certification/test_malformed.py"
MALFORMED = f"{_FILES}::test_a_malformed_file_is_no_certificate"
NESTED = f"{_FILES}::test_nesting_is_refused_before_anything_is_parsed"
CLAIMS = f"{FORGED}::test_a_forgery_with_a_fitting_digest_is_refused"
MORE_THAN_PROVED = "tests/certification/test_told.py::test_an_agent_that_tolerates_more_than_is_proved_says_so_or_is_refused"
EARLY = f"{FORGED}::test_a_step_may_be_rounded_away_only_where_episodes_end_early"
HOVERS = f"{FORGED}::test_a_barrier_that_hovers_hides_no_events"
SPIKED = f"{LOOPS}::test_a_spike_in_u_makes_no_start_close"
UNNAMED = f"{LOOPS}::test_seeds_that_only_the_certificate_names_measure_nothing"
STEPS = f"{LOOPS}::test_events_are_those_of_every_single_step"
AGENT, BESIDE = "torchrl_sspl/modules/agent.py", "torchrl_sspl/evaluation/beside.py"
CONTROLLERS, KNOWN = "torchrl_sspl/evaluation/controllers.py", "torchrl_sspl/evaluation/known.py"
FLAGS = "tests/modules/test_agent.py"
BELONGS = "tests/evaluation/test_beside.py"
BESIDES = f"{BELONGS}::test_a_certificate_is_shown_beside_its_own_agent_alone"
NUMBERS = "tests/evaluation/test_known.py::test_no_number_is_an_error_of_either_kind"

#: (file, old text, new text, tests[, why it survives])
MUTANTS = [
    # Seeds.
    (SEEDS, "PURPOSES[purpose] * _INDICES + index", "PURPOSES[purpose] + index", "tests/test_seeds.py"),
    (SEEDS, "(seed - other) & _MASK == 0", "seed == other", "tests/test_seeds.py"),
    (SEEDS, "(0x85EBCA6B, 0xC2B2AE35)", "(0x85EBCA6A, 0xC2B2AE35)", "tests/test_seeds.py"),
    # Bounds.
    (STATISTICS, "beta.ppf(confidence, events + 1, n - events)", "beta.ppf(confidence, events, n - events + 1)", BOUNDS),
    (STATISTICS, "beta.ppf(1.0 - tail, events + 1, n - events)", "beta.ppf(1.0 - tail, events + 1, n - events + 1)", BOUNDS),
    (STATISTICS, "beta.ppf(tail, events, n - events + 1)", "beta.ppf(tail, events + 1, n - events)", BOUNDS),
    (STATISTICS, "if n == 0 or events == n:\n        return 1.0", "if n == 0 or events == n:\n        return 0.0", BOUNDS),
    (STATISTICS, "* (1.0 + 1e-9)", "* (1.0 - 1e-9)", BOUNDS),
    (STATISTICS, "1.0 - share**n < confidence", "1.0 - share**n < 0.0", BOUNDS),
    (STATISTICS, "binom.cdf(rank - 2, n, share)", "binom.cdf(rank - 1, n, share)", BOUNDS),
    (STATISTICS, "ordered[rank - 1]", "ordered[rank - 2]", BOUNDS),
    (STATISTICS, "each = 1.0 - 0.5 * (1.0 - record.confidence)", "each = record.confidence", BOUNDS),
    (STATISTICS, "n, m = total.episodes - sizes[\"repeated\"]", "n, m = total.episodes - 0", BOUNDS),
    (STATISTICS, "total.shown - sizes[\"leaked\"]", "total.shown", BOUNDS),
    (STATISTICS, "holds = bound <= acceptable", "holds = bound < acceptable", BOUNDS),
    (STATISTICS, "why = Reason.TOO_FEW if events == 0 else reason", "why = reason", TWINS),
    (STATISTICS, "reason = Reason.EPISODES_LEAVE if not total.entered else", "reason = Reason.EPISODES_LEAVE if total.entered else", TWINS),
    (STATISTICS, "events = min(total.events, n)", "events = min(total.left, n)", TWINS),
    (STATISTICS, "of {m}; at most\", min(total.mistaken, m)", "of {m}; at most\", 0", TWINS),
    (STATISTICS, "clash = any(used_before(seed, used) or", "clash = any(", TWINS),
    (STATISTICS, "any(drawn_for(seed, root) not in own for root in used)", "False", f"{LOOPS}::test_seeds_of_the_training_are_found"),
    (STATISTICS, "fails = found > REPEATED * n", "fails = False", TWINS),
    (STATISTICS, "total.undefined, total.episodes,\n         Reason", "0, total.episodes,\n         Reason", TWINS),
    (STATISTICS, "total.outside, total.seen, Reason", "0, total.seen, Reason", TWINS),
    (STATISTICS, "if not total.episodes or not total.shown", "if not total.episodes and not total.shown", TWINS),
    (STATISTICS, "if tolerated_error is None or not tolerated_error > 0", "if tolerated_error is None", BOUNDS),
    (STATISTICS, "needed = psi * (closed_loop_constant + 1.0)", "needed = psi * closed_loop_constant", BOUNDS),
    (STATISTICS, "psi3 = psi * (number[\"closed_loop_constant\"] + 1.0)", "psi3 = psi", TWINS),
    (STATISTICS, "\"unsafe\": -unsafe.double()", "\"unsafe\": unsafe.double()", TWINS),
    (STATISTICS, "\"following\", psi + eta, ", "\"following\", psi, ", TWINS),
    # The record.
    (RECORD, "type(value) is not int or not low <= value", "not isinstance(value, int) or not low <= value", MALFORMED),
    (RECORD, "not abs(value) <= _FINITE or not low", "not low", MALFORMED),
    (RECORD, "set(body) != set(expected)", "not set(body) >= set(expected)", MALFORMED),
    (RECORD, "max(parts) <= self.events", "0 <= self.events", MALFORMED),
    (RECORD, "self.events <= min(sum(parts), self.episodes)", "self.events <= self.episodes", MALFORMED),
    (RECORD, "self.mistaken > self.shown or ", "", MALFORMED),
    (RECORD, " or self.aliased > self.entered", "", MALFORMED),
    (RECORD, " or self.exceeding > self.episodes", "", MALFORMED),
    (RECORD, "if block.episodes > n or ", "if ", MALFORMED),
    (RECORD, " or block.steps > block.episodes * self.horizon", "", MALFORMED),
    (RECORD, "if not self.complete() or ", "if ", MALFORMED),
    (RECORD, "(len(self.blocks) > 1 and Record", "(False and Record", f"{BOUNDS}::test_blocks_beyond_those_that_the_rule_asks_for_are_refused"),
    (RECORD, "begun == 0 or begun >= self.episodes", "begun >= self.episodes", BOUNDS),
    (RECORD, "begun >= self.episodes", "min(begun, self.total.shown) >= self.episodes", BOUNDS),
    (RECORD, "self.envs * -(-min(self.episodes, 100) // self.envs)", "max(self.envs, min(self.episodes, 100))", BOUNDS),
    (RECORD, "drawn >= 3 * self.episodes", "drawn >= 4 * self.episodes", BOUNDS),
    (RECORD, "if drawn < self.episodes:\n            return False", "if drawn < self.episodes:\n            return True", BOUNDS),
    (RECORD, "spawn(self.seed, purpose, k) for k", "spawn(self.seed, purpose, 0) for k", BOUNDS),
    (RECORD, "<= s[\"longest\"] <= self.horizon", "<= s[\"longest\"]", MALFORMED),
    (RECORD, "or s[\"repeated\"] > total.episodes", "", MALFORMED),
    (RECORD, "any(s[f\"{k}_met\"] > s[k] for", "any(False for", MALFORMED),
    # Reading a certificate.
    (CERTIFICATE, "is not int or body[\"schema\"] != SCHEMA", "is int and body[\"schema\"] != SCHEMA", MALFORMED),
    (CERTIFICATE, "if depth > _DEPTH:", "if depth > 10**9:", NESTED),
    (CERTIFICATE, "if len(data) > _BYTES:", "if False:", MALFORMED),
    (CERTIFICATE, "if len(body) < len(pairs):", "if False:", MALFORMED),
    (CERTIFICATE, "parse_constant=_no_constant, ", "", MALFORMED,
     "every number is looked at once more where it is used, as 1e999 is infinity without being a constant: the file is refused "
     "all the same"),
    (CERTIFICATE, " or not body[name].isprintable()", "", MALFORMED),
    (CERTIFICATE, "or len(body[name]) > _TEXT ", "", MALFORMED),
    (CERTIFICATE, "is not (bool if decides else type(None))", "not in (bool, int, type(None))", MALFORMED),
    (CERTIFICATE, "bool(body[\"reason\"]) != (body[\"holds\"] is False) or", "False or", MALFORMED),
    (CERTIFICATE, "body[\"reason\"] not in Reason.__members__", "False", MALFORMED),
    (CERTIFICATE, "if part[\"name\"] != name or", "if", MALFORMED),
    (CERTIFICATE, "any(s.kind == PROVED for s in layers[name].statements)", "False", MALFORMED),
    (CERTIFICATE, "if part[\"verdict\"] != layers[name].verdict:", "if False:", MALFORMED),
    (CERTIFICATE, "len(set(names)) < len(names) or", "False or", MALFORMED),
    # Comparing it.
    (CERTIFICATE, "claimed.written != claimed.digest", "False", f"{FORGED}::test_a_digest_alone_is_changed"),
    (CERTIFICATE, "for k in (\"text\", \"kind\", \"unit\", \"n\", \"confidence\") if", "for k in (\"kind\", \"n\", \"confidence\") if", CLAIMS),
    (CERTIFICATE, "for k in (\"text\", \"kind\", \"unit\", \"n\", \"confidence\") if", "for k in (\"text\", \"kind\", \"unit\") if", CLAIMS),
    (CERTIFICATE, "if a.holds != b.holds or a.reason != b.reason or", "if a.holds != b.holds or", f"{FORGED}::test_a_refutation_is_not_made_smaller"),
    (CERTIFICATE, "not _not_better(a, b):", "False:", CLAIMS),
    (CERTIFICATE, "return a.value >= b.value * (1.0 - 1e-9)", "return a.value <= b.value * (1.0 + 1e-9)", CLAIMS),
    (CERTIFICATE, "not 0.5 <= _ratio(a.misses_by, b.misses_by) <= 2.0", "False", f"{FORGED}::test_a_refutation_is_not_made_smaller"),
    (CERTIFICATE, "a.value <= b.value * (1.0 + 1e-9):\n        return []", "a.value <= b.value * 1.01:\n        return []", CLAIMS),
    (CERTIFICATE, "any(limit < a.value for limit in said)", "False", CLAIMS),
    (CERTIFICATE, "any(x < y - 1.001 *", "any(False and x < y - 1.001 *", CLAIMS),
    (CERTIFICATE, "if not a.holds or a.misses_by", "if a.misses_by", CLAIMS),
    (CERTIFICATE, "a.value >= required and a.value > 0.0", "a.value > 0.0", MORE_THAN_PROVED),
    (CERTIFICATE, "max(required - a.value, 0.0)", "max(-a.value, 0.0)", MORE_THAN_PROVED),
    (CERTIFICATE, "or not _bounds_are_all_there(mine)", "", MORE_THAN_PROVED),
    (CERTIFICATE, "return [] if same else", "return [] if True else", CLAIMS),
    (CERTIFICATE, "not (_EFFORT.fullmatch(a.detail) or (_gave_up(b) and a.detail == b.detail)) or ", "", CLAIMS),
    (CERTIFICATE, "elif b.holds is False and not _gave_up(b):", "elif False:", f"{FORGED}::test_a_refutation_replaced_by_undecided_is_refused"),
    (CERTIFICATE, "elif b is None or (_gave_up(b) and not _gave_up(a)):", "elif b is None:", f"{LOOPS}::test_a_slow_machine_that_verifies_says_that_the_time_was_short"),
    (CERTIFICATE, "    if not named or not _bounds_are_all_there(mine):\n", "    if False:\n", CLAIMS),
    (CERTIFICATE, "if f.name not in (\"value\", \"misses_by\", \"confidence\")]", "if f.name in (\"name\", \"kind\")]", CLAIMS),
    (CERTIFICATE, "for k in (\"value\", \"misses_by\", \"confidence\") if not", "for k in (\"misses_by\",) if not", CLAIMS),
    (CERTIFICATE, "rel_tol=1e-9, abs_tol=1e-15", "rel_tol=1e-2, abs_tol=1e-15", CLAIMS),
    # Counting.
    (BLOCKS, "\"left\": ((barrier > level + margin) & alive).any(0)", "\"left\": ((barrier > level + margin) & alive)[-1]", STEPS),
    (BLOCKS, "\"entered\": unsafe.any(0),", "\"entered\": unsafe.any(0) & False,", STEPS),
    (BLOCKS, "\"aliased\": (unsafe & (torch.minimum(barrier, seen) <= level - margin)).any(0),", "\"aliased\": (unsafe & (barrier < -9)).any(0),", STEPS),
    (BLOCKS, "(~barrier.isfinite() & alive).any(0) | ~worst.isfinite()", "~worst.isfinite()[:0].any() & (barrier[0] > 1e9)", f"{LOOPS}::test_no_number_is_an_event_and_no_way_to_stay_inside"),
    (BLOCKS, "torch.stack(list(events.values())).any(0)", "events[\"left\"]", STEPS),
    (BLOCKS, "error, limit * (1 + slack), held", "error, limit * (2 + slack), held", STEPS),
    (BLOCKS, "found, worst = counted(run, self.level, self.tolerated, held=self.held)", "found, worst = counted(run, self.level + 9, self.tolerated, held=self.held)", STEPS),
    (BLOCKS, "before, after = self._entering(n // 2, g)", "before, after = uniform[: n // 2], uniform[: n // 2]", f"{LOOPS}::test_half_of_the_observations_of_u_are_where_it_is_entered"),
    (BLOCKS, "(int((~(unsafe > self.level - m)).sum()) for m", "(0 for m", f"{LOOPS}::test_half_of_the_observations_of_u_are_where_it_is_entered"),
    (BLOCKS, "(~(own_barrier[0] > level))", "(own_barrier[0] > -9)", f"{LOOPS}::test_episodes_end_where_the_environment_ends_them"),
    (BLOCKS, "looks = torch.minimum(barrier, both.seen)", "looks = barrier", f"{LOOPS}::test_a_picture_of_u_that_looks_safe_counts_though_the_memory_knows_better"),
    (CERTIFY, "if agent.tolerated_error and claimed.level:", "if claimed.level > 0:", f"{LOOPS}::test_an_agent_that_tolerates_errors_is_certified_at_the_level_that_it_keeps"),
    (CERTIFY, "if measure and not blocks:", "if False:", f"{LOOPS}::test_measuring_all_again_fails_where_nothing_can_be_measured"),
    (AGENT, "return 0.0 if self.of_other_weights else", "return", FLAGS),
    (AGENT, "if before not in (None, agent.description[\"proof_of\"]):", "if False:", FLAGS),
    (AGENT, "and not self.of_other_weights", "", FLAGS),
    (BESIDE, "if said != now:", "if False:", BESIDES),
    (BESIDE, "(Reason.WEIGHTS_CHANGED, found.weights, weights_digest(agent.state_dict())),", "", BESIDES),
    (CERTIFY, "if record is None or before.weights == weights_digest(agent.state_dict()):", "if True:", f"{BELONGS}::test_an_agent_that_was_changed_is_measured_on_other_episodes"),
    (CERTIFY, "record.among != env.among", "False", f"{BELONGS}::test_which_states_are_drawn_is_said_and_compared"),
    (CONTROLLERS, "outside = ~(encoded.abs() <= 1.0).all(1)", "outside = ~(latent.abs() <= 1.0).all(1)", f"{LOOPS}::test_latents_outside_the_domain_are_counted_before_the_memory_cuts_them"),
    (KNOWN, "out.count(names[1], ~(safe_barrier <= 0)", "out.count(names[1], safe_barrier > 0", NUMBERS),
    (KNOWN, "~(in_unsafe > 0)", "in_unsafe <= 0", NUMBERS),
    (KNOWN, "(~(barrier <= 0)).any(0)", "(barrier > 0).any(0)", NUMBERS),
    (CERTIFY, "measure, trust, seconds, say)", "measure, trust or bool(measure), seconds, say)", f"{TWINS}::test_a_certificate_of_networks_that_run_code_is_checked_on_request_alone"),
    (CERTIFY, "Agent.load(directory, trust=trust)", "Agent.load(directory)", f"{TWINS}::test_a_certificate_of_networks_that_run_code_is_checked_on_request_alone"),
    (BLOCKS, "int((shown & ~(looks > level - m)).any(0).sum())", "0", f"{LOOPS}::test_resets_show_what_the_camera_hides"),
    (BLOCKS, "steps=int(start.alive[1:].sum())", "steps=int(start.alive.sum())", f"{LOOPS}::test_episodes_end_where_the_environment_ends_them"),
    (BLOCKS, "\"repeated\": n - len(set(prints))", "\"repeated\": 0", f"{LOOPS}::test_copies_of_one_episode_are_not_independent"),
    (BLOCKS, "sum(p in known for b in blocks for p in b.labelled)", "0", f"{LOOPS}::test_labelled_states_of_the_training_are_found"),
    (BLOCKS, "seed=spawn(root, \"certificate\", index)", "seed=root", f"{LOOPS}::test_blocks_of_resets_are_different_episodes"),
    (BLOCKS, "manual_seed(spawn(self.record.seed, \"certificate\", index))", "manual_seed(spawn(self.record.seed, \"certificate\", 0))", f"{LOOPS}::test_states_on_a_line_do_not_collide_falsely"),
    (CERTIFY, "return sorted({*recorded, *(int(s) for s in more)})", "return sorted(recorded)", f"{LOOPS}::test_seeds_of_the_training_are_found"),
    (CERTIFY, "return sorted({*recorded, *(int(s) for s in more)})", "return sorted(more)", f"{LOOPS}::test_seeds_of_the_training_are_found"),
    # Verifying.
    (CERTIFY, "if said != labels:", "if False:", CLAIMS),
    (STATISTICS, "if record.used is None or not (names_seeds or clash):", "if record.used is None:", UNNAMED),
    (STATISTICS, "not (names_seeds or clash)", "not names_seeds", UNNAMED),
    (CERTIFY, "missing = set(named or ()) - set(record or ())", "missing: set[int] = set()", CLAIMS),
    (CERTIFY, "if missing or (named is not None and record is None):", "if missing and False:", CLAIMS),
    (CERTIFY, "    _refuse(found)\n    budget", "    budget", CLAIMS),
    (CERTIFY, "        found = compared(_proof(agent, claimed.level, budget))\n    _refuse(found)", "        return", CLAIMS),
    (CERTIFY, "compared(proved(given_up)) if given_up else", "{} if given_up else", f"{FORGED}::test_where_a_search_gave_up_the_rest_is_compared_all_the_same"),
    (BLOCKS, "if missing > min(found[k] - least[k], 1)]", "if False]", f"{FORGED}::test_one_lowered_count_is_found_where_its_block_is_measured"),
    (BLOCKS, "min(found[k] - least[k], 1)", "found[k] - least[k]", HOVERS),
    (BLOCKS, "for k, n in wrong.items() if n > 1)", "for k, n in wrong.items() if n > 10**6)", HOVERS),
    (BLOCKS, "min(float(values.max()), max(1.0, abs(level)))", "float(values.max())", SPIKED),
    (BLOCKS, "<= margin).sum()), _CLOSE)", "<= margin).sum()), 10**6)", f"{LOOPS}::test_where_many_starts_are_close_few_may_be_rounded_away"),
    (BLOCKS, "short[\"uncovered\"] -= max(found.steps - claimed.steps, 0)", "pass", EARLY),
    (BLOCKS, "max(found.steps - claimed.steps, 0)", "abs(found.steps - claimed.steps)", EARLY),
    (BLOCKS, ".sum()) / _LATE)", ".sum()) / 2)", EARLY),
    (BLOCKS, "block.steps[block.steps < longest]", "block.steps", EARLY),
    (BLOCKS, "if abs(getattr(claimed, k) - found[k]) > most]", "if abs(getattr(claimed, k) - found[k]) > 10**9]", CLAIMS),
    (BLOCKS, "not _not_smaller(number, other)", "False", CLAIMS),
    (BLOCKS, "-1e-6 * max(1.0, abs(found)) <= claimed", "-1e-2 * max(1.0, abs(found)) <= claimed", CLAIMS),
    (BLOCKS, "abs(a[1] - b[1]) > close * claimed.horizon + max(3, b[1] // 100)", "False", CLAIMS),
    (BLOCKS, "value > found.sizes[name] + slack", "False", CLAIMS),
    (CERTIFY, "code = Exit.TIME if set(found) == {Reason.UNDECIDED} else Exit.REFUSED", "code = Exit.REFUSED", f"{LOOPS}::test_a_slow_machine_that_verifies_says_that_the_time_was_short"),
    (BLOCKS, "kind = resolve(spec[\"_target_\"]) if found else None", "kind = resolve(spec[\"_target_\"])", f"{LOOPS}::test_code_that_a_description_names_is_imported_only_if_it_is_trusted"),
    (BLOCKS, "if not (isinstance(kind, type) and issubclass(kind, SafetyEnv)):", "if False:", f"{LOOPS}::test_the_system_of_a_description_is_one_of_the_library"),
    (ROUNDING, "s.kind if checked or s.kind == \"assumed\" else \"claimed\"", "s.kind", f"{FORGED}::test_without_the_system_nothing_measured_is_printed_as_checked"),
    (CERTIFY, "except CheckpointError as error:\n        raise _Stop(Exit.AGENT", "except CheckpointError as error:\n        raise _Stop(Exit.REFUSED", f"{FORGED}::test_an_agent_that_cannot_be_read_has_an_exit_code_of_its_own"),
    ("torchrl_sspl/interrupts.py", "signal.setitimer(signal.ITIMER_REAL, max(seconds, 1e-3))", "pass", f"{FORGED}::test_a_proof_that_does_not_end_is_interrupted"),
    (CERTIFY, "if not plain or not all(type(v) in (int, float)", "if not plain or not all(True or type(v) in (int, float)", f"{FORGED}::test_an_agent_that_cannot_be_read_has_an_exit_code_of_its_own"),
    (BLOCKS, "all(a.shape == b.shape and torch.equal(a, b) for a, b in zip(seen(env), seen(twin), strict=True))", "True", f"{LOOPS}::test_a_system_is_compared_with_its_description"),
    (BLOCKS, "range(min(horizon, _COMPARED))", "range(1)", f"{LOOPS}::test_resets_are_compared_with_their_description"),
    (BLOCKS, "last = torch.tensor(min(horizon, ", "last = torch.tensor(max(horizon, ", f"{LOOPS}::test_resets_are_compared_with_their_description"),
]  # fmt: skip
