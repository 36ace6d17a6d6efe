"""Certificates of closed loops that are known by hand, and of honest settings: counted right, and never refused."""

from __future__ import annotations

import json
import sys
from collections.abc import Callable
from dataclasses import replace
from functools import partial
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
import torch
from analytic import SIDE, Line, line_agent
from torch import Tensor, nn

from torchrl_sspl.certification.branch_and_bound import Budget
from torchrl_sspl.certification.certificate import Certificate, Layer, Reason, weights_digest
from torchrl_sspl.certification.record import Counts, Record
from torchrl_sspl.certification.statistics import fingerprint
from torchrl_sspl.envs import DubinsEnv, PendulumEnv
from torchrl_sspl.errors import ConfigError
from torchrl_sspl.evaluation import blocks
from torchrl_sspl.evaluation import certify as certify_module
from torchrl_sspl.evaluation.blocks import described_system
from torchrl_sspl.evaluation.certify import Exit, certify, certify_on_episodes, issue, verify_run
from torchrl_sspl.modules.agent import Agent, load, mlp_barrier
from torchrl_sspl.seeds import spawn
from torchrl_sspl.sets import Box

STEPS = 6
SHORT = Budget(boxes=50)  # where no proof is asked for


PROVED: dict[tuple[Any, ...], Layer] = {}


@pytest.fixture
def proved_once(monkeypatch: pytest.MonkeyPatch) -> None:
    """What is asked twice about the same weights is proved once: here one looks at what is measured."""
    prove = certify_module._proof

    def once(agent: Agent, *asked: Any) -> Layer:
        key = weights_digest(agent.state_dict()), *asked
        if key not in PROVED:
            PROVED[key] = prove(agent, *asked)
        return PROVED[key]

    monkeypatch.setattr(certify_module, "_proof", once)


def total(certificate: Certificate) -> Counts:
    assert certificate.record is not None
    return certificate.record.total


# --- the closed loop by hand ------------------------------------------------------------------------------------------------


def by_hand(start: list[float], law: Callable[[float], float], shown: Callable[[float], float], gain: float) -> Counts:
    """Counts of episodes from given starts, one step after the other, in plain numbers."""
    found = dict.fromkeys(("left", "entered", "aliased", "events", "exceeding", "uncovered"), 0)
    for x in start:
        left = entered = aliased = exceeding = False
        for t in range(STEPS + 1):
            z = shown(x)
            left |= abs(z) - 0.5 > 0
            entered |= abs(x) > 0.8
            aliased |= abs(x) > 0.8 and abs(z) - 0.5 <= 0
            if t == STEPS:
                break
            push = min(max(-2 * z, -1), 1)
            predicted = min(max(1.8 * z + 0.6 * push, -1), 1)
            x = law(min(max(gain * x + 0.6 * push, -1), 1))
            missed = abs(shown(x) - predicted) > 0.1326905 or abs(shown(x)) - 0.5 > 0
            exceeding |= missed
            found["uncovered"] += int(missed)
        for name, value in (("left", left), ("entered", entered), ("aliased", aliased), ("exceeding", exceeding)):
            found[name] += int(value)
        found["events"] += int(left or entered or aliased)
    return Counts(len(start), STEPS * len(start), undefined=0, shown=0, mistaken=0, seen=0, outside=0, **found)


def same(x: float) -> float:
    return x


def jump(low: float, to: float) -> Callable[[float], float]:
    return lambda x: to if abs(x) > low else x


def tensor_law(law: Callable[[float], float]) -> Callable[[Tensor], Tensor]:
    return lambda x: torch.tensor([[law(float(v))] for v in x[:, 0]], dtype=torch.float32).reshape(-1, 1)


LOOPS: dict[str, tuple[Callable[[float], float], Callable[[float], float], float, tuple[str, ...]]] = {
    "kept": (same, same, 1.8, ()),
    "leaves the set": (jump(0.2, 0.6), same, 1.8, ("left", "exceeding")),
    "leaves the set and comes back": (lambda x: 0.6 if 0.2 < abs(x) < 0.4 else 0.0 if abs(x) > 0.45 else x, same, 1.8, ("left", "exceeding")),
    "enters U and stays": (jump(0.2, 0.95), same, 1.8, ("left", "entered", "exceeding")),
    "enters U, which looks safe": (jump(0.2, 0.95), jump(0.8, 0.1), 1.8, ("entered", "aliased", "exceeding")),
    "starts in U that look safe": (same, jump(0.8, 0.1), 1.8, ("entered", "aliased")),
    "errors that the set survives": (same, same, 1.4, ("exceeding",)),
    "errors that lead out": (lambda x: 1.35 * x, same, 2.4, ("left", "entered", "exceeding")),
}


