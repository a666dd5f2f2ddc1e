# One command from a clean clone:   make train
# Every target sets up .venv first if it has to; the second time that costs nothing.
#
#   make train ARGS="env=reach_fixed seed=3"     Hydra overrides go into ARGS
#   make results ROW="reach-cpu muzero-cpu"      measure rows of docs/results.md again
#   make clean setup PYTHON=/opt/python3.12      choose the interpreter yourself

SHELL := /bin/bash
.DEFAULT_GOAL := help
.DELETE_ON_ERROR:

ARGS ?=
PYTHON ?=
ROW ?=
REPOSITORY ?=
MINUTES ?= 60
VENV := .venv
STAMP := $(VENV)/.installed
DEV := $(VENV)/.installed-dev
BIN := $(VENV)/bin

.PHONY: help setup train demo demo-agent test test-slow results mutation fuzz lint format lock docs wheel audit clean

help: ## show the targets
	@grep -hE '^[a-z-]+:.*## ' $(firstword $(MAKEFILE_LIST)) | sed -E 's/:[^#]*## /\t/' | \
	  while IFS=$$'\t' read -r name text; do printf '  make %-10s %s\n' "$$name" "$$text"; done

# The stamp is written last, by a script that stops at the first failure: if it is there and newer than
# what the installation depends on, the installation is whole.
$(STAMP): requirements.lock pyproject.toml scripts/setup.sh
	@PYTHON="$(PYTHON)" scripts/setup.sh "$(VENV)" "$(STAMP)" requirements.lock

# The packages for tests, linting and documentation hold those for running, at the same versions.
$(DEV): requirements-dev.lock requirements.lock pyproject.toml scripts/setup.sh
	@PYTHON="$(PYTHON)" scripts/setup.sh "$(VENV)" "$(DEV)" requirements-dev.lock
	@touch "$(STAMP)" "$(DEV)"

setup: $(STAMP) ## make .venv and install what running needs

train: $(STAMP) ## train, plan and evaluate; Hydra overrides in ARGS="..."
	@$(BIN)/python train.py $(ARGS)

demo: $(STAMP) ## the live page with a small trained agent; no training, no network
	@$(BIN)/franka-wm demo $(ARGS)

# When the model's code has changed so that the weights in franka_wm/demo_agent no longer load.
demo-agent: $(STAMP) ## train that agent anew (ten minutes on two CPU cores)
	@$(BIN)/python scripts/make_demo_agent.py $(ARGS)

# Two processes with a thread each: tests are small, and torch's threads would wait for each other. Bytecode is kept even
# where the environment forbids it: without, each process that a test starts compiles torch anew, which takes seconds.
# Files begin in the order that tests/conftest.py gives them.
PYTEST = PYTHONDONTWRITEBYTECODE= OMP_NUM_THREADS=1 $(BIN)/python -m pytest -n 2 --dist loadfile --no-loadscope-reorder

test: $(DEV) ## run the quick tests; pytest options in ARGS="..."
	@$(PYTEST) -m "not slow" $(ARGS)

test-slow: $(DEV) ## run the slow tests; continuous integration runs a few of them
	@$(PYTEST) -m slow $(ARGS)

# Numbers come from the files in docs/results/, which runs wrote: benchmarks/results/rows.yaml declares them.
results: $(DEV) ## which results are older than the code; ROW="name …" measures some again
	@if [[ -n "$(ROW)" ]]; then $(BIN)/python -m benchmarks.results run $(ROW) $(ARGS); fi
	@$(BIN)/python -m benchmarks.results render
	@$(BIN)/python -m benchmarks.results list

# Not in CI: every mistake runs tests of seconds. Its tool is not locked; nothing else needs it.
mutation: $(DEV) ## which small mistakes in the code no test notices (hours; ARGS="--sample 40")
	@$(BIN)/python -c 'import cosmic_ray' 2>/dev/null || \
	  $(BIN)/python -m pip install --quiet --disable-pip-version-check cosmic-ray==8.7.0
	@$(BIN)/python scripts/mutation.py $(ARGS)

# What it finds becomes files in tests/fuzz/cases, which the tests run from then on.
fuzz: $(DEV) ## damaged checkpoints, runs, datasets, robots and options for MINUTES=60; ARGS="config --seed 3"
	@OMP_NUM_THREADS=1 HF_HUB_OFFLINE=1 $(BIN)/python tests/fuzz --minutes $(MINUTES) $(ARGS)

lint: $(DEV) ## ruff check, ruff format --check, pyright
	@$(BIN)/ruff check .
	@$(BIN)/ruff format --check .
	@$(BIN)/pyright --threads 2

format: $(DEV) ## let ruff fix and format the code
	@$(BIN)/ruff check --fix .
	@$(BIN)/ruff format .

# Versions already locked stay as they are; `make lock ARGS=--upgrade` takes the newest. The locks must not tie a
# reader to one package index.
COMPILE = $(BIN)/uv pip compile pyproject.toml --group install --universal --python-version 3.12 --generate-hashes \
  --no-emit-index-url --no-emit-find-links --no-annotate --no-header --quiet $(ARGS)

lock: $(DEV) ## write the requirements*.lock files anew from pyproject.toml
	@[[ -x $(BIN)/uv ]] || $(BIN)/python -m pip install --quiet --disable-pip-version-check uv
	@$(COMPILE) --extra view -o requirements.lock
	@$(COMPILE) --extra dev -c requirements.lock -o requirements-dev.lock
	@if grep -n '://' requirements*.lock; then echo 'the locks hold addresses (above)' >&2; exit 1; fi

# Warnings are errors: a link that leads nowhere, a page that no one can reach. The variable silences an advertisement.
docs: $(DEV) ## the documentation as a site, in site/
	@NO_MKDOCS_2_WARNING=1 $(BIN)/mkdocs build --quiet
	@echo "open site/index.html"

# With the repository's address, README's pictures and links work on a package index: setup.py says how.
wheel: $(DEV) ## build dist/*.whl; REPOSITORY=https://… for a package index
	@rm -rf build # of an earlier wheel: files that are gone would come back
	@REPOSITORY="$(REPOSITORY)" $(BIN)/python -m build --wheel --no-isolation --outdir dist .

# Its tools are not locked, and have a folder of their own: they would change locked packages. Needs the network, and the answer
# changes from day to day; the list of packages (sbom.json) comes from the lock alone. The lock for development holds the other.
AUDIT := $(VENV)/audit
audit: $(DEV) ## known vulnerabilities of the locked packages, and sbom.json (CycloneDX)
	@[[ -x $(AUDIT)/bin/pip-audit ]] || { $(BIN)/python -m venv $(AUDIT) && $(AUDIT)/bin/python -m pip install --quiet \
	  --disable-pip-version-check pip-audit==2.10.1 cyclonedx-bom==7.5.0; } || echo 'make audit: its tools cannot be installed'
	@[[ ! -x $(AUDIT)/bin/cyclonedx-py ]] || $(AUDIT)/bin/cyclonedx-py requirements requirements.lock -o sbom.json
	@$(BIN)/python scripts/audit.py $(AUDIT)/bin/pip-audit requirements-dev.lock

clean: ## remove .venv and what tools left behind; outputs/ and datasets/ stay
	rm -rf $(VENV) build dist *.egg-info .pytest_cache .ruff_cache .hypothesis
	find . -name __pycache__ -type d -prune -exec rm -rf {} +
