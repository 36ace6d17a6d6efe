"""Bounds against independent references, the rule of the blocks, and what a record says."""

from __future__ import annotations

import math
from dataclasses import asdict, fields, replace
from fractions import Fraction
from typing import Any

import pytest
import torch

from torchrl_sspl.certification.certificate import Reason, Statement
from torchrl_sspl.certification.record import NOTHING, Counts, Record
from torchrl_sspl.certification.statistics import (
    clopper_pearson,
    fingerprint,
    largest_error_bound,
    paper_numbers,
    quantile_rank,
    run_time_layer,
    share_upper,
    statistical_layer,
)
from torchrl_sspl.errors import CertificationError, ConfigError
from torchrl_sspl.seeds import spawn


def at_most(k: int, n: int, p: float) -> float:
    """P(Bin(n, p) <= k), by exact fractions where n is small."""
    if n <= 60:
        q = Fraction(p)
        return float(sum(math.comb(n, j) * q**j * (1 - q) ** (n - j) for j in range(k + 1)))
    log = [math.lgamma(n + 1) - math.lgamma(j + 1) - math.lgamma(n - j + 1) for j in range(k + 1)]
    return math.fsum(math.exp(c + j * math.log(p) + (n - j) * math.log1p(-p)) for j, c in enumerate(log))


@pytest.mark.parametrize(("k", "n"), [(0, 1), (0, 30), (1, 30), (2, 30), (15, 30), (29, 30), (3, 200)])
@pytest.mark.parametrize("confidence", [0.9, 0.975])
def test_the_upper_bound_is_where_so_few_events_become_unlikely(k, n, confidence):
    # The definition: at the bound, k events or fewer have probability 1 - c.
    bound = share_upper(k, n, confidence)
    assert at_most(k, n, bound) == pytest.approx(1 - confidence, rel=1e-5)
    assert at_most(k, n, bound) <= (1 - confidence) * (1 + 1e-12)  # rounded to the side of caution
    lower, upper = clopper_pearson(k, n, confidence=2 * confidence - 1 if k else confidence)
    assert upper == pytest.approx(bound, rel=1e-8)
    if k:
        assert 1 - at_most(k - 1, n, lower) == pytest.approx(1 - confidence, rel=1e-6)


def test_the_upper_bound_covers_as_often_as_it_says():
    n, p, confidence = 60, 0.07, 0.9
    covered = sum(at_most(k, n, p) - (at_most(k - 1, n, p) if k else 0) for k in range(n + 1) if share_upper(k, n, confidence) >= p)
    assert covered >= confidence


def test_bounds_without_trials_and_of_events_only_are_one():
    assert share_upper(0, 0, 0.95) == 1.0
    assert share_upper(7, 7, 0.95) == 1.0
    for bad in ((-1, 5, 0.9), (6, 5, 0.9), (1, 5, 1.0), (1, 5, 0.0)):
        with pytest.raises(ConfigError):
            share_upper(*bad)


@pytest.mark.parametrize("n", [59, 299, 300, 473, 1000, 3000])
@pytest.mark.parametrize(("share", "confidence"), [(0.95, 0.95), (0.99, 0.95), (0.99, 0.5)])
def test_the_rank_of_a_quantile_is_the_smallest_that_covers(n, share, confidence):
    rank = quantile_rank(n, share, confidence)
    if rank is None:
        assert 1 - share**n < confidence
    else:
        assert at_most(rank - 1, n, share) >= confidence
        assert rank == 1 or at_most(rank - 2, n, share) < confidence


def test_largest_errors_are_no_sample_maximum():
    values = torch.arange(1.0, 1001.0)
    assert largest_error_bound(values.flip(0), 0.95) == quantile_rank(1000, 0.99, 0.95) < 1000
    assert math.isnan(largest_error_bound(values[:298], 0.95))
    assert math.isnan(largest_error_bound([math.nan] * 400, 0.95))


def test_fingerprints_are_of_full_precision():
    a = torch.tensor([[0.1], [0.1 + 2**-27], [0.0], [-0.0]])
    prints = fingerprint(a)
    assert prints[0] != prints[1]
    assert prints[2] == prints[3]
    assert fingerprint(a, grid=2.0**-19)[0] == fingerprint(a, grid=2.0**-19)[1]
    assert fingerprint(torch.zeros(0, 3)) == []
    many = fingerprint(torch.linspace(-1, 1, 20_000)[:, None])
    assert len(set(many)) == 20_000


def counts(**values: int) -> Counts:
    return replace(NOTHING, **values)


def record(**values: Any) -> Record:
    base: dict[str, Any] = {"kind": "resets", "system": "given", "seed": 7, "episodes": 100, "horizon": 10, "envs": 100}
    return Record(**(base | values))