@pytest.mark.usefixtures("proved_once")
@pytest.mark.parametrize("name", LOOPS)
def test_events_are_those_of_every_single_step(name, monkeypatch):
    law, shown, gain, expected = LOOPS[name]
    starts: list[Tensor] = []
    simulate = blocks.simulate

    def seen(controller: Any, env: Any, *, start: Tensor, **options: Any) -> Any:
        starts.append(start)
        return simulate(controller, env, start=start, **options)

    monkeypatch.setattr(blocks, "simulate", seen)
    env = Line(tensor_law(law), tensor_law(shown), gain=gain)
    certificate = certify(line_agent(), env, episodes=300, horizon=STEPS)
    found, hand = total(certificate), by_hand(torch.cat(starts)[:, 0].tolist(), law, shown, gain)
    for field in ("episodes", "steps", "left", "entered", "aliased", "events", "exceeding", "uncovered"):
        # The picture has 16 bits: who starts within one of them of a border may fall on either side.
        most = STEPS if field == "uncovered" else 1
        assert abs(getattr(found, field) - getattr(hand, field)) <= most, (field, found, hand)
    assert certificate.layers["run-time"].holds == ("exceeding" not in expected)
    assert {k for k in ("left", "entered", "aliased", "exceeding") if getattr(found, k)} == set(expected)
    assert (found.mistaken > 0) == (shown is not same)
    if "left" in expected or "entered" in expected:
        layer = certificate.layers["statistical"]
        assert not layer.holds
        assert layer["episodes"].reason == ("UNSAFE_ENTERED" if "entered" in expected else "EPISODES_LEAVE")


@pytest.mark.usefixtures("proved_once")
def test_a_system_in_which_every_episode_enters_u_and_stays_is_refused():
    # Nobody leaves {B <= 0} by what the pictures show.
    env = Line(law=lambda x: torch.full_like(x, 0.9), shown=lambda x: torch.where(x.abs() > 0.8, 0.1, x))
    certificate = certify(line_agent(), env, episodes=400, horizon=3)
    found = total(certificate)
    assert (found.left, found.entered, found.aliased, found.events) == (0, 400, 400, 400)
    assert certificate.layers["statistical"]["episodes"].value == 1.0
    assert Reason.UNSAFE_ENTERED in certificate.layers["statistical"].reasons


@pytest.mark.usefixtures("proved_once")
def test_half_of_the_observations_of_u_are_where_it_is_entered():
    # x+ = clamp(x + 0.6 v): 4 in 9 of those that enter U come to its very end, of a uniform sample 1 in 200.
    # Only there it looks safe.
    agent, env = line_agent(), Line(gain=1.0, shown=lambda x: torch.where(x.abs() > 0.999, 0.1, x))
    found = total(certify(agent, env, episodes=500, horizon=1))
    assert found.shown == 500
    assert 80 < found.mistaken < 150  # 111 of the 250 that enter it, and about one of the others


class Blind(nn.Module):
    """Gives no number for some pictures."""

    def __init__(self, reader: nn.Module, above: float) -> None:
        super().__init__()
        self.reader, self.above = reader, above

    def forward(self, pixels: Tensor) -> Tensor:
        z = self.reader(pixels)
        return torch.where(z[..., :1] > self.above, torch.nan, z)


@pytest.mark.usefixtures("proved_once")
@pytest.mark.parametrize(("known", "horizon"), [(True, 3), (True, 1), (False, 3)])  # after one step no policy is asked
def test_no_number_is_an_event_and_no_way_to_stay_inside(known, horizon):
    agent = line_agent()
    blind = Agent(Blind(agent.encoder, 0.55), agent.dynamics, agent.barrier, agent.policy, 1.5, agent.description)
    law = partial(torch.where, torch.tensor(True), torch.tensor(0.7))  # every step leads to 0.7
    if known:
        certificate = certify(blind, Line(law=lambda x: law(x) + 0 * x), episodes=50, horizon=horizon)
    else:
        make = partial(Line, lambda x: law(x) + 0 * x, initial=0.4)
        certificate = certify_on_episodes(blind, make, episodes=50, horizon=horizon, envs=10)
    found = total(certificate)
    assert found.undefined == found.events == found.episodes >= 50
    layer = certificate.layers["statistical"]
    assert layer["finite"].reason == "NOT_FINITE"
    assert layer["episodes"].value == 1.0
    assert Certificate.from_dict(json.loads(json.dumps(certificate.to_dict(), allow_nan=False))) == certificate


