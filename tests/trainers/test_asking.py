"""Which pictures a person is asked about, and what the answers say of the others."""

from __future__ import annotations

from types import SimpleNamespace

import pytest
import torch
from tiny import SINGLE

from torchrl_sspl.configs import compose
from torchrl_sspl.data import Labels
from torchrl_sspl.errors import ConfigError, EmptyRegionError
from torchrl_sspl.experiments import Experiment
from torchrl_sspl.sets import SAFE, UNLABELLED, UNSAFE
from torchrl_sspl.trainers import asking, choose_and_spread, infer_unsafe


def box(n: int = 6000) -> tuple[torch.Tensor, torch.Tensor]:
    """Latents of a plane, and their answers: U around a box, S in its middle."""
    z = torch.rand(n, 2, generator=torch.Generator().manual_seed(0)) * 2 - 1
    far = z.abs().amax(1)
    answer = torch.full((n,), UNLABELLED)
    answer[far < 0.1] = SAFE
    answer[far > 0.6] = UNSAFE
    return z, answer


def first(answer: torch.Tensor, count: int) -> torch.Tensor:
    """The first labels of S and of U."""
    told = torch.zeros(len(answer), dtype=torch.bool)
    for code in (SAFE, UNSAFE):
        told[(answer == code).nonzero()[:count, 0]] = True
    return told


def test_chosen_labels_tell_where_u_ends_better_than_as_many_random_ones():
    z, answer = box()
    region, told = choose_and_spread(z, first(answer, 20), answer, 160)
    assert int(told.sum()) == 200
    random = torch.arange(len(z)) < 200
    plain, still = choose_and_spread(z, random, answer, 0)
    assert torch.equal(still, random)

    def wrong(found: torch.Tensor) -> float:
        return float(((found == UNSAFE) != (answer == UNSAFE)).float().mean())

    assert wrong(region) < 0.01
    assert wrong(plain) > 4 * wrong(region)
    assert int(((region != UNSAFE) & (answer == UNSAFE)).sum()) < int(((region == UNSAFE) & (answer != UNSAFE)).sum())  # caution


def test_many_labels_are_interpolated_from_those_nearby(monkeypatch):
    z, answer = box(1500)
    told = torch.arange(len(z)) < 400
    whole = choose_and_spread(z, told, answer, 0)[0]
    monkeypatch.setattr("torchrl_sspl.trainers.asking._MOST", 399)
    assert float((choose_and_spread(z, told, answer, 0)[0] != whole).float().mean()) < 0.002


def test_only_labels_say_s_and_no_answer_is_read_that_was_not_asked_for():
    z, answer = box()
    start = first(answer, 20)
    region, told = choose_and_spread(z, start, answer, 100)
    assert torch.equal(region == SAFE, told & (answer == SAFE))
    assert (told & start == start).all()
    secret = torch.where(told, answer, UNSAFE)
    again = choose_and_spread(z, start, secret, 100)
    assert torch.equal(again[0], region)
    assert torch.equal(again[1], told)
    # Later rounds ask for nothing, and know what was answered.
    assert torch.equal(choose_and_spread(z, told, answer * told, 0)[0], region)
    known = start.nonzero()[:, 0]
    rows, start = torch.cat([known, torch.arange(5), known]), torch.cat([start[known], start[:5], torch.zeros(len(known), dtype=torch.bool)])
    assert choose_and_spread(z[rows], start, answer[rows], 100)[1].all()  # those that look the same, too


def test_labels_that_all_others_contradict_are_not_used():
    z, answer = box()
    start = first(answer, 20)
    right, told = choose_and_spread(z, start, answer, 160)
    far = (z.abs().amax(1) - 0.6).abs() > 0.1
    wrong = (told & far).nonzero()[::9, 0]
    assert len(wrong) >= 5
    mistaken = answer.clone()
    mistaken[wrong] = torch.where(answer[wrong] == UNSAFE, SAFE, UNSAFE)
    region, still = choose_and_spread(z, told, mistaken, 0)
    assert torch.equal(still, told)  # they were asked for, and cost what they cost
    mended = (region[wrong] == UNSAFE) == (answer[wrong] == UNSAFE)
    assert int(mended.sum()) >= len(wrong) - 1
    assert mended[answer[wrong] == UNSAFE].all()

    def missed(found: torch.Tensor) -> int:
        return int(((found != UNSAFE) & (answer == UNSAFE)).sum())

    assert missed(region) <= missed(right) + 10


