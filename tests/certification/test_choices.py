"""[V] for policies that choose: proved where nothing continuous can be, and refused where what chooses is not what is proved."""

from __future__ import annotations

import copy
import math
import re
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
import torch
from analytic import SIZES, Line, line_agent
from choosing import LEFT_OR_RIGHT, linear, road, road_barrier, road_dynamics, steering, with_net
from forging import copied, verify
from safetensors.torch import load_file, save_file
from torch import Tensor, nn

from torchrl_sspl.certification.branch_and_bound import SLACK, Budget
from torchrl_sspl.certification.certificate import Certificate, Reason
from torchrl_sspl.certification.conditions import (
    computed_error,
    decide_domain,
    decide_invariance,
    decide_vacuity,
    find_counterexamples,
    largest_error,
    search_level,
    tolerates,
)
from torchrl_sspl.certification.deployed import check_deployed
from torchrl_sspl.certification.floating import UNITS, largest_rounding
from torchrl_sspl.certification.layers import deterministic_layer
from torchrl_sspl.certification.loop import ClosedLoop, closed_loop, closed_loop_lipschitz, evaluation_rounding
from torchrl_sspl.certification.vnnlib import export_vnnlib
from torchrl_sspl.errors import ConfigError, StructureError
from torchrl_sspl.evaluation.certify import certify, premise
from torchrl_sspl.lipschitz.layers import FORMS, ORIGINAL, known_form
from torchrl_sspl.modules import ChoosingPolicy, LatentDynamics, Policy
from torchrl_sspl.modules.agent import Agent

U = UNITS[torch.float32]


def system(*args: Any, **options: Any) -> ClosedLoop:
    return closed_loop(**road(*args, **options))


def points(n: int, p: int = 2, seed: int = 0) -> Tensor:
    return 2 * torch.rand(n, p, generator=torch.Generator().manual_seed(seed)) - 1


# --- what is proved ---------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(("gain", "offset"), [(0.0, 0.0), (5.0, 0.0), (50.0, 0.0), (-5.0, 0.0), (5.0, 1.0), (0.0, 1.0)])
def test_whatever_is_continuous_runs_into_the_obstacle_and_what_chooses_does_not(gain, offset):
    own = steering(gain, offset)
    parts = road(policy=own)
    assert decide_invariance(closed_loop(**parts | {"policy": own})).status == "refuted"
    assert decide_invariance(closed_loop(**parts)).status == "proved"


@pytest.mark.parametrize(("margin", "kept"), [(0.05, 0.05), (0.2, 0.2), (0.5, 0.3), (9.0, 0.3)])
def test_the_largest_error_is_that_of_what_is_accepted_or_of_the_table(margin, kept):
    # Beside the obstacle by 0.3, the best of the table leads to B = -0.3; own actions are accepted at -margin.
    loop = system(margin=margin)
    found, exact = largest_error(loop, tolerance=1e-3), kept / loop.lipschitz_bound
    assert exact - 2e-3 < found.delta < exact <= found.refuted_above + 1e-9 < exact + 2e-3


def test_its_own_action_is_proved_where_the_table_would_not_do():
    parts = road(actions=[[2.0]], policy=steering(0.0, -1.0))  # u = -2, or 2 where that is not accepted
    assert decide_invariance(closed_loop(**parts)).status == "proved"
    alone = road(actions=[[2.0]], policy=steering(0.0, -1.0), margin=9.0)
    assert decide_invariance(closed_loop(**alone)).status == "refuted"


def test_a_table_without_a_way_out_is_refuted_by_a_latent_that_really_leaves():
    parts = road(actions=[[0.0], [0.3]])
    loop = closed_loop(**parts)
    found = decide_invariance(loop)
    assert found.status == "refuted"
    z = found.witness[None].float()
    assert float(parts["barrier"](z)) <= 0.0 < float(parts["barrier"](parts["dynamics"](z, parts["policy"](z))))
    bad = find_counterexamples(loop, 20, generator=torch.Generator().manual_seed(0))
    assert len(bad) == 20
    after = parts["barrier"](parts["dynamics"](bad, parts["policy"](bad)))
    assert bool((after > -1e-6).all())
    assert len(find_counterexamples(system(), 20, generator=torch.Generator().manual_seed(0))) == 0


