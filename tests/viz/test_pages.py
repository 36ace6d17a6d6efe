"""Pages in a browser: nothing scrolls sideways on a phone, figures open at full size."""

from __future__ import annotations

import json

import pytest
from browser import BROWSER, browser

pytest.importorskip("matplotlib")
from torchrl_sspl.certification.certificate import Certificate
from torchrl_sspl.files import append, write
from torchrl_sspl.modules.agent import agent_directory
from torchrl_sspl.viz import requirement_rows, write_report
from torchrl_sspl.viz.certificate import certificate_section
from torchrl_sspl.viz.compare import compare
from torchrl_sspl.viz.pages import render
from torchrl_sspl.viz.plane import new_figure
from torchrl_sspl.viz.training import read_training
from torchrl_sspl.viz.verdict import first_screen

pytestmark = [pytest.mark.slow, pytest.mark.skipif(BROWSER is None, reason="needs chromium")]
WIDTH = "document.documentElement.scrollWidth"
#: What is wider than the page, inside of boxes that scroll or not.
WIDER = "[...document.querySelectorAll('section *')].filter(e => e.getBoundingClientRect().right > innerWidth + 1).length"


@pytest.fixture(scope="module", params=["pendulum", "quadruped"])
def report(request, tmp_path_factory):
    """All that a report can hold, with the certificate of a shipped agent."""
    from torchrl_sspl.envs import DubinsEnv, PendulumEnv
    from torchrl_sspl.evaluation.measurements import Evaluation, share

    certificate = Certificate.load(agent_directory(request.param) / "certificate.json")
    env, found = {"pendulum": PendulumEnv, "quadruped": DubinsEnv}[request.param](), Evaluation()
    for r in env.system.requirements:
        found.add(share(r.name, 0, 50, "a long remark on how it was measured " * 3))
    rows = requirement_rows(env.system.requirements, found)
    screen = first_screen(certificate, rows, trained=False)
    figure = new_figure(10, 4, "A wide figure.")
    figure.add_subplot().plot([0, 1])
    return write_report(
        tmp_path_factory.mktemp(request.param) / "report.html", title=env.system.title, summary=rows, measurements=found.measurements,
        figures={"Wide": figure}, config={"a": {"very_long_key_of_a_setting": "module.path:" + "Name" * 20}}, kernel=True,
        checks=[{"round": 0, "unsafe_inside": 0, "size": 0.5, "passed": True, "reason": "unsafe inside 3, left 4, touched U 5"}],
        certificate=certificate_section(certificate), headline=(screen.headline, screen.kind, screen.more),
        measured=screen.measured, proved=screen.proved,
    )  # fmt: skip


@pytest.mark.parametrize("dark", [False, True])
@pytest.mark.parametrize("width", [390, 1400])
def test_a_report_does_not_scroll_sideways(report, width, dark):
    with browser() as page:
        page.open(report, width, dark=dark)
        page.value("document.querySelectorAll('details').forEach(d => d.open = true)")
        assert page.value(WIDTH) <= width
        assert page.value(WIDER) == 0
        head = page.value("document.querySelector('.verdict h2').getBoundingClientRect().bottom")
        assert head < 844, "the verdict is on the first screen"


def test_a_figure_opens_at_full_size_and_closes(report):
    shown = "document.querySelector('.zoom img').getBoundingClientRect().width"
    with browser() as page:
        page.open(report, 390)
        small = page.value(shown)
        page.value("document.querySelector('.zoom').click()")
        assert page.value(shown) == page.value("document.querySelector('.zoom img').naturalWidth") > 2 * small
        assert page.value(WIDTH) <= 390
        page.value("document.querySelector('.zoom').click()")
        assert page.value(shown) == small


LONG = "a_name_that_is_long_and_has_no_place_to_break" * 2


def runs(folder):
    """Directories of runs that differ in a setting, one of them in the middle of its training."""
    found = [folder / f"{LONG}{k}" for k in range(3)]
    for k, run in enumerate(found):
        config = {"seed": 0, "env": {"_target_": LONG}, "synthesis": {"margin": 0.1 * k}}
        for phase in ("joint", "fit", "tune"):
            for step in (100, 200, 300):
                append(run / "log.jsonl", json.dumps({"phase": phase, "round": 0, "step": step, f"loss_{LONG}": 1 / step, "loss_safe": k}))
        append(run / "log.jsonl", json.dumps({"phase": "check", "round": 0, "step": 0, "size": 0.5, "reason": LONG}))
        write(run / "metrics.json", json.dumps({"config": config, "measurements": {"own": {LONG: {"value": 0.5 * k, "unit": "share"}}}}))
    write(found[0] / "progress.json", json.dumps({"phase": LONG, "done": 1, "total": 2, "left": "4 min left in this phase, then 3 more"}))
    return found


@pytest.fixture(scope="module", params=["comparison", "agent at work", "training"])
def other(request, tmp_path_factory):
    """The pages that are no reports; the served ones as they are before anything is told."""
    folder = tmp_path_factory.mktemp("other")
    if request.param == "comparison":
        return compare(runs(folder), folder / "page.html")
    if request.param == "training":
        return write(folder / "page.html", render("training.html", title=LONG, facts=LONG, **read_training(runs(folder)[0])))
    return write(folder / "page.html", render("watch.html", title=LONG, facts=LONG))


@pytest.mark.parametrize("width", [390, 1400])
def test_other_pages_do_not_scroll_sideways(other, width):
    with browser() as page:
        page.open(other, width, dark=width == 390)
        page.value("document.querySelectorAll('details').forEach(d => d.open = true)")
        assert page.value(WIDTH) <= width