def test_blocks_of_resets_that_show_nothing_are_not_complete_before_all_episodes_are_drawn():
    nothing = counts(episodes=0, steps=0, shown=0)
    assert not record(episodes=300, blocks=[nothing]).complete()
    assert record(episodes=300, blocks=[nothing] * 3).complete()


def test_what_the_papers_proof_needs_counts_the_step_of_the_closed_loop_too():
    one = torch.tensor([-0.25])
    sizes, _ = paper_numbers(
        safe=one, unsafe=-one, following=one, lipschitz_bound=1.0, covering_radius=0.1, dynamics_error=0.0, closed_loop_constant=2.0
    )
    assert (sizes["following_met"], sizes["following_met_as_needed"]) == (1, 0)  # asked for 0.1, needed 0.1 (2 + 1)


def test_blocks_of_states_are_as_many_as_episodes_ask_for():
    one = counts(episodes=250, steps=2500)
    full = record(kind="states", episodes=600, blocks=[one, one])
    assert [full.block, full.size(0), full.size(2)] == [250, 250, 100]
    assert not full.complete()
    full.blocks.append(counts(episodes=100))
    assert full.complete()
    assert record(kind="states", episodes=600, blocks=[NOTHING]).complete()  # the set is empty
    assert not record(kind="states", episodes=600).complete()
    assert record(kind="states", episodes=4).block == 4


@pytest.mark.parametrize(
    ("kind", "asked", "enough", "more"),
    [("resets", 100, [100], [100, 100]), ("states", 300, [0], [0, 50]), ("states", 100, [100], [100, 0])],
)
def test_blocks_beyond_those_that_the_rule_asks_for_are_refused(kind, asked, enough, more):
    # Who may draw on until the counts please him can claim any risk.
    def check(episodes: list[int]) -> None:
        blocks = [counts(episodes=n, steps=10 * n, shown=n) for n in episodes]
        lengths = dict.fromkeys(("shortest", "median", "longest"), 10 if sum(episodes) else 0)
        record(kind=kind, episodes=asked, blocks=blocks, sizes=lengths).check()

    check(enough)
    with pytest.raises(CertificationError, match="as many blocks"):
        check(more)


@pytest.mark.parametrize(
    ("blocks", "complete"),
    [
        ([(100, 100)], True),
        ([(99, 100)], False),
        ([(100, 99)], True),  # how many show U depends on what the policy does
        ([(100, 0)], True),
        ([(0, 100)], True),
        ([(0, 0)], True),
        ([(30, 60), (30, 60)], False),
        ([(30, 60), (30, 60), (30, 60)], True),  # three times as many as asked for
        ([(60, 60), (60, 60)], True),
    ],
)
def test_resets_go_on_while_too_few_count_and_never_look_at_what_happened(blocks, complete):
    made = [counts(episodes=n, shown=m) for n, m in blocks]
    assert record(blocks=made).complete() == complete
    events = [replace(c, left=c.episodes, events=c.episodes, mistaken=c.shown) for c in made]
    assert record(blocks=events).complete() == complete


def test_blocks_of_resets_are_whole_batches():
    assert [record(envs=k, episodes=n).block for k, n in ((20, 1000), (64, 1000), (64, 3), (7, 50))] == [100, 128, 64, 56]


def test_how_many_observations_of_u_were_drawn_where_a_step_enters_it_is_said():
    # Of 300, 150 are drawn uniformly; where few steps enter U, fewer are added than asked for.
    for shown, told in ((300, "150 drawn uniformly in U and 150 where"), (162, "150 drawn uniformly in U and 12 where"), (150, "and 0 where")):
        blocks = [counts(episodes=250, steps=2500, shown=shown - 25), counts(episodes=50, steps=500, shown=25)]
        layer = statistical_layer(record(kind="states", episodes=300, blocks=blocks))
        assert told in layer["unsafe observations"].text
        assert layer["seed"].kind == "assumed"
        assert "seed of all this, 7," in layer["seed"].text


def test_a_premise_that_nothing_watches_is_not_called_watched():
    given = record(blocks=[counts(episodes=100, steps=1000, shown=100)])
    texts = [run_time_layer(given, 0.1, held, watched)["premise"].text for held in (False, True) for watched in (True, False)]
    assert [text.startswith("the premise, watched at run time: ") for text in texts] == [True, False, True, False]
    assert all("which nothing watches" in text for text in texts[1::2])