def test_what_the_others_say_of_a_label_is_the_interpolation_without_it():
    from scipy.interpolate import RBFInterpolator

    from torchrl_sspl.trainers.asking import _SMOOTHING, _left_out

    z, answer = box(40)
    y = torch.where(answer == UNSAFE, 1.0, -1.0).double()
    found = _left_out(z.double(), y)
    for j in (0, 7, 39):
        others = torch.arange(40) != j
        f = RBFInterpolator(z[others].double().numpy(), y[others].numpy(), kernel="linear", smoothing=_SMOOTHING)
        assert float(found[j]) == pytest.approx(f(z[j : j + 1].double().numpy())[0], abs=1e-6)


@pytest.mark.parametrize("codes", [[UNSAFE, UNSAFE], [SAFE, SAFE]])
def test_labels_of_one_side_alone_are_refused(codes):
    told = torch.ones(2, dtype=torch.bool)
    with pytest.raises(EmptyRegionError, match="labels of U and of what is not of U"):
        choose_and_spread(torch.rand(2, 2), told, torch.tensor(codes), 0)


def test_a_run_asks_for_as_many_labels_as_it_may(tmp_path):
    run = Experiment(compose([*SINGLE, f"out_dir={tmp_path}", "synthesis.transitions=800", "labels.safe=9", "labels.unsafe=11", "labels.choose=30"]))
    run.train()
    budget, latents = run.work.source.budget, run.work.latents
    assert (budget["labels of S"], budget["labels of U"]) == (9, 11)
    assert sum(budget[f"chosen labels of {name}"] for name in ("S", "U", "neither")) == 30
    assert budget["chosen labels of neither"] > 0
    assert int(latents["told"].sum()) == 50
    assert int((latents["region"] == UNSAFE).sum()) > 5 * budget["labels of U"]


@pytest.mark.parametrize(("number", "choose", "asked"), [(0, 5, 5), (1, 5, 0), (0, 38, 38), (0, 50, 38), (1, 50, 0)])
def test_labels_are_asked_for_in_the_first_round_alone_and_too_few_are_told(number, choose, asked):
    seen, counted = torch.linspace(-1, 1, 40)[:, None], []
    told = torch.zeros(40, 1, dtype=torch.bool).index_fill(0, torch.tensor([0, 39]), True)
    latents = {"seen": seen, "told": told, "answer": torch.where(seen > 0, UNSAFE, SAFE)}
    source = SimpleNamespace(labels=Labels(safe=1, unsafe=1, choose=choose), count_labels=lambda answers: counted.append(len(answers)))
    work = SimpleNamespace(latents=latents, source=source, seen_dim=1, warnings=[])
    asking.tell_of_others(work, number)
    assert counted == [asked]
    assert work.warnings == (["all pictures have labels: 38 had none, and labels.choose asked for 50"] if choose == 50 and not number else [])
    assert int(latents["told"].sum()) == 2 + asked


@pytest.mark.parametrize("options", [{"choose": 5}, {"choose": 5, "safe": 3}, {"choose": 5, "safe": 0, "unsafe": 3}, {"choose": -1, "safe": 3, "unsafe": 3}])
def test_choosing_needs_limits(options):
    with pytest.raises(ConfigError, match="labels: expected choose"):
        Labels(**options)


def test_choosing_needs_latents():
    with pytest.raises(ConfigError, match=r"labels\.choose=0 without the synthesis on frozen latents"):
        compose(["env=pendulum", "labels.safe=9", "labels.unsafe=9", "labels.choose=5", "synthesis.enabled=false"]).check()


def labelled(z: torch.Tensor, answer: torch.Tensor, count: int, within: int) -> torch.Tensor:
    """Codes of which ``count`` labels of S and U are known, all of the first ``within``."""
    told = first(torch.where(torch.arange(len(z)) < within, answer, UNLABELLED), count)
    return torch.where(told, answer, UNLABELLED)


