"""What is shown while a training runs: words, loss, volume, and a time that is measured in the phase it is about."""

from __future__ import annotations

import io
import json
from pathlib import Path
from types import SimpleNamespace

import pytest
from torch import nn

from torchrl_sspl.trainers import progress as module
from torchrl_sspl.trainers.phases import Check, Phase, Phases
from torchrl_sspl.trainers.progress import WORDS, Progress, round_line
from torchrl_sspl.trainers.synthesis import synthesis_phases


@pytest.fixture
def clock(monkeypatch):
    now = SimpleNamespace(seconds=100.0)
    monkeypatch.setattr(module.time, "monotonic", lambda: now.seconds)
    monkeypatch.setenv("COLUMNS", "200")  # a narrow window cuts the bar's words
    return now


def test_the_time_left_is_that_of_the_present_phase_by_its_own_pace(clock):
    bar = Progress(2000, 0, file=io.StringIO())
    bar.begin("joint training", 100, left=3)
    assert bar.eta() == "3 phases follow"  # nothing is known yet
    for _ in range(10):
        clock.seconds += 6.0
        bar.tick(lambda: 0.25)
    assert bar.eta() == "9 min left in this phase, then 3 more"
    bar.begin("fitting", 1000, taken=500, left=0)  # slow steps before say nothing of these
    assert bar.eta() == ""
    for _ in range(100):
        clock.seconds += 0.1
        bar.tick(lambda: None)
    assert bar.eta() == "40 s left in this phase"


def test_phase_loss_and_volume_are_in_the_bar_and_the_loss_is_asked_for_once_a_second(clock):
    file, asked = io.StringIO(), []
    bar = Progress(100, 0, file=file)
    bar.begin("joint training", 100)
    bar.kept = 0.62
    for _ in range(40):
        clock.seconds += 0.1
        bar.tick(lambda: asked.append(1) or 0.125)
    shown = file.getvalue()
    for words in ("joint training", "loss 0.125", "safe set 62 % of the space outside U".replace(" %", "%"), "left in this phase"):
        assert words in shown
    assert 3 <= len(asked) <= 5


def test_the_clock_goes_on_while_there_are_no_steps(clock):
    file = io.StringIO()
    bar = Progress(100, 30, file=file)
    bar.begin("checking on fresh episodes", 1, left=1)
    sizes = [len(file.getvalue())]
    for seconds in (0.0, 0.0, 2.0):  # once a second is enough
        clock.seconds += seconds
        bar.beat()
        sizes.append(len(file.getvalue()))
    assert sizes[0] < sizes[1] == sizes[2] < sizes[3]


def test_a_file_says_the_same_without_a_bar_until_the_end(clock, tmp_path):
    bar, file = Progress(30, 10, shown=False, out_dir=tmp_path), tmp_path / "progress.json"
    bar.begin("fitting", 20, left=2)
    assert json.loads(file.read_text()) == {"phase": "fitting", "done": 10, "total": 30, "left": "2 phases follow"}
    for _ in range(4):
        clock.seconds += 2.0
        bar.tick(lambda: pytest.fail("a loss was asked for"))
    assert json.loads(file.read_text()) == {"phase": "fitting", "done": 14, "total": 30, "left": "32 s left in this phase, then 2 more"}
    file.unlink()
    file.mkdir()  # what cannot be written does not end a training
    clock.seconds += 2.0
    bar.tick(lambda: None)
    file.rmdir()
    bar.show()
    bar.close()
    assert list(tmp_path.iterdir()) == []


def test_what_is_not_shown_asks_for_nothing():
    bar = Progress(10, 0, shown=False)
    bar.begin("a", 10)
    bar.tick(lambda: pytest.fail("a loss was asked for"))
    bar.say("nothing")
    bar.move(7)
    assert bar.n == 7


def test_every_round_ends_with_a_sentence_and_collecting_is_counted(capsys):
    found = Check(0, 0.0, 0, 0, 2, 0, 0.98, 0.62, True, "")

    class Checked(Phase):
        name = "check"

        def run(self, work):
            work.checks.append(found)
            work.source.tell(28_672)

    loop = SimpleNamespace(step=0, restart=lambda: None, loss=None)
    work = SimpleNamespace(
        checks=[], config=SimpleNamespace(check_episodes=4000), loop=loop, skip=False, begin=lambda: None, finish=lambda: None,
        out_dir=None, encoder=nn.Identity(), networks=nn.ModuleDict(), source=SimpleNamespace(),
    )
    Phases([Checked(0)], work, progress=True).run()
    said = "".join(capsys.readouterr())
    assert "28,672 transitions seen" in said
    assert "round 1: the safe set covers 62 % of the space outside U; of up to 4,000 held-out episodes 2 left it, 0 entered U" in said
    refused = Check(1, 0.0, 3, 0, 0, 0, 0.0, 0.4, False, "unsafe inside 3")
    assert round_line(refused, 10).endswith("not kept, because of: unsafe inside 3")
    assert "no safe set" in round_line(Check(1, 0.0, 0, 0, 0, 0, 0.0, 0.0, False, "the set is empty"), 10)


def test_every_phase_has_words():
    from torchrl_sspl.configs.schema import SynthesisConfig

    for settings in (SynthesisConfig(), SynthesisConfig(teacher="clearance", tolerated_error=0.1, steady_steps=1)):
        assert {phase.name for phase in synthesis_phases(settings)} <= set(WORDS)


def test_the_benchmark_that_interrupts_trainings_reads_every_phase_off_the_bar(clock, monkeypatch):
    monkeypatch.syspath_prepend(str(Path(__file__).parents[2] / "benchmarks"))
    import resume

    file = io.StringIO()
    bar, phases = Progress(100, 0, file=file), ["joint training", *(f"round 1 of 2: {words}" for words in WORDS.values()), *WORDS.values()]
    for phase in phases:
        bar.begin(phase, 4)
        clock.seconds += 1.0
        bar.tick(lambda: 0.5)
    found = [(found["phase"], int(found["step"])) for found in resume.BAR.finditer(file.getvalue())]
    assert list(dict.fromkeys(phase for phase, _ in found)) == ["starting", *phases]
    assert found[-1][1] == len(phases)