def test_seeds_of_blocks_are_all_different_and_of_their_purposes():
    three = record(blocks=[NOTHING] * 3)
    assert three.seeds() == [spawn(7, p, k) for k in range(3) for p in ("certificate", "certificate actions")]
    assert record(kind="states", blocks=[NOTHING] * 2).seeds() == [spawn(7, "certificate", 0), spawn(7, "certificate", 1)]


def test_counts_add_up_by_name():
    values = {f.name: k for k, f in enumerate(fields(Counts), 1)}
    with pytest.raises(CertificationError):
        Counts(**values)  # 4 left, 5 entered U ... but only 8 events among 1
    a = counts(episodes=5, steps=7, left=1, events=1)
    assert asdict(a + a) == asdict(counts(episodes=10, steps=14, left=2, events=2))


def layer_of(sizes: dict[str, int] | None = None, **values: Any) -> Any:
    block = {"episodes": 100, "steps": 1000, "shown": 100, "seen": 300} | {k: v for k, v in values.items() if k in NOTHING.__dict__}
    rest = {k: v for k, v in values.items() if k not in NOTHING.__dict__}
    lengths = {"shortest": 1, "median": 2, "longest": 10} | (sizes or {})
    return statistical_layer(record(**({"acceptable": 0.2} | rest), blocks=[counts(**block)], sizes=lengths))


def test_what_is_said_of_episodes_is_honest_about_their_lengths():
    text = layer_of()["episodes"]
    assert text.text.startswith("episodes of at most 10 steps")
    assert "shortest 1, median 2, longest 10" in text.detail


def test_shares_of_episodes_and_of_observations_are_never_added():
    layer = layer_of(left=3, events=3, mistaken=2)
    assert layer["episodes"].value == share_upper(3, 100, 0.975)
    assert layer["unsafe observations"].value == share_upper(2, 100, 0.975)
    assert "risk" not in [s.name for s in layer.statements]


def test_repeated_episodes_and_leaked_labels_do_not_count():
    layer = layer_of({"repeated": 4, "leaked": 3, "trained_on": 9}, left=2, events=2, mistaken=1)
    assert (layer["episodes"].n, layer["unsafe observations"].n) == (96, 97)
    assert layer["episodes"].value == share_upper(2, 96, 0.975)
    assert layer["unsafe observations"].value == share_upper(1, 97, 0.975)
    assert layer.holds


def test_what_is_not_recorded_is_assumed_and_said():
    layer = layer_of()
    assert {layer["fresh"].kind, layer["unseen"].kind} == {"assumed"}
    assert layer_of(used=[1, 2])["fresh"].kind == "measured"


def test_a_bound_that_is_just_acceptable_holds():
    bound = share_upper(1, 100, 0.975)
    just, beyond = (layer_of(left=1, events=1, acceptable=a)["episodes"] for a in (bound, bound - 1e-12))
    assert (just.holds, just.misses_by) == (True, None)
    assert (beyond.holds, beyond.reason) == (False, "EPISODES_LEAVE")
    assert 0 < beyond.misses_by < 1e-11


def test_descriptions_carry_no_verdict():
    measured = record(
        blocks=[counts(episodes=400, steps=4000, shown=400, seen=9)],
        rims=[("at the rim", 50, 0.3)], numbers={"episode_error": 0.2}, acceptable=0.2,
    )  # fmt: skip
    layer = statistical_layer(measured)
    for name in ("largest error", "error at the rim"):
        statement: Statement = layer[name]
        assert (statement.kind, statement.holds, statement.reason) == ("reported", None, "")
    assert layer["error at the rim"].confidence is None
    assert layer["largest error"].confidence == 0.95


@pytest.mark.parametrize("tolerated", [None, 0.0, -1.0])
def test_where_no_error_is_tolerated_the_proof_applies_to_no_episode(tolerated):
    layer = run_time_layer(record(blocks=[counts(episodes=9, shown=9)]), tolerated)
    assert not layer.holds
    assert layer.reasons == [Reason.NOTHING_TOLERATED]
    assert [s.name for s in layer.statements] == ["covered"]


def test_not_finite_numbers_are_none():
    assert record(numbers={"covering_radius": math.inf, "largest_error": math.nan}).numbers["covering_radius"] is None
    assert Statement("a", "b", "proved", False, -math.inf, misses_by=math.inf).value is None


def test_a_record_reads_what_it_writes():
    one = record(
        kind="states", used=[1], blocks=[counts(episodes=100, steps=1000, left=2, events=2, shown=100, seen=1)],
        sizes={"longest": 10, "median": 10, "shortest": 10}, rims=[("half way", 3, 0.5)], numbers={"safe_worst": -0.25},
    )  # fmt: skip
    assert Record.from_dict(one.to_dict()) == one
