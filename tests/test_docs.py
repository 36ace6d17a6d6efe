"""The documentation: its code runs, its pages name everything public, its checks can fail."""

from __future__ import annotations

import functools
import importlib.util
import json
import re
import subprocess
import sys
from pathlib import Path
from types import ModuleType

import pytest
import torch

from torchrl_sspl import cli
from torchrl_sspl.certification import Budget

ROOT = Path(__file__).parents[1]
DOCS = ROOT / "docs"
if not (ROOT / "torchrl_sspl").is_dir():
    pytest.skip("needs a checkout", allow_module_level=True)
PAGES = sorted(path for path in DOCS.rglob("*.md"))


def load(name: str) -> ModuleType:
    spec = importlib.util.spec_from_file_location(name, DOCS / f"{name}.py")
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


hooks, check_site = load("hooks"), load("check_site")
api_pages = functools.cache(hooks.api_pages)


def code(path: Path) -> str:
    """The Python of a page as one program, every line where it stands in the page."""
    text = path.read_text()
    lines = [""] * (text.count("\n") + 1)
    for found in re.finditer(r"^```python\n(.*?)^```", text, flags=re.DOTALL | re.MULTILINE):
        first = text.count("\n", 0, found.start(1))
        if "--8<--" not in found[1]:
            lines[first : first + found[1].count("\n")] = found[1].splitlines()
    return "\n".join(lines)


# The page on extensions is run by test_extend.py, file by file.
SLOW = {"plug_into_trainer.md"}  # it proves an error
CODE = [pytest.param(path, id=str(path.relative_to(DOCS)), marks=pytest.mark.slow if path.name in SLOW else ()) for path in PAGES if code(path).strip() and path.name != "extend.md"]


