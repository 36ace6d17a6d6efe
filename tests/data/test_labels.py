"""Few labels, and wrong ones: what is kept, where, and that a run uses no more."""

from __future__ import annotations

import pytest
import torch
from tensordict import TensorDict
from tiny import SINGLE

from torchrl_sspl.configs import compose
from torchrl_sspl.data import Labels, TransitionStore, collect_random
from torchrl_sspl.envs import PendulumEnv
from torchrl_sspl.errors import ConfigError, EmptyRegionError, ShapeError
from torchrl_sspl.experiments import Experiment
from torchrl_sspl.sets import SAFE, UNLABELLED, UNSAFE
from torchrl_sspl.trainers.source import Source


def codes(*values: int) -> torch.Tensor:
    return torch.tensor(values)[:, None]


def rows(region: torch.Tensor) -> TensorDict:
    pixels = torch.randint(255, (len(region), 6, 4, 4), dtype=torch.uint8)
    following = torch.cat([pixels[:, 3:], pixels[:, 3:]], 1)
    body = {"pixels": pixels, "action": torch.zeros(len(region), 1), "region": region, "next": {"pixels": following, "region": region}}
    return TensorDict(body, [len(region)])


def test_the_first_labels_of_each_kind_are_kept():
    region = codes(1, 2, 1, 0, 2, 2, 1)
    assert Labels(safe=2, unsafe=1)(region).flatten().tolist() == [1, 2, 1, 0, 0, 0, 0]
    assert Labels(safe=1)(region).flatten().tolist() == [1, 2, 0, 0, 2, 2, 0]
    assert Labels(safe=3)(region, {SAFE: 2, UNSAFE: 1}).flatten().tolist() == [1, 2, 0, 0, 2, 2, 0]
    assert torch.equal(Labels()(region), region)


def test_wrong_labels_are_the_other_ones_as_often_as_said():
    region = torch.cat([codes(SAFE).repeat(5000, 1), codes(UNSAFE).repeat(5000, 1), codes(UNLABELLED).repeat(100, 1)])
    found = Labels(wrong=0.05, seed=3)(region)
    assert (found[10000:] == UNLABELLED).all()
    for part, code in ((found[:5000], UNSAFE), (found[5000:10000], SAFE)):
        assert float((part == code).float().mean()) == pytest.approx(0.05, abs=0.012)
    assert torch.equal(Labels(wrong=0.05, seed=3)(region), found)
    assert not torch.equal(Labels(wrong=0.05, seed=3)(region, position=1), found)
    assert (Labels(wrong=1.0)(region)[:5000] == UNSAFE).all()


def test_a_share_of_the_pictures_is_labelled_all_over_the_data():
    region = torch.cat([codes(SAFE, UNSAFE, UNLABELLED).repeat(4000, 1)])
    labels = Labels(share=0.1, seed=3)
    found = labels(region)
    for code in (SAFE, UNSAFE):
        assert torch.isin(found[region == code], torch.tensor([code, UNLABELLED])).all()
        assert float((found[region == code] == code).float().mean()) == pytest.approx(0.1, abs=0.015)
        assert int((found[6000:] == code).sum()) > 150
    assert not found[region == UNLABELLED].any()
    assert torch.equal(labels(region), found)
    assert not torch.equal(labels(region, position=1), found)
    assert int((Labels(share=0.1, unsafe=50, seed=3)(region) == UNSAFE).sum()) == 50
    wrong = Labels(share=0.1, wrong=1.0, seed=3)(region)
    assert torch.equal(wrong > 0, found > 0)
    assert (wrong[found == SAFE] == UNSAFE).all()


@pytest.mark.parametrize(
    ("options", "infers", "kept"),
    [
        ({}, False, []),
        ({"unsafe": 5}, False, []),
        ({"share": 0.5}, True, ["drawn"]),
        ({"share": 0.5, "unsafe": 5}, True, ["drawn"]),
        ({"safe": 3, "unsafe": 3, "choose": 5}, False, ["answer"]),
        ({"share": 0.5, "safe": 3, "unsafe": 3, "choose": 5}, False, ["answer"]),
    ],
)
def test_labels_at_random_say_what_the_others_are(options, infers, kept):
    labels = Labels(**options)
    assert (labels.infers, labels.kept) == (infers, kept)
    assert labels.tells is bool(kept)
    store = TransitionStore(20, labels=labels)
    store.extend(rows(codes(1, 2, 0)))
    assert {"answer", "drawn"} & set(store.get(slice(None)).keys()) == set(kept)