# --- an environment's own resets --------------------------------------------------------------------------------------------


class Stuck(Line):
    """Every reset begins at the same place."""

    def sample_states(self, n: int, *args: Any, **options: Any) -> Tensor:
        return torch.full((n, 1), 0.25)


@pytest.mark.usefixtures("proved_once")
def test_copies_of_one_episode_are_not_independent():
    certificate = certify_on_episodes(line_agent(), Stuck, episodes=100, horizon=3, envs=10)
    record, layer = certificate.record, certificate.layers["statistical"]
    assert record is not None
    assert record.sizes["repeated"] == record.total.episodes - 1 >= 99
    assert layer["different"].reason == "CALIBRATION_REUSED"
    assert layer["episodes"].n == 1


class StuckOften(Line):
    """One reset in four begins at the same place, and some lie in U."""

    def sample_states(self, n: int, generator: Any = None, **options: Any) -> Tensor:
        state = super().sample_states(n, generator, **options)
        return torch.where(torch.arange(n)[:, None] % 4 == 0, 0.25, state)


@pytest.mark.usefixtures("proved_once")
def test_a_quarter_of_copies_is_refused():
    certificate = certify_on_episodes(line_agent(), StuckOften, episodes=80, horizon=3, envs=8)
    assert Reason.CALIBRATION_REUSED in certificate.layers["statistical"].reasons


@pytest.mark.usefixtures("proved_once")
def test_states_on_a_line_do_not_collide_falsely():
    for seed in (0, 1):
        certificate = certify(line_agent(), Line(), episodes=1000, horizon=1, seed=seed)
        assert Reason.CALIBRATION_REUSED not in certificate.reasons
        record = certificate.record
        assert record is not None
        assert certificate.layers["statistical"]["episodes"].n == 1000 - record.sizes["repeated"]


@pytest.mark.usefixtures("proved_once")
def test_episodes_end_where_the_environment_ends_them():
    make = partial(Line, initial=0.9, horizon=2)
    record = certify_on_episodes(line_agent(), make, episodes=40, horizon=9, envs=8).record
    assert record is not None
    assert [record.sizes[k] for k in ("shortest", "median", "longest")] == [2, 2, 2]
    assert record.total.steps == 2 * record.total.episodes
    assert record.total.episodes < 0.75 * len(record.blocks) * record.block  # five in nine begin in the set


@pytest.mark.usefixtures("proved_once")
def test_blocks_of_resets_are_different_episodes():
    record = certify_on_episodes(line_agent(), partial(Line, initial=0.4), episodes=250, horizon=1, envs=50).record
    assert record is not None
    assert len(record.blocks) >= 3
    assert record.total.episodes == 100 * len(record.blocks)
    assert record.sizes["repeated"] <= 4


@pytest.mark.usefixtures("proved_once")
def test_resets_show_what_the_camera_hides():
    make = partial(Line, shown=lambda x: torch.where(x.abs() > 0.8, 0.1, x))
    certificate = certify_on_episodes(line_agent(), make, episodes=60, horizon=2, envs=20)
    found = total(certificate)
    assert found.shown == found.mistaken > 20
    assert found.entered == found.aliased > 0  # they begin in U and look safe
    assert certificate.layers["statistical"]["unsafe observations"].reason == "UNSAFE_INSIDE"


# --- what was used before ---------------------------------------------------------------------------------------------------


