"""Mutants of what is proved: search, bounds, layers, structure, floating point, exact arithmetic, printing."""

from __future__ import annotations

SEARCH, SPACES = "torchrl_sspl/certification/branch_and_bound.py", "torchrl_sspl/certification/half_spaces.py"
BOUNDS, FLOATING = "torchrl_sspl/certification/propagation.py", "torchrl_sspl/certification/floating.py"
CONDITIONS, LOOP, DEPLOYED = (f"torchrl_sspl/certification/{n}.py" for n in ("conditions", "loop", "deployed"))
PROOF, PRINT = "torchrl_sspl/certification/layers.py", "torchrl_sspl/certification/rounding.py"
LAYERS, NETWORK, EXACT = (f"torchrl_sspl/lipschitz/{n}.py" for n in ("layers", "network", "exact"))

_C = "tests/certification/test_"
NEEDLE = f"{_C}needles.py::test_a_needle_that_leads_out_is_never_proved_away"
LITTLE = f"{_C}needles.py::test_a_needle_that_leads_out_by_little_is_never_proved_away"
SLACKS = f"{_C}needles.py::test_nothing_is_proved_by_less_than_the_slack"
LEVEL = f"{_C}needles.py::test_points_within_the_slack_of_the_level_count"
FLOOR = f"{_C}needles.py::test_points_within_the_slack_of_the_floor_count"
WIDER = f"{_C}needles.py::test_a_needle_that_throws_beyond_one_is_seen_in_a_domain_that_is_wider"
ONE_POINT = f"{_C}needles.py::test_a_decrease_that_fails_at_one_point_is_not_proved"
DIAGONAL = f"{_C}needles.py::test_a_barrier_that_rises_along_the_diagonal_is_bounded_along_it"
WITNESS = f"{_C}needles.py::test_witnesses_lie_in_the_set_by_more_than_the_slack"
WITHIN = f"{_C}deployed.py::test_a_maximum_within_the_slack_is_neither_proved_nor_refuted"
EDGE = f"{_C}conditions.py::test_a_domain_that_is_left_by_less_than_the_slack_is_neither_kept_nor_left"
SAFE_SIDE = f"{_C}deployed.py::test_the_tolerated_error_is_on_the_safe_side_of_the_truth"
TWINS = f"{_C}deployed.py::test_networks_that_are_not_what_is_proved_are_refused"
VALUES = f"{_C}deployed.py::test_values_are_compared_where_a_module_is_not_of_the_form_that_it_was_given"
CLASSES = f"{_C}deployed.py::test_hooks_of_all_modules_and_methods_replaced_in_a_class_are_found"
SCALE = f"{_C}deployed.py::test_the_scale_counts_where_one_module_has_none"
ESCAPES, LINES = f"{_C}propagation.py::test_no_sample_escapes", f"{_C}propagation.py::test_lines_lie_below_and_above_their_activation"
PROGRAMME = f"{_C}propagation.py::test_linear_programme_on_boxes_is_never_below_what_sampling_finds"
CUT_TWICE = f"{_C}propagation.py::test_boxes_that_are_cut_twice_keep_every_point_that_meets_both_constraints"
ACCURATE = f"{_C}float32.py::test_float32_activations_are_as_accurate_as_is_assumed"
PRECISE = f"{_C}float32.py::test_float64_activations_are_as_accurate_as_is_assumed"
SECANTS = f"{_C}float32.py::test_slopes_of_intervals_hold_every_secant"
PIECES = f"{_C}float32.py::test_slopes_of_piecewise_linear_functions_are_exact"
RATIONAL = f"{_C}float32.py::test_bounds_hold_for_sums_in_any_order_against_rational_arithmetic"
SMOOTH = f"{_C}float32.py::test_bounds_hold_for_networks_of_every_activation"
ALONE = f"{_C}float32.py::test_bounds_hold_for_an_activation_alone"
WORST = f"{_C}float32.py::test_bound_is_reached_by_the_worst_order_up_to_a_quarter"
TERMS = f"{_C}float32.py::test_terms_that_are_zero_do_not_round_and_roundings_besides_do"
BIAS = f"{_C}float32.py::test_a_bias_rounds_as_every_other_term"
ACTION = f"{_C}float32.py::test_errors_of_the_action_reach_the_next_latent"
OVERFLOW = f"{_C}float32.py::test_a_sum_that_may_overflow_has_no_bound"
DOMAIN = f"{_C}float32.py::test_rounding_of_a_domain_bounds_that_of_its_points"
UNITS = f"{_C}float32.py::test_units_are_those_of_the_dtypes"
CANCEL = f"{_C}float32.py::test_units_that_cancel_in_real_arithmetic_only_are_refused"
LEFT = f"{_C}float32.py::test_what_is_left_of_the_tolerated_error_is_what_rounding_leaves"
TAKEN_IN = f"{_C}float32.py::test_a_point_that_only_the_computed_barrier_takes_in_counts"
BOTH_ENDS = f"{_C}float32.py::test_rounding_of_the_barrier_counts_where_a_step_begins_and_where_it_ends"
UNDECIDABLE = f"{_C}float32.py::test_a_search_that_float64_cannot_decide_is_said_to_be_none"
CORNER, DEEP = (f"{_C}conditions.py::test_{n}" for n in (
    "a_set_in_a_corner_is_not_overlooked", "a_decrease_that_fails_deep_in_the_set_is_not_proved_without_a_search"))  # fmt: skip