def test_it_is_known_where_there_were_labels_of_u_left():
    found = codes(0, 2, 1, 0, 2, 0)
    assert Labels(unsafe=2).left(found).flatten().tolist() == [True] * 5 + [False]
    assert Labels(unsafe=2).left(found, {SAFE: 9, UNSAFE: 1}).flatten().tolist() == [True, True, False, False, False, False]
    assert not Labels(unsafe=0).left(found).any()
    assert Labels(safe=0).left(found).all()

    store = TransitionStore(100, labels=Labels(share=0.5, unsafe=20))
    for _ in range(3):
        store.extend(rows(codes(2).repeat(30, 1)))
    drawn, last = store.get(slice(None))["drawn"][:, 0], int((store.region == UNSAFE).nonzero().max())
    assert drawn[: last + 1].all()
    assert not drawn[last + 1 :].any()
    assert 30 < last < 60


def test_what_has_been_used_is_not_used_again():
    left = Labels(safe=5, unsafe=None).less(3, 9, seed=1)
    assert left.most == {SAFE: 2, UNSAFE: None}
    assert Labels(safe=5).less(7, 0, seed=1).most[SAFE] == 0


def test_a_store_holds_no_more_labels_than_it_may(tmp_path):
    store = TransitionStore(20, labels=Labels(safe=3, unsafe=2))
    for _ in range(4):
        store.extend(rows(codes(1, 2, 0, 1, 2)))
        assert int((store.region == SAFE).sum()) <= 3
        assert int((store.region == UNSAFE).sum()) <= 2
    assert (store.region == SAFE).sum() == 3
    assert store.get(slice(None))["next", "region"].abs().sum() == 0
    other = TransitionStore(20, labels=Labels(safe=3, unsafe=2))
    other.load_state_dict(store.state_dict())
    for again in (store, other):
        again.extend(rows(codes(1, 1, 1, 1, 1)))  # in the place of the two labels of S that came first: no other one is given
        assert (again.region == SAFE).sum() == 1
        assert (again.given, again.recorded) == ({SAFE: 3, UNSAFE: 2}, 25)
    last = TransitionStore(20, labels=Labels(safe=3, unsafe=2))
    last.load_state_dict(store.state_dict())  # of which two labels of S were overwritten
    last.extend(rows(codes(1, 1, 1, 1, 1)))
    assert last.given == {SAFE: 3, UNSAFE: 2}
    store.dumps(tmp_path)
    read = TransitionStore.from_folder(tmp_path, labels=Labels(safe=3, unsafe=2))
    read.extend(rows(codes(1, 2)))
    assert read.given == {SAFE: 3, UNSAFE: 2}
    plain = TransitionStore(20)
    plain.extend(rows(codes(1, 2, 0)))
    assert plain.get(slice(None))["next", "region"].flatten().tolist() == [1, 2, 0]


@pytest.mark.parametrize("options", [{"wrong": 0.5}, {"share": 0.5}, {"wrong": 0.5, "safe": 999, "unsafe": 999, "choose": 1}])
def test_what_takes_the_place_of_others_gets_labels_of_its_own(options):
    labels, data = Labels(**options, seed=3), rows(codes(SAFE).repeat(40, 1))
    store = TransitionStore(80, labels=labels)
    name, found = "answer" if labels.choose else "region", []
    for k in range(4):  # twice through the ring
        store.extend(data)
        found.append(store.get(slice(40 * (k % 2), 40 * (k % 2) + 40))[name])
        said = labels.answers if labels.choose else labels
        assert torch.equal(found[-1], said(data["region"], position=40 * k))
    assert not any(torch.equal(found[a], found[b]) for a in range(4) for b in range(a))

    other = TransitionStore(80, labels=labels)
    other.load_state_dict(store.state_dict())
    for each in (store, other):
        each.extend(data)
    assert torch.equal(store.get(slice(0, 40))[name], other.get(slice(0, 40))[name])
    with pytest.raises(ShapeError):
        store.extend(data.exclude("pixels"))
    assert store.recorded == 200  # what is refused counts for nothing
    store.recorded = 2**24  # more than a seed can tell apart
    store.extend(data)
    assert torch.equal(store.get(slice(40, 80))[name], found[0])