def test_at_a_tie_either_action_keeps_the_set():
    parts = road()
    z = torch.tensor([[0.45, 0.0], [0.45, 1e-8], [0.45, -1e-8], [0.5, 0.0]])
    assert bool((parts["barrier"](parts["dynamics"](z, parts["policy"](z))) < -0.29).all())
    assert decide_invariance(system(actions=[[2.0], [-2.0], [2.0]]), margin=0.09).status == "proved"


def test_what_is_accepted_counts_with_margins_levels_and_errors():
    loop = system(margin=0.1)
    assert decide_invariance(loop, margin=0.1 - 1e-6).status == "proved"
    assert decide_invariance(loop, margin=0.101).status == "undecided"
    assert decide_invariance(loop, level=-0.11).status == "undecided"
    assert decide_invariance(loop, level=-0.11).upper == pytest.approx(0.01, abs=1e-6)
    assert search_level(loop, levels=[-0.11]) is None
    error = 0.1 / loop.lipschitz_bound
    for every_way in (True, False):
        assert tolerates(loop, 0.99 * error, every_way=every_way).status == "proved"
        assert tolerates(loop, 1.01 * error, every_way=every_way).status == "undecided"
    few = system(margin=9.0)
    assert tolerates(few, 0.99 * 0.3 / few.lipschitz_bound).status == "proved"
    assert tolerates(few, 1.05 * 0.3 / few.lipschitz_bound).status == "refuted"


def test_without_a_margin_the_set_is_kept_and_no_error_tolerated():
    loop = system(margin=0.0)
    assert decide_invariance(loop).status == "proved"
    assert -1e-5 < largest_error(loop).delta < 0.0


def test_domain_and_vacuity_are_those_of_the_barrier():
    loop = system()
    assert decide_domain(loop).status == "proved"
    assert decide_vacuity(loop).status == "neither"
    assert 0.0 < evaluation_rounding(loop) < 0.1 * SLACK


def test_conditions_that_weigh_the_barrier_are_refused():
    for condition in ("R1", "R2"):
        with pytest.raises(ConfigError, match="R3"):
            decide_invariance(system(), condition=condition)
    with pytest.raises(StructureError, match="no Lipschitz constant"):
        closed_loop_lipschitz(road()["dynamics"], road()["policy"])


def test_the_graph_is_what_is_deployed_for_every_action_and_scale():
    parts = road([[-2.0], [0.7], [2.0]])
    loop, z = closed_loop(**parts), points(200)
    tried = [parts["policy"].policy(z), *(a.expand(200, 1) for a in parts["policy"].actions)]
    after = [parts["dynamics"](z, u) for u in tried]
    torch.testing.assert_close(loop.step(z).float(), torch.cat(after, 1), atol=1e-6, rtol=0)
    torch.testing.assert_close(loop.looped(z).float(), torch.cat([parts["barrier"](x) for x in after], 1), atol=2e-6, rtol=0)
    plain = ChoosingPolicy(nn.Sequential(linear([[0.0, 5.0]])), [[-2.0], [2.0]], 0.1)  # an action in physical units
    other = closed_loop(**parts | {"policy": plain.bind(parts["dynamics"], parts["barrier"])})
    torch.testing.assert_close(other.looped(z)[:, 1:], loop.looped(z)[:, [1, 3]])


