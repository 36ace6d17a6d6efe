"""Results that take long outlive an interruption, and are taken by nothing else."""

from __future__ import annotations

from contextlib import contextmanager, suppress

import pytest
import torch
from plain import small_agent

import torchrl_sspl.journal as module
from torchrl_sspl.certification import closed_loop
from torchrl_sspl.certification.branch_and_bound import Budget, maximise
from torchrl_sspl.envs import PendulumEnv
from torchrl_sspl.evaluation.controllers import AgentController, RandomController
from torchrl_sspl.evaluation.known import encode_states
from torchrl_sspl.evaluation.simulation import simulate
from torchrl_sspl.interrupts import Interrupted
from torchrl_sspl.journal import FOLDER, Entry, journal, kept_parts
from torchrl_sspl.lipschitz import SandwichBarrier
from torchrl_sspl.modules import LatentDynamics, Policy
from torchrl_sspl.modules.agent import load
from torchrl_sspl.viability import grid, viability_kernel


class Killed(BaseException):
    """What ends a process in the middle."""


@pytest.fixture(autouse=True)
def everything_is_worth_a_file(monkeypatch):
    monkeypatch.setattr(module, "_SHORT", 0.0)
    monkeypatch.setattr(module, "_EVERY", 0.0)


@contextmanager
def journal_of_a_killed_run(path, *about):
    """A journal whose process is killed inside, at the end of the block at the latest."""
    with suppress(Killed), journal(path, *about):
        yield
        raise Killed


def problem(seed: int = 0):
    torch.manual_seed(seed)
    nets = SandwichBarrier(2, (16, 16), 2.0), LatentDynamics(2, 1, (16,)), Policy(2, 1, (8,))
    return closed_loop(*nets, latent_dim=2, lipschitz_bound=2.0).problem(level=0.1, constant=(0.0,))


def killed_after(calls: int, monkeypatch, target, name):
    """Lets a function fail at a call."""
    whole, count = getattr(target, name), [0]

    def counted(*args, **options):
        count[0] += 1
        if count[0] > calls:
            raise Killed
        return whole(*args, **options)

    monkeypatch.setattr(target, name, counted)
    return count