def test_seeds_of_the_training_are_found(monkeypatch):
    root = line_agent().description["config"]["seed"]
    block = spawn(root, "certificate", 0)
    for options in ({"seeds": [root, block]}, {"seeds": [root, block + 2**32]}):
        certificate = certify(line_agent(**options), Line(), episodes=20, horizon=1, budget=SHORT)
        assert Reason.CALIBRATION_REUSED in certificate.reasons
    certificate = certify(line_agent(), Line(), episodes=20, horizon=1, used_seeds=[block], budget=SHORT)
    assert Reason.CALIBRATION_REUSED in certificate.reasons
    assert Reason.CALIBRATION_REUSED not in certify(line_agent(), Line(), episodes=20, horizon=1, budget=SHORT).reasons
    # A seed by which a round was chosen, given as one of the certificate's by a root that was looked for.
    monkeypatch.setattr(Record, "seeds", lambda record: [spawn(root, "checks", 1)])
    assert Reason.CALIBRATION_REUSED in certify(line_agent(), Line(), episodes=20, horizon=1, budget=SHORT).reasons
    monkeypatch.undo()
    # The seed of the run itself is no seed of its certificate.
    assert Reason.CALIBRATION_REUSED not in certify(line_agent(), Line(), episodes=20, horizon=1, seed=root, budget=SHORT).reasons


def test_an_agent_that_does_not_say_its_seeds_is_told_so():
    agent = line_agent()
    del agent.description["seeds"]
    fresh = certify(agent, Line(), episodes=20, horizon=1, budget=SHORT).layers["statistical"]["fresh"]
    assert fresh.kind == "assumed"
    assert "does not say" in fresh.text


def test_seeds_that_only_the_certificate_names_measure_nothing(tmp_path):
    agent = line_agent()
    del agent.description["seeds"]
    agent.save(tmp_path)
    certificate = certify(agent, Line(), name="line", episodes=20, horizon=1, used_seeds=[5], budget=SHORT)
    certificate.save(tmp_path / "certificate.json")
    assert certificate.record is not None
    assert certificate.record.used == [5]
    assert certificate.layers["statistical"]["fresh"].kind == "assumed"
    assert verify_run(tmp_path, env=Line(), report=lambda line: None) == Exit.HOLDS
    clash = certify(agent, Line(), episodes=20, horizon=1, used_seeds=[spawn(3, "certificate", 0)], budget=SHORT)
    assert Reason.CALIBRATION_REUSED in clash.reasons


def test_labelled_states_of_the_training_are_found(monkeypatch):
    seen: list[str] = []
    block = blocks.Block

    def kept(*values: Any) -> Any:
        made = block(*values)
        seen.extend(made.labelled)
        return made

    monkeypatch.setattr(blocks, "Block", kept)
    certify(line_agent(), Line(), episodes=200, horizon=1, budget=SHORT)
    foreign = fingerprint(torch.rand(500, 1) + 5)
    leaked = certify(line_agent(trained_on=seen[:100] + foreign), Line(), episodes=200, horizon=1, budget=SHORT)
    assert Reason.LABELS_LEAKED in leaked.reasons
    some = certify(line_agent(trained_on=seen[:5] + foreign), Line(), episodes=200, horizon=1, budget=SHORT).layers["statistical"]
    assert Reason.LABELS_LEAKED not in some.reasons
    assert some["unsafe observations"].n == 195


# --- honest certificates are never refused ----------------------------------------------------------------------------------

POOL: dict[str, dict[str, Any]] = {
    "as it is": {},
    "one episode": {"episodes": 1, "horizon": 1},
    "episodes of a block and one": {"episodes": 251, "horizon": 1},
    "long episodes": {"episodes": 20, "horizon": 40},
    "another seed": {"seed": 99},
    "a large seed": {"seed": 2**40},
    "another level": {"level": -0.1},
    "a level that is not kept": {"level": -0.499},
    "an empty set": {"level": -0.6},
    "another confidence": {"confidence": 0.5},
    "another acceptable risk": {"acceptable": 0.4},
    "another name": {"name": "run_7 (of 8), [x] <b>"},
    "more seeds": {"used_seeds": [5, 6, -7]},
    "no time": {"budget": Budget(seconds=0.0)},
    "no boxes": {"budget": Budget(boxes=0)},
    "a few boxes": {"budget": SHORT},
    "some boxes": {"budget": Budget(boxes=600)},
    "nothing measured": {"env": None},
    "a system that leaves": {"env": Line(law=lambda x: torch.where(x > 0.2, 0.6, x)), "acceptable": 0.9},
    "a system that enters U": {"env": Line(law=lambda x: torch.where(x > 0.2, 0.9, x))},
    "a camera that lies": {"env": Line(shown=lambda x: torch.where(x > 0.8, 0.2, x))},
}


FAST = (
    "as it is", "one episode", "another level", "a level that is not kept", "an empty set", "more seeds", "no time", "nothing measured",
    "a system that enters U", "a camera that lies",
)  # fmt: skip
WITH_PROOF = ("as it is", "another level", "a level that is not kept", "an empty set", "nothing measured")