def test_dynamics_that_remember_the_action_are_understood():
    torch.manual_seed(0)
    dynamics, barrier = LatentDynamics(3, 1, (8,), 2.0, remembers=True), nn.Sequential(nn.Linear(3, 8), nn.ReLU(), nn.Linear(8, 1))
    policy = ChoosingPolicy(Policy(3, 1, (8,), 2.0), LEFT_OR_RIGHT, 0.1).bind(dynamics, barrier).requires_grad_(False)
    loop = closed_loop(barrier, dynamics, policy, latent_dim=3, lipschitz_bound=9.0)
    assert check_deployed(loop, barrier, dynamics, policy, n=100) == 109
    assert loop.step(points(3, 3))[:, [5, 8]].tolist() == [[-1.0, 1.0]] * 3


# --- the numbers that are computed ------------------------------------------------------------------------------------


def rough(k: float, margin: float) -> dict[str, Any]:
    """B = 1/2 - |z| in real arithmetic; large units cancel, and float32 leaves what they round off. z+ = 0.8 z + 0.3 u."""
    first = linear([[1.0], [-1.0], [k], [k], [0.0]], [0.0, 0.0, 2 * k, k, k])
    barrier = nn.Sequential(first, nn.ReLU(), linear([[-1.0, -1.0, 1.0, -1.0, -1.0]], [0.5]))
    moves = linear([[-0.2, 0.3], [0.2, -0.3]])
    dynamics = with_net(LatentDynamics(1, 1, (1,)), moves, nn.ReLU(), linear([[1.0, -1.0]]))
    own = with_net(Policy(1, 1, (1,)), linear([[0.0]]))
    policy = ChoosingPolicy(own, [[-1.0], [1.0]], margin).bind(dynamics, barrier)
    return {"barrier": barrier, "dynamics": dynamics, "policy": policy, "latent_dim": 1, "lipschitz_bound": 1.0}


@pytest.mark.parametrize(("margin", "room", "times"), [(0.1, 0.1, 2.0), (9.0, 0.2, 3.8)])
def test_rounding_counts_where_it_chooses_and_where_it_lands(margin, room, times):
    # Own actions: 2 (e_B + e_d). The table: 3, and the set is larger by e_B, of which z+ = 0.8 z takes 0.8.
    loop = closed_loop(**rough(5e3, margin))
    real = computed_error(loop, largest_error(loop, tolerance=1e-5), unit=U, tolerance=1e-5)
    assert 1e-3 < real.barrier_rounding < 0.02
    assert real.step_rounding < 1e-5
    exact = room - times * real.barrier_rounding
    assert exact - 2e-4 < real.delta <= exact
    of = {"barrier_rounding": real.barrier_rounding, "step_rounding": real.step_rounding}
    assert tolerates(loop, real.delta - 1e-4, **of).status == "proved"
    assert tolerates(loop, real.delta + 4e-4, **of).status != "proved"


@pytest.mark.parametrize("margin", [0.1, 0.25, 9.0])
def test_the_computed_set_is_kept_by_what_is_computed(margin):
    parts = rough(5e3, margin)
    loop = closed_loop(**parts)
    real = computed_error(loop, largest_error(loop), unit=U)
    assert real.delta > 0.05
    z = torch.linspace(-1, 1, 200_001)[:, None]
    z = z[parts["barrier"](z)[:, 0] <= 0]
    after = parts["dynamics"](z, parts["policy"](z)).double()
    for side in (-1.0, 1.0):
        moved = (after + side * 0.999999 * real.delta).clamp(-1.0, 1.0).float()
        assert float(parts["barrier"](moved).max()) <= 0.0


def test_rounding_at_a_tie_may_choose_what_is_not_the_best():
    # 0.3 u is 0.3 on both sides of zero: near it the two differ by less than is rounded off.
    parts = rough(1e4, 9.0)
    z = torch.linspace(-0.02, 0.02, 20_001)[:, None]
    loop, u = closed_loop(**parts), parts["policy"](z)
    taken = torch.where(u[:, 0] > 0, loop.looped(z)[:, 2], loop.looped(z)[:, 1])
    lost = float((taken - loop.looped(z)[:, 1:].amin(1)).max())
    off = largest_rounding(loop.barrier, loop.low, loop.high, U)
    assert 1e-4 < lost <= 2.0 * off + 1e-5
    assert check_deployed(loop, *(parts[k] for k in ("barrier", "dynamics", "policy"))) > 1000


