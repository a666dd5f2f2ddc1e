# One command from a clean clone:   make train
# Every target sets up .venv first if it has to; the second time that costs nothing.
#
#   make train ARGS="env=reach_fixed seed=3"     Hydra overrides go into ARGS
#   make results ROW=reach-cpu                   measure one row of docs/results.md again
#   make clean setup PYTHON=/opt/python3.12      choose the interpreter yourself

SHELL := /bin/bash
.DEFAULT_GOAL := help
.DELETE_ON_ERROR:

ARGS ?=
PYTHON ?=
ROW ?=
VENV := .venv
STAMP := $(VENV)/.installed
BIN := $(VENV)/bin

.PHONY: help setup train test results mutation lint format lock clean

help: ## show the targets
	@grep -hE '^[a-z]+:.*## ' $(firstword $(MAKEFILE_LIST)) | sed -E 's/:[^#]*## /\t/' | \
	  while IFS=$$'\t' read -r name text; do printf '  make %-8s %s\n' "$$name" "$$text"; done

# The stamp is written last, by a script that stops at the first failure: if it is there and newer than
# what the installation depends on, the installation is whole.
$(STAMP): requirements.lock pyproject.toml scripts/setup.sh
	@PYTHON="$(PYTHON)" scripts/setup.sh "$(VENV)" "$(STAMP)"

setup: $(STAMP) ## make .venv and install the locked packages

train: $(STAMP) ## train, plan and evaluate; Hydra overrides in ARGS="..."
	@$(BIN)/python train.py $(ARGS)

# Two processes with a thread each: tests are small, and torch's threads would wait for each other.
test: $(STAMP) ## run the tests; pytest options in ARGS="..."
	@OMP_NUM_THREADS=1 $(BIN)/python -m pytest -n 2 --dist loadfile $(ARGS)

# Numbers come from the files in docs/results/, which runs wrote: benchmarks/results/rows.yaml declares them.
results: $(STAMP) ## which results are older than the code; ROW=name measures one again
	@if [[ -n "$(ROW)" ]]; then $(BIN)/python -m benchmarks.results run $(ROW) $(ARGS); fi
	@$(BIN)/python -m benchmarks.results render
	@$(BIN)/python -m benchmarks.results list

# Not in CI: every mistake runs tests of seconds. Its tool is not locked; nothing else needs it.
mutation: $(STAMP) ## which small mistakes in the code no test notices (hours; ARGS="--sample 40")
	@$(BIN)/python -c 'import cosmic_ray' 2>/dev/null || \
	  $(BIN)/python -m pip install --quiet --disable-pip-version-check cosmic-ray==8.7.0
	@$(BIN)/python scripts/mutation.py $(ARGS)

lint: $(STAMP) ## ruff check, ruff format --check, pyright
	@$(BIN)/ruff check .
	@$(BIN)/ruff format --check .
	@$(BIN)/pyright

format: $(STAMP) ## let ruff fix and format the code
	@$(BIN)/ruff check --fix .
	@$(BIN)/ruff format .

# Needs uv, which is installed into .venv for the purpose. Versions already locked stay as they are;
# `make lock ARGS=--upgrade` takes the newest. The lock must not tie a reader to one package index.
lock: $(STAMP) ## write requirements.lock anew from pyproject.toml
	@$(BIN)/python -m pip install --quiet --disable-pip-version-check uv
	@$(BIN)/uv pip compile pyproject.toml --extra dev --universal --python-version 3.12 --generate-hashes \
	  --no-emit-index-url --no-emit-find-links --no-annotate --no-header --quiet $(ARGS) -o requirements.lock
	@if grep -n '://' requirements.lock; then echo 'requirements.lock holds addresses (above)' >&2; exit 1; fi

clean: ## remove .venv and what tools left behind; outputs/ and datasets/ stay
	rm -rf $(VENV) build dist *.egg-info .pytest_cache .ruff_cache .hypothesis
	find . -name __pycache__ -type d -prune -exec rm -rf {} +