@pytest.mark.parametrize("name", [name if name in FAST else pytest.param(name, marks=pytest.mark.slow) for name in POOL])
def test_an_honest_certificate_is_found_again(name, tmp_path):
    # Where the proof is another one it takes its time; where only what is measured changes it ends early.
    few = {} if name in WITH_PROOF else {"budget": SHORT}
    options = {"env": Line(), "episodes": 60, "horizon": 3, "name": "line"} | few | POOL[name]
    env = options.pop("env")
    agent = line_agent()
    directory = tmp_path / "another folder" / "pendulum"
    agent.save(directory)
    certify(agent, env, **options).save(directory / "certificate.json")
    lines: list[str] = []
    assert verify_run(directory, env=env, report=lines.append) == Exit.HOLDS, "\n".join(lines)


@pytest.mark.parametrize(
    "options",
    [
        {},
        pytest.param({"initial": 0.3}, marks=pytest.mark.slow),
        {"initial": 0.9, "horizon": 2},
        {"law": lambda x: torch.where(x > 0.2, 0.9, x)},
        pytest.param({"seed": 5}, marks=pytest.mark.slow),
        {"envs": 7},
        pytest.param({"confidence": 0.8, "acceptable": 0.3}, marks=pytest.mark.slow),
        pytest.param({"budget": Budget(seconds=0.0)}, marks=pytest.mark.slow),
    ],
)
def test_an_honest_certificate_of_resets_is_found_again(options, tmp_path):
    of_env = {k: options[k] for k in ("initial", "horizon", "law") if k in options}
    settings = {"episodes": 40, "horizon": 4, "envs": 8, "budget": SHORT} | {k: v for k, v in options.items() if k not in of_env}
    agent, make = line_agent(), partial(Line, **({"initial": 0.7} | of_env))
    agent.save(tmp_path)
    certify_on_episodes(agent, make, name="line", **settings).save(tmp_path / "certificate.json")
    lines: list[str] = []
    assert verify_run(tmp_path, env=make, report=lines.append) == Exit.HOLDS, "\n".join(lines)


def test_an_agent_that_tolerates_errors_is_certified_at_the_level_that_it_keeps(tmp_path):
    agent = line_agent()
    certificate = certify(agent, None, name="line", level=-0.1, budget=SHORT)
    agent.description["tolerated_error"] = 0.01
    agent.save(tmp_path)
    certificate.save(tmp_path / "certificate.json")
    lines: list[str] = []
    assert verify_run(tmp_path, report=lines.append) == Exit.REFUSED
    assert "LEVEL" in lines[0]
    with pytest.raises(ConfigError, match="expected 0 of an agent that tolerates errors"):
        certify(agent, None, level=-0.1)
    assert certify(agent, None, budget=SHORT).level == 0.0


@pytest.mark.slow
def test_measuring_all_again_fails_where_nothing_can_be_measured(tmp_path):
    agent = line_agent()
    agent.save(tmp_path)
    certify(agent, Line(), name="line", episodes=20, horizon=2, acceptable=0.4, confidence=0.8, budget=SHORT).save(tmp_path / "certificate.json")
    lines: list[str] = []
    assert verify_run(tmp_path, report=lines.append) == Exit.HOLDS
    assert any("at most 40 %: the two of the statistical layer together, and that of the run-time layer by itself, with 80 % confidence" in line for line in lines)
    assert verify_run(tmp_path, measure=True, report=lines.append) == Exit.UNMEASURED
    assert "NOT_MEASURED: its system was given in code" in lines[-1]
    assert verify_run(tmp_path, env=Line(), measure=True, report=lines.append) == Exit.HOLDS


def test_a_picture_of_u_that_looks_safe_counts_though_the_memory_knows_better():
    class Lying(PendulumEnv):
        def draw(self, state: Tensor) -> Tensor:
            return super().draw(torch.where(state.abs()[:, :1] > 1.9, 0.0, state))

    agent = load("pendulum")
    source = blocks.ResetBlocks(agent, Lying, Record("resets", "given", 1, 40, 12, 20, 0.95, 0.01, []), 0.0, agent.tolerated_error)
    counts = source(0).counts
    assert counts.shown > 20
    assert counts.mistaken > 0.52 * counts.shown  # 41 of 70; the memory is deceived in 32