CLAMPED, STILL = (f"{_C}conditions.py::test_{n}" for n in (
    "a_clamp_proves_the_domain_only_if_it_lies_in_it", "lipschitz_constant_of_a_loop_that_stands_still_is_one"))  # fmt: skip
MARGINS = f"{_C}conditions.py::test_decay_and_decrement_are_proved_exactly_as_far_as_they_hold"
VACUOUS = f"{_C}conditions.py::test_empty_and_full_sets_are_called_so"
PRINTED = f"{_C}rounding.py"
LIMITS, LIPSCHITZ = "tests/lipschitz/test_proof_limits.py", "tests/lipschitz/test_lipschitz.py"

#: (file, old text, new text, tests[, why it survives])
TURNED = "tests/test_direction.py"

MUTANTS = [
    # Latents that hold a direction.
    (LAYERS, "after = ((lower - 1e-6 - sign * quarter) / turn).ceil()", "after = ((lower - 1e-6 - sign * quarter) / turn).floor()", TURNED),
    (LAYERS, "there = after <= upper + 1e-6", "there = after <= lower", TURNED),
    (LOOP, "pair[k : k + 2] = r * torch.eye(2, dtype=torch.float64)", "pair[k : k + 2] = 0.99 * r * torch.eye(2, dtype=torch.float64)", TURNED),
    (LOOP, "around = math.pi * direction.radius", "around = 0.5 * math.pi * direction.radius", TURNED),
    (LOOP, "at = torch.eye(n, dtype=torch.float64), torch.tensor([0.5 * math.pi, 0.0]", "at = torch.eye(n, dtype=torch.float64), torch.tensor([-0.5 * math.pi, 0.0]", TURNED),
    # The search: slacks.
    (SEARCH, "SLACK = 1e-6\n", "SLACK = 1e-7\n", f"{_C}deployed.py::test_a_maximum_within_the_slack_is_neither_proved_nor_refuted"),
    (SEARCH, "limit = threshold - SLACK\n", "limit = threshold\n", SLACKS),
    (SEARCH, "limit = threshold - SLACK\n", "limit = threshold + SLACK\n", SLACKS),
    (SEARCH, "least > problem.level + SLACK", "least > problem.level", LEVEL),
    (SEARCH, "most < problem.floor - SLACK", "most < problem.floor", FLOOR),
    (SEARCH, "-below.value - q.level - SLACK", "-below.value - q.level", LEVEL),
    (SEARCH, "q.floor - SLACK - above_b.value", "q.floor - above_b.value", FLOOR),
    (SEARCH, "barrier <= self.level - SLACK", "barrier <= self.level", WITNESS),
    (SEARCH, "barrier >= self.floor + SLACK", "barrier >= self.floor", WITNESS),
    (SEARCH, "self.lower > self.threshold + SLACK", "self.lower > self.threshold", EDGE),
    (SEARCH, "\"undecided\" if search.close else \"proved\"", "\"proved\"", EDGE),
    (SEARCH, "upper, volume = self.goal + (SLACK if self.close else 0.0)", "upper, volume = self.goal", EDGE),
    (SEARCH, "float(self.left.upper.max()) + SLACK", "float(self.left.upper.min())", f"{_C}needles.py::test_an_open_search_bounds_from_above_what_it_has_not_decided"),
    # The search: boxes.
    (SEARCH, "reach = q.lipschitz * (0.5 * (high - low)).norm(dim=1)", "reach = q.lipschitz * (0.25 * (high - low)).norm(dim=1)", NEEDLE),
    (SEARCH, "reach = q.lipschitz * (0.5 * (high - low)).norm(dim=1)", "reach = q.lipschitz * (0.5 * (high - low)).amax(1)", CORNER),
    (SEARCH, "reach = q.lipschitz * ((0.5 * (most - least)).norm(dim=2) + q.error)", "reach = q.lipschitz * ((0.25 * (most - least)).norm(dim=2) + q.error)", NEEDLE),
    (SEARCH, "reach = q.lipschitz * ((0.5 * (most - least)).norm(dim=2) + q.error)", "reach = q.lipschitz * ((0.5 * (most - least)).amax(2) + q.error)", DIAGONAL),
    (SEARCH, "value - reach, value + reach)", "value, value)", NEEDLE),
    (SEARCH, "first = (middle + reach) @ q.rows.mT", "first = middle @ q.rows.mT", NEEDLE),
    (SEARCH, "(inner.interval(k) for k in q.inner)", "([t.clamp(-1.0, 1.0) for t in inner.interval(k)] for k in q.inner)", WIDER),
    (SEARCH, "first = first + q.barrier_weight * below.at(inner.center).upper(inner.radius)", "pass", DEEP),
    (SEARCH, "slope + q.barrier_weight[:, None] * here.slope", "slope", ONE_POINT),
    (SEARCH, "value + q.barrier_weight * here.value", "value", ONE_POINT),
    (SEARCH, "parts = torch.minimum(first, above.upper(inner.radius))", "parts = torch.minimum(first, above.value)", NEEDLE),
    (SEARCH, "keep = ~(upper <= limit)", "keep = ~(upper <= limit + 0.05)", WITHIN),
    (SEARCH, "limit - above.value[:, k : k + 1]", "limit + 0.05 - above.value[:, k : k + 1]", LITTLE),
    (SEARCH, "torch.cat([self.low, low, low.scatter(1, axis, middle)])", "torch.cat([self.low, low, low.scatter(1, axis, high.gather(1, axis))])", NEEDLE),
    (SEARCH, "torch.cat([self.high, high.scatter(1, axis, middle), high])", "torch.cat([self.high, high.scatter(1, axis, low.gather(1, axis)), high])", NEEDLE),
    (SEARCH, "edges[:, 1:]).reshape", "edges[:, 1:] - 0.1 * span[:, None] / per_axis).reshape", NEEDLE),
    (SEARCH, "self.combine == \"min\"", "self.combine == \"max\"", MARGINS),
    # Half-spaces.
    (SPACES, "ratio, 0.0).clamp_min(0.0)", "ratio, 0.0)", PROGRAMME),
    (SPACES, "objective.value[..., None] - weights * constraint.value", "objective.value[..., None] + weights * constraint.value", PROGRAMME),
    (SPACES, "reach = (rest.abs() *", "reach = (rest *", PROGRAMME),
    (SPACES, "reach.sum(1, keepdim=True) - reach - moved.value", "reach.sum(1, keepdim=True) - 2.0 * reach - moved.value", PROGRAMME),
    (SPACES, "moved = constraint.at(center)", "moved = constraint", CUT_TWICE),
    (SPACES, "torch.where(cut & (slope < 0), center - room, low)", "torch.where(cut & (slope > 0), center - room, low)", PROGRAMME),
    # Propagation.
    (BOUNDS, "return self.value + (self.slope.abs() @ radius[..., None])[..., 0]", "return self.value + (self.slope @ radius[..., None])[..., 0]", NEEDLE),
    (BOUNDS, "(self.slope @ (center - self.center)[..., None])", "(self.slope @ (self.center - center)[..., None])", NEEDLE),
    (BOUNDS, "            reach += self.error\n", "            pass\n", ESCAPES),
    (BOUNDS, "gap.addcmul_(form.error, slope.abs())", "gap.addcmul_(form.error, slope)", ESCAPES),
    (BOUNDS, "wide = form.error @ weight.abs().mT", "wide = form.error @ weight.mT", ESCAPES),
    (BOUNDS, "value += (c.abs() @ form.error[..., None])[..., 0]", "pass", ESCAPES),
    (BOUNDS, "(above @ lines.upper_offset[..., None] + below @ lines.lower_offset[..., None])", "(above @ lines.lower_offset[..., None] + below @ lines.upper_offset[..., None])", ESCAPES),
    (BOUNDS, "above.mul_(lines.upper_slope[:, None]).addcmul_(below, lines.lower_slope[:, None])", "above.mul_(lines.lower_slope[:, None]).addcmul_(below, lines.upper_slope[:, None])", ESCAPES),
    (BOUNDS, "error = 0.5 * ((both.value", "error = 0.4 * ((both.value", ESCAPES),
    (BOUNDS, "(apart.abs() @ self.radius[..., None])[..., 0])\n", "0.0)\n", ESCAPES),
    (BOUNDS, "torch.minimum(high[:, open_], above[:, :half])", "torch.minimum(high[:, open_], 0.9 * above[:, :half])", ESCAPES),
    (BOUNDS, "radius = radius + 0.5 * (above - below) @ weight.abs().mT", "radius = radius + 0.5 * (above - below) @ weight.mT", ESCAPES),
    # Layers.
    (LAYERS, "curvature=0.7699", "curvature=0.5", LINES),
    (LAYERS, "curvature=0.0963", "curvature=0.06", LINES),
    (LAYERS, "curvature=0.501", "curvature=0.3", LINES),
    (LAYERS, "curvature=0.7979", "curvature=0.5", LINES),
    (LAYERS, "curvature=0.25 * b", "curvature=0.15 * b", LINES),
    (LAYERS, "-0.2784646)", "-0.2)", LINES),
    (LAYERS, "-0.1699713)", "-0.1)", LINES),
    (LAYERS, "(_GRID - 1)).square() / 8.0", "(_GRID - 1)).square() / 80.0", LINES),
    (LAYERS, "return rest.amin(0) - between, rest.amax(0) + between", "return rest.amin(0) + between, rest.amax(0) + between", LINES),
    (LAYERS, "(0.0, 1.0), (low, high), jump", "(0.0, 1.0), (low,), jump", LINES),
    (LAYERS, "jump=_off(low, high)", "jump=0.0", ACCURATE),
    (LAYERS, "min(a, deployed, 1.0), max(a, deployed, 1.0)", "min(a, 1.0), max(a, 1.0)", LIMITS),
    (LAYERS, "20.0 <= threshold", "0.0 <= threshold", f"{TWINS} {LIMITS}"),
    (LAYERS, "if not (b > 0 and", "if not (", TWINS),
    (LAYERS, "module.approximate != \"none\"", "module.approximate == \"\"", TWINS),
    (LAYERS, "\"Tanh\", torch.tanh, (0.0, 1.0), curvature=0.7699, ulps=8.0", "\"Tanh\", torch.tanh, (0.0, 1.0), curvature=0.7699, ulps=0.1", ACCURATE),
    (LAYERS, "jump = math.exp(-threshold) / b", "jump = 0.0 / b", PRECISE),
    (LAYERS, "\"Sigmoid\", torch.sigmoid, (0.0, 0.25)", "\"Sigmoid\", torch.sigmoid, (0.0, 0.24)", LIMITS),
    (LAYERS, "F.silu, (-0.1, 1.1)", "F.silu, (0.0, 1.0)", LIMITS),
    (LAYERS, "return (chord - change).clamp_min(self.slope[0]), (chord + change)", "return chord.clamp_min(self.slope[0]), chord", SECANTS),
    (LAYERS, "here = (lower < right) & (upper > left)", "here = (lower > left) & (upper < right)", f"{SECANTS} {PIECES}"),
    # Structure.
    (NETWORK, "_CALLS = (\"_forward_pre_hooks\", \"_forward_hooks\", ", "_CALLS = (\"_forward_hooks\", ", TWINS),
    (NETWORK, "\"_forward_hooks\", \"_backward_pre_hooks\"", "\"_backward_pre_hooks\"", TWINS),
    (NETWORK, "if any(everywhere) or any(", "if any(", CLASSES),
    (NETWORK, "if kind not in known:", "if not isinstance(module, known):", TWINS),
    (NETWORK, "if \"parametrizations\" in module._modules:", "if False:", TWINS),
    (NETWORK, "replaced = [k for k in vars(module) if callable(getattr(kind, k, None))]", "replaced: list[str] = []", TWINS),
    (NETWORK, "vars(module).get(\"_compiled_call_impl\") is not None", "False", TWINS),
    (NETWORK, "kind.forward is not ORIGINAL.get(kind, kind.forward) or ", "", CLASSES),
    (NETWORK, " or kind.__call__ is not _CALL", "", CLASSES),
    (NETWORK, "if kind is nn.Linear and any(", "if kind is nn.Tanh and any(", TWINS),
    (NETWORK, "value.is_meta or not bool(value.isfinite().all())", "value.is_meta", TWINS),
    (NETWORK, "if type(network) in COLLAPSIBLE:", "if hasattr(network, \"collapse\"):", f"{_C}deployed.py::test_collapse_of_a_plain_network_is_not_asked"),
    (NETWORK, "    check_module(network)\n    if type(network) in COLLAPSIBLE", "    if type(network) in COLLAPSIBLE", f"{TWINS} {LIMITS}"),
    (NETWORK, "a < low or b > high", "a < low", LIMITS),
    # The closed loop.
    (LOOP, "1.0 / cast(Tensor, own)", "cast(Tensor, own)", SCALE),
    (LOOP, "if (scale is None) != (own is None):", "if scale is not None and own is None:", SCALE),
    (LOOP, "if (scale is None) != (own is None):", "if scale is None and own is not None:", SCALE),
    (LOOP, "own is not None and not torch.equal(scale, own)", "own is not None and False", TWINS),
    (LOOP, "bool((scale >= _SCALES[0]).all() & (scale <= _SCALES[1]).all())", "bool((scale <= _SCALES[1]).all())", TWINS),
    (LOOP, "FORMS.get(type(module)) != form or ", "", TWINS),
    (CONDITIONS, "(system.low <= below).all()", "(system.low <= 9.0).all()", CLAMPED),
    (CONDITIONS, "(system.high >= above).all()", "(system.high >= -9.0).all()", CLAMPED),
    (CONDITIONS, "less_than(-(found.upper + SLACK) / system.lipschitz_bound)", "less_than(-(found.lower) / system.lipschitz_bound)", SAFE_SIDE),
    (CONDITIONS, "(SLACK - most) / system.lipschitz_bound", "(-SLACK - found.upper) / system.lipschitz_bound", SAFE_SIDE),
    (CONDITIONS, "level=level + of_barrier + SLACK", "level=level", TAKEN_IN),
    (CONDITIONS, "lost = of_step + of_barrier / lipschitz", "lost = of_step", BOTH_ENDS),
    (CONDITIONS, "lost = of_step + of_barrier / lipschitz", "lost = of_barrier / lipschitz", f"{LEFT} {CANCEL}"),
    (CONDITIONS, "delta = -(found.upper + SLACK) / lipschitz - lost", "delta = -(found.upper + SLACK) / lipschitz", LEFT),
    (CONDITIONS, "weight=(1.0 - decay,)", "weight=(1.0 + decay,)", MARGINS),
    (CONDITIONS, "constant=(margin + decrement, margin + floor)", "constant=(margin, margin + floor)", MARGINS),
    (CONDITIONS, "found.status != \"proved\", found.witness", "True, found.witness", VACUOUS),
    (LOOP, "seen = 1.0 + loop", "seen = loop", STILL),
    (LOOP, "math.hypot(seen, gain)", "seen", "tests/certification/test_deployed.py::test_the_lipschitz_constant_of_the_loop_is_one"),
    # Floating point.
    (FLOATING, "torch.float32: 2.0**-24", "torch.float32: 2.0**-25", UNITS),
    (FLOATING, "for w in step.weights).max()) + 1 + step.roundings", "for w in step.weights).max()) + step.roundings", TERMS),
    (FLOATING, ".max()) + 1 + step.roundings", ".max()) + 1", TERMS),
    (FLOATING, "gamma = terms * unit /", "gamma = 0.5 * terms * unit /", f"{WORST} {TERMS}"),
    (FLOATING, "handed = handed + errors[source] @ weight.abs().mT", "handed = handed + 0.0 * errors[source] @ weight.abs().mT", ACTION),
    (FLOATING, "torch.where(size < _OVERFLOW, own, torch.inf)", "own", OVERFLOW),
    (FLOATING, "made = errors[number] if number in ends else local[number]", "made = local[number]", ACTION),
    (FLOATING, "(middle.abs() + radius) @ made", "(middle + radius) @ made", f"{RATIONAL} {SMOOTH}"),
    (FLOATING, "own = own if act.ulps or act.jump or act.units else torch.zeros_like(before)", "own = torch.zeros_like(before)", ALONE),
    (FLOATING, "error = torch.stack([s.abs() for s in slopes[number]]).amax(0) * before + own", "error = own", f"{ACTION} {RATIONAL} {SMOOTH}"),
    (FLOATING, "return float(bound.max()) * _SAFETY", "return float(bound.min()) * _SAFETY", DOMAIN),
    (FLOATING, "size = step.bias.abs()\n", "size = 0.0 * step.bias\n", BIAS),
    # What is deployed.
    (DEPLOYED, "gap <= (first + second)[rows]", "gap <= 1e4 * (first + second)[rows]", VALUES),
    (DEPLOYED, "(slice(None), *(slice(k, k + 1) for k in range(0, n, max(1, n // 8))))", "(slice(None),)", VALUES),
    (DEPLOYED, " or not torch.equal(z, given[rows])", "", TWINS),
    (DEPLOYED, "share.append(torch.cartesian_prod(", "share[:1] and (torch.cartesian_prod(", VALUES),
    (DEPLOYED, "if len(found) != 1 or not found <= set(UNITS):", "if not found <= set(UNITS):", TWINS),
    (DEPLOYED, "if type(barrier) is not nn.Sequential:", "if False:", TWINS),
    (PROOF, "points = check_deployed(system, barrier, dynamics, policy)", "points = 0", VALUES),
    (PROOF, "value < 0.1 * SLACK", "value < 1e9 * SLACK", UNDECIDABLE),
    (PROOF, "proved, why = proof.proved, proof.reason", "proved, why = True, proof.reason", f"{_C}refusals.py::test_deterministic_layer_refuses"),
    (PROOF, "delta >= self.required and delta > 0.0", "True", CANCEL),
    # Exact arithmetic.
    (EXACT, "\"\" if margin >= 0 else", "\"\" if margin >= -(1 << common) else", LIMITS),
    (EXACT, "np.abs(rest).sum(axis=1) - np.abs(diagonal)", "rest.sum(axis=1) - diagonal", LIMITS),
    (EXACT, "square, square_shift = dyadic(Fraction(bound) ** 2)", "square, square_shift = dyadic(Fraction(2 * bound) ** 2)", f"{LIMITS} {LIPSCHITZ}"),
    (EXACT, "((high @ high.T, 2 * half), (cross + cross.T, half)", "((high @ high.T, 2 * half), (cross + cross.T, 0)", LIMITS),
    (EXACT, "identity(len(d)) * (2 * d)", "identity(len(d)) * (3 * d)", f"{LIMITS} {LIPSCHITZ}"),
    (EXACT, "(v > 0).all() for v in lams", "(v > -9).all() for v in lams", LIMITS),
    (EXACT, "product, product_shift = dyadic(Fraction(alpha) * Fraction(beta))", "product, product_shift = dyadic(Fraction(0))", LIMITS),
    (EXACT, "matrix[parts[j], parts[i]] += value.T", "pass", LIMITS),
    # Printing.
    (PRINT, "return _rounded(value, digits, ROUND_CEILING)", "return _rounded(value, digits, ROUND_FLOOR)", PRINTED),
    (PRINT, "return _rounded(value, digits, ROUND_FLOOR)", "return f\"{value:.{digits}g}\"", PRINTED),
    (PRINT, "statement.name in LOWER_BOUNDS)", "False)", PRINTED),
    (PRINT, "ROUND_FLOOR if lower else ROUND_CEILING", "ROUND_CEILING if lower else ROUND_FLOOR", PRINTED),
    (PRINT, "statement.unit, digits, False)", "statement.unit, digits, True)", PRINTED),
    (PRINT, "text if Decimal(text) == rounded else", "text if True else", PRINTED),
]  # fmt: skip