def test_without_a_journal_nothing_is_kept(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    entry = Entry("a")
    entry.save(torch.ones(1), complete=True)
    with journal(None, "name"):
        Entry("a").save(torch.ones(1), complete=True)
    assert entry.saved() is None
    assert not entry.due
    assert not list(tmp_path.iterdir())


def test_entries_are_found_again_in_their_order_and_for_the_same_thing_alone(tmp_path):
    def run(name="part", about=1, things=("a", "b")):
        found = []
        with journal_of_a_killed_run(tmp_path, name, about):
            for thing in things:
                entry = Entry(thing)
                found.append(entry.saved())
                entry.save({"thing": thing, "of": about}, complete=True)
        return found

    assert run() == [None, None]
    assert run() == [{"thing": "a", "of": 1}, {"thing": "b", "of": 1}]
    assert run(things=("b", "a")) == [None, None]  # another order
    assert run(name="other") == [None, None]
    assert run(about=2) == [None, None]  # other weights: those of the first are gone
    assert run() == [None, None]


def test_it_is_gone_when_the_outermost_ends_and_not_before(tmp_path):
    with journal(tmp_path, "run"):
        with journal(None, "part"):  # a part of it
            Entry("a").save(1, complete=True)
        assert len(list(tmp_path.glob(f"{FOLDER}/run-*/part-*/*.pt"))) == 1
    assert not (tmp_path / FOLDER).exists()


def test_what_the_journal_around_depends_on_counts_inside(tmp_path):
    """A certificate of episodes of 200 steps takes no block that an earlier configuration has left behind."""

    def run(about):
        with journal_of_a_killed_run(tmp_path, "evaluation", about), journal(None, "part"):
            entry = Entry("a")
            found = entry.saved()
            entry.save(about, complete=True)
        return found

    assert [run(50), run(50), run(200), run(50)] == [None, 50, None, None]


def test_what_took_no_time_has_no_file(tmp_path, monkeypatch):
    monkeypatch.setattr(module, "_SHORT", 60.0)
    with journal(tmp_path, "run"):
        Entry("a").save(1, complete=True)
        Entry("b").save(1)  # but what is not complete was asked for
        assert [p.name[:5] for p in tmp_path.rglob("*.pt")] == ["00002"]


def test_a_file_that_cannot_be_read_is_computed_again(tmp_path):
    with journal_of_a_killed_run(tmp_path, "run"):
        Entry("a").save(torch.ones(100), complete=True)
    (path,) = tmp_path.rglob("*.pt")
    path.write_bytes(path.read_bytes()[:200])
    with journal(tmp_path, "run"):
        assert Entry("a").saved() is None


@pytest.mark.parametrize("threshold", [None, 0.2])
def test_a_proof_goes_on_where_it_was(tmp_path, monkeypatch, threshold):
    from torchrl_sspl.certification import branch_and_bound

    monkeypatch.setattr(branch_and_bound, "_BATCH", 16)
    whole = maximise(problem(), threshold=threshold, budget=Budget(seconds=1e9))
    with monkeypatch.context() as patch, journal_of_a_killed_run(tmp_path, "run"):
        killed_after(20, patch, branch_and_bound, "_bound")
        maximise(problem(), threshold=threshold, budget=Budget(seconds=1e9))
    with monkeypatch.context() as patch, journal(tmp_path, "run"):
        count = killed_after(10**9, patch, branch_and_bound, "_bound")
        again = maximise(problem(), threshold=threshold, budget=Budget(seconds=1e9))
        left = count[0]
        repeated = maximise(problem(), threshold=threshold, budget=Budget(seconds=1e9))  # the next of the journal: a new one
        assert count[0] - left == left + 20
    plain = [{k: v for k, v in vars(o).items() if k not in ("seconds", "witness")} for o in (whole, again, repeated)]
    assert plain[0] == plain[1] == plain[2]
    assert whole.boxes > 16 * 20


def test_a_finished_proof_is_not_made_again_and_one_of_another_level_is(tmp_path, monkeypatch):
    from torchrl_sspl.certification import branch_and_bound

    def run(level):
        of = problem()
        of.level = level
        with monkeypatch.context() as patch:
            count = killed_after(10**9, patch, branch_and_bound, "_bound")
            with journal_of_a_killed_run(tmp_path, "run"):
                outcome = maximise(of)
        return outcome.upper, count[0]

    first, again, other = run(0.1), run(0.1), run(0.0)
    assert first[1] > 0
    assert again == (first[0], 0)
    assert other[1] > 0


def test_the_time_of_a_search_counts_over_its_interruptions(tmp_path):
    with journal_of_a_killed_run(tmp_path, "run"):
        maximise(problem(), budget=Budget(boxes=3000))
    (path,) = tmp_path.rglob("*.pt")
    torch.save(_search(problem(), seconds=100.0), path)
    with journal(tmp_path, "run"):
        assert maximise(problem(), budget=Budget(boxes=3000)).seconds > 100.0


def _search(of, seconds):
    from torchrl_sspl.certification.branch_and_bound import _Search

    return _Search(of, None, 1e-3, None, True).state_dict() | {"seconds": seconds}


def test_what_draws_its_actions_is_not_kept(tmp_path):
    """What it draws next depends on what it has drawn."""
    env = PendulumEnv()
    drawn = AgentController(load("pendulum"), driver=RandomController.within(env, 0))
    with journal(tmp_path, "run"):
        simulate(drawn, env, start=torch.zeros(2, 2), horizon=2)
        assert not list(tmp_path.rglob("*.pt"))


def test_a_signal_ends_a_proof_when_it_is_saved(tmp_path, monkeypatch):
    """A training that saves its state does not wait for the end of a proof that takes minutes."""
    monkeypatch.setattr(module, "_EVERY", 1e9)
    monkeypatch.setattr(module, "pending", lambda: True)

    def end():
        raise Interrupted(15)

    monkeypatch.setattr(module, "end_if_pending", end)
    with pytest.raises(Interrupted), journal(tmp_path, "run"):
        maximise(problem())
    (path,) = tmp_path.rglob("*.pt")
    assert "boxes" in torch.load(path)
    assert "status" not in torch.load(path)


def test_a_viability_kernel_goes_on_with_its_sweeps(tmp_path, monkeypatch):
    def kernel():
        return viability_kernel(
            lambda x, u: 1.2 * x + u, low=[-1.0], high=[1.0], resolution=101, margin=lambda x: 1.0 - x[:, 0].abs(),
            actions=torch.linspace(-0.1, 0.1, 5)[:, None],
        )  # fmt: skip

    expected, sweep = kernel(), (grid._Problem, "best_successor")
    assert expected.iterations > 6
    with monkeypatch.context() as patch, journal_of_a_killed_run(tmp_path, "run"):
        killed_after(4, patch, *sweep)
        kernel()
    with monkeypatch.context() as patch, journal_of_a_killed_run(tmp_path, "run"):
        count = killed_after(10**9, patch, *sweep)
        found = kernel()
    assert count[0] == expected.iterations - 4
    with monkeypatch.context() as patch, journal(tmp_path, "run"):
        killed_after(0, patch, *sweep)
        again = kernel()
    for one in (found, again):
        assert torch.equal(one.value, expected.value)
        assert (one.iterations, one.change) == (expected.iterations, expected.change)


def test_episodes_and_latents_are_not_made_again(tmp_path, monkeypatch):
    from torchrl_sspl.evaluation import known, simulation

    agent, env = load("pendulum"), PendulumEnv()
    monkeypatch.setattr(known, "CHUNK", 16)
    monkeypatch.setattr(simulation, "_PART", 16)
    states = env.sample_states(50, torch.Generator().manual_seed(0))
    with monkeypatch.context() as patch:
        count = killed_after(10**9, patch, PendulumEnv, "draw")
        expected = encode_states(agent, env, states), simulate(agent, env, start=states, horizon=3)
    found, attempts = None, 0
    while found is None:
        attempts += 1
        with monkeypatch.context() as patch, suppress(Killed), journal(tmp_path, "run"):
            killed_after(6, patch, PendulumEnv, "draw")
            found = encode_states(agent, env, states), simulate(agent, env, start=states, horizon=3)
    assert 3 <= count[0] / 6 <= attempts < count[0] / 2
    assert expected[0].shape == (50, agent.latent_dim)
    assert torch.equal(expected[0], found[0])
    for name in ("states", "barrier", "latent", "actions", "alive"):
        assert torch.equal(getattr(expected[1], name), getattr(found[1], name)), name
    assert expected[1].events.keys() == found[1].events.keys()


def test_every_piece_is_heard_of_in_parts_of_parts_too(tmp_path):
    beats: list[int] = []
    with journal(tmp_path, "run", beat=lambda: beats.append(1)):
        kept_parts(str, range(3), "texts")
        assert len(beats) == 4
        with journal(None, "part"):
            Entry("a")
    assert len(beats) == 5
    Entry("b")
    assert len(beats) == 5


def test_no_part_is_computed_twice_and_parts_of_something_else_are(tmp_path):
    computed: list[int] = []

    def squared(part):
        if len(computed) == 3:
            raise Killed
        computed.append(part)
        return part * part

    with journal_of_a_killed_run(tmp_path, "run"):
        kept_parts(squared, range(5), "squares")
    assert computed == [0, 1, 2]
    computed.clear()
    with journal_of_a_killed_run(tmp_path, "run"):
        assert kept_parts(squared, range(5), "squares") == [0, 1, 4, 9, 16]
    assert computed == [3, 4]
    computed.clear()
    with journal_of_a_killed_run(tmp_path, "run"):
        kept_parts(squared, range(5), "squares of others")
    assert computed == [0, 1, 2]
    computed.clear()
    assert kept_parts(squared, [], "squares") == []


def test_blocks_of_a_certificate_are_not_drawn_again(tmp_path, monkeypatch):
    from torchrl_sspl.evaluation import certify as module_of_certify
    from torchrl_sspl.evaluation.blocks import StateBlocks

    # What takes the time of a certificate of a shipped agent, its proof, is not what is kept here.
    agent, env = small_agent(), PendulumEnv(image_size=16)

    def layers(name, horizon=2):
        with journal(tmp_path / name, "run"):
            found = module_of_certify.certify(agent, env, level=0.0, episodes=300, horizon=horizon, budget=Budget(boxes=1))
        return {k: [(s.name, s.value, s.n) for s in layer.statements] for k, layer in found.layers.items()}, found.record

    with monkeypatch.context() as patch:
        drawn = killed_after(10**9, patch, StateBlocks, "__call__")
        expected, record = layers("whole")
    assert len(record.blocks) == drawn[0] > 1
    with monkeypatch.context() as patch, suppress(Killed):
        killed_after(drawn[0] - 1, patch, StateBlocks, "__call__")
        layers("killed")
    with monkeypatch.context() as patch:
        again = killed_after(10**9, patch, StateBlocks, "__call__")
        found, same = layers("killed")
    assert again[0] == 1
    with monkeypatch.context() as patch, suppress(Killed):
        killed_after(drawn[0] - 1, patch, StateBlocks, "__call__")
        layers("other")
    with monkeypatch.context() as patch:
        other = killed_after(10**9, patch, StateBlocks, "__call__")
        layers("other", horizon=1)
    assert other[0] == drawn[0], "of longer episodes"
    assert found == expected
    assert same.blocks == record.blocks