def test_a_slow_machine_that_verifies_says_that_the_time_was_short(tmp_path, monkeypatch):
    agent = line_agent()
    agent.save(tmp_path)
    certify(agent, None, name="line").save(tmp_path / "certificate.json")
    proof = certify_module._proof
    monkeypatch.setattr(certify_module, "_proof", lambda agent, level, budget: proof(agent, level, replace(budget, boxes=20)))
    lines: list[str] = []
    assert verify_run(tmp_path, report=lines.append) == Exit.TIME
    assert any("UNDECIDED" in line for line in lines)


def test_part_of_the_blocks_is_said_to_be_a_part(tmp_path, monkeypatch):
    agent = line_agent()
    agent.save(tmp_path)
    certify(agent, Line(), name="line", episodes=600, horizon=1).save(tmp_path / "certificate.json")
    ticks = iter(range(0, 10_000, 18))
    monkeypatch.setattr(certify_module, "time", SimpleNamespace(monotonic=lambda: float(next(ticks))))
    lines: list[str] = []
    assert verify_run(tmp_path, env=Line(), report=lines.append) == Exit.HOLDS
    text = "\n".join(lines)
    assert "1 of 3 blocks" in text
    assert "    measured" not in text[text.index("statistical") :]


@pytest.mark.slow
def test_a_certificate_is_issued_again_with_its_own_settings(tmp_path):
    agent = line_agent()
    agent.save(tmp_path / "agent")
    settings = {"episodes": 30, "horizon": 2, "seed": 4, "acceptable": 0.3, "level": -0.01, "used_seeds": [4, 7]}
    certify(agent, Line(), name="line", **settings).save(tmp_path / "agent" / "certificate.json")
    before = (tmp_path / "agent" / "certificate.json").read_text()
    issue(tmp_path, Line())
    assert (tmp_path / "agent" / "certificate.json").read_text() == before
    again = issue(tmp_path, Line(), seed=5)
    assert (again.record.seed, again.level) == (5, -0.01)
    assert {4, 7} <= set(again.record.used)  # what was used once is fresh never again
    (tmp_path / "agent" / "certificate.json").unlink()
    assert issue(tmp_path).agent == tmp_path.name.replace("[", "_").replace("]", "_")


def test_a_spike_in_u_makes_no_start_close():
    # The barrier rises to 10,000 behind .9: what rounding may move near the level is no larger.
    agent, signs = line_agent(), torch.tensor([[1.0, 0.0], [-1.0, 0.0]])
    barrier = mlp_barrier(2, [6])
    barrier[0].weight.data[:4], barrier[0].weight.data[4:] = agent.barrier[0].weight, signs
    barrier[0].bias.data[:4], barrier[0].bias.data[4:] = 0.0, -0.9
    barrier[2].weight.data[0], barrier[2].bias.data[0] = torch.tensor([1.0, 1.0, 1.0, 1.0, 1e5, 1e5]), -0.5
    spiked = Agent(agent.encoder, agent.dynamics, barrier, agent.policy, 2e5, agent.description)
    record = Record("resets", "given", 3, 100, 2, 20, used=[])
    block = blocks.ResetBlocks(spiked, Line, record, 0.0)(0)
    assert block.close == 0
    assert float(block.unsafe.max()) > 5000.0
    more = replace(block.counts, episodes=block.counts.episodes + 1, steps=block.counts.steps + 2)
    assert "episodes" in blocks.block_changes(more, block, resets=True)


def test_where_many_starts_are_close_few_may_be_rounded_away():
    make = partial(Line, shown=lambda x: torch.where(x > 0.0, 0.5, 0.0))  # B = -7.6e-6 for half of them
    record = Record("resets", "given", 3, 40, 2, 20, used=[])
    assert blocks.ResetBlocks(line_agent(), make, record, -7e-6)(0).close == 2


def test_networks_in_float64_are_the_same_agent_from_disk(tmp_path):
    line = line_agent()
    gain = torch.tensor([[0.9, 0.0], [0.0, 1.0]], dtype=torch.float64)
    nets = (net.double() for net in (line.encoder, line.dynamics, line.barrier, line.policy))
    agent = Agent(*nets, 1.5, line.description, gain)
    assert torch.equal(agent.gain, gain)
    agent.save(tmp_path)
    certify(agent, None, name="line", level=0.0, budget=SHORT).save(tmp_path / "certificate.json")
    lines: list[str] = []
    assert verify_run(tmp_path, report=lines.append) == Exit.HOLDS, lines