def test_own_actions_that_rounding_may_refuse_are_not_counted_on():
    parts = rough(5e3, 0.18)  # by real numbers its own action is accepted everywhere, at B <= -0.2, and the table is no way out
    parts["policy"].policy.net = nn.Sequential(linear([[50.0]]))
    parts["policy"].actions = torch.zeros(1, 1)
    loop = closed_loop(**parts)
    assert tolerates(loop, 0.01).status == "proved"
    of_barrier, of_step = loop.rounding(U)
    assert 0.01 < of_barrier < 0.02
    assert tolerates(loop, 0.01, barrier_rounding=of_barrier, step_rounding=of_step).status == "refuted"
    parts["policy"].margin.fill_(0.15)
    assert tolerates(closed_loop(**parts), 0.01, barrier_rounding=of_barrier, step_rounding=of_step).status == "proved"


def test_rounding_of_many_successors_is_that_of_the_worst_one():
    loop = system()
    parts = road()
    alone = closed_loop(**parts | {"policy": parts["policy"].policy})
    step = loop.rounding(U, boxes=512)[1]
    assert alone.rounding(U, boxes=512)[1] * 0.5 < step < 1e-5
    together = largest_rounding(loop.step, loop.low, loop.high, U, boxes=512)
    assert step < together <= math.sqrt(3.0) * step * 1.01


# --- what is refused --------------------------------------------------------------------------------------------------


class Other(ChoosingPolicy):
    pass


class OtherPolicy(Policy):
    pass


def without_buffer(p: dict[str, Any]) -> None:
    table = p["policy"]._buffers.pop("actions")
    p["policy"].actions = table


def rebound(**changed: Any) -> Callable[[dict[str, Any]], Any]:
    return lambda p: p.update(changed) or p["policy"].bind(p["dynamics"], p["barrier"])


def subclassed(p: dict[str, Any]) -> None:
    p["policy"] = Other(p["policy"].policy, LEFT_OR_RIGHT, 0.1).bind(p["dynamics"], p["barrier"])