@pytest.mark.parametrize("path", CODE)
def test_code_of_the_page_runs(path, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    # Proofs of shipped agents have tests of their own, and pages only print what comes out.
    monkeypatch.setattr("torchrl_sspl.evaluation.certify.Budget", lambda **_: Budget(boxes=200))
    state = torch.get_rng_state()
    try:
        exec(compile(code(path), str(path), "exec"), {"__name__": "page"})
    finally:
        torch.set_rng_state(state)


TRAIN = [
    pytest.param(line.split("#")[0].split()[2:], id=f"{path.stem}:{number}")
    for path in PAGES for number, line in enumerate(path.read_text().splitlines(), 1)
    if line.startswith("sspl train ") and "my_system" not in line and "--help" not in line  # of the reader's own
]  # fmt: skip


@pytest.mark.parametrize("words", TRAIN)
def test_lines_that_train_are_accepted(words, capsys):
    assert cli.main(["train", *words, *(() if "--cfg" in words else ("--cfg", "job"))]) == 0, capsys.readouterr().err


def test_code_of_a_page_keeps_its_lines(tmp_path):
    page = tmp_path / "page.md"
    page.write_text("# A\n\n```python\nx = 1\n```\n\ntext\n\n```python\nassert x == 2\n```\n")
    with pytest.raises(AssertionError) as caught:
        exec(compile(code(page), "page", "exec"), {})
    assert caught.traceback[-1].lineno == 9  # counted from 0
    assert len(CODE) >= 6


def test_every_public_name_has_a_place():
    """Against the snapshot of the public names, without building."""
    written = "\n".join(api_pages().values())
    lines = (ROOT / "tests" / "api_surface.txt").read_text().splitlines()
    missing = []
    for line in lines:
        package, name = line.split()
        constants = f"::: {package}.{name}\n" if package != "torchrl_sspl" else f'<a id="torchrl_sspl.{name}"></a>'
        if constants not in written:
            missing.append(line)
    assert not missing


def test_every_example_is_in_the_gallery_with_its_code():
    paths = hooks.examples()
    assert {p.stem for p in paths} >= {"inverted_pendulum", "plug_into_trainer"}
    for path in paths:
        last = path.read_text().rstrip().splitlines()[-1]
        assert f"examples/{path.name}" in hooks.gallery_index()
        assert last in hooks.gallery_page(path)


@pytest.mark.parametrize("path", PAGES, ids=lambda path: str(path.relative_to(DOCS)))
def test_links_between_pages_exist(path):
    generated = {f"gallery/{p.stem}.md" for p in hooks.examples()} | {"gallery/index.md", *api_pages()}
    generated |= {f"notebooks/{p.stem}.md" for p in hooks.notebooks()}
    text = re.sub(r"^```.*?^```", "", hooks.on_page_markdown(path.read_text()), flags=re.DOTALL | re.MULTILINE)
    for target in re.findall(r"\]\((?!https?:|mailto:)([^)#\s]+)", text):
        place = (path.parent / target).resolve()
        assert place.exists() or str(place.relative_to(DOCS)) in generated, target


def test_sections_of_the_readme_are_included_with_their_links_bent():
    page = hooks.on_page_markdown((DOCS / "index.md").read_text())
    section = (ROOT / "README.md").read_text().split("## What is guaranteed, and what is not\n")[1]
    assert section.strip().splitlines()[0] in page
    assert "](docs/" not in page
    with pytest.raises(ValueError, match="expected a section"):
        hooks.on_page_markdown("<!-- README: No such section -->")


def test_roles_and_formulas_become_markdown():
    text = "A :math:`a\n    b` of :class:`~x.y.Z` and ``f()``.\n\n.. math:: c\n\nText.\n\n    .. math::\n        d &= e \\\\\n        f\n\nEnd."
    done = hooks.to_markdown(text)
    assert "\\(a b\\) of `Z` and `f()`" in done
    assert "$$\nc\n$$" in done
    assert "    \\begin{aligned} d &= e \\\\ f \\end{aligned}\n    $$" in done
    assert done.endswith("End.")
    for left in (":math:", ".. math", ":class:"):
        assert left not in done


def test_tables_of_docstrings_become_markdown():
    text = "Keys:\n\n==== =====\nkey  shape\n==== =====\na    b c\n==== =====\n\nEnd."
    assert "| key | shape |\n|---|---|\n| a | b c |" in hooks.to_markdown(text)


@pytest.mark.parametrize(
    ("page", "problem"),
    [
        ('<a href="gone.html">x</a>', "no file"),
        ('<a href="#gone">x</a>', "no anchor for #gone"),
        ('<a href="other.html#gone">x</a>', "no anchor for other"),
        ('<script src="https://elsewhere.example/x.js"></script>', "loads"),
        ('<link rel="stylesheet" href="//elsewhere.example/x.css">', "loads"),
        ("", "public name pkg.name"),
    ],
)
def test_a_broken_site_is_seen(tmp_path, page, problem):
    (tmp_path / "index.html").write_text(page)
    (tmp_path / "other.html").write_text('<h2 id="there">x</h2>')
    found = check_site.problems(tmp_path, ["pkg.name"] if not page else [])
    assert len(found) == 1
    assert problem in found[0]


def test_a_good_site_passes(tmp_path):
    (tmp_path / "index.html").write_text('<a href="other.html#pkg.name">x</a> <a href="https://example.org">y</a>')
    (tmp_path / "other.html").write_text('<h2 id="pkg.name">x</h2> <a href="#pkg.name">up</a>')
    assert check_site.problems(tmp_path, ["pkg.name"]) == []


@pytest.mark.slow
@pytest.mark.parametrize("path", hooks.notebooks(), ids=lambda path: path.stem)
def test_notebook_runs(path, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    names: dict[str, object] = {"__name__": "notebook"}
    for number, (kind, text) in enumerate(hooks.cells(path)):
        if kind == "code":
            exec(compile(text, f"{path.stem}, cell {number}", "exec"), names)


def test_notebooks_are_saved_without_outputs_and_are_pages():
    assert [p.stem for p in hooks.notebooks()] == ["certify_your_own", "quickstart"]
    for path in hooks.notebooks():
        assert all(not cell.get("outputs") for cell in json.loads(path.read_text())["cells"])
        assert all(text in hooks.notebook_page(path) for _, text in hooks.cells(path))


@pytest.mark.slow
def test_site_builds_without_warnings_and_passes_its_checks(tmp_path):
    pytest.importorskip("mkdocstrings")
    build = [sys.executable, "-m", "mkdocs", "build", "--strict", "--site-dir", str(tmp_path)]
    done = subprocess.run(build, cwd=ROOT, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr[-3000:]
    names = [".".join(line.split()) for line in (ROOT / "tests" / "api_surface.txt").read_text().splitlines()]
    assert check_site.problems(tmp_path, names) == []