# --- which system -----------------------------------------------------------------------------------------------------------


def test_the_system_of_a_description_is_one_of_the_library():
    named = described_system({"config": {"env": {"_target_": "torchrl_sspl.envs.PendulumEnv", "max_torque": 5.0}}})
    assert named is not None
    assert named([1], 0).max_action == 5.0
    for target in ("os.mkdir", "torchrl_sspl.envs.gymnasium.GymnasiumPixels", "torchrl_sspl.envs:Sequence", "torchrl_sspl.cli:main", 5, None):
        assert described_system({"config": {"env": {"_target_": target}}}) is None
    for broken in ({}, {"config": 7}, {"config": {"env": []}}, {"environment": 3}, {"environment": "../x"}, {"environment": "NoEnv"},
                   {"config": {"env": {"_target_": "torchrl_sspl.envs.PendulumEnv", "colour": 1}}}):  # fmt: skip
        assert described_system(broken) is None


def test_code_that_a_description_names_is_imported_only_if_it_is_trusted(tmp_path, monkeypatch):
    monkeypatch.syspath_prepend(tmp_path)
    (tmp_path / "somebodys_code.py").write_text("from torchrl_sspl.envs import PendulumEnv")
    description = {"config": {"env": {"_target_": "somebodys_code:PendulumEnv"}}}
    assert described_system(description) is None
    assert "somebodys_code" not in sys.modules
    assert described_system(description, trust=True) is not None
    sys.modules.pop("somebodys_code", None)


@pytest.mark.parametrize(
    ("env", "same_one"),
    [
        (PendulumEnv(batch_size=[1]), True),
        (PendulumEnv(batch_size=[3]), True),
        (PendulumEnv(batch_size=[1], max_torque=5.0), False),
        (PendulumEnv(batch_size=[1], image_size=32), False),
        (PendulumEnv(batch_size=[1], integrator="explicit"), False),
        (DubinsEnv(batch_size=[1]), False),
    ],
)
def test_a_system_is_compared_with_its_description(env, same_one):
    assert blocks.same_system(env, PendulumEnv) == same_one


def test_no_system_is_the_one_of_a_description_that_cannot_be_built():
    unbuildable = described_system({"config": {"env": {"_target_": "torchrl_sspl.envs.PendulumEnv", "max_torque": -1.0}}})
    assert unbuildable is not None
    with pytest.raises(ConfigError):
        unbuildable(batch_size=[1], seed=0)
    assert not blocks.same_system(PendulumEnv(batch_size=[1]), unbuildable)


def test_resets_are_compared_with_their_description():
    assert blocks.same_resets(partial(Line, initial=0.5), partial(Line, initial=0.5))
    assert not blocks.same_resets(partial(Line, initial=0.5), Line)
    assert not blocks.same_resets(Line, lambda batch_size, seed: object())
    assert not blocks.same_resets(partial(PendulumEnv, max_torque=5.0), PendulumEnv)
    assert not blocks.same_resets(partial(PendulumEnv, horizon=3), PendulumEnv)
    assert blocks.same_resets(partial(PendulumEnv, horizon=4), partial(PendulumEnv, horizon=9), 3)
    ends = partial(Line, lambda x: 0.99 * x.sign().where(x.abs() >= 1.0, x / 0.99), initial=0.1)  # no first step comes so far
    assert not blocks.same_resets(ends, partial(Line, initial=0.1))


def test_the_line_is_what_it_says():
    env = Line()
    assert env.observation_spec["pixels"].shape[-1] == SIDE
    assert isinstance(env.state_space, Box)
    assert Path(__file__).exists()


@pytest.mark.usefixtures("proved_once")
def test_latents_outside_the_domain_are_counted_before_the_memory_cuts_them():
    agent = line_agent()
    with torch.no_grad():
        agent.encoder.scale.mul_(4.0)
    for make in (Line(), partial(Line, initial=0.9)):
        settings: Any = {"episodes": 20, "horizon": 2, "budget": SHORT}
        certificate = certify(agent, make, **settings) if isinstance(make, Line) else certify_on_episodes(agent, make, envs=20, **settings)
        assert total(certificate).outside > 0
        assert certificate.layers["statistical"]["encoder"].reason == "OUTSIDE_DOMAIN"
