# Each target sets up everything it needs in .venv and then runs.
PYTHON ?= python3
VENV := .venv
BIN := $(VENV)/bin
# Python compiles what is imported when it is imported: to compile all of it takes about as long as the rest of the installation.
PIP_INSTALL = $(BIN)/pip install --quiet --disable-pip-version-check --no-compile -c constraints.txt
# It has to keep what it has compiled: else every process that the tests start compiles all of torch and TorchRL anew, 4 of its 7 s.
unexport PYTHONDONTWRITEBYTECODE

.PHONY: pendulum quadruped demo table test types suite docs wheel release-check clean

pendulum: $(VENV)/.viz
	$(BIN)/python examples/inverted_pendulum.py $(ARGS)

quadruped: $(VENV)/.quadruped
	$(BIN)/python examples/quadruped_obstacle.py $(ARGS)

# The shipped agent in full physics: a film and a report in runs/demo.
demo: $(VENV)/.quadruped
	OMP_NUM_THREADS=1 $(BIN)/python examples/quadruped_obstacle.py agent=quadruped evaluation.episodes=0 evaluation.walks=20 out_dir=runs/demo $(ARGS)

# The paper's Table I in numbers; cells that have been measured are read. ARGS="methods=latent_cbf budget=full seed=0,1,2 jobs=2".
table: $(VENV)/.viz $(VENV)/.quadruped
	OMP_NUM_THREADS=1 $(BIN)/python -m torchrl_sspl.baselines table $(ARGS)

test: $(VENV)/.test
	$(BIN)/ruff check .
	$(MAKE) --no-print-directory --jobs=2 types suite

types: $(VENV)/.test
	$(BIN)/mypy

suite: $(VENV)/.test
	OMP_NUM_THREADS=1 $(BIN)/python -m pytest -n auto --dist worksteal -m "not slow and not gpu and not ray"

docs: $(VENV)/.docs
	NO_MKDOCS_2_WARNING=1 $(BIN)/python -m mkdocs build --strict
	$(BIN)/python docs/check_site.py build/site tests/api_surface.txt
	@echo "open build/site/index.html"

wheel: $(VENV)/.release
	$(BIN)/python -m build

# Builds, installs the wheel into a fresh environment and runs the tests against it, outside the checkout.
release-check: wheel
	sh tests/check_wheel.sh $(PYTHON) dist

$(VENV)/bin/python:
	$(PYTHON) -m venv $(VENV)

# One stamp per extra: nothing is installed twice, everything again when the requirements change.
$(VENV)/.%: $(VENV)/bin/python pyproject.toml constraints.txt
	$(PIP_INSTALL) -e '.[$*]'
	@touch $@

clean:
	rm -rf $(VENV) build dist *.egg-info .pytest_cache .mypy_cache .ruff_cache
