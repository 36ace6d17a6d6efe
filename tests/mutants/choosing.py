"""Mutants of policies that choose, and of what is proved of them."""

from __future__ import annotations

CONDITIONS, LOOP, DEPLOYED = (f"torchrl_sspl/certification/{n}.py" for n in ("conditions", "loop", "deployed"))
FLOATING, MODULE = "torchrl_sspl/certification/floating.py", "torchrl_sspl/modules/choosing.py"
AGENT, OTHERS = "torchrl_sspl/modules/agent.py", "torchrl_sspl/certification/vnnlib.py"

_T, _M = "tests/certification/test_choices.py::test_", "tests/modules/test_choosing.py::test_"
ROUNDED = f"{_T}rounding_counts_where_it_chooses_and_where_it_lands"
REFUSES = f"{_T}own_actions_that_rounding_may_refuse_are_not_counted_on"
LARGEST = f"{_T}the_largest_error_is_that_of_what_is_accepted_or_of_the_table"
COUNTS = f"{_T}what_is_accepted_counts_with_margins_levels_and_errors"
OWN = f"{_T}its_own_action_is_proved_where_the_table_would_not_do"
WEIGHED = f"{_T}conditions_that_weigh_the_barrier_are_refused"
GRAPH = f"{_T}the_graph_is_what_is_deployed_for_every_action_and_scale"
TWINS = f"{_T}what_is_not_the_policy_that_is_proved_is_refused"
TAKEN = f"{_T}which_action_is_taken_is_compared"
WORST = f"{_T}rounding_of_many_successors_is_that_of_the_worst_one"
PROPERTY = f"{_T}other_verifiers_are_asked_for_a_latent_at_which_nothing_helps"
TAKES = f"{_M}it_takes_its_own_action_where_that_is_accepted_else_the_best_of_the_table"
EXACTLY = f"{_M}its_own_action_is_accepted_at_exactly_the_margin"
INVALID = f"{_M}tables_and_margins_that_are_not_valid_are_refused"
BINDS, SAVED = f"{_M}an_agent_binds_its_policy_to_its_own_networks", f"{_M}nothing_is_saved_twice"
TRAVELS, TWICE = f"{_M}it_travels_with_its_agent", f"{_M}a_policy_that_is_not_bound_or_chooses_twice_is_refused"

MUTANTS = [
    # What is proved.
    (LOOP, "kept = constant[0] + 3.0 * lost", "kept = constant[0] + 2.0 * lost", ROUNDED),
    (CONDITIONS, "(system.accepted, constant, 2.0 * lost, ", "(system.accepted, constant, lost, ", ROUNDED),
    (CONDITIONS, "how[\"lost\"], lost = more_than(lost * lipschitz), 0.0", "pass", ROUNDED),
    (LOOP, "_SHARPNESS * (lost - self.accepted)", "_SHARPNESS * (-self.accepted)", REFUSES),
    (LOOP, "_SHARPNESS * (lost - self.accepted)", "_SHARPNESS * (lost + self.accepted)", f"{OWN} {LARGEST}"),
    (LOOP, " + self.lost_by(error)\n", "\n", COUNTS),
    (CONDITIONS, "lost, system.lost_by(error)))", "lost))", COUNTS),
    (CONDITIONS, "upper=max(found.upper, own)", "upper=found.upper", LARGEST),
    (CONDITIONS, "upper=max(found.upper, own)", "upper=min(found.upper, own)", LARGEST),
    (CONDITIONS, "or own <= threshold\n", "or True\n", COUNTS),
    (CONDITIONS, "most = max(found.lower, system.accepted - level)", "most = found.lower", LARGEST),
    (LOOP, "accepted = -float(cast(Tensor, policy.margin))", "accepted = float(cast(Tensor, policy.margin))", LARGEST),
    (LOOP, "if any(weight) or len(weight) > 1:", "if False:", WEIGHED),
    (LOOP, "action if scale is None else action / scale", "action", GRAPH),
    (LOOP, "looped.side_by_side([looped.network(k, barrier) for k in reads])", "looped.side_by_side([looped.network(k, barrier) for k in inner[::-1]])", GRAPH),
    (CONDITIONS, "constant = -level if every_way else system.lost_by(error) - level", "constant = -level", COUNTS),
    (FLOATING, "nan_to_num(nan=torch.inf).amax(1)", "nan_to_num(nan=torch.inf).amin(1)", f"{WORST} {ROUNDED}"),
    # What is refused.
    (LOOP, "or loop[0] is not dynamics", "", TWINS),
    (LOOP, " or loop[1] is not barrier", "", TWINS),
    (LOOP, "    check_module(policy)\n    loop", "    loop", TWINS),
    (LOOP, "if any(t is None for t in parts) or ", "if ", TWINS),
    (LOOP, "FORMS.get(type(dynamics)) != \"residual\" or ", "", TWINS),
    (LOOP, "(corners[1] < 1.0)", "(corners[1] < 0.0)", TWINS),
    (DEPLOYED, "may[:, 0] = low[:, 0] <= system.accepted", "may[:, 0] = True", TAKEN),
    (DEPLOYED, "    may &= high[:, :1] > system.accepted\n", "", TAKEN),
    (DEPLOYED, "high[:, 1:].amin(1, keepdim=True)", "high[:, 1:].amax(1, keepdim=True)", TAKEN),
    (DEPLOYED, "tried.dtype and torch.equal(z, given[rows])", "tried.dtype", TAKEN),
    # What chooses.
    (MODULE, "value[..., 0] <= -self.margin", "value[..., 0] < -self.margin", EXACTLY),
    (MODULE, "value[..., 0] <= -self.margin", "value[..., 0] <= self.margin", TAKES),
    (MODULE, "value[..., 1:].argmin(-1)", "value[..., 1:].argmax(-1)", TAKES),
    (MODULE, "1 + value[..., 1:]", "value[..., 1:]", TAKES),
    (MODULE, "not bool(table.isfinite().all())", "False", INVALID),
    (MODULE, "(table.abs() > scale).any()", "(table > 9 * scale).any()", INVALID),
    (MODULE, "not 0.0 <= margin", "not -1.0 <= margin", INVALID),
    (MODULE, "self.loop = (dynamics, barrier)\n", "self.loop = nn.ModuleList((dynamics, barrier))\n", SAVED),
    (MODULE, "if isinstance(policy, ChoosingPolicy):", "if False:", TWICE),
    (AGENT, "self.policy.bind(self.dynamics, self.barrier)", "pass", BINDS),
    (AGENT, "arguments = spec[\"arguments\"] | nested", "arguments = spec[\"arguments\"]", TRAVELS),
    (OTHERS, "[system.accepted, *[level]", "[level, *[level]", PROPERTY),
    (OTHERS, "if system.accepted > level:", "if False:", PROPERTY),
]  # fmt: skip