TWINS: dict[str, tuple[Callable[[dict[str, Any]], Any], Reason]] = {
    "not bound": (lambda p: setattr(p["policy"], "loop", None), Reason.CHOOSES_BY_OTHERS),
    "another barrier of the same weights": (lambda p: p.update(barrier=copy.deepcopy(p["barrier"])), Reason.CHOOSES_BY_OTHERS),
    "other dynamics of the same weights": (lambda p: p.update(dynamics=copy.deepcopy(p["dynamics"])), Reason.CHOOSES_BY_OTHERS),
    "bound to another barrier": (lambda p: p["policy"].bind(p["dynamics"], road_barrier()), Reason.CHOOSES_BY_OTHERS),
    "bound to other dynamics": (lambda p: p["policy"].bind(road_dynamics(), p["barrier"]), Reason.CHOOSES_BY_OTHERS),
    "bound the other way round": (lambda p: p["policy"].bind(p["barrier"], p["dynamics"]), Reason.CHOOSES_BY_OTHERS),
    "hook on the policy that chooses": (lambda p: p["policy"].register_forward_hook(lambda m, i, o: -o), Reason.HOOKED),
    "hook on the policy inside": (lambda p: p["policy"].policy.register_forward_hook(lambda m, i, o: -o), Reason.HOOKED),
    "hook on a layer of the policy inside": (lambda p: p["policy"].policy.net[0].register_forward_hook(lambda m, i, o: -o), Reason.HOOKED),
    "forward of its own": (lambda p: setattr(p["policy"], "forward", lambda z: z[:, :1]), Reason.OVERRIDDEN),
    "forward of its own inside": (lambda p: setattr(p["policy"].policy, "forward", lambda z: z[:, :1]), Reason.OVERRIDDEN),
    "compiled": (lambda p: p["policy"].compile(), Reason.OVERRIDDEN),
    "subclass": (subclassed, Reason.SUBCLASSED),
    "subclass inside": (lambda p: setattr(p["policy"], "policy", with_net(OtherPolicy(2, 1, (1,), 2.0), *p["policy"].policy.net)), Reason.SUBCLASSED),
    "one that chooses inside": (lambda p: setattr(p["policy"], "policy", road()["policy"]), Reason.NOT_UNDERSTOOD),
    "table that is no buffer": (without_buffer, Reason.NOT_UNDERSTOOD),
    "table without actions as vectors": (lambda p: setattr(p["policy"], "actions", torch.tensor([1.0])), Reason.NOT_UNDERSTOOD),
    "table of another size": (lambda p: setattr(p["policy"], "actions", torch.ones(2, 2)), Reason.NOT_UNDERSTOOD),
    "NaN in the table": (lambda p: p["policy"].actions[0].fill_(math.nan), Reason.NOT_FINITE),
    "margin that is not a number": (lambda p: p["policy"].margin.fill_(math.nan), Reason.NOT_FINITE),
    "table in double precision": (lambda p: setattr(p["policy"], "actions", p["policy"].actions.double()), Reason.WRONG_DTYPE),
    "domain that successors may leave": (lambda p: p.update(high=0.9), Reason.NOT_UNDERSTOOD),
    "dynamics without a clamp": (rebound(dynamics=nn.Sequential(linear([[1.0, 0.0, 0.0], [0.0, 1.0, 0.3]]))), Reason.NOT_UNDERSTOOD),
    "table with one side alone": (lambda p: p["policy"].actions.fill_(0.5), Reason.NOT_INVARIANT),
    "margin too small for the error": (lambda p: p["policy"].margin.fill_(0.01) and p.update(required_error=0.05), Reason.MARGIN_TOO_SMALL),
    "no margin": (lambda p: p["policy"].margin.fill_(0.0), Reason.MARGIN_TOO_SMALL),
    "margin below zero": (lambda p: p["policy"].margin.fill_(-0.1), Reason.UNDECIDED),
    "margin below the level": (lambda p: p.update(level=-0.2), Reason.UNDECIDED),
}  # fmt: skip


def test_the_road_is_certified_with_the_policy_that_chooses():
    layer = deterministic_layer(**road())
    assert layer.holds, [(s.name, s.detail) for s in layer.statements if not s.holds]
    assert 0.0 < layer["float32"].value < layer["tolerated error"].value < 0.1


@pytest.mark.parametrize("name", TWINS)
def test_what_is_not_the_policy_that_is_proved_is_refused(name):
    breaking, reason = TWINS[name]
    twin = road()
    breaking(twin)
    layer = deterministic_layer(**twin, budget=Budget(boxes=20_000))
    assert not layer.holds
    assert layer.reasons[0] is reason, layer.reasons


def test_a_margin_that_does_not_fit_the_level_is_said_to_be_the_reason():
    assert "larger margin" in deterministic_layer(**road(), level=-0.2)["invariance"].detail


def test_rounding_that_the_choice_does_not_survive_tolerates_nothing():
    loop = closed_loop(**rough(2.2e4, 0.1))  # one e_B less than is left by the margin, two are more
    real = computed_error(loop, largest_error(loop), unit=U)
    assert real.barrier_rounding < 0.1 < 2 * real.barrier_rounding
    assert real.delta <= 0.0


def test_a_forward_that_is_replaced_in_the_class_is_found(monkeypatch):
    monkeypatch.setattr(ChoosingPolicy, "forward", lambda self, z: self.policy(z))
    with pytest.raises(StructureError) as error:
        system()
    assert error.value.reason == "OVERRIDDEN"


