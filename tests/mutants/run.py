"""Changes lines of the library one at a time, and sees that the tests notice.

    python tests/mutants/run.py [area ...] [--only N ...] [--share K/N]

Areas are the data files beside this one; each has a list MUTANTS of (file, old text, new text, tests[, why it survives]).
Mutants are made in a temporary copy of package and tests, one child process each; what is not the library's own is imported
once. It fails if the tests do not pass unchanged, if a mutant survives that is not explained, if an explained one is killed,
or if fewer than 95 % are killed.
"""

from __future__ import annotations

import argparse
import importlib.util
import os
import shutil
import sys
import tempfile
import time
from pathlib import Path

HERE = Path(__file__).resolve().parent
ROOT = HERE.parents[1]
REQUIRED = 0.95


def read(area: str) -> list[tuple[str, ...]]:
    """The mutants of an area."""
    spec = importlib.util.spec_from_file_location(f"mutants_{area}", HERE / f"{area}.py")
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module.MUTANTS


def areas() -> list[str]:
    """Names of the data files."""
    return sorted(p.stem for p in HERE.glob("*.py") if p.stem != "run")


def mutated(mutant: tuple[str, ...], source: str) -> str:
    """The source with the one change.

    Raises:
        ValueError: if the old text is not there exactly once.
    """
    old, new = mutant[1:3]
    if source.count(old) != 1 or old == new:
        raise ValueError(f"expected the text once in {mutant[0]} and another one for it, received {source.count(old)} of {old!r}")
    return source.replace(old, new)


def run_tests(copy: Path, tests: str, log: Path) -> int:
    """Exit status of the tests on the copy, in a child; what this process has imported need not be imported again."""
    child = os.fork()
    if child == 0:
        output = os.open(log, os.O_WRONLY | os.O_CREAT | os.O_TRUNC)
        os.dup2(output, 1)
        os.dup2(output, 2)
        import pytest

        import torchrl_sspl

        status = 3
        if str(copy) in str(torchrl_sspl.__file__):
            options = ["-x", "-q", "-p", "no:cacheprovider", "-m", "not slow", "--rootdir", str(copy)]
            status = int(pytest.main([*options, "--basetemp", str(copy.parent / "base"), *tests.split()]))
        os._exit(status)
    return os.waitstatus_to_exitcode(os.waitpid(child, 0)[1])


def prepare(folder: Path) -> Path:
    """The copy, ahead of everything else on the path."""
    copy = folder / "copy"
    for part in ("torchrl_sspl", "tests"):
        shutil.copytree(ROOT / part, copy / part, ignore=shutil.ignore_patterns("__pycache__"))
    shutil.copy(ROOT / "pyproject.toml", copy)
    os.chdir(copy)
    # What is compiled of a mutant must not stand for what comes after it, here or in a process that a test starts.
    sys.dont_write_bytecode, os.environ["PYTHONDONTWRITEBYTECODE"] = True, "1"
    sys.path[:] = [str(copy), str(copy / "tests"), *(p for p in sys.path if p and Path(p).resolve() not in (ROOT, HERE))]
    sys.meta_path[:] = [finder for finder in sys.meta_path if "editable" not in repr(finder).lower()]
    os.environ["OMP_NUM_THREADS"] = "1"
    for name in ("torch", "torchrl.envs", "torchrl.data", "torchrl.objectives", "gymnasium", "scipy.stats", "pytest", "tqdm"):
        importlib.import_module(name)
    import torch

    torch.set_num_threads(1)
    return copy


def main(arguments: list[str]) -> int:
    """Runs and prints; 0 if enough are killed."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("areas", nargs="*", metavar="area", help=f"of {', '.join(areas())}; all if none is given")
    parser.add_argument("--only", type=int, nargs="*", help="numbers of mutants")
    parser.add_argument("--share", default="1/1", help="K/N: every Nth mutant, from the Kth")
    chosen = parser.parse_args(arguments)
    which, of = (int(v) for v in chosen.share.split("/"))
    mutants = [(area, i, m) for area in chosen.areas or areas() for i, m in enumerate(read(area))]
    mutants = [m for m in mutants if chosen.only is None or m[1] in chosen.only][which - 1 :: of]
    killed, wrong = 0, []
    with tempfile.TemporaryDirectory() as folder:
        copy, log = prepare(Path(folder)), Path(folder) / "log"
        unchanged: dict[str, int] = {}
        for area, i, mutant in mutants:
            file, old, new, tests = mutant[:4]
            if unchanged.setdefault(tests, -1) == -1:
                unchanged[tests] = run_tests(copy, tests, log)
                if unchanged[tests]:
                    print(f"the tests fail unchanged: {tests}\n{log.read_text()[-3000:]}", flush=True)
                    return 1
            path, start = copy / file, time.monotonic()
            source = path.read_text()
            path.write_text(mutated(mutant, source))
            status = run_tests(copy, tests, log)
            path.write_text(source)
            dead = status == 1 or (status == 2 and "Error" in log.read_text())  # 2: it cannot even be imported
            killed += dead
            expected = len(mutant) == 4
            if dead != expected:
                wrong.append(i)
            word = "killed" if dead else f"SURVIVED ({status})"
            print(f"{area} {i:3d} {word} {time.monotonic() - start:.0f} s  {file}: {old[:60]!r} -> {new[:60]!r}", flush=True)
    share = killed / len(mutants) if mutants else 0.0
    print(f"{killed} of {len(mutants)} killed ({100 * share:.1f} %), not as expected: {wrong}")
    return int(bool(wrong) or share < REQUIRED)


if __name__ == "__main__":
    raise SystemExit(main(sys.argv[1:]))