@pytest.mark.slow
def test_labels_that_are_as_frequent_everywhere_in_u_tell_where_u_ends():
    z, answer = box()
    region, everywhere = labelled(z, answer, 200, 6000), torch.ones(len(z), dtype=torch.bool)
    before = torch.random.get_rng_state()
    found = infer_unsafe(z, region, everywhere, steps=400, seed=3)
    assert torch.equal(torch.random.get_rng_state(), before)
    far = z.abs().amax(1)
    assert int((region == UNSAFE).sum()) == 200
    assert int((answer == UNSAFE).sum()) > 3500
    assert (found[far > 0.65] == UNSAFE).all()
    assert not (found[far < 0.3] == UNSAFE).any()
    missed, added = int(((found != UNSAFE) & (answer == UNSAFE)).sum()), int(((found == UNSAFE) & (answer != UNSAFE)).sum())
    assert missed < added < 1300  # caution; of 2,200
    assert torch.equal(found[region != UNLABELLED], region[region != UNLABELLED])
    assert torch.equal(found == SAFE, region == SAFE)
    assert torch.equal(infer_unsafe(z, region, everywhere, steps=400, seed=3), found)


@pytest.mark.slow
def test_what_was_recorded_without_labels_does_not_count_against_u():
    z, answer = box()
    corner = (z > 0.7).all(1).nonzero()[:, 0].repeat(100)  # many more pictures of a part of U, none of them labelled
    rows = torch.cat([torch.arange(6000), corner])
    region = torch.cat([labelled(z, answer, 200, 6000), torch.full((len(corner),), UNLABELLED)])
    drawn = torch.arange(len(rows)) < 6000
    wrong = int((z.abs().amax(1) > 0.9).nonzero()[-1])
    region[wrong] = SAFE
    found = infer_unsafe(z[rows], region, drawn, steps=300)
    assert torch.equal(found[:6000], infer_unsafe(z, region[:6000], drawn[:6000], steps=300))
    assert (found[6000:] == UNSAFE).all()
    assert found[wrong] == SAFE  # a label stays what it is
    assert not (infer_unsafe(z[rows], region, torch.ones_like(drawn), steps=300)[6000:] == UNSAFE).all()


@pytest.mark.parametrize("codes", [[SAFE, UNLABELLED], [SAFE, UNSAFE]])
def test_what_is_of_u_is_inferred_from_labels_of_u_and_pictures_without_any(codes):
    with pytest.raises(EmptyRegionError, match=r"latents without a label, received .* labels\.share=1"):
        infer_unsafe(torch.rand(2, 2), torch.tensor(codes), torch.ones(2, dtype=torch.bool))


@pytest.mark.parametrize(("words", "inferred"), [(["labels.share=0.5"], True), pytest.param([], False, marks=pytest.mark.slow)])
def test_a_run_with_few_labels_infers_what_else_is_of_u(words, inferred, tmp_path, monkeypatch):
    asked = []

    def spread(seen, region, drawn, **seed):
        asked.append((region.clone(), drawn))
        return torch.where((torch.arange(len(seen)) % 2 == 0) & (region == UNLABELLED), UNSAFE, region)

    monkeypatch.setattr("torchrl_sspl.trainers.asking.infer_unsafe", spread)
    rounds = ["synthesis.rounds=2", "synthesis.transitions=800", "synthesis.rollout_transitions=40", "synthesis.rim_transitions=40"]
    run = Experiment(compose([*SINGLE, f"out_dir={tmp_path}", *rounds, "labels.safe=9", "labels.unsafe=11", *words]))
    run.train()
    budget, latents = run.work.source.budget, run.work.latents
    assert bool(asked) == inferred
    if not inferred:
        assert int((latents["region"] == UNSAFE).sum()) <= budget["labels of U"]
        return
    assert (budget["labels of S"], budget["labels of U"]) == (9, 11)
    assert int((latents["region"] == UNSAFE).sum()) > 300
    (first_known, first_drawn), (known, drawn) = asked
    assert len(known) > len(first_known)
    assert int((known == UNSAFE).sum()) == 11  # labels alone, not what was made of them
    assert int(first_drawn.sum()) == 1 + int((first_known == UNSAFE).nonzero().max())  # until the last label of U was given
    assert torch.equal(drawn.nonzero(), first_drawn.nonzero())  # what came later was recorded without labels
