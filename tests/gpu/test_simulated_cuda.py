"""The tests that need a GPU, on a simulated one: every tensor has to be on the device where a GPU would want it."""

from __future__ import annotations

import json
import os
import shutil
import subprocess
import sys
from pathlib import Path

import pytest
import torch
from simulated_cuda import build
from test_gpu import saving_experiment

HERE = Path(__file__).parent
#: Files that have such tests; to collect all of them takes ten seconds.
WITH_A_GPU = sorted(str(path) for path in HERE.parent.rglob("test_*.py") if "mark.gpu" in path.read_text())
COMPILER = os.environ.get("CXX") or shutil.which("c++")
pytestmark = [
    pytest.mark.slow,
    pytest.mark.skipif(COMPILER is None, reason="needs a C++ compiler"),
    pytest.mark.skipif(torch.cuda.is_available(), reason="there is a GPU: run the tests marked gpu on it"),
    pytest.mark.skipif(torch.version.cuda is not None, reason="functions of a torch that is built for a GPU are not replaced"),
    pytest.mark.skipif(not sys.platform.startswith("linux"), reason="replaces functions of torch as Linux links them"),
]


@pytest.fixture(scope="module")
def environment(tmp_path_factory) -> dict[str, str]:
    library = build(COMPILER, tmp_path_factory.mktemp("device"))
    path = os.pathsep.join(filter(None, [str(HERE), str(HERE.parent), os.environ.get("PYTHONPATH", "")]))
    return os.environ | {"SIMULATED_CUDA": str(library), "PYTHONPATH": path}


def python(environment: dict[str, str], *arguments: str) -> subprocess.CompletedProcess[str]:
    command = [sys.executable, *arguments]
    return subprocess.run(command, env=environment, cwd=HERE.parents[1], capture_output=True, text=True, timeout=1800)


#: What a GPU refuses, with a part of the message.
REFUSED = {
    "there + here": "Expected all tensors to be on the same device",
    "torch.where(there > 0, there, here)": "Expected all tensors to be on the same device",
    "torch.nn.functional.linear(here, there[None])": "Expected all tensors to be on the same device",
    "here[there.long()]": "on the same device",
    "torch.rand(3, device='cuda', generator=torch.Generator())": "Expected a 'cuda' device type for generator",
    "there.numpy()": "can't convert cuda:0 device type tensor to numpy",
}
TRY = """
import json, sys, simulated_cuda, torch
here = torch.ones(3)
there = here.cuda()
there[here.long() - 1] + 1
said = {}
for code in sys.argv[1:]:
    try:
        eval(code)
    except Exception as error:
        said[code] = str(error)
print(json.dumps(said))
"""


def test_it_refuses_what_a_gpu_refuses(environment):
    found = python(environment, "-c", TRY, *REFUSED)
    assert found.returncode == 0, found.stderr
    said = json.loads(found.stdout)
    assert said.keys() == REFUSED.keys()
    assert all(part in said[code] for code, part in REFUSED.items()), said


@pytest.mark.slow
def test_a_run_that_began_on_a_gpu_goes_on_without_one(environment, tmp_path):
    code = "import simulated_cuda, test_gpu; from pathlib import Path; "
    code += f"test_gpu.interrupt(test_gpu.saving_experiment(Path({str(tmp_path)!r}), 'cuda'))"
    assert "InterruptedError" in python(environment, "-c", code).stderr
    experiment = saving_experiment(tmp_path, "cpu")
    experiment.train()
    assert experiment.trainer.resumed
    assert experiment.trainer.collected_frames == 512


@pytest.mark.parametrize("chosen", ["gpu and not slow", pytest.param("gpu and slow", marks=pytest.mark.slow)])
def test_what_needs_a_gpu_works_on_it(environment, chosen):
    found = python(environment, "-m", "pytest", "-p", "simulated_cuda", "-p", "no:cacheprovider", "-m", chosen, "-rs", *WITH_A_GPU)
    assert found.returncode == 0, found.stdout[-8000:]
    assert "CUDA device" not in found.stdout, found.stdout[-2000:]  # the reason for which they are skipped