def test_what_is_collected_later_gets_what_is_left():
    env = PendulumEnv([16], seed=0)
    store = TransitionStore(64, labels=Labels(safe=3, unsafe=30))
    collect_random(env, 64, seed=0, steps=1, store=store)
    used = int((store.region == UNSAFE).sum())
    assert 20 < used <= 30

    source = Source(PendulumEnv, _Mean(), store=store, labels=Labels(safe=3, unsafe=30), steps=1)
    source.count(store)
    found = source.random(300, 0)["region"]
    assert int((found == UNSAFE).sum()) == 30 - used
    assert source.budget["labels of U"] == 30
    assert source.budget["transitions"] == 364


def test_what_is_overwritten_counts_all_the_same():
    env = PendulumEnv([16], seed=0)
    store = TransitionStore(64, labels=Labels(safe=3, unsafe=30))
    collect_random(env, 160, seed=0, steps=1, store=store)
    source = Source(PendulumEnv, _Mean(), store=store, labels=Labels(safe=3, unsafe=30), steps=1)
    source.count(store)
    assert (source.budget["transitions"], source.budget["labels of U"]) == (160, 30)


@pytest.mark.parametrize(("options", "name"), [({"share": 0.5}, "drawn"), ({"safe": 3, "unsafe": 3, "choose": 5}, "answer")])
def test_a_store_that_was_recorded_with_other_labels_is_refused(options, name):
    store = TransitionStore(8)
    collect_random(PendulumEnv([8], seed=0), 8, seed=0, steps=1, store=store)
    source = Source(PendulumEnv, _Mean(), store=store, labels=Labels(**options))
    with pytest.raises(ConfigError, match=f"recorded with these labels, received one without {name}"):
        source.stored(8)


def test_answers_that_chosen_labels_took_leave_the_others():
    source = Source(PendulumEnv, _Mean(), labels=Labels(safe=9, unsafe=30, choose=5), steps=1)
    source.count_labels(codes(1, 1, 2, 0)[:, 0])
    found = source.random(300, 0)["region"]
    assert (int((found == SAFE).sum()), int((found == UNSAFE).sum())) == (9, 30)
    assert [source.budget[f"chosen labels of {name}"] for name in ("S", "U", "neither")] == [2, 1, 1]


class _Mean(torch.nn.Module):
    """Brightness of two frames."""

    def __init__(self):
        super().__init__()
        self.weight = torch.nn.Parameter(torch.ones(1))

    def sequence(self, frames):
        mean = frames.float().mean((-1, -2, -3))
        return torch.stack([mean[:, :2], mean[:, 1:]], 1)


def test_a_run_uses_no_more_labels_than_it_may(tmp_path):
    words = [*SINGLE, f"out_dir={tmp_path}"]
    run = Experiment(compose([*words, "labels.safe=9", "labels.unsafe=11"]))
    run.train()
    budget = run.work.source.budget
    assert budget["transitions"] > 100
    assert budget["labels of S"] == 9
    assert budget["labels of U"] == 11
    assert Experiment(compose([*SINGLE, f"out_dir={tmp_path}/plain"])).labels is None


@pytest.mark.parametrize(
    ("words", "problem"),
    [
        (["labels.safe=9", "buffer.capacity=100"], r"buffer\.capacity >= trainer\.total_frames=.* with limits of labels, received 100"),
        (["labels.safe=9", "labels.unsafe=9", "labels.choose=5", "loss=paper"], r"labels\.choose=0 without the synthesis"),
    ],
)
def test_labels_that_would_be_lost_or_never_asked_for_are_refused(words, problem):
    with pytest.raises(ConfigError, match=problem):
        compose(["env=pendulum", *words]).check()


def test_a_run_without_labels_of_u_says_which_options_give_them(tmp_path):
    with pytest.raises(EmptyRegionError, match=r"give labels of both \(labels\.safe, labels\.unsafe"):
        Experiment(compose([*SINGLE, f"out_dir={tmp_path}", "labels.unsafe=0"])).train()


@pytest.mark.parametrize("options", [{"safe": -1}, {"wrong": 1.5}, {"share": 0.0}, {"share": 1.1}])
def test_labels_that_cannot_be_are_refused(options):
    with pytest.raises(ConfigError, match="labels: expected"):
        Labels(**options)


def test_labels_of_another_shape_are_refused():
    with pytest.raises(ShapeError, match=r"labels: expected \(n, 1\)"):
        Labels()(torch.zeros(3, dtype=torch.int64))