class Worst(ChoosingPolicy):
    def forward(self, latent: Tensor) -> Tensor:
        dynamics, barrier = self.loop
        own = self.policy(latent)
        value = torch.cat([barrier(dynamics(latent, a.expand(len(latent), 1))) for a in self.actions], 1)
        return torch.where(barrier(dynamics(latent, own)) <= -self.margin, own, self.actions[value.argmax(1)])


class AcceptsMore(ChoosingPolicy):
    def forward(self, latent: Tensor) -> Tensor:
        dynamics, barrier = self.loop
        own = self.policy(latent)
        return torch.where(barrier(dynamics(latent, own)) <= 0.5 * self.margin, own, super().forward(latent))


class NeverItsOwn(ChoosingPolicy):
    def forward(self, latent: Tensor) -> Tensor:
        dynamics, barrier = self.loop
        value = torch.cat([barrier(dynamics(latent, a.expand(len(latent), 1))) for a in self.actions], 1)
        return self.actions[value.argmin(1)]


class Between(ChoosingPolicy):
    def forward(self, latent: Tensor) -> Tensor:
        return 0.999 * super().forward(latent)


class Alone(ChoosingPolicy):
    def forward(self, latent: Tensor) -> Tensor:
        return super().forward(latent) * (1.0 if len(latent) > 1 else -1.0)


class Changes(ChoosingPolicy):
    def forward(self, latent: Tensor) -> Tensor:
        taken = super().forward(latent)
        latent.mul_(0.5)
        return taken


class Fails(ChoosingPolicy):
    def forward(self, latent: Tensor) -> Tensor:
        raise RuntimeError("no")


class Flat(ChoosingPolicy):
    def forward(self, latent: Tensor) -> Tensor:
        return super().forward(latent)[:, 0]


@pytest.mark.parametrize("kind", [Worst, AcceptsMore, NeverItsOwn, Between, Alone, Changes, Fails, Flat])
def test_which_action_is_taken_is_compared(kind):
    tables = dict(FORMS), dict(ORIGINAL)
    try:
        known_form("choosing")(kind)
        parts = road(margin=0.1)
        parts["policy"] = kind(parts["policy"].policy, LEFT_OR_RIGHT, 0.1).bind(parts["dynamics"], parts["barrier"])
        loop = closed_loop(**parts)
        with pytest.raises(StructureError) as error:
            check_deployed(loop, parts["barrier"], parts["dynamics"], parts["policy"])
        assert error.value.reason == "VALUES_DIFFER"
    finally:
        for table, old in zip((FORMS, ORIGINAL), tables, strict=True):
            table.clear()
            table.update(old)


def test_a_table_that_was_permuted_or_changed_is_not_the_graph_s():
    parts = road([[-2.0], [0.1], [2.0]])
    loop = closed_loop(**parts)
    for change in (lambda t: t.flip(0), lambda t: t + torch.tensor([[0.0], [1e-4], [0.0]])):
        parts["policy"].actions = change(parts["policy"].actions)
        with pytest.raises(StructureError, match="values that differ"):
            check_deployed(loop, parts["barrier"], parts["dynamics"], parts["policy"])
        parts["policy"].actions = torch.tensor([[-2.0], [0.1], [2.0]])
    parts["policy"].margin.fill_(0.3)
    with pytest.raises(StructureError, match="its own where B"):
        check_deployed(loop, parts["barrier"], parts["dynamics"], parts["policy"])


# --- other verifiers, agents and files --------------------------------------------------------------------------------


