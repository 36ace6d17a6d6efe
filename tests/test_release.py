"""What is released: the wheel and the sdist hold what they should, and the wheel works outside the checkout."""

from __future__ import annotations

import re
import shutil
import subprocess
import sys
import tarfile
import tomllib
import venv
import zipfile
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
if not (ROOT / "torchrl_sspl").is_dir():
    pytest.skip("needs a checkout", allow_module_level=True)
PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]


def test_version_is_the_same_everywhere():
    text = (ROOT / "torchrl_sspl" / "__init__.py").read_text()
    assert re.search(r'__version__ = "(.*)"', text)[1] == PROJECT["version"]


def test_constraints_lie_within_the_declared_ranges():
    from packaging.requirements import Requirement

    lines = (ROOT / "constraints.txt").read_text().splitlines()
    pins = dict(re.split("==", line.lower()) for line in lines if "==" in line)
    wanted = PROJECT["dependencies"] + [r for extra in PROJECT["optional-dependencies"].values() for r in extra]
    requirements = [r for r in map(Requirement, wanted) if r.name != PROJECT["name"]]
    for requirement in requirements:
        assert requirement.name.lower() in pins, f"no pin for {requirement.name}"
        assert requirement.specifier.contains(pins[requirement.name.lower()]), requirement


def test_extra_all_is_all_extras():
    extras = PROJECT["optional-dependencies"]
    listed = re.search(r"\[(.*)\]", extras["all"][0])[1].split(",")
    assert set(listed) == set(extras) - {"all"}


@pytest.fixture(scope="module")
def built(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Path]:
    """Wheel and sdist of the files that git knows."""
    pytest.importorskip("build", reason="needs the extra release")
    source, out = tmp_path_factory.mktemp("source"), tmp_path_factory.mktemp("dist")
    for name in ("torchrl_sspl", "pyproject.toml", "README.md", "LICENSE", "CHANGELOG.md"):
        copy = shutil.copytree if (ROOT / name).is_dir() else shutil.copy
        copy(ROOT / name, source / name)
    done = subprocess.run(
        [sys.executable, "-m", "build", "--no-isolation", "--outdir", str(out)], cwd=source, capture_output=True, text=True
    )
    assert done.returncode == 0, done.stdout[-2000:] + done.stderr[-2000:]
    return next(out.glob("*.whl")), next(out.glob("*.tar.gz"))


@pytest.mark.slow
def test_wheel_holds_the_package_its_types_the_agents_and_the_templates(built):
    names = zipfile.ZipFile(built[0]).namelist()
    sources = {str(p.relative_to(ROOT)) for p in (ROOT / "torchrl_sspl").rglob("*.py") if "__pycache__" not in p.parts}
    assert sources <= set(names)
    assert "torchrl_sspl/py.typed" in names
    for folder in ("agents", "viz/templates"):
        files = {str(p.relative_to(ROOT)) for p in (ROOT / "torchrl_sspl" / folder).rglob("*") if p.is_file()}
        assert files
        assert files <= set(names)
    assert not [n for n in names if n.startswith(("tests/", "docs/", "examples/")) or n.endswith(".pyc")]
    assert any(n.endswith("licenses/LICENSE") for n in names)


@pytest.mark.slow
def test_sdist_builds_the_same_package(built):
    with tarfile.open(built[1]) as archive:
        inside = {name.split("/", 1)[-1] for name in archive.getnames()}
    modules = {n for n in zipfile.ZipFile(built[0]).namelist() if n.startswith("torchrl_sspl/")}
    assert modules <= inside


@pytest.mark.slow
def test_wheel_works_outside_the_checkout(built, tmp_path):
    """A fresh environment that borrows this one's dependencies; `make release-check` installs them, too."""
    venv.create(tmp_path / "venv", with_pip=False)
    python = tmp_path / "venv" / "bin" / "python"
    install = ["install", "--quiet", "--disable-pip-version-check", "--no-deps", "--no-index", str(built[0])]
    subprocess.run([sys.executable, "-m", "pip", "--python", str(python), *install], check=True)
    packages = next((tmp_path / "venv" / "lib").glob("python*/site-packages"))
    # A folder in a .pth file is searched last, and its own .pth files (an editable install) are not read.
    (packages / "borrowed.pth").write_text("\n".join(p for p in sys.path if p.endswith("site-packages")))
    code = (
        "import torch, torchrl_sspl as s; print(s.__file__); a = s.load('pendulum');"
        "e = s.envs.PendulumEnv(batch_size=[2], image_size=64, seed=0);"
        "print((a.act(e.observe(torch.tensor([[0.2, 0.0], [3.0, 0.0]])))[1].flatten() <= 0).tolist())"
    )
    done = subprocess.run([python, "-c", code], cwd=tmp_path, capture_output=True, text=True, check=True)
    place, verdict = done.stdout.split("\n")[:2]
    assert Path(place).is_relative_to(packages)
    assert verdict == "[True, False]"