def test_other_verifiers_are_asked_for_a_latent_at_which_nothing_helps(tmp_path):
    pytest.importorskip("onnx")
    run = pytest.importorskip("onnx.reference").ReferenceEvaluator
    loop = system()
    network, prop = export_vnnlib(loop, tmp_path, level=-0.05)
    z = points(20)
    made = torch.stack([torch.from_numpy(run(str(network)).run(None, {"X": row[None].numpy()})[0][0]) for row in z])
    torch.testing.assert_close(made, torch.cat([loop.barrier(z), loop.looped(z)], 1).float(), atol=2e-6, rtol=1e-5)
    found = re.findall(r"\(assert \(([<>]=) (Y_\d) (\S+)\)\)", prop.read_text())
    assert [(op, name) for op, name, _ in found] == [("<=", "Y_0"), (">=", "Y_1"), (">=", "Y_2"), (">=", "Y_3")]
    assert [float(v) for *_, v in found] == pytest.approx([-0.05, -0.1, -0.05, -0.05])
    with pytest.raises(ConfigError, match="accepts"):
        export_vnnlib(loop, tmp_path, level=-0.2)


def choosing_line(margin: float = 0.15, actions: Any = ((-2.0,), (0.0,), (2.0,))) -> Agent:
    """The agent of the line, with a policy that takes over: B(z+) <= -0.2 by either."""
    agent = line_agent()
    policy = ChoosingPolicy(agent.policy, actions, margin)
    inner = {"class": "Policy", "arguments": SIZES}
    networks = agent.description["networks"] | {
        "policy": {"class": "ChoosingPolicy", "arguments": policy.arguments | {"policy": inner}}
    }
    return Agent(agent.encoder, agent.dynamics, agent.barrier, policy, 1.5, agent.description | {"networks": networks})


@pytest.fixture(scope="module")
def issued_choosing(tmp_path_factory) -> Path:
    directory = tmp_path_factory.mktemp("issued_choosing")
    agent = choosing_line()
    agent.tolerated_error = premise(agent)
    assert 0.09 < agent.tolerated_error < 0.1
    agent.save(directory)
    certificate = certify(agent, Line(), name="line", episodes=300, horizon=4, acceptable=0.02)
    assert certificate.layers["deterministic"].holds
    assert certificate.layers["statistical"].holds
    certificate.save(directory / "certificate.json")
    return directory


def test_an_agent_that_chooses_is_certified_and_verified(issued_choosing):
    code, text = verify(issued_choosing, measure=True)
    assert code == 0, text
    assert "not certified: q1" in text or "not certified: q3" in text
    assert Reason.NO_LIPSCHITZ in Certificate.load(issued_choosing / "certificate.json").reasons
    assert Reason.NOT_FINITE not in Certificate.load(issued_choosing / "certificate.json").reasons


def weights(change: Callable[[dict[str, Tensor]], Any]) -> Callable[[Path], None]:
    def apply(directory: Path) -> None:
        state = load_file(directory / "agent.safetensors")
        change(state)
        save_file({k: v.contiguous() for k, v in state.items()}, directory / "agent.safetensors")

    return apply


CHANGED: dict[str, Callable[[Path], None]] = {
    "table permuted": weights(lambda s: s.update({"policy.actions": s["policy.actions"].flip(0)})),
    "table changed": weights(lambda s: s["policy.actions"].mul_(0.99)),
    "margin raised": weights(lambda s: s["policy.margin"].mul_(1.1)),
    "margin lowered": weights(lambda s: s["policy.margin"].mul_(0.5)),
    "barrier swapped": weights(lambda s: s["barrier.2.bias"].sub_(0.01)),
    "policy inside swapped": weights(lambda s: s["policy.policy.net.2.weight"].mul_(-1)),
}


@pytest.mark.parametrize("name", CHANGED)
def test_what_was_changed_after_certification_is_refused(name, issued_choosing, tmp_path):
    directory = copied(issued_choosing, tmp_path)
    CHANGED[name](directory)
    code, text = verify(directory, measure=False)
    assert code == 1, text
    assert Reason.WEIGHTS_CHANGED.name in text
